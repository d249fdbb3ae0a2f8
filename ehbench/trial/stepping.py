"""Controllers by themselves, one tick at a time: for a plant of the user's, or a loop of theirs."""

from typing import Protocol, runtime_checkable

import numpy as np

from ehbench.machines.protocol import Inputs, Machine
from ehbench.machines.rows import control
from ehbench.trial.preparation import Prepared
from ehbench.trial.session import packed
from ehbench.trial.user_code import UserCode
from ehbench.vocabulary import InputError, message


@runtime_checkable
class Controller(Protocol):
    """What turns samples into commands, once a tick; the other half of a `Machine`.

    Example:
        recipe = "recipes/trials/own_controller.toml"
        controller: ehbench.Controller = ehbench.open_controller(recipe, allow_code=True)
        machine = ehbench.open_machine(recipe, allow_code=True)
        sample = machine.start(controller.posture, controller.low_side)
        controller.start(sample)
        for _ in range(controller.ticks):
            sample = machine.tick(controller.step(sample))

    Attributes:
        channels: names of the sample's entries, in order [SI].
        commands: the valves that it commands.
        rate: ticks a second [Hz].
        ticks: how many steps it has.
        posture: where its motion begins, as `Machine.start` takes it.
        low_side: pressure [Pa] of the unloaded chambers there, by cylinder."""

    channels: tuple[str, ...]
    commands: Inputs
    rate: float
    ticks: int
    posture: dict[str, str]
    low_side: dict[str, float]

    def start(self, sample: np.ndarray) -> None:
        """Begin anew with the machine at rest.

        Args:
            sample: SI, shape (channels,); nan where the machine has no sensor.

        Raises:
            InputError: a sample of another shape; a user's class that raised."""
        ...

    def step(self, sample: np.ndarray) -> np.ndarray:
        """The commands [V], shape (valves,), at a sample as `start` takes it.

        Raises:
            InputError: it was not started, or its motion is over; a user's class that raised."""
        ...


class RecipeController:
    """The controllers of a trial's recipe, or its open-loop commands, as a `Controller`."""

    def __init__(self, prepared: Prepared) -> None:
        self._prepared, machine = prepared, prepared.machine
        self.channels, self.commands, self.rate = machine.channels, machine.commands, machine.rate
        self.posture, self.low_side = prepared.posture, prepared.low_side
        self._row = self.ticks = prepared.t.size

    def start(self, sample: np.ndarray) -> None:
        """As `Controller.start`."""
        prepared = self._prepared
        laws = prepared.law(prepared.machine)
        self._code = next((law for law in laws if isinstance(law, UserCode)), None)
        self._rows = prepared.rows(prepared.machine, self._taken(sample))
        self._laws, self._row = packed(laws), 0
        if self._code is not None:
            self._code.start(self._rows.sample)

    def step(self, sample: np.ndarray) -> np.ndarray:
        """As `Controller.step`."""
        if self._row >= self.ticks:
            raise InputError(message("trial.no_step", ticks=self.ticks))
        rows, row = self._rows, self._row
        rows.sample[:] = self._taken(sample)
        if self._laws is not None:
            control(self._laws, row, rows)
        elif self._code is not None:
            self._code.step(row, float(rows.t[row]), rows.sample, rows.commands[row])
        self._row += 1
        return rows.commands[row].copy()

    def _taken(self, sample: np.ndarray) -> np.ndarray:
        try:
            result = np.array(sample, dtype=float)
        except (TypeError, ValueError):  # no numbers
            result = np.empty(0)
        if result.shape != (len(self.channels),):
            names = ", ".join(self.channels)
            raise InputError(message("trial.other_sample", shape=result.shape, channels=names))
        return result


def refuse_other(machine: Machine, prepared: Prepared) -> None:
    """Refuse a user's machine that lacks a part, or is not of a trial's rig and rate.

    Raises:
        InputError: says what differs."""
    like, parts = prepared.machine, (*Machine.__annotations__, *vars(Machine))
    missing = [name for name in parts if name[0] != "_" and not hasattr(machine, name)]
    if missing:
        raise InputError(message("trial.no_machine", names=", ".join(missing)))
    for name, here, right in (
        ("channels", machine.channels, like.channels),
        ("commands", machine.commands.names, like.commands.names),
        ("rate", machine.rate, like.rate),
    ):
        if here != right:
            raise InputError(
                message("trial.other_machine", machine=machine.name, name=name, here=here),
                hint=message("trial.like_machine", right=right),
            )
