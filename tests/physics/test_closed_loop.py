"""Controllers closed over model and bench: every law, only its channels, limits, same bytes."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from closed_loop import LONG

from ehbench.config.recipe import TrialRecipe, TrialSetRecipe
from ehbench.config.rig import LoadSensing
from ehbench.control import pressure_feedback as pf
from ehbench.control.arc_gains import GAIN_NAMES
from ehbench.control.functions import PATH_FLOWS, RULES
from ehbench.parts.sample import sample_channels
from ehbench.plant.design_point import circuit_of
from ehbench.plant.model import Model
from ehbench.trial import (
    RUN_OUT,
    Case,
    Session,
    account,
    controllers,
    prepare,
    run,
    run_cases,
    run_trial,
    table_csv,
    table_rows,
)
from ehbench.trial.motion import full_speed
from ehbench.vocabulary.codes import ESTIMATES, FROZEN, FUNCTIONS, SATURATED
from ehbench.vocabulary.fields import Value
from ehbench.vocabulary.quantities import quantity
from tests.shared import RECIPES, refused, shipped

NAMES = ("thesis_arm", "thesis_arm_standard", "boom_four_valve", "crane_proportional")
RIGS = {name: shipped(name) for name in (*NAMES, "slide_servo")}
ARM = RIGS["thesis_arm"]
BENCH = str(RECIPES / "bench" / "thesis_arm.toml")


def strokes(cylinder, *waypoints, speed, **more):
    """A motion from stroke to stroke [m, m/s]."""
    given = {"waypoints": [f"{x} m" for x in waypoints], "speed": f"{speed} m/s", "hold": "0.6 s"}
    return {"kind": "point_to_point", "cylinder": cylinder} | given | more


def feedback(gain):
    """Pressure feedback of a gain [m³/(s·Pa)]."""
    gains = {"feedback_gain": f"{gain} m^3/(s*Pa)", "washout": "1 Hz"}
    return {"kind": "pressure_feedback", "gains": gains}


UP_DOWN = strokes("boom", 0.06, 0.12, 0.06, speed=0.08)
OPEN, FEEDBACK, ARC = {"kind": "open_loop"}, feedback(8e-11), {"kind": "arc"}
EDGES = ("hect", "hepc", "regen", "repc", "rect")


def recipe(controller, motion=UP_DOWN, path="trial.toml", **given):
    given |= {"controller": controller, "motion": motion, "path": Path(path)}
    return TrialRecipe(stage="trial", rig="x.toml", **given)


def moved(controller, *, rig=ARM, allow_code=False, **given):
    """(record, facts) of a trial."""
    return run_trial(rig, recipe(controller, **given), allow_code=allow_code)


def closed(recipe, rig=ARM):
    """The compiled controller of a recipe, as its trial would run it."""
    return prepare(recipe, rig).loop.laws[0]


def closed_layout():
    return controllers.design(recipe(FEEDBACK), ARM, None).model.layout


def working_edges(rig, cylinder, functions):
    """Names of the edges that some working functions meter through."""
    model = Model.of(rig)
    paths = circuit_of(model, model.layout.cylinders.index(cylinder)).paths
    return {
        model.layout.edges[paths[path]]
        for function in functions
        for path in np.flatnonzero(PATH_FLOWS[function].any(axis=1))
    }


# rig: its cylinder, a stroke in the middle of its range [m], a payload, a feedback gain
# [m³/(s·Pa)]: a spool's off-side pressure rises with every motion, and feedback takes it for load
MACHINES = {
    "thesis_arm": ("boom", 0.10, "50 lb", 8e-11),
    "thesis_arm_standard": ("boom", 0.10, "50 lb", 1e-11),
    "boom_four_valve": ("boom", 0.20, "bucket", 8e-11),
    "crane_proportional": ("lift", 0.25, "200 kg", 5e-12),
    "slide_servo": ("press", 0.20, "100 kg", 5e-12),
}


@pytest.mark.parametrize("on", ["model", "bench"])
@pytest.mark.parametrize("name", MACHINES)
def test_every_law_moves_every_rig(name, on):
    """Each arrives: with position feedback near the sensor's resolution, without it within a share
    of the travel.

    The bench is another machine than the design model, with friction, hysteresis and other valves:
    there only in proportion."""
    rig, (cylinder, x, payload, gain) = RIGS[name], MACHINES[name]
    motion, worst = strokes(cylinder, x, x + 0.05, x, speed=0.04), {}
    for law in (OPEN, feedback(gain), ARC):
        record, facts = moved(law, rig=rig, motion=motion, payload=payload, on=on)
        assert not facts.stopped and facts.cylinder == cylinder and facts.controller == law["kind"]
        own = record[f"{cylinder}.x"]
        # the crane's encoder on the bench is as coarse as 2 mm, and friction holds a load back
        assert own[0] == pytest.approx(x, abs=1e-9 if on == "model" else 2e-3)
        assert np.ptp(own) == pytest.approx(0.05, rel=0.2 if on == "model" else 0.4)
        assert record[f"{cylinder}.x_desired"][-1] == pytest.approx(x, abs=1e-12)
        used = set(record[f"{cylinder}.function"].astype(int)) - {0}
        assert {FUNCTIONS[f].split("_")[0] for f in used} == {"extend", "retract"}
        words = [e.rsplit(".", 1) for e in record.channels if e.startswith(f"{cylinder}.")]
        edges = [edge for edge, word in words if word == "flow_desired"]
        asked = {edge: np.abs(record[f"{edge}.flow_desired"]).max() for edge in edges}
        # the edges of the functions that were used, and no others, were asked for oil
        working = working_edges(rig, cylinder, used)
        assert working and {edge for edge, most in asked.items() if most > 0.0} == working
        for edge in edges:
            assert set(record[f"{edge}.limits"]) <= set(range(32))
        worst[law["kind"]] = facts.measures["tracking"]
    # the issue asks for 1 mm; without position feedback the load's compression and the valves' lag
    # stay in the stroke
    if on == "model":
        assert worst["arc"]["max_error"] < 5e-4 and abs(worst["arc"]["final_error"]) < 1e-4
    for law in ("open_loop", "pressure_feedback"):
        assert abs(worst[law]["final_error"]) < (0.2 if on == "model" else 0.25) * 0.05
        assert worst["arc"]["rms_error"] < 0.3 * worst[law]["rms_error"]


@pytest.mark.parametrize("on", ["model", "bench"])
@pytest.mark.parametrize("loaded", [False, True])
@pytest.mark.parametrize("name", LONG)
def test_the_adaptive_law_does_not_swing_along_the_stroke(name, loaded, on):
    """At constant speed: no ripple in the speed, one change of function for each motion."""
    cylinder, low, high, speed, payload = LONG[name]
    slope = f"{5 * speed} m/s^2"
    motion = strokes(cylinder, low, high, low, speed=speed, acceleration=slope)
    load = payload if loaded else None
    record, facts = moved(ARC, rig=RIGS[name], motion=motion, payload=load, on=on)
    desired, v = record[f"{cylinder}.v_desired"], record[f"{cylinder}.v"]
    steady = np.abs(desired) > 0.999 * speed
    late = steady.copy()
    late[1000:] &= steady[:-1000]  # a second after it set in
    # the bench's encoders turn into steps of speed; behind 20 ms the noise is below 3 mm/s
    smooth = np.convolve(v, np.full(20, 0.05), "same")
    assert np.std((smooth - desired)[late]) < 0.02 * speed + (0.0 if on == "model" else 3e-3)
    assert facts.measures["tracking"]["max_error"] < (1e-3 if on == "model" else 3e-3)
    last = record[f"{cylinder}.payload_estimate"][-1]
    if on == "model":
        assert np.abs(record[f"{cylinder}.x_error"][-200:]).max() < 25e-6, "no more than a count"
        kilograms = {"boom_four_valve": 120.0, "crane_proportional": 200.0}.get(name)
        if kilograms is not None:
            assert last == pytest.approx(kilograms * loaded, abs=0.05 * kilograms)
    elif name == "boom_four_valve":  # its bucket of 120 kg, by valves known from data sheets only
        assert last == pytest.approx(120.0 * loaded, abs=25.0)
    changes = np.flatnonzero(np.diff(record[f"{cylinder}.function"]))
    assert not steady[changes].any()


def test_the_adaptive_law_gives_ahead_the_friction_that_turns_round_slowly():
    """What it gives ahead follows the rig file: it errs by 0.15 mm where friction is thought to
    turn round over 2 mm/s."""
    slide = RIGS["slide_servo"]
    rubbing = {"press.friction_coulomb": 800.0, "press.coulomb_speed": 0.02}
    motion = strokes("press", 0.15, 0.25, 0.15, speed=0.15)
    _, facts = moved(ARC, rig=slide.with_values(rubbing), motion=motion)
    assert facts.measures["tracking"]["max_error"] < 5e-5


def test_a_trial_starts_with_the_off_side_at_its_set_point():
    record, _ = moved(OPEN | {"gains": {"low_pressure": "5 bar"}}, payload="50 lb")
    assert record["boom.p_rod"][0] == pytest.approx(5e5, rel=1e-12)
    assert record["boom.p_head"][0] > 5e5
    assert np.ptp(record["boom.v"][:400]) < 1e-9, "the load is carried"


@pytest.mark.parametrize("on", ["model", "bench"])
def test_the_same_recipe_gives_the_same_bytes(on):
    given = recipe(ARC, on=on, payload="50 lb", seed=3, duration="1.5 s")
    (one, facts), (two, again) = (run_trial(ARM, given) for _ in range(2))
    assert list(one.channels) == list(two.channels) and facts == again
    assert all(one[name].tobytes() == two[name].tobytes() for name in one.channels)
    other, _ = run_trial(ARM, given.model_copy(update={"seed": 4}))
    same = np.array_equal(one["boom.p_head"], other["boom.p_head"])
    assert same == (on == "model"), "the seed is the bench's noise"


@pytest.mark.parametrize("law", [OPEN, FEEDBACK, ARC], ids=lambda law: law["kind"])
def test_a_log_of_the_bench_has_what_a_machine_measures_the_commands_and_the_notes(law):
    """And nothing else: no state of the bench is in it."""
    record, _ = moved(law, on="bench", bench=BENCH, duration="0.1 s")
    layout, notes = closed_layout(), closed(recipe(law)).channels
    assert set(record.channels) == {
        *sample_channels(layout.cylinders),
        *(f"{valve}.command" for valve in layout.valves),
        *notes,
    }
    said = {"function", "function_status", "limits", "flow_head_desired", "flow_rod_desired"}
    said |= {f"{letter}_desired" for letter in "xvaj"}
    said |= {f"{edge}.{word}" for edge in EDGES for word in ("flow_desired", "limits")}
    said |= {*ESTIMATES, "payload_estimate", "learning"} if law is ARC else {"feedback_flow"}
    assert {f"boom.{word}" for word in said} <= set(notes)


# --- gains


def in_range(values):
    """Fail unless each number lies in the range of its quantity."""
    for name, value in values.items():
        assert quantity(name).lower <= value <= quantity(name).upper, name


def test_the_gains_and_bounds_that_a_trial_ran_with_are_saved():
    """50 lb under a bound of 12 kg: the estimates go to their bounds, and no farther."""
    stated = {"position_bandwidth": "8 rad/s", "observer_bandwidth": "50 rad/s"}
    stated |= {"adaptation": "1 rad/s", "disturbance": "100 N", "payload": ["0 kg", "12 kg"]}
    record, facts = moved(ARC | {"gains": stated}, payload="50 lb")
    gains, bounds, rules = (facts.measures[key] for key in ("gains", "estimate_bounds", "rules"))
    assert set(gains) == {*GAIN_NAMES, "adaptation", "adaptation_bulk"}
    assert set(bounds) == {*ESTIMATES, "payload_estimate"}
    assert set(rules) == set(RULES.names) and (rules["dwell"], rules["allow_seventh"]) == (0.1, 0.0)
    in_range(gains | rules)
    expected = {"position_bandwidth": 8.0, "observer_bandwidth": 50.0, "adapt": 1.0, "tick": 1e-3}
    expected |= {"adaptation": pytest.approx(1.0, rel=1e-12)}
    expected |= {"adaptation_bulk": pytest.approx(0.02, rel=1e-12)}
    expected |= {"low_pressure": float(ARM.supply.pressure) / 20}
    assert {name: gains[name] for name in expected} == expected
    assert bounds["payload_share"] == [0.0, 12.0] and bounds["disturbance"] == [-100.0, 100.0]
    for name, (lower, upper) in bounds.items():
        values = record[f"boom.{name}"]
        # the quotient of two clipped numbers may differ from that of their bounds by rounding
        assert lower <= values.min() and values.max() <= upper * (1 + 1e-15)
    assert record["boom.payload_share"].max() == 12.0
    # 12 kg of it stand at the bound; what is left to the quotient's bound is the inverse inertia
    assert record["boom.payload_estimate"].max() > 12.0 / bounds["inverse_inertia"][1]


def test_the_gains_of_feedback_are_saved_by_function_and_with_its_shaping():
    some = {"extend_resistive": 8e-11, "retract_overrunning": 4e-11}
    by_function = {name: f"{gain} m^3/(s*Pa)" for name, gain in some.items()}
    found = {}
    for key, law in {
        "open": OPEN,
        "one": FEEDBACK,
        "each": FEEDBACK | {"gains": {"feedback_gain": by_function}},
        "shaped": FEEDBACK | {"shaping": {"acceleration_max": "2 m/s^2"}},
    }.items():
        found[key] = moved(law, duration="0.1 s")[1].measures["gains"]
        in_range(found[key])
    plain, one = found["open"], found["one"]
    assert plain["feedback_gain"] == plain["washout"] == plain["off_gain"] == 0.0 < one["off_gain"]
    given = {"off_gain": one["off_gain"], "feedback_gain": 8e-11}
    assert one == plain | given | {"washout": pytest.approx(2 * np.pi, rel=1e-12)}
    assert found["shaped"] == one | {"acceleration_max": 2.0}
    each = {f"{name}.feedback_gain": some.get(name, 0.0) for name in FUNCTIONS[1:7]}
    assert {name: value for name, value in found["each"].items() if "." in name} == each
    assert "feedback_gain" not in found["each"]


@pytest.mark.parametrize("on", ["model", "bench"])
def test_what_a_weak_pump_cannot_give_saturates_is_said_and_leaves_no_wind_up(on):
    """A reference twice as fast as the pump: its pressure falls; no overshoot after it."""
    weak = ARM.with_values({"supply.flow_limit": 1e-4})
    motion = strokes("boom", 0.06, 0.14, speed=0.12, hold=["0.3 s", "3 s"])
    record, facts = moved(ARC, rig=weak, motion=motion, payload="50 lb", on=on)
    saturated = record["boom.limits"].astype(int) & SATURATED > 0
    error = record["boom.x"] - record["boom.x_desired"]
    share = facts.measures["limits"]["saturated"]
    assert 0.1 < share == saturated.mean() == facts.warnings[0].fields["share"]
    assert record["p_supply"].min() < 0.25 * float(weak.supply.pressure) and error.min() < -0.02
    last = int(np.flatnonzero(saturated)[-1])
    short = saturated & (record["boom.v_desired"] > facts.measures["rules"]["speed_start"])
    assert short.sum() > 300 and (record["boom.learning"][short] == FROZEN).all() and last < 2000
    for name in ESTIMATES:
        assert not np.diff(record[f"boom.{name}"])[short[:-1]].any(), name
    # less than the 1 mm asked for in tracking; the bench's friction leaves half of that at rest
    assert error[last:].max() < 1e-3
    assert np.abs(error[-500:]).max() < (5e-5 if on == "model" else 5e-4)


# --- channels


PRESSURES = {"boom.p_head", "boom.p_rod", "p_supply", "p_tank"}
ANGLES = {"swing.q", "stick.q", "boom.q", "boom.qd", "boom.x", "boom.v"}


@pytest.mark.parametrize(("law", "given"), [(FEEDBACK, PRESSURES), (ARC, PRESSURES | ANGLES)])
@pytest.mark.parametrize("on", ["model", "bench"])
def test_a_built_in_law_is_given_its_channels_only(law, given, on, monkeypatch):
    """What reaches the kernel is NaN outside of what it observes, and the log is not touched."""
    seen, through = [], Session._through

    def watched(self, first, stop):
        seen.append(self.laws)
        return through(self, first, stop)

    monkeypatch.setattr(Session, "_through", watched)
    record, _ = moved(law, on=on, payload="50 lb")
    names = sample_channels(closed_layout().cylinders)
    last = seen[-1][0].controller.given
    assert {name for name, value in zip(names, last, strict=True) if not math.isnan(value)} == given
    assert all(np.isfinite(values).all() for values in record.channels.values())


def test_the_payload_is_not_told():
    for law in (FEEDBACK, ARC):
        light, heavy = closed(recipe(law)), closed(recipe(law, payload="50 lb"))
        one, two = light.controller, heavy.controller
        assert one.gains == two.gains
        assert np.array_equal(one.axis.mechanism.links, two.axis.mechanism.links)
    bare, loaded = (moved(ARC, payload=load)[0]["boom.p_head"] for load in (None, "50 lb"))
    assert not np.array_equal(bare, loaded)


CODE = """
from __future__ import annotations
import math
import numpy as np
from ehbench.control import pressure_feedback as pf
from ehbench.control.functions import pack_rules
from ehbench.control.records import blank

