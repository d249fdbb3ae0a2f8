"""Where a simulation along a recording starts, and by how much that may be off.

A recording tells its own first state only as well as its sensors do: the mean of a drifting rest is
not the pressure at the first sample, and a supply's pressure is known to its noise. Each such
number is a nuisance, in units of the standard deviation that the recording leaves it (its prior);
identification and validation let the whole log say the rest."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ehbench.data.record import Record
from ehbench.parts.cylinder import linkage_of
from ehbench.parts.valve import valve_lag, valve_settle
from ehbench.plant.integrate import STEP
from ehbench.plant.layout import SIDES
from ehbench.plant.many import Replay, replay_many
from ehbench.plant.model import Model, Seen, Start, seen_of
from ehbench.plant.ties import supplied, tied_words
from ehbench.plant.trim import settle_parts
from ehbench.preprocessing.observations import column
from ehbench.preprocessing.plausibility import moving_at_first, on_at_first
from ehbench.preprocessing.sensors import Excess, Term, corrected, sensed
from ehbench.signals.series import LEAST_LINE, autocorrelation, correlation_time, rms
from ehbench.vocabulary.errors import SimulationError

# priors as shares: pressures of the supply's, positions of the stroke, speeds of the fastest,
# openings of the driver's range
VAGUE_PRESSURE, COMPARED_PRESSURE, SENSOR = 0.2, 0.05, 0.005
VAGUE_PLACE, FINE_PLACE, VAGUE_SPEED, VAGUE_OPENING = 0.25, 1.0e-5, 0.2, 0.25
FINE_SUPPLY = 1.0e-5
SUPPLY_CHANNEL, TANK_CHANNEL = "p_supply", "p_tank"
BEGINNING = 0.03  # [s] over which the first samples of a motion tell its state
# a rest creeps where its mean speed is so many standard errors, and such a share of the fastest
CREEPS, CREEPING = 3.0, 1.0e-3
DIFFERENCE = 0.3  # of finite differences, in prior standard deviations, …
SENSED = 0.01  # … of a sensor's, which nothing makes uneven
SMALLEST, LARGEST = 1.0e-6, 2.0e-4  # … but within these shares of a number's range
LINE = math.sqrt(12.0)  # standard error of what a line rises by, in those of its mean
LEAST_LEFT = 0.2  # share of noise that a line through few independent samples leaves
ROUNDS, CONVERGED = 20, 1.0e-3  # of an estimate: maximum of rounds, and the gain that ends them
NOTHING: Mapping[str, float] = {}  # wrong with the sensors of all logs
_KEPT = 64  # starts along one recording
FLOOR = 5.0e-3  # of a channel's scale, as a share of its spread


@dataclass(frozen=True)
class Doubt:
    """One number of a start: what it is (``boom.p_head``), where it stands in the state, the
    standard deviation that the recording leaves it and its step of finite differences, both in SI.

    ``valve`` is the number of the valve that an opening belongs to, −1 for all others; ``state`` is
    −1 for what stands in no state: the tank's pressure, and a number of a sensor of this log, which
    is its ``excess`` (`sensors.Term`)."""

    name: str
    state: int
    std: float
    step: float
    valve: int = -1
    excess: bool = False

    @property
    def share(self) -> float:
        """Its step in standard deviations."""
        return self.step / self.std


class Starts:
    """Where models begin along one recording: found once of all that are alike in what a start
    hangs on. Most parameters of a fit are none of that.

    Args:
        begin: finds the start of a model.
        moves: whether the recording begins in motion.
    """

    def __init__(self, begin: Callable[[Model], Start], moves: bool) -> None:
        self._begin, self._moves = begin, moves
        self._known: dict[Hashable, Start] = {}

    def of(self, model: Model) -> Start:
        """The start of a model, which is for all: its state cannot be written."""
        requested = model.asked_at_start(self._moves)
        result = self._known.get(requested)
        if result is None:
            result = self._begin(model)
            result.y.flags.writeable = False
            if len(self._known) >= _KEPT:
                self._known.clear()
            self._known[requested] = result
        return result


@dataclass(frozen=True)
class LogStart:
    """Where a recording starts: after ``rest`` samples at rest, or in motion; its doubts, and what
    its sensors make of it. ``shared`` is what is wrong with those of all logs alike."""

    record: Record
    rest: int
    moves: bool
    doubts: tuple[Doubt, ...]
    terms: tuple[Term, ...] = ()

    def at(self, model: Model, shifts: np.ndarray, shared: Excess = NOTHING) -> Start:
        """The start of a model, moved by ``shifts`` [prior standard deviations], one a doubt.

        Raises:
            InputError: a posture outside the stroke.
        """
        return self.moved_from(self.unmoved(model, shifts, shared), model, shifts)

    @property
    def alike(self) -> bool:
        """Whether `unmoved` is the same for all shifts: none is of a sensor."""
        return not any(doubt.excess for doubt in self.doubts)

    def unmoved(self, model: Model, shifts: np.ndarray, shared: Excess = NOTHING) -> Start:
        """What `at` moves: the start as sensors tell it that the shifts have put right.

        Raises:
            InputError: as `at`.
        """
        true = self.true(shifts, shared)
        if true is self.record:
            return self._starts.of(model)
        # sensors are put right, and it tells something else
        if self.moves:
            return _moving_start(model, true, _firsts(true, self.rest))
        return model.rest_start(true, self.rest)

    @cached_property
    def _starts(self) -> Starts:
        """What models begin with along the recording as it is."""

        def begin(model: Model) -> Start:
            if self.moves:
                return _moving_start(model, self.record, self._firsts)
            return model.rest_start(self.record, self.rest, self._seen)

        return Starts(begin, self.moves)

    @cached_property
    def _seen(self) -> Seen:
        """What the recording tells of its rest: it stays, whichever model is asked to start."""
        return seen_of(self.record, self.rest)

    @cached_property
    def _firsts(self) -> dict[str, tuple[float, float, float]]:
        """What the recording tells of its motion."""
        return _firsts(self.record, self.rest)

    def moved_from(self, first: Start, model: Model, shifts: np.ndarray) -> Start:
        """`at`, from a start of `unmoved`, which is left as it is."""
        y, supply, tank = first.y.copy(), first.supply, first.tank
        for doubt, shift in zip(self.doubts, shifts, strict=True):
            by = doubt.std * float(shift)
            if doubt.excess:
                continue
            if doubt.name == TANK_CHANNEL:
                tank = None if tank is None else tank + by
                continue
            if doubt.valve >= 0:
                valve = model.plant.valves[doubt.valve]
                value = min(max(y[doubt.state] + by, valve.lowest), valve.highest)
                valve_settle(valve, value, model.plant, y)
                continue
            y[doubt.state] += by
            if doubt.name == SUPPLY_CHANNEL and supply is not None:
                supply += by
        for index, row in enumerate(model.plant.cylinders):
            low, high = sorted(model.stroke_range(index))
            y[row.joint] = min(max(y[row.joint], low), high)
        settle_parts(model.plant, y)
        return Start(y, supply, tank)

    def moved(self, shifts: np.ndarray) -> dict[str, float]:
        """By how much the shifts move each number of the start [SI]."""
        return {
            doubt.name: doubt.std * float(shift)
            for doubt, shift in zip(self.doubts, shifts, strict=True)
            if not doubt.excess
        }

    def numbers(self, start: Start) -> dict[str, float]:
        """Each number of a start [SI] that is in doubt."""
        tank = math.nan if start.tank is None else start.tank
        return {
            doubt.name: tank if doubt.name == TANK_CHANNEL else float(start.y[doubt.state])
            for doubt in self.doubts
            if not doubt.excess
        }

    def excess(self, shifts: np.ndarray, shared: Excess = NOTHING) -> dict[str, float]:
        """What is wrong with the sensors, by term."""
        own = {
            doubt.name: doubt.std * float(shift)
            for doubt, shift in zip(self.doubts, shifts, strict=True)
            if doubt.excess
        }
        return {**shared, **own}

    def true(self, shifts: np.ndarray, shared: Excess = NOTHING) -> Record:
        """The recording as sound sensors would have given it, commands as the valves get them."""
        return corrected(self.record, self.terms, self.excess(shifts, shared))

    def seen(self, replayed: Record, shifts: np.ndarray, shared: Excess = NOTHING) -> Record:
        """A simulation as the sensors would show it."""
        return sensed(replayed, self.terms, self.excess(shifts, shared))


def start_of_log(
    model: Model,
    record: Record,
    live: Sequence[str],
    compared: Sequence[str],
    terms: Sequence[Term] = (),
) -> LogStart:
    """Where a recording starts, with the doubts about the cylinders that move.

    Args:
        record: evenly sampled.
        live: cylinders that move.
        compared: channels on which the simulation is compared with the recording, which tell a
            pressure by themselves.
        terms: what its sensors make of it; those for each log by itself are doubts.
    """
    rest = model.rest_samples(model.commands_of(record))
    moves = bool(moving_at_first(record, model.rig, rest) or on_at_first(record, model.rig, rest))
    doubts: list[Doubt] = []
    for cylinder in live:
        doubts += _of_cylinder(model, record, cylinder, compared, rest, moves)
    given = tied_words(record)
    doubts = [doubt for doubt in doubts if doubt.name.rpartition(".")[2] not in given]
    if moves:
        doubts += _of_valves(model, record, live)
    doubts += _of_lines(model, record, rest, moves)
    own = [term for term in terms if term.per_log and term.std > 0.0]
    doubts += [Doubt(term.name, -1, term.std, SENSED * term.std, excess=True) for term in own]
    return LogStart(record, rest, moves, tuple(doubts), tuple(terms))


def _of_lines(model: Model, record: Record, rest: int, moves: bool) -> list[Doubt]:
    """Doubts about the supply's set pressure, and the tank's pressure where a recording is less
    sure of it than of any supply.
    """
    maximum, result = float(model.plant.supply.pressure), []
    for channel in (SUPPLY_CHANNEL, TANK_CHANNEL):
        if channel not in record or (channel == SUPPLY_CHANNEL and supplied(record)):
            continue
        y = record[channel]
        std = rms(y - np.mean(y)) if moves else mean_error(y, rest)
        if channel == SUPPLY_CHANNEL:
            std = max(std, FINE_SUPPLY * maximum)
            result.append(_doubt(channel, model.plant.at.supply, std, maximum))
        elif std > FINE_SUPPLY * maximum:
            result.append(_doubt(channel, -1, std, maximum))
    return result


def mean_error(y: np.ndarray, rest: int) -> float:
    """Standard error of the mean of a recorded rest as the value at its first sample: that of its
    noise, and half of its drift.
    """
    error, drift = _rest_errors(y, rest)
    return math.hypot(error, 0.5 * max(0.0, drift - 2.0 * LINE * error))


def first_error(y: np.ndarray, rest: int) -> float:
    """Standard error of `signals.first_of`: a line is known half as well at its end as in its
    middle, where it is the mean.
    """
    error, _ = _rest_errors(y, rest)
    return error if rest < LEAST_LINE else 2.0 * error


def _rest_errors(y: np.ndarray, rest: int) -> tuple[float, float]:
    """(standard error of the mean of a recorded rest but for its drift, its drift over the rest);
    few samples tell no drift.

    Of the noise about a line, which takes two of its ``rest/τ`` independent samples. Short series
    show too little of their correlation time τ, so that at least that of a first-order process
    counts whose pole ρ is the first autocorrelation without its bias, −(2 + 4ρ)/n about a line
    (Kendall 1954): τ = (1 + ρ)/(1 − ρ).
    """
    if rest < LEAST_LINE:
        return float(1.5 * np.median(np.abs(np.diff(y)))) / math.sqrt(rest), 0.0
    z = np.linspace(-0.5, 0.5, rest)
    line = np.polyfit(z, y[:rest], 1)
    noise = y[:rest] - np.polyval(line, z)
    pole = float(autocorrelation(noise, 1)[1])
    pole = min(pole + (2.0 + 4.0 * pole) / rest, 1.0 - 2.0 / rest)
    time = max(correlation_time(noise), (1.0 + pole) / (1.0 - pole))
    error = math.sqrt(time / rest) / max(1.0 - 2.0 * time / rest, LEAST_LEFT)
    return rms(noise) * min(1.0, error), abs(float(line[0]))


def _doubt(name: str, state: int, std: float, span: float, valve: int = -1) -> Doubt:
    step = min(max(DIFFERENCE * std, SMALLEST * span), LARGEST * span)
    return Doubt(name, state, std, step, valve)


def _of_cylinder(
    model: Model, record: Record, cylinder: str, compared: Sequence[str], rest: int, moves: bool
) -> list[Doubt]:
    """Doubts about both pressures and the position of a cylinder, and its speed in motion or where
    its rest creeps.
    """
    names, index = model.layout, model.layout.cylinders.index(cylinder)
    supply, result = float(model.plant.supply.pressure), []
    for side in SIDES:
        channel = f"{cylinder}.p_{side}"
        std = VAGUE_PRESSURE * supply
        if channel in compared:
            std = COMPARED_PRESSURE * supply
        elif channel in record:
            error = rms(np.diff(record[channel])) if moves else mean_error(record[channel], rest)
            std = error + SENSOR * supply
        result.append(_doubt(channel, names.state(f"p_{side}", index), std, supply))
    row = model.plant.cylinders[index]
    low, high = sorted(model.stroke_range(index))
    std = VAGUE_PLACE * (high - low)
    for word, scale in (("q", 1.0), ("x", (high - low) / float(row.stroke))):
        if (channel := f"{cylinder}.{word}") in record:
            y = record[channel]
            error = _first(y, rest, record.sample_time)[2] if moves else first_error(y, rest)
            std = scale * error + FINE_PLACE * (high - low)
            break
    joint = int(row.joint)
    result.append(_doubt(f"{cylinder}.q", names.state("q", joint), std, high - low))
    speed = rate_of(record, cylinder)
    if speed is not None:
        maximum = float(np.abs(speed).max()) or 1.0
        std = max(VAGUE_SPEED * maximum, 1e-4 * (high - low))
        if not moves:
            std = _creep(record, cylinder, rest, (high - low) / float(row.stroke))
        if std > CREEPING * maximum:
            result.append(_doubt(f"{cylinder}.qd", names.state("qd", joint), std, maximum))
    return result


def _creep(record: Record, cylinder: str, rest: int, lever: float) -> float:
    """Speed of a joint at a rest, without its sign, if it surely has one: what leaks lets a load
    sink, and begun from no speed at all it would ring. Zero if not.

    By the mean of what is recorded of its rate, else by the line through its place; ``lever`` is
    what the joint turns by per stroke [1/m, or 1].
    """
    for word, scale in (("qd", 1.0), ("v", lever), ("q", 1.0), ("x", lever)):
        if (channel := f"{cylinder}.{word}") not in record:
            continue
        if word in ("qd", "v"):
            y = record[channel]
            creep, error = abs(float(np.mean(y[:rest]))), mean_error(y, rest)
        else:
            error, creep = _rest_errors(record[channel], rest)
            creep, error = (item / (rest * record.sample_time) for item in (creep, LINE * error))
        return scale * creep if creep > CREEPS * error else 0.0
    return 0.0


def _of_valves(model: Model, record: Record, live: Sequence[str]) -> list[Doubt]:
    """Doubts about the openings of the valves of moving cylinders that have been commanded."""
    results = []
    for index, name in enumerate(model.layout.valves):
        valve, channel = model.plant.valves[index], f"{name}.command"
        if name.partition(".")[0] not in live or valve.output < 0 or channel not in record:
            continue
        span = float(valve.highest - valve.lowest)
        if np.ptp(record[channel]) > 0.0 or record[channel][0] != 0.0:
            std = VAGUE_OPENING * span
            results.append(_doubt(f"{name}.opening", int(valve.output), std, span, index))
    return results


def rate_of(record: Record, cylinder: str) -> np.ndarray | None:
    """A cylinder's recorded joint rate or speed, else that of its position; None without any."""
    for word in ("qd", "v"):
        if f"{cylinder}.{word}" in record:
            return record[f"{cylinder}.{word}"]
    both = (column(record, f"{cylinder}.{word}", record) for word in ("qd", "v"))
    return next((rate for rate in both if rate is not None), None)


