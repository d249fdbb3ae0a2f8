"""What each channel's residual goes along with: command, speed, pressure, position, direction,
time."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ehbench.data.record import Record
from ehbench.diagnosis.cases import Case
from ehbench.preprocessing.observations import column
from ehbench.signals.series import correlation_band
from ehbench.vocabulary.quantities import GAUGES

STILL = 0.05  # share of the largest speed below which no direction is told


@dataclass(frozen=True)
class Follows:
    """A channel of a log whose residual goes along with ``what`` more than chance lets it: their
    ``correlation``, and the half-width ``band`` within which it stays by chance in 95 %.
    """

    log: str
    channel: str
    what: str
    correlation: float
    band: float


def followed(case: Case, simulated: Record) -> Iterator[Follows]:
    """What the residuals of a case follow, channel by channel."""
    for channel in case.channels:
        values = column(simulated, channel, case.record)
        assert values is not None
        error = case.blocks(values) - case.recorded[channel]
        for what, cause in _causes(case, channel.rpartition(".")[0]).items():
            if 0.0 in (np.ptp(cause), np.ptp(error)):
                continue
            result = float(np.corrcoef(error, cause)[0, 1])
            band = correlation_band(error, cause)
            if abs(result) > band:
                yield Follows(case.name, channel, what, result, band)


def _causes(case: Case, cylinder: str) -> dict[str, np.ndarray]:
    """What an error may follow, in blocks."""
    record = case.record
    results = {
        f"command of {name.removesuffix('.command')}": case.blocks(record[name])
        for name in record.channels
        if name.startswith(f"{cylinder}.") and name.endswith(".command")
    }
    for word in ("v", "qd"):
        speed = column(record, f"{cylinder}.{word}", record)
        if speed is not None:
            slow = case.blocks(speed)
            moving = np.abs(slow) > STILL * float(np.max(np.abs(slow)))
            results |= {"speed": slow, "direction": np.where(moving, np.sign(slow), 0.0)}
            break
    for what, words in (("position", ("x", "q")), ("pressure", ("p_head", "p_rod", *GAUGES))):
        name = next((f"{cylinder}.{w}" for w in words if f"{cylinder}.{w}" in record), None)
        if name is not None:
            results[what] = case.blocks(record[name])
    return results | {"time": case.blocks(record.t)}
