"""Energy-saving adaptive robust controller of one cylinder, the other joints held (thesis 4);
derivation in docs/arc.md.

Task level: `ehbench.control.functions` chooses the working function. Valve level: the off-side
chamber follows a low pressure; the other tracks the motion by backstepping (stroke → load force →
flow) with projected adaptation of inverse inertia, payload, disturbance and bulk modulus. Where one
spool opens both chambers, the same law drives its one opening."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ehbench.compiled import kernel, table
from ehbench.control.functions import (
    CROSS_DROP,
    DIRECTION,
    EXTEND_RESISTIVE_REGENERATION,
    FUNCTIONS,
    HEAD,
    HEAD_TANK,
    HOLD,
    METERED,
    METERING,
    ROD,
    ROD_TANK,
    RULES,
    SPEED_START,
    SUPPLY_HEAD,
    SUPPLY_ROD,
    Circuit,
    coupled,
    path_drop,
    select,
    widest,
)
from ehbench.control.trajectory import A, J, V, X
from ehbench.control.valve_level import AGAINST, REVERSED, SATURATED, give
from ehbench.errors import InputError
from ehbench.parts.edge import edge_command, edge_flow
from ehbench.physics import arm
from ehbench.physics.arm import gravity_torque, mass_matrix, work_size
from ehbench.physics.cylinder import chamber_volume, linkage

# a sample of a rig: this many channels a cylinder, then p_supply and p_tank
PER_CYLINDER, AT_Q, AT_X, AT_V, AT_HEAD, AT_ROD = 6, 0, 2, 3, 4, 5

# the four estimates, in order, with their units
ESTIMATES = ("inverse_inertia", "payload_share", "disturbance", "inverse_bulk")
INVERSE_INERTIA, PAYLOAD, DISTURBANCE, INVERSE_BULK = range(4)
_N = 4
# share of each estimate's bounds that scales its adaptation: inertia and disturbance shall not take
# what the payload explains
SHARES = np.array([0.3, 1.0, 0.2])

LOST = 0.01  # [m] between observed and measured stroke, at which the observer starts anew

# gains, see `pack_arc`
GAIN_NAMES = (
    "tick",
    "adapt",
    "position_bandwidth",
    "speed_bandwidth",
    "force_bandwidth",
    "coupling_frequency",
    "speed_tolerance",
    "force_tolerance",
    "robust_limit",
    "pressure_bandwidth",
    "low_pressure",
    "pressure_rate",
    "observer_bandwidth",
    "speed_correction",
    "speed_nudge",
    "stroke_resolution",
    "load_corner",
    "standby",
    "valve_lead",
    "drop_floor",
    "weighing_time",
    "reference_mass",
)
(
    TICK,
    ADAPT,
    POSITION,
    SPEED,
    FORCE,
    COUPLING,
    SPEED_TOLERANCE,
    FORCE_TOLERANCE,
    ROBUST_LIMIT,
    PRESSURE,
    LOW_PRESSURE,
    PRESSURE_RATE,
    OBSERVER,
    CORRECTION,
    NUDGE,
    RESOLUTION,
    LOAD_CORNER,
    STANDBY,
    LEAD,
    DROP_FLOOR,
    WEIGHING,
    REFERENCE_MASS,
) = range(22)
MAY_BE_ZERO = {
    "adapt",
    "coupling_frequency",
    "robust_limit",
    "low_pressure",
    "observer_bandwidth",
    "speed_nudge",
    "stroke_resolution",
    "standby",
    "valve_lead",
    "weighing_time",
}
AT_LOWER = len(GAIN_NAMES)
AT_UPPER, AT_RATE, AT_START = AT_LOWER + _N, AT_LOWER + 2 * _N, AT_LOWER + 3 * _N
AT_RULES = AT_LOWER + 4 * _N
GAINS = AT_RULES + RULES

# how the estimates learn: from the errors of tracking, from the load at rest, or not
FREE, FROZEN, WEIGHED = 0, 1, 2

# memory, before the workspace of the mechanism
(
    STARTED,
    FUNCTION,
    AGE,
    SIDE,
    SET_POINT,
    SLOW_LOAD,
    SLOW_ERROR,
    LEARNING,
    SEEN_X,
    SEEN_V,
    BIAS,
    MODEL_A,
) = range(12)
AT_ESTIMATES = 12
AT_WORK = AT_ESTIMATES + _N

# note: these, then (flow, limits) of each of the cylinder's edges
NOTE = (
    "x_desired",
    "v_desired",
    "a_desired",
    "j_desired",
    "function",
    "function_status",
    "x_error",
    "v_error",
    "load_force",
    "load_force_desired",
    "v_observed",
    "flow_head_desired",
    "flow_rod_desired",
    "pressure_set",
    "inverse_inertia",
    "payload_share",
    "disturbance",
    "inverse_bulk",
    "payload_estimate",
    "learning",
    "limits",
)
NOTES = len(NOTE)


class Axis(NamedTuple):
    """One cylinder of the design model and what it moves, as the controller takes it; made by
    `axis`.

    ``links`` are those of the rig without payload, ``tip`` those of the same mechanism without
    mass, but 1 kg at the end of the last link. ``joints`` is the joint of each cylinder, ``joint``
    the one that this cylinder drives, ``posture`` [rad or m] where joints without a cylinder stand.
    ``pins``: arguments of `linkage` before the angle. ``chambers``: dead volumes [m³], β [Pa],
    leakages internal, head, rod [m³/(s·Pa)]. ``friction``: viscous [N·s/m], Coulomb [N], its speed
    [m/s]. ``spool`` [8] is 1 for each working function whose two edges hang on one command, and for
    hold if there is such a one. ``onset`` [V] of each of the cylinder's edges: where it begins to
    pass oil, 0 where its valve has other edges as well."""

    circuit: Circuit
    kind: int
    gravity: np.ndarray
    links: np.ndarray
    tip: np.ndarray
    joints: np.ndarray
    joint: int
    posture: np.ndarray
    pins: np.ndarray
    chambers: np.ndarray
    friction: np.ndarray
    spool: np.ndarray
    onset: np.ndarray


V_HEAD, V_ROD, BULK, LEAK_INTERNAL, LEAK_HEAD, LEAK_ROD = range(6)


@kernel
def project(estimate, rate, lower, upper):
    """``rate`` of an estimate, or 0 where it would leave its bounds: the discontinuous projection."""
    if (estimate >= upper and rate > 0.0) or (estimate <= lower and rate < 0.0):
        return 0.0
    return rate


@kernel
def adapt(estimates, rates, lower, upper, tick):
    """Move the estimates, in place, over one tick; they cannot leave [lower, upper] whatever the
    rates are.
    """
    for i in range(estimates.shape[0]):
        moved = estimates[i] + tick * project(estimates[i], rates[i], lower[i], upper[i])
        if not math.isnan(moved):
            estimates[i] = min(max(moved, lower[i]), upper[i])


@kernel
def inertias(axis, angles, mass, work):
    """(D_jj, what 1 kg at the tip adds to it) about the axis's joint [kg·m²], or [kg] of a slide;
    q_j does not matter.
    """
    j = axis.joint
    mass_matrix(axis.kind, axis.links, angles, mass, work)
    own = mass[j, j]
    mass_matrix(axis.kind, axis.tip, angles, mass, work)
    return own, mass[j, j]


@kernel
def mechanics(axis, q, own, angles, work):
    """(m0 [kg], c/l [N], b/l² [N·s/m], κ/v² [1/m], G [N/kg], l [m/rad]) at joint coordinate q, seen
    at the cylinder.

    Of the rig without payload: equivalent mass ``m0 = D_jj/l²``, gravity force, joint damping, and
    the linkage's own acceleration ``κ = l′ q̇²``; of 1 kg at the tip: its gravity force G. ``own``
    is D_jj."""
    j = axis.joint
    _, lever, curve = linkage(
        int(axis.pins[0]), axis.pins[1], axis.pins[2], axis.pins[3], axis.pins[4], axis.pins[5], q
    )
    torque = work[work.shape[0] - axis.links.shape[0] :]
    per = 1.0 / lever
    angles[j] = q
    gravity_torque(axis.kind, axis.links, axis.gravity, angles, torque, work)
    held = torque[j] * per
    gravity_torque(axis.kind, axis.tip, axis.gravity, angles, torque, work)
    return (
        own * per * per,
        held,
        axis.links[j].damping * per * per,
        curve * per * per,
        torque[j] * per,
        lever,
    )


@kernel
def spool_flows(function, wanted, head_gain, rod_gain, p_head, p_rod, p_supply, p_tank, circuit):
    """(flow_head, flow_rod) [m³/s] of the one opening at which a spool gives ``head_gain·Q1 +
    rod_gain·Q2 = wanted``.

    False position with Illinois weights over the opening, in which both flows grow. What even the
    widest opening does not give is asked for in proportion, so that the valve level flags it."""
    way = DIRECTION[function]
    head_path = SUPPLY_HEAD if way > 0 else HEAD_TANK
    rod_path = ROD_TANK if way > 0 else SUPPLY_ROD
    if (
        way * wanted <= 0.0
    ):  # asked for against the function's direction: the valve level shuts and says so
        return wanted / head_gain, wanted / rod_gain
    one, two = circuit.paths[head_path], circuit.paths[rod_path]
    drop_one = path_drop(head_path, p_head, p_rod, p_supply, p_tank)
    drop_two = path_drop(rod_path, p_head, p_rod, p_supply, p_tank)
    along_one, along_two = circuit.along[head_path], circuit.along[rod_path]
    low, high = 0.0, widest(circuit, one, along_one * drop_one)
    goal = way * wanted
    at_low, at_high, flow_one, flow_two = -goal, 0.0, 0.0, 0.0
    side = 0
    for turn in range(19):
        at = high if turn == 0 else high - at_high * (high - low) / (at_high - at_low)
        flow_one = along_one * edge_flow(along_one * drop_one, at, circuit.edges[one], circuit.maps)
        flow_two = along_two * edge_flow(along_two * drop_two, at, circuit.edges[two], circuit.maps)
        given = head_gain * flow_one + rod_gain * flow_two
        if turn == 0:
            at_high = given - goal
            if at_high <= 0.0:
                more = goal / given if given > 0.0 else 2.0
                return way * flow_one * more, way * flow_two * more
            continue
        if abs(given - goal) <= 1e-9 * goal:
            break
        if given > goal:
            high, at_high = at, given - goal
            if side == 1:
                at_low *= 0.5
            side = 1
        else:
            low, at_low = at, given - goal
            if side == -1:
                at_high *= 0.5
            side = -1
    return way * flow_one, way * flow_two


@kernel
def stand_by(axis, share, command):
    """Raise the cylinder's shut cartridges to ``share`` of the command at which they begin to pass
    oil.
    """
    circuit = axis.circuit
    for i in range(circuit.count):
        edge = circuit.first + i
        valve = circuit.edges[edge].valve
        waits = share * axis.onset[i]
        if abs(command[valve]) < abs(waits):
            command[valve] = waits


@kernel
def clip(value, lower, upper):
    """``value`` held within [lower, upper]; NaN stays NaN."""
    return lower if value < lower else (upper if value > upper else value)


@kernel
def start_estimates(load, held, pull, own, tip, gains, estimates):
    """Write the first estimates: the design model's or, with adaptation, those that the pressures
    tell at rest.

    What the load force carries beyond the model's gravity is payload and disturbance, in the shares
    of their adaptation."""
    for i in range(_N):
        estimates[i] = gains[AT_START + i]
    if gains[ADAPT] == 0.0:
        return
    part = gains[AT_RATE + PAYLOAD] * pull * pull
    if part > 0.0:
        part /= part + gains[AT_RATE + DISTURBANCE]
        payload = clip(
            part * (load - held) / pull, gains[AT_LOWER + PAYLOAD], gains[AT_UPPER + PAYLOAD]
        )
        estimates[INVERSE_INERTIA] = clip(
            own / (own + tip * payload), gains[AT_LOWER], gains[AT_UPPER]
        )
        estimates[PAYLOAD] = estimates[INVERSE_INERTIA] * payload
    left = estimates[INVERSE_INERTIA] * (load - held) - estimates[PAYLOAD] * pull
    estimates[DISTURBANCE] = clip(
        left, gains[AT_LOWER + DISTURBANCE], gains[AT_UPPER + DISTURBANCE]
    )


@kernel
def observe(x, v, gains, memory):
    """(x [m], v [m/s]) of the observer, or as measured where it has no bandwidth.

    The model's acceleration and an unknown bias of it are integrated and corrected by the measured
    stroke, three poles at ``observer_bandwidth``: speed without the lag of a filter and without the
    noise of a difference."""
    if gains[OBSERVER] > 0.0:
        tick = gains[TICK]
        z = math.exp(-gains[OBSERVER] * tick)
        a = memory[MODEL_A] + memory[BIAS]
        seen = memory[SEEN_X] + tick * (memory[SEEN_V] + 0.5 * tick * a)
        miss = x - seen
        if abs(miss) > LOST:
            memory[SEEN_X], memory[SEEN_V], memory[BIAS] = x, v, -memory[MODEL_A]
            return x, v
        x = seen + (1.0 - z * z * z) * miss
        v = memory[SEEN_V] + tick * a + 1.5 * (1.0 - z) * (1.0 - z) * (1.0 + z) / tick * miss
        memory[BIAS] += (1.0 - z) ** 3 / (tick * tick) * miss
    memory[SEEN_X], memory[SEEN_V] = x, v
    return x, v


@kernel
def off_side(
    function, load, v_d, head_rate, rod_rate, p_head, p_rod, p_tank, circuit, gains, memory
):
    """What the off-side chamber's pressure asks for beyond ``A v_d``, as a speed of its piston face
    [m/s].

    Its set-point goes from where the pressure was when the chamber became the off-side to
    ``low_pressure`` above tank or, in the seventh function, to ``(P_L + Δp3 A1)/(A1 − A2)``.
    ``head_rate``, ``rod_rate`` [Pa/m] are β A/V of the chambers."""
    tick = gains[TICK]
    metered = METERED[function]
    if memory[SIDE] != metered:
        memory[SIDE] = metered
        memory[SET_POINT] = p_rod if metered == HEAD else p_head
    target = p_tank + gains[LOW_PRESSURE]
    if function == EXTEND_RESISTIVE_REGENERATION:
        target = (load + gains[AT_RULES + CROSS_DROP] * circuit.area_head) / (
            circuit.area_head - circuit.area_rod
        )
    # never so fast that the metered chamber would have to give way against the motion
    if metered == HEAD:
        fastest = head_rate * circuit.area_head / circuit.area_rod
    else:
        fastest = rod_rate * circuit.area_rod / circuit.area_head
    travel = min(gains[PRESSURE_RATE], 0.5 * fastest * abs(v_d)) * tick
    moved = clip(target - memory[SET_POINT], -travel, travel)
    memory[SET_POINT] += moved
    ramp = (
        moved / tick if abs(moved) == travel else 0.0
    )  # less than that is the noise of the tank's sensor
    if metered == HEAD:
        return (gains[PRESSURE] * (p_rod - memory[SET_POINT]) - ramp) / rod_rate
    return (gains[PRESSURE] * (memory[SET_POINT] - p_head) + ramp) / head_rate


@kernel
def step(t, sample, wish, axis, gains, memory, command, note):
    """One tick of the controller: observe, estimate, choose the function, write commands and note.

    Args:
        t: time [s], unused.
        sample: what the rig measured, shape (6·cylinders + 2,); read are this cylinder's channels
            but q̇, the other cylinders' joint angles, p_supply and p_tank.
        wish: x_d, v_d, a_d, j_d of the cylinder.
        axis: of the design model, an `Axis`.
        gains: of `pack_arc`.
        memory: state of the controller, shape (memory_size(axis),), zeros before the first tick.
        command: out, [V], one per valve of the rig; only this cylinder's are written.
        note: out, shape (NOTES + 2·edges of the cylinder,), columns as `note_channels`.
    """
    circuit = axis.circuit
    n = axis.links.shape[0]
    at = PER_CYLINDER * circuit.cylinder
    q, x, v, p_head, p_rod = (
        sample[at + AT_Q],
        sample[at + AT_X],
        sample[at + AT_V],
        sample[at + AT_HEAD],
        sample[at + AT_ROD],
    )
    p_supply, p_tank = sample[sample.shape[0] - 2], sample[sample.shape[0] - 1]
    tick = gains[TICK]
    estimates = memory[AT_ESTIMATES:AT_WORK]
    angles = memory[AT_WORK : AT_WORK + n]
    mass = memory[AT_WORK + n : AT_WORK + n + n * n].reshape((n, n))
    work = memory[AT_WORK + n + n * n :]
    for i in range(n):
        angles[i] = axis.posture[i]
    for c in range(axis.joints.shape[0]):
        angles[axis.joints[c]] = sample[PER_CYLINDER * c + AT_Q]
    angles[axis.joint] = q
    own, tip = inertias(axis, angles, mass, work)
    m0, held, damping, curve, pull, lever = mechanics(axis, q, own, angles, work)
    load = p_head * circuit.area_head - p_rod * circuit.area_rod
    friction = axis.friction
    turn = math.tanh(wish[V] / friction[2])

    starting = memory[STARTED] == 0.0
    if starting:
        memory[STARTED], memory[FUNCTION], memory[SLOW_LOAD] = 1.0, HOLD, load
        memory[SIDE] = HEAD if load >= 0.0 else ROD
        memory[SET_POINT] = p_rod if load >= 0.0 else p_head
        memory[SEEN_X], memory[SEEN_V] = x, v
        start_estimates(load, held, pull, own, tip, gains, estimates)
    else:
        x, v = observe(x, v, gains, memory)

    # the laws a moment ahead on the same motion, for their rates
    ahead = 1.0e-3
    m1, held1, damping1, curve1, pull1, _ = mechanics(
        axis, q + ahead * v / lever, own, angles, work
    )

    # step 1: stroke
    k1, k2, k3 = gains[POSITION], gains[SPEED], gains[FORCE]
    z1 = x - wish[X]
    pulled = k1 * z1
    if abs(pulled) > gains[CORRECTION]:
        pulled, k1 = math.copysign(gains[CORRECTION], pulled), 0.0
    v_error = v - wish[V]
    z2 = v_error + pulled
    a_eq = wish[A] - k1 * v_error

    # step 2: load force
    inverse, share, offset, softness = estimates[0], estimates[1], estimates[2], estimates[3]
    kappa = curve * v * v
    force = held + (damping + friction[0]) * v + friction[1] * turn
    phi1, phi2, phi3 = (load - force) / m0, -pull / m0, -1.0 / m0
    acceleration = kappa + inverse * phi1 + share * phi2 + offset * phi3
    wide = abs(phi1) * (gains[AT_UPPER] - gains[AT_LOWER])
    wide += abs(phi2) * (gains[AT_UPPER + 1] - gains[AT_LOWER + 1]) + abs(phi3) * (
        gains[AT_UPPER + 2] - gains[AT_LOWER + 2]
    )
    k2 += min(wide * wide / (4.0 * k2 * gains[SPEED_TOLERANCE] ** 2), gains[ROBUST_LIMIT] * k2)
    pushed = a_eq - kappa - k2 * z2
    need = m0 * pushed + share * pull + offset
    load_d = force + need / inverse
    z3 = load - load_d

    # adaptation: the gradient of both steps
    slope = damping + friction[0] - m0 / inverse * (k1 + 2.0 * curve * v + k2)
    chambers = axis.chambers
    head_gain = circuit.area_head / chamber_volume(chambers[V_HEAD], circuit.area_head * x)
    rod_gain = circuit.area_rod / chamber_volume(chambers[V_ROD], -circuit.area_rod * x)
    cross = chambers[BULK] * (head_gain * circuit.area_head + rod_gain * circuit.area_rod)
    if gains[COUPLING] > 0.0:
        cross = inverse * gains[REFERENCE_MASS] ** 2 * gains[COUPLING] ** 2 / m0
    weight = inverse / (m0 * cross)
    mixed = z2 - weight * slope * z3
    rates = work[:_N]
    learning = int(memory[LEARNING]) if gains[ADAPT] > 0.0 and not starting else FROZEN
    error = (
        mixed
        if learning == FREE
        else (-gains[WEIGHING] * acceleration if learning == WEIGHED else 0.0)
    )
    for i in range(3):
        phi = phi1 if i == 0 else (phi2 if i == 1 else phi3)
        rate = gains[AT_RATE + i] * phi * error
        rates[i] = project(estimates[i], rate, gains[AT_LOWER + i], gains[AT_UPPER + i])

    # step 3: flow
    moved = (m1 - m0) * pushed - m0 * (curve1 - curve) * v * v + share * (pull1 - pull)
    along = (held1 - held + (damping1 - damping) * v + moved / inverse) / ahead
    timed = friction[1] * (1.0 - turn * turn) * wish[A] / friction[2] + m0 / inverse * (
        wish[J] + k1 * wish[A] + k2 * a_eq
    )
    learnt = (-need / inverse * rates[0] + pull * rates[1] + rates[2]) / inverse
    load_rate = slope * acceleration + along + timed + learnt
    stiff = (gains[AT_UPPER + 3] - gains[AT_LOWER + 3]) / gains[AT_LOWER + 3]
    wide = abs(slope) * wide + stiff * abs(load_rate)
    k3 += min(wide * wide / (4.0 * k3 * gains[FORCE_TOLERANCE] ** 2), gains[ROBUST_LIMIT] * k3)
    # the feedback goes by the design's bulk modulus: it would teach that of the oil no more than
    # that it is not zero
    rates[3] = project(
        softness,
        -gains[AT_RATE + 3] * weight * z3 * load_rate if learning == FREE else 0.0,
        gains[AT_LOWER + 3],
        gains[AT_UPPER + 3],
    )
    across = chambers[LEAK_INTERNAL] * (p_head - p_rod)
    lost_head = across + chambers[LEAK_HEAD] * (p_head - p_tank)
    lost_rod = across - chambers[LEAK_ROD] * (p_rod - p_tank)
    soon = gains[LEAD] * wish[A]  # what the valves deliver is late by their lag
    wanted = head_gain * (circuit.area_head * (v + soon) + lost_head) + rod_gain * (
        circuit.area_rod * (v + soon) + lost_rod
    )
    wanted += (softness * load_rate - k3 * z3 - cross * z2) / chambers[BULK]

    # task level: the direction is that of the desired speed, led back to the desired stroke; an
    # error that the sensor cannot
    # tell from none asks for no motion. A spool passes its centre without switching, so it just
    # follows what is wanted.
    memory[SLOW_LOAD] -= math.expm1(-gains[LOAD_CORNER] * tick) * (load - memory[SLOW_LOAD])
    slow, now = memory[SLOW_LOAD], int(memory[FUNCTION])
    # where rest is wished for, what swings is left to calm down, and the error is led back at
    # little more than the speed
    # that it alone asks for
    resting = abs(wish[V]) <= gains[AT_RULES + SPEED_START]
    calm = math.exp(-2.0 * gains[POSITION] * tick) if resting else 0.0
    memory[SLOW_ERROR] = z1 + calm * (memory[SLOW_ERROR] - z1)
    blind = max(
        gains[RESOLUTION] - gains[AT_RULES + SPEED_START] / gains[POSITION], 0.3 * gains[RESOLUTION]
    )
    told = memory[SLOW_ERROR] - clip(memory[SLOW_ERROR], -blind, blind)
    toward = wish[V] - clip(gains[POSITION] * told, -gains[CORRECTION], gains[CORRECTION])
    led = 2.0 * abs(toward) + gains[NUDGE]
    if axis.spool[now] == 1 and not resting:
        toward = wanted / (head_gain * circuit.area_head + rod_gain * circuit.area_rod)
    function, status = select(
        now,
        memory[AGE],
        toward,
        slow,
        p_head,
        p_rod,
        p_supply,
        p_tank,
        circuit,
        gains[AT_RULES:GAINS],
    )
    if function != now:
        memory[AGE] = 0.0
    memory[AGE] += tick
    memory[FUNCTION] = function

    # valve level: the off-side chamber's flow follows its pressure, the rest of what is wanted is
    # the metered chamber's
    flow_head, flow_rod = 0.0, 0.0
    if function == HOLD:
        memory[SIDE] = HEAD if slow >= 0.0 else ROD
        memory[SET_POINT] = p_rod if memory[SIDE] == HEAD else p_head
    elif axis.spool[function] == 1:
        flow_head, flow_rod = spool_flows(
            function, wanted, head_gain, rod_gain, p_head, p_rod, p_supply, p_tank, circuit
        )
    else:
        way, stiff = DIRECTION[function], chambers[BULK] / softness
        extra = off_side(
            function,
            slow,
            wish[V],
            stiff * head_gain,
            stiff * rod_gain,
            p_head,
            p_rod,
            p_tank,
            circuit,
            gains,
            memory,
        )
        if METERED[function] == HEAD:
            flow_rod = circuit.area_rod * (wish[V] + soon + extra) + lost_rod
            flow_rod = 0.0 if way * flow_rod < 0.0 else flow_rod
            flow_head = (wanted - rod_gain * flow_rod) / head_gain
            if resting and way * flow_head > circuit.area_head * led:
                flow_head = way * circuit.area_head * led
        else:
            flow_head = circuit.area_head * (wish[V] + soon + extra) + lost_head
            flow_head = 0.0 if way * flow_head < 0.0 else flow_head
            flow_rod = (wanted - head_gain * flow_head) / rod_gain
            if resting and way * flow_rod > circuit.area_rod * led:
                flow_rod = way * circuit.area_rod * led

    edges = NOTES + circuit.count
    limits = give(
        function,
        flow_head,
        flow_rod,
        p_head,
        p_rod,
        p_supply,
        p_tank,
        gains[DROP_FLOOR],
        circuit,
        command,
        note[NOTES:edges],
        note[edges:],
    )
    if gains[STANDBY] > 0.0:
        stand_by(axis, gains[STANDBY], command)

    # a valve at its end, or a metered path that cannot follow, must not teach; where no motion is
    # wished for, the load is weighed
    bound = function == HOLD or limits & SATURATED != 0
    if not bound:
        bound = (
            int(note[edges + circuit.paths[METERING[function]] - circuit.first])
            & (AGAINST | REVERSED)
            != 0
        )
    memory[LEARNING] = WEIGHED if resting else (FROZEN if bound else FREE)
    if learning != FROZEN:
        adapt(estimates, rates, gains[AT_LOWER:AT_UPPER], gains[AT_UPPER:AT_RATE], tick)
    # what the estimates learn is no news to the observer
    learnt_a = (
        (estimates[0] - inverse) * phi1
        + (estimates[1] - share) * phi2
        + (estimates[2] - offset) * phi3
    )
    memory[MODEL_A] = acceleration + learnt_a
    memory[BIAS] -= learnt_a
    if starting:
        memory[BIAS] = -acceleration

    note[0], note[1], note[2], note[3] = wish[X], wish[V], wish[A], wish[J]
    note[4], note[5], note[6], note[7], note[8], note[9] = (
        function,
        status,
        z1,
        v_error,
        load,
        load_d,
    )
    note[10], note[11], note[12], note[13] = v, flow_head, flow_rod, memory[SET_POINT]
    for i in range(_N):
        note[14 + i] = estimates[i]
    note[18], note[19], note[20] = (
        estimates[PAYLOAD] / estimates[INVERSE_INERTIA],
        memory[LEARNING],
        limits,
    )


def memory_size(axis: Axis) -> int:
    """Length of the controller's memory."""
    n = axis.links.shape[0]
    return AT_WORK + n + n * n + max(work_size(n), _N) + n


