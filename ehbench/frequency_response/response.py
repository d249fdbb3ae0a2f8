"""Frequency response from logs: gain, phase and coherence by Welch averaging, delay by the slope of
the phase.

The estimate is H = G_xy/G_xx over segments of all logs, with errors as for one input and one output
(Bendat & Piersol, Random Data, 4th ed., 9.2): n segments leave 2n − 2 degrees of freedom, and of
the output's power the share 1 − γ² is not explained by the input."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ehbench.data.record import Record
from ehbench.preprocessing.plausibility import at_limit
from ehbench.preprocessing.time_base import SETTINGS as TIME
from ehbench.preprocessing.time_base import evened
from ehbench.signals.series import levelled, repeats, stretches_of
from ehbench.vocabulary import Z95, InputError, InsufficientData, Message, listed, message, setting


@dataclass(frozen=True)
class ResponseSettings:
    """Numbers of frequency responses."""

    averages: int = setting(4, "", "least number of segments", "fewer leave no useful error")
    usual_averages: int = setting(8, "", "usual averages of the shortest log", "a compromise")
    samples: int = setting(16, "", "least samples of a segment", "8 frequencies")
    no_power: float = setting(1.0e-8, "", "power of no excitation, of the largest", "windows")
    late: float = setting(0.1, "", "share of a segment from which a delay lowers the gain", "10 %")
    curved: float = setting(2.0, "", "residual of a curved phase over its error", "χ²")
    line: int = setting(4, "", "frequencies from which a slope is fitted", "two more than needed")
    shown: float = setting(1.5, "", "shown beyond the highest frequency that counts", "half as far")


SETTINGS = ResponseSettings()
OVERLAP = {"hann": 0.5, "boxcar": 0.0}


class Averaging(NamedTuple):
    """How logs are averaged: ``segment`` [s] (None: 8 averages), ``window``, least ``coherence``,
    largest ``frequency`` [Hz]."""

    segment: float | None = None
    window: str = "hann"
    coherence: float = 0.8
    frequency: float = math.inf

    @classmethod
    def of(cls, table: Any) -> Averaging:
        """As a recipe's table has it."""
        length = None if table.segment is None else float(table.segment)
        highest = math.inf if table.frequency_max is None else float(table.frequency_max)
        return cls(length, table.window, table.coherence_min, highest)


@dataclass(frozen=True)
class Signals:
    """Input and output of all logs, evenly sampled at ``rate`` [Hz], and how they are averaged:
    ``size`` samples a segment, ``segments`` of each log, ``averages`` independent ones in all."""

    pairs: tuple[tuple[np.ndarray, np.ndarray], ...]
    rate: float
    size: int
    segments: tuple[int, ...]
    averages: float
    choice: Averaging
    warnings: tuple[str, ...]

    @property
    def overlap(self) -> int:
        """Samples that neighbouring segments share."""
        return round(OVERLAP[self.choice.window] * self.size)


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval; an end that the data do not show is None."""

    value: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Response:
    """A frequency response at ``frequency`` [Hz], shape (frequencies,), of ``averages`` independent
    segments of ``segment`` seconds.

    ``gain`` is in SI units of output over input, ``phase`` [rad] unwrapped over the coherent
    frequencies; each with its 95 % interval, nan where there is none. ``coherence`` is γ²,
    ``noise`` what two signals without connection reach in 5 % of cases, ``coherent`` marks where it
    counts.
    ``delay`` [s] is −dφ/dω; ``bandwidth`` and ``quadrature`` [Hz] are where the gain is 3 dB below
    its first value and where the phase passes −90°, None where the data do not show it."""

    frequency: np.ndarray
    gain: np.ndarray
    gain_low: np.ndarray
    gain_high: np.ndarray
    phase: np.ndarray
    phase_low: np.ndarray
    phase_high: np.ndarray
    coherence: np.ndarray
    coherent: np.ndarray
    noise: float
    averages: float
    segment: float
    delay: Estimate | None
    bandwidth: Estimate | None
    quadrature: Estimate | None
    warnings: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """What ``response.json`` says of it, SI."""
        shown = self.frequency[self.coherent]
        return {
            "averages": self.averages,
            "segment": self.segment,
            "frequencies": self.frequency.size,
            "coherent": int(self.coherent.sum()),
            "coherent_range": [shown.min(), shown.max()],
            "coherence_noise": self.noise,
            "delay": _as_json(self.delay, "s"),
            "bandwidth": _as_json(self.bandwidth, "Hz"),
            "quadrature": _as_json(self.quadrature, "Hz"),
        }

    def table(self, unit: str) -> str:
        """The curves as CSV; ``unit`` is the gain's, phases are in degrees."""
        phases = ("phase", "phase_low", "phase_high")
        columns = {"frequency [Hz]": self.frequency}
        columns |= {f"{name} [{unit}]": getattr(self, name) for name in _GAINS}
        columns |= {f"{name} [deg]": np.degrees(getattr(self, name)) for name in phases}
        columns |= {"coherence": self.coherence, "coherent": self.coherent.astype(int)}
        lines = [",".join(columns)]
        for row in zip(*columns.values(), strict=True):
            lines.append(",".join("" if math.isnan(value) else f"{value:.9g}" for value in row))
        return "\n".join(lines) + "\n"


