"""What a friction law is made of."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ehbench.runtime.compiled import inlined, part_kernel
from ehbench.vocabulary.fields import FileModel

# [s]: a piston so light that its friction stops it sooner settles in this time: it gets as much
# inertia as that takes, in place of steps of microseconds for as long as it creeps
SETTLING = 2.0e-4


class FrictionTable(FileModel):
    """Base of the tables ``[cylinder.friction]``, one a ``law``, with the names of its columns."""

    def misfit(self, coulomb: float) -> tuple[str, str] | None:
        """(key, what is wrong with it) beside the cylinder's Coulomb friction [N]."""
        return None


@part_kernel
def _idle(row, v, _, y):
    """A law without states has no rates, and nothing to advance."""


@part_kernel
def _settled(row, v, y):
    """A law without states has none to settle."""


@part_kernel
def _no_energy(row, y):
    """A law without states stores no energy [J]."""
    return 0.0


@dataclass(frozen=True)
class FrictionLaw:
    """A friction law of a cylinder.

    Its kernels read the cylinder's row, where ``columns`` are its own; ``table`` is what the rig
    file says of it. ``steady(row, v)`` is the resistance [N], of the sign of v, once a speed [m/s]
    has lasted; ``fastest(row, v)`` the fastest rate [1/s] that it makes near that speed, for the
    substep guard, at most 1/SETTLING for what ``slope(row, v)`` says, the slope [N·s/m] of the
    steady resistance.

    A law with ``states`` has them from ``row.friction_state`` on, and six more kernels:
    ``force(row, v, y)`` is the resistance now [N], ``loss(row, v, y)`` the power that turns to heat
    [W], ``rates(row, v, y, dy)`` writes the states' rates, ``settle(row, v, y)`` puts them where a
    lasting speed does, ``advance(row, v, dt, y)`` brings them on by ``dt`` [s] at a constant speed,
    and ``stored(row, y)`` is the energy in them [J]. Without states the resistance is the steady
    one."""

    name: str
    table: type[FrictionTable]
    columns: tuple[str, ...]
    steady: Callable
    slope: Callable
    fastest: Callable
    states: tuple[str, ...] = ()
    force: Callable | None = None
    loss: Callable | None = None
    rates: Callable = _idle
    settle: Callable = _settled
    advance: Callable = _idle
    stored: Callable = _no_energy

    def pack(self, cylinder: Any) -> dict[str, float]:
        """Columns of a cylinder of the rig file: of its own table, else of the cylinder."""
        table = cylinder.friction
        return {
            key: float(getattr(table if hasattr(table, key) else cylinder, key))
            for key in self.columns
        }

    def resistance(self) -> Callable:
        """``force(row, v, y)`` of a law with or without states."""
        if self.force is not None:
            return self.force
        steady = self.steady

        @inlined
        def force(row, v, y):
            return steady(row, v)

        return force

    def heat(self) -> Callable:
        """``loss(row, v, y)`` of a law with or without states."""
        if self.loss is not None:
            return self.loss
        steady = self.steady

        @inlined
        def loss(row, v, y):
            return steady(row, v) * v

        return loss
