"""Where a flow map begins: commands between which flow starts, deadband and its interval."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ehbench.flow_maps.cells import Cells
from ehbench.flow_maps.readings import Task
from ehbench.flow_maps.steps import Shape, likelihoods, roughly_smoothed, solve
from ehbench.vocabulary.errors import InsufficientData

# no driver's command is known better than this share of the largest one
_LEAST_WIDTH = 5e-4
# rise of −2 log likelihood at the ends of intervals of 95 and of 99.9 %
_LEVEL_95, _LEVEL_999 = 3.841, 10.83
_GOLDEN, _SECTIONS = 0.5 * (5.0**0.5 - 1.0), 10
_TRIES, _FINE = 8, 1e-5  # of the search for such an end; [V] to which it is found


@dataclass(frozen=True)
class Window:
    """Range of the deadband [V], the index of the lowest command that passes flow, the commands on
    either side [V], and whether the lowest of all passes flow."""

    low: float
    high: float
    opens: int
    bracket: tuple[float, float]
    flows_at_lowest: bool


@dataclass(frozen=True)
class Deadband:
    """A deadband [V] with standard error and 95 % interval; ``at_bound``: it may be 0 V."""

    value: float = 0.0
    std: float = 0.0
    interval: tuple[float, float] = (0.0, 0.0)
    at_bound: bool = True


def window_of(task: Task, cells: Cells, lack: float) -> Window:
    """From the last but one command that may be shut to just below the first that is not."""
    k = _first_flow(task, cells, lack)
    levels = task.levels
    below = float(levels[k - 1]) if k else 0.0
    seen = np.flatnonzero(np.bincount(task.cell_level, cells.weight)[: max(k - 1, 0)])
    return Window(
        low=float(levels[seen[-2:][0]]) if seen.size else 0.0,
        high=float(levels[k]) - 0.02 * (float(levels[k]) - below),
        opens=k,
        bracket=(below, float(levels[k])),
        flows_at_lowest=k == 0,
    )


def _first_flow(task: Task, cells: Cells, lack: float) -> int:
    """Index of the lowest command that passes flow for sure, and so do all above it."""
    total = np.maximum(np.bincount(task.cell_level, cells.weight), 1e-300)
    mean = np.bincount(task.cell_level, cells.weight * cells.y) / total
    shut = np.flatnonzero((mean * np.sqrt(total / lack) <= 4.0) | (mean <= 1e-3))
    first = int(shut[-1]) + 1 if shut.size else 0
    if task.levels.size - first < 3:
        raise InsufficientData(
            f"the {task.who} passes flow at {task.levels.size - first} of its "
            f"{task.levels.size} commands",
            hint="3 or more commands above the deadband are needed",
        )
    return first


def start_deadband(task: Task, shape: Shape, cells: Cells, lack: float) -> Shape:
    """The likeliest of a few deadbands, each with its own smoothing: one far off would call for a
    wrong smoothing.
    """
    window = window_of(task, cells, lack)
    above = task.levels[window.opens :]
    options = [
        roughly_smoothed(replace(shape, deadband=u, above=above), cells, 0)
        for u in np.linspace(window.low, window.high, 13)
    ]
    return min(options, key=lambda item: item[1])[0]


def find_deadband(task: Task, shape: Shape, cells: Cells, lack: float) -> tuple[Deadband, Shape]:
    """(deadband by its profile likelihood, if the flow starts with a kink; the shape with it)."""
    window = window_of(task, cells, lack)
    shape = replace(shape, deadband=0.0, above=task.levels[window.opens :])
    if window.high <= window.low:
        return Deadband(), shape
    minimum = _LEAST_WIDTH * float(task.levels[-1])
    grid, rise = _profile(task, shape, cells, window, soft=False)
    best = int(np.argmin(rise))
    value = round(_lowest(grid, rise, best), 4)
    weight = np.exp(-0.5 * rise)
    spread = weight @ (grid - value) ** 2 / weight.sum() + (grid[1] - grid[0]) ** 2 / 12
    level = _LEVEL_999 if window.flows_at_lowest else _LEVEL_95  # an extrapolation is worth less
    lower, upper = (_crossing(grid[best::way], rise[best::way], level) for way in (-1, 1))
    ends = max(min(lower, value - minimum), 0.0), max(upper, value + minimum)
    interval = (round(ends[0], 4), round(ends[1], 4))
    result = Deadband(value, float(np.sqrt(spread)), interval, at_bound=lower <= 0.0)
    return result, replace(shape, deadband=value)


def soften(task: Task, shape: Shape, cells: Cells, result: Deadband, window: Window) -> Deadband:
    """Lowers the lower end of the deadband's interval to where a flow with a soft start would
    begin.

    That is the lower end for a spline which may curve at will over the first commands that pass
    flow. Such splines end with a parabola that starts level, a shape which valves do have: the end
    is taken at 99.9 %. It is sought between the grid's points: how far these lie apart hangs on the
    last bits of the readings."""
    if window.high <= window.low:
        return result
    grid, rise = _profile(task, shape, cells, window, soft=True)
    best = int(np.argmin(rise))

    _, level, near = solve(shape, shape.spline(float(grid[best]), soft=True), cells)

    def above_least(u: float) -> float:
        """−2 log likelihood of a deadband above that of the grid's best."""
        return solve(shape, shape.spline(u, soft=True), cells, near)[1] - level

    # the least lies between the grid's points, too
    around = (float(grid[max(best - 1, 0)]), float(grid[min(best + 1, grid.size - 1)]))
    edge = min(_least(above_least, *around), 0.0) + _LEVEL_999
    beyond, soft = np.flatnonzero(rise[:best] > edge), float(grid[0])
    if beyond.size:
        ends = (float(grid[beyond[-1]]), float(grid[beyond[-1] + 1]))
        soft = _root(lambda u: above_least(u) - edge, *ends)
    lower, upper = result.interval
    return replace(result, interval=(round(min(lower, soft), 4), upper))