class Mine:
    channels = ["boom.p_*", "p_*"]
    def __init__(self, feedback_gain, washout, off_gain):
        self.gains = {"feedback_gain": feedback_gain, "washout": washout, "off_gain": off_gain}
    def start(self, rig, tick, sample):
        self.seen = [sample]
        self.names, self.circuit, supply = list(sample), rig.circuit, float(rig.rig.supply.pressure)
        rules = pack_rules(rig.circuit.area_rod, supply, low_pressure=supply / 20)
        self.packed = pf.pack_pressure_feedback(
            tick=tick, rules=rules, low_pressure=supply / 20, **self.gains
        )
        self.memory, self.command = blank(pf.MEMORY), np.zeros(len(rig.valves))
        self.out = np.zeros(pf.COLUMNS + 2 * rig.circuit.count)
    notes = ["boom.load_force"]
    def step(self, t, sample, desired):
        self.seen.append(sample)
        values = np.array([sample[name] for name in self.names])
        laws = self.circuit, self.packed, self.memory
        pf.step(t, values, np.array(desired), *laws, self.command, self.out)
        self.note = [self.out[7]]
        return self.command
"""


@pytest.mark.parametrize("on", ["model", "bench"])
def test_a_users_class_does_what_the_compiled_law_does(tmp_path, on):
    """Through Python and compiled: every channel the same, bit for bit; NaN elsewhere."""
    (tmp_path / "mine.py").write_text(CODE)
    gains = {"feedback_gain": "8e-11 m^3/(s*Pa)", "washout": "1 Hz", "off_gain": "2e-11 m^3/(s*Pa)"}
    given = {"on": on, "path": tmp_path / "trial.toml", "payload": "50 lb", "duration": "2 s"}
    law = {"class": "mine:Mine", "gains": gains}
    with refused("trial.code_not_allowed"):
        moved(law, **given)
    mine, facts = moved(law, allow_code=True, **given)
    built, _ = moved({"kind": "pressure_feedback", "gains": gains}, **given)
    assert {name.removeprefix("note.") for name in mine.channels} < set(built.channels)
    for name, values in mine.channels.items():
        assert np.array_equal(values, built[name.removeprefix("note.")]), name
    assert facts.controller == "Mine" and np.ptp(mine["boom.x"]) > 0.03 and not facts.warnings


ANSWER = """
class Mine:
    channels = {channels}
    def start(self, rig, tick, sample): {start}
    def step(self, t, sample, desired): return {answer}
