"""The limits of a trial and what every sample is compared with, from its recipe and its rig."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ehbench.config.recipe import Limits
from ehbench.config.rig import Rig
from ehbench.machines.rows import LIMITS, Checks
from ehbench.parts.sample import OF, entry
from ehbench.vocabulary import setting

if TYPE_CHECKING:
    from ehbench.trial.controllers import Compiled
    from ehbench.trial.coordination import Driven


@dataclass(frozen=True)
class CheckSettings:
    """Bounds of a trial that its recipe leaves ``auto``."""

    following: float = setting(
        0.1, "", "following error, as a share of the stroke", "five times that of a sound trial"
    )
    mismatch: float = setting(
        0.05, "", "difference of two strokes, as a share of the stroke", "pins measured to 1 %"
    )
    range: float = setting(
        3.0, "", "a pressure, in highest pressures of the rig", "a caught load doubles it"
    )
    late: float = setting(0.02, "s", "a sample's age, a controller's time", "a watchdog")
    late_ticks: float = setting(4.0, "", "the least of it, in ticks", "two packets lost")


CHECKS = CheckSettings()


def limit_array(limits: Limits, rig: Rig, tick: float) -> np.ndarray:
    """A recipe's limits in the order of LIMITS, SI; infinite where there is none; ``tick`` [s].

    Those of each cylinder by itself, the last of LIMITS, are in `checks_of`."""
    highest = [float(rig.supply.pressure)]
    highest += [float(c.relief_pressure) for c in rig.cylinder if c.relief_pressure is not None]
    late, values = max(CHECKS.late, CHECKS.late_ticks * tick), []
    auto = {"pressure_range": CHECKS.range * max(highest), "sample_age": late, "overrun": late}
    for name in LIMITS:
        value = getattr(limits, name, None)
        if value == "auto":
            value = auto.get(name)
        none = -math.inf if name in ("pressure_min", "stroke_margin") else math.inf
        values.append(none if value is None else float(value))
    return np.array(values)


def checks_of(
    limits: Limits,
    measured: np.ndarray,
    cylinders: np.ndarray,
    rows: int,
    driven: Sequence[Driven] = (),
    laws: Sequence[Compiled] = (),
) -> Checks:
    """What the samples of a trial are compared with.

    Args:
        limits: of the recipe.
        measured: which channels of the sample the machine has a sensor for.
        cylinders: of the rig's plant.
        rows: of the trial.
        driven: the cylinders that it moves.
        laws: of these, none of a user's class."""
    strokes = cylinders["stroke"]

    def bound(given: object, share: float) -> np.ndarray:
        return share * strokes if given == "auto" else np.full(len(strokes), float(given))  # type: ignore[arg-type]

    desired = np.full((rows, len(strokes)), math.nan)
    for number, item in enumerate(driven):
        index = item.design.index
        law = laws[number].controller if laws else None
        follows = law is not None and bool(law.observed[entry(index, OF.x)])
        if follows or limits.following_error != "auto":
            table = item.references.table
            desired[: len(table), index] = table[:rows, 0]
    return Checks(
        np.ones(1, dtype=np.bool_),
        measured,
        cylinders,
        desired,
        bound(limits.following_error, CHECKS.following),
        bound(limits.position_mismatch, CHECKS.mismatch),
        np.full(len(strokes), -1, dtype=np.int64),
        np.zeros(len(strokes)),
        np.zeros(len(strokes)),
        np.zeros(5),
    )
