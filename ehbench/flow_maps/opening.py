"""How the flow goes with the opening where that is no smooth rise: kinks between commands, and an
opening above which the flow falls."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from ehbench.flow_maps.cells import Cells
from ehbench.flow_maps.deadband import find_deadband, start_deadband
from ehbench.flow_maps.readings import Task
from ehbench.flow_maps.spline import SPANS_U
from ehbench.flow_maps.steps import (
    Shape,
    deviance,
    likeliest_smoothing,
    likelihoods,
    normal_equations,
    roughly_smoothed,
    solve,
    valley,
)

# what must be gained in −2 log likelihood: by a kink anywhere between two commands for a closer
# look and to be taken, by a flow that falls
_LOOK_GAIN, _KINK_GAIN, _FALL_GAIN = -5.0, 24.0, 45.0
_MOST_KINKS, _IN_GAP = 3, 8
# commands that pass flow, from which on a kink can be told from a bend
_LEAST_COMMANDS = 7
# share of the commands' range below which two of them, such as hysteresis sets beside each other,
# leave no room for a kink: the spline would be too stiff there for its arithmetic
_LEAST_GAP = 0.01
# −2 log likelihood by which openings may differ and still count as where the flow is largest
_LEVEL_95 = 3.841


@dataclass(frozen=True)
class Kink:
    """An opening [V] where the flow's slope jumps, with standard error and 95 % interval."""

    value: float
    std: float
    interval: tuple[float, float]


def let_fall(shape: Shape, cells: Cells) -> Shape:
    """Lets the flow fall above an opening, where the readings are far likelier so."""
    spline = replace(shape, rising=np.inf).spline()
    band, right = normal_equations(spline, cells)
    _, gain, determinant = spline.free(band, right, shape.smoothing, whole=False)
    total = cells.total
    minimum = deviance(max(total - gain, 1e-12), cells) + determinant
    risen = solve(replace(shape, rising=np.inf), spline, cells)[1]
    if risen - minimum < _FALL_GAIN:
        return replace(shape, rising=np.inf)
    breaks = spline.deadband + spline.along_u.breaks * (spline.top - spline.deadband)
    options = [replace(shape, rising=float(volts)) for volts in breaks[1:-1]]
    values = np.array([solve(option, option.spline(), cells)[1] for option in options])
    if risen - values.min() < _FALL_GAIN:
        return replace(shape, rising=np.inf)
    return options[int(np.flatnonzero(values < values.min() + _LEVEL_95)[-1])]


def find_kinks(
    task: Task, shape: Shape, cells: Cells, lack: float
) -> tuple[Shape, tuple[Kink, ...]]:
    """(shape that bends sharply at some openings, where these are), where the likelihood says so.

    A kink hides between two commands; where it is follows from how the flow goes on either side,
    and so does the deadband, which is looked for anew with each kink."""
    kinks: tuple[Kink, ...] = ()
    if not _LEAST_COMMANDS <= shape.above.size <= 2 * SPANS_U:
        return shape, kinks
    plain, value = _settled(task, replace(shape, rising=np.inf), cells, lack)
    while len(kinks) < _MOST_KINKS:
        options = [_bent(plain, cells, gap) for gap in _gaps(shape.above, kinks)]
        best, score = min(options, key=lambda item: item[1])
        if value - score < _LOOK_GAIN:
            break
        bent, _ = _settled(task, best, cells, lack)
        result = _place(bent, cells)
        bent, score = _settled(task, _with(plain, result.value), cells, lack)
        if value - score < _KINK_GAIN:
            break
        plain, value = bent, score
        kinks = (*kinks, result)
    if not kinks:
        return shape, kinks
    return let_fall(plain, cells), tuple(sorted(kinks, key=lambda kink: kink.value))


def _settled(task: Task, shape: Shape, cells: Cells, lack: float) -> tuple[Shape, float]:
    """(shape with its deadband and smoothing, −2 log likelihood)."""
    shape, _ = likeliest_smoothing(start_deadband(task, shape, cells, lack), cells)
    _, shape = find_deadband(task, shape, cells, lack)
    return likeliest_smoothing(shape, cells, coarse=False)


def _gaps(above: np.ndarray, kinks: tuple[Kink, ...]) -> list[np.ndarray]:
    """Openings [V] to try a kink at, some in each gap between two commands that has none yet and
    two commands or more on either side.
    """
    taken = {int(np.searchsorted(above, kink.value)) for kink in kinks}
    shares = np.arange(1, _IN_GAP + 1) / (_IN_GAP + 1)
    return [
        above[k - 1] + shares * (above[k] - above[k - 1])
        for k in range(2, above.size - 1)
        if k not in taken and _roomy(above)[k]
    ]


def _bent(plain: Shape, cells: Cells, gap: np.ndarray) -> tuple[Shape, float]:
    """(shape with a kink more, −2 log likelihood) at the likeliest of the openings [V] of a gap."""

    @cache
    def bent(i: int) -> tuple[Shape, float]:
        return roughly_smoothed(_with(plain, float(gap[i])), cells, 0)

    return bent(valley(lambda i: bent(i)[1], gap.size, gap.size // 2))


def _roomy(above: np.ndarray) -> np.ndarray:
    """Whether the gap below each command is wide enough for a kink; shape (commands,)."""
    return np.diff(above, prepend=-np.inf) >= _LEAST_GAP * (above[-1] - above[0])


def _with(shape: Shape, kink: float) -> Shape:
    return replace(shape, kinks=(*shape.kinks, kink))


def _place(shape: Shape, cells: Cells) -> Kink:
    """Where the last kink of the shape is, by its profile likelihood over the gap it was found in
    and the ones beside.
    """
    *others, middle = shape.kinks
    k = int(np.searchsorted(shape.above, middle))
    low, high = shape.above[max(k - 2, 0)], shape.above[min(k + 1, shape.above.size - 1)]
    grid = np.linspace(low, high, 62)[1:-1]
    step = float(grid[1] - grid[0])
    grid = grid[_roomy(shape.above)[np.searchsorted(shape.above, grid)]]
    near = [
        np.searchsorted(shape.above, other) == np.searchsorted(shape.above, grid)
        for other in others
    ]
    grid = grid[~np.any(near, axis=0)] if near else grid
    moved = (replace(shape, kinks=(*others, volts)).spline() for volts in grid.tolist())
    value = likelihoods(shape, moved, cells)
    rise = value - value.min()
    weight = np.exp(-0.5 * rise)
    best = float(grid[np.argmin(rise)])
    std = float(np.sqrt(weight @ (grid - best) ** 2 / weight.sum() + step**2 / 12))
    inside = grid[rise <= _LEVEL_95]
    interval = (round(float(inside[0]) - step, 4), round(float(inside[-1]) + step, 4))
    return Kink(round(best, 4), std, interval)
