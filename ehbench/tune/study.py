"""What gains are tuned on: operating points over postures, payloads, functions and speeds."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

import numpy as np

from ehbench.config.recipe import AnyTuning
from ehbench.config.rig import Rig
from ehbench.control.functions import Circuit
from ehbench.plant.build import Maps
from ehbench.plant.layout import SIDES
from ehbench.plant.model import Model
from ehbench.tune.linear import LinearModel, development_model
from ehbench.tune.loop import Law, Loop, close
from ehbench.tune.operating_point import (
    FED,
    Aim,
    Equivalent,
    OperatingPoint,
    at_its_supply,
    circuit_of,
    equivalent,
    operating_point,
)
from ehbench.tune.results import Curves
from ehbench.vocabulary.codes import EXTEND_RESISTIVE_REGENERATION, FUNCTIONS
from ehbench.vocabulary.errors import InputError, InsufficientData, ModelRejected
from ehbench.vocabulary.fields import read_value
from ehbench.vocabulary.quantities import VOCABULARY

NONE = "none"  # the payload's name where there is none
POSTURES = 41  # of the curves of equivalent mass and gravity
R = TypeVar("R", bound=AnyTuning)


class Machine(Protocol):
    """What tuning needs of a validated rig."""

    @property
    def rig(self) -> Rig: ...

    @property
    def flow_maps(self) -> Maps | None: ...


@dataclass(frozen=True)
class Site:
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
    sites: tuple[Site, ...] = ()
    curves: tuple[Curves, ...] = ()
    notes: tuple[str, ...] = ()

    def model(self, payload: str) -> Model:
        """The rig under a payload."""
        return model_under(self.rig, self.maps, payload)

    def steady(
        self, model: Model, circuit: Circuit, function: int, here: Equivalent, index: int, aim: Aim
    ) -> tuple[Model, OperatingPoint]:
        """The steady motion that is aimed at, as `operating_point`, and the model for it."""
        felt = self._felt(model)
        point = operating_point(model, circuit, function, here, index, replace(aim, felt=felt))
        return at_its_supply(model, point, felt), point

    def _felt(self, model: Model) -> float:
        """The highest pressure [Pa] that the cylinders hold which are moving as well."""
        also, names = self.recipe.also_moving, model.layout
        if not also:
            return -math.inf
        y = model.trim(model.posture(self.recipe.posture), model.plant.tank_pressure + self.low)
        indices = [names.cylinders.index(name) for name in also]
        return max(float(y[names.state(f"p_{side}", i)]) for i in indices for side in SIDES)


def prepare_tuning(machine: Machine, recipe: R, *, validated: type | None = None) -> Study[R]:
    """Find the operating points; arguments and errors as in `tune_pressure_feedback`."""
    if validated is not None and not isinstance(machine, validated):
        raise ModelRejected(
            f"rig '{machine.rig.name}' was not validated, and gains are tuned on validated rigs "
            "only",
            hint="run a validate recipe on it first",
        )
    rig, maps = machine.rig, machine.flow_maps
    name = recipe.cylinder or rig.cylinder[0].name
    if recipe.cylinder is None and len(rig.cylinder) > 1:
        raise InputError(
            "the rig has several cylinders",
            hint="name one with cylinder = " + ", ".join(f'"{c.name}"' for c in rig.cylinder),
        )
    rig.cylinder_named(name)
    _check_also_moving(rig, name, recipe)
    supply = float(rig.supply.pressure)
    low = supply / 20.0 if recipe.low_pressure is None else float(recipe.low_pressure)
    cross = supply / 20.0 if recipe.cross_drop is None else float(recipe.cross_drop)
    _check_functions(recipe)
    study = Study(rig, maps, recipe, name, low, cross)
    curves, sites = [], []
    for payload in recipe.payloads or (NONE, *rig.payload):
        model = study.model(payload)
        curves.append(_curves(model, name, payload, recipe))
        sites += _possible(study, model, payload)
    sites, notes = _those_that_count(sites, recipe, name)
    notes += Model.of(rig, maps).creeping(name)
    notes += rail_notes(rig, [site.point for site in sites if site.counts])
    return replace(study, sites=tuple(sites), curves=tuple(curves), notes=tuple(notes))


def model_under(rig: Rig, maps: Maps | None, payload: str) -> Model:
    """The model of a rig under a payload, NONE for none."""
    return Model.of(rig, maps, None if payload == NONE else payload)


def _check_also_moving(rig: Rig, name: str, recipe: AnyTuning) -> None:
    for item in recipe.also_moving:
        rig.cylinder_named(item)
        if item == name:
            raise InputError(f"'{item}' is tuned: also_moving names other cylinders")
    if recipe.also_moving and rig.supply.load_sensing is None:
        raise InputError(
            f"also_moving is for load sensing, and the rig's supply is {rig.supply.kind}",
            hint="leave it out: such a supply feels no load",
        )


def _check_functions(recipe: AnyTuning) -> None:
    for function in recipe.functions:
        if function not in FUNCTIONS[1:]:
            raise InputError(
                f"no working function '{function}'", hint="there are " + ", ".join(FUNCTIONS[1:])
            )


def _wanted(recipe: AnyTuning) -> Sequence[int]:
    """Numbers of the working functions to tune for: those asked for, or the first six."""
    return [FUNCTIONS.index(f) for f in recipe.functions] or range(1, EXTEND_RESISTIVE_REGENERATION)


def _curves(model: Model, name: str, payload: str, recipe: AnyTuning) -> Curves:
    """Equivalent mass, gravity and damping of a cylinder under a payload, over its stroke."""
    cylinder = model.layout.cylinders.index(name)
    x = np.linspace(0.0, model.plant.cylinders[cylinder].stroke, POSTURES)
    shown = equivalent(model, cylinder, x, recipe.posture)
    columns = (shown.x, shown.q, shown.mass, shown.gravity_force, shown.damping)
    return Curves(payload, *(tuple(a.tolist()) for a in columns))


def _possible(study: Study, model: Model, payload: str) -> Iterator[Site]:
    """Every operating point under a payload at which the cylinder moves.

    Raises:
        InputError: a function asked for that the valves are not able of.
    """
    recipe, name = study.recipe, study.cylinder
    cylinder = model.layout.cylinders.index(name)
    stroke = model.plant.cylinders[cylinder].stroke
    here = equivalent(model, cylinder, _strokes(model.rig, recipe, stroke), recipe.posture)
    circuit = circuit_of(model, cylinder, study.maps)
    for function in _wanted(recipe):
        if circuit.able[function] == 0:
            if recipe.functions:
                raise InputError(
                    f"the valves of cylinder '{name}' are not able of '{FUNCTIONS[function]}'"
                )
            continue
        for index in range(here.x.size):
            for share in recipe.speed_shares:
                aim = Aim(study.low, study.cross, share=share, payload=payload, held=recipe.posture)
                own, point = study.steady(model, circuit, function, here, index, aim)
                if point.possible and point.v != 0.0:
                    linear = development_model(own, point)
                    yield Site(own, circuit, point, linear, point.fits)


def _those_that_count(
    sites: Sequence[Site], recipe: AnyTuning, name: str
) -> tuple[list[Site], list[str]]:
    """(sites to tune on or to show, what is odd about them): a function that no load calls for is
    shown, but no gain is chosen on it.

    Raises:
        InsufficientData: no site counts.
    """
    fitting = {site.point.function for site in sites if site.counts}
    result = {site.point.function for site in sites}
    lost = [f for f in recipe.functions if f not in result]
    notes = [f"{function} is possible at no operating point" for function in lost]
    retained = [site for site in sites if site.counts or site.point.function not in fitting]
    if not fitting:
        raise InsufficientData(
            f"no operating point of cylinder '{name}' calls for any of the functions asked for",
            hint="choose other functions, payloads or postures",
        )
    shown = sorted({site.point.function for site in retained} - fitting)
    notes += [
        f"{function} is shown only: at no operating point does the load call for it"
        for function in shown
    ]
    return retained, notes


def rail_notes(rig: Rig, points: Sequence[OperatingPoint]) -> list[str]:
    """A sentence where points stand near the pressure at which the low rail is not enough any more:
    a swing over it meets two supplies in turn, and no linear model has that.
    """
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
    return [
        f"at {near} of {len(points)} operating points the chamber that is fed stands within "
        "twice rail_margin of where the high rail takes over from the low one: a swing that "
        "reaches over is not in the promise"
    ]


def _strokes(rig: Rig, recipe: AnyTuning, stroke: float) -> np.ndarray:
    if not recipe.strokes:
        return (
            np.linspace(0.1, 0.9, recipe.postures) * stroke
            if recipe.postures > 1
            else np.array([0.5 * stroke])
        )
    x = np.array([float(read_value(text, VOCABULARY["x"])) for text in recipe.strokes])
    if x.min() < 0 or x.max() > stroke:
        raise InputError(
            "a stroke to tune at lies outside the cylinder's",
            hint=f"0 to {rig.text('x', stroke, 1)}",
        )
    return x
