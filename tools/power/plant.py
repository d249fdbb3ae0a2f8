"""A cylinder with its valve and load, from the equations of the thesis (2.1, 2.4, 2.5, 2.10, 2.12)
and shared with nothing of the package: the oracle of the power study.

A slide, or a crane of one joint; a four-way spool, or four cartridges. SI, gauge pressures,
extension positive."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

HEAD_IN, ROD_OUT, ROD_IN, HEAD_OUT = range(4)  # edges: supply-head, rod-tank, supply-rod, head-tank
SMOOTH_DROP = 2.0e4  # [Pa]: below it an orifice's flow is linear in the drop
TURNING = 2.0e-3  # [m/s]: speed over which friction turns round


class Numbers(NamedTuple):
    """Numbers of a plant.

    ``crane``: 0 a slide of ``inertia`` [kg] and ``damping`` [N·s/m]; 1 one joint, its ``inertia``
    about the axis [kg·m²], ``damping`` [N·m·s/rad], and ``weight`` [N·m] at q = 0, where the load
    hangs level, with pins ``l_a``, ``l_b`` from the joint, ``phase`` and ``retracted`` length.
    ``spools``: 1 for a four-way valve, 4 for cartridges. ``gain`` and ``deadband`` by edge."""

    crane: int
    inertia: float
    damping: float
    weight: float
    rise: float
    l_a: float
    l_b: float
    phase: float
    retracted: float
    area_head: float
    area_rod: float
    volume_head: float
    volume_rod: float
    bulk_modulus: float
    supply: float
    tank: float
    leakage_internal: float
    leakage_head: float
    coulomb: float
    static: float
    stribeck_speed: float
    spools: int
    omega: float
    zeta: float
    gain: np.ndarray
    deadband: np.ndarray


@numba.njit(cache=True)
def stroke_of(n, q):
    """(stroke [m], lever ∂x/∂q [m/rad]) at a joint angle, or at a slide's position."""
    if n.crane == 0:
        return q, 1.0
    theta = q + n.phase
    c = math.sqrt(n.l_a**2 + n.l_b**2 - 2.0 * n.l_a * n.l_b * math.cos(theta))
    return c - n.retracted, n.l_a * n.l_b * math.sin(theta) / c


@numba.njit(cache=True)
def _flow(n, edge, opening, drop):
    wide = opening - n.deadband[edge]
    if wide <= 0.0:
        return 0.0
    return n.gain[edge] * wide * drop / (drop * drop + SMOOTH_DROP * SMOOTH_DROP) ** 0.25


@numba.njit(cache=True)
def _friction(n, v):
    dip = 0.0
    if n.static > n.coulomb:
        dip = (n.static - n.coulomb) * math.exp(-((v / n.stribeck_speed) ** 2))
    return (n.coulomb + dip) * math.tanh(v / TURNING)


@numba.njit(cache=True)
def _rates(n, y, u, dy):
    q, w, head, rod = y[0], y[1], y[2], y[3]
    x, lever = stroke_of(n, q)
    v = lever * w
    opening = np.empty(4)
    for e in range(4):
        if n.spools == 1:
            opening[e] = y[4] if e < 2 else -y[4]
        else:
            opening[e] = y[4 + 2 * e]
    into_head = _flow(n, HEAD_IN, opening[HEAD_IN], n.supply - head)
    into_head -= _flow(n, HEAD_OUT, opening[HEAD_OUT], head - n.tank)
    into_rod = _flow(n, ROD_IN, opening[ROD_IN], n.supply - rod)
    into_rod -= _flow(n, ROD_OUT, opening[ROD_OUT], rod - n.tank)
    across = n.leakage_internal * (head - rod)
    into_head -= across + n.leakage_head * (head - n.tank)
    into_rod += across
    stiff_head = n.bulk_modulus / (n.volume_head + n.area_head * x)
    stiff_rod = n.bulk_modulus / (n.volume_rod - n.area_rod * x)
    force = head * n.area_head - rod * n.area_rod - _friction(n, v)
    load = n.damping * w
    if n.crane == 1:
        load += n.weight * math.cos(q) - n.rise * math.sin(q)
    dy[0] = w
    dy[1] = (lever * force - load) / n.inertia
    dy[2] = stiff_head * (into_head - n.area_head * v)
    dy[3] = stiff_rod * (into_rod + n.area_rod * v)
    for i in range(n.spools):
        at = 4 + 2 * i
        dy[at] = y[at + 1]
        dy[at + 1] = n.omega**2 * (u[i] - y[at]) - 2.0 * n.zeta * n.omega * y[at + 1]


@numba.njit(cache=True)
def run(n, start, commands, tick, substeps):
    """States at each sample, shape (samples, 4 + 2 spools), by classical Runge–Kutta.

    Args:
        n: `Numbers`.
        start: state at the first sample: q, its rate, p_head, p_rod, then opening and rate of each
            spool.
        commands: [V], held from each sample on, shape (samples, spools).
        tick: time between samples [s].
        substeps: steps between samples."""
    y = start.copy()
    out = np.empty((commands.shape[0], y.size))
    k = np.empty((4, y.size))
    h = tick / substeps
    for i in range(commands.shape[0]):
        out[i] = y
        for _ in range(substeps):
            _rates(n, y, commands[i], k[0])
            _rates(n, y + 0.5 * h * k[0], commands[i], k[1])
            _rates(n, y + 0.5 * h * k[1], commands[i], k[2])
            _rates(n, y + h * k[2], commands[i], k[3])
            y = y + h / 6.0 * (k[0] + 2.0 * k[1] + 2.0 * k[2] + k[3])
    return out
