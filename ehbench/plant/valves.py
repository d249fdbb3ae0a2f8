"""States that no sensor tells, over a whole record: openings of valves, exact for commands that are
held from sample to sample, and the states of frictions.
"""

from __future__ import annotations

import numpy as np

from ehbench.compiled import allocating_kernel, kernel
from ehbench.parts.cylinder import linkage_of
from ehbench.parts.friction import friction_advance
from ehbench.parts.valve import limited, valve_advance, valve_recover, valve_settle
from ehbench.plant.build import Plant


@allocating_kernel
def follow_valves(t, commands, plant, known, states):
    """Write the valves' states at every sample.

    Args:
        t: [s], shape (samples,).
        commands: [V], shape (samples, valves), limited here to each driver's range.
        known: True where ``states`` holds the openings and only what is behind them is missing,
            which it is not of a series of elements; else valves start at rest at their command.
        states: of the plant, in and out, shape (samples, states).
    """
    scratch = np.empty((5, states.shape[1]))
    for i in range(plant.valves.shape[0]):
        valve = plant.valves[i]
        if valve.output < 0 or (known and valve.count > 1):
            continue
        signal = limited(commands[0, i], valve)
        if not known:
            valve_settle(valve, signal, plant, states[0])
        elif t.shape[0] > 1:
            later = states[1, valve.output]
            valve_recover(valve, signal, t[1] - t[0], plant, states[0], later)
        for s in range(t.shape[0] - 1):
            later = states[s + 1, valve.output]
            for e in range(valve.first, valve.first + valve.count):
                first = plant.elements[e].state
                for k in range(first, first + plant.elements[e].states):
                    states[s + 1, k] = states[s, k]
            signal = limited(commands[s, i], valve)
            valve_advance(valve, signal, t[s + 1] - t[s], plant, states[s + 1], scratch)
            if known:
                states[s + 1, valve.output] = later


@kernel
def follow_friction(t, plant, states):
    """Write the frictions' own states at every sample, from rest on, by the joints' rates.

    Args:
        t: [s], shape (samples,).
        states: of the plant, in and out, shape (samples, states).
    """
    n = plant.at.rates
    for c in range(plant.cylinders.shape[0]):
        row = plant.cylinders[c]
        if row.friction_state < 0:
            continue
        for s in range(t.shape[0] - 1):
            _, lever, _ = linkage_of(row, states[s, row.joint])
            for k in range(row.friction_state, row.friction_state + row.friction_states):
                states[s + 1, k] = states[s, k]
            v = 0.5 * lever * (states[s, n + row.joint] + states[s + 1, n + row.joint])
            friction_advance(row, v, t[s + 1] - t[s], states[s + 1])


def opening_of(plant: Plant, valve: int, commands: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Opening [V] of a valve at states, shape (samples, states), under its commands [V], shape
    (samples,).
    """
    row = plant.valves[valve]
    if row.output < 0:
        return np.clip(commands, row.lowest, row.highest)
    return states[:, row.output]
