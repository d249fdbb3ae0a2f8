"""What a machine is to a trial: the one protocol of model, virtual bench and hardware.

Once a tick a machine takes a command for each valve and gives a sample: ``[q, qd, x, v, p_head,
p_rod]`` of each cylinder in the rig file's order, then ``p_supply, p_tank``, all SI. Nothing else
comes from it by the protocol, so a controller sees what a sensor could give. What more a simulation
can do stands behind an attribute of its own that a machine may have or lack: see `truth_of`,
`carry_of` and `advance_of`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from ehbench.machines.rows import Controls, Rows
from ehbench.parts.edge import edge_flows
from ehbench.parts.sample import sample_channels
from ehbench.plant.model import Model
from ehbench.plant.trim import LowSide
from ehbench.vocabulary import InputError, SimulationError, message

Posture = Mapping[str, str | float] | None
Advance = Callable[[int, int], int]  # (first row, row after the last) → row at a limit, or −1


class Inputs(NamedTuple):
    """The commands of a machine: valves' names, ranges [V] and rest [V], shape (valves,)."""

    names: tuple[str, ...]
    lowest: np.ndarray
    highest: np.ndarray
    rest: np.ndarray

    @classmethod
    def of(cls, model: Model) -> Inputs:
        """The commands of a model's valves.

        Raises:
            InputError: the model has a force that is played from a log.
        """
        if model.layout.played:
            fields = {"rig": model.rig.name, "force": model.layout.played[0]}
            raise InputError(message("machines.played_force", **fields))
        low, high = model.plant.valves.lowest.copy(), model.plant.valves.highest.copy()
        return cls(model.layout.valves, low, high, model.rest_commands(1)[0])

    def taken(self, command: ArrayLike) -> np.ndarray:
        """A command [V], shape (valves,).

        Raises:
            InputError: it is not one finite number for each valve.
        """
        try:
            result = np.asarray(command, dtype=float)
        except (TypeError, ValueError):  # no numbers
            result = np.empty(0)
        if result.shape != self.rest.shape or not np.isfinite(result).all():
            names = ", ".join(self.names)
            raise InputError(message("machines.other_command", command=command, valves=names))
        return result


class Stamp(NamedTuple):
    """When a sample was taken: ``time`` [s] since the start by the machine's clock, ``sequence``
    counts its samples, ``age`` [s] is how long ago that was. ``stopped`` is the number of the
    reason, among the machine's ``reasons``, for which it stopped by itself, 0 where it did not."""

    time: float
    sequence: int
    age: float
    stopped: int = 0


@runtime_checkable
class Machine(Protocol):
    """A machine that a trial runs on.

    Example:
        machine: ehbench.Machine = ehbench.open_machine("recipes/rigs/slide_servo.toml")
        sample = machine.start()
        assert isinstance(machine, ehbench.Machine) and len(sample) == len(machine.channels)

    Making one moves nothing and reaches for nothing outside: that begins with `start`, which may be
    called again and then begins anew.

    Attributes:
        name: what logs and reports call it.
        channels: names of the sample's entries.
        commands: what it takes.
        strokes: full stroke of each cylinder [m], in the order of the sample.
        rate: ticks a second [Hz].
        latency: how much older than its tick a sample is [s].
    """

    name: str
    channels: tuple[str, ...]
    commands: Inputs
    strokes: np.ndarray
    rate: float
    latency: float

    def check_posture(self, posture: Posture) -> None:
        """Say, without moving, whether `start` can take a posture.

        Raises:
            InputError: a posture that it cannot take.
        """
        ...

    def start(self, posture: Posture = None, low_side: LowSide = None) -> np.ndarray:
        """Come to rest, valves at rest; the sample at t = 0.

        Args:
            posture: by cylinder or joint, as `Model.posture` reads it; mid-stroke where it says
                nothing.
            low_side: pressure [Pa] of the chambers that no load presses on, of all cylinders or by
                name of some; else the machine's own choice.

        Raises:
            InputError: a posture that it cannot take.
        """
        ...

    def tick(self, command: np.ndarray) -> np.ndarray:
        """Let ``command`` [V], shape (valves,), act for one tick; the sample at its end.

        Raises:
            SimulationError: the numbers left the finite range.
        """
        ...

    def close(self) -> None:
        """Let the machine go, its valves at rest; closing twice does nothing."""
        ...


class Simulated:
    """What machines that are simulations of a model have alike; ``state`` is where it stands."""

    name: str
    state: np.ndarray

    def __init__(self, model: Model, rate: float) -> None:
        self.model, self.layout, self.rate = model, model.layout, float(rate)
        self.channels, self.commands = sample_channels(self.layout.cylinders), Inputs.of(model)
        self.strokes = model.plant.cylinders.stroke.copy()

    def check_posture(self, posture: Posture) -> None:
        """As `Machine.check_posture`."""
        self.model.posture(posture)

    def must_be_finite(self) -> None:
        """Raise SimulationError where its numbers left the finite range."""
        if not np.isfinite(self.state).all():
            raise SimulationError(message("machines.not_finite", machine=self.name))

    def close(self) -> None:
        """There is nothing to let go."""


