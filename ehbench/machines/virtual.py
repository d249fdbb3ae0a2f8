"""The virtual bench: a separate, richer plant that plays the machine; only trials and datasets may
import it.

It shares the mechanism, the cylinder's geometry, the valves' dynamics and the integrator with the
model, and has its own laws for all that a model leaves out: air in the oil, leakage, Stribeck
friction, valves that are no two alike, hysteresis, a pump that droops, and sensors that are late,
noisy and coarse. Its parameters are read by nothing but itself.

State, one flat array: the states of the model's plant, the pump's flow; then memory: hysteresis per
valve, sensor lags per raw channel, speed filter (3) per cylinder, delay line, its position. Raw
channels: ``q, x, p_head, p_rod`` of each cylinder, then ``p_supply, p_tank``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import copy
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from ehbench.compiled import bound, kernel, part_kernel, record, table
from ehbench.errors import InputError, SimulationError
from ehbench.machines.protocol import Advance, Inputs, Posture
from ehbench.machines.rows import Controls, Rows, control, violated
from ehbench.parts.cylinder import (
    RELIEF_GAIN,
    chamber_inflow,
    chamber_of,
    chamber_oil,
    leakage_slope,
    linkage_of,
)
from ehbench.parts.edge import CHECK, PUMP, check, edge_opening, pump
from ehbench.parts.edge.orifice import ORIFICE_DROP
from ehbench.parts.end_stop import stop_force, stop_rate
from ehbench.parts.line import line_rates
from ehbench.parts.load import force_on, force_steepness
from ehbench.parts.mount import mount_rate, piston_of, resistance_of
from ehbench.parts.nodes import SUPPLY, TANK, ends_of, node_pressure
from ehbench.parts.oil import bulk
from ehbench.parts.sample import OF, entry, line_entry, sample_channels
from ehbench.parts.supply import line_stiffness, pump_flow, sensed
from ehbench.parts.valve import VALVE_COLUMNS, limited, valve_rates, valve_settle
from ehbench.parts.valve.delay import Line, line_felt, line_of, line_push
from ehbench.parts.valve.second_order import SecondOrder, second_order
from ehbench.physics.cylinder import chamber_rate, relief_flow
from ehbench.physics.friction import stribeck
from ehbench.plant.build import Maps, links_of
from ehbench.plant.derivatives import derivatives_of, finish_of, join, move
from ehbench.plant.integrate import rk4
from ehbench.plant.layout import Layout, Offsets, layout
from ehbench.plant.model import Model
from ehbench.quantities import VOCABULARY
from ehbench.recipe import BenchRecipe, TrialRecipe, load_recipe, load_rig
from ehbench.rig import Edge, Rig, Value, Valve, read_value

NAME = "virtual bench"
STEP = 2.5e-4  # [s]
CREEP = 1.0e-3  # [m/s]: over which friction turns round
NOISE_ROWS = 256  # drawn at a time
SETTLE = 0.25  # [s] of rest before t = 0, so that lags and delays have filled
RAW = (OF.q, OF.x, OF.p_head, OF.p_rod)  # a cylinder's raw channels
_RAW, _RAW_LINES, _FILTER = len(RAW), 2, 3
_STROKE = RAW.index(OF.x)

# Wider rows begin with the columns of their own: numba would else take one for the other.
# A valve: ``gain`` and ``offset`` [V] of its driver, its ``hysteresis`` [V], the model's columns.
BENCH_VALVE = record(("gain", "f8"), ("offset", "f8"), ("hysteresis", "f8"), *VALVE_COLUMNS)
# An edge: its nodes, its valve and sign, its law, its leakage at null [m³/(s·Pa)] over
# ``null_width`` [V], ``blocked`` 1 where nothing passes in reverse, and its two curves; a pump or a
# check valve has the model's columns with numbers of its own instead.
BENCH_EDGE = record(
    *((name, "i8") for name in ("from_node", "to_node", "valve", "blocked", "forward", "reverse")),
    *((name, "f8") for name in ("sign", "null", "null_width")),
    ("law", "i8"),
    *pump.LAW.columns,
    *check.LAW.columns,
)
# A curve, see `curve_flow`: ``onset, softness, saturation`` and ``wide_open`` [V], ``gain``
# [m³/(s·V·√Pa)], ``setting`` of the compensator [Pa], 0 for none, its ``flow_force`` [1/V].
CURVE = record(
    *((name, "f8") for name in ("onset", "softness", "saturation", "gain")),
    *((name, "f8") for name in ("setting", "wide_open", "flow_force")),
)
# A sensor: ``lag`` [s]; standard deviation of its ``noise``, ``resolution`` and ``zero`` offset in
# its channel's unit.
SENSOR = record(*((name, "f8") for name in ("lag", "noise", "resolution", "zero")))
# Fluid and pump: share of free ``air``, ``polytropic`` exponent; ``droop`` [Pa], ``pump_lag`` [s],
# ``supply_relief`` of the supply line [Pa].
FLUID = record(
    *((name, "f8") for name in ("air", "polytropic", "droop", "pump_lag", "supply_relief"))
)


class BenchOffsets(NamedTuple):
    """Where things begin.

    In the state: as `ehbench.plant.layout.Offsets`, then the ``pump``'s flow and the pressure it is
    to hold, ``sensed``; ``states`` that are integrated; then memory: ``hysteresis``, ``lags``,
    ``filters``, ``ring`` of the delay line, ``depth`` rows of it, its ``place``; ``size`` in all.
    ``channels`` raw ones. In the workspace: as there.
    """

    joints: int
    rates: int
    supply: int
    pump: int
    sensed: int
    states: int
    hysteresis: int
    lags: int
    filters: int
    ring: int
    depth: int
    place: int
    size: int
    channels: int
    torque: int
    net: int
    slope: int
    opening: int
    work: int


def _offsets(names: Layout, depth: int) -> BenchOffsets:
    at: Offsets = names.offsets()
    nc, nv = len(names.cylinders), len(names.valves)
    channels = _RAW * nc + _RAW_LINES
    states = at.states + 2
    lags = states + nv
    filters = lags + channels
    ring = filters + _FILTER * nc
    place = ring + depth * channels
    return BenchOffsets(
        joints=at.joints,
        rates=at.rates,
        supply=at.supply,
        pump=at.states,
        sensed=at.states + 1,
        states=states,
        hysteresis=states,
        lags=lags,
        filters=filters,
        ring=ring,
        depth=depth,
        place=place,
        size=place + 1,
        channels=channels,
        torque=at.torque,
        net=at.net,
        slope=at.slope,
        opening=at.opening,
        work=at.flow,
    )


class VirtualPlant(NamedTuple):
    """A bench as flat tables. ``delay``: whole ticks of the sensors' delay, ``share`` the rest of
    it as a share of a tick; ``speed`` the numbers of the speed filter, see `_speed_filter`.
    """

    kind: int
    gravity: np.ndarray
    links: np.recarray
    cylinders: np.recarray
    nodes: np.recarray
    valves: np.recarray
    elements: np.recarray
    edges: np.recarray
    curves: np.recarray
    supply: np.record
    forces: np.recarray
    lines: np.recarray
    fluid: np.record
    sensors: np.recarray
    delay: int
    share: float
    speed: np.ndarray
    at: BenchOffsets


class Scratch(NamedTuple):
    """What a tick of the bench works in: ``k`` (5, states), ``work`` (at.work,), ``target`` [V]
    (valves,), ``raw`` (channels,), and the ``line`` of past targets.
    """

    k: np.ndarray
    work: np.ndarray
    target: np.ndarray
    raw: np.ndarray
    line: Line


def scratch_of(bench: VirtualPlant, tick: float) -> Scratch:
    """A scratch for a bench."""
    at = bench.at
    return Scratch(
        np.zeros((5, at.states)),
        np.zeros(at.work),
        np.zeros(bench.valves.shape[0]),
        np.zeros(at.channels),
        line_of(bench, tick),
    )


# --- laws


@part_kernel
def opening_area(wide, softness, saturation):
    """Opening [V of ideal travel] at ``wide`` [V] beyond the onset: ``w²/(w + softness)``, then
    levelling off at saturation.
    """
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
    """Flow [m³/s] along an edge at a drop [Pa] of either sign and a spool position [V], null
    leakage included.
    """
    reach = edge.sign * spool
    if edge.law == PUMP:
        return pump.flow(drop, reach, edge, curves)
    if edge.law == CHECK:
        return check.flow(drop, reach, edge, curves)
    closed = reach / edge.null_width
    flow = edge.null * drop / (1.0 + closed * closed)
    if drop >= 0.0:
        return flow + curve_flow(drop, reach, curves[edge.forward])
    if edge.blocked == 1:
        return 0.0
    return flow - curve_flow(-drop, reach, curves[edge.reverse])


@kernel
def _spool_for(flow, drop, most, edge, curves):
    """Spool position [V], at most ``most`` from closed, at which an edge passes a flow [m³/s]."""
    low, high = 0.0, most
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
    return flow / drop


@part_kernel
def play(memory, value, width):
    """Backlash of ``width``: where the output goes from ``memory`` when the input is ``value``."""
    return min(max(memory, value - 0.5 * width), value + 0.5 * width)


@part_kernel
def _valves_and_edges(y, target, bench, dy, work):
    """Rates of the valves, net inflow and its slope of every node; the fastest rate [1/s]."""
    at, fastest = bench.at, 0.0
    for i in range(bench.valves.shape[0]):
        spool, rate = valve_rates(bench.valves[i], target[i], bench, y, dy)
        work[at.opening + i] = spool
        fastest = max(fastest, rate)
    for i in range(at.net, at.opening):
        work[i] = 0.0
    for e in range(bench.edges.shape[0]):
        edge = bench.edges[e]
        first, last, railed = ends_of(y, bench, edge)
        drop = first - last
        spool = edge_opening(y, bench, edge, work[at.opening :])
        flow = edge_flow(drop, spool, edge, bench.curves)
        if flow != 0.0 or edge.law >= PUMP:
            join(edge, flow, edge_slope(drop, flow, spool, edge), railed, at, work)
    return fastest


@part_kernel
def _load(y, bench, work):
    """The highest pressure [Pa] to which an open edge leads from the supply; the tank's where none
    does.
    """
    load, margin = node_pressure(y, bench, TANK), bench.supply.margin
    for e in range(bench.edges.shape[0]):
        edge = bench.edges[e]
        if edge.law >= PUMP or (edge.from_node != SUPPLY and edge.to_node != SUPPLY):
            continue
        reach = edge.sign * edge_opening(y, bench, edge, work[bench.at.opening :])
        curve = edge.forward if edge.from_node == SUPPLY else edge.reverse
        if curve_flow(margin, reach, bench.curves[curve]) > 0.0:
            end = edge.to_node if edge.from_node == SUPPLY else edge.from_node
            load = max(load, node_pressure(y, bench, end))
    return load


@resistance_of(VirtualPlant)
@part_kernel
def _resistance(row, v, y, plant):
    viscous, static = row.friction_viscous, row.friction_static
    return stribeck(v, viscous, row.friction_coulomb, static, row.stribeck_speed, CREEP)


@part_kernel
def _cylinders(y, target, bench, dy, work):
    """Pressure rates of the chambers, torques of the cylinders; the fastest rate [1/s]."""
    at, fluid, fastest = bench.at, bench.fluid, 0.0
    for c in range(bench.cylinders.shape[0]):
        row = bench.cylinders[c]
        way, lever, _ = linkage_of(row, y[row.joint])
        speed = lever * y[at.rates + row.joint]
        x, v = piston_of(row, way, speed, y, bench)
        force, spring = 0.0, 0.0
        for side in range(2):
            node, area, _, _ = chamber_of(row, side)
            p, volume = node_pressure(y, bench, node), chamber_oil(row, side, x)
            beta = bulk(p, row.bulk_modulus, fluid.air, fluid.polytropic)
            inflow = chamber_inflow(row, side, v, work[at.net + node], y, bench)
            dy[bench.nodes[node].state] = chamber_rate(
                inflow, p, volume, beta, row.cavitation_pressure
            )
            slope = max(work[at.slope + node], leakage_slope(row, side))
            fastest = max(fastest, beta / volume * slope)
            force += p * area
            spring += beta / volume * area * area
        force -= _resistance(row, v, y, bench)
        steep = 0.0 if abs(v) > 4.0 * CREEP else row.friction_static / CREEP
        if bench.forces.shape[0] > 0:
            force += force_on(c, way, speed, target, bench)
            steep += force_steepness(c, speed, bench)
        fastest = max(fastest, row.mobility * (steep + row.friction_viscous))
        if x < 0.0 or x > row.stroke:
            force += stop_force(row, x, v)
            fastest = max(fastest, stop_rate(row))
            spring += row.stop_stiffness
        if row.mount_state >= 0:
            dy[row.mount_state] = v - speed
            fastest = max(fastest, mount_rate(row, spring))
        work[at.torque + row.joint] = lever * force
    return fastest


@part_kernel
def _supply(y, bench, dy, work):
    """Rates of the supply line, of the pump and of the pressure that it is told to hold; the
    fastest of them [1/s].
    """
    at, line, fluid = bench.at, bench.supply, bench.fluid
    p, demand = y[at.supply], -work[at.net + SUPPLY]
    stiffness = line_stiffness(p, line)
    wanted = line.pressure
    dy[at.sensed] = 0.0
    if line.margin > 0.0:
        wanted = sensed(_load(y, bench, work), line)
        dy[at.sensed] = (wanted - y[at.sensed]) / line.lag
    if fluid.pump_lag == 0.0:  # the model's ideal compensator
        dy[at.supply] = stiffness * (pump_flow(p, demand, wanted, line) - demand)
        dy[at.pump] = 0.0
        return 0.0
    stroke = min(max((y[at.sensed] - p) / fluid.droop, 0.0), 1.0)
    dy[at.pump] = (line.flow_limit * stroke - y[at.pump]) / fluid.pump_lag
    spilt = relief_flow(p, fluid.supply_relief, RELIEF_GAIN)
    dy[at.supply] = stiffness * (y[at.pump] - demand - spilt)
    pumping = math.sqrt(stiffness * line.flow_limit / (fluid.droop * fluid.pump_lag))
    return max(stiffness * work[at.slope + SUPPLY], pumping)


@derivatives_of(VirtualPlant)
@kernel
def derivatives(y, target, bench, dy, work):
    """Write ẏ of the bench's continuous states into ``dy``; return the fastest rate [1/s] of the
    stiff blocks.

    ``target`` [V] is where each driver wants its spool, shape (valves,).
    """
    fastest = _valves_and_edges(y, target, bench, dy, work)
    for i in range(bench.at.torque, bench.at.net):
        work[i] = 0.0
    fastest = max(fastest, line_rates(y, bench, dy, work))
    fastest = max(fastest, _cylinders(y, target, bench, dy, work))
    move(y, bench, dy, work)
    return max(fastest, _supply(y, bench, dy, work))


@finish_of(VirtualPlant)
@part_kernel
def _finish(y, target, bench, slope, d):
    """The bench leaves a Runge–Kutta step as it is."""


@part_kernel
def _raw(y, bench, raw):
    """What the sensors would say were they perfect, in the order of the raw channels."""
    cylinders = bench.cylinders.shape[0]
    for c in range(cylinders):
        row = bench.cylinders[c]
        q = y[row.joint]
        x, _, _ = linkage_of(row, q)
        raw[_RAW * c] = q
        raw[_RAW * c + 1] = x
        raw[_RAW * c + 2] = node_pressure(y, bench, row.node_head)
        raw[_RAW * c + 3] = node_pressure(y, bench, row.node_rod)
    raw[_RAW * cylinders] = node_pressure(y, bench, SUPPLY)
    raw[_RAW * cylinders + 1] = node_pressure(y, bench, TANK)


@part_kernel
def _follow(a, b, before, z, speed):
    """One tick of the filter ``s ω²/(s² + 2 ζ ω s + ω²)``, exact for an input that runs straight
    from ``before`` to ``z``.

    ``a`` and ``b`` are the smoothed input and its slope, ``speed`` what `_speed_filter` gives;
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
    """Noise, offset and quantization of the lagged channels, then the delay line, then speed from
    position.
    """
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
        for i in range(_RAW):
            sample[entry(c, RAW[i])] = _delayed(state, bench, _RAW * c + i)
        z, k = sample[entry(c, OF.x)], at.filters + _FILTER * c
        state[k], state[k + 1] = _follow(state[k], state[k + 1], state[k + 2], z, bench.speed)
        state[k + 2] = z
        sample[entry(c, OF.v)] = state[k + 1]
        _, lever, _ = linkage_of(row, sample[entry(c, OF.q)])
        sample[entry(c, OF.qd)] = state[k + 1] / lever if abs(lever) > 1.0e-3 else 0.0
    for i in range(_RAW_LINES):
        sample[line_entry(cylinders, i)] = _delayed(state, bench, _RAW * cylinders + i)


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
        line_felt(line, scratch.target, bench, step * h, h)
        rk4(y, line.held, bench, h, scratch.k, scratch.work)
        _raw(y, bench, scratch.raw)
        for i in range(at.channels):
            lag = bench.sensors[i].lag
            keep = math.exp(-h / lag) if lag > 0.0 else 0.0
            state[at.lags + i] = scratch.raw[i] + keep * (state[at.lags + i] - scratch.raw[i])
    line_push(line, scratch.target)
    _measure(state, bench, noise_row, sample)


