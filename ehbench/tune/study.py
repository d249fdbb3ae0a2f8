"""What gains are tuned on: operating points over postures, payloads, functions and speeds."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from ehbench.config.recipe import AnyTuning
from ehbench.config.rig import Rig
from ehbench.control.functions import Circuit, default_pressure
from ehbench.parts.supply import sensed as sensed_pressure
from ehbench.plant.build import Maps
from ehbench.plant.design_point import circuit_of
from ehbench.plant.layout import SIDES
from ehbench.plant.model import Model
from ehbench.tune.linear import LinearModel, development_model
from ehbench.tune.loop import Law, Loop, close
from ehbench.tune.operating_point import (
    FED,
    Aim,
    Equivalent,
    OperatingPoint,
    equivalent,
    operating_point,
)
from ehbench.tune.results import Curves
from ehbench.vocabulary import VOCABULARY, InputError, InsufficientData, Message, message
from ehbench.vocabulary.codes import EXTEND_RESISTIVE_REGENERATION, FUNCTIONS
from ehbench.vocabulary.fields import read_value

NONE = "none"  # the payload's name where there is none
POSTURES = 41  # of the curves of equivalent mass and gravity
R = TypeVar("R", bound=AnyTuning)


@dataclass(frozen=True)
class SteadyMotion:
    """An operating point with what is needed to close loops about it."""

    model: Model
    circuit: Circuit
    point: OperatingPoint
    linear: LinearModel
    counts: bool

    def loop(self, law: Law) -> Loop:
        return close(self.linear, self.point, self.circuit, law)


@dataclass(frozen=True)
class Study(Generic[R]):
    """What is tuned on: every operating point, linearised, with what is known without a search.

    ``low`` and ``cross`` [Pa] as in `Tuning`, ``notes`` what is odd about the points."""

    rig: Rig
    maps: Maps | None
    recipe: R
    cylinder: str
    low: float
    cross: float
    motions: tuple[SteadyMotion, ...] = ()
    curves: tuple[Curves, ...] = ()
    notes: tuple[str, ...] = ()

    def steady(
        self, model: Model, circuit: Circuit, function: int, here: Equivalent, index: int, aim: Aim
    ) -> tuple[Model, OperatingPoint]:
        """The steady motion that is aimed at, as `operating_point`, and the model for it."""
        sensed = self._sensed(model)
        point = operating_point(model, circuit, function, here, index, replace(aim, sensed=sensed))
        supply = model.plant.supply
        if supply.margin == 0.0 or point.p_supply > sensed_pressure(sensed, supply):
            return model, point
        supply = supply.copy()  # the pump follows the others, and is constant here
        supply.pressure, supply.margin = point.p_supply, 0.0
        return replace(model, plant=model.plant._replace(supply=supply)), point

    def _sensed(self, model: Model) -> float:
        """The highest pressure [Pa] of the cylinders that move as well."""
        also, names = self.recipe.also_moving, model.layout
        if not also:
            return -math.inf
        y = model.trim(model.posture(self.recipe.posture), model.plant.tank_pressure + self.low)
        indices = [names.cylinders.index(name) for name in also]
        return max(float(y[names.state(f"p_{side}", i)]) for i in indices for side in SIDES)


def prepare_tuning(rig: Rig, maps: Maps | None, recipe: R) -> Study[R]:
    """The operating points of one cylinder of a validated rig, with its measured flow maps.

    Raises:
        InputError: no such cylinder, payload, function or posture.
        InsufficientData: no operating point at which a function can work."""
    name = recipe.cylinder or rig.cylinder[0].name
    if recipe.cylinder is None and len(rig.cylinder) > 1:
        known = ", ".join(f'"{c.name}"' for c in rig.cylinder)
        raise InputError(message("tune.several_cylinders", known=known))
    rig.cylinder_named(name)
    for item in recipe.also_moving:
        rig.cylinder_named(item)
        if item == name:
            raise InputError(message("tune.tuned_also_moving", cylinder=item))
    if recipe.also_moving and rig.supply.load_sensing is None:
        raise InputError(message("tune.not_load_sensing", supply=rig.supply.kind))
    part = default_pressure(float(rig.supply.pressure))
    low = part if recipe.low_pressure is None else float(recipe.low_pressure)
    cross = part if recipe.cross_drop is None else float(recipe.cross_drop)
    for function in recipe.functions:
        if function not in FUNCTIONS[1:]:
            known = ", ".join(FUNCTIONS[1:])
            raise InputError(message("control.unknown_function", name=function, known=known))
    study = Study(rig, maps, recipe, name, low, cross)
    curves, motions = [], []
    for payload in recipe.payloads or (NONE, *rig.payload):
        model = model_under(rig, maps, payload)
        curves.append(_curves(model, name, payload, recipe))
        motions += _possible(study, model, payload)
    possible = {motion.point.function for motion in motions}
    counting = {motion.point.function for motion in motions if motion.counts}
    if not counting:
        raise InsufficientData(message("tune.no_points", cylinder=name))
    lost = [function for function in recipe.functions if function not in possible]
    notes: list[str] = [message("tune.not_possible", function=function) for function in lost]
    # a function that no load calls for is shown, but no gain is chosen on it
    shown = sorted(possible - counting)
    notes += [message("tune.for_information", function=function) for function in shown]
    motions = [item for item in motions if item.counts or item.point.function in shown]
    notes += Model.of(rig, maps).creeping(name)
    notes += rail_notes(rig, [motion.point for motion in motions if motion.counts])
    return replace(study, motions=tuple(motions), curves=tuple(curves), notes=tuple(notes))


def model_under(rig: Rig, maps: Maps | None, payload: str) -> Model:
    """The model of a rig under a payload, NONE for none."""
    return Model.of(rig, maps, None if payload == NONE else payload)


def _curves(model: Model, name: str, payload: str, recipe: AnyTuning) -> Curves:
    """Equivalent mass, gravity and damping of a cylinder under a payload, over its stroke."""
    cylinder = model.layout.cylinders.index(name)
    x = np.linspace(0.0, model.plant.cylinders[cylinder].stroke, POSTURES)
    shown = equivalent(model, cylinder, x, recipe.posture)
    columns = (shown.x, shown.q, shown.mass, shown.gravity_force, shown.damping)
    return Curves(payload, *(tuple(a.tolist()) for a in columns))


def _possible(study: Study, model: Model, payload: str) -> Iterator[SteadyMotion]:
    """Every operating point under a payload at which the cylinder moves.

    Raises:
        InputError: a requested function that the valves cannot do."""
    recipe, name = study.recipe, study.cylinder
    cylinder = model.layout.cylinders.index(name)
    stroke = model.plant.cylinders[cylinder].stroke
    here = equivalent(model, cylinder, _strokes(model.rig, recipe, stroke), recipe.posture)
    circuit = circuit_of(model, cylinder, study.maps)
    requested = [FUNCTIONS.index(f) for f in recipe.functions]
    plain = [f for f in range(1, len(FUNCTIONS)) if f != EXTEND_RESISTIVE_REGENERATION]
    for function in requested or plain:
        if circuit.able[function] == 0:
            if recipe.functions:
                raise InputError(
                    message("tune.unable", cylinder=name, function=FUNCTIONS[function])
                )
            continue
        for index in range(here.x.size):
            for share in recipe.speed_shares:
                aim = Aim(
                    study.low, study.cross, share=share, payload=payload, posture=recipe.posture
                )
                model_here, point = study.steady(model, circuit, function, here, index, aim)
                if point.possible and point.v != 0.0:
                    linear = development_model(model_here, point)
                    yield SteadyMotion(model_here, circuit, point, linear, point.fits)


def rail_notes(rig: Rig, points: Sequence[OperatingPoint]) -> list[Message]:
    """A note on points near the pressure at which the low rail ends: no linear model has that."""
    low = rig.supply.low_rail
    if low is None:
        return []
    margin = float(low.rail_margin)
    ends = float(low.rail_pressure) - margin
    paths = [(point, path.path) for point in points for path in point.paths]
    fed = [(at.p_head, at.p_rod)[FED[path]] for at, path in paths if path in FED]
    near = sum(1 for p in fed if abs(p - ends) < 2.0 * margin)
    if not near:
        return []
    return [message("tune.near_rail", near=near, points=len(points))]


def _strokes(rig: Rig, recipe: AnyTuning, stroke: float) -> np.ndarray:
    if not recipe.strokes:
        return (
            np.linspace(0.1, 0.9, recipe.postures) * stroke
            if recipe.postures > 1
            else np.array([0.5 * stroke])
        )
    x = np.array([float(read_value(text, VOCABULARY["x"])) for text in recipe.strokes])
    if x.min() < 0 or x.max() > stroke:
        raise InputError(message("tune.stroke_outside", stroke=rig.text("x", stroke, 1)))
    return x