def axis(
    circuit: Circuit,
    kind: int,
    gravity: np.ndarray,
    links: np.ndarray,
    joints: Sequence[int],
    posture: Sequence[float],
    pins: Sequence[float],
    chambers: Sequence[float],
    friction: Sequence[float] = (0.0, 0.0, 1.0),
) -> Axis:
    """The axis of one cylinder, from the arrays of the design model: the rig without payload.

    Args:
        circuit: the cylinder's, `ehbench.control.functions.circuit`.
        kind, gravity, links: of the mechanism, see `ehbench.physics.arm`.
        joints: the joint that each cylinder of the rig drives.
        posture: joint coordinates [rad or m] of all joints; the gains are scaled there.
        pins: kind, l_a, l_b, sign, phase, retracted of `ehbench.physics.cylinder.linkage`.
        chambers: dead volumes of head and rod [m³], β [Pa], leakages internal, head, rod
            [m³/(s·Pa)].
        friction: of the cylinder: viscous [N·s/m], Coulomb [N], speed over which it turns round
            [m/s].

    Raises:
        InputError: arrays that do not fit each other, or a number that is not finite.
    """
    tip = table(links.shape[0], arm.LINK)
    for key in ("a", "d", "cos_alpha", "sin_alpha", "theta0"):
        tip[key] = links[key]
    end = tip[-1]
    end.mass = 1.0
    if kind == arm.CHAIN:
        a, d = end.a, end.d
        end.hx, end.hz = a, d
        end.jxx, end.jyy, end.jzz, end.jxz = d * d, a * a + d * d, a * a, -a * d
    spool = np.array([coupled(circuit, f) for f in range(len(FUNCTIONS))], dtype=np.int64)
    spool[HOLD] = spool.max()
    own = range(circuit.first, circuit.first + circuit.count)
    alone = [np.count_nonzero(circuit.edges.valve == circuit.edges[e].valve) == 1 for e in own]
    onset = [
        edge_command(1.0e6, 1.0e-12, circuit.edges[e], circuit.maps) if one else 0.0
        for e, one in zip(own, alone, strict=True)
    ]
    made = Axis(
        circuit,
        int(kind),
        np.ascontiguousarray(gravity, float),
        links,
        tip,
        np.ascontiguousarray(joints, np.int64),
        int(joints[circuit.cylinder]),
        np.ascontiguousarray(posture, float),
        np.ascontiguousarray(pins, float),
        np.ascontiguousarray(chambers, float),
        np.ascontiguousarray(friction, float),
        spool,
        np.array(onset, float),
    )
    shapes = [part.shape for part in (made.posture, made.pins, made.chambers, made.friction)]
    if shapes != [(links.shape[0],), (6,), (6,), (3,)]:
        raise InputError(
            "the arrays of an axis do not fit each other",
            hint="posture: one a joint; 6 pins, 6 chambers",
        )
    numbers = (
        made.gravity,
        links.view(float),
        made.posture,
        made.pins,
        made.chambers,
        made.friction,
    )
    if (
        not all(np.isfinite(part).all() for part in numbers)
        or made.friction[2] <= 0
        or made.chambers[:3].min() <= 0
    ):
        raise InputError(
            "an axis needs finite numbers, and volumes, bulk modulus and friction speed above 0"
        )
    return made


