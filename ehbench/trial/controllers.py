"""From a recipe's ``[controller]`` to something that turns samples into commands: a compiled law,
or a user's class.

A controller is designed on the recipe's rig without payload, and is given only the channels that it
observes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ehbench.config.recipe import TrialRecipe, load_rig
from ehbench.config.recipe.trial import Controller as ChosenController
from ehbench.config.rig import Rig
from ehbench.control.functions import (
    ALL_RULES,
    DIRECTION,
    RULE_NAMES,
    Circuit,
    default_pressure,
    pack_rules,
)
from ehbench.control.law import Controller, Law, late_of
from ehbench.control.monitor import monitor_of
from ehbench.control.records import numbers
from ehbench.control.registry import LAWS
from ehbench.control.trajectory import SHAPING_NAMES, V, pack_shaping
from ehbench.parts.cylinder import linkage_arrays
from ehbench.parts.sample import sample_size
from ehbench.plant.design_point import circuit_of, design_point_of
from ehbench.plant.model import Model
from ehbench.runs.rundir import read_json
from ehbench.vocabulary import VOCABULARY, InputError, Message, Quantity, from_si, message, placed
from ehbench.vocabulary.errors import nearest
from ehbench.vocabulary.fields import read_value, read_vector

if TYPE_CHECKING:
    from ehbench.plant.build import Maps

ROUNDING = 1.0e-7  # share of a number by which files of rigs may round it


@dataclass(frozen=True)
class Design:
    """What a controller may know of the machine: the recipe's rig without payload.

    ``model`` is its simulation model on ``maps``; ``cylinder`` the controlled one, number
    ``index``; ``q`` the posture of all joints at the start [rad or m]; ``circuit`` the cylinder's
    metering edges without those of valves the controller shall not use."""

    rig: Rig
    maps: Maps | None
    model: Model
    cylinder: str
    index: int
    q: np.ndarray
    circuit: Circuit

    @property
    def row(self) -> np.record:
        """The cylinder's row of the plant."""
        return self.model.plant.cylinders[self.index]

    @property
    def valves(self) -> tuple[str, ...]:
        """Names of all valves, in the order of the commands."""
        return self.model.layout.valves

    @property
    def at_cylinder(self) -> slice:
        """Where the cylinder's edges stand among all."""
        return slice(self.circuit.first, self.circuit.first + self.circuit.count)

    @property
    def edges(self) -> tuple[str, ...]:
        """Names of the cylinder's edges."""
        return self.model.layout.edges[self.at_cylinder]

    @property
    def valve_frequencies(self) -> dict[str, list[float]]:
        """Natural frequencies [rad/s] of the cylinder's slowest and fastest valve; nothing where
        its valves follow at once.
        """
        periods = [
            max(self.rig.dynamics[name].period() for name in valve.series)
            for owner, valve in self.rig.valves()
            if owner.name == self.cylinder and valve.series
        ]
        ends = [2.0 * math.pi / end for end in (max(periods), min(periods))] if periods else []
        return {"natural_frequency": ends} if all(ends) and ends else {}

    @property
    def x(self) -> float:
        """The cylinder's stroke [m] at the start."""
        joint = int(self.row.joint)
        return float(linkage_arrays(self.row, self.q[joint : joint + 1])[0][0])


