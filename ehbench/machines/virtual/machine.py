"""The virtual bench behind the protocol of a real machine."""

from __future__ import annotations

from copy import copy
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from ehbench.config.recipe import BenchRecipe, TrialRecipe, load_recipe, load_rig
from ehbench.config.rig import Rig
from ehbench.machines.protocol import Advance, Posture, Simulated
from ehbench.machines.rows import Controls, Rows, control, violated
from ehbench.machines.virtual.drawing import build, check_names, true_rig
from ehbench.machines.virtual.laws import bench_tick, edge_flow, play, raw_of
from ehbench.machines.virtual.plant import (
    A_CYLINDER,
    FILTER,
    RAW,
    STROKE,
    Scratch,
    VirtualPlant,
    scratch_of,
)
from ehbench.parts.edge import CHECK, PUMP
from ehbench.parts.sample import OF
from ehbench.parts.valve import valve_settle
from ehbench.plant.build import Maps, links_of
from ehbench.plant.layout import layout
from ehbench.plant.model import Model
from ehbench.plant.trim import LowSide
from ehbench.runtime.compiled import bound, kernel
from ehbench.vocabulary import InputError, message

NAME = "virtual bench"
STEP = 2.5e-4  # [s]
NOISE_ROWS = 256  # drawn at a time
SETTLE = 0.25  # [s] of rest before t = 0, so that lags and delays have filled


class Running(NamedTuple):
    """A bench at work: ``state`` with its memory, numbers, ``tick`` [s], ``steps`` in it,
    scratch."""

    state: np.ndarray
    bench: VirtualPlant
    tick: float
    steps: int
    scratch: Scratch


@kernel
def _advance(first, stop, run, rows, law, noise):
    sample = rows.sample
    for i in range(first, stop):
        if law is not None:
            control(law, i, rows)
        if violated(rows, i):
            return i
        for j in range(sample.shape[0]):
            rows.samples[i, j] = sample[j]
        for c in range(rows.truth.shape[1]):
            rows.truth[i, c] = run.scratch.raw[A_CYLINDER * c + STROKE]
        bench_tick(
            run.state,
            rows.commands[i],
            run.bench,
            run.tick,
            run.steps,
            run.scratch,
            noise[i - first],
            sample,
        )
    return -1


def bench_of(recipe: TrialRecipe, rig: Rig) -> tuple[Rig, BenchRecipe]:
    """(the rig that a trial's bench is, its bench file, or an empty one where there is none).

    Raises:
        InputError: no bench file, or one of other cylinders or valves than the rig's.
    """
    if recipe.bench is None:
        return rig, BenchRecipe(stage="bench", rig="")
    bench = load_recipe(recipe.file(recipe.bench))
    if not isinstance(bench, BenchRecipe):
        raise InputError(message("machines.no_bench_file"), file=bench.path)
    bench_rig = load_rig(bench.file(bench.rig)).with_dynamics(recipe.dynamics)
    bench_rig = bench_rig.with_supply(recipe.supply.load_sensing, recipe.supply.low_rail)
    for what, mine, its in (
        ("cylinders", [c.name for c in rig.cylinder], [c.name for c in bench_rig.cylinder]),
        ("valves", layout(rig).valves, layout(bench_rig).valves),
    ):
        if mine != its:
            fields = {"bench": bench_rig.name, "what": what, "rig": rig.name}
            text = message("machines.other_rig", known=", ".join(its), **fields)
            raise InputError(text, **recipe.at("bench"))
    return bench_rig, bench


class TrueStrokes:
    """The strokes of a running bench as they are, without its sensors."""

    def __init__(self, running: Running) -> None:
        self._running, self.width = running, running.bench.cylinders.shape[0]

    def read(self, command: np.ndarray, row: np.ndarray) -> None:
        """As `Hidden.read`."""
        row[:] = self._running.scratch.raw[STROKE : A_CYLINDER * self.width : A_CYLINDER]


