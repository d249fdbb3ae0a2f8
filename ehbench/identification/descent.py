"""Descent to the nearest minimum: Levenberg and Marquardt within bounds, for all logs at once.

`scipy.optimize.least_squares` comes to the same estimates, but takes the initial states of the logs
as further columns of one Jacobian: 442 simulations where this takes 203 to 285, on six fits with
white noise. Here they are eliminated log by log, their derivatives serve several steps, and all
simulations that differences are taken of run together on one mesh."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ehbench.identification.covariance import Block, eliminate
from ehbench.identification.problem import (
    Problem,
    State,
    cost,
    evaluate,
    linearised,
    prior_of,
    start_jacobian,
    weighed,
)
from ehbench.identification.simulator import Shifts
from ehbench.vocabulary import setting


@dataclass(frozen=True)
class DescentSettings:
    """Numbers of the descent to a minimum."""

    rounds: int = setting(8, "", "largest number of rounds of weighing and solving", "few needed")
    settled: float = setting(
        0.03, "", "change of every scale below which the weights are settled", "of their own error"
    )
    damping: float = setting(1e-3, "", "damping of the first step", "Marquardt's")
    damping_min: float = setting(1e-9, "", "smallest damping", "arithmetic")
    damping_max: float = setting(1e9, "", "damping from which no step is possible", "arithmetic")
    easier: float = setting(0.1, "", "factor of damping after a good step", "Marquardt's")
    harder: float = setting(8.0, "", "factor of damping after a bad step", "near Marquardt's")
    good: float = setting(0.25, "", "share of the expected gain of a good step", "customary")
    faithful: float = setting(
        0.25,
        "",
        "share of the expected gain that may be missed until initial states are linearised anew",
        "saves a third of the simulations",
    )


SETTINGS = DescentSettings()


@dataclass(frozen=True, eq=False)
class _Descent:
    """A descent under way: where it stands, the state whose derivatives by the initial states it
    uses, its damping, and the number of steps taken."""

    state: State
    origin: State
    damping: float = field(default_factory=lambda: SETTINGS.damping)
    steps: int = 0


def solve(
    problem: Problem, state: State, tolerance: float, secant: bool = False
) -> tuple[State, bool]:
    """(the minimum over the free parameters and the logs' initial states, whether it converged).

    Args:
        tolerance: of the cost, as a share, that a last step would gain.
        secant: derivatives are carried from point to point (`carried`), and simulated only where
            they are not known."""
    journal, effort = problem.journal, problem.simulator.effort
    saved = journal.begin("descent", tolerance, *start_of(problem, state))
    descent, converged = _restored(problem, state, saved), False
    if "ended" in saved and saved["left"]:  # the last one goes on, for what it has in memory
        effort.iterations, effort.evaluations = saved["counted"]
        return descent.state, saved["ended"]
    while descent.steps < problem.max_iterations and not converged:
        effort.iterations += 1
        after = _stepped(problem, descent, tolerance, secant)
        descent, converged = after or descent, after is None
        if after is not None:
            journal.keep(
                progress_of(problem, descent.state.theta),
                state=_saved(descent.state),
                origin=None if descent.origin is descent.state else _saved(descent.origin),
                damping=descent.damping,
                steps=descent.steps,
                count=[effort.iterations, effort.evaluations],
            )
    count = [effort.iterations, effort.evaluations]
    journal.keep(progress_of(problem, descent.state.theta), ended=converged, counted=count)
    return descent.state, converged


def _stepped(
    problem: Problem, descent: _Descent, tolerance: float, secant: bool
) -> _Descent | None:
    """A descent after one more step; None where no step would gain more than the tolerance."""
    state, damping = descent.state, descent.damping
    _report(problem)
    linear = linearised(problem, state, state.free, start_jacobian(problem, descent.origin))
    before = cost(problem, state)
    while damping <= SETTINGS.damping_max:
        theta, shifts, gain = step(problem, state, linear, damping)
        if gain <= tolerance * before:
            return None
        there = evaluate(problem, state, theta, shifts)
        _report(problem)
        gained = before - cost(problem, there)
        if gained > 0.0:
            there = carried(there, state) if secant else there
            if gained > SETTINGS.good * gain:
                damping = max(damping * SETTINGS.easier, SETTINGS.damping_min)
            faithful = abs(gained - gain) < SETTINGS.faithful * gain
            origin = descent.origin if faithful or secant else there
            return _Descent(there, origin, damping, descent.steps + 1)
        damping *= SETTINGS.harder
    return None


def carried(there: State, before: State) -> State:
    """A state with the derivatives of the one before, turned along the step between them until they
    explain what it has changed (Broyden 1965); parameters count by the size of their effect."""
    here, point = before.here, there.here
    moves = {i: float(point.theta[i] - here.theta[i]) for i in before.free}
    sizes = {
        i: sum(float(np.sum(column**2)) for (j, _), column in here.columns.items() if j == i)
        for i in moves
    }
    total = sum(moves[i] ** 2 * size for i, size in sizes.items())
    columns = dict(here.columns)
    for k, (after, residual) in enumerate(zip(point.residuals, here.residuals, strict=True)):
        left = after - residual
        for j, shift in enumerate(point.shifts[k] - here.shifts[k]):
            left = left - here.start_columns.get((k, j), 0.0) * shift
        for i, move in moves.items():
            left = left - columns.get((i, k), 0.0) * move
        for i, move in moves.items():
            if (i, k) in columns and total:
                columns[i, k] = columns[i, k] + left * (move * sizes[i] / total)
    known = {"columns": columns, "start_columns": dict(here.start_columns)}
    return replace(there, point=replace(point, **known))


def step(
    problem: Problem, state: State, blocks: Sequence[Block], damping: float
) -> tuple[np.ndarray, Shifts, float]:
    """(theta, shifts after a step of the free parameters, what it should gain of the cost)."""
    solved = [eliminate(block, state.prior_weight) for block in blocks]
    free, bounds = list(state.free), problem.bounds(state.free)
    prior = prior_of(problem, state, free)
    normal = np.sum([item.normal for item in solved], axis=0) + prior.normal
    gradient = np.sum([item.gradient for item in solved], axis=0) + prior.gradient
    theta, move = state.theta.copy(), np.zeros(len(free))
    if free:
        for _ in range(3):
            move = bounded_step(normal, gradient, damping, *(bounds - state.theta[free][:, None]).T)
            theta[free] = np.clip(state.theta[free] + move, *bounds.T)
            if not problem.simulator.misfit(problem.values(theta)):
                break
            # one parameter limits another: how far each may go of the way that it would
            way = np.sort([state.theta[free], theta[free]], axis=0).T
            room = problem.room(state.theta, free, way)
            bounds = np.where(room == way, bounds, room)
    shifts, gain = [], -float(2.0 * gradient @ move + move @ normal @ move)
    for shift, item, block in zip(state.shifts, solved, blocks, strict=True):
        shifts.append(shift + item.move - item.gain @ move)
        inner = (
            np.einsum("tcn,tc->n", block.start_jacobian, block.residuals)
            + state.prior_weight * shift
        )
        gain -= float(inner @ item.move)
    return theta, shifts, gain


def bounded_step(
    normal: np.ndarray, gradient: np.ndarray, damping: float, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """The step ``d`` within ``low ≤ d ≤ high`` that minimises ``dᵀ(H + λ diag H) d/2 + gᵀd``.

    Args:
        normal: H, shape (n, n), positive semidefinite.
        gradient: g, shape (n,).
        damping: λ."""
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    matrix = normal / np.outer(size, size) + (damping + 1e-12) * np.eye(len(size))
    values, vectors = np.linalg.eigh(matrix)
    values = np.maximum(values, 1e-13 * values[-1])
    aim = vectors.T @ (gradient / size) / np.sqrt(values)
    root = np.sqrt(values)[:, None] * vectors.T
    move = -np.linalg.solve(root, aim)
    if np.any(move < low * size) or np.any(move > high * size):
        from scipy.optimize import lsq_linear  # a quarter of a second to import

        inside = (np.minimum(low * size, -1e-12), np.maximum(high * size, 1e-12))
        move = lsq_linear(root, -aim, inside, method="bvls").x
    return np.clip(move / size, low, high)


def settle(problem: Problem, state: State) -> tuple[State, bool]:
    """(the state once the weights are settled by weighing and solving, whether it converged)."""
    converged = False
    for _ in range(SETTINGS.rounds):
        before = state.scales
        state = weighed(problem, evaluate(problem, state))
        change = max(abs(math.log(state.scales[c] / before[c])) for c in before)
        if converged and change < SETTINGS.settled:
            break
        state, converged = solve(problem, state, 1e-6)
    return state, converged


def constrained(problem: Problem, state: State, i: int, theta: float) -> tuple[State, float]:
    """(the minimum with a parameter fixed at a search coordinate, its cost), from a state."""
    fixed, _ = solve(problem, state.moved(i, theta).fixed(i), 1e-7)
    return replace(fixed, free=state.free), cost(problem, fixed)


def _report(problem: Problem) -> None:
    count = problem.simulator.effort.iterations
    problem.report("output error: fitting", count / (count + 6.0))


def start_of(problem: Problem, state: State) -> tuple[object, ...]:
    """All that a step of the search starts from, for the journal."""
    mesh = None if state.point is None else state.point.mesh
    names = [(c.name, c.bounds, c.start) for c in problem.search]
    numbers = (
        state.free,
        sorted(state.scales.items()),
        state.prior_weight,
        state.coarse,
        None if mesh is None else mesh.slack,
        [log.counts.shape for log in problem.logs],
    )
    arrays = [state.theta, state.influence, *state.shifts]
    arrays += [] if mesh is None else [mesh.theta, *mesh.shifts]
    return (names, numbers, *(item.tobytes() for item in arrays))


def progress_of(problem: Problem, theta: np.ndarray) -> dict[str, object]:
    """How far the search is, for who reads the journal: evaluations, and parameters [SI]."""
    values = list(problem.by_name(theta).items())[: problem.requested]
    return {"evaluations": problem.simulator.effort.evaluations, "parameters": dict(values)}


def _saved(state: State) -> dict[str, Any]:
    """A point, and where its mesh was chosen, as plain values."""
    mesh = state.here.mesh
    return {
        "theta": state.theta.tolist(),
        "shifts": [shift.tolist() for shift in state.shifts],
        "mesh_theta": mesh.theta.tolist(),
        "mesh_shifts": [shift.tolist() for shift in mesh.shifts],
    }


def _restored(problem: Problem, state: State, saved: Mapping[str, Any]) -> _Descent:
    """Where a descent begins, or goes on after its last step that the journal knows."""
    if "steps" not in saved:
        state = evaluate(problem, state)
        return _Descent(state, state)

    def restored(part: str) -> State:
        point, where = saved[part], replace(state, point=None)
        for prefix in ("mesh_", ""):  # the mesh is chosen where it was, then serves the point
            shifts = [np.array(shift, dtype=float) for shift in point[f"{prefix}shifts"]]
            where = evaluate(problem, where, np.array(point[f"{prefix}theta"]), shifts)
        return where

    there = origin = restored("state")
    if saved["origin"] is not None:
        origin = restored("origin")
        start_jacobian(problem, origin)  # it was known
    effort = problem.simulator.effort
    effort.iterations, effort.evaluations = saved["count"]
    return _Descent(there, origin, saved["damping"], saved["steps"])
