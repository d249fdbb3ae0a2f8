"""Trials: what is commanded, where a limit stops, what is recorded."""

import json
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from ehbench.config.recipe import Command, TrialRecipe, TrialSetRecipe, load_recipe, load_rig
from ehbench.data import read_log
from ehbench.data.logs import write_log
from ehbench.data.record import Record
from ehbench.plant.model import simulate
from ehbench.trial import (
    RUN_OUT,
    Case,
    code_file,
    command_table,
    controllers,
    file_names,
    gains_file,
    prepare,
    run,
    run_trial,
)
from ehbench.trial.cases import middle_of, over_runs
from ehbench.trial.measures import step_measures, tracking_measures
from ehbench.trial.motion import references
from ehbench.trial.preparation import Stop
from ehbench.trial.running import Facts, _coarse_stroke
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.fields import Value
from ehbench.vocabulary.messages import is_warning
from tests.shared import RECIPES, RIGS, shipped
from tests.tables import rows

VALVE = {"valve": "press.servo"}
STEP = VALVE | {"kind": "step", "amplitude": "4 V", "start": "0.1 s", "stop": "0.6 s"}


def refused(says):
    """An error of the catalogue's key, or whose text matches."""

    def fits(error):
        return says == error.key or re.search(says, str(error)) is not None

    return pytest.raises(InputError, check=fits)


@pytest.fixture(scope="module")
def rig():
    return shipped("slide_servo")


def recipe(*command, **given):
    given = {"duration": "1 s"} | given
    return TrialRecipe(stage="trial", rig="x.toml", command=command, **given)


def played(rig, *command, duration=1.0, rate=1000):
    return command_table(recipe(*command), rig, np.arange(round(duration * rate) + 1) / rate)[:, 0]


RAMP = {"kind": "ramp", "offset": "1 V", "amplitude": "2 V", "start": "0.2 s", "stop": "0.4 s"}


@pytest.mark.parametrize(
    ("commands", "volts"),
    [
        ([], {0: 0.0, 999: 0.0}),
        # the sample at the switching time has the new command
        ([{**STEP, "offset": "1 V"}], {99: 1.0, 100: 5.0, 599: 5.0, 600: 1.0}),
        # entries for one valve add up
        ([STEP, VALVE | {"kind": "constant", "offset": "-1 V"}], {0: -1.0, 300: 3.0}),
        # a ramp arrives and stays
        ([STEP | RAMP], {200: 1.0, 300: 2.0, 400: 3.0, -1: 3.0}),
    ],
)
def test_a_command_is_what_its_entries_say(rig, commands, volts):
    u = played(rig, *commands)
    assert {at: u[at] for at in volts} == pytest.approx(volts, rel=1e-12)


@pytest.mark.parametrize(
    ("key", "name", "entry"),
    [
        ("kind_takes", "amplitude", {"kind": "constant", "amplitude": "3 V"}),
        ("kind_takes", "frequency", {"kind": "step", "frequency": "5 Hz"}),
        ("kind_takes", "stop", {"kind": "file", "file": "a.mcap", "stop": "1 s"}),
        ("kind_needs", "stop", {"kind": "ramp", "amplitude": "3 V"}),
        ("kind_needs", "file", {"kind": "file"}),
        ("kind_needs", "frequency", {"kind": "sine", "amplitude": "3 V"}),
        ("kind_needs", "frequency_max", {"kind": "multisine", "frequency": "5 Hz"}),
    ],
)
def test_a_command_has_the_keys_of_its_kind_alone(key, name, entry):
    with pytest.raises(ValidationError) as caught:
        Command.model_validate(VALVE | entry)
    error = caught.value.errors()[0].get("ctx", {})["error"].args[0]
    assert (error.key, error.fields["key"]) == (f"config.{key}", name)


def test_none_is_the_word_for_no_payload(tmp_path):
    assert recipe(payload="none").payload is None
    assert recipe(payload="100 kg").payload == "100 kg"
    written = (RIGS / "slide_servo.toml").read_text()
    (tmp_path / "rig.toml").write_text(written.replace('payload."100 kg"', "payload.none"))
    with pytest.raises(InputError, match="'none' means no payload"):
        load_rig(tmp_path / "rig.toml")


def test_a_sine_has_its_frequency_and_window(rig):
    window = {"start": "0.2 s", "stop": "0.8 s"}
    u = played(rig, VALVE | {"kind": "sine", "amplitude": "2 V", "frequency": "5 Hz"} | window)
    t = np.arange(1001) / 1000
    inside = (t > 0.1995) & (t < 0.7995)
    assert u[inside] == pytest.approx(2 * np.sin(2 * np.pi * 5 * (t[inside] - 0.2)), abs=1e-9)
    assert not u[~inside].any()


def test_a_multisine_has_its_lines_and_its_amplitude_and_its_seed(rig):
    wave = VALVE | {"kind": "multisine", "amplitude": "2 V", "lines": 10}
    wave |= {"frequency": "2 Hz", "frequency_max": "20 Hz"}
    u = played(rig, wave, duration=2.0)[:-1]
    assert np.abs(u).max() == pytest.approx(2.0)
    power = np.abs(np.fft.rfft(u)) ** 2
    lines = np.argsort(power)[-10:] * 0.5
    assert sorted(lines) == list(np.arange(2.0, 21.0, 2.0))
    assert power[np.argsort(power)[:-10]].sum() < 1e-18 * power.sum()
    assert np.array_equal(u, played(rig, wave, duration=2.0)[:-1])
    assert not np.array_equal(u, played(rig, {**wave, "seed": 1}, duration=2.0)[:-1])


