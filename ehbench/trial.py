"""Trials: open-loop commands on the model or on the virtual bench, stopped safely when a limit is reached."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ehbench.compiled import kernel
from ehbench.errors import InputError, SimulationError
from ehbench.plant import STROKE, derivatives
from ehbench.quantities import VOCABULARY
from ehbench.recipe import BenchRecipe, Command, Limits, TrialRecipe, load_recipe, load_rig
from ehbench.record import Record
from ehbench.rig import Rig
from ehbench.rigs.bench import BenchRig, bench_tick
from ehbench.rigs.model import ModelRig, model_sample
from ehbench.simulate import Model, advance, rk4
from ehbench.units import from_si

if TYPE_CHECKING:
    from ehbench.simulate import Maps

Machine = ModelRig | BenchRig
RUN_OUT = 0.3  # [s] logged after a stop, valves at rest
CHUNK = 500  # ticks between two reports of progress
LIMITS = ("pressure_max", "pressure_min", "stroke_margin", "speed_max", "command_max")
_NO_LIMITS = (math.inf, -math.inf, -math.inf, math.inf, math.inf)
_PRESSURE_MAX, _PRESSURE_MIN, _MARGIN, _SPEED, _COMMAND = range(5)


@dataclass(frozen=True)
class Stop:
    """Why a trial stopped: which limit, on which channel, the value [SI] that reached it, its bound [SI] and when [s].

    ``sentence`` says so in the units of the rig file.
    """

    limit: str
    channel: str
    value: float
    bound: float
    t: float
    sentence: str


@dataclass(frozen=True)
class Facts:
    """What is to be said of a trial beside its record.

    ``stopped`` is empty, or the sentence that says which limit stopped it; ``stop`` has the same as numbers.
    """

    on: str
    rig: str
    payload: str
    posture: dict[str, str]
    seed: int
    duration: float
    samples: int
    rate: float
    stop: Stop | None = None
    warnings: tuple[str, ...] = ()

    @property
    def stopped(self) -> str:
        """Why the trial stopped, or ''."""
        return "" if self.stop is None else self.stop.sentence

    def as_json(self) -> dict[str, Any]:
        """Plain values for a JSON file."""
        return {**asdict(self), "stopped": self.stopped, "warnings": list(self.warnings)}


# --- commands -------------------------------------------------------------------------------------------------------


def _shape(command: Command, t: np.ndarray, record: Record | None) -> np.ndarray:
    """One entry's command [V] at times ``t`` [s]."""
    offset, amplitude, start = float(command.offset), float(command.amplitude), float(command.start)
    stop = math.inf if command.stop is None else float(command.stop)
    slack = 1e-9  # a sample that falls on the switching time belongs to what comes after
    on = (t >= start - slack) & (t < stop - slack)
    if command.kind == "constant":
        return np.full(t.shape, offset)
    if command.kind == "step":
        return offset + amplitude * on
    if command.kind == "ramp":
        return offset + amplitude * np.clip((t - start) / (stop - start), 0.0, 1.0)
    if command.kind == "sine":
        return offset + amplitude * on * np.sin(2 * np.pi * float(command.frequency) * (t - start))
    if command.kind == "multisine":
        low, high = float(command.frequency), float(command.frequency_max)
        phases = np.random.default_rng(command.seed).uniform(0, 2 * np.pi, command.lines)
        waves = np.sin(2 * np.pi * np.outer(t - start, np.linspace(low, high, command.lines)) + phases).sum(axis=1) * on
        largest = np.abs(waves).max()
        return offset + (amplitude / largest * waves if largest > 0 else waves)
    assert record is not None
    at = np.searchsorted(record.t - record.t[0], t - start + slack, side="right") - 1
    values = record[f"{command.valve}.command"]
    return offset + np.where((at >= 0) & (t - start <= record.t[-1] - record.t[0] + slack), values[np.maximum(at, 0)], 0.0)


