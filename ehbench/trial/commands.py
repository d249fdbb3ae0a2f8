"""Open-loop commands of a trial as a table of volts."""

import math
from collections.abc import Collection
from pathlib import Path

import numpy as np

from ehbench.config.recipe import Command, TrialRecipe
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.vocabulary import InputError, message


def _shape(command: Command, t: np.ndarray, record: Record | None) -> np.ndarray:
    offset, amplitude, start = float(command.offset), float(command.amplitude), float(command.start)
    stop = math.inf if command.stop is None else float(command.stop)
    slack = 1e-9  # a sample that falls on the switching time belongs to what comes after
    on = (t >= start - slack) & (t < stop - slack)
    if command.kind == "constant":
        return np.full(t.shape, offset)
    if command.kind == "step":
        return offset + amplitude * on
    if command.kind == "ramp":
        return offset + amplitude * np.clip((t - start) / (stop - start), 0.0, 1.0)
    if command.kind == "sine":
        assert command.frequency is not None  # the recipe's model sees to it
        return offset + amplitude * on * np.sin(2 * np.pi * float(command.frequency) * (t - start))
    if command.kind == "multisine":
        assert command.frequency is not None and command.frequency_max is not None
        low, high = float(command.frequency), float(command.frequency_max)
        phases = np.random.default_rng(command.seed).uniform(0, 2 * np.pi, command.lines)
        tones = 2 * np.pi * np.outer(t - start, np.linspace(low, high, command.lines)) + phases
        waves = np.sin(tones).sum(axis=1) * on
        largest = np.abs(waves).max()
        return offset + (amplitude / largest * waves if largest > 0 else waves)
    assert record is not None
    at = np.searchsorted(record.t - record.t[0], t - start + slack, side="right") - 1
    values = record[f"{command.valve}.command"][np.maximum(at, 0)]
    on = (at >= 0) & (t - start <= record.t[-1] - record.t[0] + slack)
    return offset + np.where(on, values, 0.0)


def command_table(
    recipe: TrialRecipe, rig: Rig, t: np.ndarray, taken: Collection[str] = ()
) -> np.ndarray:
    """Commands [V], shape (samples, valves), in the rig file's order; row i acts from ``t[i]`` on.

    Entries for one valve add up; a valve without entry stays at rest. A ``file`` command plays a
    log's ``<valve>.command`` from ``start`` on and adds nothing outside of it. Valves ``taken`` by
    a controller take no entry.

    Raises:
        InputError: unknown or taken valve, a command outside its valve's range, a file without the
            channel, a window that is empty."""
    valves = {f"{c.name}.{v.name}": v for c, v in rig.valves()}
    names = list(valves)
    table = np.tile([v.rest for v in valves.values()], (t.size, 1))
    last: dict[str, int] = {}  # the last entry for each valve
    for index, entry in enumerate(recipe.command):
        fields = {"number": index + 1, "valve": entry.valve}
        if entry.valve not in names:
            fields |= {"rig": rig.name, "known": ", ".join(names)}
            where = recipe.at("command", index, "valve")
            raise InputError(message("trial.unknown_valve", **fields), **where)
        if entry.valve in taken:
            where = recipe.at("command", index, "valve")
            raise InputError(message("trial.controlled_valve", **fields), **where)
        if entry.stop is not None and float(entry.stop) <= float(entry.start):
            where = recipe.at("command", index, "stop")
            raise InputError(message("trial.empty_window", **fields), **where)
        column = names.index(entry.valve)
        if entry.valve not in last:
            table[:, column] = 0.0
        last[entry.valve] = index
        record = None
        if entry.kind == "file":
            assert entry.file is not None  # the recipe's model sees to it
            record = log_with(f"{entry.valve}.command", recipe.file(entry.file))
        table[:, column] += _shape(entry, t, record)
    for column, (name, valve) in enumerate(valves.items()):
        values, low, high = table[:, column], float(valve.command_min), float(valve.command_max)
        inside = (values >= low - 1e-9) & (values <= high + 1e-9)
        if not inside.all():
            bad = int(np.argmin(inside))
            where = recipe.at("command", last[name]) if name in last else {}
            fields = {"name": name, "value": float(values[bad]), "t": float(t[bad])}
            raise InputError(message("trial.command_range", low=low, high=high, **fields), **where)
    return table


def log_with(channel: str, path: Path) -> Record:
    """A log, or that of a trial's run, which has a channel.

    Raises:
        InputError: it does not have it; names those that it has."""
    from ehbench.data import read

    record = read(path / "log.mcap" if path.is_dir() else path)
    if channel not in record:
        known = ", ".join(record.channels)
        raise InputError(message("trial.no_channel", channel=channel, known=known), file=path)
    return record
