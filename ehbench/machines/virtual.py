"""The virtual bench: a separate, richer plant that plays the machine; only trials and datasets may
import it.

It shares the arm, the cylinder's geometry and the friction kernel with the model, and has its own
laws for all that a model leaves out: air in the oil, leakage, Stribeck friction, valves that are no
two alike, hysteresis, a pump that droops, and sensors that are late, noisy and coarse. Its
parameters are read by nothing but itself.

State, one flat array: ``q, qd, [p_head, p_rod] per cylinder, spool per valve, spool rate per valve,
p_supply, pump flow``; then memory: hysteresis per valve, sensor lags per raw channel, speed filter
(3) per cylinder, delay line, its position. Raw channels: ``q, x, p_head, p_rod`` of each cylinder,
then ``p_supply, p_tank``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from ehbench.compiled import kernel
from ehbench.errors import InputError, SimulationError
from ehbench.physics.arm import forward, work_size
from ehbench.physics.cylinder import chamber_rates, chamber_volume, end_stop, linkage, relief_flow
from ehbench.physics.friction import stribeck
from ehbench.physics.metering import ORIFICE_DROP
from ehbench.physics.supply import BULK as SUPPLY_BULK
from ehbench.physics.supply import FLOW_LIMIT, P_SET, P_TANK, VOLUME, pump_flow
from ehbench.plant import (
    AREA_HEAD,
    AREA_ROD,
    BULK,
    COULOMB,
    CYLINDER_FLOATS,
    DAMPING,
    FLOOR,
    GEOMETRY,
    HIGHEST,
    L_A,
    L_B,
    LEAK_HEAD,
    LEAK_INTERNAL,
    LEAK_ROD,
    LOWEST,
    MOBILITY,
    PHASE,
    RELIEF,
    RELIEF_GAIN,
    RETRACTED,
    SIDE,
    STIFFNESS,
    STOP,
    STOP_DISSIPATION,
    STROKE,
    TANK,
    VALVE_FLOATS,
    VISCOUS,
    VOLUME_HEAD,
    VOLUME_ROD,
    Layout,
    layout,
)
from ehbench.quantities import VOCABULARY
from ehbench.recipe import BenchRecipe, TrialRecipe, load_recipe, load_rig
from ehbench.rig import Edge, Rig, Value, Valve, read_value
from ehbench.machines.protocol import Inputs, Posture, sample_channels
from ehbench.machines.rows import LawRows, Rows, control, violated
from ehbench.simulation import Maps, Model

NAME = "virtual bench"
STEP = 2.5e-4  # [s]
STIFF = 1.0
MOST_SUBSTEPS = 400
ATMOSPHERE = 101325.0
CREEP = 1.0e-3  # [m/s]: over which friction turns round
NOISE_ROWS = 256  # drawn at a time
SETTLE = 0.25  # [s] of rest before t = 0, so that lags and delays have filled

# columns of a cylinder's row after those of the model
STATIC, STRIBECK_SPEED = CYLINDER_FLOATS, CYLINDER_FLOATS + 1
# columns of a valve's row after those of the model
DRIVER_GAIN, DRIVER_OFFSET, HYSTERESIS = VALVE_FLOATS, VALVE_FLOATS + 1, VALVE_FLOATS + 2
# columns of an edge: SIGN, NULL, NULL_WIDTH, BLOCKED, then one curve forward and one in reverse
E_SIGN, NULL, NULL_WIDTH, E_BLOCKED, CURVE = 0, 1, 2, 3, 4
ONSET, SOFTNESS, SATURATION, E_GAIN, SETTING, WIDE_OPEN, FLOW_FORCE = range(7)
CURVE_FLOATS = 7
# columns of a sensor's row
LAG, NOISE, RESOLUTION, ZERO = 0, 1, 2, 3
# fluid: air fraction, polytropic exponent; pump: droop, lag, relief of the supply line
AIR, POLYTROPIC, DROOP, PUMP_LAG, SUPPLY_RELIEF = range(5)


class VirtualPlant(NamedTuple):
    """A bench as flat arrays. ``timing``: whole ticks of delay, rest of it as a share of a tick;
    ``speed`` the speed filter.
    """

    kind: int
    gravity: np.ndarray
    links: np.ndarray
    joints: np.ndarray
    cylinders: np.ndarray
    valves: np.ndarray
    edges: np.ndarray
    wiring: np.ndarray
    supply: np.ndarray
    extra: np.ndarray
    sensors: np.ndarray
    timing: np.ndarray
    speed: np.ndarray


# --- laws
# ------------------------------------------------------------------------------------------


@kernel
def bulk(pressure, solid, air, exponent):
    """Bulk modulus [Pa] of oil with free air: ``1/β = 1/β_solid + α/(n p) (p0/p)^(1/n)``, p
    absolute.

    The air is compressed polytropically from its share α at atmospheric pressure p0, so a chamber
    gets softer as its pressure falls and cannot be drawn below vacuum."""
    if air == 0.0:
        return solid
    p = max(pressure + ATMOSPHERE, 500.0)
    return 1.0 / (1.0 / solid + air / (exponent * p) * (ATMOSPHERE / p) ** (1.0 / exponent))


@kernel
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


@kernel
def curve_flow(drop, spool, row, at):
    """Flow [m³/s] at drop ≥ 0 through the curve that begins at ``row[at]``.

    Orifice: ``γ a √Δp``. Behind a pressure compensator, the metering drop p_m that the spool holds
    obeys ``p_m = setting − κ a √Δp √p_m`` (spring against flow force, which grows with flow and
    with the drop taken), and cannot exceed what the wide open compensator in series leaves, ``Δp/(1
    + (a/a_c)²)``; the two blend by a fourth power."""
    a = opening_area(spool - row[at + ONSET], row[at + SOFTNESS], row[at + SATURATION])
    if a == 0.0:
        return 0.0
    p = drop
    if row[at + SETTING] > 0.0:
        share = a / row[at + WIDE_OPEN]
        p = drop / (1.0 + share * share)
        b = row[at + FLOW_FORCE] * a * math.sqrt(drop)
        root = 0.5 * (math.sqrt(b * b + 4.0 * row[at + SETTING]) - b)
        ratio = p / (root * root)
        ratio *= ratio
        p /= math.sqrt(math.sqrt(1.0 + ratio * ratio))
    return row[at + E_GAIN] * a * p / math.sqrt(math.sqrt(p * p + ORIFICE_DROP * ORIFICE_DROP))


@kernel
def edge_flow(drop, spool, row):
    """Flow [m³/s] along an edge at a drop [Pa] of either sign and a spool position [V], null
    leakage included.
    """
    reach = row[E_SIGN] * spool
    closed = reach / row[NULL_WIDTH]
    flow = row[NULL] * drop / (1.0 + closed * closed)
    if drop >= 0.0:
        return flow + curve_flow(drop, reach, row, CURVE)
    if row[E_BLOCKED] != 0.0:
        return 0.0
    return flow - curve_flow(-drop, reach, row, CURVE + CURVE_FLOATS)


@kernel
def play(memory, value, width):
    """Backlash of ``width``: where the output goes from ``memory`` when the input is ``value``."""
    return min(max(memory, value - 0.5 * width), value + 0.5 * width)


@kernel
def derivatives(y, target, bench, dy, work):
    """Write ẏ of the bench's continuous states into ``dy``; return the fastest rate [1/s] of the
    stiff blocks.

    ``target`` [V] is where each driver wants its spool, shape (valves,).
    """
    n, nc, nv, ne = (
        bench.links.shape[0],
        bench.cylinders.shape[0],
        bench.valves.shape[0],
        bench.edges.shape[0],
    )
    at_p = 2 * n
    at_open = at_p + 2 * nc
    at_rate = at_open + nv
    at_supply = at_rate + nv
    torque_at = work_size(n)
    net_at = torque_at + n
    slope_at = net_at + 2 + 2 * nc
    end = slope_at + 2 + 2 * nc
    fastest = 0.0
    for i in range(nv):
        k, rate = bench.valves[i, STIFFNESS], y[at_rate + i]
        dy[at_open + i] = rate
        dy[at_rate + i] = k * (target[i] - y[at_open + i]) - bench.valves[i, DAMPING] * rate
        fastest = max(fastest, k)
    fastest = math.sqrt(fastest)
    for i in range(net_at, end):
        work[i] = 0.0
    p_tank = bench.supply[P_TANK]
    for e in range(ne):
        a, b, i = bench.wiring[e, 0], bench.wiring[e, 1], bench.wiring[e, 2]
        spool = target[i] if bench.valves[i, STIFFNESS] == 0.0 else y[at_open + i]
        p_a = y[at_supply] if a == 0 else (p_tank if a == TANK else y[at_p + a - 2])
        p_b = y[at_supply] if b == 0 else (p_tank if b == TANK else y[at_p + b - 2])
        drop = p_a - p_b
        flow = edge_flow(drop, spool, bench.edges[e])
        if flow != 0.0:
            work[net_at + a] -= flow
            work[net_at + b] += flow
            work[slope_at + a] += flow / drop
            work[slope_at + b] += flow / drop
    for i in range(n):
        dy[i] = y[n + i]
        work[torque_at + i] = 0.0
    air, exponent = bench.extra[AIR], bench.extra[POLYTROPIC]
    for c in range(nc):
        row = bench.cylinders[c]
        j = bench.joints[c]
        p_head, p_rod = y[at_p + 2 * c], y[at_p + 2 * c + 1]
        x, lever, _ = linkage(
            int(row[GEOMETRY]), row[L_A], row[L_B], row[SIDE], row[PHASE], row[RETRACTED], y[j]
        )
        v = lever * y[n + j]
        volume_head = chamber_volume(row[VOLUME_HEAD], row[AREA_HEAD] * x)
        volume_rod = chamber_volume(row[VOLUME_ROD], -row[AREA_ROD] * x)
        bulk_head, bulk_rod = (
            bulk(p_head, row[BULK], air, exponent),
            bulk(p_rod, row[BULK], air, exponent),
        )
        head_in = work[net_at + 2 + 2 * c] - relief_flow(p_head, row[RELIEF], RELIEF_GAIN)
        rod_out = -work[net_at + 3 + 2 * c] + relief_flow(p_rod, row[RELIEF], RELIEF_GAIN)
        dy[at_p + 2 * c], dy[at_p + 2 * c + 1] = chamber_rates(
            v,
            head_in,
            rod_out,
            p_head,
            p_rod,
            p_tank,
            bulk_head,
            bulk_rod,
            volume_head,
            volume_rod,
            row[AREA_HEAD],
            row[AREA_ROD],
            row[LEAK_INTERNAL],
            row[LEAK_HEAD],
            row[LEAK_ROD],
            row[FLOOR],
        )
        fastest = max(fastest, bulk_head / volume_head * work[slope_at + 2 + 2 * c])
        fastest = max(fastest, bulk_rod / volume_rod * work[slope_at + 3 + 2 * c])
        force = p_head * row[AREA_HEAD] - p_rod * row[AREA_ROD]
        force -= stribeck(v, row[VISCOUS], row[COULOMB], row[STATIC], row[STRIBECK_SPEED], CREEP)
        steep = 0.0 if abs(v) > 4.0 * CREEP else row[STATIC] / CREEP
        fastest = max(fastest, row[MOBILITY] * (steep + row[VISCOUS]))
        if x < 0.0 or x > row[STROKE]:
            force += end_stop(x, v, row[STROKE], row[STOP], STOP_DISSIPATION)
            fastest = max(fastest, 2.0 * math.sqrt(row[MOBILITY] * row[STOP]))
        work[torque_at + j] = lever * force
    forward(
        bench.kind,
        bench.links,
        bench.gravity,
        y[:n],
        y[n : 2 * n],
        work[torque_at : torque_at + n],
        dy[n : 2 * n],
        work,
    )

    p, demand = y[at_supply], -work[net_at]
    stiffness = bench.supply[SUPPLY_BULK] / bench.supply[VOLUME]
    if bench.extra[PUMP_LAG] == 0.0:  # the model's ideal compensator
        dy[at_supply] = stiffness * (pump_flow(p, demand, bench.supply) - demand)
        dy[at_supply + 1] = 0.0
        return fastest
    stroke = min(max((bench.supply[P_SET] - p) / bench.extra[DROOP], 0.0), 1.0)
    dy[at_supply + 1] = (bench.supply[FLOW_LIMIT] * stroke - y[at_supply + 1]) / bench.extra[
        PUMP_LAG
    ]
    spilt = relief_flow(p, bench.extra[SUPPLY_RELIEF], RELIEF_GAIN)
    dy[at_supply] = stiffness * (y[at_supply + 1] - demand - spilt)
    pumping = math.sqrt(
        stiffness * bench.supply[FLOW_LIMIT] / (bench.extra[DROOP] * bench.extra[PUMP_LAG])
    )
    return max(fastest, stiffness * work[slope_at], pumping)


@kernel
def continuous_states(n, cylinders, valves):
    """How many of the bench's states are integrated."""
    return 2 * n + 2 * cylinders + 2 * valves + 2


