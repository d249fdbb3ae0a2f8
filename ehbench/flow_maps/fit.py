"""The fit of one flow map: noise, outliers, shape, leak and hysteresis from the readings.

The spline of ``physics.flow_map`` is fitted by least squares on its positive increments with a
penalty on its curvature in either direction. Residuals beyond the noise widen every interval, and
most where they are. A cell that repeats support, and that no map smooth enough for the others
passes near, stands alone: the map goes by the others, and only the intervals about it grow."""

from dataclasses import dataclass, replace
from functools import cache
from itertools import count

import numpy as np

from ehbench.data.flowmeter import FlowmeterData
from ehbench.flow_maps.readings import SETTINGS as READING
from ehbench.flow_maps.readings import (
    Cells,
    FlowMapOptions,
    Noise,
    Readings,
    few,
    first_noise,
    gather_cells,
    measure_noise,
    medians,
    sort_readings,
    unbacked,
)
from ehbench.flow_maps.shape import SETTINGS as SHAPE
from ehbench.flow_maps.shape import (
    Deadband,
    Kink,
    Shape,
    Solution,
    Window,
    bend,
    find_deadband,
    find_kinks,
    judge,
    jumps,
    let_fall,
    likeliest_smoothing,
    lone_cells,
    regression,
    soften,
    start_deadband,
    window_of,
)
from ehbench.vocabulary import MAD, Z95, InsufficientData, message, setting


@dataclass(frozen=True)
class FitSettings:
    """Numbers of the fit of a flow map to readings."""

    rms: float = setting(0.2, "", "rms from which no map fits, share of the rated flow", "no valve")
    lack: float = setting(100.0, "", "lack of fit from which a map is doubted", "10 times noise")
    lack_rms: float = setting(0.05, "", "rms from which a doubted map is refused", "lone cells")
    fall_rms: float = setting(0.01, "", "the same of a map that falls with the opening", "as above")
    settle: int = setting(20, "", "turns after which no reading comes back", "few needed")
    lag_turns: int = setting(12, "", "largest number of turns for hysteresis and shift", "8 seen")
    lag: float = setting(4.0, "", "standard errors of a hysteresis or shift", "chance")
    lag_share: float = setting(5e-4, "", "the same, of the largest command", "drivers")
    leak_gain: float = setting(10.83, "", "−2 log likelihood between two leaks", "χ² at 99.9 %")
    leak_over: float = setting(1.25, "", "flow of an open valve, of its leak", "scatter")
    passing: float = setting(5e-3, "", "flow that an open valve passes, of the rated", "meters")
    settled: float = setting(0.1, "", "change of either that counts, standard errors", "no matter")
    shift: float = setting(
        0.05, "", "first step to a shift, of the largest command", "ends at 1/10"
    )


SETTINGS = FitSettings()


@dataclass(frozen=True)
class Leak:
    """Scaled flow at rest at the largest drop: the part that grows with the root of the drop, that
    which grows with the drop, the standard error of their sum; ``level`` commands pass no more.
    ``goes_on``: the open valve passes it as well."""

    root: float
    drop: float
    std: float
    level: int
    goes_on: bool = False

    def flow(self, s: np.ndarray) -> np.ndarray:
        """Scaled flow at scaled roots of the drop."""
        return s * (self.root + s * self.drop)


@dataclass(frozen=True)
class Hysteresis:
    """Command of rising readings above that of falling ones [V], its standard error, if it is
    ``removed``."""

    value: float
    std: float
    removed: bool


@dataclass(frozen=True, eq=False)
class Fit:
    """The fit of one map: the readings, which of them are kept, their distance from the map in
    standard deviations, and what the map is made of."""

    readings: Readings
    shape: Shape
    solution: Solution
    noise: Noise
    deadband: Deadband
    window: Window
    keep: np.ndarray
    sigmas: np.ndarray
    kinks: tuple[Kink, ...]
    leak: Leak | None = None
    hysteresis: Hysteresis | None = None
    shift_std: float = 0.0

    @property
    def shift_interval(self) -> tuple[float, float]:
        """95 % interval [V] of the shift of the deadband."""
        shift, half = self.readings.shift, Z95 * self.shift_std
        return round(shift - half, 4), round(shift + half, 4)

    @property
    def used(self) -> Cells:
        """The cells that do not stand alone."""
        return self.solution.cells.without(self.solution.lone)

    @property
    def residuals(self) -> np.ndarray:
        """Scaled flow of each reading less the map's."""
        return self.solution.cells.heard - self.solution.flow


