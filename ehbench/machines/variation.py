"""Machines that are not the one a controller was designed on: the model or the virtual bench with
slower valves, other oil, more friction, late sensors, other flow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from ehbench.errors import InputError
from ehbench.machines.simulated import SimulatedMachine
from ehbench.machines.virtual import VirtualMachine
from ehbench.physics.flow_map import FlowMap, FlowMaps, collect
from ehbench.plant.build import Maps
from ehbench.plant.model import Model
from ehbench.quantities import VOCABULARY
from ehbench.recipe import BenchRecipe, MachineChange, TrialRecipe, load_recipe
from ehbench.recipe.bench import BenchSensors
from ehbench.rig import Rig, Value, read_value

FRICTION = ("friction_coulomb", "friction_static", "friction_viscous")
FLOW = ("flow_gain", "compensated_gain", "map_factor")
SENSOR_LAG = 5.3e-5  # [s] of a bench's pressure sensors where its file says nothing


def varied(recipe: TrialRecipe, rig: Rig, maps: Maps | None) -> SimulatedMachine | VirtualMachine:
    """The machine of a trial's recipe after its ``machine`` changes; the design is not changed.

    Raises:
        InputError: late sensors of the model, which has exact ones; a bench file that does not fit.
    """
    change = recipe.machine
    assert change is not None  # else it is the machine as it is
    if recipe.on == "bench":
        return _bench(recipe, change, rig, maps)
    for key in ("delay", "pressure_lag"):
        if float(getattr(change, key)):
            raise InputError(
                f"the sensors of the model are exact: it has no {key}",
                **recipe.at(*change.where, key),
                hint='take on = "bench"',
            )
    own = varied_rig(rig, change, flow=True)
    model = Model.of(own, _varied_maps(maps, float(change.deadband)), recipe.payload)
    return SimulatedMachine(model, float(recipe.rate), float(recipe.step))


def varied_rig(rig: Rig, change: MachineChange, flow: bool) -> Rig:
    """A rig with slower valves, other oil, more friction and less supply; with other ``flow`` and
    deadbands as well, where asked for.
    """
    known, values = rig.parameters(), {}
    for name, value in known.items():
        owner, _, word = name.rpartition(".")
        number = float(value)
        if owner in rig.dynamics:
            powers = {"s1": 1, "s2": 2, "time_constant": 1}
            if f"{owner}.s1" not in known:
                powers["natural_frequency"] = -1
            number *= change.valve_lag ** powers.get(word, 0)
        elif word == "bulk_modulus":
            number *= change.bulk_modulus
        elif word in FRICTION:
            number *= change.friction
        elif name == "supply.pressure":
            number *= change.supply_pressure
        elif flow and word in FLOW:
            number *= change.flow
        elif flow and word == "deadband":
            number = max(number + float(change.deadband), 0.0)
        if number != float(value):
            values[name] = number
    return rig.with_values(values) if values else rig


def _varied_maps(maps: Maps | None, shift: float) -> Maps | None:
    """Flow maps whose edges open by ``shift`` [V] later."""
    if not isinstance(maps, FlowMaps) or shift == 0.0:
        return maps

    def later(one: FlowMap) -> FlowMap:
        low, high = one.deadband_interval
        return replace(
            one,
            deadband=one.deadband + shift,
            deadband_interval=(low + shift, high + shift),
            opening_knots=one.opening_knots + shift,
            hull_command=one.hull_command + shift,
            std_command=one.std_command + shift,
            rising_to=one.rising_to + shift,
        )

    return collect([later(one) for one in maps.each()])


def _bench(
    recipe: TrialRecipe, change: MachineChange, rig: Rig, maps: Maps | None
) -> VirtualMachine:
    given: dict[str, Any] = {
        "payload": recipe.payload,
        "rate": float(recipe.rate),
        "seed": recipe.seed,
    }
    own, bench = VirtualMachine.of(recipe, rig, maps).rig, BenchRecipe(stage="bench", rig="")
    if recipe.bench is not None:
        told = load_recipe(recipe.file(recipe.bench))
        assert isinstance(told, BenchRecipe)
        bench = told
    machine = VirtualMachine(varied_rig(own, change, flow=False), _told(bench, change), **given)
    curves = machine.bench.curves
    curves.gain *= change.flow
    curves.onset += float(change.deadband)
    return machine


def _told(bench: BenchRecipe, change: MachineChange) -> BenchRecipe:
    """A bench file after a change."""
    truth, row = dict(bench.truth), VOCABULARY["bulk_modulus"]
    if "bulk_modulus" in truth:
        stiff = change.bulk_modulus * float(read_value(truth["bulk_modulus"], row))
        truth["bulk_modulus"] = f"{stiff!r} {row.unit}"
    tables = {
        "cylinder": _scaled(bench.cylinder, FRICTION, change.friction),
        "valve": _scaled(bench.valve, ("natural_frequency",), 1.0 / change.valve_lag),
    }
    sensors = {}
    for name, one in {"all": BenchSensors(), **bench.sensors}.items():
        lag = SENSOR_LAG if one.pressure_lag is None else float(one.pressure_lag)
        if name == "all" or one.pressure_lag is not None:
            late = Value(lag + float(change.pressure_lag))
            one = one.model_copy(update={"pressure_lag": late})
        sensors[name] = one
    late = Value(float(bench.delay) + float(change.delay))
    return bench.model_copy(update={**tables, "truth": truth, "sensors": sensors, "delay": late})


def _scaled(tables: Mapping[str, Any], keys: Sequence[str], factor: float) -> dict[str, Any]:
    """Tables of a bench file with some of their numbers times a factor, where they are given."""
    scaled = {}
    for name, one in tables.items():
        given = {key: getattr(one, key) for key in keys}
        update = {
            key: Value(factor * float(value)) for key, value in given.items() if value is not None
        }
        scaled[name] = one.model_copy(update=update)
    return scaled
