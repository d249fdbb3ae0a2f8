"""Which machines there are, by the ``on`` of a trial's recipe, and machines that differ from the
design: slower valves, other oil, friction or flow, later sensors."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from ehbench.config.recipe import MachineChange, TrialRecipe
from ehbench.config.rig import Rig
from ehbench.machines.faults import FaultyMachine
from ehbench.machines.fmu import FmuMachine
from ehbench.machines.protocol import Machine
from ehbench.machines.simulated import SimulatedMachine
from ehbench.machines.virtual import VirtualMachine, bench_of
from ehbench.machines.virtual.plant import RAW
from ehbench.parts.sample import OF
from ehbench.physics.flow_map import FlowMaps, collect
from ehbench.plant.build import Maps
from ehbench.plant.model import Model
from ehbench.vocabulary import InputError, message, placed, quantity
from ehbench.vocabulary.fields import Value, read_value

MACHINES: dict[str, Callable[[TrialRecipe, Rig, Maps | None], Machine]] = {
    "model": lambda recipe, rig, maps: (SimulatedMachine if rig.model is None else FmuMachine).of(
        recipe, rig, maps
    ),
    "bench": VirtualMachine.of,
}
FRICTION = ("friction_coulomb", "friction_static", "friction_viscous")
FLOW = ("flow_gain", "compensated_gain", "map_factor")
# powers of the valves' periods in the numbers of their dynamics
PERIODS = {"s1": 1, "s2": 2, "lag": 1, "delay": 1, "corner": -1, "natural_frequency": -1}


def open_machine(recipe: TrialRecipe, rig: Rig, maps: Maps | None = None) -> Machine:
    """The machine that a trial's recipe asks for; the model where it asks for one at an address.

    Args:
        recipe: its ``on`` names the machine.
        rig: as the recipe names it, without payload.
        maps: measured flow maps of the rig.

    Raises:
        InputError: no such payload, or a bench file that does not fit the rig.
    """
    with placed(recipe.at("payload")):
        rig.with_payload(recipe.payload)
    change = recipe.machine
    machine = (
        MACHINES.get(recipe.on, SimulatedMachine.of)(recipe, rig, maps)
        if change is None or (rig.model is not None and recipe.on == "model")
        else varied(recipe, rig, maps)
    )
    faults = [(fault, recipe.at("fault", i)) for i, fault in enumerate(recipe.fault)]
    if change is not None:
        places = (recipe.at(*change.where, "fault", i) for i in range(len(change.fault)))
        faults += zip(change.fault, places, strict=True)
    return FaultyMachine(machine, faults, rig) if faults else machine


def varied(recipe: TrialRecipe, rig: Rig, maps: Maps | None) -> SimulatedMachine | VirtualMachine:
    """The machine of a trial's recipe after its ``machine`` changes; the design is not changed.

    Raises:
        InputError: late sensors of the model, which has exact ones; a bench file that does not fit.
    """
    change = recipe.machine
    assert change is not None  # else it is the machine as it is
    if recipe.on == "bench":
        return _bench(recipe, change, rig)
    if float(change.pressure_lag):
        where = recipe.at(*change.where, "pressure_lag")
        raise InputError(message("machines.exact_sensors"), **where)
    shift = float(change.deadband)
    if isinstance(maps, FlowMaps) and shift != 0.0:  # their edges open later
        moved = ("deadband", "opening_knots", "hull_command", "std_command", "rising_to")
        shifted = []
        for item in maps.each():
            low, high = item.deadband_interval
            values: dict[str, Any] = {name: getattr(item, name) + shift for name in moved}
            values["deadband_interval"] = (low + shift, high + shift)
            shifted.append(replace(item, **values))
        maps = collect(shifted)
    model = Model.of(_varied_rig(rig, change), maps, recipe.payload)
    # late commands do to a loop what late samples do
    model.plant.valves.delay += float(change.delay)
    step = recipe.step if isinstance(recipe.step, str) else float(recipe.step)
    return SimulatedMachine(model, float(recipe.rate), step)


def _powers(rig: Rig) -> dict[str, int]:
    """Powers of the valves' periods in the parameters of a rig."""
    known = rig.parameters()
    powers = {}
    for name in known:
        owner, _, word = name.rpartition(".")
        told_twice = word == "natural_frequency" and f"{owner}.s1" in known
        if owner in rig.dynamics and not told_twice:
            powers[name] = PERIODS.get(word, 0)
    return powers


def _changed(name: str, number: float, change: MachineChange, powers: Mapping[str, int]) -> float:
    word = name.rpartition(".")[2]
    if name in powers:
        return number * change.valve_lag ** powers[name]
    if name == "supply.pressure":
        return number * change.supply_pressure
    if word == "deadband":
        return max(number + float(change.deadband), 0.0)
    factors = {"bulk_modulus": change.bulk_modulus, **dict.fromkeys(FRICTION, change.friction)}
    factors |= dict.fromkeys(FLOW, change.flow)
    return number * factors.get(word, 1.0)


def _varied_rig(rig: Rig, change: MachineChange) -> Rig:
    known = {name: float(value) for name, value in rig.parameters().items()}
    powers = _powers(rig)
    values = {name: _changed(name, number, change, powers) for name, number in known.items()}
    values = {name: number for name, number in values.items() if number != known[name]}
    return rig.with_values(values) if values else rig


def _bench(recipe: TrialRecipe, change: MachineChange, rig: Rig) -> VirtualMachine:
    base, bench = bench_of(recipe, rig)
    # what a bench draws by the rig's numbers stays: these are changed where they act
    slower = change.model_copy(
        update={"friction": 1.0, "flow": 1.0, "deadband": Value(0.0), "supply_pressure": 1.0}
    )
    truth, powers, valves = {}, _powers(base), {}
    for name, text in bench.truth.items():
        row = quantity(name)
        number = _changed(name, float(read_value(text, row)), slower, powers)
        truth[name] = f"{number!r} {row.unit}"
    for name, item in bench.valve.items():
        if item.natural_frequency is not None:
            frequency = Value(float(item.natural_frequency) / change.valve_lag)
            item = item.model_copy(update={"natural_frequency": frequency})
        valves[name] = item
    late = Value(float(bench.delay) + float(change.delay))
    bench = bench.model_copy(update={"truth": truth, "valve": valves, "delay": late})
    given = recipe.payload, float(recipe.rate)
    machine = VirtualMachine(_varied_rig(base, slower), bench, *given, seed=recipe.seed)
    plant = machine.bench
    for name in FRICTION:
        plant.cylinders[name] *= change.friction
    plant.curves.gain *= change.flow
    # of the spool: a driver's gain lies before it
    shift = float(change.deadband) * plant.valves.gain[plant.edges.valve]
    for curve in (plant.edges.forward, plant.edges.reverse):
        plant.curves.onset[curve] += shift
    plant.supply.pressure *= change.supply_pressure
    chambers = [channel in (OF.p_head, OF.p_rod) for channel in RAW] * len(plant.cylinders)
    lines = [True] * (machine.raw - len(chambers))
    plant.sensors.lag[chambers + lines] += float(change.pressure_lag)
    return machine
