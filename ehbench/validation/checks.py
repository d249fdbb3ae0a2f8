"""Requirements on a model on a log: thresholds compared with what was reached."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from ehbench.config.recipe import Thresholds
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.preprocessing.observations import stood_for
from ehbench.validation.results import ChannelResult, Check, Ring, Sweep, Transient
from ehbench.vocabulary import Message, message, setting


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
    responses to commands that sweep."""
    checks = [check for result in results for check in _channel_checks(result, requested, rig)]
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


def _channel_checks(result: ChannelResult, requested: Thresholds, rig: Rig) -> Iterator[Check]:
    """Fit, largest error and whiteness of the residual of a channel."""
    word, channel = result.channel.rsplit(".", 1)[1], _channel_name(result.channel)
    limits = (requested.fit_percent.get(item) for item in stood_for(word))
    required = next((limit for limit in limits if limit is not None), None)
    fit = result.fit_percent
    if required is not None and fit is not None:
        fields = {"channel": channel, "reached": fit, "required": required}
        sentence, minimum = message("validation.fit", **fields), required
        if 100.0 * (1.0 - result.noise_share) < required + SETTINGS.noisy:
            minimum = beyond_noise(required, result.noise_share)
            sentence = message("validation.fit_of_noisy", least=minimum, **fields)
        yield Check(f"{result.channel} fit", fit, minimum, "percent", fit >= minimum, sentence)
    if word in requested.max_error:
        reached, maximum = abs(result.max_error), float(requested.max_error[word])
        shown = [rig.shown(word, value, 3) for value in (reached, maximum)]
        fields = {"channel": channel, "reached": shown[0], "allowed": shown[1]}
        sentence, passed = message("validation.error", **fields), reached <= maximum
        yield Check(f"{result.channel} max error", reached, maximum, result.unit, passed, sentence)
    auto = (result.autocorrelation,) if result.autocorrelation else ()
    limit = requested.outside_percent
    for wished, kind, correlations in (
        (requested.whiteness, "autocorrelation", auto),
        (requested.independence, "correlation with commands", result.cross_correlation),
    ):
        if wished and correlations:
            reached = max(item.outside_percent for item in correlations)
            fields = {"channel": channel, "kind": kind, "reached": reached, "allowed": limit}
            sentence, what = message("validation.residual", **fields), "residual " + kind
            passed = reached <= limit
            yield Check(f"{result.channel} {what}", reached, limit, "percent", passed, sentence)


def beyond_noise(fit: float, noise_share: float) -> float:
    """The fit [%] of a recording by a model that fits its motion to ``fit`` [%], where white noise
    makes up ``noise_share`` of the standard deviation: the squares of both misses add up."""
    miss, noise = 1.0 - fit / 100.0, noise_share**2
    return 100.0 * (1.0 - math.sqrt(miss**2 * (1.0 - noise) + noise))


def unrequested(
    results: Sequence[ChannelResult], requested: Thresholds, rig: Rig, record: Record
) -> Iterator[Message]:
    """What is poor although no threshold asks for it: a position that is followed badly, a level
    that is off."""
    for result in results:
        name, fit = _channel_name(result.channel), result.fit_percent
        cylinder, word = result.channel.rsplit(".", 1)
        if fit is None:
            continue
        if word in ("q", "x"):  # has no level: it begins where the recording does
            silent = not {*stood_for(word)} & {*requested.fit_percent, *requested.max_error}
            if silent and fit < SETTINGS.poor:
                error = rig.shown(word, abs(result.max_error), 3)
                yield message("validation.poor_fit", word=word, channel=name, fit=fit, error=error)
                if (wish := f"{cylinder}.x_desired") in record:
                    yield message("validation.was_controlled", channel=wish)
            continue
        bias, rms = result.bias, result.rms_error
        if bias**2 >= SETTINGS.mostly * rms**2 and fit < 100.0:
            spread = rms / (1.0 - fit / 100.0)
            shape = 100.0 * (1.0 - math.sqrt(max(rms**2 - bias**2, 0.0)) / spread)
            if abs(bias) > SETTINGS.level * spread and shape >= SETTINGS.shape:
                way = "high" if bias > 0.0 else "low"
                off = f"{rig.shown(result.channel, abs(bias), 3)} too {way}"
                yield message("validation.level", channel=name, shape=shape, off=off, fit=fit)


def _ringing_check(cylinder: str, key: str, windows: Sequence[Transient], limit: float) -> Check:
    """The worst window: fails where the difference exceeds what is allowed by more than two of its
    standard errors."""
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
