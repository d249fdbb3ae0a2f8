"""A validation reads its logs as the fit of its rig found their sensors to be."""

import json
from pathlib import Path

import numpy as np
import pytest

from ehbench.config.recipe.sensor import Sensor
from ehbench.data.record import Record
from ehbench.identification.results import SensorFit
from ehbench.plant.model import Model
from ehbench.preprocessing.sensors import ATMOSPHERE, Term, corrected, terms_of
from ehbench.stages.fitted_sensors import inherited, tables_of
from tests.shared import shipped

CHANNELS = ("boom.q", "boom.p_head", "boom.p_rod", "boom.sh.command", "boom.sr.command")


def row(channel: str, word: str, value: float, std: float, log: str = "") -> dict:
    return {"channel": channel, "word": word, "value": value, "std": std, "log": log}


@pytest.fixture
def run(tmp_path) -> Path:
    told = [
        Sensor.model_validate(one)
        for one in (
            {"channel": "boom.q", "offset": "estimate"},
            {"channel": "boom.p_head", "pressure": "absolute", "offset": "estimate"},
            {"channel": "boom.p_rod", "offset": "estimate", "per_log": True},
            {"channel": "boom.sh.command", "sign": -1, "scale": "estimate"},
            {"channel": "boom.sr.command", "offset": "0.2 V"},
            {"channel": "boom.x", "scale": "estimate"},
        )
    ]
    found = [
        row("boom.q", "offset", 0.07, 0.005),
        row("boom.p_head", "offset", ATMOSPHERE + 3e4, 1e3),
        row("boom.p_rod", "offset", 2e4, 1e3, log="a"),
        row("boom.sh.command", "scale", -1.05, 0.01),
        row("boom.x", "scale", 1.1, 0.01),
        row("boom.sr.command", "delay", -0.011, 0.0),  # written late
    ]
    text = json.dumps({"sensors": found} | tables_of(told))
    (tmp_path / "parameters.json").write_text(text)
    return tmp_path


def test_what_a_fit_found_of_its_sensors_is_taken_over(run):
    rig = shipped("boom_four_valve")
    sensors, said = inherited(run, (), CHANNELS, rig)
    by = {one.channel: one for one in sensors}
    assert set(by) == set(CHANNELS)  # not of the stroke, which these logs do not have
    assert float(by["boom.q"].offset) == 0.07 and by["boom.q"].offset.std == 0.005
    assert float(by["boom.p_head"].offset) == pytest.approx(3e4)  # above the atmosphere
    assert by["boom.p_head"].pressure == "absolute"
    assert by["boom.p_rod"].offset == "estimate" and by["boom.p_rod"].per_log
    assert float(by["boom.sh.command"].scale) == 1.05 and by["boom.sh.command"].sign == -1
    assert float(by["boom.sr.command"].offset) == 0.2 and by["boom.sr.command"].offset.std is None
    t = np.linspace(0.0, 1.0, 1001)
    late = Record(t, {"boom.sr.command": np.sin(t)})
    (early,) = terms_of([by["boom.sr.command"]], [late])
    command = corrected(late, [early], {})["boom.sr.command"]
    assert command[:900] == pytest.approx(np.sin(t[:900] + 0.011), abs=1e-6)
    terms = {(n.fields["channel"], n.fields.get("term") or n.fields["terms"]) for n in said}
    assert {
        ("boom.q", "offset 4 ± 0.56 deg"),
        ("boom.sh.command", "sign -1"),
        ("boom.p_rod", "offset of each log"),
        ("boom.sr.command", "offset 0.2 V"),
    } <= terms


@pytest.mark.parametrize("delay", [0.002, 0.005, -0.003])
def test_a_command_is_late_by_parts_of_a_sample(delay):
    """As at 1 kHz, where the same command is late by whole samples; integration steps of 0.5 ms
    are whole parts of it. Means over a sample of 4 ms would be off by 3 % and more."""
    model, t = Model.of(shipped("slide_servo")), np.arange(1200) * 1e-3

    def command(times):
        return np.select([times < 0.2, times < 0.3, times < 0.5], [0.0, 4.0, -4.0], 1.0)

    fine = Record(t, {"press.servo.command": command(t - delay + 1e-9)})
    slow = Record(t[::4], {"press.servo.command": command(t[::4] + 1e-9)})
    sensor = Sensor.model_validate({"channel": "press.servo.command", "delay": f"{delay} s"})
    seen = model.replay(corrected(slow, terms_of([sensor], [slow]), {}))
    for name in ("press.v", "press.p_head", "press.p_rod"):
        expected = model.replay(fine)[name][::4]
        assert np.max(np.abs(seen[name] - expected)) < 1e-6 * np.ptp(expected), name


def test_a_table_of_the_recipe_goes_before_it_and_none_is_none(run, tmp_path):
    rig = shipped("boom_four_valve")
    own = (Sensor.model_validate({"channel": "boom.q", "offset": "1 deg"}),)
    sensors, said = inherited(run, own, CHANNELS, rig)
    assert sensors[0] is own[0] and [one.channel for one in sensors].count("boom.q") == 1
    assert not any("boom.q" in one for one in said)
    assert inherited(tmp_path / "none", own, CHANNELS, rig) == (own, ())
    assert tables_of(()) == {}


def test_a_number_of_a_sensor_has_the_standard_error_of_its_bias():
    """5 Pa a unit of bias, from 2 Pa on: bias 3 ± 0.4 is 17 ± 2 Pa, in 95 % ± 1.96 times that."""
    term = Term("boom.p_head", "offset", 2.0, -5.0, 0.6, False)
    found = SensorFit.of(term, "log", -3.0, 0.4, 1.96)
    assert (found.value, found.std, found.known, found.prior) == (17.0, 2.0, 2.0, 3.0)
    assert found.interval == pytest.approx((17.0 - 3.92, 17.0 + 3.92))