@dataclass
class Compiled:
    """A built-in controller as the compiled loops take it.

    ``telemetry`` has a row a tick, its columns ``channels``, and none before `afresh`; ``rules``
    are those of function selection; ``used`` says what it was made of, SI: see
    `ehbench.control.law.Packed`."""

    law: Law
    controller: Controller
    channels: tuple[str, ...]
    references: np.ndarray
    telemetry: np.ndarray
    rules: np.record
    used: dict[str, Any]

    def afresh(self, plays: bool = True) -> Compiled:
        """The same at its beginning, for a run of its own; ``plays`` False on a machine whose
        valves have no hysteresis, whatever their maps know of one."""
        law, telemetry = self.controller, np.zeros((len(self.references), len(self.channels)))
        axis, given = law.axis, np.zeros(law.given.shape)
        if not plays:
            still = np.zeros_like(axis.circuit.play)
            axis = axis._replace(circuit=axis.circuit._replace(play=still))
        if law.monitor is not None:  # which writes what the circuit can do
            able = axis.circuit.able.copy()
            axis = axis._replace(circuit=axis.circuit._replace(able=able))
            old, known = law.monitor, law.monitor.sensors
            load = float(known.lines[1]), known.payload, known.steady
            monitor = monitor_of(axis, old.tick, old.lag, *load)
            law = law._replace(monitor=monitor)
        late = law.late._replace(desired=np.full_like(law.late.desired, np.nan))
        law = law._replace(axis=axis, memory=self.law.memory(axis), given=given, late=late)
        return replace(self, controller=law, telemetry=telemetry)


def valve_fault(design: Design, t: np.ndarray, code: np.ndarray) -> dict[str, Any]:
    """The valve that a monitor reported: its name, ``stays`` "shut" or "open", from time ``t`` [s].

    Args:
        design: of the controller.
        t: of the trial [s].
        code: channel `valve_fault`, not all zero.
    """
    first = int(np.flatnonzero(code)[0])
    circuit, number = design.circuit, int(code[first])
    valves = np.unique(circuit.edges.valve[circuit.first : circuit.first + circuit.count])
    name = design.valves[int(valves[abs(number) - 1])]
    return {"valve": name, "stays": "shut" if number > 0 else "open", "t": float(t[first])}


def controller_of(recipe: TrialRecipe) -> ChosenController:
    """The ``[controller]`` of a closed-loop trial's recipe."""
    assert recipe.controller is not None  # nothing here is asked of open loop
    return recipe.controller


def design(recipe: TrialRecipe, rig: Rig, maps: Maps | None, model: Model | None = None) -> Design:
    """The design of a trial; ``model`` is that of the rig on the maps, where it is made already.

    Raises:
        InputError: no such cylinder or valve, or a posture outside the stroke.
    """
    controller, motion = controller_of(recipe), recipe.motion
    motion_at = motion.where if motion is not None else ()
    names = [c.name for c in rig.cylinder]
    name = motion.cylinder if motion is not None else None
    if name is None and len(names) > 1:
        where = recipe.at(*(motion_at or ("controller",)))
        raise InputError(message("trial.several_cylinders", known=", ".join(names)), **where)
    with placed(recipe.at(*motion_at, "cylinder")):
        index = rig.cylinder.index(rig.cylinder_named(name)) if name is not None else 0
    model = Model.of(rig, maps) if model is None else model
    valves = model.layout.valves
    for valve in controller.unused:
        if valve not in valves:
            raise InputError(
                message("trial.unused_valve", valve=valve, known=", ".join(valves)),
                **recipe.at(*controller.where, "unused"),
            )
    with placed(recipe.at(*controller.where, "unused")):
        unused = [valves.index(valve) for valve in controller.unused]
        circuit = circuit_of(model, index, maps, unused)
    with placed(recipe.at(*motion_at, "waypoints")):
        q = model.posture(recipe.posture)
    return Design(rig, maps, model, names[index], index, q, circuit)


def refuse_unknown(recipe: TrialRecipe) -> None:
    """Refuse what built-in controllers are given and do not have, or are not given and need: it is
    known before anything that the recipe names has been run.

    Raises:
        InputError: an unknown gain, rule or word of shaping, a wrong unit, a gain that is missing,
            with the line.
    """
    chosen = recipe.controller
    if chosen is None or chosen.code is not None:
        return
    for cylinder in (chosen, *map(chosen.of, chosen.cylinders)):
        assert cylinder.kind is not None  # those of single cylinders are no classes either
        item, law = recipe.model_copy(update={"controller": cylinder}), LAWS[cylinder.kind]
        gains, _, _ = _recipe_tables(item, law)
        # that of all cylinders may be nobody's where these have laws of their own
        if chosen.gains_from is None and (cylinder is not chosen or not chosen.cylinders):
            _refuse_without(item, law, gains)


