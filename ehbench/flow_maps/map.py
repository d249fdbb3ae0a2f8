"""Flowmeter readings to flow maps, with noise, deadband, outliers and intervals found from the
readings.

The spline of ``physics.flow_map`` is fitted by least squares on its positive increments with a
penalty on its curvature in either direction. Readings at one command and nearly one drop form a
cell: their scatter gives the noise, the cells' means the fit. What the fit leaves beyond the noise
widens every interval, and most where it was left. A cell that repeats back, and that no map smooth
enough for the others passes near, stands alone: the map goes by the others, and only the intervals
about it grow."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ehbench.flow_maps.cells import (
    OUTLIER_SIGMAS,
    Cells,
    alone,
    few,
    first_noise,
    gather_cells,
    measure_noise,
)
from ehbench.flow_maps.deadband import (
    Deadband,
    find_deadband,
    soften,
    start_deadband,
    window_of,
)
from ehbench.flow_maps.error import Found, flow_std, hull, trial_scatter
from ehbench.flow_maps.opening import Kink, find_kinks, let_fall
from ehbench.flow_maps.readings import (
    FlowMapOptions,
    FlowReadings,
    Task,
    make_task,
    medians,
    sort_readings,
)
from ehbench.flow_maps.rest import (
    Lag,
    Leak,
    find_leak,
    hysteresis_of,
    interval_of,
    is_sure,
    without_leak,
)
from ehbench.flow_maps.results import (
    Calibration,
    FlowMapFit,
    Outlier,
    Units,
    check_calibration,
)
from ehbench.flow_maps.steps import (
    Shape,
    bend,
    distances,
    judge,
    likeliest_smoothing,
    lone_cells,
    solve,
)
from ehbench.physics.flow_map import FlowMap, root_drop
from ehbench.vocabulary.errors import InsufficientData

if TYPE_CHECKING:
    from ehbench.data.flowmeter import FlowmeterData

__all__ = [
    "Calibration",
    "FlowMapFit",
    "FlowMapOptions",
    "FlowReadings",
    "Outlier",
    "Units",
    "fit_flow_map",
    "fit_flow_maps",
]

# beyond these the readings are not those of a valve that opens with its command
_MOST_RMS, _MOST_LACK, _LACK_RMS, _FALL_RMS = 0.2, 100.0, 0.05, 0.01
# turns of noise, fit and outliers; from the second number on no reading comes back
_TURNS, _SETTLE, _LAG_TURNS = 40, 20, 4
# −2 log likelihood by which two accounts of a leak must differ for one to be sure
_SURE_GAIN = 10.83
# spans along the root of the drop of a map without pressures: it rises within the first ones
_LEVEL_SPANS = 24


def fit_flow_map(
    valve: str,
    direction: str,
    readings: FlowReadings | FlowmeterData,
    options: FlowMapOptions = FlowMapOptions(),  # noqa: B008
) -> FlowMapFit:
    """The flow map of one edge in one direction from readings, with intervals.

    Raises:
        InsufficientData: fewer than 4 commands, fewer than 3 of them passing flow, fewer than 4
            drops, a flow that does not depend on the command, or readings that no map fits.
    """
    who = f"flow map of '{valve}' ({direction})"
    taken_off = 0.0
    for _ in range(_LAG_TURNS):
        ready = sort_readings(who, readings, options, taken_off)
        task = make_task(who, ready, options.rated_flow, options.show)
        shared = {
            "drop_std": options.drop_std / task.drop_max,
            "command_std": options.command_std,
        }
        result, leak = _find(replace(task, **shared))
        more, std = hysteresis_of(result)
        if not is_sure(result, taken_off + more, std) or abs(more) < 0.1 * std:
            break
        taken_off += more
    lag = Lag(taken_off + more, std, taken_off > 0.0) if np.any(ready.sweep) else None
    return _summary(Result(result, leak, lag), (valve, direction), options)


class Result(NamedTuple):
    """What was found of one valve: the fit, its leak and its hysteresis, if there are."""

    found: Found
    leak: Leak | None
    lag: Lag | None


def fit_flow_maps(
    data: FlowmeterData,
    options: FlowMapOptions = FlowMapOptions(),  # noqa: B008
) -> list[FlowMapFit]:
    """One fit for each valve and direction in the readings, sorted by name.

    Raises:
        InsufficientData: a valve has too few readings.
    """
    return [fit_flow_map(*group, data.select(*group), options) for group in data.groups()]


def _guess(task: Task, leak: Leak | None) -> tuple[Task, Shape, np.ndarray, np.ndarray]:
    """(task without the leak, shape, scaled flow at each reading, readings to keep) by a robust fit
    to the cells' medians; leaves out what lies far from it.
    """
    r, levels, noise = task.readings, task.levels, first_noise(task)
    passes = medians(medians(task.y, r.cell), task.cell_level) > 5e-3
    k = int(np.flatnonzero(~passes)[-1]) + 1 if not passes.all() else 0
    k = min(leak.level if leak else k, levels.size - 3)
    if leak:  # what passes no more than the leak is shut; the leak is told apart from the map
        shut = r.level < k
        bottom = np.polyval(np.polyfit(task.s[shut], task.y[shut], 2), task.s)
        task = replace(task, y=task.y - shut * bottom)
    cells = gather_cells(task, noise, np.ones(r.q.size, bool), task.y)
    cells = replace(cells, y=medians(cells.heard, r.cell))
    shape = Shape(
        deadband=0.5 * float(levels[k - 1] + levels[k]) if k else 0.0,
        above=levels[k:],
        along_s=task.axis,
        smoothing=np.full(2, 1e-5 * cells.weight.sum()),
    )
    shape = let_fall(shape, cells)
    spline = shape.spline()
    flow = spline.design(r.u, task.s) @ solve(shape, spline, cells)[0]
    size = np.abs(cells.heard - flow) / noise.std(task, flow)
    far = size > 1.5 * OUTLIER_SIGMAS * max(1.4826 * float(np.median(size[flow > 0])), 0.1)
    return task, shape, flow, ~few(far & alone(task, noise, cells.heard, flow), size)


def _find(task: Task) -> tuple[Found, Leak | None]:
    """(the fit, its leak): of a valve that leaks at rest the likelier of a leak that ends where the
    valve opens and one that goes on beside the opening.
    """
    leak = find_leak(task)
    if leak is None:
        result = _settle(task, None)
        _refuse_misfit(result)
        return result, None
    ends, goes_on = _settle(task, leak), _settle(without_leak(task, leak), None)
    gain = _misfit(ends, ends) - _misfit(goes_on, ends)
    result = goes_on if gain > 0 else ends
    leak = replace(leak, goes_on=gain > 0)
    if abs(gain) < _SURE_GAIN:  # the readings do not tell which: the deadband may be either's
        low, high = np.array([ends.deadband.interval, goes_on.deadband.interval]).T
        both = float(low.min()), float(high.max())
        result = replace(result, deadband=replace(result.deadband, interval=both))
    _refuse_misfit(result)
    return result, leak


def _misfit(result: Found, by: Found) -> float:
    """Squares of the residuals over the noise ``by`` another fit, and twice the parameters."""
    std = by.noise.std(result.task, by.solution.flow)
    both = result.keep & by.keep
    squares = (_residuals(result) / std)[both] ** 2
    return float(np.sum(squares)) / by.solution.lack + 2.0 * result.solution.parameters


def _settle(task: Task, leak: Leak | None) -> Found:
    """Alternate noise, fit and outliers until the outliers stay the same, then find the deadband
    and do it again.

    Args:
        leak: one that ends with the opening.
    """
    task, shape, flow, keep = _guess(task, leak)
    kinks: tuple[Kink, ...] = ()
    noise, lack, deadband = first_noise(task), 1.0, Deadband()
    leverage = (flow > 0) * (shape.spline().rows + 3) / np.count_nonzero(flow > 0)
    lone = np.zeros(int(task.readings.cell.max()) + 1, bool)
    for final in (False, True):
        for turn in range(_TURNS):
            noise = measure_noise(task, noise, keep, leverage, flow)
            cells = gather_cells(task, noise, keep, flow)
            if final and not turn:
                shape, lone = _begin(task, shape, cells, lack)
                used = cells.without(lone)
                shape, kinks = find_kinks(task, shape, used, lack)
            used = cells.without(lone)
            shape, _ = likeliest_smoothing(shape, used)
            if final:
                deadband, shape = find_deadband(task, shape, used, lack)
                shape, _ = likeliest_smoothing(shape, used)
            solution = judge(task, shape, cells, lone)
            flow, lack = solution.flow, solution.widening
            variance = noise.std(task, flow) ** 2
            sigmas, leverage = distances(task, solution, variance, keep)
            before = keep
            keep = ~_outliers(sigmas, before, alone(task, noise, cells.heard, flow))
            if turn > _SETTLE:  # no coming and going for ever
                keep &= before
            if np.array_equal(before, keep):
                break
    window = window_of(task, cells, lack)
    shape = replace(shape, above=task.levels[window.opens :])
    deadband = soften(task, shape, used, deadband, window)
    return Found(task, shape, solution, noise, deadband, window, keep, sigmas, kinks)


def _begin(task: Task, shape: Shape, cells: Cells, lack: float) -> tuple[Shape, np.ndarray]:
    """(shape with its bends and a first deadband, which cells stand alone): these have no say in
    the shape.
    """
    shape = let_fall(shape, cells)
    bent = start_deadband(task, bend(shape, cells), cells, lack)
    lone = lone_cells(task, bent, cells)
    if lone.any():
        used = cells.without(lone)
        bent = start_deadband(task, bend(shape, used), used, lack)
    return bent, lone


def _outliers(sigmas: np.ndarray, kept: np.ndarray, alone: np.ndarray) -> np.ndarray:
    """Which readings to leave out: the farthest first, as what seems far beside it may be near once
    it is out.
    """
    far = np.abs(sigmas)
    worst = max(OUTLIER_SIGMAS, 0.75 * float(far[kept & alone].max(initial=0.0)))
    return few(alone & (far > np.where(kept, worst, OUTLIER_SIGMAS)), far)


def _refuse_misfit(result: Found) -> None:
    """Refuses a map that says nothing of the readings."""
    rms = float(np.sqrt(np.mean(_residuals(result)[result.keep] ** 2)))
    maximum = _LACK_RMS if np.isinf(result.shape.rising) else _FALL_RMS
    if rms > _MOST_RMS or (result.solution.widening > _MOST_LACK and rms > maximum):
        raise InsufficientData(
            f"no map fits the readings of the {result.task.who}: they lie {100 * rms:.2g} % of the "
            "rated flow from the best one (rms)",
            hint="check the columns, and that the flow grows with the command at every drop, up to "
            "one command above which it may fall",
        )


def _residuals(result: Found) -> np.ndarray:
    """Scaled flow of each reading less the map's."""
    return result.solution.cells.heard - result.solution.flow