def command_table(recipe: TrialRecipe, rig: Rig, t: np.ndarray) -> np.ndarray:
    """Commands [V], shape (samples, valves), in the rig file's order; row i acts from ``t[i]`` on.

    Entries for one valve add up; a valve without entry stays at rest. A ``file`` command plays a log's
    ``<valve>.command`` from ``start`` on and adds nothing outside of it.

    Raises:
        InputError: unknown valve, a command outside its valve's range, a file without the channel, a window that is empty.
    """
    valves = {f"{c.name}.{v.name}": v for c, v in rig.valves()}
    names = list(valves)
    table = np.tile([v.rest for v in valves.values()], (t.size, 1))
    last: dict[str, int] = {}  # the last entry for each valve
    for index, entry in enumerate(recipe.command):
        where = f"command {index + 1}"
        if entry.valve not in valves:
            raise InputError(
                f"{where}: rig '{rig.name}' has no valve '{entry.valve}'", **recipe.at("command", index, "valve"),
                hint="it has " + ", ".join(names),
            )  # fmt: skip
        if entry.stop is not None and float(entry.stop) <= float(entry.start):
            raise InputError(f"{where} to '{entry.valve}' stops before it starts", **recipe.at("command", index, "stop"))
        if entry.valve not in last:
            table[:, names.index(entry.valve)] = 0.0
        last[entry.valve] = index
        record = None
        if entry.kind == "file":
            from ehbench.logs import read_record

            path = recipe.file(entry.file)
            record = read_record(path)
            if f"{entry.valve}.command" not in record:
                there = ", ".join(record.channels)
                raise InputError(f"has no channel '{entry.valve}.command' to play", file=path, hint=f"it has {there}")
        table[:, names.index(entry.valve)] += _shape(entry, t, record)
    for column, (name, valve) in enumerate(valves.items()):
        low, high = float(valve.command_min), float(valve.command_max)
        values = table[:, column]
        bad = np.flatnonzero((values < low - 1e-9) | (values > high + 1e-9) | ~np.isfinite(values))
        if bad.size:
            raise InputError(
                f"the command of '{name}' is {values[bad[0]]:.4g} V at t = {t[bad[0]]:.4g} s, which its driver does not take",
                **recipe.at("command", last[name]),
                hint=f"its range is {low:g} to {high:g} V",
            )
    return table


# --- limits ---------------------------------------------------------------------------------------------------------


@kernel
def violated(sample, command, limits, strokes, found):
    """Whether a sample or the command reached a limit; then ``found`` says (which limit, cylinder or valve, entry of the sample).

    Args:
        sample: as in ``ehbench.rigs``.
        command: [V], shape (valves,).
        limits: (pressure_max, pressure_min, stroke_margin, speed_max, command_max), SI; infinite where there is none.
        strokes: full stroke of each cylinder [m].
        found: out, int64 (3,).
    """
    for c in range(strokes.shape[0]):
        for entry in range(4, 6):
            p = sample[6 * c + entry]
            if p > limits[_PRESSURE_MAX] or p < limits[_PRESSURE_MIN]:
                found[0], found[1], found[2] = (_PRESSURE_MAX if p > limits[_PRESSURE_MAX] else _PRESSURE_MIN), c, 6 * c + entry
                return True
        x = sample[6 * c + 2]
        if x < limits[_MARGIN] or x > strokes[c] - limits[_MARGIN]:
            found[0], found[1], found[2] = _MARGIN, c, 6 * c + 2
            return True
        if abs(sample[6 * c + 3]) > limits[_SPEED]:
            found[0], found[1], found[2] = _SPEED, c, 6 * c + 3
            return True
    for i in range(command.shape[0]):
        if abs(command[i]) > limits[_COMMAND]:
            found[0], found[1], found[2] = _COMMAND, i, -1
            return True
    return False


def _limits(limits: Limits) -> np.ndarray:
    given = (getattr(limits, name) for name in LIMITS)
    return np.array([none if value is None else float(value) for value, none in zip(given, _NO_LIMITS, strict=True)])


