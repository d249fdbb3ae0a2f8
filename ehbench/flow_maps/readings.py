"""Flowmeter readings made ready for the fit of one flow map: in a fixed order, scaled, with their
noise, and the means of cells.

Readings at one command and nearly one drop form a cell: their scatter gives the noise, the cells'
means the fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ehbench.data.flowmeter import FlowmeterData
from ehbench.flow_maps.spline import Axis, OneColumn
from ehbench.physics.flow_map import root_drop
from ehbench.vocabulary import VOCABULARY, InsufficientData, from_si, message, setting


@dataclass(frozen=True)
class ReadingSettings:
    """Numbers of what is known of readings before a map is fitted to them."""

    spans: int = setting(24, "", "largest number of spans along the root of the drop", "seldom met")
    effect: float = setting(0.1, "", "smallest change of flow, of the largest", "else no valve")
    across: float = setting(
        0.5, "", "smallest share of the commands at one drop that tells the effect", "most of them"
    )
    sweep: float = setting(0.15, "", "smallest share of readings either way", "else an order")
    outlier: float = setting(5.0, "", "standard deviations of an outlier", "1 in 10⁶ by chance")
    outliers: float = setting(0.05, "", "largest share of outliers", "slips of the pen are rare")
    noise: float = setting(1e-4, "", "smallest noise, of the rated flow", "best meters: 1e-3")


SETTINGS = ReadingSettings()


@dataclass(frozen=True)
class Units:
    """Units of messages; ``sign`` of the commands that open the edge, as the driver gets them."""

    flow_unit: str = VOCABULARY["flow"].display
    pressure_unit: str = VOCABULARY["pressure_drop"].display
    sign: int = 1

    def volts(self, opening: float) -> str:
        return f"{self.sign * opening + 0.0:g} V"

    def flow(self, value: float, digits: int = 4) -> str:
        value = value if abs(value) > 1e-12 else 0.0  # m³/s, a nanolitre a second: below any meter
        return f"{from_si(value, self.flow_unit, VOCABULARY['flow']):.{digits}g} {self.flow_unit}"

    def drop(self, value: float) -> str:
        shown = from_si(value, self.pressure_unit, VOCABULARY["pressure_drop"])
        return f"{shown:.4g} {self.pressure_unit}"


@dataclass(frozen=True)
class FlowMapOptions:
    """Options of the fit of a flow map.

    Args:
        meter_limit: [m³/s] a flowmeter reading below it only says that the flow lies below it.
        calibration: (command [V], flow [m³/s], tolerance as a share of the flow) to check.
        reference_drop: [Pa] where the calibration is checked; over the upper half of the drops
            measured at the command if not given.
        drop_std: [Pa] standard error of every drop, which all readings share: of the zeros of the
            pressure sensors.
        command_std: [V] likewise of every command: half a hysteresis that readings on the way up
            do not show.
        nominal_drop: [Pa] the largest drop of a map that is measured without pressures.
        show: units of the messages."""

    meter_limit: float = 0.0
    calibration: Sequence[tuple[float, float, float]] = ()
    reference_drop: float | None = None
    drop_std: float = 0.0
    command_std: float = 0.0
    nominal_drop: float = 1e7
    show: Units = field(default_factory=Units)


@dataclass(frozen=True, eq=False)
class Readings:
    """The readings of one map at positive drops, in an order that does not depend on the file's.

    ``size`` is how many were given, ``row`` where each stood among them; ``u`` the command [V],
    ``drop`` [Pa], ``q`` the flow [m³/s], zero for the ``silent`` ones: those below the lower
    ``limit`` [m³/s] of their meter. ``y`` is the flow over ``rated`` [m³/s]. ``cell`` and ``level``
    count cells and commands from zero. ``sweep``: 1 for a reading on the way up, −1 on the way
    down, 0 where that is not known. ``one_drop``: taken without pressures. ``drop_std`` is the
    standard error that all drops share, as a share of the largest, ``command_std`` that of all
    commands [V]. ``shift`` [V]: what the deadband is higher at the largest drop than at none; ``u``
    is the command that does the same at half of the largest drop. ``zeros``: what meters show
    without flow, scaled, by method, which is taken off both flows."""

    who: str
    show: Units
    size: int
    row: np.ndarray
    u: np.ndarray
    drop: np.ndarray
    q: np.ndarray
    method: np.ndarray
    trial: np.ndarray
    file: np.ndarray
    line: np.ndarray
    limit: np.ndarray
    silent: np.ndarray
    sweep: np.ndarray
    one_drop: bool
    rated: float
    y: np.ndarray
    cell: np.ndarray
    level: np.ndarray
    drop_std: float
    command_std: float
    shift: float = 0.0
    zeros: dict[str, float] = field(default_factory=dict)

    def shifted(self, shift: float) -> Readings:
        """The same readings with another ``shift``."""
        u = self.command - shift * (self.drop / self.drop_max - 0.5) if shift else self.command
        return replace(self, u=u, shift=shift)

    @property
    def command(self) -> np.ndarray:
        """The commands as given [V]."""
        return self.u + self.shift * (self.drop / self.drop_max - 0.5) if self.shift else self.u

    @cached_property
    def drop_max(self) -> float:
        """The largest drop [Pa]."""
        return float(self.drop.max())

    @cached_property
    def delta(self) -> float:
        """Drop [Pa] below which its root bends."""
        # an orifice bends by 1 % at five times delta; the bounds keep the slope at zero finite and
        # the bend out of sight
        low = float(np.quantile(self.drop, 0.02)) / 5.0
        return float(np.clip(low, 1e-3 * self.drop_max, 1e-2 * self.drop_max))

    @cached_property
    def s(self) -> np.ndarray:
        """The root of each drop over that of the largest."""
        return root_drop(self.drop, self.delta) / root_drop(self.drop_max, self.delta)

    @cached_property
    def at_drop(self) -> np.ndarray:
        """Which of the drops measured each reading is at."""
        return clusters(self.drop, 0.03, 0.003 * self.drop_max)

    @cached_property
    def places_read(self) -> np.ndarray:
        """The scaled roots of the drops measured, ascending."""
        return np.sort(np.bincount(self.at_drop, self.s) / np.bincount(self.at_drop))

    @property
    def roots(self) -> np.ndarray:
        """`places_read` with zero; empty where they are too many to leave gaps."""
        places = self.places_read
        return np.append(0.0, places) if places.size <= 2 * SETTINGS.spans else places[:0]

    @cached_property
    def axis(self) -> Axis:
        """Spans of the roots: as narrow as the closest drops measured."""
        if self.one_drop:
            return OneColumn()
        closest = np.diff(self.places_read).min(initial=1.0)
        spans = min(math.ceil(1.0 / closest), SETTINGS.spans)
        return Axis(np.linspace(0.0, 1.0, spans + 1), 3)

    @cached_property
    def digit(self) -> dict[str, float]:
        """Rounding error of each method's display: the smallest step of its flows/√12, 0 without
        one."""
        results = {}
        for name in sorted(set(self.method.tolist())):
            apart = np.diff(np.unique(self.q[self.method == name] / self.rated))
            results[name] = float(min(apart[apart > 1e-9], default=0.0)) / 12**0.5
        return results

    @cached_property
    def commands(self) -> np.ndarray:
        """The commands [V] by level."""
        return np.bincount(self.level, self.command) / np.bincount(self.level)

    @cached_property
    def _steps(self) -> tuple[np.ndarray, np.ndarray]:
        """(openings [V], the first that each reading does not exceed): the commands, of which a
        shift leaves those out that no reading is at."""
        if not self.shift:
            return self.commands, self.level
        ends = np.append(self.commands[:-1], max(self.commands[-1], self.u.max()))
        which, step = np.unique(np.searchsorted(ends, self.u), return_inverse=True)
        return ends[which], step

    @property
    def levels(self) -> np.ndarray:
        """Openings [V] between which the flow begins."""
        return self._steps[0]

    @property
    def step(self) -> np.ndarray:
        """Of each reading the first of ``levels`` that it does not exceed."""
        return self._steps[1]

    @cached_property
    def cell_level(self) -> np.ndarray:
        """The level of each cell, counted from zero."""
        return medians(self.step, self.cell).astype(int)

    @property
    def spans(self) -> int:
        """Spans along the root of the drop."""
        return self.axis.breaks.size - 1

    def heard(self, flow: np.ndarray) -> np.ndarray:
        """The scaled flow of each reading, a silent one where a map has it, up to its limit."""
        return np.where(self.silent, np.clip(flow, 0.0, self.limit / self.rated), self.y)

    def places(self, u: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Commands and roots counted in commands measured and spans, shape (points, 2)."""
        return np.column_stack(
            [np.interp(u, self.levels, np.arange(self.levels.size)), s * self.spans]
        )


