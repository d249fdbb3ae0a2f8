"""A user's FMU behind the protocol of a machine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ehbench.config.recipe import TrialRecipe
from ehbench.config.rig import Rig
from ehbench.machines.protocol import Inputs, Posture
from ehbench.parts.sample import sample_channels
from ehbench.plant.build import Maps
from ehbench.plant.foreign import FmuModel
from ehbench.plant.model import Start
from ehbench.plant.trim import LowSide
from ehbench.runtime.fmu import FmuProcess
from ehbench.vocabulary import InputError, message, setting
from ehbench.vocabulary.errors import FmuError


@dataclass(frozen=True)
class FmuMachineSettings:
    """Numbers of an FMU as a machine."""

    off: float = setting(0.01, "", "error of a start's posture, of the stroke", "a sensor's")


SETTINGS = FmuMachineSettings()


class FmuMachine:
    """The FMU of a rig as a machine: each tick is a step of its own.

    Args:
        model: with its payload.
        rate: ticks a second [Hz].

    Raises:
        InputError: no such file or variable, or not for this platform.
    """

    name, latency = "fmu", 0.0
    plays = False

    def __init__(self, model: FmuModel, rate: float = 1000.0) -> None:
        self.model, self.rate = model, float(rate)
        self.channels, self.commands = sample_channels(model.layout.cylinders), Inputs.of(model)
        self.strokes = model.plant.cylinders.stroke.copy()
        self.unmeasured = tuple(name for name in self.channels if not model.shows(name))
        self._process: FmuProcess | None = None
        self._first = Start(np.zeros(0))

    @classmethod
    def of(cls, recipe: TrialRecipe, rig: Rig, maps: Maps | None) -> FmuMachine:
        """The FMU that a trial runs on."""
        if recipe.machine is not None:
            raise InputError(message("machines.fmu_changed"), **recipe.at(*recipe.machine.where))
        return cls(FmuModel.of(rig, maps, recipe.payload), float(recipe.rate))

    def check_posture(self, posture: Posture) -> None:
        """As `Machine.check_posture`."""
        self.model.posture(posture)

    def start(self, posture: Posture = None, low_side: LowSide = None) -> np.ndarray:
        """As `Machine.start`; also

        Raises:
            InputError: it does not begin in the posture.
            FmuError: it crashes or hangs, or gives numbers that are not finite.
        """
        model = self.model
        self._first = Start(model.trim(model.posture(posture), low_side))
        self._process = self._process or model.binding.open()
        rest = model.commanded(self.commands.rest)
        values = np.concatenate([model.values_at(self._first), rest])
        sample = self._sample(self._process.start(values))
        desired = model.record(np.zeros(1), None, self._first.y[None, :])
        for name, stroke in zip(model.layout.cylinders, self.strokes, strict=True):
            here, there = sample[self.channels.index(f"{name}.x")], desired[f"{name}.x"][0]
            if abs(here - there) > SETTINGS.off * stroke:
                fields = {"name": name, "here": model.rig.shown("x", here)}
                fields["there"] = model.rig.shown("x", there)
                raise InputError(message("machines.fmu_elsewhere", **fields))
        return sample

    def tick(self, command: np.ndarray) -> np.ndarray:
        """As `Machine.tick`."""
        if self._process is None:
            raise InputError(message("machines.fmu_not_started"))
        given = self.model.commanded(self.commands.taken(command))
        return self._sample(self._process.steps(given[None, :], 1.0 / self.rate)[0])

    def _sample(self, row: np.ndarray) -> np.ndarray:
        if not np.isfinite(row).all():
            raise FmuError(message("machines.fmu_not_finite"), file=self.model.binding.fmu.file)
        known = self.model.channels_of(row[None, :], self._first)
        return np.array([known[c][0] if c in known else np.nan for c in self.channels])

    def __deepcopy__(self, memo: object) -> FmuMachine:
        raise InputError(message("machines.fmu_copied"))

    def close(self) -> None:
        """End its process."""
        if self._process is not None:
            self._process.close()
            self._process = None
