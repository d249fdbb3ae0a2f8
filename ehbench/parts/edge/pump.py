"""A pump between two nodes: a displacement at a speed, of either sign, and what slips back."""

from __future__ import annotations

from ehbench.compiled import part_kernel
from ehbench.parts.edge.law import EdgeLaw


@part_kernel
def flow(drop, reach, edge, maps):
    """``D ω + slip Δp`` [m³/s], ``ω = pump_speed + speed_gain·opening``: at a negative drop the
    pump lifts pressure, and oil slips back.
    """
    speed = edge.pump_speed + edge.speed_gain * reach
    return edge.displacement * speed + edge.slip * drop


@part_kernel
def opening(drop, flow, edge, maps):
    """Opening [V] at which ``flow`` passes."""
    speed = (flow - edge.slip * drop) / edge.displacement
    return (speed - edge.pump_speed) / edge.speed_gain


@part_kernel
def slope(drop, flow, reach, edge):
    """How fast the flow changes with the drop [m³/(s·Pa)]."""
    return edge.slip


@part_kernel
def slip_loss(drop, edge):
    """Power [W] that slip takes."""
    return edge.slip * drop * drop


LAW = EdgeLaw(
    name="pump",
    columns=(("displacement", "f8"), ("speed_gain", "f8"), ("pump_speed", "f8"), ("slip", "f8")),
    flow=flow,
    opening=opening,
    slope=slope,
    metering=False,
)
