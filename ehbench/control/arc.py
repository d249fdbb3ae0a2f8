"""Energy-saving adaptive robust controller of one cylinder, the other joints held (thesis 4);
derivation in docs/arc.md.

Task level: `ehbench.control.functions` chooses the working function. Valve level: the off-side
chamber follows a low pressure; the other tracks the motion by backstepping (stroke → load force →
flow) with projected adaptation of inverse inertia, payload, disturbance and bulk modulus. Where one
spool opens both chambers, the same law drives its one opening."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ehbench.control.arc_gains import COUNT, GAIN_NAMES, GAINS, VOCABULARY_OF_GAINS, pack
from ehbench.control.axis import Axis, inertias, load_at
from ehbench.control.coupling import loads_among
from ehbench.control.functions import (
    DIRECTION,
    HEAD,
    HEAD_TANK,
    METERED,
    METERING,
    PATH_FLOWS,
    RAISED,
    ROD,
    ROD_TANK,
    SUPPLY_HEAD,
    SUPPLY_ROD,
    VENTED,
    capacity,
    metering_drop,
    select,
    steady_reference,
    supply_draw,
    supply_pressure,
    widest,
)
from ehbench.control.law import Controller, Law
from ehbench.control.map_learning import GAIN, SHIFT, MapMemory, Seen, begin, learn_maps, map_memory
from ehbench.control.measured import (
    Pressures,
    load_force,
    place_joints,
    pressure_entries,
    pressures,
    write,
)
from ehbench.control.oil_learning import (
    OIL,
    begin_oil,
    credit_maps,
    lacking,
    learn_oil,
    restart_for,
)
from ehbench.control.records import blank, constants, rows_of
from ehbench.control.trajectory import ORDERS, reference_of, speeds_soon
from ehbench.control.valve_level import Flows, allocate
from ehbench.parts.cylinder import chamber_oil
from ehbench.parts.edge import edge_flow
from ehbench.parts.sample import OF, entry
from ehbench.parts.supply import beside_change
from ehbench.physics.arm import work_size
from ehbench.runtime.compiled import kernel, record
from ehbench.vocabulary import setting
from ehbench.vocabulary.codes import (
    AGAINST,
    DISTURBANCE,
    FREE,
    FROZEN,
    HOLD,
    INVERSE_BULK,
    INVERSE_INERTIA,
    PAYLOAD_SHARE,
    REVERSED,
    SATURATED,
    WEIGHED,
)


@dataclass(frozen=True)
class ArcSettings:
    """Numbers of the law that are no gain."""

    jump: float = setting(0.01, "m", "observer error that restarts it", "beyond any sensor error")
    ahead: float = setting(1e-3, "s", "step along the motion for its rates", "a tick at 1 kHz")
    preview: float = setting(0.15, "s", "how far desired speeds are known", "docs arc.md")
    smaller: float = setting(0.15, "", "largest cut of a drop, of supply pressure", "docs arc.md")
    settled: float = setting(
        3.0, "1/k1", "quiet time before a standstill", "leaves 5 % of an error"
    )
    turns: int = setting(4, "", "reversals at standstill that end damping", "docs arc.md")
    counts: float = setting(1.5, "", "stroke error of one count, in resolutions", "sensor counts")
    reversal: float = setting(4.0, "", "required speed that reverses, in small speeds", "chosen")
    fresh: float = setting(3.0, "rad/s·s", "corner of a new function times its age", "chosen")
    follows: float = setting(1.5, "", "margins above a chamber that a pump follows", "chosen")
    payload_memory: float = setting(5.0, "1/k1", "memory of the payload estimate", "docs arc.md")
    weak_pull: float = setting(0.1, "(N/kg)²", "pull that hardly shows a payload", "chosen")
    other_payload: float = setting(0.15, "", "change of payload, of its bound", "docs arc.md")
    no_information: float = setting(1e-6, "(N/kg)²", "information at the first tick", "above 0")
    offset: float = setting(0.1, "", "sensor zeros, of the disturbance's bound", "chosen")
    damping: float = setting(0.2, "", "error of the damping in the payload interval", "chosen")


ARC = constants(ArcSettings())

STATE = record(
    ("started", "i8"),
    ("function", "i8"),
    ("age", "f8"),
    ("metered", "i8"),
    ("set_point", "f8"),
    ("raised", "f8"),
    ("slow_load", "f8"),
    ("slow_error", "f8"),
    ("slow_reference", "f8"),
    ("standstill", "f8"),
    ("way", "i8"),
    ("turns", "i8"),
    ("slow_required", "f8"),
    ("calm_load", "f8"),
    ("supply_swing", "f8"),
    ("slow_drop", "f8"),
    ("learning", "i8"),
    ("x", "f8"),
    ("v", "f8"),
    ("bias", "f8"),
    ("acceleration", "f8"),
    ("slow_force", "f8"),
    ("slow_speed", "f8"),
    ("slow_pull", "f8"),
    ("evidence", "f8"),
    ("information", "f8"),
    ("scatter", "f8"),
    ("payload", "f8"),
    ("half", "f8"),
    ("eased", "f8"),
    ("heaviest", "f8"),
    ("estimates", "f8", (COUNT,)),
)


class Memory(NamedTuple):
    """State of the controller from tick to tick, a record of type STATE, and room to work in.

    ``x``, ``v`` [m, m/s] of the state are observed, ``bias`` [m/s²] is what the model's
    ``acceleration`` lacks; ``metered`` and ``set_point`` [Pa] are of the off-side control,
    ``raised`` [Pa] is how far its goal stands above the low pressure, see `provide_headroom`,
    ``standstill`` [s] for how long no motion is desired and hardly any remains,
    ``slow_required`` [m/s] the required oil, as a speed, behind a low-pass. ``evidence``,
    ``information`` and ``scatter`` are means of what the mechanism's equation says of the
    ``payload`` [kg], ``half`` [kg] its interval's, see `estimate_payload`; ``eased`` is how far the
    bandwidths went down at most, as a share of them, and ``heaviest`` [kg] the payload then, see
    `ease`; ``calm_load`` [N], ``supply_swing`` and ``slow_drop`` [Pa] are what valves are opened
    by, see `opened_by`; ``turns`` counts how often the required oil changed its ``way`` while no
    motion was desired; ``maps`` is what is learnt of the flow maps, ``oil``, a record of type OIL,
    of the oil, ``gains`` are those in force, see `ease`."""

    state: np.record
    rates: np.ndarray
    angles: np.ndarray
    mass: np.ndarray
    work: np.ndarray
    maps: MapMemory
    oil: np.record
    gains: np.recarray


class Telemetry(NamedTuple):
    """The law's own columns of a row of telemetry."""

    x_desired: float
    v_desired: float
    a_desired: float
    j_desired: float
    function: float
    function_status: float
    x_error: float
    v_error: float
    load_force: float
    load_force_desired: float
    v_observed: float
    flow_head_desired: float
    flow_rod_desired: float
    pressure_set: float
    inverse_inertia: float
    payload_share: float
    disturbance: float
    inverse_bulk: float
    payload_estimate: float
    payload_measured: float
    payload_low: float
    payload_high: float
    bulk_measured: float
    learning: float
    limits: float