@kernel
def workspace_size(n, cylinders):
    """Length of the float64 workspace of `bench_tick`."""
    return work_size(n) + n + 2 * (2 + 2 * cylinders)


@kernel
def _raw(y, bench, raw):
    """What the sensors would say were they perfect, in the order of the raw channels."""
    n, nc = bench.links.shape[0], bench.cylinders.shape[0]
    for c in range(nc):
        row = bench.cylinders[c]
        q = y[bench.joints[c]]
        x, _, _ = linkage(
            int(row[GEOMETRY]), row[L_A], row[L_B], row[SIDE], row[PHASE], row[RETRACTED], q
        )
        raw[4 * c] = q
        raw[4 * c + 1] = x
        raw[4 * c + 2] = y[2 * n + 2 * c]
        raw[4 * c + 3] = y[2 * n + 2 * c + 1]
    raw[4 * nc] = y[2 * n + 2 * nc + 2 * bench.valves.shape[0]]
    raw[4 * nc + 1] = bench.supply[P_TANK]


@kernel
def _follow(a, b, before, z, speed):
    """One tick of the filter ``s ω²/(s² + 2 ζ ω s + ω²)``, exact for an input that runs straight
    from ``before`` to ``z``.

    ``a`` and ``b`` are the smoothed input and its slope, ``speed`` what `_speed_filter` gives;
    returns the new (a, b)."""
    slope = (z - before) / speed[4]
    behind = speed[5] * slope  # how far the filter trails a steady ramp
    e, f = a - before + behind, b - slope
    return z - behind + speed[0] * e + speed[1] * f, slope + speed[2] * e + speed[3] * f