def test_a_file_is_played_as_it_was_recorded(rig, tmp_path):
    t = 7.0 + np.arange(6) * 0.01
    write_log(tmp_path / "u.mcap", Record(t, {"press.servo.command": np.arange(6.0)}))
    write_log(tmp_path / "other.mcap", Record(t, {"press.x": np.zeros(6)}))

    def table(name, rows):
        entry = VALVE | {"kind": "file", "file": name, "start": "0.1 s"}
        given = recipe(entry).model_copy(update={"path": tmp_path / "trial.toml"})
        return command_table(given, rig, np.arange(rows) / 1000)[:, 0]

    u = table("u.mcap", 301)
    assert u[[99, 110, 119, 120, 150, 151]].tolist() == [0.0, 1.0, 1.0, 2.0, 5.0, 0.0]
    with refused("trial.no_channel"):
        table("other.mcap", 3)


@pytest.mark.parametrize(
    ("command", "says", "hint"),
    [
        ({**STEP, "amplitude": "11 V"}, "trial.command_range", "-10 to 10 V"),
        ({**STEP, "valve": "press.servos"}, "trial.unknown_valve", "press.servo"),
        ({**STEP, "stop": "0.05 s"}, "trial.empty_window", None),
    ],
)
def test_a_command_that_cannot_be_is_refused_with_its_line(rig, tmp_path, command, says, hint):
    entry = "\n".join(f'{key} = "{value}"' for key, value in command.items())
    with refused(says) as error:
        run_trial(rig, closed(tmp_path, "", f'{OPEN}duration = "1 s"\n[[command]]\n{entry}\n'))
    assert error.value.file.endswith("trial.toml") and error.value.line >= 4
    assert hint is None or hint in error.value.hint


def test_a_trial_is_what_simulate_gives_or_what_a_machine_measures(rig):
    given = recipe(STEP, posture={"press": "120 mm"}, payload="100 kg")
    record, facts = run_trial(rig, given)
    u = played(rig, STEP)
    plain = simulate(rig, {"press.servo": u}, 1.0, posture={"press": "120 mm"}, payload="100 kg")
    assert list(record.channels) == list(plain.channels)
    for name, values in plain.channels.items():
        # the trial's step is the same one, taken one by one
        least = 1e-12 * max(1.0, np.abs(values).max())
        assert np.allclose(record[name], values, rtol=1e-9, atol=least), name
    assert not facts.stopped and facts.samples == 1001
    assert (record.meta["payload"], record.meta["on"]) == ("100 kg", "model")
    json.dumps(facts.as_json(), allow_nan=False)
    record, facts = run_trial(rig, recipe(STEP, on="bench", seed=4))
    own = [f"press.{key}" for key in ("x", "v", "p_head", "p_rod")]
    assert list(record.channels) == [*own, "press.servo.command", "p_supply", "p_tank"]
    assert (facts.on, facts.seed, facts.rate) == ("virtual bench", 4, 1000.0)


LIMITS = {
    "pressure_max": ("60 bar", "press.p_rod", lambda x, s: x > s),
    "pressure_min": ("13 bar", "press.p_head", lambda x, s: x < s),
    "stroke_margin": ("175 mm", "press.x", lambda x, s: x > s),
    "speed_max": ("150 mm/s", "press.v", lambda x, s: abs(x) > s),
    "command_max": ("3 V", "press.servo.command", lambda x, s: abs(x) > s),
}


@pytest.mark.parametrize("on", ("model", "bench"))
@pytest.mark.parametrize("limit", LIMITS)
def test_a_limit_stops_within_one_tick(rig, on, limit):
    bound, channel, beyond = LIMITS[limit]
    amplitude = "-6 V" if "pressure" in limit else "4 V"
    given = {"limits": {limit: bound, "ramp": "0 s"}, "on": on, "posture": {"press": "200 mm"}}
    record, facts = run_trial(rig, recipe(STEP | {"amplitude": amplitude}, **given))
    stop = facts.stop
    assert stop is not None, (channel, np.ptp(record[channel]))
    row = round(stop.t * 1000)
    assert (stop.limit, stop.channel) == (limit, channel)
    assert beyond(stop.value, stop.bound)
    if channel != "press.servo.command":
        assert record[channel][row] == stop.value
        assert not beyond(record[channel][row - 1], stop.bound)
        assert np.abs(record["press.servo.command"][row - 1]) > 0
    assert not record["press.servo.command"][row:].any(), "valves rest from the very tick"
    assert facts.after is not None and facts.after.seconds <= RUN_OUT
    assert record.t[-1] == pytest.approx(stop.t + facts.after.seconds)
    assert limit in facts.stopped and facts.stopped.startswith(record.meta["stopped"])
    json.dumps(facts.as_json(), allow_nan=False)


@pytest.mark.parametrize("on", ("model", "bench"))
@pytest.mark.parametrize("ramp", ["0 s", "50 ms", "200 ms"])
def test_the_valves_go_to_rest_in_the_recipes_ramp_and_the_log_goes_on_until_it_stands(
    rig, on, ramp
):
    """Also beyond the trial's own length."""
    limits = {"speed_max": "0.1 m/s", "ramp": ramp}
    given = recipe(STEP | {"amplitude": "6 V"}, limits=limits, on=on)
    given = given.model_copy(update={"duration": Value(0.2)})
    prepared = prepare(given, rig)
    many, one = run(prepared), run(prepared, fast=False)
    assert all(np.array_equal(many.record[n], one.record[n]) for n in many.record.channels)
    assert many.facts == one.facts
    record, facts = many.record, many.facts
    command, row = record["press.servo.command"], round(facts.stop.t * 1000)
    rows = round(float(given.limits.ramp) * 1000)
    assert command[row - 1] == 6.0 and (command[row + rows :] == 0.0).all()
    slope = np.diff(command[row - 1 : row + rows + 1])
    assert slope[: rows + 1] == pytest.approx(np.full(rows + 1, -6.0 / (rows + 1)), abs=1e-12)
    assert facts.after.ramp == float(given.limits.ramp)
    assert record.t[-1] == pytest.approx(facts.stop.t + facts.after.seconds) and record.t[-1] > 0.3
    assert facts.after.still and np.abs(record["press.v"][-90:]).max() < 0.02
    assert facts.samples == record.t.size and facts.duration == record.t[-1]


