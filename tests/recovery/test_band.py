"""Parameters from the frequency response of logs, in place of their samples."""

import math
from functools import cache

import numpy as np
import pytest
import tomli_w

from ehbench import workflow
from ehbench.config.recipe import Sensor, load_rig
from ehbench.data.logs import write_log
from ehbench.data.record import Record
from ehbench.frequency_response.response import Averaging
from ehbench.guidance.suggestions import suggest
from ehbench.identification.hydraulics import FitOptions, identify_hydraulics, prepare_fit
from ehbench.plant.model import simulate
from ehbench.runs.rundir import read_json
from ehbench.vocabulary.errors import InputError
from tests.shared import RIGS

RIG = RIGS / "slide_servo.toml"
TRUE = {"bulk_modulus": 720e6, "spool.natural_frequency": 2.0 * math.pi * 60.0}
COMMAND = "press.servo.command"
NOISE = {"press.v": 2e-3, "press.p_head": 15e3, "press.p_rod": 15e3, "p_supply": 9e3}
RESPONSE = (COMMAND, Averaging(segment=0.4))
CHANNELS = ("v", "p_head", "p_rod")
LATE = 4  # samples


@cache
def swept(late: int = 0) -> Record:
    """A multisine of the command up to 30 Hz, all channels some samples late."""
    rng, t = np.random.default_rng(4), np.arange(1001) * 2e-3
    tones = [np.sin(2.0 * math.pi * f * t + rng.uniform(0.0, 6.3)) for f in range(1, 31)]
    command = 0.12 * np.sum(tones, axis=0) * (t > 0.1)
    rig = load_rig(RIG).with_values(TRUE)
    start = {"press": "200 mm"}
    made = simulate(rig, {"press.servo": command}, t[-1], posture=start, rate=500.0)
    channels = {COMMAND: command}
    for name, size in NOISE.items():
        y = np.concatenate([np.full(late, made[name][0]), made[name][: t.size - late]])
        channels[name] = y + size * rng.standard_normal(t.size)
    return Record(t, channels, {"payload": "none"})


def fitted(late: int, parameters=tuple(TRUE), **options):
    given = FitOptions(channels=CHANNELS, response=RESPONSE, **options)
    return identify_hydraulics(load_rig(RIG), [("sweep", swept(late))], parameters, given)


@pytest.mark.slow
def test_stiffness_and_valve_come_from_the_response(tmp_path, unpainted):
    write_log(tmp_path / "sweep.mcap", swept())
    recipe = {"stage": "identify", "what": "hydraulics", "rig": str(RIG), "data": ["sweep.mcap"]}
    recipe |= {"parameters": list(TRUE), "channels": list(CHANNELS)}
    recipe["response"] = {"input": COMMAND, "segment": "0.4 s"}
    (tmp_path / "fit.toml").write_text(tomli_w.dumps(recipe))
    run = workflow.run(tmp_path / "fit.toml", workflow.Session(root=tmp_path / "runs"))
    found = read_json(run.folder / "parameters.json")
    for one in found["parameters"]:
        low, high = one["interval"]
        assert low <= TRUE[one["name"]] <= high and high - low < 0.03 * TRUE[one["name"]]
    (log,) = found["logs"]
    assert log["samples"] < 150  # numbers of a response, not samples
    assert min(log["fit_percent"].values()) > 98.0
    assert not any("by the slope of its phase" in text for text in found["warnings"])
    assert [one["channel"] for one in log["responses"]] == list(log["fit_percent"])
    for one in log["responses"]:
        seen, made = one["recorded"], one["simulated"]
        at = np.array(seen["coherent"])
        assert at.sum() > 2 and max(np.array(seen["frequency"])[at]) == 22.5
        assert np.array(made["gain"])[at] == pytest.approx(np.array(seen["gain"])[at], rel=0.05)
    index = read_json(run.folder / "figures" / "index.json")
    assert ["Response to press.servo in sweep"] == [
        one["title"] for one in index["figures"] if one["about"]["kind"] == "response"
    ]


@pytest.mark.slow
def test_a_delay_that_nobody_modelled_shows_up():
    fit = fitted(LATE, ("bulk_modulus",))
    said = [text for text in fit.warnings if "by the slope of its phase" in text]
    assert any(f"press.v answers {COMMAND}" in text for text in said)
    late = float(said[0].split(COMMAND)[1].split()[0])
    assert 4.0 < late < 12.0  # 8 ms, and the valve's own lag is not the rig file's
    free = fitted(LATE, sensors=(Sensor(channel=COMMAND, delay="estimate"),))
    (delay,) = free.sensors
    assert abs(delay.value - 0.008) < 3.0 * delay.std + 1e-4 and delay.std < 1e-3
    low, high = free["bulk_modulus"].interval  # pyright: ignore[reportGeneralTypeIssues]
    assert low <= TRUE["bulk_modulus"] <= high


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (FitOptions(response=RESPONSE, cutoff=20.0), "without a low-pass"),
        (FitOptions(response=RESPONSE, method="thesis"), "no response to a sweep"),
        (FitOptions(response=("press.pa.command", Averaging())), "does not have"),
        (FitOptions(response=("p_supply", Averaging())), "none of them answers"),
    ],
)
def test_what_has_no_response_is_refused(options, said):
    with pytest.raises(InputError, match=said):
        prepare_fit(load_rig(RIG), [("sweep", swept())], ["bulk_modulus"], options)


def test_no_suggestions_without_windows():
    options = FitOptions(channels=CHANNELS, response=RESPONSE)
    prepared = prepare_fit(load_rig(RIG), [("sweep", swept())], ["bulk_modulus"], options)
    with pytest.raises(InputError, match="windows left out"):
        suggest(prepared, [("sweep", swept())])
