"""Flow maps from readings: the map with its standard errors and intervals, outliers, calibration,
and the notes that people read."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

from ehbench.data.flowmeter import FlowmeterData
from ehbench.flow_maps.fit import Fit, fit_readings
from ehbench.flow_maps.readings import SETTINGS as READING
from ehbench.flow_maps.readings import FlowMapOptions, Units
from ehbench.flow_maps.shape import regression
from ehbench.flow_maps.spline import SETTINGS as SPLINE
from ehbench.flow_maps.spline import Spline
from ehbench.physics.flow_map import FlowMap, root_drop
from ehbench.vocabulary import Z95, Message, message, setting


@dataclass(frozen=True)
class NoteSettings:
    """Numbers from which a map has a note."""

    far: float = setting(0.01, "", "share of readings far from the map", "1 in 10⁶ by chance")
    wide: float = setting(0.1, "", "flow whose scatter counts, of the rated", "below: the zero")
    scatter: float = setting(0.05, "", "scatter of repeats, of their flow", "meters: 0.01")
    lack: float = setting(2.0, "", "squares of lack of fit, in those of noise", "chance: less")
    trials: float = setting(2e-3, "", "standard error by trials, of the flow", "a map's accuracy")


SETTINGS = NoteSettings()


@dataclass(frozen=True)
class Outlier:
    """A reading left out of the fit: its place, command [V], drop [Pa], flow [m³/s], distance in
    sigmas."""

    file: str
    line: int
    command: float
    pressure_drop: float
    flow: float
    sigmas: float

    def sentence(self, show: Units) -> Message:
        """What people read of it."""
        return message(
            "flow_maps.outlier" if self.file else "flow_maps.outlier_of_line",
            file=self.file,
            line=self.line,
            flow=show.flow(self.flow),
            command=show.volts(self.command),
            drop=show.drop(self.pressure_drop),
            sigmas=self.sigmas,
        )


@dataclass(frozen=True)
class Calibration:
    """A flow [m³/s] that a command [V] should give, and what the map gives there.

    ``flow`` is the mean over the drops from ``drop_low`` to ``drop_high`` [Pa], ``low`` and
    ``high`` its 95 % interval, ``least`` and ``most`` the range of the map over those drops.
    ``verdict``: ``met`` or ``missed`` where the whole interval lies inside or outside of target·(1
    ± tolerance), else ``undecided``; ``not_measured`` outside the commands."""

    command: float
    target: float
    tolerance: float
    flow: float
    low: float
    high: float
    least: float
    most: float
    drop_low: float
    drop_high: float
    verdict: str

    def sentence(self, show: Units) -> Message:
        """What people read of it."""
        command, target = show.volts(self.command), show.flow(self.target)
        if self.verdict == "not_measured":
            return message("flow_maps.not_measured", command=command, target=target)
        first, last = show.drop(self.drop_low), show.drop(self.drop_high)
        return message(
            "flow_maps.calibration",
            command=command,
            target=target,
            tolerance=self.tolerance,
            flow=show.flow(self.flow),
            low=show.flow(self.low),
            high=show.flow(self.high),
            drops=first if self.drop_low == self.drop_high else f"{first} to {last}",
            verdict=self.verdict,
        )


@dataclass(frozen=True)
class FlowMapFit:
    """A map and how it was fitted. SI.

    ``deadband`` [V] with ``deadband_std``, if the flow starts with a kink there; its 95 % interval
    also holds where a flow would start that grows softly, no softer than a parabola. ``bracket``
    [V, V]: the highest command at which no flow is seen (under 0.1 % of the rated one, or within
    the noise) and the lowest with some, whatever the shape. ``status`` of the
    deadband: ``estimated``, ``at_bound`` (0 V) or ``not_excited`` (flow at the lowest command
    measured). ``noise``: per method (floor [m³/s], share of the flow), the standard deviation of
    one reading being √(floor² + (share·flow)²). ``replicates``: degrees of freedom behind the
    noise; 0 means that it was taken from the residuals. ``lack_of_fit``: variance of cell means
    about the map over what the noise explains, at least 1; every interval is widened by its root,
    and further near the cells missed. ``smoothing``: penalty along opening and root of drop;
    ``parameters``: effective number of them. ``rms`` [m³/s]: of the residuals of the readings used.
    ``leakage`` [m³/s]: mean flow at commands below the deadband, with its interval. Where it ends
    with the opening the map takes the valve as shut there; where it goes on, the map has it.
    ``hysteresis`` [V]: what the commands of rising readings lie above those of falling ones at the
    same flow, with its interval; the map is the middle of both. None where the readings go one way
    only. ``kinks`` [V]: openings where the slope jumps, each with its interval. ``falls``: what the
    flow falls by from its largest to the largest command [1]; 0 where it does not.
    ``trial_scatter``: standard error [1] of the mean of the trials' common factors beyond the
    noise. ``residuals`` [m³/s] and ``sigmas`` [1]: one a reading in the order given, NaN at drops
    of zero or less. ``warnings``: messages. Of a table of readings: ``rows`` are behind it, with
    commands as openings, which the driver gets times ``sign``. ``shift`` [V]: what the deadband is
    higher at the largest drop than at none, with its interval; ``deadband`` is at half of it."""

    map: FlowMap
    deadband: float
    deadband_interval: tuple[float, float]
    deadband_std: float
    bracket: tuple[float, float]
    status: str
    noise: dict[str, tuple[float, float]]
    replicates: int
    lack_of_fit: float
    smoothing: tuple[float, float]
    parameters: float
    readings: int
    cells: int
    outliers: tuple[Outlier, ...]
    rms: float
    leakage: float
    leakage_interval: tuple[float, float]
    hysteresis: float | None
    hysteresis_interval: tuple[float, float]
    shift: float
    shift_interval: tuple[float, float]
    kinks: tuple[tuple[float, float, float], ...]
    falls: float
    trial_scatter: float
    calibration: tuple[Calibration, ...]
    residuals: np.ndarray = field(repr=False)
    sigmas: np.ndarray = field(repr=False)
    warnings: tuple[str, ...] = ()
    rows: FlowmeterData | None = field(default=None, repr=False)
    sign: int = 1

    def to_dict(self) -> dict:
        """The summary without map and residuals, for a JSON file."""
        skip = ("map", "residuals", "sigmas", "rows", "sign")
        plain = {item.name: getattr(self, item.name) for item in fields(self)}
        plain = {name: value for name, value in plain.items() if name not in skip}
        for name in ("outliers", "calibration"):
            plain[name] = [asdict(item) for item in plain[name]]
        named = {name: getattr(self.map, name) for name in ("valve", "direction", "rated_flow")}
        return named | plain


def fit_flow_map(
    valve: str,
    direction: str,
    readings: FlowmeterData,
    options: FlowMapOptions = FlowMapOptions(),  # noqa: B008
) -> FlowMapFit:
    """The flow map of one edge in one direction from readings, with intervals.

    Args:
        valve: name of the map, as ``direction``.
        readings: commands as openings; their valve and direction are not looked at.

    Raises:
        InsufficientData: fewer than 4 commands, fewer than 3 of them passing flow, fewer than 4
            drops, a flow that does not depend on the command, or readings that no map fits."""
    result = fit_readings(message("flow_maps.who", valve=valve, way=direction), readings, options)
    r, solution, deadband = result.readings, result.solution, result.deadband
    rated, residual, lag = r.rated, result.residuals, result.hysteresis
    scatter, outliers = _trial_scatter(result), _outliers(result)
    built = _map_of(result, scatter, valve, direction, outliers)
    residuals, sigmas = np.full((2, r.size), np.nan)
    residuals[r.row], sigmas[r.row] = rated * residual, result.sigmas
    leakage, ends = _leakage(result)
    smoothing = result.shape.smoothing / solution.cells.weight.sum()
    low, high = (0.0, 0.0) if lag is None else _interval(lag.value, lag.std)
    extrapolated = result.window.flows_at_lowest and r.commands[0] > 0
    status = "not_excited" if extrapolated else "at_bound" if deadband.at_bound else "estimated"
    fit = FlowMapFit(
        map=built,
        deadband=deadband.value,
        deadband_interval=deadband.interval,
        deadband_std=deadband.std,
        bracket=result.window.bracket,
        status=status,
        noise={key: (rated * low, share) for key, (low, share) in result.noise.methods.items()},
        replicates=result.noise.replicates,
        lack_of_fit=solution.lack,
        smoothing=(float(smoothing[0]), float(smoothing[1])),
        parameters=solution.parameters,
        readings=int(result.keep.sum()),
        cells=solution.cells.weighed,
        outliers=outliers,
        rms=rated * float(np.sqrt(np.mean(residual[result.keep] ** 2))),
        leakage=rated * leakage,
        leakage_interval=(rated * ends[0], rated * ends[1]),
        hysteresis=None if lag is None else round(lag.value, 4),
        hysteresis_interval=(round(low, 4), round(high, 4)),
        shift=r.shift,
        shift_interval=result.shift_interval,
        kinks=tuple((kink.value, *kink.interval) for kink in result.kinks),
        falls=_fall(built),
        trial_scatter=scatter,
        calibration=tuple(
            check_calibration(built, *each, options.reference_drop) for each in options.calibration
        ),
        residuals=residuals,
        sigmas=sigmas,
    )
    return replace(fit, warnings=(*_warnings(result, fit), *_features(result, fit)))


def _map_of(
    result: Fit, scatter: float, valve: str, direction: str, outliers: Sequence[Outlier]
) -> FlowMap:
    r, leak, deadband = result.readings, result.leak, result.deadband
    spline = result.solution.spline
    knots = _digits(deadband.value + spline.along_u.breaks * (spline.top - deadband.value), 10)
    knots[0] = deadband.value
    fine_u = np.unique([*knots, *(0.5 * (knots[1:] + knots[:-1])), *deadband.interval])
    even, roots = np.linspace(0.0, 1.0, 2 * r.spans + 1), r.roots
    fine_s = np.unique(np.concatenate([even, roots, 0.5 * (roots[1:] + roots[:-1])]))
    command, low, high = _hull(result)
    increments = spline.increments(result.solution.coefficients)
    more: dict[str, Any] = {}
    if leak and leak.goes_on:
        more["leakage"] = tuple(_digits([leak.root, leak.drop], 6) * r.rated)
        more["leakage_std"] = float(_digits([r.rated * leak.std], 4)[0])
    if np.any(spline.sign < 0):
        rising = int(np.count_nonzero(spline.sign == 1)) // spline.columns
        more["rising_to"] = float(knots[rising - 1])
    if result.hysteresis is not None and result.hysteresis.removed:
        more["hysteresis"] = round(result.hysteresis.value, 4)
    if r.shift:
        more["shift"] = float(_digits([r.shift / r.drop_max], 6)[0])
    if r.one_drop:
        # 24 spans along the root of the drop: the map rises within the first ones
        increments, low = np.repeat(increments, 24 + 2, axis=1), np.zeros_like(low)
        more["level"] = True
    return FlowMap(
        valve=valve,
        direction=direction,
        deadband=deadband.value,
        deadband_interval=deadband.interval,
        opening_knots=knots,
        drop_max=r.drop_max,
        delta=r.delta,
        increments=_digits(r.rated * increments, 10),
        hull_command=_digits(command, 10),
        hull_low=low,
        hull_high=high,
        std_command=_digits(fine_u, 10),
        std_root=_digits(fine_s * root_drop(r.drop_max, r.delta), 10),
        std=_digits(r.rated * _flow_std(result, fine_u, fine_s, scatter), 4),
        rated_flow=r.rated,
        samples=int(result.keep.sum()),
        outliers=tuple(outlier.sentence(r.show) for outlier in outliers),
        source=", ".join(name for name in np.unique(r.file).tolist() if name),
        **more,
    )


def _digits(values, count: int) -> np.ndarray:
    """Values to so many significant digits, without the last bits of a linear algebra library."""
    values = np.asarray(values, float)
    return np.array([float(f"{v:.{count - 1}e}") for v in values.ravel()]).reshape(values.shape)


def _interval(value: float, std: float) -> tuple[float, float]:
    """95 % interval of a number that is not negative."""
    return max(value - Z95 * std, 0.0), max(value + Z95 * std, 0.0)


def _hull(result: Fit) -> np.ndarray:
    """Rows commands [V], lowest and highest drop [Pa] read there; neighbouring commands are
    grouped."""
    r, group, u = result.readings, result.readings.level, result.readings.command
    if r.commands.size > 2 * SPLINE.spans:
        parts = np.arange(1, SPLINE.spans) / SPLINE.spans
        group = np.searchsorted(np.quantile(u, parts), u)
    rows = [np.flatnonzero((group == k) & result.keep) for k in np.unique(group)]
    table = np.array([(u[at].mean(), r.drop[at].min(), r.drop[at].max()) for at in rows if at.size])
    table[[0, -1], 0] = r.commands[[0, -1]]
    if table[0, 0] > 0 and not result.window.flows_at_lowest:
        # shut at the lowest command, so shut below it
        table = np.vstack([[0.0, *table[0, 1:]], table])
    return table.T


def _trial_scatter(result: Fit) -> float:
    """Standard error of the mean of the trials' factors [1] beyond the noise
    (DerSimonian–Laird)."""
    r, flow = result.readings, result.solution.flow
    keep = result.keep & (flow > 0) & ~result.solution.lone[r.cell]
    weight = np.where(keep, 1.0 / result.noise.std(r, flow) ** 2, 0.0)
    trials = np.unique(r.trial[keep])
    if trials.size < 2:
        return 0.0
    precision = np.array([np.sum((weight * flow**2)[r.trial == t]) for t in trials])
    product = weight * flow * result.residuals
    share = np.array([np.sum(product[r.trial == t]) for t in trials]) / precision
    mean = precision @ share / precision.sum()
    excess = precision @ (share - mean) ** 2 - (trials.size - 1)
    between = max(excess, 0.0) / (precision.sum() - np.sum(precision**2) / precision.sum())
    return float(np.sqrt(between / trials.size))


def _flow_std(result: Fit, u: np.ndarray, s: np.ndarray, scatter: float) -> np.ndarray:
    """Standard error of the scaled flow on the grid u × s, shape (u, s)."""
    r, solution = result.readings, result.solution
    opening, root = (a.ravel() for a in np.meshgrid(u, s, indexing="ij"))
    design = solution.spline.design(opening, root)
    variance = solution.widening * solution.variance(design)
    flow = design @ solution.coefficients
    # trials' common factors do not average over all where only some of the trials read
    levels = range(r.commands.size)
    counts = [np.unique(r.trial[result.keep & (r.level == k)]).size for k in levels]
    trials = np.unique(r.trial[result.keep]).size
    few = np.sqrt(trials / np.interp(opening, r.commands, np.maximum(counts, 1)))
    variance += (scatter * few * flow) ** 2
    variance += _missed(result, opening, root) + _between(result, opening, root)
    for sides, smoothing in _uncertain(result):
        low, high = (
            spline.design(opening - more * (root**2 - 0.5), root)
            @ regression(spline, result.used.shifted(more)).solve(smoothing)[0]
            for spline, more in sides
        )
        variance += ((high - low) / (2.0 * Z95)) ** 2
    scaled = r.delta / r.drop_max  # half of what s and a plain root of the drop differ by
    drop = root * np.sqrt(0.5 * root**2 + np.sqrt(0.25 * root**4 + scaled**2))
    variance += (0.5 * flow * (np.sqrt(drop) / np.maximum(root, 1e-12) - 1.0)) ** 2
    variance, flow = variance.reshape(u.size, s.size), flow.reshape(u.size, s.size)
    # what all commands and all drops are off by: no reading tells these from the valve
    for axis, places, std in ((0, u, r.command_std), (1, drop[: s.size], r.drop_std)):
        if std > 0.0:
            variance += (std * np.asarray(np.gradient(flow, places, axis=axis))) ** 2
    return np.sqrt(variance)


def _uncertain(
    result: Fit,
) -> Iterator[tuple[tuple[tuple[Spline, float], tuple[Spline, float]], np.ndarray]]:
    """For the deadband, its shift and each kink, the spline with it at either end of its interval,
    and the shift [V] more; for a soft start the one at the lower end, and the map's; with the
    penalties. The deadband's are those that its error is of: stiffer ones would tilt the whole map.
    """
    shape, deadband = result.shape, result.deadband
    if half := Z95 * deadband.std:
        low = max(deadband.value - half, 0.0)
        ends = (shape.spline(low), 0.0), (shape.spline(deadband.value + half), 0.0)
        yield ends, deadband.smoothing
    if deadband.interval[0] < deadband.value:
        soft = shape.spline(deadband.interval[0], soft=True)
        yield ((soft, 0.0), (shape.spline(), 0.0)), shape.smoothing
    if half := Z95 * result.shift_std:
        yield ((shape.spline(), -half), (shape.spline(), half)), shape.smoothing
    for kink in result.kinks:
        others = tuple(item.value for item in result.kinks if item is not kink)
        low, high = (
            replace(shape, kinks=(*others, kink.value + k * kink.std)).spline() for k in (-Z95, Z95)
        )
        yield ((low, 0.0), (high, 0.0)), shape.smoothing


def _missed(result: Fit, u: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Variance [rated²] by which cells near each point surely miss the map, beyond their noise."""
    r, solution, cells = result.readings, result.solution, result.solution.cells
    some = (cells.weight > 0) & (cells.u > result.deadband.value)
    if not some.any():
        return np.zeros(u.size)
    square = (cells.y - solution.at(cells.u, cells.s))[some] ** 2
    away = r.places(u, s)[:, None, :] - r.places(cells.u[some], cells.s[some])
    near = np.exp(-0.5 * np.sum(away**2, axis=2)) + 1e-12
    near /= near.sum(axis=1, keepdims=True)
    # the scatter of a mean of squares: what it exceeds the noise by must exceed 1.6 times that,
    # too
    sure = 1.0 + 1.6 * np.sqrt(2.0 * np.sum(near**2, axis=1))
    return np.maximum(near @ square - sure * (near @ (1.0 / cells.weight[some])), 0.0)


