"""Which machines there are, by the ``on`` of a trial's recipe."""

from __future__ import annotations

from collections.abc import Callable

from ehbench.config.recipe import TrialRecipe
from ehbench.config.rig import Rig
from ehbench.machines.protocol import Machine
from ehbench.machines.simulated import SimulatedMachine
from ehbench.machines.variation import varied
from ehbench.machines.virtual import VirtualMachine
from ehbench.plant.build import Maps
from ehbench.vocabulary.errors import InputError

MACHINES: dict[str, Callable[[TrialRecipe, Rig, Maps | None], Machine]] = {
    "model": SimulatedMachine.of,
    "bench": VirtualMachine.of,
}


def open_machine(recipe: TrialRecipe, rig: Rig, maps: Maps | None = None) -> Machine:
    """The machine that a trial's recipe asks for.

    Args:
        recipe: its ``on`` names the machine.
        rig: as the recipe names it, without payload.
        maps: measured flow maps of the rig.

    Raises:
        InputError: no such payload, or a bench file that does not fit the rig.
    """
    try:
        rig.with_payload(recipe.payload)
    except InputError as error:
        raise InputError(error.message, **recipe.at("payload"), hint=error.hint) from None
    if recipe.machine is not None:
        return varied(recipe, rig, maps)
    return MACHINES[recipe.on](recipe, rig, maps)
