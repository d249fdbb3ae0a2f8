"""The powers of a state and what is stored in it, asked of the parts one by one.

Energies count from oil at zero gauge pressure. A volume of oil that crosses a pressure p carries p,
and what its compression holds, ``u(p)`` of `ehbench.parts.oil.stored` per volume; with these two
the chamber law ``V/β ṗ = Q − V̇`` is exactly ``(p + u(p)) Q = p V̇ + d/dt (V u(p))``: flow work is
piston work and a change of what is stored, a function of state."""

from typing import NamedTuple

from ehbench.parts.accumulator import gas_energy
from ehbench.parts.cylinder import (
    chamber_inflow,
    chamber_of,
    chamber_oil,
    linkage_of,
)
from ehbench.parts.edge import PUMP as PUMP_LAW
from ehbench.parts.edge.pump import slip_loss
from ehbench.parts.end_stop import stop_loss, stop_stored
from ehbench.parts.friction import friction_loss, friction_stored
from ehbench.parts.line import line_drop, line_flow
from ehbench.parts.load import push_on, spring_stored
from ehbench.parts.mount import mount_loss, mount_stored, piston_of
from ehbench.parts.nodes import SUPPLY, TANK, ends_of, node_pressure, node_stored
from ehbench.parts.sway import sway_loss, sway_stored
from ehbench.physics import arm
from ehbench.physics.cylinder import makeup_flow, relief_flow
from ehbench.runtime.compiled import kernel


class CylinderPowers(NamedTuple):
    """Where a power stands among those of its cylinder."""

    drawn: int = 0
    drawn_compression: int = 1
    work: int = 2
    expansion: int = 3
    leakage: int = 4
    relief: int = 5
    makeup: int = 6
    return_line: int = 7
    friction: int = 8
    end_stop: int = 9
    external_force: int = 10


class CylinderStores(NamedTuple):
    """Places of what a cylinder stores: oil of head and rod, end stops, springs on the rod."""

    head: int = 0
    rod: int = 1
    stop: int = 2
    load_spring: int = 3


# powers: the pump's, its share for compression, one per edge, those of each cylinder, one per
# joint, the shaft of each edge that is a pump, what each line takes, what each mount takes,
# the damper of what sways, then the low rail's and its share for compression, where there is one
PUMP, COMPRESSION, FIRST_EDGE = 0, 1, 2
OF, PER_CYLINDER = CylinderPowers(), len(CylinderPowers())
# what is stored: in the supply line, in the mechanism, in each cylinder, then in the friction of
# each whose law has states, in each line, in each mount, in what sways, then in an
# accumulator
SUPPLY_LINE, KINETIC, POTENTIAL, FIRST_CYLINDER = 0, 1, 2, 3
STORED, STORES = CylinderStores(), len(CylinderStores())


@kernel
def power_at(edges, cylinder, which):
    """Column of a cylinder's power, such as ``power_at(edges, c, OF.work)``."""
    return FIRST_EDGE + edges + PER_CYLINDER * cylinder + which


@kernel
def store_at(cylinder, which):
    """Column of what a cylinder stores, such as ``store_at(c, STORED.head)``."""
    return FIRST_CYLINDER + STORES * cylinder + which


@kernel
def _node(node, y, plant):
    """(pressure [Pa], energy of its compression [J/m³]) of the oil at a node of the circuit."""
    p = node_pressure(y, plant, node)
    return p, node_stored(plant, node, p)


