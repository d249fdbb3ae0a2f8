"""Weighted least squares of simulations over all logs at once, and the descent to a minimum.

The initial state of each log is estimated with the parameters: its uncertain numbers
(`initial_states.Uncertain`) are nuisances of that log alone, eliminated block by block."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ehbench.identification.covariance import Block, Prior, eliminate
from ehbench.identification.journal import Journal
from ehbench.identification.search import Coordinate, of_sensors
from ehbench.identification.simulator import Log, Meshes, Shifts, Simulator
from ehbench.preprocessing.initial_states import prior_weight
from ehbench.signals.series import lowpass, rms
from ehbench.vocabulary.progress import Progress

# a scale's floor as a share of the channel's spread: no sensor makes a channel worth more than that
SCALE_FLOOR = 5.0e-3
# a parameter is not excited if moving it by its unit (a factor e, or its whole range) changes no
# channel by more than this share of the channel's spread, rms
FAINT = 2.0e-3
# step of finite differences, in units of a parameter: over half a minute a larger one bends, and
# where parameters nearly cancel the bend outweighs what they differ by
DIFFERENCE = 1.0e-5
ROUNDS = 8  # of weighing and solving at most
STANDS = 0.03  # share by which scales may still change when a fit stands
# of the descent: damping at first, at least and at most, and what a step changes it by
DAMPING, LEAST_DAMPING, MOST_DAMPING, EASIER, HARDER = 1e-3, 1e-9, 1e9, 0.1, 8.0
FARTHEST = 1.0e6  # spreads that a simulation counts as off at most: squares stay finite
FAITHFUL = 0.25  # share of what a step should gain that may be missed before all is linearised anew
COARSE_SLACK = 100.0  # of the integration's steps while the search is coarse (`Model.paced`)
# steps of the integration are taken again while no parameter is further off, in its units, and no
# start in its standard deviations: costs are compared to a millionth, and chosen steps shift them
SAME_STEPS, SAME_STARTS = 0.02, 1.0


@dataclass(frozen=True, eq=False)
class _Grid:
    """Where the integration's steps were chosen, and those steps by log, of some ``slack``."""

    theta: np.ndarray
    shifts: Shifts
    logs: Sequence[Log]
    meshes: Meshes
    slack: float

    def of(self, logs: Sequence[Log], slack: float) -> bool:
        """Whether its steps are those of some logs, and as long as is asked."""
        return logs is self.logs and slack == self.slack

    def serves(self, theta: np.ndarray, shifts: Shifts) -> bool:
        """Whether a point is so near that its simulations may take the same steps."""
        off = [np.abs(shift - item) for shift, item in zip(shifts, self.shifts, strict=False)]
        return (
            float(np.max(np.abs(theta - self.theta), initial=0.0)) <= SAME_STEPS
            and float(np.max(np.concatenate(off), initial=0.0)) <= SAME_STARTS
        )


@dataclass(frozen=True, eq=False)
class Point:
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


@dataclass
class _Way:
    """A descent under way: its damping, whether the last step gained what it should, the steps
    done, the sensitivities to the logs' starts and the point that they are of.
    """

    damping: float = DAMPING
    faithful: bool = True
    done: int = 0
    nudges: list[np.ndarray] | None = None
    origin: Point | None = None


