"""The steps of the fit of a flow map: smoothing, bends, cells that stand alone, least squares.

Each takes the cells and the shape so far, and gives the next."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import numpy as np

from ehbench.flow_maps import banded
from ehbench.flow_maps.cells import OUTLIER_SIGMAS, Cells
from ehbench.flow_maps.readings import Task
from ehbench.flow_maps.spline import (
    Axis,
    Spline,
    cholesky,
)

# what must be gained in −2 log likelihood for a curve over the drop that bends more at low drops,
# for one that bends sharply somewhere, and for taking a cell for one that stands alone: a sound
# one out of some hundreds gains less
_GRADED_GAIN, _BEND_GAIN, _LONE_GAIN = 4.0, 45.0, 30.0
_MOST_LONE = 0.05
# degrees of freedom of repeats from which on they tell the noise to some 20 %
_REPEATS = 12
_COARSE = (-9.0, -7.0, -5.0, -3.0, -1.0)
# splines that are kept, and those of which what was found is kept: about what one turn asks for
_SPLINES, _LIKELIHOODS = 256, 512

Normal = tuple[np.ndarray, np.ndarray]
Point = tuple[float, float]
Solved = tuple[np.ndarray, float, np.ndarray]  # coefficients, likelihood, which are tied


@dataclass(frozen=True, eq=False)
class Shape:
    """What a spline and its penalties hang on: the deadband [V], the commands [V] ``above`` it, the
    axis along the root of the drop, the penalties along opening and root, the openings [V] where it
    may bend sharply, the opening [V] up to which its flow grows."""

    deadband: float
    above: np.ndarray
    along_s: Axis
    smoothing: np.ndarray
    kinks: tuple[float, ...] = ()
    rising: float = np.inf

    def spline(self, deadband: float | None = None, soft: bool = False) -> KeptSpline:
        start = self.deadband if deadband is None else deadband
        above = tuple(self.above.tolist())
        return _spline((start, above, self.along_s, soft, self.kinks, self.rising))


Asked = tuple[float, tuple[float, ...], Axis, bool, tuple[float, ...], float]


class KeptSpline(Spline):
    """A spline that says by what it was ``asked`` for."""

    asked: Asked


@lru_cache(_SPLINES)
def _spline(requested: Asked) -> KeptSpline:
    """The spline of these arguments: one look after another asks for the same."""
    deadband, above, along_s, soft, kinks, rising = requested
    built = KeptSpline(deadband, np.array(above), along_s, soft, kinks, rising)
    built.asked = requested
    return built


@lru_cache(_LIKELIHOODS)
def _known(requested: Asked, cells: Cells) -> tuple[dict[Point, float], dict[Point, Solved]]:
    """What has been found of a spline on some cells, for each pair of penalties: −2 log likelihood,
    and what `solve` gives. A fit asks twice of one in five.
    """
    return {}, {}


@dataclass(frozen=True, eq=False)
class Solution:
    """A fitted spline: coefficients, lower band of the Cholesky factor of the penalised normal
    matrix, effective number of parameters, the cells it was judged on and which of them stand
    alone.

    ``lack`` is the variance of the cells' means about the map over what the noise explains, at
    least 1, and ``widening`` the same without the cells that stand alone: these widen the intervals
    about themselves only. ``flow``: scaled, at each reading."""

    spline: Spline
    coefficients: np.ndarray
    factor: np.ndarray
    parameters: float
    cells: Cells
    lone: np.ndarray
    lack: float
    widening: float
    flow: np.ndarray

    def at(self, u: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Scaled flow at openings [V] and scaled roots, shape (points,)."""
        return self.spline.design(u, s) @ self.coefficients

    def variance(self, design: np.ndarray) -> np.ndarray:
        """Variance of the scaled flow at rows of a design, from the noise alone."""
        return banded.half_squares(self.factor, design)


def normal_equations(spline: Spline, cells: Cells) -> Normal:
    """(lower band of the normal matrix, right side) of the cells' means."""
    return spline.normal(cells.u, cells.s, cells.weight, cells.y)


def deviance(misfit: float, cells: Cells) -> float:
    """−2 log likelihood of a penalised misfit; its scale is free, but where repeats tell the
    noise not below that.

    Were it free below, a map through every cell could pass for one without noise. Without
    repeats the noise of the last turn counts as much as a quarter of the cells, for the same
    reason."""
    free = cells.weighed - 1
    scale = misfit / free
    if cells.replicates >= _REPEATS and scale < 1.0:
        return misfit - free
    if not cells.replicates:
        scale = (scale + 0.25) / 1.25
    return free * np.log(scale)