def gains_file(recipe: TrialRecipe) -> str | None:
    """The tune recipe, run folder or file that a recipe takes gains from, as written there."""
    return recipe.controller.gains_from if recipe.controller is not None else None


def compiled(
    recipe: TrialRecipe,
    design: Design,
    tuning: Mapping[str, Any] | None,
    references: np.ndarray,
    rate: float,
) -> Compiled:
    """A built-in controller, ready to run over the rows of ``references``.

    Raises:
        InputError: a gain or rule that is unknown or wrong.
    """
    chosen = controller_of(recipe)
    assert chosen.kind is not None  # it is no class of the user's
    law, unused = LAWS[chosen.kind], [design.valves.index(name) for name in chosen.unused]
    point = design_point_of(design.model, design.circuit, design.q, 1.0 / rate, unused)
    gains, given_rules, given_shaping = _taken(recipe, law, tuning, design.cylinder)
    low = gains.get("low_pressure", point.low_pressure)
    with placed(recipe.at(*chosen.where, "rules")):
        rules = pack_rules(
            design.circuit.area_rod, point.supply_pressure, low_pressure=low, **given_rules
        )
    for way, word in ((1, "extend"), (-1, "retract")):
        moves = (way * references[:, V] > rules.speed_start).any()
        if moves and not design.circuit.able[way == DIRECTION].any():
            text = message("trial.no_function", cylinder=design.cylinder, direction=word)
            raise InputError(text, **recipe.at("motion"))
    with placed(recipe.at(*chosen.where, "shaping")):
        shaping = pack_shaping(**given_shaping)
    _refuse_without(recipe, law, gains)
    with placed(recipe.at(*chosen.where, "gains")):
        packed = law.pack(point, gains, rules, shaping)
    channels, monitor = sample_size(len(design.model.layout.cylinders)), None
    if chosen.monitor:
        tank, times = design.model.plant.tank_pressure, (point.tick, point.valve_lag)
        known = not point.unmodelled
        load = tank, point.payload if known else math.inf, known and not recipe.payload_change
        monitor = monitor_of(point.axis, *times, *load)
    controller = Controller(
        point.axis,
        packed.gains,
        law.memory(point.axis),
        law.observed(point.axis, channels),
        np.zeros(channels),
        late_of(float(chosen.delay), point.tick),
        monitor,
    )
    names = law.channels(design.cylinder, design.edges)
    if chosen.monitor:
        names = (*names, f"{design.cylinder}.valve_fault")
    used = {**packed.used, "rules": numbers(rules, ALL_RULES)}
    if "cylinders" in chosen.where:  # otherwise the controller's label says it
        used["law"] = law.name
    return Compiled(law, controller, names, references, np.empty((0, len(names))), rules, used)


def low_pressure(recipe: TrialRecipe, rig: Rig, tuning: Mapping[str, Any] | None) -> float:
    """Set-point of the off-side chamber above tank [Pa] that a recipe's controller has, at which
    its trial starts."""
    given = controller_of(recipe).written_gains.get("low_pressure")
    if given is not None:
        return quantities(
            recipe, "gains", {"low_pressure": given}, {"low_pressure": VOCABULARY["low_pressure"]}
        )["low_pressure"]
    return float((tuning or {}).get("low_pressure") or default_pressure(float(rig.supply.pressure)))


