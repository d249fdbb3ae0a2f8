"""The laws of SPEC 2 put together into derivatives for any rig."""

from ehbench.parts.cylinder import (
    chamber_inflow,
    chamber_of,
    chamber_oil,
    chamber_slope,
    leakage_slope,
    linkage_of,
)
from ehbench.parts.edge import edge_flow, edge_leaks, edge_opening, edge_slope
from ehbench.parts.edge.preload import preload
from ehbench.parts.end_stop import stop_force, stop_rate
from ehbench.parts.friction import friction_fastest, friction_force, friction_rates, friction_slope
from ehbench.parts.friction.law import SETTLING
from ehbench.parts.line import line_rates
from ehbench.parts.load import force_on, force_slope
from ehbench.parts.mount import any_resistance, mount_rate, piston_of
from ehbench.parts.nodes import SUPPLY, TANK, ends_of, node_pressure
from ehbench.parts.oil import bulk_of
from ehbench.parts.supply import line_stiffness, pump_flow, sensed
from ehbench.parts.sway import sway_pull, sway_rate
from ehbench.parts.valve import limited, valve_finish, valve_rates
from ehbench.physics.arm import forward
from ehbench.physics.cylinder import chamber_rate
from ehbench.plant.build import Plant
from ehbench.runtime.compiled import generic, kernel, part_kernel

# [1/s] least flow of an edge that a load-sensing pump feels, in what brings its line up by its
# margin: what would take a day for that is none
LEAST_FELT = 1.0e-5
any_derivatives = generic("derivatives", "y, command, plant, dy, work")
any_finish = generic("finish", "y, command, plant, slope, d")
# where a valve is to go [V], by a row of commands
any_wanted = generic("wanted", "i, command, plant")
# whether nothing passes an edge, whatever its drop
any_shut = generic("shut", "edge, opening, plant")
# flow [m³/s] along an edge at a drop [Pa] and an opening, and the bound of its slope [m³/(s·Pa)]
any_along = generic("along", "drop, opening, edge, plant")
any_change = generic("change", "drop, flow, opening, edge, plant")
# whether an edge at the supply is open, so that a load-sensing supply feels what lies behind it
any_opens = generic("opens", "edge, opening, plant")
# bulk modulus [Pa] of the oil in a chamber
any_stiff = generic("stiff", "row, pressure, plant")
# how fast a chamber's inflow changes with its pressure [m³/(s·Pa)], for the substep guard, where
# ``slope`` is that of its edges
any_steep = generic("steep", "row, side, pressure, inflow, slope, plant")
# write the rates of a friction's own states; the fastest rate [1/s] that it makes near speed v
any_rubbing = generic("rubbing", "row, v, y, dy, plant")
# slope [N·s/m] of a steady friction over the speed v of the piston
any_gripping = generic("gripping", "row, v, plant")


@any_wanted.of(Plant)
@part_kernel
def _wanted_opening(i, command, plant):
    return limited(command[i], plant.valves[i])


@any_shut.of(Plant)
@part_kernel
def _shut_edge(edge, opening, plant):
    closed = edge.unmetered == 0 and edge.sign * opening <= 0.0
    return closed and not edge_leaks(edge, plant.maps)


@any_along.of(Plant)
@part_kernel
def _along_edge(drop, opening, edge, plant):
    return edge_flow(drop, opening, edge, plant.maps)


@any_change.of(Plant)
@part_kernel
def _change_along(drop, flow, opening, edge, plant):
    return edge_slope(drop, flow, opening, edge)


@part_kernel
def valves(y, command, plant, dy, work):
    """Rates of the valves' elements; openings into ``work``; the fastest rate [1/s]."""
    fastest = 0.0
    for i in range(plant.valves.shape[0]):
        required = any_wanted(i, command, plant)
        opening, rate = valve_rates(plant.valves[i], required, plant, y, dy)
        work[plant.at.opening + i] = opening
        fastest = max(fastest, rate)
    return fastest


@part_kernel
def join(edge, flow, slope, railed, at, work):
    """Add an edge's flow [m³/s] and slope at its nodes, but for what the low rail supplies."""
    a, b = edge.from_node, edge.to_node
    if not (railed and a == SUPPLY):
        work[at.net + a] -= flow
        work[at.slope + a] += slope
    if not (railed and b == SUPPLY):
        work[at.net + b] += flow
        work[at.slope + b] += slope


