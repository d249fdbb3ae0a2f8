"""From where parameters start to the basin of the best minimum: a look over their range, and coarse
solutions from what it met."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ehbench.identification.descent import SETTINGS as DESCENT
from ehbench.identification.descent import progress_of, solve, start_of, step
from ehbench.identification.problem import SETTINGS as PROBLEM
from ehbench.identification.problem import (
    Problem,
    State,
    at_values,
    by_channel,
    effects,
    evaluate,
    initial,
    jacobian,
    linearised,
    pooled,
    residuals_at,
    scaled,
    squares,
    weighed,
)
from ehbench.vocabulary import setting


@dataclass(frozen=True)
class BasinSettings:
    """Numbers of the search for the basin of the best minimum."""

    reach: float = setting(
        math.log(10.0), "", "reach of the look either way, in units of a parameter", "a decade"
    )
    coarse: int = setting(11, "", "points of the look over the bulk modulus", "broad basins")
    fine: int = setting(
        97, "", "points over any other parameter", "2.4 % in frequency: 20 cycles still tell it"
    )
    damping: float = setting(
        1.4, "", "logarithm of the factor by which the look varies the damping", "a factor of 4"
    )
    rival: float = setting(
        3.0, "", "cost of another basin over the best up to which it is tried", "few are"
    )
    rivals: int = setting(3, "", "largest number of other basins that are tried", "time")
    slack: float = setting(
        1000.0, "", "error of integration in the look over that of the fit", "points lie 5 % apart"
    )
    much: float = setting(
        0.01,
        "",
        "mean square residual, share of the spread's, from which more starts are tried",
        "a tenth of the spread",
    )


SETTINGS = BasinSettings()


@dataclass(frozen=True, eq=False)
class _End:
    """Where a coarse solution ended, its misfit, and whether much is left of the spread."""

    state: State
    misfit: float
    much: bool


def nearest_basin(problem: Problem, state: State) -> State:
    """Coarsely the best that a look over the range of the parameters leads to, or that lies near
    where they start.

    Where the solutions from the look leave much, it is no worse than solutions over ever more of
    the parameters, nor than those in which one stays at its start."""
    starts, looks = _look(problem, state)
    every, begin = state.free, state.theta

    def solved(start: np.ndarray, free: Sequence[int]) -> _End:
        return _coarse(problem, state, start, free)

    ends = [solved(start, every) for start in starts]
    if len(every) > 1 and all(end.much for end in ends):
        ends += [solved(begin, every), _chain(solved, begin, every, looks)]
        best = min(ends, key=_misfit_of)
        for i in every:
            start = best.state.theta.copy()
            start[i] = problem.search[i].begin
            without = solved(start, [k for k in every if k != i])
            if without.misfit < best.misfit:
                best = min(without, solved(without.state.theta, every), key=_misfit_of)
        ends.append(best)
    return min(ends, key=_misfit_of).state


def descend(problem: Problem, values: Mapping[str, float]) -> tuple[State, float]:
    """(the minimum next to some values, by name, each channel weighed by its residual; its
    `level`). Derivatives are carried to the end, which saves a quarter of all simulations: ends are
    compared to a few percent."""
    state = at_values(problem, values)
    state = _coarse(problem, state, state.theta, state.free).state
    state, _ = solve(problem, weighed(problem, evaluate(problem, state)), 1e-3, secant=True)
    return state, level(problem, state.here.residuals)


def foreseen(
    problem: Problem, values: Mapping[str, float], known: tuple[Problem, State] | None = None
) -> tuple[float, State]:
    """(what `descend` would come to if the problem were as linear as it is at its start, the state
    there).

    Args:
        known: another problem over the same logs, and its state, whose derivatives serve where
            both simulate a log alike."""
    state = weighed(problem, evaluate(problem, at_values(problem, values)))
    if known is not None:
        _take_over(problem, state, *known)
    blocks = linearised(problem, state, state.free)
    theta, shifts, _ = step(problem, state, blocks, DESCENT.damping_min)
    move = (theta - state.theta)[list(state.free)]
    pairs = zip(blocks, problem.logs, shifts, state.shifts, strict=True)
    residuals = [
        (block.residuals + block.jacobian @ move + block.start_jacobian @ (new - old))
        * by_channel(state.scales, log)
        for block, log, new, old in pairs
    ]
    return level(problem, residuals), state


def _take_over(problem: Problem, state: State, other: Problem, known: State) -> None:
    """Derivatives by the same numbers at another problem's state, of logs simulated alike there."""
    here, there = state.here, known.here
    for k, (log, old) in enumerate(zip(problem.logs, other.logs, strict=True)):
        limit = PROBLEM.faint * by_channel(problem.spread, log)
        if log.channels != old.channels or np.any(
            np.abs(here.residuals[k] - there.residuals[k]) > limit
        ):
            continue
        for i, coordinate in enumerate(problem.search):
            if coordinate in other.search:
                column = there.columns.get((other.search.index(coordinate), k))
                here.columns.update({} if column is None else {(i, k): column})
        for j, number in enumerate(log.start.uncertain):
            if number in old.start.uncertain:
                column = there.start_columns.get((k, old.start.uncertain.index(number)))
                here.start_columns.update({} if column is None else {(k, j): column})


