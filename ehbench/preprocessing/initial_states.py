"""The initial state of a simulation along a recording, and its uncertainty.

A recording shows its first state only as well as its sensors do: the mean of a drifting standstill
is not the pressure at the first sample, and a supply's pressure is known to its noise. Each such
number is a nuisance, in units of the standard deviation that the recording leaves it (its prior);
identification and validation let the whole log estimate it."""

import math
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ehbench.data.record import Record
from ehbench.parts.cylinder import linkage_of
from ehbench.parts.valve import valve_lag, valve_settle
from ehbench.plant.build import Plant
from ehbench.plant.layout import SIDES
from ehbench.plant.many import Replay, replay_many
from ehbench.plant.model import Model, Seen, Start, seen_of
from ehbench.plant.ties import supplied, tied_words
from ehbench.plant.trim import settle_parts
from ehbench.preprocessing.observations import column, count_error
from ehbench.preprocessing.plausibility import moving_at_first, on_at_first
from ehbench.preprocessing.sensors import Bias, Term, corrected, sensed
from ehbench.signals.series import LEAST_LINE, autocorrelation, correlation_time, rms
from ehbench.vocabulary import SimulationError, quantity, setting

SUPPLY_CHANNEL, TANK_CHANNEL = "p_supply", "p_tank"
NO_BIAS: Mapping[str, float] = {}  # no bias of the sensors of all logs
LINE = math.sqrt(12.0)  # standard error of what a line rises by, in those of its mean
_CACHED = 64  # initial states along one recording


@dataclass(frozen=True)
class InitialStateSettings:
    """Numbers of initial states. Priors are shares: pressures of the supply's, positions of the
    stroke, speeds of the fastest, openings of the driver's range."""

    pressure: float = setting(0.2, "", "prior of a pressure that is not recorded", "vague")
    compared: float = setting(0.05, "", "prior of a pressure that is compared", "the log decides")
    sensor: float = setting(0.005, "", "prior of a recorded pressure beyond its noise", "gauges")
    place: float = setting(0.25, "", "prior of a position that is not recorded", "vague")
    fine_place: float = setting(1.0e-5, "", "least prior of a position", "encoders")
    speed: float = setting(0.2, "", "prior of a speed", "vague")
    opening: float = setting(0.25, "", "prior of an opening in motion", "vague")
    supply: float = setting(1.0e-5, "", "least prior of the supply's and tank's pressure", "gauges")
    beginning: float = setting(0.03, "s", "span that shows the state of a motion", "a parabola")
    creep_sigmas: float = setting(3.0, "", "standard errors of a creep at standstill", "chance")
    creep: float = setting(1.0e-3, "", "least creep, share of the fastest speed", "no matter")
    difference: float = setting(0.3, "", "step of finite differences, of a prior", "linear there")
    sensed: float = setting(0.01, "", "the same of a sensor's number", "which is smooth")
    least_step: float = setting(1.0e-6, "", "least step, share of a number's range", "rounding")
    largest_step: float = setting(2.0e-4, "", "largest step, likewise", "linear there")
    rounds: int = setting(20, "", "largest number of rounds of an estimate", "few needed")
    gain: float = setting(1.0e-3, "", "gain of the last round, share of the cost", "no matter")
    floor: float = setting(5.0e-3, "", "least scale of a channel, of its spread", "finite weights")


SETTINGS = InitialStateSettings()


@dataclass(frozen=True)
class Uncertain:
    """One uncertain number of an initial state: its name (``boom.p_head``), its place in the state,
    the standard deviation that the recording leaves it and its step of finite differences, in SI.

    ``valve`` is the number of the valve that an opening belongs to, −1 for all others; ``state`` is
    −1 for what stands in no state: the tank's pressure, and the ``bias`` of a sensor of this log
    (`sensors.Term`)."""

    name: str
    state: int
    std: float
    step: float
    valve: int = -1
    bias: bool = False

    @property
    def share(self) -> float:
        """Its step in standard deviations."""
        return self.step / self.std

    def place(self, plant: Plant) -> int:
        """Where it stands in the state of a plant, to which a fault may have added states."""
        if self.valve >= 0:
            return int(plant.valves[self.valve].output)
        return int(plant.at.supply) if self.name == SUPPLY_CHANNEL else self.state