# --- putting a bench together


def _scalar(value) -> float | None:
    return None if value is None else float(value)


class _Given:
    """What a bench file says of one thing: its own entry, else that of ``all``, else a default."""

    def __init__(self, table: Mapping[str, Any], name: str) -> None:
        self.entries = [table[key] for key in (name, "all") if key in table]

    def __call__(self, key: str, default: float) -> float:
        for own in self.entries:
            value = _scalar(getattr(own, key))
            if value is not None:
                return value
        return default

    def reverse(self) -> _Given:
        found = _Given({}, "")
        found.entries = [own.reverse for own in self.entries]
        return found


def _draws(seed: int, name: str) -> np.random.Generator:
    """The generator of one part: its numbers do not depend on what other parts the machine has."""
    return np.random.default_rng([seed, crc32(name.encode())])


def _truth(recipe: BenchRecipe, rig: Rig) -> Rig:
    """The rig as the bench has it: overridden parameters, and an analytic law where the rig file
    waits for a flow map.
    """
    values = {}
    for name, text in recipe.truth.items():
        try:
            values[name] = float(read_value(text, VOCABULARY[name.rsplit(".", 1)[-1]]))
        except KeyError:
            values[name] = 0.0  # `with_values` says that there is no such parameter
        except InputError as error:
            raise InputError(
                f"truth.{name}: {error.message}", **recipe.at("truth", name), hint=error.hint
            ) from None
    try:
        rig = rig.with_values(values)
    except InputError as error:
        raise InputError(f"truth: {error.message}", **recipe.at("truth"), hint=error.hint) from None

    def edge(edge: Edge, valve: Valve) -> Edge:
        if edge.law != "map":
            return edge
        nominal = float(rig.supply.flow_limit) / max(
            abs(float(valve.command_max)), abs(float(valve.command_min))
        )
        gain = edge.compensated_gain or edge.flow_gain
        law = (
            "orifice"
            if edge.compensated_gain is None and edge.flow_gain is not None
            else "compensated"
        )
        update = (
            {"law": law} if gain is not None else {"law": law, "compensated_gain": Value(nominal)}
        )
        return edge.model_copy(update=update)

    return rig.model_copy(
        update={
            "cylinder": tuple(
                c.model_copy(
                    update={
                        "valve": tuple(
                            v.model_copy(update={"edge": tuple(edge(e, v) for e in v.edge)})
                            for v in c.valve
                        )
                    }
                )
                for c in rig.cylinder
            )
        }
    )


