"""How sure a fit by output error is of its parameters."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ehbench.identification import results
from ehbench.identification.covariance import Block, correlation_of, covariance_of, eliminate
from ehbench.identification.groups import Group, groups_of, sentence
from ehbench.identification.problem import SETTINGS as PROBLEM
from ehbench.identification.problem import (
    Problem,
    State,
    effects,
    fixed_changes,
    linearised,
    prior_of,
)
from ehbench.identification.search import VAGUE
from ehbench.vocabulary import Z95, message
from ehbench.vocabulary.terms import CORRELATED

ROUNDING = 1e-9  # share of the reach within which a number is at its bound


@dataclass(frozen=True)
class Error:
    """A standard error in search coordinates, its interval's quantile, where it is from, what it
    means, the share of what is known of the parameter that is from the data, and the shares of its
    variance that the logs' starts and errors of fixed numbers are to blame for."""

    std: float
    quantile: float
    source: str
    kind: str
    from_data: float
    from_starts: float
    from_fixed: float


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors by index of the parameter, and the correlation between the free ones, in the order of
    their names, of the whole errors and of those by the logs alone, the state they belong to, what
    each log says there, the covariance of those that are live, and the standard error each would
    have if all others were known."""

    by_index: dict[int, Error]
    names: tuple[str, ...]
    correlation: np.ndarray
    by_logs: np.ndarray
    state: State
    blocks: list[Block]
    covariance: np.ndarray
    alone: np.ndarray

    def with_ranges(self) -> "Errors":
        """With those free, too, of which the logs deny a part of their range: known by what is
        left of it, without the derivatives there."""
        state, ranges = self.state, self.state.ranges
        known = {
            i: Error((high - low) / (2.0 * Z95), Z95, "range", "estimated", 1.0, 0.0, 0.0)
            for i, (low, high) in ranges.items()
        }
        columns = {(i, k): by for (i, k), by in state.here.columns.items() if i not in ranges}
        free, point = tuple(sorted({*state.free, *ranges})), replace(state.here, columns=columns)
        state = replace(state, free=free, ranges={}, point=point)
        return replace(self, by_index=self.by_index | known, state=state)


def errors_of(problem: Problem, state: State) -> Errors:
    """Standard errors of the parameters in search coordinates at an evaluated state, and what they
    mean; all of them as if none were fixed at a bound."""
    live = state.live
    blocks = linearised(problem, state, live)
    match = covariance_of(blocks, prior_of(problem, state, live), fixed_changes(problem, state))
    sizes = effects(problem, state, [block.jacobian for block in blocks])
    correlation = match.correlation
    inside = [k for k, i in enumerate(live) if not _at_bound(problem, state, i)]
    result = {}
    for k, i in enumerate(live):
        std, quantile, source = match.error(k)
        vague = VAGUE[problem.search[i].log]
        others = correlation[k, [j for j in inside if j != k]]
        if sizes[k] < PROBLEM.faint or match.alone[k] > vague:
            kind = "not_excited"
        elif k not in inside:
            kind = "at_bound"
        elif std > vague or np.any(np.abs(others) > CORRELATED):
            kind = "correlated"
        else:
            kind = "estimated"
        shares = match.from_data[k], match.from_starts[k], match.from_fixed[k]
        result[i] = Error(std, quantile, source, kind, *map(float, shares))
    names = tuple(problem.search[live[k]].name for k in inside)
    among = np.ix_(inside, inside)
    whole = correlation_of(match.whole)[among], correlation[among]
    return Errors(result, names, *whole, state, blocks, match.whole, match.alone)


def _groups(problem: Problem, result: Errors) -> tuple[Group, ...]:
    """The products of parameters that the logs know though they do not know each; one that ran
    into its bound is taken for known there, as the search takes it."""
    state, live = result.state, result.state.live
    normal = np.sum([eliminate(b, state.prior_weight).normal for b in result.blocks], axis=0)
    inside = [k for k, i in enumerate(live) if not _at_bound(problem, state, i)]
    logs = [k for k in inside if live[k] < problem.requested and problem.search[live[k]].log]
    rest = [k for k in inside if k not in logs]
    if not logs:
        return ()
    inner = np.linalg.pinv(normal[np.ix_(rest, rest)])
    projected = normal[np.ix_(logs, logs)]
    projected = projected - normal[np.ix_(logs, rest)] @ inner @ normal[np.ix_(rest, logs)]
    widening = (result.alone * np.sqrt(np.diag(normal)))[logs]
    names = [problem.search[live[k]].name for k in logs]
    values = [problem.search[live[k]].at(state.theta[live[k]]) for k in logs]
    return groups_of(names, values, projected, float(np.median(widening)))


def _at_bound(problem: Problem, state: State, i: int) -> bool:
    c = problem.search[i]
    near = any(abs(state.theta[i] - bound) <= ROUNDING * c.reach for bound in c.bounds)
    return i in state.at_bound or near or bool(problem.limit_at(state.theta, i))


def result_of(
    problem: Problem,
    state: State,
    errors: Errors,
    converged: bool,
    iterations: int,
    doubts: results.Doubts,
) -> results.HydraulicsFit:
    """A fit as it leaves, with what it took as known and the logs deny."""
    fitted = [_fitted(problem, state, errors, i) for i in range(problem.requested)]
    warnings, rig = [*doubts.warnings], problem.simulator.rig
    for i in (i for i in state.ranges if i < problem.requested):
        c = problem.search[i]
        low, high = (rig.shown(c.name, c.at(end)) for end in state.ranges[i])
        warnings.append(message("identification.flat", name=c.name, low=low, high=high))
    for i, item in enumerate(fitted):
        if item.status == "at_bound" and (reason := problem.limit_at(state.theta, i)):
            fields = {"name": item.name, "value": rig.shown(item.name, item.value)}
            warnings.append(message("identification.at_limit", reason=reason, **fields))
    if not converged:
        count = problem.max_iterations
        warnings.append(message("identification.not_converged", count=count))
    groups = _groups(problem, errors)
    warnings += [sentence(groups)] if groups else []
    warnings += together(errors.names, errors.by_logs, [set(g.alone) for g in groups])
    shared = range(problem.requested, problem.fitted)
    return results.finish(
        problem.simulator,
        results.Estimate(
            method="output_error",
            fitted=fitted,
            warnings=warnings,
            iterations=iterations,
            names=errors.names,
            correlation=errors.correlation,
            scales=state.scales,
            cutoff=problem.cutoff,
            shifts=state.shifts,
            groups=groups,
            doubts=doubts,
            shared=[problem.search[i].at(state.theta[i]) for i in shared],
            sensors=_sensors(problem, errors),
        ),
    )


def _fitted(problem: Problem, state: State, errors: Errors, i: int) -> results.FittedParameter:
    c, error = problem.search[i], errors.by_index.get(i)
    samples = sum(log.each * int(log.counts.any(axis=1).sum()) for log in problem.logs)
    item, value = results.not_excited(c, samples), c.at(state.theta[i])
    prior = c.prior if c.known else None
    if i in state.ranges:  # the logs deny a part of its range, the rest is one to them
        low, high = state.ranges[i]
        ends = c.at(low), c.at(high)
        std = (ends[1] - ends[0]) / (2.0 * Z95)
        item = replace(item, value=value, std=std, interval=ends, prior=prior)
        return replace(item, status="estimated", error_from="range")
    if error is None or error.kind == "not_excited":
        return item
    std, ends = c.spread(state.theta[i], error.std, error.quantile)
    return replace(
        item,
        value=value,
        std=std,
        interval=ends,
        status=error.kind,
        error_from=error.source,
        prior=prior,
        from_data=error.from_data,
        from_starts=error.from_starts,
        from_fixed=error.from_fixed,
    )


def together(names: Sequence[str], correlation: np.ndarray, shown: Sequence[set[str]]) -> list[str]:
    """A warning of each set of parameters that hang together by pairs of strong correlation, but
    for those pairs whose names are in a group that is ``shown`` already."""
    pairs = [
        (b, a)
        for a, name in enumerate(names)
        for b, other in enumerate(names[:a])
        if abs(correlation[a, b]) > CORRELATED and not any({name, other} <= item for item in shown)
    ]
    sets: list[set[int]] = []
    for pair in pairs:
        met = [item for item in sets if item & {*pair}]
        sets = [item for item in sets if item not in met] + [set(pair).union(*met)]
    warnings: list[str] = []
    for members in sorted(sets, key=min):
        inside = [pair for pair in pairs if members.issuperset(pair)]
        first, second = max(inside, key=lambda pair: abs(correlation[pair]))
        *listed, last = (names[i] for i in sorted(members))
        key = "correlated" if len(members) == 2 else "correlated_set"
        warnings.append(
            message(
                f"identification.{key}",
                names=f"{', '.join(listed)} and {last}",
                first=names[first],
                second=names[second],
                by=correlation[first, second],
            )
        )
    return warnings


def _sensors(problem: Problem, errors: Errors) -> list[results.SensorFit]:
    """The estimates of the sensors: of all logs, then of each."""
    result, state = [], errors.state
    terms = {term.name: term for log in problem.logs for term in log.start.terms}
    for i in range(problem.requested, problem.fitted):
        c, error, quantile = problem.search[i], errors.by_index.get(i), Z95
        std = terms[c.name].std
        if error is not None:
            std, quantile = c.unit * error.std, error.quantile
        result.append(results.SensorFit.of(terms[c.name], "", c.at(state.theta[i]), std, quantile))
    for log, shifts, block in zip(problem.logs, state.shifts, errors.blocks, strict=True):
        stds = eliminate(block, state.prior_weight).std(errors.covariance)
        for item, shift, std in zip(log.start.uncertain, shifts, stds, strict=True):
            if item.name in terms:
                value = item.std * float(shift)
                error = item.std * float(std)
                result.append(results.SensorFit.of(terms[item.name], log.name, value, error, Z95))
    return result
