"""Forces on the rod: closed forms, the energy they give and take, and what logs tell of them."""

import numpy as np
import pytest
from closed_loop import axis_of, gains_of, run_model
from scipy.integrate import solve_ivp
from with_parts import books, moved, point_of, recovered, ringing, swing

from ehbench.config.rig import Force, Rig
from ehbench.control.functions import pack_rules
from ehbench.control.measured import Pressures
from ehbench.control.required_flow import Motion, required_flow
from ehbench.control.trajectory import point_to_point
from ehbench.ledger import ledger_of_model
from ehbench.machines.simulated import SimulatedMachine
from ehbench.machines.virtual import VirtualMachine
from ehbench.parts.cylinder import linkage_of
from ehbench.plant.derivatives import derivatives
from ehbench.plant.model import Model, simulate
from ehbench.vocabulary.errors import InputError, LogError
from tests.shared import shipped, slide

CONSTANT = {"kind": "constant", "force": "4 kN"}
DIRECTION = {"kind": "by_direction", "force_extending": "-900 N", "force_retracting": "500 N"}
SPRING = {"kind": "spring", "stiffness": "80 kN/m", "free_length": "150 mm"}
CHANNEL = {"kind": "channel", "channel": "press.force"}
AGAINST = {
    **{"kind": "cylinder", "area_head": "10 cm^2", "pressure_head": "60 bar"},
    **{"area_rod": "5 cm^2", "pressure_rod": "20 bar"},
}


def pushed(*forces: dict) -> Rig:
    """The sliding mass with forces on its rod."""
    return slide(force=[{"name": f"f{i}", **force} for i, force in enumerate(forces)])


def carried(model: Model, y: np.ndarray) -> float:
    """Force [N] of the oil on the rod."""
    row, names = model.plant.cylinders[0], model.layout
    return y[names.state("p_head")] * row.area_head - y[names.state("p_rod")] * row.area_rod


@pytest.mark.parametrize(
    ("force", "newtons"),
    [(CONSTANT, 4000.0), (DIRECTION, -200.0), (SPRING, -4000.0), (AGAINST, -5000.0)],
)
def test_the_oil_carries_the_force_at_rest(force, newtons):
    """On the level, ``p_head A1 − p_rod A2 = −F`` at 200 mm, and nothing moves from there."""
    model = Model.of(pushed(force))
    y = model.trim(model.posture({"press": "200 mm"}))
    assert carried(model, y) == pytest.approx(-newtons, rel=1e-12)
    log = model.run(y, model.rest_commands(200))
    assert np.ptp(log[:, 0]) < 1e-9


def test_forces_turn_with_the_speed_and_springs_stand_beside_the_oil():
    model = Model.of(pushed(DIRECTION))
    y = model.trim(model.posture(None))
    dy, work = np.empty_like(y), np.empty(model.plant.at.work)
    for v, newtons in ((0.1, -900.0), (-0.1, 500.0)):
        y[model.layout.state("qd")] = v
        derivatives(y, model.rest_commands(1)[0], model.plant, dy, work)
        pull = 250.0 * dy[model.layout.state("qd")] - carried(model, y) + 800.0 * v
        assert pull == pytest.approx(newtons, rel=1e-9)
    # Valves shut: ω² = (β A1²/V1 + β A2²/V2 + k)/m
    stiff = {**SPRING, "stiffness": "20 kN/mm", "free_length": "200 mm"}
    for forces, k in (((), 0.0), ((stiff,), 2e7)):
        model = Model.of(pushed(*forces).with_values({"carriage.damping": 0.0}))
        omega = np.sqrt((swing(model) + k) / 250.0)
        assert ringing(model, omega) == pytest.approx(omega, rel=1e-5)


