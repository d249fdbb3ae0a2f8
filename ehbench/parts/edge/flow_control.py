"""An edge behind a compensator that holds its flow above its drop, and damps nothing there."""

from dataclasses import replace

from ehbench.parts.edge.compensated import FAULTS as LIKE
from ehbench.parts.edge.compensated import LAW as COMPENSATED
from ehbench.parts.edge.law import beyond_deadband
from ehbench.parts.edge.orifice import root
from ehbench.runtime.compiled import part_kernel


@part_kernel
def level(drop, edge):
    """Share of ``compensated_gain·(opening − deadband)`` [m³/s] for drop ≥ 0: ``s (3 − s²)/2``, ``s
    = √(Δp/Δp0)``, 1 from the ``compensation_drop`` Δp0 [Pa] on."""
    if drop >= edge.compensation_drop:
        return 1.0
    share = root(drop) / root(edge.compensation_drop)
    return 0.5 * share * (3.0 - share * share)


flow, opening = beyond_deadband(level)
LAW = replace(COMPENSATED, name="flow_control", flow=flow, opening=opening)
FAULTS = tuple(replace(row, law=LAW.name) for row in LIKE)
