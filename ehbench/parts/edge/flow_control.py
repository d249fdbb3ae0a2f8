"""An edge behind a compensator that holds its flow above its drop, and damps nothing there."""

from __future__ import annotations

import math

from ehbench.parts.edge.compensated import pack
from ehbench.parts.edge.law import EdgeLaw
from ehbench.parts.edge.orifice import root
from ehbench.parts.fault import Fault
from ehbench.runtime.compiled import part_kernel


@part_kernel
def level(drop, reference):
    """Share of full flow [1]: ``s (3 − s²)/2``, ``s = √(Δp/Δp0)``, 1 from the reference drop Δp0
    [Pa] on."""
    if drop >= reference:
        return 1.0
    share = root(drop) / root(reference)
    return 0.5 * share * (3.0 - share * share)


@part_kernel
def flow(drop, reach, edge, maps):
    """``compensated_gain·(opening − deadband)`` [m³/s], exactly so above ``compensation_drop``."""
    wide = reach - edge.deadband
    if wide <= 0.0:
        return 0.0
    return math.copysign(edge.gain * wide * level(abs(drop), edge.compensation_drop), drop)


@part_kernel
def opening(drop, flow, edge, maps):
    """Opening [V] at which ``flow`` passes; 0 for less than an underlap lets through."""
    wide = abs(flow) / (edge.gain * level(abs(drop), edge.compensation_drop))
    return max(edge.deadband + wide, 0.0)


LAW = EdgeLaw(
    name="flow_control",
    columns=(("gain", "f8"), ("deadband", "f8"), ("compensation_drop", "f8")),
    flow=flow,
    opening=opening,
    pack=pack,
    needs=("compensated_gain",),
    takes=("compensation_drop",),
)

FAULTS = (
    Fault(
        "gain", ("compensated_gain",), low=-0.6, high=1.5, rank=1, law="flow_control", joined=True
    ),
    Fault("compensator", ("compensation_drop",), step=0.1, rank=4, law="flow_control", joined=True),
)
