"""From where parameters start to the basin of the best minimum: a look over their range, and coarse
solutions from what it met."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ehbench.identification.descent import FAINT, LEAST_DAMPING, SCALE_FLOOR, Descent, Point

SCAN = math.log(10.0)  # how far the first look goes either way, in units of a parameter
# its points over the bulk modulus, and over other parameters: 5 % apart, 2.4 % in frequency, which
# twenty cycles of ringing can still tell
COARSE, FINER = 11, 97
# of other basins that the look meets: how much worse than the best one may be to be tried, how many
RIVAL, RIVALS = 3.0, 3
LOOK_SLACK = 1000.0  # of the integration's steps in the look, whose points are some per cent apart
MUCH = 0.01  # squares of what is left, as a share of the channels' spread, that ask for more starts


@dataclass(frozen=True, eq=False)
class _End:
    """Where a coarse solution ended: its misfit, whether much is left of the channels' spread, the
    parameters.
    """

    misfit: float
    much: bool
    theta: np.ndarray


class MultiStart(Descent):
    """A descent that finds where to begin."""

    def scan(self) -> list[np.ndarray]:
        """A coarse look over bulk modulus and damping together, then over each other parameter that
        is positive or has no range, and no prior, on one log for each set of cylinders asked: least
        squares from far off could lock on to the wrong cycle of the ringing. The best that it met
        first, then the bottoms of other basins that are not much worse."""
        chosen = self._first_logs()
        bulk, damping = (
            [i for i in self.free if self.search[i].row.mode_role == what and self.search[i].log]
            for what in ("frequency", "decay")
        )
        others = [
            [i]
            for i, c in enumerate(self.search[: self.asked])
            if c.roams and not c.known and i not in (*bulk, *damping)
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
            for parts in self.residuals(vectors, chosen, LOOK_SLACK)
        ]
        best = vectors[int(np.argmin(costs))]
        self.journal.keep(self._standing(best), costs=costs, evaluations=self.simulator.evaluations)
        return np.array(costs)

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
        count = FINER if self.search[some[0]].row.mode_role != "frequency" else COARSE
        losses = (0.0, -1.4, 1.4) if damping else (0.0,)
        vectors = []
        for shift in (0.0, *np.linspace(*ends, count)):
            for loss in losses:
                theta = self.theta.copy()
                theta[some] += shift
                theta[list(damping)] += loss
                vectors.append(np.clip(theta, low + 1e-6, high - 1e-6))
        return vectors, len(losses)

    def _arrive(self, starts: Sequence[np.ndarray], begin: np.ndarray) -> np.ndarray:
        """The best that a coarse solution comes to from some starts; where these leave much, no
        worse than what fewer parameters come to (`_chain`, `_without`).
        """
        every = self.free
        ends = [self.solved(start, every) for start in starts]
        if len(every) > 1 and all(end.much for end in ends):
            ends += [self.solved(begin, every), self._chain(begin)]
            ends.append(self._without(min(ends, key=_by_misfit)))
        return min(ends, key=_by_misfit).theta

    def _chain(self, begin: np.ndarray) -> _End:
        """Where solutions over ever more of the parameters end, in their order: each begins where
        the one before ended and where the look stood, so none ends worse than one over fewer.
        """
        every = self.free
        end = self.solved(begin, every[:1])
        for count in range(1, len(every) + 1):
            some = every[:count]
            look = [theta for last, theta in self.looked if last <= some[-1]][-1:]
            if look:
                start = begin.copy()
                start[some] = look[0][some]
                end = min(end, self.solved(start, some), key=_by_misfit)
            end = min(end, self.solved(end.theta, some), key=_by_misfit)
        return end

    def _without(self, end: _End) -> _End:
        """A solution held against those in which one of its parameters stays at its start: where
        one of these ends better, all go on from there.
        """
        every = self.free
        for i in every:
            start = end.theta.copy()
            start[i] = self.search[i].begin
            rest = self.solved(start, [k for k in every if k != i])
            if rest.misfit < end.misfit:
                end = min(rest, self.solved(rest.theta, every), key=_by_misfit)
        return end

    def solved(self, start: np.ndarray, free: list[int]) -> _End:
        """Where a coarse solution over some of the free parameters ends; first every channel counts
        by its spread, then by what is left of it.
        """
        every = self.free
        self.theta, self.shifts = start, self.simulator.unshifted()
        self.scales = dict(self.spread)
        here = self.point(start, self.shifts)
        self.weigh(here, scales=False)
        effects = self.effects(self.slopes(here, free), free)
        self.free = [i for i in free if effects[i] >= FAINT]
        self.solve(1e-3)
        here = self.point(self.theta, self.shifts)
        much = self._squares(here) > MUCH * sum(part.size for part in here.left)
        if much:
            self.weigh(here)
            self.solve(1e-3)
            here = self.point(self.theta, self.shifts)
        self.free, self.scales = every, dict(self.spread)
        return _End(self._misfit(here), much, self.theta)

    def _squares(self, here: Point) -> float:
        """Squares of what is left, in units of the scales."""
        return sum(float(np.sum(part**2)) for part in self.scaled(here.left))

    def _misfit(self, here: Point) -> float:
        """Logarithms of the mean squares that are left of the channels, which weighing them by what
        is left makes least; below the floor of the scales straight.
        """
        result = 0.0
        for channel, spread in self.spread.items():
            share = (self.pooled(channel, here.left) / (SCALE_FLOOR * spread)) ** 2
            result += math.log(share) if share > 1.0 else share - 1.0
        return result

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
        self.solved(self.theta, self.free)
        self.weigh(self.point(self.theta, self.shifts))
        self.solve(1e-3)
        return self._level(self.point(self.theta, self.shifts).left)

    def foreseen(self, begin: Mapping[str, float]) -> float:
        """What `descend` would come to if all were as linear as it is at its start."""
        self._stand(begin)
        self.shifts = self.simulator.unshifted()
        here = self.point(self.theta, self.shifts)
        self.weigh(here)
        free = np.array(self.free, dtype=int)
        blocks = self.blocks(here, self.slopes(here, self.free), self.nudges(here))
        bounds = np.array([self.search[i].bounds for i in free]).reshape(-1, 2)
        (theta, shifts), _ = self.step(here, blocks, free, bounds, LEAST_DAMPING)
        move = (theta - here.theta)[free]
        left = [
            (block.left + block.slopes @ move + block.nudges @ (shift - old))
            * self.per(self.scales, log)
            for block, log, shift, old in zip(
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
        return sum(2.0 * math.log(max(self.pooled(c, left), 1e-300)) for c in self.spread)


def _by_misfit(end: _End) -> float:
    return end.misfit