def test_a_stop_is_told_ramps_and_shuts_what_feeds_a_full_chamber(rig):
    """How far each quantity went beyond its limit, in numbers and in the rig's units."""
    limits = {"speed_max": "0.25 m/s", "pressure_max": "100 bar", "stroke_margin": "5 mm"}
    _, facts = run_trial(rig, recipe({**STEP, "amplitude": "10 V"}, limits=limits))
    assert facts.stop.limit == "speed_max" and facts.after.still
    beyond = {one.limit: one for one in facts.after.beyond}
    fastest = beyond["speed_max"]
    assert fastest.channel == "press.v"
    assert fastest.value >= facts.stop.value > fastest.bound == 0.25
    after = facts.after.sentence.fields
    assert after["seconds"] == facts.after.seconds and "press.v went to" in after["beyond"]
    assert facts.as_json()["after"]["beyond"][0]["limit"] in beyond
    # A load at speed between shut valves: their ramp lets it slow down (m v = A ∫p dt)
    peaks = {}
    for ramp in ("0 s", "50 ms"):
        limits = {"speed_max": "0.25 m/s", "ramp": ramp}
        record, facts = run_trial(rig, recipe({**STEP, "amplitude": "10 V"}, limits=limits))
        peaks[ramp] = record["press.p_rod"][round(facts.stop.t * 1000) :].max()
    assert peaks["50 ms"] < 0.8 * peaks["0 s"]
    limits = {"pressure_max": "75 bar", "ramp": "0.1 s"}
    given = recipe({**STEP, "amplitude": "-8 V"}, limits=limits, posture={"press": "200 mm"})
    record, facts = run_trial(rig, given)
    row, fed = round(facts.stop.t * 1000), facts.stop.channel == "press.p_rod"
    assert bool(record["press.servo.command"][row]) == (not fed)


def test_a_trial_that_cannot_start_is_refused(rig):
    with refused("trial.start_limit"):
        run_trial(rig, recipe(STEP, limits={"stroke_margin": "20 mm"}, posture={"press": "10 mm"}))
    named = {"bench/crane_proportional": "other cylinders", "datasets/slide_servo": "no bench file"}
    for bench, says in named.items():
        with refused(says):
            run_trial(rig, recipe(STEP, on="bench", bench=str(RECIPES / f"{bench}.toml")))


def test_progress_rises_to_one(rig):
    seen = []
    run_trial(rig, recipe(STEP, duration="3.4 s"), progress=lambda _, share: seen.append(share))
    assert seen == sorted(seen) and seen[-1] == 1.0 and len(seen) > 2


# --- measures


def second_order(t, omega, zeta):
    """Unit step response of ω²/(s² + 2ζω s + ω²)."""
    wd = omega * np.sqrt(1 - zeta**2)
    return 1 - np.exp(-zeta * omega * t) * (np.cos(wd * t) + zeta * omega / wd * np.sin(wd * t))


@pytest.mark.parametrize("zeta", [0.05, 0.1, 0.3])
@pytest.mark.parametrize(("speed", "reached"), [(0.08, 0.076), (-0.05, -0.05)])
def test_a_step_is_read_off_as_its_formula_says(zeta, speed, reached):
    """Overshoot e^(−πζ/√(1−ζ²)), and when the response stays within 5 %, on 1 ms samples."""
    t, omega = 0.5 + np.arange(4000) * 1e-3, 2 * np.pi * 4.0
    y = second_order(t - t[0], omega, zeta)
    found = step_measures(t, reached * y, speed, share=0.3)
    assert found.overshoot == pytest.approx(np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2)), rel=5e-3)
    assert found.steady_error == pytest.approx(reached / speed - 1, abs=2e-4)
    assert (found.share, found.start) == (0.3, 0.5)
    settled = (np.flatnonzero(np.abs(y - 1) > 0.05)[-1] + 1) * 1e-3
    assert found.settling_time == pytest.approx(settled, abs=2e-3)
    assert found.damping_ratio == pytest.approx(zeta, rel=0.03)
    assert found.natural_frequency == pytest.approx(omega, rel=0.01)
    assert found.rms_error == pytest.approx(np.sqrt(np.mean((reached * y - speed) ** 2)), rel=1e-12)


def test_what_a_step_does_not_show_is_none_and_tracking():
    t = np.arange(500) * 1e-3
    ringing_on = step_measures(t, 0.1 * second_order(t, 40.0, 0.01), 0.1)
    assert ringing_on.settling_time is None and ringing_on.overshoot > 0.5
    backwards = step_measures(t, np.full(t.size, -0.01), 0.1)
    assert backwards.overshoot is None and backwards.damping_ratio is None and backwards.ringing
    json.dumps(asdict(backwards), allow_nan=False)
    t = np.arange(2000) * 1e-3
    result = step_measures(t, 0.1 + 0.004 * np.exp(0.5 * t) * np.sin(25.0 * t), 0.1)
    assert result.damping_ratio == pytest.approx(-0.5 / 25.0, abs=0.003)
    assert result.overshoot is None and result.settling_time is None
    t = np.arange(1001) * 1e-3
    found = tracking_measures(t, np.where(t < 0.5, 0.01, 0.002), np.zeros(t.size))
    assert found["max_error"] == 0.01 and found["final_error"] == pytest.approx(0.002, rel=1e-12)
    mean = (500 * 0.01**2 + 501 * 0.002**2) / 1001
    assert found["rms_error"] == pytest.approx(np.sqrt(mean), rel=1e-12)


# --- closed loop: what a recipe may say

OPEN = 'stage = "trial"\nrig = "x.toml"\n'
TOML = f"""{OPEN}[motion]
kind = "point_to_point"
waypoints = ["100 mm", "200 mm"]
speed = "100 mm/s"
[controller]
"""


def closed(tmp_path, controller, motion=TOML):
    (tmp_path / "trial.toml").write_text(motion + controller)
    return load_recipe(tmp_path / "trial.toml")


