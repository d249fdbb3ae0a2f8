"""The virtual bench's own laws: all that a model leaves out."""

import math

from ehbench.machines.virtual.plant import A_CYLINDER, FILTER, LINES, RAW, VirtualPlant
from ehbench.parts.cylinder import leakage_slope, linkage_of
from ehbench.parts.edge import CHECK, PUMP, check, pump
from ehbench.parts.edge.orifice import ORIFICE_DROP
from ehbench.parts.edge.preload import metered
from ehbench.parts.friction.law import SETTLING
from ehbench.parts.line import line_rates
from ehbench.parts.mount import any_resistance
from ehbench.parts.nodes import SUPPLY
from ehbench.parts.oil import bulk
from ehbench.parts.sample import OF, entry, line_entry, line_reading, reading
from ehbench.parts.supply import line_stiffness, pump_flow, sensed
from ehbench.parts.valve import limited
from ehbench.parts.valve.delay import line_acting, line_push
from ehbench.physics.cylinder import relief_flow
from ehbench.physics.friction import stribeck, stribeck_slope
from ehbench.plant.derivatives import (
    any_along,
    any_change,
    any_derivatives,
    any_finish,
    any_gripping,
    any_opens,
    any_rubbing,
    any_shut,
    any_steep,
    any_stiff,
    any_wanted,
    cylinders,
    edges,
    highest_load,
    move,
    valves,
)
from ehbench.plant.integrate import rk4
from ehbench.runtime.compiled import kernel, part_kernel

CREEP = 1.0e-3  # [m/s]: over which friction turns round


@part_kernel
def opening_area(wide, softness, saturation):
    """Opening [V] at ``wide`` [V] beyond the onset: ``w²/(w + softness)``, levelling off at
    saturation."""
    if wide <= 0.0:
        return 0.0
    soft = wide * wide / (wide + softness)
    ratio = soft / saturation
    ratio *= ratio
    return soft / math.sqrt(math.sqrt(1.0 + ratio * ratio))


@part_kernel
def curve_flow(drop, spool, curve):
    """Flow [m³/s] at drop ≥ 0 through a curve at a spool position [V].

    Orifice: ``γ a √Δp``. Behind a pressure compensator, the metering drop p_m that the spool holds
    obeys ``p_m = setting − κ a √Δp √p_m`` (spring against flow force, which grows with flow and
    with the drop taken), and cannot exceed what the wide open compensator in series leaves, ``Δp/(1
    + (a/a_c)²)``; the two blend by a fourth power."""
    a = opening_area(spool - curve.onset, curve.softness, curve.saturation)
    if a == 0.0:
        return 0.0
    p = drop
    if curve.setting > 0.0:
        share = a / curve.wide_open
        p = drop / (1.0 + share * share)
        b = curve.flow_force * a * math.sqrt(drop)
        level = 0.5 * (math.sqrt(b * b + 4.0 * curve.setting) - b)
        ratio = p / (level * level)
        ratio *= ratio
        p /= math.sqrt(math.sqrt(1.0 + ratio * ratio))
    return curve.gain * a * p / math.sqrt(math.sqrt(p * p + ORIFICE_DROP * ORIFICE_DROP))


@part_kernel
def edge_flow(drop, spool, edge, curves):
    """Flow [m³/s] along an edge at a drop [Pa] and a spool position [V], null leakage included."""
    reach = edge.sign * spool
    if edge.law == PUMP:
        return pump.flow(drop, reach, edge, curves)
    if edge.law == CHECK:
        return check.flow(drop, reach, edge, curves)
    drop = metered(drop, edge)
    closed = reach / edge.null_width
    flow = edge.null * drop / (1.0 + closed * closed)
    if drop >= 0.0:
        return flow + curve_flow(drop, reach, curves[edge.forward])
    if edge.blocked == 1:
        return 0.0
    return flow - curve_flow(-drop, reach, curves[edge.reverse])


@kernel
def spool_for(flow, drop, maximum, edge, curves):
    """Spool position [V], at most ``most`` from closed, at which an edge passes a flow [m³/s]."""
    low, high = 0.0, maximum
    for _ in range(200):
        middle = 0.5 * (low + high)
        if edge_flow(drop, edge.sign * middle, edge, curves) > flow:
            high = middle
        else:
            low = middle
    return edge.sign * 0.5 * (low + high)


