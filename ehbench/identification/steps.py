"""What both ways of identification share: parameters as search coordinates, logs made ready,
simulation of all of them, and the result."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ehbench import units
from ehbench.errors import InputError, InsufficientData, SimulationError
from ehbench.intake import take_in
from ehbench.plant.build import Maps
from ehbench.plant.model import MOVED, Model
from ehbench.quantities import quantity
from ehbench.record import Record
from ehbench.rig import Cylinder, Rig, Value, Valve, parameter_row
from ehbench.signals import Ringing, correlation_time, fit_percent, lowpass, rms, transients

LEVEL = 0.95
# a standard error of more than this many units of a parameter says nothing: 95 % then span a factor
# of 50 (searched as a
# logarithm), or its whole range
VAGUE = {True: 1.0, False: 0.5}
# a chamber counts as empty below this share of the way from zero gauge pressure to the cavitation
# pressure; so long before and
# after [s] its cylinder's samples do not count either
EMPTY, EMPTYING = 0.5, 0.05
MOVES = 0.01  # share of the stroke beyond which a cylinder counts as moving
RATE_CUTOFF = 20.0  # [Hz] of the low-pass before a rate is taken from a position
SHOWN = ("q", "qd", "x", "v", "p_head", "p_rod")
# what stands in for a channel that a log lacks, and moves with it
_STAND_INS = {"qd": "v", "v": "qd", "q": "x", "x": "q"}
_RATE_OF = {"qd": "q", "v": "x"}

WIDE = 1.0e3  # factor either way that a positive parameter without bounds is searched over

Progress = Callable[[str, float], None]
Where = Callable[..., Mapping[str, Any]]


@dataclass(frozen=True)
class FittedParameter:
    """One fitted number, SI. ``std`` and ``interval`` (95 %) are None where the data give none;
    ``error_from`` says which standard error it is: ``hac`` (coloured residuals within each log),
    ``jackknife`` (leaving out one log at a time) or ``windows``."""

    name: str
    unit: str
    value: float
    std: float | None
    interval: tuple[float, float] | None
    lower: float
    upper: float
    start: float
    status: str
    samples: int
    error_from: str = ""


@dataclass(frozen=True)
class Match:
    """One transient whose ringing was matched: natural frequency [rad/s] and damping ratio,
    recorded and simulated.
    """

    log: str
    cylinder: str
    channels: tuple[str, ...]
    start: float
    stop: float
    recorded: Ringing
    simulated: Ringing


@dataclass(frozen=True)
class LogFit:
    """How well one log is reproduced, by channel: NRMSE fit [%], rms residual [SI] and its
    correlation time [samples], over the samples that count; ``counted`` is their share [%],
    ``samples`` how many the log has."""

    name: str
    payload: str
    samples: int
    fit_percent: dict[str, float]
    residual_rms: dict[str, float]
    correlation_time: dict[str, float]
    counted: dict[str, float]


@dataclass(frozen=True)
class HydraulicsFit:
    """What an identification found. ``rig`` carries the fitted values; ``correlation`` is between
    the parameters with a standard error, in the order of ``correlated_names``; ``scales`` [SI] is
    what each channel's residual was divided by."""

    rig: Rig
    method: str
    parameters: tuple[FittedParameter, ...]
    correlated_names: tuple[str, ...]
    correlation: tuple[tuple[float, ...], ...]
    logs: tuple[LogFit, ...]
    matches: tuple[Match, ...]
    scales: dict[str, float]
    warnings: tuple[str, ...]
    evaluations: int
    iterations: int
    recordings: tuple[tuple[str, dict[str, np.ndarray]], ...]

    def __getitem__(self, name: str) -> FittedParameter:
        """The fitted parameter of that name.

        Raises:
            KeyError: it was not fitted.
        """
        for one in self.parameters:
            if one.name == name:
                return one
        raise KeyError(name)

    def as_json(self) -> dict[str, Any]:
        """Everything but the rig and the time series as plain values, for `rundir.write_json`; what
        is unknown is None.
        """
        return asdict(replace(self, rig=None, recordings=())) | {
            "rig": self.rig.name,
            "recordings": [name for name, _ in self.recordings],
        }  # type: ignore[arg-type]

    def series(self) -> dict[str, dict[str, np.ndarray]]:
        """By log, columns named ``t [s]``, ``boom.q [rad]`` (recorded) and ``simulated.boom.q
        [rad]``, in SI.
        """
        return {
            log: {f"{name} [{quantity(name).unit}]": y for name, y in columns.items()}
            for log, columns in self.recordings
        }


