"""A pump between two nodes: a displacement at a speed, of either sign, and what slips back."""

from typing import Annotated

from ehbench.parts.edge.law import EdgeLaw
from ehbench.parts.fault import Amount, Fault
from ehbench.runtime.compiled import part_kernel
from ehbench.vocabulary.fields import FileModel, Q, Value


class PumpFields(FileModel):
    """What an edge of law ``pump`` has in the rig file."""

    displacement: Annotated[Value, Q("displacement")] | None = None
    speed_gain: Annotated[Value, Q("speed_gain")] | None = None
    slip: Annotated[Value, Q("slip")] = Value(0.0)


class FixedPumpFields(FileModel):
    """What a pump without a command has in the rig file."""

    displacement: Annotated[Value, Q("displacement")] | None = None
    pump_speed: Annotated[Value, Q("pump_speed")] | None = None
    slip: Annotated[Value, Q("slip")] = Value(0.0)


@part_kernel
def flow(drop, reach, edge, maps):
    """``D ω + slip Δp`` [m³/s], ``ω = pump_speed + speed_gain·opening``; it slips back at Δp <
    0."""
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
    needs=("displacement", "speed_gain"),
    needs_fixed=("displacement", "pump_speed"),
    takes=("slip",),
    has_deadband=False,
    slope=slope,
    metering=False,
)

FAULTS = (
    Fault("gain", ("displacement",), low=-0.6, high=1.5, rank=1, law="pump", joined=True),
    Fault(
        "leakage",
        ("slip",),
        unit="leakage",
        step=0.01,
        high=30.0,
        law="pump",
        upper=Amount((30.0,), "leakage"),
    ),
)
