"""Time in lanes: the loops of `ehbench.plant.integrate` and `ehbench.plant.paced` for several
plants at once, bit for bit.

With fixed steps each lane takes the substeps that it needs, and those that need fewer wait. Steps
of a mesh are those of all lanes."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ehbench.compiled import allocating_kernel, part_kernel
from ehbench.parts.valve.delay import line_felt, line_push
from ehbench.plant.derivatives import any_derivatives
from ehbench.plant.integrate import advance, rk4
from ehbench.plant.lanes.convert import of
from ehbench.plant.lanes.vectors import LANES
from ehbench.plant.paced import (
    LATE,
    MOST_TICKS,
    SCRATCH,
    Way,
    arrive,
    between,
    reach,
    weights_of,
)

_derivatives, _advance, _rk4 = of(any_derivatives), of(advance), of(rk4)
_felt, _push = of(line_felt), of(line_push)
_reach, _between, _arrive = of(reach), of(between), of(arrive)


@part_kernel
def _let(values, log, sample, column):
    """Write lanes into rows of their own, from a column on."""
    for lane in range(LANES):
        for i in range(values.shape[0]):
            log[lane, sample, column + i] = values[i, lane]


@allocating_kernel
def run_lanes(y, commands, plant, line, steps, log):
    """`ehbench.plant.integrate.run` in lanes: all arrays have a last axis of them.

    Args:
        y: states at the first sample, shape (states, LANES).
        commands: [V], shape (samples, valves or more, LANES).
        plant: in lanes (`ehbench.plant.lanes.pack`).
        line: of past commands, in lanes.
        steps: integration steps a tick.
        log: out, shape (LANES, samples, states + edges + 1).
    """
    size, at = y.shape[0], plant.at.flow
    k, work = np.empty((5, size, LANES)), np.empty((plant.at.work, LANES))
    h = line.tick / steps
    for sample in range(commands.shape[0]):
        _felt(True, line, commands[sample], plant, 0.0, h)
        rate = _derivatives(True, y, line.held, plant, k[0], work)
        _let(y, log, sample, 0)
        _let(work[at:], log, sample, size)
        if sample + 1 < commands.shape[0]:
            _advance(True, y, line.held, plant, h, k, work, rate)
            for step in range(1, steps):
                _felt(True, line, commands[sample], plant, step * h, h)
                _rk4(True, y, line.held, plant, h, k, work)
            _push(True, line, commands[sample])


@part_kernel
def _note_ends(y, sample, ends):
    """Note of the lanes that are no longer finite at a sample where they ended; whether any is."""
    some = False
    for lane in range(LANES):
        for i in range(y.shape[0]):
            if not math.isfinite(y[i, lane]):
                ends[lane] = min(ends[lane], sample)
        some = some or ends[lane] > sample
    return some


@part_kernel
def _add_means(way, log, each, sample, ends, ticks):
    """`ehbench.plant.paced`'s of the same name, in lanes."""
    first, d, k = sample + 1, ticks * way.line.tick, way.k
    while first <= ends and first < each * log.shape[1]:
        row = first // each
        until = min(ends + 1, (row + 1) * each)
        begin, end, slope, last = weights_of(first, until, ends, ticks, d, each)
        for lane in range(LANES):
            for i in range(way.y.shape[0]):
                one, other = way.y[i, lane], k[4, i, lane]
                value = begin * one + end * other + slope * k[0, i, lane] + last * k[5, i, lane]
                log[lane, row, i] += value
        first = until


class Held(NamedTuple):
    """Commands [V], a row whenever one changes, which they do in all lanes at once, shape (rows,
    valves or more, LANES); the sample from which each row acts, and last the number of samples.
    """

    commands: np.ndarray
    begins: np.ndarray


@allocating_kernel
def run_meshed(y, held, plant, line, pace, mesh, each, log):
    """`ehbench.plant.paced.run_paced` in lanes, along a mesh of steps, without flows.

    Args:
        y, plant, line: as `run_lanes` takes them.
        held: what is commanded.
        pace: of any of them.
        mesh: steps to take [units].
        each: samples of which a row of the log is the mean; more than one needs a log of zeros.
        log: out, shape (LANES, samples, states).
    """
    commands, begins = held
    size, last, units = y.shape[0], begins[-1] - 1, pace.units
    k, work = np.empty((SCRATCH, size, LANES)), np.empty((plant.at.work, LANES))
    way, row = Way(y, plant, line, pace, k, work), np.empty((size, LANES))
    late, unit, run = line.past.shape[0] > 1, line.tick / units, 0
    sample, part, ahead, there = 0, 0, 0, 0
    stops = np.full(LANES, last + 1)
    _felt(True, line, commands[0], plant, 0.0, line.tick / LATE)
    _derivatives(True, y, line.held, plant, k[0], work)
    for i in range(size):
        for lane in range(LANES):
            log[lane, 0, i] = y[i, lane] / each
    while sample < last:
        until = min(begins[run + 1], last, sample + (1 if late else MOST_TICKS * each))
        if ahead == 0:
            ahead, there = mesh[min(there, mesh.shape[0] - 1)], there + 1
        taken = min(ahead, units - part if part > 0 else (until - sample) * units)
        if late:
            taken = min(taken, units // LATE)
            _felt(True, line, commands[run], plant, part * unit, taken * unit)
            _derivatives(True, y, line.held, plant, k[0], work)
        _reach(True, way, line.held, taken * unit)
        ahead -= taken
        ends, part = sample + (part + taken) // units, (part + taken) % units
        if part == 0 and each > 1:
            _add_means(way, log, each, sample, ends, taken / units)
        elif part == 0:
            _let(k[4], log, ends, 0)
            for s in range(sample + 1, ends):
                _between(True, way, line.held, (s - sample) * units / taken, taken * unit, row)
                _let(row, log, s, 0)
        _arrive(True, way)
        if part == 0:
            if not _note_ends(y, ends, stops):
                break
            _push(True, line, commands[run])
            changed = ends == begins[run + 1]
            run += changed
            if late or changed:
                _felt(True, line, commands[run], plant, 0.0, line.tick / LATE)
                _derivatives(True, y, line.held, plant, k[0], work)
        sample = ends
    for lane in range(LANES):
        log[lane, stops[lane] // each :] = math.nan
