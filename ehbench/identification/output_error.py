"""Output error: the parameters with which the simulation comes nearest to all logs at once, and how
sure they are."""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ehbench.identification.descent import FAINT, Point
from ehbench.identification.multi_start import MultiStart
from ehbench.identification.results import HydraulicsFit, read_off
from ehbench.identification.sensitivity import doubts_of
from ehbench.identification.uncertainty import Error, errors_of, result_of
from ehbench.vocabulary.errors import InsufficientData

NOTHING = 1.0e-3  # share of its largest effect below which a parameter does not touch a log
NEAR = 5.0e-3  # share of its reach within which a parameter is tried at its bound
HEAD = 5.0  # [s] of a log at least that the search begins with
# points over the range of a parameter of faint effect; halvings that find where the logs deny it
RANGE, HALVINGS = 13, 5
DENIED = 3.84  # rise of -2 log likelihood at the ends of a 95 % interval
SURE = 16.0  # fall of it at the best of many places that is more than noise: four standard errors


class OutputError(MultiStart):
    """A fit: the best minimum, parameters at their bounds held there, and how sure the rest is."""

    def fit(self) -> HydraulicsFit:
        """Search, weigh and solve until no parameter is lost or comes near a bound.

        Raises:
            InsufficientData: the logs tell nothing about any parameter.
        """
        whole = self.simulator.logs
        heads = tuple(log.head(HEAD) for log in whole)
        heads = whole if all(map(operator.is_, heads, whole)) else heads
        self.simulator.logs = heads
        self.tell("output error: looking over the range of the bulk modulus", 0.0)
        self.arrive()
        self.simulator.logs = whole
        here = self.point(self.theta, self.shifts)
        self.weigh(here, scales=False)
        slopes = self.slopes(here, self.free)
        self.coarse = False
        effects = self.effects(slopes, self.free)
        for k, part in enumerate(slopes):
            sizes = self.effects([part], self.free, [k])
            for i, size in sizes.items():
                self.touches[i, k] = size > NOTHING * effects[i]
        self._range([i for i, size in effects.items() if size < FAINT])
        converged = self.settle(1e-6)
        self.free, self.ranged = sorted({*self.free, *self.ranged}), {}
        for _ in range(self.fitted):
            result = errors_of(self)
            lost = [i for i, error in result.by_index.items() if error.kind == "not_excited"]
            near = self._near_bounds(result.by_index)
            if not lost and not near:
                break
            self._range(lost)
            self._hold({i: bound for i, bound in near.items() if i not in lost})
            converged = self.settle(1e-6)
        else:
            result = errors_of(self)
        doubts = doubts_of(self, result)
        self.tell("output error: done", 1.0)
        return result_of(self, result, converged, *doubts)

    def _range(self, which: Sequence[int]) -> None:
        """Ask the whole range of parameters whose effect here is faint: go where the logs would
        have them, hold those of which they deny a part, drop those of which they say nothing.
        """
        dropped = []
        for i in which:
            self.bound = [k for k in self.bound if k != i]
            self.free = sorted({*self.free, i})
            here = self.point(self.theta, self.shifts)
            every = np.linspace(*self.search[i].bounds, RANGE)
            points = np.unique([*every, self.search[i].begin])
            rises, effect = self._rises(here, i, points)
            possible, minimum = np.isfinite(rises).all(), int(np.argmin(rises))
            if (effect < FAINT and possible) or np.max(rises) < DENIED * self.weight:
                dropped.append(i)
            elif not self._gone(here, i, (float(rises[minimum]), float(points[minimum]))):
                ends, lowest = self._ends(here, i, points, rises)
                if not self._gone(here, i, lowest):
                    self.free = [k for k in self.free if k != i]
                    self.ranged[i] = ends
                    continue
            self.ranged.pop(i, None)
        self._drop(dropped)

    def _rises(self, here: Point, i: int, points: np.ndarray) -> tuple[np.ndarray, float]:
        """(by how much the cost is higher with a parameter at some points than where it is, the
        others following to first order; its largest effect, as `effects`).
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
            blocks = self.blocks(there, slopes, nudges)
            gain = self.step(there, blocks, np.array(others, dtype=int), bounds, 0.0)[1]
            rises[at] = self.cost(there) - gain - self.cost(here)
            change = [(a - b)[..., None] for a, b in zip(self.scaled(moved), scaled, strict=True)]
            effect = max(effect, self.effects(change, [i])[i])
        return rises, effect

    def _gone(self, here: Point, i: int, lowest: tuple[float, float]) -> bool:
        """Whether the cost is surely lower with a parameter at another value than here, and a
        solution that begins there ends better, where the search goes then.

        Args:
            lowest: (by how much the cost is higher there, the value).
        """
        rise, value = lowest
        if rise >= -SURE * self.weight:
            return False
        self.theta = here.theta.copy()
        self.theta[i] = value
        self.touches[i] = True  # what it does there is not what it does here
        self.solve(1e-3)
        if self.cost(self.point(self.theta, self.shifts)) < self.cost(here):
            return True
        self.theta, self.shifts = here.theta, here.shifts
        return False

    def _ends(
        self, here: Point, i: int, points: np.ndarray, rises: np.ndarray
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        """(between which values the logs do not deny a parameter, the bounds where they never do;
        the least rise met on the way there, and where). Between the last point at which it does
        nothing and the first that is denied may lie the one that the logs know.
        """
        ends, minimum = [], (0.0, float(here.theta[i]))
        for side in (-1, 1):
            beyond = [k for k in range(len(points)) if (points[k] - here.theta[i]) * side > 0.0]
            inner, outer = float(here.theta[i]), None
            for k in beyond[::side]:
                if rises[k] > DENIED * self.weight:
                    outer = float(points[k])
                    break
                inner = float(points[k])
            for _ in range(HALVINGS if outer is not None else 0):
                middle = 0.5 * (inner + float(outer or 0.0))
                rise = float(self._rises(here, i, np.array([middle]))[0][0])
                minimum = min(minimum, (rise, middle))
                inner, outer = (inner, middle) if rise > DENIED * self.weight else (middle, outer)
            ends.append(self.search[i].bounds[side > 0] if outer is None else outer)
        return (ends[0], ends[1]), minimum

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
            requested = [c.name for c in self.search[: self.asked]]
            result = {read_off(name, self.simulator.logs) for name in requested}
            hint = "use logs in which the commands excite them"
            if None not in result:
                channels = " and ".join(sorted(filter(None, result)))
                hint = f"each log goes by its own {channels} instead: read it there"
            raise InsufficientData(f"the logs tell nothing about {', '.join(requested)}", hint=hint)

    def _near_bounds(self, errors: Mapping[int, Error]) -> dict[int, float]:
        """Bounds, by index, that free parameters come near and that their intervals do not exclude:
        the cost grows by less than 3.84 correlation times there.
        """
        results = {}
        for i in self.free:
            c, error = self.search[i], errors.get(i)
            if error is None:
                continue
            for bound in c.bounds:
                off = abs(self.theta[i] - bound)
                if 0.0 < off < min(NEAR * c.reach, error.quantile * error.std):
                    results[i] = bound
        return results

    def _hold(self, at: Mapping[int, float]) -> None:
        """Put parameters on their bounds and leave them there."""
        for i, bound in at.items():
            self.theta = self.theta.copy()
            self.theta[i] = bound
            self.free.remove(i)
            self.bound.append(i)
