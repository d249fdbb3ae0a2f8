"""Which machines there are, by the ``on`` of a trial's recipe."""

from collections.abc import Callable

from ehbench.config.recipe import TrialRecipe
from ehbench.config.rig import Rig
from ehbench.machines.faults import FaultyMachine
from ehbench.machines.fmu import FmuMachine
from ehbench.machines.protocol import Machine
from ehbench.machines.simulated import SimulatedMachine
from ehbench.machines.variation import varied
from ehbench.machines.virtual import VirtualMachine
from ehbench.plant.build import Maps
from ehbench.vocabulary import placed

MACHINES: dict[str, Callable[[TrialRecipe, Rig, Maps | None], Machine]] = {
    "model": lambda recipe, rig, maps: (SimulatedMachine if rig.model is None else FmuMachine).of(
        recipe, rig, maps
    ),
    "bench": VirtualMachine.of,
}


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
