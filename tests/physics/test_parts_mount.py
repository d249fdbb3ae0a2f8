"""A mount that gives way: closed forms, energy, linear models; and a guard that sees leakage."""

import math

import numpy as np
import pytest
from with_parts import books, jacobian, linear_models_agree, moved, steps, swing

from ehbench.config.rig import Rig
from ehbench.control.axis import Mechanism, axis_of, hydraulic_frequency
from ehbench.machines.virtual import VirtualMachine
from ehbench.parts.friction import friction_force
from ehbench.parts.mount import piston_of, push_of
from ehbench.parts.sway import Sway
from ehbench.plant.derivatives import derivatives
from ehbench.plant.design_point import circuit_of
from ehbench.plant.integrate import STEP
from ehbench.plant.model import Model, simulate
from tests.shared import slide

SOFT = {"stiffness": "10 kN/mm", "damping": "6000 N*s/m"}
SEALS = {"friction_coulomb": "200 N", "friction_viscous": "400 N*s/m"}
BREAKS = {"friction_static": "400 N", "stribeck_speed": "20 mm/s"}
BRISTLES = BREAKS | {"bristle_stiffness": "2 kN/mm", "bristle_damping": "4 kN*s/m"}
FRICTIONS = {
    "plain": {},
    "stribeck": {"friction": {"law": "stribeck"} | BREAKS},
    "lugre": {"friction": {"law": "lugre"} | BRISTLES},
}


def mounted(mount: dict = SOFT, **parts) -> Rig:
    """The sliding mass on a mount that gives way."""
    return slide(mount=mount, **parts)


def test_oil_and_mount_are_springs_in_series():
    """Valves shut: ``m s² (c s + k + k_o) + k_o (c s + k) = 0``; where the damper takes little,
    ``ω² = 1/(1/k_o + 1/k)/m``. The controllers' estimate is that."""
    little = SOFT | {"damping": "200 N*s/m"}
    for mount, damping in ((SOFT, 6000.0), (little, 200.0)):
        model = Model.of(mounted(mount).with_values({"carriage.damping": 0.0}))
        oil, k, mass = swing(model), 1e7, 250.0
        exact = np.roots([mass * damping, mass * (k + oil), oil * damping, oil * k])
        found = np.linalg.eigvals(jacobian(model))
        for pole in exact:
            assert found[np.argmin(np.abs(found - pole))] == pytest.approx(pole, rel=1e-5)
    series = math.sqrt(1.0 / (1.0 / oil + 1.0 / k) / mass)
    assert np.abs(exact.imag).max() == pytest.approx(series, rel=1e-3)
    plant, q = model.plant, model.posture(None)
    mechanism = Mechanism(plant.kind, plant.gravity, plant.links, plant.cylinders.joint, q)
    axis = axis_of(circuit_of(model, 0), mechanism, plant.cylinders[0], plant.forces)
    assert hydraulic_frequency(axis) == pytest.approx(series, rel=1e-9)


def test_a_mount_rests_where_it_carries_the_load():
    """Uphill ``k δ = m g sin(incline)``, the piston so much further out; nothing moves then."""
    model = Model.of(mounted().with_values({"carriage.incline": 0.5}))
    y = model.trim(model.posture({"press": "200 mm"}))
    given = y[model.layout.state("mount_deflection")]
    assert given == pytest.approx(250.0 * 9.80665 * math.sin(0.5) / 1e7, rel=1e-9)
    row = model.plant.cylinders[0]
    assert piston_of(row, 0.2, 0.0, y, model.plant) == pytest.approx((0.2 + given, 0.0))
    log = model.run(y, model.rest_commands(300))
    assert np.ptp(log[:, 0]) < 1e-9
    assert np.ptp(log[:, model.layout.state("mount_deflection")]) < 1e-9