def read_tuning(recipe: TrialRecipe, folder: Path | None) -> dict[str, Any] | None:
    """What the tune run says that a recipe names, from ``folder`` or, without one, from where the
    recipe points; ``parameters`` [SI] are those of the rig that the run leaves, ``validated`` and
    ``reservations`` what its validation said of it.

    Raises:
        InputError: there is no ``tuning.json``.
    """
    name = gains_file(recipe)
    if name is None:
        return None
    path = recipe.file(name) if folder is None else folder
    if path.is_dir():
        path = path / "tuning.json"
    if path.suffix != ".json":
        where = recipe.at(*controller_of(recipe).where, "gains")
        raise InputError(message("trial.gains_of_recipe", name=name), **where)
    is_run = all(path.with_name(file).is_file() for file in ("run.json", "rig.toml"))
    known = {}
    if is_run:
        facts = read_json(path.with_name("run.json"))
        known = {name: facts[name] for name in ("validated", "reservations") if name in facts}
        numbers = load_rig(path.parent).parameters()
        known["parameters"] = {name: float(value) for name, value in numbers.items()}
    return read_json(path) | known


def not_as_tuned(
    recipe: TrialRecipe, rig: Rig, tuning: Mapping[str, Any] | None
) -> tuple[Message, ...]:
    """Notes where gains were tuned for another supply, rig, tick or law than the trial's, on a
    rig that no validation accepted without reservation, or miss what was demanded of them."""
    if tuning is None:
        return ()
    notes = (*other_supply(rig, tuning), *other_rig(rig, tuning))
    if not tuning.get("validated", True):
        notes += (message("stages.tuned_unvalidated"),)
    for reason in tuning.get("reservations", ())[:1]:
        notes += (message("stages.tuned_with_reservation", reason=reason),)
    notes += (message("stages.demands_missed"),) * (not tuning.get("met", True))
    tick, chosen = 1.0 / float(recipe.rate), recipe.controller
    if (tuned := tuning.get("tick")) is not None and _differ(tuned, tick):
        notes += (message("trial.other_tick", tuned=1e3 * tuned, tick=1e3 * tick),)
    if chosen is not None and chosen.kind is not None:
        law, of = LAWS[chosen.kind], LAWS[tuning.get("what", "pressure_feedback")]
        lost = [name for name in of.gains if name in tuning and name not in law.gains]
        fields = {"law": law.name, "tuned": of.name, "lost": ", ".join(lost)}
        notes += (message("trial.other_law", **fields),) * bool(lost)
    return notes


def other_supply(rig: Rig, tuning: Mapping[str, Any]) -> tuple[Message, ...]:
    """A note where gains were tuned on another supply than the trial's."""
    tuned, here = tuning.get("supply"), rig.supply.facts()
    if tuned is None:
        return ()
    if tuned.keys() == here.keys() and not any(_differ(tuned[name], here[name]) for name in here):
        return ()
    if tuned["kind"] != here["kind"]:
        supply = message("trial.other_kind", tuned=tuned["kind"], kind=here["kind"])
        return (message("trial.other_supply", supply=supply),)
    changes = []
    for name in [name for name in here if name != "kind"]:
        unit, row = rig.unit_of(name), VOCABULARY[name]
        before, now = (f"{from_si(item[name], unit, row):.4g}" for item in (tuned, here))
        other = _differ(tuned[name], here[name])
        changes.append(f"{name} {before} {unit}" + f" (here {now})" * other)
    supply = ", ".join([here["kind"], *changes])
    return (message("trial.other_supply", supply=supply),)


def other_rig(rig: Rig, tuning: Mapping[str, Any]) -> tuple[Message, ...]:
    """A note where gains were tuned on a rig of other numbers than the trial's, with the one that
    differs most; those of the supply are in `other_supply`."""
    tuned = tuning.get("parameters", {})
    here = {name: float(value) for name, value in rig.parameters().items()}
    apart: dict[str, float] = {}
    for name in [*here, *(name for name in tuned if name not in here)] if tuned else ():
        pair = tuned.get(name, math.nan), here.get(name, math.nan)
        if name.removeprefix("supply.") not in rig.supply.facts() and _differ(*pair):
            share = abs(pair[0] - pair[1]) / max(map(abs, pair))
            apart[name] = math.inf if math.isnan(share) else share
    if not apart:
        return ()
    name = max(apart, key=lambda name: apart[name])
    numbers = {"tuned": tuned.get(name), "here": here.get(name)}
    shown = {key: "none" if x is None else rig.shown(name, x, 5) for key, x in numbers.items()}
    return (message("trial.other_rig", count=len(apart), name=name, **shown),)