@dataclass(frozen=True)
class Coordinate:
    """How a parameter is searched: as its logarithm where it is surely positive, else in units of
    its range or of its start.
    """

    name: str
    log: bool
    unit: float
    start: float
    lower: float
    upper: float

    def at(self, theta: float) -> float:
        low, high = self.bounds
        theta = float(min(max(theta, low), high))
        return min(max(math.exp(theta) if self.log else theta * self.unit, self.lower), self.upper)

    def of(self, value: float) -> float:
        return math.log(value) if self.log else value / self.unit

    @property
    def bounds(self) -> tuple[float, float]:
        return self.of(self.lower), self.of(self.upper)

    @property
    def reach(self) -> float:
        """How far a parameter may sensibly move, in its own units: between its bounds, or a few
        units if they are far apart.
        """
        low, high = self.bounds
        return min(high - low, 3.0)

    @property
    def begin(self) -> float:
        """Where the search starts: inside the bounds, as the solver asks."""
        low, high = self.bounds
        margin = 1e-3 * self.reach
        return min(max(self.of(self.start), low + margin), high - margin)

    def spread(
        self, theta: float, std: float, quantile: float
    ) -> tuple[float, tuple[float, float]]:
        """(standard error, interval inside the bounds), SI, from a standard error of theta."""
        value = self.at(theta)
        ends = (self.at(theta - quantile * std), self.at(theta + quantile * std))
        return (value * std if self.log else self.unit * std), ends


def _number(raw: str | float, name: str, at: Mapping[str, Any]) -> float:
    if not isinstance(raw, str):
        return float(raw)
    try:
        return units.parse(raw, parameter_row(name))
    except InputError as error:
        raise type(error)(error.message, **at, hint=error.hint) from None


def coordinates(
    rig: Rig,
    names: Sequence[str],
    start: Mapping[str, str | float] | None = None,
    lower: Mapping[str, str | float] | None = None,
    upper: Mapping[str, str | float] | None = None,
    where: Where = lambda *location: {},
) -> list[Coordinate]:
    """The search coordinates of parameters; start and bounds as given (SI or text with unit), else
    the rig's, else some.

    A positive start without any bound is searched as a logarithm, a factor `WIDE` either way.
    ``where`` gives file and line of a recipe's key, for the errors.

    Raises:
        InputError: unknown or repeated parameter, a start outside its bounds, or a zero start
            without an upper bound.
    """
    from difflib import get_close_matches

    known = rig.parameters()
    given = {"start": dict(start or {}), "lower": dict(lower or {}), "upper": dict(upper or {})}
    for key, name in [
        (key, name) for key, table in {"parameters": names, **given}.items() for name in table
    ]:
        at = where(key) if key == "parameters" else where(key, name)
        if name not in known:
            near = get_close_matches(name, known, 1)
            hint = f"nearest is '{near[0]}'" if near else None
            raise InputError(f"rig '{rig.name}' has no parameter '{name}'", **at, hint=hint)
        if name not in names:
            raise InputError(
                f"{key} names '{name}', which is not among the parameters to fit",
                **at,
                hint=", ".join(names),
            )
    if not names or len(set(names)) < len(names):
        raise InputError("the parameters to fit must be named, each once", **where("parameters"))
    result = []
    for name in names:
        value, row = known[name], parameter_row(name)

        def bound(key: str, own: float | None, name: str = name) -> float | None:
            return _number(given[key][name], name, where(key, name)) if name in given[key] else own

        first = _number(given["start"].get(name, float(value)), name, where("start", name))
        low, high = bound("lower", value.lower), bound("upper", value.upper)
        bounded = high is not None
        if first > 0.0 and row.lower >= 0.0 and low is None and high is None:
            low, high = (
                max(row.lower, first / WIDE, _least(rig, name)),
                min(row.upper, first * WIDE),
            )
        low = max(row.lower, _least(rig, name)) if low is None else low
        high = row.upper if high is None else high
        if not low < high:
            at = where("upper" if name in given["upper"] else "lower", name)
            raise InputError(
                f"{name}: the lower bound {low:g} is not below the upper bound {high:g} {row.unit}",
                **at,
            )
        if not low <= first <= high:
            at = where("start", name) if name in given["start"] else where("parameters")
            raise InputError(
                f"{name} starts at {first:g} {row.unit}, outside its bounds {low:g} to {high:g}",
                **at,
            )
        log = low > 0.0
        unit = high - low if bounded and math.isfinite(high - low) else abs(first)
        if unit == 0.0:
            raise InputError(
                f"{name} starts at zero and has no upper bound",
                **where("start", name) if name in given["start"] else where("parameters"),
                hint=f'give it one, so that the search has a scale: [upper] "{name}" = "… {row.display}"',
            )
        result.append(Coordinate(name, log, 1.0 if log else unit, first, low, high))
    return result