@pytest.mark.parametrize("law", FRICTIONS)
def test_the_balance_of_forces_holds_and_the_ledger_closes(law):
    """``c (u − v) = A1 P1 − A2 P2 − friction(u) − k δ``, also in the end stops."""
    parts = FRICTIONS[law] | SEALS
    model = Model.of(mounted(**parts))
    row, plant = model.plant.cylinders[0], model.plant
    rng = np.random.default_rng(4)
    for _ in range(200):
        y = model.trim(model.posture(None))
        y[model.layout.state("p_head")] = rng.uniform(0.0, 1e7)
        y[row.mount_state], v = rng.uniform(-1e-3, 1e-3), rng.uniform(-0.3, 0.3)
        if row.friction_state >= 0:
            y[row.friction_state] = rng.uniform(-1e-4, 1e-4)
        x, u = piston_of(row, 0.2, v, y, plant)
        force = push_of(row, y, plant) - friction_force(row, u, y)
        taken = 6000.0 * (u - v) + 1e7 * y[row.mount_state]
        assert x == 0.2 + y[row.mount_state]
        assert taken == pytest.approx(force, abs=1e-8 * abs(push_of(row, y, plant)))
    # To what RK4 leaves over, as without; k δ²/2 is stored, c ∫(dδ/dt)² dt lost. The damper is
    # steeper than any friction here falls, 0.86·200 N/(20 mm/s)
    rig = mounted(SOFT | {"damping": "1e4 N*s/m"}, **parts)
    record = moved(rig)
    ledger = books(rig, record, "press.mount", "press.mount_spring", "press.work")
    given = record["press.mount_deflection"]
    stored = 0.5e7 * (given[-1] ** 2 - given[0] ** 2)
    assert ledger["press.mount_spring"].energy == pytest.approx(stored, rel=1e-9)
    lost = 1e4 * np.trapezoid(np.gradient(given, record.t) ** 2, record.t)
    assert ledger["press.mount"].energy == pytest.approx(lost, rel=0.05)


def test_a_stiff_mount_is_none_and_a_record_starts_on_its_own():
    """And the guard sees how quick it is: 2e10 N/m over 20 µs times that."""
    hard = {"stiffness": "20 MN/mm", "damping": "4e5 N*s/m"}
    commands = {"press.servo": steps((4.0, -3.0))[300:750]}
    found = [simulate(rig, commands, 0.449)["press.v"] for rig in (mounted(hard), slide())]
    assert np.abs(found[0] - found[1]).max() < 2e-3 * np.abs(found[1]).max()
    model = Model.of(mounted(hard))
    y = model.trim(model.posture(None))
    dy, work = np.empty_like(y), np.empty(model.plant.at.work)
    rate = derivatives(y, model.rest_commands(1)[0], model.plant, dy, work)
    assert rate == pytest.approx((2e10 + swing(model)) / 4e5, rel=1e-6)
    assert 1e3 * STEP < rate * STEP < 1e5 * STEP
    model = Model.of(mounted().with_values({"carriage.incline": 0.3}))
    table = model.rest_commands(500)
    table[100:300, 0] = 3.0
    start = model.trim(model.posture(None))
    record = model.record(np.arange(500) * 1e-3, table, model.run(start, table))
    kept = {k: v for k, v in record.channels.items() if k != "press.mount_deflection"}
    again = model.replay(type(record)(record.t, kept, record.meta))
    assert np.allclose(again["press.mount_deflection"], record["press.mount_deflection"], atol=1e-9)


@pytest.mark.parametrize("way", [0, 1])
def test_a_linear_model_has_the_mount(way):
    """From the equations as from differences of the plant; the point is a steady motion."""
    rig = mounted(**SEALS).with_values({"press.leakage_internal": 2e-12})
    linear_models_agree(rig, way, {"mount_deflection": 1e-3})


def test_the_virtual_bench_and_the_rig_file_have_the_mount():
    """Its position channels are the linkage's, its pressures those of the piston's own place."""
    machine = VirtualMachine(mounted().with_values({"carriage.incline": 0.5}), seed=1)
    machine.start()
    at = machine.model.layout.state("mount_deflection")
    for _ in range(400):
        machine.tick(np.array([0.0]))
    row, state = machine.bench.cylinders[0], machine.state
    carried = push_of(row, state, machine.bench)
    assert state[at] == pytest.approx(carried / 1e7, rel=0.05) and state[at] > 5e-5
    rig = mounted().with_values({"press.mount.stiffness": 3e7})
    assert float(rig.cylinder[0].mount.stiffness) == 3e7
    bare = mounted({"stiffness": "10 kN/mm"})
    assert Model.of(bare).plant.cylinders[0].mount_damping == pytest.approx(1e4)
    assert "press.mount.damping" not in bare.parameters()
    assert bare.cylinder[0].unmodelled == ("[cylinder.mount]",)
    assert Rig.model_validate(rig.as_toml()).parameters().keys() == rig.parameters().keys()