def readings_table(
    command: np.ndarray, pressure_drop: np.ndarray, flow: np.ndarray, **columns: np.ndarray | str
) -> FlowmeterData:
    """Readings of one edge in one direction as a table, from arrays in SI.

    Args:
        command: openings [V], positive where the edge opens (times −1 for a spool's other half).
        pressure_drop: [Pa] along the direction; readings at a drop of zero or less say nothing and
            are left out. NaN throughout: not measured, the map goes by the opening alone.
        flow: [m³/s] along the direction.
        columns: other fields of `FlowmeterData`, each an array or one value for all: ``method``,
            ``flowmeter`` by default, ``trial``, ``temperature``, ``file``, ``line``.

    Raises:
        ValueError: arrays that are not one-dimensional or not of one length."""
    u, drop, q = (np.asarray(a, float) for a in (command, pressure_drop, flow))
    if not (u.ndim == 1 and u.shape == drop.shape == q.shape):
        raise ValueError(message("flow_maps.shapes"))
    default = {"valve": "", "direction": "forward", "method": "flowmeter", "trial": 0, "file": ""}
    default |= {"temperature": np.nan, "line": np.arange(1, u.size + 1)}
    rest: dict[str, Any] = {
        name: np.broadcast_to(value, u.shape) for name, value in (default | columns).items()
    }
    return FlowmeterData(command=u, pressure_drop=drop, flow=q, **rest)


