"""The gain of the pressure feedback: the best worst case over operating points.

Gains are chosen on `ehbench.tune.linear` models: the gain with the largest least damping ratio over
all operating points, of those that keep the stated gain margin, phase margin and bandwidth at every
one of them."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ehbench.config.recipe import TuneRecipe
from ehbench.control.functions import HEAD, METERED
from ehbench.tune.draws import Correlation, robustness
from ehbench.tune.linear import AT_ZERO
from ehbench.tune.loop import (
    Law,
    Loop,
    dominant,
    gain_limit,
    margins,
    speed_of,
    system_of,
    violations,
)
from ehbench.tune.operating_point import OperatingPoint
from ehbench.tune.results import Locus, PointResult, StepResponse, Tuning, functions_of, pairs
from ehbench.tune.search import SEARCH, LawSearch, choose_gain
from ehbench.tune.study import SteadyMotion, Study
from ehbench.vocabulary import Progress, grouped, message
from ehbench.vocabulary.codes import FUNCTIONS


def tune_pressure_feedback(
    study: Study[TuneRecipe],
    correlation: Correlation | None = None,
    progress: Progress | None = None,
) -> Tuning:
    """Choose the gains of the pressure feedback of one cylinder.

    Args:
        study: of `ehbench.tune.study.prepare_tuning`.
        correlation: (names, matrix) of the identified parameters; others are drawn independently.
        progress: called with the step at work and the share done."""
    report = progress or (lambda what, share: None)
    recipe, notes = study.recipe, list(study.notes)
    counted = [motion for motion in study.motions if motion.counts]
    report("washout and off-side gain", 0.1)
    demands = {key: float(getattr(recipe, key)) for key in ("gain_margin", "phase_margin")}
    demands["bandwidth"] = 2.0 * math.pi * float(recipe.bandwidth)
    search = LawSearch(counted, recipe, demands)
    law, gains = search.law(), search.grid
    report("gain", 0.35)
    chosen = _gains_by_function(study, law, gains, demands, notes)
    report("margins", 0.5)
    results = tuple(
        _result(motion, law, chosen[motion.point.function], gains) for motion in study.motions
    )
    counting = [r for r in results if r.counts]
    target = float(recipe.damping_ratio)
    worst = min(counting, key=lambda r: r.damping_ratio_closed)
    damping = worst.damping_ratio_closed
    if damping < target:
        fields = {"damping": damping, "target": target, "point": worst.name}
        notes.append(message("tune.below_target", **fields))
    report("root loci", 0.65)
    loci, steps = _curves(study, results, law, chosen)
    report("draws", 0.75)
    draws = robustness(
        study, results, law, chosen, correlation, lambda share: report("draws", 0.75 + 0.25 * share)
    )
    notes += [message("tune.no_draws")] if not draws.parameters else []
    return Tuning(
        **_setup(study, law),
        feedback_gain=chosen,
        target=target,
        damping_ratio=damping,
        **_ranges(counting),
        met=damping >= target and not any(violations(r.margins, demands) for r in counting),
        constraints=demands,
        gains=tuple(gains.tolist()),
        worst_curve=tuple(np.min([r.curve for r in counting], axis=0).tolist()),
        points=results,
        loci=loci,
        steps=steps,
        alternatives=search.alternatives(law),
        robustness=draws,
        warnings=tuple(dict.fromkeys(notes)),
    )


def _setup(study: Study[TuneRecipe], law: Law) -> dict[str, Any]:
    return {
        "rig": study.rig.name,
        "supply": study.rig.supply.facts(),
        "cylinder": study.cylinder,
        "washout": law.washout,
        "ramp_washout": law.ramp_washout,
        "off_gain": law.off_gain,
        "low_pressure": study.low,
        "cross_drop": study.cross,
        "tick": 1.0 / float(study.recipe.rate),
        "delay": law.delay,
        "functions": functions_of(study.rig, study.motions[0].circuit),
        "equivalents": study.curves,
    }


def _ranges(results: Sequence[PointResult]) -> dict[str, Any]:
    """Ranges of the damping ratio without any feedback, and with the off-side's alone."""
    ranges = {}
    for name in ("damping_ratio_open", "damping_ratio_held"):
        values = [getattr(result, name) for result in results]
        ranges |= {name: min(values), f"{name}_most": max(values)}
    return ranges


def _gains_by_function(
    study: Study[TuneRecipe],
    law: Law,
    gains: np.ndarray,
    demands: dict[str, float],
    notes: list[str],
) -> dict[str, float]:
    """The gain of each working function; of one that no load calls for, the least."""
    counted = (motion for motion in study.motions if motion.counts)
    apart = not study.recipe.one_gain
    groups = grouped(counted, lambda motion: motion.point.function if apart else "")
    chosen = {key: choose_gain(group, law, gains, demands, notes) for key, group in groups.items()}
    minimum = min(chosen.values())
    return {
        f: chosen.get(f, chosen.get("", minimum))
        for f in dict.fromkeys(motion.point.function for motion in study.motions)
    }