def level(problem: Problem, residuals: Sequence[np.ndarray]) -> float:
    """Logarithms of the mean squares of residuals [SI], added up over the channels."""
    sizes = (pooled(problem.logs, c, residuals) for c in problem.spread)
    return sum(2.0 * math.log(max(size, 1e-300)) for size in sizes)


def _look(problem: Problem, state: State) -> tuple[list[np.ndarray], list[tuple[int, np.ndarray]]]:
    """(the best point of a look and the bottoms of other basins that are not much worse; where the
    look stood after each parameter).

    Bulk modulus and damping together, then each other parameter that is positive or has no range,
    and no prior, on one log for each set of cylinders: least squares from far off could lock on to
    the wrong cycle of the ringing."""
    first: dict[tuple[str, ...], int] = {}
    for k, log in enumerate(problem.logs):
        first.setdefault(log.commanded, k)
    chosen, search = list(first.values()), problem.search
    bulk, damping = (
        [i for i in state.free if search[i].row.mode_role == role and search[i].log]
        for role in ("frequency", "decay")
    )
    groups = [
        [i]
        for i, c in enumerate(search[: problem.requested])
        if c.roams and not c.known and i not in (*bulk, *damping)
    ]
    rivals: list[tuple[float, np.ndarray]] = []
    looks, best = [], math.inf
    for group in [bulk, *groups] if bulk else groups:
        vectors, each = _points(problem, state.theta, group, damping if group is bulk else [])
        costs = _costs(problem, state, vectors, chosen)
        lowest = int(np.argmin(costs))
        state, best = replace(state, theta=vectors[lowest]), float(costs[lowest])
        looks.append((max(group), state.theta))
        valley = np.min(costs[each:].reshape(-1, each), axis=1)
        bottoms = np.flatnonzero((valley[1:-1] < valley[:-2]) & (valley[1:-1] < valley[2:]))
        for k in each + each * (bottoms + 1):
            bottom = int(k) + int(np.argmin(costs[k : k + each]))
            if not np.array_equal(vectors[bottom], vectors[lowest]):
                rivals.append((float(costs[bottom]), vectors[bottom]))
    near = sorted(
        (value, k) for k, (value, _) in enumerate(rivals) if value < SETTINGS.rival * best
    )
    return [state.theta, *(rivals[k][1] for _, k in near[: SETTINGS.rivals])], looks