# --- loops ----------------------------------------------------------------------------------------------------------
# One loop a rig: sample, limits, log, tick. A closed-loop controller belongs between limits and log, where it turns the
# sample of the tick into the row of commands.


@kernel
def _model_loop(y, sample, commands, plant, tick, steps, k, work, limits, strokes, log, samples, found):
    size, flows = y.shape[0], plant.edges.shape[0] + 1
    at = work.shape[0] - flows
    for i in range(commands.shape[0]):
        command = commands[i]
        if violated(sample, command, limits, strokes, found):
            return i
        rate = derivatives(y, command, plant, k[0], work)
        for j in range(size):
            log[i, j] = y[j]
        for j in range(flows):
            log[i, size + j] = work[at + j]
        for j in range(sample.shape[0]):
            samples[i, j] = sample[j]
        advance(y, command, plant, tick / steps, k, work, rate)
        for _ in range(1, steps):
            rk4(y, command, plant, tick / steps, k, work)
        model_sample(y, plant, sample)
    return -1


@kernel
def _bench_loop(state, sample, commands, bench, tick, steps, scratch, work, limits, strokes, noise, samples, found):
    for i in range(commands.shape[0]):
        if violated(sample, commands[i], limits, strokes, found):
            return i
        for j in range(sample.shape[0]):
            samples[i, j] = sample[j]
        bench_tick(state, commands[i], bench, tick, steps, scratch, work, noise[i], sample)
    return -1


def _go(rig: Machine, sample, table, limits, log, samples, found) -> int:
    """Run a chunk on either rig, ``log`` and ``samples`` out; returns the row at which a limit stopped it, or −1."""
    tick = 1.0 / rig.rate
    if isinstance(rig, ModelRig):
        plant = rig.model.plant
        return _model_loop(
            rig.state, sample, table, plant, tick, rig.steps, rig._k, rig._work, limits, plant.cylinders[:, STROKE].copy(), log,
            samples, found,
        )  # fmt: skip
    return _bench_loop(
        rig.state, sample, table, rig.bench, tick, rig.steps, rig._scratch, rig._work, limits,
        rig.bench.cylinders[:, STROKE].copy(), rig.noise(table.shape[0]), samples, found,
    )  # fmt: skip


def _stop_of(found, sample, command, rig: Machine, limits, t: float) -> Stop:
    which, index, entry = (int(v) for v in found)
    bound = float(limits[which])
    if which == _COMMAND:
        channel, value = f"{rig.layout.valves[index]}.command", float(command[index])
    else:
        channel, value = rig.channels[entry], float(sample[entry])
    if which == _MARGIN and value >= bound:  # then it is the far end that came too near
        bound = float(rig.model.plant.cylinders[index, STROKE]) - bound
    word = channel.rsplit(".", 1)[-1]
    unit = rig.model.rig.unit_of(word)
    shown, edge = (from_si(v, unit, VOCABULARY[word]) for v in (value, bound))
    sentence = f"{channel} = {shown:.4g} {unit} passed {LIMITS[which]}, which sets in at {edge:.4g} {unit}, at t = {t:.4g} s"
    return Stop(LIMITS[which], channel, value, bound, t, sentence)


