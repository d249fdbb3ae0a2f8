"""Frequency response from logs: gain, phase and coherence by local polynomials, delay by the slope
of the phase.

About each frequency the spectra of whole logs obey Y = H X + T: H, and of each log how it begins
and ends, T, are parabolas over the lines nearer than 1/segment, by least squares (Schoukens,
Vandersteen, Barbé & Pintelon, IEEE Trans. Instrum. Meas. 58, 2009). What is left of Y is noise."""

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
from ehbench.signals.series import stretches_of
from ehbench.vocabulary import Z95, InputError, InsufficientData, Message, listed, message, setting


@dataclass(frozen=True)
class ResponseSettings:
    """Numbers of frequency responses."""

    averages: int = setting(4, "", "least number of segments", "fewer leave no useful error")
    usual_averages: int = setting(8, "", "usual segments of the shortest log", "a compromise")
    samples: int = setting(16, "", "least samples of a segment", "8 frequencies")
    no_power: float = setting(1.0e-8, "", "power of no excitation, of the largest", "rounding")
    distinct: float = setting(1e-3, "", "share of power that no neighbour explains", "measured")
    late: float = setting(0.25, "", "share of a segment from which a delay lowers the gain", "2 %")
    curved: float = setting(2.0, "", "residual of a curved phase over its error", "χ²")
    line: int = setting(4, "", "frequencies from which a slope is fitted", "two more than needed")
    narrow: float = setting(0.5, "", "share of the lines that shows a sharp curve", "half")
    sharp: float = setting(9.0, "", "squares by which these differ, of chance", "one in 8000")
    shown: float = setting(1.5, "", "shown beyond the highest frequency that counts", "half as far")


SETTINGS = ResponseSettings()
ORDER = 3  # coefficients of a parabola


class Averaging(NamedTuple):
    """How logs are averaged: ``segment`` [s] (None: 8 of the shortest log), least ``coherence``,
    largest ``frequency`` [Hz]."""

    segment: float | None = None
    coherence: float = 0.8
    frequency: float = math.inf

    @classmethod
    def of(cls, table: Any) -> Averaging:
        """As a recipe's table has it."""
        length = None if table.segment is None else float(table.segment)
        highest = math.inf if table.frequency_max is None else float(table.frequency_max)
        return cls(length, table.coherence_min, highest)


@dataclass(frozen=True)
class Signals:
    """Input and output of all logs, evenly sampled at ``rate`` [Hz], and how they are averaged:
    ``size`` samples a segment, ``segments`` of each log, which leave ``freedom`` complex degrees of
    freedom at a frequency."""

    pairs: tuple[tuple[np.ndarray, np.ndarray], ...]
    rate: float
    size: int
    segments: tuple[int, ...]
    freedom: int
    choice: Averaging
    warnings: tuple[str, ...]

    @property
    def averages(self) -> float:
        """How many independent segments leave as much: two of the lines for each."""
        return 1.0 + 0.5 * self.freedom


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
    return replace(signals_of(pairs, rates[0], choice), warnings=tuple(warnings))