def _check_names(recipe: BenchRecipe, names: Layout) -> None:
    for kind, allowed in (
        ("cylinder", names.cylinders),
        ("valve", names.valves),
        ("edge", names.edges),
        ("sensors", (*names.cylinders, "supply")),
    ):
        for name in getattr(recipe, kind):
            if name != "all" and name not in allowed:
                there = "there are all, " + ", ".join(allowed)
                raise InputError(
                    f"{kind}.{name}: the rig has no such {kind}",
                    **recipe.at(kind, name),
                    hint=there,
                )


def _curve(given: _Given, edge: Edge, valve: Valve, rng: np.random.Generator) -> np.record:
    """One direction of an edge. All draws are made whatever is given, so that giving one value
    leaves the others.
    """
    full = max(abs(float(valve.command_min)), abs(float(valve.command_max)))
    compensated = edge.law in ("compensated", "flow_control")
    low, high = (
        np.array([0.85, 0.03, 0.9, 0.97, 1.4, 1.2, 0.10]),
        np.array([1.1, 0.06, 1.4, 1.03, 2.0, 1.8, 0.18]),
    )
    onset, soft, sat, factor, setting, wide, force = rng.uniform(low, high)
    row = table(1, CURVE)[0]
    dead = float(edge.deadband)
    row.onset = given("onset", onset * dead if dead > 0 else 0.1 * soft * full)
    row.softness = given("softness", soft * full if compensated else 0.3 * soft * full)
    usual = sat * full if compensated else 1.6 * sat * full
    if edge.opening_max is not None:
        usual = float(edge.opening_max) - dead
    row.saturation = given("saturation", usual) or math.inf
    assert edge.gain is not None  # `_truth` sees to it
    gain = float(edge.gain) * given("gain_factor", factor)
    row.gain = gain
    if compensated:
        row.setting = given("compensation_drop", setting * float(edge.compensation_drop))
        row.gain = gain / math.sqrt(row.setting)
        row.wide_open = given("compensator_opening", wide * full)
        row.flow_force = given("flow_force", force / full)
    return row


