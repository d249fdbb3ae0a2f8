"""Linear models of a rig's steady motions, for python-control and MATLAB."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ehbench.config.recipe import AnyTuning, TuneRecipe
from ehbench.config.rig import Rig
from ehbench.plant.build import Maps
from ehbench.tune.study import prepare_tuning
from ehbench.vocabulary import InsufficientData

if TYPE_CHECKING:
    import control

OUTPUTS = ("v", "p_head", "p_rod")  # states that are outputs too


@dataclass(frozen=True)
class StateSpace:
    """``ẋ = A x + B u``, ``y = C x`` about a steady motion called ``name``, all SI.

    ``inputs`` name u: commands [V], then the force on the rod [N]; ``outputs`` name y; ``at`` has
    the numbers of the steady motion [SI], ``counts`` says whether gains are tuned on it."""

    name: str
    cylinder: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    at: dict[str, float]
    counts: bool

    def as_control(self) -> control.StateSpace:
        """The same for python-control, whose signal names have underscores for dots."""
        import control

        signals = {
            word: [name.replace(".", "_") for name in getattr(self, word)]
            for word in ("inputs", "outputs", "states")
        }
        named: Any = {**signals, "name": self.name.replace(".", "_")}
        through = np.zeros((len(self.outputs), len(self.inputs)))
        return control.StateSpace(self.a, self.b, self.c, through, **named)


def state_spaces(rig: Rig, maps: Maps | None, points: AnyTuning | None = None) -> list[StateSpace]:
    """The linear model of every steady motion: of the points of a tune recipe, by default of each
    cylinder at five strokes, with every payload, function and 30 and 70 % of full speed.

    Raises:
        InputError: as `prepare_tuning`.
        InsufficientData: no cylinder can move."""
    recipes = (
        [points]
        if points is not None
        else [TuneRecipe(stage="tune", rig="", cylinder=cylinder.name) for cylinder in rig.cylinder]
    )
    results, refused = [], None
    for recipe in recipes:
        try:
            study = prepare_tuning(rig, maps, recipe)
        except InsufficientData as error:
            refused = error
            continue
        for motion in study.motions:
            linear, point = motion.linear, motion.point
            valves = motion.model.layout.valves
            results.append(
                StateSpace(
                    f"{study.cylinder}, {point.name}",
                    study.cylinder,
                    linear.states,
                    (*(valves[i] for i in linear.valves), f"{study.cylinder}.force"),
                    tuple(f"{study.cylinder}.{name}" for name in OUTPUTS),
                    linear.a,
                    np.column_stack([linear.b, linear.e]),
                    np.eye(len(linear.states))[[linear.states.index(name) for name in OUTPUTS]],
                    {name: getattr(point, name) for name in ("x", *OUTPUTS, "p_supply")},
                    motion.counts,
                )
            )
    if not results and refused is not None:
        raise refused
    return results
