"""A machine's log in the order of a model's arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ehbench.data.record import Record
from ehbench.parts.cylinder import joint_of, linkage_arrays
from ehbench.physics.cylinder import DIRECT
from ehbench.plant.model import Model
from ehbench.plant.valves import felt_commands
from ehbench.vocabulary.errors import LogError

CUT_MEAN = 0.7561  # mean of |z|, z standard normal, what exceeds its 90 % quantile cut to it
ROUNDING = 1.0e-12  # smaller than any reading


@dataclass(frozen=True)
class Readings:
    """A log in the order of a model's arrays: commands (samples, valves), q, qd (samples, joints),
    x (samples, cylinders), p (samples, 2·cylinders); ``flow_supply`` only where it was measured."""

    t: np.ndarray
    commands: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    x: np.ndarray
    p: np.ndarray
    p_supply: np.ndarray
    p_tank: np.ndarray
    flow_supply: np.ndarray | None


def read_log(model: Model, record: Record) -> tuple[Readings, list[str]]:
    """The readings of a log and a sentence for each that is missing.

    Raises:
        LogError: no pressures, no position or no commands of a cylinder; values that are not
            finite.
    """
    log = _Log(model, record, [])
    commands = log.commands()
    q, qd, x, p = log.motion()
    p_supply = log.line("p_supply", model.plant.supply.pressure)
    p_tank = log.line("p_tank", model.plant.tank_pressure)
    flow_supply = log.get("flow_supply") if "flow_supply" in record else None
    if flow_supply is None and model.plant.supply.flow_limit > 0.0:
        log.notes.append(
            "no flow of the pump: its energy is that of what the valves draw and the supply line "
            "stores"
        )
    t = np.ascontiguousarray(record.t, dtype=float)
    tick = float(t[1] - t[0])
    felt = felt_commands(model.plant.held_before(commands[0]), commands, tick, tick)
    return Readings(t, felt, q, qd, x, p, p_supply, p_tank, flow_supply), log.notes


@dataclass(frozen=True)
class _Log:
    """A log that is read for a model; ``notes`` says what is missing."""

    model: Model
    record: Record
    notes: list[str]

    def get(self, channel: str) -> np.ndarray:
        """A channel's values."""
        values = np.asarray(self.record[channel], dtype=float)
        if not np.isfinite(values).all():
            raise LogError(
                f"channel '{channel}' has values that are not finite",
                hint="cut the log to where all were read",
            )
        return values

    def line(self, channel: str, usual: float) -> np.ndarray:
        """Pressure of a line, by the rig file where the log has none."""
        if channel in self.record:
            return self.get(channel)
        self.notes.append(f"no {channel}: taken from the rig file")
        return np.full(self.record.t.size, usual)

    def commands(self) -> np.ndarray:
        """Commands of all valves, then forces that are played."""
        commands = self.model.rest_commands(self.record.t.size)
        for i, name in enumerate(self.model.layout.valves):
            if f"{name}.command" in self.record:
                commands[:, i] = self.get(f"{name}.command")
            else:
                self.notes.append(f"no command of {name}: taken to be at rest")
        for i, channel in enumerate(self.model.layout.played, len(self.model.layout.valves)):
            commands[:, i] = self.get(channel)
        return commands

    def motion(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(q, qd, x, p) of all joints and cylinders."""
        names, cylinders = self.model.layout, self.model.plant.cylinders
        samples, n, nc = self.record.t.size, len(names.joints), len(names.cylinders)
        q, qd, x, p = (np.zeros((samples, many)) for many in (n, n, nc, 2 * nc))
        for j, joint in enumerate(names.joints):
            if j not in cylinders.joint:
                q[:, j], qd[:, j] = self.free_joint(joint)
        for i, (name, row) in enumerate(zip(names.cylinders, cylinders, strict=True)):
            j = int(row.joint)
            q[:, j], qd[:, j], x[:, i] = self.cylinder(name, row)
            for side, key in enumerate(("p_head", "p_rod")):
                if f"{name}.{key}" not in self.record:
                    raise LogError(
                        f"the log has no channel '{name}.{key}'",
                        hint="a ledger needs both pressures of every cylinder",
                    )
                p[:, 2 * i + side] = self.get(f"{name}.{key}")
        return q, qd, x, p

    def free_joint(self, joint: str) -> tuple[np.ndarray | float, np.ndarray | float]:
        """(q, qd) of a joint that no cylinder drives."""
        if f"{joint}.q" not in self.record:
            self.notes.append(f"no angle of joint {joint}: taken to stand at zero")
            return 0.0, 0.0
        q = self.get(f"{joint}.q")
        rate = f"{joint}.qd"
        return q, self.get(rate) if rate in self.record else np.gradient(q, self.record.t)

    def cylinder(self, name: str, row: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(q, qd, x) of a cylinder, each from the others where the log has not all of them."""
        record = self.record
        if f"{name}.q" not in record and f"{name}.x" not in record:
            raise LogError(
                f"the log has neither '{name}.q' nor '{name}.x'",
                hint="a ledger needs the position of every cylinder",
            )
        x = self.get(f"{name}.x") if f"{name}.x" in record else None
        if x is None or f"{name}.q" in record:
            q = self.get(f"{name}.q")
        elif row.geometry == DIRECT:
            q = x  # also beyond an end of the stroke, where a stop gives way
        else:
            q = joint_of(row, np.clip(x, 0.0, row.stroke))
        result, lever = linkage_arrays(row, q)
        if f"{name}.qd" in record:
            qd = self.get(f"{name}.qd")
        elif f"{name}.v" in record:
            qd = self.get(f"{name}.v") / lever
        else:
            qd = np.gradient(q, record.t)
            self.notes.append(f"no speed of {name}: taken from its position")
        return q, qd, result if x is None else x


def noise_of(values: np.ndarray) -> float:
    """Standard deviation of a reading's white noise and quantization: from its second differences,
    or from its least step.

    Of the second differences, √6 times as large as the noise, the largest tenth is cut: it may be
    motion."""
    if values.size < 8:
        return 0.0
    bend = np.abs(np.diff(values, 2))
    bend = np.minimum(bend, np.quantile(bend, 0.9))
    steps = np.abs(np.diff(values))
    steps = steps[steps > ROUNDING * max(float(np.abs(values).max()), ROUNDING)]
    minimum = float(steps.min()) if steps.size else 0.0
    return max(float(bend.mean()) / (CUT_MEAN * math.sqrt(6.0)), minimum / math.sqrt(12.0))