@kernel
def _measure(state, bench, memory, noise_row, sample):
    """Noise, offset and quantization of the lagged channels, then the delay line, then speed from
    position.
    """
    nc = bench.cylinders.shape[0]
    channels = 4 * nc + 2
    lags = memory + bench.valves.shape[0]
    filters = lags + channels
    ring = filters + 3 * nc
    depth = int(bench.timing[0]) + 2
    place = int(state[ring + depth * channels])
    for i in range(channels):
        value = state[lags + i] + bench.sensors[i, ZERO] + bench.sensors[i, NOISE] * noise_row[i]
        if bench.sensors[i, RESOLUTION] > 0.0:
            value = bench.sensors[i, RESOLUTION] * math.floor(
                value / bench.sensors[i, RESOLUTION] + 0.5
            )
        state[ring + place * channels + i] = value
    late = (place - int(bench.timing[0]) + depth) % depth
    later = (late - 1 + depth) % depth
    share = bench.timing[1]
    state[ring + depth * channels] = (place + 1) % depth
    for c in range(nc):
        row = bench.cylinders[c]
        for i in range(4):
            at = 4 * c + i
            value = (1.0 - share) * state[ring + late * channels + at] + share * state[
                ring + later * channels + at
            ]
            sample[6 * c + (0, 2, 4, 5)[i]] = value
        z, at = sample[6 * c + 2], filters + 3 * c
        state[at], state[at + 1] = _follow(state[at], state[at + 1], state[at + 2], z, bench.speed)
        state[at + 2] = z
        sample[6 * c + 3] = state[at + 1]
        _, lever, _ = linkage(
            int(row[GEOMETRY]),
            row[L_A],
            row[L_B],
            row[SIDE],
            row[PHASE],
            row[RETRACTED],
            sample[6 * c],
        )
        sample[6 * c + 1] = state[at + 1] / lever if abs(lever) > 1.0e-3 else 0.0
    for i in range(2):
        at = 4 * nc + i
        sample[6 * nc + i] = (1.0 - share) * state[ring + late * channels + at] + share * state[
            ring + later * channels + at
        ]


