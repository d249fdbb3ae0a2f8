"""One cylinder of the design model and what it moves, as model-based controllers take it."""

import math
from typing import NamedTuple

import numpy as np

from ehbench.control.functions import Circuit, coupled
from ehbench.parts.cylinder import chamber_oil, linkage_of
from ehbench.parts.edge import edge_onset
from ehbench.parts.friction.coulomb_viscous import COULOMB_SPEED
from ehbench.physics.arm import (
    CHAIN,
    LINK,
    inertia_turned,
    plumb,
    turn,
    turn_joint,
    weigh_turned,
    work_size,
)
from ehbench.runtime.compiled import kernel, table
from ehbench.vocabulary import InputError, message
from ehbench.vocabulary.codes import FUNCTIONS, HOLD

# what must be known of the cylinder
NEEDED = (
    *("l_a", "l_b", "side", "phase", "retracted_length", "area_head", "area_rod"),
    *("volume_head", "volume_rod", "bulk_modulus"),
    *("leakage_internal", "leakage_head", "leakage_rod", "friction_viscous", "friction_coulomb"),
)


class Mechanism(NamedTuple):
    """The rig without payload, as `ehbench.physics.arm` has it.

    ``joints`` is the joint that each cylinder drives, ``posture`` [rad or m] the joint coordinates
    in which gains are scaled and joints without a cylinder stand."""

    kind: int
    gravity: np.ndarray
    links: np.ndarray
    joints: np.ndarray
    posture: np.ndarray


class Axis(NamedTuple):
    """One cylinder and what it moves; made by `axis_of`.

    ``tip`` are the links of the mechanism without mass, but 1 kg at the end of the last link.
    ``cylinder`` is its row of `ehbench.parts.cylinder.CYLINDER`. ``spool`` [functions] is 1 for
    each working function whose two edges hang on one command, and for hold if there is such a
    function. ``onset`` [V] of each of the cylinder's edges: where it begins to pass oil, 0
    where its valve has other edges as well. Forces from outside push the rod out by ``push``
    [N] at stroke 0, by ``stiffness`` [N/m] less with each metre."""

    circuit: Circuit
    mechanism: Mechanism
    tip: np.ndarray
    cylinder: np.record
    spool: np.ndarray
    onset: np.ndarray
    push: float
    stiffness: float


class Load(NamedTuple):
    """What a cylinder moves, seen at its rod, of the rig without payload.

    Equivalent mass ``m0 = D_jj/l²`` [kg], ``gravity`` force c/l [N] less the push from outside,
    joint ``damping`` b/l² [N·s/m], ``curve`` κ/v² [1/m] of the linkage's own acceleration
    ``κ = l′ q̇²``, ``pull`` G [N/kg] of 1 kg at the tip, ``lever`` l [m/rad]."""

    mass: float
    gravity: float
    damping: float
    curve: float
    pull: float
    lever: float


@kernel
def inertias(axis, angles, work):
    """(D_jj, what 1 kg at the tip adds) about the axis's joint [kg·m²] or [kg]; turns ``work``."""
    j, mechanism = axis.cylinder.joint, axis.mechanism
    turn(mechanism.links, angles, work)
    inertia = inertia_turned(mechanism.kind, mechanism.links, j, work)
    return inertia, inertia_turned(mechanism.kind, axis.tip, j, work)


@kernel
def load_at(axis, q, inertia, work):
    """The `Load` at joint coordinate q, after `inertias`, which turned the other joints."""
    j, mechanism = axis.cylinder.joint, axis.mechanism
    x, lever, curve = linkage_of(axis.cylinder, q)
    torque = work[work.shape[0] - mechanism.links.shape[0] :]
    per = 1.0 / lever
    turn_joint(mechanism.links, j, q, work)
    plumb(mechanism.kind, mechanism.links, mechanism.gravity, work)
    weigh_turned(mechanism.kind, mechanism.links, mechanism.gravity, j, torque, work)
    fixed = torque[j] * per - axis.push + axis.stiffness * x
    weigh_turned(mechanism.kind, axis.tip, mechanism.gravity, j, torque, work)
    return Load(
        inertia * per * per,
        fixed,
        mechanism.links[j].damping * per * per,
        curve * per * per,
        torque[j] * per,
        lever,
    )