def _set_edge(
    row: np.record, curves: np.recarray, given: _Given, item: tuple[str, Edge, Valve], rig: _Seeded
) -> None:
    """Fill an edge's row and its two curves."""
    name, edge, valve = item
    full = max(abs(float(valve.command_min)), abs(float(valve.command_max)))
    rng = _draws(rig.seed, name)
    row.sign, row.blocked, row.null_width = edge.sign, edge.reverse == "blocked", 0.05 * full
    curves[row.forward] = forward = _curve(given, edge, valve, rng)
    curves[row.reverse] = _curve(given.reverse(), edge, valve, rng)
    rated = forward.gain * full * math.sqrt(forward.setting or rig.p_supply)
    spool = len(valve.edge) > 1
    row.null = given("null_leakage", (1e-4 if spool else 1e-5) * rated / rig.p_supply)


def _set_unmetered(row: np.record, own: np.record, given: _Given, rng: np.random.Generator) -> None:
    """Fill the row of a pump or of a check valve: like the model's, and none like another."""
    for key, _ in (*pump.LAW.columns, *check.LAW.columns):
        row[key] = own[key]
    row.sign = own.sign
    size, second = rng.uniform([0.97, 0.7], [1.0, 1.4])
    size = given("gain_factor", size)
    row.displacement *= size
    row.gain *= size
    row.slip = given("null_leakage", second * own.slip)
    row.cracking_pressure *= second