@dataclass(frozen=True)
class InitialState:
    """The initial state of a recording: after ``rest`` samples at standstill, or in motion; its
    uncertain numbers, and the terms of its sensors. ``shared`` is the bias of those of all logs."""

    record: Record
    rest: int
    moves: bool
    uncertain: tuple[Uncertain, ...]
    terms: tuple[Term, ...] = ()

    def begin(
        self, model: Model, shifts: np.ndarray, shared: Bias = NO_BIAS
    ) -> tuple[Start, Record]:
        """The start of a model, moved by ``shifts`` [prior standard deviations], one a number, and
        the recording by sensors that the shifts have put right, along which it is replayed.

        Raises:
            InputError: a posture outside the stroke."""
        true = self.true(shifts, shared)
        first = self.unmoved(model, true)
        y, supply, tank = first.y.copy(), first.supply, first.tank
        for number, shift in zip(self.uncertain, shifts, strict=True):
            by = number.std * float(shift)
            if number.bias:
                continue
            if number.name == TANK_CHANNEL:
                tank = None if tank is None else tank + by
            elif number.valve >= 0:
                valve = model.plant.valves[number.valve]
                value = min(max(y[number.place(model.plant)] + by, valve.lowest), valve.highest)
                valve_settle(valve, value, model.plant, y)
            else:
                y[number.place(model.plant)] += by
                if number.name == SUPPLY_CHANNEL and supply is not None:
                    supply += by
        for index, row in enumerate(model.plant.cylinders):
            low, high = sorted(model.stroke_range(index))
            y[row.joint] = min(max(y[row.joint], low), high)
        settle_parts(model.plant, y)
        return Start(y, supply, tank), true

    def unmoved(self, model: Model, true: Record) -> Start:
        """What `begin` moves: the start by sensors that are put right.

        Raises:
            InputError: as `begin`."""
        commands = []
        for channel, y in true.channels.items():
            if channel.endswith(".command"):
                commands += y[:2].tolist()
            elif y is not self.record.channels[channel]:  # put right, it shows something else
                return replace(self, record=true)._start(model, true)
        key = model.start_key(self.moves), *commands
        if (result := self._known.get(key)) is None:
            result = self._start(model, true)
            result.y.flags.writeable = False
            if len(self._known) >= _CACHED:
                self._known.clear()
            self._known[key] = result
        return result

    @cached_property
    def _known(self) -> dict[Hashable, Start]:
        """Starts by what of a model and of commands they depend on: most parameters of a fit are
        none of that."""
        return {}

    @cached_property
    def _seen(self) -> Seen:
        """What the recording shows of its standstill, the same for all models."""
        return seen_of(self.record, self.rest)

    @cached_property
    def firsts(self) -> dict[str, tuple[float, float, float]]:
        """`_first` of the recording's readings, by channel."""
        return {
            channel: _first(y, self.rest, self.record.sample_time)
            for channel, y in self.record.channels.items()
            if not channel.endswith(".command")
        }

    def _start(self, model: Model, record: Record) -> Start:
        """The first state: at rest, or as readings have it in motion, valves by their lag and the
        commands of ``record``."""
        if not self.moves:
            return model.rest_start(record, self.rest, self._seen)
        seen = self.firsts
        tick, names = self.record.sample_time, model.layout
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

    def moved(self, shifts: np.ndarray, bias: bool = False) -> dict[str, float]:
        """By how much the shifts move each number of the start [SI], or each ``bias`` of a
        sensor."""
        pairs = zip(self.uncertain, shifts, strict=True)
        return {item.name: item.std * float(x) for item, x in pairs if item.bias == bias}

    def numbers(self, start: Start) -> dict[str, float]:
        """Each number of a start [SI] that is uncertain."""
        tank = math.nan if start.tank is None else start.tank
        return {
            number.name: tank if number.name == TANK_CHANNEL else float(start.y[number.state])
            for number in self.uncertain
            if not number.bias
        }

    def bias(self, shifts: np.ndarray, shared: Bias = NO_BIAS) -> dict[str, float]:
        """The bias of the sensors, by term."""
        return {**shared, **self.moved(shifts, bias=True)}

    def true(self, shifts: np.ndarray, shared: Bias = NO_BIAS) -> Record:
        """The recording as sound sensors would have given it, commands as the valves get them."""
        return corrected(self.record, self.terms, self.bias(shifts, shared))

    def seen(self, replayed: Record, shifts: np.ndarray, shared: Bias = NO_BIAS) -> Record:
        """A simulation as the sensors would show it."""
        return sensed(replayed, self.terms, self.bias(shifts, shared))


