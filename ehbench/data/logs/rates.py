"""Signals of several rates in one table, as loggers of a bus write them: a row for each message,
blank in the columns of all others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ehbench.data.readers import Column

_SLOWER = 1.5  # times the rows between values, from which on a signal has a rate of its own
_SHARED = 0.1  # share of rows up to which two signals take turns
_LEAST = 4  # values that tell a rate
REPEATED = 0.05  # share of rows up to which a time that stands still is none that was rounded


def apart(columns: Sequence[Column]) -> list[tuple[list[int], np.ndarray]]:
    """(columns by number, the rows that are theirs) of the signals of a table that stand in the
    same rows. A signal has rows of its own where it stands in every second row of another or more
    seldom, or where the two take turns; one that is missing here and there has not, nor one that
    is missing for a while.
    """
    groups: list[tuple[list[int], np.ndarray]] = []
    for index, column in enumerate(columns):
        own = column.filled
        near = next((group for group in groups if not _takes_turns(own, group[1])), None)
        if near is None:
            groups.append(([index], own))
        else:
            near[0].append(index)
            near[1][:] |= own
    return groups


def _takes_turns(item: np.ndarray, other: np.ndarray) -> bool:
    """Whether two signals, by the rows that hold them, are of different messages."""
    if np.array_equal(item, other):
        return False
    rows = [np.flatnonzero(item), np.flatnonzero(other)]
    if min(some.size for some in rows) < _LEAST:
        return False
    steps = [float(np.median(np.diff(some))) for some in rows]
    if max(steps) >= _SLOWER * min(steps):
        return True
    first, last = max(some[0] for some in rows), min(some[-1] for some in rows)
    inside = [int(((some >= first) & (some <= last)).sum()) for some in rows]
    return min(inside) >= _LEAST and int((item & other).sum()) <= _SHARED * min(inside)


def repeated(t: np.ndarray, columns: Sequence[Column]) -> np.ndarray:
    """Where a row is the one before once more: its time [s] and all its cells; shape (rows,).
    Nowhere in a table whose time stands still often, as one that is rounded does.
    """
    same = np.concatenate([[False], t[1:] == t[:-1]])
    if not 0.0 < same.mean() <= REPEATED:
        return np.zeros(t.size, bool)
    for column in columns:
        values = column.values
        equal = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
        same[1:] &= equal
        for row in np.flatnonzero(same):
            same[row] &= column.odd.get(int(row)) == column.odd.get(int(row) - 1)
    return same