CONTROLLERS = """
8  | arcs                            |                        | kind = "arcs"
7  | give 'kind' or 'class'          |                        |
7  | not both                        |                        | kind = "arc"; class = "m:C"
7  | shaping                         |   | kind = "arc"; [controller.shaping]; jerk_max = "1 m/s^3"
7  | control.feedback_gain_missing   | tune recipe            | kind = "pressure_feedback"
10 | trial.unknown_key               | washout                | GAINS wash = "1 Hz"
10 | 'bar' cannot be turned into rad |                        | GAINS washout = "1 bar"
10 | payload                         |                        | ARC payload = "20 kg"
10 | trial.wrong_value               | true or false          | ARC adapt = 1
9  | control.bounds_miss_design      |                        | ARC payload = ["10 kg", "2 kg"]
10 | trial.unknown_key               | did you mean 'standby' | ARC standbye = 0.5
9  | control.standby_range           |                        | ARC standby = 1.0
9  | control.unknown_function | | kind = "pressure_feedback"; gains.feedback_gain.up = "1 mL/s/bar"
10 | trial.unknown_key               | allow_seventh          | RULES allow_eighth = true
10 | dwell                           |                        | RULES dwell = "-1 s"
9  | control.stop_above_start        |                        | RULES speed_stop = "1 m/s"
9  | control.shaping_incomplete | damping_ratio | SHAPED natural_frequency = "2 Hz"
9  | trial.unused_valve              | press.servo          | kind = "arc"; unused = ["press.spool"]
9  | control.no_edge                 |                      | kind = "arc"; unused = ["press.servo"]
8  | trial.no_module                 | nowhere.py             | class = "nowhere:C"
8  | trial.no_class_name             | my_module:MyController | class = "nowhere"
"""
SHORT = {
    "ARC ": 'kind = "arc"\n[controller.gains]\n',
    "RULES ": 'kind = "arc"\n[controller.rules]\n',
    "GAINS ": 'kind = "open_loop"\n[controller.gains]\n',
    "SHAPED ": 'kind = "open_loop"\n[controller.shaping]\n',
}


@pytest.mark.parametrize(("line", "says", "hint", "controller"), rows(CONTROLLERS))
def test_a_controller_that_cannot_be_is_refused_with_its_line(
    rig, tmp_path, line, says, hint, controller
):
    text = controller or ""
    for short, whole in SHORT.items():
        text = text.replace(short, whole)
    with refused(says) as error:
        run_trial(rig, closed(tmp_path, text), allow_code=True)
    assert error.value.file.endswith("trial.toml") and error.value.line == line
    assert hint is None or hint in error.value.hint


MOTIONS = """
trial.leaves_stroke     | POINTS waypoints = ["100 mm", "900 mm"]; speed = "100 mm/s"
outside the stroke      | POINTS waypoints = ["900 mm", "100 mm"]; speed = "100 mm/s"
two strokes or more     | POINTS waypoints = ["100 mm"]; speed = "100 mm/s"
needs 'speed'           | POINTS waypoints = ["100 mm", "200 mm"]
trial.hold_count        | POINTS waypoints = ["1 mm", "2 mm"]; speed = "1 m/s"; hold = THRICE
'duration' or 'travel'  | STEPS levels = ["30 %"]
trial.zero_level        | STEPS levels = ["0 %"]; duration = "1 s"
no unit                 | STEPS levels = ["30"]; duration = "1 s"
trial.leaves_stroke     | STEPS levels = ["100 %"]; duration = "60 s"
needs 'file'            | kind = "file"
config.no_cylinder      | POINTS cylinder = "boom"; waypoints = ["1 mm", "2 mm"]; speed = "1 m/s"
"""
KINDS = {
    "POINTS ": 'kind = "point_to_point"\n',
    "STEPS ": 'kind = "velocity_steps"\n',
    "THRICE": '["1 s", "1 s", "1 s"]',
}


@pytest.mark.parametrize(("says", "motion"), rows(MOTIONS))
def test_a_motion_that_cannot_be_is_refused(rig, tmp_path, motion, says):
    for short, whole in KINDS.items():
        motion = motion.replace(short, whole)
    text = f"{OPEN}[motion]\n{motion}\n[controller]\n"
    with refused(says):
        run_trial(rig, closed(tmp_path, 'kind = "open_loop"', text))


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ('payload = "one tonne"', "no payload 'one tonne'"),
        ('posture = { elbow = "3 deg" }', "posture names 'elbow'"),
        ('posture = { press = "3 kg" }', "'kg' cannot be turned into m"),
    ],
)
@pytest.mark.parametrize("on", ["model", "bench"])
def test_a_machine_that_cannot_be_is_refused_with_its_line(rig, tmp_path, line, says, on):
    for rest in (TOML.split("\n", 2)[2] + 'kind = "open_loop"\n', 'duration = "1 s"\n'):
        with refused(says) as error:
            run_trial(rig, closed(tmp_path, "", f'{OPEN}on = "{on}"\n{line}\n{rest}'))
        assert error.value.file.endswith("trial.toml") and error.value.line == 4


def test_a_waypoint_that_cannot_be_is_refused_with_its_line(rig, tmp_path):
    text = TOML.replace('["100 mm"', '["900 mm"')
    with refused("outside the stroke") as error:
        run_trial(rig, closed(tmp_path, 'kind = "open_loop"', text))
    assert error.value.line == 5


def test_every_gain_of_a_law_can_be_written_in_a_recipe(rig, tmp_path):
    """By the name and value it is saved with: the same gains come back."""
    from ehbench.vocabulary.quantities import quantity

    fed = 'kind = "pressure_feedback"\n[controller.gains]\nfeedback_gain = "3e-12 m^3/(s*Pa)"\n'
    for law in ('kind = "arc"\n[controller.gains]\n', fed):
        short = TOML.replace("[motion]", 'duration = "0.01 s"\n[motion]')
        first = run_trial(rig, closed(tmp_path, law, short))[1].measures["gains"]
        fixed = ("tick", "adapt", "adapt_maps", "adapt_oil", "feedback_gain")
        moved = {name: 0.9 * value for name, value in first.items() if name not in fixed}
        lines = []
        for name, value in moved.items():
            unit = quantity(name).unit
            lines.append(f'{name} = "{value!r} {unit}"')
            if unit == "dimensionless":
                lines[-1] = f"{name} = {value!r}"
        again = run_trial(rig, closed(tmp_path, law + "\n".join(lines), short))[1].measures["gains"]
        assert again == pytest.approx(first | moved, rel=1e-12)


