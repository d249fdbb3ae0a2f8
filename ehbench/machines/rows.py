"""A trial's rows as compiled code sees them, the limits that stop it, one tick of a controller."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba.extending import overload

from ehbench.control.law import Controller
from ehbench.control.registry import tick
from ehbench.parts.cylinder import linkage_of
from ehbench.parts.sample import OF, entry
from ehbench.physics.cylinder import DIRECT
from ehbench.runtime.compiled import WITHIN, kernel, part_kernel

LIMITS = (
    *("pressure_max", "pressure_min", "stroke_margin", "speed_max", "command_max"),
    *("command_rate", "pressure_range", "sample_age", "overrun", "following_time"),
    *("following_error", "position_mismatch", "finite", "machine", "monitor"),
)
PRESSURE_MAX, PRESSURE_MIN, MARGIN, SPEED, COMMAND = range(5)
COMMAND_RATE, PRESSURE_RANGE, AGE, OVERRUN, FOLLOWING_TIME = range(5, 10)
FOLLOWING, MISMATCH, FINITE, MACHINE, MONITOR = range(10, 15)
VACUUM = -1.5e5  # [Pa] gauge: a perfect vacuum, and half a bar of a sensor's offset
FORGETS = 1.0  # [s] until what a speed's error added to a stroke is forgotten


class Checks(NamedTuple):
    """What a sample is compared with beside the limits of all cylinders.

    ``armed`` is [False] where nothing is checked, as after a stop; ``measured`` marks the channels
    that the machine measures; ``cylinders`` are the rig's. ``desired`` strokes [m], shape (samples,
    cylinders), nan where no law controls the stroke; ``following`` and ``mismatch`` their bounds
    [m], shape (cylinders,); ``since`` the first row of a following error, −1 without one;
    ``apart`` what the strokes moved beyond their speed [m], shape (cylinders,); ``alarms``, shape
    (cylinders,), those of `ehbench.control.monitor.Monitor`. ``stamp`` is (time [s], sequence, age
    [s], reason of a machine that stopped by itself, time [s] that the controller took) of the
    present sample."""

    armed: np.ndarray
    measured: np.ndarray
    cylinders: np.ndarray
    desired: np.ndarray
    following: np.ndarray
    mismatch: np.ndarray
    since: np.ndarray
    apart: np.ndarray
    alarms: np.ndarray
    stamp: np.ndarray


class Rows(NamedTuple):
    """A trial's rows, one a tick, and what is checked in each.

    ``t`` [s]; ``commands`` [V], shape (samples, valves), into which a controller writes its own;
    ``samples`` what was measured, shape (samples, channels); ``truth`` what only a simulation
    knows, its `Truth` or `Hidden`, shape (samples, width). ``sample`` is the present sample, which
    no row holds yet. ``limits`` are in the order of LIMITS, SI, those of each cylinder apart;
    ``strokes`` the full strokes [m]; ``reached`` says of a limit that was reached (which, cylinder
    or valve, entry of the sample), ``by`` the value that reached it and its bound [SI]."""

    t: np.ndarray
    commands: np.ndarray
    samples: np.ndarray
    truth: np.ndarray
    sample: np.ndarray
    limits: np.ndarray
    strokes: np.ndarray
    checks: Checks
    reached: np.ndarray
    by: np.ndarray


class LawRows(NamedTuple):
    """A built-in controller over a trial's rows: ``references`` and ``telemetry`` have a row a
    tick."""

    references: np.ndarray
    controller: Controller
    telemetry: np.ndarray


Controls = tuple[LawRows, ...]  # of a trial, one a cylinder


@part_kernel
def _stop(rows, which, index, entry, value, bound):
    """Note a limit that was reached."""
    rows.reached[0], rows.reached[1], rows.reached[2] = which, index, entry
    rows.by[0], rows.by[1] = value, bound
    return True


@part_kernel
def _mismatch(rows, i, c):
    """By how much a cylinder's stroke [m] is beyond that of its joint's coordinate, or, of a slide
    and where none is measured, beyond its speed, whose error is forgotten; the larger of both."""
    sample, checks, apart = rows.sample, rows.checks, 0.0
    x, q = sample[entry(c, OF.x)], sample[entry(c, OF.q)]
    if checks.measured[entry(c, OF.q)]:
        apart = x - linkage_of(checks.cylinders[c], q)[0]
        if checks.cylinders[c].geometry != DIRECT:
            return apart
    if i > 0 and checks.measured[entry(c, OF.v)]:
        tick, before = rows.t[i] - rows.t[i - 1], rows.samples[i - 1, entry(c, OF.x)]
        checks.apart[c] += x - before - tick * sample[entry(c, OF.v)]
        checks.apart[c] /= 1.0 + tick / FORGETS
    return apart if abs(apart) >= abs(checks.apart[c]) else checks.apart[c]


@part_kernel
def _of_cylinder(rows, i, c):
    """Whether the present sample of a cylinder reached a limit of row ``i``."""
    sample, limits, checks = rows.sample, rows.limits, rows.checks
    alarm = int(checks.alarms[c])
    if alarm > 0:
        return _stop(rows, MONITOR, c, alarm - 1, sample[alarm - 1], 0.0)
    if alarm < 0:
        return _stop(rows, MONITOR, -1 - alarm, -1, rows.commands[i, -1 - alarm], 0.0)
    for channel in (OF.p_head, OF.p_rod):
        j = entry(c, channel)
        p = sample[j]
        if p > limits[PRESSURE_MAX]:
            return _stop(rows, PRESSURE_MAX, c, j, p, limits[PRESSURE_MAX])
        if p < limits[PRESSURE_MIN]:
            return _stop(rows, PRESSURE_MIN, c, j, p, limits[PRESSURE_MIN])
        if p > limits[PRESSURE_RANGE] or p < VACUUM:
            bound = limits[PRESSURE_RANGE] if p > 0.0 else VACUUM
            return _stop(rows, PRESSURE_RANGE, c, j, p, bound)
    j = entry(c, OF.x)
    x, far = sample[j], rows.strokes[c] - limits[MARGIN]
    if x < limits[MARGIN] or x > far:
        return _stop(rows, MARGIN, c, j, x, limits[MARGIN] if x < limits[MARGIN] else far)
    j = entry(c, OF.v)
    if abs(sample[j]) > limits[SPEED]:
        return _stop(rows, SPEED, c, j, sample[j], limits[SPEED])
    apart = _mismatch(rows, i, c)
    if abs(apart) > checks.mismatch[c]:
        return _stop(rows, MISMATCH, c, entry(c, OF.x), apart, checks.mismatch[c])
    apart = x - checks.desired[i, c]
    if not abs(apart) > checks.following[c]:
        checks.since[c] = -1
        return False
    if checks.since[c] < 0:
        checks.since[c] = i
    if rows.t[i] - rows.t[checks.since[c]] >= limits[FOLLOWING_TIME]:
        return _stop(rows, FOLLOWING, c, entry(c, OF.x), apart, checks.following[c])
    return False


@kernel
def violated(rows, i):
    """Whether the present sample or command of row ``i`` reached a limit (``rows.reached``,
    ``rows.by``); what is not finite has reached one."""
    sample, command, limits, checks = rows.sample, rows.commands[i], rows.limits, rows.checks
    if not checks.armed[0]:
        return False
    for j in range(sample.shape[0]):
        if checks.measured[j] and not math.isfinite(sample[j]):
            return _stop(rows, FINITE, -1, j, sample[j], math.inf)
    if checks.stamp[3] != 0.0:
        return _stop(rows, MACHINE, -1, -1, checks.stamp[3], 0.0)
    if checks.stamp[2] > limits[AGE]:
        return _stop(rows, AGE, -1, -1, checks.stamp[2], limits[AGE])
    if checks.stamp[4] > limits[OVERRUN]:
        return _stop(rows, OVERRUN, -1, -1, checks.stamp[4], limits[OVERRUN])
    for c in range(rows.strokes.shape[0]):
        if _of_cylinder(rows, i, c):
            return True
    for v in range(command.shape[0]):
        if not math.isfinite(command[v]):
            return _stop(rows, FINITE, v, -1, command[v], math.inf)
        if abs(command[v]) > limits[COMMAND]:
            return _stop(rows, COMMAND, v, -1, command[v], limits[COMMAND])
        if i > 0:
            rate = (command[v] - rows.commands[i - 1, v]) / (rows.t[i] - rows.t[i - 1])
            if abs(rate) > limits[COMMAND_RATE]:
                return _stop(rows, COMMAND_RATE, v, -1, rate, limits[COMMAND_RATE])
    return False


@kernel
def within(values, lower, upper):
    """Whether each of some values lies between its bounds; nan does not."""
    for i in range(values.shape[0]):
        if not lower[i] <= values[i] <= upper[i]:
            return False
    return True


def control(laws, i, rows):
    """One tick of each of some built-in controllers, a tuple of `LawRows`, in their order: its
    command and its telemetry of row ``i``."""
    for law in laws:
        tick(
            rows.t[i],
            rows.sample,
            law.references[i],
            law.controller,
            rows.commands[i],
            law.telemetry[i],
        )


@overload(control, jit_options=WITHIN)
def _control(laws, i, rows):
    # laws of several kinds are of several types: a loop over them is written out
    given = "rows.t[i], rows.sample, law.references[i], law.controller, rows.commands[i]"
    calls = "".join(
        f"    law = laws[{n}]\n    tick({given}, law.telemetry[i])\n" for n in range(len(laws))
    )
    space: dict[str, Any] = {"tick": tick}
    exec(f"def each(laws, i, rows):\n{calls}", space)
    each: Callable[..., None] = space["each"]
    return each
