"""Valve level: chamber flows to edge flows to commands, through the inverse laws or maps at the
measured drops (thesis 3).

What a valve cannot do is flagged for each edge, never hidden: a sum of the bits of
`ehbench.vocabulary.codes.LIMITS`."""

import math
from typing import NamedTuple

from ehbench.control.functions import (
    DIRECTION,
    METERING,
    PATH_FLOWS,
    PATHS,
    TANK_HEAD,
    Circuit,
    capacity,
    metering_drop,
    path_drop,
    supply_draw,
    widest,
)
from ehbench.control.measured import Pressures
from ehbench.parts.edge import MAP, edge_command, edge_flow
from ehbench.parts.edge.preload import preload
from ehbench.runtime.compiled import kernel
from ehbench.vocabulary.codes import AGAINST, FAINT, OUTSIDE, REVERSED, SATURATED


class Flows(NamedTuple):
    """Q1 into the head end, Q2 out of the rod end [m³/s], negative in retraction."""

    head: float
    rod: float


@kernel
def _interpolated(x, data, grid, values, count):
    """Linear interpolation of ``data[values:]`` over ``data[grid:]`` at x inside the grid."""
    i = 0
    while i + 2 < count and x >= data[grid + i + 1]:
        i += 1
    if count < 2:
        return data[values]
    part = (x - data[grid + i]) / (data[grid + i + 1] - data[grid + i])
    return data[values + i] + part * (data[values + i + 1] - data[values + i])


@kernel
def inside(circuit, edge, drop, command):
    """True where readings surround (drop [Pa] along the edge, command [V]); always for analytic
    laws."""
    if circuit.edges[edge].law != MAP:
        return True
    first = circuit.domain_at[edge, 0 if drop >= 0.0 else 1]
    if first < 0:
        return False
    count = int(circuit.domain[first])
    grid = first + 1
    reach, size = circuit.edges[edge].sign * command, abs(drop)
    if not (circuit.domain[grid] <= reach <= circuit.domain[grid + count - 1]):
        return False
    low = _interpolated(reach, circuit.domain, grid, grid + count, count)
    return low <= size <= _interpolated(reach, circuit.domain, grid, grid + 2 * count, count)


@kernel
def edge_order(circuit, path, flow, drop, floor):
    """(command [V], limits) at which a path's edge passes ``flow`` [m³/s] along it at ``drop`` [Pa]
    along it.

    The exact inverse of the edge's law for drops from ``floor`` [Pa] up. Between −floor and floor
    the command is that for the floor, so that sensor noise about zero drop neither slams the valve
    nor opens it without end; below, it is shut. What is known to differ from the law (``trim``) is
    taken into account."""
    edge = circuit.paths[path]
    if flow == 0.0:
        return 0.0, 0
    if flow < 0.0:
        return 0.0, AGAINST
    if path >= TANK_HEAD:
        return widest(circuit, edge, circuit.along[path] * max(drop, floor)), 0
    if drop <= -floor:
        return 0.0, REVERSED
    limits, along, sign = 0, circuit.along[path], circuit.edges[edge].sign
    if along > 0.0:
        floor += preload(circuit.edges[edge])
    if drop < floor:
        limits, drop = FAINT, floor
    gain, shift = circuit.trim[edge - circuit.first, 0], circuit.trim[edge - circuit.first, 1]
    flow /= gain
    command = edge_command(along * drop, along * flow, circuit.edges[edge], circuit.maps)
    command += sign * shift
    maximum = widest(circuit, edge, along * drop)
    # a map's inverse stops at its last command by itself, so the flow decides
    if sign * command >= sign * maximum:
        command = maximum
        given = edge_flow(along * drop, maximum - sign * shift, circuit.edges[edge], circuit.maps)
        if given * along < flow * (1.0 - 1e-9):
            limits += SATURATED
    return command, limits