NEEDS = """
controller 'arc' needs a | duration = "1 s"; [controller]; kind = "arc"
a motion needs a         | duration = "1 s"; [motion]; kind = "file"; file = "a.csv"
'duration' is missing    |
"""


@pytest.mark.parametrize(("says", "text"), rows(NEEDS))
def test_a_controller_needs_a_motion_and_a_trial_a_duration(tmp_path, says, text):
    with refused(says):
        closed(tmp_path, text or "", OPEN)


def table_of(rig, recipe):
    return references(recipe, controllers.design(recipe, rig, None), 1e5)


def test_levels_are_shares_speeds_and_rows(rig, tmp_path):
    motion = 'kind = "velocity_steps"\nlevels = ["50 %", "-40 mm/s"]\nfull_speed = "0.2 m/s"\n'
    motion += 'travel = "20 mm"\nrest = "0.1 s"\n[controller]\n'
    text = f'{OPEN}posture = {{ press = "50 mm" }}\n[motion]\n{motion}'
    made = table_of(rig, closed(tmp_path, 'kind = "open_loop"', text))
    levels = [(one.first, one.stop, one.speed, one.share) for one in made.levels]
    assert levels == [(100, 300, 0.1, 0.5), (400, 900, -0.04, None)]
    speeds = made.table[[99, 100, 299, 300, 400, 899, 900], 1]
    assert speeds.tolist() == [0.0, 0.1, 0.1, 0.0, -0.04, -0.04, 0.0]
    assert made.table[[0, 300], 0] == pytest.approx([0.05, 0.07], abs=1e-12)


def test_cycles_repeat_the_way_and_the_last_one_is_known(rig, tmp_path):
    def cycles(text, count):
        return text.replace("[controller]", f"cycles = {count}\n[controller]")

    held = 'hold = ["0.3 s", "0.2 s", "0.4 s"]\n[controller]'
    text = TOML.replace('"200 mm"]', '"200 mm", "100 mm"]').replace("[controller]", held)
    again, once = cycles(text, 3), cycles(text, 1)
    made, one = (table_of(rig, closed(tmp_path, 'kind = "arc"', t)) for t in (again, once))
    way = len(one.table) - 1
    assert one.last_cycle == 0 and made.last_cycle == pytest.approx(2 * way - 300, abs=2)
    last = made.table[made.last_cycle :]
    assert last[0, 0] == last[-1, 0] == 0.1 and not last[[0, -1], 1:].any()
    assert last[:, 0].max() == pytest.approx(0.2) and len(last) == pytest.approx(way - 300, abs=3)
    for wrong in (cycles(TOML, 2), cycles(text, 0)):
        with pytest.raises(InputError, match="cycles"):
            closed(tmp_path, 'kind = "arc"', wrong)


def test_a_trial_lasts_as_long_as_its_motion_or_as_it_says(rig, tmp_path):
    def lasting(time):
        text = TOML.replace("[motion]", f"{time}[motion]")
        return table_of(rig, closed(tmp_path, 'kind = "open_loop"', text)).table

    alone, long = lasting(""), lasting('duration = "9 s"\n')
    assert alone[-1, 0] == 0.2 and not alone[-1, 1:].any()
    assert len(long) == 9001 and np.array_equal(long[: len(alone)], alone)
    assert (long[len(alone) :] == [0.2, 0, 0, 0]).all()
    assert np.array_equal(lasting('duration = "0.8 s"\n'), alone[:801])


def test_a_motion_from_a_file_is_the_curve_through_its_samples(rig, tmp_path):
    """A sine sampled at 100 Hz: position, speed, acceleration and jerk between the samples."""
    t, at = np.arange(101) * 0.01, np.arange(1001) * 1e-3
    text = f'{OPEN}[motion]\nkind = "file"\nfile = "m.mcap"\n[controller]\n'

    def table(**channels):
        columns = {f"press.{name}": values for name, values in channels.items()}
        write_log(tmp_path / "m.mcap", Record(t, columns))
        return table_of(rig, closed(tmp_path, 'kind = "open_loop"', text)).table

    sine, cosine = np.sin(4 * at), np.cos(4 * at)
    exact = np.column_stack([0.2 + 0.02 * sine, 0.08 * cosine, -0.32 * sine, -1.28 * cosine])
    curve = table(x_desired=0.2 + 0.02 * np.sin(4 * t))
    assert np.abs(curve - exact).max(axis=0) == pytest.approx([0, 0, 0, 0], abs=1e-4)
    given = table(x_desired=0.2 + 0.0 * t, v_desired=0.08 * np.cos(4 * t))
    assert np.abs(given[:, 1] - exact[:, 1]).max() < 1e-6
    with refused("trial.no_channel"):
        table(x=t)


def test_a_cylinder_that_moves_alone_has_the_law_that_is_named_for_it(rig, tmp_path):
    own = 'kind = "arc"\n[controller.cylinders.press]\nkind = "position"\n'
    named = TOML.replace("[motion]", '[motion]\ncylinder = "press"')
    (law,) = prepare(closed(tmp_path, own, named), rig).loop.laws
    assert law.law.name == "position"


