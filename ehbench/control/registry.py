"""The built-in controllers that a recipe can name, and one tick of any of them.

To add one: write its file, which ends in ``LAW = Law(…)``, and name it in `LAW_NAMES`."""

import math
from collections.abc import Callable
from importlib import import_module
from inspect import unwrap
from typing import Any

import numba
from numba.extending import overload

from ehbench.control import LAW_NAMES
from ehbench.control.law import Law
from ehbench.control.monitor import watch
from ehbench.parts.sample import OF, entry
from ehbench.runtime.compiled import WITHIN, kernel

LAWS: dict[str, Law] = {name: import_module(f"{__package__}.{name}").LAW for name in LAW_NAMES}
_STEPS: dict[Any, Callable[..., None]] = {
    numba.from_dtype(law.record): law.step for law in LAWS.values()
}


def step(t, sample, reference, axis, gains, memory, command, telemetry):
    """The step of the law that the gains are of; compiled code chooses it by their type."""
    _STEPS[numba.typeof(gains)](t, sample, reference, axis, gains, memory, command, telemetry)


@overload(step, jit_options=WITHIN, strict=False)  # not the same names of arguments
def _step(t, sample, reference, axis, gains, memory, command, telemetry):
    return unwrap(_STEPS[gains])  # its own code: a call of the kernel is compiled once more


@kernel
def _watch(monitor, sample, command, axis, telemetry):
    """One tick of the monitor, if there is one."""
    if monitor is not None:
        telemetry[-1] = watch(sample, command, axis, monitor)


@kernel
def tick(t, sample, reference, controller, command, telemetry):
    """One tick of a built-in controller; what it does not observe is NaN in what it gets.

    To stroke and speed as given is added what the reference has moved by while they were on their
    way, ``x + x_d(t) − x_d(t − T)``: their errors are those of the time of the sample.

    Args:
        t: time [s].
        sample: what the machine measured.
        reference: x_d, v_d, a_d, j_d of the cylinder.
        controller: a `ehbench.control.law.Controller`.
        command: out, [V], one per valve; only those of the controller's cylinder are written.
        telemetry: out, as `Law.channels`, then `valve_fault` with a monitor.
    """
    for i in range(sample.shape[0]):
        controller.given[i] = sample[i] if controller.observed[i] else math.nan
    desired, share = controller.late.desired, controller.late.share
    last = desired.shape[0] - 1
    for order in range(2):
        for i in range(last, 0, -1):
            desired[i, order] = desired[i - 1, order]
        desired[0, order] = reference[order]
        for i in range(last, -1, -1):  # it has always stood where it begins
            if math.isnan(desired[i, order]):
                desired[i, order] = reference[order]
        newer = desired[max(last - 1, 0), order]
        then = desired[last, order] + share * (newer - desired[last, order])
        place = entry(controller.axis.circuit.cylinder, OF.x if order == 0 else OF.v)
        controller.given[place] += reference[order] - then
    step(
        t,
        controller.given,
        reference,
        controller.axis,
        controller.gains,
        controller.memory,
        command,
        telemetry,
    )
    _watch(controller.monitor, sample, command, controller.axis, telemetry)