def fit_readings(who: str, given: FlowmeterData, options: FlowMapOptions) -> Fit:
    """The fit of one map to its readings, from whose commands a sure hysteresis, and a sure shift
    of the deadband with the drop, are taken off.

    Raises:
        InsufficientData: as `sort_readings`; fewer than 3 commands that pass flow, or readings that
            no map fits.
    """
    removed, shift, may_shift = 0.0, 0.0, True
    for _ in range(SETTINGS.lag_turns):
        readings = without_zeros(sort_readings(who, given, options, removed)).shifted(shift)
        leak = _find_leak(readings)
        if leak is None:
            result = _iterate(readings, None)
        else:
            ends = _iterate(readings, leak)
            goes_on = _iterate(replace(readings, y=readings.y - leak.flow(readings.s)), None)
            gain = _misfit(ends, ends) - _misfit(goes_on, ends)
            stays = gain > -SETTINGS.leak_gain  # past the edges, unless it surely ends
            result = goes_on if stays else ends
            result = replace(result, leak=replace(leak, goes_on=stays))
            if abs(gain) < SETTINGS.leak_gain:  # not sure which: the deadband may be either's
                low, high = np.array([ends.deadband.interval, goes_on.deadband.interval]).T
                both = float(low.min()), float(high.max())
                result = replace(result, deadband=replace(result.deadband, interval=both))
        rms = float(np.sqrt(np.mean(result.residuals[result.keep] ** 2)))
        limit = SETTINGS.lack_rms if np.isinf(result.shape.rising) else SETTINGS.fall_rms
        if rms > SETTINGS.rms or (result.solution.widening > SETTINGS.lack and rms > limit):
            raise InsufficientData(message("flow_maps.no_map_fits", map=readings.who, rms=rms))
        more, std = _hysteresis_of(result)
        smallest = SETTINGS.lag_share * float(readings.commands[-1])
        sure = removed + more > max(SETTINGS.lag * std, smallest)
        before, (shift, shift_std) = shift, _shift_of(result) if may_shift else (0.0, 0.0)
        may_shift &= shift != 0.0 or not before  # one that did not last is sought no more
        result = replace(result, shift_std=shift_std)
        moved = abs(shift - before) > SETTINGS.settled * shift_std
        if not moved and (not sure or abs(more) < SETTINGS.settled * std):
            break
        removed += more * sure
    if np.any(readings.sweep):
        return replace(result, hysteresis=Hysteresis(removed + more, std, removed > 0.0))
    return result


def _misfit(result: Fit, by: Fit) -> float:
    """Squares of the residuals over the noise ``by`` another fit, and twice the parameters."""
    std = by.noise.std(result.readings, by.solution.flow)
    squares = (result.residuals / std)[result.keep & by.keep] ** 2
    return float(np.sum(squares)) / by.solution.lack + 2.0 * result.solution.parameters


def _iterate(readings: Readings, leak: Leak | None) -> Fit:
    """Alternate noise, fit and outliers until the outliers stay the same, then find the deadband
    and do it again.

    Args:
        leak: one that ends with the opening.
    """
    readings, shape, flow, keep = _first_shape(readings, leak)
    kinks: tuple[Kink, ...] = ()
    noise, lack, deadband = first_noise(readings), 1.0, Deadband()
    leverage = (flow > 0) * (shape.spline().rows + 3) / np.count_nonzero(flow > 0)
    lone = np.zeros(int(readings.cell.max()) + 1, bool)
    for final in (False, True):
        for turn in count():
            noise = measure_noise(readings, noise, keep, leverage, flow)
            cells = gather_cells(readings, noise, keep, flow)
            if final and not turn:
                shape = let_fall(shape, cells)
                bent = start_deadband(readings, bend(shape, cells), cells, lack)
                lone = lone_cells(readings, bent, cells)
                if lone.any():
                    used = cells.without(lone)
                    bent = start_deadband(readings, bend(shape, used), used, lack)
                shape, kinks = find_kinks(readings, bent, cells.without(lone), lack)
            used = cells.without(lone)
            if used.weighed < 3:  # all else lies below what its meter shows
                raise InsufficientData(message("flow_maps.no_flow", map=readings.who))
            shape, _ = likeliest_smoothing(shape, used)
            if final:
                deadband, shape = find_deadband(readings, shape, used, lack)
                shape, _ = likeliest_smoothing(shape, used)
            solution = judge(readings, shape, cells, lone)
            flow, lack = solution.flow, solution.widening
            variance = noise.std(readings, flow) ** 2
            error = solution.variance(solution.spline.design(readings.u, readings.s))
            inside = keep & ~solution.lone[readings.cell]
            spread = np.where(
                inside, np.maximum(variance - error, 0.1 * variance), variance + error
            )
            sigmas, leverage = (
                (solution.cells.heard - solution.flow) / np.sqrt(spread),
                error / variance,
            )
            before = keep
            alone = unbacked(readings, noise, solution.cells.heard, flow)
            # the farthest first: what seems far next to it may be near once it is out
            far = np.abs(sigmas)
            worst = max(READING.outlier, 0.75 * float(far[keep & alone].max(initial=0.0)))
            keep = ~few(alone & (far > np.where(keep, worst, READING.outlier)), far)
            if turn > SETTINGS.settle:  # no coming and going for ever
                keep &= before
            if np.array_equal(before, keep):
                break
    window = window_of(readings, cells, lack)
    shape = replace(shape, above=readings.levels[window.opens :])
    deadband = soften(readings, shape, used, deadband, window)
    if jumps(readings, shape, used, window):
        (low, high), (below, first) = deadband.interval, window.bracket
        deadband = replace(deadband, interval=(min(low, below), max(high, first)))
    return Fit(readings, shape, solution, noise, deadband, window, keep, sigmas, kinks)


