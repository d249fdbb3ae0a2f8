"""The shape of a flow map: smoothing, bends in the drop, deadband, kinks and fall in the opening,
each by its likelihood given the cells' means."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from typing import Any, cast

import numpy as np

from ehbench.flow_maps.readings import SETTINGS as READING
from ehbench.flow_maps.readings import Cells, Readings
from ehbench.flow_maps.spline import SETTINGS as SPLINE
from ehbench.flow_maps.spline import Axis, Spline, full
from ehbench.vocabulary import InsufficientData, message, setting


@dataclass(frozen=True)
class ShapeSettings:
    """Gains in −2 log likelihood, and other numbers, by which a map gets its shape."""

    graded_gain: float = setting(4.0, "", "a curve that bends more at low drops", "two deviations")
    bend_gain: float = setting(45.0, "", "a sharp bend at a drop", "smooth laws gain less")
    lone_gain: float = setting(30.0, "", "a map without a lone cell", "chance gains less")
    lone: float = setting(0.05, "", "largest share of cells that stand alone", "slips are rare")
    kink_gain: float = setting(24.0, "", "a kink between two commands", "smooth openings: less")
    look_gain: float = setting(-5.0, "", "gain of a rough kink worth a closer look", "kink_gain")
    fall_gain: float = setting(45.0, "", "a flow that falls above an opening", "rising: less")
    kinks: int = setting(3, "", "largest number of kinks", "lands of a spool")
    kink_commands: int = setting(7, "", "open commands that show a kink", "two on each side")
    kink_gap: float = setting(0.01, "", "gap of a kink, share of the range", "its digits")
    repeats: int = setting(12, "", "degrees of freedom that measure the noise", "to some 20 %")
    level_95: float = setting(3.841, "", "rise of −2 log likelihood at 95 %", "χ², one number")
    level_99: float = setting(6.635, "", "rise of −2 log likelihood at 99 %", "χ², one number")
    level_999: float = setting(10.83, "", "rise of −2 log likelihood at 99.9 %", "χ², one number")
    shut: float = setting(1e-3, "", "flow that may be none, of the rated", "meters")
    shut_sure: float = setting(4.0, "", "standard deviations of a flow that is none", "chance")
    width: float = setting(5e-4, "", "half interval of a deadband, of the range", "drivers")


SETTINGS = ShapeSettings()
_COARSE = (-9.0, -7.0, -5.0, -3.0, -1.0)

Penalties = tuple[float, float]
Solved = tuple[np.ndarray, float, np.ndarray]  # coefficients, −2 log likelihood, which are tied


@dataclass(frozen=True, eq=False)
class Shape:
    """What a spline and its penalties depend on: deadband [V], commands [V] ``above`` it, axis
    along the root of the drop, penalties, openings [V] of ``kinks``, opening [V] up to which the
    flow grows."""

    deadband: float
    above: np.ndarray
    along_s: Axis
    smoothing: np.ndarray
    kinks: tuple[float, ...] = ()
    rising: float = np.inf

    def spline(self, deadband: float | None = None, soft: bool = False) -> Spline:
        start = self.deadband if deadband is None else deadband
        above = tuple(self.above.tolist())
        return _spline(start, above, self.along_s, soft, self.kinks, self.rising)


@lru_cache(256)
def _spline(start: float, above: tuple[float, ...], along_s: Axis, *rest: Any) -> Spline:
    """The spline of these arguments: one search after another asks for the same."""
    return Spline(start, np.array(above), along_s, *rest)


class Regression:
    """The penalised least squares of a spline to the means of cells, for any penalties."""

    def __init__(self, spline: Spline, cells: Cells) -> None:
        self.spline, self.cells = spline, cells
        self.factors = spline.factors(cells.u, cells.s)
        self.band, self.right = spline.normal(self.factors, cells.weight, cells.y)
        self.unit, self.total = float(cells.weight.sum()), float(cells.weight @ cells.y**2)
        self._scores: dict[Penalties, float] = {}
        self._solved: dict[Penalties, Solved] = {}

    def score(self, point: Penalties) -> float:
        """−2 log likelihood of the penalties 10**point·unit, without the constraint."""
        if point not in self._scores:
            smoothing = 10.0 ** np.array(point) * self.unit
            try:
                self._scores[point] = self.free(smoothing)
            except np.linalg.LinAlgError:
                self._scores[point] = np.inf
        return self._scores[point]

    def free(self, smoothing: np.ndarray) -> float:
        """−2 log likelihood without the constraint.

        Raises:
            LinAlgError: too little smoothing for the readings to make a map.
        """
        free, determinant = self.spline.free(self.band, self.right, smoothing)
        return self._deviance(free, smoothing) + determinant

    def solve(self, smoothing: np.ndarray, near: np.ndarray | None = None) -> Solved:
        """(coefficients, −2 log likelihood, which coefficients are tied to those before).

        Args:
            near: which are tied for a spline that differs little, as a first guess.
        """
        point = tuple(smoothing.tolist())
        if point not in self._solved:
            result, determinant, tied = self.spline.solve(self.band, self.right, smoothing, near)
            self._solved[point] = result, self._deviance(result, smoothing) + determinant, tied
        return self._solved[point]

    def _deviance(self, coefficients: np.ndarray, smoothing: np.ndarray) -> float:
        """−2 log likelihood of a penalised misfit; its scale is free, but where repeats measure the
        noise not below that.

        Were it free below, a map through every cell could pass for one without noise. Without
        repeats the noise of the last turn counts as much as a quarter of the cells, for the same
        reason."""
        cells, (of_u, of_s) = self.cells, self.factors
        table = self.spline.table(coefficients)
        misfit = float(cells.weight @ (cells.y - np.sum((of_u @ table) * of_s, axis=1)) ** 2)
        misfit += self.spline.roughness(coefficients, smoothing)
        misfit, free = max(misfit, 1e-12 * self.total), cells.weighed - 1
        scale = misfit / free
        if cells.replicates >= SETTINGS.repeats and scale < 1.0:
            return misfit - free
        return free * float(np.log(scale if cells.replicates else (scale + 0.25) / 1.25))


regression = lru_cache(512)(Regression)


def likelihoods(shape: Shape, splines: Iterable[Spline], cells: Cells) -> np.ndarray:
    """−2 log likelihood of each of some splines, those next to each other of one size."""
    values, near = [], None
    for spline in splines:
        _, value, near = regression(spline, cells).solve(shape.smoothing, near)
        values.append(value)
    return np.array(values)


def _lattice(shape: Shape, cells: Cells) -> tuple[Regression, Penalties]:
    """(the regression of a shape, its penalties as a point on the lattice of logarithms)."""
    fit = regression(shape.spline(), cells)
    now = np.clip(np.round(4 * np.log10(shape.smoothing / fit.unit)) / 4, -12, 0)
    return fit, (float(now[0]), float(now[1]))


def likeliest_smoothing(shape: Shape, cells: Cells, coarse: bool = True) -> tuple[Shape, float]:
    """(shape with penalties by restricted maximum likelihood, −2 log of it), the scale of the noise
    left free (Wood 2011).

    Points come from a fixed lattice, so that the last bits of a linear algebra library do not move
    the result.

    Args:
        coarse: begins with a look over all penalties, else about the shape's own.
    """
    fit, now = _lattice(shape, cells)
    first = [(a, b) for a in _COARSE for b in _COARSE] if coarse else [now]
    best = min(first, key=fit.score)
    for step in (1.0, 0.5, 0.25):
        for _ in range(5):
            a, b = best
            around = [(a + i * step, b + j * step) for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))]
            better = min((p for p in around if all(-12 <= x <= 0 for x in p)), key=fit.score)
            if fit.score(better) >= fit.score(best):
                break
            best = better
    return replace(shape, smoothing=10.0 ** np.array(best) * fit.unit), fit.score(best)


def roughly_smoothed(shape: Shape, cells: Cells, along: int) -> tuple[Shape, float]:
    """`likeliest_smoothing` along the opening (0) or the root (1) alone, to two decades."""
    fit, now = _lattice(shape, cells)
    points = [(x, now[1]) if along == 0 else (now[0], x) for x in _COARSE]
    begin = int(np.argmin(np.abs(np.array(_COARSE) - now[along])))
    best = points[valley(lambda i: fit.score(points[i]), len(points), begin)]
    return replace(shape, smoothing=10.0 ** np.array(best) * fit.unit), fit.score(best)


def valley(of: Callable[[int], float], size: int, begin: int) -> int:
    """The index of the least of a row of values with one valley: walks down from ``begin``."""
    known, at = cache(of), begin
    while True:
        better = min((i for i in (at - 1, at + 1) if 0 <= i < size), key=known, default=at)
        if known(better) >= known(at):
            return at
        at = better


def bend(shape: Shape, cells: Cells) -> Shape:
    """Lets the map bend more towards low drops, and sharply at a drop, where that is likelier."""
    if shape.along_s.size == 1:
        return shape
    options = []
    for power in (0.0, 1.0, 2.0, 4.0):
        graded = replace(shape, along_s=shape.along_s.graded(power))
        graded, value = likeliest_smoothing(graded, cells)
        options.append((value + SETTINGS.graded_gain * (power > 0), graded))
    plain, straight = min(options, key=lambda item: item[0])
    axes = map(straight.along_s.bent, range(1, straight.along_s.breaks.size - 1))
    bent = [roughly_smoothed(replace(straight, along_s=axis), cells, 1) for axis in axes]
    sharp, value = likeliest_smoothing(min(bent, key=lambda item: item[1])[0], cells)
    return straight if value > plain - SETTINGS.bend_gain else sharp


@dataclass(frozen=True, eq=False)
class Solution:
    """A fitted spline: coefficients, inverse of the penalised normal matrix, effective number of
    parameters, the cells it was judged on and which of them stand alone.

    ``lack`` is the variance of the cells' means about the map over what the noise explains, at
    least 1, and ``widening`` the same without the cells that stand alone: these widen the intervals
    about themselves only. ``flow``: scaled, at each reading."""

    spline: Spline
    coefficients: np.ndarray
    covariance: np.ndarray
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
        return np.sum((design @ self.covariance) * design, axis=1)


def judge(readings: Readings, shape: Shape, cells: Cells, lone: np.ndarray) -> Solution:
    """The fit to the cells but those that stand alone, and how well it meets all."""
    used = cells.without(lone)
    fit = regression(shape.spline(), used)
    coefficients, *_ = fit.solve(shape.smoothing)
    covariance = np.linalg.inv(full(fit.spline.penalised(fit.band, shape.smoothing)))
    parameters = float(np.sum(covariance * full(fit.band)))
    predicted = fit.spline.design(cells.u, cells.s) @ coefficients
    flow = fit.spline.design(readings.u, readings.s) @ coefficients

    def lack(judged: Cells) -> float:
        misfit = float(judged.weight @ (judged.y - predicted) ** 2)
        return max(1.0, misfit / max(judged.weighed - parameters, 1.0))

    return Solution(
        spline=fit.spline,
        coefficients=coefficients,
        covariance=covariance,
        parameters=parameters,
        cells=replace(cells, heard=readings.heard(flow)),
        lone=lone,
        lack=lack(cells),
        widening=lack(used),
        flow=flow,
    )


def lone_cells(readings: Readings, shape: Shape, cells: Cells) -> np.ndarray:
    """Which cells stand alone: repeats support them, and no map smooth enough for the others passes
    near, shape (cells,).

    One such cell would free the whole map to bend, which then goes near it and shows no lack of
    fit. A cell stands alone if without it the others, smoothed anew, are much likelier. The cell
    that lies farthest off by the others' account (externally studentised) is tried first."""
    lone = np.zeros(cells.weight.size, bool)
    shape, value = likeliest_smoothing(shape, cells)
    while lone.sum() < max(3, int(SETTINGS.lone * cells.weighed)):
        result = judge(readings, shape, cells, lone)
        design = result.spline.design(cells.u, cells.s)
        # a cell's part in its own fit
        leverage = np.minimum(result.variance(design) * cells.weight, 0.999)
        miss = np.abs(cells.y - design @ result.coefficients)
        far = miss * np.sqrt(cells.weight / (1.0 - leverage) / result.widening)
        backed = (cells.u > shape.deadband) & (cells.count > 1) & ~lone
        worst = int(np.argmax(np.where(backed, far, 0.0)))
        if not backed[worst] or far[worst] < READING.outlier:
            break
        lone[worst] = True
        shape, without = likeliest_smoothing(shape, cells.without(lone))
        if value - without < SETTINGS.lone_gain:
            lone[worst] = False
            break
        value = without
    return lone


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
    """A deadband [V] with standard error and 95 % interval; ``at_bound``: it may be 0 V;
    ``smoothing``: the penalties under which these were found."""

    value: float = 0.0
    std: float = 0.0
    interval: tuple[float, float] = (0.0, 0.0)
    at_bound: bool = True
    smoothing: np.ndarray = field(default_factory=lambda: np.ones(2), compare=False)


