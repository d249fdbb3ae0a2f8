"""Whether a controlled cylinder swings by itself: a limit cycle, told from ringing that dies out
and from what the reference asks for.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ehbench.runtime.compiled import kernel

CYCLES = 5  # in a row, of like period and like amplitude, make a limit cycle
PERIODS_ALIKE = 0.35  # share by which periods in a row may differ from their median
LASTING = 0.75  # of the amplitude of the first half of the cycles is left in the second
SMALLEST = 5.0e-4  # of the stroke: what is less is no swing
SIZES = (1.0, 3.0, 10.0)  # of that, of the turns that are looked at
COUNTS = 4.0  # of the stroke's sensor, likewise
ASKED = 0.5  # share of the swing that the reference may have at its frequency
HARMONICS = 8  # a swing so many times as fast as the reference turns round is one of its own


@dataclass(frozen=True)
class LimitCycle:
    """A lasting swing of the stroke about the desired one: half its height ``amplitude`` [m], its
    ``period`` [s], when it was seen first, ``start`` [s], and for how long, ``duration`` [s].
    """

    amplitude: float
    period: float
    start: float
    duration: float


class _Swings(NamedTuple):
    """Half swings of an error: rows of its turning points and its values there."""

    rows: np.ndarray
    values: np.ndarray


def limit_cycle(
    t: np.ndarray, x: np.ndarray, x_desired: np.ndarray, commands: np.ndarray, stroke: float
) -> LimitCycle | None:
    """The largest lasting swing of a stroke about the desired one, None where there is none.

    Turning points of the error that lie further apart than a sensor's counts make half swings;
    `CYCLES` periods of like length and height in a row are a limit cycle, unless the reference
    itself swings like that.

    Args:
        t: [s], evenly spaced, shape (samples,).
        x: measured stroke [m].
        x_desired: desired stroke [m].
        commands: of the cylinder's valves [V], shape (samples, valves): what swings while they rest
            rings.
        stroke: of the cylinder [m].
    """
    steps = np.abs(np.diff(x))
    count = float(steps[steps > 0.0].min(initial=np.inf)) if (steps > 0.0).any() else 0.0
    minimum = max(SMALLEST * stroke, min(COUNTS * count, 0.02 * stroke))
    error = x - x_desired
    best: LimitCycle | None = None
    for size in SIZES:  # small turns within a large swing are none of its own
        for result, span in _lasting(t, _turning_points(error, size * minimum)):
            larger = best is None or result.amplitude > best.amplitude
            acts = np.ptp(commands[span], axis=0).any()
            if larger and acts and not _asked(t[span], x_desired[span], result):
                best = result
    return best


def _lasting(t: np.ndarray, turns: _Swings) -> Iterator[tuple[LimitCycle, slice]]:
    """Each stretch of swings that are alike, and its rows."""
    rows, heights = turns.rows, np.abs(np.diff(turns.values)) / 2.0
    first = 0
    while first + 2 * CYCLES < rows.size:
        last = _alike(t[rows], heights, first, 2 * CYCLES)
        if last is None:
            first += 1
            continue
        yield (
            LimitCycle(
                float(np.median(heights[first:last])),
                2.0 * float(np.median(np.diff(t[rows[first : last + 1]]))),
                float(t[rows[first]]),
                float(t[rows[last]] - t[rows[first]]),
            ),
            slice(int(rows[first]), int(rows[last]) + 1),
        )
        first = last


def _turning_points(error: np.ndarray, least: float) -> _Swings:
    """Where the error turns, by a zigzag: a turn counts once the error has come back from it by
    twice ``least``.
    """
    rows = np.empty(error.size, np.int64)
    rows = rows[: _zigzag(np.ascontiguousarray(error, float), 2.0 * least, rows)]
    return _Swings(rows, error[rows])


@kernel
def _zigzag(error, height, rows):
    """Write the rows of the turning points of ``height`` or more; how many there are."""
    count, way, top, bottom = 0, 0, 0, 0
    for i in range(error.shape[0]):
        if error[i] > error[top]:
            top = i
        if error[i] < error[bottom]:
            bottom = i
        down = way >= 0 and error[top] - error[i] > height
        if down or (way <= 0 and error[i] - error[bottom] > height):
            rows[count] = top if down else bottom
            count, way, top, bottom = count + 1, -1 if down else 1, i, i
    return count


def _alike(t: np.ndarray, heights: np.ndarray, first: int, halves: int) -> int | None:
    """The turning point up to which swings from ``first`` on are alike; None if not for long
    enough.
    """

    def same(last: int) -> bool:
        whole = t[first + 2 : last + 1] - t[first : last - 1]
        typical = float(np.median(whole))
        if np.abs(whole - typical).max() > PERIODS_ALIKE * typical:
            return False
        own = heights[first:last]
        middle = own.size // 2
        early, late = float(own[:middle].mean()), float(own[middle:].mean())
        return late >= LASTING * early

    last = first + halves
    if not same(last):
        return None
    while last + 1 < t.size and same(last + 1):
        last += 1
    return last


def _asked(t: np.ndarray, x_desired: np.ndarray, result: LimitCycle) -> bool:
    """Whether the reference swings like that, or turns round so often that it makes the error."""
    ways = np.sign(np.diff(x_desired))
    ways = ways[ways != 0.0]
    turns = int(np.count_nonzero(np.diff(ways)))
    if turns >= 3 and HARMONICS * turns >= 2.0 * result.duration / result.period:
        return True
    return _amplitude(t, x_desired, result.period) >= ASKED * result.amplitude


def _amplitude(t: np.ndarray, y: np.ndarray, period: float) -> float:
    """Amplitude of a signal at a period, a straight line taken off it before."""
    line = np.polynomial.Polynomial.fit(t, y, 1)
    turn = np.exp(-2j * np.pi * (t - t[0]) / period)
    return 2.0 * abs(complex(np.mean((y - line(t)) * turn)))