def _tune(
    valve: Valve, row: np.record, curves: np.recarray, drop: float, width: float
) -> tuple[float, float]:
    """(gain, offset) of a driver turned until the rig file's calibration holds, the command coming
    up from rest.

    With one calibration point only the offset is turned; with more the first and the last hold.
    """
    points = sorted(
        (float(read_value(u, VOCABULARY["command"])), float(read_value(q, VOCABULARY["flow"])))
        for u, q in valve.calibration
    )

    def spool(flow: float) -> float:
        most = 4.0 * float(valve.command_max)
        if edge_flow(drop, row.sign * most, row, curves) < flow:
            raise InputError(
                f"valve '{valve.name}' of the bench never passes its calibration flow {flow:g} "
                "m^3/s"
            )
        return _spool_for(flow, drop, most, row, curves)

    ends = [(command - 0.5 * width, spool(flow)) for command, flow in (points[0], points[-1])]
    (u0, s0), (u1, s1) = ends
    gain = (s1 - s0) / (u1 - u0) if u1 > u0 else 1.0
    return gain, s0 - gain * u0


class Running(NamedTuple):
    """A virtual machine at work: its ``state``, memory included, its numbers, the ``tick`` [s] and
    the integration ``steps`` in it, and the scratch of both.
    """

    state: np.ndarray
    bench: VirtualPlant
    tick: float
    steps: int
    scratch: Scratch


@part_kernel
def _true_strokes(raw, row):
    """Write each cylinder's stroke [m] among the raw channels of the last tick into ``row``."""
    for c in range(row.shape[0]):
        row[c] = raw[_RAW * c + _STROKE]


@kernel
def _advance(first, stop, own, rows, law, noise):
    sample = rows.sample
    for i in range(first, stop):
        if law is not None:
            control(law, i, rows)
        if violated(rows, i):
            return i
        for j in range(sample.shape[0]):
            rows.samples[i, j] = sample[j]
        _true_strokes(own.scratch.raw, rows.truth[i])
        bench_tick(
            own.state,
            rows.commands[i],
            own.bench,
            own.tick,
            own.steps,
            own.scratch,
            noise[i - first],
            sample,
        )
    return -1


class TrueStrokes:
    """The strokes of a running bench as they are, without its sensors."""

    def __init__(self, own: Running) -> None:
        self._own, self.width = own, own.bench.cylinders.shape[0]

    def read(self, command: np.ndarray, row: np.ndarray) -> None:
        """As `Hidden.read`."""
        row[:] = self._own.scratch.raw[_STROKE : _RAW * self.width : _RAW]