def _to_map(
    result: Result, scatter: float, named: tuple[str, str], outliers: tuple[str, ...]
) -> FlowMap:
    """The map of the valve and direction ``named``, with its standard errors."""
    match, leak = result.found, result.leak
    task, spline, deadband = match.task, match.solution.spline, match.deadband
    knots = _digits(deadband.value + spline.along_u.breaks * (spline.top - deadband.value), 10)
    knots[0] = deadband.value
    fine_u = np.unique(
        np.concatenate([knots, 0.5 * (knots[1:] + knots[:-1]), np.array(deadband.interval)])
    )
    even, roots = np.linspace(0.0, 1.0, 2 * task.spans + 1), task.roots
    fine_s = np.unique(np.concatenate([even, roots, 0.5 * (roots[1:] + roots[:-1])]))
    command, low, high = hull(match)
    increments = spline.increments(match.solution.coefficients)
    additional: dict[str, Any] = {}
    if leak and leak.goes_on:
        additional["leakage"] = tuple(_digits([leak.root, leak.drop], 6) * task.rated)
        additional["leakage_std"] = float(_digits([task.rated * leak.std], 4)[0])
    if np.any(spline.sign < 0):
        additional["rising_to"] = float(
            knots[int(np.count_nonzero(spline.sign > 0)) // spline.columns - 1]
        )
    if result.lag is not None and result.lag.taken_off:
        additional["hysteresis"] = round(result.lag.value, 4)
    if task.readings.one_drop:
        increments, low = np.repeat(increments, _LEVEL_SPANS + 2, axis=1), 0.0 * low
        additional["level"] = True
    return FlowMap(
        valve=named[0],
        direction=named[1],
        deadband=deadband.value,
        deadband_interval=deadband.interval,
        opening_knots=knots,
        drop_max=task.drop_max,
        delta=task.delta,
        increments=_digits(task.rated * increments, 10),
        hull_command=_digits(command, 10),
        hull_low=low,
        hull_high=high,
        std_command=_digits(fine_u, 10),
        std_root=_digits(fine_s * root_drop(task.drop_max, task.delta), 10),
        std=_digits(task.rated * flow_std(match, fine_u, fine_s, scatter), 4),
        rated_flow=task.rated,
        samples=int(match.keep.sum()),
        outliers=outliers,
        source=", ".join(name for name in np.unique(task.readings.file).tolist() if name),
        **additional,
    )


def _digits(values, count: int) -> np.ndarray:
    """Values to so many significant digits: what a file needs, and not the last bits of a linear
    algebra library.
    """
    values = np.asarray(values, float)
    return np.array([float(f"{v:.{count - 1}e}") for v in values.ravel()]).reshape(values.shape)


def _left_out(result: Found) -> tuple[Outlier, ...]:
    """The readings that are not kept, by line."""
    r, out = result.task.readings, np.flatnonzero(~result.keep)
    return tuple(
        Outlier(
            str(r.file[i]),
            int(r.line[i]),
            float(r.u[i]),
            float(r.drop[i]),
            float(r.q[i]),
            round(float(result.sigmas[i]), 2),
        )
        for i in out[np.argsort(r.line[out], kind="stable")]
    )


def _summary(result: Result, named: tuple[str, str], options: FlowMapOptions) -> FlowMapFit:
    match, lag = result.found, result.lag
    task, solution, deadband = match.task, match.solution, match.deadband
    r, rated, left = task.readings, task.rated, _residuals(match)
    scatter, outliers = trial_scatter(match), _left_out(match)
    sentences = tuple(outlier.sentence(task.show) for outlier in outliers)
    built = _to_map(result, scatter, named, sentences)
    residuals, sigmas = np.full((2, r.size), np.nan)
    residuals[r.row], sigmas[r.row] = rated * left, match.sigmas
    leakage, ends = _leakage(match)
    smoothing = match.shape.smoothing / solution.cells.weight.sum()
    fit = FlowMapFit(
        map=built,
        deadband=deadband.value,
        deadband_interval=deadband.interval,
        deadband_std=deadband.std,
        bracket=match.window.bracket,
        status=_status(match),
        noise={
            name: (rated * floor, share) for name, (floor, share) in match.noise.methods.items()
        },
        replicates=match.noise.replicates,
        lack_of_fit=solution.lack,
        smoothing=(float(smoothing[0]), float(smoothing[1])),
        parameters=solution.parameters,
        readings=int(match.keep.sum()),
        cells=solution.cells.weighed,
        outliers=outliers,
        rms=rated * float(np.sqrt(np.mean(left[match.keep] ** 2))),
        leakage=rated * leakage,
        leakage_interval=(rated * ends[0], rated * ends[1]),
        hysteresis=lag and round(lag.value, 4),
        hysteresis_interval=(0.0, 0.0) if lag is None else _volts(interval_of(lag.value, lag.std)),
        kinks=tuple((kink.value, *kink.interval) for kink in match.kinks),
        falls=_fall(built),
        trial_scatter=scatter,
        calibration=tuple(
            check_calibration(built, *point, options.reference_drop)
            for point in options.calibration
        ),
        residuals=residuals,
        sigmas=sigmas,
    )
    return replace(fit, warnings=tuple([*_warnings(match, fit), *_ways(result, fit)]))


def _leakage(result: Found) -> tuple[float, tuple[float, float]]:
    """(mean scaled flow at commands below the deadband, its 95 % interval)."""
    r = result.task.readings
    shut = result.keep & (r.u <= result.deadband.interval[0])
    if not shut.any():
        return 0.0, (0.0, 0.0)
    mean = float(r.q[shut].mean()) / result.task.rated
    left = (result.task.y - result.solution.flow)[shut]  # the leak is off these
    return mean, interval_of(mean, float(np.sqrt(np.mean(left**2) / shut.sum())))


def _fall(built: FlowMap) -> float:
    """What the flow falls by from its largest to the largest command at the largest drop read
    there, as a share.
    """
    if built.rising == built.opening_knots.size - 1:
        return 0.0
    drop = float(built.hull_high[-1])
    maximum = np.max(built.flow(drop, np.linspace(built.deadband, built.command_max, 400)))
    return round(float(1.0 - built.flow(drop, built.command_max) / maximum), 4)


def _volts(interval: tuple[float, float]) -> tuple[float, float]:
    return round(interval[0], 4), round(interval[1], 4)


def _shown(volts: float) -> float:
    return round(volts, 2)


def _ways(result: Result, fit: FlowMapFit) -> Iterator[str]:
    """Sentences on what a valve does beside opening smoothly with its command."""
    match, show = result.found, result.found.task.show
    if result.leak and fit.leakage:
        low, high = (show.flow(end, 3) for end in fit.leakage_interval)
        leak = f"{show.flow(fit.leakage, 3)} pass below the deadband ({low} to {high})"
        yield leak + (
            ", and go on beside the opening: the map has this leak"
            if result.leak.goes_on
            else "; the map takes the valve as shut there"
        )
    for value, low, high in fit.kinks:
        yield (
            f"the flow's slope jumps at {show.volts(_shown(value))} ({show.volts(_shown(low))} to "
            f"{show.volts(_shown(high))}): a kink between two commands, followed"
        )
    if fit.falls:
        yield (
            f"the flow falls above {show.volts(_shown(fit.map.rising_to))}, by "
            f"{100 * fit.falls:.2g} % up to {show.volts(_shown(fit.map.command_max))}: kept; the "
            "inverse goes by the rising branch"
        )
    if result.lag and result.lag.taken_off:
        low, high = fit.hysteresis_interval
        yield (
            f"rising commands lie {result.lag.value:.3g} V above falling ones of the same flow "
            f"({low:.3g} to {high:.3g} V): hysteresis; the map is the middle of both"
        )
    if match.task.readings.one_drop:
        yield (
            "no pressures: the map is one-dimensional, the flow by the command alone at the loads "
            "measured, and says nothing of others"
        )


def _status(result: Found) -> str:
    if result.window.flows_at_lowest and result.task.levels[0] > 0:
        return "not_excited"
    return "at_bound" if result.deadband.at_bound else "estimated"


def _warnings(result: Found, fit: FlowMapFit) -> Iterator[str]:
    show, n = result.task.show, result.sigmas.size
    if fit.outliers:
        worst = max(fit.outliers, key=lambda item: abs(item.sigmas)).sentence(show)
        yield (
            f"{len(fit.outliers)} of {n} readings were left out, over {OUTLIER_SIGMAS:g} sigma "
            f"from the map; the worst: {worst}"
        )
    yield from _lone_sentences(result)
    far = int(np.count_nonzero(result.keep & (np.abs(result.sigmas) > OUTLIER_SIGMAS)))
    if far > 0.01 * n:
        yield (
            f"{far} of {n} readings lie over {OUTLIER_SIGMAS:g} sigma from the map, but repeats "
            "back them, or they are too many for accidents: they stay in, and the intervals are "
            "wider there"
        )
    if not fit.replicates:
        yield (
            "no repeats: the noise was taken from the residuals, so lack of fit cannot be told "
            "from noise"
        )
    if result.solution.widening > 2.0:
        times = f"{result.solution.widening**0.5:.1f}"
        yield (
            f"the cells' means miss the map by {times} times what repeats explain; the intervals "
            "are widened by that"
        )
    if fit.status == "not_excited":
        yield (
            f"flow at the lowest command, {show.volts(result.task.levels[0])}: the deadband is an "
            "extrapolation; measure below it"
        )
    if fit.trial_scatter > 2e-3:
        yield (
            f"whole trials differ: their mean is uncertain by {100 * fit.trial_scatter:.2g} % of "
            "the flow, which is in the intervals"
        )


def _lone_sentences(result: Found) -> Iterator[str]:
    """One sentence for each cell that stands alone."""
    r, show = result.task.readings, result.task.show
    for cell in np.flatnonzero(result.solution.lone):
        at = result.keep & (r.cell == cell)
        if at.any():
            where = f"{show.volts(r.u[at].mean())} and {show.drop(r.drop[at].mean())}"
            off = 100.0 * (
                r.q[at].mean() / (result.task.rated * result.solution.flow[at].mean()) - 1
            )
            yield (
                f"{at.sum()} readings at {where} agree and lie {off:+.2g} % from the map that all "
                "others make: the map goes by the others, and the intervals are wider there"
            )