@kernel
def bench_tick(state, command, bench, tick, steps, scratch, work, noise_row, sample):
    """Let ``command`` act for one tick, in place, then write what the machine measures into
    ``sample``.

    Args:
        state: the whole state of the bench, memory included.
        command: [V], shape (valves,), limited to each driver's range.
        tick: [s].
        steps: integration steps a tick; more substeps are taken where the bench is stiff.
        scratch: float64 (6, continuous states or raw channels, whichever is more).
        work: float64 workspace of `workspace_size`.
        noise_row: standard normal numbers, shape (raw channels,).
        sample: out, shape (6·cylinders + 2,).
    """
    n, nc, nv = bench.links.shape[0], bench.cylinders.shape[0], bench.valves.shape[0]
    size, channels = continuous_states(n, nc, nv), 4 * nc + 2
    y, lags = state[:size], size + nv
    target, raw = scratch[5, channels : channels + nv], scratch[5, :channels]
    for i in range(nv):
        u = min(max(command[i], bench.valves[i, LOWEST]), bench.valves[i, HIGHEST])
        state[size + i] = play(state[size + i], u, bench.valves[i, HYSTERESIS])
        target[i] = bench.valves[i, DRIVER_GAIN] * state[size + i] + bench.valves[i, DRIVER_OFFSET]
    h = tick / steps
    for _ in range(steps):
        rate = derivatives(y, target, bench, scratch[0], work)
        substeps = 1
        if rate * h > STIFF:
            substeps = min(MOST_SUBSTEPS, int(math.ceil(rate * h / STIFF)))
        d = h / substeps
        for s in range(substeps):
            if s > 0:
                derivatives(y, target, bench, scratch[0], work)
            for i in range(size):
                scratch[4, i] = y[i] + 0.5 * d * scratch[0, i]
            derivatives(scratch[4, :size], target, bench, scratch[1], work)
            for i in range(size):
                scratch[4, i] = y[i] + 0.5 * d * scratch[1, i]
            derivatives(scratch[4, :size], target, bench, scratch[2], work)
            for i in range(size):
                scratch[4, i] = y[i] + d * scratch[2, i]
            derivatives(scratch[4, :size], target, bench, scratch[3], work)
            for i in range(size):
                y[i] += (
                    d
                    / 6.0
                    * (scratch[0, i] + 2.0 * (scratch[1, i] + scratch[2, i]) + scratch[3, i])
                )
        _raw(y, bench, raw)
        for i in range(channels):
            lag = bench.sensors[i, LAG]
            keep = math.exp(-h / lag) if lag > 0.0 else 0.0
            state[lags + i] = raw[i] + keep * (state[lags + i] - raw[i])
    _measure(state, bench, size, noise_row, sample)


