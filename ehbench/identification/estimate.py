"""Output error: the parameters with which the simulation comes nearest to all logs at once, and how
sure they are."""

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ehbench.identification.basins import nearest_basin
from ehbench.identification.covariance import Block, Prior
from ehbench.identification.descent import settle, solve, step
from ehbench.identification.problem import SETTINGS as PROBLEM
from ehbench.identification.problem import (
    Problem,
    State,
    cost,
    effects,
    evaluate,
    initial,
    jacobian,
    linearised,
    prior_of,
    residuals_at,
    scaled,
    towards,
    weighed,
)
from ehbench.identification.results import HydraulicsFit, read_off
from ehbench.identification.sensitivity import doubts_of
from ehbench.identification.uncertainty import errors_of, result_of
from ehbench.vocabulary import InsufficientData, message, setting


@dataclass(frozen=True)
class EstimateSettings:
    """Numbers of a fit by output error."""

    nothing: float = setting(
        1e-3,
        "",
        "effect, share of its largest, below which a parameter does not move a log",
        "noise",
    )
    near: float = setting(
        5e-3,
        "",
        "share of its reach within which a parameter is tried at its bound",
        "of its start",
    )
    head: float = setting(5.0, "s", "shortest part of a log that the search begins with", "time")
    points: int = setting(
        13, "", "points over the range of a parameter of faint effect", "a twelfth of the range"
    )
    halvings: int = setting(5, "", "halvings that find where the logs deny it", "3 % of a gap")
    denied: float = setting(
        3.84, "", "rise of −2 log likelihood at the ends of a 95 % interval", "χ² at 95 %"
    )
    sure: float = setting(
        16.0, "", "fall of it at the best of many places that is more than noise", "4 std. errors"
    )


SETTINGS = EstimateSettings()


def estimate(problem: Problem) -> tuple[HydraulicsFit, State]:
    """(the result of a fit, where it stands): search, weigh and solve until no parameter is lost or
    comes near a bound.

    Raises:
        InsufficientData: the logs tell nothing about any parameter."""
    heads = tuple(log.head(SETTINGS.head) for log in problem.logs)
    whole = all(map(operator.is_, heads, problem.logs))
    problem.report("output error: looking over the range of the bulk modulus", 0.0)
    state = nearest_basin(problem if whole else problem.over(heads), initial(problem))
    state = state if whole else replace(state, point=None)
    state = weighed(problem, evaluate(problem, state), scales=False)
    columns = jacobian(problem, state, state.free)
    sizes = effects(problem, state, columns)
    influence = state.influence.copy()
    for k, part in enumerate(columns):
        influence[list(state.free), k] = (
            effects(problem, state, [part], [k]) > SETTINGS.nothing * sizes
        )
    state = replace(state, influence=influence, coarse=False)
    faint = [i for i, size in zip(state.free, sizes, strict=True) if size < PROBLEM.faint]
    state, converged = settle(problem, _over_ranges(problem, state, faint))
    state = replace(state, free=tuple(sorted({*state.free, *state.ranges})), ranges={})
    for _ in range(problem.fitted):
        state = evaluate(problem, state)
        errors = errors_of(problem, state)
        lost = [i for i, error in errors.by_index.items() if error.kind == "not_excited"]
        near = {}  # bounds that parameters come near and that their intervals do not exclude
        for i in (i for i in state.free if i in errors.by_index):
            c, error = problem.search[i], errors.by_index[i]
            half = error.quantile * error.std * math.sqrt(1.0 - error.from_fixed)
            for bound in c.bounds:
                off = abs(state.theta[i] - bound)
                if 0.0 < off < min(SETTINGS.near * c.reach, half):
                    near[i] = bound
        if not lost and not near:
            break
        state = _over_ranges(problem, state, lost)
        for i in set(near) - set(lost):
            state = towards(problem, state, i, near[i]).fixed(i)
            state = replace(state, at_bound=(*state.at_bound, i))
        state, converged = settle(problem, state)
    else:
        state = evaluate(problem, state)
        errors = errors_of(problem, state)
    iterations = problem.simulator.effort.iterations
    doubts = doubts_of(problem, state, errors)
    problem.report("output error: done", 1.0)
    return result_of(problem, state, errors, converged, iterations, doubts), state


def estimate_starts(problem: Problem, values: Sequence[float]) -> State:
    """The state at given values [SI] of the requested parameters; each log's initial state, its
    sensors and the channels' scales are estimated there."""
    state = initial(problem)
    theta = state.theta.copy()
    theta[: problem.requested] = [c.of(x) for c, x in zip(problem.search, values, strict=False)]
    sensors = tuple(range(problem.requested, problem.fitted))
    state = replace(state, theta=theta, free=sensors, coarse=False)
    for _ in range(2):
        state, _ = solve(problem, state, 1e-4)
        state = weighed(problem, state)
    return state


def information(problem: Problem, state: State) -> tuple[list[Block], Prior]:
    """What each log says of the parameters and shared sensors at a state, and what is known of them
    besides."""
    which = range(problem.fitted)
    state = evaluate(problem, state)
    return linearised(problem, state, which), prior_of(problem, state, which)


