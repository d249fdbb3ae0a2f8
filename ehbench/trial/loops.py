"""The loops of a trial, compiled: sample, controller, limits, log, tick; one for the model, one for
the virtual bench.
"""

from __future__ import annotations

import math

import numpy as np

from ehbench.compiled import kernel
from ehbench.control import registry
from ehbench.parts.sample import OF, entry
from ehbench.plant.derivatives import derivatives
from ehbench.plant.integrate import advance, rk4
from ehbench.recipe import Limits
from ehbench.rigs.bench import BenchRig, bench_tick
from ehbench.rigs.model import ModelRig, model_sample
from ehbench.trial.controllers import Compiled

Machine = ModelRig | BenchRig
LIMITS = ("pressure_max", "pressure_min", "stroke_margin", "speed_max", "command_max")
NO_LIMITS = (math.inf, -math.inf, -math.inf, math.inf, math.inf)
PRESSURE_MAX, PRESSURE_MIN, MARGIN, SPEED, COMMAND = range(5)


def limit_array(limits: Limits) -> np.ndarray:
    """A recipe's limits in the order of LIMITS, SI; infinite where there is none."""
    given = (getattr(limits, name) for name in LIMITS)
    return np.array(
        [
            none if value is None else float(value)
            for value, none in zip(given, NO_LIMITS, strict=True)
        ]
    )


@kernel
def violated(sample, command, limits, strokes, found):
    """Whether a sample or the command reached a limit; then ``found`` says (which limit, cylinder
    or valve, entry of the sample).

    Args:
        sample: as in ``ehbench.rigs``.
        command: [V], shape (valves,).
        limits: (pressure_max, pressure_min, stroke_margin, speed_max, command_max), SI; infinite
            where there is none.
        strokes: full stroke of each cylinder [m].
        found: out, int64 (3,).
    """
    for c in range(strokes.shape[0]):
        for channel in (OF.p_head, OF.p_rod):
            p = sample[entry(c, channel)]
            if p > limits[PRESSURE_MAX] or p < limits[PRESSURE_MIN]:
                found[0], found[1], found[2] = (
                    (PRESSURE_MAX if p > limits[PRESSURE_MAX] else PRESSURE_MIN),
                    c,
                    entry(c, channel),
                )
                return True
        x = sample[entry(c, OF.x)]
        if x < limits[MARGIN] or x > strokes[c] - limits[MARGIN]:
            found[0], found[1], found[2] = MARGIN, c, entry(c, OF.x)
            return True
        if abs(sample[entry(c, OF.v)]) > limits[SPEED]:
            found[0], found[1], found[2] = SPEED, c, entry(c, OF.v)
            return True
    for i in range(command.shape[0]):
        if abs(command[i]) > limits[COMMAND]:
            found[0], found[1], found[2] = COMMAND, i, -1
            return True
    return False


@kernel
def _model_row(y, sample, command, plant, tick, steps, k, work, log, samples):
    """Log a row and let the command act for a tick; ``log`` has the state, the edge flows and the
    pump flow.
    """
    size, flows = y.shape[0], plant.edges.shape[0] + 1
    at = work.shape[0] - flows
    rate = derivatives(y, command, plant, k[0], work)
    for j in range(size):
        log[j] = y[j]
    for j in range(flows):
        log[size + j] = work[at + j]
    for j in range(sample.shape[0]):
        samples[j] = sample[j]
    advance(y, command, plant, tick / steps, k, work, rate)
    for _ in range(1, steps):
        rk4(y, command, plant, tick / steps, k, work)
    model_sample(y, plant, sample)


@kernel
def _model_loop(
    y, sample, commands, plant, tick, steps, k, work, limits, strokes, log, samples, found
):
    for i in range(commands.shape[0]):
        if violated(sample, commands[i], limits, strokes, found):
            return i
        _model_row(y, sample, commands[i], plant, tick, steps, k, work, log[i], samples[i])
    return -1