def reference(axis: Axis) -> tuple[float, float, float]:
    """(m0 [kg], G [N/kg], share of D_jj that 1 kg at the tip adds [1/kg]) in the axis's posture;
    see `mechanics`.

    Raises:
        InputError: no lever there.
    """
    n = axis.links.shape[0]
    angles, work = axis.posture.copy(), np.zeros(work_size(n) + n)
    own, tip = inertias(axis, angles, np.zeros((n, n)), work)
    m0, _, _, _, pull, lever = mechanics(axis, float(angles[axis.joint]), own, angles, work)
    if abs(lever) < 1e-6 or not math.isfinite(m0):
        raise InputError(
            "the cylinder has no lever in the posture for which the controller is designed"
        )
    return m0, pull, tip / own


def hydraulic_frequency(axis: Axis) -> float:
    """ω_h [rad/s] of the bare rig on its oil, valves shut, in the axis's posture: ``ω_h² = β
    (A1²/V1 + A2²/V2)/m0``.
    """
    mass, _, _ = reference(axis)
    x, _, _ = linkage(int(axis.pins[0]), *axis.pins[1:], float(axis.posture[axis.joint]))
    head, rod = axis.circuit.area_head, axis.circuit.area_rod
    volumes = (
        chamber_volume(axis.chambers[V_HEAD], head * x),
        chamber_volume(axis.chambers[V_ROD], -rod * x),
    )
    return math.sqrt(axis.chambers[BULK] * (head**2 / volumes[0] + rod**2 / volumes[1]) / mass)