def _curves(
    study: Study, results: Sequence[PointResult], law: Law, chosen: dict[str, float]
) -> tuple[tuple[Locus, ...], tuple[StepResponse, ...]]:
    """Root loci and step responses at the least damped point of each function and payload."""
    parameters = ("feedback_gain", "washout") if law.washout > 0 else ("feedback_gain",)
    loci, steps = [], []
    worst: dict[tuple[str, str], int] = {}
    for i, r in enumerate(results):
        last = worst.setdefault((r.point.function, r.point.payload), i)
        if r.damping_ratio_closed < results[last].damping_ratio_closed:
            worst[r.point.function, r.point.payload] = i
    for i in worst.values():
        motion, result = study.motions[i], results[i]
        gain = chosen[motion.point.function]
        loci += [locus(motion, law, gain, name, result.gain_limit) for name in parameters]
        steps.append(step_response(motion, law, result, gain))
    return tuple(loci), tuple(steps)


def _result(motion: SteadyMotion, law: Law, gain: float, gains: np.ndarray) -> PointResult:
    loop, point = motion.loop(law), motion.point
    bare = motion.loop(law.without_feedback())
    opened, closed = np.linalg.eigvals(bare.a), np.linalg.eigvals(loop.closed(gain))
    plain = motion.loop(replace(law, washout=0.0, ramp_washout=0.0))
    return PointResult(
        point.name,
        point,
        motion.counts,
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
    """Static pressure's part in the steady speed [m/s] without a washout; NaN where nothing is
    steady."""
    pressure = point.p_head if METERED[FUNCTIONS.index(point.function)] == HEAD else point.p_rod
    poles = np.linalg.eigvals(plain.closed(gain))
    if (poles.real > -AT_ZERO * np.abs(poles).max()).any():
        return math.nan
    return float(np.linalg.solve(-plain.closed(gain), plain.b)[0] * gain * pressure)


def locus(motion: SteadyMotion, law: Law, gain: float, parameter: str, limit: float) -> Locus:
    """Root locus of one operating point over the gain, or over the washout corner at the chosen
    gain, by python-control.

    Values lie densely about the choice and the stability limit. Over the corner: ``1 +
    ω_w·S(s)/s``, S the loop without washout."""
    import control

    loop = motion.loop(law)
    if parameter == "feedback_gain":
        system, chosen = system_of(loop.a, loop.b, -loop.c), gain
        crossing = limit if 0 < limit < math.inf else None
    else:
        # the sensitivity 1 + K c (s − a − K b c)⁻¹ b without washout, then an integrator
        plain = motion.loop(replace(law, washout=0.0))
        n = len(plain.a)
        a = np.zeros((n + 1, n + 1))
        a[:n, :n], a[n, :n] = plain.closed(gain), gain * plain.c
        system = system_of(a, np.append(plain.b, 1.0), np.eye(n + 1)[n])
        chosen, crossing = law.washout, None
    top = 10.0 * max(chosen, crossing or 0.0)
    if parameter == "washout":
        top = max(top, 2.0 * abs(dominant(np.linalg.eigvals(loop.a), loop.fastest)))
    centre = [chosen] + ([crossing] if crossing else [])
    values = np.unique(
        np.concatenate(
            [
                [0.0],
                np.geomspace(chosen / 1e3, top, SEARCH.locus_points // 2),
                *(c * np.linspace(0.8, 1.2, SEARCH.locus_points // 4) for c in centre),
                centre,
            ]
        )
    )
    root_locus: Any = control.root_locus_map(system, gains=values)
    poles = np.asarray(root_locus.loci)
    at = poles[int(np.searchsorted(values, chosen))]
    cross = poles[int(np.searchsorted(values, crossing))] if crossing else np.zeros(0, complex)
    # what matters: the pole pair that swings, from no gain to the choice, and the crossing
    shown = (poles[0], at, *([cross] if crossing else []))
    reach = max(abs(dominant(p, loop.fastest)) for p in shown)
    return Locus(
        motion.point.name,
        parameter,
        tuple(values.tolist()),
        tuple(map(tuple, np.real(poles).tolist())),
        tuple(map(tuple, np.imag(poles).tolist())),
        float(chosen),
        pairs(at),
        None if crossing is None else float(crossing),
        pairs(cross),
        (-1.6 * reach, 0.4 * reach, 1.4 * reach),
    )


def step_response(motion: SteadyMotion, law: Law, result: PointResult, gain: float) -> StepResponse:
    """Speed after a step of desired speed, without any feedback and at a gain."""
    import control

    t = np.linspace(
        0.0, 20.0 * math.pi / max(result.natural_frequency_open, 1e-3), SEARCH.step_samples
    )
    loops = ((motion.loop(law.without_feedback()), 0.0), (motion.loop(law), gain))
    # pyrefly: ignore[missing-attribute]
    speeds = [np.asarray(control.step_response(speed_of(*loop), t).outputs) for loop in loops]
    return StepResponse(result.name, *(tuple(a.tolist()) for a in (t, *speeds)))