"""


def own(folder, answer, channels=("boom.x",), start="pass", **given):
    """(record, facts) of a trial under a short class, the cross-port valve unused."""
    text = ANSWER.format(channels=list(channels), start=start, answer=answer)
    (folder / "mine.py").write_text(text)
    law = {"class": "mine:Mine", "unused": ["boom.regen"]}
    return moved(law, path=folder / "trial.toml", allow_code=True, **given)


HEARD = "assert [n for n, v in sample.items() if v == v] == ['boom.p_head']"


@pytest.mark.parametrize(
    ("answer", "key", "more"),
    [
        ("3.0", "no_commands", {}),  # not spread over seven valves
        ("{'boom.regen': 1.0}", "unknown_command", {}),
        # a channel that is not named is NaN
        (
            "{'boom.hepc': 3.0 + 0.0 * sample['boom.x']}",
            "command_not_finite",
            {"channels": ("boom.p_head",), "start": HEARD},
        ),
    ],
)
def test_an_answer_is_finite_volts_for_every_valve_or_by_name(tmp_path, answer, key, more):
    with refused(f"trial.{key}"):
        own(tmp_path, answer, **more)


def test_seven_numbers_leave_an_unused_valve_at_rest(tmp_path):
    record, _ = own(tmp_path, "7 * [0.1]", duration="0.1 s")
    for valve in closed_layout().valves:
        volts = 0.0 if valve == "boom.regen" else 0.1
        assert (record[f"{valve}.command"] == volts).all(), valve


# --- motion, limits, disturbance


def test_full_speed_is_what_pump_and_valves_give():
    """A weak pump's flow over the area; the cartridges' 8 gpm; a spool as it runs wide open."""
    weak = controllers.design(recipe(FEEDBACK), ARM.with_values({"supply.flow_limit": 1e-4}), None)
    assert full_speed(weak, 1, 3.4e5) == pytest.approx(1e-4 / weak.circuit.area_head, rel=1e-12)
    made = controllers.design(recipe(FEEDBACK), ARM, None)
    most = float(ARM.supply.flow_limit) / made.circuit.area_head
    assert 0.95 * most < full_speed(made, -1, 3.4e5) < full_speed(made, 1, 3.4e5) < most

    rig = RIGS["slide_servo"].with_values({"supply.pressure": 2.0e6})
    motion = {"kind": "velocity_steps", "levels": ["100 %"], "duration": "0.5 s"}
    spool = controllers.design(recipe(FEEDBACK, motion, posture={"press": "50 mm"}), rig, None)
    speed = full_speed(spool, 1, 1e5)
    pumped = float(rig.supply.flow_limit) / spool.circuit.area_head
    assert speed < pumped, "the valve is the limit here"
    command = {"valve": "press.servo", "kind": "constant", "offset": "10 V"}
    given = {"duration": "0.6 s", "command": [command], "posture": {"press": "50 mm"}}
    record, _ = run_trial(rig, TrialRecipe(stage="trial", rig="x", **given))
    # friction and damping, which are no load at rest, take a few per cent
    assert 0.9 * speed < record["press.v"][-1] < speed


@pytest.mark.parametrize("way", [1, -1])
def test_full_speed_on_a_load_sensing_pump_is_what_its_margin_passes(way):
    """A spool wide open, against the speed that a simulation comes to: the margin sets it."""
    sensing = LoadSensing(load_margin=Value(1.5e6), load_lag=Value(0.005))
    rig = RIGS["slide_servo"].with_supply(load_sensing=sensing)
    posture = {"press": "80 mm" if way > 0 else "280 mm"}
    motion = {"kind": "velocity_steps", "levels": ["100 %"], "duration": "0.3 s"}
    spool = controllers.design(recipe(FEEDBACK, motion, posture=posture), rig, None)
    speed = full_speed(spool, way, 1e5)
    assert speed < 0.8 * full_speed(
        controllers.design(recipe(FEEDBACK, motion, posture=posture), RIGS["slide_servo"], None),
        way,
        1e5,
    )
    command = {"valve": "press.servo", "kind": "constant", "offset": f"{10 * way} V"}
    given = {"duration": "0.3 s", "command": [command], "posture": posture}
    record, _ = run_trial(rig, TrialRecipe(stage="trial", rig="x", **given))
    assert way * record["press.v"][-1] == pytest.approx(speed, rel=0.03)


@pytest.mark.parametrize("on", ["model", "bench"])
@pytest.mark.parametrize("law", [ARC, {"class": "own_controller:Lift"}])
def test_a_limit_shuts_the_valves_in_the_very_tick(law, on, tmp_path):
    (tmp_path / "own_controller.py").write_text(
        "class Lift:\n    channels = ['boom.x']\n    def start(self, rig, tick, sample): pass\n"
        "    def step(self, t, sample, desired): return {'boom.hepc': 4.0 * (desired.v > 0), "
        "'boom.rect': 6.0 * (desired.v > 0)}\n"
    )
    more = {"limits": {"speed_max": "50 mm/s", "ramp": "0 s"}, "posture": {"boom": "60 mm"}}
    record, facts = moved(law, path=tmp_path / "trial.toml", on=on, allow_code=True, **more)
    row = round(facts.stop.t * 1000)
    end = facts.stop.t + facts.after.seconds
    assert facts.stop.channel == "boom.v" and record.t[-1] == pytest.approx(end)
    assert 0.0 < facts.after.seconds <= RUN_OUT
    commands = np.column_stack([record[f"{v}.command"] for v in closed_layout().valves])
    assert commands[row - 1].any() and not commands[row:].any()
    if "kind" in law:
        assert not record["boom.function"][row:].any()
        assert (np.diff(record["boom.payload_estimate"][row:]) == 0).all()
    # what comes after the stop does not count
    assert facts.measures["tracking"]["max_error"] < 0.02


def test_commands_are_for_other_cylinders_and_an_unused_valve_rests():
    shake = {"valve": "stick.servo", "kind": "sine", "amplitude": "0.5 V", "frequency": "1 Hz"}
    still, _ = moved(ARC)
    record, facts = moved(ARC, command=[shake])
    assert np.abs(record["stick.servo.command"]).max() > 0.49
    assert np.ptp(record["stick.x"]) > 10 * np.ptp(still["stick.x"])
    assert facts.measures["tracking"]["max_error"] < 2e-3
    with refused("trial.controlled_valve"):
        moved(ARC, command=[shake | {"valve": "boom.hepc"}])
    record, facts = moved(ARC | {"unused": ["boom.regen"]})
    assert not record["boom.regen.command"].any() and facts.measures["tracking"]["max_error"] < 1e-3
    assert not {3, 6, 7} & set(record["boom.function"].astype(int))
    assert still["boom.regen.command"].any()
    with refused("trial.unused_valve"):
        moved(ARC | {"unused": ["boom.regenn"]})


# --- energy


@pytest.mark.parametrize("on", ["model", "bench"])
def test_the_energies_of_a_trial_are_those_of_its_ledger(on):
    """One code gives both: the pump's energy, the cylinder's work, and where the flow is from."""
    prepared = prepare(recipe(ARC, on=on, bench=BENCH), ARM)
    result = run(prepared)
    made = account(prepared, result)
    found, rows = made.facts.measures["energy"], {row["name"]: row for row in made.ledger["rows"]}
    assert found["pump"] == rows["pump"]["energy"] > 100.0
    assert found["cylinder_work"] == rows["boom.work"]["energy"]
    # the supply stands at its set pressure all the while, but for what the pump's droop takes
    mean = found["pump"] / found["oil_drawn"]
    assert mean == pytest.approx(np.mean(result.record["p_supply"]), rel=0.03)
    assert found["source"].startswith("edge flows" if on == "model" else "estimated")
    known = list(made.facts.measures)
    assert known.index("energy") == known.index("limits") - 1 and not made.notes


def test_a_trial_of_a_machine_without_pressure_sensors_has_no_energies():
    prepared = prepare(recipe(ARC, on="bench", bench=BENCH), ARM)
    done = run(prepared)
    known = {name: y for name, y in done.record.channels.items() if not name.endswith("p_rod")}
    made = account(prepared, done._replace(record=replace(done.record, channels=known)))
    assert made.ledger is None and [note.key for note in made.notes] == ["trial.no_ledger"]
    found = made.facts.measures["energy"]
    assert found["pump"] is None and found["cylinder_work"] is None and "p_rod" in found["source"]


# --- sets


@pytest.mark.slow
def test_a_set_is_the_product_in_order_and_its_bytes_do_not_depend_on_threads(tmp_path):
    steps = {"name": "step", "kind": "velocity_steps", "cylinder": "boom", "levels": ["30 %"]}
    steps |= {"travel": "30 mm", "rest": "0.2 s"}
    of = {"payloads": ["none", "50 lb"], "motion": [steps, UP_DOWN], "posture": {"boom": "60 mm"}}
    of |= {"controller": [OPEN | {"name": "open loop"}, FEEDBACK | {"name": "fed"}]}
    of |= {"stage": "trials", "rig": "x", "on": "bench", "path": tmp_path / "set.toml"}
    (tmp_path / "set.toml").touch()
    given = TrialSetRecipe(bench=BENCH, **of)
    cases = [Case(one.title, one, ARM, None) for one in given.cases()]
    names = ("step open loop", "step fed", "point_to_point open loop")
    assert [c.name for c in cases][:3] == [f"no load {name}" for name in names]
    assert len(cases) == 8 and cases[-1].recipe.payload == "50 lb"
    assert cases[0].recipe.payload is None
    prepared = [case.prepare() for case in cases]
    for workers in ("1", "4"):
        (tmp_path / workers).mkdir()
    serial, parallel = (
        run_cases(cases, prepared, logs=tmp_path / str(workers), workers=workers)
        for workers in (1, 4)
    )
    assert serial == parallel
    logs = sorted((tmp_path / "1").iterdir())
    assert len(logs) == 8
    for log in logs:
        assert log.read_bytes() == (tmp_path / "4" / log.name).read_bytes()
    rows = table_rows(cases, serial)
    text = table_csv(rows, ARM).splitlines()
    assert len(text) == 9 and len({line.count(",") for line in text}) == 1
    assert text == table_csv(table_rows(cases, parallel), ARM).splitlines()
    head, first = (line.split(",") for line in text[:2])
    cell = dict(zip(head, first, strict=True))
    assert float(cell["speed [mm/s]"]) == pytest.approx(74.66, abs=0.01)
    assert cell["share [%]"] == "30" and cell["step"] == "1"
    assert float(cell["pump_energy [J]"]) == pytest.approx(rows[0]["energy"]["pump"], rel=1e-5)
    assert rows[0]["energy"]["source"].startswith("estimated")


def test_a_case_that_fails_stops_the_set(tmp_path):
    methods = "def start(self, *_): pass", "def step(self, *_): return 1 / 0"
    lines = "class Bad:", "channels = ['boom.x']", *methods
    (tmp_path / "mine.py").write_text("\n    ".join(lines) + "\n")
    bad = recipe({"class": "mine:Bad"}, path=tmp_path / "trial.toml", on="model")
    good = recipe(FEEDBACK)
    cases = [Case(name, one, ARM, None) for name, one in (("good", good), ("bad", bad))]
    prepared = [case.prepare(allow_code=True) for case in cases]
    with refused("trial.code_raised"):
        run_cases(cases, prepared, workers=2)


def test_notes_have_the_columns_they_are_named_by():
    """The reference first, each edge's flow and limits last."""
    record, _ = run_trial(ARM, recipe(FEEDBACK))
    law = closed(recipe(FEEDBACK))
    assert law.channels == pf.LAW.channels("boom", tuple(f"boom.{edge}" for edge in EDGES))
    assert np.array_equal(record["boom.v_desired"], law.references[:, 1])
    moving = (record["boom.function"] == 1) & (record["boom.limits"] == 0)
    total = record["boom.hepc.flow_desired"][moving]
    assert moving.any() and np.allclose(total, record["boom.flow_head_desired"][moving], rtol=1e-12)
