"""Output error: the parameters with which the simulation comes nearest to all logs at once, and how
sure they are.

Where each log starts is estimated with them: its doubts (`starts.Doubt`) are nuisances of that log
alone, so they are eliminated block by block."""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ehbench.errors import InsufficientData
from ehbench.identification.covariance import Block, Prior, covariance_of, eliminate, release_of
from ehbench.identification.groups import Group, groups_of, sentence
from ehbench.identification.journal import Journal
from ehbench.identification.results import (
    Estimate,
    FittedParameter,
    HydraulicsFit,
    Progress,
    SensorFit,
    finish,
    not_excited,
)
from ehbench.identification.search import VAGUE, Coordinate, of_sensors
from ehbench.identification.simulator import Log, Meshes, Shifts, Simulator
from ehbench.signals import lowpass, rms
from ehbench.starts import prior_weight
from ehbench.terms import CORRELATED, Z95

# a scale's floor as a share of the channel's spread: no sensor makes a channel worth more than that
SCALE_FLOOR = 5.0e-3
# a parameter is not excited if moving it by its unit (a factor e, or its whole range) changes no
# channel by more than this share of the channel's spread, rms
FAINT = 2.0e-3
# step of finite differences, in units of a parameter: over half a minute a larger one bends, and
# where parameters nearly cancel the bend outweighs what they differ by
DIFFERENCE = 1.0e-5
# … and it touches no log in which its effect is less than this share of its largest
NOTHING = 1.0e-3
NEAR = 5.0e-3  # share of its reach within which a parameter is tried at its bound
SCAN = math.log(10.0)  # how far the first look goes either way
# its points over the bulk modulus, and over other parameters: 5 % apart, 2.4 % in frequency, which
# twenty cycles of ringing can still tell
COARSE, FINER = 11, 97
# of other basins that the look meets: how much worse than the best one may be to be tried, how many
RIVAL, RIVALS = 3.0, 3
HEAD = 5.0  # [s] of a log at least that the search begins with
MUCH = 0.01  # squares of what is left, as a share of the channels' spread, that ask for more starts
STANDS = 0.03  # share by which scales may still change when a fit stands
ROUNDS = 8  # of weighing and solving at most
# of the descent: damping at first, at least and at most, and what a step changes it by
DAMPING, LEAST_DAMPING, MOST_DAMPING, EASIER, HARDER = 1e-3, 1e-9, 1e9, 0.1, 8.0
# a held parameter is surely wrong if the logs would move it by so many standard errors, by this
# share of it, and to the benefit of this share of the squares that are left
SURELY, SURELY_OFF, WORTH = 4.0, 0.01, 0.05
FARTHEST = 1.0e6  # spreads that a simulation counts as off at most: squares stay finite
# points over the range of a parameter of faint effect; halvings that find where the logs deny it
RANGE, HALVINGS = 13, 5
DENIED = 3.84  # rise of -2 log likelihood at the ends of a 95 % interval
FAITHFUL = 0.25  # share of what a step should gain that may be missed before all is linearised anew
# steps of the integration are taken again while no parameter is further off, in its units, and no
# start in its standard deviations: costs are compared to a millionth, and chosen steps shift them
SAME_STEPS, SAME_STARTS = 0.02, 1.0


@dataclass(frozen=True, eq=False)
class _Grid:
    """Where the integration's steps were chosen, and those steps by log; ``rough`` are longer."""

    theta: np.ndarray
    shifts: Shifts
    logs: Sequence[Log]
    meshes: Meshes
    rough: bool

    def of(self, logs: Sequence[Log], rough: bool) -> bool:
        """Whether its steps are those of some logs, and as long as is asked."""
        return logs is self.logs and rough == self.rough

    def serves(self, theta: np.ndarray, shifts: Shifts) -> bool:
        """Whether a point is so near that its simulations may take the same steps."""
        off = [np.abs(one - own) for one, own in zip(shifts, self.shifts, strict=False)]
        return (
            float(np.max(np.abs(theta - self.theta), initial=0.0)) <= SAME_STEPS
            and float(np.max(np.concatenate(off), initial=0.0)) <= SAME_STARTS
        )


@dataclass(frozen=True, eq=False)
class _Point:
    """Parameters in search coordinates, the shifts of the logs' starts, the residuals [SI] by log
    there, and the grid that they were simulated on; ``slopes`` are what is known already of their
    sensitivities [SI], by parameter and log, ``nudges`` by log and number of its start.
    """

    theta: np.ndarray
    shifts: Shifts
    left: list[np.ndarray]
    grid: _Grid
    slopes: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)
    nudges: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _End:
    """Where a coarse solution ended: its misfit, whether much is left of the channels' spread, the
    parameters.
    """

    misfit: float
    much: bool
    theta: np.ndarray


@dataclass
class _Way:
    """A descent under way: its damping, whether the last step gained what it should, the steps
    done, the sensitivities to the logs' starts and the point that they are of.
    """

    damping: float = DAMPING
    faithful: bool = True
    done: int = 0
    nudges: list[np.ndarray] | None = None
    origin: _Point | None = None


