"""How sure a fit by output error is of its parameters, and what it says of those that it held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ehbench.identification.covariance import Block, covariance_of, eliminate
from ehbench.identification.descent import FAINT, Descent, Point
from ehbench.identification.groups import Group, groups_of, sentence
from ehbench.identification.results import (
    Estimate,
    FittedParameter,
    HydraulicsFit,
    Lean,
    SensorFit,
    finish,
    not_excited,
)
from ehbench.identification.search import VAGUE, Coordinate
from ehbench.vocabulary.terms import CORRELATED, Z95


@dataclass(frozen=True)
class Error:
    """A standard error in search coordinates, its interval's quantile, where it is from, what it
    means, the share of what is known of the parameter that is from the data, and the share of its
    variance that the logs' starts are to blame for."""

    std: float
    quantile: float
    source: str
    kind: str
    from_data: float
    from_starts: float


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors by index of the parameter, and the correlation between the free ones, in the order of
    their names, the point they belong to, what each log says there, the covariance of those that
    are live, and the standard error each would have if all others were known."""

    by_index: dict[int, Error]
    names: tuple[str, ...]
    correlation: np.ndarray
    here: Point
    blocks: list[Block]
    covariance: np.ndarray
    alone: np.ndarray


def errors_of(fit: Descent) -> Errors:
    """Standard errors of the parameters in search coordinates, and what they mean; all of them
    as if none were held at a bound.
    """
    live = sorted(fit.free + fit.bound)
    here = fit.point(fit.theta, fit.shifts)
    slopes = fit.slopes(here, live)
    blocks = fit.blocks(here, slopes, fit.nudges(here))
    match = covariance_of(blocks, fit.prior(fit.theta, live))
    effects, correlation = fit.effects(slopes, live), match.correlation
    inside = [k for k, i in enumerate(live) if not _at_bound(fit, i)]
    result = {}
    for k, i in enumerate(live):
        std, quantile, source = match.error(k)
        vague = VAGUE[fit.search[i].log]
        others = np.abs(correlation[k, [j for j in inside if j != k]])
        if effects[i] < FAINT or match.alone[k] > vague:
            kind = "not_excited"
        elif k not in inside:
            kind = "at_bound"
        elif std > vague or np.max(others, initial=0.0) > CORRELATED:
            kind = "correlated"
        else:
            kind = "estimated"
        result[i] = Error(
            std, quantile, source, kind, *map(float, (match.from_data[k], match.from_starts[k]))
        )
    names = tuple(fit.search[live[k]].name for k in inside)
    among = correlation[np.ix_(inside, inside)]
    return Errors(result, names, among, here, blocks, match.hac, match.alone)


def _groups(fit: Descent, result: Errors) -> tuple[Group, ...]:
    """The products of parameters that the logs know though they do not know each; one that ran
    into its bound is taken for known there, as the search takes it.
    """
    live = sorted(fit.free + fit.bound)
    normal = np.sum([eliminate(b, fit.weight).normal for b in result.blocks], axis=0)
    inside = [k for k, i in enumerate(live) if not _at_bound(fit, i)]
    logs = [k for k in inside if live[k] < fit.asked and fit.search[live[k]].log]
    rest = [k for k in inside if k not in logs]
    if len(logs) < 2:
        return ()
    inner = np.linalg.pinv(normal[np.ix_(rest, rest)])
    own = normal[np.ix_(logs, logs)]
    own = own - normal[np.ix_(logs, rest)] @ inner @ normal[np.ix_(rest, logs)]
    ideal = np.sqrt(1.0 / np.maximum(np.diag(normal), 1e-300))
    widening = [result.alone[k] / ideal[k] for k in logs]
    names = [fit.search[live[k]].name for k in logs]
    values = [fit.search[live[k]].at(fit.theta[live[k]]) for k in logs]
    return groups_of(names, values, own, float(np.median(widening)))


def _at_bound(fit: Descent, i: int) -> bool:
    return i in fit.bound or fit.theta[i] in fit.search[i].bounds


def result_of(
    fit: Descent,
    result: Errors,
    converged: bool,
    held: Sequence[str] = (),
    leans: Sequence[Lean] = (),
) -> HydraulicsFit:
    """A fit as it leaves: ``held`` are warnings of what it holds, ``leans`` what it leans on."""
    samples = sum(log.each * int(log.counts.any(axis=1).sum()) for log in fit.simulator.logs)
    fitted = []
    for i, c in enumerate(fit.search[: fit.asked]):
        item, error = not_excited(c, samples), result.by_index.get(i)
        if error is not None and error.kind != "not_excited":
            std, ends = c.spread(fit.theta[i], error.std, error.quantile)
            item = replace(
                item,
                value=c.at(fit.theta[i]),
                std=std,
                interval=ends,
                status=error.kind,
                error_from=error.source,
                prior=c.prior if c.known else None,
                from_data=error.from_data,
                from_starts=error.from_starts,
            )
        fitted.append(_within(fit, item, i) if i in fit.ranged else item)
    warnings = [*held, *_flat(fit)]
    if not converged:
        warnings.append(
            f"the fit stopped after {fit.most} evaluations without converging; its numbers "
            "are not final"
        )
    groups = _groups(fit, result)
    warnings += [sentence(groups)] if groups else []
    messages = [set(group.alone) for group in groups]
    warnings += together(result.names, result.correlation, messages)
    return finish(
        fit.simulator,
        Estimate(
            method="output_error",
            fitted=fitted,
            warnings=warnings,
            iterations=fit.iterations,
            names=result.names,
            correlation=result.correlation,
            scales=fit.scales,
            cutoff=fit.cutoff,
            shifts=fit.shifts,
            groups=groups,
            leans=leans,
            held=[
                *(c.at(fit.theta[i]) for i, c in _shared(fit)),
                *(c.start for c in fit.search[fit.fitted :]),
            ],
            sensors=_sensors(fit, result),
        ),
    )


def together(names: Sequence[str], correlation: np.ndarray, shown: Sequence[set[str]]) -> list[str]:
    """A warning of each set of parameters that hang together by pairs of strong correlation, but
    for those pairs that a group of ``told`` names already says.
    """
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
    sentences = []
    for members in sorted(sets, key=min):
        own = [pair for pair in pairs if members.issuperset(pair)]
        first, second = max(own, key=lambda pair: abs(correlation[pair]))
        by = f"{correlation[first, second]:+.3f}"
        listed = [names[i] for i in sorted(members)]
        message = f"{', '.join(listed[:-1])} and {listed[-1]} are correlated"
        if len(listed) == 2:
            sentences.append(f"{message} by {by}: the logs tell them only together")
        else:
            maximum = f"{names[first]} and {names[second]} most, by {by}"
            sentences.append(
                f"{message} with one another, {maximum}: the logs tell them only together"
            )
    return sentences


def _within(fit: Descent, item: FittedParameter, i: int) -> FittedParameter:
    """A parameter of which the logs deny a part of the range, the rest being one to them."""
    c, value = fit.search[i], fit.search[i].at(fit.theta[i])
    low, high = (c.at(end) for end in fit.ranged[i])
    return replace(
        item,
        value=value,
        std=(high - low) / (2.0 * Z95),
        interval=(low, high),
        status="estimated",
        error_from="range",
        prior=c.prior if c.known else None,
    )


def _flat(fit: Descent) -> list[str]:
    """A note of each parameter that the logs tell by its range alone."""

    def said(c: Coordinate, value: float) -> str:
        own = c.quantity is None  # else of a sensor
        return fit.simulator.rig.shown(c.name, value) if own else f"{value:.4g} {c.row.unit}"

    return [
        f"{c.name} may be anything from {said(c, c.at(low))} to {said(c, c.at(high))} for "
        "these logs, which deny the rest of its range"
        for i, (low, high) in fit.ranged.items()
        for c in [fit.search[i]]
    ]


def _shared(fit: Descent) -> list[tuple[int, Coordinate]]:
    """(index, coordinate) of what all logs' sensors share."""
    return [(i, fit.search[i]) for i in range(fit.asked, fit.fitted)]


def _sensors(fit: Descent, match: Errors) -> list[SensorFit]:
    """What was found of the sensors: of all logs, then of each."""
    result = []
    terms = {term.name: term for term in fit.simulator.logs[0].start.terms}
    for i, c in _shared(fit):
        error, quantile = match.by_index.get(i), 1.96
        std = terms[c.name].std
        if error is not None:
            std, quantile = c.unit * error.std, error.quantile
        result.append(SensorFit.of(terms[c.name], "", c.at(fit.theta[i]), std, quantile))
    for log, shifts, block in zip(fit.simulator.logs, fit.shifts, match.blocks, strict=True):
        errors = eliminate(block, fit.weight).std(match.covariance)
        terms = {term.name: term for term in log.start.terms}
        for doubt, shift, error in zip(log.start.uncertain, shifts, errors, strict=True):
            if doubt.name in terms:
                at, std = doubt.std * float(shift), doubt.std * float(error)
                result.append(SensorFit.of(terms[doubt.name], log.name, at, std, 1.96))
    return result