COLUMNS = len(Telemetry._fields)


class StrokeLaw(NamedTuple):
    """Step 1: ``z1`` [m], ``v_error`` [m/s], ``z2 = v_error + k1 z1`` [m/s], k1 [1/s] (0 where
    limited), ``a_eq`` [m/s²]."""

    z1: float
    v_error: float
    z2: float
    k1: float
    a_eq: float


class ForceLaw(NamedTuple):
    """Step 2: the load force [N] as ``measured``, as ``required``, and the error ``z3`` between.

    ``pushed`` [m/s²] and ``need`` [N] are its parts, ``k2`` [1/s] with its robust share, ``turn``
    [1] the sign of friction, ``slope`` [N·s/m] its change with speed. ``acceleration`` [m/s²] is
    the model's, by the regressors ``phi_1..3`` of the estimates, and ``uncertainty`` [m/s²] what
    their bounds leave open."""

    measured: float
    required: float
    z3: float
    pushed: float
    need: float
    k2: float
    turn: float
    slope: float
    acceleration: float
    phi_1: float
    phi_2: float
    phi_3: float
    uncertainty: float


class Oil(NamedTuple):
    """``head``, ``rod``: A/V of the chambers [1/m]; design's ``bulk`` [Pa]; ``coupling`` [N/m], the
    oil's spring; leakage out of the head, into the rod end [m³/s]."""

    head: float
    rod: float
    bulk: float
    coupling: float
    lost_head: float
    lost_rod: float


class Choice(NamedTuple):
    """The task level's function, status, slow load force [N]; whether the load rests, the speed
    [m/s] of correction then; whether one spool opens both chambers."""

    function: int
    status: int
    load: float
    resting: bool
    return_speed: float
    spool: bool


@kernel
def project(estimate, rate, lower, upper):
    """``rate`` of an estimate, or 0 where it would leave its bounds (discontinuous projection)."""
    if (estimate >= upper and rate > 0.0) or (estimate <= lower and rate < 0.0):
        return 0.0
    return rate


@kernel
def adapt(estimates, rates, lower, upper, tick):
    """Move the estimates over one tick, in place, within [lower, upper]."""
    for i in range(estimates.shape[0]):
        moved = estimates[i] + tick * project(estimates[i], rates[i], lower[i], upper[i])
        if not math.isnan(moved):
            estimates[i] = min(max(moved, lower[i]), upper[i])


@kernel
def flow_along(path, drop, opening, circuit):
    """Flow [m³/s] along a path at a drop [Pa] along it and an opening [V] of its edge."""
    edge, along = circuit.paths[path], circuit.along[path]
    gain, shift = circuit.trim[edge - circuit.first, 0], circuit.trim[edge - circuit.first, 1]
    reach = opening - circuit.edges[edge].sign * shift
    return gain * along * edge_flow(along * drop, reach, circuit.edges[edge], circuit.maps)


@kernel
def spool_flows(function: int, required, head_gain, rod_gain, p, circuit):
    """`Flows` of the one opening at which a spool gives ``head_gain·Q1 + rod_gain·Q2 = required``.

    False position with Illinois weights over the opening, in which both flows grow. Flow beyond the
    widest opening is required in proportion, so that the valve level flags it."""
    way = DIRECTION[function]
    head_path = SUPPLY_HEAD if way > 0 else HEAD_TANK
    rod_path = ROD_TANK if way > 0 else SUPPLY_ROD
    if way * required <= 0.0:  # against the function's direction: the valve level shuts, says so
        return Flows(required / head_gain, required / rod_gain)
    drop_one, drop_two = (
        metering_drop(head_path, p, circuit),
        metering_drop(rod_path, p, circuit),
    )
    along = circuit.along[head_path]
    low, high = 0.0, widest(circuit, circuit.paths[head_path], along * drop_one)
    goal = way * required
    at_low, at_high, flow_one, flow_two = -goal, 0.0, 0.0, 0.0
    side = 0
    for turn in range(19):
        opening = high if turn == 0 else high - at_high * (high - low) / (at_high - at_low)
        flow_one = flow_along(head_path, drop_one, opening, circuit)
        flow_two = flow_along(rod_path, drop_two, opening, circuit)
        given = head_gain * flow_one + rod_gain * flow_two
        if turn == 0:
            at_high = given - goal
            if at_high <= 0.0:
                more = goal / given if given > 0.0 else 2.0
                return Flows(way * flow_one * more, way * flow_two * more)
            continue
        if abs(given - goal) <= 1e-9 * goal:
            break
        if given > goal:
            high, at_high = opening, given - goal
            if side == 1:
                at_low *= 0.5
            side = 1
        else:
            low, at_low = opening, given - goal
            if side == -1:
                at_high *= 0.5
            side = -1
    return Flows(way * flow_one, way * flow_two)


