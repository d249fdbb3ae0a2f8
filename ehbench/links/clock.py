"""Delays and clocks of a link, from the packets that a trial's log has."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ehbench.data.record import Record


def exchanges_in(record: Record) -> list[tuple[float, ...]]:
    """The exchanges of a log, for `estimated`; none of one that has no packets."""
    names = ("packet", "packet_sent", "packet_received", "sample_time", "packet_acknowledged")
    if names[0] not in record:
        return []
    table = np.column_stack([record[name] for name in names])
    table = table[table[:, 0] > 0.0]  # before the first there is none
    return table[np.unique(table[:, 0], return_index=True)[1]].tolist()


def estimated(exchanges: Sequence[Sequence[float]]) -> dict[str, Any]:
    """Clock offset, drift and transport delays, each with its interval, of a link.

    A packet never comes before it left. A sample taken at t by the target and received at h by the
    host bounds the offset θ of the host's clock from above, θ ≤ h − t. A command sent at h and
    acknowledged by the sample of t bounds it from below, θ ≥ h − t. The offset's interval is that
    of the bounds that 95 % of the ticks keep, for a target stamps its ticks as they were due.
    Delays are medians, their intervals those of the median (95 %, order statistics) widened by the
    offset's.

    Args:
        exchanges: (number of the command, host time sent, host time received, target time,
            number acknowledged) of each tick [s].

    Returns:
        ``clock_offset``, ``command_delay``, ``sample_delay`` [s] and ``clock_drift`` as (value,
        low, high); empty of fewer than ten ticks.
    """
    table = np.array(exchanges)
    if len(table) < 10:
        return {}
    number, sent, came, t, acknowledged = table.T
    span = np.linspace(t[0], t[-1], 11)
    parts = [(t >= a) & (t <= b) for a, b in zip(span[:-1], span[1:], strict=True)]
    # of each part the sample that came soonest after it was taken, and the line through these
    waits = [np.where(part, came - t, np.inf) for part in parts if part.any()]
    soonest = [int(np.argmin(wait)) for wait in waits]
    taken, waited = t[soonest], (came - t)[soonest]
    taken, waited = taken - taken.mean(), waited - waited.mean()
    spread = float(taken @ taken)
    slope = float(taken @ waited) / spread
    rest = waited - slope * taken
    error = float(np.sqrt(rest @ rest / max(len(taken) - 2, 1) / spread))
    base = t[0]
    first = np.searchsorted(acknowledged, number)  # the sample that acknowledges a command
    known = first < len(t)
    up, down = came - t - slope * (t - base), np.full(len(t), np.nan)
    acted = t[first[known]]
    down[known] = sent[known] - acted - slope * (acted - base)
    low, high = float(np.nanquantile(down, 0.95)), float(np.quantile(up, 0.05))
    offset, half = 0.5 * (low + high), 0.5 * abs(high - low)
    return {
        "clock_offset": (offset, offset - half, offset + half),
        "clock_drift": (slope, slope - 2.0 * error, slope + 2.0 * error),
        "command_delay": _median(offset - down[known], half),
        "sample_delay": _median(up - offset, half),
    }


def _median(values: np.ndarray, half: float) -> tuple[float, float, float]:
    """(median, the ends of its 95 % interval widened by ``half``)."""
    ordered, n = np.sort(values), len(values)
    reach = 0.98 * np.sqrt(n)
    low, high = (int(np.clip(round(0.5 * n + side * reach), 0, n - 1)) for side in (-1, 1))
    middle = float(np.median(ordered))
    return middle, float(ordered[low]) - half, float(ordered[high]) + half