class Descent:
    """Weighted least squares over all logs; one instance a search.

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
        maximum: int,
        cutoff: float | None,
        watched: Sequence[Coordinate] = (),
        journal: Journal | None = None,
    ) -> None:
        self.journal = journal or Journal()
        sensors = of_sensors(simulator.logs[0].start.terms)
        self.simulator, self.search, self.tell = simulator, [*search, *sensors, *watched], tell
        self.most, self.cutoff = maximum, cutoff
        self.asked, self.fitted = len(search), len(search) + len(sensors)
        search = self.search
        names = sorted({channel for log in simulator.logs for channel in log.channels})
        self.spread = {
            c: self.pooled(
                c, [log.recorded - np.mean(log.recorded, axis=0) for log in simulator.logs]
            )
            for c in names
        }
        self.scales = dict(self.spread)
        self.within = {
            c: self.pooled(
                c, [np.tile(log.within, (len(log.recorded), 1)) for log in simulator.logs]
            )
            for c in names
        }
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
        self.last: Point | None = None
        self.grid: _Grid | None = None

    def pooled(self, channel: str, parts: Sequence[np.ndarray]) -> float:
        """rms of a channel's column over all logs that have it, where it counts."""
        results = []
        for log, part in zip(self.simulator.logs, parts, strict=True):
            if channel in log.channels:
                i = log.channels.index(channel)
                results.append(part[log.counts[:, i], i])
        return rms(np.concatenate(results))

    def per(self, sizes: Mapping[str, float], log: Log) -> np.ndarray:
        """Sizes by channel as those of a log's columns, shape (channels,)."""
        return np.array([sizes[channel] for channel in log.channels])

    def residuals(
        self,
        thetas: Sequence[np.ndarray],
        chosen: Sequence[int] | None = None,
        slack: float = 1.0,
    ) -> list[list[np.ndarray] | None]:
        """Residuals simulated − recorded [SI] by vector and log, from the present starts; None
        where a log could not be simulated; with the ``slack`` of steps that a look may have.
        """
        values = [self.values(x) for x in thetas]
        rows = self.simulator.simulate(values, chosen, self.shifts, slack)
        logs = self.simulator.chosen(chosen)
        return [
            None
            if any(item is None for item in row)
            else [self.left_of(*pair) for pair in zip(logs, row, strict=True)]
            for row in rows
        ]

    @property
    def slack(self) -> float:
        """Of the integration's steps where the search stands."""
        return COARSE_SLACK if self.coarse else 1.0

    def values(self, theta: np.ndarray) -> list[float]:
        """Values [SI] of the parameters at search coordinates."""
        return [c.at(x) for c, x in zip(self.search, theta, strict=True)]

    def left_of(self, log: Log, simulated: np.ndarray | None) -> np.ndarray:
        """Residual of a log [SI], low-passed, zero where it does not count; a failed simulation
        counts ten spreads.
        """
        if simulated is None:
            return np.tile(10.0 * self.per(self.spread, log), (len(log.recorded), 1)) * log.counts
        maximum = FARTHEST * self.per(self.spread, log)
        left = np.clip(simulated - log.recorded, -maximum, maximum)
        left = lowpass(left, log.sample_time, self.cutoff) if self.cutoff else left
        return left * log.counts

    def point(self, theta: np.ndarray, shifts: Shifts) -> Point:
        """The residuals at a point, in the steps of the integration chosen last if that was near;
        the last one is remembered.
        """
        logs, values, last, grid = self.simulator.logs, self.values(theta), self.last, self.grid
        grid = grid if grid is not None and grid.of(logs, self.slack) else None
        if last is not None and grid is not None and last.grid is grid:
            same = zip([last.theta, *last.shifts], [theta, *shifts], strict=True)
            if all(np.array_equal(*pair) for pair in same):
                return last
        if grid is None or not grid.serves(theta, shifts):
            row, meshes = self.simulator.begin(values, shifts, self.slack)
            grid = self.grid = _Grid(theta, shifts, logs, meshes, self.slack)
        else:
            points = [(values, k, shift) for k, shift in enumerate(shifts)]
            row = self.simulator.each(points, grid.meshes)
        left = [self.left_of(*pair) for pair in zip(logs, row, strict=True)]
        self.last = Point(theta, shifts, left, grid)
        return self.last

    def scaled(
        self, parts: Sequence[np.ndarray], chosen: Sequence[int] | None = None
    ) -> list[np.ndarray]:
        """Residuals divided by their channels' scales."""
        return [
            part / self.per(self.scales, log)
            for part, log in zip(parts, self.simulator.chosen(chosen), strict=True)
        ]

    def slopes(self, here: Point, which: Sequence[int]) -> list[np.ndarray]:
        """Scaled sensitivities by log, shape (samples, channels, parameters), by differences that
        stay inside the bounds and where the rig is possible; zero where a parameter has been seen
        to change nothing in a log.
        """
        logs, known = self.simulator.logs, here.slopes
        every = [(i, k) for i in which for k in range(len(logs))]
        requested = [pair for pair in every if pair not in known and self.touches[pair]]
        for side in (1.0, -1.0):
            steps = {i: side * self._inward(here.theta, i) * DIFFERENCE for i in which}
            points = []
            for i, k in requested:
                theta = here.theta + steps[i] * np.eye(len(here.theta))[i]
                points.append((self.values(theta), k, here.shifts[k]))
            done = zip(requested, self.simulator.each(points, here.grid.meshes), strict=True)
            for (i, k), simulated in done:
                if simulated is not None:
                    known[i, k] = (self.left_of(logs[k], simulated) - here.left[k]) / steps[i]
            # where there is no such rig, the other side is asked
            requested = [pair for pair in requested if pair not in known]
        return [
            _stacked([known.get((i, k)) for i in which], left) / self.per(self.scales, log)[:, None]
            for k, (log, left) in enumerate(zip(logs, here.left, strict=True))
        ]

    def _inward(self, theta: np.ndarray, i: int) -> float:
        """The side on which a parameter has room for a difference."""
        return 1.0 if theta[i] + DIFFERENCE <= self.search[i].bounds[1] else -1.0

    def nudges(self, here: Point) -> list[np.ndarray]:
        """Scaled sensitivities to where each log starts, shape (samples, channels, nuisances); zero
        for logs that begin at rest while the search is coarse.
        """
        logs, known, values = self.simulator.logs, here.nudges, self.values(here.theta)
        requested = [
            (k, j, doubt.share)
            for k, log in enumerate(logs)
            for j, doubt in enumerate(log.start.uncertain)
            if (log.start.moves or not self.coarse) and (k, j) not in known
        ]
        points = [
            (values, k, here.shifts[k] + share * np.eye(len(here.shifts[k]))[j])
            for k, j, share in requested
        ]
        done = self.simulator.each(points, here.grid.meshes)
        for (k, j, share), simulated in zip(requested, done, strict=True):
            if simulated is not None:
                known[k, j] = (self.left_of(logs[k], simulated) - here.left[k]) / share
        return [
            _stacked([known.get((k, j)) for j in range(len(log.start.uncertain))], left)
            / self.per(self.scales, log)[:, None]
            for k, (log, left) in enumerate(zip(logs, here.left, strict=True))
        ]

    def _stands(self) -> tuple[object, ...]:
        """All that a step of the search starts from, for the journal."""
        logs, grid = self.simulator.logs, self.grid
        names = [(c.name, c.bounds, c.start) for c in self.search]
        sizes = sorted(self.scales.items())
        fixed = (
            self.free,
            sizes,
            self.weight,
            self.coarse,
            grid is not None and grid.of(logs, self.slack),
            [log.counts.shape for log in logs],
        )
        chosen = () if grid is None else (grid.theta, *grid.shifts)
        at = (self.theta, self.touches, *self.shifts, *chosen)
        return (names, fixed, *(item.tobytes() for item in at))

    def _standing(self, theta: np.ndarray) -> dict[str, object]:
        """Where the search stands, for who reads the journal: evaluations, and parameters [SI]."""
        values = dict(zip((c.name for c in self.search), self.values(theta), strict=True))
        requested = {c.name: values[c.name] for c in self.search[: self.asked]}
        return {"evaluations": self.simulator.evaluations, "parameters": requested}

    def cost(self, point: Point) -> float:
        """What is minimised: scaled residuals and what priors are missed by, squared."""
        left = sum(float(np.sum(part**2)) for part in self.scaled(point.left))
        known = sum(float(np.sum(shift**2)) for shift in point.shifts)
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
            blocks = self.blocks(here, slopes, way.nudges)
            cost = self.cost(here)
            while True:
                step, gain = self.step(here, blocks, free, bounds, way.damping)
                if gain <= tolerance * cost:
                    return self._ended(True)
                there = self.point(*step)
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

    def _begun(self, known: Mapping[str, Any]) -> tuple[Point, _Way]:
        """Where a descent begins, or goes on after its last step that the journal knows."""
        if "done" not in known:
            return self.point(self.theta, self.shifts), _Way()
        way = _Way(known["damping"], known["faithful"], known["done"])
        if way.faithful:
            way.origin = self.point(*self._placed(known["origin"]))
            way.nudges = self.nudges(way.origin)
        self.theta, self.shifts = self._placed(known)
        here = self.point(self.theta, self.shifts)
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
        _, meshes = self.simulator.begin(self.values(theta), shifts, self.slack)
        self.simulator.evaluations = count
        self.grid = _Grid(theta, shifts, logs, meshes, self.slack)

    def _keep(self, way: _Way, here: Point) -> None:
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

    def blocks(
        self, here: Point, slopes: Sequence[np.ndarray], nudges: Sequence[np.ndarray]
    ) -> list[Block]:
        """What each log says of the parameters and of its own start, linear about a point."""
        each = zip(
            self.simulator.logs, slopes, nudges, self.scaled(here.left), here.shifts, strict=True
        )
        return [Block(log.channels, *rest) for log, *rest in each]

    def prior(self, theta: np.ndarray, which: Sequence[int]) -> Prior:
        """What is known of some parameters beside the logs, and how far off it they are."""
        some = np.array(which, dtype=int)
        return Prior(self.sharpness[some], (theta - self.centre)[some], self.weight)

    def step(
        self,
        here: Point,
        blocks: Sequence[Block],
        free: np.ndarray,
        bounds: np.ndarray,
        damping: float,
    ) -> tuple[tuple[np.ndarray, Shifts], float]:
        """((theta, shifts) after a step, what it should gain of the cost)."""
        solved = [eliminate(block, self.weight) for block in blocks]
        prior, count = self.prior(here.theta, free.tolist()), len(free)
        normal = np.sum([item.normal for item in solved], axis=0) + prior.normal
        pull = np.sum([item.gradient for item in solved], axis=0) + prior.gradient
        theta, move = here.theta.copy(), np.zeros(count)
        if count:
            move = bounded_step(normal, pull, damping, *(bounds - theta[free][:, None]).T)
            theta[free] = np.clip(theta[free] + move, *bounds.T)
        shifts, gain = [], -float(2.0 * pull @ move + move @ normal @ move)
        for shift, item, block in zip(here.shifts, solved, blocks, strict=True):
            shifts.append(shift + item.move - item.gain @ move)
            inner = np.einsum("tcn,tc->n", block.nudges, block.left) + self.weight * shift
            gain -= float(inner @ item.move)
        return (theta, shifts), gain

    def weigh(self, here: Point, scales: bool = True) -> None:
        """Scales of the channels, and the weight of priors beside them, by what is left; where
        means are compared, by what is left of samples, so that channels count for the same.
        """
        if scales:
            for channel, spread in self.spread.items():
                size = math.hypot(self.pooled(channel, here.left), self.within[channel])
                self.scales[channel] = max(size, SCALE_FLOOR * spread)
        self.weight = prior_weight(self.scaled(here.left))

    def effects(
        self,
        slopes: Sequence[np.ndarray],
        which: Sequence[int],
        chosen: Sequence[int] | None = None,
    ) -> dict[int, float]:
        """Largest rms change of a channel in a log when one of the parameters ``which`` moves by
        its unit, as a share of the channel's spread.
        """
        ratio = [
            self.per(self.scales, log) / self.per(self.spread, log)
            for log in self.simulator.chosen(chosen)
        ]
        each = [
            np.sqrt(np.mean(part**2, axis=0)) * r[:, None]
            for part, r in zip(slopes, ratio, strict=True)
        ]
        return dict(zip(which, np.max(np.concatenate(each), axis=0), strict=True))

    def settle(self, tolerance: float) -> bool:
        """Weigh and solve until the weights stand; whether it converged."""
        converged = False
        for _ in range(ROUNDS):
            before = dict(self.scales)
            self.weigh(self.point(self.theta, self.shifts))
            change = max(abs(math.log(self.scales[c] / before[c])) for c in before)
            if converged and change < STANDS:
                break
            converged = self.solve(tolerance)
        return converged

    def settle_starts(self, values: Sequence[float]) -> None:
        """Stand at given values [SI] of the parameters searched; each log's start, its sensors and
        the channels' scales settled there.
        """
        self.coarse, self.free = False, list(range(self.asked, self.fitted))
        self.theta[: self.asked] = [c.of(x) for c, x in zip(self.search, values, strict=False)]
        for _ in range(2):
            self.solve(1e-4)
            self.weigh(self.point(self.theta, self.shifts))

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
        values = self.values(self.theta)[: self.asked]
        names = [c.name for c in self.search[: self.asked]]
        cost = self.cost(self.point(self.theta, self.shifts))
        return cost, dict(zip(names, values, strict=True))

    def said(self) -> tuple[list[Block], Prior]:
        """What each log says of the parameters searched and of shared sensors where the fit stands,
        and what is known of them beside.
        """
        here, which = self.point(self.theta, self.shifts), list(range(self.fitted))
        blocks = self.blocks(here, self.slopes(here, which), self.nudges(here))
        return blocks, self.prior(self.theta, which)

    def named(self) -> dict[str, float]:
        """Where the search stands, by name; of sensors their bias."""
        return dict(zip((c.name for c in self.search), self.values(self.theta), strict=True))

    def beside(self, logs: Sequence[Log]) -> list[np.ndarray]:
        """Residuals of these logs [SI] in place of the search's own, of which other samples count,
        where it stands; shape (samples, channels).
        """
        row = self.simulator.simulate([self.values(self.theta)], None, self.shifts)[0]
        return [self.left_of(*pair) for pair in zip(logs, row, strict=True)]


def _place(theta: np.ndarray, shifts: Shifts) -> dict[str, Any]:
    """A point as the journal keeps it."""
    return {"theta": theta.tolist(), "shifts": [shift.tolist() for shift in shifts]}


def _kept(point: Point) -> dict[str, Any]:
    """A point as the journal keeps it, with where its steps were chosen."""
    grid = point.grid
    return _place(point.theta, point.shifts) | {"chosen": _place(grid.theta, grid.shifts)}


def _placed(kept: Mapping[str, Any]) -> tuple[np.ndarray, Shifts]:
    """(parameters, shifts) of a point that the journal kept."""
    return np.array(kept["theta"]), [np.array(shift, dtype=float) for shift in kept["shifts"]]


def _stacked(columns: Sequence[np.ndarray | None], like: np.ndarray) -> np.ndarray:
    """Columns side by side along a last axis, zero where there is none."""
    results = [np.zeros_like(like) if column is None else column for column in columns]
    return np.stack(results, axis=-1) if results else np.zeros((*like.shape, 0))


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