@kernel
def _model_closed(
    y,
    sample,
    commands,
    plant,
    tick,
    steps,
    k,
    work,
    limits,
    strokes,
    log,
    samples,
    found,
    t,
    references,
    controller,
    telemetry,
):
    for i in range(commands.shape[0]):
        registry.tick(t + i * tick, sample, references[i], controller, commands[i], telemetry[i])
        if violated(sample, commands[i], limits, strokes, found):
            return i
        _model_row(y, sample, commands[i], plant, tick, steps, k, work, log[i], samples[i])
    return -1


@kernel
def _bench_row(state, sample, command, bench, tick, steps, scratch, noise, samples):
    for j in range(sample.shape[0]):
        samples[j] = sample[j]
    bench_tick(state, command, bench, tick, steps, scratch, noise, sample)


@kernel
def _bench_loop(
    state,
    sample,
    commands,
    bench,
    tick,
    steps,
    scratch,
    limits,
    strokes,
    noise,
    samples,
    found,
):
    for i in range(commands.shape[0]):
        if violated(sample, commands[i], limits, strokes, found):
            return i
        _bench_row(state, sample, commands[i], bench, tick, steps, scratch, noise[i], samples[i])
    return -1


@kernel
def _bench_closed(
    state,
    sample,
    commands,
    bench,
    tick,
    steps,
    scratch,
    limits,
    strokes,
    noise,
    samples,
    found,
    t,
    references,
    controller,
    telemetry,
):
    for i in range(commands.shape[0]):
        registry.tick(t + i * tick, sample, references[i], controller, commands[i], telemetry[i])
        if violated(sample, commands[i], limits, strokes, found):
            return i
        _bench_row(state, sample, commands[i], bench, tick, steps, scratch, noise[i], samples[i])
    return -1


class Runner:
    """A machine at rest and what a trial logs of it, chunk by chunk.

    Attributes:
        t: [s], shape (samples,).
        commands: [V], shape (samples, valves): the open-loop table, into which a controller writes
            its own.
        log: model only: state, edge flows and pump flow at each sample.
        samples: what the machine measured, shape (samples, channels).
        sample: the last one.
    """

    def __init__(
        self,
        machine: Machine,
        sample: np.ndarray,
        t: np.ndarray,
        commands: np.ndarray,
        limits: np.ndarray,
    ) -> None:
        self.machine, self.sample, self.t, self.commands, self.limits = (
            machine,
            sample,
            t,
            commands,
            limits,
        )
        self.is_model = isinstance(machine, ModelRig)
        width = machine.layout.states + len(machine.layout.edges) + 1 if self.is_model else 0
        self.log, self.samples = np.empty((t.size, width)), np.empty((t.size, sample.size))
        self.found = np.zeros(3, dtype=np.int64)
        numbers = machine.model.plant if self.is_model else machine.bench
        self.strokes = numbers.cylinders.stroke.copy()
        tick = 1.0 / machine.rate
        if self.is_model:
            self._own = (numbers, tick, machine.steps, machine._k, machine._work)
        else:
            self._own = (numbers, tick, machine.steps, machine._scratch)

    def go(self, first: int, stop: int, controller: Compiled | None = None) -> int:
        """Run rows ``first`` to ``stop`` under a compiled controller, or as the table says; the row
        at a limit, or −1.
        """
        machine, rows = self.machine, slice(first, stop)
        start = (
            machine.state,
            self.sample,
            self.commands[rows],
            *self._own,
            self.limits,
            self.strokes,
        )
        if self.is_model:
            ends = (self.log[rows], self.samples[rows], self.found)
        else:
            ends = (machine.noise(stop - first), self.samples[rows], self.found)
        if controller is None:
            row = (_model_loop if self.is_model else _bench_loop)(*start, *ends)
        else:
            row = (_model_closed if self.is_model else _bench_closed)(
                *start,
                *ends,
                float(self.t[first]),
                controller.references[rows],
                controller.controller,
                controller.telemetry[rows],
            )
        return row if row < 0 else first + row

    def reached(self, row: int) -> bool:
        """Whether the present sample and the row's command reach a limit; ``found`` says which."""
        return bool(
            violated(self.sample, self.commands[row], self.limits, self.strokes, self.found)
        )