@part_kernel
def highest_load(y, plant, work):
    """Highest pressure [Pa] to which an open edge leads from the supply, else the tank's."""
    load = node_pressure(y, plant, TANK)
    for e in range(plant.edges.shape[0]):
        edge = plant.edges[e]
        if edge.from_node == SUPPLY or edge.to_node == SUPPLY:
            opening = edge_opening(y, plant, edge, work[plant.at.opening :])
            if any_opens(edge, opening, plant):
                end = edge.to_node if edge.from_node == SUPPLY else edge.from_node
                load = max(load, node_pressure(y, plant, end))
    return load


@any_opens.of(Plant)
@part_kernel
def _opens(edge, opening, plant):
    if edge.unmetered == 1 or edge.sign * opening <= 0.0:
        return False
    drop = -plant.supply.margin
    if edge.from_node == SUPPLY:
        drop = plant.supply.margin + preload(edge)
    # what a shut edge leaks senses nothing, nor does a spool that has all but come to rest
    leak = edge_flow(drop, 0.0, edge, plant.maps)
    minimum = LEAST_FELT * plant.supply.volume / plant.supply.bulk_modulus * plant.supply.margin
    return abs(edge_flow(drop, opening, edge, plant.maps)) > abs(leak) + minimum


@part_kernel
def edges(y, plant, work):
    """Flows along the edges; net inflow and its slope of every node."""
    at = plant.at
    for i in range(at.net, at.opening):
        work[i] = 0.0
    for e in range(plant.edges.shape[0]):
        edge = plant.edges[e]
        opening, flow = edge_opening(y, plant, edge, work[at.opening :]), 0.0
        if not any_shut(edge, opening, plant):
            first, last, railed = ends_of(y, plant, edge)
            drop = first - last
            flow = any_along(drop, opening, edge, plant)
            if flow != 0.0 or edge.unmetered == 1:
                slope = any_change(drop, flow, opening, edge, plant)
                join(edge, flow, slope, railed, at, work)
        work[at.flow + e] = flow


@any_resistance.of(Plant)
@part_kernel
def _resistance(row, v, y, plant):
    return friction_force(row, v, y)


@any_stiff.of(Plant)
@part_kernel
def _stiff_oil(row, pressure, plant):
    return bulk_of(row, pressure)


@any_steep.of(Plant)
@part_kernel
def _steep_inflow(row, side, pressure, inflow, slope, plant):
    return max(chamber_slope(row, pressure, inflow, slope), leakage_slope(row, side))


@any_rubbing.of(Plant)
@part_kernel
def _rubbing_piston(row, v, y, dy, plant):
    friction_rates(row, v, y, dy)
    return friction_fastest(row, v)


@any_gripping.of(Plant)
@part_kernel
def _gripping_piston(row, v, plant):
    return friction_slope(row, v)


@part_kernel
def cylinders(y, command, plant, dy, work):
    """Pressure rates of the chambers; torques of the cylinders, and the inertia with which friction
    settles in SETTLING, into ``work``; the fastest rate [1/s].

    ``(m + m_a) a = F(v)`` with ``m_a = max(0, F′ SETTLING − m)`` is the linearly implicit step of
    friction, whose rest and creep are those of F itself."""
    at, fastest = plant.at, 0.0
    for c in range(plant.cylinders.shape[0]):
        row = plant.cylinders[c]
        way, lever, _ = linkage_of(row, y[row.joint])
        speed = lever * y[at.rates + row.joint]
        x, v = piston_of(row, way, speed, y, plant)
        force, spring = 0.0, 0.0
        for side in range(2):
            node, area, _, _ = chamber_of(row, side)
            p, volume = y[plant.nodes[node].state], chamber_oil(row, side, x)
            bulk = any_stiff(row, p, plant)
            inflow = chamber_inflow(row, side, v, work[at.net + node], y, plant)
            dy[plant.nodes[node].state] = chamber_rate(
                inflow, p, volume, bulk, row.cavitation_pressure
            )
            slope = any_steep(row, side, p, inflow, work[at.slope + node], plant)
            stiffness = bulk / volume
            fastest = max(fastest, stiffness * slope)
            force += p * area
            spring += stiffness * area * area
        force -= any_resistance(row, v, y, plant)
        rate, grip = any_rubbing(row, v, y, dy, plant), any_gripping(row, v, plant)
        if row.mount_state >= 0 and grip > 0.0:  # behind the mount's damper
            grip *= row.mount_damping / (grip + row.mount_damping)
        if plant.forces.shape[0] > 0:
            force += force_on(c, way, speed, command, plant)
            slope, steep = force_slope(c, speed, plant)
            grip += slope
            rate += min(row.mobility * steep, 1.0 / SETTLING)
        added = max(0.0, grip * SETTLING - 1.0 / row.mobility)
        work[at.inertia + row.joint] += lever * lever * added
        fastest = max(fastest, rate)
        if x < 0.0 or x > row.stroke:
            force += stop_force(row, x, v)
            fastest = max(fastest, stop_rate(row, x))
            spring += row.stop_stiffness
        if row.mount_state >= 0:
            dy[row.mount_state] = v - speed
            fastest = max(fastest, mount_rate(row, spring))
        if row.sway_state >= 0:
            force += sway_pull(row, speed, y, dy)
            fastest = max(fastest, sway_rate(row))
        work[at.torque + row.joint] = lever * force
    return fastest