@kernel
def bias_valves(axis, share, trim, command):
    """Raise shut cartridges to ``share`` of the command at which they begin to pass oil (with
    ``trim``)."""
    circuit = axis.circuit
    for i in range(circuit.count):
        edge = circuit.first + i
        valve = circuit.edges[edge].valve
        waits = 0.0
        if axis.onset[i] != 0.0:
            waits = share * (axis.onset[i] + circuit.edges[edge].sign * trim[i, SHIFT])
        if abs(command[valve]) < abs(waits):
            command[valve] = waits


@kernel
def clip(value, lower, upper):
    """``value`` within [lower, upper]; NaN stays NaN."""
    return lower if value < lower else (upper if value > upper else value)


@kernel
def loads_along(reference, q, v, inertia, axis, memory):
    """(`Load` now, a step ahead on the same motion), after `inertias`; with what other joints
    add."""
    angles, work = memory.angles, memory.work
    if reference.shape[0] >= 2 * ORDERS:
        return loads_among(reference, q, v, ARC.ahead, axis, angles, memory.mass, work)
    load = load_at(axis, q, inertia, work)
    return load, load_at(axis, q + ARC.ahead * v / load.lever, inertia, work)


@kernel
def wait(load_force, p, state):
    """Between motions the loaded chamber counts as metered, the set-point is the other's
    pressure."""
    state.metered = HEAD if load_force >= 0.0 else ROD
    state.set_point = p.rod if state.metered == HEAD else p.head


@kernel
def begin_estimates(load_force, load, inertia, tip, gains, state):
    """Write the first estimates, and the payload: the design model's or, with adaptation, those
    that the pressures tell at rest.

    What the load force carries beyond the model's gravity is payload and disturbance, in the shares
    of their adaptation."""
    estimates = state.estimates
    for i in range(COUNT):
        estimates[i] = gains.start[i]
    if gains.adapt == 0.0:
        return
    lower, upper, beyond = gains.lower, gains.upper, load_force - load.gravity
    part = gains.rate[PAYLOAD_SHARE] * load.pull * load.pull
    if part > 0.0:
        part /= part + gains.rate[DISTURBANCE]
        payload = clip(part * beyond / load.pull, lower[PAYLOAD_SHARE], upper[PAYLOAD_SHARE])
        estimates[INVERSE_INERTIA] = clip(
            inertia / (inertia + tip * payload), lower[INVERSE_INERTIA], upper[INVERSE_INERTIA]
        )
        estimates[PAYLOAD_SHARE] = estimates[INVERSE_INERTIA] * payload
        state.payload = payload
    residual = estimates[INVERSE_INERTIA] * beyond - estimates[PAYLOAD_SHARE] * load.pull
    estimates[DISTURBANCE] = clip(residual, lower[DISTURBANCE], upper[DISTURBANCE])


@kernel
def ease(gains, ratio, state, table):
    """The gains in force, a row in ``table``: k1 + k2 + k3 at most ``bandwidth_limit`` times the
    share of its frequency that a payload leaves the rig; ``ratio`` [1/kg]: what 1 kg adds to the
    inertia."""
    share = 1.0
    if gains.bandwidth_limit > 0.0:
        total = gains.position_bandwidth + gains.speed_bandwidth + gains.force_bandwidth
        payload = state.payload if state.payload > 0.0 else 0.0
        heavier = math.sqrt(1.0 + ratio * payload)
        share = min(gains.bandwidth_limit / (heavier * total), 1.0)
        if 1.0 - share > state.eased:
            state.eased, state.heaviest = 1.0 - share, payload
    slowed(gains, share, table)
    return table


@kernel
def slowed(gains, share, table):
    """Write the gains at a ``share`` of their bandwidths [1] into the row of ``table``."""
    table[0] = gains
    eased = table[0]
    eased.position_bandwidth = share * gains.position_bandwidth
    eased.speed_bandwidth = share * gains.speed_bandwidth
    eased.force_bandwidth = share * gains.force_bandwidth
    eased.observer_bandwidth = share * gains.observer_bandwidth
    eased.pressure_bandwidth = share * gains.pressure_bandwidth
    eased.map_bandwidth = share * gains.map_bandwidth
    eased.drop_corner = share * gains.drop_corner
    eased.speed_tolerance = gains.speed_tolerance / share
    for i in range(COUNT):
        eased.rate[i] = share * gains.rate[i]


@kernel
def observe(x, v, gains, state):
    """(x [m], v [m/s]) of the observer, or as measured where it has no bandwidth.

    The model's acceleration and an unknown bias of it are integrated and corrected by the measured
    stroke, three poles at ``observer_bandwidth``: speed without the lag of a filter and without the
    noise of a difference."""
    if gains.observer_bandwidth > 0.0:
        tick = gains.tick
        z = math.exp(-gains.observer_bandwidth * tick)
        a = state.acceleration + state.bias
        seen = state.x + tick * (state.v + 0.5 * tick * a)
        miss = x - seen
        if abs(miss) > ARC.jump:
            state.x, state.v, state.bias = x, v, -state.acceleration
            return x, v
        x = seen + (1.0 - z * z * z) * miss
        v = state.v + tick * a + 1.5 * (1.0 - z) * (1.0 - z) * (1.0 + z) / tick * miss
        state.bias += (1.0 - z) ** 3 / (tick * tick) * miss
    state.x, state.v = x, v
    return x, v


@kernel
def track_stroke(reference, x, v, gains):
    """Step 1 of the backstepping: the `StrokeLaw`."""
    k1 = gains.position_bandwidth
    z1 = x - reference.x
    pulled = k1 * z1
    if abs(pulled) > gains.speed_correction:
        pulled, k1 = math.copysign(gains.speed_correction, pulled), 0.0
    v_error = v - reference.v
    return StrokeLaw(z1, v_error, v_error + pulled, k1, reference.a - k1 * v_error)


@kernel
def robust(gain, uncertainty, tolerance, limit):
    """``gain`` [1/s] and what keeps an error within ``tolerance``, at most ``limit`` [1] of it."""
    return gain + min(uncertainty * uncertainty / (4.0 * gain * tolerance**2), limit * gain)