def likeliest_smoothing(
    shape: Shape, cells: Cells, coarse: bool = True, normal: Normal | None = None
) -> tuple[Shape, float]:
    """(shape with penalties by restricted maximum likelihood, −2 log of it), the scale of the noise
    left free (Wood 2011).

    Points come from a fixed lattice of decadic logarithms, so that the last bits of a linear
    algebra library do not move the result.

    Args:
        coarse: begins with a look over all penalties, else about the shape's own.
    """
    score, now, unit = _score(shape, cells, normal)
    first = [(a, b) for a in _COARSE for b in _COARSE] if coarse else [now]
    best = min(first, key=score)
    for step in (1.0, 0.5, 0.25):
        for _ in range(5):
            a, b = best
            around = [(a + i * step, b + j * step) for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))]
            better = min((p for p in around if all(-12 <= x <= 0 for x in p)), key=score)
            if score(better) >= score(best):
                break
            best = better
    return replace(shape, smoothing=10.0 ** np.array(best) * unit), score(best)


def roughly_smoothed(
    shape: Shape, cells: Cells, along: int, normal: Normal | None = None
) -> tuple[Shape, float]:
    """`likeliest_smoothing` by the penalty along the opening (0) or the root (1) alone, to two
    decades.
    """
    score, now, unit = _score(shape, cells, normal)
    points = [(x, now[1]) if along == 0 else (now[0], x) for x in _COARSE]
    begin = int(np.argmin(np.abs(np.array(_COARSE) - now[along])))
    best = points[valley(lambda i: score(points[i]), len(points), begin)]
    return replace(shape, smoothing=10.0 ** np.array(best) * unit), score(best)


def valley(of: Callable[[int], float], size: int, begin: int) -> int:
    """The index of the least of a row of values with one valley: walks down from ``begin``."""
    known, at = cache(of), begin
    while True:
        additional = (i for i in (at - 1, at + 1) if 0 <= i < size)
        better = min(additional, key=known, default=at)
        if known(better) >= known(at):
            return at
        at = better


def _score(
    shape: Shape, cells: Cells, normal: Normal | None
) -> tuple[Callable[[Point], float], Point, float]:
    """(−2 log likelihood over decadic logarithms of the penalties, the shape's own on the lattice,
    the unit of penalties).
    """
    spline = shape.spline()
    total, unit = cells.total, float(cells.weight.sum())
    known, _ = _known(spline.asked, cells)
    built: list[Normal] = [] if normal is None else [normal]

    def score(point: Point) -> float:
        if point not in known:
            if not built:
                built.append(normal_equations(spline, cells))
            known[point] = found(point, *built[0])
        return known[point]

    def found(point: Point, band: np.ndarray, right: np.ndarray) -> float:
        try:
            smoothing = 10.0 ** np.array(point) * unit
            _, gain, determinant = spline.free(band, right, smoothing, whole=False)
        except np.linalg.LinAlgError:  # too little smoothing for the readings to tell a map
            return np.inf
        return deviance(max(total - gain, 1e-12 * total), cells) + determinant

    now = np.clip(np.round(4 * np.log10(shape.smoothing / unit)) / 4, -12, 0)
    return score, (float(now[0]), float(now[1])), unit


def bend(shape: Shape, cells: Cells) -> Shape:
    """Lets the map bend more towards low drops, and sharply at one drop, where that makes the
    readings likelier.
    """
    if shape.along_s.size == 1:
        return shape
    normal = normal_equations(shape.spline(), cells)  # the same for all
    options = []
    for power in (0.0, 1.0, 2.0, 4.0):
        graded = replace(shape, along_s=shape.along_s.graded(power))
        graded, value = likeliest_smoothing(graded, cells, normal=normal)
        options.append((value + _GRADED_GAIN * (power > 0), graded))
    plain, straight = min(options, key=lambda item: item[0])
    kinks = (
        replace(straight, along_s=straight.along_s.bent(k))
        for k in range(1, straight.along_s.breaks.size - 1)
    )
    bent = [roughly_smoothed(kink, cells, 1, normal) for kink in kinks]
    sharp, value = likeliest_smoothing(min(bent, key=lambda item: item[1])[0], cells, normal=normal)
    return straight if value > plain - _BEND_GAIN else sharp


