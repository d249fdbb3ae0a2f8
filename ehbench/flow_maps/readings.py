"""Flowmeter readings made ready for the fit of one flow map: in a fixed order, gathered in cells,
scaled.

Readings at one command and nearly one drop form a cell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ehbench.flow_maps.results import Units
from ehbench.flow_maps.spline import Axis, OneColumn
from ehbench.physics.flow_map import root_drop
from ehbench.vocabulary.errors import InsufficientData

if TYPE_CHECKING:
    from ehbench.data.flowmeter import FlowmeterData

# below this the readings are not those of a valve that opens with its command
_LEAST_EFFECT = 0.1
_SPANS_S = 24
# share of the readings that either way of a sweep must have
_LEAST_WAY = 0.15


@dataclass(frozen=True, eq=False)
class FlowReadings:
    """Readings of one edge in one direction, SI, one-dimensional and of one length.

    Args:
        command: openings [V], positive where the edge opens (times −1 for a spool's other half).
        pressure_drop: [Pa] along the direction; readings at a drop of zero or less say nothing and
            are left out. NaN throughout: not measured, the map goes by the opening alone.
        flow: [m³/s] along the direction.
        method: ``flowmeter`` or ``cylinder`` per reading; each has its own noise.
        trial: number per reading; trials that differ as a whole widen the intervals. Within one,
            readings in the order of their lines tell rising from falling commands.
        line, file: where each reading stands, for naming outliers; ``file`` may be one for all.
    """

    command: np.ndarray
    pressure_drop: np.ndarray
    flow: np.ndarray
    method: np.ndarray | None = None
    trial: np.ndarray | None = None
    line: np.ndarray | None = None
    file: str | np.ndarray = ""


@dataclass(frozen=True)
class FlowMapOptions:
    """What a fit of a flow map may be told.

    Args:
        meter_limit: [m³/s] a flowmeter reading below it only says that the flow lies below it.
        rated_flow: [m³/s]; the largest fitted flow among the cells if not given.
        calibration: (command [V], flow [m³/s], tolerance as a share of the flow) to check.
        reference_drop: [Pa] or a range, where the calibration is checked; the upper half of the
            drops measured at the command if not given.
        drop_std: [Pa] standard error of every drop, which all readings share: of the zeros of the
            pressure sensors.
        command_std: [V] likewise of every command: half a hysteresis that readings on the way up
            do not tell.
        nominal_drop: [Pa] the largest drop that a map measured without pressures is said for.
        show: units of the sentences.
    """

    meter_limit: float = 0.0
    rated_flow: float | None = None
    calibration: Sequence[tuple[float, float, float]] = ()
    reference_drop: float | tuple[float, float] | None = None
    drop_std: float = 0.0
    command_std: float = 0.0
    nominal_drop: float = 1e7
    show: Units = field(default_factory=Units)


@dataclass(frozen=True, eq=False)
class Sorted:
    """Readings at positive drops, in an order that does not depend on the file's.

    ``size`` is how many were given, ``row`` where each stood among them; ``u`` the command [V],
    ``q`` the flow [m³/s], zero for the ``silent`` ones: those below the lower ``limit`` [m³/s] of
    their meter. ``cell`` and ``level`` count cells and commands from zero. ``sweep``: 1 for a
    reading on the way up, −1 on the way down, 0 where that is not known. ``one_drop``: taken
    without pressures."""

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
    sweep: np.ndarray
    one_drop: bool


@dataclass(frozen=True, eq=False)
class Task:
    """One map to fit: its readings, scaled, and what is known of it before the fit.

    ``y`` is the flow over ``rated`` [m³/s], ``s`` the root of the drop over that of ``drop_max``
    [Pa], bent below ``delta`` [Pa]. ``levels`` [V] are the commands read, ``cell_level`` that of
    each cell. ``roots`` are the scaled roots of the drops read, with zero; empty where they are too
    many to leave gaps. ``axis`` spans the roots. ``digit`` is the rounding error of each method's
    display, ``drop_std`` the standard error that all drops share, as a share of ``drop_max``,
    ``command_std`` that of all commands [V]."""

    who: str
    show: Units
    readings: Sorted
    rated: float
    y: np.ndarray
    s: np.ndarray
    drop_max: float
    delta: float
    levels: np.ndarray
    cell_level: np.ndarray
    roots: np.ndarray
    axis: Axis
    digit: dict[str, float]
    drop_std: float = 0.0
    command_std: float = 0.0

    @property
    def spans(self) -> int:
        """Spans along the root of the drop."""
        return self.axis.breaks.size - 1

    def places(self, u: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Commands and roots counted in commands measured and spans, shape (points, 2)."""
        return np.column_stack(
            [np.interp(u, self.levels, np.arange(self.levels.size)), s * self.spans]
        )


def clusters(values: np.ndarray, share: float, width: float) -> np.ndarray:
    """Label of the cluster of each value; one spans at most share·(its least value) + width."""
    order = np.argsort(values, kind="stable")
    labels = np.empty(values.size, int)
    start, label = -np.inf, -1
    for i in order:
        if values[i] > start + share * abs(start) + width or label < 0:
            start, label = values[i], label + 1
        labels[i] = label
    return labels


def medians(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Median of the values of each group 0, 1, 2, …, none of them empty."""
    ascending = values[np.lexsort((values, group))]
    count = np.bincount(group)
    first = np.cumsum(count) - count
    return 0.5 * (ascending[first + (count - 1) // 2] + ascending[first + count // 2])


def sort_readings(
    who: str,
    given: FlowReadings | FlowmeterData,
    options: FlowMapOptions,
    hysteresis: float = 0.0,
) -> Sorted:
    """Readings at positive drops, sorted and gathered in cells.

    Args:
        hysteresis: [V] rising commands act as if lower by half of it, falling ones as if higher.

    Raises:
        ValueError: shapes that differ, a number that is not finite, a negative opening.
        InsufficientData: no drop above zero, fewer than 4 commands or 4 drops.
    """
    u, drop, q, one_drop = _columns_of(who, given, options.nominal_drop)
    n = u.size
    method = np.full(n, "flowmeter") if given.method is None else np.asarray(given.method)
    method = method.astype(str)
    file = np.full(n, given.file) if isinstance(given.file, str) else np.asarray(given.file)
    file = file.astype(str)
    trial = np.zeros(n, int) if given.trial is None else np.asarray(given.trial, int)
    line = np.arange(1, n + 1) if given.line is None else np.asarray(given.line, int)
    use = np.flatnonzero(drop > 0)
    if use.size == 0:
        raise InsufficientData(f"the {who} has no reading at a pressure drop above zero")
    use = use[np.lexsort((line[use], q[use], drop[use], u[use]))]
    # trial 1 of two files is two trials
    trial = np.unique(file, return_inverse=True)[1] * (trial.max() + 1) + trial
    u, drop, q, method, trial, file, line = (
        a[use] for a in (u, drop, q, method, trial, file, line)
    )
    sweep = _sweeps(u, trial, line)
    u = np.maximum(u - 0.5 * hysteresis * sweep, 0.0)
    level, cell = _cells_of(who, u, drop, method, one_drop)
    limit = np.where(method != "cylinder", options.meter_limit, 0.0)
    silent = (limit > 0) & (q < limit)
    return Sorted(
        size=n,
        row=use,
        u=u,
        drop=drop,
        q=np.where(silent, 0.0, q),
        method=method,
        trial=trial,
        file=file,
        line=line,
        cell=cell,
        level=level,
        limit=limit,
        silent=silent,
        sweep=sweep,
        one_drop=one_drop,
    )


def _columns_of(
    who: str, given: FlowReadings | FlowmeterData, nominal: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
    """(command, drop, flow, whether the readings were taken without pressures): the drop is then
    the ``nominal`` one [Pa].
    """
    u, drop, q = (np.asarray(a, float) for a in (given.command, given.pressure_drop, given.flow))
    one_drop = drop.size > 0 and bool(np.isnan(drop).all())
    if one_drop:
        drop = np.full(drop.shape, nominal)
    elif np.isnan(drop).any():
        raise InsufficientData(
            f"the {who} has readings with a pressure drop and readings without",
            hint="give the drop of all, or of none for a map by the command alone",
        )
    _refuse_malformed(u, drop, q)
    return u, drop, q, one_drop


def _sweeps(u: np.ndarray, trial: np.ndarray, line: np.ndarray) -> np.ndarray:
    """1 for each reading whose command was reached from below, −1 from above, by the order of the
    lines within a trial; all 0 where nearly all go one way: that is an order, not a sweep.
    """
    sweep = np.zeros(u.size, int)
    for item in np.unique(trial):
        at = np.flatnonzero(trial == item)
        at = at[np.argsort(line[at], kind="stable")]
        step = np.sign(np.diff(u[at], prepend=u[at[0]]))
        last = np.maximum.accumulate(np.where(step != 0, np.arange(at.size), 0))
        sweep[at] = step[last]
    ways = np.count_nonzero(sweep > 0), np.count_nonzero(sweep < 0)
    return sweep if min(ways) >= _LEAST_WAY * u.size else np.zeros(u.size, int)


def _refuse_malformed(u: np.ndarray, drop: np.ndarray, q: np.ndarray) -> None:
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


def _cells_of(
    who: str, u: np.ndarray, drop: np.ndarray, method: np.ndarray, one_drop: bool
) -> tuple[np.ndarray, np.ndarray]:
    """(level, cell) of each reading; refuses too few commands or drops."""
    level = clusters(u, 0.0, 0.005 * max(u.max(), 1e-12))
    levels = int(level.max()) + 1
    key = np.empty((u.size, 3), int)
    key[:, 0], key[:, 2] = level, method == "cylinder"
    for k in range(levels):
        at = level == k
        key[at, 1] = clusters(drop[at], 0.03, 0.003 * drop.max())
    cell = np.unique(key, axis=0, return_inverse=True)[1].ravel()
    drops = np.unique(_drop_clusters(drop)).size
    if levels < 4:
        raise InsufficientData(
            f"the {who} has readings at {levels} commands",
            hint="4 or more are needed, 3 of them passing flow",
        )
    if drops < 4 and not one_drop:
        raise InsufficientData(
            f"the {who} has readings at {drops} pressure drops",
            hint="4 or more different ones are needed",
        )
    return level, cell


def _drop_clusters(drop: np.ndarray) -> np.ndarray:
    """Which of the drops measured each reading is at."""
    return clusters(drop, 0.03, 0.003 * float(drop.max()))


def make_task(who: str, readings: Sorted, rated: float | None, show: Units) -> Task:
    """The readings scaled, with the axes of the fit.

    Raises:
        InsufficientData: no flow at any command, or one that does not depend on the command.
    """
    rated = float(rated) if rated else _largest_flow(readings)
    if not rated > 0:
        raise InsufficientData(
            f"the {who} passes no flow at any command",
            hint="3 or more commands above the deadband are needed",
        )
    y = readings.q / rated
    drop_max = float(readings.drop.max())
    minimum = float(np.quantile(readings.drop, 0.02))
    # an orifice bends by 1 % at five times delta; the bounds keep the slope at zero finite and
    # the bend out of sight
    delta = float(np.clip(minimum / 5.0, 1e-3 * drop_max, 1e-2 * drop_max))
    s = root_drop(readings.drop, delta) / root_drop(drop_max, delta)
    cluster = _drop_clusters(readings.drop)
    _refuse_idle(who, show, readings, y, cluster)
    places = np.sort(np.bincount(cluster, s) / np.bincount(cluster))
    roots = np.append(0.0, places) if places.size <= 2 * _SPANS_S else places[:0]
    # as narrow as the closest drops measured, the penalty sees to the rest
    spans = int(np.clip(np.ceil(1.0 / np.diff(places).min(initial=1.0)), 3, _SPANS_S))
    methods = sorted(set(readings.method.tolist()))
    return Task(
        who=who,
        show=show,
        readings=readings,
        rated=rated,
        y=y,
        s=s,
        drop_max=drop_max,
        delta=delta,
        levels=np.bincount(readings.level, readings.u) / np.bincount(readings.level),
        cell_level=medians(readings.level, readings.cell).astype(int),
        roots=roots,
        axis=OneColumn() if readings.one_drop else Axis(np.linspace(0.0, 1.0, spans + 1), 3),
        digit={name: _last_digit(y[readings.method == name]) / 12**0.5 for name in methods},
    )


def _largest_flow(readings: Sorted) -> float:
    """The largest median flow [m³/s] of a cell, but for slips of the pen."""
    largest = np.sort(medians(readings.q, readings.cell))
    while largest.size > 4 and largest[-1] > 4.0 * largest[-2] > 0.0:
        largest = largest[:-1]
    return float(largest[-1])


def _last_digit(flows: np.ndarray) -> float:
    """The last digit of a meter, if it shows so few that values repeat: the least distance between
    two values.
    """
    apart = np.diff(np.unique(flows))
    return float(apart[apart > 1e-9].min(initial=np.inf)) if np.any(apart > 1e-9) else 0.0


def _refuse_idle(
    who: str, show: Units, readings: Sorted, y: np.ndarray, cluster: np.ndarray
) -> None:
    """Refuses readings whose flow at one drop is nearly the same at every command."""
    pair = np.column_stack([cluster, readings.level])
    pairs, index = np.unique(pair, axis=0, return_inverse=True)
    middle, drop = medians(y, index.ravel()), pairs[:, 0]
    spread = [np.ptp(middle[drop == k]) for k in np.unique(drop) if np.count_nonzero(drop == k) > 1]
    if spread and np.median(spread) < _LEAST_EFFECT:
        low, high = show.volts(readings.u.min()), show.volts(readings.u.max())
        raise InsufficientData(
            f"the {who} does not depend on the command: at one drop the flow changes by "
            f"{100 * np.median(spread):.2g} % of the largest flow between {low} and {high}",
            hint="check that the command reached the valve, and the columns of the file",
        )