def initial_state_of(
    model: Model,
    record: Record,
    live: Sequence[str],
    compared: Sequence[str],
    terms: Sequence[Term] = (),
) -> InitialState:
    """The initial state of a recording, with the uncertain numbers of the cylinders that move.

    Args:
        record: evenly sampled.
        live: cylinders that move.
        compared: channels on which the simulation is compared with the recording, which tell a
            pressure by themselves.
        terms: of its sensors; those of each log by itself are uncertain numbers."""
    rest = model.rest_samples(model.commands_of(record))
    moves = bool(moving_at_first(record, model.rig, rest) or on_at_first(record, model.rig, rest))
    numbers: list[Uncertain] = []
    for cylinder in live:
        numbers += _of_cylinder(model, record, cylinder, compared, rest, moves)
    given = tied_words(record)
    numbers = [number for number in numbers if number.name.rpartition(".")[2] not in given]
    for index, name in enumerate(model.layout.valves if moves else ()):
        valve, channel = model.plant.valves[index], f"{name}.command"
        if name.partition(".")[0] not in live or valve.output < 0 or channel not in record:
            continue
        span = float(valve.highest - valve.lowest)
        if np.ptp(record[channel]) > 0.0 or record[channel][0] != 0.0:
            std, output = SETTINGS.opening * span, int(valve.output)
            numbers.append(_uncertain(f"{name}.opening", output, std, span, index))
    maximum = float(model.plant.supply.pressure)
    for channel in (SUPPLY_CHANNEL, TANK_CHANNEL):  # pressures of the lines
        if channel not in record or (channel == SUPPLY_CHANNEL and supplied(record)):
            continue
        y = record[channel]
        std = rms(y - np.mean(y)) if moves else mean_error(y, rest)
        if not np.any(y != y[0]):  # readings of the same unit tell how fine it is
            unit = quantity(channel).unit
            alike = [item for c, item in record.channels.items() if quantity(c).unit == unit]
            std = max(map(count_error, alike))
        if channel == SUPPLY_CHANNEL:
            std = max(std, SETTINGS.supply * maximum)
            numbers.append(_uncertain(channel, model.plant.at.supply, std, maximum))
        elif std > SETTINGS.supply * maximum:
            numbers.append(_uncertain(channel, -1, std, maximum))
    numbers = [number for number in numbers if model.starts(number.name)]
    for term in terms:
        if term.per_log and term.std > 0.0:
            step = SETTINGS.sensed * term.std
            numbers.append(Uncertain(term.name, -1, term.std, step, bias=True))
    return InitialState(record, rest, moves, tuple(numbers), tuple(terms))


def mean_error(y: np.ndarray, rest: int) -> float:
    """Standard error of the mean of a standstill as its first value: noise, and half of the
    drift."""
    error, drift = _rest_errors(y, rest)
    return math.hypot(error, 0.5 * max(0.0, drift - 2.0 * LINE * error))


def first_error(y: np.ndarray, rest: int) -> float:
    """Standard error of `signals.first_of`: at its end a line is known half as well."""
    error, _ = _rest_errors(y, rest)
    return error if rest < LEAST_LINE else 2.0 * error


def _rest_errors(y: np.ndarray, rest: int) -> tuple[float, float]:
    """(standard error of the mean of a recorded rest but for its drift, its drift over the rest);
    few samples tell no drift.

    Of the noise about a line, which takes two of its ``rest/τ`` independent samples. Short series
    show too little of their correlation time τ, so that at least that of a first-order process
    counts whose pole ρ is the first autocorrelation without its bias, −(2 + 4ρ)/n about a line
    (Kendall 1954): τ = (1 + ρ)/(1 − ρ).

    A reading in counts is known no better than `count_error`."""
    coarse = count_error(y)
    if rest < LEAST_LINE:
        error = float(1.5 * np.median(np.abs(np.diff(y)))) / math.sqrt(rest)
        return math.hypot(error, coarse), 0.0
    z = np.linspace(-0.5, 0.5, rest)
    line = np.polyfit(z, y[:rest], 1)
    noise = y[:rest] - np.polyval(line, z)
    pole = float(autocorrelation(noise, 1)[1])
    pole = min(pole + (2.0 + 4.0 * pole) / rest, 1.0 - 2.0 / rest)
    time = max(correlation_time(noise), (1.0 + pole) / (1.0 - pole))
    share = min(time / rest, 0.25)  # where the error is that of a single sample
    error = math.sqrt(share) / (1.0 - 2.0 * share)
    return math.hypot(rms(noise) * error, coarse), abs(float(line[0]))


def _uncertain(name: str, state: int, std: float, span: float, valve: int = -1) -> Uncertain:
    step = max(SETTINGS.difference * std, SETTINGS.least_step * span)
    return Uncertain(name, state, std, min(step, SETTINGS.largest_step * span), valve)