def solve(shape: Shape, spline: KeptSpline, cells: Cells, near: np.ndarray | None = None) -> Solved:
    """(coefficients, −2 log likelihood of the spline's deadband with the scale of the noise left
    free, which coefficients are tied to those before).

    Args:
        near: which are tied for a spline that differs little, as a first guess.
    """
    _, known = _known(spline.asked, cells)
    if (point := tuple(shape.smoothing.tolist())) in known:
        return known[point]
    band, right = normal_equations(spline, cells)
    c, determinant, tied = spline.solve(band, right, shape.smoothing, near)
    misfit = cells.total + float(
        c @ (banded.times(spline.penalised(band, shape.smoothing), c) - 2 * right)
    )
    known[point] = c, deviance(max(misfit, 1e-12), cells) + determinant, tied
    return known[point]


def likelihoods(shape: Shape, splines: Iterable[KeptSpline], cells: Cells) -> np.ndarray:
    """−2 log likelihood of each of some splines, those beside each other of one size."""
    values, near = [], None
    for spline in splines:
        _, value, near = solve(shape, spline, cells, near)
        values.append(value)
    return np.array(values)


def judge(task: Task, shape: Shape, cells: Cells, lone: np.ndarray) -> Solution:
    """The fit to the cells but those that stand alone, and how well it meets all."""
    spline, used = shape.spline(), cells.without(lone)
    band, right = normal_equations(spline, used)
    factor = cholesky(spline.penalised(band, shape.smoothing))
    coefficients, *_ = spline.solve(band, right, shape.smoothing)
    parameters = banded.explained(factor, band)
    meant = spline.design(cells.u, cells.s) @ coefficients

    def lack(judged: Cells) -> float:
        misfit = float(judged.weight @ (judged.y - meant) ** 2)
        return max(1.0, misfit / max(judged.weighed - parameters, 1.0))

    return Solution(
        spline=spline,
        coefficients=coefficients,
        factor=factor,
        parameters=parameters,
        cells=cells,
        lone=lone,
        lack=lack(cells),
        widening=lack(used),
        flow=spline.design(task.readings.u, task.s) @ coefficients,
    )


def distances(
    task: Task, solution: Solution, noise: np.ndarray, keep: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(distance of each reading from the map in standard deviations of that distance, leverage).

    A reading in the fit draws the map to itself, one left out stands against the map's own error.

    Args:
        noise: variance of each scaled reading.
    """
    r = task.readings
    design = solution.spline.design(r.u, task.s) * (r.u > solution.spline.deadband)[:, None]
    error = solution.variance(design)
    inside = keep & ~solution.lone[r.cell]
    spread = np.where(inside, np.maximum(noise - error, 0.1 * noise), noise + error)
    return (solution.cells.heard - solution.flow) / np.sqrt(spread), error / noise


def lone_cells(task: Task, shape: Shape, cells: Cells) -> np.ndarray:
    """Which cells stand alone: repeats back them, and no map smooth enough for the others passes
    near, shape (cells,).

    One such cell would free the whole map to bend, which then goes near it and shows no lack of
    fit. A cell stands alone if without it the others, smoothed anew, are likelier by _LONE_GAIN: a
    shift of its own is worth that much. The cell that lies farthest off by the others' account
    (externally studentised) is tried first."""
    lone = np.zeros(cells.weight.size, bool)
    maximum = max(3, int(_MOST_LONE * cells.weighed))
    shape, value = likeliest_smoothing(shape, cells)
    while lone.sum() < maximum:
        far = _studentised(task, shape, cells, lone)
        worst = int(np.argmax(far))
        if far[worst] < OUTLIER_SIGMAS:
            break
        lone[worst] = True
        shape, without = likeliest_smoothing(shape, cells.without(lone))
        if value - without < _LONE_GAIN:
            lone[worst] = False
            break
        value = without
    return lone


def _studentised(task: Task, shape: Shape, cells: Cells, lone: np.ndarray) -> np.ndarray:
    """Distance of each backed cell from the map that the others make, in standard errors."""
    result = judge(task, shape, cells, lone)
    used = (cells.weight > 0) & (cells.u > shape.deadband) & (cells.count > 1) & ~lone
    design = result.spline.design(cells.u, cells.s)
    own = np.minimum(result.variance(design) * cells.weight, 0.999)  # a cell's part in its own fit
    miss = np.abs(cells.y - design @ result.coefficients) * np.sqrt(cells.weight / (1.0 - own))
    return np.where(used, miss / np.sqrt(result.widening), 0.0)
