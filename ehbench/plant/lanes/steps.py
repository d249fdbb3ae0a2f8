"""Fixed steps in lanes: the loop of `ehbench.plant.integrate` for several plants at once, bit for
bit. Each lane takes the substeps that it needs, and those that need fewer wait.
"""

from __future__ import annotations

import numpy as np

from ehbench.parts.valve.delay import line_felt, line_push
from ehbench.plant.derivatives import any_derivatives
from ehbench.plant.integrate import advance, rk4
from ehbench.plant.lanes.convert import of
from ehbench.plant.lanes.vectors import LANES
from ehbench.runtime.compiled import allocating_kernel, part_kernel

_derivatives, _advance, _rk4 = of(any_derivatives), of(advance), of(rk4)
_felt, _push = of(line_felt), of(line_push)


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
