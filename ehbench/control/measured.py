"""What controllers take from a machine's sample, and what they write of themselves."""

from typing import NamedTuple

from ehbench.parts.sample import LINE, OF, cylinders_in, entry, line_entry
from ehbench.runtime.compiled import kernel


class Pressures(NamedTuple):
    """Gauge pressures at a cylinder's metering edges [Pa]."""

    head: float
    rod: float
    supply: float
    tank: float


@kernel
def pressures(sample, cylinder):
    """The `Pressures` of a cylinder in a sample."""
    cylinders = cylinders_in(sample.shape[0])
    return Pressures(
        sample[entry(cylinder, OF.p_head)],
        sample[entry(cylinder, OF.p_rod)],
        sample[line_entry(cylinders, LINE.p_supply)],
        sample[line_entry(cylinders, LINE.p_tank)],
    )


def pressure_entries(cylinder: int, channels: int) -> list[int]:
    """Where the `Pressures` of a cylinder stand in a sample of so many channels."""
    cylinders = cylinders_in(channels)
    chambers = [entry(cylinder, channel) for channel in (OF.p_head, OF.p_rod)]
    lines = (LINE.p_supply, LINE.p_tank)
    return [*chambers, *(line_entry(cylinders, channel) for channel in lines)]


@kernel
def place_joints(sample, axis, angles):
    """Write the joint coordinates: measured where a cylinder drives the joint, else the design
    posture's."""
    mechanism = axis.mechanism
    for i in range(angles.shape[0]):
        angles[i] = mechanism.posture[i]
    for c in range(mechanism.joints.shape[0]):
        angles[mechanism.joints[c]] = sample[entry(c, OF.q)]


@kernel
def load_force(p, area_head, area_rod):
    """``P_L = p_head A1 − p_rod A2`` [N]."""
    return p.head * area_head - p.rod * area_rod


@kernel
def write(values, row):
    """Write a tuple of numbers into a row, in its order."""
    for i in range(len(values)):
        row[i] = values[i]
