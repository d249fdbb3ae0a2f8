"""What an element of a valve's dynamics is made of."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from ehbench.vocabulary.fields import FileModel, Value, scalars

SETTLED = 1.0e-12  # [V]: a valve this near to its command has arrived


class DynamicsTable(FileModel):
    """Base of the tables ``[dynamics.<name>]``, one a kind, told apart by ``kind``."""

    note: str = ""

    def row(self) -> dict[str, float]:
        """Fields of its element: ``fastest`` and its law's columns."""
        return {}

    def period(self) -> float:
        """Period [s] of its own motion, inf where it has none."""
        return math.inf

    def late(self) -> float:
        """Pure delay [s] in it."""
        return 0.0

    def parameters(self) -> dict[str, Value]:
        """Its numbers by name, also those that follow from the ones the file has."""
        return dict(scalars(self))

    def with_values(self, new: Mapping[str, Value]) -> DynamicsTable:
        """These dynamics with some of their `parameters` replaced."""
        return self.model_copy(update=dict(new)) if new else self


@dataclass(frozen=True)
class ValveElement:
    """One element between a valve's command and its opening; a valve has any number in series.

    Its kernels read the element's row, where ``columns`` are its own (``table.row`` fills
    them) and its ``states`` stand in the plant's state from ``element.state`` on. ``signal`` [V] is
    what comes in.

    ``rates(element, signal, y, dy)`` writes the rates of its states and gives what goes out [V].
    ``settle(element, value, y)`` puts its states at rest where both are ``value`` [V].
    ``advance(element, signal, dt, y)`` brings its states on by ``dt`` [s], exact for a held signal.
    ``finish(element, signal, y, slope, d)`` betters them after a Runge–Kutta step of ``d`` [s] over
    which the signal was held; ``slope`` holds the rates where the step began.
    ``lag(element)`` is the time [s] by which it trails a steady ramp.
    ``recover(element, signal, dt, y, later)`` finds the states behind its first one in ``y`` from
    that one, and from what goes out ``later`` by ``dt`` [s] under a held signal [V]."""

    name: str
    table: type[DynamicsTable]
    columns: tuple[str, ...]
    states: tuple[str, ...]
    rates: Callable
    settle: Callable
    advance: Callable
    finish: Callable
    recover: Callable
    lag: Callable