def signals_of(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]], rate: float, choice: Averaging
) -> Signals:
    """Pairs of input and output, sampled at one rate [Hz], and how they are cut into segments.

    Raises:
        InsufficientData: they are too short."""
    shortest = min(x.size for x, _ in pairs)
    size = round((choice.segment or shortest / SETTINGS.usual_averages / rate) * rate)
    # whole ones, with which an input that repeats leaks nowhere; two would show a log's ends alone
    whole = (x.size // max(size, 1) for x, _ in pairs)
    segments = tuple(n if 2 * n - 1 > ORDER else 0 for n in whole)
    seconds, count = size / rate, sum(segments)
    if size < SETTINGS.samples:
        fields = {"segment": seconds, "count": size, "least": SETTINGS.samples}
        raise InsufficientData(message("frequency_response.short_segments", **fields))
    if count < SETTINGS.averages:
        fields = {"segment": seconds, "count": count, "least": SETTINGS.averages}
        raise InsufficientData(message("frequency_response.few_segments", **fields))
    freedom = sum(2 * n - 1 - ORDER for n in segments if n) - ORDER
    return Signals(tuple(pairs), rate, size, segments, freedom, choice, ())


def estimate(signals: Signals) -> Response:
    """The frequency response of the logs.

    Raises:
        InsufficientData: no frequency is coherent enough to count."""
    frequency, power, transfer, left, freedom, bias, sharp = _local(signals)
    powered, gain = power > 0.0, np.abs(transfer)
    # half the lines' noise is that of as many segments as the averages stand for
    explained = gain**2 * power
    coherence = np.where(powered, explained / np.maximum(explained + 0.5 * left, 1e-300), 0.0)
    by_chance = 1.0 - 0.05 ** (1.0 / signals.freedom)
    noise = 2.0 * by_chance / (1.0 + by_chance)
    limit = max(signals.choice.coherence, noise)
    coherent = powered & (coherence >= limit)
    if not powered.any():
        length = signals.size / signals.rate
        raise InsufficientData(message("frequency_response.at_the_ends", segment=length))
    if not coherent.any():
        best = int(np.argmax(coherence))
        fields = {"limit": limit, "best": coherence[best], "frequency": frequency[best]}
        raise InsufficientData(message("frequency_response.no_coherence", **fields))
    from scipy.special import stdtrit

    known = np.where(coherence > 0.0, coherence, np.nan)
    spread = stdtrit(2.0 * freedom, 0.975) * np.sqrt((1.0 - known) / known / freedom)
    spread += bias / np.where(gain > 0.0, gain, np.nan)
    phase = _unwrapped(np.angle(transfer), coherent)
    turn = np.where(spread < 1.0, np.arcsin(np.minimum(spread, 1.0)), np.nan)
    curves = {
        "gain_low": np.maximum(gain * (1.0 - spread), 0.0),
        "gain_high": gain * (1.0 + spread),
        "phase_low": phase - turn,
        "phase_high": phase + turn,
    }
    delay, curved = _delay(frequency, phase, turn, coherent)
    at = np.flatnonzero(coherent)
    fallen = [curve[at] for curve in (gain, curves["gain_low"], curves["gain_high"])]
    turned = [curve[at] for curve in (phase, curves["phase_low"], curves["phase_high"])]
    starts = [item[0] / math.sqrt(2.0) for item in fallen]
    marks = powered, coherent, sharp & coherent
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
        warnings=(*signals.warnings, *_warnings(signals, frequency, marks), *curved),
        **curves,
    )
    if delay is not None and delay.value > SETTINGS.late * result.segment:
        fields = {"delay": 1e3 * delay.value, "share": delay.value / result.segment}
        late = message("frequency_response.late", **fields)
        return replace(result, warnings=(*result.warnings, late))
    return result


def transfer_of(signals: Signals) -> np.ndarray:
    """H at the frequencies of `estimate`, complex; zero where the input has no power."""
    return np.nan_to_num(_local(signals)[2])


