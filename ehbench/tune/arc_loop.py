"""The sampled loop of the adaptive robust controller, linearised about steady motions, and how far
it is from swinging.

Nothing is written down twice: the controller's own tick and the plant's are taken as maps from one
sample to the next, and central differences of them give the matrices. So valve lag, hold, observer,
adaptation, the off-side's loop and the neighbouring joints on their oil are all in; delay and lag
of the sensors stand between."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ehbench.control import arc
from ehbench.control.axis import inertias, load_at
from ehbench.control.functions import METERED, SUPPLY_HEAD, SUPPLY_ROD
from ehbench.control.law import Controller, DesignPoint, late_of
from ehbench.control.registry import tick as law_tick
from ehbench.machines.simulated import model_tick
from ehbench.parts.sample import perfect_sample, sample_channels, sample_size
from ehbench.parts.valve.delay import line_of
from ehbench.plant.integrate import STEP
from ehbench.plant.model import Model
from ehbench.tune.operating_point import OperatingPoint, state_of
from ehbench.vocabulary import setting
from ehbench.vocabulary.codes import DISTURBANCE, FREE, FUNCTIONS, INVERSE_INERTIA, PAYLOAD_SHARE

# states of the controller's memory in motion, and their steps for differences
MEMORY_STEPS = {"x": 1e-6, "v": 1e-5, "bias": 1e-3, "acceleration": 1e-3, "set_point": 300.0}
MEMORY_STEPS |= {"slow_load": 1.0, "calm_load": 1.0, "supply_swing": 300.0, "slow_drop": 300.0}
# the same of the plant's states: rad or m, per second, V, V/s, m
STATE_STEPS = {"q": 1e-6, "qd": 1e-5, "opening": 1e-4, "rate": 1e-2}
STATE_STEPS |= {"mount_deflection": 1e-8, "sway": 1e-6, "sway_speed": 1e-5}


@dataclass(frozen=True)
class ArcLoopSettings:
    """Numbers of the margins of a sampled loop."""

    estimate: float = setting(1e-4, "", "step of estimates, of their bounds", "differences")
    inside: float = setting(1e-3, "", "distance of estimates to their bounds", "no kink there")
    slowest: float = setting(3.0, "rad/s", "slowest swing", "slower is the motion itself")
    points: int = setting(500, "", "frequencies of the response", "smooth loci")
    rings: float = setting(0.3, "", "damping ratio of a mode that rings", "has a peak")
    peak: float = setting(1.45, "rad", "part of a peak's circle to look at", "half a turn is 1.57")
    peak_points: int = setting(41, "", "points on that circle", "smooth loci")
    safety: float = setting(1.5, "", "computed delay margin over the stated one", "model error")
    growth: float = setting(0.05, "1/s", "growth of a pole that stands", "drifts of the motion")


ARC_LOOP = ArcLoopSettings()


class Sensing(NamedTuple):
    """Between machine and controller: ``delay`` of all samples, ``lag`` of those of pressure
    [s]."""

    delay: float = 0.0
    lag: float = 0.0


class LoopMargins(NamedTuple):
    """How far a loop is from swinging: factor ``gain`` of all commands, angle ``phase`` [rad] and
    extra ``delay`` [s] at which it begins, each by itself; the ``frequency`` [rad/s] at which it
    swings then, by delay; the factor ``away`` of all commands at which it runs away without a
    swing. All 0 where it swings as it is, infinite where nothing makes it swing."""

    gain: float
    phase: float
    delay: float
    frequency: float
    away: float = math.inf

    @property
    def stated_gain(self) -> float:
        """The gain margin to count on, of swings and of what runs away."""
        return min(self.gain, self.away)

    @property
    def stated(self) -> float:
        """The delay margin [s] to count on: the computed one over ``safety``."""
        return self.delay / ARC_LOOP.safety


class Sampled(NamedTuple):
    """A linear map over a tick: state' = a·state + b·input, output = c·state + d·input."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray

    def response(self, z: np.ndarray) -> np.ndarray:
        """c (z − a)⁻¹ b + d at each z, shape (points, outputs, inputs).

        Over Schur's triangle of ``a``, solved from its last row up for all z at once; states of
        Pa and of m are balanced before, or rounding of the one would drown the other."""
        from scipy.linalg import matrix_balance, schur  # a quarter of a second to import

        balancing: Any = matrix_balance(self.a, permute=False, separate=True)
        balanced, (scale, _) = balancing
        result: Any = schur(balanced, output="complex")
        triangle, turn = result
        inflow = turn.conj().T @ (self.b / scale[:, None])
        state = np.empty((len(triangle), z.size, self.b.shape[1]), complex)
        for i in reversed(range(len(triangle))):
            known = np.tensordot(triangle[i, i + 1 :], state[i + 1 :], 1) + inflow[i]
            state[i] = known / (z - triangle[i, i])[:, None]
        return np.tensordot((self.c * scale) @ turn, state, 1).transpose(1, 0, 2) + self.d