def _first(y: np.ndarray, rest: int, tick: float) -> tuple[float, float, float]:
    """(value, rate [1/s], standard error of the value) at the first sample, of a parabola through
    the first samples, as many as pass before a command changes if those are enough.
    """
    count = min(max(LEAST_LINE, min(rest, round(BEGINNING / tick))), y.size)
    t = np.arange(count) * tick
    order = 2 if count >= LEAST_LINE else min(1, count - 1)
    line = np.polynomial.Polynomial.fit(t, y[:count], order).convert()
    coefficients = np.append(line.coef, np.zeros(3))
    noise = rms(y[:count] - line(t)) * math.sqrt(count / max(1, count - order - 1))
    return float(coefficients[0]), float(coefficients[1]), 3.0 * noise / math.sqrt(count)


def _firsts(record: Record, rest: int) -> dict[str, tuple[float, float, float]]:
    """`_first` of the readings of a recording, by channel."""
    return {
        channel: _first(y, rest, record.sample_time)
        for channel, y in record.channels.items()
        if not channel.endswith(".command")
    }


def _moving_start(
    model: Model, record: Record, seen: Mapping[str, tuple[float, float, float]]
) -> Start:
    """The state at the first sample of a recording that begins in motion, by `_firsts` of it:
    places, pressures and speeds as they read, valves where their commands were a lag before.
    """
    tick, names = record.sample_time, model.layout
    value = {channel: first for channel, (first, _, _) in seen.items()}
    table = model.commands_of(record)
    supply, tank = value.get(SUPPLY_CHANNEL), value.get(TANK_CHANNEL)
    model = replace(model, plant=model.plant.at_pressures(supply, tank))
    y = model.posed(value, table[0] if names.played else None)
    for index, name in enumerate(names.cylinders):
        for side in SIDES:
            at = names.state(f"p_{side}", index)
            y[at] = value.get(f"{name}.p_{side}", y[at])
        row = model.plant.cylinders[index]
        joint = int(row.joint)
        lever = linkage_of(row, y[joint])[1]
        speeds = {
            "qd": value.get(f"{name}.qd"),
            "v": None if f"{name}.v" not in value else value[f"{name}.v"] / lever,
            "q": None if f"{name}.q" not in seen else seen[f"{name}.q"][1],
            "x": None if f"{name}.x" not in seen else seen[f"{name}.x"][1] / lever,
        }
        y[names.state("qd", joint)] = next((v for v in speeds.values() if v is not None), 0.0)
    for index, valve in enumerate(model.plant.valves):
        slope = (table[min(1, len(table) - 1), index] - table[0, index]) / tick
        opening = table[0, index] - slope * valve_lag(valve, model.plant)
        valve_settle(valve, min(max(opening, valve.lowest), valve.highest), model.plant, y)
    return Start(y, supply, tank)


