"""A pure delay: what comes out is what came in ``delay`` ago.

The elements of a valve are linear, so that their delays stand together before them all: a valve
feels the command of ``valve.delay`` ago. Commands are held from tick to tick; where the delay is no
whole number of integration steps, a step feels the mean of what is late over it. Its impulse is
exact then, and changes smoothly with the delay."""

import math
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from ehbench.parts.fault import Amount, Fault
from ehbench.parts.valve.law import DynamicsTable
from ehbench.runtime.compiled import part_kernel
from ehbench.vocabulary.fields import Q, Value


class Delay(DynamicsTable):
    """A pure delay."""

    kind: Literal["delay"]
    delay: Annotated[Value, Q("delay")]

    def late(self) -> float:
        return float(self.delay)


class Line(NamedTuple):
    """The commands of past ticks.

    ``tick`` [s]; ``past`` [V], shape (depth, valves), a ring by tick of as many as the longest
    delay needs, of one where there is none; ``count`` of ticks so far, shape (1,); ``acting`` what
    acts of a row of commands over a step: forces that are played are never late."""

    tick: float
    past: np.ndarray
    count: np.ndarray
    acting: np.ndarray


def line_of(plant: Any, tick: float, columns: int = 0) -> Line:
    """The line of a plant commanded ``valves.before`` until now, by rows of ``columns``."""
    before, delay = plant.valves["before"], plant.valves["delay"]
    depth = math.ceil(delay.max() / tick) + 2 if delay.any() else 1
    played = 1 + int(plant.forces["played"].max(initial=-1))
    fixed = np.zeros(max(before.size, played, columns))
    fixed[: before.size] = before
    past = np.empty((depth, before.size))
    past[:] = before
    return Line(float(tick), past, np.zeros(1, np.int64), fixed)


@part_kernel
def line_acting(line, command, plant, start, h):
    """Write the delayed commands over ``h`` [s] from ``start`` [s] of this tick into
    ``line.acting``."""
    for i in range(command.shape[0]):
        line.acting[i] = command[i]
    depth = line.past.shape[0]
    if depth == 1:
        return
    for i in range(line.past.shape[1]):
        since = start - plant.valves[i].delay
        if plant.valves[i].delay > 0.0:
            first = int(math.floor(since / line.tick))
            late = command[i] if first >= 0 else line.past[(line.count[0] + first) % depth, i]
            soon = command[i] if first >= -1 else line.past[(line.count[0] + first + 1) % depth, i]
            share = min(max((since + h - (first + 1) * line.tick) / h, 0.0), 1.0)
            line.acting[i] = late + share * (soon - late)


@part_kernel
def line_push(line, command):
    """The present tick, of this ``command`` [V], is over."""
    depth = line.past.shape[0]
    if depth > 1:
        for i in range(line.past.shape[1]):
            line.past[line.count[0] % depth, i] = command[i]
        line.count[0] += 1


LONGEST = Amount((0.1,), "second")
# a lag or a delay that stands behind the elements that a valve has
FAULTS = (
    Fault(
        "delay",
        ("delay",),
        unit="second",
        step=0.001,
        high=0.2,
        trials=(0.005, 0.01, 0.02, 0.04),
        rank=5,
        upper=LONGEST,
        adds={"kind": "delay", "delay": Amount((0.003,), "second", "s")},
        joined=True,
    ),
    Fault(
        "lag",
        ("lag",),
        step=0.0,
        upper=LONGEST,
        adds={"kind": "first_order", "lag": Amount((0.01,), "second", "s")},
        joined=True,
    ),
)