_GAINS = ("gain", "gain_low", "gain_high")


@dataclass(frozen=True)
class Curve:
    """A response to be drawn at ``frequency`` [Hz]: ``gain`` [SI], ``phase`` [deg],
    ``coherence``."""

    frequency: tuple[float | None, ...]
    gain: tuple[float | None, ...]
    phase: tuple[float | None, ...]
    coherence: tuple[float | None, ...]
    coherent: tuple[bool, ...]

    @classmethod
    def of(cls, response: Response, highest: float) -> Curve:
        """Some way beyond the highest frequency [Hz] that counts."""
        shown = response.frequency <= SETTINGS.shown * highest

        def column(values: np.ndarray) -> tuple[float | None, ...]:
            return tuple(
                float(f"{value:.6g}") if math.isfinite(value) else None
                for value in values[shown].tolist()
            )

        return cls(
            column(response.frequency),
            column(response.gain),
            column(np.degrees(response.phase)),
            column(response.coherence),
            tuple(bool(item) for item in response.coherent[shown]),
        )


def _as_json(estimate: Estimate | None, unit: str) -> dict[str, Any] | None:
    if estimate is None:
        return None
    return {"value": estimate.value, "interval": [estimate.low, estimate.high], "unit": unit}


def prepare_signals(
    logs: Sequence[tuple[str, Record]], names: tuple[str, str], choice: Averaging
) -> Signals:
    """Input and output of the logs, and how they are cut into segments.

    Args:
        logs: name and record of each.
        names: channels of input and output.
        choice: of the user.

    Raises:
        LogError: a channel is not there, or a log is not evenly sampled.
        InputError: logs of different rates.
        InsufficientData: the logs are too short, or the input does not move."""
    warnings, pairs, rates = [], [], []
    driven = [
        name
        for name, record in logs
        if record.meta.get("controller", "open_loop") != "open_loop"
        and names[0].startswith(f"{record.meta.get('cylinder')}.")
        and names[0].endswith(".command")
    ]
    if driven:
        fields = {"input": names[0], "logs": listed(driven, 3)}
        warnings.append(message("frequency_response.closed_loop", **fields))
    for name, record in logs:
        x, y = (record[channel] for channel in names)
        record, notes = evened(name, Record(record.t, dict(zip(names, (x, y), strict=True))))
        warnings += [f"{name}: {text}" for text in notes]
        if share := 100.0 * float(np.mean(at_limit(y))):
            fields = {"log": name, "channel": names[1], "share": share}
            warnings.append(message("frequency_response.limited", **fields))
        pairs.append((record[names[0]], record[names[1]]))
        rates.append(float(f"{1.0 / record.sample_time:.9g}"))
    if max(rates) > (1.0 + TIME.even) * min(rates):
        low, high = min(rates), max(rates)
        raise InputError(message("frequency_response.several_rates", low=low, high=high))
    if all(np.ptp(x) == 0.0 for x, _ in pairs):
        fields = {"channel": names[0], "level": pairs[0][0][0]}
        raise InsufficientData(message("frequency_response.constant_input", **fields))
    signals = signals_of(pairs, rates[0], choice)
    if choice.window == "hann" and all(
        repeats(x, signals.size, SETTINGS.no_power) for x, _ in pairs
    ):
        fields = {"input": names[0], "segment": signals.size / signals.rate}
        warnings.append(message("frequency_response.repeats", **fields))
    return replace(signals, warnings=tuple(warnings))


