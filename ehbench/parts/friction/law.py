"""What a friction law is made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ehbench.compiled import inlined, part_kernel


@part_kernel
def _no_rates(row, v, y, dy):
    """A law without states has no rates."""


@part_kernel
def _nothing_held(row, y):
    """A law without states holds no energy [J]."""
    return 0.0


@dataclass(frozen=True)
class FrictionLaw:
    """A friction law of a cylinder.

    Its kernels read the cylinder's row, where ``columns`` are its own. ``steady(row, v)`` is the
    resistance [N], of the sign of v, once a speed [m/s] has lasted; ``steepness(row, v)`` the
    largest slope [N·s/m] near that speed, for the substep guard.

    ``pack(cylinder)`` gives its columns of a cylinder of the rig file.

    A law with ``states`` has them from ``row.friction_state`` on, and three more kernels:
    ``force(row, v, y)`` is the resistance now [N], ``rates(row, v, y, dy)`` writes their rates, and
    ``held(row, y)`` is the energy in them [J]. Without states the resistance is the steady one.
    """

    name: str
    columns: tuple[tuple[str, str], ...]
    steady: Callable
    pack: Callable[[Any], dict[str, float]]
    steepness: Callable
    states: tuple[str, ...] = ()
    force: Callable | None = None
    rates: Callable = _no_rates
    held: Callable = _nothing_held

    def resistance(self) -> Callable:
        """``force(row, v, y)`` of a law with or without states."""
        steady = self.steady
        return self.force or inlined(lambda row, v, y: steady(row, v))