@dataclass(frozen=True)
class ArcLoop:
    """The loop at an operating point: ``plant`` from commands [V] to samples, ``law`` from samples
    to commands, over one ``tick`` [s]; ``lagged`` marks samples of pressure."""

    plant: Sampled
    law: Sampled
    tick: float
    lagged: np.ndarray

    def poles(self, sensing: Sensing) -> np.ndarray:
        """Poles [rad/s] of the closed loop that swing or grow, the neutral and forgotten left out.

        Samples between two ticks are read on the straight line between them."""
        plant, law = self.plant, self.law
        n, m, k = map(len, (plant.a, plant.c, law.a))
        late = sensing.delay / self.tick
        whole, share = int(late), late - int(late)
        rows = whole + 2
        keep = np.where(self.lagged, _keep(sensing.lag, self.tick), 0.0)
        # state: plant, sensors, their last rows, controller
        size = n + m * rows + k
        closed = np.zeros((size, size))
        seen = np.zeros((m, size))  # what the controller gets now
        at = [slice(n + m * i, n + m * (i + 1)) for i in range(rows)]
        seen[:, at[whole]] += (1.0 - share) * np.eye(m)
        seen[:, at[whole + 1]] += share * np.eye(m)
        command = law.d @ seen
        command[:, size - k :] += law.c
        closed[:n] = plant.b @ command
        closed[:n, :n] += plant.a
        closed[at[0]] = (1.0 - keep)[:, None] * (plant.c @ closed[:n])
        closed[at[0], at[0]] += np.diag(keep)
        for i in range(1, rows):
            closed[at[i], at[i - 1]] = np.eye(m)
        closed[size - k :] = law.b @ seen
        closed[size - k :, size - k :] += law.a
        grown = np.linalg.eigvals(closed)
        grown = grown[np.abs(grown) > 1e-6]
        return np.log(grown.astype(complex)) / self.tick

    def growth(self, sensing: Sensing) -> float:
        """Growth [1/s] of what swings, the fastest; negative where all dies out."""
        poles = self.poles(sensing)
        return float(
            np.real(poles[np.abs(np.imag(poles)) > ARC_LOOP.slowest]).max(initial=-math.inf)
        )

    def loci(self, sensing: Sensing) -> tuple[np.ndarray, np.ndarray]:
        """(frequencies [rad/s], characteristic loci): eigenvalues of the response from all commands
        to all."""
        highest = 0.98 * math.pi / self.tick
        modes = np.linalg.eigvals(self.plant.a)
        modes = np.log(modes[np.abs(modes) > 1e-6].astype(complex)) / self.tick
        ringing = modes[-np.real(modes) < ARC_LOOP.rings * np.imag(modes)]
        # a stiff rig's peaks lie between even steps: about each in its half-widths, evenly along
        # the circle that it draws
        about = np.tan(np.linspace(-ARC_LOOP.peak, ARC_LOOP.peak, ARC_LOOP.peak_points))
        near = np.imag(ringing)[:, None] + np.abs(np.real(ringing))[:, None] * about
        omega = np.append(np.geomspace(ARC_LOOP.slowest, highest, ARC_LOOP.points), near.ravel())
        omega = np.unique(omega[(omega >= ARC_LOOP.slowest) & (omega <= highest)])
        return omega, self.eigenvalues(np.exp(1j * omega * self.tick), sensing)

    def eigenvalues(self, z: np.ndarray, sensing: Sensing) -> np.ndarray:
        """Those of the response from all commands to all at each z, shape (points, commands)."""
        late = z ** (-sensing.delay / self.tick)
        keep = _keep(sensing.lag, self.tick)
        lag = (1.0 - keep) / (1.0 - keep / z)
        sensors = np.where(self.lagged, lag[:, None], 1.0) * late[:, None]
        # the plant's output is that of its state at a tick
        through = self.plant.response(z)
        return np.linalg.eigvals(self.law.response(z) @ (sensors[:, :, None] * through))

    def margins(self, sensing: Sensing) -> LoopMargins:
        """Margins of all commands together; exact, as a common gain, angle or delay turns all loci
        alike."""
        if self.growth(sensing) > ARC_LOOP.growth:
            return LoopMargins(0.0, 0.0, 0.0, 0.0, 0.0)
        w, loci = self.loci(sensing)
        for i in range(1, len(loci)):  # each locus by itself: the eigenvalues that went on
            remaining = list(loci[i])
            for j, last in enumerate(loci[i - 1]):
                nearest = int(np.argmin([abs(item - last) for item in remaining]))
                loci[i, j] = remaining.pop(nearest)
        # a real pole that grows as fast as the slowest swing
        real = self.eigenvalues(np.exp([ARC_LOOP.slowest * self.tick + 0j]), sensing)[0]
        reached = [x.real for x in real if abs(x.imag) < 1e-9 * abs(x) and 0.0 < x.real < 1.0]
        away = min((1.0 / x for x in reached), default=math.inf)
        gain = phase = delay = math.inf
        frequency = 0.0
        for item in loci.T:
            size, angle = np.abs(item), np.angle(item)
            for i, share in _crossings(np.log(np.maximum(size, 1e-300))):
                at = w[i] * (w[i + 1] / w[i]) ** share
                turn = cmath.phase(item[i] + share * (item[i + 1] - item[i]))
                phase = min(phase, abs(turn))
                delay, frequency = min((delay, frequency), ((turn % (2.0 * math.pi)) / at, at))
            for i, share in _crossings(angle):
                if abs(angle[i]) < 1.0 and abs(angle[i + 1]) < 1.0:
                    reached = size[i] + share * (size[i + 1] - size[i])
                    gain = min(gain, 1.0 / reached) if reached < 1.0 else gain
        return LoopMargins(gain, phase, delay, frequency, away)


