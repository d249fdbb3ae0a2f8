"""Logs that are compared by their frequency response in place of their samples."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ehbench.data.record import Record
from ehbench.frequency_response.response import SETTINGS as RESPONSE
from ehbench.frequency_response.response import (
    Averaging,
    Curve,
    Response,
    Signals,
    estimate,
)
from ehbench.identification.band import Band, band_signals
from ehbench.identification.simulator import Log, columns_of
from ehbench.vocabulary.errors import InputError, InsufficientData
from ehbench.vocabulary.quantities import like_channel
from ehbench.vocabulary.terms import Z95

SURE = 0.01  # share of its size that no number of a response is better known than
LATE = 0.25  # of a sample, and …
SURELY = 4.0  # … so many standard errors, by which a phase must lag to be said


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
    results = [
        _estimated(band_signals(log.record, command, y, choice), f"{log.name}: {channel}")
        for channel, y in zip(log.channels, log.recorded.T, strict=True)
    ]
    coherent = np.column_stack([item.coherent for item in results])
    at = np.flatnonzero(coherent.any(axis=1))
    if at.size < RESPONSE.line:
        raise InsufficientData(
            f"{log.name}: only {at.size} frequencies answer {command} coherently",
            hint="a log in which it sweeps, or a smaller coherence_min",
        )
    errors = np.column_stack([_error(item) for item in results])[at]
    errors = np.where(coherent[at], errors, np.inf)
    band = Band(command, choice, at, results[0].frequency[at], errors)
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
    results = []
    for k, channel in enumerate(log.channels):
        curves: list[Curve | None] = []
        for columns, requested in sides:
            try:
                item = estimate(band_signals(log.record, command, columns[:, k], requested))
            except InsufficientData:
                curves.append(None)
            else:
                curves.append(Curve.of(item, highest))
        recorded, simulated = curves
        if recorded is not None:
            results.append(ResponseFit(command, channel, choice.coherence, recorded, simulated))
    return tuple(results)


def late_responses(log: Log, simulated: np.ndarray) -> list[str]:
    """A warning of each channel whose recorded response is behind the model's by a delay."""
    assert log.band is not None
    results = []
    for channel, built, seen in zip(log.channels, simulated.T, log.recorded.T, strict=True):
        late, error = log.band.behind(built, seen)
        if abs(late) > max(LATE * log.record.sample_time, SURELY * error):
            word = "behind" if late > 0 else "ahead of"
            results.append(
                f"{log.name}: {channel} answers {log.band.command} {1e3 * abs(late):.2g} ± "
                f"{1e3 * Z95 * error:.1g} ms {word} the model, by the slope of its phase: a delay "
                f'that is not modelled? [[sensor]] channel = "{log.band.command}", delay = '
                '"estimate"'
            )
    return results


def _estimated(signals: Signals, where: str) -> Response:
    try:
        return estimate(signals)
    except InsufficientData as error:
        raise InsufficientData(f"{where}: {error.message}", hint=error.hint) from None


def _error(item: Response) -> np.ndarray:
    """Standard errors [SI] of the real and of the imaginary part."""
    share = np.nan_to_num((item.gain_high / item.gain - 1.0) / Z95, nan=np.inf)
    return item.gain * np.maximum(share, SURE)