def signals_of(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]], rate: float, choice: Averaging
) -> Signals:
    """Pairs of input and output, sampled at one rate [Hz], and how they are cut into segments.

    Raises:
        InsufficientData: they are too short."""
    shared = OVERLAP[choice.window]
    shortest = min(x.size for x, _ in pairs)
    usual = shortest / (1.0 + (SETTINGS.usual_averages - 1) * (1.0 - shared)) / rate
    size = round((choice.segment or usual) * rate)
    step = size - round(shared * size)
    segments = tuple(max(0, 1 + (x.size - size) // max(step, 1)) for x, _ in pairs)
    seconds, count = size / rate, sum(segments)
    if size < SETTINGS.samples:
        fields = {"segment": seconds, "count": size, "least": SETTINGS.samples}
        raise InsufficientData(message("frequency_response.short_segments", **fields))
    if count < SETTINGS.averages:
        fields = {"segment": seconds, "count": count, "least": SETTINGS.averages}
        raise InsufficientData(message("frequency_response.few_segments", **fields))
    # how many independent segments so many overlapping ones are worth (Welch 1967)
    taper = _taper(choice.window, size)
    overlapping = (float(taper[step:] @ taper[: size - step] / (taper @ taper))) ** 2
    averages = sum(n / (1.0 + 2.0 * (1.0 - 1.0 / max(n, 1)) * overlapping) for n in segments)
    return Signals(tuple(pairs), rate, size, segments, averages, choice, ())


def _taper(window: str, size: int) -> np.ndarray:
    from scipy.signal import get_window

    return np.asarray(get_window(window, size), float)


def estimate(signals: Signals) -> Response:
    """The frequency response of the logs.

    Raises:
        InsufficientData: no frequency is coherent enough to count."""
    frequency, gxx, gyy, gxy = _spectra(signals)
    powered = gxx > SETTINGS.no_power * gxx.max()
    product = np.where(powered & (gyy > 0.0), gxx * gyy, np.inf)
    coherence = np.minimum(np.abs(gxy) ** 2 / product, 1.0)
    transfer = np.where(powered, gxy / np.where(powered, gxx, 1.0), np.nan)
    noise = 1.0 - 0.05 ** (1.0 / (signals.averages - 1.0))
    limit = max(signals.choice.coherence, noise)
    coherent = coherence >= limit
    if not coherent.any():
        best = int(np.argmax(coherence))
        fields = {"limit": limit, "best": coherence[best], "frequency": frequency[best]}
        raise InsufficientData(message("frequency_response.no_coherence", **fields))
    from scipy.special import stdtrit

    freedom = 2.0 * signals.averages - 2.0
    known = np.where(coherence > 0.0, coherence, np.nan)
    gain = np.abs(transfer)
    spread = stdtrit(freedom, 0.975) * np.sqrt((1.0 - known) / known / freedom)
    phase = _unwrapped(np.angle(transfer), coherent)
    turn = np.where(spread < 1.0, np.arcsin(np.minimum(spread, 1.0)), np.nan)
    curves = {
        "gain_low": np.maximum(gain * (1.0 - spread), 0.0),
        "gain_high": gain * (1.0 + spread),
        "phase_low": phase - turn,
        "phase_high": phase + turn,
    }
    delay, curved = _delay(signals, frequency, phase, turn, coherent)
    at = np.flatnonzero(coherent)
    fallen = [curve[at] for curve in (gain, curves["gain_low"], curves["gain_high"])]
    turned = [curve[at] for curve in (phase, curves["phase_low"], curves["phase_high"])]
    starts = [item[0] / math.sqrt(2.0) for item in fallen]
    result = Response(
        frequency=frequency,
        gain=gain,
        phase=phase,
        coherence=np.where(powered, coherence, np.nan),
        coherent=coherent,
        noise=noise,
        averages=signals.averages,
        segment=signals.size / signals.rate,
        delay=delay,
        bandwidth=_falls_below(frequency[at], fallen, [starts[0], starts[2], starts[1]]),
        quadrature=_falls_below(frequency[at], turned, [-0.5 * math.pi] * 3),
        warnings=(*signals.warnings, *_warnings(signals, frequency, powered, coherent), *curved),
        **curves,
    )
    if delay is not None and delay.value > SETTINGS.late * result.segment:
        fields = {"delay": 1e3 * delay.value, "share": delay.value / result.segment}
        late = message("frequency_response.late", **fields)
        return replace(result, warnings=(*result.warnings, late))
    return result


def transfer_of(signals: Signals) -> np.ndarray:
    """G_xy/G_xx at the frequencies of `estimate`, complex; zero where the input has no power."""
    _, gxx, _, gxy = _spectra(signals)
    powered = gxx > SETTINGS.no_power * gxx.max()
    return np.where(powered, gxy / np.where(powered, gxx, 1.0), 0.0)


def _spectra(signals: Signals) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(frequency [Hz], G_xx, G_yy, G_xy) averaged over all segments, up to the largest
    frequency."""
    from scipy.signal import ShortTimeFFT

    size = signals.size
    taper = _taper(signals.choice.window, size)
    how: Any = {"fs": signals.rate, "scale_to": "psd", "phase_shift": None}
    transform: Any = ShortTimeFFT(taper, size - signals.overlap, **how)
    # from where the first segment begins, as SciPy's `csd`, which transforms both signals each time
    where: Any = {"detr": "constant", "p0": 0, "k_offset": size // 2}
    total = np.zeros((3, transform.f_pts), complex)
    for pair, count in zip(signals.pairs, signals.segments, strict=True):
        if count:
            level = (levelled(item, size, size - signals.overlap, count) for item in pair)
            x, y = (transform.stft_detrend(item, p1=count, **where) for item in level)
            for i, density in enumerate((_power(x), _power(y), y * np.conj(x))):
                total[i] += count * np.mean(density, axis=-1)
    total[:, 1 : -1 if size % 2 == 0 else None] *= 2.0
    frequency = transform.f
    retained = (frequency > 0.0) & (frequency <= signals.choice.frequency)
    if not retained.any():
        fields = {"highest": signals.choice.frequency, "segment": signals.size / signals.rate}
        raise InsufficientData(message("frequency_response.no_frequency", **fields))
    gxx, gyy, gxy = total[:, retained] / sum(signals.segments)
    return frequency[retained], gxx.real, gyy.real, gxy


def _power(transformed: np.ndarray) -> np.ndarray:
    return np.real(transformed) ** 2 + np.imag(transformed) ** 2


def _unwrapped(phase: np.ndarray, coherent: np.ndarray) -> np.ndarray:
    """The phase without jumps over the coherent frequencies; the others go to the nearest turn."""
    at = np.flatnonzero(coherent)
    line = np.interp(np.arange(phase.size), at, np.unwrap(phase[at]))
    return phase + 2.0 * math.pi * np.round((line - phase) / (2.0 * math.pi))


def _delay(
    signals: Signals,
    frequency: np.ndarray,
    phase: np.ndarray,
    turn: np.ndarray,
    coherent: np.ndarray,
) -> tuple[Estimate | None, list[Message]]:
    """(−dφ/dω with its interval, notes on it) by a weighted line through the phase.

    The window spreads a frequency over its neighbours, so their errors go together: the variance
    is that of the weighted line under their correlation."""
    at = np.flatnonzero(coherent & np.isfinite(turn))
    if at.size < SETTINGS.line:
        return None, [message("frequency_response.no_delay", count=at.size)]
    omega = 2.0 * math.pi * frequency[at]
    error = np.maximum(turn[at] / Z95, 1.0e-9)
    design = np.column_stack([np.ones(at.size), -omega])
    weighted = design / error[:, None]
    inverse = np.linalg.inv(weighted.T @ weighted)
    solution = inverse @ weighted.T @ (phase[at] / error)
    residual = (phase[at] - design @ solution) / error
    taper = _taper(signals.choice.window, signals.size)
    leak = np.abs(np.fft.rfft(taper**2) / np.sum(taper**2)) ** 2
    apart = np.abs(at[:, None] - at[None, :])
    correlated = np.where(apart < leak.size, leak[np.minimum(apart, leak.size - 1)], 0.0)
    variance = (inverse @ weighted.T @ correlated @ weighted @ inverse)[1, 1]
    curved = math.sqrt(float(residual @ residual) / (at.size - 2))
    warnings = []
    if curved > SETTINGS.curved:
        fields = {"low": frequency[at[0]], "high": frequency[at[-1]], "times": curved}
        warnings.append(message("frequency_response.curved_phase", **fields))
    half = Z95 * math.sqrt(variance) * max(1.0, curved)
    slope = float(solution[1])
    if slope + half < 0.0:
        warnings.append(message("frequency_response.early", early=-1e3 * slope, error=1e3 * half))
    return Estimate(slope, slope - half, slope + half), warnings


def _falls_below(
    frequency: np.ndarray, curves: Sequence[np.ndarray], levels: Sequence[float]
) -> Estimate | None:
    """Where a curve first falls through a level, with its interval; None where it does not, or
    where its errors leave that open.

    Args:
        frequency: the coherent ones [Hz].
        curves: the curve, its low end, its high end.
        levels: one for each curve."""
    ends: list[float | None] = []
    for curve, level in zip(curves, levels, strict=True):
        i = next(iter(np.flatnonzero(curve < level).tolist()), 0)
        if i:
            share = (curve[i - 1] - level) / (curve[i - 1] - curve[i])
            ends.append(float(frequency[i - 1] + share * (frequency[i] - frequency[i - 1])))
        else:
            ends.append(None)
    value, early, late = ends
    return None if value is None or late is None else Estimate(value, early, late)


def _warnings(
    signals: Signals, frequency: np.ndarray, powered: np.ndarray, coherent: np.ndarray
) -> list[Message]:
    warnings = []
    fields: dict[str, Any] = {"all": powered.size}
    if not powered.all():
        fields |= {"ranges": _ranges(frequency, ~powered), "count": int((~powered).sum())}
        warnings.append(message("frequency_response.no_power", **fields))
    low = powered & ~coherent
    if low.any():
        fields |= {"ranges": _ranges(frequency, low), "count": int(low.sum())}
        limit = signals.choice.coherence
        warnings.append(message("frequency_response.low_coherence", limit=limit, **fields))
    return warnings


def _ranges(frequency: np.ndarray, marked: np.ndarray) -> str:
    """``2 … 5 Hz, 30 … 500 Hz``; the three widest, in order."""
    runs = stretches_of(marked)
    widest = np.sort(np.argsort(runs[:, 0] - runs[:, 1], kind="stable")[:3])
    words = [
        f"{frequency[start]:.4g}" + (f" … {frequency[end - 1]:.4g}" if end - start > 1 else "")
        for start, end in runs[widest]
    ]
    return ", ".join(f"{word} Hz" for word in words) + (", …" if len(runs) > 3 else "")
