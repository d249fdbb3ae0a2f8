"""Logs of a controller that held the position: their motion is tied in, and pressures stay what is
judged."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import tomli_w
from scipy.signal import butter, sosfiltfilt

from ehbench import workflow
from ehbench.config.recipe import Sensor
from ehbench.data.logs import write_log
from ehbench.data.record import Record
from ehbench.identification.hydraulics import FitOptions, identify_hydraulics, prepare_fit
from ehbench.plant.model import Model
from ehbench.plant.ties import TIED, without_noise
from ehbench.preprocessing.observations import column
from ehbench.preprocessing.sensors import lagged
from ehbench.runs.rundir import read_json
from ehbench.validation import prepare_validation
from ehbench.vocabulary.errors import InputError
from tests.shared import RIGS, judged, shipped
from tools.studies.closed_loop_study import SLOPE, TRUE, closed_loop_log, fitted, rigs

STIFF, LEAKS = "bulk_modulus", "press.leakage_internal"


@cache
def loaded() -> Record:
    """A closed loop on a slope that the rig file does not know."""
    return closed_loop_log("load", 3, seconds=1.6)


def tied(record: Record, how: str) -> Record:
    return replace(record, meta=record.meta | {TIED: how})


def holds(fit, name: str) -> bool:
    low, high = fit[name].interval
    return low <= TRUE[name] <= high


def test_a_given_motion_keeps_the_oil_right_whatever_loads_the_rod():
    free = fitted("load", [loaded()], "none", (STIFF, LEAKS))
    given = fitted("load", [loaded()], "motion", (STIFF, LEAKS, "carriage.damping"))
    assert not holds(free, LEAKS)
    assert holds(given, LEAKS) and holds(given, STIFF)
    assert abs(given[STIFF].value / TRUE[STIFF] - 1.0) < 0.005
    assert given["carriage.damping"].status == "not_excited"
    assert sum("masses, loads, damping" in text for text in given.warnings) == 1
    assert set(given.logs[0].fit_percent) == {"press.p_head", "press.p_rod"}


@pytest.mark.slow
def test_a_tied_position_keeps_the_stiffness_right_where_the_replay_drifts_away():
    log = closed_loop_log("neutral", 5, seconds=12.0)
    free, held = (fitted("neutral", [log], how) for how in ("none", "position"))
    assert not holds(free, STIFF)
    assert abs(held[STIFF].value - TRUE[STIFF]) < 0.5 * abs(free[STIFF].value - TRUE[STIFF])
    assert "press.v" in held.logs[0].fit_percent  # which stays judged


@pytest.mark.parametrize(("how", "same"), [("position", ("x",)), ("motion", ("x", "v"))])
def test_what_is_tied_is_as_recorded(how, same):
    """The position from sample to sample; a rate beside what noise makes of its differences."""
    record = loaded()
    model = Model.of(rigs("load")[1])
    made = model.replay(tied(record, how))
    for word in same:
        off = made[f"press.{word}"] - record[f"press.{word}"]
        size = {"position": {"x": 1e-12}, "motion": {"x": 2e-5, "v": 8e-3}}[how][word]
        assert np.sqrt(np.mean(off**2)) < size
    assert made["press.p_head"] == pytest.approx(record["press.p_head"], abs=8e5)


def test_a_rate_from_a_tied_position_is_that_of_the_simulation():
    """Wrong gains show in it, as they cannot in the position. Oracle: SciPy's filter of the rate,
    which central differences 1 ms apart follow to (2π·20·1e-3)²/6 = 3e-3."""
    recorded = loaded()
    kept = {name: y for name, y in recorded.channels.items() if name != "press.v"}
    record = tied(replace(recorded, channels=kept), "position")
    known = rigs("load")[1]
    gains = {name: 0.9 * float(y) for name, y in known.parameters().items() if "gain" in name}
    for rig, most, least in ((known, 0.02, 0.0), (known.with_values(gains), 0.2, 0.05)):
        made = Model.of(rig).replay(record)
        shown, seen = (column(item, "press.v", record) for item in (made, record))
        assert shown is not None and seen is not None
        sections = butter(2, 20.0, fs=1.0 / record.sample_time, output="sos")
        expected = sosfiltfilt(sections, made["press.v"])
        size = float(np.std(expected))
        assert shown[100:-100] == pytest.approx(expected[100:-100], abs=5e-3 * size)
        assert least < np.std(shown - seen) / size < most


def test_the_angle_of_a_boom_is_tied_through_its_pins():
    """By stroke or by angle, on every joint, paced or not."""
    model = Model.of(shipped("crane_proportional"))
    t = np.arange(301) * 1e-3
    table = model.rest_commands(t.size)
    table[50:] = 3.0
    log = model.run(model.trim(model.posture({"lift": "300 mm"})), table)
    made = model.record(t, table, log)
    for word in ("x", "q"):
        kept = {
            n: y for n, y in made.channels.items() if n in (f"lift.{word}", "lift.spool.command")
        }
        record = tied(Record(t, kept, {}), "position")
        for step in (5e-4, "auto"):
            again = model.replay(record, step)
            assert again["lift.q"] == pytest.approx(made["lift.q"], abs=1e-9)
            assert again["lift.p_head"] == pytest.approx(made["lift.p_head"], abs=3e4)


def test_noise_of_a_position_is_cut_off_above_its_motion():
    t = np.arange(2000) * 1e-3
    ring = 0.1 * np.sin(2.0 * np.pi * 2.0 * t) + 2e-4 * np.sin(2.0 * np.pi * 25.0 * t)
    noise = 2e-5 * np.random.default_rng(1).standard_normal(t.size)
    off = without_noise(ring + noise, 1e-3) - ring
    assert np.std(off[100:-100]) < 0.5 * np.std(noise)
    assert without_noise(ring, 1e-3)[100:-100] == pytest.approx(ring[100:-100], abs=1e-6)
    # samples of 50 Hz on straight lines: third differences of the lines tell nothing of their noise
    slow = 0.1 * np.sin(np.pi * t[::20]) + 50.0 * noise[::20]
    line, motion = np.interp(t, t[::20], slow), 0.1 * np.sin(np.pi * t)
    off, asis = ((without_noise(line, 1e-3, n) - motion)[100:-100] for n in (20, 1))
    assert np.std(off) < 0.6 * np.std(asis)


@pytest.mark.parametrize("how", ["position", "motion"])
def test_a_log_without_a_position_is_refused(how):
    kept = {name: y for name, y in loaded().channels.items() if name != "press.x"}
    record, said = tied(replace(loaded(), channels=kept), how), "has no position of a cylinder"
    with pytest.raises(InputError, match=said):
        prepare_fit(rigs("load")[0], [("a", record)], [STIFF])
    with pytest.raises(InputError, match=said):
        prepare_validation(rigs("load")[0], [("a", record)])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (FitOptions(channels=("v",)), "v: being tied"),
        (FitOptions(method="thesis"), "takes no tied motion"),
    ],
)
def test_what_a_given_motion_cannot_bear_is_refused(options, said):
    with pytest.raises(InputError, match=said):
        prepare_fit(rigs("load")[0], [("a", tied(loaded(), "motion"))], [STIFF], options)


def test_a_given_motion_is_taken_as_much_earlier_as_its_sensor_is_late():
    """4 ms move the leakage by a tenth; known, they leave the estimate of the sound sensor."""
    log = loaded()
    x = lagged(log["press.x"], log.sample_time, 4e-3)
    late = replace(log, channels=log.channels | {"press.x": x})
    known = (Sensor(channel="press.x", lag="4 ms"),)
    sound, biased, right = (
        identify_hydraulics(
            rigs("load")[0],
            [("a", tied(item, "motion"))],
            [STIFF, LEAKS],
            FitOptions(sensors=given),
        )[LEAKS].value
        for item, given in ((log, ()), (late, ()), (late, known))
    )
    assert abs(right / sound - 1.0) < 0.005 and abs(biased / sound - 1.0) > 0.05


def test_motion_of_a_chain_needs_every_joint():
    rig = shipped("thesis_arm")
    t = np.arange(300) * 1e-3
    channels = {"boom.q": 0.1 * t, "boom.sr.command": np.where(t > 0.1, 5.0, 0.0)}
    record = tied(Record(t, channels, {"payload": "none"}), "motion")
    with pytest.raises(InputError, match="has no position of swing, stick"):
        prepare_validation(rig.with_values({}), [("a", record)])


def test_a_coarse_position_is_said():
    coarse = tied(closed_loop_log("load", 3, seconds=0.8, noise=40.0), "motion")
    prepared = prepare_validation(rigs("load")[0], [("a", coarse)])
    notes = [n for n in prepared.logs[0].log.notes if n.key == "preprocessing.position_noise"]
    # the slide at mid-stroke: oil of volume_head + A1 L/2 and of volume_rod − A2 L/2
    head, rod = math.pi * 0.05**2 / 4.0, math.pi * (0.05**2 - 0.028**2) / 4.0
    worth = [head / (150e-6 + 0.2 * head), rod / (700e-6 - 0.2 * rod)]
    spreads = [float(np.std(coarse[f"press.p_{side}"])) for side in ("head", "rod")]
    shares = [note.fields["share"] for note in notes]
    expected = worth[0] / worth[1] * spreads[1] / spreads[0]
    assert shares[0] / shares[1] == pytest.approx(expected, rel=1e-6)
    fine = prepare_validation(rigs("load")[0], [("a", tied(loaded(), "motion"))])
    keys = [note.key for note in fine.logs[0].log.notes]
    assert "preprocessing.position_noise" not in keys


def test_a_model_is_judged_by_what_is_not_tied():
    machine = rigs("load")[1]
    wrong = machine.with_values({STIFF: 1.5 * TRUE[STIFF]})
    for how, channels in (("position", {"v", "p_head", "p_rod"}), ("motion", {"p_head", "p_rod"})):
        given = [("a", tied(loaded(), how))]
        right = judged(machine, given, ("x", "v", "p_head", "p_rod"))
        assert {one.channel.partition(".")[2] for one in right.logs[0].channels} == channels
        assert right.accepted, right.reasons
        assert f"preprocessing.{how}_replayed" in {note.key for note in right.logs[0].warnings}
    off = judged(wrong, given).logs[0].channels
    assert off[0].fit_percent < right.logs[0].channels[0].fit_percent - 5.0
    # an unknown load does not count where the motion is given
    known = rigs("load")[0].with_values(
        {name: float(machine.parameters()[name]) for name in machine.parameters() if "gain" in name}
        | TRUE
    )
    assert SLOPE > 0.0 and judged(known, given).accepted


def test_recipes_say_what_is_tied(tmp_path, inside, undrawn):
    write_log(tmp_path / "log.mcap", loaded())
    recipe = {"stage": "identify", "what": "hydraulics", "rig": str(RIGS / "slide_servo.toml")}
    recipe |= {"tied": "motion", "data": ["log.mcap"], "parameters": [STIFF]}
    path = tmp_path / "fit.toml"
    path.write_text(tomli_w.dumps(recipe))
    outcome = workflow.run(path, workflow.Session(root=tmp_path / "runs"))
    logs = read_json(outcome.folder / "parameters.json")["logs"]
    assert set(logs[0]["fit_percent"]) == {"press.p_head", "press.p_rod"}
    judge = {"stage": "validate", "rig": str(outcome.folder)}
    # pyrefly: ignore[bad-assignment]
    judge["data"] = [{"path": "log.mcap", "tied": "position"}]
    (tmp_path / "judge.toml").write_text(tomli_w.dumps(judge))
    checked = inside("check", "-v", tmp_path / "judge.toml")
    assert "follows press.x: no position is judged" in " ".join(checked.stdout.split())
    path.write_text(tomli_w.dumps(recipe | {"tied": "speed"}))
    assert inside("check", path).returncode == 2