# --- putting a bench together
# ------------------------------------------------------------------------------------------


def _scalar(value) -> float | None:
    return None if value is None else float(value)


class _Given:
    """What a bench file says of one thing: its own entry, else that of ``all``, else a default."""

    def __init__(self, table: Mapping[str, Any], name: str) -> None:
        self.entries = [table[key] for key in (name, "all") if key in table]

    def __call__(self, key: str, default: float) -> float:
        for entry in self.entries:
            value = _scalar(getattr(entry, key))
            if value is not None:
                return value
        return default

    def reverse(self) -> _Given:
        found = _Given({}, "")
        found.entries = [entry.reverse for entry in self.entries]
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
    for table, allowed in (
        ("cylinder", names.cylinders),
        ("valve", names.valves),
        ("edge", names.edges),
        ("sensors", (*names.cylinders, "supply")),
    ):
        for name in getattr(recipe, table):
            if name != "all" and name not in allowed:
                there = "there are all, " + ", ".join(allowed)
                raise InputError(
                    f"{table}.{name}: the rig has no such {table}",
                    **recipe.at(table, name),
                    hint=there,
                )


def _curve(given: _Given, edge: Edge, valve: Valve, rng: np.random.Generator) -> np.ndarray:
    """One direction of an edge. All draws are made whatever is given, so that giving one value
    leaves the others.
    """
    full = max(abs(float(valve.command_min)), abs(float(valve.command_max)))
    compensated = edge.law == "compensated"
    low, high = (
        np.array([0.85, 0.03, 0.9, 0.97, 1.4, 1.2, 0.10]),
        np.array([1.1, 0.06, 1.4, 1.03, 2.0, 1.8, 0.18]),
    )
    onset, soft, sat, factor, setting, wide, force = rng.uniform(low, high)
    row = np.zeros(CURVE_FLOATS)
    dead = float(edge.deadband)
    row[ONSET] = given("onset", onset * dead if dead > 0 else 0.1 * soft * full)
    row[SOFTNESS] = given("softness", soft * full if compensated else 0.3 * soft * full)
    row[SATURATION] = (
        given("saturation", sat * full if compensated else 1.6 * sat * full) or math.inf
    )
    nominal = edge.compensated_gain if compensated else edge.flow_gain
    assert nominal is not None  # `_truth` sees to it
    gain = float(nominal) * given("gain_factor", factor)
    row[E_GAIN] = gain
    if compensated:
        row[SETTING] = given("compensation_drop", setting * float(edge.compensation_drop))
        row[E_GAIN] = gain / math.sqrt(row[SETTING])
        row[WIDE_OPEN] = given("compensator_opening", wide * full)
        row[FLOW_FORCE] = given("flow_force", force / full)
    return row