def _of_cylinder(
    model: Model, record: Record, cylinder: str, compared: Sequence[str], rest: int, moves: bool
) -> list[Uncertain]:
    """Uncertain pressures and position of a cylinder; its speed in motion or where it creeps."""
    names, index = model.layout, model.layout.cylinders.index(cylinder)
    supply, result = float(model.plant.supply.pressure), []
    for side in SIDES:
        channel = f"{cylinder}.p_{side}"
        std = SETTINGS.pressure * supply
        if channel in compared:
            std = SETTINGS.compared * supply
        elif channel in record:
            error = rms(np.diff(record[channel])) if moves else mean_error(record[channel], rest)
            std = error + SETTINGS.sensor * supply
        result.append(_uncertain(channel, names.state(f"p_{side}", index), std, supply))
    row = model.plant.cylinders[index]
    low, high = sorted(model.stroke_range(index))
    std = SETTINGS.place * (high - low)
    for word, scale in (("q", 1.0), ("x", (high - low) / float(row.stroke))):
        if (channel := f"{cylinder}.{word}") in record:
            y = record[channel]
            error = _first(y, rest, record.sample_time)[2] if moves else first_error(y, rest)
            std = scale * error + SETTINGS.fine_place * (high - low)
            break
    joint = int(row.joint)
    result.append(_uncertain(f"{cylinder}.q", names.state("q", joint), std, high - low))
    recorded = [f"{cylinder}.{word}" for word in ("qd", "v")]
    rates = [record[c] for c in recorded if c in record]
    rates += [y for c in recorded if (y := column(record, c, record)) is not None]
    speed = rates[0] if rates else None  # that of its position only without any
    if speed is not None:
        maximum = float(np.abs(speed).max()) or 1.0
        std = max(SETTINGS.speed * maximum, 1e-4 * (high - low))
        if not moves:
            std = _creep(record, cylinder, rest, (high - low) / float(row.stroke))
        if std > SETTINGS.creep * maximum:
            result.append(_uncertain(f"{cylinder}.qd", names.state("qd", joint), std, maximum))
    return result


def _creep(record: Record, cylinder: str, rest: int, lever: float) -> float:
    """Speed of a joint at standstill, without its sign, if it surely has one, else 0; ``lever`` is
    its turn per stroke [1/m, or 1]. A load that sinks would ring if it began at no speed."""
    for word, scale in (("qd", 1.0), ("v", lever), ("q", 1.0), ("x", lever)):
        if (channel := f"{cylinder}.{word}") not in record:
            continue
        if word in ("qd", "v"):
            y = record[channel]
            creep, error = abs(float(np.mean(y[:rest]))), mean_error(y, rest)
        else:
            error, creep = _rest_errors(record[channel], rest)
            creep, error = (item / (rest * record.sample_time) for item in (creep, LINE * error))
        return scale * creep if creep > SETTINGS.creep_sigmas * error else 0.0
    return 0.0


def _first(y: np.ndarray, rest: int, tick: float) -> tuple[float, float, float]:
    """(value, rate [1/s], standard error of the value) at the first sample, by a parabola."""
    count = min(max(LEAST_LINE, min(rest, round(SETTINGS.beginning / tick))), y.size)
    t = np.arange(count) * tick
    order = 2 if count >= LEAST_LINE else min(1, count - 1)
    line = np.polynomial.Polynomial.fit(t, y[:count], order).convert()
    coefficients = np.append(line.coef, np.zeros(3))
    noise = rms(y[:count] - line(t)) * math.sqrt(count / max(1, count - order - 1))
    return float(coefficients[0]), float(coefficients[1]), 3.0 * noise / math.sqrt(count)


class Followed(NamedTuple):
    """How a model follows a recording best: ``start``, corrected recording, ``bias`` by term,
    terms."""

    start: Start
    true: Record
    bias: dict[str, float]
    terms: tuple[Term, ...]

    def replay(self, model: Model) -> Record:
        """What the model does, as the recording's sensors show it.

        Raises:
            SimulationError: the state is not finite."""
        return sensed(model.replay(self.true, start=self.start), self.terms, self.bias)


def follow_recording(
    model: Model,
    record: Record,
    live: Sequence[str],
    channels: Sequence[str],
    terms: Sequence[Term] = (),
) -> Followed:
    """The start from which a model follows the whole of a recording best, each number of it held by
    what the recording's first samples say.

    Least squares of the channels, each by its residual's rms, over the numbers of
    `initial_state_of`, their priors weighted as the residuals' correlation in time asks.

    Args:
        record: evenly sampled.
        live: cylinders that move.
        channels: full names, of which the recording has the values or their position's.
        terms: what its sensors make of it; all of them are estimated of this recording by itself.

    Raises:
        InputError: a posture outside the stroke.
        SimulationError: the state is not finite."""
    terms = tuple(replace(term, per_log=True) for term in terms)
    start = initial_state_of(model, record, live, channels, terms)
    shifts = best_shifts(model, start, channels)
    return Followed(*start.begin(model, shifts), start.bias(shifts), terms)