@pytest.mark.parametrize("place", ["250 mm", "150 mm", "195 mm", None])
def test_a_motion_begins_where_its_cylinder_stands(rig, tmp_path, place):
    """Without a jump, and no faster than the motion itself."""
    t = np.arange(201) * 0.01
    x = 0.2 + 0.02 * (1.0 - np.cos(np.pi * t))  # 63 mm/s, 0.2 m/s², 0.62 m/s³ at most
    write_log(tmp_path / "m.mcap", Record(t, {"press.x_desired": x}))
    posture = "" if place is None else f'posture = {{ press = "{place}" }}\n'
    text = f'{OPEN}{posture}[motion]\nkind = "file"\nfile = "m.mcap"\n[controller]\n'
    prepared = prepare(closed(tmp_path, 'kind = "open_loop"', text), rig)
    table = prepared.loop.references.table
    begins = 0.2 if place is None else float(place.split()[0]) * 1e-3
    assert float(prepared.first_rows(prepared.machine).sample[2]) == pytest.approx(begins)
    assert table[0, 0] == pytest.approx(begins, abs=1e-12)
    assert table[2000, 0] == pytest.approx(0.2, abs=1e-6) and len(table) == 2001
    alone = table_of(rig, closed(tmp_path, 'kind = "open_loop"', text.replace(posture, "")))
    way = table - alone.table
    assert (np.abs(way[:, 1:]).max(axis=0) <= [0.0629, 0.198, 0.63]).all()
    for order in range(2):  # each column is the integral of the next, by trapezoids
        rises = 0.5e-3 * np.cumsum(way[1:, order + 1] + way[:-1, order + 1])
        np.testing.assert_allclose(way[1:, order], way[0, order] + rises, atol=1e-6)
    notes = [note for note in prepared.notes if note.key == "trial.off_start"]
    assert len(notes) == (place is not None)
    for note in notes:
        assert note.fields["apart"] == f"{1e3 * abs(begins - 0.2):.4g} mm"


def test_gains_come_from_a_tune_run_and_what_is_written_goes_first(rig, tmp_path):
    tuned = {"cylinder": "press", "feedback_gain": {"extend_resistive": 3e-12}, "washout": 5.0}
    tuned |= {"off_gain": 2e-12, "low_pressure": 3e5, "cross_drop": 4e5}
    tuned |= {"damping_ratio": 0.6, "tick": 1e-3}
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "tuning.json").write_text(json.dumps(tuned))

    def packed(controller):
        recipe = closed(tmp_path, controller)
        made = controllers.design(recipe, rig, None)
        tuning = controllers.read_tuning(recipe, None)
        assert gains_file(recipe) == "run"
        low = 1e5 if "low_pressure" in controller else 3e5
        assert controllers.low_pressure(recipe, rig, tuning) == low
        return controllers.compiled(recipe, made, tuning, np.zeros((2, 4)), 1000.0).controller.gains

    plain = packed('kind = "pressure_feedback"\ngains = "run"')
    assert (plain.washout, plain.off_gain, plain.low_pressure) == (5.0, 2e-12, 3e5)
    assert np.flatnonzero(plain.feedback_gain).tolist() == [1] and plain.feedback_gain[1] == 3e-12
    more = 'gains = { from = "run", washout = "0 Hz", low_pressure = "1 bar" }'
    over = packed(f'kind = "pressure_feedback"\n{more}')
    assert (over.washout, over.low_pressure, over.feedback_gain[1]) == (0.0, 1e5, 3e-12)
    loose = packed('kind = "open_loop"\ngains = "run"')
    assert (loose.washout, loose.off_gain) == (0.0, 0.0) and not loose.feedback_gain.any()
    (tmp_path / "run" / "tuning.json").write_text(json.dumps(tuned | {"cylinder": "boom"}))
    with refused("trial.other_cylinder"):
        packed('kind = "pressure_feedback"\ngains = "run"')


# --- a user's class

HEAD = "class C:\n    channels = ['press.x']\n"
START = "    def start(self, rig, tick, sample): pass\n"
STEPS = "    def step(self, t, sample, desired): return {}\n"
STEP_IS = HEAD + START + "    def step(self, t, sample, desired):"
BODY = START + STEPS
FAILS_AT_START = START.replace("pass", "\n        rig.nothing")
CODE = [
    (1, "trial.not_python", "class C(:\n"),
    (2, "raised ZeroDivisionError: division by zero .in the line: 1/0", "import json\n1/0\n"),
    (None, "trial.no_class", "class D: pass\n"),
    (None, "trial.no_method", HEAD + STEPS),
    (None, "trial.no_observed", f"class C:\n{BODY}"),
    (None, "trial.unmeasured", f"class C:\n    channels = ['boom.x']\n{BODY}"),
    (None, "trial.note_quantity", f"{HEAD}    notes = ['press.wow']\n{BODY}"),
    (None, "trial.note_count", f"{HEAD}    notes = ['press.force']\n{BODY}"),
    (None, "trial.code_raised", f"{HEAD}    def __init__(self, gain): pass\n{BODY}"),
    (4, "C.start raised AttributeError", HEAD + FAILS_AT_START + STEPS),
    (5, r"IndexError at t = 0 s.*\[\]", f"{STEP_IS}\n        return [][int(t > 0.1)]\n"),
    (None, "trial.unknown_command", f"{STEP_IS} return {{'press.valve': 1.0}}\n"),
    (None, "trial.no_commands", f"{STEP_IS} return [1.0, 2.0]\n"),
    (5, "C.step raised SystemExit at t = 0", f"{STEP_IS}\n        raise SystemExit\n"),
    (1, "raised SystemExit", "raise SystemExit\n"),
    (None, "trial.command_not_finite", f"{STEP_IS} return [float('nan')]\n"),
    (None, "trial.no_commands", f"{STEP_IS} return None\n"),
]


@pytest.mark.parametrize(("line", "says", "code"), CODE)
def test_code_that_goes_wrong_says_where(rig, tmp_path, code, says, line):
    (tmp_path / "mine.py").write_text(code)
    with refused(says) as error:
        run_trial(rig, closed(tmp_path, 'class = "mine:C"'), allow_code=True)
    assert error.value.file.endswith("mine.py") and error.value.line == line
    left = [p.name for p in sorted(tmp_path.iterdir())]
    assert left == ["mine.py", "trial.toml"], "not even bytecode"


