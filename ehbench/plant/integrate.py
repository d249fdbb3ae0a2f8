"""One integrator for every type of plant: fourth-order Runge–Kutta, more steps where it is
stiff."""

import math

import numpy as np

from ehbench.parts.valve.delay import line_acting, line_push
from ehbench.plant.derivatives import any_derivatives, any_finish
from ehbench.runtime.compiled import allocating_kernel, part_kernel

STEP = 5.0e-4  # [s]
STIFF = 1.0  # substeps are taken so that rate·step stays below this
# of the fastest rate met within a substep: beyond, it is taken again in shorter ones (Runge and
# Kutta's method ends at 2.78)
STABLE = 2.5
MOST_SUBSTEPS = 400


@part_kernel
def put(values, out):
    """Copy values; numba's ``out[:] = values`` takes two seconds to compile."""
    for i in range(values.shape[0]):
        out[i] = values[i]


@part_kernel
def rk4(y, command, plant, h, k, work):
    """One classical Runge–Kutta step of ``h`` [s] in place, more substeps where the plant is stiff;
    returns the substeps.

    ``k`` is a (5, states) scratch. ``k[0]`` holds the derivatives at the step's start and ``work``
    the edge flows there only if one substep was taken."""
    return advance(y, command, plant, h, k, work, any_derivatives(y, command, plant, k[0], work))


@part_kernel
def stages(y, command, plant, d, k, work):
    """Derivatives within a step of ``d`` [s], into ``k[1]`` to ``k[3]``; returns the fastest rate
    [1/s]."""
    size = y.shape[0]
    for i in range(size):
        k[4, i] = y[i] + 0.5 * d * k[0, i]
    fastest = any_derivatives(k[4], command, plant, k[1], work)
    for i in range(size):
        k[4, i] = y[i] + 0.5 * d * k[1, i]
    fastest = max(fastest, any_derivatives(k[4], command, plant, k[2], work))
    for i in range(size):
        k[4, i] = y[i] + d * k[2, i]
    return max(fastest, any_derivatives(k[4], command, plant, k[3], work))


@part_kernel
def advance(y, command, plant, h, k, work, rate):
    """`rk4` where ``k[0]`` and ``rate`` already hold what the derivatives give at ``y``. The
    damping of the joints counts here only: steps by their error follow it by themselves.

    A check valve that opens and shuts within a step is in no rate at its start, so a substep that
    meets a rate which it is too long for is taken again, and what is left of the step with it, in
    as many parts as that rate asks for."""
    size, left, taken = y.shape[0], 1.0, 0
    for c in range(plant.cylinders.shape[0]):
        row = plant.cylinders[c]
        rate = max(rate, row.joint_mobility * plant.links[row.joint].damping)
    if rate * h > STIFF:
        left = 1.0 * min(MOST_SUBSTEPS, math.ceil(rate * h / STIFF))
    d, maximum = h / left, MOST_SUBSTEPS / left
    while left > 0.0:
        if taken > 0:
            any_derivatives(y, command, plant, k[0], work)
        met = d * stages(y, command, plant, d, k, work)
        if met > STABLE and maximum >= 2.0:
            parts = 1.0 * math.ceil(min(met / STIFF, maximum))
            d, left, maximum = d / parts, left * parts, maximum / parts
        else:
            for i in range(size):
                y[i] += d / 6.0 * (k[0, i] + 2.0 * (k[1, i] + k[2, i]) + k[3, i])
            any_finish(y, command, plant, k[0], d)
            left, taken = left - 1.0, taken + 1
    return taken


@allocating_kernel
def run(y, commands, plant, line, steps, log):
    """Integrate from ``y`` (in place) through a table of commands, held over each tick; returns the
    most substeps.

    Args:
        y: state at the first sample.
        commands: [V], shape (samples, valves); row i acts from sample i on.
        line: of past commands; its ``tick`` is the time between samples [s].
        steps: integration steps a tick.
        log: out, shape (samples, states + edges + 1): the state, the edge flows and the pump flow
            at each sample, before the tick that starts there.
    """
    size, at = y.shape[0], plant.at.flow
    k, work = np.empty((5, size)), np.empty(plant.at.work)
    maximum, h = 1, line.tick / steps
    for sample in range(commands.shape[0]):
        line_acting(line, commands[sample], plant, 0.0, h)
        rate = any_derivatives(y, line.acting, plant, k[0], work)
        put(y, log[sample])
        put(work[at:], log[sample, size:])
        if sample + 1 < commands.shape[0]:
            maximum = max(maximum, advance(y, line.acting, plant, h, k, work, rate))
            for step in range(1, steps):
                line_acting(line, commands[sample], plant, step * h, h)
                maximum = max(maximum, rk4(y, line.acting, plant, h, k, work))
            line_push(line, commands[sample])
    return maximum