@part_kernel
def edge_slope(drop, flow, spool, edge):
    """Bound of how fast a flow changes with a pressure at either end [m³/(s·Pa)]."""
    if edge.law == PUMP:
        return pump.slope(drop, flow, edge.sign * spool, edge)
    if edge.law == CHECK:
        return check.slope(drop, flow, edge.sign * spool, edge)
    return flow / metered(drop, edge)


@part_kernel
def play(memory, value, width):
    """Backlash of ``width``: where the output goes from ``memory`` when the input is ``value``."""
    return min(max(memory, value - 0.5 * width), value + 0.5 * width)


@any_wanted.of(VirtualPlant)
@part_kernel
def _wanted(i, command, plant):
    return command[i]


@any_shut.of(VirtualPlant)
@part_kernel
def _shut(edge, opening, plant):
    return False


@any_along.of(VirtualPlant)
@part_kernel
def _along(drop, opening, edge, plant):
    return edge_flow(drop, opening, edge, plant.curves)


@any_change.of(VirtualPlant)
@part_kernel
def _change(drop, flow, opening, edge, plant):
    return edge_slope(drop, flow, opening, edge)


@any_opens.of(VirtualPlant)
@part_kernel
def _opens(edge, opening, plant):
    if edge.unmetered == 1:
        return False
    curve = edge.forward if edge.from_node == SUPPLY else edge.reverse
    return curve_flow(plant.supply.margin, edge.sign * opening, plant.curves[curve]) > 0.0


@any_resistance.of(VirtualPlant)
@part_kernel
def _resistance(row, v, y, plant):
    viscous, static = row.friction_viscous, row.friction_static
    return stribeck(v, viscous, row.friction_coulomb, static, row.stribeck_speed, CREEP)


@any_stiff.of(VirtualPlant)
@part_kernel
def _stiff(row, pressure, plant):
    return bulk(pressure, row.bulk_modulus, plant.fluid.air, plant.fluid.polytropic)


@any_steep.of(VirtualPlant)
@part_kernel
def _steep(row, side, pressure, inflow, slope, plant):
    return max(slope, leakage_slope(row, side))


@any_rubbing.of(VirtualPlant)
@part_kernel
def _rubbing(row, v, y, dy, plant):
    steep = 0.0 if abs(v) > 4.0 * CREEP else row.friction_static / CREEP
    return min(row.mobility * (steep + row.friction_viscous), 1.0 / SETTLING)


@any_gripping.of(VirtualPlant)
@part_kernel
def _gripping(row, v, plant):
    viscous, static = row.friction_viscous, row.friction_static
    return stribeck_slope(v, viscous, row.friction_coulomb, static, row.stribeck_speed, CREEP)


@part_kernel
def _supply(y, bench, dy, work):
    """Rates of supply line, pump and the pressure that it senses; the fastest of them [1/s]."""
    at, line, fluid = bench.at, bench.supply, bench.fluid
    p, demand = y[at.supply], -work[at.net + SUPPLY]
    stiffness = line_stiffness(p, line)
    required = line.pressure
    dy[at.sensed] = 0.0
    if line.margin > 0.0:
        required = sensed(highest_load(y, bench, work), line)
        dy[at.sensed] = (required - y[at.sensed]) / line.lag
    if fluid.pump_lag == 0.0:  # the model's ideal compensator
        dy[at.supply] = stiffness * (pump_flow(p, demand, required, line) - demand)
        dy[at.pump] = 0.0
        return 0.0
    stroke = min(max((y[at.sensed] - p) / fluid.droop, 0.0), 1.0)
    dy[at.pump] = (line.flow_limit * stroke - y[at.pump]) / fluid.pump_lag
    spilt = relief_flow(p, fluid.supply_relief)
    dy[at.supply] = stiffness * (y[at.pump] - demand - spilt)
    pumping = math.sqrt(stiffness * line.flow_limit / (fluid.droop * fluid.pump_lag))
    return max(stiffness * work[at.slope + SUPPLY], pumping)


@any_derivatives.of(VirtualPlant)
@kernel
def derivatives(y, target, bench, dy, work):
    """Write ẏ of the bench's continuous states into ``dy``; return the fastest rate [1/s] of the
    stiff blocks.

    ``target`` [V] is where each driver wants its spool, shape (valves,)."""
    fastest = valves(y, target, bench, dy, work)
    edges(y, bench, work)
    for i in range(bench.at.torque, bench.at.net):
        work[i] = 0.0
    lines = line_rates(y, bench, dy, work)
    fastest = max(fastest, lines + cylinders(y, target, bench, dy, work))
    move(y, bench, dy, work)
    return max(fastest, _supply(y, bench, dy, work))


