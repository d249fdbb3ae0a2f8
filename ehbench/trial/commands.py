"""Open-loop commands of a trial as a table of volts."""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np

from ehbench.config.recipe import Command, TrialRecipe
from ehbench.config.rig import Rig, Valve
from ehbench.data.record import Record
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.fields import Value
from ehbench.vocabulary.messages import message


def _si(value: Value | None) -> float:
    """A number that the recipe's model demands of this kind of command."""
    assert value is not None
    return float(value)


def _shape(command: Command, t: np.ndarray, record: Record | None) -> np.ndarray:
    """One entry's command [V] at times ``t`` [s]."""
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
        return offset + amplitude * on * np.sin(2 * np.pi * _si(command.frequency) * (t - start))
    if command.kind == "multisine":
        low, high = _si(command.frequency), _si(command.frequency_max)
        phases = np.random.default_rng(command.seed).uniform(0, 2 * np.pi, command.lines)
        waves = (
            np.sin(
                2 * np.pi * np.outer(t - start, np.linspace(low, high, command.lines)) + phases
            ).sum(axis=1)
            * on
        )
        largest = np.abs(waves).max()
        return offset + (amplitude / largest * waves if largest > 0 else waves)
    assert record is not None
    at = np.searchsorted(record.t - record.t[0], t - start + slack, side="right") - 1
    values = record[f"{command.valve}.command"]
    return offset + np.where(
        (at >= 0) & (t - start <= record.t[-1] - record.t[0] + slack),
        values[np.maximum(at, 0)],
        0.0,
    )


def command_table(
    recipe: TrialRecipe, rig: Rig, t: np.ndarray, taken: Collection[str] = ()
) -> np.ndarray:
    """Commands [V], shape (samples, valves), in the rig file's order; row i acts from ``t[i]`` on.

    Entries for one valve add up; a valve without entry stays at rest. A ``file`` command plays a
    log's ``<valve>.command`` from ``start`` on and adds nothing outside of it. Valves ``taken`` by
    a controller take no entry.

    Raises:
        InputError: unknown or taken valve, a command outside its valve's range, a file without the
            channel, a window that is empty.
    """
    valves = {f"{c.name}.{v.name}": v for c, v in rig.valves()}
    names = list(valves)
    table = np.tile([v.rest for v in valves.values()], (t.size, 1))
    last: dict[str, int] = {}  # the last entry for each valve
    for index, entry in enumerate(recipe.command):
        _check_entry(recipe, index, rig, taken)
        if entry.valve not in last:
            table[:, names.index(entry.valve)] = 0.0
        last[entry.valve] = index
        record = _played(recipe, entry) if entry.kind == "file" else None
        table[:, names.index(entry.valve)] += _shape(entry, t, record)
    for column, (name, valve) in enumerate(valves.items()):
        _check_range(recipe, name, valve, t, table[:, column], last.get(name))
    return table


def _check_entry(recipe: TrialRecipe, index: int, rig: Rig, taken: Collection[str]) -> None:
    entry, number = recipe.command[index], index + 1
    names = [f"{c.name}.{v.name}" for c, v in rig.valves()]
    if entry.valve not in names:
        known = ", ".join(names)
        raise InputError(
            message(
                "trial.unknown_valve", number=number, rig=rig.name, valve=entry.valve, known=known
            ),
            **recipe.at("command", index, "valve"),
        )
    if entry.valve in taken:
        raise InputError(
            message("trial.controlled_valve", number=number, valve=entry.valve),
            **recipe.at("command", index, "valve"),
        )
    if entry.stop is not None and float(entry.stop) <= float(entry.start):
        raise InputError(
            message("trial.empty_window", number=number, valve=entry.valve),
            **recipe.at("command", index, "stop"),
        )


def _played(recipe: TrialRecipe, entry: Command) -> Record:
    """The log that an entry plays."""
    from ehbench.data import read

    assert entry.file is not None
    path = recipe.file(entry.file)
    record = read(path)
    channel = f"{entry.valve}.command"
    if channel not in record:
        known = ", ".join(record.channels)
        raise InputError(message("trial.no_channel", channel=channel, known=known), file=path)
    return record


def _check_range(
    recipe: TrialRecipe,
    name: str,
    valve: Valve,
    t: np.ndarray,
    values: np.ndarray,
    entry: int | None,
) -> None:
    """Refuse commands [V] outside the range of a valve's driver; ``entry`` is the last one for
    it."""
    low, high = float(valve.command_min), float(valve.command_max)
    if low <= values.min() and values.max() <= high:
        return
    bad = np.flatnonzero((values < low - 1e-9) | (values > high + 1e-9) | ~np.isfinite(values))
    if bad.size:
        where = recipe.at("command", entry) if entry is not None else {}
        value, time = float(values[bad[0]]), float(t[bad[0]])
        raise InputError(
            message("trial.command_range", name=name, value=value, t=time, low=low, high=high),
            **where,
        )
