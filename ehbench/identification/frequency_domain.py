"""Logs that are compared by their frequency response in place of their samples."""

from dataclasses import dataclass, replace

import numpy as np

from ehbench.data.record import Record
from ehbench.frequency_response.response import SETTINGS as RESPONSE
from ehbench.frequency_response.response import Averaging, Curve, Response, estimate
from ehbench.identification.band import Band, band_signals
from ehbench.identification.simulator import Log, columns_of
from ehbench.vocabulary import Z95, InputError, InsufficientData, message, setting
from ehbench.vocabulary.quantities import like_channel


@dataclass(frozen=True)
class ResponseFitSettings:
    """Numbers of fits to frequency responses."""

    known: float = setting(
        0.01, "", "smallest error of a response, of its size", "no sensor is better"
    )
    late: float = setting(0.25, "", "part of a sample by which a phase must lag", "chosen")
    surely: float = setting(4.0, "", "standard errors by which it must", "one in 16 000 by chance")


SETTINGS = ResponseFitSettings()


def on_response(log: Log, command: str, choice: Averaging) -> Log:
    """A log that is compared by its frequency response.

    Raises:
        InputError: the log has no such command, or a chamber of its cylinder cavitates.
        InsufficientData: no channel answers coherently, at four frequencies at least."""
    fields = {"log": log.name, "command": command, "channels": ", ".join(log.channels)}
    if command not in log.record:
        text = message("identification.no_command", **fields)
        raise InputError(text, hint=like_channel(command, list(log.record.channels)))
    fields["cylinder"] = command.partition(".")[0]
    places = [i for i, name in enumerate(log.channels) if name.startswith(f"{fields['cylinder']}.")]
    if not places or not command.endswith(".command"):
        raise InputError(message("identification.no_answer", **fields))
    names = tuple(log.channels[i] for i in places)
    if not log.counts[:, places].all():
        raise InputError(message("identification.response_cavitates", **fields))
    log = replace(log, channels=names, recorded=log.recorded[:, places])
    results = []
    for channel, y in zip(log.channels, log.recorded.T, strict=True):
        try:
            results.append(estimate(band_signals(log.record, command, y, choice)))
        except InsufficientData as error:
            text = f"{log.name}: {channel}: {error.message}"
            raise InsufficientData(text, hint=error.hint) from None
    coherent = np.column_stack([item.coherent for item in results])
    at = np.flatnonzero(coherent.any(axis=1))
    if at.size < RESPONSE.line:
        raise InsufficientData(message("identification.few_coherent", count=at.size, **fields))
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
        (columns_of(log, replayed), choice._replace(coherence=0.0)),
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
    results: list[str] = []
    for channel, built, seen in zip(log.channels, simulated.T, log.recorded.T, strict=True):
        late, error = log.band.lateness(built, seen)
        if abs(late) > max(SETTINGS.late * log.record.sample_time, SETTINGS.surely * error):
            fields = {"log": log.name, "channel": channel, "command": log.band.command}
            fields |= {"word": "behind" if late > 0 else "ahead of"}
            fields |= {"delay": 1e3 * abs(late), "half": 1e3 * Z95 * error}
            results.append(message("identification.late_response", **fields))
    return results


def _error(item: Response) -> np.ndarray:
    """Standard errors [SI] of the real and of the imaginary part."""
    share = np.nan_to_num((item.gain_high / item.gain - 1.0) / Z95, nan=np.inf)
    return item.gain * np.maximum(share, SETTINGS.known)