@any_finish.of(VirtualPlant)
@part_kernel
def _finish(y, target, bench, slope, d):
    """The bench leaves a Runge–Kutta step as it is."""


@part_kernel
def raw_of(y, bench, raw):
    """What the sensors would say were they perfect, in the order of the raw channels."""
    cylinders = bench.cylinders.shape[0]
    for c in range(cylinders):
        for i in range(A_CYLINDER):
            raw[A_CYLINDER * c + i] = reading(y, bench, c, RAW[i])
    for i in range(LINES):
        raw[A_CYLINDER * cylinders + i] = line_reading(y, bench, i)


@part_kernel
def follow(a, b, before, z, speed):
    """One tick of the filter ``s ω²/(s² + 2 ζ ω s + ω²)``, exact for an input that runs straight
    from ``before`` to ``z``.

    ``a`` and ``b`` are the smoothed input and its slope, ``speed`` what `speed_filter` gives;
    returns the new (a, b)."""
    slope = (z - before) / speed[4]
    behind = speed[5] * slope  # how far the filter trails a steady ramp
    e, f = a - before + behind, b - slope
    return z - behind + speed[0] * e + speed[1] * f, slope + speed[2] * e + speed[3] * f


@part_kernel
def _delayed(state, bench, channel):
    """A raw channel as late as the delay line makes it; the line's present row is written."""
    at = bench.at
    late = (int(state[at.place]) - 1 - bench.delay + 2 * at.depth) % at.depth
    later = (late - 1 + at.depth) % at.depth
    return (1.0 - bench.share) * state[at.ring + late * at.channels + channel] + (
        bench.share * state[at.ring + later * at.channels + channel]
    )


@part_kernel
def _measure(state, bench, noise_row, sample):
    """Noise, offset and quantization of lagged channels, then the delay line, then speed."""
    at, cylinders = bench.at, bench.cylinders.shape[0]
    place = int(state[at.place])
    for i in range(at.channels):
        sensor = bench.sensors[i]
        value = state[at.lags + i] + sensor.zero + sensor.noise * noise_row[i]
        if sensor.resolution > 0.0:
            value = sensor.resolution * math.floor(value / sensor.resolution + 0.5)
        state[at.ring + place * at.channels + i] = value
    state[at.place] = (place + 1) % at.depth
    for c in range(cylinders):
        row = bench.cylinders[c]
        for i in range(A_CYLINDER):
            sample[entry(c, RAW[i])] = _delayed(state, bench, A_CYLINDER * c + i)
        z, k = sample[entry(c, OF.x)], at.filters + FILTER * c
        state[k], state[k + 1] = follow(state[k], state[k + 1], state[k + 2], z, bench.speed)
        state[k + 2] = z
        sample[entry(c, OF.v)] = state[k + 1]
        _, lever, _ = linkage_of(row, sample[entry(c, OF.q)])
        sample[entry(c, OF.qd)] = state[k + 1] / lever if abs(lever) > 1.0e-3 else 0.0
    for i in range(LINES):
        sample[line_entry(cylinders, i)] = _delayed(state, bench, A_CYLINDER * cylinders + i)


@kernel
def bench_tick(state, command, bench, tick, steps, scratch, noise_row, sample):
    """Let ``command`` act for one tick, in place, then write what the machine measures into
    ``sample``.

    Args:
        state: the whole state of the bench, memory included.
        command: [V], shape (valves,), limited to each driver's range.
        tick: [s].
        steps: integration steps a tick; more substeps are taken where the bench is stiff.
        scratch: of `scratch_of`.
        noise_row: standard normal numbers, shape (raw channels,).
        sample: out, as `ehbench.parts.sample`.
    """
    at = bench.at
    y = state[: at.states]
    for i in range(bench.valves.shape[0]):
        valve, k = bench.valves[i], at.hysteresis + i
        state[k] = play(state[k], limited(command[i], valve), valve.hysteresis)
        scratch.target[i] = valve.gain * state[k] + valve.offset
    h = tick / steps
    line = scratch.line
    for step in range(steps):
        line_acting(line, scratch.target, bench, step * h, h)
        rk4(y, line.acting, bench, h, scratch.k, scratch.work)
        raw_of(y, bench, scratch.raw)
        for i in range(at.channels):
            lag = bench.sensors[i].lag
            keep = math.exp(-h / lag) if lag > 0.0 else 0.0
            state[at.lags + i] = scratch.raw[i] + keep * (state[at.lags + i] - scratch.raw[i])
    line_push(line, scratch.target)
    _measure(state, bench, noise_row, sample)
