"""Pressure feedback over the plant: it damps, keeps the steady speed, sees pressures only."""

import math

import numpy as np
import pytest
from closed_loop import TICK, axis_of, run_from

from ehbench.control import functions as fn
from ehbench.control import pressure_feedback as pf
from ehbench.control import trajectory as tr
from ehbench.control.measured import pressure_entries
from ehbench.control.records import blank
from ehbench.parts.sample import OF, entry
from ehbench.plant.model import Model
from ehbench.vocabulary import codes
from ehbench.vocabulary.quantities import quantity
from tests.shared import refused, shipped

COLUMN = {name: index for index, name in enumerate(pf.TELEMETRY)}


class Trial:
    """A cylinder of a rig under pressure feedback: its motion, notes and commands by tick."""

    def __init__(
        self, rig, cylinder, reference, *, at=None, payload=None, values=None, **gains
    ) -> None:
        made = shipped(rig).with_values(values or {})
        self.model = Model.of(made, payload=payload)
        plant, names = self.model.plant, self.model.layout
        self.index = names.cylinders.index(cylinder)
        row = plant.cylinders[self.index]
        axis = axis_of(self.model, self.index, None)
        self.circuit = axis.circuit
        low = plant.supply.pressure / 20
        rules = fn.pack_rules(row.area_rod, plant.supply.pressure, low_pressure=low)
        off_gain = 10.0 * row.volume_rod / row.bulk_modulus
        gains |= {"tick": TICK, "rules": rules, "off_gain": off_gain, "low_pressure": low}
        packed = pf.pack_pressure_feedback(**gains)
        posture = self.model.posture({cylinder: at} if at else None)
        start = self.model.trim(posture, plant.tank_pressure + low)
        run = run_from(start, self.model, axis, packed, reference, pf.LAW)
        self.notes, self.commands = run.telemetry, run.commands
        words = (OF.x, OF.v, OF.p_head, OF.p_rod)
        self.x, self.v, self.p_head, self.p_rod = run.log[
            :, [entry(self.index, w) for w in words]
        ].T


