"""A sharp-edged orifice: flow goes with opening and the square root of the drop."""

import math
from typing import Annotated

from ehbench.parts.edge.law import EdgeLaw, beyond_deadband
from ehbench.parts.fault import Amount, Fault
from ehbench.runtime.compiled import part_kernel
from ehbench.vocabulary.fields import FileModel, Q, Value

# below this drop [Pa] the law turns from square root to linear, so that its slope stays finite
ORIFICE_DROP = 2.0e4


class OrificeFields(FileModel):
    """What an edge of law ``orifice`` has in the rig file."""

    flow_gain: Annotated[Value, Q("flow_gain")] | None = None


@part_kernel
def root(drop):
    """√Δp [√Pa] for drop ≥ 0, as ``Δp/(Δp² + δ²)^¼``: smooth, and of finite slope at zero."""
    return drop / math.sqrt(math.sqrt(drop * drop + ORIFICE_DROP * ORIFICE_DROP))


@part_kernel
def level(drop, edge):
    """`root`, of the flow ``flow_gain·(opening − deadband)·√Δp`` [m³/s]."""
    return root(drop)


flow, opening = beyond_deadband(level)


LAW = EdgeLaw(
    name="orifice",
    columns=(("gain", "f8"), ("deadband", "f8")),
    flow=flow,
    opening=opening,
    needs=("flow_gain",),
)

FAULTS = (
    Fault("gain", ("flow_gain",), low=-0.6, high=1.5, rank=1, law="orifice", joined=True),
    Fault(
        "saturation",
        ("opening_max",),
        step=0.0,
        law="orifice",
        upper=Amount((1.2,), "reach"),
        adds={"law": "saturating", "opening_max": Amount((0.85, 0.6), "reach", "V")},
        joined=True,
    ),
)