@kernel
def track_force(reference, v, load_force, load, stroke, axis, gains, estimates):
    """Step 2: the `ForceLaw`."""
    cylinder, lower, upper = axis.cylinder, gains.lower, gains.upper
    inverse = estimates[INVERSE_INERTIA]
    share, offset = estimates[PAYLOAD_SHARE], estimates[DISTURBANCE]
    turn = math.tanh(reference.v / cylinder.coulomb_speed)
    kappa = load.curve * v * v
    force = (
        load.gravity
        + (load.damping + cylinder.friction_viscous) * v
        + cylinder.friction_coulomb * turn
    )
    phi1, phi2, phi3 = (load_force - force) / load.mass, -load.pull / load.mass, -1.0 / load.mass
    uncertainty = abs(phi1) * (upper[0] - lower[0])
    uncertainty += abs(phi2) * (upper[1] - lower[1]) + abs(phi3) * (upper[2] - lower[2])
    k2 = robust(gains.speed_bandwidth, uncertainty, gains.speed_tolerance, gains.robust_limit)
    pushed = stroke.a_eq - kappa - k2 * stroke.z2
    need = load.mass * pushed + share * load.pull + offset
    required = force + need / inverse
    return ForceLaw(
        load_force,
        required,
        load_force - required,
        pushed,
        need,
        k2,
        turn,
        load.damping
        + cylinder.friction_viscous
        - load.mass / inverse * (stroke.k1 + 2.0 * load.curve * v + k2),
        kappa + inverse * phi1 + share * phi2 + offset * phi3,
        phi1,
        phi2,
        phi3,
        uncertainty,
    )


@kernel
def oil_at(x, p, load, axis, gains, estimates):
    """The `Oil` at a stroke [m]."""
    circuit, cylinder = axis.circuit, axis.cylinder
    head = circuit.area_head / chamber_oil(cylinder, 0, x)
    rod = circuit.area_rod / chamber_oil(cylinder, 1, x)
    coupling = cylinder.bulk_modulus * (head * circuit.area_head + rod * circuit.area_rod)
    if gains.coupling_frequency > 0.0:
        coupling = (
            estimates[INVERSE_INERTIA]
            * gains.reference_mass**2
            * gains.coupling_frequency**2
            / load.mass
        )
    across = cylinder.leakage_internal * (p.head - p.rod)
    return Oil(
        head,
        rod,
        cylinder.bulk_modulus,
        coupling,
        across + cylinder.leakage_head * (p.head - p.tank),
        across - cylinder.leakage_rod * (p.rod - p.tank),
    )


@kernel
def adapt_mechanics(learning, mixed, force, gains, memory):
    """Write the rates of the mechanical estimates: the gradient of both steps, at rest of the
    model's acceleration, all of which is error then."""
    estimates, rates = memory.state.estimates, memory.rates
    error = 0.0
    if learning == FREE:
        error = mixed
    elif learning == WEIGHED:
        error = -gains.weighing_time * force.acceleration
    for i in range(3):
        phi = force.phi_1 if i == 0 else (force.phi_2 if i == 1 else force.phi_3)
        rate = gains.rate[i] * phi * error
        rates[i] = project(estimates[i], rate, gains.lower[i], gains.upper[i])


@kernel
def load_rate(reference, load, ahead, stroke, force, v, axis, memory):
    """(rate [N/s] of the required load force with speed, stroke (``ahead``), time and learning; the
    reference's part of it)."""
    estimates, rates, cylinder = memory.state.estimates, memory.rates, axis.cylinder
    inverse, share = estimates[INVERSE_INERTIA], estimates[PAYLOAD_SHARE]
    moved = (
        (ahead.mass - load.mass) * force.pushed
        - load.mass * (ahead.curve - load.curve) * v * v
        + share * (ahead.pull - load.pull)
    )
    along = (
        ahead.gravity - load.gravity + (ahead.damping - load.damping) * v + moved / inverse
    ) / ARC.ahead
    turning = (1.0 - force.turn * force.turn) / cylinder.coulomb_speed
    turned = cylinder.friction_coulomb * turning * reference.a
    timed = turned + load.mass / inverse * (
        reference.j + stroke.k1 * reference.a + force.k2 * stroke.a_eq
    )
    learnt = (-force.need / inverse * rates[0] + load.pull * rates[1] + rates[2]) / inverse
    damped = load.damping + cylinder.friction_viscous - 2.0 * load.mass / inverse * load.curve * v
    planned = along + turned + damped * reference.a + load.mass / inverse * reference.j
    return force.slope * force.acceleration + along + timed + learnt, planned


@kernel
def track_flow(rates, learning, weight, stroke, force, oil, gains, memory):
    """Step 3: what the required load force's ``rates`` [N/s], of `load_rate`, and the errors take
    of the oil [1/s], as a relative change of volume; writes the rate of the inverse bulk modulus.

    The feedback goes by the design's bulk modulus: it would teach that of the oil no more than that
    it is not zero. What pressures tell of the oil counts for the reference's part alone, so that
    the loop's gain is not theirs."""
    rate, planned = rates
    softness = memory.state.estimates[INVERSE_BULK]
    lower, upper = gains.lower[INVERSE_BULK], gains.upper[INVERSE_BULK]
    uncertainty = abs(force.slope) * force.uncertainty + (upper - lower) / lower * abs(rate)
    k3 = robust(gains.force_bandwidth, uncertainty, gains.force_tolerance, gains.robust_limit)
    memory.rates[INVERSE_BULK] = project(
        softness,
        -gains.rate[INVERSE_BULK] * weight * force.z3 * rate if learning == FREE else 0.0,
        lower,
        upper,
    )
    rate = softness * rate + memory.oil.softer * planned
    return (rate - k3 * force.z3 - oil.coupling * stroke.z2) / oil.bulk


