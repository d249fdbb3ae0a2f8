"""How far a fitted flow map may lie from the valve: standard errors over opening and drop."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ehbench.flow_maps.cells import Noise
from ehbench.flow_maps.deadband import Deadband, Window
from ehbench.flow_maps.opening import Kink
from ehbench.flow_maps.readings import Task
from ehbench.flow_maps.spline import SPANS_U
from ehbench.flow_maps.steps import KeptSpline, Shape, Solution, solve


@dataclass(frozen=True, eq=False)
class Found:
    """A fit that has come to rest: task, shape, solution, noise, deadband with its window, the
    readings kept and each one's distance from the map in sigmas, where it bends sharply in the
    opening."""

    task: Task
    shape: Shape
    solution: Solution
    noise: Noise
    deadband: Deadband
    window: Window
    keep: np.ndarray
    sigmas: np.ndarray
    kinks: tuple[Kink, ...]


def trial_scatter(result: Found) -> float:
    """Standard error of the mean of the trials' common factors [1], beyond what the noise explains
    (DerSimonian–Laird).
    """
    r, flow = result.task.readings, result.solution.flow
    keep = result.keep & (flow > 0) & ~result.solution.lone[r.cell]
    weight = np.where(keep, 1.0 / result.noise.std(result.task, flow) ** 2, 0.0)
    trials = np.unique(r.trial[keep])
    if trials.size < 2:
        return 0.0
    miss = result.solution.cells.heard - flow
    precision = np.array([np.sum((weight * flow**2)[r.trial == t]) for t in trials])
    share = np.array([np.sum((weight * flow * miss)[r.trial == t]) for t in trials]) / precision
    mean = precision @ share / precision.sum()
    excess = precision @ (share - mean) ** 2 - (trials.size - 1)
    between = max(excess, 0.0) / (precision.sum() - np.sum(precision**2) / precision.sum())
    return float(np.sqrt(between / trials.size))


def flow_std(result: Found, u: np.ndarray, s: np.ndarray, scatter: float) -> np.ndarray:
    """Standard error of the scaled flow on the grid u × s: coefficients, deadband, what all drops
    are off by and the ``scatter`` of whole trials in the mean of all, shape (u, s).
    """
    task, shape, solution = result.task, result.shape, result.solution
    at, root = (a.ravel() for a in np.meshgrid(u, s, indexing="ij"))
    design = solution.spline.design(at, root)
    variance = solution.widening * solution.variance(design)
    flow = design @ solution.coefficients
    whole = scatter * _few_trials(result, at) * flow
    variance += _missed(result, at, root) + _between(result, at, root)
    used = solution.cells.without(solution.lone)
    for sides in _uncertain(result):
        moved = [spline.design(at, root) @ solve(shape, spline, used)[0] for spline in sides]
        variance += 0.25 * (moved[1] - moved[0]) ** 2
    scaled = task.delta / task.drop_max  # half of what s and a plain root of the drop differ by
    drop = root * np.sqrt(0.5 * root**2 + np.sqrt(0.25 * root**4 + scaled**2))
    variance += (0.5 * flow * (np.sqrt(drop) / np.maximum(root, 1e-12) - 1.0)) ** 2
    variance += _shared(task, flow.reshape(u.size, s.size), u, drop[: s.size]).ravel()
    return np.sqrt(variance + whole**2).reshape(u.size, s.size)


def _shared(task: Task, flow: np.ndarray, u: np.ndarray, drop: np.ndarray) -> np.ndarray:
    """Variance of scaled flows, shape (commands, drops), by what all commands and all drops are off
    by: no reading tells these from the valve.
    """
    variance = np.zeros(flow.shape)
    for axis, at, std in ((0, u, task.command_std), (1, drop, task.drop_std)):
        if std > 0.0:
            variance += (std * np.asarray(np.gradient(flow, at, axis=axis))) ** 2
    return variance


def _few_trials(result: Found, u: np.ndarray) -> np.ndarray:
    """By how much more than their mean the trials' common factors scatter at some commands [V],
    where only some of them read: √(all trials/those that read there).
    """
    r, levels = result.task.readings, result.task.levels
    counts = [np.unique(r.trial[result.keep & (r.level == k)]).size for k in range(levels.size)]
    return np.sqrt(
        np.unique(r.trial[result.keep]).size / np.interp(u, levels, np.maximum(counts, 1))
    )


def _uncertain(result: Found) -> Iterator[list[KeptSpline]]:
    """For the deadband and for each kink, the spline with it a standard error lower and higher."""
    shape, deadband = result.shape, result.deadband
    if deadband.std > 0:
        yield [shape.spline(max(deadband.value + k * deadband.std, 0.0)) for k in (-1, 1)]
    for kink in result.kinks:
        others = tuple(item.value for item in result.kinks if item is not kink)
        sides = [
            replace(shape, kinks=(*others, kink.value + k * kink.std)).spline() for k in (-1, 1)
        ]
        yield sides


def _missed(result: Found, u: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Variance [rated²] by which the cells near each point surely miss the map, beyond their
    noise.
    """
    task, solution, cells = result.task, result.solution, result.solution.cells
    some = (cells.weight > 0) & (cells.u > result.deadband.value)
    if not some.any():
        return np.zeros(u.size)
    square = (cells.y - solution.at(cells.u, cells.s))[some] ** 2
    away = task.places(u, s)[:, None, :] - task.places(cells.u[some], cells.s[some])
    near = np.exp(-0.5 * np.sum(away**2, axis=2)) + 1e-12
    near /= near.sum(axis=1, keepdims=True)
    # the scatter of a mean of squares: what it exceeds the noise by must exceed 1.6 times that,
    # too
    sure = 1.0 + 1.6 * np.sqrt(2.0 * np.sum(near**2, axis=1))
    return np.maximum(near @ square - sure * (near @ (1.0 / cells.weight[some])), 0.0)


