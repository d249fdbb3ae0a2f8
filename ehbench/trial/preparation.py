"""All that is known of a trial before its machine runs: what is asked of it, from where, and where
it stops.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ehbench.errors import InputError
from ehbench.machines.protocol import Machine
from ehbench.machines.registry import open_machine
from ehbench.machines.rows import limit_array
from ehbench.physics.metering import VALVE
from ehbench.recipe import TrialRecipe
from ehbench.rig import Rig
from ehbench.trial import controllers
from ehbench.trial.commands import command_table
from ehbench.trial.controllers import Compiled, Design, UserCode
from ehbench.trial.motion import Wishes, wishes

if TYPE_CHECKING:
    from ehbench.simulation import Maps


@dataclass(frozen=True)
class Loop:
    """A closed loop before there is a machine: design model, references, and the law.

    ``law`` is packed, and None for a user's class, which is loaded when its trial begins.
    ``low_side`` [Pa] is where the off-side chamber stands at the start.
    """

    design: Design
    references: Wishes
    law: Compiled | None
    low_side: float


@dataclass(frozen=True)
class Prepared:
    """A trial ready to run, on whatever machine.

    ``t`` [s], shape (samples,); ``table`` the open-loop commands [V], shape (samples, valves);
    ``limits`` as in `ehbench.machines.rows`; ``posture`` where it starts; ``loop`` None for open
    loop. Nothing in it changes when it runs, so that it may run again."""

    recipe: TrialRecipe
    rig: Rig
    maps: Maps | None
    t: np.ndarray
    table: np.ndarray
    limits: np.ndarray
    posture: dict[str, str]
    loop: Loop | None

    @property
    def low_side(self) -> float | None:
        """Pressure [Pa] of the unloaded chambers at the start; None is the machine's own choice."""
        return None if self.loop is None else self.loop.low_side

    def open(self) -> Machine:
        """The machine that the recipe names.

        Raises:
            InputError: a payload, bench file or posture that does not fit.
        """
        machine = open_machine(self.recipe, self.rig, self.maps)
        with controllers.located(self.recipe, "posture"):
            machine.check_posture(self.posture)
        return machine

    def law(self, machine: Machine) -> Compiled | UserCode | None:
        """A controller at its beginning, for one run on a machine; None for open loop.

        Raises:
            InputError: a user's class that cannot be loaded, or raised.
        """
        if self.loop is None:
            return None
        law, table = self.loop.law, self.loop.references.table
        if law is None:
            return UserCode(self.recipe, self.loop.design, machine.channels, machine.rate, table)
        own = {"given": law.given.copy(), "memory": law.memory.copy(), "notes": law.notes.copy()}
        return replace(law, **own)


def prepare(
    recipe: TrialRecipe,
    rig: Rig,
    maps: Maps | None = None,
    gains: Path | Mapping[str, Any] | None = None,
    allow_code: bool = False,
    blind: bool = False,
) -> Prepared:
    """Prepare a trial.

    Args:
        recipe: what to do.
        rig: as the recipe names it.
        maps: measured flow maps of the rig, for the model and for the controller.
        gains: the run folder of the tune run that the recipe takes gains from, or what it says; by
            default where the recipe points.
        allow_code: lets a controller of the user's own run.
        blind: the flow maps that the motion's speeds hang on are not there yet, so that the
            reference stands still.

    Raises:
        InputError: a command, posture, motion or gain that does not fit the rig; code that is not
            allowed.
    """
    loop, posture = None, recipe.posture
    if recipe.controller is not None:
        controllers.refuse_code(recipe, allow_code)
        loop = _loop(recipe, rig, maps, gains, blind)
        posture = controllers.posture_of(recipe, loop.design.cylinder)
    rate = float(recipe.rate)
    if loop is not None:
        count = len(loop.references.table)
    else:
        assert recipe.duration is not None  # the recipe's model sees to it
        count = round(float(recipe.duration) * rate) + 1
    if count < 2:
        raise InputError(
            "the trial is shorter than one sample",
            **recipe.at("duration"),
            hint="raise duration or rate",
        )
    t = np.arange(count) / rate
    table = command_table(recipe, rig, t, () if loop is None else _taken(recipe, loop.design))
    return Prepared(recipe, rig, maps, t, table, limit_array(recipe.limits), posture, loop)


def _loop(
    recipe: TrialRecipe,
    rig: Rig,
    maps: Maps | None,
    gains: Path | Mapping[str, Any] | None,
    blind: bool,
) -> Loop:
    design = controllers.design(recipe, rig, maps)
    told = isinstance(gains, Mapping)
    tuning = dict(gains) if told else controllers.read_tuning(recipe, gains)
    low = controllers.low_pressure(recipe, rig, tuning)
    still = np.tile([design.x, 0.0, 0.0, 0.0], (2, 1))
    references = Wishes(still) if blind else wishes(recipe, design, low)
    law = None
    if recipe.controller is not None and recipe.controller.code is None:
        rate = float(recipe.rate)
        law = controllers.compiled(recipe, design, tuning, references.table, rate)
    return Loop(design, references, law, float(rig.supply.tank_pressure) + low)


def _taken(recipe: TrialRecipe, design: Design) -> tuple[str, ...]:
    """Valves that the controller commands by itself; a user's class may leave any of them to the
    recipe.
    """
    if recipe.controller is None or recipe.controller.code is not None:
        return ()
    own = slice(design.circuit.first, design.circuit.first + design.circuit.count)
    return tuple(
        design.valves[i] for i in sorted({int(v) for v in design.circuit.wiring[own, VALVE]})
    )
