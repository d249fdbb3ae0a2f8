"""Logs made ready for identification, and the simulation of all of them at any parameters."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ehbench.config.rig import Cylinder, Rig
from ehbench.data.record import BlockAverages, Record, block_averages
from ehbench.identification.means import Decimate, means_of
from ehbench.parts.edge import edge_onset
from ehbench.plant.build import Kept, Maps, map_of
from ehbench.plant.foreign import model_of
from ehbench.plant.many import map_threads
from ehbench.plant.model import FREE, Model
from ehbench.plant.paced import AUTO, Step
from ehbench.plant.stiffness import short_steps
from ehbench.plant.ties import tied_words
from ehbench.preprocessing.initial_states import InitialState, initial_state_of
from ehbench.preprocessing.observations import (
    alternatives,
    channels_asked,
    column,
    count_error,
    least_changes,
    not_described,
    payload_of,
    position_of,
)
from ehbench.preprocessing.plausibility import LIMITED, at_limit, held
from ehbench.preprocessing.preparation import preprocess
from ehbench.preprocessing.sensors import Term
from ehbench.runtime.cores import cores
from ehbench.signals.series import white_noise
from ehbench.vocabulary import Message, message, quantity, setting
from ehbench.vocabulary.errors import EhbenchError, InputError, InsufficientData
from ehbench.vocabulary.messages import of_log
from ehbench.vocabulary.quantities import like_channel

if TYPE_CHECKING:
    from ehbench.identification.band import Band

# rates and pressures: an angle is the integral of the flow map's error
CHANNELS = ("qd", "p_head", "p_rod")
FLOWS = ("flow", "flow_supply")  # words of what a simulation has only where it is asked for
# words of what means of its state do not tell: openings, and a force that turns with the speed
BENT = ("opening", "rod_force")


@dataclass(frozen=True)
class LogSettings:
    """Which samples of a log count, and what moves in it."""

    moves: float = setting(0.01, "", "part of the stroke from which a cylinder moves", "slips")


SETTINGS = LogSettings()

Shifts = list[np.ndarray]  # by log, of its start [prior standard deviations], one a doubt
Meshes = Sequence[np.ndarray]  # by log, the steps that its simulation takes (`plant.paced`)
Where = tuple[Sequence[float], int, np.ndarray]  # parameters, a log by index, shifts of its start


@dataclass(frozen=True)
class Log:
    """A log made ready: the cylinders that are asked to move, those that move, the channels that
    are compared, what was recorded of them and whether it counts, both of shape (samples,
    channels), and where it starts. Where it is compared as ``means``, these are the samples."""

    name: str
    record: Record
    payload: str | None
    commanded: tuple[str, ...]
    live: tuple[str, ...]
    channels: tuple[str, ...]
    recorded: np.ndarray
    counts: np.ndarray
    start: InitialState
    warnings: tuple[str, ...] = ()
    band: Band | None = None
    means: BlockAverages | None = None

    @property
    def each(self) -> int:
        """Samples of the record of which one is compared."""
        return 1 if self.means is None else self.means.each

    @property
    def seen(self) -> Record:
        """The readings as they are compared."""
        return self.record if self.means is None else self.means.record

    @cached_property
    def within(self) -> np.ndarray:
        """rms of the noise that means leave out, by channel [SI], shape (channels,)."""
        share, record = math.sqrt(1.0 - 1.0 / self.each), self.record
        known = self.means is not None
        return np.array(
            [
                share * white_noise(record[c]) if known and c in record else 0.0
                for c in self.channels
            ]
        )

    @cached_property
    def coarse(self) -> np.ndarray:
        """Standard error [SI] of a resting reading that is recorded in counts, shape (channels,);
        zero where the log is compared otherwise than by its readings."""
        record, known = self.record, self.band is None
        return np.array(
            [count_error(record[c]) if known and c in record else 0.0 for c in self.channels]
        )

    @property
    def sample_time(self) -> float:
        """Between what is compared [s]."""
        return self.each * self.record.sample_time

    def head(self, seconds: float) -> Log:
        """The first seconds of the log, as many as it takes every command to have changed as often
        as two steps out and back; the log itself if it is not much longer."""
        if self.band is not None:
            return self
        record = self.record
        names = [name for name in record.channels if name.endswith(".command")]
        ends = [round(seconds / record.sample_time)]
        for name in names:
            changes = np.flatnonzero(np.abs(np.diff(record[name])) > 0.0)
            if changes.size:
                ends.append(int(changes[min(4, changes.size) - 1]) + 1)
        count = max(ends) + round(0.1 * seconds / record.sample_time)
        if count > 0.7 * record.t.size:
            return self
        seen = -(-count // self.each)
        short = record.at(slice(seen * self.each))
        means = self.means and replace(self.means, record=self.means.record.at(slice(seen)))
        return replace(
            self,
            record=short,
            recorded=self.recorded[:seen],
            counts=self.counts[:seen],
            start=replace(self.start, record=short),
            means=means,
        )


def prepare(
    model: Model,
    record: Record,
    name: str,
    required: Sequence[str],
    terms: Sequence[Term],
    decimate: Decimate,
    cutoff: float | None,
) -> Log:
    """Take a log in (`preprocessing.preprocess`) for a model that carries its payload, and choose
    the channels: the wanted ones of every cylinder that is asked to move or moves; ``terms`` are
    what its sensors make of it, ``decimate`` and ``cutoff`` as `means.means_of` takes them.

    Raises:
        InputError: a log that is not of this rig, or not in the units it says; no channel to
            compare.
        InsufficientData: no command changes."""
    rig = model.rig
    record, doubts = preprocess(name, record, model)
    warnings = [of_log(name, text) for text in doubts]
    requested = [
        cylinder.name
        for cylinder in rig.cylinder
        if any(
            np.ptp(record[c]) > minimum for c, minimum in least_changes(cylinder, record).items()
        )
    ]
    live = [c.name for c in rig.cylinder if c.name in requested or _moves(c, record)]
    if not requested:
        raise InsufficientData(message("identification.no_command_changes", log=name, rig=rig.name))
    means = means_of(model, record, decimate, cutoff)
    seen = record if means is None else means.record
    columns = _compared(name, seen, live, required)
    gone = [c for c in columns if not model.shows(c if c in seen else position_of(c))]
    if len(gone) == len(columns):
        raise InputError(message("identification.fmu_shows", log=name, channels=", ".join(gone)))
    columns = {channel: y for channel, y in columns.items() if channel not in gone}
    warnings += [
        message("identification.not_compared", log=name, word=word)
        for word in required
        if word not in CHANNELS and not _columns(record, live, [word])
    ]
    counts, voids = _counts(name, model, record, list(columns))
    if not counts.any():
        raise InsufficientData(message("identification.none_counts", notes="; ".join(voids)))
    return Log(
        name,
        record,
        payload_of(record),
        tuple(requested),
        tuple(live),
        tuple(columns),
        np.column_stack(list(columns.values())),
        counts if means is None else block_averages(counts, means.each) == 1.0,
        initial_state_of(model, record, live, list(columns), terms),
        (*warnings, *voids),
        means=means,
    )


def _counts(
    name: str, model: Model, record: Record, channels: Sequence[str]
) -> tuple[np.ndarray, list[str]]:
    """(which samples of a log count, shape (samples, channels); a warning of each cylinder of which
    some do not): what the model does not describe, and a sensor at its end, do not."""
    messages: list[str] = []
    counts = np.ones((record.t.size, len(channels)), dtype=bool)
    for what, cylinder, void in not_described(model, record):
        columns = [i for i, name in enumerate(channels) if name.startswith(f"{cylinder}.")]
        if columns:
            counts[np.ix_(void, np.array(columns))] = False
            fields = {"t": record.t[int(np.argmax(void))], "share": 100 * np.mean(void)}
            fields |= {"log": name, "cylinder": cylinder}
            messages.append(message(f"identification.{what}", **fields))
    for i, channel in enumerate(channels):
        if channel in record and quantity(channel).unit in LIMITED:
            counts[at_limit(record[channel]), i] = False
        counts[held(record, channel), i] = False
    return counts, messages


def shut(model: Model, log: Log) -> str | None:
    """Why no valve opens in a log, whose commands stay within dead bands; None if one does."""
    plant, names = model.plant, model.layout
    closest: tuple[float, str] | None = None
    for edge, name in zip(plant.edges, names.edges, strict=True):
        valve = names.valves[edge.valve] if edge.valve >= 0 else ""
        channel = f"{valve}.command"
        if valve.partition(".")[0] not in log.commanded or channel not in log.record:
            continue
        onset = edge.sign * edge_onset(edge, plant.maps)
        onset = 0.0 if edge.unmetered else onset
        maximum = float(np.max(edge.sign * log.record[channel]))
        if maximum > onset:
            return None
        if maximum > 0.0 and (closest is None or onset - maximum < closest[0]):
            fields = {"channel": channel, "maximum": maximum, "edge": name, "onset": onset}
            closest = onset - maximum, message("identification.within_deadband", **fields)
    return closest[1] if closest else message("identification.opens_nothing")


def _moves(cylinder: Cylinder, record: Record) -> bool:
    """Whether a recorded position of the cylinder changes."""
    stroke = float(cylinder.stroke)
    spans = {"x": stroke, "q": 1.0 if cylinder.linkage else stroke}
    limits = {f"{cylinder.name}.{word}": SETTINGS.moves * span for word, span in spans.items()}
    return any(c in record and np.ptp(record[c]) > limit for c, limit in limits.items())


def _compared(
    name: str, record: Record, live: Sequence[str], required: Sequence[str]
) -> dict[str, np.ndarray]:
    """What a simulation along a log is compared with: `_columns` but for what is tied.

    Raises:
        InputError: nothing."""
    result, given = _columns(record, live, required), tied_words(record)
    free = {channel: y for channel, y in result.items() if channel.rpartition(".")[2] not in given}
    fields = {"log": name, "live": ", ".join(live), "required": ", ".join(required)}
    if result and not free:
        raise InputError(message("identification.tied_channels", **fields))
    if not result:
        hint = like_channel(required[0] if len(required) == 1 else "", list(record.channels))
        raise InputError(message("identification.nothing_changes", **fields), hint=hint)
    return free


def _columns(record: Record, live: Sequence[str], required: Sequence[str]) -> dict[str, np.ndarray]:
    """What the log has of the wanted quantities of the live cylinders and of the channels wanted by
    full name, if it changes: the channel, what stands in for it, or the rate of its position."""
    columns: dict[str, np.ndarray] = {}
    for word in required:
        listed = [item for cylinder in live for item in channels_asked(record, cylinder, word)]
        for channel in [word] if "." in word else listed:
            names = alternatives(channel)
            results = {name: column(record, name, record) for name in names}
            present = [name for name in names if results[name] is not None]
            choice = next(
                (name for name in present if name in record), present[0] if present else channel
            )
            values = results.get(choice)
            if values is not None and np.ptp(values) > 0.0:
                columns.setdefault(choice, values)
    return columns


@dataclass
class Effort:
    """What a search has cost so far."""

    evaluations: int = 0
    iterations: int = 0


class Simulator:
    """All logs, simulated at any parameter values, several at a time.

    Args:
        names: of the parameters, in the order of the values; also of terms of sensors that all
            logs share, whose values are their bias.
        workers: threads; 0 for one per core.
        step: of the integration [s], or ``"auto"``."""

    def __init__(
        self,
        rig: Rig,
        logs: Sequence[Log],
        names: Sequence[str],
        maps: Maps | None,
        workers: int,
        step: Step = AUTO,
    ) -> None:
        self.rig, self.known, self.maps = rig, rig.parameters(), maps
        self.step: Step = step
        self.logs, self.names = tuple(logs), tuple(names)
        self.shared = {t.name for log in logs for t in log.start.terms if not t.per_log}
        self.workers = workers or cores()
        self.effort = Effort()
        self._kept = Kept()
        self._last: tuple[dict[str, float], Rig] = {}, rig

    def over(self, logs: Sequence[Log]) -> Simulator:
        """The same simulator of other logs, with the same cache and count of effort."""
        other = copy.copy(self)
        other.logs = tuple(logs)
        return other

    def beside(self, names: Iterable[str]) -> Simulator:
        """The same simulator with further parameters behind its own."""
        other = copy.copy(self)
        other.names = (*self.names, *names)
        return other

    def fixed_errors(self) -> dict[str, tuple[float, float]]:
        """(value, standard error) [SI] of each number of the rig that states one and is none of the
        parameters, and of the factor on each measured map."""
        known = {name: (float(value), value.std or 0.0) for name, value in self.known.items()}
        for cylinder, valve, edge in self.rig.edges():
            name = f"{cylinder.name}.{valve.edge_name(edge)}"
            item, factor = map_of(self.maps, name), f"{name}.map_factor"
            channel = f"{cylinder.name}.{valve.name}.command"
            commands = [log.record[channel] for log in self.logs if channel in log.record]
            if item is not None and commands and known[factor][1] == 0.0:
                error = item.relative_std(edge.sign * np.concatenate(commands))
                known[factor] = known[factor][0], known[factor][0] * error
        given = known if self.rig.model is None else self.rig.model.settable
        return {
            name: pair
            for name, pair in known.items()
            if pair[1] > 0.0 and name in given and name not in self.names
        }

    def models(self, values: Sequence[float]) -> dict[str | None, Model]:
        """The model at these values by payload.

        Raises:
            EhbenchError: there is no such rig."""
        changed = self._rig(values)
        return {
            load: model_of(changed, self.maps, load, self._kept)
            for load in {log.payload for log in self.logs}
        }

    def misfit(self, values: Sequence[float]) -> str:
        """Why no rig file may have these values beside one another; empty if it may."""
        try:
            self._rig(values)
        except InputError as error:
            return str(error)
        return ""

    def _rig(self, values: Sequence[float]) -> Rig:
        """The rig at these values, made of the last: what did not change stays the same objects.

        Raises:
            InputError: no rig file may have these values beside one another."""
        (before, rig), named = self._last, self._by_name(values, False)
        moved = {name: value for name, value in named.items() if before.get(name) != value}
        rig = rig.with_values(moved, self.known)
        self._last = named, rig
        rig.refuse_misfits()
        return rig

    def _by_name(self, values: Sequence[float], shared: bool) -> dict[str, float]:
        """The values of the rig's parameters, or those of the sensors that all logs share."""
        pairs = zip(self.names, values, strict=True)
        return {name: value for name, value in pairs if (name in self.shared) == shared}

    def chosen(self, which: Sequence[int] | None) -> Sequence[Log]:
        """Some logs by index; None for all."""
        return self.logs if which is None else [self.logs[i] for i in which]

    def simulate(
        self,
        vectors: Sequence[Sequence[float]],
        chosen: Sequence[int] | None = None,
        shifts: Shifts | None = None,
        slack: float = 1.0,
    ) -> list[list[np.ndarray | None]]:
        """Simulated channels by vector and log, shape (samples, channels); None where the
        simulation failed.

        Args:
            chosen: logs by index, all by default.
            shifts: of all logs' starts, by default none.
            slack: of the steps that are chosen (`Model.paced`)."""
        shifts = self.unshifted() if shifts is None else shifts
        which = range(len(self.logs)) if chosen is None else chosen
        row, _ = self.each([(v, k, shifts[k]) for v in vectors for k in which], slack=slack)
        return [row[i : i + len(which)] for i in range(0, len(row), len(which))]

    def each(
        self, points: Sequence[Where], meshes: Meshes | None = None, slack: float = 1.0
    ) -> tuple[list[np.ndarray | None], Meshes]:
        """(simulated channels, shape (samples, channels), None where the simulation failed; the
        steps taken) of each (values, log by index, shifts of its start).

        Args:
            meshes: steps to take, of all logs; chosen by default.
            slack: of the steps that are chosen."""
        self.effort.evaluations += len(points)
        built: dict[tuple[float, ...], dict[str | None, Model | None]] = {}
        models = []
        for values, k, _ in points:
            key = tuple(self._by_name(values, False).values())
            if key not in built:
                try:
                    built[key] = dict(self.models(values))
                except (EhbenchError, ArithmeticError, np.linalg.LinAlgError):
                    # these values make no rig: pins that its cylinder cannot join
                    built[key] = dict.fromkeys(item.payload for item in self.logs)
            models.append(built[key][self.logs[k].payload])

        def simulated(i: int) -> tuple[np.ndarray | None, np.ndarray]:
            model, (values, k, shifts) = models[i], points[i]
            if model is None:
                return None, FREE
            log, shared = self.logs[k], self._by_name(values, True)
            words = {channel.rpartition(".")[2] for channel in log.channels}
            try:
                start, true = log.start.begin(model, shifts, shared)
                if self.step == AUTO and words.isdisjoint(FLOWS):
                    means = log.means if words.isdisjoint(BENT) else None
                    mesh = FREE if meshes is None else meshes[k]
                    replayed, mesh = model.replay_paced(true, start, mesh, slack, means)
                else:
                    replayed, mesh = model.replay(true, self.step, start=start), FREE
                return channels_of(log, log.start.seen(replayed, shifts, shared)), mesh
            except (EhbenchError, ArithmeticError):
                return None, FREE

        done = map_threads(simulated, range(len(points)), self.workers)
        return [channels for channels, _ in done], [mesh for _, mesh in done]

    def unshifted(self) -> Shifts:
        """No shift of any log's start."""
        return [np.zeros(len(log.start.uncertain)) for log in self.logs]

    def replay(
        self, values: Sequence[float], shifts: Shifts
    ) -> tuple[list[dict[str, float]], list[Record]]:
        """Every log simulated whole, its start shifted: where it starts [SI] by doubt, and the
        record.

        Raises:
            SimulationError: the numbers left the finite range."""
        models, shared = self.models(values), self._by_name(values, True)

        def replayed(task: tuple[Log, np.ndarray]) -> tuple[dict[str, float], Record]:
            log, shift = task
            model = models[log.payload]
            start, true = log.start.begin(model, shift, shared)
            numbers, built = log.start.numbers(start), model.replay(true, self.step, start=start)
            return numbers, log.start.seen(built, shift, shared)

        tasks = list(zip(self.logs, shifts, strict=True))
        starts, records = zip(*map_threads(replayed, tasks, self.workers), strict=True)
        return list(starts), list(records)

    def short_steps(self, values: Sequence[float], shifts: Shifts) -> Iterator[Message]:
        """Of each log that takes very short steps, which state limits them and what makes it fast.

        Raises:
            SimulationError: the numbers left the finite range."""
        if self.step != AUTO:
            return
        models, shared = self.models(values), self._by_name(values, True)
        for log, shift in zip(self.logs, shifts, strict=True):
            model = models[log.payload]
            start, true = log.start.begin(model, shift, shared)
            for note in short_steps(model, true, start):
                yield message("identification.short_steps", log=log.name, note=note)


def columns_of(log: Log, record: Record) -> np.ndarray:
    """The log's channels in a recording or a replay, shape (samples, channels)."""
    columns = [column(record, channel, log.record) for channel in log.channels]
    return np.column_stack([values for values in columns if values is not None])


def channels_of(log: Log, replayed: Record) -> np.ndarray:
    """What is compared of a replay, of every sample or of means: the log's channels, shape
    (samples, channels); of a log that is compared by its frequency response, that."""
    built = columns_of(log, seen_as(log, replayed))
    return built if log.band is None else log.band.seen(log.record, built)


def seen_as(log: Log, replayed: Record) -> Record:
    """A replay as the log is compared: the replay itself, or its means."""
    if log.means is None or replayed.t.size == log.seen.t.size:
        return replayed
    return BlockAverages.of(replayed, log.each).record