@pytest.mark.parametrize("key", ["leakage_internal", "leakage_head", "leakage_rod"])
def test_a_worn_out_seal_is_seen_by_the_guard(key):
    """100 000 mL/min/bar evens a chamber out within a step."""
    rig = slide().with_values({f"press.{key}": 1e-1 / 60.0 / 1e5})
    record = simulate(rig, {"press.servo": steps((3.0, 3.0))[300:700]}, 0.399)
    assert np.abs(record["press.p_head"]).max() < 2e7
    assert np.abs(np.diff(record["press.p_head"])[-40:]).max() < 1e5


# --- a load that sways: closed forms, energy, linear models

SPRUNG = {"mass": "80 kg", "stiffness": "300 N/mm", "damping": "400 N*s/m"}


def swaying(sway: dict = SPRUNG, **parts) -> Rig:
    """The sliding mass with another on a spring."""
    return slide(sway=sway, **parts)


def test_it_rings_as_two_masses_on_two_springs():
    """Valves shut, no loss: ``(k_o + k − m1 ω²)(k − m2 ω²) = k²``."""
    rig = swaying(SPRUNG | {"damping": "0 N*s/m"}).with_values({"carriage.damping": 0.0})
    model = Model.of(rig)
    oil, k, mass, more = swing(Model.of(slide())), 3e5, 250.0, 80.0
    squares = np.roots([mass * more, -(mass * k + more * (oil + k)), oil * k])
    found = np.linalg.eigvals(jacobian(model))
    for square in squares:
        pole = 1j * math.sqrt(square)
        assert found[np.argmin(np.abs(found - pole))] == pytest.approx(pole, rel=1e-4, abs=1e-2)


def test_the_ledger_closes_with_what_sways():
    """``k z²/2 + m w²/2`` is stored, ``c ∫(dz/dt)² dt`` lost."""
    rig = swaying(**SEALS)
    record = moved(rig)
    ledger = books(rig, record, "press.sway", "press.swaying", "press.work", share=1e-2)
    z, w = record["press.sway"], record["press.sway_speed"]
    held = 0.5 * (3e5 * z**2 + 80.0 * w**2)
    assert ledger["press.swaying"].energy == pytest.approx(held[-1] - held[0], rel=1e-9)
    lost = 400.0 * np.trapezoid((w - record["press.v"]) ** 2, record.t)
    assert ledger["press.sway"].energy == pytest.approx(lost, rel=1e-2)


def test_a_stiff_spring_makes_one_mass_and_a_replay_takes_it_along():
    hard = {"mass": "80 kg", "stiffness": "300 kN/mm", "damping": "20 kN*s/m"}
    commands = {"press.servo": steps((4.0, -3.0))[300:750]}
    one = slide().with_values({"carriage.mass": 330.0})
    found = [simulate(rig, commands, 0.449)["press.v"] for rig in (swaying(hard), one)]
    assert np.abs(found[0] - found[1]).max() < 5e-3 * np.abs(found[1]).max()
    model = Model.of(swaying())
    y = model.trim(model.posture(None))
    assert not y[model.plant.cylinders[0].sway_state :][:2].any()
    record = simulate(swaying(), {"press.servo": steps((3.0, 3.0))[300:700]}, 0.399)
    kept = {k: v for k, v in record.channels.items() if "sway" not in k}
    again = model.replay(type(record)(record.t, kept, record.meta))
    assert np.abs(again["press.sway"] - record["press.sway"]).max() < 1e-5


@pytest.mark.parametrize("way", [0, 1])
def test_a_linear_model_has_what_sways(way):
    """From the equations as from differences of the plant; the point is a steady motion."""
    rig = swaying(**SEALS).with_values({"press.leakage_internal": 2e-12})
    linear_models_agree(rig, way, {"sway": 1e-3, "sway_speed": 1.0})


def test_the_virtual_bench_and_the_rig_file_have_it():
    machine = VirtualMachine(swaying(), seed=1)
    machine.start()
    for _ in range(400):
        machine.tick(np.array([2.0]))
    at = machine.model.layout.state("sway_speed")
    assert machine.state[at] > 0.01
    rig = swaying().with_values({"press.sway.stiffness": 3e7})
    assert float(rig.cylinder[0].sway.stiffness) == 3e7
    assert rig.cylinder[0].unmodelled == ("[cylinder.sway]",)
    assert Rig.model_validate(rig.as_toml()).parameters().keys() == rig.parameters().keys()
    with pytest.raises(ValueError, match="above 0"):
        Sway.model_validate({"mass": "0 kg", "stiffness": "1 N/m"})