@kernel
def required_speed(reference, oil, gains):
    """The speed [m/s] required of valves so that they give the desired one: ahead by their lag, and
    by how much later or smaller than known flows are, by the record ``oil`` of what is learnt.

    Only the desired motion is corrected, so that the gain of the loop stays."""
    soon = reference.v + (gains.valve_lead + oil.later) * reference.a
    return soon * (1.0 + oil.more[0 if reference.v >= 0.0 else 1])


@kernel
def choose(reference, z1, load_force, spool_speed, p, axis, gains, state):
    """The task level's `Choice`: the direction is that of the desired speed, led back to the
    desired stroke.

    An error below the sensor's resolution moves nothing. At a stop the direction is that of the
    required oil: a load that swings back meets oil and not a shut valve. A spool passes its centre
    without switching, so it follows the required ``spool_speed`` [m/s], at standstill as well until
    it is small."""
    tick, k1, speed_start = gains.tick, gains.position_bandwidth, gains.rules.speed_start
    state.slow_load -= math.expm1(-gains.load_corner * tick) * (load_force - state.slow_load)
    # at standstill swings calm down by themselves, and the error goes back slowly
    spool = axis.spool[state.function] == 1
    state.slow_reference = steady = steady_reference(
        reference.v, state.slow_reference, tick, gains.rules
    )
    still = abs(steady) <= speed_start
    near = max(gains.speed_nudge, 4.0 * k1 * gains.stroke_resolution)
    reversal = ARC.reversal * near
    quiet = still and min(abs(k1 * z1), abs(state.v)) <= near
    state.standstill = state.standstill + tick if quiet else 0.0
    if not still:
        state.way = state.turns = 0
    resting = still if spool else state.standstill > ARC.settled / k1 or state.turns >= ARC.turns
    calm = math.exp(-2.0 * k1 * tick) if resting else 0.0
    state.slow_error = z1 + calm * (state.slow_error - z1)
    resolution = gains.stroke_resolution
    blind = max(resolution - speed_start / k1, 0.3 * resolution)
    error = state.slow_error - clip(state.slow_error, -blind, blind)
    toward = steady - clip(k1 * error, -gains.speed_correction, gains.speed_correction)
    return_speed = 2.0 * abs(toward) + gains.speed_nudge
    state.slow_required -= math.expm1(-gains.force_bandwidth * tick) * (
        spool_speed - state.slow_required
    )
    if still and abs(state.slow_required) > reversal and state.way * state.slow_required <= 0.0:
        state.way, state.turns = 1 if state.slow_required > 0.0 else -1, state.turns + 1
    if spool:
        # shut at standstill only where little oil is required, and none against the error: shutting
        # by the sign alone would stop the oil that damps the load
        small = abs(z1) <= ARC.counts * resolution or z1 * state.slow_required > 0.0
        shut = still and small and abs(state.slow_required) <= near
        toward = 0.0 if shut else spool_speed
    elif not resting and abs(steady) <= abs(k1 * z1) + near:
        fast = abs(state.slow_required) > abs(toward) + reversal
        if fast and toward * state.slow_required < 0.0:
            toward = state.slow_required
    if still and not spool and abs(toward) <= speed_start:
        # the function stays at work: it makes up for leakage, and holding and moving in turn hunts
        toward = 2.0 * speed_start * DIRECTION[state.function]
    function, status = select(
        state.function, state.age, toward, state.slow_load, p, axis.circuit, gains.rules
    )
    if function != state.function:
        state.age = 0.0
    state.age += tick
    state.function = function
    coupled = axis.spool[function] == 1
    return Choice(function, status, state.slow_load, resting, return_speed, coupled)


@kernel
def carried(path, drop, circuit):
    """Largest flow [m³/s] along a path at a drop [Pa], as far as it is known (``trim``)."""
    return circuit.trim[circuit.paths[path] - circuit.first, GAIN] * capacity(circuit, path, drop)


@kernel
def provide_headroom(choice, soon, p, circuit, gains, memory):
    """Write by how much [Pa] the off-side's goal is raised, so that the supply's edge will carry
    what is desired.

    An edge that keeps its flow against the drop passes a little more at a smaller one, that is
    where the chamber which it fills stands higher. Where it passes less so, or the pump would have
    to follow, nothing is raised. ``soon`` are the (least, largest) desired speeds [m/s] of the next
    preview."""
    state, path, way = memory.state, METERING[choice.function], DIRECTION[choice.function]
    state.raised, regenerates = 0.0, RAISED[choice.function]
    if choice.spool or regenerates or (path != SUPPLY_HEAD and path != SUPPLY_ROD):
        return
    area, other = circuit.area_head, circuit.area_rod
    if path == SUPPLY_ROD:
        area, other = other, area
    fastest = max(soon[1] if way > 0 else -soon[0], 0.0)
    required = (1.0 + gains.flow_reserve) * area * fastest / (1.0 - lacking(way, memory.oil))
    filled = ((p.tank + gains.low_pressure) * other + way * choice.load) / area
    supply = supply_pressure(filled, p, circuit)
    less = min(ARC.smaller * p.supply, 0.5 * (supply - filled))
    follows = circuit.supply[0].margin > 0.0 or supply_pressure(filled + less, p, circuit) != supply
    if gains.flow_reserve == 0.0 or less <= 0.0 or follows:
        return
    plain = carried(path, supply - filled, circuit)
    wide = carried(path, supply - filled - less, circuit)
    if wide > plain and required > plain:
        state.raised = min((required - plain) / (wide - plain), 1.0) * less * area / other