def axis_of(
    circuit: Circuit, mechanism: Mechanism, cylinder: np.record, forces: np.ndarray
) -> Axis:
    """The axis of one cylinder.

    Args:
        circuit: the cylinder's, `ehbench.control.functions.circuit`.
        mechanism: of the design model.
        cylinder: its row of the plant.
        forces: all of the plant, of `ehbench.parts.load.FORCE`.

    Raises:
        InputError: a number that is not finite.
    """
    mechanism = Mechanism(
        int(mechanism.kind),
        np.ascontiguousarray(mechanism.gravity, float),
        mechanism.links,
        np.ascontiguousarray(mechanism.joints, np.int64),
        np.ascontiguousarray(mechanism.posture, float),
    )
    spool = np.array([coupled(circuit, f) for f in range(len(FUNCTIONS))], dtype=np.int64)
    spool[HOLD] = spool.max()
    parts = (mechanism.gravity, mechanism.links.view(float), mechanism.posture)
    needed = [cylinder[name] for name in NEEDED]
    if not all(np.isfinite(part).all() for part in (*parts, needed)) or not (
        min(cylinder.volume_head, cylinder.volume_rod, cylinder.bulk_modulus) > 0.0
    ):
        raise InputError(message("control.axis_not_finite"))
    own = forces[forces["cylinder"] == circuit.cylinder]
    cylinder = cylinder.copy()
    # what a force takes from a moving rod in either direction acts as Coulomb friction does
    cylinder.friction_coulomb += 0.5 * float((own["retracting"] - own["extending"]).sum())
    # what is given ahead must not jump where friction turns round at once
    cylinder.coulomb_speed = max(cylinder.coulomb_speed, COULOMB_SPEED)
    push = 0.5 * (own["extending"] + own["retracting"]) + own["stiffness"] * own["free_length"]
    tip, onset = _tip(mechanism.kind, mechanism.links), np.zeros(circuit.count)
    for i in range(circuit.count):
        edge = circuit.edges[circuit.first + i]
        if np.count_nonzero(circuit.edges.valve == edge.valve) == 1:
            onset[i] = edge_onset(edge, circuit.maps)
    stiffness = float(own["stiffness"].sum())
    return Axis(circuit, mechanism, tip, cylinder, spool, onset, float(push.sum()), stiffness)


def _tip(kind: int, links: np.ndarray) -> np.ndarray:
    """The links without mass, but 1 kg at the end of the last."""
    tip = table(links.shape[0], LINK)
    for key in ("a", "d", "cos_alpha", "sin_alpha", "theta0"):
        tip[key] = links[key]
    end = tip[-1]
    end.mass = 1.0
    if kind == CHAIN:
        a, d = end.a, end.d
        end.hx, end.hz = a, d
        end.jxx, end.jyy, end.jzz, end.jxz = d * d, a * a + d * d, a * a, -a * d
    return tip


def reference_load(axis: Axis) -> tuple[Load, float]:
    """(`Load`, share of D_jj that 1 kg at the tip adds [1/kg]) in the axis's posture.

    Raises:
        InputError: no lever there.
    """
    n = axis.mechanism.links.shape[0]
    angles, work = axis.mechanism.posture.copy(), np.zeros(work_size(n) + n)
    inertia, tip = inertias(axis, angles, work)
    load = load_at(axis, float(angles[axis.cylinder.joint]), inertia, work)
    if abs(load.lever) < 1e-6 or not math.isfinite(load.mass):
        raise InputError(message("control.no_lever"))
    return load, tip / inertia


def hydraulic_frequency(axis: Axis, load: Load | None = None) -> float:
    """ω_h [rad/s] of the bare rig on its oil, valves shut, in the axis's posture: ``ω_h² = k/m0``,
    ``k = β (A1²/V1 + A2²/V2)``, in series with a mount that gives way. ``load`` is that of the
    posture, where it is known."""
    load = load or reference_load(axis)[0]
    cylinder = axis.cylinder
    x, _, _ = linkage_of(cylinder, float(axis.mechanism.posture[cylinder.joint]))
    head, rod = cylinder.area_head, cylinder.area_rod
    spring = head**2 / chamber_oil(cylinder, 0, x) + rod**2 / chamber_oil(cylinder, 1, x)
    if cylinder.mount_state >= 0:
        spring /= 1.0 + cylinder.bulk_modulus * spring / cylinder.mount_stiffness
    return math.sqrt((cylinder.bulk_modulus * spring + axis.stiffness) / load.mass)
