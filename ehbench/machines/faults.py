"""A simulated machine on which a sensor, valve, supply, link or controller fails at a given
time."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from ehbench.config.recipe import Fault
from ehbench.config.rig import Rig
from ehbench.machines.protocol import Machine, Posture, Stamp
from ehbench.parts.sample import OF, entry
from ehbench.plant.trim import LowSide
from ehbench.vocabulary import VOCABULARY, InputError, message, placed
from ehbench.vocabulary.fields import read_value


@dataclass
class Failure:
    """A fault at work: its file's words, where it acts and what it remembers.

    ``index`` of the channel in the sample or of the valve in the commands; ``size`` [SI]; ``rest``,
    ``high`` the valve's [V]; ``tick`` [s]; ``last`` what it last gave, ``past`` what waits."""

    fault: Fault
    index: int
    size: float
    tick: float
    rest: float = 0.0
    high: float = 0.0
    last: float = math.nan
    past: deque[Any] = field(default_factory=deque)

    def active(self, t: float) -> bool:
        """Whether it acts at t [s]."""
        stop = math.inf if self.fault.stop is None else float(self.fault.stop)
        return float(self.fault.start) <= t < stop

    def since(self, t: float) -> float:
        """Time [s] since its start."""
        return t - float(self.fault.start)

    @property
    def share(self) -> float:
        """How far a slow valve comes in a tick, of its way."""
        return -math.expm1(-self.tick / max(float(self.fault.duration), 1e-9))

    def pulse(self, t: float, width: float) -> bool:
        """Whether t [s] lies in the first ``width`` [s] of one of its periods."""
        return self.since(t) % float(self.fault.period) < width - 0.5 * self.tick

    def late(self, t: float, given: Any) -> tuple[float, Any]:
        """(when it came [s], what) of what has come by t [s], where all is late while it acts."""
        late = float(self.fault.duration) if self.active(t) else 0.0
        self.past.append((t + late, given))
        while len(self.past) > 1 and self.past[1][0] <= t + 0.5 * self.tick:
            self.past.popleft()
        return self.past[0]


Effect = Callable[[Failure, float, float], float]  # (failure, t [s], value as it is) → as it fails


class Kind(NamedTuple):
    """Where a kind of fault acts, ``sensor``, ``valve`` or ``machine``, its effect, if it ``needs``
    a size."""

    place: str
    effect: Effect | None = None
    needs: bool = False


KINDS: dict[str, Kind] = {
    "stuck": Kind("sensor", lambda f, t, value: f.last),
    "offset": Kind("sensor", lambda f, t, value: value + f.size, True),
    "drift": Kind("sensor", lambda f, t, value: value + f.size * f.since(t), True),
    "scale": Kind("sensor", lambda f, t, value: value * f.size, True),
    "nan": Kind("sensor", lambda f, t, value: math.nan),
    "zero": Kind("sensor", lambda f, t, value: 0.0),
    "dropouts": Kind(
        "sensor", lambda f, t, value: f.last if f.pulse(t, float(f.fault.duration)) else value
    ),
    "spikes": Kind("sensor", lambda f, t, value: value + f.size * f.pulse(t, f.tick), True),
    "stuck_open": Kind("valve", lambda f, t, value: f.size),
    "stuck_closed": Kind("valve", lambda f, t, value: f.rest),
    "slow": Kind("valve", lambda f, t, value: f.last + f.share * (value - f.last)),
    **dict.fromkeys(("supply_lost", "link_delayed", "link_lost"), Kind("machine")),
    **dict.fromkeys(("link_reordered", "controller_late"), Kind("machine")),
}
WATCHDOG = 0.02  # [s] without a command after which a target lets its valves go to rest


