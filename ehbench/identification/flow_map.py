"""Flowmeter readings to flow maps, with noise, deadband, outliers and intervals found from the
readings.

The spline of ``physics.flow_map`` is fitted by least squares on its positive increments with a
penalty on its curvature in either direction. Readings at one command and nearly one drop form a
cell: their scatter gives the noise, the cells' means the fit. What the fit leaves beyond the noise
widens every interval, and most where it was left."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ehbench.errors import InsufficientData
from ehbench.identification.flow_spline import SPANS_U, Axis, Spline
from ehbench.physics.flow_map import FlowMap, root_drop
from ehbench.quantities import VOCABULARY
from ehbench.terms import Z95
from ehbench.units import from_si

if TYPE_CHECKING:
    from ehbench.readers import FlowmeterData

OUTLIER_SIGMAS = 5.0
# more than this share far from the map is no accident, and stays in
_MOST_OUTLIERS = 0.05
# beyond these the readings are not those of a valve that opens with its command
_LEAST_EFFECT, _MOST_RMS, _MOST_LACK, _LACK_RMS = 0.1, 0.2, 100.0, 0.05
# what must be gained in −2 log likelihood for a curve over the drop that bends more at low drops,
# or sharply somewhere
_GRADED_GAIN, _BEND_GAIN = 4.0, 45.0
# no meter is better than this share of the rated flow; keeps weights finite on noise-free data
_LEAST_NOISE = 1e-4
# no driver's command is known better than this share of the largest one
_LEAST_WIDTH = 5e-4
# degrees of freedom of repeats from which on they tell the noise to some 20 %
_REPEATS = 12
_SPANS_S = 24
_COARSE = (-9.0, -7.0, -5.0, -3.0, -1.0)


@dataclass(frozen=True)
class Units:
    """How sentences show flows, drops and openings; ``sign``: of the commands that open the edge,
    as the driver gets them.
    """

    flow_unit: str = VOCABULARY["flow"].display
    pressure_unit: str = VOCABULARY["pressure_drop"].display
    sign: int = 1

    def volts(self, opening: float) -> str:
        return f"{self.sign * opening + 0.0:g} V"

    def flow(self, value: float, digits: int = 4) -> str:
        value = value if abs(value) > 1e-12 else 0.0  # m³/s, a nanolitre a second: below any meter
        return f"{from_si(value, self.flow_unit, VOCABULARY['flow']):.{digits}g} {self.flow_unit}"

    def drop(self, value: float) -> str:
        return f"{from_si(value, self.pressure_unit, VOCABULARY['pressure_drop']):.4g} {self.pressure_unit}"


@dataclass(frozen=True)
class Outlier:
    """A reading left out of the fit: file and line, command [V], drop [Pa], flow [m³/s], distance
    from the map in sigmas.
    """

    file: str
    line: int
    command: float
    pressure_drop: float
    flow: float
    sigmas: float

    def sentence(self, show: Units) -> str:
        where = f"{self.file}:{self.line}" if self.file else f"line {self.line}"
        point = f"{show.flow(self.flow)} at {show.volts(self.command)} and {show.drop(self.pressure_drop)}"
        return f"{where}: {point} lies {self.sigmas:+.1f} sigma from the map"


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

    def sentence(self, show: Units) -> str:
        if self.verdict == "not_measured":
            return f"{show.volts(self.command)} lies outside the measured commands: {show.flow(self.target)} there cannot be checked"
        gives = f"{show.volts(self.command)} gives {show.flow(self.flow)} ({show.flow(self.low)} to {show.flow(self.high)})"
        drops = show.drop(self.drop_low)
        drops = (
            f"at {drops}"
            if self.drop_low == self.drop_high
            else f"from {drops} to {show.drop(self.drop_high)}"
        )
        return f"{gives} {drops}, asked {show.flow(self.target)} ± {100 * self.tolerance:.3g} %: {self.verdict}"


@dataclass(frozen=True)
class FlowMapFit:
    """A map and how it was found. SI.

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
    ``leakage`` [m³/s]: mean flow at commands below the deadband, which the map takes as shut.
    ``trial_scatter``: standard error [1] of the mean of the trials' common factors beyond the
    noise. ``residuals`` [m³/s] and ``sigmas`` [1]: one a reading in the order given, NaN at drops
    of zero or less. ``warnings``: plain sentences."""

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
    trial_scatter: float
    calibration: tuple[Calibration, ...]
    residuals: np.ndarray = field(repr=False)
    sigmas: np.ndarray = field(repr=False)
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict:
        """The summary without map and residuals, for a JSON file."""
        skip = ("map", "residuals", "sigmas")
        plain = {
            name: getattr(self, name) for name in self.__dataclass_fields__ if name not in skip
        }
        plain["outliers"] = [asdict(one) for one in self.outliers]
        plain["calibration"] = [asdict(one) for one in self.calibration]
        return {
            "valve": self.map.valve,
            "direction": self.map.direction,
            "rated_flow": self.map.rated_flow,
            **plain,
        }


def fit_flow_map(
    valve: str,
    direction: str,
    command: np.ndarray,
    pressure_drop: np.ndarray,
    flow: np.ndarray,
    *,
    method: np.ndarray | None = None,
    trial: np.ndarray | None = None,
    line: np.ndarray | None = None,
    file: str | np.ndarray = "",
    meter_limit: float = 0.0,
    rated_flow: float | None = None,
    calibration: Sequence[tuple[float, float, float]] = (),
    reference_drop: float | tuple[float, float] | None = None,
    show: Units | None = None,
) -> FlowMapFit:
    """The flow map of one edge in one direction from readings, with intervals.

    Args:
        command: openings [V], shape (readings,), positive where the edge opens (times −1 for a
            spool's other half).
        pressure_drop: [Pa] along the direction; readings at a drop of zero or less say nothing and
            are left out.
        flow: [m³/s] along the direction.
        method: ``flowmeter`` or ``cylinder`` per reading; each has its own noise.
        trial: number per reading; trials that differ as a whole widen the intervals.
        file, line: where each reading stands, for naming outliers; ``file`` may be one for all.
        meter_limit: [m³/s] a flowmeter reading below it only says that the flow lies below it.
        rated_flow: [m³/s]; the largest fitted flow among the cells if not given.
        calibration: (command [V], flow [m³/s], tolerance as a share of the flow) to check.
        reference_drop: [Pa] or a range, where the calibration is checked; the upper half of the
            drops measured at the command if not given.
        show: units of the sentences; gpm and kPa if not given.

    Raises:
        InsufficientData: fewer than 4 commands, fewer than 3 of them passing flow, fewer than 4
            drops, a flow that does not depend on the command, or readings that no map fits.
    """
    who = f"flow map of '{valve}' ({direction})"
    readings = _readings(who, command, pressure_drop, flow, method, trial, file, line, meter_limit)
    fit = _Fit(who, readings, rated_flow, show or Units())
    fit.run()
    return fit.summary(valve, direction, calibration, reference_drop)


def fit_flow_maps(data: FlowmeterData, **options) -> list[FlowMapFit]:
    """One fit for each valve and direction in the readings, sorted by name; options as
    ``fit_flow_map``.

    Raises:
        InsufficientData: a valve has too few readings.
    """
    names = ("command", "pressure_drop", "flow", "method", "trial", "file", "line")
    rows = ((group, data.select(*group)) for group in data.groups())
    return [
        fit_flow_map(*group, **{name: getattr(part, name) for name in names}, **options)
        for group, part in rows
    ]


@dataclass
class _Readings:
    """Readings at positive drops; ``silent`` are those below the lower ``limit`` [m³/s] of their
    meter.
    """

    size: int
    row: np.ndarray
    u: np.ndarray
    drop: np.ndarray
    q: np.ndarray
    method: np.ndarray
    trial: np.ndarray
    file: np.ndarray
    line: np.ndarray
    cell: np.ndarray
    level: np.ndarray
    limit: np.ndarray
    silent: np.ndarray


def _clusters(values: np.ndarray, share: float, width: float) -> np.ndarray:
    """Label of the cluster of each value; a cluster spans at most share·(its least value) + width."""
    order = np.argsort(values, kind="stable")
    labels = np.empty(values.size, int)
    start, label = -np.inf, -1
    for i in order:
        if values[i] > start + share * abs(start) + width or label < 0:
            start, label = values[i], label + 1
        labels[i] = label
    return labels


def _readings(who, command, drop, flow, method, trial, file, line, meter_limit) -> _Readings:
    """Readings at positive drops, in an order that does not depend on the file's, gathered in
    cells.
    """
    u, drop, q = (np.asarray(a, float) for a in (command, drop, flow))
    if not (u.ndim == 1 and u.shape == drop.shape == q.shape):
        raise ValueError(
            "command, pressure_drop and flow must be one-dimensional and of one length"
        )
    if not np.all(np.isfinite([u, drop, q])):
        raise ValueError("command, pressure_drop and flow must be finite")
    if np.any(u < 0):
        raise ValueError(
            "openings must not be negative: multiply the command by the sign of the edge"
        )
    n = u.size
    method = np.full(n, "flowmeter") if method is None else np.asarray(method).astype(str)
    file = np.full(n, file) if isinstance(file, str) else np.asarray(file).astype(str)
    trial = np.zeros(n, int) if trial is None else np.asarray(trial, int)
    line = np.arange(1, n + 1) if line is None else np.asarray(line, int)
    use = np.flatnonzero(drop > 0)
    if use.size == 0:
        raise InsufficientData(f"the {who} has no reading at a pressure drop above zero")
    use = use[np.lexsort((line[use], q[use], drop[use], u[use]))]
    trial = (
        np.unique(file, return_inverse=True)[1] * (trial.max() + 1) + trial
    )  # trial 1 of two files is two trials
    u, drop, q, method, trial, file, line = (
        a[use] for a in (u, drop, q, method, trial, file, line)
    )

    level = _clusters(u, 0.0, 0.005 * max(u.max(), 1e-12))
    u_level = np.bincount(level, u) / np.bincount(level)
    key = np.empty((u.size, 3), int)
    key[:, 0], key[:, 2] = level, method == "cylinder"
    for k in range(u_level.size):
        at = level == k
        key[at, 1] = _clusters(drop[at], 0.03, 0.003 * drop.max())
    cell = np.unique(key, axis=0, return_inverse=True)[1].ravel()

    drops = np.unique(_clusters(drop, 0.03, 0.003 * drop.max())).size
    if u_level.size < 4:
        raise InsufficientData(
            f"the {who} has readings at {u_level.size} commands",
            hint="4 or more are needed, 3 of them passing flow",
        )
    if drops < 4:
        raise InsufficientData(
            f"the {who} has readings at {drops} pressure drops",
            hint="4 or more different ones are needed",
        )
    limit = np.where(method != "cylinder", meter_limit, 0.0)
    silent = (limit > 0) & (q < limit)
    return _Readings(
        n,
        use,
        u,
        drop,
        np.where(silent, 0.0, q),
        method,
        trial,
        file,
        line,
        cell,
        level,
        limit,
        silent,
    )


class _Fit:
    """The steps of one fit, in order: ``run`` and then ``summary``. Flows are scaled by ``rated``
    inside.
    """

    def __init__(self, who: str, readings: _Readings, rated: float | None, show: Units) -> None:
        self.who, self.r, self.show = who, readings, show
        self.keep = np.ones(readings.q.size, bool)
        self.levels = np.bincount(readings.level, readings.u) / np.bincount(readings.level)
        largest = np.sort(_medians(readings.q, readings.cell))
        while (
            largest.size > 4 and largest[-1] > 4.0 * largest[-2] > 0.0
        ):  # a slip of the pen, to be left out below
            largest = largest[:-1]
        self.rated = float(rated) if rated else float(largest[-1])
        if not self.rated > 0:
            raise InsufficientData(
                f"the {who} passes no flow at any command",
                hint="3 or more commands above the deadband are needed",
            )
        self.y = readings.q / self.rated
        self.drop_max = float(readings.drop.max())
        least = float(np.quantile(readings.drop, 0.02))
        # an orifice bends by 1 % at five times delta; the bounds keep the slope at zero finite and
        # the bend out of sight
        self.delta = float(np.clip(least / 5.0, 1e-3 * self.drop_max, 1e-2 * self.drop_max))
        self.s = root_drop(readings.drop, self.delta) / root_drop(self.drop_max, self.delta)
        cluster = _clusters(readings.drop, 0.03, 0.003 * self.drop_max)
        self.refuse_idle(cluster)
        self.spans = self.count_spans(cluster)
        self.along_s = Axis(np.linspace(0.0, 1.0, self.spans + 1), 3)
        self.cell_level = _medians(readings.level, readings.cell).astype(int)
        self.noise = {name: (3e-3, 1e-2) for name in sorted(set(readings.method.tolist()))}
        self.digit = {name: _step(self.y[readings.method == name]) / 12**0.5 for name in self.noise}
        self.replicates, self.lack, self.trial_scatter = 0, 1.0, 0.0
        self.smoothing = np.array([1e-2, 1e-2])

    def count_spans(self, cluster: np.ndarray) -> int:
        """Spans along the root of the drop: as narrow as the closest drops measured, the penalty
        sees to the rest.

        Sets ``roots`` of those drops, with zero; empty where they are too many to leave gaps.
        """
        places = np.sort(np.bincount(cluster, self.s) / np.bincount(cluster))
        self.roots = np.append(0.0, places) if places.size <= 2 * _SPANS_S else places[:0]
        return int(np.clip(np.ceil(1.0 / np.diff(places).min()), 3, _SPANS_S))

    def refuse_idle(self, cluster: np.ndarray) -> None:
        """Refuses readings whose flow at one drop is nearly the same at every command."""
        r, at = (
            self.r,
            np.unique(np.column_stack([cluster, self.r.level]), axis=0, return_inverse=True),
        )
        middle, drop = _medians(self.y, at[1].ravel()), at[0][:, 0]
        spread = [
            np.ptp(middle[drop == k]) for k in np.unique(drop) if np.count_nonzero(drop == k) > 1
        ]
        if spread and np.median(spread) < _LEAST_EFFECT:
            raise InsufficientData(
                f"the {self.who} does not depend on the command: at one drop the flow changes by "
                f"{100 * np.median(spread):.2g} % of the largest flow between {self.show.volts(r.u.min())} and "
                f"{self.show.volts(r.u.max())}",
                hint="check that the command reached the valve, and the columns of the file",
            )

    # readings and cells
    def std(self, flow: np.ndarray) -> np.ndarray:
        """Standard deviation of each single reading, given the map's flow there."""
        floor, share, digit = np.array([(*self.noise[m], self.digit[m]) for m in self.r.method]).T
        return np.sqrt(np.maximum(floor**2 + (share * flow) ** 2, digit**2) + _LEAST_NOISE**2)

    def cells(self, flow: np.ndarray):
        """(command, root, flow, weight) of the mean of the kept readings of each cell; weight 0
        where none is kept.
        """
        r, limit, std = self.r, self.r.limit / self.rated, self.std(flow)
        self.y = np.where(r.silent, np.clip(flow, 0.0, limit), self.y)
        # whether a reading counts must not hang on its own noise, so the map says whether the meter
        # turns
        weight = np.where(
            self.keep & ((limit == 0) | (flow > limit + 2.0 * std)), 1.0 / std**2, 0.0
        )
        total = np.bincount(r.cell, weight)
        mean = [
            np.bincount(r.cell, weight * a) / np.maximum(total, 1e-300)
            for a in (r.u, self.s, self.y)
        ]
        return *mean, total

    def measure_noise(self, flow: np.ndarray) -> None:
        """Noise per method from the scatter inside cells about the map's course; from the residuals
        without repeats.
        """
        r, keep = self.r, self.keep
        residual = self.y - flow
        dof_all = 0
        for name in self.noise:
            use = keep & (r.method == name) & ~r.silent
            count = np.bincount(r.cell[use], minlength=r.cell.max() + 1)
            mean = np.bincount(r.cell[use], residual[use], count.size) / np.maximum(count, 1)
            inside = residual - mean[r.cell]
            dof = np.where(use, 1.0 - 1.0 / np.maximum(count, 1)[r.cell], 0.0)
            if dof.sum() < 6:
                inside, dof = residual, np.where(use, np.maximum(1.0 - self.leverage, 0.1), 0.0)
            else:
                dof_all += int(round(dof.sum()))
            if dof.sum() > 0:
                self.noise[name] = _growing(inside[use] ** 2, dof[use], flow[use])
        self.replicates = dof_all

    # the fit
    def spline(self, deadband: float, soft: bool = False) -> Spline:
        return Spline(deadband, self.levels[self.opens :], self.along_s, soft)

    def normal(self, spline: Spline, cells):
        """(design, normal matrix, right side) of the cells' means."""
        u, s, y, weight = cells
        design = spline.design(u, s)
        used, root = (weight > 0) & (u > spline.deadband), np.sqrt(weight)
        rows = root[used, None] * design[used]
        return design, rows.T @ rows, rows.T @ (root * y)[used]

    def choose_smoothing(
        self, cells, u=_COARSE, s=_COARSE, fine: bool = True, normal=None
    ) -> float:
        """Penalties by restricted maximum likelihood, the scale of the noise left free (Wood 2011);
        −2 log of it.

        ``u``, ``s``: decadic logarithms of the penalties to begin with; the present ones if none
        are given."""
        spline = self.spline(self.deadband)
        _, gram, right = normal or self.normal(spline, cells)
        band = spline.banded(gram)
        total, n, unit = (
            float(cells[3] @ cells[2] ** 2),
            np.count_nonzero(cells[3]),
            float(cells[3].sum()),
        )

        def score(point: tuple[float, float]) -> float:
            free, determinant = spline.free(band, right, 10.0 ** np.array(point) * unit)
            return self.deviance(max(total - right @ free, 1e-12 * total), n) + determinant

        now = np.clip(np.round(4 * np.log10(self.smoothing / unit)) / 4, -12, 0)
        best, value = _lattice_minimum(
            score, u or now[:1].tolist(), s or now[1:].tolist(), (1.0, 0.5, 0.25) if fine else ()
        )
        self.smoothing = 10.0 ** np.array(best) * unit
        return value

    def deviance(self, misfit: float, cells: int) -> float:
        """−2 log likelihood of a penalised misfit; its scale is free, but where repeats tell the
        noise not below that.

        Were it free below, a map through every cell could pass for one without noise. Without
        repeats the noise of the last turn counts as much as a quarter of the cells, for the same
        reason."""
        scale = misfit / (cells - 1)
        if self.replicates >= _REPEATS and scale < 1.0:
            return misfit - (cells - 1)
        if not self.replicates:
            scale = (scale + 0.25) / 1.25
        return (cells - 1) * np.log(scale)

    def bend(self, cells) -> None:
        """Lets the map bend more towards low drops, and sharply at one drop, where that makes the
        readings likelier.
        """
        normal = self.normal(self.spline(self.deadband), cells)  # the same for all
        straight, options = self.along_s, []
        for power in (0.0, 1.0, 2.0, 4.0):
            self.along_s = straight.graded(power)
            options.append(
                (
                    self.choose_smoothing(cells, normal=normal) + _GRADED_GAIN * (power > 0),
                    power,
                    self.along_s,
                    self.smoothing,
                )
            )
        plain, _, straight, smoothing = min(options, key=lambda one: one[0])
        options = []
        for k in range(1, self.spans):
            self.along_s, self.smoothing = straight.bent(k), smoothing
            options.append(
                (
                    self.choose_smoothing(cells, (), _COARSE, False, normal),
                    k,
                    self.along_s,
                    self.smoothing,
                )
            )
        _, _, self.along_s, self.smoothing = min(options, key=lambda one: one[0])
        if self.choose_smoothing(cells) > plain - _BEND_GAIN:
            self.along_s, self.smoothing = straight, smoothing

    def start_deadband(self, cells) -> None:
        """The likeliest of a few deadbands, each with its own smoothing: one far off would call for
        a wrong smoothing.
        """
        low, high = self.window(cells)
        options = []
        for self.deadband in np.linspace(low, high, 13):
            options.append(
                (self.choose_smoothing(cells, s=(), fine=False), self.deadband, self.smoothing)
            )
        _, self.deadband, self.smoothing = min(options, key=lambda one: one[0])

    def window(self, cells) -> tuple[float, float]:
        """Range of the deadband [V]: from the last but one command that may be shut to just below
        the first that is not.
        """
        self.opens = k = self.first_flow(cells)
        below = float(self.levels[k - 1]) if k else 0.0
        self.bracket, self.flows_at_lowest = (below, float(self.levels[k])), k == 0
        seen = np.flatnonzero(np.bincount(self.cell_level, cells[3])[: max(k - 1, 0)])
        low = float(self.levels[seen[-2:][0]]) if seen.size else 0.0
        return low, float(self.levels[k]) - 0.02 * (float(self.levels[k]) - below)

    def solve(self, spline: Spline, cells):
        """(coefficients, −2 log likelihood of the spline's deadband with the scale of the noise
        left free).
        """
        _, gram, right = self.normal(spline, cells)
        c, determinant = spline.solve(gram, right, self.smoothing)
        misfit = float(cells[3] @ cells[2] ** 2) + c @ (
            spline.matrix(gram, self.smoothing) @ c - 2 * right
        )
        return c, self.deviance(max(misfit, 1e-12), np.count_nonzero(cells[3])) + determinant

    def first_flow(self, cells) -> int:
        """Index of the lowest command that passes flow for sure, and so do all above it."""
        _, _, y, weight = cells
        total = np.maximum(np.bincount(self.cell_level, weight), 1e-300)
        mean = np.bincount(self.cell_level, weight * y) / total
        shut = np.flatnonzero((mean * np.sqrt(total / self.lack) <= 4.0) | (mean <= 1e-3))
        first = int(shut[-1]) + 1 if shut.size else 0
        if self.levels.size - first < 3:
            raise InsufficientData(
                f"the {self.who} passes flow at {self.levels.size - first} of its {self.levels.size} commands",
                hint="3 or more commands above the deadband are needed",
            )
        return first

    def find_deadband(self, cells) -> None:
        """Deadband by its profile likelihood, if the flow starts with a kink: the best, its
        standard deviation, 95 % interval.
        """
        window = self.window(cells)
        self.deadband, self.deadband_std, self.deadband_interval, self.at_bound = (
            0.0,
            0.0,
            (0.0, 0.0),
            True,
        )
        if window[1] <= window[0]:
            return
        least = _LEAST_WIDTH * float(self.levels[-1])
        grid, rise = self.profile(cells, *window, soft=False)
        best = int(np.argmin(rise))
        self.deadband = round(_lowest(grid, rise, best), 4)
        weight = np.exp(-0.5 * rise)
        spread = weight @ (grid - self.deadband) ** 2 / weight.sum() + (grid[1] - grid[0]) ** 2 / 12
        self.deadband_std = float(np.sqrt(spread))
        level = 10.83 if self.flows_at_lowest else 3.841  # an extrapolation is worth less
        lower, upper = (_crossing(grid[best::way], rise[best::way], level) for way in (-1, 1))
        self.at_bound = lower <= 0.0
        lower, upper = (
            max(min(lower, self.deadband - least), 0.0),
            max(upper, self.deadband + least),
        )
        self.deadband_interval = (round(lower, 4), round(upper, 4))

    def soften(self, cells) -> None:
        """Lowers the lower end of the deadband's interval to where a flow with a soft start would
        begin.

        That is the lower end for a spline which may curve at will over the first commands that pass
        flow. Such splines end with a parabola that starts level, a shape which valves do have: the
        end is taken at 99.9 %."""
        low, high = self.window(cells)
        if high <= low:
            return
        grid, rise = self.profile(cells, low, high, soft=True)
        best = int(np.argmin(rise))
        lower, upper = self.deadband_interval
        self.deadband_interval = (
            round(min(lower, _crossing(grid[best::-1], rise[best::-1], 10.83)), 4),
            upper,
        )

    def profile(self, cells, low: float, high: float, soft: bool):
        """(deadbands [V], −2 log likelihood of each above the least), about the likely ones."""
        for _ in range(5):
            grid = np.linspace(low, high, 15)
            value = np.array([self.solve(self.spline(u, soft), cells)[1] for u in grid])
            rise = value - value.min()
            near = np.flatnonzero(rise < 14.0)
            if near.size > 7 or high - low < 1e-3 * self.levels[-1]:
                break
            low, high = grid[max(near[0] - 1, 0)], grid[min(near[-1] + 1, 14)]
        return grid, rise

    def leak(self) -> float:
        """Scaled flow that surely passes at 0 V, if 0 V was measured and the flow there is small;
        else 0.
        """
        at = (self.r.level == 0) & (self.r.u == 0) & ~self.r.silent
        if at.sum() < 4:
            return 0.0
        middle = float(np.median(self.y[at]))
        error = 1.4826 * float(np.median(np.abs(self.y[at] - middle))) / np.sqrt(at.sum())
        return middle if middle > max(1e-3, 4.0 * error) else 0.0

    def guess(self) -> np.ndarray:
        """Flow by a robust fit to the cells' medians; leaves out what lies far from it."""
        r = self.r
        leak = self.leak()
        self.leaks = leak > 0
        passes = _medians(_medians(self.y, r.cell), self.cell_level) > max(5e-3, 1.5 * leak)
        k = min(
            int(np.flatnonzero(~passes)[-1]) + 1 if not passes.all() else 0, self.levels.size - 3
        )
        if leak:  # what passes no more than the leak is shut; the leak is told apart from the map
            shut = r.level < k
            self.y = self.y - shut * np.polyval(np.polyfit(self.s[shut], self.y[shut], 2), self.s)
        u, s, _, weight = self.cells(self.y)
        y = _medians(self.y, r.cell)
        self.opens, self.deadband = (
            k,
            0.5 * float(self.levels[k - 1] + self.levels[k]) if k else 0.0,
        )
        spline = self.spline(self.deadband)
        self.smoothing = np.full(2, 1e-5 * weight.sum())
        coefficients, _ = self.solve(spline, (u, s, y, weight))
        flow = spline.design(r.u, self.s) @ coefficients
        size = np.abs(self.y - flow) / self.std(flow)
        far = size > 1.5 * OUTLIER_SIGMAS * max(1.4826 * float(np.median(size[flow > 0])), 0.1)
        self.keep = ~self.few(far & self.alone(flow), size)
        return flow

    def alone(self, flow: np.ndarray) -> np.ndarray:
        """True for readings that no repeats back: those that do not agree with theirs within the
        noise, or have none.

        What repeats back is the valve's own, and a map that misses it lacks fit there.
        """
        r, residual = self.r, self.y - flow
        count = np.bincount(r.cell)
        high, low = np.full(count.size, -np.inf), np.full(count.size, np.inf)
        np.maximum.at(high, r.cell, residual)
        np.minimum.at(low, r.cell, residual)
        agree = high - low <= OUTLIER_SIGMAS * np.sqrt(
            np.bincount(r.cell, self.std(flow) ** 2) / count
        )
        return ~(agree & (count > 1))[r.cell]

    def places(self, u: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Commands and roots counted in commands measured and spans, shape (points, 2)."""
        return np.column_stack(
            [np.interp(u, self.levels, np.arange(self.levels.size)), s * self.spans]
        )

    def few(self, out: np.ndarray, size: np.ndarray) -> np.ndarray:
        """The farthest of the readings ``out``, no more than a small share of all."""
        most = max(3, int(_MOST_OUTLIERS * out.size))
        farthest = np.argsort(np.where(out, -size, np.inf), kind="stable")[:most]
        return out & np.isin(np.arange(out.size), farthest)

    def run(self) -> None:
        """Alternate noise, fit and outliers until the outliers stay the same, then find the
        deadband and do it again.
        """
        flow = self.guess()
        self.leverage = (
            (flow > 0) * (self.spline(self.deadband).rows + 3) / np.count_nonzero(flow > 0)
        )
        for final in (False, True):
            for turn in range(40):
                self.measure_noise(flow)
                cells = self.cells(flow)
                if final and not turn:
                    self.bend(cells)
                    self.start_deadband(cells)
                self.choose_smoothing(cells)
                if final:
                    self.find_deadband(cells)
                    self.choose_smoothing(cells)
                flow = self.judge(cells)
                self.sigmas = self.distances(flow)
                far, before = np.abs(self.sigmas), self.keep
                # the farthest first: what seems far beside it may be near once it is out
                alone = self.alone(flow)
                worst = max(OUTLIER_SIGMAS, 0.75 * float(far[before & alone].max(initial=0.0)))
                self.keep = ~self.few(alone & (far > np.where(before, worst, OUTLIER_SIGMAS)), far)
                if turn > 20:  # no coming and going for ever
                    self.keep &= before
                if np.array_equal(before, self.keep):
                    break
        self.soften(cells)
        self.flow = flow
        self.refuse_misfit()

    def refuse_misfit(self) -> None:
        """Refuses a map that says nothing of the readings."""
        rms = float(np.sqrt(np.mean((self.y - self.flow)[self.keep] ** 2)))
        if rms > _MOST_RMS or (self.lack > _MOST_LACK and rms > _LACK_RMS):
            raise InsufficientData(
                f"no map fits the readings of the {self.who}: they lie {100 * rms:.2g} % of the rated flow "
                "from the best one (rms)",
                hint="check the columns, and that the flow grows with the command at every drop",
            )

    def distances(self, flow: np.ndarray) -> np.ndarray:
        """Distance of each reading from the map in standard deviations of that distance.

        A reading in the fit draws the map to itself, one left out stands against the map's own
        error."""
        from scipy.linalg import solve_triangular

        design = self.final.design(self.r.u, self.s) * (self.r.u > self.deadband)[:, None]
        error = np.sum(solve_triangular(self.factor, design.T, lower=True) ** 2, axis=0)
        noise = self.std(flow) ** 2
        self.leverage = error / noise
        return (self.y - flow) / np.sqrt(
            np.where(self.keep, np.maximum(noise - error, 0.1 * noise), noise + error)
        )

    def judge(self, cells) -> np.ndarray:
        """Flow of the fit at each reading; sets coefficients, their covariance's factor, parameters
        and lack of fit.
        """
        self.final = spline = self.spline(self.deadband)
        design, gram, right = self.normal(spline, cells)
        self.factor = np.linalg.cholesky(spline.matrix(gram, self.smoothing))
        self.coefficients, _ = spline.solve(gram, right, self.smoothing)
        half = np.linalg.solve(self.factor, gram)
        self.parameters = float(np.trace(np.linalg.solve(self.factor.T, half)))
        misfit = float(cells[3] @ (cells[2] - design @ self.coefficients) ** 2)
        self.lack = max(1.0, misfit / max(np.count_nonzero(cells[3]) - self.parameters, 1.0))
        self.judged = cells
        return spline.design(self.r.u, self.s) @ self.coefficients

    # what leaves
    def flow_std(self, u: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Standard error of the scaled flow on the grid u × s: coefficients, deadband and scatter
        of whole trials.
        """
        from scipy.linalg import solve_triangular

        at, root = (a.ravel() for a in np.meshgrid(u, s, indexing="ij"))
        design = self.final.design(at, root)
        variance = self.lack * np.sum(
            solve_triangular(self.factor, design.T, lower=True) ** 2, axis=0
        )
        flow = design @ self.coefficients
        variance += self.missed(at, root) + self.between(at, root)
        sides = [max(self.deadband + k * self.deadband_std, 0.0) for k in (-1, 1)]
        if self.deadband_std > 0:
            moved = [
                spline.design(at, root) @ self.solve(spline, self.judged)[0]
                for spline in map(self.spline, sides)
            ]
            variance += 0.25 * (moved[1] - moved[0]) ** 2
        scaled = self.delta / self.drop_max  # half of what s and a plain root of the drop differ by
        drop = root * np.sqrt(0.5 * root**2 + np.sqrt(0.25 * root**4 + scaled**2))
        variance += (0.5 * flow * (np.sqrt(drop) / np.maximum(root, 1e-12) - 1.0)) ** 2
        return np.sqrt(variance + (self.trial_scatter * flow) ** 2).reshape(u.size, s.size)

    def missed(self, u: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Variance [rated²] by which the cells near each point surely miss the map, beyond their
        noise.
        """
        cell_u, cell_s, y, weight = self.judged
        some = (weight > 0) & (cell_u > self.deadband)
        if not some.any():
            return np.zeros(u.size)
        square = (y - self.final.design(cell_u, cell_s) @ self.coefficients)[some] ** 2
        away = self.places(u, s)[:, None, :] - self.places(cell_u[some], cell_s[some])
        near = np.exp(-0.5 * np.sum(away**2, axis=2)) + 1e-12
        near /= near.sum(axis=1, keepdims=True)
        # the scatter of a mean of squares: what it exceeds the noise by must exceed 1.6 times that,
        # too
        sure = 1.0 + 1.6 * np.sqrt(2.0 * np.sum(near**2, axis=1))
        return np.maximum(near @ square - sure * (near @ (1.0 / weight[some])), 0.0)

    def between(self, u: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Variance [rated²] of where a map that bends sharply does so between the drops measured;
        else zero.

        A kink that changes the slope by κ inside a gap h leaves the chord by κ·h·w·(1 − w) at most,
        w from 0 to 1 in the gap; taken as two standard errors, with the largest change of slope
        over this gap or one beside it as κ: a spline rings."""
        roots = self.roots
        if roots.size < 4:
            return np.zeros(u.size)
        gap = np.clip(np.searchsorted(roots, s, side="right") - 1, 0, roots.size - 2)
        each, row = np.unique(u, return_inverse=True)
        flow = (
            self.final.design(np.repeat(each, roots.size), np.tile(roots, each.size))
            @ self.coefficients
        )
        turn = np.diff(
            np.diff(flow.reshape(each.size, roots.size), axis=1) / np.diff(roots), axis=1
        )
        turn = np.pad(turn, ((0, 0), (1, 1)))
        turn = np.abs(turn[:, 1:] + turn[:, :-1])  # a kink inside a gap shows half at either end
        width = np.diff(roots)[gap]
        part = np.clip((s - roots[gap]) / width, 0.0, 1.0)
        kink = np.max([turn[row, np.clip(gap + k, 0, roots.size - 2)] for k in (-1, 0, 1)], axis=0)
        sure = 0.5 if self.along_s.kink else 0.25
        return (sure * kink * width * part * (1.0 - part)) ** 2

    def compare_trials(self) -> None:
        """Standard error of the mean of the trials' common factors [1], beyond what the noise
        explains (DerSimonian–Laird).
        """
        r, keep = self.r, self.keep & (self.flow > 0)
        weight = np.where(keep, 1.0 / self.std(self.flow) ** 2, 0.0)
        trials = np.unique(r.trial[keep])
        if trials.size < 2:
            return
        precision = np.array([np.sum((weight * self.flow**2)[r.trial == t]) for t in trials])
        share = (
            np.array(
                [np.sum((weight * self.flow * (self.y - self.flow))[r.trial == t]) for t in trials]
            )
            / precision
        )
        mean = precision @ share / precision.sum()
        excess = precision @ (share - mean) ** 2 - (trials.size - 1)
        between = max(excess, 0.0) / (precision.sum() - np.sum(precision**2) / precision.sum())
        self.trial_scatter = float(np.sqrt(between / trials.size))

    def hull(self):
        """(commands [V], least, largest drop [Pa] read there); many commands are taken in groups of
        neighbours.
        """
        r, group = self.r, self.r.level
        if self.levels.size > 2 * SPANS_U:
            group = np.searchsorted(np.quantile(r.u, np.arange(1, SPANS_U) / SPANS_U), r.u)
        parts = [np.flatnonzero((group == k) & self.keep) for k in np.unique(group)]
        hull = np.array(
            [(r.u[at].mean(), r.drop[at].min(), r.drop[at].max()) for at in parts if at.size]
        )
        hull[[0, -1], 0] = self.levels[[0, -1]]
        if (
            hull[0, 0] > 0 and not self.flows_at_lowest
        ):  # shut at the lowest command, so shut below it
            hull = np.vstack([[0.0, *hull[0, 1:]], hull])
        return hull.T

    def to_map(self, valve: str, direction: str, outliers: tuple[str, ...]) -> FlowMap:
        r, spline = self.r, self.final
        knots = _digits(self.deadband + spline.along_u.breaks * (spline.top - self.deadband), 10)
        knots[0] = self.deadband
        fine_u = np.unique(
            np.concatenate([knots, 0.5 * (knots[1:] + knots[:-1]), self.deadband_interval])
        )
        roots = self.roots
        fine_s = np.unique(
            np.concatenate(
                [np.linspace(0.0, 1.0, 2 * self.spans + 1), roots, 0.5 * (roots[1:] + roots[:-1])]
            )
        )
        command, low, high = self.hull()
        return FlowMap(
            valve=valve,
            direction=direction,
            deadband=self.deadband,
            deadband_interval=self.deadband_interval,
            opening_knots=knots,
            drop_max=self.drop_max,
            delta=self.delta,
            increments=_digits(self.rated * spline.increments(self.coefficients), 10),
            hull_command=_digits(command, 10),
            hull_low=low,
            hull_high=high,
            std_command=_digits(fine_u, 10),
            std_root=_digits(fine_s * root_drop(self.drop_max, self.delta), 10),
            std=_digits(self.rated * self.flow_std(fine_u, fine_s), 4),
            rated_flow=self.rated,
            samples=int(self.keep.sum()),
            outliers=outliers,
            source=", ".join(name for name in np.unique(r.file).tolist() if name),
        )

    def summary(self, valve, direction, calibration, reference_drop) -> FlowMapFit:
        r = self.r
        self.compare_trials()
        out = np.flatnonzero(~self.keep)
        outliers = tuple(
            Outlier(
                str(r.file[i]),
                int(r.line[i]),
                float(r.u[i]),
                float(r.drop[i]),
                float(r.q[i]),
                round(float(self.sigmas[i]), 2),
            )
            for i in out[np.argsort(r.line[out], kind="stable")]
        )
        found = self.to_map(valve, direction, tuple(one.sentence(self.show) for one in outliers))
        residuals, sigmas = np.full((2, r.size), np.nan)
        residuals[r.row], sigmas[r.row] = self.rated * (self.y - self.flow), self.sigmas
        shut = self.keep & (r.u <= self.deadband_interval[0])
        leakage = float(r.q[shut].mean()) / self.rated if shut.any() else 0.0
        return FlowMapFit(
            map=found,
            deadband=self.deadband,
            deadband_interval=self.deadband_interval,
            deadband_std=self.deadband_std,
            bracket=self.bracket,
            status=self.status,
            noise={
                name: (self.rated * floor, share) for name, (floor, share) in self.noise.items()
            },
            replicates=self.replicates,
            lack_of_fit=self.lack,
            smoothing=tuple(float(v) for v in self.smoothing / self.judged[3].sum()),
            parameters=self.parameters,
            readings=int(self.keep.sum()),
            cells=int(np.count_nonzero(self.judged[3])),
            outliers=outliers,
            rms=self.rated * float(np.sqrt(np.mean((self.y - self.flow)[self.keep] ** 2))),
            leakage=self.rated * leakage,
            trial_scatter=self.trial_scatter,
            calibration=tuple(_check(found, *point, reference_drop) for point in calibration),
            residuals=residuals,
            sigmas=sigmas,
            warnings=tuple(self.warnings(outliers, leakage if self.leaks else 0.0)),
        )

    @property
    def status(self) -> str:
        if self.flows_at_lowest and self.levels[0] > 0:
            return "not_excited"
        return "at_bound" if self.at_bound else "estimated"

    def warnings(self, outliers: tuple[Outlier, ...], leakage: float) -> Iterator[str]:
        n = self.y.size
        if outliers:
            worst = max(outliers, key=lambda one: abs(one.sigmas)).sentence(self.show)
            count = f"{len(outliers)} of {n} readings were left out, over {OUTLIER_SIGMAS:g} sigma from the map"
            yield f"{count}; the worst: {worst}"
        far = int(np.count_nonzero(self.keep & (np.abs(self.sigmas) > OUTLIER_SIGMAS)))
        if far > 0.01 * n:
            yield (
                f"{far} of {n} readings lie over {OUTLIER_SIGMAS:g} sigma from the map, but repeats back them, or they are too many "
                "for accidents: they stay in, and the intervals are wider there"
            )
        if not self.replicates:
            yield "no repeats: the noise was taken from the residuals, so lack of fit cannot be told from noise"
        if self.lack > 2.0:
            times = f"{self.lack**0.5:.1f}"
            yield f"the cells' means miss the map by {times} times what repeats explain; the intervals are widened by that"
        if self.status == "not_excited":
            yield f"flow at the lowest command, {self.show.volts(self.levels[0])}: the deadband is an extrapolation; measure below it"
        if self.trial_scatter > 2e-3:
            share = f"{100 * self.trial_scatter:.2g} %"
            yield f"whole trials differ: their mean is uncertain by {share} of the flow, which is in the intervals"
        if leakage:
            yield f"{self.show.flow(leakage * self.rated, 3)} pass below the deadband; the map takes the valve as shut there"


def _lattice_minimum(score, first, second, steps) -> tuple[tuple[float, float], float]:
    """(point, value) of the least of ``score`` over decadic logarithms, on a lattice that is
    refined about the best.

    Points come from a fixed lattice, so that the last bits of a linear algebra library do not move
    the result."""
    known: dict[tuple[float, float], float] = {}

    def value(point: tuple[float, float]) -> float:
        if point not in known:
            known[point] = float(score(point))
        return known[point]

    best = min(((float(a), float(b)) for a in first for b in second), key=value)
    for step in steps:
        for _ in range(5):
            a, b = best
            around = [(a + i * step, b + j * step) for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))]
            better = min((p for p in around if all(-12 <= x <= 0 for x in p)), key=value)
            if value(better) >= value(best):
                break
            best = better
    return best, value(best)


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


def _step(flows: np.ndarray) -> float:
    """The last digit of a meter, if it shows so few that values repeat: the least distance between
    two values.
    """
    apart = np.diff(np.unique(flows))
    return float(apart[apart > 1e-9].min(initial=np.inf)) if np.any(apart > 1e-9) else 0.0


def _medians(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Median of the values of each group 0, 1, 2, …"""
    order = np.argsort(group, kind="stable")
    return np.array(
        [np.median(part) for part in np.split(values[order], np.cumsum(np.bincount(group))[:-1])]
    )


def _digits(values, count: int) -> np.ndarray:
    """Values to so many significant digits: what a file needs, and not the last bits of a linear
    algebra library.
    """
    values = np.asarray(values, float)
    return np.array([float(f"{v:.{count - 1}e}") for v in values.ravel()]).reshape(values.shape)


def _growing(square: np.ndarray, dof: np.ndarray, flow: np.ndarray) -> tuple[float, float]:
    """(floor, share) of a standard deviation √(floor² + (share·flow)²) by maximum likelihood from
    squared deviations.
    """
    best = (np.inf, 0.0, 0.0)
    for ratio in (0.0, *np.geomspace(1.0, 1e4, 25)):
        shape = 1.0 + ratio * flow**2
        floor2 = max(float(np.sum(square / shape) / dof.sum()), 1e-300)
        score = float(dof.sum() * np.log(floor2) + dof @ np.log(shape))
        best = min(best, (score, floor2**0.5, (ratio * floor2) ** 0.5))
    return float(best[1]), float(best[2])


def _check(
    found: FlowMap,
    command: float,
    target: float,
    tolerance: float,
    reference: float | tuple[float, float] | None,
) -> Calibration:
    """A calibration point against the map, over the reference drops."""
    low, high = (
        float(np.interp(command, found.hull_command, side))
        for side in (found.hull_low, found.hull_high)
    )
    if reference is None:
        low = 0.5 * (low + high)
    else:
        low, high = reference if isinstance(reference, tuple) else (reference, reference)
    drops = np.linspace(low, high, 21)
    flows = found.flow(drops, command)
    flow, std = float(flows.mean()), float(found.flow_std(drops, command).mean())
    bounds = flow - Z95 * std, flow + Z95 * std
    band = target * (1 - tolerance), target * (1 + tolerance)
    if not found.hull_command[0] <= command <= found.hull_command[-1]:
        verdict = "not_measured"
    elif band[0] <= bounds[0] and bounds[1] <= band[1]:
        verdict = "met"
    else:
        verdict = "missed" if bounds[1] < band[0] or bounds[0] > band[1] else "undecided"
    return Calibration(
        command,
        target,
        tolerance,
        flow,
        *bounds,
        float(flows.min()),
        float(flows.max()),
        low,
        high,
        verdict,
    )
