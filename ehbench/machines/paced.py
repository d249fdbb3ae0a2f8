"""A simulated machine that keeps the time of the clock, for people who watch it."""

import time
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from ehbench.machines.protocol import Machine
from ehbench.vocabulary import setting


@dataclass(frozen=True)
class PaceSettings:
    """Numbers of a simulation in real time."""

    lag: float = setting(0.1, "s", "lag that is not caught up", "a person sees a longer jump")


PACE = PaceSettings()


class PacedMachine:
    """A machine whose ticks take as long as they say; its numbers are those of the machine itself,
    and what that can do beside ticking, this can.

    ``missed`` counts the ticks that ended late. It advances tick by tick.

    Args:
        machine: that is paced.
    """

    def __init__(self, machine: Machine) -> None:
        self._machine, self.missed, self._due = machine, 0, 0.0

    @classmethod
    def of(cls, machine: Machine) -> Machine:
        """A machine in real time."""
        return cast(Machine, cls(machine))

    def __getattr__(self, name: str) -> Any:
        if name == "advance":  # its many ticks would come at once
            raise AttributeError(name)
        return getattr(self._machine, name)

    def tick(self, command: np.ndarray) -> np.ndarray:
        """As `Machine.tick`, but not before its time is over."""
        sample, now = self._machine.tick(command), time.monotonic()
        self._due = (self._due or now) + 1.0 / self._machine.rate  # the first one may compile
        if now > self._due:
            self.missed += 1
            self._due = max(self._due, now - PACE.lag)
        else:
            time.sleep(self._due - now)
        return sample