class Truth(Protocol):
    """What only a simulation can say of itself, as the attribute ``truth`` of a machine.

    Attributes:
        model: whose states they are.
        width: numbers in a row.
        rate: of the derivatives' fastest at the rows of a run, the mean [1/s].
    """

    model: Model
    width: int

    @property
    def rate(self) -> float: ...

    def read(self, command: np.ndarray, row: np.ndarray) -> None:
        """Write what is true now, ``command`` [V] about to act, into ``row``, shape (width,)."""
        ...

    def channels(
        self, t: np.ndarray, commands: np.ndarray, rows: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Rows of a trial as named SI channels, measured ones and commands among them."""
        ...


class Hidden(Protocol):
    """What a simulated machine knows and no log holds, as the attribute ``hidden`` of a machine:
    only a trial's own measures are taken of it.

    Attributes:
        width: numbers in a row.
    """

    width: int

    def read(self, command: np.ndarray, row: np.ndarray) -> None:
        """Write the true strokes [m] of the cylinders into ``row``, shape (width,)."""
        ...


def _attribute(name: str, default: Any = None) -> Callable[[Machine], Any]:
    """What a machine has as an attribute of its own, else the default."""
    return lambda machine: getattr(machine, name, default)


# what a simulation can say of itself beyond its sensors, and what no log holds
truth_of: Callable[[Machine], Truth | None] = _attribute("truth")
hidden_of: Callable[[Machine], Hidden | None] = _attribute("hidden")
# the stamp of the last sample; none where ticks are time itself
stamp_of: Callable[[Machine], Stamp | None] = _attribute("stamp")
# of a machine behind a link the newest packet that a sample answers: its number, host's time sent
# [s], host's time at which the sample came [s], the number that it acknowledges
packet_of: Callable[[Machine], tuple[float, ...]] = _attribute("packet", ())
# channels without a sensor, nan in every sample
unmeasured_of: Callable[[Machine], tuple[str, ...]] = _attribute("unmeasured", ())
# commands [V] that acted in the last tick, where these are not those that were given
applied_of: Callable[[Machine], np.ndarray | None] = _attribute("applied")
# after how many rows a machine that has played a table has no more
ends_of: Callable[[Machine], int | None] = _attribute("ends")
# how a machine that makes its own commands is stopped
halt_of: Callable[[Machine], Callable[[], None] | None] = _attribute("halt")
# whether it goes on while its controller thinks; a simulation waits
in_real_time: Callable[[Machine], bool] = _attribute("real_time", False)
# by a seed, the same machine with other noise of its sensors
seeded_of: Callable[[Machine], Callable[[int], Machine] | None] = _attribute("seeded")
# takes up another payload at once, at the speed that it has; raises InputError for an unknown one
carry_of: Callable[[Machine], Callable[[str | None], None] | None] = _attribute("carry")
# whether its valves may have a hysteresis
plays_of: Callable[[Machine], bool] = _attribute("plays", True)
# ``advance(rows, laws, often)`` gives a function of (first, stop) that runs these rows in one
# compiled call, to the bit as `ehbench.trial.session` does tick by tick, under laws or as the table
# says; it returns the row at which a limit was reached, before its tick, or −1. ``often``: it will
# be called for every row
advance_of: Callable[[Machine], Callable[[Rows, Controls | None, bool], Advance] | None]
advance_of = _attribute("advance")


def reason_of(machine: Machine, number: int) -> str:
    """Why a machine stopped by itself, by the number in its stamp: one of its ``reasons``, or the
    number of one that is not among them."""
    reasons = getattr(machine, "reasons", ())
    return reasons[number] if 0 <= number < len(reasons) else str(number)


def heard_of(machine: Machine) -> tuple[np.ndarray, np.ndarray] | None:
    """All that a machine in real time has sent: times [s] by its clock and, shape (samples,
    channels and valves), samples with the commands [V] that acted; None of a machine that waits."""
    heard = getattr(machine, "heard", None)
    return None if heard is None else heard()


def static_flow_of(machine: Machine) -> Callable[..., np.ndarray] | None:
    """How a simulated machine says what its own edge passes at rest: ``flow(edge, command, drop)``
    [m³/s] at commands [V] and drops [Pa] along it, arrays of one shape, in the mean of rising and
    falling commands; None of one that cannot."""
    truth = truth_of(machine)
    if truth is None:
        return getattr(machine, "mean_flow", None)
    layout, plant = truth.model.layout, truth.model.plant

    def flow(edge: str, command: np.ndarray, drop: np.ndarray) -> np.ndarray:
        row, flows = plant.edges[layout.edges.index(edge)], np.empty(drop.size)
        drops, openings = (np.ascontiguousarray(item, dtype=float) for item in (drop, command))
        edge_flows(drops, openings, row, plant.maps, flows)
        return flows

    return flow
