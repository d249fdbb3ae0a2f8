"""Logs that two recorders wrote of one run, brought on one time base."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from ehbench.config.recipe.columns import ColumnMap
from ehbench.data.logs.mapped import Group, Window, joined
from ehbench.data.logs.reading import read_record
from ehbench.data.readers import Table
from ehbench.data.record import Record
from ehbench.vocabulary.errors import InputError

_DAY = 86400.0
_HALF_HOUR = 1800.0
_AFTER = 'shift = "0 s" where both began at once, else how much later this file\'s time 0 lies'


@dataclass(frozen=True)
class Beside:
    """A file that another recorder wrote of the same run: its map of columns, and by how much its
    samples were taken later [s] than its time says (None where its clock is to tell). Without a
    ``shared_clock`` both times count from their own zero, whatever their clocks say.
    """

    path: Path
    columns: ColumnMap | None = None
    shift: float | None = None
    shared_clock: bool = True


def with_beside(
    record: Record, path: Path, others: Sequence[Beside], window: Window | None = None
) -> Record:
    """A log with the channels of files beside it, its time counting on as in ``path``, its own
    file. The fastest file gives the time base, as the fastest table of a file does.

    Raises:
        LogError: a file cannot be read, or has a bad sample inside of the window.
        InputError: nothing tells when it began, it has a channel that is there already, or no
            sample at the log's time.
    """
    groups, losses = [_group(path, record, 0.0)], list(record.losses)
    rates = [record.meta["rates"]] if "rates" in record.meta else []
    for other in others:
        whole = window is None or not np.isfinite(window).any()
        result = read_record(other.path, whole, other.columns)
        late = _lateness(record, path, result, other)
        if window is not None and not whole:
            span = (window[0] - late, window[1] - late)
            result = read_record(other.path, True, other.columns, span)
        if twice := sorted(
            {name for group in groups for name in group.channels} & {*result.channels}
        ):
            raise InputError(
                f"has {', '.join(twice)}, and so has a file beside it",
                file=other.path,
                hint="leave it out of one of the maps",
            )
        t = result.t + late
        if not ((t >= record.t[0]) & (t <= record.t[-1])).any():
            raise InputError(
                f"has no sample while {path.name} runs: {_ends(record, 0.0)} there, "
                f"{_ends(result, late)} here",
                file=other.path,
                hint=_cure(t, record),
            )
        groups.append(_group(other.path, result, late))
        losses += [f"{other.path.name}: {loss}" for loss in result.losses]
        rates += [result.meta["rates"]] if "rates" in result.meta else []
    t, channels, brought = joined(groups, losses)
    if not t.size:
        raise InputError("has no sample at which all files beside it have one", file=path)
    meta = record.meta | ({"rates": "; ".join(rates + brought)} if rates + brought else {})
    return replace(record, t=t, channels=channels, meta=meta, losses=tuple(losses))


def _group(path: Path, record: Record, late: float) -> Group:
    """A log as a table of its own, ``late`` [s] against the first."""
    return Group(Table(path.name, ()), record.t + late, None, channels=dict(record.channels))


def _lateness(record: Record, path: Path, result: Record, other: Beside) -> float:
    """By how much the time 0 of a file lies after that of the log [s]."""
    message = _clock(record, result) if other.shared_clock else None
    if message is None and other.shift is None:
        if not other.shared_clock:
            return 0.0
        raise InputError(
            f"nothing tells when it began against {path.name}: {_began(record)} there, "
            f"{_began(result)} here",
            file=other.path,
            hint=_AFTER,
        )
    return (message or 0.0) + (other.shift or 0.0)


def _clock(record: Record, result: Record) -> float | None:
    """What the clocks of two logs say of that [s]: by date and time, by the times of day where one
    knows no more; None where one knows neither.
    """
    moments = [_moment(item) for item in (record, result)]
    if moments[0] is not None and moments[1] is not None:
        return moments[1] - moments[0]
    days = [
        float(item.meta["time_of_day"]) if "time_of_day" in item.meta else moment
        for item, moment in zip((record, result), moments, strict=True)
    ]
    if days[0] is None or days[1] is None:
        return None
    return (days[1] - days[0] + 0.5 * _DAY) % _DAY - 0.5 * _DAY


def _moment(record: Record) -> float | None:
    """Wall clock of a log's t = 0 [s since 1970], None where it knows none."""
    text = record.meta.get("began")
    return None if text is None else datetime.fromisoformat(text).timestamp()


def _began(record: Record) -> str:
    """When a log began, as far as it knows."""
    if (text := record.meta.get("began")) is not None:
        return text.replace("T", " ").replace("+00:00", "")
    if (day := record.meta.get("time_of_day")) is not None:
        return _daytime(float(day))
    return "no clock"


def _cure(t: np.ndarray, record: Record) -> str:
    """What to write where two files have no time in common; clocks of other zones are whole half
    hours apart.
    """
    cure = "say by how much their clocks differ: shift, which counts beside them"
    if t.size:
        halves = -round((0.5 * (t[0] + t[-1]) - 0.5 * (record.t[0] + record.t[-1])) / _HALF_HOUR)
        near = t + halves * _HALF_HOUR
        if halves and near[0] < record.t[-1] and near[-1] > record.t[0]:
            cure = f'clocks of two time zones? shift = "{0.5 * halves:g} h" puts them together'
    return f'{cure}; or clock = "own" where each counts from its own start'


def _daytime(seconds: float) -> str:
    minutes, rest = divmod(seconds, 60.0)
    return f"{int(minutes) // 60:02d}:{int(minutes) % 60:02d}:{rest:06.3f}"


def _ends(record: Record, late: float) -> str:
    """From when to when a log runs, and by which clock."""
    if not record.t.size:
        return "no sample"
    clock = _began(record)
    message = "" if clock == "no clock" else f" (its time 0 is {clock})"
    first, last = (record.t[[0, -1]] + late).tolist()
    return f"{first:.6g} to {last:.6g} s{message}"
