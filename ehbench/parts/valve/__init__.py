"""Valves: a command, limited to its driver's range, and the elements in series that lead from it to
the opening, a file an element.

To add an element: write its file after ``first_order.py`` and name it in LAWS. A pure delay is none
of them: those of a valve stand together before its elements, see ``delay.py``."""

import math

from ehbench.parts.fault import Amount, Fault
from ehbench.parts.valve import delay, first_order, second_order
from ehbench.runtime.compiled import choice, part_kernel, record

LAWS = (second_order.LAW, first_order.LAW)
ELEMENTS = tuple(law.table for law in LAWS)
TABLES = (*ELEMENTS, delay.Delay)
FAULTS = (
    Fault(
        "saturation",
        ("drive_limit",),
        unit="reach",
        step=-0.05,
        low=-0.8,
        high=0.0,
        trials=(-0.1, -0.25, -0.4, -0.55),
        rank=5,
        upper=Amount((1.2,), "reach"),
        table="drive_limit",
        adds={"drive_limit": Amount((0.85, 0.6), "reach", "V")},
        neutral=Amount((1.0,), "reach"),
        joined=True,
    ),
)
# of a spool, whose edges share them; its middle stands at rest as long as its overlap alone moves
_MIDDLE = Amount((0.01,), "reach", "V", (-50.0, 50.0))
_NULL = Amount((1.0e-4,), "reach", "V", (-5.0e3, 5.0e3))
SPOOL = (
    Fault("overlap", ("overlap",), unit="command", step=0.01, low=-0.4, high=0.4, rank=4),
    Fault(
        "overlap",
        ("overlap", "null"),
        unit="command",
        step=0.01,
        low=-0.4,
        high=0.4,
        trials=(-0.02,),
        rank=4,
        table="overlap",
        adds={"overlap": _MIDDLE, "null": _NULL},
        moved=("overlap",),
    ),
)
SHARE = 0.25  # of its fastest period over 2π, over which a series of elements is integrated

# A valve. ``lowest, highest`` command of its driver [V]; the ``delay`` [s] with which it feels a
# command, and the command [V] ``before`` the first; its ``count`` elements stand from
# ``first`` on in the plant's elements; ``output`` is where its opening [V] stands in the state, −1
# where the opening is the command.
VALVE_COLUMNS = (
    *((name, "f8") for name in ("lowest", "highest", "delay", "before")),
    *((name, "i8") for name in ("first", "count", "output")),
)
VALVE = record(*VALVE_COLUMNS)

# An element. ``law`` its number in LAWS; where its ``states`` stand from in the plant's
# state (``state``); its
# ``fastest`` rate [1/s]; then the columns of the laws: ``stiffness`` ω_n² [1/s²] and ``damping``
# 2 ζ ω_n [1/s].
ELEMENT = record(
    *(("law", "i8"), ("state", "i8"), ("states", "i8"), ("fastest", "f8")),
    *((name, "f8") for name in dict.fromkeys(name for law in LAWS for name in law.columns)),
)

_rates = choice("rates", [law.rates for law in LAWS], "element, signal, y, dy")
_settle = choice("settle", [law.settle for law in LAWS], "element, value, y")
_advance = choice("advance", [law.advance for law in LAWS], "element, signal, dt, y")
_finish = choice("finish", [law.finish for law in LAWS], "element, signal, y, slope, d")
_lag = choice("lag", [law.lag for law in LAWS], "element")
_recover = choice("recover", [law.recover for law in LAWS], "element, signal, dt, y, later")


@part_kernel
def limited(command, valve):
    """A command [V] within the range of a valve's driver."""
    return min(max(command, valve.lowest), valve.highest)


@part_kernel
def valve_rates(valve, signal, plant, y, dy):
    """(opening [V], fastest rate [1/s]) of a valve under a signal [V]; writes its states' rates."""
    fastest = 0.0
    for i in range(valve.first, valve.first + valve.count):
        element = plant.elements[i]
        signal = _rates(element.law, element, signal, y, dy)
        fastest = max(fastest, element.fastest)
    return signal, fastest


@part_kernel
def valve_settle(valve, value, plant, y):
    """Put a valve's states at rest where command and opening are ``value`` [V]."""
    for i in range(valve.first, valve.first + valve.count):
        element = plant.elements[i]
        _settle(element.law, element, value, y)


@part_kernel
def valve_finish(valve, signal, plant, y, slope, d):
    """Better a valve's states after a Runge–Kutta step of ``d`` [s] under a held signal [V].

    Only its first element has a signal that was held."""
    if valve.count > 0:
        element = plant.elements[valve.first]
        _finish(element.law, element, signal, y, slope, d)


@part_kernel
def valve_advance(valve, signal, dt, plant, y, k):
    """Bring a valve's states on by ``dt`` [s] under a held signal [V]: exact for one element, by
    Runge and Kutta's method for a series.

    Args:
        k: scratch of shape (5, states).
    """
    if valve.count == 1:
        element = plant.elements[valve.first]
        _advance(element.law, element, signal, dt, y)
    elif valve.count > 1:
        _, fastest = valve_rates(valve, signal, plant, y, k[0])
        last = plant.elements[valve.first + valve.count - 1]
        low, high = plant.elements[valve.first].state, last.state + last.states
        pieces = max(1, int(math.ceil(fastest * dt / SHARE)))
        d = dt / pieces
        for _ in range(pieces):
            valve_rates(valve, signal, plant, y, k[0])
            for stage in range(1, 4):
                share = d if stage == 3 else 0.5 * d
                for j in range(low, high):
                    k[4, j] = y[j] + share * k[stage - 1, j]
                valve_rates(valve, signal, plant, k[4], k[stage])
            for j in range(low, high):
                y[j] += d / 6.0 * (k[0, j] + 2.0 * (k[1, j] + k[2, j]) + k[3, j])


@part_kernel
def valve_recover(valve, signal, dt, plant, y, later):
    """Recover inner states from a known opening in ``y`` and the opening ``later`` [V] by ``dt``
    [s]."""
    if valve.count > 0:
        element = plant.elements[valve.first]
        _recover(element.law, element, signal, dt, y, later)


@part_kernel
def valve_lag(valve, plant):
    """Time [s] by which a valve's opening trails a steady ramp of its command."""
    lag = valve.delay
    for i in range(valve.first, valve.first + valve.count):
        element = plant.elements[i]
        lag += _lag(element.law, element)
    return lag
