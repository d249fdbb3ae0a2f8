"""An orifice whose area stops growing at an opening: a spool on its stop, a window fully open."""

from __future__ import annotations

import math

from ehbench.compiled import part_kernel
from ehbench.parts.edge.law import EdgeLaw
from ehbench.parts.edge.orifice import root


@part_kernel
def area(reach, edge):
    """Opening [V] beyond the deadband that counts at ``reach`` > 0: as it is up to ``opening_max −
    saturation_softness``, ``opening_max − deadband`` from ``opening_max + saturation_softness`` on,
    a parabola of matching slopes between.
    """
    most, soft = edge.opening_max - edge.deadband, edge.saturation_softness
    wide = max(reach - edge.deadband, 0.0)
    if wide >= most + soft:
        return most
    bent = wide - most + soft
    return wide if bent <= 0.0 else wide - bent * bent / (4.0 * soft)


@part_kernel
def flow(drop, reach, edge, maps):
    """``flow_gain·area·√Δp`` [m³/s]."""
    return math.copysign(edge.gain * area(reach, edge) * root(abs(drop)), drop)


@part_kernel
def opening(drop, flow, edge, maps):
    """Opening [V] at which ``flow`` passes; for more than the widest opening gives, that opening."""
    most, soft = edge.opening_max - edge.deadband, edge.saturation_softness
    wide = abs(flow) / (edge.gain * root(abs(drop)))
    if wide >= most:
        wide = most + soft
    elif wide > most - soft:
        wide = most + soft - 2.0 * math.sqrt(soft * (most - wide))
    return edge.deadband + wide


@part_kernel
def known(drop, edge, maps):
    """Opening [V] from which on nothing more passes."""
    return edge.opening_max + edge.saturation_softness


LAW = EdgeLaw(
    name="saturating",
    columns=(
        *(("gain", "f8"), ("deadband", "f8")),
        *(("opening_max", "f8"), ("saturation_softness", "f8")),
    ),
    flow=flow,
    opening=opening,
    known=known,
)