def _least(of: Callable[[float], float], low: float, high: float) -> float:
    """The least value of a function with one valley between two points, by golden sections."""
    inner = [high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)]
    values = [of(inner[0]), of(inner[1])]
    for _ in range(_SECTIONS):
        if values[0] < values[1]:
            high, inner = inner[1], [inner[1] - _GOLDEN * (inner[1] - low), inner[0]]
            values = [of(inner[0]), values[0]]
        else:
            low, inner = inner[0], [inner[1], inner[0] + _GOLDEN * (high - inner[0])]
            values = [values[1], of(inner[1])]
    return min(values)


def _root(of: Callable[[float], float], low: float, high: float) -> float:
    """Where a function that is positive at the one of two points and negative at the other is zero
    between them: false position, the end that stays counting half (Dowell & Jarratt 1971).
    """
    left, right = (low, of(low)), (high, of(high))
    for _ in range(_TRIES):
        x = right[0] - right[1] * (right[0] - left[0]) / (right[1] - left[1])
        y = of(x)
        if abs(x - right[0]) < _FINE or y == 0.0:
            return float(x)
        left = right if y * right[1] < 0.0 else (left[0], 0.5 * left[1])
        right = x, y
    return right[0]


def _profile(
    task: Task, shape: Shape, cells: Cells, window: Window, soft: bool
) -> tuple[np.ndarray, np.ndarray]:
    """(deadbands [V], −2 log likelihood of each above the least), about the likely ones."""
    low, high = window.low, window.high
    grid = rise = np.empty(0)
    for _ in range(5):
        grid = np.linspace(low, high, 15)
        splines = (shape.spline(u, soft) for u in grid.tolist())
        value = likelihoods(shape, splines, cells)
        rise = value - value.min()
        near = np.flatnonzero(rise < 14.0)
        if near.size > 7 or high - low < 1e-3 * task.levels[-1]:
            break
        low, high = grid[max(near[0] - 1, 0)], grid[min(near[-1] + 1, 14)]
    return grid, rise


def _lowest(x: np.ndarray, y: np.ndarray, at: int) -> float:
    """Where the parabola through the least of y and its neighbours is least; the end of the grid if
    that is least.
    """
    if not 0 < at < x.size - 1:
        return float(x[at])
    left, right = y[at - 1] - y[at], y[at + 1] - y[at]
    return float(x[at] + 0.5 * (x[1] - x[0]) * (left - right) / max(left + right, 1e-300))


def _crossing(x: np.ndarray, rise: np.ndarray, level: float) -> float:
    """The first x along the array where ``rise`` reaches ``level``; its last x if it does not."""
    above = np.flatnonzero(rise > level)
    if not above.size:
        return float(x[-1])
    j = above[0]
    return float(x[j - 1] + (x[j] - x[j - 1]) * (level - rise[j - 1]) / (rise[j] - rise[j - 1]))
