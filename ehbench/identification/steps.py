"""What both ways of identification share: parameters as search coordinates, logs made ready, simulation of all of them,
and the result."""

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
from ehbench.quantities import quantity
from ehbench.record import Record
from ehbench.rig import Cylinder, Rig, Value, Valve, parameter_row
from ehbench.signals import Ringing, correlation_time, fit_percent, lowpass, rms, transients
from ehbench.simulation import MOVED, Maps, Model

LEVEL = 0.95
# a standard error of more than this many units of a parameter says nothing: 95 % then span a factor of 50 (searched as a
# logarithm), or its whole range
VAGUE = {True: 1.0, False: 0.5}
# a chamber counts as empty below this share of the way from zero gauge pressure to the cavitation pressure; so long before and
# after [s] its cylinder's samples do not count either
EMPTY, EMPTYING = 0.5, 0.05
MOVES = 0.01  # share of the stroke beyond which a cylinder counts as moving
RATE_CUTOFF = 20.0  # [Hz] of the low-pass before a rate is taken from a position
SHOWN = ("q", "qd", "x", "v", "p_head", "p_rod")
# what stands in for a channel that a log lacks, and moves with it
_STAND_INS = {"qd": "v", "v": "qd", "q": "x", "x": "q"}
_RATE_OF = {"qd": "q", "v": "x"}

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class FittedParameter:
    """One fitted number, SI. ``std`` and ``interval`` (95 %) are None where the data give none; ``error_from`` says which
    standard error it is: ``hac`` (coloured residuals within each log), ``jackknife`` (leaving out one log at a time) or ``windows``."""

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
    """One transient whose ringing was matched: natural frequency [rad/s] and damping ratio, recorded and simulated."""

    log: str
    cylinder: str
    channels: tuple[str, ...]
    start: float
    stop: float
    recorded: Ringing
    simulated: Ringing


@dataclass(frozen=True)
class LogFit:
    """How well one log is reproduced, by channel: NRMSE fit [%], rms residual [SI] and its correlation time [samples], over the
    samples that count; ``counted`` is their share [%], ``samples`` how many the log has."""

    name: str
    payload: str
    samples: int
    fit_percent: dict[str, float]
    residual_rms: dict[str, float]
    correlation_time: dict[str, float]
    counted: dict[str, float]


@dataclass(frozen=True)
class HydraulicsFit:
    """What an identification found. ``rig`` carries the fitted values; ``correlation`` is between the parameters with a
    standard error, in the order of ``correlated_names``; ``scales`` [SI] is what each channel's residual was divided by."""

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
        """Everything but the rig and the time series as plain values, for `rundir.write_json`; what is unknown is None."""
        return asdict(replace(self, rig=None, recordings=())) | {
            "rig": self.rig.name,
            "recordings": [name for name, _ in self.recordings],
        }  # type: ignore[arg-type]

    def series(self) -> dict[str, dict[str, np.ndarray]]:
        """By log, columns named ``t [s]``, ``boom.q [rad]`` (recorded) and ``simulated.boom.q [rad]``, in SI."""
        return {log: {f"{name} [{quantity(name).unit}]": y for name, y in columns.items()} for log, columns in self.recordings}


@dataclass(frozen=True)
class Coordinate:
    """How a parameter is searched: as its logarithm where it is surely positive, else as a share of its range."""

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
    def begin(self) -> float:
        """Where the search starts: inside the bounds, as the solver asks."""
        low, high = self.bounds
        margin = 1e-3 * (high - low if math.isfinite(high - low) else 1.0)
        return min(max(self.of(self.start), low + margin), high - margin)

    def spread(self, theta: float, std: float, quantile: float) -> tuple[float, tuple[float, float]]:
        """(standard error, interval inside the bounds), SI, from a standard error of theta."""
        value = self.at(theta)
        ends = (self.at(theta - quantile * std), self.at(theta + quantile * std))
        return (value * std if self.log else self.unit * std), ends


def _number(raw: str | float, name: str) -> float:
    return units.parse(raw, parameter_row(name)) if isinstance(raw, str) else float(raw)