def test_a_played_force_acts_sample_by_sample_and_comes_back_from_its_log():
    """A pulse of F on a mass on shut valves gives F/m at once; the log of the run replays to the
    same states, and without the channel nothing is replayed."""
    rig = pushed(CHANNEL)
    t = np.arange(401) * 1e-3
    force = 3000.0 * np.sin(2 * np.pi * 8.0 * t) * (t > 0.1)
    record = simulate(rig, {"press.force": force}, 0.4)
    assert np.array_equal(record["press.force"], force) and np.ptp(record["press.v"]) > 1e-3
    model = Model.of(rig)
    y, dy = model.trim(model.posture(None)), np.empty(model.layout.states)
    command = model.rest_commands(1)[0]
    command[-1] = 500.0
    derivatives(y, command, model.plant, dy, np.empty(model.plant.at.work))
    assert dy[model.layout.state("qd")] == pytest.approx(500.0 / 250.0, rel=1e-9)
    again = model.replay(record, start=model.rest_start(record, 100))
    assert np.allclose(again["press.v"], record["press.v"], atol=1e-9)
    lost = type(record)(record.t, {k: v for k, v in record.channels.items() if k != "press.force"})
    with pytest.raises(LogError, match=r"press\.force"):
        model.replay(lost)


def test_a_coarsely_sampled_force_does_not_come_half_a_sample_late():
    """A sine of 12 Hz on a mass on shut valves, at 500 Hz, against SciPy's solution of its
    equations with the force itself: half a sample late it is 7.5 % off."""
    model, period, omega = Model.of(pushed(CHANNEL)), 2e-3, 2.0 * np.pi * 12.0
    t = np.arange(201) * period
    force = lambda at: 2000.0 * np.sin(omega * at)
    built = simulate(model.rig, {"press.force": force(t)}, 0.4, rate=1.0 / period)
    row, y = model.plant.cylinders[0], model.trim(model.posture(None))
    p_head, p_rod = (y[model.layout.state(f"p_{end}")] for end in ("head", "rod"))
    x0, *ends = y[0], row.volume_head + row.area_head * y[0], row.volume_rod - row.area_rod * y[0]

    def rates(at, s):
        x, v, head, rod = s
        push = head * row.area_head - rod * row.area_rod + force(at) - 800.0 * v
        wide = ends[0] + row.area_head * (x - x0), ends[1] - row.area_rod * (x - x0)
        slopes = -row.area_head * v / wide[0], row.area_rod * v / wide[1]
        return [v, push / 250.0, *(row.bulk_modulus * by for by in slopes)]

    exact = solve_ivp(rates, (0.0, 0.4), [x0, 0.0, p_head, p_rod], "Radau", t, rtol=1e-9).y[1]
    assert np.max(np.abs(built["press.v"] - exact)) < 0.01 * np.ptp(exact)


@pytest.mark.parametrize("force", [CONSTANT, DIRECTION, SPRING, CHANNEL, AGAINST])
def test_the_ledger_closes_with_a_force_on_the_rod(force):
    """To what RK4 leaves over, as without; the rows are ``−∫F dx`` and ``k (x − x0)²/2``."""
    rig, played = pushed(force), {"press.force": 2000.0 * np.cos(np.arange(801) / 40.0)}
    record = moved(rig, **(played if force is CHANNEL else {}))
    ledger = books(rig, record, "press.external_force", share=2e-3)
    x = record["press.x"]
    if force is SPRING:
        stored = 4e4 * ((x[-1] - 0.15) ** 2 - (x[0] - 0.15) ** 2)
        assert ledger["press.load_spring"].energy == pytest.approx(stored, rel=1e-9)
    elif force in (CONSTANT, AGAINST):
        newtons = 4000.0 if force is CONSTANT else -5000.0
        given = ledger["press.external_force"].energy
        assert given == pytest.approx(-newtons * (x[-1] - x[0]), abs=1e-5 * ledger.pump)


def test_without_forces_there_are_no_rows():
    record = simulate(slide(), {"press.servo": 2.0}, 0.1)
    names = {row.name for row in ledger_of_model(Model.of(slide()), record).rows}
    assert not names & {"press.external_force", "press.load_spring"}


STIFF = {"kind": "spring", "stiffness": "40 kN/m", "free_length": "150 mm"}


