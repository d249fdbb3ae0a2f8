"""The gain of the pressure feedback: the best worst case over operating points.

Gains are chosen on `ehbench.tune.linear` models: the gain with the largest least damping ratio over
all operating points, of those that keep the stated gain margin, phase margin and bandwidth at every
one of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ehbench.config.recipe import TuneRecipe
from ehbench.control.functions import HEAD, METERED
from ehbench.tune.circuits import functions_of
from ehbench.tune.draws import Correlation, robustness, uncertain
from ehbench.tune.loci import locus, step_response, worst_of_each
from ehbench.tune.loop import AT_ZERO, Law, Loop, close, dominant
from ehbench.tune.margins import gain_limit, margins, violations
from ehbench.tune.operating_point import OperatingPoint
from ehbench.tune.results import Locus, PointResult, StepResponse, Tuning, pairs
from ehbench.tune.search import GAIN_POINTS, GAIN_SPAN, LawSearch, choose_gain, natural_gain
from ehbench.tune.study import Machine, Site, Study, prepare_tuning
from ehbench.vocabulary.codes import FUNCTIONS
from ehbench.vocabulary.progress import Progress

NO_DRAWS = "no parameter of the rig is identified with a standard error, so no draws were made"


def tune_pressure_feedback(
    machine: Machine,
    recipe: TuneRecipe,
    *,
    validated: type | None = None,
    correlation: Correlation | None = None,
    progress: Progress | None = None,
) -> Tuning:
    """Choose the gains of the pressure feedback of one cylinder on a validated rig.

    Args:
        machine: the validated rig, with ``rig`` and ``flow_maps``.
        recipe: what to look at and what to demand.
        validated: the type that only validation makes; None where the user said that an unvalidated
            rig will do.
        correlation: (names, matrix) of the identified parameters; those not named are drawn
            independently.
        progress: told what is at work and the share done.

    Raises:
        ModelRejected: the machine is not ``validated``.
        InputError: no such cylinder, payload, function or posture.
        InsufficientData: no operating point at which a function can work.
    """
    if progress is not None:
        progress("operating points", 0.0)
    study = prepare_tuning(machine, recipe, validated=validated)
    return tune_prepared(study, correlation=correlation, progress=progress)


def tune_prepared(
    study: Study[TuneRecipe], correlation: Correlation | None, progress: Progress | None = None
) -> Tuning:
    """Search the gains over what `prepare_tuning` found; as in `tune_pressure_feedback`."""
    tell = progress or (lambda what, share: None)
    recipe, notes = study.recipe, list(study.notes)
    counted = [site for site in study.sites if site.counts]
    scale = natural_gain(counted)
    gains = np.concatenate([[0.0], np.geomspace(scale / GAIN_SPAN, scale * GAIN_SPAN, GAIN_POINTS)])
    tell("washout and off-side gain", 0.1)
    search = LawSearch(counted, recipe, gains, scale)
    law = search.law()
    tell("gain", 0.35)
    demands = _demands(recipe)
    chosen = _gains_by_function(study, law, gains, demands, notes)
    tell("margins", 0.5)
    results = tuple(_result(site, law, chosen[site.point.function], gains) for site in study.sites)
    counting = [r for r in results if r.counts]
    target = float(recipe.damping_ratio)
    damping = _least_damping(counting, target, notes)
    tell("root loci", 0.65)
    loci, steps = _drawn(study, results, law, chosen)
    tell("draws", 0.75)
    if not uncertain(study.rig):
        notes.append(NO_DRAWS)
    sure = robustness(
        study, results, law, chosen, correlation, lambda share: tell("draws", 0.75 + 0.25 * share)
    )
    return Tuning(
        rig=study.rig.name,
        supply=study.rig.supply.facts(),
        cylinder=study.cylinder,
        feedback_gain=chosen,
        washout=law.washout,
        ramp_washout=law.ramp_washout,
        off_gain=law.off_gain,
        low_pressure=study.low,
        cross_drop=study.cross,
        tick=1.0 / float(recipe.rate),
        delay=law.delay,
        target=target,
        damping_ratio=damping,
        damping_ratio_open=min(r.damping_ratio_open for r in counting),
        damping_ratio_open_most=max(r.damping_ratio_open for r in counting),
        damping_ratio_held=min(r.damping_ratio_held for r in counting),
        damping_ratio_held_most=max(r.damping_ratio_held for r in counting),
        met=damping >= target and not any(violations(r.margins, demands) for r in counting),
        constraints=demands,
        gains=tuple(gains.tolist()),
        worst_curve=tuple(np.min([r.curve for r in counting], axis=0).tolist()),
        functions=functions_of(study.rig, study.sites[0].circuit),
        points=results,
        equivalents=study.curves,
        loci=loci,
        steps=steps,
        alternatives=search.alternatives(law),
        robustness=sure,
        warnings=tuple(dict.fromkeys(notes)),
    )


def _least_damping(results: Sequence[PointResult], target: float, notes: list[str]) -> float:
    """The least damping ratio; that it is below the target goes to ``notes``."""
    worst = min(results, key=lambda r: r.damping_ratio_closed)
    damping = worst.damping_ratio_closed
    if damping < target:
        notes.append(
            f"the worst damping ratio is {damping:.2f}, below the target {target:.2f}: {worst.name}"
        )
    return damping


def _demands(recipe: TuneRecipe) -> dict[str, float]:
    """What every operating point has to keep, by the names of `Margins`."""
    demands = {key: float(getattr(recipe, key)) for key in ("gain_margin", "phase_margin")}
    return demands | {"bandwidth": 2.0 * math.pi * float(recipe.bandwidth)}


def _gains_by_function(
    study: Study[TuneRecipe],
    law: Law,
    gains: np.ndarray,
    demands: dict[str, float],
    notes: list[str],
) -> dict[str, float]:
    """The gain of each working function; of one that no load calls for, the least."""
    counted = [site for site in study.sites if site.counts]
    groups = {"": counted} if study.recipe.one_gain else _by_function(counted)
    chosen = {key: choose_gain(group, law, gains, demands, notes) for key, group in groups.items()}
    minimum = min(chosen.values())
    return {
        f: chosen.get(f, chosen.get("", minimum))
        for f in dict.fromkeys(site.point.function for site in study.sites)
    }


def _drawn(
    study: Study, results: Sequence[PointResult], law: Law, chosen: dict[str, float]
) -> tuple[tuple[Locus, ...], tuple[StepResponse, ...]]:
    """Root loci and step responses at the least damped point of each function and payload."""
    parameters = ("feedback_gain", "washout") if law.washout > 0 else ("feedback_gain",)
    loci, steps = [], []
    for i in worst_of_each(results):
        site, result = study.sites[i], results[i]
        gain = chosen[site.point.function]
        loci += [locus(site, law, gain, name, result.gain_limit) for name in parameters]
        steps.append(step_response(site, law, result, gain))
    return tuple(loci), tuple(steps)


def _by_function(sites: Sequence[Site]) -> dict[str, list[Site]]:
    groups: dict[str, list[Site]] = {}
    for site in sites:
        groups.setdefault(site.point.function, []).append(site)
    return groups


def _result(site: Site, law: Law, gain: float, gains: np.ndarray) -> PointResult:
    loop, point = site.loop(law), site.point
    bare = site.loop(law.without_feedback())
    opened, closed = np.linalg.eigvals(bare.a), np.linalg.eigvals(loop.closed(gain))
    plain = close(site.linear, point, site.circuit, replace(law, washout=0.0, ramp_washout=0.0))
    return PointResult(
        point.name,
        point,
        site.counts,
        pairs(opened),
        pairs(closed),
        abs(dominant(opened, bare.fastest)),
        abs(dominant(closed, loop.fastest)),
        float(bare.damping_ratio(0.0)),
        float(loop.damping_ratio(0.0)),
        float(loop.damping_ratio(gain)),
        float(plain.damping_ratio(gain)),
        _bias(plain, point, gain),
        gain_limit(loop, gains),
        margins(loop, gain),
        tuple(loop.damping_ratio(gains).tolist()),
    )


def _bias(plain: Loop, point: OperatingPoint, gain: float) -> float:
    """What the static pressure does to the steady speed [m/s] where it is fed back without a
    washout; NaN where nothing is steady."""
    pressure = point.p_head if METERED[FUNCTIONS.index(point.function)] == HEAD else point.p_rod
    poles = np.linalg.eigvals(plain.closed(gain))
    if (poles.real > -AT_ZERO * np.abs(poles).max()).any():
        return math.nan
    return float(np.linalg.solve(-plain.closed(gain), plain.b)[0] * gain * pressure)
