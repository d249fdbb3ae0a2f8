"""TDMS files of LabVIEW, by npTDMS: a table for the channels of a group that have one time base."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from nptdms import TdmsFile
from nptdms.scaling import get_scaling

from ehbench.data.readers.clock import moments
from ehbench.data.readers.table import Dialect, Source, SourceColumn, SourceTable
from ehbench.data.record import floats
from ehbench.runtime.memory import refuse_beyond
from ehbench.vocabulary import LogError, message

_SCALE = re.compile(r"NI_Scale\[\d+\]_Scale_Type")


class _Base(NamedTuple):
    """A time base: the group that has it, how many rows, [s] their increment, the first, and the
    wall clock of zero."""

    group: str
    rows: int
    increment: float
    offset: float
    began: float | None

    @classmethod
    def of(cls, channel: Any) -> Self:
        """That of a channel."""
        properties = channel.properties
        increment = float(properties.get("wf_increment", 0.0) or 0.0)
        if properties.get("wf_xunit_string", "s") not in ("s", "sec", "seconds", ""):
            increment = 0.0  # rows of a spectrum
        start = properties.get("wf_start_time")
        began = None
        if start is not None and increment > 0.0:
            began = float(np.datetime64(start, "ns").astype(np.int64)) / 1e9
            began = began if began > 0.0 else None  # LabVIEW's zero is in 1904: it says nothing
        offset = float(properties.get("wf_start_offset", 0.0) or 0.0)
        return cls(channel.group_name, len(channel), increment, offset, began)


def read(path: Path, dialect: Dialect) -> Source:
    """The groups of a file."""
    gathered: dict[_Base, list[SourceColumn]] = {}
    moved: dict[str, float] = {}
    losses = []
    with TdmsFile.open(path) as file:
        channels = [(channel, group) for group in file.groups() for channel in group.channels()]
        refuse_beyond(24.0 * sum(len(channel) for channel, _ in channels))
        for channel, group in channels:
            if not len(channel):
                continue
            name = f"{channel.group_name}/{channel.name}"
            try:
                kind = _unknown_scale(channel.properties, group.properties, file.properties)
                values = np.asarray([] if kind else channel[:])
                reason = message("data.unknown_scale", kind=kind) if kind else ""
            except (KeyError, IndexError):
                values, reason = np.zeros(0), message("data.bad_scale")
            if reason:
                losses.append(message("data.not_converted", name=name, reason=reason))
                continue
            unit = str(channel.properties.get("unit_string", "") or "")
            base = _Base.of(channel)
            if values.dtype.kind == "M":
                seconds, began = moments(values)
                moved[channel.group_name] = began or 0.0
                column = SourceColumn(channel.name, seconds, "s")
            elif values.ndim == 1 and values.dtype.kind in "fiub":
                try:
                    column = SourceColumn(channel.name, floats(values), unit)
                except LogError as error:
                    text = message("data.not_converted", name=name, reason=error.message)
                    losses.append(text)
                    continue
            else:
                losses.append(message("data.not_read", name=name))
                continue
            gathered.setdefault(base, []).append(column)
    # on one zero of time: that of the first to begin
    first = min((began for *_, began in gathered if began is not None), default=None)
    names = [group for group, *_ in gathered]
    tables: list[SourceTable] = []
    for (group, size, increment, offset, began), columns in gathered.items():
        name = group if names.count(group) == 1 else f"{group}[{size}]"
        if any(table.name == name for table in tables):
            name = f"{group}[{size}, {1 / increment if increment else 0:g} Hz]"
        t = None
        if increment > 0.0:
            t = offset + increment * np.arange(size)
            t += 0.0 if began is None or first is None else began - first
        zero = first if t is not None else moved.get(group)
        tables.append(SourceTable(name, tuple(columns), t, zero))
    return Source(tuple(tables), losses=tuple(losses))


def _unknown_scale(*properties: Mapping[str, Any]) -> str:
    """The kind of a scale that npTDMS does not know: it would give the readings unscaled."""
    for content in properties:
        kinds = [str(content[key]) for key in content if _SCALE.fullmatch(key)]
        if kinds and content.get("NI_Scaling_Status") != "scaled":
            return "" if get_scaling(content, {}, {}) else ", ".join(kinds)
    return ""