def _over_ranges(problem: Problem, state: State, which: Sequence[int]) -> State:
    """Ask the whole range of parameters whose effect is faint: go where the logs favour them, fix
    those of which they deny a part, drop those of which they say nothing.

    Raises:
        InsufficientData: no parameter is left."""
    dropped = []
    for i in which:
        state = replace(
            state,
            at_bound=tuple(k for k in state.at_bound if k != i),
            free=tuple(sorted({*state.free, i})),
        )
        state = evaluate(problem, state)
        ((low, high),) = problem.room(state.theta, [i])
        every = np.linspace(low, high, SETTINGS.points)
        points = np.unique([*every, problem.search[i].begin])
        rises, effect = _rises(problem, state, i, points)
        possible, lowest = np.isfinite(rises).all(), int(np.argmin(rises))
        ranges = {k: ends for k, ends in state.ranges.items() if k != i}
        if (effect < PROBLEM.faint and possible) or (
            np.max(rises) < SETTINGS.denied * state.prior_weight
        ):
            dropped.append(i)
        else:
            better = _better(problem, state, i, float(rises[lowest]), float(points[lowest]))
            if better is None:
                ends, rise, value = _interval_ends(problem, state, i, points, rises)
                better = _better(problem, state, i, rise, value)
                if better is None:
                    state = replace(state.fixed(i), ranges={**state.ranges, i: ends})
                    continue
            state = better
        state = replace(state, ranges=ranges)
    for i in dropped:
        state = towards(problem, state, i, problem.search[i].of(problem.search[i].start))
    state = replace(
        state,
        free=tuple(i for i in state.free if i not in dropped),
        at_bound=tuple(i for i in state.at_bound if i not in dropped),
    )
    if not any(i < problem.requested for i in (*state.live, *state.ranges)):
        names = [c.name for c in problem.search[: problem.requested]]
        channels = {read_off(name, [log.record for log in problem.logs]) for name in names}
        if None in channels:
            raise InsufficientData(message("identification.nothing_told", names=", ".join(names)))
        fields = {
            "names": ", ".join(names),
            "channels": " and ".join(sorted(filter(None, channels))),
        }
        raise InsufficientData(message("identification.only_channels", **fields))
    return state


def _rises(problem: Problem, state: State, i: int, points: np.ndarray) -> tuple[np.ndarray, float]:
    """(by how much the cost is higher with a parameter at some points than here, the others
    following to first order; its largest effect, as `effects`, infinite where none is possible)."""
    others = state.fixed(i)
    blocks = linearised(problem, others, others.free)
    rises, sizes = np.zeros(len(points)), []
    residuals, here = scaled(problem, state), cost(problem, state)
    for n, value in enumerate(points):
        theta = state.moved(i, value).theta
        (moved,) = residuals_at(problem, state, [theta])
        if moved is None:
            rises[n] = math.inf
            continue
        point = replace(state.here, theta=theta, residuals=moved)
        there = replace(others, theta=theta, point=point)
        after = scaled(problem, state, moved)
        linear = [replace(b, residuals=r) for b, r in zip(blocks, after, strict=True)]
        gain = step(problem, there, linear, 0.0)[2]
        rises[n] = cost(problem, there) - gain - here
        change = [(a - b)[..., None] for a, b in zip(after, residuals, strict=True)]
        sizes += effects(problem, state, change).tolist()
    return rises, max(sizes, default=math.inf)


def _better(problem: Problem, state: State, i: int, rise: float, value: float) -> State | None:
    """Where a solution ends that begins with a parameter at a value at which the cost rises by
    ``rise``; None unless that is surely a fall, and the solution ends better than here."""
    if rise >= -SETTINGS.sure * state.prior_weight:
        return None
    influence = state.influence.copy()
    influence[i] = True  # what it does there is not what it does here
    there, _ = solve(problem, replace(state.moved(i, value), influence=influence), 1e-3)
    return there if cost(problem, there) < cost(problem, state) else None


def _interval_ends(
    problem: Problem, state: State, i: int, points: np.ndarray, rises: np.ndarray
) -> tuple[tuple[float, float], float, float]:
    """(between which values the logs do not deny a parameter, the bounds where they never do; the
    smallest rise met on the way there, and where). Between the last point at which it does nothing
    and the first that is denied may lie the value that the logs favour."""
    here, limit = float(state.theta[i]), SETTINGS.denied * state.prior_weight
    ends, lowest = [], (0.0, here)
    for side in (-1, 1):
        beyond = [k for k in range(len(points)) if (points[k] - here) * side > 0.0]
        inner, outer = here, None
        for k in beyond[::side]:
            if rises[k] > limit:
                outer = float(points[k])
                break
            inner = float(points[k])
        if outer is None:
            ends.append(float(points[::side][-1]))
            continue
        for _ in range(SETTINGS.halvings):
            middle = 0.5 * (inner + outer)
            (rise,), _ = _rises(problem, state, i, np.array([middle]))
            lowest = min(lowest, (float(rise), middle))
            inner, outer = (inner, middle) if rise > limit else (middle, outer)
        ends.append(outer)
    return (ends[0], ends[1]), *lowest
