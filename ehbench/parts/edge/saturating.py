"""An orifice whose area stops growing at an opening: a spool on its stop, a window fully open."""

import math
from typing import Annotated, Any

from ehbench.parts.edge.law import EdgeLaw
from ehbench.parts.edge.orifice import root
from ehbench.parts.fault import Amount, Fault
from ehbench.runtime.compiled import part_kernel
from ehbench.vocabulary.fields import FileModel, Q, Value


class SaturatingFields(FileModel):
    """What an edge of law ``saturating`` has in the rig file beside what an orifice has."""

    opening_max: Annotated[Value, Q("opening_max")] | None = None
    saturation_softness: Annotated[Value, Q("saturation_softness")] | None = None


@part_kernel
def area(reach, edge):
    """Opening [V] beyond the deadband that counts at ``reach`` > 0: as it is up to ``opening_max −
    saturation_softness``, ``opening_max − deadband`` from ``opening_max + saturation_softness`` on,
    a parabola of matching slopes between."""
    maximum, soft = edge.opening_max - edge.deadband, edge.saturation_softness
    wide = max(reach - edge.deadband, 0.0)
    if wide >= maximum + soft:
        return maximum
    bent = wide - maximum + soft
    return wide if bent <= 0.0 else wide - bent * bent / (4.0 * soft)


@part_kernel
def flow(drop, reach, edge, maps):
    """``flow_gain·area·√Δp`` [m³/s]."""
    return math.copysign(edge.gain * area(reach, edge) * root(abs(drop)), drop)


@part_kernel
def opening(drop, flow, edge, maps):
    """Opening [V] at which ``flow`` passes: the widest for too much, 0 for less than an
    underlap's."""
    maximum, soft = edge.opening_max - edge.deadband, edge.saturation_softness
    wide = abs(flow) / (edge.gain * root(abs(drop)))
    if wide >= maximum:
        wide = maximum + soft
    elif wide > maximum - soft:
        wide = maximum + soft - 2.0 * math.sqrt(soft * (maximum - wide))
    return max(edge.deadband + wide, 0.0)


@part_kernel
def known(drop, edge, maps):
    """Opening [V] from which on nothing more passes."""
    return edge.opening_max + edge.saturation_softness


def odd(edge: Any) -> tuple[str, str] | None:
    """What is wrong where it saturates before it opens."""
    wide = float(edge.opening_max) - edge.onset
    if wide <= 0.0:
        return "opening_max must lie above deadband", "opening_max"
    if float(edge.saturation_softness or 0.0) > wide:
        message = f"saturation_softness must not exceed opening_max − deadband, {wide:g} V"
        return message, "saturation_softness"
    return None


LAW = EdgeLaw(
    name="saturating",
    columns=(
        *(("gain", "f8"), ("deadband", "f8")),
        *(("opening_max", "f8"), ("saturation_softness", "f8")),
    ),
    flow=flow,
    opening=opening,
    known=known,
    needs=("flow_gain", "opening_max"),
    takes=("saturation_softness",),
    odd=odd,
)

FAULTS = (
    Fault("gain", ("flow_gain",), low=-0.6, high=1.5, rank=1, law="saturating", joined=True),
    Fault("opening", ("opening_max",), low=-0.6, high=1.0, rank=5, law="saturating"),
    Fault(
        "softness",
        ("saturation_softness",),
        step=0.0,
        law="saturating",
        upper=Amount((0.5,), "travel"),
        table="saturation_softness",
        adds={"saturation_softness": Amount((0.1,), "travel", "V")},
        joined=True,
    ),
)
