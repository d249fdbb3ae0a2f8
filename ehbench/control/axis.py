"""One cylinder of the design model and what it moves, as model-based controllers take it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ehbench.codes import FUNCTIONS, HOLD
from ehbench.compiled import kernel
from ehbench.control.functions import Circuit, coupled
from ehbench.errors import InputError
from ehbench.physics import arm
from ehbench.physics.arm import gravity_torque, mass_matrix, work_size
from ehbench.physics.cylinder import chamber_volume, linkage
from ehbench.physics.metering import VALVE, edge_command


class Mechanism(NamedTuple):
    """The rig without payload, as `ehbench.physics.arm` has it.

    ``joints`` is the joint that each cylinder drives, ``posture`` [rad or m] the joint coordinates
    in which gains are scaled and joints without a cylinder stand."""

    kind: int
    gravity: np.ndarray
    links: np.ndarray
    joints: np.ndarray
    posture: np.ndarray


class Pins(NamedTuple):
    """Arguments of `ehbench.physics.cylinder.linkage` before the angle: kind, lengths [m], side,
    phase [rad], retracted length [m].
    """

    kind: int
    l_a: float
    l_b: float
    side: float
    phase: float
    retracted: float


class Chambers(NamedTuple):
    """Dead volumes [m³], bulk modulus β [Pa], leakages internal, head, rod [m³/(s·Pa)]."""

    volume_head: float
    volume_rod: float
    bulk: float
    leak_internal: float
    leak_head: float
    leak_rod: float


class Friction(NamedTuple):
    """Of the cylinder: viscous [N·s/m], Coulomb [N], speed over which it turns round [m/s]."""

    viscous: float = 0.0
    coulomb: float = 0.0
    speed: float = 1.0


class Axis(NamedTuple):
    """One cylinder and what it moves; made by `axis_of`.

    ``tip`` are the links of the mechanism without mass, but 1 kg at the end of the last link.
    ``joint`` is the one that this cylinder drives. ``spool`` [8] is 1 for each working function
    whose two edges hang on one command, and for hold if there is such a one. ``onset`` [V] of each
    of the cylinder's edges: where it begins to pass oil, 0 where its valve has other edges as
    well."""

    circuit: Circuit
    mechanism: Mechanism
    tip: np.ndarray
    joint: int
    pins: Pins
    chambers: Chambers
    friction: Friction
    spool: np.ndarray
    onset: np.ndarray


class Load(NamedTuple):
    """What a cylinder moves, seen at its rod, of the rig without payload.

    Equivalent mass ``m0 = D_jj/l²`` [kg], ``gravity`` force c/l [N], joint ``damping`` b/l²
    [N·s/m], ``curve`` κ/v² [1/m] of the linkage's own acceleration ``κ = l′ q̇²``, ``pull`` G [N/kg]
    of 1 kg at the tip, ``lever`` l [m/rad]."""

    mass: float
    gravity: float
    damping: float
    curve: float
    pull: float
    lever: float


@kernel
def inertias(axis, angles, mass, work):
    """(D_jj, what 1 kg at the tip adds to it) about the axis's joint [kg·m²], or [kg] of a slide;
    q_j does not matter.
    """
    j, mechanism = axis.joint, axis.mechanism
    mass_matrix(mechanism.kind, mechanism.links, angles, mass, work)
    own = mass[j, j]
    mass_matrix(mechanism.kind, axis.tip, angles, mass, work)
    return own, mass[j, j]


@kernel
def load_at(axis, q, own, angles, work):
    """The `Load` at joint coordinate q; ``own`` is D_jj, ``angles`` the other joints'."""
    j, mechanism, pins = axis.joint, axis.mechanism, axis.pins
    _, lever, curve = linkage(
        pins.kind, pins.l_a, pins.l_b, pins.side, pins.phase, pins.retracted, q
    )
    torque = work[work.shape[0] - mechanism.links.shape[0] :]
    per = 1.0 / lever
    angles[j] = q
    gravity_torque(mechanism.kind, mechanism.links, mechanism.gravity, angles, torque, work)
    held = torque[j] * per
    gravity_torque(mechanism.kind, axis.tip, mechanism.gravity, angles, torque, work)
    return Load(
        own * per * per,
        held,
        mechanism.links[j, arm.DAMPING] * per * per,
        curve * per * per,
        torque[j] * per,
        lever,
    )