def off_track(machine: Model, design: Model) -> float:
    """Largest error [m] of a law without adaptation, out and back."""
    given = {"speed": 0.07, "acceleration": 0.5, "jerk": 5.0, "hold": [0.3, 0.5, 0.5]}
    reference = point_to_point([0.05, 0.3, 0.05], tick=1e-3, profile="seventh", **given)
    axis = axis_of(design, 0, {"press": "0.175 m"})
    gains = gains_of(design, axis, adapt=False)
    run = run_model(machine, axis, gains, reference, {"press": "0.05 m"})
    return np.abs(run.telemetry["x_error"]).max()


@pytest.fixture(scope="module")
def free() -> tuple[Model, float]:
    """The slide with a free rod, and how far it is off track."""
    model = Model.of(slide())
    return model, off_track(model, model)


@pytest.mark.parametrize("force", [CONSTANT, DIRECTION, STIFF, AGAINST])
def test_a_law_that_knows_the_force_tracks_as_without_one(force, free):
    """Its errors are then those of a free rod; a law that does not know the force is several times
    as far off."""
    (design, least), loaded = free, Model.of(pushed(force))
    assert off_track(loaded, loaded) < 1.2 * least
    assert off_track(loaded, design) > 5.0 * least


def test_the_flow_that_a_motion_takes_knows_the_force():
    """A force that pushes the rod out acts as a load which is lighter by as much: the boom goes
    over to the working functions of a lowered load, as if its joint carried less."""
    rig = shipped("thesis_arm")
    push = {"kind": "constant", "force": "30 kN"}
    boom = rig.cylinder_named("boom").model_copy(update={"force": (Force.model_validate(push),)})
    forced = rig.model_copy(
        update={"cylinder": tuple(boom if c.name == "boom" else c for c in rig.cylinder)}
    )
    design = Model.of(rig)
    q = np.full(200, design.posture({"boom": "120 mm"})[design.plant.cylinders[1].joint])
    v = np.full(200, 0.1)
    line = Pressures(5e5, 5e5, 1.0e7, 0.0)
    _, lever, _ = linkage_of(design.plant.cylinders[1], q[0])
    flows = []
    for model, carried_by_joint in ((Model.of(forced), 2e4), (design, 2e4 - 3e4), (design, 2e4)):
        axis = axis_of(model, 1, {"boom": "120 mm"})
        rules = pack_rules(axis.circuit.area_rod, 1e7)
        motion = Motion(v, np.full(200, carried_by_joint * lever), q)
        flows.append(required_flow(axis, motion, line, 1e-3, rules))
    assert np.array_equal(flows[0], flows[1]) and not np.array_equal(flows[0], flows[2])


@pytest.mark.slow
def test_forces_come_back_from_noisy_logs():
    """A constant force and a spring together, started 1.8 and 0.5 times off."""
    rig = pushed(CONSTANT, {**SPRING, "stiffness": "40 N/mm"})
    recovered(rig, {"press.f0.force": 1.8, "press.f1.stiffness": 0.5})


def test_a_design_point_carries_the_force_and_a_played_one_is_refused():
    """The oil's load force at a steady speed is less by the force; a design knows no log."""
    loads = []
    for forces in ((), (AGAINST,)):
        loads.append(point_of(Model.of(pushed(*forces)), speed=0.1).load_force)
    assert loads[1] - loads[0] == pytest.approx(5000.0, rel=1e-9)
    model = Model.of(pushed(CHANNEL))
    with pytest.raises(InputError, match=r"plays the force 'press\.force' from a log"):
        point_of(model, speed=0.1)
    with pytest.raises(InputError, match="a machine on trial has none"):
        SimulatedMachine(model)


def test_the_virtual_bench_carries_it_too():
    """At rest its chambers carry the force, but for what sticks and what sensors are off."""
    loads = []
    for forces in ((), (CONSTANT,)):
        machine = VirtualMachine(pushed(*forces))
        sample = dict(zip(machine.channels, machine.start(), strict=True))
        row = machine.bench.cylinders[0]
        head, rod = sample["press.p_head"] * row.area_head, sample["press.p_rod"] * row.area_rod
        loads.append(head - rod)
    assert loads[0] - loads[1] == pytest.approx(4000.0, rel=0.1)