def window_of(readings: Readings, cells: Cells, lack: float) -> Window:
    """The range of the deadband: below the first command that surely passes flow, as all above it
    do."""
    levels, of = readings.levels, readings.cell_level
    total = np.maximum(np.bincount(of, cells.weight), 1e-300)
    mean = np.bincount(of, cells.weight * cells.y) / total
    # a command is shut if its flow may be none: what counts is the noise of no flow
    used = cells.weight > 0
    quiet = np.max(cells.weight[used] / np.maximum(cells.count[used], 1), initial=0.0)
    count = np.bincount(of, np.where(used, cells.count, 0.0))
    sure = mean * np.sqrt(count * quiet / lack) > SETTINGS.shut_sure
    shut = np.flatnonzero(~sure | (mean <= SETTINGS.shut))
    k = int(shut[-1]) + 1 if shut.size else 0
    if levels.size - k < 3:
        counts = {"open": levels.size - k, "all": levels.size}
        fields = {**counts, "shut": readings.show.volts(levels[k - 1])}
        raise InsufficientData(message("flow_maps.mostly_shut", map=readings.who, **fields))
    below = float(levels[k - 1]) if k else 0.0
    seen = np.flatnonzero(np.bincount(of, cells.weight)[: max(k - 1, 0)])
    return Window(
        low=float(levels[seen[-2:][0]]) if seen.size else 0.0,
        high=float(levels[k]) - 0.02 * (float(levels[k]) - below),
        opens=k,
        bracket=(below, float(levels[k])),
        flows_at_lowest=k == 0,
    )