class OutputError:
    """Weighted least squares over all logs; one instance a fit.

    Args:
        simulator: of the logs, its parameters those searched, what is shared of the logs' sensors
            (`search.of_sensors`), and then those watched.
        search: parameters to fit.
        tell: progress.
        most: iterations of a solution.
        cutoff: of the low-pass [Hz].
        watched: parameters that are held, and of which the logs are asked at the end whether they
            should be.
        journal: of how far it has come.
    """

    def __init__(
        self,
        simulator: Simulator,
        search: list[Coordinate],
        tell: Progress,
        most: int,
        cutoff: float | None,
        watched: Sequence[Coordinate] = (),
        journal: Journal | None = None,
    ) -> None:
        self.journal = journal or Journal()
        sensors = of_sensors(simulator.logs[0].start.terms)
        self.simulator, self.search, self.tell = simulator, [*search, *sensors, *watched], tell
        self.most, self.cutoff = most, cutoff
        self.asked, self.fitted = len(search), len(search) + len(sensors)
        search = self.search
        names = sorted({channel for log in simulator.logs for channel in log.channels})
        self.spread = {
            c: self._pooled(
                c, [log.recorded - np.mean(log.recorded, axis=0) for log in simulator.logs]
            )
            for c in names
        }
        self.scales = dict(self.spread)
        self.theta = np.array([c.begin for c in search])
        self.shifts = simulator.unshifted()
        self.free = list(range(self.fitted))
        self.bound: list[int] = []
        self.ranged: dict[int, tuple[float, float]] = {}
        self.sharpness = np.array([c.sharpness if c.known else 0.0 for c in search])
        self.centre = np.array([c.of(c.centre) if c.known else 0.0 for c in search])
        self.weight = 1.0
        self.iterations = 0
        self.coarse = True
        self.touches = np.ones((len(search), len(simulator.logs)), dtype=bool)
        self.looked: list[tuple[int, np.ndarray]] = []
        self.last: _Point | None = None
        self.grid: _Grid | None = None

    def _pooled(self, channel: str, parts: Sequence[np.ndarray]) -> float:
        """rms of a channel's column over all logs that have it, where it counts."""
        found = []
        for log, part in zip(self.simulator.logs, parts, strict=True):
            if channel in log.channels:
                i = log.channels.index(channel)
                found.append(part[log.counts[:, i], i])
        return rms(np.concatenate(found))

    def _per(self, sizes: Mapping[str, float], log: Log) -> np.ndarray:
        return np.array([sizes[channel] for channel in log.channels])

    def residuals(
        self,
        thetas: Sequence[np.ndarray],
        chosen: Sequence[int] | None = None,
        rough: bool = False,
    ) -> list[list[np.ndarray] | None]:
        """Residuals simulated − recorded [SI] by vector and log, from the present starts; None
        where a log could not be simulated. ``rough`` ones are good for a look.
        """
        values = [self._values(x) for x in thetas]
        rows = self.simulator.simulate(values, chosen, self.shifts, rough)
        logs = self.simulator.chosen(chosen)
        return [
            None
            if any(one is None for one in row)
            else [self._left(*pair) for pair in zip(logs, row, strict=True)]
            for row in rows
        ]

    def _values(self, theta: np.ndarray) -> list[float]:
        return [c.at(x) for c, x in zip(self.search, theta, strict=True)]

    def _left(self, log: Log, simulated: np.ndarray | None) -> np.ndarray:
        """Residual of a log [SI], low-passed, zero where it does not count; a failed simulation
        counts ten spreads.
        """
        if simulated is None:
            return np.tile(10.0 * self._per(self.spread, log), (len(log.recorded), 1)) * log.counts
        most = FARTHEST * self._per(self.spread, log)
        left = np.clip(simulated - log.recorded, -most, most)
        left = lowpass(left, log.record.sample_time, self.cutoff) if self.cutoff else left
        return left * log.counts

    def _at(self, theta: np.ndarray, shifts: Shifts) -> _Point:
        """The residuals at a point, in the steps of the integration chosen last if that was near;
        the last one is remembered.
        """
        logs, values, last, grid = self.simulator.logs, self._values(theta), self.last, self.grid
        grid = grid if grid is not None and grid.of(logs, self.coarse) else None
        if last is not None and grid is not None and last.grid is grid:
            same = zip([last.theta, *last.shifts], [theta, *shifts], strict=True)
            if all(np.array_equal(*pair) for pair in same):
                return last
        if grid is None or not grid.serves(theta, shifts):
            row, meshes = self.simulator.begin(values, shifts, self.coarse)
            grid = self.grid = _Grid(theta, shifts, logs, meshes, self.coarse)
        else:
            points = [(values, k, own) for k, own in enumerate(shifts)]
            row = self.simulator.each(points, grid.meshes)
        left = [self._left(*pair) for pair in zip(logs, row, strict=True)]
        self.last = _Point(theta, shifts, left, grid)
        return self.last

    def scaled(
        self, parts: Sequence[np.ndarray], chosen: Sequence[int] | None = None
    ) -> list[np.ndarray]:
        """Residuals divided by their channels' scales."""
        return [
            part / self._per(self.scales, log)
            for part, log in zip(parts, self.simulator.chosen(chosen), strict=True)
        ]

    def slopes(self, here: _Point, which: Sequence[int]) -> list[np.ndarray]:
        """Scaled sensitivities by log, shape (samples, channels, parameters), by differences that
        stay inside the bounds and where the rig is possible; zero where a parameter has been seen
        to change nothing in a log.
        """
        logs, known = self.simulator.logs, here.slopes
        every = [(i, k) for i in which for k in range(len(logs))]
        asked = [pair for pair in every if pair not in known and self.touches[pair]]
        for side in (1.0, -1.0):
            steps = {i: side * self._inward(here.theta, i) * DIFFERENCE for i in which}
            points = []
            for i, k in asked:
                theta = here.theta + steps[i] * np.eye(len(here.theta))[i]
                points.append((self._values(theta), k, here.shifts[k]))
            done = zip(asked, self.simulator.each(points, here.grid.meshes), strict=True)
            for (i, k), simulated in done:
                if simulated is not None:
                    known[i, k] = (self._left(logs[k], simulated) - here.left[k]) / steps[i]
            # where there is no such rig, the other side is asked
            asked = [pair for pair in asked if pair not in known]
        return [
            _stacked([known.get((i, k)) for i in which], left)
            / self._per(self.scales, log)[:, None]
            for k, (log, left) in enumerate(zip(logs, here.left, strict=True))
        ]

    def _inward(self, theta: np.ndarray, i: int) -> float:
        """The side on which a parameter has room for a difference."""
        return 1.0 if theta[i] + DIFFERENCE <= self.search[i].bounds[1] else -1.0

    def nudges(self, here: _Point) -> list[np.ndarray]:
        """Scaled sensitivities to where each log starts, shape (samples, channels, nuisances); zero
        for logs that begin at rest while the search is coarse.
        """
        logs, known, values = self.simulator.logs, here.nudges, self._values(here.theta)
        asked = [
            (k, j, doubt.share)
            for k, log in enumerate(logs)
            for j, doubt in enumerate(log.start.doubts)
            if (log.start.moves or not self.coarse) and (k, j) not in known
        ]
        points = [
            (values, k, here.shifts[k] + share * np.eye(len(here.shifts[k]))[j])
            for k, j, share in asked
        ]
        done = self.simulator.each(points, here.grid.meshes)
        for (k, j, share), simulated in zip(asked, done, strict=True):
            if simulated is not None:
                known[k, j] = (self._left(logs[k], simulated) - here.left[k]) / share
        return [
            _stacked([known.get((k, j)) for j in range(len(log.start.doubts))], left)
            / self._per(self.scales, log)[:, None]
            for k, (log, left) in enumerate(zip(logs, here.left, strict=True))
        ]

    def scan(self) -> list[np.ndarray]:
        """A coarse look over bulk modulus and damping together, then over each other positive
        parameter without a prior, on one log for each set of cylinders asked: least squares from
        far off could lock on to the wrong cycle of the ringing. The best that it met first, then
        the bottoms of other basins that are not much worse."""
        chosen = self._first_logs()
        bulk, damping = (
            [i for i in self.free if self.search[i].row.rings == what and self.search[i].log]
            for what in ("frequency", "decay")
        )
        others = [
            [i]
            for i, c in enumerate(self.search[: self.asked])
            if c.log and not c.known and i not in (*bulk, *damping)
        ]
        rivals: list[tuple[float, np.ndarray]] = []
        best = math.inf
        for group in [bulk, *others] if bulk else others:
            vectors, losses = self._looks(group, damping if group is bulk else [])
            costs = self._costs(vectors, chosen)
            at = int(np.argmin(costs))
            self.theta, best = vectors[at], float(costs[at])
            self.looked.append((max(group, default=0), self.theta))
            valley = np.min(costs[losses:].reshape(-1, losses), axis=1)
            bottoms = np.flatnonzero((valley[1:-1] < valley[:-2]) & (valley[1:-1] < valley[2:]))
            for k in bottoms + 1:
                own = losses + k * losses + int(np.argmin(costs[losses + k * losses :][:losses]))
                if not np.array_equal(vectors[own], vectors[at]):
                    rivals.append((float(costs[own]), vectors[own]))
        near = sorted((cost, k) for k, (cost, _) in enumerate(rivals) if cost < RIVAL * best)
        return [self.theta, *(rivals[k][1] for _, k in near[:RIVALS])]

    def _first_logs(self) -> list[int]:
        """One log for each set of cylinders asked."""
        first: dict[tuple[str, ...], int] = {}
        for i, log in enumerate(self.simulator.logs):
            first.setdefault(log.asked, i)
        return list(first.values())

    def _costs(self, vectors: Sequence[np.ndarray], chosen: Sequence[int]) -> np.ndarray:
        """Squares of what is left at some points, over some logs; a step of the journal."""
        known = self.journal.begin("look", *self._stands(), np.array(vectors).tobytes(), chosen)
        if "costs" in known:
            self.simulator.evaluations = known["evaluations"]
            return np.array(known["costs"])
        costs = [
            math.inf
            if parts is None
            else sum(float(np.sum(part**2)) for part in self.scaled(parts, chosen))
            for parts in self.residuals(vectors, chosen, rough=True)
        ]
        best = vectors[int(np.argmin(costs))]
        self.journal.keep(self._standing(best), costs=costs, evaluations=self.simulator.evaluations)
        return np.array(costs)

    def _stands(self) -> tuple[object, ...]:
        """All that a step of the search starts from, for the journal."""
        logs, grid = self.simulator.logs, self.grid
        names = [(c.name, c.bounds, c.start) for c in self.search]
        sizes = sorted(self.scales.items())
        held = (
            self.free,
            sizes,
            self.weight,
            self.coarse,
            grid is not None and grid.of(logs, self.coarse),
            [log.counts.shape for log in logs],
        )
        chosen = () if grid is None else (grid.theta, *grid.shifts)
        at = (self.theta, self.touches, *self.shifts, *chosen)
        return (names, held, *(own.tobytes() for own in at))

    def _standing(self, theta: np.ndarray) -> dict[str, object]:
        """Where the search stands, for who reads the journal: evaluations, and parameters [SI]."""
        values = dict(zip((c.name for c in self.search), self._values(theta), strict=True))
        asked = {c.name: values[c.name] for c in self.search[: self.asked]}
        return {"evaluations": self.simulator.evaluations, "parameters": asked}

    def _looks(self, group: Sequence[int], damping: Sequence[int]) -> tuple[list[np.ndarray], int]:
        """(points of a look along a group of parameters, from here and then from one end to the
        other, how many dampings it takes at each).
        """
        low, high = np.array([c.bounds for c in self.search]).T
        some = list(group)
        ends = (
            max(-SCAN, max(low[some] - self.theta[some])),
            min(SCAN, min(high[some] - self.theta[some])),
        )
        count = FINER if self.search[some[0]].row.rings != "frequency" else COARSE
        losses = (0.0, -1.4, 1.4) if damping else (0.0,)
        vectors = []
        for shift in (0.0, *np.linspace(*ends, count)):
            for loss in losses:
                theta = self.theta.copy()
                theta[some] += shift
                theta[list(damping)] += loss
                vectors.append(np.clip(theta, low + 1e-6, high - 1e-6))
        return vectors, len(losses)

    def cost(self, point: _Point) -> float:
        """What is minimised: scaled residuals and what priors are missed by, squared."""
        left = sum(float(np.sum(part**2)) for part in self.scaled(point.left))
        known = sum(float(np.sum(own**2)) for own in point.shifts)
        known += float(np.sum((self.sharpness * (point.theta - self.centre)) ** 2))
        return left + self.weight * known

    def solve(self, tolerance: float) -> bool:
        """Move ``theta`` over the free parameters, and the logs' starts, to the minimum; whether it
        converged.

        Levenberg's and Marquardt's descent within the bounds, each log's start eliminated from its
        normal equations (`covariance.eliminate`)."""
        free = np.array(self.free, dtype=int)
        bounds = np.array([self.search[i].bounds for i in free]).reshape(-1, 2)
        known = self.journal.begin("descent", tolerance, *self._stands())
        if "ended" in known and known["left"]:
            return self._skipped(known)
        here, way = self._begun(known)
        for done in range(way.done, self.most):
            self.iterations += 1
            self.tell("output error: fitting", self.iterations / (self.iterations + 6.0))
            slopes = self.slopes(here, self.free)
            if way.nudges is None or not way.faithful:
                way.nudges, way.origin = self.nudges(here), here
            blocks = self._blocks(here, slopes, way.nudges)
            cost = self.cost(here)
            while True:
                step, gain = self._step(here, blocks, free, bounds, way.damping)
                if gain <= tolerance * cost:
                    return self._ended(True)
                there = self._at(*step)
                self.tell("output error: fitting", self.iterations / (self.iterations + 6.0))
                won = cost - self.cost(there)
                if won > 0.0:
                    break
                way.damping *= HARDER
                if way.damping > MOST_DAMPING:
                    return self._ended(True)
            way.faithful = abs(won - gain) < FAITHFUL * gain
            if won > 0.25 * gain:
                way.damping = max(way.damping * EASIER, LEAST_DAMPING)
            here, self.theta, self.shifts = there, there.theta, there.shifts
            way.done = done + 1
            self._keep(way, here)
        return self._ended(False)

    def _begun(self, known: Mapping[str, Any]) -> tuple[_Point, _Way]:
        """Where a descent begins, or goes on after its last step that the journal knows."""
        if "done" not in known:
            return self._at(self.theta, self.shifts), _Way()
        way = _Way(known["damping"], known["faithful"], known["done"])
        if way.faithful:
            way.origin = self._at(*self._placed(known["origin"]))
            way.nudges = self.nudges(way.origin)
        self.theta, self.shifts = self._placed(known)
        here = self._at(self.theta, self.shifts)
        self.iterations, self.simulator.evaluations = known["count"]
        return here, way

    def _placed(self, kept: Mapping[str, Any]) -> tuple[np.ndarray, Shifts]:
        """(parameters, shifts) of a point that the journal kept, its steps chosen as they were."""
        self._choose(kept["chosen"])
        return _placed(kept)

    def _choose(self, kept: Mapping[str, Any]) -> None:
        """Choose the integration's steps where the journal says they were."""
        theta, shifts = _placed(kept)
        logs, count = self.simulator.logs, self.simulator.evaluations
        _, meshes = self.simulator.begin(self._values(theta), shifts, self.coarse)
        self.simulator.evaluations = count
        self.grid = _Grid(theta, shifts, logs, meshes, self.coarse)

    def _keep(self, way: _Way, here: _Point) -> None:
        """Write a step of a descent into the journal."""
        assert way.origin is not None  # a step has been taken
        self.journal.keep(
            self._standing(self.theta),
            **_kept(here),
            origin=_kept(way.origin),
            damping=way.damping,
            faithful=bool(way.faithful),
            done=way.done,
            count=[self.iterations, self.simulator.evaluations],
        )

    def _ended(self, converged: bool) -> bool:
        """Write the end of a descent into the journal; whether it converged."""
        count = [self.iterations, self.simulator.evaluations]
        assert self.grid is not None  # a point has been simulated
        chosen = _place(self.grid.theta, self.grid.shifts)
        self.journal.keep(self._standing(self.theta), ended=converged, counted=count, chosen=chosen)
        return converged

    def _skipped(self, known: Mapping[str, Any]) -> bool:
        """Stand where a descent ended that the journal knows; whether it converged."""
        if "done" in known:
            self.theta, self.shifts = _placed(known)
        self._choose(known["chosen"])
        self.iterations, self.simulator.evaluations = known["counted"]
        return known["ended"]

    def _blocks(
        self, here: _Point, slopes: Sequence[np.ndarray], nudges: Sequence[np.ndarray]
    ) -> list[Block]:
        each = zip(
            self.simulator.logs, slopes, nudges, self.scaled(here.left), here.shifts, strict=True
        )
        return [Block(log.channels, *rest) for log, *rest in each]

    def _prior(self, theta: np.ndarray, which: Sequence[int]) -> Prior:
        some = np.array(which, dtype=int)
        return Prior(self.sharpness[some], (theta - self.centre)[some], self.weight)

    def _step(
        self,
        here: _Point,
        blocks: Sequence[Block],
        free: np.ndarray,
        bounds: np.ndarray,
        damping: float,
    ) -> tuple[tuple[np.ndarray, Shifts], float]:
        """((theta, shifts) after a step, what it should gain of the cost)."""
        solved = [eliminate(block, self.weight) for block in blocks]
        prior, count = self._prior(here.theta, free.tolist()), len(free)
        normal = np.sum([one.normal for one in solved], axis=0) + prior.normal
        pull = np.sum([one.gradient for one in solved], axis=0) + prior.gradient
        theta, move = here.theta.copy(), np.zeros(count)
        if count:
            move = bounded_step(normal, pull, damping, *(bounds - theta[free][:, None]).T)
            theta[free] = np.clip(theta[free] + move, *bounds.T)
        shifts, gain = [], -float(2.0 * pull @ move + move @ normal @ move)
        for own, one, block in zip(here.shifts, solved, blocks, strict=True):
            shifts.append(own + one.move - one.gain @ move)
            inner = np.einsum("tcn,tc->n", block.nudges, block.left) + self.weight * own
            gain -= float(inner @ one.move)
        return (theta, shifts), gain

    def fit(self) -> HydraulicsFit:
        whole = self.simulator.logs
        heads = tuple(log.head(HEAD) for log in whole)
        heads = whole if all(map(operator.is_, heads, whole)) else heads
        self.simulator.logs = heads
        self.tell("output error: looking over the range of the bulk modulus", 0.0)
        self.arrive()
        self.simulator.logs = whole
        here = self._at(self.theta, self.shifts)
        self._weigh(here, scales=False)
        slopes = self.slopes(here, self.free)
        self.coarse = False
        effects = self._effects(slopes, self.free)
        for k, part in enumerate(slopes):
            sizes = self._effects([part], self.free, [k])
            for i, size in sizes.items():
                self.touches[i, k] = size > NOTHING * effects[i]
        self._range([i for i, size in effects.items() if size < FAINT])
        converged = self._settle(1e-6)
        self.free, self.ranged = sorted({*self.free, *self.ranged}), {}
        for _ in range(self.fitted):
            found = self._errors()
            lost = [i for i, error in found.by_index.items() if error.kind == "not_excited"]
            near = self._near_bounds(found.by_index)
            if not lost and not near:
                break
            self._range(lost)
            self._hold({i: bound for i, bound in near.items() if i not in lost})
            converged = self._settle(1e-6)
        else:
            found = self._errors()
        self.tell("output error: done", 1.0)
        return self._result(found, converged)

    def _arrive(self, starts: Sequence[np.ndarray], begin: np.ndarray) -> np.ndarray:
        """The best that a coarse solution comes to from some starts; where these leave much, no
        worse than what fewer parameters come to (`_chain`, `_without`).
        """
        every = self.free
        ends = [self._solved(start, every) for start in starts]
        if len(every) > 1 and all(end.much for end in ends):
            ends += [self._solved(begin, every), self._chain(begin)]
            ends.append(self._without(min(ends, key=_by_misfit)))
        return min(ends, key=_by_misfit).theta

    def _chain(self, begin: np.ndarray) -> _End:
        """Where solutions over ever more of the parameters end, in their order: each begins where
        the one before ended and where the look stood, so none ends worse than one over fewer.
        """
        every = self.free
        end = self._solved(begin, every[:1])
        for count in range(1, len(every) + 1):
            some = every[:count]
            look = [theta for last, theta in self.looked if last <= some[-1]][-1:]
            if look:
                start = begin.copy()
                start[some] = look[0][some]
                end = min(end, self._solved(start, some), key=_by_misfit)
            end = min(end, self._solved(end.theta, some), key=_by_misfit)
        return end

    def _without(self, end: _End) -> _End:
        """A solution held against those in which one of its parameters stays at its start: where
        one of these ends better, all go on from there.
        """
        every = self.free
        for i in every:
            start = end.theta.copy()
            start[i] = self.search[i].begin
            rest = self._solved(start, [k for k in every if k != i])
            if rest.misfit < end.misfit:
                end = min(rest, self._solved(rest.theta, every), key=_by_misfit)
        return end

    def _solved(self, start: np.ndarray, free: list[int]) -> _End:
        """Where a coarse solution over some of the free parameters ends; first every channel counts
        by its spread, then by what is left of it.
        """
        every = self.free
        self.theta, self.shifts = start, self.simulator.unshifted()
        self.scales = dict(self.spread)
        here = self._at(start, self.shifts)
        self._weigh(here, scales=False)
        effects = self._effects(self.slopes(here, free), free)
        self.free = [i for i in free if effects[i] >= FAINT]
        self.solve(1e-3)
        here = self._at(self.theta, self.shifts)
        much = self._squares(here) > MUCH * sum(part.size for part in here.left)
        if much:
            self._weigh(here)
            self.solve(1e-3)
            here = self._at(self.theta, self.shifts)
        self.free, self.scales = every, dict(self.spread)
        return _End(self._misfit(here), much, self.theta)

    def _squares(self, here: _Point) -> float:
        """Squares of what is left, in units of the scales."""
        return sum(float(np.sum(part**2)) for part in self.scaled(here.left))

    def _misfit(self, here: _Point) -> float:
        """Logarithms of the mean squares that are left of the channels, which weighing them by what
        is left makes least; below the floor of the scales straight.
        """
        found = 0.0
        for channel, spread in self.spread.items():
            share = (self._pooled(channel, here.left) / (SCALE_FLOOR * spread)) ** 2
            found += math.log(share) if share > 1.0 else share - 1.0
        return found

    def arrive(self) -> None:
        """Coarsely to the best that a look over the range of the parameters leads to, or that lies
        near where they start.
        """
        begin = self.theta
        self.theta = self._arrive(self.scan(), begin)

    def descend(self, begin: Mapping[str, float]) -> float:
        """Coarsely from some values, by name, to the nearest minimum, each channel weighed by what
        is left of it; returns that minimum's cost, whatever its weights.
        """
        self._stand(begin)
        self._solved(self.theta, self.free)
        self._weigh(self._at(self.theta, self.shifts))
        self.solve(1e-3)
        return self._level(self._at(self.theta, self.shifts).left)

    def foreseen(self, begin: Mapping[str, float]) -> float:
        """What `descend` would come to if all were as linear as it is at its start."""
        self._stand(begin)
        self.shifts = self.simulator.unshifted()
        here = self._at(self.theta, self.shifts)
        self._weigh(here)
        free = np.array(self.free, dtype=int)
        blocks = self._blocks(here, self.slopes(here, self.free), self.nudges(here))
        bounds = np.array([self.search[i].bounds for i in free]).reshape(-1, 2)
        (theta, shifts), _ = self._step(here, blocks, free, bounds, LEAST_DAMPING)
        move = (theta - here.theta)[free]
        left = [
            (block.left + block.slopes @ move + block.nudges @ (own - old))
            * self._per(self.scales, log)
            for block, log, own, old in zip(
                blocks, self.simulator.logs, shifts, here.shifts, strict=True
            )
        ]
        return self._level(left)

    def _stand(self, begin: Mapping[str, float]) -> None:
        """Go to some values, by name, inside the bounds."""
        for i, c in enumerate(self.search):
            if c.name in begin:
                low, high = c.bounds
                margin = 1e-3 * c.reach
                value = c.of(max(begin[c.name], c.lower))
                self.theta[i] = min(max(value, low + margin), high - margin)

    def _level(self, left: Sequence[np.ndarray]) -> float:
        """Logarithms of the mean squares of residuals [SI], added up over the channels."""
        return sum(2.0 * math.log(max(self._pooled(c, left), 1e-300)) for c in self.spread)

    def named(self) -> dict[str, float]:
        """Where the search stands, by name; of sensors their excess."""
        return dict(zip((c.name for c in self.search), self._values(self.theta), strict=True))

    def beside(self, logs: Sequence[Log]) -> list[np.ndarray]:
        """Residuals of these logs [SI] in place of the search's own, of which other samples count,
        where it stands; shape (samples, channels).
        """
        row = self.simulator.simulate([self._values(self.theta)], None, self.shifts)[0]
        return [self._left(*pair) for pair in zip(logs, row, strict=True)]

    def _settle(self, tolerance: float) -> bool:
        """Weigh and solve until the weights stand; whether it converged."""
        converged = False
        for _ in range(ROUNDS):
            before = dict(self.scales)
            self._weigh(self._at(self.theta, self.shifts))
            change = max(abs(math.log(self.scales[c] / before[c])) for c in before)
            if converged and change < STANDS:
                break
            converged = self.solve(tolerance)
        return converged

    def _weigh(self, here: _Point, scales: bool = True) -> None:
        """Scales of the channels, and the weight of priors beside them, by what is left."""
        if scales:
            for channel, spread in self.spread.items():
                self.scales[channel] = max(self._pooled(channel, here.left), SCALE_FLOOR * spread)
        self.weight = prior_weight(self.scaled(here.left))

    def _effects(
        self,
        slopes: Sequence[np.ndarray],
        which: Sequence[int],
        chosen: Sequence[int] | None = None,
    ) -> dict[int, float]:
        """Largest rms change of a channel in a log when one of the parameters ``which`` moves by
        its unit, as a share of the channel's spread.
        """
        ratio = [
            self._per(self.scales, log) / self._per(self.spread, log)
            for log in self.simulator.chosen(chosen)
        ]
        each = [
            np.sqrt(np.mean(part**2, axis=0)) * r[:, None]
            for part, r in zip(slopes, ratio, strict=True)
        ]
        return dict(zip(which, np.max(np.concatenate(each), axis=0), strict=True))

    def _range(self, which: Sequence[int]) -> None:
        """Ask the whole range of parameters whose effect here is faint: go where the logs would
        have them, hold those of which they deny a part, drop those of which they say nothing.
        """
        dropped = []
        for i in which:
            self.bound = [k for k in self.bound if k != i]
            self.free = sorted({*self.free, i})
            here = self._at(self.theta, self.shifts)
            points = np.linspace(*self.search[i].bounds, RANGE)
            rises, effect = self._rises(here, i, points)
            denied = DENIED * self.weight
            if effect < FAINT or np.max(rises) < denied:
                dropped.append(i)
            elif np.min(rises) < -denied and self._gone(here, i, float(points[np.argmin(rises)])):
                self.ranged.pop(i, None)
            else:
                self.free = [k for k in self.free if k != i]
                self.ranged[i] = self._ends(here, i, points, rises)
        self._drop(dropped)

    def _rises(self, here: _Point, i: int, points: np.ndarray) -> tuple[np.ndarray, float]:
        """(by how much the cost is higher with a parameter at some points than where it is, the
        others following to first order; its largest effect, as `_effects`).
        """
        others = [k for k in self.free if k != i]
        bounds = np.array([self.search[k].bounds for k in others]).reshape(-1, 2)
        slopes, nudges = self.slopes(here, others), self.nudges(here)
        rises, effect = np.zeros(len(points)), 0.0
        scaled = self.scaled(here.left)
        for at, value in enumerate(points):
            theta = here.theta.copy()
            theta[i] = value
            moved = self.residuals([theta])[0]
            if moved is None:
                rises[at] = math.inf
                continue
            there = replace(here, theta=theta, left=moved)
            blocks = self._blocks(there, slopes, nudges)
            gain = self._step(there, blocks, np.array(others, dtype=int), bounds, 0.0)[1]
            rises[at] = self.cost(there) - gain - self.cost(here)
            change = [(a - b)[..., None] for a, b in zip(self.scaled(moved), scaled, strict=True)]
            effect = max(effect, self._effects(change, [i])[i])
        return rises, effect

    def _gone(self, here: _Point, i: int, value: float) -> bool:
        """Whether a solution that begins with a parameter at another value ends better than here,
        where the search goes then.
        """
        self.theta = here.theta.copy()
        self.theta[i] = value
        self.solve(1e-3)
        if self.cost(self._at(self.theta, self.shifts)) < self.cost(here):
            return True
        self.theta, self.shifts = here.theta, here.shifts
        return False

    def _ends(
        self, here: _Point, i: int, points: np.ndarray, rises: np.ndarray
    ) -> tuple[float, float]:
        """Between which values the logs do not deny a parameter; the bounds where they never do."""
        ends = []
        for side in (-1, 1):
            beyond = [k for k in range(RANGE) if (points[k] - here.theta[i]) * side > 0.0]
            inner, outer = float(here.theta[i]), None
            for k in beyond[::side]:
                if rises[k] > DENIED * self.weight:
                    outer = float(points[k])
                    break
                inner = float(points[k])
            for _ in range(HALVINGS if outer is not None else 0):
                middle = 0.5 * (inner + float(outer or 0.0))
                rise = self._rises(here, i, np.array([middle]))[0][0]
                inner, outer = (inner, middle) if rise > DENIED * self.weight else (middle, outer)
            ends.append(self.search[i].bounds[side > 0] if outer is None else outer)
        return ends[0], ends[1]

    def _drop(self, which: Sequence[int]) -> None:
        """Put parameters back to their start and leave them out.

        Raises:
            InsufficientData: none is left.
        """
        for i in which:
            self.theta[i] = self.search[i].of(self.search[i].start)
        self.free = [i for i in self.free if i not in which]
        self.bound = [i for i in self.bound if i not in which]
        if not any(i < self.asked for i in (*self.free, *self.bound, *self.ranged)):
            names = ", ".join(c.name for c in self.search[: self.asked])
            raise InsufficientData(
                f"the logs tell nothing about {names}",
                hint="use logs in which the commands excite them",
            )

    def _near_bounds(self, errors: Mapping[int, _Error]) -> dict[int, float]:
        """Bounds, by index, that free parameters come near and that their intervals do not exclude:
        the cost grows by less than 3.84 correlation times there.
        """
        found = {}
        for i in self.free:
            c, error = self.search[i], errors.get(i)
            if error is None:
                continue
            for bound in c.bounds:
                off = abs(self.theta[i] - bound)
                if 0.0 < off < min(NEAR * c.reach, error.quantile * error.std):
                    found[i] = bound
        return found

    def _hold(self, at: Mapping[int, float]) -> None:
        """Put parameters on their bounds and leave them there."""
        for i, bound in at.items():
            self.theta = self.theta.copy()
            self.theta[i] = bound
            self.free.remove(i)
            self.bound.append(i)

    def _errors(self) -> _Errors:
        """Standard errors of the parameters in search coordinates, and what they mean; all of them
        as if none were held at a bound.
        """
        live = sorted(self.free + self.bound)
        here = self._at(self.theta, self.shifts)
        slopes = self.slopes(here, live)
        blocks = self._blocks(here, slopes, self.nudges(here))
        found = covariance_of(blocks, self._prior(self.theta, live))
        effects, correlation = self._effects(slopes, live), found.correlation
        inside = [k for k, i in enumerate(live) if not self._at_bound(i)]
        result = {}
        for k, i in enumerate(live):
            std, quantile, source = found.error(k)
            vague = VAGUE[self.search[i].log]
            others = np.abs(correlation[k, [j for j in inside if j != k]])
            if effects[i] < FAINT or found.alone[k] > vague:
                kind = "not_excited"
            elif k not in inside:
                kind = "at_bound"
            elif std > vague or np.max(others, initial=0.0) > CORRELATED:
                kind = "correlated"
            else:
                kind = "estimated"
            result[i] = _Error(
                std, quantile, source, kind, *map(float, (found.from_data[k], found.from_starts[k]))
            )
        names = tuple(self.search[live[k]].name for k in inside)
        among = correlation[np.ix_(inside, inside)]
        return _Errors(result, names, among, here, blocks, found.hac, found.alone)

    def _wrongly_held(self, found: _Errors) -> list[str]:
        """A warning of the held parameter whose release would better the fit most, if it is surely
        wrong: the recipe's line that frees it.
        """
        live, suspects = sorted(self.free + self.bound), []
        for i in range(self.fitted, len(self.search)):
            c, blocks = self.search[i], self._released(found, i)
            if not blocks:
                continue
            least = WORTH * self.cost(found.here)
            release = release_of(blocks, self._prior(found.here.theta, [*live, i]), least)
            share = 1.0 if c.log else c.unit / c.start
            off, less = abs(release.move), release.gain / self.cost(found.here)
            if off * share > SURELY_OFF and off > SURELY * release.std:
                suspects.append((less, share * release.move, share * release.std, c.name))
        if not suspects:
            return []
        less, move, std, name = max(suspects)
        return [
            f"{name} is held, and these logs would have it {100.0 * move:+.1f} ± "
            f"{100.0 * std:.1f} % off: what is left would fall by {100.0 * less:.0f} %. "
            f'Add "{name}" to parameters, with [prior] "{name}" = "3 %"'
        ]

    def _released(self, found: _Errors, i: int) -> list[Block]:
        """What the logs say, with a held parameter behind those that are fitted; nothing where it
        changes nothing.
        """
        logs = self.simulator.logs
        which = [k for k, log in enumerate(logs) if _concerns(log, self.search[i])]
        theta = found.here.theta + DIFFERENCE * np.eye(len(self.search))[i]
        moved = (self.residuals([theta], which)[0] or []) if which else []
        added = [np.zeros((*block.left.shape, 1)) for block in found.blocks]
        for k, left in zip(which, moved, strict=False):
            scale = self._per(self.scales, logs[k])
            added[k][..., 0] = (left - found.here.left[k]) / (DIFFERENCE * scale)
        if self._effects(added, [i])[i] < FAINT:
            return []
        return [
            replace(block, slopes=np.concatenate([block.slopes, slope], axis=-1))
            for block, slope in zip(found.blocks, added, strict=True)
        ]

    def _groups(self, found: _Errors) -> tuple[Group, ...]:
        """The products of parameters that the logs know though they do not know each."""
        live = sorted(self.free + self.bound)
        normal = np.sum([eliminate(b, self.weight).normal for b in found.blocks], axis=0)
        logs = [k for k, i in enumerate(live) if i < self.asked and self.search[i].log]
        rest = [k for k in range(len(live)) if k not in logs]
        if len(logs) < 2:
            return ()
        inner = np.linalg.pinv(normal[np.ix_(rest, rest)])
        own = normal[np.ix_(logs, logs)]
        own = own - normal[np.ix_(logs, rest)] @ inner @ normal[np.ix_(rest, logs)]
        ideal = np.sqrt(1.0 / np.maximum(np.diag(normal), 1e-300))
        widening = [found.alone[k] / ideal[k] for k in logs]
        names = [self.search[live[k]].name for k in logs]
        values = [self.search[live[k]].at(self.theta[live[k]]) for k in logs]
        return groups_of(names, values, own, float(np.median(widening)))

    def settle_starts(self, values: Sequence[float]) -> None:
        """Stand at given values [SI] of the parameters searched; each log's start, its sensors and
        the channels' scales settled there.
        """
        self.coarse, self.free = False, list(range(self.asked, self.fitted))
        self.theta[: self.asked] = [c.of(x) for c, x in zip(self.search, values, strict=False)]
        for _ in range(2):
            self.solve(1e-4)
            self._weigh(self._at(self.theta, self.shifts))

    def held_at(self, i: int, theta: float) -> tuple[float, dict[str, float]]:
        """(least cost with a parameter held at a value of its search coordinate, the values [SI] of
        all there by name), from where the search stands, which moves there.
        """
        free = self.free
        self.free = [k for k in free if k != i]
        self.theta = self.theta.copy()
        self.theta[i] = theta
        self.solve(1e-7)
        self.free = free
        values = self._values(self.theta)[: self.asked]
        names = [c.name for c in self.search[: self.asked]]
        cost = self.cost(self._at(self.theta, self.shifts))
        return cost, dict(zip(names, values, strict=True))

    def said(self) -> tuple[list[Block], Prior]:
        """What each log says of the parameters searched and of shared sensors where the fit stands,
        and what is known of them beside.
        """
        here, which = self._at(self.theta, self.shifts), list(range(self.fitted))
        blocks = self._blocks(here, self.slopes(here, which), self.nudges(here))
        return blocks, self._prior(self.theta, which)

    def _at_bound(self, i: int) -> bool:
        return i in self.bound or self.theta[i] in self.search[i].bounds

    def _result(self, found: _Errors, converged: bool) -> HydraulicsFit:
        samples = sum(int(log.counts.any(axis=1).sum()) for log in self.simulator.logs)
        fitted = []
        for i, c in enumerate(self.search[: self.asked]):
            one, error = not_excited(c, samples), found.by_index.get(i)
            if error is not None and error.kind != "not_excited":
                std, ends = c.spread(self.theta[i], error.std, error.quantile)
                one = replace(
                    one,
                    value=c.at(self.theta[i]),
                    std=std,
                    interval=ends,
                    status=error.kind,
                    error_from=error.source,
                    prior=c.prior if c.known else None,
                    from_data=error.from_data,
                    from_starts=error.from_starts,
                )
            fitted.append(self._within(one, i) if i in self.ranged else one)
        warnings = [*self._wrongly_held(found), *self._flat()]
        if not converged:
            warnings.append(
                f"the fit stopped after {self.most} evaluations without converging; its numbers "
                "are not final"
            )
        groups = self._groups(found)
        warnings += [sentence(groups)] if groups else []
        told = [one.alone.keys() for one in groups]
        for a, name in enumerate(found.names):
            for b, other in enumerate(found.names[:a]):
                if any({name, other} <= names for names in told):
                    continue  # the group says it
                if abs(found.correlation[a, b]) > CORRELATED:
                    warnings.append(
                        f"{other} and {name} are correlated by {found.correlation[a, b]:+.3f}: "
                        "the logs tell them only together"
                    )
        return finish(
            self.simulator,
            Estimate(
                method="output_error",
                fitted=fitted,
                warnings=warnings,
                iterations=self.iterations,
                names=found.names,
                correlation=found.correlation,
                scales=self.scales,
                cutoff=self.cutoff,
                shifts=self.shifts,
                groups=groups,
                held=[
                    *(c.at(self.theta[i]) for i, c in self._shared()),
                    *(c.start for c in self.search[self.fitted :]),
                ],
                sensors=self._sensors(found),
            ),
        )

    def _within(self, one: FittedParameter, i: int) -> FittedParameter:
        """A parameter of which the logs deny a part of the range, the rest being one to them."""
        c, value = self.search[i], self.search[i].at(self.theta[i])
        low, high = (c.at(end) for end in self.ranged[i])
        return replace(
            one,
            value=value,
            std=(high - low) / (2.0 * Z95),
            interval=(low, high),
            status="estimated",
            error_from="range",
            prior=c.prior if c.known else None,
        )

    def _flat(self) -> list[str]:
        """A note of each parameter that the logs tell by its range alone."""

        def said(c: Coordinate, value: float) -> str:
            own = c.quantity is None  # else of a sensor
            return self.simulator.rig.shown(c.name, value) if own else f"{value:.4g} {c.row.unit}"

        return [
            f"{c.name} may be anything from {said(c, c.at(low))} to {said(c, c.at(high))} for "
            "these logs, which deny the rest of its range"
            for i, (low, high) in self.ranged.items()
            for c in [self.search[i]]
        ]

    def _shared(self) -> list[tuple[int, Coordinate]]:
        """(index, coordinate) of what all logs' sensors share."""
        return [(i, self.search[i]) for i in range(self.asked, self.fitted)]

    def _sensors(self, found: _Errors) -> list[SensorFit]:
        """What was found of the sensors: of all logs, then of each."""
        result = []
        terms = {term.name: term for term in self.simulator.logs[0].start.terms}
        for i, c in self._shared():
            error, quantile = found.by_index.get(i), 1.96
            std = terms[c.name].std
            if error is not None:
                std, quantile = c.unit * error.std, error.quantile
            result.append(SensorFit.of(terms[c.name], "", c.at(self.theta[i]), std, quantile))
        for log, shifts, block in zip(self.simulator.logs, self.shifts, found.blocks, strict=True):
            errors = eliminate(block, self.weight).std(found.covariance)
            terms = {term.name: term for term in log.start.terms}
            for doubt, shift, error in zip(log.start.doubts, shifts, errors, strict=True):
                if doubt.name in terms:
                    at, std = doubt.std * float(shift), doubt.std * float(error)
                    result.append(SensorFit.of(terms[doubt.name], log.name, at, std, 1.96))
        return result