@kernel
def powers(y, command, flows, plant, owner, out):
    """Write every power [W] of a state into ``out``: what is spent positive, the supply's positive
    where it gives.

    What comes to the tank is lost with the tank's own pressure on it. An end stop takes what it
    does not hold as a spring.

    Args:
        y: state of the plant.
        command: valve commands [V], then forces that are played [N].
        flows: along the edges, then the pump's [m³/s].
        owner: cylinder to which each edge belongs.
        out: shape (columns,).
    """
    at, edges = plant.at, plant.edges.shape[0]
    for i in range(out.shape[0]):
        out[i] = 0.0
    p_supply, u_supply = _node(SUPPLY, y, plant)
    out[PUMP], out[COMPRESSION] = p_supply * flows[edges], u_supply * flows[edges]
    for e in range(edges):
        if flows[e] != 0.0:
            _throttle(e, y, flows[e], plant, power_at(edges, owner[e], 0), out)
    cylinders = plant.cylinders.shape[0]
    for c in range(cylinders):
        first = power_at(edges, c, 0)
        _cylinder(c, y, flows, plant, first, out)
        row = plant.cylinders[c]
        _, lever, _ = linkage_of(row, y[row.joint])
        v = lever * y[at.rates + row.joint]
        out[first + OF.external_force] = -push_on(c, v, command, plant) * v
    first = power_at(edges, cylinders, 0)
    for j in range(at.joints):
        rate = y[at.rates + j]
        out[first + j] = plant.links[j].damping * rate * rate
    shaft = first + at.joints
    for e in range(edges):
        edge = plant.edges[e]
        if edge.law == PUMP_LAW:  # its slip, and its shaft, D ω (p_b − p_a)
            drop = node_pressure(y, plant, edge.from_node) - node_pressure(y, plant, edge.to_node)
            out[FIRST_EDGE + e] = slip_loss(drop, edge)
            out[shaft] = out[FIRST_EDGE + e] - drop * flows[e]
            shaft += 1
    for i in range(plant.lines.shape[0]):
        _line(i, y, flows, plant, shaft + i, out)
    mount = shaft + plant.lines.shape[0]
    for c in range(cylinders):
        row = plant.cylinders[c]
        if row.mount_state >= 0:
            x, lever, _ = linkage_of(row, y[row.joint])
            v = lever * y[at.rates + row.joint]
            out[mount] = mount_loss(row, piston_of(row, x, v, y, plant)[1], v)
            mount += 1
    for c in range(cylinders):
        row = plant.cylinders[c]
        if row.sway_state >= 0:
            _, lever, _ = linkage_of(row, y[row.joint])
            out[mount] = sway_loss(row, lever * y[at.rates + row.joint], y)
            mount += 1


@kernel
def _line(i, y, flows, plant, at, out):
    """Write a line's power into column ``at``; its oil and cavitation count as its cylinder's."""
    row = plant.lines[i]
    own = power_at(plant.edges.shape[0], row.cylinder, 0)
    p, u = _node(row.node, y, plant)
    _, u_end = _node(row.chamber, y, plant)
    p_tank, u_tank = _node(TANK, y, plant)
    drop, flow = line_drop(y, plant, row), line_flow(y, plant, row)
    makeup = makeup_flow(_net_flow(row.node, y, flows, plant), p, row.cavitation_pressure)
    out[at] = drop * flow
    out[own + OF.expansion] += (u - u_end) * flow - (u - u_tank) * makeup
    out[own + OF.makeup] += makeup * (p_tank - p)
    out[own + OF.return_line] -= (p_tank + u_tank) * makeup


@kernel
def _throttle(e, y, flow, plant, at, out):
    """Add what an edge takes: a throttle of flow Q from a to b takes ``(p_a − p_b) Q`` (SPEC 4) and
    lets ``(u_a − u_b) Q`` of compression go. ``at``: the first column of its cylinder.
    """
    a, b = plant.edges[e].from_node, plant.edges[e].to_node
    p_a, p_b, railed = ends_of(y, plant, plant.edges[e])
    u_a, u_b = node_stored(plant, a, p_a), node_stored(plant, b, p_b)
    out[FIRST_EDGE + e] = (p_a - p_b) * flow
    out[at + OF.expansion] += (u_a - u_b) * flow
    for node, p, u, sign in ((a, p_a, u_a, 1.0), (b, p_b, u_b, -1.0)):
        if node == SUPPLY:
            out[at + OF.drawn] += sign * p * flow
            out[at + OF.drawn_compression] += sign * u * flow
            if railed:  # its pump is another one, and has the last two columns
                out[out.shape[0] - 2] += sign * p * flow
                out[out.shape[0] - 1] += sign * u * flow
        elif node == TANK:
            out[at + OF.return_line] -= sign * (p + u) * flow


