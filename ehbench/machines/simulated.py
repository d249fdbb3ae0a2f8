"""The identified model behind the protocol of a real machine, with perfect sensors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ehbench.config.recipe import TrialRecipe
from ehbench.config.rig import Rig
from ehbench.machines.protocol import Advance, Posture, Simulated
from ehbench.machines.rows import Controls, Rows, control, violated
from ehbench.parts.sample import perfect_sample
from ehbench.parts.valve.delay import Line, line_acting, line_of, line_push
from ehbench.plant.build import Maps, Plant, links_of
from ehbench.plant.derivatives import derivatives
from ehbench.plant.integrate import STEP, advance, rk4
from ehbench.plant.model import Model
from ehbench.plant.paced import AUTO, LATE, SCRATCH, Step, Way, over_tick, pace_of
from ehbench.plant.trim import LowSide
from ehbench.runtime.compiled import bound, kernel

NAME = "model"


class Running(NamedTuple):
    """A model at work: state ``y``, plant, ``tick`` [s], integration ``steps`` in it, ``line`` of
    past commands, scratch, the sum of the fastest ``rates`` [1/s] at rows and their number."""

    y: np.ndarray
    plant: Plant
    line: Line
    tick: float
    steps: int
    k: np.ndarray
    work: np.ndarray
    rates: np.ndarray


@kernel
def model_tick(y, command, plant, line, steps, k, work, sample):
    """Let ``command`` [V] act for one tick of its ``line`` on state ``y``, in place, then write the
    sample at its end.

    ``k`` is a (5, states) scratch and ``work`` the workspace of the plant; ``steps`` integration
    steps a tick."""
    h = line.tick / steps
    for step in range(steps):
        line_acting(line, command, plant, step * h, h)
        rk4(y, line.acting, plant, h, k, work)
    line_push(line, command)
    perfect_sample(y, plant, sample)


@kernel
def paced_tick(run, command, pace, sample):
    """`model_tick` in steps chosen by the guard."""
    line_acting(run.line, command, run.plant, 0.0, run.tick / run.steps)
    rate = derivatives(run.y, run.line.acting, run.plant, run.k[0], run.work)
    over_tick(Way(run.y, run.plant, run.line, pace, run.k, run.work), command, rate)
    line_push(run.line, command)
    perfect_sample(run.y, run.plant, sample)


@kernel
def model_truth(run, command, row):
    """Write state, edge flows and pump flow into ``row``; the fastest rate [1/s] of the
    derivatives."""
    size, at = run.y.shape[0], run.plant.at.flow
    line_acting(run.line, command, run.plant, 0.0, run.tick / run.steps)
    rate = derivatives(run.y, run.line.acting, run.plant, run.k[0], run.work)
    for j in range(size):
        row[j] = run.y[j]
    for j in range(run.work.shape[0] - at):
        row[size + j] = run.work[at + j]
    run.rates[0] += rate
    run.rates[1] += 1.0
    return rate


@kernel
def _advance(first, stop, run, rows, law, pace):
    sample, h = rows.sample, run.tick / run.steps
    for i in range(first, stop):
        if law is not None:
            control(law, i, rows)
        if violated(rows, i):
            return i
        command = rows.commands[i]
        rate = model_truth(run, command, rows.truth[i])
        for j in range(sample.shape[0]):
            rows.samples[i, j] = sample[j]
        if pace is None:
            for step in range(run.steps):
                if step > 0:
                    line_acting(run.line, command, run.plant, step * h, h)
                    rate = derivatives(run.y, run.line.acting, run.plant, run.k[0], run.work)
                advance(run.y, run.line.acting, run.plant, h, run.k, run.work, rate)
        else:
            over_tick(Way(run.y, run.plant, run.line, pace, run.k, run.work), command, rate)
        line_push(run.line, command)
        perfect_sample(run.y, run.plant, sample)
    return -1


class SimulatedMachine(Simulated):
    """A model as a machine: ``start`` puts it at rest in a posture, ``tick`` lets a command act;
    samples are exact.

    Args:
        model: with its payload and flow maps.
        rate: ticks a second [Hz].
        step: integration step [s], or ``"auto"``: chosen by the guard.
    """

    name = NAME
    latency = 0.0
    plays = False  # its valves are the maps themselves, the middle of both ways

    def __init__(self, model: Model, rate: float = 1000.0, step: Step = STEP) -> None:
        super().__init__(model, rate)
        self.steps = LATE if step == AUTO else max(1, round(1.0 / (self.rate * step)))
        plant, states = model.plant, model.layout.states
        self.state = np.zeros(states)
        self._running = Running(
            self.state,
            plant,
            line_of(plant, 1.0 / self.rate),
            1.0 / self.rate,
            self.steps,
            np.empty((SCRATCH, states)),
            np.empty(plant.at.work),
            np.zeros(2),
        )
        self._pace = pace_of(plant, model.layout, 1.0 / self.rate) if step == AUTO else None
        self.truth = ModelTruth(model, self._running)

    @classmethod
    def of(cls, recipe: TrialRecipe, rig: Rig, maps: Maps | None) -> SimulatedMachine:
        """The model that a trial runs on."""
        model = Model.of(rig, maps, recipe.payload)
        step = recipe.step if isinstance(recipe.step, str) else float(recipe.step)
        return cls(model, float(recipe.rate), step)

    def carry(self, payload: str | None) -> None:
        """As `carry_of` says."""
        self.model.plant.links[:] = self.model.links(payload)

    def start(self, posture: Posture = None, low_side: LowSide = None) -> np.ndarray:
        """As `Machine.start`."""
        self.model.plant.links[:] = links_of(self.model.rig)
        self.state[:] = self.model.trim(self.model.posture(posture), low_side)
        self._running.line.past[:] = self.model.plant.valves.before
        self._running.rates[:] = 0.0
        sample = np.empty(len(self.channels))
        perfect_sample(self.state, self.model.plant, sample)
        return sample

    def tick(self, command: np.ndarray) -> np.ndarray:
        """As `Machine.tick`."""
        sample = np.empty(len(self.channels))
        sim, fixed = self._running, self.commands.taken(command)
        if self._pace is None:
            model_tick(sim.y, fixed, sim.plant, sim.line, sim.steps, sim.k, sim.work, sample)
        else:
            paced_tick(sim, fixed, self._pace, sample)
        self.must_be_finite()
        return sample

    def advance(self, rows: Rows, law: Controls | None, often: bool) -> Advance:
        """As `advance_of` says."""
        running, pace = self._running, self._pace
        through_rows = bound(_advance, 0, 0, running, rows, law, pace) if often else _advance

        def through(first: int, stop: int) -> int:
            row = through_rows(first, stop, running, rows, law, pace)
            self.must_be_finite()
            return row

        return through


class ModelTruth:
    """States of a running model, edge flows and pump flow, as in `Model.run`'s log."""

    def __init__(self, model: Model, running: Running) -> None:
        self.model, self._running = model, running
        self.width = model.layout.states + len(model.layout.edges) + 1

    def read(self, command: np.ndarray, row: np.ndarray) -> None:
        """As `Truth.read`."""
        model_truth(self._running, command, row)

    @property
    def rate(self) -> float:
        """As `Truth.rate`."""
        total, rows = self._running.rates
        return float(total) / max(float(rows), 1.0)

    def channels(
        self, t: np.ndarray, commands: np.ndarray, rows: np.ndarray
    ) -> dict[str, np.ndarray]:
        """As `Truth.channels`: all that `Model.record` gives."""
        return self.model.record(t, commands, rows).channels