def _least(rig: Rig, name: str) -> float:
    """A bound from the rig's geometry: the rod end holds oil over the whole stroke. Minus infinity
    where there is none.
    """
    for cylinder in rig.cylinder:
        if name == f"{cylinder.name}.volume_rod":
            return 1.001 * cylinder.areas()[1] * float(cylinder.stroke)
    return -math.inf


@dataclass(frozen=True)
class Log:
    """A log made ready: the cylinders that are asked to move, those that move, the channels that
    are compared, what was recorded of them and whether it counts, both of shape (samples,
    channels)."""

    name: str
    record: Record
    payload: str | None
    asked: tuple[str, ...]
    live: tuple[str, ...]
    channels: tuple[str, ...]
    recorded: np.ndarray
    counts: np.ndarray
    warnings: tuple[str, ...] = ()


def column(record: Record, channel: str, like: Record) -> np.ndarray | None:
    """A channel [SI]; where ``like`` lacks it, the rate of its position behind a low-pass, None if
    that is lacking too.
    """
    if channel in like:
        return record[channel]
    head, word = channel.rsplit(".", 1)
    position = f"{head}.{_RATE_OF.get(word, word)}"
    if word not in _RATE_OF or position not in like:
        return None
    return np.gradient(
        lowpass(record[position], record.sample_time, RATE_CUTOFF), record.sample_time
    )


def least_change(valve: Valve) -> float:
    """The change of a valve's recorded command [V] that is more than noise."""
    return MOVED * (float(valve.command_max) - float(valve.command_min))


def payload_of(record: Record) -> str | None:
    """The payload that a log says was carried, None for none."""
    said = record.meta.get("payload", "none")
    return None if said in ("", "none") else said


def prepare(model: Model, record: Record, name: str, wanted: Sequence[str]) -> Log:
    """Take a log in (`intake.take_in`) for a model that carries its payload, and choose the
    channels: the wanted ones of every cylinder that is asked to move or moves.

    Raises:
        InputError: a log that is not of this rig, or not in the units it says; no channel to
            compare.
        InsufficientData: no command changes.
    """
    rig = model.rig
    record, told = take_in(name, record, model)
    warnings = [f"{name}: {text}" for text in told]
    asked, live = [], []
    for cylinder in rig.cylinder:
        valves = {
            f"{cylinder.name}.{valve.name}.command": least_change(valve) for valve in cylinder.valve
        }
        if any(
            valve in record and np.ptp(record[valve]) > least for valve, least in valves.items()
        ):
            asked.append(cylinder.name)
        spans = {
            f"{cylinder.name}.x": float(cylinder.stroke),
            f"{cylinder.name}.q": 1.0 if cylinder.pins else float(cylinder.stroke),
        }
        if cylinder.name in asked or any(
            c in record and np.ptp(record[c]) > MOVES * span for c, span in spans.items()
        ):
            live.append(cylinder.name)
    if not asked:
        raise InsufficientData(
            f"{name}: no valve command of rig '{rig.name}' changes, so the log shows no response to one"
        )
    columns: dict[str, np.ndarray] = {}
    for word in wanted:
        for channel in [word] if "." in word else [f"{cylinder}.{word}" for cylinder in live]:
            head, last = channel.rsplit(".", 1)
            for choice in (channel, f"{head}.{_STAND_INS.get(last, last)}"):
                if choice in record or (
                    choice == channel and f"{head}.{_STAND_INS.get(last, last)}" not in record
                ):
                    values = column(record, choice, record)
                    if values is not None and np.ptp(values) > 0.0:
                        columns.setdefault(choice, values)
                    break
    if not columns:
        raise InputError(
            f"{name}: of {', '.join(live)} the log has none of {', '.join(wanted)} that changes",
            hint="it has " + ", ".join(record.channels),
        )
    counts = np.ones((record.t.size, len(columns)), dtype=bool)
    for cylinder in rig.cylinder:
        void = _cavitates(rig, cylinder, record)
        own = [i for i, channel in enumerate(columns) if channel.startswith(cylinder.name + ".")]
        if own and void.any():
            counts[np.ix_(void, own)] = False
            warnings.append(
                f"{name}: {cylinder.name} cavitates at {record.t[int(np.argmax(void))]:.3g} s, which the model has only as a floor of"
                f" pressure; {100 * np.mean(void):.0f} % of its samples do not count"
            )
    return Log(
        name,
        record,
        payload_of(record),
        tuple(asked),
        tuple(live),
        tuple(columns),
        np.column_stack(list(columns.values())),
        counts,
        tuple(warnings),
    )


