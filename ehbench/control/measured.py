"""Where a controller finds its channels in a machine's sample."""

from __future__ import annotations

from typing import NamedTuple

from ehbench.compiled import kernel


class Entries(NamedTuple):
    """Where the channels of one cylinder, and those of the supply, stand in a sample."""

    q: int
    qd: int
    x: int
    v: int
    p_head: int
    p_rod: int
    p_supply: int
    p_tank: int


class Pressures(NamedTuple):
    """Gauge pressures at a cylinder's metering edges [Pa]."""

    head: float
    rod: float
    supply: float
    tank: float


@kernel
def entries(cylinder):
    """The `Entries` of a cylinder by its number."""
    at = 6 * cylinder
    return Entries(at, at + 1, at + 2, at + 3, at + 4, at + 5, -2, -1)


@kernel
def pressures(sample, cylinder):
    """The `Pressures` in a sample."""
    at = entries(cylinder)
    return Pressures(sample[at.p_head], sample[at.p_rod], sample[at.p_supply], sample[at.p_tank])


@kernel
def load_force(p, area_head, area_rod):
    """``P_L = p_head A1 − p_rod A2`` [N]."""
    return p.head * area_head - p.rod * area_rod


@kernel
def write(values, row):
    """Write a tuple of numbers into a row, in its order."""
    for i in range(len(values)):
        row[i] = values[i]