@dataclass(frozen=True)
class _Error:
    """A standard error in search coordinates, its interval's quantile, where it is from, what it
    means, the share of what is known of the parameter that is from the data, and the share of its
    variance that the logs' starts are to blame for."""

    std: float
    quantile: float
    source: str
    kind: str
    from_data: float
    from_starts: float


@dataclass(frozen=True, eq=False)
class _Errors:
    """Errors by index of the parameter, and the correlation between the free ones, in the order of
    their names, the point they belong to, what each log says there, the covariance of those that
    are live, and the standard error each would have if all others were known."""

    by_index: dict[int, _Error]
    names: tuple[str, ...]
    correlation: np.ndarray
    here: _Point
    blocks: list[Block]
    covariance: np.ndarray
    alone: np.ndarray


def _by_misfit(end: _End) -> float:
    return end.misfit


def _place(theta: np.ndarray, shifts: Shifts) -> dict[str, Any]:
    """A point as the journal keeps it."""
    return {"theta": theta.tolist(), "shifts": [own.tolist() for own in shifts]}


def _kept(point: _Point) -> dict[str, Any]:
    """A point as the journal keeps it, with where its steps were chosen."""
    grid = point.grid
    return _place(point.theta, point.shifts) | {"chosen": _place(grid.theta, grid.shifts)}