def _keep(lag: float, tick: float) -> float:
    """Share of a first-order lag's output that is left after a tick."""
    return math.exp(-tick / lag) if lag > 0.0 else 0.0


def _crossings(y: np.ndarray) -> list[tuple[int, float]]:
    """(index, share of the step behind it) of each change of sign."""
    at = np.flatnonzero(np.sign(y[1:]) != np.sign(y[:-1]))
    return [(int(i), float(y[i] / (y[i] - y[i + 1]))) for i in at]


@dataclass(frozen=True)
class SampledPlant:
    """A steady motion of a rig, sampled: ``model`` with its payload, its other cylinders' valves
    shut, the ``point``, the map over a tick from the ``valves`` at work to the samples, and the
    ``sample`` there."""

    model: Model
    point: OperatingPoint
    plant: Sampled
    valves: tuple[int, ...]
    sample: np.ndarray

    @classmethod
    def of(cls, model: Model, point: OperatingPoint, tick: float) -> SampledPlant:
        """The plant of a model at a point, sampled each ``tick`` [s]."""
        (y, command), names = state_of(model, point), model.layout
        there = np.empty(sample_size(len(names.cylinders)))
        perfect_sample(y, model.plant, there)
        valves, rows = sorted({path.valve for path in point.paths}), model.plant.valves.copy()
        rows.delay[:] = 0.0  # a valve's pure delay is one of the loop's
        plant, steps = model.plant._replace(valves=rows), max(1, round(tick / STEP))
        line, sample = line_of(plant, tick), np.empty_like(there)
        k, work = np.empty((5, names.states)), np.empty(plant.at.work)

        def after(push: np.ndarray, turned: np.ndarray) -> np.ndarray:
            state, fixed = y + push, command.copy()
            fixed[valves] += turned
            model_tick(state, fixed, plant, line, steps, k, work, sample)
            return state

        def read(push: np.ndarray) -> np.ndarray:
            perfect_sample(y + push, plant, sample)
            return sample.copy()

        words = (name.rsplit(".", 1)[-1] for name in names.state_names)
        usual = {True: 300.0, False: 1e-4}  # of pressures, of others
        sizes = np.array([STATE_STEPS.get(w, usual[w.startswith("p_")]) for w in words])
        none, volts = np.zeros(len(valves)), np.full(len(valves), 1e-4)
        a = _differences(lambda push: after(push, none), sizes)
        b = _differences(lambda turned: after(np.zeros(y.size), turned), volts)
        c, d = _differences(read, sizes), np.zeros((sample.size, len(valves)))
        return cls(model, point, Sampled(a, b, c, d), tuple(valves), there)

    def stays(self, design_point: DesignPoint, gains: np.record) -> bool:
        """Whether the controller stays in the point's working function: else it is no steady
        motion."""
        tick = _LawTick(self, design_point, gains)
        tick.after(np.zeros(tick.sizes.size), np.zeros(tick.reads.size))
        return FUNCTIONS[int(tick.memory.state.function)] == self.point.function

    def loop(self, design_point: DesignPoint, gains: np.record) -> ArcLoop:
        """The loop of the controller about it.

        Args:
            design_point: what the controller is designed for.
            gains: of `ehbench.control.arc_gains.pack_arc`."""
        lagged = np.array([name.startswith("p_") for name in _words(self.model)])
        tick = _LawTick(self, design_point, gains)
        count, none = tick.sizes.size, np.zeros(tick.inputs.size)
        by_memory = _differences(lambda push: tick.after(push, none), tick.sizes)
        by_sample = np.zeros((count + len(self.valves), self.sample.size))
        still = np.zeros(count)
        by_sample[:, tick.reads] = _differences(lambda seen: tick.after(still, seen), tick.inputs)
        law = Sampled(by_memory[:count], by_sample[:count], by_memory[count:], by_sample[count:])
        return ArcLoop(self.plant, law, design_point.tick, lagged)


