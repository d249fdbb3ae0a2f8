"""Requirements on a model on a log: thresholds compared with what was reached."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from ehbench.config.recipe import Thresholds
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.preprocessing.observations import stood_for
from ehbench.validation.results import ChannelResult, Check, Correlation, Ring, Sweep, Transient
from ehbench.vocabulary.messages import Message, message
from ehbench.vocabulary.quantities import quantity
from ehbench.vocabulary.settings import setting
from ehbench.vocabulary.units import from_si


@dataclass(frozen=True)
class CheckSettings:
    """Numbers of the notes on what no threshold asks for, and of noisy recordings."""

    poor: float = setting(80.0, "%", "fit of a position below which a note says so", "plain to see")
    level: float = setting(
        0.25, "", "least bias of a channel off by its level, share of its spread", "plain to see"
    )
    mostly: float = setting(0.5, "", "least share of the bias in the error's square", "most of it")
    shape: float = setting(50.0, "%", "least fit of such a channel without its bias", "it follows")
    noisy: float = setting(
        5.0, "%", "fit above the required one below which noise is allowed for", "else no matter"
    )


SETTINGS = CheckSettings()


def checks_of(
    results: Sequence[ChannelResult],
    windows: Sequence[Transient],
    sweeps: Sequence[Sweep],
    requested: Thresholds,
    rig: Rig,
) -> list[Check]:
    """Every check that a log supports: channel by channel, then cylinder by cylinder, then the
    responses to commands that sweep.
    """
    checks = []
    for result in results:
        checks += [
            *_fit_check(result, requested),
            *_error_check(result, requested, rig),
            *_residual_checks(result, requested),
        ]
    judged = (w for w in windows if w.judged)
    for cylinder, mine in groupby(judged, key=lambda w: w.cylinder):
        group = list(mine)
        for key, limit in (
            ("natural_frequency", requested.natural_frequency_error),
            ("damping_ratio", requested.damping_ratio_error),
        ):
            if limit is not None:
                checks.append(_ringing_check(cylinder, key, group, limit))
    return checks + [check for sweep in sweeps for check in _sweep_checks(sweep, requested)]


def _sweep_checks(sweep: Sweep, requested: Thresholds) -> Iterator[Check]:
    """Gain, phase and delay of a channel's response to its command."""
    low, high = sweep.band
    for what, reached, limit, unit, (shown, factor) in (
        ("gain", sweep.gain_error, requested.response_gain_error, "share", (" %", 100.0)),
        ("phase", sweep.phase_error, requested.response_phase_error, "rad", ("°", 180.0 / math.pi)),
        ("delay", sweep.delay_error, requested.response_delay_error, "s", (" ms", 1000.0)),
    ):
        if limit is None:
            continue
        maximum, fields = float(limit), {"what": what, "low": low, "high": high}
        fields["channel"] = _channel_name(sweep.channel)
        if reached is None:
            sentence = message("validation.no_response", **fields)
        else:
            reached_, allowed = (f"{factor * value:.3g}{shown}" for value in (reached, maximum))
            sentence = message("validation.response", reached=reached_, allowed=allowed, **fields)
        passed = reached is not None and reached <= maximum
        yield Check(f"{sweep.channel} response {what}", reached, maximum, unit, passed, sentence)


def _fit_check(result: ChannelResult, requested: Thresholds) -> Iterator[Check]:
    word = result.channel.rsplit(".", 1)[1]
    limits = (requested.fit_percent.get(item) for item in stood_for(word))
    required = next((limit for limit in limits if limit is not None), None)
    reached = result.fit_percent
    if required is None or reached is None:
        return
    fields = {"channel": _channel_name(result.channel), "reached": reached, "required": required}
    sentence, minimum = message("validation.fit", **fields), required
    if 100.0 * (1.0 - result.noise_share) < required + SETTINGS.noisy:
        minimum = beyond_noise(required, result.noise_share)
        sentence = message("validation.fit_of_noisy", least=minimum, **fields)
    yield Check(f"{result.channel} fit", reached, minimum, "percent", reached >= minimum, sentence)


def beyond_noise(fit: float, noise_share: float) -> float:
    """The fit [%] of a recording by a model that fits its motion to ``fit`` [%], where white noise
    makes up ``noise_share`` of the standard deviation: the squares of both misses add up.
    """
    miss, noise = 1.0 - fit / 100.0, noise_share**2
    return 100.0 * (1.0 - math.sqrt(miss**2 * (1.0 - noise) + noise))


def _error_check(result: ChannelResult, requested: Thresholds, rig: Rig) -> Iterator[Check]:
    word = result.channel.rsplit(".", 1)[1]
    if word in requested.max_error:
        row, unit = quantity(word), rig.unit_of(word)
        reached, maximum = abs(result.max_error), float(requested.max_error[word])
        shown = [f"{from_si(value, unit, row):.3g}" for value in (reached, maximum)]
        sentence = message(
            "validation.error",
            channel=_channel_name(result.channel),
            reached=f"{shown[0]} {unit}",
            allowed=f"{shown[1]} {unit}",
        )
        what = f"{result.channel} max error"
        yield Check(what, reached, maximum, result.unit, reached <= maximum, sentence)