def _placed(kept: Mapping[str, Any]) -> tuple[np.ndarray, Shifts]:
    """(parameters, shifts) of a point that the journal kept."""
    return np.array(kept["theta"]), [np.array(own, dtype=float) for own in kept["shifts"]]


def _stacked(columns: Sequence[np.ndarray | None], like: np.ndarray) -> np.ndarray:
    """Columns side by side along a last axis, zero where there is none."""
    found = [np.zeros_like(like) if one is None else one for one in columns]
    return np.stack(found, axis=-1) if found else np.zeros((*like.shape, 0))


def _concerns(log: Log, c: Coordinate) -> bool:
    """Whether a parameter belongs to a cylinder that the log asks to move."""
    return c.name.partition(".")[0] in log.asked


def bounded_step(
    normal: np.ndarray, pull: np.ndarray, damping: float, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """The step ``d`` within ``low ≤ d ≤ high`` that minimises ``dᵀ(H + λ diag H) d/2 + gᵀd``.

    Args:
        normal: H, shape (n, n), positive semidefinite.
        pull: the gradient g, shape (n,).
        damping: λ.
    """
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / np.outer(size, size) + (damping + 1e-12) * np.eye(len(size))
    values, vectors = np.linalg.eigh(scaled)
    values = np.maximum(values, 1e-13 * values[-1])
    aim = vectors.T @ (pull / size) / np.sqrt(values)
    root = np.sqrt(values)[:, None] * vectors.T
    step = -np.linalg.solve(root, aim)
    if np.any(step < low * size) or np.any(step > high * size):
        from scipy.optimize import lsq_linear  # a quarter of a second to import

        room = (np.minimum(low * size, -1e-12), np.maximum(high * size, 1e-12))
        step = lsq_linear(root, -aim, room, method="bvls").x
    return np.clip(step / size, low, high)
