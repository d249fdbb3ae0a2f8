"""Whether a controlled cylinder swings by itself: a limit cycle, as opposed to ringing that decays
and to a swing of the reference.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ehbench.runtime.compiled import kernel
from ehbench.vocabulary import setting


@dataclass(frozen=True)
class LimitCycleSettings:
    """What makes a swing a limit cycle."""

    cycles: int = setting(5, "", "cycles in a row that are alike", "a decay leaves fewer")
    periods: float = setting(0.35, "", "difference of a period from the median", "chosen")
    lasting: float = setting(0.75, "", "amplitude of the second half over the first", "chosen")
    smallest: float = setting(5.0e-4, "", "smallest swing, of the stroke", "chosen")
    windows: tuple = setting((0.2, 0.6, 2.0), "s", "what is slower is taken off", "5, 2, 0.5 Hz")
    counts: float = setting(4.0, "", "smallest swing, in counts of the sensor", "quantisation")
    coarse: float = setting(0.02, "", "largest limit by counts, of the stroke", "coarse sensors")
    reference: float = setting(0.5, "", "share of the swing in the reference", "chosen")
    harmonics: float = setting(8.0, "", "frequency of a swing over the reference's", "chosen")


LIMIT_CYCLE = LimitCycleSettings()


@dataclass(frozen=True)
class LimitCycle:
    """A lasting swing of the stroke about the desired one: half its height ``amplitude`` [m], its
    ``period`` [s], when it was seen first, ``start`` [s], and for how long, ``duration`` [s].
    """

    amplitude: float
    period: float
    start: float
    duration: float


def limit_cycle(
    t: np.ndarray, x: np.ndarray, x_desired: np.ndarray, commands: np.ndarray, stroke: float
) -> LimitCycle | None:
    """The largest lasting swing of a stroke about the desired one, None where there is none.

    Turning points of the error, without what is slow in it, that lie further apart than a sensor's
    counts make half swings; ``cycles`` periods of like length and height in a row are a limit
    cycle, unless the reference itself swings like that.

    Args:
        t: [s], evenly spaced, shape (samples,).
        x: measured stroke [m].
        x_desired: desired stroke [m].
        commands: of the cylinder's valves [V], shape (samples, valves): what swings while they rest
            rings.
        stroke: of the cylinder [m].
    """
    from scipy.ndimage import uniform_filter1d  # a tenth of a second to import

    steps = np.abs(np.diff(x))
    count = float(steps[steps > 0.0].min(initial=np.inf)) if (steps > 0.0).any() else 0.0
    minimum = max(
        LIMIT_CYCLE.smallest * stroke,
        min(LIMIT_CYCLE.counts * count, LIMIT_CYCLE.coarse * stroke),
    )
    error = x - x_desired
    best: LimitCycle | None = None
    for window in LIMIT_CYCLE.windows:  # a swing on a slow error turns only without it
        width, slow = max(1, round(0.5 * window / float(t[1] - t[0]))), error
        for _ in range(2):
            slow = uniform_filter1d(slow, width, mode="nearest")
        fast, rows = error - slow, np.empty(error.size, np.int64)
        rows = rows[: _zigzag(fast, 2.0 * minimum, rows)]
        for result, span in _lasting(t, rows, fast[rows]):
            larger = best is None or result.amplitude > best.amplitude
            acts = np.ptp(commands[span], axis=0).any()
            if larger and acts and not _follows_reference(t[span], x_desired[span], result):
                best = result
    return best


def _lasting(
    t: np.ndarray, rows: np.ndarray, values: np.ndarray
) -> Iterator[tuple[LimitCycle, slice]]:
    """Each stretch of half swings that are alike, by the rows of the turning points and the values
    there, and its rows.
    """
    heights, turns = np.abs(np.diff(values)) / 2.0, t[rows]
    first, halves = 0, 2 * LIMIT_CYCLE.cycles

    def alike(last: int) -> bool:
        whole = turns[first + 2 : last + 1] - turns[first : last - 1]
        typical = float(np.median(whole))
        if np.abs(whole - typical).max() > LIMIT_CYCLE.periods * typical:
            return False
        among, middle = heights[first:last], (last - first) // 2
        return among[middle:].mean() >= LIMIT_CYCLE.lasting * among[:middle].mean()

    while first + halves < rows.size:
        last = first + halves
        if not alike(last):
            first += 1
            continue
        while last + 1 < rows.size and alike(last + 1):
            last += 1
        period = 2.0 * float(np.median(np.diff(turns[first : last + 1])))
        began, lasts = float(turns[first]), float(turns[last] - turns[first])
        cycle = LimitCycle(float(np.median(heights[first:last])), period, began, lasts)
        yield cycle, slice(int(rows[first]), int(rows[last]) + 1)
        first = last


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


def _follows_reference(t: np.ndarray, x_desired: np.ndarray, result: LimitCycle) -> bool:
    """Whether the reference swings like that, or turns round so often that it makes the error."""
    ways = np.sign(np.diff(x_desired))
    ways = ways[ways != 0.0]
    turns = int(np.count_nonzero(np.diff(ways)))
    if turns >= 3 and LIMIT_CYCLE.harmonics * turns >= 2.0 * result.duration / result.period:
        return True
    # the ends of a ramp have energy at every frequency, but not through Hann's window
    line = np.polynomial.Polynomial.fit(t, x_desired, 1)
    turn = np.hanning(t.size) * np.exp(-2j * np.pi * (t - t[0]) / result.period)
    amplitude = 4.0 * abs(complex(np.mean((x_desired - line(t)) * turn)))
    return amplitude >= LIMIT_CYCLE.reference * result.amplitude