def _residual_kinds(
    requested: Thresholds,
) -> list[tuple[bool, str, Callable[[ChannelResult], tuple[Correlation, ...]]]]:
    """(whether it is required, the recipe's key, the correlations of a channel)."""

    def auto(result: ChannelResult) -> tuple[Correlation, ...]:
        return (result.autocorrelation,) if result.autocorrelation else ()

    return [
        (requested.whiteness, "whiteness", auto),
        (requested.independence, "independence", lambda result: result.cross_correlation),
    ]


_KINDS = {"whiteness": "autocorrelation", "independence": "correlation with commands"}


def _residual_checks(result: ChannelResult, requested: Thresholds) -> Iterator[Check]:
    for required, key, of in _residual_kinds(requested):
        if required and (correlations := of(result)):
            reached, kind = max(item.outside_percent for item in correlations), _KINDS[key]
            sentence = message(
                "validation.residual",
                channel=_channel_name(result.channel),
                kind=kind,
                reached=reached,
                allowed=requested.outside_percent,
            )
            what, passed = f"{result.channel} residual {kind}", reached <= requested.outside_percent
            yield Check(what, reached, requested.outside_percent, "percent", passed, sentence)


def unrequested(
    results: Sequence[ChannelResult], requested: Thresholds, rig: Rig, record: Record
) -> Iterator[Message]:
    """What is poor although no threshold asks for it: a position that is followed badly, a level
    that is off.
    """
    for result in results:
        yield from _level_note(result, rig)
        word, reached = result.channel.rsplit(".", 1)[1], result.fit_percent
        silent = not {*stood_for(word)} & {*requested.fit_percent, *requested.max_error}
        if word in ("q", "x") and silent and reached is not None and reached < SETTINGS.poor:
            row, unit = quantity(word), rig.unit_of(word)
            error = f"{from_si(abs(result.max_error), unit, row):.3g} {unit}"
            fields = {"channel": _channel_name(result.channel), "fit": reached, "error": error}
            yield message("validation.poor_fit", word=word, **fields)
            wish = f"{result.channel.rsplit('.', 1)[0]}.x_desired"
            if wish in record:
                yield message("validation.was_controlled", channel=wish)


def _level_note(result: ChannelResult, rig: Rig) -> Iterator[Message]:
    """That a channel is followed but for its level. Positions have none: they begin where the
    recording does.
    """
    word, fit = result.channel.rsplit(".", 1)[1], result.fit_percent
    bias, rms = result.bias, result.rms_error
    if fit is None or word in ("q", "x") or bias**2 < SETTINGS.mostly * rms**2 or fit >= 100.0:
        return
    spread = rms / (1.0 - fit / 100.0)
    shape = 100.0 * (1.0 - math.sqrt(max(rms**2 - bias**2, 0.0)) / spread)
    if abs(bias) > SETTINGS.level * spread and shape >= SETTINGS.shape:
        way = "high" if bias > 0.0 else "low"
        off = f"{rig.shown(result.channel, abs(bias), 3)} too {way}"
        channel = _channel_name(result.channel)
        yield message("validation.level", channel=channel, shape=shape, off=off, fit=fit)


def _ringing_check(cylinder: str, key: str, windows: Sequence[Transient], limit: float) -> Check:
    """The worst window: fails where the difference exceeds what is allowed by more than two of its
    standard errors.
    """
    what = f"{cylinder} {key.replace('_', ' ')}"
    silent = [w for w in windows if w.simulated.natural_frequency is None]
    if silent:
        when, why = silent[0].start, silent[0].simulated.reason
        sentence = message("validation.no_ringing", what=what, time=when, reason=why)
        return Check(what, None, limit, "share", False, sentence)

    def number(side: Ring) -> tuple[float, float]:
        return getattr(side, key), getattr(side, f"{key}_std")

    def miss(window: Transient) -> tuple[float, float]:
        """(difference, its standard error) as shares of the recorded value."""
        (recorded, item), (simulated, other) = number(window.recorded), number(window.simulated)
        scale = max(abs(recorded), 1e-9)
        return abs(simulated - recorded) / scale, math.hypot(item, other) / scale

    worst = max(windows, key=lambda w: miss(w)[0] - 2.0 * miss(w)[1])
    reached, spread = miss(worst)
    passed = reached - 2.0 * spread <= limit
    scale, unit = (0.5 / math.pi, " Hz") if key == "natural_frequency" else (1.0, "")
    shown = [
        f"{scale * value:.3g} ± {scale * std:.2g}{unit}"
        for value, std in map(number, (worst.simulated, worst.recorded))
    ]
    fields = {"simulated": shown[0], "recorded": shown[1], "apart": reached, "allowed": limit}
    sentence = message("validation.ringing", what=what, time=worst.start, **fields)
    return Check(what, reached, limit, "share", passed, sentence)


def _channel_name(channel: str) -> str:
    cylinder, word = channel.rsplit(".", 1)
    plain = {
        "q": "position",
        "qd": "rate",
        "x": "stroke",
        "v": "speed",
        "p_head": "head pressure",
        "p_rod": "rod pressure",
        "load_pressure": "load pressure",
        "load_force": "cylinder force",
        "rod_force": "rod force",
        "opening": "opening",
    }
    return f"{cylinder} {plain[word]}"
