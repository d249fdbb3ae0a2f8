"""What an element of a valve's dynamics is made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class ValveElement:
    """One element between a valve's command and its opening; a valve has any number in series.

    Its kernels read the element's row, where ``columns`` are its own and its ``states`` stand in
    the plant's state from ``element.state`` on. ``signal`` [V] is what comes in.

    ``rates(element, signal, y, dy)`` writes the rates of its states and gives what goes out [V].
    ``settle(element, value, y)`` puts its states at rest where both are ``value`` [V].
    ``advance(element, signal, dt, y)`` brings its states on by ``dt`` [s], exact for a held signal.
    ``finish(element, signal, y, slope, d)`` betters them after a Runge–Kutta step of ``d`` [s] over
    which the signal was held; ``slope`` holds the rates where the step began.
    ``lag(element)`` is the time [s] by which it trails a steady ramp.
    ``recover(element, signal, dt, y, later)`` finds the states behind its first one in ``y`` from
    that one, and from what goes out ``later`` by ``dt`` [s] under a held signal [V].
    ``pack(dynamics)`` gives its columns and its ``fastest`` rate [1/s], from a ``[dynamics.…]`` of
    the rig file.
    """

    name: str
    columns: tuple[tuple[str, str], ...]
    states: tuple[str, ...]
    rates: Callable
    settle: Callable
    advance: Callable
    finish: Callable
    recover: Callable
    lag: Callable
    pack: Callable[[Any], dict[str, float]]