@kernel
def off_side(choice, v_d, head_rate, rod_rate, p, circuit, gains, state):
    """What the off-side chamber's pressure takes beyond ``A v_d``, as a speed of its piston face
    [m/s].

    Its set-point goes from where the pressure was when the chamber became the off-side to
    ``low_pressure`` above tank, ``raised`` by `provide_headroom`, or, in the seventh function, to
    ``(P_L + Δp3 A1)/(A1 − A2)``. ``head_rate``, ``rod_rate`` [Pa/m] are β A/V of the chambers."""
    metered = METERED[choice.function]
    if state.metered != metered:
        state.metered = metered
        state.set_point = p.rod if metered == HEAD else p.head
    if VENTED[choice.function]:  # nothing holds it but the tank
        return 0.0
    target = p.tank + gains.low_pressure + state.raised
    if RAISED[choice.function]:
        target = (choice.load + gains.rules.cross_drop * circuit.area_head) / (
            circuit.area_head - circuit.area_rod
        )
    # never so fast that the metered chamber would have to give way against the motion
    if metered == HEAD:
        fastest = head_rate * circuit.area_head / circuit.area_rod
    else:
        fastest = rod_rate * circuit.area_rod / circuit.area_head
    travel = min(gains.pressure_rate, 0.5 * fastest * abs(v_d)) * gains.tick
    moved = clip(target - state.set_point, -travel, travel)
    state.set_point += moved
    # less than that is the noise of the tank's sensor
    ramp = moved / gains.tick if abs(moved) == travel else 0.0
    if metered == HEAD:
        return (gains.pressure_bandwidth * (p.rod - state.set_point) - ramp) / rod_rate
    return (gains.pressure_bandwidth * (state.set_point - p.head) + ramp) / head_rate


@kernel
def share_flows(choice, reference, required, oil, p, opened, axis, memory):
    """Valve level: the `Flows` whose ``head·Q1 + rod·Q2`` is ``required`` [1/s].

    The off-side chamber's flow follows its pressure, the rest is the metered chamber's; a spool
    opens both, by the pressures of `opened_by`."""
    function, circuit = choice.function, axis.circuit
    gains, state = memory.gains[0], memory.state
    if function == HOLD:
        wait(choice.load, p, state)
        return Flows(0.0, 0.0)
    if choice.spool:
        return spool_flows(function, required, oil.head, oil.rod, opened, circuit)
    stiff = oil.bulk / state.estimates[INVERSE_BULK]
    extra = off_side(
        choice, reference.v, stiff * oil.head, stiff * oil.rod, p, circuit, gains, state
    )
    piston = reference.v + gains.valve_lead * reference.a + extra
    if (METERED[function] == HEAD) == (DIRECTION[function] < 0):
        piston = required_speed(reference, memory.oil, gains) + extra  # or it would run empty
    way = DIRECTION[function]
    if METERED[function] == HEAD:
        off = forward(way, circuit.area_rod * piston + oil.lost_rod)
        metered = (required - oil.rod * off) / oil.head
        return Flows(limit_return(metered, circuit.area_head, way, choice), off)
    off = forward(way, circuit.area_head * piston + oil.lost_head)
    metered = (required - oil.head * off) / oil.rod
    return Flows(off, limit_return(metered, circuit.area_rod, way, choice))


@kernel
def opened_by(starting, p, planned, choice, oil, circuit, gains, state):
    """The `Pressures` by whose drops valves are opened: as measured, or without what the load's
    swing adds to them.

    A valve that makes up for its drop does so late by its lag, and where the drop is small that
    feeds the load's swing; opened without it, what it passes the more or the less damps the swing.
    ``calm_load`` [N] is the load force as ``planned`` [N/s], drawn to the measured one. What that
    has beyond it is the piston's on the oil: x raises the head end by −β A_1/V_1 x and the rod end
    by β A_2/V_2 x."""
    measured = load_force(p, circuit.area_head, circuit.area_rod)
    part = 1.0
    if gains.drop_corner > 0.0 and not starting:
        part = -math.expm1(-(gains.drop_corner + ARC.fresh / state.age) * gains.tick)
        state.calm_load += planned * gains.tick
    state.calm_load += part * (measured - state.calm_load)
    if part == 1.0:
        return p
    swing = measured - state.calm_load
    swing /= oil.head * circuit.area_head + oil.rod * circuit.area_rod
    head, rod, supply = oil.head * swing, -oil.rod * swing, circuit.supply[0]
    return Pressures(
        beside_change(p.head - head, p.head, supply),
        beside_change(p.rod - rod, p.rod, supply),
        calm_supply(choice, part, head, rod, p, circuit, gains, state),
        p.tank,
    )


@kernel
def calm_supply(choice, part, head, rod, p, circuit, gains, state):
    """The supply's pressure [Pa] in `opened_by`: as measured but for a load-sensing pump's, of
    which is taken off what the swing of the chamber that it feeds, ``head`` or ``rod`` [Pa], makes
    of it behind its lag.

    An off-side chamber is fed by a slow drop (``part`` of what is new in a tick): its own pressure
    goes up and down with what it is fed, and the pump follows, with no load between."""
    function, supply = choice.function, circuit.supply[0]
    if supply.margin == 0.0 or supply_draw(function, circuit) == 0.0:
        return p.supply
    fed, chamber, swing = SUPPLY_ROD, p.rod, rod
    if PATH_FLOWS[function, SUPPLY_HEAD, 0] != 0.0:
        fed, chamber, swing = SUPPLY_HEAD, p.head, head
    drop, felt = p.supply - chamber, 0.0
    state.slow_drop += part * (drop - state.slow_drop)
    if METERING[function] != fed and not choice.spool:
        state.supply_swing = 0.0
        return state.slow_drop + chamber - swing
    if drop < ARC.follows * supply.margin and p.supply < supply.pressure:
        felt = swing
    state.supply_swing += gains.tick / (gains.tick + supply.lag) * (felt - state.supply_swing)
    return p.supply - state.supply_swing


@kernel
def forward(way, flow):
    """A flow [m³/s], or 0 where it is against the direction."""
    return 0.0 if way * flow < 0.0 else flow


@kernel
def limit_return(flow, area, way, choice):
    """A metered chamber's flow [m³/s], at standstill at most that of the return speed."""
    if choice.resting and way * flow > area * choice.return_speed:
        return way * area * choice.return_speed
    return flow