def coordinates(
    rig: Rig,
    names: Sequence[str],
    start: Mapping[str, str | float] | None = None,
    lower: Mapping[str, str | float] | None = None,
    upper: Mapping[str, str | float] | None = None,
) -> list[Coordinate]:
    """The search coordinates of parameters; start and bounds as given (SI or text with unit), else the rig's, else plausible ones.

    Raises:
        InputError: unknown or repeated parameter, a start outside its bounds, or a zero start without an upper bound.
    """
    from difflib import get_close_matches

    known = rig.parameters()
    given = {"start": dict(start or {}), "lower": dict(lower or {}), "upper": dict(upper or {})}
    for name in [*names, *(name for table in given.values() for name in table)]:
        if name not in known:
            near = get_close_matches(name, known, 1)
            raise InputError(f"rig '{rig.name}' has no parameter '{name}'", hint=f"nearest is '{near[0]}'" if near else None)
    for key, table in given.items():
        for name in table:
            if name not in names:
                raise InputError(f"{key} names '{name}', which is not among the parameters to fit", hint=", ".join(names))
    if not names or len(set(names)) < len(names):
        raise InputError("the parameters to fit must be named, each once")
    result = []
    for name in names:
        value, row = known[name], parameter_row(name)
        first = _number(given["start"].get(name, float(value)), name)
        low = _number(given["lower"].get(name, row.lower if value.lower is None else value.lower), name)
        high = _number(given["upper"].get(name, row.upper if value.upper is None else value.upper), name)
        if not low < high:
            raise InputError(f"{name}: the lower bound {low:g} is not below the upper bound {high:g} {row.unit}")
        if not low <= first <= high:
            raise InputError(f"{name} starts at {first:g} {row.unit}, outside its bounds {low:g} to {high:g}")
        log = low > 0.0
        bounded = name in given["upper"] or value.upper is not None
        unit = high - low if bounded and math.isfinite(high - low) else abs(first)
        if unit == 0.0:
            raise InputError(f"{name} starts at zero and has no upper bound", hint="give it one, so that the search has a scale")
        result.append(Coordinate(name, log, 1.0 if log else unit, first, low, high))
    return result


@dataclass(frozen=True)
class Log:
    """A log made ready: the cylinders that are asked to move, those that move, the channels that are compared, what was
    recorded of them and whether it counts, both of shape (samples, channels)."""

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
    """A channel [SI]; where ``like`` lacks it, the rate of its position behind a low-pass, None if that is lacking too."""
    if channel in like:
        return record[channel]
    head, word = channel.rsplit(".", 1)
    position = f"{head}.{_RATE_OF.get(word, word)}"
    if word not in _RATE_OF or position not in like:
        return None
    return np.gradient(lowpass(record[position], record.sample_time, RATE_CUTOFF), record.sample_time)


def least_change(valve: Valve) -> float:
    """The change of a valve's recorded command [V] that is more than noise."""
    return MOVED * (float(valve.command_max) - float(valve.command_min))


def prepare(rig: Rig, record: Record, name: str, wanted: Sequence[str]) -> Log:
    """Choose the channels: the wanted ones of every cylinder that is asked to move or moves.

    Raises:
        InputError: an unknown payload, a sample that is no number, or no channel to compare.
        InsufficientData: no command changes.
    """
    said = record.meta.get("payload", "none")
    payload = None if said in ("", "none") else said
    rig.with_payload(payload)
    asked, live = [], []
    for cylinder in rig.cylinder:
        valves = {f"{cylinder.name}.{valve.name}.command": least_change(valve) for valve in cylinder.valve}
        if any(valve in record and np.ptp(record[valve]) > least for valve, least in valves.items()):
            asked.append(cylinder.name)
        spans = {
            f"{cylinder.name}.x": float(cylinder.stroke),
            f"{cylinder.name}.q": 1.0 if cylinder.pins else float(cylinder.stroke),
        }
        if cylinder.name in asked or any(c in record and np.ptp(record[c]) > MOVES * span for c, span in spans.items()):
            live.append(cylinder.name)
    if not asked:
        raise InsufficientData(f"{name}: no valve command of rig '{rig.name}' changes, so the log shows no response to one")
    for channel, values in record.channels.items():
        if not np.isfinite(values).all():
            raise InputError(
                f"{name}: channel '{channel}' is not a number at t = {record.t[int(np.argmin(np.isfinite(values)))]:g} s"
            )
    columns: dict[str, np.ndarray] = {}
    for word in wanted:
        for channel in [word] if "." in word else [f"{cylinder}.{word}" for cylinder in live]:
            head, last = channel.rsplit(".", 1)
            for choice in (channel, f"{head}.{_STAND_INS.get(last, last)}"):
                if choice in record or (choice == channel and f"{head}.{_STAND_INS.get(last, last)}" not in record):
                    values = column(record, choice, record)
                    if values is not None and np.ptp(values) > 0.0:
                        columns.setdefault(choice, values)
                    break
    if not columns:
        raise InputError(
            f"{name}: of {', '.join(live)} the log has none of {', '.join(wanted)} that changes",
            hint="it has " + ", ".join(record.channels),
        )
    counts, told = np.ones((record.t.size, len(columns)), dtype=bool), []
    for cylinder in rig.cylinder:
        void = _cavitates(rig, cylinder, record)
        own = [i for i, channel in enumerate(columns) if channel.startswith(cylinder.name + ".")]
        if own and void.any():
            counts[np.ix_(void, own)] = False
            told.append(
                f"{name}: {cylinder.name} cavitates at {record.t[int(np.argmax(void))]:.3g} s, which the model has only as a floor of"
                f" pressure; {100 * np.mean(void):.0f} % of its samples do not count"
            )
    return Log(
        name,
        record,
        payload,
        tuple(asked),
        tuple(live),
        tuple(columns),
        np.column_stack(list(columns.values())),
        counts,
        tuple(told),
    )