def sort_readings(
    who: str, given: FlowmeterData, options: FlowMapOptions, hysteresis: float
) -> Readings:
    """The readings at positive drops, sorted, gathered in cells and scaled.

    Args:
        who: the valve and direction, for messages.
        hysteresis: [V] rising commands act as if lower by half of it, falling ones as if higher.

    Raises:
        ValueError: a number that is not finite, a negative opening.
        InsufficientData: no drop above zero, fewer than 4 commands or 4 drops, no flow at any
            command, or one that does not depend on the command or falls with it."""
    u, drop, q = (np.asarray(a, float) for a in (given.command, given.pressure_drop, given.flow))
    one_drop = drop.size > 0 and bool(np.isnan(drop).all())
    if one_drop:
        drop = np.full(drop.shape, options.nominal_drop)
    elif np.isnan(drop).any():
        raise InsufficientData(message("flow_maps.some_drops", map=who))
    if not np.all(np.isfinite([u, drop, q])):
        raise ValueError(message("flow_maps.not_finite"))
    if np.any(u < 0):
        raise ValueError(message("flow_maps.negative_opening"))
    use = np.flatnonzero(drop > 0)
    if use.size == 0:
        raise InsufficientData(message("flow_maps.no_drop", map=who))
    use = use[np.lexsort((given.line[use], q[use], drop[use], u[use]))]
    # trial 1 of two files is two trials
    file = given.file.astype(str)
    pairs = np.column_stack([np.unique(file, return_inverse=True)[1], given.trial])
    trial = np.unique(pairs, axis=0, return_inverse=True)[1].ravel()
    method, line = given.method.astype(str)[use], given.line[use]
    u, drop, q, trial, file = (a[use] for a in (u, drop, q, trial, file))
    sweep = _sweeps(u, trial, line)
    u = np.maximum(u - 0.5 * hysteresis * sweep, 0.0)
    level = clusters(u, 0.0, 0.005 * max(u.max(), 1e-12))
    metered, lowest = method != "cylinder", options.meter_limit
    first = float(np.min(q[metered], where=q[metered] > 0.0, initial=np.inf))
    # a meter that reads 0 but never less shows nothing below what it reads first
    if np.any(q[metered] == 0.0) and not np.any(q[metered] < 0.0) and math.isfinite(first):
        lowest = max(lowest, first)
    limit = np.where(metered, lowest, 0.0)
    silent = (limit > 0) & (q < limit)
    key = np.column_stack([level, np.zeros(level.size, int), ~metered])
    for k in np.unique(level):
        key[level == k, 1] = clusters(drop[level == k], 0.03, 0.003 * drop.max())
    cell = np.unique(key, axis=0, return_inverse=True)[1].ravel()
    readings = Readings(
        *(who, options.show, given.command.size, use, u, drop, np.where(silent, 0.0, q)),
        *(method, trial, file, line, limit, silent, sweep, one_drop, math.nan, q, cell, level),
        options.drop_std / float(drop.max()),
        options.command_std,
    )
    return _rated(readings)


