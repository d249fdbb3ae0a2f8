"""Time: accuracy against SciPy, replay, alignment, start, errors, determinism."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.parts.valve.second_order import SETTLED
from ehbench.plant.model import Model, simulate
from ehbench.vocabulary.errors import InputError, LogError, SimulationError
from tests.shared import RIGS, shipped
from tools.benchmark import radau_error, thesis_trial

NAMES = sorted(path.stem for path in RIGS.glob("*.toml"))
METERED = [name for name in NAMES if shipped(name).cylinder[0].pump is None]


@pytest.fixture(scope="module", params=NAMES)
def rig(request) -> Rig:
    """A shipped rig; a pump that slips lets its load sink, so without slip there is a rest."""
    made = shipped(request.param)
    return made.with_values({n: 0.0 for n in made.parameters() if n.endswith(".slip")})


@pytest.fixture(scope="module", params=METERED)
def metered(request) -> Rig:
    """A rig whose shut valves hold its oil, as a pump and check valves do not."""
    return shipped(request.param)


@pytest.fixture(scope="module")
def arm() -> Rig:
    return shipped("thesis_arm")


def step_of(rig: Rig) -> dict[str, np.ndarray]:
    """A step of every valve to half of its range and back, over 1 s at 1 kHz from 0.1 s on."""
    t = np.arange(1001) * 1e-3
    return {
        f"{c.name}.{v.name}": np.where((t >= 0.1) & (t < 0.5), 0.5 * float(v.command_max), v.rest)
        for c, v in rig.valves()
    }


def test_a_ten_second_trial_is_within_1e_5_of_scipy(arm):
    """Every state of the thesis arm within 1e-5 of its range of Radau at rtol 1e-9."""
    model, table = thesis_trial(arm)
    errors = radau_error(model, table)
    assert len(errors) > 15
    assert max(errors.values()) < 1e-5, errors


@pytest.mark.parametrize("mass, damping", [(2.0, 20000.0), (1.0, 8000.0)])
def test_a_light_load_on_a_heavy_damper_is_within_1e_5_of_scipy(mass, damping):
    """Its speed settles in a fifth of a step of 500 µs."""
    rig = shipped("slide_servo").with_values({"carriage.mass": mass, "carriage.damping": damping})
    model = Model.of(rig)
    table = model.rest_commands(400)
    table[100:, 0] = 3.0
    errors = radau_error(model, table)
    assert max(errors.values()) < 1e-5, errors


def test_valves_follow_their_second_order_step_response(arm):
    """1 − e^(−ζωt)(…) of thesis 2.12 to 1e-9 of the step at 500 µs."""
    model = Model.of(arm)
    valve = model.layout.valves.index("boom.hepc")
    table = model.rest_commands(60)
    table[:, valve] = 4.0
    log = model.run(model.trim(model.posture(None)), table)
    omega, zeta = arm.dynamics["eq_2_12"].frequency_and_damping()
    t = np.arange(60) * 1e-3
    roots = np.roots([1.0, 2 * zeta * omega, omega**2])
    a, b = roots
    exact = 4.0 * (1.0 + (b * np.exp(a * t) - a * np.exp(b * t)) / (a - b)).real
    assert np.abs(log[:, model.layout.state("opening", valve)] - exact).max() < 4e-9


def test_valves_that_arrive_stay_without_subnormal_tails(arm):
    """A shut valve's tail ends at exactly its command: nothing small is left."""
    model = Model.of(arm)
    table = model.rest_commands(3000)
    table[:100] = [4.0 if name.startswith("boom") else 0.0 for name in model.layout.valves]
    log = model.run(model.trim(model.posture(None)), table)
    first = model.layout.state("opening", 0)
    tail = log[-1000:, first : first + 2 * len(model.layout.valves)]
    late = log[120, model.layout.state("opening", model.layout.valves.index("boom.hect"))]
    assert (tail == 0.0).all() and late > SETTLED, "it takes its time"


@pytest.mark.parametrize("payload", [True, False])
def test_replay_of_a_simulation_is_that_simulation(rig, payload):
    """The start is made of means of the recording, equal to trim but for rounding, which may
    grow as the machine moves: 1e-7 of each range."""
    load = next(iter(rig.payload)) if payload else None
    made = simulate(rig, step_of(rig), 1.0, payload=load)
    again = Model.of(rig, payload=load).replay(made)
    moved = 0
    for name, values in made.channels.items():
        span = np.ptp(values)
        moved += span > 1e-3
        least = max(span, 1e-9 * np.abs(values).max(), 1e-12)
        assert np.abs(again[name] - values).max() <= 1e-7 * least, name
    assert moved > 5