def _edge_row(
    given: _Given, name: str, edge: Edge, valve: Valve, seed: int, p_supply: float
) -> np.ndarray:
    full = max(abs(float(valve.command_min)), abs(float(valve.command_max)))
    rng = _draws(seed, name)
    row = np.zeros(CURVE + 2 * CURVE_FLOATS)
    row[E_SIGN], row[E_BLOCKED], row[NULL_WIDTH] = edge.sign, edge.reverse == "blocked", 0.05 * full
    forward_curve, reverse_curve = (
        _curve(given, edge, valve, rng),
        _curve(given.reverse(), edge, valve, rng),
    )
    row[CURVE : CURVE + CURVE_FLOATS], row[CURVE + CURVE_FLOATS :] = forward_curve, reverse_curve
    rated = forward_curve[E_GAIN] * full * math.sqrt(forward_curve[SETTING] or p_supply)
    spool = len(valve.edge) > 1
    row[NULL] = given("null_leakage", (1e-4 if spool else 1e-5) * rated / p_supply)
    return row


def _tune(valve: Valve, row: np.ndarray, drop: float, width: float) -> tuple[float, float]:
    """(gain, offset) of a driver turned until the rig file's calibration holds, the command coming
    up from rest.

    With one calibration point only the offset is turned; with more the first and the last hold.
    """
    points = sorted(
        (float(read_value(u, VOCABULARY["command"])), float(read_value(q, VOCABULARY["flow"])))
        for u, q in valve.calibration
    )

    def spool(flow: float) -> float:
        low, high = 0.0, 4.0 * float(valve.command_max)
        if edge_flow(drop, row[E_SIGN] * high, row) < flow:
            raise InputError(
                f"valve '{valve.name}' of the bench never passes its calibration flow "
                f"{flow:g} m^3/s"
            )
        for _ in range(200):
            middle = 0.5 * (low + high)
            low, high = (
                (low, middle)
                if edge_flow(drop, row[E_SIGN] * middle, row) > flow
                else (middle, high)
            )
        return row[E_SIGN] * 0.5 * (low + high)

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
    scratch: np.ndarray
    work: np.ndarray


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
        bench_tick(
            own.state,
            rows.commands[i],
            own.bench,
            own.tick,
            own.steps,
            own.scratch,
            own.work,
            noise[i - first],
            sample,
        )
    return -1


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
        self.channels, self.commands = sample_channels(names), Inputs.of(self.model)
        _check_names(recipe, names)
        self.bench = _build(recipe, self.model, 1.0 / self.rate)
        self.strokes = self.bench.cylinders[:, STROKE].copy()
        self.steps = max(1, round(1.0 / (self.rate * step)))
        nc, nv = len(names.cylinders), len(names.valves)
        self.size = continuous_states(len(names.joints), nc, nv)
        self.raw = 4 * nc + 2
        depth = int(self.bench.timing[0]) + 2
        self.state = np.zeros(self.size + nv + self.raw + 3 * nc + depth * self.raw + 1)
        self._own = Running(
            self.state,
            self.bench,
            1.0 / self.rate,
            self.steps,
            np.zeros((6, max(self.size, self.raw + nv))),
            np.zeros(workspace_size(len(names.joints), nc)),
        )
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
        own = load_rig(bench.file(bench.rig))
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

    def start(self, posture: Posture = None, low_side: float | None = None) -> np.ndarray:
        """As `Machine.start`; the unloaded chambers begin to settle at ``low_side``."""
        self._rng, self._used = self._new_noise(), len(self._noise)
        bench, size, nv = self.bench, self.size, len(self.layout.valves)
        y = self.model.trim(self.model.posture(posture), low_side)
        rest = self.commands.rest
        state = self.state
        state[:] = 0.0
        state[: size - 1] = y
        state[size : size + nv] = rest
        spools = self.layout.state("opening", 0) if nv else 0
        state[spools : spools + nv] = (
            bench.valves[:, DRIVER_GAIN] * rest + bench.valves[:, DRIVER_OFFSET]
        )
        _raw(state[:size], bench, state[size + nv : size + nv + self.raw])
        filters = size + nv + self.raw
        for c in range(len(self.layout.cylinders)):
            state[[filters + 3 * c, filters + 3 * c + 2]] = state[size + nv + 4 * c + 1]
        sample = np.zeros(len(self.channels))
        for _ in range(max(round(SETTLE * self.rate), int(bench.timing[0]) + 3)):
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
            own.work,
            noise,
            sample,
        )

    def advance(self, first: int, stop: int, rows: Rows, law: LawRows | None) -> int:
        """As `advance_of` says."""
        row = _advance(first, stop, self._own, rows, law, self.noise(stop - first))
        if row >= 0:  # noise that no tick used is the next one's, however long the call was
            self._used -= stop - row
        return row

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
        valve = int(self.bench.wiring[index, 2])
        _, _, gain, offset, width = self.bench.valves[
            valve, [LOWEST, HIGHEST, DRIVER_GAIN, DRIVER_OFFSET, HYSTERESIS]
        ]
        rest = self.commands.rest[valve]
        command, drop = np.broadcast_arrays(
            np.asarray(command, dtype=float), np.asarray(drop, dtype=float)
        )
        flows = [
            edge_flow(dp, gain * play(rest, u, width) + offset, self.bench.edges[index])
            for u, dp in zip(command.ravel(), drop.ravel(), strict=True)
        ]
        return np.array(flows).reshape(command.shape)


