"""Readings that a state implies: of a gauge across the piston and of a load cell in the rod."""

from collections.abc import Iterable

import numpy as np

from ehbench.parts.cylinder import chamber_of, linkage_of
from ehbench.parts.friction import friction_force
from ehbench.parts.mount import piston_of
from ehbench.plant.build import Plant
from ehbench.plant.layout import Layout
from ehbench.runtime.compiled import allocating_kernel
from ehbench.vocabulary.quantities import GAUGES


@allocating_kernel
def _gauged(states, cylinder, plant):
    """Readings of a cylinder's gauges, in the order of GAUGES, shape (gauges, samples).

    Load pressure ``p_head − p_rod``, load force ``P_L = p_head·A_head − p_rod·A_rod`` (thesis 2.2),
    rod force ``P_L − F(v)``: the friction of the seals is taken up by the barrel, and the masses of
    piston and rod are the mechanism's."""
    row, rates = plant.cylinders[cylinder], plant.at.rates
    out = np.zeros((3, states.shape[0]))
    for s in range(states.shape[0]):
        y = states[s]
        way, lever, _ = linkage_of(row, y[row.joint])
        _, v = piston_of(row, way, lever * y[rates + row.joint], y, plant)
        for side in range(2):
            node, area, _, _ = chamber_of(row, side)
            p = y[plant.nodes[node].state]
            out[0, s] += p if area > 0.0 else -p
            out[1, s] += p * area
        out[2, s] = out[1, s] - friction_force(row, v, y)
    return out


def gauged(
    plant: Plant, names: Layout, states: np.ndarray, required: Iterable[str]
) -> dict[str, np.ndarray]:
    """The required channels [SI] among a model's gauges, such as ``ram.rod_force``.

    Args:
        states: of the plant, shape (samples, states or more).
        required: full names, of anything.
    """
    requested = [(item, *item.rpartition(".")[::2]) for item in required]
    requested = [item for item in requested if item[2] in GAUGES and item[1] in names.cylinders]
    built = {
        cylinder: _gauged(states, names.cylinders.index(cylinder), plant)
        for cylinder in dict.fromkeys(cylinder for _, cylinder, _ in requested)
    }
    return {channel: built[cylinder][GAUGES.index(word)] for channel, cylinder, word in requested}