def axis_of(
    circuit: Circuit,
    mechanism: Mechanism,
    pins: Pins,
    chambers: Chambers,
    friction: Friction | None = None,
) -> Axis:
    """The axis of one cylinder.

    Args:
        circuit: the cylinder's, `ehbench.control.functions.circuit`.
        mechanism: of the design model.
        pins, chambers, friction: of the cylinder; no friction by default.

    Raises:
        InputError: parts that do not fit each other, or a number that is not finite.
    """
    links = np.ascontiguousarray(mechanism.links, float)
    mechanism = Mechanism(
        int(mechanism.kind),
        np.ascontiguousarray(mechanism.gravity, float),
        links,
        np.ascontiguousarray(mechanism.joints, np.int64),
        np.ascontiguousarray(mechanism.posture, float),
    )
    friction = Friction() if friction is None else friction
    spool = np.array([coupled(circuit, f) for f in range(len(FUNCTIONS))], dtype=np.int64)
    spool[HOLD] = spool.max()
    made = Axis(
        circuit,
        mechanism,
        _tip(mechanism.kind, links),
        int(mechanism.joints[circuit.cylinder]),
        Pins(int(pins[0]), *map(float, pins[1:])),
        Chambers(*map(float, chambers)),
        Friction(*map(float, friction)),
        spool,
        _onsets(circuit),
    )
    if mechanism.posture.shape != (links.shape[0],):
        raise InputError(
            "the parts of an axis do not fit each other", hint="posture: one coordinate a joint"
        )
    parts = (mechanism.gravity, links, mechanism.posture, made.pins, made.chambers, made.friction)
    if (
        not all(np.isfinite(part).all() for part in parts)
        or made.friction.speed <= 0.0
        or min(made.chambers[:3]) <= 0.0
    ):
        raise InputError(
            "an axis needs finite numbers, and volumes, bulk modulus and friction speed above 0"
        )
    return made


def _tip(kind: int, links: np.ndarray) -> np.ndarray:
    """The links without mass, but 1 kg at the end of the last."""
    tip = np.zeros_like(links)
    keep = [arm.A, arm.D, arm.COS_ALPHA, arm.SIN_ALPHA, arm.THETA0]
    tip[:, keep] = links[:, keep]
    end = tip[-1]
    end[arm.MASS] = 1.0
    if kind == arm.CHAIN:
        a, d = end[arm.A], end[arm.D]
        end[[arm.HX, arm.HZ, arm.JXX, arm.JYY, arm.JZZ, arm.JXZ]] = (
            a,
            d,
            d * d,
            a * a + d * d,
            a * a,
            -a * d,
        )
    return tip


def _onsets(circuit: Circuit) -> np.ndarray:
    """Command [V] at which each edge begins to pass oil, 0 where it shares its valve."""
    onset = np.zeros(circuit.count)
    for i in range(circuit.count):
        e = circuit.first + i
        row = circuit.wiring[e]
        if np.count_nonzero(circuit.wiring[:, VALVE] == row[VALVE]) == 1:
            onset[i] = edge_command(1.0e6, 1.0e-12, circuit.edges[e], row, circuit.maps)
    return onset


def reference_load(axis: Axis) -> tuple[Load, float]:
    """(`Load`, share of D_jj that 1 kg at the tip adds [1/kg]) in the axis's posture.

    Raises:
        InputError: no lever there.
    """
    n = axis.mechanism.links.shape[0]
    angles, work = axis.mechanism.posture.copy(), np.zeros(work_size(n) + n)
    own, tip = inertias(axis, angles, np.zeros((n, n)), work)
    load = load_at(axis, float(angles[axis.joint]), own, angles, work)
    if abs(load.lever) < 1e-6 or not math.isfinite(load.mass):
        raise InputError(
            "the cylinder has no lever in the posture for which the controller is designed"
        )
    return load, tip / own


def hydraulic_frequency(axis: Axis) -> float:
    """ω_h [rad/s] of the bare rig on its oil, valves shut, in the axis's posture: ``ω_h² = β
    (A1²/V1 + A2²/V2)/m0``.
    """
    load, _ = reference_load(axis)
    x, _, _ = linkage(*axis.pins, float(axis.mechanism.posture[axis.joint]))
    head, rod = axis.circuit.area_head, axis.circuit.area_rod
    volumes = (
        chamber_volume(axis.chambers.volume_head, head * x),
        chamber_volume(axis.chambers.volume_rod, -rod * x),
    )
    return math.sqrt(axis.chambers.bulk * (head**2 / volumes[0] + rod**2 / volumes[1]) / load.mass)