def _build(recipe: BenchRecipe, model: Model, tick: float) -> VirtualPlant:
    """The compiled form of a bench whose truth ``model`` is."""
    plant, names, rig, seed = model.plant, model.layout, model.rig, recipe.seed
    p_supply = float(rig.supply.pressure)
    air = float(recipe.air_fraction)

    cylinders = np.hstack([plant.cylinders, np.zeros((len(names.cylinders), 2))])
    for name, item, row in zip(names.cylinders, rig.cylinder, cylinders, strict=True):
        given = _Given(recipe.cylinder, name)
        force = p_supply * row[AREA_HEAD]
        rng = _draws(seed, name)
        coulomb, static, viscous, speed = rng.uniform(
            [0.004, 1.4, 0.015, 0.006], [0.007, 1.8, 0.03, 0.012]
        )
        row[COULOMB] = given("friction_coulomb", float(item.friction_coulomb) or coulomb * force)
        row[STATIC] = given("friction_static", static * row[COULOMB])
        row[VISCOUS] = given("friction_viscous", float(item.friction_viscous) or viscous * force)
        row[STRIBECK_SPEED] = given("stribeck_speed", speed)
        if row[STATIC] < row[COULOMB]:
            where = recipe.at("cylinder", name)
            raise InputError(
                f"cylinder.{name}: friction_static must not lie below friction_coulomb", **where
            )
        for key, column in (
            ("leakage_internal", LEAK_INTERNAL),
            ("leakage_head", LEAK_HEAD),
            ("leakage_rod", LEAK_ROD),
        ):
            if f"{name}.{key}" not in recipe.truth and row[column] == 0.0:
                row[column] = (
                    rng.uniform(0.5, 1.5)
                    * (1e-4 if column == LEAK_INTERNAL else 1e-5)
                    * row[AREA_HEAD]
                    / p_supply
                )
        if air > 0.0:
            row[FLOOR] = -math.inf  # the air itself keeps a chamber above vacuum

    edges, wiring = [], plant.wiring[:, :3].copy()
    for name, (_, valve, edge) in zip(names.edges, rig.edges(), strict=True):
        edges.append(_edge_row(_Given(recipe.edge, name), name, edge, valve, seed, p_supply))
    edges = np.array(edges)

    valves = np.hstack([plant.valves, np.zeros((len(names.valves), 3))])
    for index, (name, (_, valve), row) in enumerate(
        zip(names.valves, rig.valves(), valves, strict=True)
    ):
        given, rng = _Given(recipe.valve, name), _draws(seed, name)
        full = max(abs(float(valve.command_min)), abs(float(valve.command_max)))
        width, gain, offset, faster, damper = rng.uniform(
            [0.002, 0.97, -0.003, 0.93, 0.9], [0.006, 1.03, 0.003, 1.07, 1.1]
        )
        row[HYSTERESIS] = given("hysteresis", width * full)
        if valve.calibration:
            tuned = _tune(
                valve,
                edges[np.flatnonzero(wiring[:, 2] == index)[0]],
                float(recipe.calibration_drop),
                row[HYSTERESIS],
            )
            gain, offset = tuned[0], tuned[1] / full
        row[DRIVER_GAIN], row[DRIVER_OFFSET] = (
            given("driver_gain", gain),
            given("driver_offset", offset * full),
        )
        if valve.dynamics is not None:
            omega, zeta = rig.dynamics[valve.dynamics].frequency_and_damping()
            omega, zeta = (
                given("natural_frequency", faster * omega),
                given("damping_ratio", damper * zeta),
            )
            row[[STIFFNESS, DAMPING]] = omega**2, 2 * zeta * omega

    droop = _scalar(recipe.droop)
    relief = _scalar(recipe.supply_relief)
    extra = np.array(
        [
            air,
            float(recipe.polytropic_exponent),
            0.03 * p_supply if droop is None else droop,
            float(recipe.pump_lag),
            1.15 * p_supply if relief is None else relief,
        ]
    )
    if extra[PUMP_LAG] > 0.0 and extra[DROOP] == 0.0:
        hint = "give droop, or pump_lag = '0 s' for an ideal one"
        raise InputError("a pump with a lag needs a droop", **recipe.at("droop"), hint=hint)

    ticks = float(recipe.delay) / tick
    timing = np.array([math.floor(ticks), ticks - math.floor(ticks)])
    return VirtualPlant(
        plant.kind,
        plant.gravity,
        plant.links,
        plant.joints,
        np.ascontiguousarray(cylinders),
        np.ascontiguousarray(valves),
        np.ascontiguousarray(edges),
        np.ascontiguousarray(wiring),
        plant.supply,
        extra,
        _sensors(recipe, model, p_supply),
        timing,
        _speed_filter(
            2 * math.pi * float(recipe.velocity_cutoff), float(recipe.velocity_damping), tick
        ),
    )


def _sensors(recipe: BenchRecipe, model: Model, p_supply: float) -> np.ndarray:
    """Lag, noise, resolution and zero offset of every raw channel."""
    slide = model.rig.mechanism.kind == "slide"
    rows = []
    for name in (*model.layout.cylinders, "supply"):
        given, rng = _Given(recipe.sensors, name), _draws(recipe.seed, f"sensors {name}")
        step = given("position_resolution", 2.54e-5)
        position = [0.0, given("position_noise", 0.2 * step), step, 0.0]
        counts = given("encoder_counts", 4096)
        turn = 2 * math.pi / counts if counts else 0.0
        angle = position if slide else [0.0, 0.1 * turn, turn, 0.0]
        resolution = given("pressure_resolution", p_supply / 2048)
        pressure = [
            given("pressure_lag", 5.3e-5),
            given("pressure_noise", 5e-4 * p_supply),
            resolution,
        ]
        spread = given("pressure_offset", 1e-3 * p_supply)
        zeros = np.clip(rng.standard_normal(2), -2, 2) * spread
        both = [[*pressure, zero] for zero in zeros]
        rows += both if name == "supply" else [angle, position, *both]
    return np.array(rows)


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
