"""What is asked of a model on a log: thresholds held against what was reached, each with a
sentence."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import groupby

from ehbench.config.recipe import Thresholds
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.preprocessing.observations import stood_for
from ehbench.validation.results import ChannelResult, Check, Correlation, Ring, Sweep, Transient
from ehbench.vocabulary.quantities import quantity
from ehbench.vocabulary.units import from_si

POOR = 80.0  # percent of fit below which a position is told of although nobody asks
# a level is off by more than this share of the channel's spread, and by more than this share of the
# error's square: what is left without it follows the channel to SHAPE percent at least
LEVEL, MOSTLY, SHAPE = 0.25, 0.5, 50.0
NOISY = 5.0  # percent above the fit asked below which a recording's noise is allowed for


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
    band = f"over {sweep.band[0]:.3g} … {sweep.band[1]:.3g} Hz"
    for what, reached, limit, unit, (shown, factor) in (
        ("gain", sweep.gain_error, requested.response_gain_error, "share", ("%", 100.0)),
        ("phase", sweep.phase_error, requested.response_phase_error, "rad", ("°", 180.0 / math.pi)),
        ("delay", sweep.delay_error, requested.response_delay_error, "s", ("ms", 1000.0)),
    ):
        if limit is None:
            continue
        maximum, name = float(limit), f"{_words(sweep.channel)} {what} of the response"
        if reached is None:
            sentence = f"{name}: the recording answers the sweep {band}, the model does not"
        else:
            gap = "" if shown == "°" else " "
            sentence = (
                f"{name} is off by {factor * reached:.3g}{gap}{shown} {band}; "
                f"{factor * maximum:.3g}{gap}{shown} is allowed"
            )
        passed = reached is not None and reached <= maximum
        yield Check(f"{sweep.channel} response {what}", reached, maximum, unit, passed, sentence)


def _fit_check(result: ChannelResult, requested: Thresholds) -> Iterator[Check]:
    word = result.channel.rsplit(".", 1)[1]
    limits = (requested.fit_percent.get(item) for item in stood_for(word))
    minimum = next((limit for limit in limits if limit is not None), None)
    reached = result.fit_percent
    if minimum is not None and reached is not None:
        asked_for, allowed = minimum, ""
        if 100.0 * (1.0 - result.noise_share) < minimum + NOISY:
            minimum = beyond_noise(minimum, result.noise_share)
            allowed = f", which its noise makes {minimum:.3g} %"
        passed = reached >= minimum
        sentence = (
            f"{_words(result.channel)} fit {reached:.3g} % is {'not ' * passed}below "
            f"the {asked_for:g} % asked{allowed}"
        )
        yield Check(f"{result.channel} fit", reached, minimum, "percent", passed, sentence)


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
        sentence = (
            f"{_words(result.channel)} error reaches {shown[0]} {unit}; "
            f"{shown[1]} {unit} is allowed"
        )
        what = f"{result.channel} max error"
        yield Check(what, reached, maximum, result.unit, reached <= maximum, sentence)


def _residual_checks(result: ChannelResult, requested: Thresholds) -> Iterator[Check]:
    kinds: tuple[tuple[bool, str, tuple[Correlation, ...]], ...] = (
        (requested.whiteness, "autocorrelation", _own(result)),
        (requested.independence, "correlation with commands", _crossed(result)),
    )
    for required, kind, match in kinds:
        if required and match:
            reached = max(item.outside_percent for item in match)
            sentence = (
                f"{_words(result.channel)} residual {kind} leaves its band at {reached:.0f} % of "
                f"the lags; {requested.outside_percent:g} % is allowed"
            )
            what, passed = f"{result.channel} residual {kind}", reached <= requested.outside_percent
            yield Check(what, reached, requested.outside_percent, "percent", passed, sentence)


def unasked(
    results: Sequence[ChannelResult], requested: Thresholds, rig: Rig, record: Record
) -> Iterator[str]:
    """What is poor although no threshold asks for it: a position that is followed badly, a level
    that is off, residuals outside of their bands.
    """
    for result in results:
        yield from _level(result, rig)
        word, reached = result.channel.rsplit(".", 1)[1], result.fit_percent
        silent = not {*stood_for(word)} & {*requested.fit_percent, *requested.max_error}
        if word in ("q", "x") and silent and reached is not None and reached < POOR:
            row, unit = quantity(word), rig.unit_of(word)
            wish = f"{result.channel.rsplit('.', 1)[0]}.x_desired"
            fixed = f'; {wish} says that a controller held it: tied = "position" ties it in'
            far = from_si(abs(result.max_error), unit, row)
            yield (
                f"{_words(result.channel)} fit is {reached:.3g} %, its error reaches {far:.3g} "
                f"{unit}: no threshold asks for it (max_error or fit_percent of {word} would)"
                f"{fixed if wish in record else ''}"
            )
    for required, kind, match in (
        (requested.whiteness, "residual autocorrelation", _own),
        (requested.independence, "residual correlation with commands", _crossed),
    ):
        outside = {
            result.channel: max(item.outside_percent for item in match(result))
            for result in results
            if match(result)
        }
        outside = {
            name: share for name, share in outside.items() if share > requested.outside_percent
        }
        if outside and not required:
            shares = ", ".join(f"{name} {share:.0f} %" for name, share in outside.items())
            key = "whiteness" if match is _own else "independence"
            yield f"{kind} leaves its band at {shares} of the lags; {key} is not asked"


def _level(result: ChannelResult, rig: Rig) -> Iterator[str]:
    """That a channel is followed but for its level. Positions have none: they begin where the
    recording does.
    """
    word, fit = result.channel.rsplit(".", 1)[1], result.fit_percent
    bias, rms = result.bias, result.rms_error
    if fit is None or word in ("q", "x") or bias**2 < MOSTLY * rms**2 or fit >= 100.0:
        return
    spread = rms / (1.0 - fit / 100.0)
    shape = 100.0 * (1.0 - math.sqrt(max(rms**2 - bias**2, 0.0)) / spread)
    if abs(bias) > LEVEL * spread and shape >= SHAPE:
        off = f"{rig.shown(result.channel, abs(bias), 3)} too {'high' if bias > 0.0 else 'low'}"
        yield (
            f"{_words(result.channel)} is followed to {shape:.3g} % but for its level, which the "
            f"model has {off} on average and which makes its fit {fit:.3g} %: a sensor's offset "
            "would do that, or a part that the rig file does not have"
        )


def _own(result: ChannelResult) -> tuple[Correlation, ...]:
    return (result.autocorrelation,) if result.autocorrelation else ()


def _crossed(result: ChannelResult) -> tuple[Correlation, ...]:
    return result.cross_correlation


def _ringing_check(cylinder: str, key: str, windows: Sequence[Transient], limit: float) -> Check:
    """The worst window: fails where the difference exceeds what is allowed by more than two of its
    standard errors.
    """
    what = f"{cylinder} {key.replace('_', ' ')}"
    silent = [w for w in windows if w.simulated.natural_frequency is None]
    if silent:
        when, why = silent[0].start, silent[0].simulated.reason
        sentence = f"{what}: the recording rings from {when:.2f} s on, the model does not ({why})"
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
    apart = f"{100 * reached:.0f} % apart; {100 * limit:g} % is allowed"
    sentence = f"{what} {shown[0]} against {shown[1]} recorded from {worst.start:.2f} s on, {apart}"
    return Check(what, reached, limit, "share", passed, sentence)


def _words(channel: str) -> str:
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