def best_shifts(model: Model, start: InitialState, channels: Sequence[str]) -> np.ndarray:
    """The shifts [prior standard deviations] of a start from which the model follows its recording
    best, as `follow_recording` has it.

    Raises:
        InputError, SimulationError: as `follow_recording`."""
    search = _Follow(model, start, channels)
    shifts = np.zeros(len(start.uncertain))
    return search.best(shifts) if search.recorded.size and shifts.size else shifts


class _Follow:
    def __init__(self, model: Model, start: InitialState, channels: Sequence[str]) -> None:
        self.model, self.start, self.channels = model, start, channels
        self.recorded = _channel_table(start.record, channels, start.record)
        self.floor = np.maximum(SETTINGS.floor * np.std(self.recorded, axis=0), 1e-300)
        self.scale, self.weight = self.floor, 1.0

    def best(self, shifts: np.ndarray) -> np.ndarray:
        """The shifts with which the model follows best, sought from some on."""
        residual = self.residual(shifts)
        for _ in range(SETTINGS.rounds):
            self.scale = np.maximum(np.sqrt(np.mean(residual**2, axis=0)), self.floor)
            self.weight = prior_weight([residual / self.scale])
            before = self.cost(shifts, residual)
            move, gain = self.step(shifts, residual)
            result = next(self.tries(shifts, move, before), None)
            if result is None:
                break
            shifts, residual = result
            if gain < SETTINGS.gain * before:
                break
        return shifts

    def run_of(self, shifts: np.ndarray) -> Replay:
        """What is replayed, and from where."""
        start, true = self.start.begin(self.model, shifts)
        return Replay(self.model, true, start)

    def residual(self, shifts: np.ndarray, replayed: Record | None = None) -> np.ndarray:
        """Simulated minus recorded [SI], shape (samples, channels), of a replay, which runs here
        where there is none: one that failed among others says why."""
        if replayed is None:
            run = self.run_of(shifts)
            replayed = run.model.replay(run.record, start=run.start)
        seen = self.start.seen(replayed, shifts)
        return _channel_table(seen, self.channels, self.start.record) - self.recorded

    def cost(self, shifts: np.ndarray, residual: np.ndarray) -> float:
        """What is minimised."""
        return float(np.sum((residual / self.scale) ** 2) + self.weight * np.sum(shifts**2))

    def step(self, shifts: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, float]:
        """(Gauss's and Newton's step, what it should gain)."""
        each, shares = np.eye(len(shifts)), [item.share for item in self.start.uncertain]
        every = [shifts + share * each[i] for i, share in enumerate(shares)]
        replays = replay_many([self.run_of(moved) for moved in every])
        columns = [
            (self.residual(moved, replayed) - residual) / (share * self.scale)
            for share, moved, replayed in zip(shares, every, replays, strict=True)
        ]
        slopes = np.stack([column.ravel() for column in columns], axis=-1)
        normal = slopes.T @ slopes + self.weight * each
        pull = slopes.T @ (residual / self.scale).ravel() + self.weight * shifts
        move = -np.linalg.solve(normal, pull)
        return move, float(-pull @ move)

    def tries(
        self, shifts: np.ndarray, move: np.ndarray, before: float
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """(shifts, the residual) after a step, or a part of it, where that costs less."""
        for share in (1.0, 0.3, 0.1):
            there = shifts + share * move
            try:
                residual = self.residual(there)
            except SimulationError:
                continue
            if self.cost(there, residual) < before:
                yield there, residual


def prior_weight(residuals: Sequence[np.ndarray]) -> float:
    """Weight of a prior of unit variance beside scaled residuals, each (samples, channels): their
    variance times the samples of an independent one, the median of the channels."""
    sizes = [
        rms(column) ** 2 * correlation_time(column)
        for part in residuals
        for column in part.T
        if np.any(column)
    ]
    return float(np.median(sizes)) if sizes else 1.0


def _channel_table(record: Record, channels: Sequence[str], like: Record) -> np.ndarray:
    result = (column(record, channel, like) for channel in channels)
    return np.column_stack([y for y in result if y is not None] or [np.zeros((record.t.size, 0))])