def pack_arc(
    axis: Axis,
    rules: np.ndarray,
    *,
    tick: float,
    supply_pressure: float,
    flow_limit: float,
    valve_lag: float,
    adapt: bool = True,
    lag_budget: float = 0.5,
    payload: tuple[float, float] | None = None,
    disturbance: float | None = None,
    bulk_modulus: tuple[float, float] | None = None,
    adaptation: float | None = None,
    adaptation_bulk: float | None = None,
    gains: Mapping[str, float] | None = None,
) -> np.ndarray:
    """The gains of `step`, shape (GAINS,), with defaults from what the valves and the supply allow.

    The valves are asked for phase up to the sum of the bandwidths k1 + k2 + k3 [rad/s]. By default
    that sum times the loop's lag is ``lag_budget``, shared out 1 : 2 : 4. ``docs/arc.md`` derives
    the other defaults.

    Args:
        axis: of the design model.
        rules: of function selection, `ehbench.control.functions.pack_rules`.
        tick: between samples [s].
        supply_pressure, flow_limit: of the supply [Pa, m³/s].
        valve_lag: of the cylinder's slowest valve, 2ζ/ω_n [s].
        adapt: False for the same law with its estimates left at the design model.
        lag_budget: [rad].
        payload: bounds of the payload at the end of the last link [kg]; 0 to 1.5 times that link's
            mass by default.
        disturbance: bound ± of the unknown force [N]; 3 % of supply pressure on the head end by
            default.
        bulk_modulus: its bounds [Pa]; the design's through and times 1.4 by default.
        adaptation: rate at which the mechanical estimates together follow [rad/s]; k1/4 by default.
        adaptation_bulk: the same of the bulk modulus [rad/s]; a fiftieth of ``adaptation`` by
            default.
        gains: any of GAIN_NAMES by name instead of its default: ``position_bandwidth``,
            ``speed_bandwidth``, ``force_bandwidth`` k1, k2, k3 [rad/s]; ``coupling_frequency`` ω3
            [rad/s], 0 for that of the oil's own spring at each stroke; ``speed_tolerance`` [m/s]
            and ``force_tolerance`` [N] to which the robust terms hold the errors, by at most
            ``robust_limit`` [1] of k2 and k3; ``pressure_bandwidth`` [rad/s] of the off-side, its
            set-point ``low_pressure`` [Pa] above tank and the rate of it ``pressure_rate`` [Pa/s];
            ``observer_bandwidth`` [rad/s], 0 for the measured speed; ``speed_correction`` [m/s]
            that a stroke error asks for at most; ``speed_nudge`` [m/s] and ``stroke_resolution``
            [m] at a wish to rest; ``load_corner`` [rad/s] of the load that chooses the function;
            ``standby`` [1] share of its deadband at which a shut valve waits; ``valve_lead`` [s] by
            which desired flows lead; ``drop_floor`` [Pa] of the inverse maps; ``weighing_time``
            [s], the gain of adaptation at rest; ``reference_mass`` [kg].

    Raises:
        InputError: an unknown gain, a number out of its range, bounds that do not hold the design
            model.
    """
    given = dict(gains or {})
    for name in given:
        if name not in GAIN_NAMES:
            raise InputError(
                f"the adaptive robust controller has no gain '{name}'",
                hint="it has " + ", ".join(GAIN_NAMES),
            )
    for name, value in ({"tick": tick, "lag_budget": lag_budget} | given).items():
        if not math.isfinite(value) or value < 0.0 or (value == 0.0 and name not in MAY_BE_ZERO):
            raise InputError(
                f"gain '{name}' of the adaptive robust controller is {value:g}",
                hint="it must be a number above 0",
            )
    mass, pull, ratio = reference(axis)
    area, beta = axis.circuit.area_head, axis.chambers[BULK]
    low, high = (0.0, 1.5 * float(axis.links[-1].mass)) if payload is None else payload
    worst = 0.03 * supply_pressure * area if disturbance is None else disturbance
    softest, hardest = (beta / 1.4, 1.4 * beta) if bulk_modulus is None else bulk_modulus
    lower = np.array([0.9 / (1.0 + high * ratio), low, -worst, beta / hardest])
    upper = np.array([1.1 / (1.0 + low * ratio), high, worst, beta / softest])
    start = np.array([1.0, low, 0.0, 1.0])

    total = lag_budget / (valve_lag + tick)
    k1, k2, k3 = (
        given.get(name, total * part / 7.0)
        for name, part in zip(GAIN_NAMES[POSITION : FORCE + 1], (1, 2, 4), strict=True)
    )
    omega = given.get("coupling_frequency") or hydraulic_frequency(axis)
    # regressors at a middling payload; 1 m/s² stands for the accelerations that tell the inertia
    phi = np.array([1.0 + 0.5 * abs(pull) * (high - low) / mass, pull / mass, 1.0 / mass])
    unknown = float(np.abs(phi) @ (upper - lower)[:3])
    # in quiet motion an acceleration error Δ shows as mixed = −answer·Δ, so that θ̂' = Γ φ mixed
    # makes Δ' = −adaptation·Δ
    at_speed = (1.0 + (k1 + k2) / k3) / (k2 + omega**2 / k3)
    answer = max(at_speed + (k1 + k2) / omega**2 * (k2 * at_speed - 1.0), 0.2 * at_speed)
    gamma = 0.25 * k1 if adaptation is None else adaptation
    variance = ((upper - lower)[:3] * SHARES) ** 2
    rate = np.zeros(_N)
    rate[:3] = gamma * variance / (answer * float(phi**2 @ variance))
    # 10 m/s³ times the reference mass stands for the force rates that tell the bulk modulus
    rate[3] = (
        (0.02 * gamma if adaptation_bulk is None else adaptation_bulk) * k3 * (omega / 10.0) ** 2
    )

    defaults = {
        "tick": tick,
        "adapt": float(adapt),
        "position_bandwidth": k1,
        "speed_bandwidth": k2,
        "force_bandwidth": k3,
        "coupling_frequency": 0.0,
        "speed_tolerance": unknown / (1.1 * k2),
        "force_tolerance": mass * (k1 + k2) * unknown / (1.1 * k3),
        "robust_limit": 0.3,
        "pressure_bandwidth": 0.5 * total,
        "low_pressure": supply_pressure / 20.0,
        "pressure_rate": 3.0 * supply_pressure,
        "observer_bandwidth": 90.0,
        "speed_correction": flow_limit / area,
        "speed_nudge": 0.01 * flow_limit / area,
        "stroke_resolution": 2.5e-5,
        "load_corner": 2.0 * math.pi,
        "standby": 0.8,
        "valve_lead": valve_lag + 0.5 * tick,
        "drop_floor": 2.0e4,
        "weighing_time": answer,
        "reference_mass": mass,
    }
    chosen = defaults | given
    if chosen["standby"] >= 1.0:
        raise InputError(
            f"gain 'standby' is {chosen['standby']:g}",
            hint="a share below 1, or shut valves would leak",
        )
    bounded = (
        low >= 0.0
        and np.isfinite([lower, upper]).all()
        and ((lower <= start) & (start <= upper)).all()
    )
    if not bounded or not (rate >= 0.0).all():
        raise InputError(
            "the bounds of the estimates do not hold the design model, or a rate of adaptation is negative",
            hint="payload 0 kg or more, lower bound first; disturbance 0 N or more; bulk_modulus around the design's",
        )
    return np.concatenate([[chosen[name] for name in GAIN_NAMES], lower, upper, rate, start, rules])


def note_channels(cylinder: str, edges: Sequence[str]) -> tuple[str, ...]:
    """Channel names of the note: ``<cylinder>.<name>``, then ``<edge>.flow_desired`` and
    ``<edge>.limits`` of each edge.
    """
    return (
        *(f"{cylinder}.{name}" for name in NOTE),
        *(f"{edge}.flow_desired" for edge in edges),
        *(f"{edge}.limits" for edge in edges),
    )


def entitled(axis: Axis, channels: int) -> np.ndarray:
    """True for the channels of a rig's sample that the controller is given, shape (channels,)."""
    mask = np.zeros(channels, bool)
    mask[[PER_CYLINDER * c + AT_Q for c in range(axis.joints.size)]] = True
    at = PER_CYLINDER * axis.circuit.cylinder
    mask[at : at + PER_CYLINDER] = True
    mask[-2:] = True
    return mask