def start_deadband(readings: Readings, shape: Shape, cells: Cells, lack: float) -> Shape:
    """The likeliest of a few deadbands, each with its smoothing."""
    window = window_of(readings, cells, lack)
    above = readings.levels[window.opens :]
    options = [
        roughly_smoothed(replace(shape, deadband=u, above=above), cells, 0)
        for u in np.linspace(window.low, window.high, 13)
    ]
    return min(options, key=lambda item: item[1])[0]


def find_deadband(
    readings: Readings, shape: Shape, cells: Cells, lack: float
) -> tuple[Deadband, Shape]:
    """(deadband by its profile likelihood, if the flow starts with a kink; the shape with it)."""
    window = window_of(readings, cells, lack)
    shape = replace(shape, deadband=0.0, above=readings.levels[window.opens :])
    if window.high <= window.low:
        return Deadband(), shape
    narrowest = SETTINGS.width * float(readings.levels[-1])
    grid, rise = profile_deadband(readings, shape, cells, window)
    best = int(np.argmin(rise))
    value = float(grid[best])
    if 0 < best < grid.size - 1:  # of the parabola through the lowest and its neighbours
        left, right = rise[best - 1] - rise[best], rise[best + 1] - rise[best]
        value += float(0.5 * (grid[1] - grid[0]) * (left - right) / max(left + right, 1e-300))
    value = round(value, 4)
    weight = np.exp(-0.5 * rise)
    spread = weight @ (grid - value) ** 2 / weight.sum() + (grid[1] - grid[0]) ** 2 / 12
    # an extrapolation is worth less
    level = SETTINGS.level_999 if window.flows_at_lowest else SETTINGS.level_95
    ends = []
    for x, y in ((grid[best::-1], rise[best::-1]), (grid[best:], rise[best:])):
        j = int(np.argmax(y > level))  # 0 where it does not reach the level
        part = (level - y[j - 1]) / (y[j] - y[j - 1]) if j else 0.0
        ends.append(float(x[j - 1] + (x[j] - x[j - 1]) * part if j else x[-1]))
    lower, upper = ends
    low, high = max(min(lower, value - narrowest), 0.0), max(upper, value + narrowest)
    interval = (round(low, 4), round(high, 4))
    std, bound = float(np.sqrt(spread)), lower <= 0.0
    return Deadband(value, std, interval, bound, shape.smoothing), replace(shape, deadband=value)