def _points(
    problem: Problem, theta: np.ndarray, group: Sequence[int], damping: Sequence[int]
) -> tuple[list[np.ndarray], int]:
    """(points of a look along a group of parameters, from here and then from one end to the other,
    how many dampings it takes at each)."""
    low, high = problem.bounds(range(len(problem.search))).T
    some = list(group)
    ends = (
        max(-SETTINGS.reach, max(low[some] - theta[some])),
        min(SETTINGS.reach, min(high[some] - theta[some])),
    )
    bulk = problem.search[some[0]].row.mode_role == "frequency"
    losses = (0.0, -SETTINGS.damping, SETTINGS.damping) if damping else (0.0,)
    vectors = []
    for shift in (0.0, *np.linspace(*ends, SETTINGS.coarse if bulk else SETTINGS.fine)):
        for loss in losses:
            point = theta.copy()
            point[some] += shift
            point[list(damping)] += loss
            vectors.append(np.clip(point, low + 1e-6, high - 1e-6))
    return vectors, len(losses)


def _costs(
    problem: Problem, state: State, vectors: Sequence[np.ndarray], chosen: Sequence[int]
) -> np.ndarray:
    """Squares of the scaled residuals at some points, over some logs; a step of the journal."""
    start = (*start_of(problem, state), np.array(vectors).tobytes(), chosen)
    saved = problem.journal.begin("look", *start)
    if "costs" in saved:
        problem.simulator.effort.evaluations = saved["evaluations"]
        return np.array(saved["costs"])
    costs = [
        math.inf
        if parts is None
        else sum(float(np.sum(part**2)) for part in scaled(problem, state, parts, chosen))
        for parts in residuals_at(problem, state, vectors, chosen, SETTINGS.slack)
    ]
    best = vectors[int(np.argmin(costs))]
    problem.journal.keep(
        progress_of(problem, best), costs=costs, evaluations=problem.simulator.effort.evaluations
    )
    return np.array(costs)


def _chain(
    solved: Callable[[np.ndarray, Sequence[int]], _End],
    begin: np.ndarray,
    every: Sequence[int],
    looks: Sequence[tuple[int, np.ndarray]],
) -> _End:
    """Where solutions over ever more of the parameters end, in their order: each begins where the
    one before ended and where the look stood, so none ends worse than one over fewer."""
    end = solved(begin, every[:1])
    for count in range(1, len(every) + 1):
        some = list(every[:count])
        look = [theta for last, theta in looks if last <= some[-1]][-1:]
        if look:
            start = begin.copy()
            start[some] = look[0][some]
            end = min(end, solved(start, some), key=_misfit_of)
        end = min(end, solved(end.state.theta, some), key=_misfit_of)
    return end


def _coarse(problem: Problem, state: State, start: np.ndarray, free: Sequence[int]) -> _End:
    """Where a coarse solution over some of the free parameters ends; first every channel counts by
    its spread, then, where much is left, by its residual."""
    fresh = initial(problem)
    whole = replace(state, theta=start, shifts=fresh.shifts, scales=fresh.scales)
    here = weighed(problem, evaluate(problem, whole), scales=False)
    sizes = effects(problem, here, jacobian(problem, here, free))
    some = tuple(i for i, size in zip(free, sizes, strict=True) if size >= PROBLEM.faint)
    here, _ = solve(problem, replace(here, free=some), 1e-3)
    much = squares(problem, here) > SETTINGS.much * sum(r.size for r in here.here.residuals)
    if much:
        here, _ = solve(problem, weighed(problem, here), 1e-3)
    misfit = 0.0  # below the floor of the scales it is linear
    for channel, spread in problem.spread.items():
        share = pooled(problem.logs, channel, here.here.residuals) / (PROBLEM.scale_floor * spread)
        misfit += 2.0 * math.log(share) if share > 1.0 else share**2 - 1.0
    return _End(replace(here, free=whole.free, scales=whole.scales), misfit, much)


def _misfit_of(end: _End) -> float:
    return end.misfit