def _cavitates(rig: Rig, cylinder: Cylinder, record: Record) -> np.ndarray:
    """Where a recorded chamber is empty, or has been and no command of the cylinder has changed
    since, shape (samples,).
    """
    pressures = [
        record[c] for word in ("p_head", "p_rod") if (c := f"{cylinder.name}.{word}") in record
    ]
    void = np.zeros(record.t.size, dtype=bool)
    if not pressures:
        return void
    ahead = round(EMPTYING / record.sample_time)
    empty = np.flatnonzero(np.min(pressures, axis=0) < EMPTY * float(rig.oil.cavitation_pressure))
    valves = {
        f"{cylinder.name}.{valve.name}.command": least_change(valve) for valve in cylinder.valve
    }
    given = [valve for valve in valves if valve in record]
    table = (
        np.column_stack([record[valve] for valve in given])
        if given
        else np.zeros((record.t.size, 1))
    )
    least = np.array([valves[valve] for valve in given]) if given else 0.0
    stops = np.array(
        [window.start for window in transients(record.t, table, least=least)] + [record.t.size]
    )
    for first in empty:
        if not void[first]:
            stop = int(stops[np.searchsorted(stops, first, side="right")])
            void[max(0, first - ahead) : stop + ahead] = True
    return void


class Bench:
    """All logs, simulated at any parameter values, several at a time."""

    def __init__(
        self,
        rig: Rig,
        logs: Sequence[Log],
        names: Sequence[str],
        maps: Maps | None,
        workers: int,
        step: float,
    ) -> None:
        self.rig, self.logs, self.names, self.maps, self.step = (
            rig,
            tuple(logs),
            tuple(names),
            maps,
            step,
        )
        self.pool = ThreadPoolExecutor(workers or os.cpu_count() or 1)
        self.evaluations = 0

    def models(self, values: Sequence[float]) -> dict[str | None, Model]:
        """The model at these values by payload."""
        changed = self.rig.with_values(dict(zip(self.names, values, strict=True)))
        return {
            load: Model.of(changed, self.maps, load) for load in {log.payload for log in self.logs}
        }

    def chosen(self, which: Sequence[int] | None) -> Sequence[Log]:
        """Some logs by index; None for all."""
        return self.logs if which is None else [self.logs[i] for i in which]

    def simulate(
        self, vectors: Sequence[Sequence[float]], chosen: Sequence[int] | None = None
    ) -> list[list[np.ndarray | None]]:
        """Simulated channels by vector and log, shape (samples, channels); None where the
        simulation failed.
        """
        logs = self.chosen(chosen)
        tasks = [(models[log.payload], log) for models in map(self.models, vectors) for log in logs]
        self.evaluations += len(tasks)
        done = list(self.pool.map(self._one, tasks))
        return [done[i : i + len(logs)] for i in range(0, len(done), len(logs))]

    def _one(self, task: tuple[Model, Log]) -> np.ndarray | None:
        model, log = task
        try:
            replayed = model.replay(log.record, self.step)
        except SimulationError:
            return None
        return np.column_stack([column(replayed, channel, log.record) for channel in log.channels])

    def replay(self, values: Sequence[float]) -> list[Record]:
        """Every log simulated whole.

        Raises:
            SimulationError: the numbers left the finite range.
        """
        models = self.models(values)
        return list(
            self.pool.map(lambda log: models[log.payload].replay(log.record, self.step), self.logs)
        )