class Followed(NamedTuple):
    """How a model follows a recording best: its ``start``, the recording's commands and readings
    as they ``truly`` are, what is wrong with its sensors (``excess`` by term), and what they are.
    """

    start: Start
    truly: Record
    excess: dict[str, float]
    terms: tuple[Term, ...]

    def replay(self, model: Model) -> Record:
        """What the model does, as the recording's sensors show it.

        Raises:
            SimulationError: the numbers left the finite range.
        """
        return sensed(model.replay(self.truly, start=self.start), self.terms, self.excess)


def estimated_start(
    model: Model,
    record: Record,
    live: Sequence[str],
    channels: Sequence[str],
    step: float = STEP,
) -> Start:
    """The start of `follow`, of a recording whose sensors are sound."""
    return follow(model, record, live, channels, step=step).start


def follow(
    model: Model,
    record: Record,
    live: Sequence[str],
    channels: Sequence[str],
    terms: Sequence[Term] = (),
    step: float = STEP,
) -> Followed:
    """The start from which a model follows the whole of a recording best, each number of it held by
    what the recording's first samples say.

    Least squares of the channels, each by its residual's rms, over the doubts of `start_of_log`,
    their priors weighted as the residuals' correlation in time asks.

    Args:
        record: evenly sampled.
        live: cylinders that move.
        channels: full names, of which the recording has the values or their position's.
        terms: what its sensors make of it; all of them are estimated of this recording by itself.
        step: of the integration [s].

    Raises:
        InputError: a posture outside the stroke.
        SimulationError: the numbers left the finite range.
    """
    terms = tuple(replace(term, per_log=True) for term in terms)
    start = start_of_log(model, record, live, channels, terms)
    shifts = best_shifts(model, start, channels, step)
    return Followed(start.at(model, shifts), start.true(shifts), start.excess(shifts), terms)


