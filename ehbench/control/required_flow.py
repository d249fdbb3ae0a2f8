"""The supply's flow for a desired motion: load by the equations of motion, functions, their oil."""

import math
from typing import NamedTuple

import numpy as np

from ehbench.control.axis import Axis, Mechanism
from ehbench.control.functions import select, supply_draw
from ehbench.control.measured import Pressures
from ehbench.parts.cylinder import linkage_arrays
from ehbench.physics.arm import bias_turned, mass_matrix_turned, turn, work_size
from ehbench.runtime.compiled import kernel
from ehbench.vocabulary.codes import HOLD


@kernel
def _torques(mechanism, q, rates, accelerations, mass, work, out):
    n = q.shape[1]
    for i in range(q.shape[0]):
        turn(mechanism.links, q[i], work)
        bias_turned(mechanism.kind, mechanism.links, mechanism.gravity, rates[i], out[i], work)
        mass_matrix_turned(mechanism.kind, mechanism.links, mass, work)
        for j in range(n):
            for k in range(n):
                out[i, j] += mass[j, k] * accelerations[i, k]


def torques(mechanism: Mechanism, q: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Torque of every joint [N·m], or force [N] of a slide, that a motion takes, shape (samples,
    n): ``D q̈ + h + c + B q̇`` of the mechanism, which carries no payload.

    Args:
        q: joint coordinates, shape (samples, n).
        joints: q̇, q̈ and more of every joint, shape (2 or more, samples, n).
    """
    n = q.shape[1]
    out, mass, work = np.empty(q.shape), np.empty((n, n)), np.empty(work_size(n))
    rates, accelerations = (np.ascontiguousarray(joint) for joint in joints[:2])
    _torques(mechanism, np.ascontiguousarray(q), rates, accelerations, mass, work, out)
    return out


@kernel
def _flows(v, load, line, tick, circuit, rules, out):
    now, age = HOLD, math.inf
    for i in range(v.shape[0]):
        head = rod = line.head
        if load[i] + rod * circuit.area_rod >= head * circuit.area_head:
            head = (load[i] + rod * circuit.area_rod) / circuit.area_head
        else:
            rod = (head * circuit.area_head - load[i]) / circuit.area_rod
        p = Pressures(head, rod, line.supply, line.tank)
        function, _ = select(now, age, v[i], load[i], p, circuit, rules)
        age = age + tick if function == now else tick
        now = function
        out[i] = supply_draw(function, circuit) * abs(v[i])


class Motion(NamedTuple):
    """A cylinder's motion, shape (samples,): ``v`` [m/s], ``torque`` of its joint [N·m], ``q``."""

    v: np.ndarray
    torque: np.ndarray
    q: np.ndarray


def required_flow(
    axis: Axis, motion: Motion, line: Pressures, tick: float, rules: np.record
) -> np.ndarray:
    """Flow [m³/s] that a cylinder's motion draws from the supply, shape (samples,), by the working
    functions that `ehbench.control.functions.select` chooses along it.

    Args:
        axis: of the cylinder.
        motion: of the cylinder.
        line: supply and tank pressure, and as ``head`` and ``rod`` that of a chamber which carries
            nothing [Pa].
        tick: between samples [s].
        rules: of function selection.
    """
    cylinder, v = axis.cylinder, np.ascontiguousarray(motion.v)
    x, lever = linkage_arrays(cylinder, motion.q)
    load = motion.torque / lever - axis.push + axis.stiffness * x + cylinder.friction_viscous * v
    load += cylinder.friction_coulomb * np.sign(v)
    out = np.empty(v.shape)
    _flows(v, load, line, tick, axis.circuit, rules, out)
    return out
