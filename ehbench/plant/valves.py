"""States that no sensor shows, over a whole record: of valves, frictions, lines and mounts."""

import numpy as np

from ehbench.parts.cylinder import linkage_of
from ehbench.parts.friction import friction_advance
from ehbench.parts.mount import mount_settle
from ehbench.parts.sway import sway_settle
from ehbench.parts.valve import limited, valve_advance, valve_recover, valve_settle
from ehbench.parts.valve.delay import line_acting, line_of, line_push
from ehbench.plant.build import Plant
from ehbench.plant.derivatives import derivatives
from ehbench.plant.integrate import MOST_SUBSTEPS, put
from ehbench.runtime.compiled import allocating_kernel, kernel


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
def _felt(commands, plant, line, h, out):
    for s in range(commands.shape[0]):
        line_acting(line, commands[s], plant, 0.0, h)
        for i in range(commands.shape[1]):
            out[s, i] = line.acting[i]
        line_push(line, commands[s])


def acting_commands(plant: Plant, commands: np.ndarray, tick: float, h: float) -> np.ndarray:
    """Commands [V] that act over ``h`` [s] from each sample on, shape (samples, valves), by the
    delays."""
    if not plant.valves.delay.any():
        return commands
    table = np.ascontiguousarray(commands, dtype=float)
    out = np.empty_like(table)
    _felt(table, plant, line_of(plant, tick, table.shape[1]), h, out)
    return out


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


@allocating_kernel
def follow_parts(t, commands, plant, states):
    """Write the states of lines and mounts at every sample, from rest on: their own rates, by
    Heun's steps, while all other states run straight from sample to sample.

    Args:
        t: [s], shape (samples,).
        commands: [V], shape (samples, valves or more).
        states: of the plant, in and out, shape (samples, states).
    """
    size = states.shape[1]
    moved = np.zeros(size, dtype=np.bool_)
    for i in range(plant.lines.shape[0]):
        row = plant.lines[i]
        moved[plant.nodes[row.node].state] = True
        states[0, plant.nodes[row.node].state] = states[0, plant.nodes[row.chamber].state]
    for c in range(plant.cylinders.shape[0]):
        mount_settle(plant.cylinders[c], 0.0, states[0], plant)
        if plant.cylinders[c].mount_state >= 0:
            moved[plant.cylinders[c].mount_state] = True
        sway_settle(plant.cylinders[c], 0.0, states[0])
        if plant.cylinders[c].sway_state >= 0:
            moved[plant.cylinders[c].sway_state] = moved[plant.cylinders[c].sway_state + 1] = True
    y, ahead, work = states[0].copy(), np.empty(size), np.empty(plant.at.work)
    first, last = np.empty(size), np.empty(size)
    for s in range(t.shape[0] - 1):
        dt, left = t[s + 1] - t[s], 1.0
        for i in range(size):
            if not moved[i]:
                y[i] = states[s, i]
        while left > 0.0:
            rate = derivatives(y, commands[s], plant, first, work)
            share = min(left, 1.0 / min(max(rate * dt, 1.0), MOST_SUBSTEPS))
            left = left - share if left - share > 1e-9 else 0.0
            for i in range(size):
                step = (
                    share * dt * first[i] if moved[i] else share * (states[s + 1, i] - states[s, i])
                )
                ahead[i] = y[i] + step
            derivatives(ahead, commands[s], plant, last, work)
            for i in range(size):
                if moved[i]:
                    ahead[i] = y[i] + 0.5 * share * dt * (first[i] + last[i])
            put(ahead, y)
        for i in range(size):
            if moved[i]:
                states[s + 1, i] = y[i]


def opening_of(plant: Plant, valve: int, commands: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Opening [V], shape (samples,), of a valve at states, shape (samples, states)."""
    row = plant.valves[valve]
    if row.output < 0:
        return np.clip(commands, row.lowest, row.highest)
    return states[:, row.output]