def _words(model: Model) -> list[str]:
    return [name.rsplit(".", 1)[-1] for name in sample_channels(model.layout.cylinders)]


def _differences(function: Any, sizes: np.ndarray) -> np.ndarray:
    """∂function by central differences, a column for each size."""
    pushes = np.diag(sizes)
    columns = [(function(push) - function(-push)) / 2.0 for push in pushes]
    return np.array(columns).T / sizes


class _LawTick:
    """One tick of the controller at a steady motion, of pushed memory and pushed samples.

    ``sizes`` are the steps for differences of its memory, ``inputs`` those of what it ``reads`` of
    a sample; ``memory`` is that after the tick."""

    def __init__(self, at: SampledPlant, design_point: DesignPoint, gains: np.record) -> None:
        self.at, self.design_point, self.gains = at, design_point, gains
        self.start = steady_memory(at.model, at.point, design_point, gains)
        self.memory = arc.memory_of(design_point.axis)
        self.observed = arc.observed(design_point.axis, at.sample.size)
        self.telemetry = np.zeros(arc.COLUMNS + 4 * design_point.axis.circuit.count)
        self.reference = np.array([at.point.x, at.point.v, 0.0, 0.0])
        width = gains.upper - gains.lower
        steps = ARC_LOOP.estimate * np.where(width > 0.0, width, 1.0)
        self.sizes = np.concatenate([list(MEMORY_STEPS.values()), steps])
        self.reads = np.flatnonzero(self.observed)
        by_word, words = {"q": 1e-6, "x": 1e-6, "v": 1e-5}, _words(at.model)
        self.inputs = np.array([by_word.get(words[i], 300.0) for i in self.reads])

    def after(self, push: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Memory and commands of the valves at work after the tick."""
        at, axis = self.at, self.design_point.axis
        self.memory = memory = arc.memory_of(axis)
        state, given, command = memory.state, at.sample.copy(), at.model.rest_commands(1)[0]
        for name in arc.STATE.names or ():
            state[name] = self.start[name]
        for name, off in zip(MEMORY_STEPS, push[: len(MEMORY_STEPS)], strict=True):
            state[name] += off
        state.estimates[:] += push[len(MEMORY_STEPS) :]
        given[self.reads] += seen
        size = at.sample.size
        law = Controller(axis, self.gains, memory, self.observed, np.zeros(size), late_of())
        law_tick(0.0, given, self.reference, law, command, self.telemetry)
        moved = [float(state[name]) for name in MEMORY_STEPS]
        return np.array([*moved, *state.estimates, *command[list(at.valves)]])


def steady_memory(
    model: Model, point: OperatingPoint, design_point: DesignPoint, gains: np.record
) -> np.record:
    """The memory, a record of type `arc.STATE`, in a steady motion in which the load is known."""
    axis, state = design_point.axis, arc.memory_of(design_point.axis).state
    state.started, state.function, state.age = 1, FUNCTIONS.index(point.function), 10.0
    state.metered = METERED[state.function]
    state.set_point = point.p_tank + gains.low_pressure
    state.slow_load, state.learning = point.load_force, FREE
    state.calm_load = point.load_force
    fed = [at.drop for at in point.paths if at.path in (SUPPLY_HEAD, SUPPLY_ROD)]
    state.slow_drop = fed[0] if fed else 0.0
    state.x, state.v = point.x - design_point.tick * point.v, point.v  # of the last tick
    memory = arc.memory_of(axis)
    memory.angles[:] = point.q
    inertia, _ = inertias(axis, memory.angles, memory.work)
    load = load_at(axis, point.q[int(axis.cylinder.joint)], inertia, memory.work)
    estimates, inside = state.estimates, ARC_LOOP.inside * (gains.upper - gains.lower)
    low, high = gains.lower + inside, gains.upper - inside
    estimates[:] = np.clip(gains.start, low, high)
    estimates[INVERSE_INERTIA] = np.clip(
        load.mass / point.mass, low[INVERSE_INERTIA], high[INVERSE_INERTIA]
    )
    beyond = estimates[INVERSE_INERTIA] * (point.gravity_force - load.gravity)
    if load.pull != 0.0:
        estimates[PAYLOAD_SHARE] = np.clip(
            beyond / load.pull, low[PAYLOAD_SHARE], high[PAYLOAD_SHARE]
        )
    estimates[DISTURBANCE] = np.clip(
        beyond - estimates[PAYLOAD_SHARE] * load.pull, low[DISTURBANCE], high[DISTURBANCE]
    )
    state.payload = estimates[PAYLOAD_SHARE] / estimates[INVERSE_INERTIA]
    return state
