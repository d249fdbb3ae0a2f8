"""A load that sways: closed forms, energy, linear models."""

import math

import numpy as np
import pytest
from with_parts import books, jacobian, linear_models_agree, moved, slide, steps, swing

from ehbench.config.rig import Rig
from ehbench.machines.virtual import VirtualMachine
from ehbench.parts.sway import Sway
from ehbench.plant.model import Model, simulate
from ehbench.vocabulary.fields import Value

SOFT = {"mass": "80 kg", "stiffness": "300 N/mm", "damping": "400 N*s/m"}
SEALS = {"friction_coulomb": Value(200.0), "friction_viscous": Value(400.0)}


def swaying(sway: dict = SOFT, **parts) -> Rig:
    """The sliding mass with another on a spring."""
    return slide(sway=Sway.model_validate(sway), **parts)


def test_it_rings_as_two_masses_on_two_springs():
    """Valves shut, no loss: ``(k_o + k − m1 ω²)(k − m2 ω²) = k²``."""
    rig = swaying(SOFT | {"damping": "0 N*s/m"}).with_values({"carriage.damping": 0.0})
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
    linear_models_agree(rig, way, ("sway", "sway_speed"))


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