@kernel
def _net_flow(node, y, flows, plant):
    """What edges and lines bring to a node [m³/s]."""
    net = 0.0
    for e in range(plant.edges.shape[0]):
        if plant.edges[e].from_node == node:
            net -= flows[e]
        if plant.edges[e].to_node == node:
            net += flows[e]
    for i in range(plant.lines.shape[0]):
        row = plant.lines[i]
        if row.node == node:
            net -= line_flow(y, plant, row)
        if row.chamber == node:
            net += line_flow(y, plant, row)
    return net


@kernel
def _cylinder(c, y, flows, plant, at, out):
    """Add what a cylinder takes and gives, from column ``at`` on."""
    row = plant.cylinders[c]
    x, lever, _ = linkage_of(row, y[row.joint])
    x, v = piston_of(row, x, lever * y[plant.at.rates + row.joint], y, plant)
    p_tank, u_tank = _node(TANK, y, plant)
    p_head, u_head = _node(row.node_head, y, plant)
    p_rod, u_rod = _node(row.node_rod, y, plant)
    across = row.leakage_internal * (p_head - p_rod)
    out[at + OF.expansion] += (u_head - u_rod) * across
    out[at + OF.leakage] = across * (p_head - p_rod)
    for side in range(2):
        node, area, _, leakage = chamber_of(row, side)
        p, u = _node(node, y, plant)
        inflow = chamber_inflow(row, side, v, _net_flow(node, y, flows, plant), y, plant)
        relief = relief_flow(p, row.relief_pressure)
        makeup = makeup_flow(inflow, p, row.cavitation_pressure)
        leak = leakage * (p - p_tank)
        to_tank = relief + leak - makeup
        out[at + OF.leakage] += leak * (p - p_tank)
        out[at + OF.relief] += relief * (p - p_tank)
        out[at + OF.makeup] += makeup * (p_tank - p)
        out[at + OF.return_line] += (p_tank + u_tank) * to_tank
        out[at + OF.expansion] += (u - u_tank) * to_tank
        out[at + OF.work] += p * area * v
    out[at + OF.friction] = friction_loss(row, v, y)
    out[at + OF.end_stop] = stop_loss(row, x, v)


@kernel
def stores(y, plant, work, out):
    """Write every stored energy [J] of a state into ``out``, shape (columns,).

    Oil: ``V u(p)``. The mechanism: kinetic and potential energy. An end stop: ``k δ²/2`` of its
    depth δ, a mount as much of its deflection. A spring on the rod: ``k (x − free length)²/2``."""
    n, rates = plant.at.joints, plant.at.rates
    _, fixed = _node(SUPPLY, y, plant)
    out[SUPPLY_LINE] = plant.supply.volume * fixed
    out[KINETIC], out[POTENTIAL] = arm.energy(
        plant.kind, plant.links, plant.gravity, y[:n], y[rates : rates + n], work
    )
    for c in range(plant.cylinders.shape[0]):
        row = plant.cylinders[c]
        x, _, _ = linkage_of(row, y[row.joint])
        piston = x if row.mount_state < 0 else x + y[row.mount_state]
        for side in range(2):
            _, fixed = _node(chamber_of(row, side)[0], y, plant)
            out[store_at(c, STORED.head + side)] = chamber_oil(row, side, piston) * fixed
        out[store_at(c, STORED.stop)] = stop_stored(row, piston)
        out[store_at(c, STORED.load_spring)] = spring_stored(c, x, plant)
    at = store_at(plant.cylinders.shape[0], 0)
    for c in range(plant.cylinders.shape[0]):
        if plant.cylinders[c].friction_state >= 0:
            out[at] = friction_stored(plant.cylinders[c], y)
            at += 1
    for i in range(plant.lines.shape[0]):
        _, fixed = _node(plant.lines[i].node, y, plant)
        out[at] = plant.lines[i].volume * fixed
        at += 1
    for c in range(plant.cylinders.shape[0]):
        if plant.cylinders[c].mount_state >= 0:
            out[at] = mount_stored(plant.cylinders[c], y)
            at += 1
    for c in range(plant.cylinders.shape[0]):
        if plant.cylinders[c].sway_state >= 0:
            out[at] = sway_stored(plant.cylinders[c], y)
            at += 1
    if plant.supply.gas_volume > 0.0:
        out[at] = gas_energy(node_pressure(y, plant, SUPPLY), plant.supply)
