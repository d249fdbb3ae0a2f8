"""Openings of valves over a whole record, exact for commands held from sample to sample."""

from __future__ import annotations

import numpy as np

from ehbench.compiled import kernel
from ehbench.parts.valve import limited, valve_advance, valve_recover, valve_settle
from ehbench.plant.build import Plant


@kernel
def follow_valves(t, commands, plant, known, states):
    """Write the valves' states at every sample.

    Args:
        t: [s], shape (samples,).
        commands: [V], shape (samples, valves), limited here to each driver's range.
        known: True where ``states`` holds the openings and only what is behind them is missing;
            else valves start at rest at their command.
        states: of the plant, in and out, shape (samples, states).
    """
    for i in range(plant.valves.shape[0]):
        valve = plant.valves[i]
        if valve.output < 0:
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
            valve_advance(valve, signal, t[s + 1] - t[s], plant, states[s + 1])
            if known:
                states[s + 1, valve.output] = later


def opening_of(plant: Plant, valve: int, commands: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Opening [V] of a valve at states, shape (samples, states), under its commands [V], shape
    (samples,).
    """
    row = plant.valves[valve]
    if row.output < 0:
        return np.clip(commands, row.lowest, row.highest)
    return states[:, row.output]