@part_kernel
def move(y, plant, dy, work):
    """Rates of the joints under the torques in ``work``: ``D(q) q̈ + h + c + B q̇ = Jᵀ P_load``
    (thesis 2.1, 2.2)."""
    n, at = plant.at.joints, plant.at
    for i in range(n):
        dy[i] = y[at.rates + i]
    forward(
        plant.kind,
        plant.links,
        plant.gravity,
        y[:n],
        y[at.rates : at.rates + n],
        work[at.torque : at.torque + 2 * n],
        dy[at.rates : at.rates + n],
        work,
    )


@part_kernel
def _supply(y, plant, dy, work):
    """Pressure rate of the supply line; the pump's flow into ``work``."""
    at, supply = plant.at, plant.supply
    demand = -work[at.net + SUPPLY]
    load = highest_load(y, plant, work) if supply.margin > 0.0 else 0.0
    pump = pump_flow(y[at.supply], demand, sensed(load, supply), supply)
    work[at.pump] = pump
    stiffness = line_stiffness(y[at.supply], supply)
    dy[at.supply] = stiffness * (pump - demand)
    fixed = 0.0 < pump < supply.flow_limit
    return 0.0 if fixed else stiffness * work[at.slope + SUPPLY]


@part_kernel
def tie(command, plant, dy):
    """Put what is tied to a recording into ``dy``: rates of joints [rad/s, rad/s²] and of the
    supply's pressure [Pa/s]."""
    for c in range(plant.cylinders.shape[0]):
        row = plant.cylinders[c]
        if row.tied_position >= 0:
            dy[row.joint] = command[row.tied_position]
        if row.tied_rate >= 0:
            dy[plant.at.rates + row.joint] = command[row.tied_rate]
    if plant.supply.tied >= 0:
        dy[plant.at.supply] = command[plant.supply.tied]


@any_derivatives.of(Plant)
@kernel
def derivatives(y, command, plant, dy, work):
    """Write ẏ into ``dy``; return the fastest rate [1/s] of the pressure, valve and friction
    blocks.

    Valves (thesis 2.12), flows along the metering edges (2.10, 2.11) and lines, chambers (2.4,
    2.5), the mechanism (2.1, 2.2), the supply. After the call ``work`` holds the edge flows from
    ``plant.at.flow`` on, then the pump flow [m³/s].

    Args:
        y: state, shape (plant.at.states,).
        command: valve commands [V], limited here to each driver's range, then forces that are
            played [N] and rates of tied states, shape (valves + played + ties,).
        dy: out, shape (plant.at.states,).
        work: workspace of plant.at.work.
    """
    fastest = valves(y, command, plant, dy, work)
    edges(y, plant, work)
    for i in range(plant.at.torque, plant.at.net):
        work[i] = 0.0
    # oil of a line and of its chamber that swap through a wide line are as fast as both together
    lines = line_rates(y, plant, dy, work)
    fastest = max(fastest, lines + cylinders(y, command, plant, dy, work))
    move(y, plant, dy, work)
    fastest = max(fastest, _supply(y, plant, dy, work))
    tie(command, plant, dy)
    return fastest


LAST = (_supply, move, cylinders)  # what `derivatives` calls, from the end on


@any_finish.of(Plant)
@part_kernel
def finish(y, command, plant, slope, d):
    """Improve the valves' states after a Runge–Kutta step of ``d`` [s]; ``slope``: rates at its
    start."""
    for i in range(plant.valves.shape[0]):
        valve = plant.valves[i]
        valve_finish(valve, limited(command[i], valve), plant, y, slope, d)
