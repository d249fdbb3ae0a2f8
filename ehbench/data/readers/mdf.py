"""MDF 3 and 4 measurements, by asammdf: a table a channel group, on the group's own time."""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
from asammdf import MDF

from ehbench.data.readers.table import Dialect, Source, SourceColumn, SourceTable, numbered
from ehbench.runtime.memory import refuse_beyond
from ehbench.vocabulary.errors import LogError
from ehbench.vocabulary.messages import message

DEPTH = 9  # of conversions that refer to conversions; a file with more is damaged

# kinds of channel by version: the group's time, written or counted; samples of different lengths
_CLOCKS, _VARYING = {3: (1,), 4: (2, 3)}, {3: (), 4: (1,)}


def read(path: Path, dialect: Dialect) -> Source:
    """The groups of a measurement."""
    # it prints a channel that it cannot read
    with redirect_stdout(io.StringIO()), MDF(str(path)) as file:
        sizes = [group.channel_group.cycles_nr * len(group.channels) for group in file.groups]
        refuse_beyond(16.0 * sum(sizes), "reading it")
        _refuse_outside(file)
        began = file.start_time.timestamp() if file.start_time else None
        tables, losses = [], []
        for index, group in enumerate(file.groups):
            if not group.channel_group.cycles_nr:
                continue
            name = getattr(group.channel_group, "acq_name", "") or f"group {index + 1}"
            table, unread = _group(file, index, name, began)
            losses += [message("data.not_read", name=item) for item in unread]
            if table.columns:
                tables.append(table)
    return Source(_renamed(tables), losses=tuple(losses))


def _refuse_outside(file) -> None:
    """Refuse a damaged file with a channel outside the records of its group: asammdf reads and
    writes memory there, and the process dies.

    Raises:
        LogError: there is such a channel.
    """
    for group in file.groups:
        head = group.channel_group
        room = 8 * (head.samples_byte_nr + getattr(head, "invalidation_bytes_nr", 0))
        for channel in group.channels:
            if _version(channel) == 4:
                begin = 8 * channel.byte_offset + channel.bit_offset
            else:
                begin = 8 * channel.additional_byte_offset + channel.start_offset
            if begin + channel.bit_count > room:
                raise LogError(message("data.channel_outside_records", name=channel.name))


def _has_formula(conversion, depth: int = DEPTH) -> bool:
    """Whether a conversion is a formula, or refers to one.

    asammdf hands a formula to numexpr, which evaluates it as Python code, and returns the raw
    readings where that fails.
    """
    if conversion is None:
        return False
    if depth == 0 or getattr(conversion, "formula", None):
        return True
    references = getattr(conversion, "referenced_blocks", None) or {}
    blocks = [block for block in references.values() if hasattr(block, "conversion_type")]
    return any(_has_formula(block, depth - 1) for block in blocks)


def _group(file, index: int, name: str, began: float | None) -> tuple[SourceTable, list[str]]:
    """(a channel group, the channels in it that are not read, and why).

    Raises:
        LogError: the time of the group is converted by a formula.
    """
    group, master = file.groups[index], file.masters_db.get(index)
    columns, names, unread, required, t = [], [], [], [], None
    if master is not None and _has_formula(group.channels[master].conversion):
        raise LogError(message("data.time_by_formula", name=name))
    for at, channel in enumerate(group.channels):
        if channel.channel_type in _VARYING[_version(channel)]:
            unread.append(f"{name}/{channel.name}")  # texts, which a damaged file crashes over
        elif _has_formula(channel.conversion):
            unread.append(f"{name}/{channel.name} (a formula converts it, and is not evaluated)")
        elif at != master:
            required.append((None, index, at))
    for signal in file.select(required, copy_master=False) if required else ():
        samples = np.asarray(signal.samples)
        t = np.asarray(signal.timestamps, float)
        if samples.ndim != 1 or samples.dtype.kind not in "fiub":
            unread.append(f"{name}/{signal.name}")
            continue
        values = samples.astype(float)
        if signal.invalidation_bits is not None:
            values[np.asarray(signal.invalidation_bits, bool)] = np.nan
        columns.append((values, signal.unit or ""))
        names.append(signal.name)
    built = [
        SourceColumn(item, values, unit) for item, (values, unit) in zip(numbered(names), columns)
    ]
    clock = None if master is None else group.channels[master]
    timed = clock is not None and clock.channel_type in _CLOCKS[_version(clock)]
    return SourceTable(name, tuple(built), t if timed else None, began), unread


def _version(channel) -> int:
    """Of the format that a channel is of, 3 or 4."""
    return 4 if hasattr(channel, "byte_offset") else 3


def _renamed(tables: list[SourceTable]) -> tuple[SourceTable, ...]:
    """The tables with names of their own."""
    names = numbered([table.name for table in tables])
    return tuple(
        SourceTable(name, table.columns, table.t, table.began) for name, table in zip(names, tables)
    )