class FaultyMachine:
    """A simulated machine with faults, behind the same protocol. It advances tick by tick.

    Its log holds what its sensors say. ``hidden`` has the strokes as they are.

    Args:
        machine: that fails.
        faults: of the recipe, each with its place there.
        rig: units of sizes.

    Raises:
        InputError: a target that the machine lacks, a size that is missing or of a wrong unit.
    """

    def __init__(
        self, machine: Machine, faults: Sequence[tuple[Fault, dict[str, Any]]], rig: Rig
    ) -> None:
        self._machine, self._faults, self._rig = machine, faults, rig
        self.name, self.channels, self.commands = machine.name, machine.channels, machine.commands
        self.strokes, self.rate, self.latency = machine.strokes, machine.rate, machine.latency
        # a machine whose sensors have noise knows its strokes; another's are those of its samples
        self._sampled = TrueStrokes(len(self.strokes))
        self.hidden = getattr(machine, "hidden", self._sampled)
        self._failures: list[Failure] = []
        names = {"sensor": self.channels, "valve": self.commands.names, "machine": ("",)}
        for fault, where in faults:
            kind, rest, high = KINDS[fault.kind], 0.0, 0.0
            known = names[kind.place]
            if fault.target not in known:
                fields = {"kind": fault.kind, "target": fault.target, "known": ", ".join(known)}
                raise InputError(message("machines.fault_target", **fields), **where)
            index = known.index(fault.target)
            if kind.place == "valve":
                rest, high = float(self.commands.rest[index]), float(self.commands.highest[index])
            size = high
            if fault.value is not None:
                word = "command" if kind.place == "valve" else fault.target.rsplit(".", 1)[-1]
                row = VOCABULARY["sensor_scale" if fault.kind == "scale" else word]
                with placed(where):  # a difference has no range
                    size = float(read_value(fault.value, replace(row, lower=-math.inf)))
            elif kind.needs:
                raise InputError(message("machines.fault_value", kind=fault.kind), **where)
            self._failures.append(Failure(fault, index, size, 1.0 / self.rate, rest, high))
        self._tick, self.stamp = 0, Stamp(0.0, 0, 0.0)
        plant = getattr(machine, "bench", None) or machine.model.plant  # type: ignore[attr-defined]
        self._supply, self._flow_limit = plant.supply, float(plant.supply.flow_limit)
        self._seen = np.empty(0)

    def seeded(self, seed: int) -> FaultyMachine:
        """The same machine, not started, with other noise of its sensors."""
        return FaultyMachine(self._machine.seeded(seed), self._faults, self._rig)  # type: ignore[attr-defined]

    def check_posture(self, posture: Posture) -> None:
        """As `Machine.check_posture`."""
        self._machine.check_posture(posture)

    def carry(self, payload: str | None) -> None:
        """As `carry_of` says."""
        self._machine.carry(payload)  # type: ignore[attr-defined]

    def start(self, posture: Posture = None, low_side: LowSide = None) -> np.ndarray:
        """As `Machine.start`; nothing has failed yet."""
        self._supply.flow_limit = self._flow_limit
        sample = self._machine.start(posture, low_side)
        self._tick, self.stamp = 0, Stamp(0.0, 0, 0.0)
        for failure in self._failures:
            failure.last = math.nan
            failure.past.clear()
        self._seen = self._sensed(sample)
        return self._seen.copy()

    def begin(self) -> None:
        """Let the time of the faults begin now."""
        self._tick = 0

    def tick(self, command: np.ndarray) -> np.ndarray:
        """As `Machine.tick`: the command as it arrives, the sample as the sensors give it."""
        t = self._tick / self.rate
        given = np.array(command, dtype=float)
        for failure in self._of("machine"):  # late with the controller, at rest without a link
            if failure.fault.kind == "controller_late":
                given = failure.late(t, given)[1]
            if failure.fault.kind == "link_lost":
                if not failure.active(t):
                    failure.past = deque([given], maxlen=1)
                elif failure.past and failure.since(t) < WATCHDOG:
                    given = failure.past[0]
                else:
                    given = self.commands.rest
        given = np.array(given)
        for failure in self._of("valve"):
            i = failure.index
            value = given[i]
            if failure.active(t):
                value = _effect(failure, t, value)
            failure.last = given[i] = min(max(value, self.commands.lowest[i]), failure.high)
        lost = any(f.fault.kind == "supply_lost" and f.active(t) for f in self._failures)
        self._supply.flow_limit = 0.0 if lost else self._flow_limit
        sample = self._machine.tick(given)
        self._tick += 1
        t, shown = self._tick / self.rate, self._sensed(sample)
        sequence, arrival, taken = self._tick, t, t  # of the newest that has come over the link
        for failure in self._of("machine"):
            kind = failure.fault.kind
            if kind == "link_lost" and failure.active(t):
                arrival = math.inf
            if kind == "link_delayed":
                arrival, (sequence, taken, shown) = failure.late(t, (sequence, taken, shown))
            if kind == "link_reordered" and failure.active(t) and self._tick % 2:
                arrival = math.inf  # it comes behind the next, which is newer
        if arrival <= t + 0.5 / self.rate and sequence >= self.stamp.sequence:
            self._seen, self.stamp = shown, Stamp(taken, sequence, t - taken)
        else:
            self.stamp = self.stamp._replace(age=t - self.stamp.time)
        return self._seen.copy()

    def close(self) -> None:
        """As `Machine.close`."""
        self._supply.flow_limit = self._flow_limit
        self._machine.close()

    def _of(self, place: str) -> list[Failure]:
        return [item for item in self._failures if KINDS[item.fault.kind].place == place]

    def _sensed(self, sample: np.ndarray) -> np.ndarray:
        self._sampled.take(sample)
        t, shown = self._tick / self.rate, sample.copy()
        for failure in self._of("sensor"):
            i, value = failure.index, float(shown[failure.index])
            if failure.active(t):
                shown[i] = _effect(failure, t, value)
                owner, _, word = self.channels[i].rpartition(".")
                if word in ("x", "q"):  # a speed follows from its position, and fails with it
                    j = self.channels.index(f"{owner}.{'v' if word == 'x' else 'qd'}")
                    kind = failure.fault.kind
                    rate = failure.size if kind == "drift" else 0.0
                    factor = failure.size if kind == "scale" else kind not in ("stuck", "zero")
                    rate += factor * shown[j]
                    shown[j] = math.nan if kind == "nan" else rate
            failure.last = float(shown[i])
        return shown


def _effect(failure: Failure, t: float, value: float) -> float:
    """A value as a failure gives it; one that has not begun yet has it as it is."""
    effect = KINDS[failure.fault.kind].effect
    assert effect is not None  # those of the machine act elsewhere
    if math.isnan(failure.last):
        failure.last = value
    return effect(failure, t, value)


class TrueStrokes:
    """The strokes of a machine as they are, whatever its sensors say."""

    def __init__(self, cylinders: int) -> None:
        self.width = cylinders
        self._strokes = np.zeros(cylinders)

    def take(self, sample: np.ndarray) -> None:
        """Take the strokes of a sample before anything fails."""
        self._strokes = sample[[entry(c, OF.x) for c in range(self.width)]]

    def read(self, command: np.ndarray, row: np.ndarray) -> None:
        """As `Hidden.read`."""
        row[:] = self._strokes
