"""The frequency response of a log's channels to a command, as a fit compares it.

Both sides go through the one estimator of `ehbench.frequency_response.response`, from the same
recorded command with the same segments, so that resolution does the same to both."""

from dataclasses import dataclass

import numpy as np

from ehbench.data.record import Record
from ehbench.frequency_response.response import Averaging, Signals, signals_of, transfer_of


@dataclass(frozen=True, eq=False)
class Band:
    """The response of a log's channels to one command: how it is averaged, the numbers of the
    ``frequency`` [Hz] that count of all, and the standard errors [SI] of each, shape (frequencies,
    channels); infinite where a channel is not coherent."""

    command: str
    choice: Averaging
    at: np.ndarray
    frequency: np.ndarray
    errors: np.ndarray

    def seen(self, record: Record, columns: np.ndarray) -> np.ndarray:
        """The responses of some columns, shape (samples, channels), in units of their errors: real
        parts of all frequencies, then imaginary ones; shape (2 · frequencies, channels)."""
        parts = []
        for y, error in zip(columns.T, self.errors.T, strict=True):
            signals = band_signals(record, self.command, y, self.choice)
            parts.append(transfer_of(signals)[self.at] / error)
        built = np.column_stack(parts)
        return np.concatenate([np.real(built), np.imag(built)])

    def lateness(self, simulated: np.ndarray, recorded: np.ndarray) -> tuple[float, float]:
        """(by how much a channel's recorded response is behind the simulated one [s], standard
        error), by the slope of their phases' difference, weighted by what is known of each."""
        built, seen = (y[: self.at.size] + 1j * y[self.at.size :] for y in (simulated, recorded))
        omega, size = 2.0 * np.pi * self.frequency, np.abs(seen)
        off = np.angle(built * np.conj(seen))
        known = float(np.sum((size * omega) ** 2))
        late = float(np.sum(size**2 * omega * off)) / max(known, 1e-300)
        left = size * (off - late * omega)
        spread = float(np.sum(left**2)) / max(1, np.count_nonzero(size) - 1)
        return late, float(np.sqrt(max(spread, 1.0) / max(known, 1e-300)))


def band_signals(record: Record, command: str, y: np.ndarray, choice: Averaging) -> Signals:
    return signals_of([(record[command], y)], 1.0 / record.sample_time, choice)
