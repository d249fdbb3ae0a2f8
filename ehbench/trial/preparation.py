"""All that is known of a trial before its machine runs: what is asked of it, from where, and where
it stops.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ehbench.errors import InputError
from ehbench.machines.protocol import Machine, truth_of
from ehbench.machines.registry import open_machine
from ehbench.machines.rows import COMMAND, LIMITS, MARGIN, Rows, limit_array, violated
from ehbench.quantities import VOCABULARY
from ehbench.recipe import TrialRecipe
from ehbench.rig import Rig
from ehbench.trial import controllers
from ehbench.trial.commands import command_table
from ehbench.trial.controllers import Compiled, Design
from ehbench.trial.motion import References, references
from ehbench.trial.user_code import UserCode
from ehbench.units import from_si

if TYPE_CHECKING:
    from ehbench.plant.build import Maps


@dataclass(frozen=True)
class Stop:
    """Why a trial stopped: which limit, on which channel, the value [SI] that reached it, its bound
    [SI] and when [s].

    ``sentence`` says so in the units of the rig file.
    """

    limit: str
    channel: str
    value: float
    bound: float
    t: float
    sentence: str


@dataclass(frozen=True)
class Loop:
    """A closed loop before there is a machine: design model, references, and the law.

    ``law`` is packed, and None for a user's class, which is loaded when its trial begins.
    ``low_side`` [Pa] is where the off-side chamber stands at the start.
    """

    design: Design
    references: References
    law: Compiled | None
    low_side: float


@dataclass(frozen=True)
class Prepared:
    """A trial ready to run: all that can be known of it before the first tick.

    ``machine`` is the one that the recipe names, not started; ``t`` [s], shape (samples,);
    ``table`` the open-loop commands [V], shape (samples, valves); ``limits`` as in
    `ehbench.machines.rows`; ``posture`` where it starts; ``loop`` None for open loop. It may run
    again, and gives the same bytes."""

    recipe: TrialRecipe
    rig: Rig
    maps: Maps | None
    machine: Machine
    t: np.ndarray
    table: np.ndarray
    limits: np.ndarray
    posture: dict[str, str]
    loop: Loop | None

    @property
    def duration(self) -> float:
        """Length [s] where no limit stops it."""
        return float(self.t[-1])

    @property
    def low_side(self) -> float | None:
        """Pressure [Pa] of the unloaded chambers at the start; None is the machine's own choice."""
        return None if self.loop is None else self.loop.low_side

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
        return law.afresh()

    def first_rows(self, machine: Machine, count: int | None = None) -> Rows:
        """The rows before the first tick, the machine at rest.

        Args:
            machine: is started.
            count: how many of the trial's rows; by default all.

        Raises:
            InputError: a posture that the machine cannot take; a limit reached before the start.
        """
        truth, t, recipe = truth_of(machine), self.t[:count], self.recipe
        with controllers.located(recipe, "posture"):
            sample = machine.start(self.posture, self.low_side)
        rows = Rows(
            t,
            self.table[:count].copy(),
            np.empty((t.size, sample.size)),
            np.empty((t.size, 0 if truth is None else truth.width)),
            sample,
            self.limits.copy(),
            machine.strokes,
            np.zeros(3, dtype=np.int64),
        )
        if violated(rows, 0):
            reached = self.reached(machine, rows, 0)
            raise InputError(
                "the trial cannot start: " + reached.sentence,
                **recipe.at("limits", reached.limit),
                hint="change the posture or the limit",
            )
        return rows

    def reached(self, machine: Machine, rows: Rows, row: int) -> Stop:
        """The limit that `violated` found in a row."""
        which, index, entry = (int(v) for v in rows.found)
        bound, t = float(rows.limits[which]), float(rows.t[row])
        if which == COMMAND:
            channel = f"{machine.commands.names[index]}.command"
            value = float(rows.commands[row, index])
        else:
            channel, value = machine.channels[entry], float(rows.sample[entry])
        if which == MARGIN and value >= bound:  # then it is the far end that came too near
            bound = float(rows.strokes[index]) - bound
        word = channel.rsplit(".", 1)[-1]
        unit = self.rig.unit_of(word)
        shown, edge = (from_si(v, unit, VOCABULARY[word]) for v in (value, bound))
        sentence = (
            f"{channel} = {shown:.4g} {unit} passed {LIMITS[which]}, which sets in at {edge:.4g} "
            f"{unit}, at t = {t:.4g} s"
        )
        return Stop(LIMITS[which], channel, value, bound, t, sentence)


def prepare(
    recipe: TrialRecipe,
    rig: Rig,
    maps: Maps | None = None,
    gains: Path | Mapping[str, Any] | None = None,
    allow_code: bool = False,
    standing: bool = False,
) -> Prepared:
    """Take in what a trial needs, without a tick and without code of the user's own.

    Args:
        recipe: what to do.
        rig: as the recipe names it.
        maps: measured flow maps of the rig, for the model and for the controller.
        gains: the run folder of the tune run that the recipe takes gains from, or what it says; by
            default where the recipe points.
        allow_code: lets a controller of the user's own run.
        standing: leave the desired motion out, where its speeds cannot be known.

    Raises:
        InputError: a command, posture, payload, motion, gain or bench file that does not fit the
            rig; on a machine that stands at its start at once, a limit reached there; code that is
            not allowed.
    """
    loop, posture = None, recipe.posture
    if recipe.controller is not None:
        controllers.refuse_code(recipe, allow_code)
        loop = _loop(recipe, rig, maps, gains, standing)
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
    machine = open_machine(recipe, rig, maps)
    limits = limit_array(recipe.limits)
    prepared = Prepared(recipe, rig, maps, machine, t, table, limits, posture, loop)
    if truth_of(machine) is not None:
        prepared.first_rows(machine, 1)
    else:
        with controllers.located(recipe, "posture"):
            machine.check_posture(posture)
    return prepared


def _loop(
    recipe: TrialRecipe,
    rig: Rig,
    maps: Maps | None,
    gains: Path | Mapping[str, Any] | None,
    standing: bool,
) -> Loop:
    design = controllers.design(recipe, rig, maps)
    if isinstance(gains, Mapping):
        tuning = dict(gains)
    else:
        tuning = controllers.read_tuning(recipe, gains)
    low = controllers.low_pressure(recipe, rig, tuning)
    still = np.tile([design.x, 0.0, 0.0, 0.0], (2, 1))
    motion = References(still) if standing else references(recipe, design, low)
    law = None
    if recipe.controller is not None and recipe.controller.code is None:
        rate = float(recipe.rate)
        law = controllers.compiled(recipe, design, tuning, motion.table, rate)
    return Loop(design, motion, law, float(rig.supply.tank_pressure) + low)


def _taken(recipe: TrialRecipe, design: Design) -> tuple[str, ...]:
    """Valves that the controller commands by itself; a user's class may leave any of them to the
    recipe.
    """
    if recipe.controller is None or recipe.controller.code is not None:
        return ()
    own = slice(design.circuit.first, design.circuit.first + design.circuit.count)
    return tuple(
        design.valves[i] for i in sorted({int(v) for v in design.circuit.edges.valve[own]})
    )