def _rated(r: Readings) -> Readings:
    """Readings scaled by the rated flow, the largest among the cells; refuses too few, and flows
    that do not go with the command."""
    levels, drops = r.levels.size, r.places_read.size
    if levels < 4:
        raise InsufficientData(message("flow_maps.few_commands", map=r.who, count=levels))
    if drops < 4 and not r.one_drop:
        raise InsufficientData(message("flow_maps.few_drops", map=r.who, count=drops))
    largest = np.sort(medians(r.q, r.cell))
    while largest.size > 4 and largest[-1] > 4.0 * largest[-2] > 0.0:
        largest = largest[:-1]
    rated = float(largest[-1])
    if not rated > 0:
        raise InsufficientData(message("flow_maps.no_flow", map=r.who))
    r = replace(r, rated=rated, y=r.q / rated)
    pairs, index = np.unique(np.column_stack([r.at_drop, r.level]), axis=0, return_inverse=True)
    middle, (drop, level) = medians(r.y, index.ravel()), pairs.T
    # where the supply gives way, most drops are of one command or two
    each = (drop == k for k in np.unique(drop))
    least = SETTINGS.across * np.ptp(r.commands)
    wide = [middle[at] for at in each if np.ptp(r.commands[level[at]]) >= least]
    fields = {"low": r.show.volts(r.u.min()), "high": r.show.volts(r.u.max())}
    if wide and (change := float(np.median([*map(np.ptp, wide)]))) < SETTINGS.effect:
        raise InsufficientData(message("flow_maps.idle", map=r.who, change=change, **fields))
    falls = [flows[0] - flows[-1] for flows in wide]
    if wide and min(falls) > 0.0 and (fall := float(np.median(falls))) > SETTINGS.effect:
        raise InsufficientData(message("flow_maps.open_at_rest", map=r.who, fall=fall, **fields))
    return r


def _sweeps(u: np.ndarray, trial: np.ndarray, line: np.ndarray) -> np.ndarray:
    """1 for each reading whose command was reached from below, −1 from above, by the order of lines
    within a trial; all 0 where nearly all go one way."""
    sweep = np.zeros(u.size, int)
    for item in np.unique(trial):
        rows = np.flatnonzero(trial == item)
        rows = rows[np.argsort(line[rows], kind="stable")]
        step = np.sign(np.diff(u[rows], prepend=u[rows[0]]))
        step *= np.diff(line[rows], prepend=line[rows[0]]) != 0  # side by side: in no order
        sweep[rows] = step[np.maximum.accumulate(np.where(step != 0, np.arange(rows.size), 0))]
    fewest = min(np.count_nonzero(sweep > 0), np.count_nonzero(sweep < 0))
    return sweep if fewest >= SETTINGS.sweep * u.size else np.zeros(u.size, int)


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


@dataclass(frozen=True)
class Noise:
    """By method (floor, share): the standard deviation of one scaled reading is
    √(floor² + (share·flow)²). ``replicates``: degrees of freedom of repeats behind it."""

    methods: dict[str, tuple[float, float]]
    replicates: int = 0

    def std(self, readings: Readings, flow: np.ndarray) -> np.ndarray:
        """Standard deviation of each single reading, given the map's flow there."""
        floor, share, digit = np.array(
            [(*self.methods[m], readings.digit[m]) for m in readings.method]
        ).T
        return np.sqrt(np.maximum(floor**2 + (share * flow) ** 2, digit**2) + SETTINGS.noise**2)


def first_noise(readings: Readings) -> Noise:
    """What is assumed of the noise before there is a fit."""
    return Noise(dict.fromkeys(readings.digit, (3e-3, 1e-2)))