def test_replay_needs_no_more_than_a_machine_measures(rig):
    """From angle or stroke, pressures and commands the replay starts where it stood."""
    made = simulate(rig, step_of(rig), 1.0)
    for position in ("q", "x") if rig.mechanism.kind == "chain" else ("x",):
        measured = (position, "p_head", "p_rod", "command", "p_supply", "p_tank")
        kept = {n: v for n, v in made.channels.items() if n.rsplit(".", 1)[-1] in measured}
        again = Model.of(rig).replay(Record(made.t, kept))
        for cylinder in rig.cylinder:
            name = f"{cylinder.name}.x"
            assert np.abs(again[name] - made[name]).max() < 1e-6 * max(np.ptp(made[name]), 1e-6)


def test_a_command_acts_from_its_sample_on(arm):
    """At sample 100 it shows in the opening at 101; shifted by a sample it replays far worse."""
    made = simulate(arm, step_of(arm), 1.0)
    opening = made["boom.hepc.opening"]
    assert opening[100] == 0.0 and opening[101] > 0.0
    assert made["boom.q"][100] == made["boom.q"][0]
    shift = {n: np.roll(v, 1) if n.endswith(".command") else v for n, v in made.channels.items()}
    late = Record(made.t, shift)
    model = Model.of(arm)
    aligned, shifted = (
        np.abs(model.replay(one)["boom.p_head"] - made["boom.p_head"]).max() for one in (made, late)
    )
    assert aligned < 1.0
    assert shifted > 1e4


def test_replay_takes_the_recorded_supply_and_no_noise_for_motion(arm):
    """Supply and tank pressure of the recording, not of the rig file, feed the replay."""
    low = arm.with_values({"supply.pressure": 5.0e6, "supply.tank_pressure": 2.0e5})
    made = simulate(low, {"swing.servo": step_of(arm)["swing.servo"]}, 1.0)
    again = Model.of(arm).replay(made)
    assert np.abs(again["swing.v"] - made["swing.v"]).max() < 1e-6 * np.ptp(made["swing.v"])
    kept = {n: v for n, v in made.channels.items() if n not in ("p_supply", "p_tank")}
    gap = np.abs(Model.of(arm).replay(Record(made.t, kept))["swing.v"] - made["swing.v"]).max()
    assert gap > 0.1 * np.ptp(made["swing.v"])
    # Rest is found all the same: the start is a mean over all samples before the step
    made = simulate(arm, step_of(arm), 1.0)
    rng = np.random.default_rng(5)
    model = Model.of(arm)
    channels = dict(made.channels)
    for name, values in made.channels.items():
        if name.endswith(".command"):
            channels[name] = values + rng.uniform(-0.01, 0.01, made.t.shape)
        elif name.endswith(("p_head", "p_rod")):
            channels[name] = values + rng.normal(0.0, 2e4, made.t.shape)
    again = model.replay(Record(made.t, channels))
    spread = [abs(again[f"{c}.p_head"][0] - made[f"{c}.p_head"][0]) for c in model.layout.cylinders]
    assert max(spread) < 3 * 2e4 / math.sqrt(100)


def test_the_start_carries_the_load_from_noisy_pressures(metered):
    """Moved until nothing accelerates, by no more than the gap: 500 N are 220 kPa at one end."""
    model = Model.of(metered)
    rest = simulate(metered, {}, 0.2)
    rng = np.random.default_rng(3)
    noisy = Record(rest.t, dict(rest.channels))
    for name, v in rest.channels.items():
        if name.endswith(("p_head", "p_rod")):
            noisy.channels[name] = v + rng.normal(2e5, 2e4, v.shape)
    y = model.start_of(noisy, 200)
    log = model.run(y, model.rest_commands(200))
    n = len(model.layout.joints)
    assert np.abs(log[:, n : 2 * n]).max() < 1e-6
    pressures = y[2 * n : 2 * n + 2 * len(model.layout.cylinders)]
    trim = model.trim(model.posture(None))[2 * n : 2 * n + 2 * len(model.layout.cylinders)]
    assert np.abs(pressures - trim - 2e5).max() < 2e5


