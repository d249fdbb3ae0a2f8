"""An edge behind a pressure compensator: flow goes with opening, and hardly with the drop."""

import math
from typing import Annotated

from ehbench.parts.edge.law import EdgeLaw, beyond_deadband
from ehbench.parts.fault import Fault
from ehbench.runtime.compiled import part_kernel
from ehbench.vocabulary.fields import FileModel, Q, Value


class CompensatedFields(FileModel):
    """What an edge of law ``compensated`` has in the rig file."""

    compensated_gain: Annotated[Value, Q("compensated_gain")] | None = None
    compensation_drop: Annotated[Value, Q("compensation_drop")] = Value(2.0e5)


@part_kernel
def level(drop, edge):
    """``Δp/√(Δp² + Δp0²)`` [1] for drop ≥ 0, of ``compensated_gain·(opening − deadband)`` [m³/s];
    it levels off above the ``compensation_drop`` Δp0 [Pa]."""
    return drop / math.sqrt(drop * drop + edge.compensation_drop * edge.compensation_drop)


flow, opening = beyond_deadband(level)


LAW = EdgeLaw(
    name="compensated",
    columns=(("gain", "f8"), ("deadband", "f8"), ("compensation_drop", "f8")),
    flow=flow,
    opening=opening,
    needs=("compensated_gain",),
    takes=("compensation_drop",),
)

FAULTS = (
    Fault(
        "gain", ("compensated_gain",), low=-0.6, high=1.5, rank=1, law="compensated", joined=True
    ),
    Fault("compensator", ("compensation_drop",), step=0.1, rank=4, law="compensated", joined=True),
)