def soften(
    readings: Readings, shape: Shape, cells: Cells, result: Deadband, window: Window
) -> Deadband:
    """Lowers the deadband's interval to where a flow with a soft start would begin, at 99 %.

    The spline may curve at will over the first commands that pass flow."""
    from scipy.optimize import brentq

    if window.high <= window.low:
        return result

    def begins(u: float) -> Solved:
        return regression(shape.spline(u, soft=True), cells).solve(shape.smoothing)

    # of the kink found: so near the next command that a span goes, likelihoods are of other splines
    edge = begins(result.value)[1] + SETTINGS.level_99
    grid = np.linspace(window.low, result.value, 15)
    rise = np.array([begins(u)[1] for u in grid.tolist()]) - edge
    beyond, soft = np.flatnonzero(rise > 0.0), float(grid[0])
    if beyond.size:
        ends = grid[beyond[-1] : beyond[-1] + 2].tolist()
        soft = cast(float, brentq(lambda u: begins(u)[1] - edge, *ends, xtol=1e-5))
    lower, upper = result.interval
    return replace(result, interval=(round(min(lower, soft), 4), upper))


def jumps(readings: Readings, shape: Shape, cells: Cells, window: Window) -> bool:
    """Whether the commands that pass flow, by themselves, have it pass at the highest of the others
    too, which surely passes none: then it does not grow from zero."""
    below, of = window.bracket[0], readings.cell_level
    if window.opens == 0:
        return False
    passing, shut = cells.without(of < window.opens), of == window.opens - 1
    options = []
    for start in np.linspace(window.low, below, 5).tolist():
        spline = shape.spline(start)
        options.append((*regression(spline, passing).solve(shape.smoothing)[:2], spline))
    coefficients, _, spline = min(options, key=lambda item: item[1])
    flow = spline.design(cells.u[shut], cells.s[shut]) @ coefficients
    return bool(cells.weight[shut] @ (flow * (flow - 2.0 * cells.y[shut])) > SETTINGS.kink_gain)


