"""A machine's log in the order of a model's arrays."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ehbench.data.record import Record
from ehbench.parts.cylinder import joint_of, linkage_arrays
from ehbench.physics.cylinder import DIRECT
from ehbench.plant.model import Model
from ehbench.plant.valves import acting_commands
from ehbench.vocabulary import LogError, message

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
            finite."""
    notes: list[str] = []
    names, cylinders, size = model.layout, model.plant.cylinders, record.t.size

    def values(channel: str) -> np.ndarray:
        result = np.asarray(record[channel], dtype=float)
        if not np.isfinite(result).all():
            raise LogError(message("ledger.not_finite", channel=channel))
        return result

    def line(channel: str, usual: float) -> np.ndarray:
        """Pressure of a line, by the rig file where the log has none."""
        if channel in record:
            return values(channel)
        notes.append(message("ledger.by_rig_file", channel=channel))
        return np.full(size, usual)

    commands = model.rest_commands(size)
    for i, name in enumerate(names.valves):
        if f"{name}.command" in record:
            commands[:, i] = values(f"{name}.command")
        else:
            notes.append(message("ledger.at_rest", valve=name))
    for i, channel in enumerate(names.played, len(names.valves)):
        commands[:, i] = values(channel)
    n, nc = len(names.joints), len(names.cylinders)
    q, qd, x, p = (np.zeros((size, many)) for many in (n, n, nc, 2 * nc))
    for j, joint in enumerate(names.joints):
        if j in cylinders.joint:
            continue
        if f"{joint}.q" not in record:
            notes.append(message("ledger.free_joint", joint=joint))
            continue
        q[:, j], rate = values(f"{joint}.q"), f"{joint}.qd"
        qd[:, j] = values(rate) if rate in record else np.gradient(q[:, j], record.t)
    for i, (name, row) in enumerate(zip(names.cylinders, cylinders, strict=True)):
        j = int(row.joint)
        q[:, j], qd[:, j], x[:, i] = _motion(name, row, record, values, notes)
        for side, key in enumerate(("p_head", "p_rod")):
            if f"{name}.{key}" not in record:
                raise LogError(message("ledger.no_pressure", channel=f"{name}.{key}"))
            p[:, 2 * i + side] = values(f"{name}.{key}")
    p_supply = line("p_supply", model.plant.supply.pressure)
    p_tank = line("p_tank", model.plant.tank_pressure)
    flow_supply = values("flow_supply") if "flow_supply" in record else None
    if flow_supply is None and model.plant.supply.flow_limit > 0.0:
        notes.append(message("ledger.no_pump_flow"))
    t = np.ascontiguousarray(record.t, dtype=float)
    tick = float(t[1] - t[0])
    felt = acting_commands(model.plant.commanded_before(commands[0]), commands, tick, tick)
    return Readings(t, felt, q, qd, x, p, p_supply, p_tank, flow_supply), notes


def _motion(
    name: str, row: Any, record: Record, values: Callable[[str], np.ndarray], notes: list[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(q, qd, x) of a cylinder, each from the others where the log has not all of them."""
    if f"{name}.q" not in record and f"{name}.x" not in record:
        raise LogError(message("ledger.no_position", cylinder=name))
    x = values(f"{name}.x") if f"{name}.x" in record else None
    if x is None or f"{name}.q" in record:
        q = values(f"{name}.q")
    elif row.geometry == DIRECT:
        q = x  # also beyond an end of the stroke, where a stop gives way
    else:
        q = joint_of(row, np.clip(x, 0.0, row.stroke))
    result, lever = linkage_arrays(row, q)
    if f"{name}.qd" in record:
        qd = values(f"{name}.qd")
    elif f"{name}.v" in record:
        qd = values(f"{name}.v") / lever
    else:
        qd = np.gradient(q, record.t)
        notes.append(message("ledger.no_speed", cylinder=name))
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
    rounding = least_step(values) / math.sqrt(12.0)
    return max(float(bend.mean()) / (CUT_MEAN * math.sqrt(6.0)), rounding)


def least_step(values: np.ndarray) -> float:
    """The least change of a reading from sample to sample: a coarse sensor's count; 0 for none."""
    steps = np.abs(np.diff(values))
    steps = steps[steps > ROUNDING * max(float(np.abs(values).max()), ROUNDING)]
    return float(steps.min()) if steps.size else 0.0