def _cavitates(rig: Rig, cylinder: Cylinder, record: Record) -> np.ndarray:
    """Where a recorded chamber is empty, or has been and no command of the cylinder has changed since, shape (samples,)."""
    pressures = [record[c] for word in ("p_head", "p_rod") if (c := f"{cylinder.name}.{word}") in record]
    void = np.zeros(record.t.size, dtype=bool)
    if not pressures:
        return void
    ahead = round(EMPTYING / record.sample_time)
    empty = np.flatnonzero(np.min(pressures, axis=0) < EMPTY * float(rig.oil.cavitation_pressure))
    valves = {f"{cylinder.name}.{valve.name}.command": least_change(valve) for valve in cylinder.valve}
    given = [valve for valve in valves if valve in record]
    table = np.column_stack([record[valve] for valve in given]) if given else np.zeros((record.t.size, 1))
    least = np.array([valves[valve] for valve in given]) if given else 0.0
    stops = np.array([window.start for window in transients(record.t, table, least=least)] + [record.t.size])
    for first in empty:
        if not void[first]:
            stop = int(stops[np.searchsorted(stops, first, side="right")])
            void[max(0, first - ahead) : stop + ahead] = True
    return void


class Bench:
    """All logs, simulated at any parameter values, several at a time."""

    def __init__(self, rig: Rig, logs: Sequence[Log], names: Sequence[str], maps: Maps | None, workers: int, step: float) -> None:
        self.rig, self.logs, self.names, self.maps, self.step = rig, tuple(logs), tuple(names), maps, step
        self.pool = ThreadPoolExecutor(workers or os.cpu_count() or 1)
        self.evaluations = 0

    def models(self, values: Sequence[float]) -> dict[str | None, Model]:
        """The model at these values by payload."""
        changed = self.rig.with_values(dict(zip(self.names, values, strict=True)))
        return {load: Model.of(changed, self.maps, load) for load in {log.payload for log in self.logs}}

    def chosen(self, which: Sequence[int] | None) -> Sequence[Log]:
        """Some logs by index; None for all."""
        return self.logs if which is None else [self.logs[i] for i in which]

    def simulate(self, vectors: Sequence[Sequence[float]], chosen: Sequence[int] | None = None) -> list[list[np.ndarray | None]]:
        """Simulated channels by vector and log, shape (samples, channels); None where the simulation failed."""
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
        return list(self.pool.map(lambda log: models[log.payload].replay(log.record, self.step), self.logs))


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
    """The result: the rig with its new values, and how each log fits at them."""
    told, count = [text for log in bench.logs for text in log.warnings] + list(warnings), len(bench.logs)
    for one in fitted:
        if one.status == "not_excited":
            told.append(f"{one.name} is not excited by these logs; it stays at {one.value:g} {one.unit}")
        elif one.status == "at_bound":
            side = "lower" if one.value - one.lower < one.upper - one.value else "upper"
            told.append(f"{one.name} ran into its {side} bound, {one.value:g} {one.unit}")
    source = f"identified from {count} log{'s' if count > 1 else ''}, {method}"
    rig = bench.rig.with_values(
        {
            one.name: Value(one.value, sure="identified", source=source, std=one.std, lower=one.lower, upper=one.upper)
            for one in fitted
            if one.status != "not_excited"
        }
    )
    logs, recordings = [], []
    for log, replayed in zip(bench.logs, bench.replay([one.value for one in fitted]), strict=True):
        simulated = np.column_stack([column(replayed, channel, log.record) for channel in log.channels])
        left = simulated - log.recorded
        left = lowpass(left, log.record.sample_time, cutoff) if cutoff else left
        sizes: dict[str, list[float]] = {}
        for channel, y, model, rest, counts in zip(log.channels, log.recorded.T, simulated.T, left.T, log.counts.T, strict=True):
            some = counts if counts.any() else ~counts
            time = correlation_time(rest[some])
            sizes[channel] = [fit_percent(y[some], model[some]), rms(rest[some]), time, 100.0 * float(np.mean(counts))]
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
    return HydraulicsFit(
        rig, method, tuple(fitted), tuple(names), tuple(tuple(map(float, row)) for row in correlation), tuple(logs), tuple(matches),
        dict(scales), tuple(told), bench.evaluations, iterations, tuple(recordings),
    )  # fmt: skip


def _late(log: Log, simulated: np.ndarray) -> list[str]:
    """A warning if moving the simulation a little would explain a fifth of what is left.

    To first order ``simulated(t) − recorded(t) = delay · d simulated/dt``. Fitted parameters take up more than half of a shift,
    so a quarter of a sample may well be a whole one.
    """
    tick = log.record.sample_time
    left, slope = (simulated - log.recorded) * log.counts, np.gradient(simulated, tick, axis=0) * log.counts
    size = np.maximum(np.sqrt(np.mean(left**2, axis=0)), 1e-300)
    left, slope = left / size, slope / size
    power = float(np.sum(slope**2))
    delay = float(np.sum(slope * left)) / power if power > 0.0 else 0.0
    if not 0.25 * tick <= abs(delay) <= 5.0 * tick or delay**2 * power < 0.2 * float(np.sum(left**2)):
        return []
    word = "behind" if delay > 0 else "ahead of"
    return [
        f"{log.name}: the recording is {abs(delay) * 1e3:.2g} ms {word} the model: a sensor's lag, or samples that are not the state at their time"
    ]
