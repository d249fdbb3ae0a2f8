"""What a sensor cannot have seen: sentinels, an angle that wraps, jumps of a single sample."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ehbench.signals.series import stretches_of
from ehbench.vocabulary import setting


@dataclass(frozen=True)
class OdditySettings:
    """From when on samples are odd."""

    share: float = setting(0.05, "", "share of samples that sentinels take at most", "else values")
    jump: float = setting(8.0, "", "steps of the 99th percentile that are a jump", "noise has none")
    span: float = setting(0.2, "", "share of the other samples' span that a jump is", "visible")
    wrap: float = setting(0.1, "", "share of a turn by which a step is less where it wraps", "fast")


SETTINGS = OdditySettings()
_FEWEST = 20  # samples that show what is usual
_TURNS = (360.0, 2.0 * np.pi, 2.0**12, 2.0**16, 2.0**32)  # [deg, rad, counts]


class Oddity(NamedTuple):
    """A ``kind`` ("sentinel", "wrap" or "jump") of odd samples, their count, first row and
    value."""

    kind: str
    count: int
    first: int
    value: float


def oddities(values: np.ndarray) -> list[Oddity]:
    """The odd samples of a signal, shape (samples,), in its own unit; NaN is none."""
    rows = np.flatnonzero(np.isfinite(values))
    y = values[rows]
    if y.size < _FEWEST or not np.ptp(y) > 0.0:
        return []
    steps = np.diff(y)
    if turn := _turn(y):
        near = np.abs(steps) > 0.5 * turn
        at = int(np.argmax(near)) + 1
        return [Oddity("wrap", int(near.sum()), int(rows[at]), float(y[at]))]
    results = []
    usual = float(np.percentile(np.abs(steps), 99))
    for end in (float(y.min()), float(y.max())):
        at = np.flatnonzero(y == end)
        others = y[y != end]
        span = float(np.ptp(others)) if others.size else 0.0
        sides = [
            np.abs(end - y[i])
            for a, b in stretches_of(y == end)
            for i in (a - 1, b)
            if 0 <= i < y.size
        ]
        apart = float(np.min(np.abs(others - end))) if others.size else 0.0
        minimum = max(SETTINGS.jump * usual, SETTINGS.span * span)
        far = apart > SETTINGS.span * span
        if at.size > 1 and at.size <= SETTINGS.share * y.size and far and min(sides) > minimum:
            results.append(Oddity("sentinel", at.size, int(rows[at[0]]), end))
    gone = np.isin(y, [item.value for item in results])
    left, right = y[1:-1] - y[:-2], y[1:-1] - y[2:]
    height = np.where(left * right > 0.0, np.minimum(np.abs(left), np.abs(right)), 0.0)
    span = float(np.ptp(np.sort(y)[1:-1]))
    odd = (height > max(SETTINGS.jump * usual, SETTINGS.span * span)) & ~gone[1:-1]
    if odd.any() and odd.mean() < SETTINGS.share:
        at = np.flatnonzero(odd) + 1
        results.append(Oddity("jump", at.size, int(rows[at[0]]), float(y[at[0]])))
    return results


def _turn(y: np.ndarray) -> float:
    """The turn after which a signal begins again at its other end; 0 of one that goes on."""
    steps = np.abs(np.diff(y))
    for turn in _TURNS:
        near = np.abs(steps - turn) < SETTINGS.wrap * turn
        small = steps[~near] < SETTINGS.wrap * turn
        if near.any() and near.mean() < SETTINGS.share and np.ptp(y) <= turn * 1.01 and small.all():
            return turn
    return 0.0


def continuous(values: np.ndarray) -> np.ndarray:
    """A signal that goes on where it begins again after a turn; any other as it is."""
    rows = np.flatnonzero(np.isfinite(values))
    if turn := _turn(values[rows]):
        values = values.copy()
        values[rows] = np.unwrap(values[rows], period=turn)
    return values
