"""Logs compared by their frequency response in place of their samples.

Both sides go through the one estimator of `ehbench.response`, from the same recorded command with
the same segments, so what windows and leakage do to one they do to the other."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ehbench.errors import InputError, InsufficientData
from ehbench.identification.simulator import Log, columns_of
from ehbench.quantities import like_channel
from ehbench.record import Record
from ehbench.response import (
    LEAST_LINE,
    Averaging,
    Curve,
    Response,
    Signals,
    estimate,
    signals_of,
    transfer_of,
)
from ehbench.terms import Z95

SURE = 0.01  # share of its size that no number of a response is better known than
LATE = 0.25  # of a sample, and …
SURELY = 4.0  # … so many standard errors, by which a phase must lag to be said


@dataclass(frozen=True, eq=False)
class Band:
    """The response of a log's channels to one command: how it is averaged, the numbers of the
    ``frequency`` [Hz] that count of all, and the standard errors [SI] of each, shape (frequencies,
    channels); infinite where a channel is not coherent.
    """

    command: str
    choice: Averaging
    at: np.ndarray
    frequency: np.ndarray
    errors: np.ndarray

    def seen(self, record: Record, columns: np.ndarray) -> np.ndarray:
        """The responses of some columns, shape (samples, channels), in units of their errors: real
        parts of all frequencies, then imaginary ones; shape (2 · frequencies, channels).
        """
        parts = []
        for y, error in zip(columns.T, self.errors.T, strict=True):
            signals = _signals(record, self.command, y, self.choice)
            parts.append(transfer_of(signals)[self.at] / error)
        made = np.column_stack(parts)
        return np.concatenate([np.real(made), np.imag(made)])

    def behind(self, simulated: np.ndarray, recorded: np.ndarray) -> tuple[float, float]:
        """(by how much a channel's recorded response is behind the simulated one [s], standard
        error), by the slope of their phases' difference, weighted by what is known of each.
        """
        made, seen = (y[: self.at.size] + 1j * y[self.at.size :] for y in (simulated, recorded))
        omega, size = 2.0 * np.pi * self.frequency, np.abs(seen)
        off = np.angle(made * np.conj(seen))
        known = float(np.sum((size * omega) ** 2))
        late = float(np.sum(size**2 * omega * off)) / max(known, 1e-300)
        left = size * (off - late * omega)
        spread = float(np.sum(left**2)) / max(1, np.count_nonzero(size) - 1)
        return late, float(np.sqrt(max(spread, 1.0) / max(known, 1e-300)))


def on_response(log: Log, command: str, choice: Averaging) -> Log:
    """A log that is compared by its frequency response.

    Raises:
        InputError: the log has no such command, or a chamber of its cylinder cavitates.
        InsufficientData: no channel answers coherently, at four frequencies at least.
    """
    if command not in log.record:
        raise InputError(
            f"{log.name}: [response] names '{command}', which the log does not have",
            hint=like_channel(command, list(log.record.channels)),
        )
    cylinder = command.partition(".")[0]
    own = [i for i, name in enumerate(log.channels) if name.startswith(f"{cylinder}.")]
    if not own or not command.endswith(".command"):
        raise InputError(
            f"{log.name}: {', '.join(log.channels)}: none of them answers '{command}'",
            hint="[response] input is a valve's command, channels are of its cylinder",
        )
    names = tuple(log.channels[i] for i in own)
    if not log.counts[:, own].all():
        raise InputError(
            f"{log.name}: a chamber of {cylinder} cavitates, which the model only has as a floor "
            "of pressure; a response is of all samples",
            hint="take a part of the log in which it does not (start, stop)",
        )
    log = replace(log, channels=names, recorded=log.recorded[:, own])
    found = [
        _estimated(_signals(log.record, command, y, choice), f"{log.name}: {channel}")
        for channel, y in zip(log.channels, log.recorded.T, strict=True)
    ]
    coherent = np.column_stack([one.coherent for one in found])
    at = np.flatnonzero(coherent.any(axis=1))
    if at.size < LEAST_LINE:
        raise InsufficientData(
            f"{log.name}: only {at.size} frequencies answer {command} coherently",
            hint="a log in which it sweeps, or a smaller coherence_min",
        )
    errors = np.column_stack([_error(one) for one in found])[at]
    errors = np.where(coherent[at], errors, np.inf)
    band = Band(command, choice, at, found[0].frequency[at], errors)
    counts = np.concatenate([coherent[at]] * 2)
    return replace(log, band=band, recorded=band.seen(log.record, log.recorded), counts=counts)


@dataclass(frozen=True)
class ResponseFit:
    """The frequency response of a channel to the command ``input``, recorded and simulated; None:
    the model does not answer. ``coherence`` is from which a frequency counts."""

    input: str
    channel: str
    coherence: float
    recorded: Curve
    simulated: Curve | None


def followed(log: Log, replayed: Record) -> tuple[ResponseFit, ...]:
    """How a replay follows a log that is compared by its frequency response, by channel."""
    assert log.band is not None
    command, choice, highest = log.band.command, log.band.choice, float(log.band.frequency[-1])
    sides = (
        (columns_of(log, log.record), choice),
        (
            columns_of(log, replayed),
            choice._replace(coherence=0.0),
        ),
    )
    found = []
    for k, channel in enumerate(log.channels):
        curves: list[Curve | None] = []
        for columns, asked in sides:
            try:
                one = estimate(_signals(log.record, command, columns[:, k], asked))
            except InsufficientData:
                curves.append(None)
            else:
                curves.append(Curve.of(one, highest))
        recorded, simulated = curves
        if recorded is not None:
            found.append(ResponseFit(command, channel, choice.coherence, recorded, simulated))
    return tuple(found)


def late_responses(log: Log, simulated: np.ndarray) -> list[str]:
    """A warning of each channel whose recorded response is behind the model's by a delay."""
    assert log.band is not None
    found = []
    for channel, made, seen in zip(log.channels, simulated.T, log.recorded.T, strict=True):
        late, error = log.band.behind(made, seen)
        if abs(late) > max(LATE * log.record.sample_time, SURELY * error):
            word = "behind" if late > 0 else "ahead of"
            found.append(
                f"{log.name}: {channel} answers {log.band.command} {1e3 * abs(late):.2g} ± "
                f"{1e3 * Z95 * error:.1g} ms {word} the model, by the slope of its phase: a delay "
                f'that is not modelled? [[sensor]] channel = "{log.band.command}", delay = '
                '"estimate"'
            )
    return found


def _signals(record: Record, command: str, y: np.ndarray, choice: Averaging) -> Signals:
    return signals_of([(record[command], y)], 1.0 / record.sample_time, choice)


def _estimated(signals: Signals, where: str) -> Response:
    try:
        return estimate(signals)
    except InsufficientData as error:
        raise InsufficientData(f"{where}: {error.message}", hint=error.hint) from None


def _error(one: Response) -> np.ndarray:
    """Standard errors [SI] of the real and of the imaginary part."""
    share = np.nan_to_num((one.gain_high / one.gain - 1.0) / Z95, nan=np.inf)
    return one.gain * np.maximum(share, SURE)
