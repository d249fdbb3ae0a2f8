"""What the motion of the other joints adds to what a cylinder moves, from the equations of the
mechanism (thesis 2.2), at the posture of all joints and with their desired rates and accelerations.

About joint j, ``D_jj q̈_j + Σ_{k≠j} D_jk q̈_k + h_j(q, q̇) + c_j(q) + b_j q̇_j = l_j F``: what stands
between the first and the last term is a torque that the others make, of the rig and of 1 kg at the
tip. So a law that knows both as gravity forces (`ehbench.control.axis.Load`) takes them as such."""

from typing import NamedTuple

import numpy as np

from ehbench.control.axis import Load
from ehbench.control.trajectory import ORDERS, A, J, V
from ehbench.parts.cylinder import linkage_arrays, linkage_of
from ehbench.physics.arm import bias_turned, mass_matrix_turned, turn
from ehbench.runtime.compiled import kernel


class Joints(NamedTuple):
    """The motion of all joints: ``angles`` q, ``rates`` q̇, ``accelerations`` q̈, shape (n,)."""

    angles: np.ndarray
    rates: np.ndarray
    accelerations: np.ndarray


@kernel
def _terms(axis, links, joints, mass, work):
    """(D_jj, c_j + h_j + Σ_{k≠j} D_jk q̈_k) of some links about joint j, after `turn`."""
    j, n, mechanism = axis.cylinder.joint, links.shape[0], axis.mechanism
    torque = work[work.shape[0] - n :]
    bias_turned(mechanism.kind, links, mechanism.gravity, joints.rates, torque, work)
    fixed = torque[j] - links[j].damping * joints.rates[j]
    mass_matrix_turned(mechanism.kind, links, mass, work)
    for k in range(n):
        if k != j:
            fixed += mass[j, k] * joints.accelerations[k]
    return mass[j, j], fixed


@kernel
def _load_among(axis, joints, mass, work):
    """The `Load` with what the other joints' motion adds to its gravity forces."""
    j, mechanism = axis.cylinder.joint, axis.mechanism
    _, lever, curve = linkage_of(axis.cylinder, joints.angles[j])
    per = 1.0 / lever
    turn(mechanism.links, joints.angles, work)
    inertia, fixed = _terms(axis, mechanism.links, joints, mass, work)
    _, pull = _terms(axis, axis.tip, joints, mass, work)
    return Load(
        inertia * per * per,
        fixed * per,
        mechanism.links[j].damping * per * per,
        curve * per * per,
        pull * per,
        lever,
    )


@kernel
def loads_among(row, q, v, ahead, axis, angles, mass, work):
    """The `Load` now and a time ``ahead`` [s] on the same motion, all joints moving.

    Args:
        row: of a reference: its own columns, then the joints' as `among_others` has them.
        q: coordinate of the cylinder's own joint [rad or m].
        v: speed of the cylinder [m/s].
        ahead: as `among_others` was given.
        angles: of the joints now, shape (n,); overwritten.
    """
    n = angles.shape[0]
    rates, accelerations = row[ORDERS : ORDERS + n], row[ORDERS + n : ORDERS + 2 * n]
    angles[axis.cylinder.joint] = q
    now = _load_among(axis, Joints(angles, rates, accelerations), mass, work)
    for k in range(n):
        angles[k] += ahead * rates[k]
    angles[axis.cylinder.joint] = q + ahead * v / now.lever
    soon, faster = row[ORDERS + 2 * n : ORDERS + 3 * n], row[ORDERS + 3 * n :]
    return now, _load_among(axis, Joints(angles, soon, faster), mass, work)


def joint_motion(row: np.record, q: np.ndarray, table: np.ndarray) -> np.ndarray:
    """(q̇, q̈, q⃛) of a cylinder's joint, shape (samples, 3), that make a table of its stroke.

    ``v = l q̇``, ``a = l q̈ + l′ q̇²`` and ``j = l q⃛ + 3 l′ q̇ q̈ + l″ q̇³``; l″ by a difference.

    Args:
        row: of the cylinder.
        q: joint coordinate at each row of the table [rad or m].
        table: x, v, a, j [m, …], shape (samples, 4).
    """
    step = 1.0e-5
    (_, lever), (_, more), (_, less) = (
        linkage_arrays(row, q + way * step) for way in (0.0, 1.0, -1.0)
    )
    curve, bend = (more - less) / (2.0 * step), (more - 2.0 * lever + less) / step**2
    rate = table[:, V] / lever
    acceleration = (table[:, A] - curve * rate**2) / lever
    jerk = (table[:, J] - 3.0 * curve * rate * acceleration - bend * rate**3) / lever
    return np.column_stack([rate, acceleration, jerk])


def among_others(table: np.ndarray, joints: np.ndarray, ahead: float) -> np.ndarray:
    """A table of references with the desired motion of all joints behind its own columns, shape
    (samples, 4 + 4 n): q̇, q̈ of every joint, then both ``ahead`` [s] on.

    Args:
        table: x, v, a, j of the cylinder, shape (samples, 4).
        joints: q̇, q̈, q⃛ of every joint, shape (3, samples, n).
    """
    rate, acceleration, jerk = joints
    soon = rate + ahead * acceleration, acceleration + ahead * jerk
    return np.ascontiguousarray(np.hstack([table, rate, acceleration, *soon]))
