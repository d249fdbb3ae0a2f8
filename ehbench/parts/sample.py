"""A sample of a machine: what its sensors say at one instant, in one order for every machine.

``q, qd, x, v, p_head, p_rod`` of each cylinder, then ``p_supply, p_tank``. A channel is an entry
here with its reading; every machine then measures it."""

from collections.abc import Sequence
from typing import NamedTuple

from ehbench.parts.cylinder import linkage_of
from ehbench.parts.nodes import SUPPLY, TANK, node_pressure
from ehbench.runtime.compiled import kernel, part_kernel


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
DERIVED = (OF.qd, OF.v)  # a real machine has no sensor of these: it takes them from the position


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


@part_kernel
def reading(y, plant, cylinder, channel):
    """What a perfect sensor says of a cylinder's channel at plant state y [SI]."""
    row = plant.cylinders[cylinder]
    if channel == OF.q:
        return y[row.joint]
    if channel == OF.qd:
        return y[plant.at.rates + row.joint]
    if channel == OF.p_head:
        return node_pressure(y, plant, row.node_head)
    if channel == OF.p_rod:
        return node_pressure(y, plant, row.node_rod)
    x, lever, _ = linkage_of(row, y[row.joint])
    return x if channel == OF.x else lever * y[plant.at.rates + row.joint]


@part_kernel
def line_reading(y, plant, channel):
    """What a perfect sensor says of a channel of the supply lines at plant state y [SI]."""
    return node_pressure(y, plant, SUPPLY if channel == LINE.p_supply else TANK)


@kernel
def perfect_sample(y, plant, sample):
    """Write what perfect sensors say of plant state y into ``sample``."""
    cylinders = plant.cylinders.shape[0]
    for c in range(cylinders):
        for channel in range(_CYLINDER):
            sample[entry(c, channel)] = reading(y, plant, c, channel)
    for channel in range(_LINES):
        sample[line_entry(cylinders, channel)] = line_reading(y, plant, channel)


def sample_channels(cylinders: Sequence[str]) -> tuple[str, ...]:
    """Channel names of a sample, in order."""
    names = (f"{name}.{key}" for name in cylinders for key in CylinderEntries._fields)
    return (*names, *LineEntries._fields)
