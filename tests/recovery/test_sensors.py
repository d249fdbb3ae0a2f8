"""Sensors that are off, slow or turned, and drivers whose zero is not zero: what is known of them
is taken out, what is not is estimated with the parameters, which stay right."""

import tomllib
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import tomli_w
from pydantic import ValidationError
from scipy.signal import lfilter

from ehbench import workflow
from ehbench.config.recipe import Sensor
from ehbench.data.logs import write_log
from ehbench.data.record import Record
from ehbench.identification.hydraulics import FitOptions, identify_hydraulics, prepare_fit
from ehbench.plant.model import Model, simulate
from ehbench.preprocessing.preparation import preprocess
from ehbench.preprocessing.sensors import lagged
from ehbench.report import terminal
from ehbench.report.content import remedy_step
from ehbench.runs.rundir import read_json
from ehbench.validation import prepare_validation, run_validation, validate_rig
from ehbench.vocabulary.errors import InputError
from tests.shared import RIGS, judged, shipped

PARAMETERS = ["bulk_modulus", "carriage.damping"]
TRUE = {"bulk_modulus": 8e8, "carriage.damping": 1100.0}
NOISE = {"v": 1e-3, "p_head": 15e3, "p_rod": 15e3, "x": 2e-5, "p_supply": 9e3, "command": 0.0}


@cache
def rig(name="slide_servo"):
    return shipped(name)


@cache
def sound(amplitude: float, seed: int) -> Record:
    """A log of steps out and back with white noise, by sound sensors."""
    t = np.arange(1201) * 1e-3
    u = amplitude * (((t > 0.1) & (t < 0.5)) * 1.0 - ((t > 0.6) & (t < 1.0)) * 1.0)
    made = simulate(rig().with_values(TRUE), {"press.servo": u}, 1.2, posture={"press": "200 mm"})
    rng, channels = np.random.default_rng(seed), {}
    for name, values in made.channels.items():
        if (size := NOISE.get(name.rsplit(".", 1)[-1])) is not None:
            channels[name] = values + size * rng.standard_normal(values.size)
    return replace(made, channels=channels)


def spoilt(**changes) -> list[tuple[str, Record]]:
    """Two logs of which some channels (dots as two underlines) are changed by functions."""
    logs = []
    for name, amplitude, seed in (("a", 3.0, 1), ("b", 2.0, 2)):
        log = sound(amplitude, seed)
        own = {key.replace("__", "."): change for key, change in changes.items()}
        made = {channel: change(log[channel]) for channel, change in own.items()}
        logs.append((name, replace(log, channels=log.channels | made)))
    return logs


def fitted(logs, *sensors):
    return identify_hydraulics(rig(), logs, PARAMETERS, FitOptions(sensors=sensors))


def off(fit) -> float:
    """By how many half widths of its interval the worst parameter is off."""
    return max(
        abs(one.value - TRUE[one.name]) / (0.5 * (one.interval[1] - one.interval[0]))
        for one in fit.parameters
    )


def delayed(y):
    t = np.arange(y.size)
    return np.interp(t - 6.0, t, y)


ERRORS = {
    ("press.p_head", "offset"): (lambda y: y + 2e5, 2e5),
    ("press.p_head", "scale"): (lambda y: 1.07 * y, 1.07),
    ("press.v", "lag"): (lambda y: lagged(y, 1e-3, 0.004), 0.004),
    ("press.v", "delay"): (delayed, 0.006),
    ("press.servo.command", "offset"): (lambda y: y + 0.15, 0.15),
    ("press.servo.command", "scale"): (lambda y: y / 1.05, 1.0 / 1.05),
}


@pytest.mark.slow
@pytest.mark.parametrize(("channel", "word"), ERRORS)
def test_an_error_of_a_sensor_is_estimated_with_the_parameters(channel, word):
    change, truth = ERRORS[channel, word]
    logs = spoilt(**{channel.replace(".", "__"): change})
    unasked = fitted(logs)
    fit = fitted(logs, Sensor.model_validate({"channel": channel, word: "estimate"}))
    (found,) = fit.sensors
    assert (found.channel, found.word, found.log) == (channel, word, "")
    assert found.std < 0.1 * found.prior
    assert abs(found.value - truth) < 1.5 * (found.interval[1] - found.value) + 1e-4 * abs(truth)
    assert off(fit) < 1.5
    left = [fit.logs[0].residual_rms[c] / r for c, r in unasked.logs[0].residual_rms.items()]
    assert min(left) < 0.5 and max(left) < 1.05


def test_an_offset_of_each_log_is_its_own_and_widens_the_intervals():
    channel = "press.servo.command"
    logs = spoilt(press__servo__command=lambda y: y + 0.05)
    second = logs[1][1]
    logs[1] = ("b", replace(second, channels=second.channels | {channel: second[channel] + 0.05}))
    fit = fitted(logs, Sensor(channel=channel, offset="estimate", per_log=True))
    assert [one.log for one in fit.sensors] == ["a", "b"]
    assert [one.value for one in fit.sensors] == pytest.approx([0.05, 0.1], abs=2e-3)
    assert off(fit) < 1.5
    sure = fitted([("a", sound(3.0, 1)), ("b", sound(2.0, 2))])
    assert all(fit[one].from_starts > sure[one].from_starts for one in PARAMETERS)
    wide, narrow = (one["carriage.damping"].interval for one in (fit, sure))
    assert wide and narrow and wide[1] - wide[0] > 1.05 * (narrow[1] - narrow[0])