@kernel
def learns_next(choice, limits, edge_limits, circuit):
    """How the estimates learn at the next tick: a saturated valve must not teach; at standstill the
    payload is estimated."""
    if choice.resting:
        return WEIGHED
    if choice.function == HOLD or limits & SATURATED != 0:
        return FROZEN
    metering = circuit.paths[METERING[choice.function]] - circuit.first
    return FROZEN if int(edge_limits[metering]) & (AGAINST | REVERSED) != 0 else FREE


@kernel
def learn(learning, starting, force, gains, memory):
    """Move the estimates, and the observer's bias by what they learn."""
    state, estimates = memory.state, memory.state.estimates
    inverse, share, offset = estimates[0], estimates[1], estimates[2]
    if learning != FROZEN:
        adapt(estimates, memory.rates, gains.lower, gains.upper, gains.tick)
    learnt = (
        (estimates[0] - inverse) * force.phi_1
        + (estimates[1] - share) * force.phi_2
        + (estimates[2] - offset) * force.phi_3
    )
    state.acceleration = force.acceleration + learnt
    state.bias = -force.acceleration if starting else state.bias - learnt


@kernel
def estimate_payload(starting, force, load, ratio, v, axis, gains, state):
    """Write the payload by least squares over pressures and mechanism, and the half of an interval
    that holds it as far as friction is the design's, give or take its Coulomb part.

    ``P_L − F_0 − m_0 (a − κ) = m_p (G + m_0 ρ (a − κ))``, both sides behind a low-pass at k1, which
    gives the acceleration as well; old values fade over ``payload_memory``/k1, as fast as new ones
    come. ``ratio`` ρ [1/kg] is what 1 kg adds to the inertia."""
    beyond, corner = force.phi_1 * load.mass, gains.position_bandwidth
    slow = gains.tick * corner
    slow /= 1.0 + slow
    if starting:
        state.slow_force, state.slow_speed, state.slow_pull = beyond, v, load.pull
    state.slow_force += slow * (beyond - state.slow_force)
    state.slow_speed += slow * (v - state.slow_speed)
    state.slow_pull += slow * (load.pull - state.slow_pull)
    acceleration = corner * (v - state.slow_speed) - load.curve * v * v
    per = state.slow_pull + load.mass * ratio * acceleration
    result = state.slow_force - load.mass * acceleration
    if starting:
        state.information = per * per + ARC.no_information
        state.evidence = (
            state.estimates[PAYLOAD_SHARE] / state.estimates[INVERSE_INERTIA] * state.information
        )
    news = slow / ARC.payload_memory * per * per / (per * per + ARC.weak_pull)
    state.evidence += news * (per * result - state.evidence)
    state.information += news * (per * per - state.information)
    state.payload = state.evidence / state.information
    residual = result - per * state.payload
    state.scatter += news * (residual * residual - state.scatter)
    doubt = max(2.0 * math.sqrt(state.scatter), abs(residual)) + axis.cylinder.friction_coulomb
    doubt += ARC.offset * gains.upper[DISTURBANCE]
    doubt += ARC.damping * abs(v) * (load.damping + axis.cylinder.friction_viscous)
    state.half = min(doubt / math.sqrt(state.information), gains.upper[PAYLOAD_SHARE])


@kernel
def estimate_bulk_modulus(choice, flows, limits, load_force, v, oil, axis, memory):
    """Learn the oil's softness from the flows [m³/s] that the valves pass, with ``adapt_oil``."""
    gains, circuit = memory.gains[0], axis.circuit
    if gains.adapt_oil == 0.0 or gains.adapt == 0.0:
        return
    moving = choice.function != HOLD and not choice.resting
    passing = limits & (SATURATED | AGAINST | REVERSED) == 0
    quiet = moving and passing and memory.state.age > 1.5 * gains.tick
    given = oil.bulk * (oil.head * flows.head + oil.rod * flows.rod)
    per_speed = oil.bulk * (oil.head * circuit.area_head + oil.rod * circuit.area_rod)
    moved = per_speed * v + oil.bulk * (oil.head * oil.lost_head + oil.rod * oil.lost_rod)
    maximum = per_speed * gains.speed_correction
    bound = gains.upper[PAYLOAD_SHARE]
    if memory.state.half < 0.5 * bound:
        other = memory.state.half + ARC.other_payload * bound
        restart_for(memory.state.payload, other, memory.oil)
    learn_oil(quiet, given, moved, maximum, load_force, gains, memory.oil)


@kernel
def adapt_maps(choice, seen, command, axis, gains, memory, telemetry):
    """Correct the flow maps in a motion whose function stays, with ``adapt_maps``."""
    if gains.adapt_maps > 0.0:
        moving = choice.function != HOLD and not choice.resting
        quiet = moving and memory.state.age > 1.5 * gains.tick
        learn_maps(
            quiet, choice.resting, seen, telemetry[COLUMNS:], command, axis, gains, memory.maps
        )
        oil, added = seen.oil, memory.maps.added
        credit_maps(oil.bulk * (oil.head * added[0] - oil.rod * added[1]), memory.oil)


@kernel
def write_telemetry(reference, stroke, force, choice, flows, limits, memory, telemetry):
    """Write the law's columns, and behind those of every law the corrections of its edges."""
    state, trim = memory.state, memory.maps.trim
    estimates, count = state.estimates, trim.shape[0]
    for i in range(count):
        telemetry[COLUMNS + 2 * count + i] = trim[i, GAIN]
        telemetry[COLUMNS + 3 * count + i] = trim[i, SHIFT]
    write(
        Telemetry(
            reference.x,
            reference.v,
            reference.a,
            reference.j,
            float(choice.function),
            float(choice.status),
            stroke.z1,
            stroke.v_error,
            force.measured,
            force.required,
            state.v,
            flows.head,
            flows.rod,
            state.set_point,
            estimates[INVERSE_INERTIA],
            estimates[PAYLOAD_SHARE],
            estimates[DISTURBANCE],
            estimates[INVERSE_BULK],
            estimates[PAYLOAD_SHARE] / estimates[INVERSE_INERTIA],
            state.payload,
            state.payload - state.half,
            state.payload + state.half,
            memory.oil.bulk / (1.0 + memory.oil.softer),
            float(state.learning),
            float(limits),
        ),
        telemetry,
    )


