"""The verdict on the exact model and on wrong ones, whatever the command: steps, sine, chirp, slow
ramps."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ehbench.config.recipe import Thresholds
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.diagnosis import Finding, Structure
from ehbench.preprocessing.observations import noise_of
from ehbench.signals import series
from ehbench.validation.checks import _ringing_check, beyond_noise, checks_of, unrequested
from ehbench.validation.judge import _reasons, _unexplained, prepare_validation, run_validation
from ehbench.validation.residuals import pair_of
from ehbench.validation.results import (
    ChannelResult,
    Check,
    Correlation,
    LogResult,
    Ring,
    Sweep,
    Transient,
    Validation,
)
from ehbench.validation.sweeps import _beyond
from ehbench.validation.transients import unjudged, why_not_judged
from tests.shared import shipped
from tools.virtual_logs import DRIVES, commands_of, virtual_log

CHANNELS = {"slide_servo": ("x", "v", "p_head", "p_rod"), "pump_cylinder": ("x", "v", "p_head")}
# far narrower than the defaults: what a wrong model must not reach
STRICT = Thresholds(
    fit_percent={"qd": 80.0, "p_head": 80.0, "p_rod": 80.0},
    natural_frequency_error=0.05,
    damping_ratio_error=0.3,
    response_gain_error=0.1,
    response_phase_error="8 deg",
)


def judged(name, rig, log, thresholds=None, diagnose=False):
    """The verdict on a log: by its checks, and by what the residuals say where they are asked."""
    channels = CHANNELS.get(name, ("q", "qd", "p_head", "p_rod"))
    prepared = prepare_validation(rig, [("log", log)], channels)
    return run_validation(prepared, thresholds, diagnose=diagnose)


def held(name: str, kind: str, every: float) -> dict[str, np.ndarray]:
    """A command that a slow controller gives: a new value each ``every`` seconds."""
    t = np.arange(4001) * 1e-3
    at = (np.arange(t.size) // round(every * 1e3)) * round(every * 1e3)
    return {valve: u[at] for valve, u in commands_of(name, kind, t).items()}


COMMANDED = {
    "steps": tuple(DRIVES),
    "sine": ("crane_proportional", "thesis_arm"),
    "chirp": ("slide_servo", "boom_four_valve"),
    "ramps": ("slide_servo", "pump_cylinder"),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "name"), [(k, n) for k, names in COMMANDED.items() for n in names]
)
def test_the_exact_model_is_accepted_whatever_the_command(kind, name):
    rig = shipped(name)
    verdict = judged(name, rig, virtual_log(name, rig, kind, 1, 2.6), STRICT, diagnose=True)
    assert verdict.accepted, verdict.reasons
    assert not verdict.structure.findings


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "every", "names"),
    [
        ("sine", 0.084, ("slide_servo", "crane_proportional")),
        ("chirp", 0.02, ("slide_servo", "thesis_arm")),
        ("sine", 0.15, ("crane_proportional", "thesis_arm")),
    ],
)
def test_a_command_in_small_stairs_makes_no_ringing(kind, every, names):
    """Each stair is a step that stands for less than a few periods."""
    for name in names:
        rig = shipped(name)
        log = virtual_log(name, rig, kind, 1, commands=held(name, kind, every))
        verdict = judged(name, rig, log, STRICT)
        assert verdict.accepted, verdict.reasons
        for window in verdict.logs[0].transients:
            if window.judged and window.start < 3.6:  # then the command stands at rest
                hertz = window.recorded.natural_frequency / (2.0 * math.pi)
                assert every * hertz > 2.4, "a stair is too short for that"


@pytest.mark.slow
@pytest.mark.parametrize("name", DRIVES)
def test_wrong_models_are_rejected(name):
    """Oil 20 % off, twice the damping, a gain a fourth off: the checks of the steps tell each."""
    rig = shipped(name)
    known = rig.parameters()
    damping = [n for n in known if n.endswith((".damping", ".joint_damping"))]
    gains = [n for n in known if n.endswith(("flow_gain", "compensated_gain", "displacement"))]
    log = virtual_log(name, rig, "steps", 1, 1.6)  # a step out and a step back
    for names, factor in (
        (["bulk_modulus"], 1.2),
        (["bulk_modulus"], 0.8),
        (damping, 2.0),
        (gains, 0.75),
    ):
        wrong = rig.with_values({n: factor * float(known[n]) for n in names})
        assert not judged(name, wrong, log, STRICT).accepted, (names, factor)


def test_a_sweep_is_judged_by_its_response():
    rig = shipped("crane_proportional")
    log = virtual_log("crane_proportional", rig, "chirp", 3)
    sound = judged("crane_proportional", rig, log)
    sweeps = {one.channel: one for one in sound.logs[0].sweeps}
    assert set(sweeps) == {"lift.qd", "lift.p_head", "lift.p_rod"}
    for one in sweeps.values():
        assert one.gain_ratio == pytest.approx(1.0, abs=0.02) and one.gain_error < 0.05
        assert one.phase_error < math.radians(4.0) and one.delay_error < 2e-3
        assert one.band[1] > 8.0 and one.coherence[0] > 0.8
    assert sum("response" in check.what for check in sound.logs[0].checks) == 9
    known = rig.parameters()
    late = rig.with_values(
        {"spool.natural_frequency": 0.5 * float(known["spool.natural_frequency"])}
    )
    verdict = judged("crane_proportional", late, log)
    assert any("phase of the response is off by" in reason for reason in verdict.reasons)
    assert verdict.logs[0].sweeps[0].delay[1] > verdict.logs[0].sweeps[0].delay[0] + 3e-3
    off = Thresholds(
        response_gain_error=False, response_phase_error=False, response_delay_error=False
    )
    checks = judged("crane_proportional", late, log, off).logs[0].checks
    assert not any("response" in check.what for check in checks)
    steps = virtual_log("crane_proportional", rig, "steps", 3)
    assert not judged("crane_proportional", rig, steps).logs[0].sweeps


def ringing_slide(seed: int, until: float = 3.9) -> tuple[Rig, Record]:
    """A slide that rings for long at small steps, and its log at 200 samples a second."""
    gains = {"supply_head": 3.2e-8, "rod_tank": 5.5e-8, "supply_rod": 8.3e-8, "head_tank": 6.7e-8}
    values = {f"press.servo_{edge}.flow_gain": gain for edge, gain in gains.items()}
    values |= {"bulk_modulus": 6.36e8, "carriage.damping": 456.0, "spool.natural_frequency": 143.0}
    rig = shipped("slide_servo").with_values(values)
    log = virtual_log("slide_servo", rig, "steps", seed, until, 0.15)
    kept = {channel: y[::5] for channel, y in log.channels.items()}
    return rig, replace(log, t=log.t[::5], channels=kept)


def test_one_window_in_which_a_sound_model_rings_beside_a_bend_does_not_reject():
    """Oil 7 % and gains some percent off, which bends the pressures after the first step: there the
    oscillation explains four fifths of them, and rings as in all other windows."""
    rig, log = ringing_slide(1)
    gains = {"supply_head": 3.34e-8, "rod_tank": 5.36e-8, "head_tank": 6.33e-8}
    values = {f"press.servo_{edge}.flow_gain": gain for edge, gain in gains.items()}
    close = rig.with_values(values | {"bulk_modulus": 6.84e8})
    verdict = judged("slide_servo", close, log, STRICT)
    windows = [w for w in verdict.logs[0].transients if w.judged]
    assert len(windows) > 2 and all(w.simulated.natural_frequency for w in windows)
    checks = [c for c in verdict.logs[0].checks if c.what.endswith(("frequency", "damping ratio"))]
    assert len(checks) == 2 and checks[0].passed, [check.sentence for check in checks]


@pytest.mark.parametrize(
    "wrong", [{"carriage.damping": 9e4}, {"press.friction_coulomb": 1e4}, {"bulk_modulus": 3e10}]
)
def test_one_window_in_which_a_model_does_not_ring_rejects(wrong):
    """Damping, friction or oil far off, and one step in the log."""
    rig, log = ringing_slide(1, 0.85)
    assert judged("slide_servo", rig, log, STRICT).accepted
    verdict = judged("slide_servo", rig.with_values(wrong), log, Thresholds(fit_percent={}))
    assert len([w for w in verdict.logs[0].transients if w.judged]) == 1
    assert "the recording rings from 0.30 s on, the model does not" in verdict.reasons[0]


def test_noise_is_told_from_motion():
    """By third differences; of a rate that a position gives, by what the filter makes of it."""
    t = np.arange(4000) * 1e-3
    rng = np.random.default_rng(3)
    x = 0.1 * np.sin(2.0 * math.pi * t) + 1e-4 * rng.standard_normal(t.size)
    smooth = Record(t, {"press.x": 0.1 * np.sin(2.0 * math.pi * t)})
    log = Record(t, {"press.x": x})
    assert noise_of(log, "press.x") == pytest.approx(1e-4, rel=0.1)
    rate = pair_of(log, smooth, "press.v")
    assert rate.derived
    inner = slice(200, -200)  # at the ends the filter sees less
    assert noise_of(log, "press.v") == pytest.approx(
        np.std((rate.recorded - rate.simulated)[inner]), rel=0.15
    )
    assert beyond_noise(50.0, 0.0) == pytest.approx(50.0)
    assert beyond_noise(100.0, 0.3) == pytest.approx(70.0), "an exact model has the noise alone"


def test_a_position_that_strays_is_told_though_nobody_asks():
    rig = shipped("slide_servo")
    log = virtual_log("slide_servo", rig, "steps", 1)
    gains = {n: v for n, v in rig.parameters().items() if n.endswith("supply_head.flow_gain")}
    fast = rig.with_values({name: 1.5 * float(value) for name, value in gains.items()})
    verdict = judged("slide_servo", fast, log)
    notes = {note.key: note for note in verdict.logs[0].warnings}
    assert notes["validation.poor_fit"].fields["channel"] == "press stroke"
    quiet = judged("slide_servo", rig, log).logs[0].warnings
    assert "validation.poor_fit" not in {note.key for note in quiet}


def test_a_channel_that_nobody_asked_for_is_not_missed():
    """A position by default; a pressure that a threshold asks for is."""
    rig = shipped("slide_servo")
    log = virtual_log("slide_servo", rig, "steps", 1)
    kept = {c: y for c, y in log.channels.items() if c.endswith((".v", "p_head", "command"))}
    bare = [("log", replace(log, channels=kept))]

    def missing(*channels):
        prepared = prepare_validation(rig, bare, *channels)
        notes = run_validation(prepared, diagnose=False).logs[0].warnings
        key = "validation.channel_missing"
        return [note.fields["channel"] for note in notes if getattr(note, "key", "") == key]

    assert missing() == ["press.p_rod"] and missing(("q", "p_head")) == ["press.q"]


def test_differences_within_their_errors_are_none_in_19_of_20_cases():
    rng, errors = np.random.default_rng(5), np.full(60, 0.2)
    none = sum(_beyond(0.2 * rng.standard_normal(60), errors) == 0.0 for _ in range(2000))
    assert 0.92 < none / 2000 < 0.97
    scatter = math.sqrt(2.0 * 60.0 * 0.2**4) / 60.0
    expected = math.sqrt(0.25 - 0.04 - 1.645 * scatter)
    assert _beyond(np.full(60, 0.5), errors) == pytest.approx(expected, rel=1e-6)


def window(cylinder="a", start=1.0, simulated=10.0, std=0.1, note="", reason=""):
    """A ringing of 10 rad/s as it was recorded, and another one."""
    recorded = Ring(10.0, 0.1, 0.1, 0.01, 5.0, True) if not reason else Ring(reason=reason)
    return Transient(cylinder, start, 2.0, recorded, Ring(simulated, std, 0.1, 0.01), note=note)


@pytest.mark.parametrize(
    ("others", "reached", "passed"),
    [
        ([(10.9, 0.1)], 0.09, True),
        ([(11.2, 0.1)], 0.12, True),  # 0.092 less two standard errors of 0.014
        ([(11.4, 0.1)], 0.14, False),
        ([(8.6, 0.1)], 0.14, False),
        ([(14.0, 3.0), (11.4, 0.1)], 0.14, False),  # the other may be chance
        ([(10.2, 0.1), (11.2, 0.1)], 0.12, True),
    ],
)
def test_the_worst_window_is_the_one_most_surely_off(others, reached, passed):
    windows = [window(simulated=omega, std=std) for omega, std in others]
    check = _ringing_check("a", "natural_frequency", windows, 0.1)
    assert (check.reached, check.passed) == (pytest.approx(reached), passed)


def test_cylinders_whose_ringing_is_not_judged_are_named_with_the_commonest_reason():
    windows = [window("a"), window("b", note="n"), *[window("b", reason="r")] * 2]
    notes = {note.fields["cylinder"]: note for note in unjudged(["a", "b", "c"], windows)}
    assert {name: note.key for name, note in notes.items()} == {
        "b": "validation.not_clear",
        "c": "validation.no_steps",
    }
    assert (notes["b"].fields["reason"], notes["b"].fields["count"]) == ("r", 3)


@pytest.mark.parametrize(
    ("findings", "leans", "verdict", "texts"),
    [
        ([], [], "accepted", (0, 0)),
        ([(0.49, 9.0)], [], "accepted", (0, 0)),  # not most of the residual
        ([(0.51, 0.9)], [], "accepted with reservation", (0, 1)),
        ([(0.89, 0.9)], [], "accepted with reservation", (0, 1)),  # and something else is left
        ([(0.91, 0.9)], [], "accepted", (0, 0)),  # the interval of what was identified holds all
        ([(0.91, 0.0)], [], "accepted with reservation", (0, 1)),  # of a number that is fixed
        ([(0.91, 1.1)], [], "rejected", (1, 0)),
        ([(0.51, 1.1)], [], "rejected", (1, 0)),  # beyond the interval of what was identified
        ([(0.3, 9.0), (0.51, 0.9)], [], "accepted with reservation", (0, 1)),
        ([(0.6, 0.9), (0.51, 1.1)], [], "accepted with reservation", (0, 1)),  # the likeliest
        ([(0.4, 0.9, 0.49), (0.09, 9.0, 0.49)], [], "accepted", (0, 0)),
        ([(0.4, 0.9, 0.51), (0.38, 0.9), (0.11, 1.1, 0.51)], [], "rejected", (1, 1)),  # together
        ([(0.6, 0.9, 0.8), (0.2, 1.1, 0.8)], [], "accepted with reservation", (0, 1)),
        ([], [0.49], "accepted with reservation", (0, 1)),
        ([], [0.3, 0.51], "rejected", (1, 1)),
        ([(0.51, 0.9)], [0.49], "accepted with reservation", (0, 2)),
    ],
)
def test_causes_and_fixed_numbers_weigh_on_the_verdict(findings, leans, verdict, texts):
    """A cause by its share of the residual and by intervals, a fixed number by its share."""
    plain = Validation("a", True, (), (), {}, ())
    causes = tuple(Finding("gain", "a", "s", "r", share, 0.1, *far) for share, *far in findings)
    rows = [{"explains": share, "sentence": "s"} for share in leans]
    result = plain.with_fit(rows).with_structure(Structure(causes))
    assert result.verdict == verdict and result.structure.findings == causes
    assert (len(result.reasons), len(result.reservations)) == texts
    failed = replace(plain, accepted=False, reasons=("a fit",))
    assert failed.with_fit(rows).with_structure(Structure(causes)).verdict == "rejected"


def result_of(channel, fit=90.0, error=0.0, bias=0.0, rms=1.0, **more):
    """How a channel is followed."""
    return ChannelResult(channel, "m", fit, error, bias, rms, **more)


def outside(*percent):
    """Correlations that leave their bands at some shares [%] of their lags."""
    return tuple(Correlation("u", (0.0,), (1.0,), (0.1,), share) for share in percent)


@pytest.mark.parametrize("off", [-1.0, 0.0, 1.0])
def test_each_threshold_is_held_against_what_was_reached(off):
    """One demand at a time, missed and kept by a little; words as people read them."""
    nothing: dict[str, Any] = {"fit_percent": {}, "natural_frequency_error": False}
    nothing |= {f"response_{word}_error": False for word in ("gain", "phase", "delay")}
    sweep = Sweep("u", "press.p_head", (1.0, 9.0), 20, 8.0, (1.0, 1.0), (0.0, 0.0), None)
    answered = replace(sweep, gain_error=0.2, phase_error=math.radians(20.0), delay_error=2e-3)
    channel = result_of(
        "press.x",
        80.0,
        -3e-3,
        autocorrelation=outside(20.0)[0],
        cross_correlation=outside(20.0, 5.0),
    )
    for asked, key, fields in (
        ({"fit_percent": {"x": 80.0 + off}}, "fit", {"reached": 80.0, "required": 80.0 + off}),
        (
            {"max_error": {"x": f"{3.0 - 0.1 * off} mm"}},
            "error",
            {"reached": "3 mm", "allowed": f"{3.0 - 0.1 * off:.3g} mm"},
        ),
        (
            {"whiteness": True, "outside_percent": 20.0 - off},
            "residual",
            {"kind": "autocorrelation", "reached": 20.0},
        ),
        (
            {"independence": True, "outside_percent": 20.0 - off},
            "residual",
            {"kind": "correlation with commands", "reached": 20.0, "allowed": 20.0 - off},
        ),
        (
            {"response_gain_error": 0.2 - 0.01 * off},
            "response",
            {"reached": "20 %", "allowed": f"{20.0 - off:.3g} %", "low": 1.0, "high": 9.0},
        ),
        (
            {"response_phase_error": f"{20.0 - off} deg"},
            "response",
            {"what": "phase", "reached": "20°", "allowed": f"{20.0 - off:.3g}°"},
        ),
        (
            {"response_delay_error": f"{2.0 - 0.1 * off} ms"},
            "response",
            {"reached": "2 ms", "channel": "press head pressure"},
        ),
    ):
        requested = Thresholds(**nothing | asked)
        (check,) = checks_of([channel], [], [answered], requested, shipped("slide_servo"))
        assert check.passed == (off <= 0.0), asked
        assert check.sentence.key == f"validation.{key}"
        assert {name: check.sentence.fields[name] for name in fields} == fields
        if key == "response":
            (check,) = checks_of([channel], [], [sweep], requested, shipped("slide_servo"))
            assert (check.passed, check.reached) == (False, None)


@pytest.mark.parametrize(
    ("channel", "word"),
    [("press.x", {"fit": 79.0, "error": "3 mm"}), ("press.v", None), ("press.q", None)],
)
def test_a_position_that_is_followed_badly_is_told_where_nobody_asks(channel, word):
    rig, log = shipped("slide_servo"), Record(np.zeros(1), {"press.x_desired": np.zeros(1)})
    bad = result_of(channel, 79.0, -3e-3)
    asked = Thresholds(max_error={"q": "1 deg"} if channel == "press.q" else {}, fit_percent={})
    notes = list(unrequested([bad], asked, rig, log))
    if word is None:
        assert not notes
        return
    poor, controlled = notes
    assert {name: poor.fields[name] for name in word} == word
    assert controlled.fields["channel"] == "press.x_desired"
    assert not list(unrequested([replace(bad, fit_percent=81.0)], asked, rig, log))
    assert not list(unrequested([bad], Thresholds(fit_percent={"x": 1.0}), rig, log))


@pytest.mark.parametrize(
    ("channel", "unit", "off"), [("p_head", 1e5, "0.8 bar"), ("v", 0.1, "80 mm/s")]
)
@pytest.mark.parametrize(("sign", "way"), [(1.0, "high"), (-1.0, "low")])
def test_a_level_is_taken_from_the_error_before_the_shape_is_judged(channel, unit, off, sign, way):
    """Of an rms error of 1 with a bias of 0.8, 0.6 are left; the spread is 2, or 20."""
    result = result_of(f"press.{channel}", 50.0, bias=0.8 * sign * unit, rms=unit)
    rig, asked, log = shipped("slide_servo"), Thresholds(fit_percent={}), Record(np.zeros(1), {})
    (note,) = unrequested([result], asked, rig, log)
    assert note.fields["shape"] == pytest.approx(70.0) and note.fields["fit"] == 50.0
    assert note.fields["off"] == f"{off} too {way}"
    assert not list(unrequested([replace(result, fit_percent=95.0)], asked, rig, log))


def log_of_results(name, status, *channels, **more):
    return LogResult(name, "none", status, 1.0, 1e-3, channels=channels, **more)


@pytest.mark.parametrize(
    ("channels", "named"),
    [
        ([("a", 69.0, 0.1)], ("a", 0.31)),
        ([("a", 71.0, 0.0)], None),  # below three tenths
        ([("a", 60.0, 0.134)], None),  # 0.4 is less than three times its noise
        ([("a", 60.0, 0.13)], ("a", 0.4)),
        ([("a", 60.0, 0.0), ("b", 50.0, 0.17), ("c", 55.0, 0.1)], ("c", 0.45)),
        ([("a", None, 0.0)], None),
    ],
)
def test_the_worst_channel_beyond_its_noise_is_a_reservation(channels, named):
    """Of logs that count: of others nothing is said."""
    items = [result_of(f"{name}.v", fit, noise_share=noise) for name, fit, noise in channels]
    notes = list(_unexplained([log_of_results("log", "held_out", *items)]))
    told = [(note.fields["channel"], note.fields["share"]) for note in notes]
    assert told == ([(f"{named[0]}.v", pytest.approx(named[1]))] if named else [])
    assert not list(_unexplained([log_of_results("log", "fitted", *items)]))


def test_what_failed_or_asked_nothing_rejects():
    kept, missed = (Check("a", 1.0, 1.0, "", ok, "s") for ok in (True, False))
    sound = log_of_results("a", "held_out", checks=(kept,))
    assert sound.passed and not list(_reasons([sound, log_of_results("b", "still")]))
    failed = replace(sound, checks=(kept, missed))
    assert not failed.passed and list(_reasons([failed, sound])) == ["a: s"]
    broken = replace(sound, name="c", failure="f")
    (reason,) = _reasons([sound, broken])
    assert reason.fields == {"log": "c", "reason": "f"} and not broken.passed
    fitted = replace(failed, name="d", status="fitted")
    (reason,) = _reasons([fitted, replace(fitted, name="e")])
    assert reason.key == "validation.all_fitted" and reason.fields["logs"] == "d, e"
    (reason,) = _reasons([log_of_results("b", "held_out")])
    assert reason.key == "validation.no_check" and not log_of_results("b", "held_out").passed


@pytest.mark.parametrize(
    ("omega", "zeta", "until", "key"),
    [
        (30.0, 0.05, 3.0, ""),
        (30.0, -0.02, 3.0, "grows"),
        (30.0, 0.05, 0.5, "short_stand"),  # 2.39 periods
        (30.0, 0.05, 0.6, ""),
    ],
)
def test_a_ringing_is_judged_by_its_decay_and_the_time_that_it_has(omega, zeta, until, key):
    t = np.arange(0.0, until, 1e-3)
    bent = omega * math.sqrt(1.0 - zeta**2)
    y = np.exp(-zeta * omega * t)[:, None] * np.stack([np.cos(bent * t), np.sin(bent * t)], axis=1)
    y = y + 1e-3 * np.random.default_rng(1).standard_normal(y.shape)
    plain = {"natural_frequency_std": 0.05, "damping_ratio_std": 0.002, "stop": t[-1]}
    result = replace(series.ringing(t, y, (omega, abs(zeta)), trim=False), **plain)
    result = replace(result, natural_frequency=omega, damping_ratio=zeta)
    assert getattr(why_not_judged(t, y, result), "key", "").removeprefix("validation.") == key
    if not key and until > 1.0:  # halves that ring otherwise
        off = replace(result, natural_frequency=1.25 * omega)
        assert why_not_judged(t, y, off).key == "validation.halves_differ"
