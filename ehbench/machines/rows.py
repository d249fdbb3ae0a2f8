"""The rows of a trial as compiled code sees them: what every tick reads and writes, where a limit
stops it, and one tick of a built-in controller.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba.extending import overload

from ehbench.config.recipe import Limits
from ehbench.control.law import Controller
from ehbench.control.registry import tick
from ehbench.parts.sample import OF, entry
from ehbench.runtime.compiled import WITHIN, kernel

LIMITS = ("pressure_max", "pressure_min", "stroke_margin", "speed_max", "command_max")
NO_LIMITS = (math.inf, -math.inf, -math.inf, math.inf, math.inf)
PRESSURE_MAX, PRESSURE_MIN, MARGIN, SPEED, COMMAND = range(5)


class Rows(NamedTuple):
    """A trial's rows, one a tick, and what is checked in each.

    ``t`` [s]; ``commands`` [V], shape (samples, valves), into which a controller writes its own;
    ``samples`` what was measured, shape (samples, channels); ``truth`` what only a simulation
    knows, its `Truth` or `Hidden`, shape (samples, width). ``sample`` is the present sample, which
    no row holds yet. ``limits`` are in the order of LIMITS, SI; ``strokes`` the full strokes [m];
    ``found`` says of a limit that was reached (which, cylinder or valve, entry of the sample)."""

    t: np.ndarray
    commands: np.ndarray
    samples: np.ndarray
    truth: np.ndarray
    sample: np.ndarray
    limits: np.ndarray
    strokes: np.ndarray
    found: np.ndarray


class LawRows(NamedTuple):
    """A built-in controller over a trial's rows: ``references`` that it shall follow and the
    ``telemetry`` that it leaves have a row a tick.
    """

    references: np.ndarray
    controller: Controller
    telemetry: np.ndarray


Controls = tuple[LawRows, ...]  # of a trial, one a cylinder


def limit_array(limits: Limits) -> np.ndarray:
    """A recipe's limits in the order of LIMITS, SI; infinite where there is none."""
    given = (getattr(limits, name) for name in LIMITS)
    return np.array(
        [
            none if value is None else float(value)
            for value, none in zip(given, NO_LIMITS, strict=True)
        ]
    )


@kernel
def violated(rows, i):
    """Whether the present sample or the command of row ``i`` reached a limit; ``rows.found`` then
    says which.
    """
    sample, command, limits, result = rows.sample, rows.commands[i], rows.limits, rows.found
    for c in range(rows.strokes.shape[0]):
        for channel in (OF.p_head, OF.p_rod):
            p = sample[entry(c, channel)]
            if p > limits[PRESSURE_MAX] or p < limits[PRESSURE_MIN]:
                result[0] = PRESSURE_MAX if p > limits[PRESSURE_MAX] else PRESSURE_MIN
                result[1], result[2] = c, entry(c, channel)
                return True
        x = sample[entry(c, OF.x)]
        if x < limits[MARGIN] or x > rows.strokes[c] - limits[MARGIN]:
            result[0], result[1], result[2] = MARGIN, c, entry(c, OF.x)
            return True
        if abs(sample[entry(c, OF.v)]) > limits[SPEED]:
            result[0], result[1], result[2] = SPEED, c, entry(c, OF.v)
            return True
    for v in range(command.shape[0]):
        if abs(command[v]) > limits[COMMAND]:
            result[0], result[1], result[2] = COMMAND, v, -1
            return True
    return False


@kernel
def within(values, lower, upper):
    """Whether each of some values lies between its bounds; nan does not."""
    for i in range(values.shape[0]):
        if not lower[i] <= values[i] <= upper[i]:
            return False
    return True


@kernel
def _control_one(law, i, rows):
    """One tick of a built-in controller: its command and its telemetry of row ``i``."""
    tick(
        rows.t[i],
        rows.sample,
        law.references[i],
        law.controller,
        rows.commands[i],
        law.telemetry[i],
    )


def control(laws, i, rows):
    """One tick of each of some built-in controllers, a tuple of `LawRows`, in their order."""
    for law in laws:
        _control_one(law, i, rows)


@overload(control, jit_options=WITHIN)
def _control(laws, i, rows):
    # laws of several kinds are of several types: a loop over them is written out
    calls = "".join(f"    one(laws[{n}], i, rows)\n" for n in range(len(laws)))
    space: dict[str, Any] = {"one": _control_one}
    exec(f"def each(laws, i, rows):\n{calls}", space)
    each: Callable[..., None] = space["each"]
    return each
