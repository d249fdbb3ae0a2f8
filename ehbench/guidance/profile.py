"""The profile likelihood of a fitted parameter: how much worse the logs are followed when it is
held at a value and everything else is fitted again.

Where it is a parabola over the interval, the interval means what it says; where it is lopsided,
flat or has a second valley, the interval does not."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ehbench.identification.descent import constrained
from ehbench.identification.estimate import estimate
from ehbench.identification.hydraulics import PreparedFit, problem_over
from ehbench.identification.results import FittedParameter, HydraulicsFit
from ehbench.identification.search import Coordinate
from ehbench.vocabulary import InputError, Progress, message

LEVEL_95 = 3.841  # rise of −2 log likelihood at the ends of a 95 % interval


@dataclass(frozen=True)
class Profile:
    """``rise`` of −2 log likelihood at ``values`` [SI] of a parameter, all others and the logs'
    starts fitted again, scaled so that its curvature at the best value is that of the fit's
    interval (residuals are coloured); ``followed`` are the others' values [SI] by name. ``ends``
    [SI] are where it crosses the 95 % level (None: not within what was tried), ``shape`` a word."""

    name: str
    unit: str
    best: float
    interval: tuple[float, float] | None
    values: tuple[float, ...]
    rise: tuple[float, ...]
    ends: tuple[float | None, float | None]
    followed: dict[str, tuple[float, ...]]
    shape: str


def profile(
    prepared: PreparedFit, name: str, progress: Progress | None = None
) -> tuple[HydraulicsFit, Profile]:
    """(the fit, the profile likelihood of one of its parameters).

    Raises:
        InputError: the parameter is not among those of the fit, or the method is not output error.
        InsufficientData: as the fit."""
    names = [c.name for c in prepared.search]
    if name not in names:
        raise InputError(message("guidance.not_among", name=name, names=", ".join(names)))
    if prepared.options.method != "output_error":
        raise InputError(message("guidance.needs_output_error"))
    problem = problem_over(prepared, prepared.logs, progress)
    fit, estimated = estimate(problem)
    which = names.index(name)
    fitted, c = fit[name], prepared.search[which]
    thetas, result = profile_values(c, fitted), []
    best = c.of(fitted.value)
    for side in (thetas[thetas < best][::-1], thetas[thetas >= best]):
        state = estimated
        for theta in side:
            problem.report(f"profile of {name}", 0.5 + 0.5 * len(result) / thetas.size)
            state, minimum = constrained(problem, state, which, float(theta))
            result.append((float(theta), minimum, problem.by_name(state.theta)))
    result.sort(key=lambda item: item[0])
    return fit, _profile(c, fitted, result, [n for n in names if n != name])


def profile_values(c: Coordinate, fitted: FittedParameter) -> np.ndarray:
    """Values to fix a parameter at, in search coordinates, inside its bounds, its best among them:
    six on either side, out to twice its interval, or to 1 where it has none."""
    best, half = c.of(fitted.value), c.half(fitted.value, fitted.interval)
    reach = 1.0 if half is None else 2.0 * half
    every = best + reach * np.arange(-6, 7) / 6
    return np.unique(np.clip(every, *c.bounds))


def _profile(
    c: Coordinate,
    fitted: FittedParameter,
    result: Sequence[tuple[float, float, dict[str, float]]],
    others: Sequence[str],
) -> Profile:
    theta = np.array([item[0] for item in result])
    cost = np.array([item[1] for item in result])
    rise = cost - cost.min()
    best = float(theta[np.argmin(cost)])
    centre, scale = c.of(fitted.value), 1.0
    if (half := c.half(fitted.value, fitted.interval)) is not None:
        near = (np.abs(theta - centre) <= 1.01 * half) & (theta != centre)
        square = (theta[near] - centre) ** 2
        curve = float(np.sum(rise[near] * square) / np.sum(square**2)) if near.any() else 0.0
        scale = LEVEL_95 / half**2 / curve if curve > 0.0 else 1.0
    rise = scale * rise
    k = int(np.argmin(rise))
    low = _crossing(theta[k::-1], rise[k::-1])
    high = _crossing(theta[k:], rise[k:])
    return Profile(
        name=c.name,
        unit=c.row.unit,
        best=c.at(best),
        interval=fitted.interval,
        values=tuple(c.at(float(x)) for x in theta),
        rise=tuple(float(r) for r in rise),
        ends=(None if low is None else c.at(low), None if high is None else c.at(high)),
        followed={name: tuple(item[2][name] for item in result) for name in others},
        shape=_shape(theta, rise, best, (low, high)),
    )


def _crossing(theta: np.ndarray, rise: np.ndarray) -> float | None:
    """Where the rise first reaches the 95 % level, away from the least; None if it does not."""
    above = np.flatnonzero(rise >= LEVEL_95)
    if not above.size or above[0] == 0:
        return None
    j = int(above[0])
    # the root of the rise is straight where it is a parabola
    a, b, level = math.sqrt(max(rise[j - 1], 0.0)), math.sqrt(rise[j]), math.sqrt(LEVEL_95)
    return float(theta[j - 1] + (theta[j] - theta[j - 1]) * (level - a) / max(b - a, 1e-300))


def _shape(
    theta: np.ndarray, rise: np.ndarray, best: float, ends: tuple[float | None, float | None]
) -> str:
    """``parabola``, ``lopsided``, ``open`` (no end on a side) or ``two valleys``."""
    inner = rise[1:-1]
    valleys = np.count_nonzero((inner < rise[:-2] - 0.5) & (inner < rise[2:] - 0.5))
    if valleys > 1:
        return "two valleys"
    low, high = ends
    if low is None or high is None:
        return "open"
    sides = best - low, high - best
    return "lopsided" if max(sides) > 1.5 * min(sides) else "parabola"
