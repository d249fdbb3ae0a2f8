"""What the flow law of a metering edge is made of."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ehbench.runtime.compiled import inlined, part_kernel


@part_kernel
def _everywhere(drop, edge, maps):
    """An analytic law holds at every opening."""
    return np.inf


@part_kernel
def _chord(drop, flow, reach, edge):
    """Flow over drop [m³/(s·Pa)]: no metering law is steeper."""
    return flow / drop


def beyond_deadband(level: Callable) -> tuple[Callable, Callable]:
    """(flow, opening) of a law ``gain·(opening − deadband)·level(Δp)``, as `EdgeLaw` has them; the
    opening is 0 for less than an underlap lets through.

    Args:
        level: kernel ``level(drop, edge)``, strictly rising up to where it stays level, 0 at none.
    """

    @inlined
    def flow(drop, reach, edge, maps):
        wide = reach - edge.deadband
        if wide <= 0.0:
            return 0.0
        return math.copysign(edge.gain * wide * level(abs(drop), edge), drop)

    @inlined
    def opening(drop, flow, edge, maps):
        wide = abs(flow) / (edge.gain * level(abs(drop), edge))
        return max(edge.deadband + wide, 0.0)

    return flow, opening


@dataclass(frozen=True)
class EdgeLaw:
    """A flow law of a metering edge.

    Its kernels read the edge's row, where ``columns`` are its own, and ``maps``, the packed flow
    maps. Openings are counted from closed in the direction that opens the edge.

    ``flow(drop, reach, edge, maps)`` is the flow [m³/s], of the sign of the drop [Pa], at an
    opening ``reach`` > 0 [V]. ``opening(drop, flow, edge, maps)`` is its inverse: the opening [V]
    at which ``flow`` passes, both of one sign and not zero. ``known(drop, edge, maps)`` is the
    largest opening [V] that the law speaks of at that drop. ``slope(drop, flow, reach, edge)``
    bounds how fast a flow other than zero changes with a pressure at either end [m³/(s·Pa)], for
    the substep guard.

    Of the keys of an edge of the rig file it ``needs`` some, ``needs_fixed`` where the edge has no
    command, and ``takes`` others. ``has_deadband`` says whether its ``deadband`` counts.
    ``odd(edge)`` is (what is wrong with its numbers together, the key to blame), or None.

    A law that is not ``metering`` passes oil at any opening and drop, gives flows of any sign, and
    may be that of an edge without a command; it is only of such edges where it is not
    ``commanded``."""

    name: str
    columns: tuple[tuple[str, str], ...]
    flow: Callable
    opening: Callable
    needs: tuple[str, ...] = ()
    needs_fixed: tuple[str, ...] = ()
    takes: tuple[str, ...] = ()
    has_deadband: bool = True
    known: Callable = _everywhere
    odd: Callable[[Any], tuple[str, str] | None] = lambda edge: None
    slope: Callable = _chord
    metering: bool = True
    commanded: bool = True

    def pack(self, edge: Any) -> dict[str, float]:
        """Its numbers of an edge of the rig file, by the names of their columns; a ``gain`` is the
        first key that it needs."""
        keys = {"gain": next(iter((*self.needs, *self.needs_fixed)), ""), "deadband": "onset"}
        numbers = (name for name, kind in self.columns if kind == "f8")
        return {name: float(getattr(edge, keys.get(name, name), None) or 0.0) for name in numbers}