def profile_deadband(
    readings: Readings, shape: Shape, cells: Cells, window: Window
) -> tuple[np.ndarray, np.ndarray]:
    """(deadbands [V], −2 log likelihood of each above the least), about the likely ones."""
    low, high = window.low, window.high
    grid = rise = np.empty(0)
    for _ in range(5):
        grid = np.linspace(low, high, 15)
        value = likelihoods(shape, (shape.spline(u) for u in grid.tolist()), cells)
        rise = value - value.min()
        near = np.flatnonzero(rise < 14.0)
        if near.size > 7 or high - low < 1e-3 * readings.levels[-1]:
            break
        low, high = grid[max(near[0] - 1, 0)], grid[min(near[-1] + 1, 14)]
    return grid, rise


def let_fall(shape: Shape, cells: Cells) -> Shape:
    """Lets the flow fall above an opening, where the readings are far likelier so."""
    shape = replace(shape, rising=np.inf)
    spline = shape.spline()
    fit = regression(spline, cells)
    risen = fit.solve(shape.smoothing)[1]
    if risen - fit.free(shape.smoothing) < SETTINGS.fall_gain:
        return shape
    options = [replace(shape, rising=float(volts)) for volts in spline.volts[1:-1]]
    values = np.array(
        [regression(item.spline(), cells).solve(item.smoothing)[1] for item in options]
    )
    if risen - values.min() < SETTINGS.fall_gain:
        return shape
    return options[int(np.flatnonzero(values < values.min() + SETTINGS.level_95)[-1])]