def test_a_class_runs_only_when_allowed_and_is_given_no_rules(rig, tmp_path):
    (tmp_path / "mine.py").write_text(HEAD + BODY)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "tuning.json").write_text('{"cylinder": "press"}')
    tuned = ('gains = { from = "run" }', 'gains = "run"')
    for more in ('rules = { dwell = "1 s" }', *tuned):
        with refused("trial.code_given_tuning" if more in tuned else "trial.code_given_rules") as e:
            run_trial(rig, closed(tmp_path, f'class = "mine:C"\n{more}\n'), allow_code=True)
        assert e.value.file.endswith("trial.toml") and e.value.line == 9
    (tmp_path / "mine.py").write_text("open('touched', 'w')\n")
    recipe = closed(tmp_path, 'class = "mine:C"')
    with refused("trial.code_not_allowed") as error:
        run_trial(rig, recipe)
    assert error.value.line == 8 and "--allow-code" in str(error.value.hint)
    assert not Path("touched").exists()
    assert code_file(recipe) == (tmp_path / "mine.py").resolve()


GIVEN = """
from __future__ import annotations
from dataclasses import dataclass
@dataclass
class C:
    low_pressure: float
    mode: str
    channels = ['*']
    notes = ['press.force', 'press.pressure_drop']
    def start(self, rig, tick, sample):
        assert (self.low_pressure, self.mode, tick) == (2e5, '3 V', 1e-3)
        assert rig.rig.name == 'slide_servo' and rig.valves == ('press.servo',)
        assert rig.x == 0.1 == round(sample['press.x'], 9)
    def step(self, t, sample, desired):
        self.note = [t, desired.v]
        return [25.0 if 0.2 <= t < 0.2995 else 0.0]
"""


def test_a_class_gets_its_gains_and_is_held_to_the_drivers_range(rig, tmp_path):
    (tmp_path / "mine.py").write_text(GIVEN)
    gains = '[controller.gains]\nlow_pressure = "2 bar"\nmode = "3 V"\n'
    record, facts = run_trial(rig, closed(tmp_path, f'class = "mine:C"\n{gains}'), allow_code=True)
    command = record["press.servo.command"]
    assert command.max() == 10.0 and (command == 10.0).sum() == 100
    warning, *voids = facts.warnings
    assert {note.key for note in voids} == {"trial.cavitates"}, "its valve shuts at full speed"
    assert warning.fields == {"label": "C", "count": 100, "ticks": facts.samples}
    assert facts.measures["gains"] == {"low_pressure": 2e5}, "numbers, SI"
    assert np.array_equal(record["note.press.force"], record.t)
    assert np.array_equal(record["note.press.pressure_drop"], record["press.v_desired"])


def test_a_class_may_do_without_a_motion(rig, tmp_path):
    answer = "{'press.servo': 10 * (desired.x - sample['press.x'])}"
    (tmp_path / "mine.py").write_text(f"{STEP_IS} return {answer}\n")
    text = OPEN + 'duration = "0.5 s"\nposture = { press = "120 mm" }\n[controller]\n'
    record, facts = run_trial(rig, closed(tmp_path, 'class = "mine:C"', text), allow_code=True)
    assert (record["press.x_desired"] == record["press.x_desired"][0]).all()
    assert record["press.x"][0] == pytest.approx(0.12, abs=1e-9)
    assert facts.measures["steps"] == [] and facts.cylinder == "press"


# --- sets


def test_a_set_names_each_of_its_lists_without_doubles(tmp_path):
    arc = {"kind": "arc"}
    p2p = {"kind": "point_to_point", "waypoints": ["1 mm", "2 mm"], "speed": "1 m/s"}
    with pytest.raises(ValueError, match="two entries of controller are called 'arc'"):
        TrialSetRecipe(stage="trials", rig="x", motion=[p2p], controller=[arc, arc])
    laws = [arc, {**arc, "name": "ARC/2", "rig": "y"}, {**arc, "name": "arc 2"}]
    made = TrialSetRecipe(stage="trials", rig="x", motion=[p2p], controller=laws)
    cases = [Case(one.title, one, None, None) for one in made.cases()]
    assert [c.recipe.rig for c in cases] == ["x", "y", "x"]
    places = [c.recipe.controller.where for c in cases]
    assert places == [("controller", i) for i in range(3)]
    stem = "no_load_point_to_point_arc"
    assert file_names(cases) == [stem, f"{stem}_2", f"{stem}_2_2"]


def facts(error, overshoot, swing=0.0, stopped=False) -> Facts:
    stop = Stop("speed_max", "press.v", 1.0, 0.5, 0.1, "too fast") if stopped else None
    measures = {
        "gains": {"tick": 1e-3},
        "steps": [{"speed": 0.1, "overshoot": overshoot, "ringing": f"{error:g}"}],
        "tracking": {"max_error": error},
        "limit_cycle": {"amplitude": swing} if swing else None,
        "limits": {"saturated": 0.0},
    }
    warnings = (f"swings by {swing:g}",) if swing else ()
    about = ("bench", "rig", "none", {}, 0, 1.0, 1001, 1000.0)
    return Facts(*about, stop=stop, warnings=warnings, measures=measures)


def test_several_runs_give_medians_and_ranges():
    runs = [facts(3.0, 0.2), facts(1.0, None), facts(2.0, 0.4, swing=0.7), facts(5.0, 0.3)]
    assert middle_of(runs) == 2
    found = over_runs(runs, 2)
    assert found.measures["tracking"] == {"max_error": 2.5}
    assert found.measures["range"]["tracking"] == {"max_error": [1.0, 5.0]}
    (step,), (ends,) = found.measures["steps"], found.measures["range"]["steps"]
    assert step == {"speed": 0.1, "overshoot": pytest.approx(0.3), "ringing": "2"}
    assert ends["overshoot"] == [0.2, 0.4] and found.measures["seeds"] == 4
    assert found.measures["gains"] == {"tick": 1e-3} and "gains" not in found.measures["range"]
    # the worst swing counts, whichever run had it
    assert over_runs(runs, 0).measures["limit_cycle"] == {"amplitude": 0.7}
    assert over_runs(runs, 0).warnings == ("swings by 0.7",)
    few = over_runs([facts(1.0, None), facts(2.0, None), facts(3.0, 0.1)], 1)
    assert few.measures["steps"][0]["overshoot"] is None, "most runs have none"
    halted = [facts(1.0, 0.1), facts(9.0, 0.1, stopped=True), facts(2.0, 0.1)]
    assert middle_of(halted) == 1 and "range" not in over_runs(halted, 1).measures
    (warning,) = over_runs(halted, 1).warnings
    assert warning.fields == {"count": 1, "runs": 3}


