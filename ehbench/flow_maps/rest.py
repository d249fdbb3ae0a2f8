"""What a flow map's readings hold beside the map: a leak at rest, and commands that act otherwise
on the way up than on the way down."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ehbench.flow_maps.error import Found
from ehbench.flow_maps.readings import Task, medians
from ehbench.vocabulary.terms import Z95

# a hysteresis is taken for real from so many standard errors and this share of the commands on
_SURE, _LEAST_LAG = 4.0, 5e-4


@dataclass(frozen=True)
class Leak:
    """Scaled flow at rest at the largest drop: the part that grows with the root of the drop, the
    part that grows with the drop, the standard error of their sum. ``level``: how many of the
    commands pass no more. ``goes_on``: beside the flow of the open valve.
    """

    root: float
    drop: float
    std: float
    level: int
    goes_on: bool = False

    def at(self, s: np.ndarray) -> np.ndarray:
        """Scaled flow at scaled roots of the drop."""
        return s * (self.root + s * self.drop)


@dataclass(frozen=True)
class Lag:
    """A hysteresis [V] with its standard error; ``taken_off`` the commands before the fit."""

    value: float
    std: float
    taken_off: bool


def find_leak(task: Task) -> Leak | None:
    """The leak of a valve that passes flow at 0 V, if that was measured and is small; else None."""
    r = task.readings
    at = (r.level == 0) & (r.u == 0) & ~r.silent
    if at.sum() < 4:
        return None
    middle = float(np.median(task.y[at]))
    error = 1.4826 * float(np.median(np.abs(task.y[at] - middle))) / np.sqrt(at.sum())
    if middle <= max(1e-3, 4.0 * error):
        return None
    passes = medians(medians(task.y, r.cell), task.cell_level) > max(5e-3, 1.5 * middle)
    level = int(np.flatnonzero(~passes)[-1]) + 1 if not passes.all() else 1
    return _law_of(task, (r.level < level) & ~r.silent, level)


def _law_of(task: Task, at: np.ndarray, level: int) -> Leak:
    """The leak through the readings ``at``, far ones left out, by non-negative least squares."""
    from scipy.optimize import nnls

    s, y = task.s[at], task.y[at]
    design = np.column_stack([s, s**2])
    parts = nnls(design, y)[0]
    for _ in range(3):
        left = y - design @ parts
        near = np.abs(left) <= 5.0 * 1.4826 * max(float(np.median(np.abs(left))), 1e-9)
        parts = nnls(design[near], y[near])[0]
    used = design[near][:, parts > 0]
    scatter = float(np.sum(left[near] ** 2)) / max(int(near.sum()) - 2, 1)
    spread = np.linalg.pinv(used.T @ used)
    return Leak(float(parts[0]), float(parts[1]), float(np.sqrt(scatter * spread.sum())), level)


def without_leak(task: Task, leak: Leak) -> Task:
    """The task less a leak that goes on beside the flow of the open valve."""
    return replace(task, y=task.y - leak.at(task.s))


def hysteresis_of(result: Found) -> tuple[float, float]:
    """(what the commands of rising readings lie above those of falling ones at the same flow [V],
    beyond what was taken off them already, its standard error); 0 and 0 without both.

    A reading on the way up stands at an opening that is lower by half of it: a residual of −½·h
    times the slope of the map."""
    task, r = result.task, result.task.readings
    step = 1e-3 * float(task.levels[-1])
    slope = result.solution.at(r.u + step, task.s) - result.solution.at(r.u - step, task.s)
    slope = np.where(r.u > result.deadband.value, slope / (2.0 * step), 0.0)
    use = result.keep & ~r.silent & (r.sweep != 0) & ~result.solution.lone[r.cell]
    lever = -0.5 * (r.sweep * slope)[use]
    weight = 1.0 / result.noise.std(task, result.solution.flow)[use] ** 2
    power = float(weight @ lever**2)
    if not power > 0 or np.unique(r.sweep[use]).size < 2:
        return 0.0, 0.0
    left = result.solution.cells.heard[use] - result.solution.flow[use]
    lag = float((weight * lever) @ left) / power
    scatter = float(weight @ (left - lag * lever) ** 2) / max(int(use.sum()) - 1, 1)
    return lag, float(np.sqrt(max(scatter, 1.0) / power))


def is_sure(result: Found, lag: float, std: float) -> bool:
    """Whether a hysteresis [V] is more than chance."""
    return lag > max(_SURE * std, _LEAST_LAG * float(result.task.levels[-1]))


def interval_of(value: float, std: float) -> tuple[float, float]:
    """95 % interval of a number that is not negative."""
    return max(value - Z95 * std, 0.0), max(value + Z95 * std, 0.0)