def _local(signals: Signals) -> tuple[np.ndarray, ...]:
    """(frequency [Hz], power of the input that is not explained by its neighbours, H, power of the
    output that is left, its complex degrees of freedom, by how much H is no parabola, where half
    the lines have surely another), up to the largest frequency; power is zero and H nan where the
    input has none."""
    frequency = np.arange(1, signals.size // 2) * signals.rate / signals.size
    frequency = frequency[frequency <= signals.choice.frequency]
    if not frequency.size:
        fields = {"highest": signals.choice.frequency, "segment": signals.size / signals.rate}
        raise InsufficientData(message("frequency_response.no_frequency", **fields))
    gram, along, whole, lines = _sums(signals, frequency.size)
    gram, beyond, along = gram[:, :ORDER, :ORDER], gram[:, :ORDER, ORDER:], along[:, :ORDER]
    near = np.real(gram[:, 0, 0])
    inverse = _inverse(gram)
    solution = inverse @ along
    explained = np.sum(along.conj() * solution, axis=(1, 2)).real
    power = 1.0 / inverse[:, 0, 0].real
    density = near / np.sin(np.pi * frequency / signals.rate) ** 2
    powered = (power > SETTINGS.distinct * near) & (density > SETTINGS.no_power * density.max())
    transfer = np.where(powered, solution[:, 0, 0], np.nan)
    freedom = lines - np.trace(inverse @ gram, axis1=1, axis2=2).real
    left = np.maximum(whole - explained, 1e-15 * whole)
    bias = np.zeros(frequency.size)
    if frequency.size > ORDER + 1:
        # the next two terms of H's series, by differences between neighbours, enter it by so much
        third = np.diff(transfer, 3)
        terms = np.column_stack([(third[1:] + third[:-1]) / 12.0, np.diff(transfer, 4) / 24.0])
        terms = np.pad(terms, ((2, 2), (0, 0)), mode="edge")
        bias = np.nan_to_num(np.abs(np.sum((inverse @ beyond)[:, 0] * terms, axis=1)))
    # a curve sharper than the frequencies shows no such differences: half the lines have another H
    gram, along, *_ = _sums(signals, frequency.size, SETTINGS.narrow)
    half = _inverse(gram[:, :ORDER, :ORDER])
    apart = np.abs(transfer - (half @ along[:, :ORDER])[:, 0, 0])
    chance = left / freedom * (half - inverse)[:, 0, 0].real
    sharp = powered & (apart**2 > SETTINGS.sharp * np.maximum(chance, 1e-300))
    bias = np.where(sharp, np.maximum(bias, apart), bias)
    return frequency, np.where(powered, power, 0.0), transfer, left, freedom, bias, sharp


def _sums(
    signals: Signals, count: int, share: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """(normal matrices of H's series, their right sides, squares of Y, how many lines) over all
    logs without their T, at so many frequencies, of a share of the lines about each."""
    gram = np.zeros((count, ORDER + 2, ORDER + 2), complex)
    along, whole, lines = gram[..., :1].copy(), np.zeros(count), 0
    for pair, segments in zip(signals.pairs, signals.segments, strict=True):
        reach = math.ceil(share * segments)
        if 2 * reach - 1 <= ORDER:
            continue
        some = slice(segments - reach, segments + reach - 1)
        x, y = (
            _windows(item[: segments * signals.size], segments, count)[:, some] for item in pair
        )
        powers = (np.arange(1 - reach, reach) / segments)[:, None] ** np.arange(ORDER + 2)
        begin, _ = np.linalg.qr(powers[:, :ORDER])
        design, answer = x[..., None] * powers, y[..., None]
        design, answer = (item - begin @ (begin.T @ item) for item in (design, answer))
        adjoint = design.conj().swapaxes(1, 2)
        gram, along = gram + adjoint @ design, along + adjoint @ answer
        whole = whole + np.sum(np.real(answer) ** 2 + np.imag(answer) ** 2, axis=(1, 2))
        lines += x.shape[1] - ORDER
    return gram, along, whole, lines


def _inverse(gram: np.ndarray) -> np.ndarray:
    """With a ridge so small that it only keeps at zero what the lines do not show."""
    ridge = 1e-12 * np.real(gram[:, 0, 0]) + 1e-300
    return np.linalg.inv(gram + ridge[:, None, None] * np.eye(ORDER))


def _windows(values: np.ndarray, count: int, frequencies: int) -> np.ndarray:
    """The spectrum of a series' changes at the lines nearer than one of ``count`` segments' to each
    frequency, shape (frequencies, lines). Of changes, as a drift is the same at all lines then."""
    spectrum = np.fft.rfft(values - np.roll(values, 1))
    return np.lib.stride_tricks.sliding_window_view(spectrum, 2 * count - 1)[1::count][:frequencies]


def _unwrapped(phase: np.ndarray, coherent: np.ndarray) -> np.ndarray:
    """The phase without jumps over the coherent frequencies; the others go to the nearest turn."""
    at = np.flatnonzero(coherent)
    line = np.interp(np.arange(phase.size), at, np.unwrap(phase[at]))
    return phase + 2.0 * math.pi * np.round((line - phase) / (2.0 * math.pi))


def _delay(
    frequency: np.ndarray, phase: np.ndarray, turn: np.ndarray, coherent: np.ndarray
) -> tuple[Estimate | None, list[Message]]:
    """(−dφ/dω with its interval, notes on it) by a weighted line through the phase. The errors of
    neighbours are hardly correlated, as the middle of a parabola is hardly one of its ends."""
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
    curved = math.sqrt(float(residual @ residual) / (at.size - 2))
    warnings = []
    if curved > SETTINGS.curved:
        fields = {"low": frequency[at[0]], "high": frequency[at[-1]], "times": curved}
        warnings.append(message("frequency_response.curved_phase", **fields))
    half = Z95 * math.sqrt(inverse[1, 1]) * max(1.0, curved)
    slope = float(solution[1])
    if slope + half < 0.0:
        warnings.append(message("frequency_response.early", early=-1e3 * slope, error=1e3 * half))
    return Estimate(slope, slope - half, slope + half), warnings


def _falls_below(
    frequency: np.ndarray, curves: Sequence[np.ndarray], levels: Sequence[float]
) -> Estimate | None:
    """Where a curve first falls through a level, between the last two frequencies that are surely
    above and the first two that are surely below; None where it does not, or where its errors leave
    that open.

    Args:
        frequency: the coherent ones [Hz].
        curves: the curve, its low end, its high end.
        levels: one for each curve."""
    if frequency.size < 3:
        return None
    value, low, high = curves
    before, f, after = frequency[:-2], frequency[1:-1], frequency[2:]
    chord = value[:-2] + (value[2:] - value[:-2]) * (f - before) / (after - before)
    # a chord is a quarter as far from a parabola as one over twice the distance
    bend = np.pad(0.25 * np.abs(value[1:-1] - chord), 2, mode="edge")
    bend = np.maximum(np.maximum(bend[:-2], bend[1:-1]), bend[2:])
    low, high = np.nan_to_num(low - bend, nan=-1e9), np.nan_to_num(high + bend, nan=1e9)
    above, below = low > levels[1], high < levels[2]
    last = next(iter(np.flatnonzero(below[:-1] & below[1:]).tolist()), 0)
    surely = (above[:-1] & above[1:])[: max(last - 1, 0)]
    first = max((np.flatnonzero(surely) + 1).tolist(), default=0)
    if not last or value[first] < levels[0]:
        return None
    passes = first + int(np.argmax(value[first + 1 :] < levels[0]))
    ends = []
    for curve, level, i in zip((value, low, high), levels, (passes, first, last - 1), strict=True):
        share = (curve[i] - level) / (curve[i] - curve[i + 1])
        ends.append(float(frequency[i] + share * (frequency[i + 1] - frequency[i])))
    return Estimate(ends[0], ends[1] if first else None, ends[2])


def _warnings(
    signals: Signals, frequency: np.ndarray, marks: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> list[Message]:
    """Notes on frequencies that have no power, are not coherent, or lie too far apart for the
    response there."""
    powered, coherent, sharp = marks
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
    if sharp.any():
        fields = {"ranges": _ranges(frequency, sharp), "segment": signals.size / signals.rate}
        longer = 2.0 * signals.size / signals.rate
        warnings.append(message("frequency_response.coarse", longer=longer, **fields))
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