def _differ(item: Any, other: Any) -> bool:
    if isinstance(item, str) or isinstance(other, str):
        return item != other
    return not math.isclose(item, other, rel_tol=ROUNDING)


def _refuse_without(recipe: TrialRecipe, law: Law, gains: Mapping[str, Any]) -> None:
    """Refuse gains that lack what the law cannot do without."""
    required = law.required
    if required is not None and required.gain not in gains:
        raise InputError(required.message, **recipe.at(*controller_of(recipe).where))


def _taken(
    recipe: TrialRecipe, law: Law, tuning: Mapping[str, Any] | None, cylinder: str
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """(gains, rules, shaping) of a recipe, SI: those of the tune run, and over them those that
    stand in the recipe."""
    gains, rules, shaping = _recipe_tables(recipe, law)
    if tuning is not None:
        if tuning.get("cylinder") != cylinder:
            raise InputError(
                message("trial.other_cylinder", tuned=tuning.get("cylinder"), cylinder=cylinder),
                **recipe.at(*controller_of(recipe).where, "gains"),
            )
        gains = {name: tuning[name] for name in law.gains if name in tuning} | gains
        rules = {name: tuning[name] for name in RULE_NAMES if name in tuning} | rules
    return gains, rules, shaping


def _recipe_tables(
    recipe: TrialRecipe, law: Law
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """(gains, rules, shaping) that stand in a recipe, SI."""
    chosen = controller_of(recipe)
    rules: dict[str, Quantity | None] = {name: VOCABULARY[name] for name in RULE_NAMES}
    rules |= {"choice": None, "allow_seventh": None}
    shaping = {name: VOCABULARY[name] for name in SHAPING_NAMES}
    return (
        quantities(recipe, "gains", chosen.written_gains, law.gains, law.bounds),
        quantities(recipe, "rules", chosen.rules, rules),
        quantities(recipe, "shaping", chosen.shaping, shaping),
    )


def quantities(
    recipe: TrialRecipe,
    table: str,
    given: Mapping[str, Any],
    rows: Mapping[str, Quantity | None],
    bounds: Sequence[str] = (),
) -> dict[str, Any]:
    """The numbers [SI] of a table of the controller, by name; a row of None is yes or no, or a
    word where it is the ``choice``; one of ``bounds`` a list of two.

    Raises:
        InputError: an unknown name, a wrong unit, with the line.
    """
    controller, values = controller_of(recipe), {}
    for name, raw in given.items():
        where = recipe.at(*controller.where, table, name)
        if name not in rows:
            suggestion = nearest(name, rows) or f"it has {', '.join(rows)}"
            fields = {"controller": controller.label, "table": table, "name": name}
            raise InputError(message("trial.unknown_key", **fields, suggestion=suggestion), **where)
        try:
            values[name] = _number(name, raw, rows[name], name in bounds)
        except InputError as error:
            problem = message("trial.wrong_value", name=name, problem=error.message)
            raise InputError(problem, **where, hint=error.hint) from None
    return values


def _number(name: str, raw: Any, row: Quantity | None, pair: bool) -> Any:
    """A value of a table of the controller [SI]; of the feedback gain also one for each working
    function."""
    if row is None:
        if name == "choice":
            return raw
        if not isinstance(raw, bool):
            raise InputError(message("trial.not_a_switch", name=name, value=raw))
        return raw
    if name == "feedback_gain" and isinstance(raw, Mapping):
        return {function: float(read_value(value, row)) for function, value in raw.items()}
    if pair:
        return read_vector(raw, row, ("lower", "upper")).value
    return float(read_value(raw, row))