@dataclass(frozen=True)
class Kink:
    """An opening [V] where the flow's slope jumps, with standard error and 95 % interval."""

    value: float
    std: float
    interval: tuple[float, float]


def find_kinks(
    readings: Readings, shape: Shape, cells: Cells, lack: float
) -> tuple[Shape, tuple[Kink, ...]]:
    """(shape that bends sharply at some openings, these), where the likelihood says so; the
    deadband is sought anew with each kink."""
    kinks: tuple[Kink, ...] = ()
    if not SETTINGS.kink_commands <= shape.above.size <= 2 * SPLINE.spans:
        return shape, kinks

    def settled(shape: Shape) -> tuple[Shape, float]:
        """(shape with its deadband and smoothing, −2 log likelihood)."""
        shape, _ = likeliest_smoothing(start_deadband(readings, shape, cells, lack), cells)
        _, shape = find_deadband(readings, shape, cells, lack)
        return likeliest_smoothing(shape, cells, coarse=False)

    plain, value = settled(replace(shape, rising=np.inf))
    while len(kinks) < SETTINGS.kinks:
        gaps = gaps_of(shape.above, kinks)
        best, score = min((_bent(plain, cells, gap) for gap in gaps), key=lambda item: item[1])
        if value - score < SETTINGS.look_gain:
            break
        result = _place(settled(best)[0], cells)
        bent, score = settled(_with_kink(plain, result.value))
        if value - score < SETTINGS.kink_gain:
            break
        plain, value, kinks = bent, score, (*kinks, result)
    if not kinks:
        return shape, kinks
    return let_fall(plain, cells), tuple(sorted(kinks, key=lambda kink: kink.value))


def gaps_of(above: np.ndarray, kinks: tuple[Kink, ...]) -> list[np.ndarray]:
    """Openings [V] to try a kink at, in each gap with two commands or more on either side."""
    taken = {int(np.searchsorted(above, kink.value)) for kink in kinks}
    shares = np.arange(1, 9) / 9.0
    return [
        above[k - 1] + shares * (above[k] - above[k - 1])
        for k in range(2, above.size - 1)
        if k not in taken and _roomy(above)[k]
    ]


def _bent(plain: Shape, cells: Cells, gap: np.ndarray) -> tuple[Shape, float]:
    """(shape with a kink more, −2 log likelihood) at the likeliest of the openings [V] of a gap."""

    @cache
    def bent(i: int) -> tuple[Shape, float]:
        return roughly_smoothed(_with_kink(plain, float(gap[i])), cells, 0)

    return bent(valley(lambda i: bent(i)[1], gap.size, gap.size // 2))


def _roomy(above: np.ndarray) -> np.ndarray:
    """Whether the gap below each command is wide enough for a kink; shape (commands,)."""
    return np.diff(above, prepend=-np.inf) >= SETTINGS.kink_gap * (above[-1] - above[0])


def _with_kink(shape: Shape, kink: float) -> Shape:
    return replace(shape, kinks=(*shape.kinks, kink))


def _place(shape: Shape, cells: Cells) -> Kink:
    """The last kink of the shape, by its profile likelihood over its gap and the two next to it."""
    *others, middle = shape.kinks
    k = int(np.searchsorted(shape.above, middle))
    low, high = shape.above[[k - 2, k + 1]]  # there are two commands on either side
    grid = np.linspace(low, high, 62)[1:-1]
    step, gap = float(grid[1] - grid[0]), np.searchsorted(shape.above, grid)
    free = _roomy(shape.above)[gap] & ~np.isin(gap, np.searchsorted(shape.above, others))
    grid = grid[free]
    moved = (replace(shape, kinks=(*others, volts)).spline() for volts in grid.tolist())
    value = likelihoods(shape, moved, cells)
    rise = value - value.min()
    weight = np.exp(-0.5 * rise)
    best = float(grid[np.argmin(rise)])
    std = float(np.sqrt(weight @ (grid - best) ** 2 / weight.sum() + step**2 / 12))
    inside = grid[rise <= SETTINGS.level_95]
    interval = (round(float(inside[0]) - step, 4), round(float(inside[-1]) + step, 4))
    return Kink(round(best, 4), std, interval)