def finish(
    bench: Bench,
    method: str,
    fitted: Sequence[FittedParameter],
    warnings: Sequence[str],
    names: Sequence[str],
    correlation: np.ndarray,
    matches: Sequence[Match],
    scales: Mapping[str, float],
    iterations: int,
    cutoff: float | None = None,
) -> HydraulicsFit:
    """The result: the rig with its new values, and how each log fits at them.

    Raises:
        InsufficientData: the fitted model follows no channel of any log better than its mean.
    """
    told, count = (
        [text for log in bench.logs for text in log.warnings] + list(warnings),
        len(bench.logs),
    )
    for one in fitted:
        if one.status == "not_excited":
            told.append(
                f"{one.name} is not excited by these logs; it stays at {one.value:g} {one.unit}"
            )
        elif one.status == "at_bound":
            side = "lower" if one.value - one.lower < one.upper - one.value else "upper"
            told.append(f"{one.name} ran into its {side} bound, {one.value:g} {one.unit}")
    source = f"identified from {count} log{'s' if count > 1 else ''}, {method}"
    rig = bench.rig.with_values(
        {
            one.name: Value(
                one.value,
                sure="identified",
                source=source,
                std=one.std,
                lower=one.lower,
                upper=one.upper,
            )
            for one in fitted
            if one.status != "not_excited"
        }
    )
    logs, recordings = [], []
    for log, replayed in zip(bench.logs, bench.replay([one.value for one in fitted]), strict=True):
        simulated = np.column_stack(
            [column(replayed, channel, log.record) for channel in log.channels]
        )
        left = simulated - log.recorded
        left = lowpass(left, log.record.sample_time, cutoff) if cutoff else left
        sizes: dict[str, list[float]] = {}
        for channel, y, model, rest, counts in zip(
            log.channels, log.recorded.T, simulated.T, left.T, log.counts.T, strict=True
        ):
            some = counts if counts.any() else ~counts
            time = correlation_time(rest[some])
            sizes[channel] = [
                fit_percent(y[some], model[some]),
                rms(rest[some]),
                time,
                100.0 * float(np.mean(counts)),
            ]
        columns = [{channel: size[k] for channel, size in sizes.items()} for k in range(4)]
        logs.append(LogFit(log.name, log.payload or "none", len(left), *columns))
        told += _late(log, simulated)
        shown = [f"{cylinder}.{word}" for cylinder in log.live for word in SHOWN]
        shown = [channel for channel in shown if channel in log.record and channel in replayed]
        recordings.append(
            (
                log.name,
                {"t": log.record.t}
                | {channel: log.record[channel] for channel in shown}
                | {f"simulated.{channel}": replayed[channel] for channel in shown},
            )
        )
    told = _poor(logs) + told
    return HydraulicsFit(
        rig,
        method,
        tuple(fitted),
        tuple(names),
        tuple(tuple(map(float, row)) for row in correlation),
        tuple(logs),
        tuple(matches),
        dict(scales),
        tuple(told),
        bench.evaluations,
        iterations,
        tuple(recordings),
    )


def _poor(logs: Sequence[LogFit]) -> list[str]:
    """A loud warning of the channels that are followed worse than by their mean; refuses a fit that
    has nothing else.
    """
    fits = {
        f"{log.name}: {channel}": value
        for log in logs
        for channel, value in log.fit_percent.items()
        if math.isfinite(value)
    }
    poor = {name: value for name, value in fits.items() if value < 0.0}
    if not poor:
        return []
    some = ", ".join(
        f"{name} {value:.0f} %"
        for name, value in sorted(poor.items(), key=lambda item: item[1])[:4]
    )
    if len(poor) == len(fits):
        raise InsufficientData(
            f"the fitted model follows no channel of any log better than its mean would ({some})",
            hint="is it this rig's log, with the right payload, units, commands and flow maps?",
        )
    return [
        f"THE FITTED MODEL DOES NOT FOLLOW {len(poor)} OF {len(fits)} CHANNELS (worse than their mean): {some}; "
        "do not trust its numbers"
    ]


def _late(log: Log, simulated: np.ndarray) -> list[str]:
    """A warning if moving the simulation a little would explain a fifth of what is left.

    To first order ``simulated(t) − recorded(t) = delay · d simulated/dt``. Fitted parameters take
    up more than half of a shift, so a quarter of a sample may well be a whole one."""
    tick = log.record.sample_time
    left, slope = (
        (simulated - log.recorded) * log.counts,
        np.gradient(simulated, tick, axis=0) * log.counts,
    )
    size = np.maximum(np.sqrt(np.mean(left**2, axis=0)), 1e-300)
    left, slope = left / size, slope / size
    power = float(np.sum(slope**2))
    delay = float(np.sum(slope * left)) / power if power > 0.0 else 0.0
    if not 0.25 * tick <= abs(delay) <= 5.0 * tick or delay**2 * power < 0.2 * float(
        np.sum(left**2)
    ):
        return []
    word = "behind" if delay > 0 else "ahead of"
    return [
        f"{log.name}: the recording is {abs(delay) * 1e3:.2g} ms {word} the model: a sensor's lag, or samples that are not the state at their time"
    ]