def best_shifts(
    model: Model, start: LogStart, channels: Sequence[str], step: float = STEP
) -> np.ndarray:
    """The shifts [prior standard deviations] of a start from which the model follows its recording
    best, as `follow` has it.

    Raises:
        InputError, SimulationError: as `follow`.
    """
    search = _Follow(model, start, channels, step)
    shifts = np.zeros(len(start.doubts))
    return search.best(shifts) if search.recorded.size and shifts.size else shifts


class _Follow:
    """A recording followed from a start that may be shifted."""

    def __init__(self, model: Model, start: LogStart, channels: Sequence[str], step: float) -> None:
        self.model, self.start, self.channels, self.step_time = model, start, channels, step
        self.recorded = _columns(start.record, channels, start.record)
        self.floor = np.maximum(FLOOR * np.std(self.recorded, axis=0), 1e-300)
        self.scale, self.weight = self.floor, 1.0

    def best(self, shifts: np.ndarray) -> np.ndarray:
        """The shifts with which the model follows best, sought from some on."""
        left = self.left(shifts)
        for _ in range(ROUNDS):
            self.weigh(left)
            before = self.cost(shifts, left)
            move, gain = self.step(shifts, left)
            result = next(self.tries(shifts, move, before), None)
            if result is None:
                break
            shifts, left = result
            if gain < CONVERGED * before:
                break
        return shifts

    def left(self, shifts: np.ndarray) -> np.ndarray:
        """Simulated minus recorded [SI], shape (samples, channels)."""
        run = self.run_of(shifts)
        return self.left_by(run.model.replay(run.record, self.step_time, start=run.start), shifts)

    def run_of(self, shifts: np.ndarray) -> Replay:
        """What is replayed, and from where."""
        return Replay(self.model, self.start.true(shifts), self.start.at(self.model, shifts))

    def left_by(self, replayed: Record, shifts: np.ndarray) -> np.ndarray:
        """`left` of a replay."""
        seen = self.start.seen(replayed, shifts)
        return _columns(seen, self.channels, self.start.record) - self.recorded

    def all_left(self, every: Sequence[np.ndarray]) -> Iterator[np.ndarray]:
        """`left` of several shifts."""
        runs = [self.run_of(shifts) for shifts in every]
        replays = replay_many(runs, self.step_time)
        for shifts, replayed in zip(every, replays, strict=True):
            # a replay that failed says why when it runs again
            failed = replayed is None
            yield self.left(shifts) if failed else self.left_by(replayed, shifts)

    def weigh(self, left: np.ndarray) -> None:
        """Take scales of the channels and the weight of priors from what is left."""
        self.scale = np.maximum(np.sqrt(np.mean(left**2, axis=0)), self.floor)
        self.weight = prior_weight([left / self.scale])

    def cost(self, shifts: np.ndarray, left: np.ndarray) -> float:
        """What is minimised."""
        return float(np.sum((left / self.scale) ** 2) + self.weight * np.sum(shifts**2))

    def step(self, shifts: np.ndarray, left: np.ndarray) -> tuple[np.ndarray, float]:
        """(Gauss's and Newton's step, what it should gain)."""
        each = np.eye(len(shifts))
        doubts = self.start.doubts
        every = [shifts + doubt.share * each[i] for i, doubt in enumerate(doubts)]
        columns = [
            (moved - left) / (doubt.share * self.scale)
            for doubt, moved in zip(doubts, self.all_left(every), strict=True)
        ]
        slopes = np.stack([column.ravel() for column in columns], axis=-1)
        normal = slopes.T @ slopes + self.weight * each
        pull = slopes.T @ (left / self.scale).ravel() + self.weight * shifts
        move = -np.linalg.solve(normal, pull)
        return move, float(-pull @ move)

    def tries(
        self, shifts: np.ndarray, move: np.ndarray, before: float
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """(shifts, what is left) after a step, or a part of it, where that costs less."""
        for share in (1.0, 0.3, 0.1):
            there = shifts + share * move
            try:
                left = self.left(there)
            except SimulationError:
                continue
            if self.cost(there, left) < before:
                yield there, left


def prior_weight(residuals: Sequence[np.ndarray]) -> float:
    """What a prior of unit variance weighs beside scaled residuals, each of shape (samples,
    channels): their variance, by as many samples as count for one independent one; the median of
    the channels.
    """
    sizes = [
        rms(column) ** 2 * correlation_time(column)
        for part in residuals
        for column in part.T
        if np.any(column)
    ]
    return float(np.median(sizes)) if sizes else 1.0


def _columns(record: Record, channels: Sequence[str], like: Record) -> np.ndarray:
    result = (column(record, channel, like) for channel in channels)
    return np.column_stack([y for y in result if y is not None] or [np.zeros((record.t.size, 0))])
