"""Powers and stores over a whole record: at its samples, or integrated with the plant's motion."""

import math
from typing import NamedTuple

import numpy as np

from ehbench.ledger.powers import powers, stores
from ehbench.parts.nodes import TANK
from ehbench.parts.oil import bulk_of
from ehbench.parts.valve.delay import line_acting, line_push
from ehbench.physics import arm
from ehbench.plant.derivatives import derivatives
from ehbench.plant.integrate import MOST_SUBSTEPS, STIFF, advance, put
from ehbench.runtime.compiled import allocating_kernel


class Integrated(NamedTuple):
    """What `integrate` writes: ``flows`` [m³/s] at each sample, shape (samples, edges + 1);
    ``energies`` of each tick [J], shape (samples − 1, columns); ``ends``, where each tick ended,
    shape (samples − 1, states).
    """

    flows: np.ndarray
    energies: np.ndarray
    ends: np.ndarray


@allocating_kernel
def integrate(t, states, commands, plant, line, owner, step, out):
    """Integrate each tick anew from its logged state with the plant's own kernel, and the powers
    with it by Simpson's rule.

    Args:
        line: of past commands.
        owner: cylinder to which each edge belongs.
        step: longest piece [s]; shorter ones are taken where the plant is stiff.
        out: where it goes.
    """
    size, columns, energies = states.shape[1], out.energies.shape[1], out.energies
    k = np.empty((5, size))
    work, at = np.empty(plant.at.work), plant.at.flow
    y, start, middle = np.empty(size), np.empty(columns), np.empty(columns)
    for i in range(t.shape[0]):
        put(states[i], y)
        tick = t[min(i + 1, t.shape[0] - 1)] - t[min(i, t.shape[0] - 2)]
        steps = max(1, math.ceil(tick / step - 1e-6))
        felt, fixed = tick / steps, line.acting
        line_acting(line, commands[i], plant, 0.0, felt)
        rate = derivatives(y, fixed, plant, k[0], work)
        put(work[at:], out.flows[i])
        if i + 1 == t.shape[0]:
            break
        pieces = min(MOST_SUBSTEPS, max(1, math.ceil(max(tick / step - 1e-6, rate * tick / STIFF))))
        h = tick / pieces
        powers(y, fixed, work[at:], plant, owner, start)
        energies[i] = 0.0
        for piece in range(pieces):
            if line.past.shape[0] > 1 and piece > 0:  # what is late may come in between
                line_acting(line, commands[i], plant, (piece * steps // pieces) * felt, felt)
                rate = derivatives(y, fixed, plant, k[0], work)
                powers(y, fixed, work[at:], plant, owner, start)
            for half in range(2):
                advance(y, fixed, plant, 0.5 * h, k, work, rate)
                rate = derivatives(y, fixed, plant, k[0], work)
                powers(y, fixed, work[at:], plant, owner, start if half else middle)
                for j in range(columns):
                    middle_part = 0.0 if half else h / 1.5 * middle[j]
                    energies[i, j] += h / 6.0 * start[j] + middle_part
        line_push(line, commands[i])
        put(y, out.ends[i])


@allocating_kernel
def flows_at(states, commands, tank, plant, flows):
    """Edge flows and the pump's at given states; ``tank`` [Pa] goes into the plant's nodes."""
    k = np.empty(states.shape[1])
    work = np.empty(plant.at.work)
    for i in range(states.shape[0]):
        plant.nodes[TANK].pressure = tank[i]
        derivatives(states[i], commands[i], plant, k, work)
        put(work[plant.at.flow :], flows[i])


@allocating_kernel
def powers_at(states, commands, flows, tank, plant, owner, out):
    """Powers [W] at given states and flows; ``tank`` as in `flows_at`."""
    for i in range(states.shape[0]):
        plant.nodes[TANK].pressure = tank[i]
        powers(states[i], commands[i], flows[i], plant, owner, out[i])


@allocating_kernel
def stiffness_at(cylinders, c, pressures):
    """Bulk modulus [Pa] of the oil of cylinder ``c`` at pressures [Pa], shape (samples, 2)."""
    out = np.empty(pressures.shape)
    for i in range(pressures.shape[0]):
        for side in range(pressures.shape[1]):
            out[i, side] = bulk_of(cylinders[c], pressures[i, side])
    return out


@allocating_kernel
def stores_at(states, plant, out):
    """What is stored [J] at given states."""
    work = np.empty(arm.work_size(plant.links.shape[0]))
    for i in range(states.shape[0]):
        stores(states[i], plant, work, out[i])