def _first_shape(r: Readings, leak: Leak | None) -> tuple[Readings, Shape, np.ndarray, np.ndarray]:
    """(readings without the leak, shape, scaled flow of each reading, readings to keep) by a robust
    fit."""
    levels, noise = r.levels, first_noise(r)
    passes = medians(medians(r.y, r.cell), r.cell_level) > SETTINGS.passing
    k = int(np.flatnonzero(~passes)[-1]) + 1 if not passes.all() else 0
    k = min(leak.level if leak else k, levels.size - 3)
    if leak:  # what passes no more than the leak is shut; the leak is reported apart from the map
        shut = r.step < k
        r = replace(r, y=r.y - shut * np.polyval(np.polyfit(r.s[shut], r.y[shut], 2), r.s))
    cells = gather_cells(r, noise, np.ones(r.q.size, bool), r.y)
    cells = replace(cells, y=medians(cells.heard, r.cell))
    shape = Shape(
        deadband=0.5 * float(levels[k - 1] + levels[k]) if k else 0.0,
        above=levels[k:],
        along_s=r.axis,
        smoothing=np.full(2, 1e-5 * cells.weight.sum()),
    )
    shape = let_fall(shape, cells)
    spline = shape.spline()
    flow = spline.design(r.u, r.s) @ regression(spline, cells).solve(shape.smoothing)[0]
    size = np.abs(cells.heard - flow) / noise.std(r, flow)
    far = size > 1.5 * READING.outlier * max(MAD * float(np.median(size[flow > 0])), 0.1)
    return r, shape, flow, ~few(far & unbacked(r, noise, cells.heard, flow), size)


def without_zeros(r: Readings) -> Readings:
    """The readings without the zero of their meter: what it shows at rest at all drops alike, where
    a leak grows with the drop, as the flow of the open valve does."""
    from scipy.optimize import nnls

    def alike(at: np.ndarray) -> float:
        """−2 log likelihood that flows are alike, over that they grow with the drop."""
        s, y = r.s[at], r.y[at]
        floor = y.size * (max(r.digit.values()) + 1e-9) ** 2
        by_drop = nnls(np.column_stack([s, s**2]), y)[1] ** 2
        return y.size * float(np.log((y.size * y.var() + floor) / (by_drop + floor)))

    widest = r.level == r.level.max()
    if alike(widest) < SETTINGS.leak_gain:
        return r
    zeros = {}
    for method in r.digit:
        still = (r.method == method) & ~r.silent & (r.command == 0)
        if still.sum() < 4 or alike(still) > -SETTINGS.leak_gain:
            continue
        middle = float(np.median(r.y[still]))
        error = MAD * float(np.median(np.abs(r.y[still] - middle))) / np.sqrt(still.sum())
        if abs(middle) > max(SHAPE.shut, SHAPE.shut_sure * error):
            zeros[method] = middle
    off = np.where(r.silent, 0.0, [zeros.get(method, 0.0) for method in r.method])
    return replace(r, y=r.y - off, q=r.q - r.rated * off, zeros=zeros)


def _find_leak(r: Readings) -> Leak | None:
    """The leak of a valve that passes flow at 0 V, if that was measured and is small; else None."""
    still = (r.level == 0) & (r.command == 0) & ~r.silent
    if still.sum() < 4:
        return None
    from scipy.optimize import nnls

    s, y = r.s[still], r.y[still]
    middle, design = float(np.median(y)), np.column_stack([s, s**2])
    law = design @ nnls(design, y)[0]  # it grows with the drop, by many times its noise
    error = MAD * float(np.median(np.abs(y - law))) / np.sqrt(still.sum())
    if law.max() <= SHAPE.shut or middle <= SHAPE.shut_sure * error:
        return None
    open_flow = max(SETTINGS.passing, SETTINGS.leak_over * middle)
    passes = medians(medians(r.y, r.cell), r.cell_level) > open_flow
    level = int(np.flatnonzero(~passes)[-1]) + 1 if not passes.all() else 1
    some = (r.step < level) & ~r.silent
    s, y = r.s[some], r.y[some]
    design = np.column_stack([s, s**2])
    parts = nnls(design, y)[0]
    for _ in range(3):
        residual = y - design @ parts
        scale = MAD * max(float(np.median(np.abs(residual))), 1e-9)
        near = np.abs(residual) <= READING.outlier * scale
        parts = nnls(design[near], y[near])[0]
    used = design[near][:, parts > 0]
    scatter = float(np.sum(residual[near] ** 2)) / max(int(near.sum()) - 2, 1)
    spread = np.linalg.pinv(used.T @ used)
    return Leak(float(parts[0]), float(parts[1]), float(np.sqrt(scatter * spread.sum())), level)