def test_what_is_known_of_a_sensor_is_taken_out():
    logs = spoilt(
        press__p_head=lambda y: 1.1 * (-y) + 101_325.0,
        press__servo__command=lambda y: 0.2 - y,
        press__p_rod=lambda y: y + 3e5,
    )
    fit = fitted(
        logs,
        Sensor(channel="press.p_head", sign=-1, scale=1.1, pressure="absolute"),
        Sensor(channel="press.servo.command", sign=-1, offset="0.2 V"),
        Sensor(channel="press.p_rod", offset={"value": "2.9 bar", "std": "0.2 bar"}),
    )
    (found,) = fit.sensors
    assert found.value == pytest.approx(3e5, abs=3e3) and found.known == pytest.approx(2.9e5)
    assert found.prior == pytest.approx(2e4)
    assert off(fit) < 1.5


def test_a_known_lag_is_part_of_the_model():
    logs = spoilt(press__v=lambda y: lagged(y, 1e-3, 0.004))
    fit = fitted(logs, Sensor(channel="press.v", lag="4 ms"))
    assert not fit.sensors and off(fit) < 1.5


def test_validation_estimates_sensors_of_each_log():
    logs = spoilt(press__p_head=lambda y: y + 3e6)[:1]
    model = rig().with_values(TRUE)
    alone = judged(model, logs)
    sensors = [Sensor(channel="press.p_head", offset={"value": "0 bar", "std": "20 bar"})]
    prepared = prepare_validation(model, logs, sensors=sensors)
    found = run_validation(prepared, diagnose=False)
    assert not alone.accepted and found.accepted
    assert found.logs[0].sensors["press.p_head.offset"] == pytest.approx(3e6, rel=0.02)
    fits = {one.channel: one.fit_percent for one in found.logs[0].channels}
    assert (fits["press.p_head"] or 0.0) > 95.0
    (case,) = prepared.cases(found.logs)
    left = case.left(case.simulated())
    assert float(np.mean(left**2)) < 3.0  # the questions that follow see it as well


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"channel": "press.p_heat"}, "p_head"),
        ({"channel": "press.x", "pressure": "absolute"}, "not a pressure"),
        ({"channel": "press.x", "offset": "2 bar"}, "bar"),
        ({"channel": "press.x", "offset": "guess"}, "estimate"),
        ({"channel": "press.x", "scale": -1.0}, "sign"),
        ({"channel": "press.x", "lag": "-1 ms"}, "lag"),
    ],
)
def test_what_no_sensor_can_be_is_refused(table, words):
    with pytest.raises(ValidationError) as refused:
        Sensor.model_validate(table)
    assert words in str(refused.value)


def test_a_channel_that_the_log_lacks_is_refused():
    with pytest.raises(InputError, match=r"names 'press.q', which the log does not have"):
        asked = FitOptions(sensors=[Sensor(channel="press.q", offset="estimate")])
        prepare_fit(rig(), spoilt(), PARAMETERS, asked)


def test_sensors_of_a_recipe_are_shown_with_its_parameters(undrawn, tmp_path):
    for name, log in spoilt(press__p_head=lambda y: y + 2e5):
        write_log(tmp_path / f"{name}.mcap", log)
    recipe = {"stage": "identify", "what": "hydraulics", "rig": str(RIGS / "slide_servo.toml")}
    recipe |= {"data": ["a.mcap", "b.mcap"], "parameters": PARAMETERS}
    recipe |= {"sensor": [{"channel": "press.p_head", "offset": "estimate"}]}
    (tmp_path / "fit.toml").write_text(tomli_w.dumps(recipe))
    made = workflow.run(tmp_path / "fit.toml", workflow.Session(root=tmp_path / "runs"))
    (saved,) = read_json(made.folder / "parameters.json")["sensors"]
    assert saved["value"] == pytest.approx(2e5, abs=3e3)
    told = terminal.answer(made.folder).lines()
    (shown,) = (line for line in told if "offset of press.p_head" in line)
    assert "2.0" in shown and "bar" in shown


@pytest.mark.parametrize(
    ("word", "made"),
    [
        ("rod_force", lambda head, rod, a, b: head * a - rod * b),
        ("load_force", lambda head, rod, a, b: head * a - rod * b),
        ("load_pressure", lambda head, rod, a, b: head - rod),
    ],
)
def test_a_gauge_against_the_pressures_beside_it_is_told(word, made):
    """A load cell that reads pull as positive passed without a word."""
    log, model = sound(3.0, 1), Model.of(rig())
    force = made(log["press.p_head"], log["press.p_rod"], *rig().cylinder[0].areas())
    force = force + 0.2 * np.std(force) * np.random.default_rng(4).standard_normal(force.size)

    def told(values):
        channels = log.channels | {f"press.{word}": values}
        said = preprocess("log", replace(log, channels=channels), model)[1]
        return [text for text in said if "push more" in text]

    assert not told(force)
    assert f"press.{word} falls" in told(-force)[0] and "sign = -1" in told(-force)[0]


def test_a_lag_that_both_pressures_share_is_named_and_its_lines_are_toml():
    """The bridge amplifier's RC filter of 8 ms, as its difference equation has it."""
    slow = lambda y: lfilter([1.0 - (a := np.exp(-1.0 / 8.0))], [1.0, -a], y, zi=[a * y[0]])[0]
    logs = spoilt(press__p_head=slow, press__p_rod=slow)
    verdict = validate_rig(rig().with_values(TRUE), logs)
    first = verdict.structure.findings[0]
    assert (verdict.verdict, first.kind) == ("accepted with reservation", "sensor lag")
    assert first.size == pytest.approx(8e-3, rel=0.1)
    lines = tomllib.loads(remedy_step(first.remedy).hint)["sensor"]
    estimate = {"lag": "estimate"}
    assert lines == [{"channel": f"press.p_{end}"} | estimate for end in ("head", "rod")]
