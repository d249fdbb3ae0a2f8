"""A sample of a machine: what its sensors say at one instant, in one order for every machine.

``q, qd, x, v, p_head, p_rod`` of each cylinder, then ``p_supply, p_tank``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from ehbench.runtime.compiled import part_kernel


class CylinderEntries(NamedTuple):
    """Where a channel stands among those of its cylinder."""

    q: int = 0
    qd: int = 1
    x: int = 2
    v: int = 3
    p_head: int = 4
    p_rod: int = 5


class LineEntries(NamedTuple):
    """Where a channel stands among those behind the cylinders'."""

    p_supply: int = 0
    p_tank: int = 1


OF, LINE = CylinderEntries(), LineEntries()
_CYLINDER, _LINES = len(OF), len(LINE)


@part_kernel
def entry(cylinder, channel):
    """Where a cylinder's channel stands in a sample, such as ``entry(c, OF.p_head)``."""
    return _CYLINDER * cylinder + channel


@part_kernel
def line_entry(cylinders, channel):
    """Where a channel of the supply lines stands in a sample: ``line_entry(nc, LINE.p_tank)``."""
    return _CYLINDER * cylinders + channel


@part_kernel
def sample_size(cylinders):
    """How many channels a sample has."""
    return _CYLINDER * cylinders + _LINES


@part_kernel
def cylinders_in(channels):
    """How many cylinders a sample of so many channels is of."""
    return (channels - _LINES) // _CYLINDER


def sample_channels(cylinders: Sequence[str]) -> tuple[str, ...]:
    """Channel names of a sample, in order."""
    own = (f"{name}.{key}" for name in cylinders for key in CylinderEntries._fields)
    return (*own, *LineEntries._fields)
