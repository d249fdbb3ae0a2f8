"""The noise of flowmeter readings, and the means of their cells, which a map is fitted to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ehbench.flow_maps.readings import Task

OUTLIER_SIGMAS = 5.0
# more than this share far from the map is no accident, and stays in
_MOST_OUTLIERS = 0.05
# no meter is better than this share of the rated flow; keeps weights finite on noise-free data
_LEAST_NOISE = 1e-4


@dataclass(frozen=True)
class Noise:
    """By method (floor, share): the standard deviation of one scaled reading is
    √(floor² + (share·flow)²). ``replicates``: degrees of freedom of repeats behind it."""

    methods: dict[str, tuple[float, float]]
    replicates: int = 0

    def std(self, task: Task, flow: np.ndarray) -> np.ndarray:
        """Standard deviation of each single reading, given the map's flow there."""
        floor, share, digit = np.array(
            [(*self.methods[m], task.digit[m]) for m in task.readings.method]
        ).T
        return np.sqrt(np.maximum(floor**2 + (share * flow) ** 2, digit**2) + _LEAST_NOISE**2)


@dataclass(frozen=True, eq=False)
class Cells:
    """Means of the kept readings of each cell, shape (cells,): command [V], scaled root and flow,
    weight (0 where none is kept), how many are kept. ``heard``: the scaled flow of each reading, a
    silent one where the map has it. ``replicates`` as in `Noise`."""

    u: np.ndarray
    s: np.ndarray
    y: np.ndarray
    weight: np.ndarray
    count: np.ndarray
    heard: np.ndarray
    replicates: int

    @cached_property
    def _bytes(self) -> tuple[bytes, ...]:
        parts = self.u, self.s, self.y, self.weight, self.count, self.heard
        return *(part.tobytes() for part in parts), str(self.replicates).encode()

    def __hash__(self) -> int:
        return hash(self._bytes)

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Cells) and self._bytes == other._bytes)

    def without(self, out: np.ndarray) -> Cells:
        """The same cells, of which some have no weight."""
        return replace(self, weight=np.where(out, 0.0, self.weight)) if out.any() else self

    @cached_property
    def weighed(self) -> int:
        """How many cells have a weight."""
        return int(np.count_nonzero(self.weight))

    @cached_property
    def total(self) -> float:
        """Weighted squares of the flows."""
        return float(self.weight @ self.y**2)


def first_noise(task: Task) -> Noise:
    """What is taken for the noise before there is a fit."""
    return Noise({name: (3e-3, 1e-2) for name in task.digit})


def gather_cells(task: Task, noise: Noise, keep: np.ndarray, flow: np.ndarray) -> Cells:
    """The cells' means, given the map's scaled flow at each reading."""
    r = task.readings
    limit, std = r.limit / task.rated, noise.std(task, flow)
    heard = np.where(r.silent, np.clip(flow, 0.0, limit), task.y)
    # whether a reading counts must not hang on its own noise, so the map says whether the meter
    # turns
    weight = np.where(keep & ((limit == 0) | (flow > limit + 2.0 * std)), 1.0 / std**2, 0.0)
    total = np.bincount(r.cell, weight)
    u, s, y = (
        np.bincount(r.cell, weight * a) / np.maximum(total, 1e-300) for a in (r.u, task.s, heard)
    )
    count = np.bincount(r.cell, keep, total.size)
    return Cells(u, s, y, total, count, heard, noise.replicates)


def measure_noise(
    task: Task, last: Noise, keep: np.ndarray, leverage: np.ndarray, flow: np.ndarray
) -> Noise:
    """Noise per method from the scatter inside cells about the map's course; from the residuals
    without repeats.
    """
    r = task.readings
    residual = task.y - flow
    dof_all = 0
    methods = dict(last.methods)
    for name in methods:
        use = keep & (r.method == name) & ~r.silent
        count = np.bincount(r.cell[use], minlength=r.cell.max() + 1)
        mean = np.bincount(r.cell[use], residual[use], count.size) / np.maximum(count, 1)
        inside = residual - mean[r.cell]
        dof = np.where(use, 1.0 - 1.0 / np.maximum(count, 1)[r.cell], 0.0)
        if dof.sum() < 6:
            inside, dof = residual, np.where(use, np.maximum(1.0 - leverage, 0.1), 0.0)
        else:
            dof_all += int(round(dof.sum()))
        if dof.sum() > 0:
            methods[name] = _growing(inside[use] ** 2, dof[use], flow[use])
    return Noise(methods, dof_all)


def _growing(square: np.ndarray, dof: np.ndarray, flow: np.ndarray) -> tuple[float, float]:
    """(floor, share) of a standard deviation √(floor² + (share·flow)²) by maximum likelihood from
    squared deviations.
    """
    best = (np.inf, 0.0, 0.0)
    for ratio in (0.0, *np.geomspace(1.0, 1e4, 25)):
        shape = 1.0 + ratio * flow**2
        floor2 = max(float(np.sum(square / shape) / dof.sum()), 1e-300)
        score = float(dof.sum() * np.log(floor2) + dof @ np.log(shape))
        best = min(best, (score, floor2**0.5, (ratio * floor2) ** 0.5))
    return float(best[1]), float(best[2])


def alone(task: Task, noise: Noise, heard: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """True for readings that no repeats back: those that do not agree with theirs within the
    noise, or have none.

    What repeats back is the valve's own, and a map that misses it lacks fit there.
    """
    cell, residual = task.readings.cell, heard - flow
    count = np.bincount(cell)
    high, low = np.full(count.size, -np.inf), np.full(count.size, np.inf)
    np.maximum.at(high, cell, residual)
    np.minimum.at(low, cell, residual)
    agree = high - low <= OUTLIER_SIGMAS * np.sqrt(
        np.bincount(cell, noise.std(task, flow) ** 2) / count
    )
    return ~(agree & (count > 1))[cell]


def few(out: np.ndarray, size: np.ndarray) -> np.ndarray:
    """The farthest of the readings ``out``, no more than a small share of all."""
    maximum = max(3, int(_MOST_OUTLIERS * out.size))
    farthest = np.argsort(np.where(out, -size, np.inf), kind="stable")[:maximum]
    return out & np.isin(np.arange(out.size), farthest)