def _between(result: Fit, u: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Variance [rated²] of what a map does between the places measured: where one that bends
    sharply does so between the drops, and how the flow starts between the commands.

    A kink that changes the slope by κ inside a gap h leaves the chord by κ·h·w·(1 − w) at most, w
    from 0 to 1 in the gap; taken as two standard errors. Along the drops κ is the largest over this
    gap or its neighbours. Along the commands only the gaps on either side of the lowest one that
    passes flow count: farther up the smoothing tells."""
    r, at, first = result.readings, result.solution.at, result.window.opens
    roots = _chord(lambda root, opening: at(opening, root), r.roots, s, u, 1)
    near = np.clip(u, *r.levels[[max(first - 1, 0), first + 1]])
    start = _chord(at, r.levels, near, s, 0)
    sure = 0.25 * (1 + result.shape.along_s.kink)
    return (sure * roots) ** 2 + (0.25 * start) ** 2


def _chord(
    flow: Callable[[np.ndarray, np.ndarray], np.ndarray],
    places: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    reach: int,
) -> np.ndarray:
    """κ·h·w·(1 − w) of `_between` at points (x, y), κ the largest over so many gaps to either side
    of that of x between ``places``."""
    if places.size < 4:
        return np.zeros(x.size)
    gap = np.searchsorted(places[1:-1], x, side="right")
    each, row = np.unique(y, return_inverse=True)
    table = flow(np.tile(places, each.size), np.repeat(each, places.size))
    slopes = np.diff(table.reshape(each.size, places.size), axis=1) / np.diff(places)
    turn = np.pad(np.diff(slopes, axis=1), ((0, 0), (1, 1)))
    turn = np.abs(turn[:, 1:] + turn[:, :-1])  # a kink inside a gap shows half at either end
    width = np.diff(places)[gap]
    part = np.clip((x - places[gap]) / width, 0.0, 1.0)
    near = range(-reach, reach + 1)
    kink = np.max([turn[row, np.clip(gap + k, 0, places.size - 2)] for k in near], axis=0)
    return kink * width * part * (1.0 - part)


def _outliers(result: Fit) -> tuple[Outlier, ...]:
    r, out = result.readings, np.flatnonzero(~result.keep)
    return tuple(
        Outlier(
            str(r.file[i]),
            int(r.line[i]),
            float(r.command[i]),
            float(r.drop[i]),
            float(r.q[i] + r.rated * r.zeros.get(str(r.method[i]), 0.0)),
            round(float(result.sigmas[i]), 2),
        )
        for i in out[np.argsort(r.line[out], kind="stable")]
    )


def _leakage(result: Fit) -> tuple[float, tuple[float, float]]:
    """(mean scaled flow at commands below the deadband, its 95 % interval)."""
    r = result.readings
    shut = result.keep & (r.u <= result.deadband.interval[0])
    if not shut.any():
        return 0.0, (0.0, 0.0)
    mean = float(r.q[shut].mean()) / r.rated
    residual = (r.y - result.solution.flow)[shut]  # the leak is off these
    return mean, _interval(mean, float(np.sqrt(np.mean(residual**2) / shut.sum())))


def _fall(built: FlowMap) -> float:
    """Fall of the flow from its largest to the largest command at the largest drop, as a share."""
    if built.rising == built.opening_knots.size - 1:
        return 0.0
    drop = float(built.hull_high[-1])
    largest = np.max(built.flow(drop, np.linspace(built.deadband, built.command_max, 400)))
    return round(float(1.0 - built.flow(drop, built.command_max) / largest), 4)


def check_calibration(
    result: FlowMap, command: float, target: float, tolerance: float, reference: float | None
) -> Calibration:
    """A calibration point against the map, at the reference drop [Pa] or over the upper half."""
    low, high = (
        float(np.interp(command, result.hull_command, side))
        for side in (result.hull_low, result.hull_high)
    )
    low, high = (0.5 * (low + high), high) if reference is None else (reference, reference)
    drops = np.linspace(low, high, 21)
    flows = result.flow(drops, command)
    flow, std = float(np.mean(flows)), float(np.mean(result.flow_std(drops, command)))
    bounds = flow - Z95 * std, flow + Z95 * std
    band = target * (1 - tolerance), target * (1 + tolerance)
    if not result.hull_command[0] <= command <= result.hull_command[-1]:
        verdict = "not_measured"
    elif band[0] <= bounds[0] and bounds[1] <= band[1]:
        verdict = "met"
    else:
        verdict = "missed" if bounds[1] < band[0] or bounds[0] > band[1] else "undecided"
    lowest, highest = float(np.min(flows)), float(np.max(flows))
    return Calibration(
        command, target, tolerance, flow, *bounds, lowest, highest, low, high, verdict
    )


def _features(result: Fit, fit: FlowMapFit) -> Iterator[Message]:
    """Notes on what a valve does other than open smoothly with its command."""
    show, lag = result.readings.show, result.hysteresis

    def volts(value: float) -> str:
        return show.volts(round(value, 2))

    for method, zero in result.readings.zeros.items():
        yield message("flow_maps.zero", method=method, zero=show.flow(fit.map.rated_flow * zero, 3))
    if result.leak and fit.leakage:
        low, high = (show.flow(end, 3) for end in fit.leakage_interval)
        key = "flow_maps.leak_goes_on" if result.leak.goes_on else "flow_maps.leak_ends"
        yield message(key, leakage=show.flow(fit.leakage, 3), low=low, high=high)
    for value, low, high in fit.kinks:
        yield message("flow_maps.kink", command=volts(value), low=volts(low), high=volts(high))
    if fit.falls:
        top, end = volts(fit.map.rising_to), volts(fit.map.command_max)
        yield message("flow_maps.falls", above=top, share=fit.falls, end=end)
    if lag and lag.removed:
        low, high = fit.hysteresis_interval
        yield message("flow_maps.hysteresis", value=lag.value, low=low, high=high)
    if fit.shift:
        value, low, high = (show.volts(round(x, 3)) for x in (fit.shift, *fit.shift_interval))
        yield message("flow_maps.shift", value=value, low=low, high=high)
    if result.readings.one_drop:
        yield message("flow_maps.level")


def _warnings(result: Fit, fit: FlowMapFit) -> Iterator[Message]:
    r, solution, outlier = result.readings, result.solution, READING.outlier
    if fit.outliers:
        worst = max(fit.outliers, key=lambda item: abs(item.sigmas)).sentence(r.show)
        yield message(
            "flow_maps.outliers",
            count=len(fit.outliers),
            all=result.sigmas.size,
            sigmas=outlier,
            worst=worst,
        )
    for cell in np.flatnonzero(solution.lone):
        rows = result.keep & (r.cell == cell)
        if rows.any():
            yield message(
                "flow_maps.lone_cell",
                count=int(rows.sum()),
                command=r.show.volts(r.command[rows].mean()),
                drop=r.show.drop(r.drop[rows].mean()),
                off=float(np.mean((r.y - solution.flow)[rows])),
            )
    far = int(np.count_nonzero(result.keep & (np.abs(result.sigmas) > outlier)))
    if far > SETTINGS.far * result.sigmas.size:
        size = result.sigmas.size
        yield message("flow_maps.backed_outliers", count=far, all=size, sigmas=outlier)
    if not fit.replicates:
        yield message("flow_maps.no_repeats")
    wide = result.keep & (solution.flow > SETTINGS.wide)
    share = result.noise.std(r, solution.flow)[wide] / solution.flow[wide]
    if fit.replicates and share.size and np.median(share) > SETTINGS.scatter:
        yield message("flow_maps.scatter", share=float(np.median(share)))
    if solution.widening > SETTINGS.lack:
        yield message("flow_maps.lack_of_fit", times=solution.widening**0.5)
    if fit.status == "not_excited":
        yield message("flow_maps.not_excited", command=r.show.volts(r.commands[0]))
    if fit.trial_scatter > SETTINGS.trials:
        yield message("flow_maps.trial_scatter", share=fit.trial_scatter)
