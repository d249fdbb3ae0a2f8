"""How sure a tuning is: the worst damping ratio over draws of the identified parameters."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ehbench.config.recipe import TuneRecipe
from ehbench.config.rig import Rig
from ehbench.control.functions import Circuit
from ehbench.plant.design_point import circuit_of
from ehbench.plant.model import Model
from ehbench.tune.linear import development_model
from ehbench.tune.loop import Law, close
from ehbench.tune.operating_point import Aim, equivalent
from ehbench.tune.results import PointResult, Robustness
from ehbench.tune.search import SEARCH
from ehbench.tune.study import SteadyMotion, Study, model_under
from ehbench.vocabulary import InputError, message
from ehbench.vocabulary.codes import FUNCTIONS

Correlation = tuple[Sequence[str], Any]  # (names, matrix) of the identified parameters


def uncertain(rig: Rig) -> tuple[str, ...]:
    """Names of the parameters that are identified with a standard error."""
    return tuple(
        name
        for name, value in rig.parameters().items()
        if value.sure == "identified"
        and value.std is not None
        and math.isfinite(value.std)
        and value.std > 0
    )


def robustness(
    study: Study[TuneRecipe],
    results: Sequence[PointResult],
    law: Law,
    gains: dict[str, float],
    correlation: Correlation | None,
    progress: Callable[[float], None],
) -> Robustness:
    """The worst damping ratio over the least damped points for draws from the identified
    covariance.

    Args:
        study: what was tuned on.
        results: of its motions, in their order.
        law: with its washouts and off-side gain.
        gains: by working function.
        correlation: of the parameters; those not named are drawn independently.
        progress: called with the share done."""
    recipe, names = study.recipe, uncertain(study.rig)
    if not names or recipe.draws == 0:
        return Robustness(0, names, 0, None, (), ())
    rng = np.random.default_rng(recipe.seed)
    table = draw_parameters(study.rig, names, correlation, recipe.draws, rng)
    order = sorted(
        (i for i, r in enumerate(results) if r.counts),
        key=lambda i: results[i].damping_ratio_closed,
    )[: SEARCH.draw_points]
    motions = [study.motions[i] for i in order]
    worst = np.ones(len(table))
    for k, row in enumerate(table):
        progress(k / len(table))
        drawn = study.rig.with_values(dict(zip(names, map(float, row), strict=True)))
        worst[k] = _worst_of_draw(study, drawn, motions, law, gains)
    quantiles = tuple(np.quantile(worst, (0.05, 0.5, 0.95)).tolist())
    return Robustness(
        len(table),
        names,
        len(order),
        float(np.mean(worst >= float(recipe.damping_ratio))),
        quantiles,
        tuple(worst.tolist()),
    )


def _worst_of_draw(
    study: Study[TuneRecipe],
    drawn: Rig,
    motions: Sequence[SteadyMotion],
    law: Law,
    gains: dict[str, float],
) -> float:
    """Least damping ratio of a drawn rig at the operating points that it can take up."""
    recipe, worst = study.recipe, 1.0
    at: dict[str, tuple[Model, Circuit]] = {}
    for payload in dict.fromkeys(motion.point.payload for motion in motions):
        model = model_under(drawn, study.maps, payload)
        cylinder = model.layout.cylinders.index(study.cylinder)
        at[payload] = model, circuit_of(model, cylinder, study.maps)
    for motion in motions:
        point, (model, circuit) = motion.point, at[motion.point.payload]
        here = equivalent(model, circuit.cylinder, np.array([point.x]), recipe.posture)
        model_here, moved = study.steady(
            model,
            circuit,
            FUNCTIONS.index(point.function),
            here,
            0,
            Aim(
                study.low,
                study.cross,
                speed=abs(point.v),
                payload=point.payload,
                posture=recipe.posture,
            ),
        )
        if moved.possible:
            loop = close(development_model(model_here, moved), moved, circuit, law)
            worst = min(worst, float(loop.damping_ratio(gains[point.function])))
    return worst


def draw_parameters(
    rig: Rig,
    names: Sequence[str],
    correlation: Correlation | None,
    count: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Draws [SI], shape (count, names), of parameters from their standard errors and correlation,
    clipped to their bounds.

    Raises:
        InputError: a correlation matrix that is none."""
    known = rig.parameters()
    values = [known[n] for n in names]
    matrix = np.eye(len(names))
    if correlation is not None:
        given, block = list(correlation[0]), np.asarray(correlation[1], float)
        if (
            block.shape != (len(given), len(given))
            or not np.allclose(block, block.T, atol=1e-6)
            or (np.abs(block) > 1 + 1e-6).any()
        ):
            raise InputError(message("tune.wrong_correlation"))
        both = [n for n in names if n in given]
        rows = [list(names).index(n) for n in both]
        matrix[np.ix_(rows, rows)] = block[
            np.ix_([given.index(n) for n in both], [given.index(n) for n in both])
        ]
        np.fill_diagonal(matrix, 1.0)
    level, axes = np.linalg.eigh(matrix)
    root = axes * np.sqrt(np.maximum(level, 0.0))
    draws = rng.standard_normal((count, len(names))) @ root.T
    draws = np.array([float(v) for v in values]) + draws * [v.std or 0.0 for v in values]
    lower = [-math.inf if v.lower is None else v.lower for v in values]
    upper = [math.inf if v.upper is None else v.upper for v in values]
    return np.clip(draws, lower, upper)
