"""Flow laws of metering edges and their inverses in the opening: orifice, pressure-compensated,
measured map.
"""

from __future__ import annotations

import math

from ehbench.compiled import kernel
from ehbench.physics.flow_map import map_command, map_flow

ORIFICE, COMPENSATED, MAP = 0, 1, 2
# columns of an edge's float row
SIGN, GAIN, DEADBAND, DROP = 0, 1, 2, 3
EDGE_FLOATS = 4
# columns of an edge's integer row; FORWARD and REVERSE are offsets of its maps, −1 where there is
# none
FROM, TO, VALVE, LAW, FORWARD, REVERSE, BLOCKED = 0, 1, 2, 3, 4, 5, 6
EDGE_INTS = 7
# below this drop [Pa] the orifice law turns from square root to linear, so that its slope stays
# finite
ORIFICE_DROP = 2.0e4


@kernel
def shape(law, drop, reference):
    """Drop-dependent factor of the analytic laws for drop ≥ 0.

    Orifice: √Δp [√Pa], regularised as Δp/(Δp² + δ²)^¼ so that it is smooth and of finite slope at
        zero.
    Compensated: Δp/√(Δp² + Δp0²) [1], which levels off above the reference drop Δp0.
    """
    if law == ORIFICE:
        return drop / math.sqrt(math.sqrt(drop * drop + ORIFICE_DROP * ORIFICE_DROP))
    return drop / math.sqrt(drop * drop + reference * reference)


@kernel
def edge_flow(drop, opening, floats, ints, maps):
    """Flow [m³/s] along an edge, positive from → to, at a pressure drop [Pa] of either sign and a
    valve opening [V].
    """
    reach = floats[SIGN] * opening
    if reach <= 0.0 or drop == 0.0:
        return 0.0
    if drop < 0.0 and ints[BLOCKED] == 1:
        return 0.0
    law = ints[LAW]
    if law == MAP:
        if drop > 0.0:
            return map_flow(drop, reach, maps, ints[FORWARD])
        at = ints[REVERSE] if ints[REVERSE] >= 0 else ints[FORWARD]
        return -map_flow(-drop, reach, maps, at)
    wide = reach - floats[DEADBAND]
    if wide <= 0.0:
        return 0.0
    return math.copysign(floats[GAIN] * wide * shape(law, abs(drop), floats[DROP]), drop)


@kernel
def edge_command(drop, flow, floats, ints, maps):
    """Command [V] at which an edge passes ``flow`` [m³/s] at ``drop`` [Pa]: the exact inverse of
    ``edge_flow``.

    Flow and drop must have one sign; where they have not, or the edge is blocked, no opening gives
    that flow and the valve's closed command 0 is returned. The result is not limited to the
    driver's range by the analytic laws."""
    if flow * drop <= 0.0 or (drop < 0.0 and ints[BLOCKED] == 1):
        return 0.0
    law = ints[LAW]
    if law == MAP:
        at = ints[REVERSE] if drop < 0.0 and ints[REVERSE] >= 0 else ints[FORWARD]
        return floats[SIGN] * map_command(abs(drop), abs(flow), maps, at)
    return floats[SIGN] * (
        floats[DEADBAND] + abs(flow) / (floats[GAIN] * shape(law, abs(drop), floats[DROP]))
    )
