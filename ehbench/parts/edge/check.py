"""A check valve, and one that a pilot pressure opens against its spring and against the flow."""

import math
from typing import Annotated, Literal

from ehbench.parts.edge.law import EdgeLaw
from ehbench.parts.edge.orifice import ORIFICE_DROP, root
from ehbench.parts.fault import Fault
from ehbench.runtime.compiled import part_kernel
from ehbench.vocabulary.fields import FileModel, Q, Value


class CheckFields(FileModel):
    """What a check valve has in the rig file."""

    orifice_gain: Annotated[Value, Q("orifice_gain")] | None = None
    cracking_pressure: Annotated[Value, Q("cracking_pressure")] = Value(0.0)
    opening_range: Annotated[Value, Q("opening_range")] = Value(5.0e4)
    pilot: Literal["supply", "tank", "head", "rod"] | None = None
    pilot_ratio: Annotated[Value, Q("pilot_ratio")] | None = None


# opening ranges by which a poppet at rest may come to move within a step; a pilot's pressure moves
# it by its ratio
NEAR = 4.0
# slope taken there, in flows over the opening range, of which the steepest is 1.5: steps are then
# so short that they see the poppet on its way, by which logs tell what opens it
FINE = 4.0


@part_kernel
def lift_of(drop, pilot, edge):
    """Lift as a share: ``Δp + pilot_ratio·(p_pilot − p_from) − cracking_pressure`` over
    ``opening_range``."""
    return (drop + edge.pilot_ratio * pilot - edge.cracking_pressure) / edge.opening_range


@part_kernel
def share_open(lift):
    """Share of the full opening at a lift, smooth at both ends."""
    at = min(max(lift, 0.0), 1.0)
    return at * at * (3.0 - 2.0 * at)


@part_kernel
def flow(drop, reach, edge, maps):
    """``orifice_gain·share·√Δp`` [m³/s]; ``reach`` is the pilot's pressure above upstream [Pa]."""
    share = share_open(lift_of(drop, reach, edge))
    return math.copysign(edge.gain * share * root(abs(drop)), drop)


@part_kernel
def opening(drop, flow, edge, maps):
    """It has no command."""
    return 0.0


@part_kernel
def slope(drop, flow, reach, edge):
    """Slope of the flow [m³/(s·Pa)], more near the opening range, so that steps see the poppet
    move."""
    lift, lever = lift_of(drop, reach, edge), max(1.0, edge.pilot_ratio)
    share, steep = share_open(lift), 0.0
    if -NEAR * lever < lift < 1.0 + NEAR * lever:
        steep = FINE / edge.opening_range * lever
    chord = share / math.sqrt(math.sqrt(drop * drop + ORIFICE_DROP * ORIFICE_DROP))
    return edge.gain * (steep * root(abs(drop)) + chord)


LAW = EdgeLaw(
    name="check",
    columns=(
        *(("gain", "f8"), ("cracking_pressure", "f8"), ("opening_range", "f8")),
        *(("pilot", "i8"), ("pilot_ratio", "f8")),
    ),
    flow=flow,
    opening=opening,
    needs_fixed=("orifice_gain",),
    takes=("cracking_pressure", "opening_range", "pilot", "pilot_ratio"),
    has_deadband=False,
    slope=slope,
    metering=False,
    commanded=False,
)

FAULTS = (
    Fault("check valve", ("orifice_gain",), step=0.1, rank=5, law="check"),
    Fault("check valve", ("cracking_pressure",), step=0.1, rank=5, law="check"),
)