@kernel
def shut(circuit, command, flows, limits):
    """Shut the cylinder's valves: commands nearest to 0 V, zeros into ``flows, limits``."""
    for i in range(circuit.count):
        valve = circuit.edges[circuit.first + i].valve
        command[valve] = min(max(0.0, circuit.lowest[valve]), circuit.highest[valve])
        flows[i] = limits[i] = 0.0


@kernel
def allocate(function, required, p, floor, circuit, command, flows, limits):
    """Write the commands that give a working function its chamber flows; return all limits met,
    or'ed.

    Each path of the function carries its share of the chamber flows. Where several paths hang
    on one command, the path that sets the motion decides it and the others follow; among followers
    the widest.

    Args:
        function: index into FUNCTIONS; hold shuts all.
        required: `Flows` of the chambers.
        p: `Pressures`, measured [Pa].
        floor: smallest drop [Pa] at which the inverse is taken.
        circuit: of the cylinder.
        command: out, [V], one per valve of the rig; only this cylinder's are written.
        flows: out, desired flow [m³/s] along each of the cylinder's edges, shape (count,).
        limits: out, sum of limit bits of each of the cylinder's edges, shape (count,).
    """
    shut(circuit, command, flows, limits)
    met, decided = 0, -1
    first = METERING[function]
    for turn in range(len(PATHS) + 1):
        path = first if turn == 0 else turn - 1
        if path < 0 or (turn > 0 and path == first):
            continue
        share_head, share_rod = PATH_FLOWS[function, path, 0], PATH_FLOWS[function, path, 1]
        if share_head == 0.0 and share_rod == 0.0:
            continue
        edge = circuit.paths[path]
        # 0·NaN stays NaN: a channel withheld from the controller shows in every command that it
        # could have touched
        flow = share_head * required.head + share_rod * required.rod
        drop = metering_drop(path, p, circuit)
        order, bits = edge_order(circuit, path, flow, drop, floor)
        valve = circuit.edges[edge].valve
        if valve < 0:  # a check valve opens by itself
            continue
        if turn == 0:
            decided = valve
            command[valve] = order
        elif valve == decided:
            bits &= ~SATURATED  # it does not decide how far it opens
        elif math.isnan(order) or circuit.edges[edge].sign * (order - command[valve]) > 0.0:
            command[valve] = order
        bits |= beyond_measured(circuit, path, flow, drop, command[valve], bits)
        flows[edge - circuit.first] = circuit.along[path] * flow
        limits[edge - circuit.first] = bits
        met |= bits
    for i in range(circuit.count):  # 0 V is the nearest that the driver takes
        valve = circuit.edges[circuit.first + i].valve
        if command[valve] == 0.0:
            command[valve] = min(max(0.0, circuit.lowest[valve]), circuit.highest[valve])
    return met


@kernel
def beyond_measured(circuit, path, flow, drop, command, bits):
    """OUTSIDE where a path passes oil beyond what its edge's map was measured at, else 0."""
    if flow > 0.0 and not bits & (AGAINST | REVERSED):
        if not inside(circuit, circuit.paths[path], circuit.along[path] * drop, command):
            return OUTSIDE
    return 0


def top_speed(function: int, p: Pressures, circuit: Circuit) -> float:
    """Largest speed [m/s], ≥ 0, at which every edge of a function carries its share."""
    fastest = math.inf
    for path in range(len(PATHS)):
        a, b = PATH_FLOWS[function, path]
        need = DIRECTION[function] * (a * circuit.area_head + b * circuit.area_rod)
        if need > 0.0:
            fastest = min(fastest, capacity(circuit, path, path_drop(path, p, circuit)) / need)
    return 0.0 if math.isinf(fastest) else fastest


def pump_speed(function: int, circuit: Circuit) -> float:
    """Largest speed [m/s] for which the pump brings what a function draws, infinite where that is
    nothing."""
    drawn = float(supply_draw(function, circuit))
    return float(circuit.supply[0].flow_limit) / drawn if drawn > 0.0 else math.inf
