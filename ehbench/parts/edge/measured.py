"""An edge on its measured flow map; in reverse on a map of its own, else on the mirrored one."""

import math

from ehbench.parts.edge.law import EdgeLaw
from ehbench.parts.fault import Fault
from ehbench.physics.flow_map import map_command, map_flow, map_leaks
from ehbench.runtime.compiled import part_kernel


@part_kernel
def map_of(drop, edge):
    """Where the map of an edge for drops of this sign [Pa] begins."""
    return edge.reverse if drop < 0.0 and edge.reverse >= 0 else edge.forward


@part_kernel
def leaks(edge, maps):
    """Whether an edge passes oil when it is shut, in either direction."""
    return (edge.forward >= 0 and map_leaks(maps, edge.forward)) or (
        edge.reverse >= 0 and map_leaks(maps, edge.reverse)
    )


@part_kernel
def flow(drop, reach, edge, maps):
    """Flow [m³/s] by the map."""
    if drop > 0.0:
        return map_flow(drop, reach, maps, edge.forward)
    return -map_flow(-drop, reach, maps, map_of(drop, edge))


@part_kernel
def opening(drop, flow, edge, maps):
    """Opening [V] at which ``flow`` passes."""
    return map_command(abs(drop), abs(flow), maps, map_of(drop, edge))


@part_kernel
def known(drop, edge, maps):
    """Widest opening [V] of the map at a drop [Pa]."""
    return map_command(abs(drop), math.inf, maps, map_of(drop, edge))


LAW = EdgeLaw(
    name="map",
    columns=(("forward", "i8"), ("reverse", "i8")),
    flow=flow,
    opening=opening,
    known=known,
    has_deadband=False,
)

FAULTS = (Fault("gain", ("map_factor",), low=-0.6, high=1.5, rank=1, law="map", joined=True),)