def run_trial(
    rig: Rig, recipe: TrialRecipe, maps: Maps | None = None, progress: Callable[[float], None] | None = None
) -> tuple[Record, Facts]:
    """Run one trial from rest: its record and the facts about it.

    On the model the record has all that `Model.record` gives; on the virtual bench only what a machine measures, and the
    commands. When a limit is reached the valves go to rest in that very tick, and RUN_OUT seconds more are logged.

    Args:
        rig: as the recipe names it.
        recipe: what to do; its ``bench`` names the bench file, without which the bench is a plausible one of this rig.
        maps: measured flow maps of the rig, for the model.
        progress: called with the share done, from 0 to 1.

    Raises:
        InputError: a command, posture, payload or bench file that does not fit the rig; a limit reached before the start.
        SimulationError: the numbers left the finite range.
    """
    rate, duration = float(recipe.rate), float(recipe.duration)
    count = round(duration * rate) + 1
    if count < 2:
        raise InputError("the trial is shorter than one sample", **recipe.at("duration"), hint="raise duration or rate")
    t = np.arange(count) / rate
    table = command_table(recipe, rig, t)
    machine = _machine(rig, recipe, maps)
    sample = machine.start(recipe.posture)
    limits, found = _limits(recipe.limits), np.zeros(3, dtype=np.int64)
    strokes = machine.model.plant.cylinders[:, STROKE].copy()
    if violated(sample, table[0], limits, strokes, found):
        reached = _stop_of(found, sample, table[0], machine, limits, 0.0)
        where = recipe.at("limits", reached.limit)
        raise InputError("the trial cannot start: " + reached.sentence, **where, hint="change the posture or the limit")

    width = machine.layout.states + len(machine.layout.edges) + 1 if isinstance(machine, ModelRig) else 0
    log, samples = np.empty((count, width)), np.empty((count, sample.size))
    stop, at, end = None, 0, count
    while at < end:
        upto = min(at + CHUNK, end)
        row = _go(machine, sample, table[at:upto], limits, log[at:upto], samples[at:upto], found)
        if not np.isfinite(sample).all():
            raise SimulationError(f"the trial left finite numbers before t = {upto / rate:.4g} s", hint="take a smaller step")
        if row >= 0:
            row += at
            stop = _stop_of(found, sample, table[row], machine, limits, float(t[row]))
            limits = np.array(_NO_LIMITS)
            end = min(count, row + 1 + round(RUN_OUT * rate))
            table[row:] = machine.model.rest_commands(1)[0]
            upto = row
        at = upto
        if progress is not None:
            progress(at / end)
    meta = {
        "rig": rig.name, "payload": recipe.payload or "none", "on": machine.name, "seed": str(recipe.seed),
        "posture": ", ".join(f"{name} {value}" for name, value in recipe.posture.items()) or "mid-stroke", "title": recipe.title,
    }  # fmt: skip
    facts = Facts(machine.name, rig.name, meta["payload"], dict(recipe.posture), recipe.seed, float(t[end - 1]), end, rate, stop)
    if stop is not None:
        meta["stopped"] = stop.sentence
    if isinstance(machine, ModelRig):
        return machine.model.record(t[:end], table[:end], log[:end], meta), facts
    columns = {name: samples[:end, i].copy() for i, name in enumerate(machine.channels)}
    lines = {name: columns.pop(name) for name in ("p_supply", "p_tank")}
    commands = {f"{name}.command": table[:end, i].copy() for i, name in enumerate(machine.layout.valves)}
    return Record(t[:end], {**columns, **commands, **lines}, meta), facts


def _machine(rig: Rig, recipe: TrialRecipe, maps: Maps | None) -> Machine:
    if recipe.on == "model":
        return ModelRig(Model.of(rig, maps, recipe.payload), float(recipe.rate), float(recipe.step))
    if recipe.bench is None:
        return BenchRig(rig, None, recipe.payload, float(recipe.rate), seed=recipe.seed)
    bench = load_recipe(recipe.file(recipe.bench))
    if not isinstance(bench, BenchRecipe):
        raise InputError("is no bench file", file=bench.path, hint='a bench file has stage = "bench"')
    own = load_rig(bench.file(bench.rig))
    for what, mine, its in (
        ("cylinders", [c.name for c in rig.cylinder], [c.name for c in own.cylinder]),
        ("valves", [f"{c.name}.{v.name}" for c, v in rig.valves()], [f"{c.name}.{v.name}" for c, v in own.valves()]),
    ):
        if mine != its:
            raise InputError(
                f"the bench of rig '{own.name}' has other {what} than rig '{rig.name}'", **recipe.at("bench"),
                hint=f"the bench has {', '.join(its)}",
            )  # fmt: skip
    return BenchRig(own, bench, recipe.payload, float(recipe.rate), seed=recipe.seed)
