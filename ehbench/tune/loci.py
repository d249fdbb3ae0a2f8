"""Root loci and step responses of operating points, for the report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ehbench.tune.loop import Law, close, dominant
from ehbench.tune.margins import speed_of, system_of
from ehbench.tune.results import Locus, PointResult, StepResponse, pairs
from ehbench.tune.study import Site

LOCUS_POINTS = 240
STEP_SAMPLES = 201


def locus(site: Site, law: Law, gain: float, parameter: str, limit: float) -> Locus:
    """Root locus of one operating point over the gain, or over the washout corner at the chosen
    gain, by python-control.

    Values lie densely about the choice and the stability limit. Over the corner: ``1 +
    ω_w·S(s)/s``, S the loop without washout."""
    import control

    loop = site.loop(law)
    if parameter == "feedback_gain":
        system, chosen = system_of(loop.a, loop.b, -loop.c), gain
        crossing = limit if 0 < limit < math.inf else None
    else:
        system, chosen, crossing = _over_washout(site, law, gain), law.washout, None
    top = 10.0 * max(chosen, crossing or 0.0)
    if parameter == "washout":
        top = max(top, 2.0 * abs(dominant(np.linalg.eigvals(loop.a), loop.fastest)))
    centre = [chosen] + ([crossing] if crossing else [])
    values = np.unique(
        np.concatenate(
            [
                [0.0],
                np.geomspace(chosen / 1e3, top, LOCUS_POINTS // 2),
                *(c * np.linspace(0.8, 1.2, LOCUS_POINTS // 4) for c in centre),
                centre,
            ]
        )
    )
    root_locus: Any = control.root_locus_map(system, gains=values)
    poles = np.asarray(root_locus.loci)
    at = poles[int(np.searchsorted(values, chosen))]
    cross = poles[int(np.searchsorted(values, crossing))] if crossing else np.zeros(0, complex)
    # what matters: the pole pair that swings, from no gain to the choice, and the crossing
    reach = max(
        abs(dominant(p, loop.fastest)) for p in (poles[0], at, *([cross] if crossing else []))
    )
    reach = float(reach)
    return Locus(
        site.point.name,
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


def _over_washout(site: Site, law: Law, gain: float):
    """Sensitivity ``1 + K c (s − a − K b c)⁻¹ b`` without washout, then an integrator."""
    plain = close(site.linear, site.point, site.circuit, replace(law, washout=0.0))
    n = plain.a.shape[0]
    a = np.zeros((n + 1, n + 1))
    a[:n, :n] = plain.closed(gain)
    a[n, :n] = gain * plain.c
    return system_of(a, np.append(plain.b, 1.0), np.eye(n + 1)[n])


def worst_of_each(results: Sequence[PointResult]) -> list[int]:
    """The least damped operating point of each function and payload, in their order."""
    worst: dict[tuple[str, str], int] = {}
    for i, r in enumerate(results):
        key = (r.point.function, r.point.payload)
        if key not in worst or r.damping_ratio_closed < results[worst[key]].damping_ratio_closed:
            worst[key] = i
    return list(worst.values())


def step_response(site: Site, law: Law, result: PointResult, gain: float) -> StepResponse:
    """Speed after a step of desired speed, without any feedback and at a gain."""
    import control

    t = np.linspace(0.0, 20.0 * math.pi / max(result.natural_frequency_open, 1e-3), STEP_SAMPLES)
    loops = ((site.loop(law.without_feedback()), 0.0), (site.loop(law), gain))
    speeds = [np.asarray(control.step_response(speed_of(*loop), t).outputs) for loop in loops]
    return StepResponse(result.name, *(tuple(a.tolist()) for a in (t, *speeds)))
