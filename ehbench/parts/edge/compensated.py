"""An edge behind a pressure compensator: flow goes with opening, and hardly with the drop."""

from __future__ import annotations

import math
from typing import Annotated, Any

from ehbench.parts.edge.law import EdgeLaw
from ehbench.parts.fault import Fault
from ehbench.runtime.compiled import part_kernel
from ehbench.vocabulary.fields import FileModel, Q, Value


class CompensatedFields(FileModel):
    """What an edge of law ``compensated`` has in the rig file."""

    compensated_gain: Annotated[Value, Q("compensated_gain")] | None = None
    compensation_drop: Annotated[Value, Q("compensation_drop")] = Value(2.0e5)


@part_kernel
def level(drop, reference):
    """``Δp/√(Δp² + Δp0²)`` [1] for drop ≥ 0, which levels off above the reference drop Δp0 [Pa]."""
    return drop / math.sqrt(drop * drop + reference * reference)


@part_kernel
def flow(drop, reach, edge, maps):
    """``compensated_gain·(opening − deadband)`` [m³/s], reached over ``compensation_drop``."""
    wide = reach - edge.deadband
    if wide <= 0.0:
        return 0.0
    return math.copysign(edge.gain * wide * level(abs(drop), edge.compensation_drop), drop)


@part_kernel
def opening(drop, flow, edge, maps):
    """Opening [V] at which ``flow`` passes; 0 for less than an underlap lets through."""
    wide = abs(flow) / (edge.gain * level(abs(drop), edge.compensation_drop))
    return max(edge.deadband + wide, 0.0)


def pack(edge: Any) -> dict[str, float]:
    """Columns of an edge."""
    return {
        "gain": float(edge.compensated_gain),
        "deadband": edge.onset,
        "compensation_drop": float(edge.compensation_drop),
    }


LAW = EdgeLaw(
    name="compensated",
    columns=(("gain", "f8"), ("deadband", "f8"), ("compensation_drop", "f8")),
    flow=flow,
    opening=opening,
    pack=pack,
    needs=("compensated_gain",),
    takes=("compensation_drop",),
)

FAULTS = (
    Fault(
        "gain", ("compensated_gain",), low=-0.6, high=1.5, rank=1, law="compensated", joined=True
    ),
    Fault("compensator", ("compensation_drop",), step=0.1, rank=4, law="compensated", joined=True),
)