def measure_noise(
    r: Readings, last: Noise, keep: np.ndarray, leverage: np.ndarray, flow: np.ndarray
) -> Noise:
    """Noise per method from the scatter inside cells, from residuals where there are no repeats."""
    residual, dof_all, methods = r.y - flow, 0, dict(last.methods)
    for name in methods:
        use = keep & (r.method == name) & ~r.silent
        count = np.bincount(r.cell[use], minlength=r.cell.max() + 1)
        mean = np.bincount(r.cell[use], residual[use], count.size) / np.maximum(count, 1)
        inside = residual - mean[r.cell]
        dof = np.where(use, 1.0 - 1.0 / np.maximum(count, 1)[r.cell], 0.0)
        if dof.sum() < 6:
            inside, dof = residual, np.where(use, np.maximum(1.0 - leverage, 0.1), 0.0)
        else:
            dof_all += int(round(dof.sum()))
        if not dof.sum() > 0:
            continue
        tried, dof = [], dof[use]  # the likeliest floor and share
        for ratio in (0.0, *np.geomspace(1.0, 1e4, 25)):
            shape = 1.0 + ratio * flow[use] ** 2
            floor2 = max(float(np.sum(inside[use] ** 2 / shape) / dof.sum()), 1e-300)
            score = float(dof.sum() * np.log(floor2) + dof @ np.log(shape))
            tried.append((score, floor2**0.5, float((ratio * floor2) ** 0.5)))
        _, floor, share = min(tried)
        methods[name] = floor, share
    return Noise(methods, dof_all)


@dataclass(frozen=True, eq=False)
class Cells:
    """Means of the kept readings of each cell, shape (cells,): command [V], scaled root and flow,
    weight (0 where none is kept), how many are kept. ``heard``: the scaled flow of each reading, a
    silent one where the map has it. ``replicates`` as in `Noise`."""

    u: np.ndarray
    s: np.ndarray
    y: np.ndarray
    weight: np.ndarray
    count: np.ndarray
    heard: np.ndarray
    replicates: int

    @cached_property
    def _bytes(self) -> tuple[bytes, ...]:
        parts = self.u, self.s, self.y, self.weight, self.count, self.heard
        return *(part.tobytes() for part in parts), str(self.replicates).encode()

    def __hash__(self) -> int:
        return hash(self._bytes)

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Cells) and self._bytes == other._bytes)

    def shifted(self, shift: float) -> Cells:
        """The same cells at the openings of a deadband that shifts by so much more [V]."""
        return replace(self, u=self.u - shift * (self.s**2 - 0.5)) if shift else self

    def without(self, out: np.ndarray) -> Cells:
        """The same cells, of which some have no weight."""
        return replace(self, weight=np.where(out, 0.0, self.weight)) if out.any() else self

    @cached_property
    def weighed(self) -> int:
        """How many cells have a weight."""
        return int(np.count_nonzero(self.weight))


def gather_cells(r: Readings, noise: Noise, keep: np.ndarray, flow: np.ndarray) -> Cells:
    """The cells' means, given the map's scaled flow at each reading."""
    limit, std = r.limit / r.rated, noise.std(r, flow)
    heard = r.heard(flow)
    # whether a reading counts must not depend on its own noise, so the map says whether the meter
    # turns
    weight = np.where(keep & ((limit == 0) | (flow > limit + 2.0 * std)), 1.0 / std**2, 0.0)
    total = np.bincount(r.cell, weight)
    u, s, y = (
        np.bincount(r.cell, weight * a) / np.maximum(total, 1e-300) for a in (r.u, r.s, heard)
    )
    count = np.bincount(r.cell, keep, total.size)
    return Cells(u, s, y, total, count, heard, noise.replicates)


def unbacked(r: Readings, noise: Noise, heard: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """True for readings that no repeats support within the noise."""
    residual, count = heard - flow, np.bincount(r.cell)
    high, low = np.full(count.size, -np.inf), np.full(count.size, np.inf)
    np.maximum.at(high, r.cell, residual)
    np.minimum.at(low, r.cell, residual)
    spread = np.sqrt(np.bincount(r.cell, noise.std(r, flow) ** 2) / count)
    agree = high - low <= SETTINGS.outlier * spread
    return ~(agree & (count > 1))[r.cell]


def few(out: np.ndarray, size: np.ndarray) -> np.ndarray:
    """The farthest of the readings ``out``, no more than a small share of all."""
    count = max(3, int(SETTINGS.outliers * out.size))
    farthest = np.argsort(np.where(out, -size, np.inf), kind="stable")[:count]
    return out & np.isin(np.arange(out.size), farthest)