def _between(result: Found, u: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Variance [rated²] of where a map that bends sharply does so between the drops measured;
    else zero.

    A kink that changes the slope by κ inside a gap h leaves the chord by κ·h·w·(1 − w) at most,
    w from 0 to 1 in the gap; taken as two standard errors, with the largest change of slope
    over this gap or one beside it as κ: a spline rings."""
    roots = result.task.roots
    if roots.size < 4:
        return np.zeros(u.size)
    gap = np.clip(np.searchsorted(roots, s, side="right") - 1, 0, roots.size - 2)
    each, row = np.unique(u, return_inverse=True)
    flow = result.solution.at(np.repeat(each, roots.size), np.tile(roots, each.size))
    turn = np.diff(np.diff(flow.reshape(each.size, roots.size), axis=1) / np.diff(roots), axis=1)
    turn = np.pad(turn, ((0, 0), (1, 1)))
    turn = np.abs(turn[:, 1:] + turn[:, :-1])  # a kink inside a gap shows half at either end
    width = np.diff(roots)[gap]
    part = np.clip((s - roots[gap]) / width, 0.0, 1.0)
    kink = np.max([turn[row, np.clip(gap + k, 0, roots.size - 2)] for k in (-1, 0, 1)], axis=0)
    sure = 0.5 if result.shape.along_s.kink else 0.25
    return (sure * kink * width * part * (1.0 - part)) ** 2


def hull(result: Found) -> np.ndarray:
    """Rows commands [V], least and largest drop [Pa] read there; many commands are taken in groups
    of neighbours.
    """
    r, levels = result.task.readings, result.task.levels
    group = r.level
    if levels.size > 2 * SPANS_U:
        group = np.searchsorted(np.quantile(r.u, np.arange(1, SPANS_U) / SPANS_U), r.u)
    parts = [np.flatnonzero((group == k) & result.keep) for k in np.unique(group)]
    table = np.array(
        [(r.u[at].mean(), r.drop[at].min(), r.drop[at].max()) for at in parts if at.size]
    )
    table[[0, -1], 0] = levels[[0, -1]]
    if table[0, 0] > 0 and not result.window.flows_at_lowest:
        # shut at the lowest command, so shut below it
        table = np.vstack([[0.0, *table[0, 1:]], table])
    return table.T