class VirtualMachine:
    """The virtual bench behind the protocol of a real machine.

    ``channels`` names the sample's entries, ``rate`` [Hz] the ticks a second. ``start`` puts it at
    rest in a posture and gives the first sample; ``tick`` lets a command [V] act for one tick and
    gives the next.

    Args:
        rig: the machine as its rig file has it.
        recipe: the bench file, or None for a plausible bench of that rig.
        payload: a payload of the rig file.
        rate: [Hz].
        step: integration step [s].
        seed: of the sensors' noise.

    Raises:
        InputError: the bench file names what the rig has not; no such payload.
    """

    name = NAME

    def __init__(
        self,
        rig: Rig,
        recipe: BenchRecipe | None = None,
        payload: str | None = None,
        rate: float = 1000.0,
        step: float = STEP,
        seed: int = 0,
    ) -> None:
        recipe = recipe or BenchRecipe(stage="bench", rig="")
        self.model = Model.of(_truth(recipe, rig), None, payload)
        self.rig, self.rate, self.seed = rig, float(rate), seed
        self.latency = float(recipe.delay)
        names = self.layout = self.model.layout
        self.channels, self.commands = sample_channels(names.cylinders), Inputs.of(self.model)
        _check_names(recipe, names)
        self.bench = _build(recipe, self.model, 1.0 / self.rate)
        self.strokes = self.bench.cylinders.stroke.copy()
        self.steps = max(1, round(1.0 / (self.rate * step)))
        at = self.bench.at
        self.size, self.raw = at.states, at.channels
        self.state = np.zeros(at.size)
        self._own = self._at_rest()
        self.hidden = TrueStrokes(self._own)
        self._rng = self._new_noise()
        self._noise, self._used = np.empty((0, self.raw)), 0

    @classmethod
    def of(cls, recipe: TrialRecipe, rig: Rig, maps: Maps | None) -> VirtualMachine:
        """The virtual bench that a trial runs on; measured maps are none of its business.

        Raises:
            InputError: no bench file, or one of other cylinders or valves than the rig's.
        """
        given = {"payload": recipe.payload, "rate": float(recipe.rate), "seed": recipe.seed}
        if recipe.bench is None:
            return cls(rig, None, **given)
        bench = load_recipe(recipe.file(recipe.bench))
        if not isinstance(bench, BenchRecipe):
            raise InputError(
                "is no bench file", file=bench.path, hint='a bench file has stage = "bench"'
            )
        own = load_rig(bench.file(bench.rig)).with_dynamics(recipe.dynamics)
        for what, mine, its in (
            ("cylinders", [c.name for c in rig.cylinder], [c.name for c in own.cylinder]),
            ("valves", layout(rig).valves, layout(own).valves),
        ):
            if mine != its:
                raise InputError(
                    f"the bench of rig '{own.name}' has other {what} than rig '{rig.name}'",
                    **recipe.at("bench"),
                    hint=f"the bench has {', '.join(its)}",
                )
        return cls(own, bench, **given)

    def seeded(self, seed: int) -> VirtualMachine:
        """The same machine, not started, with other noise of its sensors."""
        other = copy(self)
        other.seed, other.state = seed, np.zeros_like(self.state)
        other._own = other._at_rest()
        other.hidden = TrueStrokes(other._own)
        other._rng = other._new_noise()
        other._noise, other._used = np.empty((0, self.raw)), 0
        return other

    def _at_rest(self) -> Running:
        scratch = scratch_of(self.bench, 1.0 / self.rate)
        return Running(self.state, self.bench, 1.0 / self.rate, self.steps, scratch)

    def _new_noise(self) -> np.random.Generator:
        return np.random.default_rng([self.seed, crc32(b"noise")])

    def noise(self, ticks: int) -> np.ndarray:
        """The next ``ticks`` rows of the sensors' noise, shape (ticks, raw channels)."""
        left = self._noise[self._used :]
        if len(left) < ticks:
            fresh = self._rng.standard_normal((max(ticks - len(left), NOISE_ROWS), self.raw))
            self._noise, self._used = np.concatenate([left, fresh]), 0
        self._used += ticks
        return self._noise[self._used - ticks : self._used]

    def check_posture(self, posture: Posture) -> None:
        """As `Machine.check_posture`."""
        self.model.posture(posture)

    def carry(self, payload: str | None) -> None:
        """As `carry_of` says."""
        self.bench.links[:] = self.model.links(payload)

    def start(self, posture: Posture = None, low_side: float | None = None) -> np.ndarray:
        """As `Machine.start`; the unloaded chambers begin to settle at ``low_side``."""
        self.bench.links[:] = links_of(self.model.rig)
        self._rng, self._used = self._new_noise(), len(self._noise)
        bench, at, state = self.bench, self.bench.at, self.state
        rest = self.commands.rest
        state[:] = 0.0
        state[: at.pump] = self.model.trim(self.model.posture(posture), low_side)
        state[at.sensed] = state[at.supply]
        state[at.hysteresis : at.lags] = rest
        for index, (valve, command) in enumerate(zip(bench.valves, rest, strict=True)):
            target = valve.gain * command + valve.offset
            valve_settle(valve, target, bench, state)
            self._own.scratch.line.past[:, index] = target
        _raw(state[: at.states], bench, state[at.lags : at.filters])
        for c in range(len(self.layout.cylinders)):
            k = at.filters + _FILTER * c
            state[[k, k + 2]] = state[at.lags + _RAW * c + RAW.index(OF.x)]
        sample = np.zeros(len(self.channels))
        for _ in range(max(round(SETTLE * self.rate), bench.delay + 3)):
            self._tick(rest, sample)
        self._must_be_finite()
        return sample

    def tick(self, command: np.ndarray) -> np.ndarray:
        """As `Machine.tick`."""
        sample = np.zeros(len(self.channels))
        self._tick(np.asarray(command, dtype=float), sample)
        self._must_be_finite()
        return sample

    def _tick(self, command: np.ndarray, sample: np.ndarray) -> None:
        own = self._own
        noise = self.noise(1)[0]
        bench_tick(
            own.state,
            command,
            own.bench,
            own.tick,
            own.steps,
            own.scratch,
            noise,
            sample,
        )

    def advance(self, rows: Rows, law: Controls | None, often: bool) -> Advance:
        """As `advance_of` says."""
        own = self._own
        run = bound(_advance, 0, 0, own, rows, law, self._noise) if often else _advance

        def through(first: int, stop: int) -> int:
            row = run(first, stop, own, rows, law, self.noise(stop - first))
            if row >= 0:  # noise that no tick used is the next one's, however long the call was
                self._used -= stop - row
            return row

        return through

    def close(self) -> None:
        """There is nothing to let go."""

    def _must_be_finite(self) -> None:
        if not np.isfinite(self.state).all():
            raise SimulationError(
                "the virtual bench left finite numbers", hint="take a smaller step"
            )

    def static_flow(self, edge: str, command: np.ndarray, drop: np.ndarray) -> np.ndarray:
        """Flow [m³/s] that an edge passes at rest at commands [V], each approached from the valve's
        rest, and drops [Pa].

        Raises:
            InputError: no such edge.
        """
        if edge not in self.layout.edges:
            raise InputError(
                f"the bench has no edge '{edge}'", hint="it has " + ", ".join(self.layout.edges)
            )
        index = self.layout.edges.index(edge)
        row = self.bench.edges[index]
        if row.law in (PUMP, CHECK):
            raise InputError(f"edge '{edge}' of the bench does not meter, so no flowmeter reads it")
        valve: Any = self.bench.valves[row.valve]
        rest = self.commands.rest[row.valve]
        command, drop = np.broadcast_arrays(
            np.asarray(command, dtype=float), np.asarray(drop, dtype=float)
        )
        flows = []
        for u, dp in zip(command.ravel(), drop.ravel(), strict=True):
            spool = valve.gain * play(rest, u, valve.hysteresis) + valve.offset
            flows.append(edge_flow(dp, spool, row, self.bench.curves))
        return np.array(flows).reshape(command.shape)