def swing(v: np.ndarray) -> tuple[float, float]:
    """(peak over the mean of the last third, rms about a line over the second half), shares."""
    steady = v[-v.size // 3 :].mean()
    half = v[v.size // 2 :]
    line = np.polynomial.Polynomial.fit(np.arange(half.size), half, 1)(np.arange(half.size))
    return float((v / steady).max() - 1.0), float(np.std(half - line) / abs(steady))


LIGHT = {"boom.joint_damping": 400.0, "poppet.natural_frequency": 2 * math.pi * 30.0}
HEAVY = {"payload": "bucket", "values": LIGHT}
LIFTS, LOWERS = (("thesis_arm", "boom", v) for v in (0.08, -0.05))
STEPS = {
    "arm lifts": (LIFTS, {"at": "0.05 m"}, 8e-11),
    "arm lifts 50 lb": (LIFTS, {"at": "0.05 m", "payload": "50 lb"}, 8e-11),
    "arm lowers": (LOWERS, {"at": "0.2 m"}, 6e-11),
    "arm lowers 50 lb": (LOWERS, {"at": "0.2 m", "payload": "50 lb"}, 6e-11),
    "four valves lift": (("boom_four_valve", "boom", 0.05), HEAVY | {"at": "0.1 m"}, 4e-11),
    "four valves lower": (("boom_four_valve", "boom", -0.05), HEAVY | {"at": "0.35 m"}, 4e-11),
}
SHARES = {"arm lifts": 0.015, "arm lowers": 0.015}
SHARES |= {"four valves lift": 0.002, "four valves lower": 0.002}


WASHOUT = 2 * math.pi * 1.5


def step(name, gain, washout=WASHOUT, **more):
    (rig, cylinder, v_d), where, _ = STEPS[name]
    reference = tr.velocity_steps([v_d], duration=1.2, tick=TICK, rest=0.3)[:1500]
    given = where | more | {"feedback_gain": gain, "washout": washout}
    return Trial(rig, cylinder, reference, **given), v_d


@pytest.mark.parametrize("name", STEPS)
def test_a_step_is_damped(name):
    """Less overshoot than in open loop, and the swing is gone within half the time."""
    gain = STEPS[name][2]
    (open_loop, _), (fed, v_d) = step(name, 0.0), step(name, gain)
    (over, ring), (over_fed, ring_fed) = swing(open_loop.v[300:]), swing(fed.v[300:])
    assert over > 0.4 and over_fed < 0.8 * over
    assert ring > 0.01 and ring_fed < 0.1 * ring
    # what is left of the steady error is the load that changes along the stroke: a washout passes
    # Ṗ/ω_w of a ramp
    slope = np.polyfit(np.arange(400) * TICK, fed.p_head[-400:], 1)[0]
    least = 1e-3 * abs(v_d) * fed.circuit.area_head
    mean = fed.notes["feedback_flow"][-400:].mean()
    assert mean == pytest.approx(gain * slope / WASHOUT, rel=0.1, abs=least)


@pytest.mark.parametrize(("name", "share"), SHARES.items())
def test_with_washout_the_steady_speed_is_that_of_the_open_loop(name, share):
    """Without gravity the load is nearly steady; after 1 s the washout's memory of the start is
    e^−9. On the arm the force of the joint damping still changes along the stroke: 1.5 %, not
    0.2 %."""
    # pyrefly: ignore[invalid-argument]
    calm = {**STEPS[name][1].get("values", {}), "gravity": 0.0}
    open_loop, fed = (step(name, k, values=calm)[0].v[-200:].mean() for k in (0.0, STEPS[name][2]))
    assert fed == pytest.approx(open_loop, rel=share)


@pytest.mark.parametrize("name", SHARES)
def test_without_washout_the_load_biases_the_steady_speed(name):
    """The metered chamber takes A v + V Ṗ/β_e = A v_d − K_p P at steady speed."""
    trial, v_d = step(name, 2e-11, washout=0.0)
    row = trial.model.plant.cylinders[trial.index]
    slope = np.polyfit(np.arange(300) * TICK, trial.p_head[-300:], 1)[0]
    compression = (row.volume_head + row.area_head * trial.x[-150]) / row.bulk_modulus * slope
    expected = v_d - (2e-11 * trial.p_head[-300:].mean() + compression) / row.area_head
    assert abs(expected - v_d) > 0.05 * abs(v_d)
    assert trial.v[-300:].mean() == pytest.approx(expected, abs=0.01 * abs(v_d))


FIVE = Trial("thesis_arm", "boom", np.zeros((2, 4)))


class Alone:
    """The step kernel by itself on a cylinder of the thesis's arm, tick by tick."""

    def __init__(self, **gains) -> None:
        c = self.circuit = FIVE.circuit
        defaults = {"rules": fn.pack_rules(c.area_rod, 7e6), "off_gain": 1e-11, "tick": TICK}
        self.gains = pf.pack_pressure_feedback(**(defaults | {"low_pressure": 3.5e5} | gains))
        self.memory, self.command = blank(pf.MEMORY), np.zeros(7)
        self.note = np.zeros(pf.COLUMNS + 2 * c.count)

    def tick(self, v_d, p_head, p_rod, p_supply=7e6, p_tank=0.0):
        sample = np.full(20, np.nan)
        at = pressure_entries(self.circuit.cylinder, sample.size)
        sample[at] = p_head, p_rod, p_supply, p_tank
        reference = np.array([np.nan, v_d, 0.0, 0.0])
        laws = self.circuit, self.gains, self.memory
        pf.step(0.0, sample, reference, *laws, self.command, self.note)
        return {name: self.note[i] for name, i in COLUMN.items()}


# pressures at which each function is chosen
CHOSEN = {
    1: (0.05, 2e6, 5e5),
    2: (0.05, 5e5, 1.2e6),
    3: (0.05, 5e5, 2.5e6),
    4: (-0.05, 5e5, 2e6),
    5: (-0.05, 1e6, 9e5),
    6: (-0.05, 2e6, 5e5),
    7: (0.05, 2e6, 2.3e6),
}


@pytest.mark.parametrize("function", CHOSEN)
def test_the_metered_chamber_gives_and_the_off_side_is_driven_to_its_set_point(function):
    """K_p Δp less into the metered chamber: a leak to its mean pressure, which takes energy."""
    v_d, p_head, p_rod = CHOSEN[function]
    rules = fn.pack_rules(FIVE.circuit.area_rod, 7e6, allow_seventh=function == 7, drop_start=1e6)
    inflow = []
    for more in (0.0, 3e4):
        gains = {codes.FUNCTIONS[function]: 2e-10}
        alone = Alone(feedback_gain=gains, washout=5.0, off_gain=0.0, rules=rules)
        alone.tick(v_d, p_head, p_rod)
        head = fn.METERED[function] == fn.HEAD
        note = alone.tick(v_d, p_head + more * head, p_rod + more * (not head))
        assert note["function"] == function and note["limits"] == 0
        inflow.append(note["flow_head_desired"] if head else -note["flow_rod_desired"])
        chamber, way = (alone.circuit.area_head, 1) if head else (alone.circuit.area_rod, -1)
        assert inflow[0] == way * chamber * v_d
    first = 0.5 * (1.0 + math.exp(-5.0 * TICK))  # of a step, as a washout sees it half a tick later
    assert inflow[1] - inflow[0] == pytest.approx(-2e-10 * 3e4 * first, rel=1e-12)
    # a gain of another function does not act
    gains = {codes.FUNCTIONS[1 + function % 7]: 2e-10}
    other = Alone(feedback_gain=gains, washout=5.0, rules=rules)
    other.tick(v_d, p_head, p_rod)
    assert other.tick(v_d, p_head + 3e4, p_rod + 3e4)["feedback_flow"] == 0.0
    # off_gain·(set − p) more than A v_d into it; the set-point is low, in the seventh Δp3 above
    alone = Alone(off_gain=2e-11, rules=rules)
    note = alone.tick(v_d, p_head, p_rod, p_tank=1e5)
    assert note["function"] == function
    low = p_head + rules.cross_drop if function == 7 else 1e5 + 3.5e5
    c, word, way, p = alone.circuit, "head", 1.0, p_head
    if fn.METERED[function] == fn.HEAD:
        word, way, p = "rod", -1.0, p_rod
    expected = {"head": c.area_head, "rod": c.area_rod}[word] * v_d + way * 2e-11 * (low - p)
    assert note[f"flow_{word}_desired"] == pytest.approx(expected, rel=1e-12)


def test_washouts_forget_a_step_and_two_forget_a_ramp():
    """e^(−ω t) and (1 − ω t) e^(−ω t) of a step, Ṗ/ω and nothing of a ramp."""
    omega, t = 7.0, TICK * np.arange(400)
    for corners, step_back, ramp_back in (
        ((omega, 0.0), np.exp(-omega * t), 1 / omega),
        ((omega, omega), (1 - omega * t) * np.exp(-omega * t), 0.0),
    ):
        alone = Alone(feedback_gain=1e-10, washout=corners[0], ramp_washout=corners[1])
        alone.tick(0.05, 2e6, 5e5)
        back = [alone.tick(0.05, 2.1e6, 5e5)["feedback_flow"] for _ in t]
        # a step between two samples is half a tick old, on average, when it is first seen
        np.testing.assert_allclose(np.array(back) / 1e-5, step_back, atol=2 * omega * TICK)
        ramp = [alone.tick(0.05, 2.1e6 + 1e5 * TICK * i, 5e5)["feedback_flow"] for i in range(3000)]
        least = 1e-5 * (1e-5 + 25 * math.exp(-3 * omega))
        assert ramp[-1] == pytest.approx(1e-5 * ramp_back, abs=least)


@pytest.mark.parametrize("corner", [0.5, 20.0, 300.0])
def test_a_washout_turns_the_phase_as_its_transfer_function_does(corner):
    """At 10 Hz against jω/(jω + ω_w): bilinear, right to (ω_w T)²/12 and (ω T)²/12."""
    omega, t = 2 * math.pi * 10.0, TICK * np.arange(4000)
    wave = np.exp(1j * omega * t)
    alone = Alone(feedback_gain=1e-10, washout=corner)
    alone.tick(0.05, 2e6, 5e5)
    flows = [alone.tick(0.05, 2e6 + 1e5 * w.real, 5e5)["feedback_flow"] for w in wave]
    back = np.array(flows)[1000:] / 1e-5
    seen = 2 * np.mean(back * wave[1000:].conj())
    exact = 1j * omega / (1j * omega + corner)
    assert abs(seen / exact - 1) < ((omega * TICK) ** 2 + (corner * TICK) ** 2) / 12 + 1e-3


def test_a_change_of_function_brings_no_bump():
    """The washout follows the other chamber as well, and while holding."""
    alone = Alone(feedback_gain=1e-10, washout=7.0)
    alone.tick(0.05, 2e6, 5e5)
    for _ in range(3000):
        alone.tick(0.0, 2e5, 9e5)
    after = alone.tick(-0.05, 2e5, 9e5)
    assert after["function"] == codes.RETRACT_RESISTIVE
    assert after["feedback_flow"] == pytest.approx(0.0, abs=1e-10 * 9e5 * math.exp(-20))


def test_each_channel_is_used_and_hold_shuts_its_valves_alone():
    """A pressure withheld turns up as NaN in the commands."""
    for gap in range(4):
        pressures = [2e6, 5e5, 7e6, 0.0]
        pressures[gap] = math.nan
        alone = Alone(feedback_gain=1e-10, washout=5.0)
        alone.tick(0.05, *pressures)
        assert np.isnan(alone.command).any()
    alone = Alone(feedback_gain=1e-10)
    alone.command[:] = 3.0
    note = alone.tick(0.0, 2e6, 5e5)
    assert note["function"] == codes.HOLD
    assert note["flow_head_desired"] == note["feedback_flow"] == 0.0
    first, count = alone.circuit.first, alone.circuit.count
    valves = np.unique(alone.circuit.edges.valve[first : first + count])
    assert not alone.command[valves].any() and (np.delete(alone.command, valves) == 3.0).all()


def test_a_shaped_step_starts_smoothly():
    shaping = tr.pack_shaping(acceleration_max=0.5, jerk_max=10.0)
    plain, shaped = (step("arm lifts", 0.0, shaping=s)[0] for s in (None, shaping))
    assert swing(shaped.v[300:])[0] < 0.7 * swing(plain.v[300:])[0]
    v = shaped.notes["v_shaped"]
    assert np.abs(np.diff(v)).max() <= 0.5 * TICK * (1 + 1e-12)
    assert v[-1] == pytest.approx(0.08, abs=1e-12)
    assert shaped.notes["v_desired"][301] == 0.08


def test_beyond_what_the_supply_gives_it_saturates_says_so_and_comes_back():
    """A speed twice the largest, then a slow one: flagged while it lasts, and forgotten."""
    speeds = tr.velocity_steps([0.4, 0.03], duration=[0.3, 0.9], tick=TICK)
    trial = Trial("thesis_arm", "boom", speeds, at="0.03 m", feedback_gain=8e-11, washout=WASHOUT)
    limits = trial.notes["limits"].astype(int)
    assert (limits[20:300] & codes.SATURATED).all() and trial.commands.max() == 10.0
    assert not limits[600:1200].any()
    assert trial.v[-400:-1].mean() == pytest.approx(0.03, rel=0.06)


def test_channels_have_words_and_masks_have_four():
    names = pf.LAW.channels("boom", tuple(f"boom.{edge}" for edge in ("a", "b")))
    last = tuple(f"boom.{edge}.{word}" for word in ("flow_desired", "limits") for edge in "ab")
    assert len(names) == pf.COLUMNS + 4 == len(set(names)) and names[-4:] == last
    assert all(quantity(name) for name in names)
    mask = pf.observed(FIVE.circuit, 20)
    assert np.flatnonzero(mask).tolist() == [10, 11, 18, 19]


@pytest.mark.parametrize(
    ("wrong", "key"),
    [
        ({"feedback_gain": -1e-11}, "feedback_gain_range"),
        ({"washout": math.nan}, "feedback_gain_range"),
        ({"tick": 0.0}, "feedback_gain_range"),
        ({"drop_floor": 0.0}, "feedback_gain_range"),
        ({"feedback_gain": {"lift": 1e-11}}, "unknown_function"),
        ({"feedback_gain": {"hold": 1e-11}}, "unknown_function"),
    ],
)
def test_wrong_gains_are_refused(wrong, key):
    with refused(f"control.{key}"):
        Alone(**wrong)