@kernel
def step(t, sample, reference, axis, design, memory, command, telemetry):
    """One tick, see `Law`: observe, estimate, choose the function, write commands and telemetry.

    Read are this cylinder's channels but q̇, the other cylinders' joint angles, p_supply, p_tank;
    where others move as well the reference has the columns of `coupling.among_others`, at its end
    those of `trajectory.with_preview`. ``design`` are the gains of `pack_arc`, see `ease`."""
    circuit, state, number = axis.circuit, memory.state, axis.circuit.cylinder
    desired, p = reference_of(reference), pressures(sample, number)
    q, x, v = sample[entry(number, OF.q)], sample[entry(number, OF.x)], sample[entry(number, OF.v)]
    measured = load_force(p, circuit.area_head, circuit.area_rod)
    place_joints(sample, axis, memory.angles)
    inertia, tip = inertias(axis, memory.angles, memory.work)
    starting = state.started == 0
    if starting:
        # at rest, the chamber that carries the load metered
        state.started, state.function, state.slow_load = 1, HOLD, measured
        state.x, state.v, state.standstill = x, v, math.inf
        wait(measured, p, state)
        load = load_at(axis, q, inertia, memory.work)
        begin_estimates(measured, load, inertia, tip, design, state)
        begin(p, axis.onset, design, memory.maps)
        begin_oil(measured, axis.cylinder.bulk_modulus, memory.oil)
    gains = ease(design, tip / inertia, state, memory.gains)[0]
    if not starting:
        x, v = observe(x, v, gains, state)
    load, ahead = loads_along(reference, q, v, inertia, axis, memory)
    stroke = track_stroke(desired, x, v, gains)
    force = track_force(desired, v, measured, load, stroke, axis, gains, state.estimates)
    oil = oil_at(x, p, load, axis, gains, state.estimates)
    learning = state.learning if gains.adapt > 0.0 and not starting else FROZEN
    weight = state.estimates[INVERSE_INERTIA] / (load.mass * oil.coupling)
    mixed = stroke.z2 - weight * force.slope * force.z3
    adapt_mechanics(learning, mixed, force, gains, memory)
    rates = load_rate(desired, load, ahead, stroke, force, v, axis, memory)
    # what motion and leakages take [1/s], head·Q1 + rod·Q2
    speed = v + (required_speed(desired, memory.oil, gains) - desired.v)
    required = oil.head * (circuit.area_head * speed + oil.lost_head)
    required += oil.rod * (circuit.area_rod * speed + oil.lost_rod)
    required += track_flow(rates, learning, weight, stroke, force, oil, gains, memory)

    spool_speed = required / (oil.head * circuit.area_head + oil.rod * circuit.area_rod)
    choice = choose(desired, stroke.z1, measured, spool_speed, p, axis, gains, state)
    provide_headroom(choice, speeds_soon(reference), p, circuit, gains, memory)
    opened = opened_by(starting, p, rates[1], choice, oil, circuit, gains, state)
    flows = share_flows(choice, desired, required, oil, p, opened, axis, memory)
    edges = COLUMNS + circuit.count
    edge_flows, edge_limits = telemetry[COLUMNS:edges], telemetry[edges : edges + circuit.count]
    limits = allocate(
        choice.function, flows, opened, gains.drop_floor, circuit, command, edge_flows, edge_limits
    )
    if gains.standby > 0.0:
        bias_valves(axis, gains.standby, memory.maps.trim, command)
    state.learning = learns_next(choice, limits, edge_limits, circuit)
    learn(learning, starting, force, gains, memory)
    estimate_payload(starting, force, load, tip / inertia, v, axis, gains, state)
    estimate_bulk_modulus(choice, flows, limits, measured, v, oil, axis, memory)
    write_telemetry(desired, stroke, force, choice, flows, limits, memory, telemetry)
    adapt_maps(choice, Seen(v, p, oil), command, axis, gains, memory, telemetry)


def memory_of(axis: Axis) -> Memory:
    """The controller's memory before the first tick."""
    n = axis.mechanism.links.shape[0]
    return Memory(
        blank(STATE),
        np.zeros(COUNT),
        np.zeros(n),
        np.zeros((n, n)),
        np.zeros(work_size(n) + n),
        map_memory(axis.circuit),
        blank(OIL),
        rows_of(GAINS, None),
    )


def eased_gains(used: Mapping[str, Any], law: Controller) -> dict[str, Any]:
    """How far a payload reduced the bandwidths, ``eased``, and the changed ``gains_under_load``
    [SI]."""
    state = law.memory.state
    if state.eased == 0.0:
        return {}
    share, table = 1.0 - float(state.eased), rows_of(GAINS, None)
    slowed(law.gains, share, table)
    under = table[0]
    results = {name: float(under[name]) for name in GAIN_NAMES if under[name] != law.gains[name]}
    results |= {name: share * used["gains"][name] for name in ("adaptation", "adaptation_bulk")}
    return {
        "eased": {"share": share, "payload": float(state.heaviest)},
        "gains_under_load": results,
    }


def observed(axis: Axis, channels: int) -> np.ndarray:
    """True for the channels of a rig's sample that the controller is given, shape (channels,)."""
    mask = np.zeros(channels, bool)
    mask[[entry(c, OF.q) for c in range(axis.mechanism.joints.size)]] = True
    mask[[entry(axis.circuit.cylinder, channel) for channel in OF]] = True
    mask[pressure_entries(axis.circuit.cylinder, channels)] = True
    return mask


LAW = Law(
    name="arc",
    record=GAINS,
    step=step,
    gains=VOCABULARY_OF_GAINS,
    pack=pack,
    memory=memory_of,
    observed=observed,
    telemetry=Telemetry._fields,
    edge_telemetry=("map_gain", "map_shift"),
    bounds=("payload", "bulk_modulus"),
    ahead=ARC.ahead,
    preview=ARC.preview,
    after=eased_gains,
    warns_saturated=True,
)