class _Seeded(NamedTuple):
    """What a bench is drawn for."""

    recipe: BenchRecipe
    model: Model
    seed: int
    p_supply: float


def _build(recipe: BenchRecipe, model: Model, tick: float) -> VirtualPlant:
    """The compiled form of a bench whose truth ``model`` is."""
    plant = model.plant
    of = _Seeded(recipe, model, recipe.seed, float(model.rig.supply.pressure))
    edges, curves = _edges(of)
    valves, elements = _valves(of, edges, curves)
    ticks = float(recipe.delay) / tick
    omega, zeta = 2 * math.pi * float(recipe.velocity_cutoff), float(recipe.velocity_damping)
    return VirtualPlant(
        kind=plant.kind,
        gravity=plant.gravity,
        links=plant.links,
        cylinders=_bench_cylinders(of),
        nodes=plant.nodes,
        valves=valves,
        elements=elements,
        edges=edges,
        curves=curves,
        supply=plant.supply,
        forces=plant.forces,
        lines=_lines(of),
        fluid=_fluid(of),
        sensors=_sensors(of),
        delay=math.floor(ticks),
        share=ticks - math.floor(ticks),
        speed=_speed_filter(omega, zeta, tick),
        at=_offsets(model.layout, math.floor(ticks) + 2),
    )


def _copied(rows: np.recarray, columns: np.dtype) -> np.recarray:
    """The rows of a table in a wider layout."""
    wide = table(rows.shape[0], columns)
    for name in rows.dtype.names or ():
        wide[name] = rows[name]
    return wide


def _bench_cylinders(of: _Seeded) -> np.recarray:
    recipe, p_supply = of.recipe, of.p_supply
    cylinders = of.model.plant.cylinders.copy()
    names, items = of.model.layout.cylinders, of.model.rig.cylinder
    for name, item, row in zip(names, items, cylinders, strict=True):
        given = _Given(recipe.cylinder, name)
        force = p_supply * row.area_head
        rng = _draws(of.seed, name)
        coulomb, static, viscous, speed = rng.uniform(
            [0.004, 1.4, 0.015, 0.006], [0.007, 1.8, 0.03, 0.012]
        )
        plain, damper = float(item.friction_coulomb), float(item.friction_viscous)
        row.friction_coulomb = given("friction_coulomb", plain or coulomb * force)
        row.friction_static = given(
            "friction_static", row.friction_static or static * row.friction_coulomb
        )
        row.friction_viscous = given("friction_viscous", damper or viscous * force)
        row.stribeck_speed = given("stribeck_speed", row.stribeck_speed or speed)
        if row.friction_static < row.friction_coulomb:
            where = recipe.at("cylinder", name)
            raise InputError(
                f"cylinder.{name}: friction_static must not lie below friction_coulomb", **where
            )
        for key in ("leakage_internal", "leakage_head", "leakage_rod"):
            if f"{name}.{key}" not in recipe.truth and row[key] == 0.0:
                typical = 1e-4 if key == "leakage_internal" else 1e-5
                row[key] = rng.uniform(0.5, 1.5) * typical * row.area_head / p_supply
        if _air(of)[0] > 0.0:
            row.cavitation_pressure = -math.inf  # the air itself keeps a chamber above vacuum
    return cylinders


def _lines(of: _Seeded) -> np.recarray:
    """The model's lines, full of the bench's oil."""
    lines = of.model.plant.lines.copy()
    lines.air, lines.polytropic = _air(of)
    if lines.size and _air(of)[0] > 0.0:
        lines.cavitation_pressure = -math.inf
    return lines