def test_a_set_runs_each_case_with_several_seeds(rig, tmp_path):
    way = {"kind": "point_to_point", "waypoints": ["90 mm", "110 mm"], "speed": "200 mm/s"}
    given = {"stage": "trials", "rig": "x", "motion": [way | {"hold": "0.1 s"}], "seeds": 3}
    law = {"kind": "arc"}
    with pytest.raises(ValueError, match="'seeds' are of the virtual bench's sensors"):
        TrialSetRecipe(**given, controller=[law])
    given |= {"on": "bench", "seed": 7, "path": tmp_path / "set.toml"}
    (tmp_path / "set.toml").touch()
    made = TrialSetRecipe(**given, controller=[law])
    (one,) = made.cases()
    case = Case(one.title, one, rig, None, seeds=made.seeds)
    prepared = case.prepare()
    found = case.run(prepared, tmp_path / "log.mcap")
    alone = [run(prepared.seeded(seed)) for seed in (7, 8, 9)]
    errors = sorted(each.facts.measures["tracking"]["max_error"] for each in alone)
    measures = found.facts.measures
    assert len(set(errors)) == 3 and measures["tracking"]["max_error"] == errors[1]
    assert measures["range"]["tracking"]["max_error"] == [errors[0], errors[2]]
    kept = next(e for e in alone if e.facts.measures["tracking"]["max_error"] == errors[1])
    assert np.array_equal(read_log(tmp_path / "log.mcap")["press.x"], kept.record["press.x"])
    assert found.facts.seed == kept.facts.seed
    # the sensor's count and noise are no error of the stroke as it is
    assert measures["tracking_true"] != measures["tracking"]


@pytest.mark.parametrize("path", sorted((RECIPES / "trials").glob("*.toml")), ids=lambda p: p.stem)
def test_the_examples_load_and_name_what_is_there(path):
    recipe = load_recipe(path)
    assert all(recipe.file(name).exists() for name in (recipe.rig, recipe.bench) if name)


def test_the_decay_of_a_shaped_step_begins_with_its_level():
    """A ramp of 0.3 s is no part of the decay after it, whose damping ratio is 0.1 at 25 rad/s."""
    t = np.arange(2000) * 1e-3
    late = np.maximum(t - 0.3, 0.0)
    swing = np.exp(-0.1 * 25.0 * late) * np.sin(25.0 * np.sqrt(0.99) * late)
    asked = 0.1 * np.minimum(t / 0.3, 1.0)
    result = step_measures(t, asked + 0.02 * swing, 0.1, asked=asked)
    assert result.damping_ratio == pytest.approx(0.1, abs=0.002)


def test_a_step_that_its_controller_shapes_decays_as_any_other(tmp_path):
    """The loop is the same; what its shaped speed makes of it is no part of the decay."""
    text = f"""{OPEN}[motion]
kind = "velocity_steps"
levels = ["80 mm/s"]
travel = "150 mm"
[controller]
kind = "pressure_feedback"
gains = {{ feedback_gain = "2e-11 m^3/(s Pa)", washout = "2 rad/s" }}
"""
    limits = 'acceleration_max = "0.4 m/s^2", jerk_max = "4 m/s^3"'
    results = []
    for shaping in (
        "",
        f"shaping = {{ {limits} }}",
        "shaping = { natural_frequency = '3 Hz', damping_ratio = 0.8 }",
    ):
        trial = run_trial(shipped("boom_four_valve"), closed(tmp_path, shaping, text))[1]
        (step,) = trial.measures["steps"]
        results.append((step["damping_ratio"], step["natural_frequency"]))
    plain, *shaped = results
    assert shaped == [(pytest.approx(plain[0], abs=0.01), pytest.approx(plain[1], rel=0.05))] * 2


def test_a_chamber_that_cavitates_is_told_with_how_long(rig):
    """A valve that shuts at speed empties the chamber behind the piston; slower, it does not."""
    step = STEP | {"stop": "0.3 s"}
    for volts, told in (("8 V", ["press.p_head", "press.p_rod"]), ("0.5 V", [])):
        record, facts = run_trial(rig, recipe(step | {"amplitude": volts}))
        notes = [note for note in facts.warnings if note.key == "trial.cavitates"]
        assert [note.fields["channel"] for note in notes] == told
        for note in notes:
            assert is_warning(note)
            times = record.t[record[note.fields["channel"]] < -45e3]  # half of -90 kPa
            assert note.fields["start"] == times[0] > 0.3
            assert note.fields["duration"] == pytest.approx(1e-3 * times.size, rel=2e-3)


@pytest.mark.parametrize(("count", "told"), [(1e-3, True), (2.5e-5, False), (0.0, False)])
def test_a_stroke_in_coarser_counts_than_the_controller_takes_is_told(count, told):
    x = np.linspace(0.1, 0.2, 1001) ** 2
    x = np.round(x / count) * count if count else x
    record = Record(np.arange(x.size) * 1e-3, {"press.x": x})
    known = {"gains": {"stroke_resolution": 2.5e-5}}
    notes = list(_coarse_stroke(record, known, shipped("slide_servo"), "press"))
    assert [note.key for note in notes] == ["trial.coarse_stroke"] * told
    assert all(note.fields["count"] == "1 mm" and is_warning(note) for note in notes)
    assert not list(_coarse_stroke(record, {}, shipped("slide_servo"), "press"))