class VirtualMachine(Simulated):
    """The virtual bench behind the protocol of a real machine.

    ``channels`` names the sample's entries, ``rate`` [Hz] the ticks a second. ``start`` puts it at
    rest in a posture and gives the first sample; ``tick`` lets a command [V] act for one tick and
    gives the next.

    Args:
        rig: the machine as its rig file has it.
        recipe: the bench file, or None for a plausible bench of that rig.
        payload: a payload of the rig file.
        rate: [Hz].
        step: integration step [s].
        seed: of the sensors' noise.

    Raises:
        InputError: the bench file names what the rig has not; no such payload.
    """

    name = NAME

    def __init__(
        self,
        rig: Rig,
        recipe: BenchRecipe | None = None,
        payload: str | None = None,
        rate: float = 1000.0,
        step: float = STEP,
        seed: int = 0,
    ) -> None:
        recipe = recipe or BenchRecipe(stage="bench", rig="")
        super().__init__(Model.of(true_rig(recipe, rig), None, payload), rate)
        self.rig, self.seed, self.latency = rig, seed, float(recipe.delay)
        check_names(recipe, self.layout)
        self.bench = build(recipe, self.model, 1.0 / self.rate)
        self.steps = max(1, round(1.0 / (self.rate * step)))
        self.size, self.raw = self.bench.at.states, self.bench.at.channels
        self._begin()

    @classmethod
    def of(cls, recipe: TrialRecipe, rig: Rig, maps: Maps | None) -> VirtualMachine:
        """The virtual bench that a trial runs on; measured maps are none of its business.

        Raises:
            InputError: as `bench_of`.
        """
        given = {"payload": recipe.payload, "rate": float(recipe.rate), "seed": recipe.seed}
        return cls(*bench_of(recipe, rig), **given)

    def seeded(self, seed: int) -> VirtualMachine:
        """The same machine, not started, with other noise of its sensors."""
        other = copy(self)
        other.seed = seed
        other._begin()
        return other

    def _begin(self) -> None:
        """A state of its own, and its noise from the first row on."""
        self.state, tick = np.zeros(self.bench.at.size), 1.0 / self.rate
        scratch = scratch_of(self.bench, tick)
        self._running = Running(self.state, self.bench, tick, self.steps, scratch)
        self.hidden = TrueStrokes(self._running)
        self._rng = self._new_noise()
        self._noise, self._used = np.empty((0, self.raw)), 0

    def _new_noise(self) -> np.random.Generator:
        return np.random.default_rng([self.seed, crc32(b"noise")])

    def noise(self, ticks: int) -> np.ndarray:
        """The next ``ticks`` rows of the sensors' noise, shape (ticks, raw channels)."""
        left = self._noise[self._used :]
        if len(left) < ticks:
            fresh = self._rng.standard_normal((max(ticks - len(left), NOISE_ROWS), self.raw))
            self._noise, self._used = np.concatenate([left, fresh]), 0
        self._used += ticks
        return self._noise[self._used - ticks : self._used]

    def carry(self, payload: str | None) -> None:
        """As `carry_of` says."""
        self.bench.links[:] = self.model.links(payload)

    def start(self, posture: Posture = None, low_side: LowSide = None) -> np.ndarray:
        """As `Machine.start`; the unloaded chambers begin to settle at ``low_side``."""
        self.bench.links[:] = links_of(self.model.rig)
        self._rng, self._used = self._new_noise(), len(self._noise)
        bench, at, state = self.bench, self.bench.at, self.state
        rest = self.commands.rest
        state[:] = 0.0
        state[: at.pump] = self.model.trim(self.model.posture(posture), low_side)
        state[at.sensed] = state[at.supply]
        state[at.hysteresis : at.lags] = rest
        for index, (valve, command) in enumerate(zip(bench.valves, rest, strict=True)):
            target = valve.gain * command + valve.offset
            valve_settle(valve, target, bench, state)
            self._running.scratch.line.past[:, index] = target
        raw_of(state[: at.states], bench, state[at.lags : at.filters])
        for c in range(len(self.layout.cylinders)):
            k = at.filters + FILTER * c
            state[[k, k + 2]] = state[at.lags + A_CYLINDER * c + RAW.index(OF.x)]
        sample = np.zeros(len(self.channels))
        for _ in range(max(round(SETTLE * self.rate), bench.delay + 3)):
            self._tick(rest, sample)
        self.must_be_finite()
        return sample

    def tick(self, command: np.ndarray) -> np.ndarray:
        """As `Machine.tick`."""
        sample = np.zeros(len(self.channels))
        self._tick(self.commands.taken(command), sample)
        self.must_be_finite()
        return sample

    def _tick(self, command: np.ndarray, sample: np.ndarray) -> None:
        state, *numbers = self._running
        bench_tick(state, command, *numbers, self.noise(1)[0], sample)

    def advance(self, rows: Rows, law: Controls | None, often: bool) -> Advance:
        """As `advance_of` says."""
        running = self._running
        run = bound(_advance, 0, 0, running, rows, law, self._noise) if often else _advance

        def through(first: int, stop: int) -> int:
            row = run(first, stop, running, rows, law, self.noise(stop - first))
            if row >= 0:  # noise that no tick used is the next one's, however long the call was
                self._used -= stop - row
            self.must_be_finite()
            return row

        return through

    def mean_flow(self, edge: str, command: np.ndarray, drop: np.ndarray) -> np.ndarray:
        """`static_flow` in the mean of commands that rise from rest and fall from twice
        themselves."""
        rest = self.commands.rest[self.bench.edges[self.layout.edges.index(edge)].valve]
        falling = self.static_flow(edge, command, drop, 2.0 * np.asarray(command) - rest)
        return 0.5 * (self.static_flow(edge, command, drop) + falling)

    def static_flow(
        self,
        edge: str,
        command: np.ndarray,
        drop: np.ndarray,
        before: np.ndarray | None = None,
    ) -> np.ndarray:
        """Flow [m³/s] that an edge passes at rest at commands [V], each approached from the command
        ``before`` [V], the valve's rest where none is given, and drops [Pa].

        Raises:
            InputError: no such edge.
        """
        if edge not in self.layout.edges:
            known = ", ".join(self.layout.edges)
            raise InputError(message("machines.no_edge", edge=edge, known=known))
        index = self.layout.edges.index(edge)
        row = self.bench.edges[index]
        if row.law in (PUMP, CHECK):
            raise InputError(message("machines.no_metering", edge=edge))
        valve: Any = self.bench.valves[row.valve]
        before = self.commands.rest[row.valve] if before is None else before
        command, drop, before = np.broadcast_arrays(
            *(np.asarray(given, dtype=float) for given in (command, drop, before))
        )
        flows = []
        for u, dp, from_u in zip(command.ravel(), drop.ravel(), before.ravel(), strict=True):
            spool = valve.gain * play(from_u, u, valve.hysteresis) + valve.offset
            flows.append(edge_flow(dp, spool, row, self.bench.curves))
        return np.array(flows).reshape(command.shape)