def _shift_of(result: Fit) -> tuple[float, float]:
    """(what the deadband is higher at the largest drop than at none [V], its standard error); 0
    and 0 where a shift is not far likelier than none, or the valve were open at rest.

    It is sought with a deadband and a smoothing of its own; once there is one, to the last digits
    with those of the fit."""
    r, shape, used = result.readings, result.shape, result.used
    most, step = 2.0 * result.deadband.value, SETTINGS.shift * float(r.commands[-1])
    end = 0.1 * step
    if r.one_drop or most <= 0.0:
        return 0.0, 0.0

    def moved(shift: float) -> Cells:
        return used.shifted(shift - r.shift)

    @cache
    def anew(shift: float) -> float:
        """−2 log likelihood of a shift."""
        if abs(shift) > most:
            return np.inf
        plain = replace(shape, kinks=())
        best = start_deadband(r.shifted(shift), plain, moved(shift), result.solution.widening)
        return likeliest_smoothing(best, moved(shift), coarse=False)[1]

    def nearby(deadband: float, shift: float) -> float:
        """The same with this deadband and all else as it is."""
        above = np.append(shape.above[:-1], r.levels[-1] + step)
        spline = replace(shape, above=above).spline(deadband)
        return regression(spline, moved(shift)).solve(shape.smoothing)[1]

    if not r.shift:
        # past the likelihoods between, which rise where a command begins to pass flow
        step *= 0.5
        best = min((step * k for k in sorted(range(-4, 5), key=abs)), key=anew)
        while step > end:
            best = min((best, best - step, best + step), key=anew)
            step *= 0.5 if anew(best) <= min(anew(best - step), anew(best + step)) else 1.0
        none = min(anew(0.0), nearby(shape.deadband, 0.0))
        return (best, end) if none - anew(best) > SHAPE.kink_gain else (0.0, 0.0)
    now, std = np.array([shape.deadband, r.shift]), end
    away = np.array([(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)])
    terms = np.column_stack([away[:, :1] ** 2, away.prod(1), away[:, 1:] ** 2, away, np.ones(9)])
    for size in end * 0.25 ** np.arange(3):
        values = [nearby(*place) for place in now + size * away]
        xx, xy, yy, x, y, _ = np.linalg.lstsq(terms, values, rcond=None)[0]
        bend = np.array([[2.0 * xx, xy], [xy, 2.0 * yy]])
        if not (xx > 0.0 and np.linalg.det(bend) > 0.0):
            break
        now = now - size * np.clip(np.linalg.solve(bend, (x, y)), -1.0, 1.0)
        std = size * float(np.sqrt(2.0 * np.linalg.inv(bend)[1, 1]))
    return (round(float(now[1]), 4), std) if abs(now[1]) > SETTINGS.lag * std else (0.0, 0.0)


def _hysteresis_of(result: Fit) -> tuple[float, float]:
    """(the hysteresis [V] that is left, its standard error); 0 and 0 where readings go one way
    only.

    A reading on the way up stands at an opening that is lower by half of it: a residual of −½·h
    times the slope of the map."""
    r, solution = result.readings, result.solution
    step = 1e-3 * float(r.commands[-1])
    slope = (solution.at(r.u + step, r.s) - solution.at(r.u - step, r.s)) / (2.0 * step)
    slope = np.where(r.u > result.deadband.value, slope, 0.0)
    use = result.keep & ~r.silent & (r.sweep != 0) & ~solution.lone[r.cell]
    lever = -0.5 * (r.sweep * slope)[use]
    weight = 1.0 / result.noise.std(r, solution.flow)[use] ** 2
    power = float(weight @ lever**2)
    if not power > 0 or np.unique(r.sweep[use]).size < 2:
        return 0.0, 0.0
    residual = result.residuals[use]
    value = float((weight * lever) @ residual) / power
    scatter = float(weight @ (residual - value * lever) ** 2) / (int(use.sum()) - 1)
    return value, float(np.sqrt(max(scatter, 1.0) / power))
