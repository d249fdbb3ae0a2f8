"""Validation: the verdict and its reasons, what counts, what is only shown, and what is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
from pydantic import TypeAdapter

from ehbench.config.recipe import Thresholds, load_recipe
from ehbench.data.record import Record
from ehbench.plant.model import Model, simulate
from ehbench.runs.rundir import read_json, write_json
from ehbench.stages.base import write_series
from ehbench.validation import Ring, Validation, prepare_validation, run_validation, validate_rig
from ehbench.validation.residuals import Pair, compare_channel
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.messages import Message, is_warning
from tests.shared import judged, shipped
from tools.virtual_logs import noisy

NOISE = {"q": 4e-4, "qd": 2e-3, "x": 1e-4, "v": 1e-3, "p_head": 8e3, "p_rod": 8e3, "command": 0.0}
T = np.arange(2401) * 1e-3


def recorded(rig, valves: dict[str, float], payload: str | None = None, seed: int = 1) -> Record:
    """What sensors record of a step there and back: no openings or flows, noise."""
    commands = {v: np.where((T >= 0.3) & (T < 1.4), a, 0.0) for v, a in valves.items()}
    made = simulate(rig, commands, 2.4, payload=payload)
    return noisy(made, seed, payload, noise=NOISE)


def keys(notes) -> set[str]:
    return {getattr(note, "key", "") for note in notes}


def without(record: Record, *words: str) -> Record:
    kept = {n: v for n, v in record.channels.items() if n.rsplit(".", 1)[-1] not in words}
    return Record(record.t, kept, record.meta)


BOOM = {"boom.hepc": 4.0, "boom.rect": 8.0}


@pytest.fixture(scope="module")
def arm():
    return shipped("thesis_arm")


@pytest.fixture(scope="module")
def boom(arm) -> Record:
    return recorded(arm, BOOM)


@pytest.fixture(scope="module")
def swing(arm) -> Record:
    return recorded(arm, {"swing.servo": 2.0}, "50 lb")


@pytest.fixture(scope="module")
def accepted(arm, boom, swing) -> Validation:
    return validate_rig(arm, [("boom", boom), ("swing", swing)])


@pytest.fixture(scope="module")
def rejected(arm, boom, swing) -> Validation:
    stiff = arm.with_values({"bulk_modulus": 1.5 * 2.71e8})
    return validate_rig(stiff, [("boom", boom), ("swing", swing)])


def test_the_true_rig_is_accepted(accepted):
    """Noise is all that is left: fits and residuals of its size, ringing alike."""
    assert accepted.accepted and accepted.verdict == "accepted" and not accepted.reasons
    boom, swing = accepted.logs
    assert boom.passed and boom.status == "held_out"
    assert boom.moved == ("boom",) and boom.held == ("swing", "stick") and swing.payload == "50 lb"
    for result in boom.channels:
        word = result.channel.rsplit(".", 1)[1]
        assert result.rms_error == pytest.approx(NOISE[word], rel=0.1)
        assert abs(result.bias) < 0.1 * NOISE[word]
        assert result.fit_percent > 95
    assert {r.channel for r in boom.channels} == {"boom.q", "boom.qd", "boom.p_head", "boom.p_rod"}
    for window in boom.transients:
        assert window.simulated.natural_frequency == pytest.approx(
            window.recorded.natural_frequency, rel=0.01
        )
        assert window.simulated.damping_ratio == pytest.approx(
            window.recorded.damping_ratio, rel=0.05
        )
    assert [w.start for w in boom.transients] == pytest.approx([0.3, 1.4])


def test_a_wrong_bulk_modulus_is_rejected_for_the_right_reasons(rejected):
    """Half as stiff again rings √1.5 times as fast, which breaks the fits as well."""
    assert not rejected.accepted
    boom = rejected.logs[0]
    failed = {check.sentence.key: check for check in boom.checks if not check.passed}
    assert set(failed) == {"validation.ringing", "validation.fit"}
    assert failed["validation.ringing"].asked == 0.15 and failed["validation.fit"].asked == 30.0
    assert f"boom: {failed['validation.ringing'].sentence}" in rejected.reasons
    ratios = [w.simulated.natural_frequency / w.recorded.natural_frequency for w in boom.transients]
    assert ratios == pytest.approx([math.sqrt(1.5)] * 2, rel=0.03)


def test_the_numbers_are_the_textbook_ones(arm, boom):
    """Fit, bias and largest error, with an offset put on a channel by hand."""
    shifted = Record(boom.t, boom.channels | {"boom.p_head": boom["boom.p_head"] - 3e5}, boom.meta)
    result = judged(arm, [("boom", shifted)])
    channel = next(c for c in result.logs[0].channels if c.channel == "boom.p_head")
    y, simulated = (
        result.logs[0].series[name] for name in ("boom.p_head", "simulated.boom.p_head")
    )
    error = simulated - y
    assert channel.bias == pytest.approx(np.mean(error)) and channel.bias > 1e5
    assert channel.rms_error == pytest.approx(np.sqrt(np.mean(error**2)))
    assert channel.max_error == error[np.argmax(np.abs(error))]
    assert channel.fit_percent == pytest.approx(
        100 * (1 - np.linalg.norm(error) / np.linalg.norm(y - y.mean()))
    )
    assert channel.unit == "Pa"


def test_ringing_that_is_not_clear_is_shown_and_not_judged(arm, swing):
    """Fewer than 1.5 cycles, or damped above 0.35: drift and ringing cannot be told apart."""
    known = {"natural_frequency": 20.0, "natural_frequency_std": 0.1, "damping_ratio_std": 0.01}
    assert Ring(**known, damping_ratio=0.2, cycles=2.0).clear
    assert not Ring(**known, damping_ratio=0.2, cycles=1.2).clear
    assert not Ring(**known, damping_ratio=0.4, cycles=2.0).clear
    assert not Ring(reason="nothing moves").clear
    damped = arm.with_values({"swing.joint_damping": 2000.0})
    made = recorded(damped, {"swing.servo": 2.0}, "50 lb")
    result = judged(damped, [("swing", made)])
    assert result.accepted and result.logs[0].transients
    assert not any("natural frequency" in check.what for check in result.logs[0].checks)
    notes = keys(result.logs[0].warnings)
    assert "validation.not_clear" in notes or "validation.no_steps" in notes


def test_a_turned_sign_is_a_reservation_with_the_line_that_puts_it_right(arm, boom):
    """Whatever the verdict goes by: here the pressures alone, which follow."""
    turned = replace(boom, channels=boom.channels | {"boom.q": -boom["boom.q"]})
    logs, seen = [("log", turned)], ("p_head", "p_rod")
    result = run_validation(prepare_validation(arm, logs, seen), diagnose=False)
    first = result.reservations[0]
    assert isinstance(first, Message) and first.key == "preprocessing.turned"
    assert first.startswith("log: boom.q falls") and first.fields["line"] == "sign = -1"
    sound = run_validation(prepare_validation(arm, [("log", boom)], seen), diagnose=False)
    assert sound.reservations == ()


def test_white_residuals_pass_and_unmodelled_motion_does_not(arm, boom):
    """One lag in twenty lies outside of a 95 % band, and 15 % is allowed."""
    asked = Thresholds(whiteness=True, independence=True)
    assert judged(arm, [("boom", boom)], thresholds=asked).accepted
    wrong = judged(arm.with_values({"bulk_modulus": 3.2e8}), [("boom", boom)], thresholds=asked)
    what = "boom.p_rod residual autocorrelation"
    assert any(one.what == what and not one.passed for one in wrong.logs[0].checks)
    auto = wrong.logs[0].channels[2].autocorrelation
    assert auto.lag[0] == pytest.approx(0.01) and auto.lag[-1] == pytest.approx(0.5)
    assert len(auto.lag) == len(auto.value) == len(auto.band)
    assert auto.outside_percent == pytest.approx(
        100 * np.mean(np.abs(auto.value) > np.array(auto.band)), abs=2.1
    )
    of = {c.of for c in wrong.logs[0].channels[2].cross_correlation}
    assert of == {"boom.hepc.command", "boom.rect.command"}


def test_a_log_in_which_a_chamber_empties_says_from_when_and_how_long(arm, boom):
    part = boom.between(0.0, 1.3)  # shut at speed, its valves empty a chamber later
    assert "validation.cavitates" not in keys(judged(arm, [("boom", part)]).logs[0].warnings)
    pressure = boom["boom.p_head"].copy()
    pressure[500:520] = -8e4
    given = Record(boom.t, boom.channels | {"boom.p_head": pressure}, boom.meta)
    warnings = judged(arm, [("boom", given.between(0.0, 1.3))]).logs[0].warnings
    (note,) = (note for note in warnings if getattr(note, "key", "") == "validation.cavitates")
    assert note.fields["cylinder"] == "boom" and note.fields["t"] == pytest.approx(0.45)
    # from 50 ms before it is seen until the end, as no command follows
    assert note.fields["share"] == pytest.approx(100.0 * (1.3 - 0.45) / 1.3, abs=0.2)


def test_logs_that_do_not_count_are_marked(arm, boom, swing):
    stiff = arm.with_values({"bulk_modulus": 1.5 * 2.71e8})
    alone = judged(arm, [("boom", boom)], fitted_on=["boom"])
    assert not alone.accepted and alone.reasons[0].key == "validation.all_fitted"
    assert alone.logs[0].status == "fitted" and alone.logs[0].channels, "it is shown all the same"
    assert "validation.fitted" in keys(alone.logs[0].warnings)
    both = judged(stiff, [("boom", boom), ("swing", swing)], fitted_on=["boom"])
    assert both.reasons and all(reason.startswith("swing") for reason in both.reasons)
    still = recorded(arm, {})
    result = judged(arm, [("still", still), ("boom", boom)])
    assert result.accepted and result.logs[0].status == "still"
    assert "validation.no_motion" in keys(result.logs[0].warnings)
    alone = judged(arm, [("still", still)])
    assert not alone.accepted and alone.reasons[0].key == "validation.no_check"
    result = judged(arm, [("log", boom), ("log", swing)])
    assert [log.name for log in result.logs] == ["log", "log_2"]
    assert all(log.series for log in result.logs)


def test_constant_and_noisy_channels_have_no_fit(arm, boom):
    """A stuck sensor and one that only shows noise: both are said, neither is judged."""
    stuck = Record(boom.t, boom.channels | {"boom.p_rod": np.full(boom.t.shape, 7e5)}, boom.meta)
    result = judged(arm, [("boom", stuck)])
    channel = result.logs[0].channels[-1]
    assert (
        channel.fit_percent is None
        and channel.note.key == "validation.constant"
        and result.accepted
    )
    assert f"boom: boom.p_rod: {channel.note}" in result.warnings
    assert not any(check.what == "boom.p_rod fit" for check in result.logs[0].checks)

    shut = recorded(arm, {"boom.hepc": 1.0})  # below the deadband: commanded, and nothing moves
    result = judged(arm, [("shut", shut)])
    assert [c.fit_percent for c in result.logs[0].channels] == [None] * 4
    assert not result.accepted and result.reasons[0].key == "validation.no_check"


def test_an_error_that_does_not_change_has_no_correlation(arm):
    t = np.arange(2000) * 1e-3
    y = np.sin(5.0 * t)
    log = Record(t, {"boom.x": y, "boom.rect.command": np.sign(y)})
    for error in (0.0, 0.1):
        result = compare_channel(log, Model.of(arm), "boom.x", Pair(y, y + error, False))
        assert result.autocorrelation is None and result.cross_correlation == ()
        assert (result.max_error, result.bias) == pytest.approx((error, error))
        assert result.derived is False and result.fit_percent is not None


def test_rates_are_taken_from_positions_where_they_were_not_recorded(arm, boom):
    result = judged(arm, [("boom", without(boom, "qd", "v"))])
    rate = next(c for c in result.logs[0].channels if c.channel == "boom.qd")
    assert rate.derived and rate.fit_percent > 90 and result.accepted
    assert not next(c for c in result.logs[0].channels if c.channel == "boom.p_head").derived


def test_a_stroke_sensor_stands_in_for_a_joint_encoder(arm, boom):
    """Stroke and speed are judged by the thresholds asked of position and rate."""
    result = judged(arm, [("boom", without(boom, "q", "qd"))])
    words = ("x", "v", "p_head", "p_rod")
    assert {c.channel for c in result.logs[0].channels} == {f"boom.{word}" for word in words}
    assert any(check.what == "boom.v fit" for check in result.logs[0].checks) and result.accepted
    bare = judged(
        arm, [("boom", without(boom, "q", "qd", "p_rod", "v"))], channels=("qd", "p_rod", "p_head")
    )
    missing = [note for note in bare.logs[0].warnings if note.key == "validation.channel_missing"]
    assert [note.fields["channel"] for note in missing] == ["boom.p_rod"]
    assert {c.channel for c in bare.logs[0].channels} == {"boom.v", "boom.p_head"}


def test_logs_that_cannot_be_judged_are_said(arm, boom, tmp_path):
    far = Record(boom.t, boom.channels | {"boom.q": boom["boom.q"] + 2.0}, boom.meta)
    keep = np.delete(np.arange(T.size), 700)
    gap = Record(boom.t[keep], {n: v[keep] for n, v in boom.channels.items()}, boom.meta)
    result = judged(arm, [("far", far), ("gap", gap), ("boom", boom)])
    assert [log.status for log in result.logs] == ["failed", "failed", "held_out"]
    assert "the stroke allows" in result.logs[0].failure
    assert "not evenly sampled" in result.logs[1].failure
    assert "boom.q" in result.logs[0].series and not result.logs[0].passed
    assert is_warning(result.reasons[0])  # shown without -v
    still = {n: np.zeros(T.size) for n in boom.channels if n.endswith(".command")}
    rest = judged(arm, [("rest", Record(boom.t, boom.channels | still, boom.meta))])
    assert not rest.accepted
    write_series(tmp_path / "series", [(log.name, log.series) for log in rest.logs])
    assert not any((tmp_path / "series").iterdir())  # nothing is compared
    reason = result.reasons[0]
    assert not result.accepted and reason.key == "validation.not_simulated"
    assert reason.fields["log"] == "far" and "boom.q runs from" in reason.fields["reason"]
    with pytest.raises(InputError, match="no log"):
        judged(arm, [])
    with pytest.raises(InputError, match="cannot be judged on channel 'temperature'"):
        judged(arm, [("boom", boom)], channels=("temperature",))
    with pytest.raises(InputError, match="no payload '70 lb'"):
        judged(arm, [("boom", Record(boom.t, boom.channels, {"payload": "70 lb"}))])
    odd = Record(boom.t, boom.channels | {"bucket.servo.command": np.zeros(T.size)}, boom.meta)
    result = judged(arm, [("boom", odd)])
    said = "'bucket.servo.command', a valve that rig 'thesis_arm' does not have"
    assert any(said in text for text in result.warnings)


def test_noise_on_recorded_commands_makes_no_steps_and_moves_no_cylinder(arm, boom):
    rng = np.random.default_rng(2)
    channels = {
        n: v + rng.uniform(-0.01, 0.01, v.shape) if n.endswith(".command") else v
        for n, v in boom.channels.items()
    }
    result = judged(arm, [("boom", Record(boom.t, channels, boom.meta))])
    assert result.logs[0].moved == ("boom",)
    assert [w.start for w in result.logs[0].transients] == pytest.approx([0.3, 1.4])


def test_series_are_recorded_and_simulated_columns_in_si(accepted, tmp_path):
    write_series(tmp_path / "series", [(log.name, log.series) for log in accepted.logs])
    header, *rows = (tmp_path / "series" / "boom.csv").read_text().splitlines()
    names = ["q [rad]", "qd [rad/s]", "p_head [Pa]", "p_rod [Pa]"]
    assert header.split(",") == [
        "t [s]",
        *(f"{side}boom.{name}" for name in names for side in ("", "simulated.")),
    ]
    assert len(rows) == T.size


def test_json_there_and_back(accepted, rejected, arm, boom, tmp_path, monkeypatch):
    far = Record(boom.t, boom.channels | {"boom.q": boom["boom.q"] + 2.0}, boom.meta)
    failed = judged(arm, [("far", far)], thresholds=Thresholds(max_error={"q": "2 deg"}))
    reserved = replace(accepted, reservations=("a fixed number is off",))
    assert reserved.verdict == "accepted with reservation"
    config = {"arbitrary_types_allowed": True}  # series are arrays
    monkeypatch.setattr(Validation, "__pydantic_config__", config, raising=False)
    back = TypeAdapter(Validation)
    for one in (accepted, rejected, failed, reserved):
        write_json(tmp_path / "validation.json", one.as_json())
        assert back.validate_python(read_json(tmp_path / "validation.json")) == one


def test_threads_and_order_do_not_change_the_result(arm, boom, swing, accepted):
    told = []
    logs = [("boom", boom), ("swing", swing)]
    taken = prepare_validation(arm, logs)
    again = run_validation(
        taken, progress=lambda *told_of: told.append(told_of), workers=1, diagnose=False
    )
    assert again.with_structure(accepted.structure) == accepted
    assert told[:2] == [("boom", 0.5), ("swing", 1.0)]


def test_thresholds_are_read_with_units_and_refused_by_name(tmp_path):
    path = tmp_path / "v.toml"

    def read(line: str) -> Thresholds:
        path.write_text(
            f'stage = "validate"\nrig = "r.toml"\ndata = ["a.mcap"]\n[thresholds]\n{line}\n'
        )
        return load_recipe(path).thresholds

    assert float(read('max_error = { q = "180 deg" }').max_error["q"]) == pytest.approx(math.pi)
    assert read("fit_percent = { qd = 70 }").fit_percent == {"qd": 70.0}
    for line, said in (
        ("max_error = { q = 2 }", "no unit"),
        ('max_error = { q = "2 kPa" }', "cannot be turned into rad"),
        ("fit_percent = { p_hed = 30 }", "nearest is 'p_head'"),
        ("fit_percent = { qd = 100 }", "100 % is an exact match"),
        ("natural_frequency_error = -1", "greater than 0"),
        ("fits_percent = { qd = 3 }", "did you mean 'fit_percent'"),
    ):
        with pytest.raises(InputError, match=said) as caught:
            read(line)
        assert caught.value.line == 5
