"""Trials: what is commanded, where a limit stops, what is recorded."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ehbench.errors import InputError
from ehbench.logs import write_log
from ehbench.recipe import TrialRecipe, load_recipe, load_rig
from ehbench.record import Record
from ehbench.simulate import simulate
from ehbench.trial import RUN_OUT, command_table, run_trial

RECIPES = Path(__file__).parents[2] / "recipes"
STEP = {"valve": "press.servo", "kind": "step", "amplitude": "4 V", "start": "0.1 s", "stop": "0.6 s"}


@pytest.fixture(scope="module")
def rig():
    return load_rig(RECIPES / "rigs" / "slide_servo.toml")


def recipe(*command, **given):
    return TrialRecipe(stage="trial", rig="x.toml", command=command, **({"duration": "1 s"} | given))


def played(rig, *command, duration=1.0, rate=1000):
    return command_table(recipe(*command), rig, np.arange(round(duration * rate) + 1) / rate)[:, 0]


def test_a_valve_without_command_rests(rig):
    assert np.array_equal(command_table(recipe(), rig, np.arange(5.0)), np.zeros((5, 1)))


def test_the_sample_at_the_switching_time_has_the_new_command(rig):
    u = played(rig, {**STEP, "offset": "1 V"})
    assert u[99] == 1.0 and u[100] == 5.0 and u[599] == 5.0 and u[600] == 1.0


def test_entries_for_one_valve_add_up(rig):
    u = played(rig, STEP, {"valve": "press.servo", "kind": "constant", "offset": "-1 V"})
    assert u[0] == -1.0 and u[300] == 3.0


def test_a_ramp_arrives_and_stays(rig):
    u = played(rig, {**STEP, "kind": "ramp", "offset": "1 V", "amplitude": "2 V", "start": "0.2 s", "stop": "0.4 s"})
    assert u[200] == 1.0 and u[300] == pytest.approx(2.0) and u[400] == pytest.approx(3.0) and u[-1] == 3.0


def test_a_sine_has_its_frequency_and_window(rig):
    u = played(rig, {**STEP, "kind": "sine", "amplitude": "2 V", "frequency": "5 Hz", "start": "0.2 s", "stop": "0.8 s"})
    t = np.arange(1001) / 1000
    inside = (t > 0.1995) & (t < 0.7995)
    assert u[inside] == pytest.approx(2 * np.sin(2 * np.pi * 5 * (t[inside] - 0.2)), abs=1e-9)
    assert not u[~inside].any()


def test_a_multisine_has_its_lines_and_its_amplitude_and_its_seed(rig):
    wave = {"valve": "press.servo", "kind": "multisine", "amplitude": "2 V", "lines": 10}
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
    write_log(tmp_path / "u.mcap", Record(t, {"press.servo.command": np.array([0.0, 1, 2, 3, 4, 5])}))
    given = recipe({"valve": "press.servo", "kind": "file", "file": "u.mcap", "start": "0.1 s"})
    given = given.model_copy(update={"path": tmp_path / "trial.toml"})
    u = command_table(given, rig, np.arange(301) / 1000)[:, 0]
    assert u[99] == 0.0 and u[110] == 1.0 and u[119] == 1.0 and u[120] == 2.0 and u[150] == 5.0 and u[151] == 0.0
    write_log(tmp_path / "other.mcap", Record(t, {"press.x": np.zeros(6)}))
    other = recipe({"valve": "press.servo", "kind": "file", "file": "other.mcap"})
    other = other.model_copy(update={"path": tmp_path / "trial.toml"})
    with pytest.raises(InputError, match=r"no channel 'press.servo.command'"):
        command_table(other, rig, np.arange(3.0))


@pytest.mark.parametrize(
    ("command", "says", "hint"),
    [
        ({**STEP, "amplitude": "11 V"}, "11 V at t = 0.1 s", "-10 to 10 V"),
        ({**STEP, "valve": "press.servos"}, "no valve 'press.servos'", "press.servo"),
        ({**STEP, "stop": "0.05 s"}, "stops before it starts", None),
    ],
)
def test_a_command_that_cannot_be_is_refused_with_its_line(rig, tmp_path, command, says, hint):
    lines = ['stage = "trial"', 'rig = "x.toml"', 'duration = "1 s"', "[[command]]"]
    lines += [f'{k} = "{v}"' for k, v in command.items()]
    (tmp_path / "trial.toml").write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match=says) as error:
        run_trial(rig, load_recipe(tmp_path / "trial.toml"))
    assert error.value.file.endswith("trial.toml") and error.value.line >= 4
    assert hint is None or hint in error.value.hint


def test_a_trial_on_the_model_is_what_simulate_gives(rig):
    given = recipe(STEP, posture={"press": "120 mm"}, payload="100 kg")
    record, facts = run_trial(rig, given)
    u = played(rig, STEP)
    plain = simulate(rig, {"press.servo": u}, 1.0, posture={"press": "120 mm"}, payload="100 kg")
    assert list(record.channels) == list(plain.channels)
    for name in plain.channels:
        # the trial's step is the same one, taken one by one
        assert np.allclose(record[name], plain[name], rtol=1e-9, atol=1e-12 * max(1.0, np.abs(plain[name]).max())), name
    assert not facts.stopped and facts.samples == 1001 and record.meta["payload"] == "100 kg" and record.meta["on"] == "model"
    json.dumps(facts.as_json(), allow_nan=False)


def test_a_trial_on_the_bench_has_only_what_a_machine_measures(rig):
    record, facts = run_trial(rig, recipe(STEP, on="bench", seed=4))
    own = [f"press.{key}" for key in ("q", "qd", "x", "v", "p_head", "p_rod")]
    assert list(record.channels) == [*own, "press.servo.command", "p_supply", "p_tank"]
    assert (facts.on, facts.seed, facts.rate) == ("virtual bench", 4, 1000.0)


LIMIT_CASES = [
    ({"pressure_max": "60 bar"}, "press.p_rod", lambda x, s: x > s),
    ({"pressure_min": "13 bar"}, "press.p_head", lambda x, s: x < s),
    ({"stroke_margin": "175 mm"}, "press.x", lambda x, s: x > s),
    ({"speed_max": "150 mm/s"}, "press.v", lambda x, s: abs(x) > s),
    ({"command_max": "3 V"}, "press.servo.command", lambda x, s: abs(x) > s),
]


@pytest.mark.parametrize("on", ("model", "bench"))
@pytest.mark.parametrize(("limit", "channel", "beyond"), LIMIT_CASES, ids=[next(iter(case[0])) for case in LIMIT_CASES])
def test_a_limit_stops_within_one_tick(rig, on, limit, channel, beyond):
    amplitude = {"pressure_min": "-6 V", "pressure_max": "-6 V"}.get(next(iter(limit)), "4 V")
    record, facts = run_trial(rig, recipe({**STEP, "amplitude": amplitude}, limits=limit, on=on, posture={"press": "200 mm"}))
    stop = facts.stop
    assert stop is not None, f"{channel} from {record[channel].min():.6g} to {record[channel].max():.6g}"
    row = round(stop.t * 1000)
    assert (stop.limit, stop.channel) == (next(iter(limit)), channel)
    assert beyond(stop.value, stop.bound)
    if channel != "press.servo.command":
        assert record[channel][row] == stop.value
        assert not beyond(record[channel][row - 1], stop.bound)
        assert np.abs(record["press.servo.command"][row - 1]) > 0
    assert not record["press.servo.command"][row:].any(), "valves rest from the very tick"
    assert record.t[-1] == pytest.approx(min(1.0, stop.t + RUN_OUT))
    assert next(iter(limit)) in facts.stopped and record.meta["stopped"] == facts.stopped
    json.dumps(facts.as_json(), allow_nan=False)


def test_a_limit_reached_before_the_start_is_refused(rig):
    with pytest.raises(InputError, match="cannot start: press.x = 10 mm passed stroke_margin"):
        run_trial(rig, recipe(STEP, limits={"stroke_margin": "20 mm"}, posture={"press": "10 mm"}))


def test_the_bench_of_another_rig_is_refused(rig):
    with pytest.raises(InputError, match="other cylinders"):
        run_trial(rig, recipe(STEP, on="bench", bench=str(RECIPES / "bench" / "crane_proportional.toml")))
    with pytest.raises(InputError, match="no bench file"):
        run_trial(rig, recipe(STEP, on="bench", bench=str(RECIPES / "datasets" / "slide_servo.toml")))


def test_progress_rises_to_one(rig):
    seen = []
    run_trial(rig, recipe(STEP, duration="3.4 s"), progress=lambda _, share: seen.append(share))
    assert seen == sorted(seen) and seen[-1] == 1.0 and len(seen) > 2
