"""What a built-in controller is: its gains, step and telemetry, and what it is designed for."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ehbench.control.axis import Axis
from ehbench.control.functions import default_pressure
from ehbench.control.monitor import Monitor
from ehbench.vocabulary import Message, Quantity


@dataclass(frozen=True)
class DesignPoint:
    """What a controller is designed for, by the design model: the rig without payload.

    ``axis`` of its cylinder, ``tick`` between samples [s], ``supply_pressure`` [Pa] and
    ``flow_limit`` [m³/s] of the supply, ``valve_lag`` 2ζ/ω_n of the slowest valve [s], ``stroke``
    of the cylinder at the start [m]; ``unmodelled`` names the tables of the rig file that an axis
    knows nothing of; ``payload`` is the mass [kg] at the end of the last link that moves like the
    heaviest payload of the rig file, on board or not."""

    axis: Axis
    tick: float
    supply_pressure: float
    flow_limit: float
    valve_lag: float
    stroke: float = 0.0
    unmodelled: tuple[str, ...] = ()
    payload: float = 0.0

    @property
    def low_pressure(self) -> float:
        """Set-point of the off-side chamber above tank [Pa] without a gain for it."""
        return default_pressure(self.supply_pressure)


class Required(NamedTuple):
    """A gain that has no default, and the message where it is not given."""

    gain: str
    message: Message


class Packed(NamedTuple):
    """The record that a controller's ``step`` takes, and its numbers by name [SI] for
    ``trial.json``."""

    gains: np.record
    used: dict[str, Any]


class Late(NamedTuple):
    """What a controller knows of the delay of its samples: ``desired``, shape (ticks + 1, 2),
    stroke [m] and speed [m/s] of the reference, the newest first; ``share`` of a tick by which the
    delay is less than the whole ticks."""

    desired: np.ndarray
    share: float


def late_of(delay: float = 0.0, tick: float = 1.0) -> Late:
    """Before the first tick, for samples that come ``delay`` [s] late, one each ``tick`` [s]."""
    ticks = math.ceil(delay / tick)
    return Late(np.full((ticks + 1, 2), math.nan), ticks - delay / tick)


class Controller(NamedTuple):
    """A built-in controller at work on one cylinder, as compiled loops take it.

    ``observed`` marks the channels of the sample that it is given, ``given`` holds them, the others
    NaN. ``gains`` and ``memory`` are of its law; ``late`` is of `late_of`; ``monitor`` may watch
    its valves."""

    axis: Axis
    gains: np.record
    memory: Any
    observed: np.ndarray
    given: np.ndarray
    late: Late
    monitor: Monitor | None = None


@dataclass(frozen=True)
class Law:
    """A controller that a recipe can name. One file each, one line in `ehbench.control.registry`.

    Attributes:
        name: what ``kind`` of a recipe's ``[controller]`` says.
        record: type of its gains; laws of one type share one step.
        step: kernel ``step(t, sample, reference, axis, gains, memory, command, telemetry)``: reads
            the sample [SI] (NaN where it may not look) and the row x_d, v_d, a_d, j_d of the
            reference, writes volts of its cylinder's valves and a row of telemetry.
        gains: what a recipe's ``gains`` may say, with its row of the vocabulary; None is yes or no.
        pack: (design point, gains [SI], rules, shaping) → `Packed`.
        memory: state of the controller before the first tick, for an axis.
        observed: (axis, channels of the sample) → mask of the channels that it is given.
        telemetry: its columns of the row, as words of the vocabulary; after them come the desired
            flow and the limits of each of the cylinder's edges.
        edge_telemetry: further columns of each edge.
        bounds: gains that are a list of two.
        required: the gain without a default.
        ahead: a time [s] if its step takes, where several cylinders move, the desired motion of all
            joints after the reference's own columns, now and so far on; else 0.
        preview: for how long [s] ahead its step takes the smallest and the largest desired speed,
            at
            the end of the reference (`ehbench.control.trajectory.with_preview`); else 0.
        shaped: whether it shapes steps of speed, so that a recipe may have ``shaping``.
        after: (what it ran with, of `Packed`, the controller after a run) → further ``measures``.
        warns_saturated: whether a trial warns of saturated valves."""

    name: str
    record: np.dtype
    step: Callable[..., None]
    gains: Mapping[str, Quantity | None]
    pack: Callable[[DesignPoint, Mapping[str, Any], np.record, np.record], Packed]
    memory: Callable[[Axis], Any]
    observed: Callable[[Axis, int], np.ndarray]
    telemetry: tuple[str, ...]
    edge_telemetry: tuple[str, ...] = ()
    bounds: tuple[str, ...] = ()
    required: Required | None = None
    ahead: float = 0.0
    preview: float = 0.0
    shaped: bool = False
    after: Callable[[Mapping[str, Any], Controller], dict[str, Any]] | None = None
    warns_saturated: bool = False

    def channels(self, cylinder: str, edges: tuple[str, ...]) -> tuple[str, ...]:
        """Channel names of a row of telemetry: ``<cylinder>.<name>``, then ``<edge>.flow_desired``
        and ``<edge>.limits`` of each edge, then its further columns of each.

        Args:
            cylinder: its name.
            edges: names of the cylinder's edges as ``<cylinder>.<edge>``, in the rig file's order.
        """
        return (
            *(f"{cylinder}.{name}" for name in self.telemetry),
            *(f"{edge}.flow_desired" for edge in edges),
            *(f"{edge}.limits" for edge in edges),
            *(f"{edge}.{name}" for name in self.edge_telemetry for edge in edges),
        )