def _edges(of: _Seeded) -> tuple[np.recarray, np.recarray]:
    """(edges, their curves)."""
    plant, names = of.model.plant, of.model.layout.edges
    edges, curves = table(len(names), BENCH_EDGE), table(2 * len(names), CURVE)
    metering = [(edge, valve) for _, valve, edge in of.model.rig.edges()]
    for index, name in enumerate(names):
        row, own, given = edges[index], plant.edges[index], _Given(of.recipe.edge, name)
        for key in ("from_node", "to_node", "valve", "law"):
            row[key] = own[key]
        row.forward, row.reverse = 2 * index, 2 * index + 1
        if own.law in (PUMP, CHECK):
            _set_unmetered(row, own, given, _draws(of.seed, name))
        else:
            _set_edge(row, curves, given, (name, *metering[index]), of)
    return edges, curves


def _valves(
    of: _Seeded, edges: np.recarray, curves: np.recarray
) -> tuple[np.recarray, np.recarray]:
    """(valves with their drivers, the elements of their dynamics)."""
    recipe, rig = of.recipe, of.model.rig
    valves = _copied(of.model.plant.valves, BENCH_VALVE)
    elements = of.model.plant.elements.copy()
    for index, (name, (_, valve)) in enumerate(
        zip(of.model.layout.valves, rig.valves(), strict=True)
    ):
        row = valves[index]
        given, rng = _Given(recipe.valve, name), _draws(of.seed, name)
        full = max(abs(float(valve.command_min)), abs(float(valve.command_max)))
        width, gain, offset, faster, damper = rng.uniform(
            [0.002, 0.97, -0.003, 0.93, 0.9], [0.006, 1.03, 0.003, 1.07, 1.1]
        )
        row.hysteresis = given("hysteresis", width * full)
        if valve.calibration:
            own: Any = edges[np.flatnonzero(edges.valve == index)[0]]
            drop = float(recipe.calibration_drop)
            gain, offset = _tune(valve, own, curves, drop, row.hysteresis)
            offset /= full
        row.gain, row.offset = given("driver_gain", gain), given("driver_offset", offset * full)
        series = [one for one in of.model.layout.elements if one.valve == index]
        for at, one in enumerate(series, int(row.first)):
            dynamics = rig.dynamics[one.dynamics]
            if not isinstance(dynamics, SecondOrder):
                continue
            omega, zeta = dynamics.frequency_and_damping()
            omega = given("natural_frequency", faster * omega)
            zeta = given("damping_ratio", damper * zeta)
            for key, value in second_order(omega, zeta).items():
                elements[at][key] = value
    return valves, elements


def _air(of: _Seeded) -> tuple[float, float]:
    """(share of free air, its exponent): the bench file's, else the rig's, else usual ones."""
    recipe, oil = of.recipe, of.model.rig.oil
    given = [
        getattr(oil, key) if key not in recipe.model_fields_set else None
        for key in ("air_fraction", "polytropic_exponent")
    ]
    share, exponent = given
    return float(share or recipe.air_fraction), float(exponent or recipe.polytropic_exponent)


def _fluid(of: _Seeded) -> np.record:
    recipe, row = of.recipe, table(1, FLUID)[0]
    droop, relief = _scalar(recipe.droop), _scalar(recipe.supply_relief)
    row.air, row.polytropic = _air(of)
    row.droop = 0.03 * of.p_supply if droop is None else droop
    row.pump_lag = float(recipe.pump_lag)
    usual = math.inf if of.model.rig.supply.accumulator is not None else 1.15 * of.p_supply
    row.supply_relief = usual if relief is None else relief
    if row.pump_lag > 0.0 and row.droop == 0.0:
        hint = "give droop, or pump_lag = '0 s' for an ideal one"
        raise InputError("a pump with a lag needs a droop", **recipe.at("droop"), hint=hint)
    return row


def _sensors(of: _Seeded) -> np.recarray:
    """Lag, noise, resolution and zero offset of every raw channel."""
    slide = of.model.rig.mechanism.kind == "slide"
    rows: list[tuple[float, ...]] = []
    for name in (*of.model.layout.cylinders, "supply"):
        given, rng = _Given(of.recipe.sensors, name), _draws(of.seed, f"sensors {name}")
        step = given("position_resolution", 2.54e-5)
        position = (0.0, given("position_noise", 0.2 * step), step, 0.0)
        counts = given("encoder_counts", 4096)
        turn = 2 * math.pi / counts if counts else 0.0
        angle = position if slide else (0.0, 0.1 * turn, turn, 0.0)
        resolution = given("pressure_resolution", of.p_supply / 2048)
        lag = given("pressure_lag", 5.3e-5)
        noise = given("pressure_noise", 5e-4 * of.p_supply)
        spread = given("pressure_offset", 1e-3 * of.p_supply)
        zeros = np.clip(rng.standard_normal(2), -2, 2) * spread
        both = [(lag, noise, resolution, float(zero)) for zero in zeros]
        rows += both if name == "supply" else [angle, position, *both]
    sensors = table(len(rows), SENSOR)
    sensors[:] = rows
    return sensors


def _speed_filter(omega: float, zeta: float, tick: float) -> np.ndarray:
    """Numbers of `_follow`: the 2 × 2 transition over a tick, row by row, the tick [s], and the lag
    2 ζ/ω [s] on a ramp.
    """
    root = complex(zeta * zeta - 1.0) ** 0.5
    if abs(root) < 1e-6:
        root = complex(1e-6)
    first, second = omega * (-zeta + root), omega * (-zeta - root)
    grow, fall = np.exp(first * tick), np.exp(second * tick)
    rows = [
        first * fall - second * grow,
        grow - fall,
        first * second * (fall - grow),
        first * grow - second * fall,
    ]
    return np.array([*np.real(np.array(rows) / (first - second)), tick, 2 * zeta / omega])