def test_what_cannot_be_simulated_is_said(arm):
    made = simulate(arm, step_of(arm), 1.0)
    for keep in (np.delete(np.arange(made.t.size), 500), slice(2)):
        few = Record(made.t[keep], {n: v[keep] for n, v in made.channels.items()})
        with pytest.raises(LogError, match="not evenly sampled"):
            Model.of(arm).replay(few)
    with pytest.raises(InputError, match="no valve 'boom.hepcc'"):
        simulate(arm, {"boom.hepcc": 1.0}, 0.1)
    with pytest.raises(InputError, match="has 7 values, the trial 101 samples"):
        simulate(arm, {"boom.hepc": np.zeros(7)}, 0.1)
    with pytest.raises(InputError, match="no payload '10 lb'"):
        simulate(arm, {}, 0.1, payload="10 lb")
    model = Model.of(arm)
    y = model.trim(model.posture(None))
    y[3] = np.nan
    with pytest.raises(SimulationError, match="t = 0 s"):
        model.run(y, model.rest_commands(10))


def test_postures_by_angle_stroke_and_name(rig):
    """A stroke, its joint angle and the joint's own name are one posture; mid-stroke else."""
    model = Model.of(rig)
    cylinder = rig.cylinder[-1]
    stroke = 0.3 * float(cylinder.stroke)
    joint = model.layout.joints.index(cylinder.joint)
    q = model.posture({cylinder.name: f"{stroke * 1e3} mm"})
    assert model.posture({cylinder.joint: float(q[joint])}) == pytest.approx(q, abs=1e-12)
    if rig.mechanism.kind == "chain":
        angle = f"{math.degrees(q[joint])} deg"
        assert model.posture({cylinder.name: angle}) == pytest.approx(q, abs=1e-9)
    low, high = model.stroke_range(len(rig.cylinder) - 1)
    assert min(low, high) < q[joint] < max(low, high)


def test_a_posture_outside_the_stroke_says_what_the_stroke_allows(rig):
    model = Model.of(rig)
    cylinder = rig.cylinder[0]
    shown = f"the stroke allows 0 to {float(cylinder.stroke) * 1e3:.1f} mm"
    if rig.mechanism.kind == "chain":
        with pytest.raises(InputError, match="outside the stroke") as caught:
            model.posture({cylinder.name: f"{float(cylinder.stroke) + 0.01} m"})
        assert caught.value.hint == shown
    low, high = sorted(model.stroke_range(0))
    for wrong in (low - 0.02, high + 0.02):
        with pytest.raises(InputError, match="outside the stroke") as caught:
            model.posture({cylinder.name: wrong})
        assert "the stroke allows" in caught.value.hint
        simulate(rig, {}, 0.01, posture={cylinder.name: min(max(wrong, low), high)})
    with pytest.raises(InputError, match="no cylinder or joint"):
        model.posture({"elbow": "10 deg"})
    with pytest.raises(InputError, match="no table") as caught:
        model.posture(["120 mm"])
    assert cylinder.name in (caught.value.hint or "")


def test_a_run_leaves_its_start_alone_and_its_rate_changes_no_motion(arm):
    model = Model.of(arm)
    y, table = model.trim(model.posture(None)), model.rest_commands(50)
    table[:, 0] = 3.0
    kept = y.copy(), table.copy()
    model.run(y, table)
    assert (y == kept[0]).all() and (table == kept[1]).all()
    # 100 Hz and 250 µs end where 1 kHz and 500 µs end, to 1e-5 of the travel
    fine = simulate(arm, {"swing.servo": 2.0}, 1.0)
    coarse = simulate(arm, {"swing.servo": 2.0}, 1.0, rate=100.0, step=2.5e-4)
    assert coarse.t.size == 101 and coarse.sample_time == pytest.approx(0.01)
    assert np.abs(coarse["swing.q"] - fine["swing.q"][::10]).max() < 1e-5 * np.ptp(fine["swing.q"])


def test_commands_that_are_changed_in_a_log_are_those_that_a_replay_takes():
    rig = shipped("slide_servo")
    model = Model.of(rig)
    log = simulate(rig, {"press.servo": np.zeros(51)}, 0.05)
    log = replace(log, channels={name: y.copy() for name, y in log.channels.items()})
    still = model.replay(log)["press.x"]
    log["press.servo.command"][10:] = 3.0
    moved = model.replay(log)["press.x"]
    assert np.ptp(still) < 1e-6 < 1e-4 < np.ptp(moved)
