"""Logs that two recorders wrote of one run, brought on one time base."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from ehbench.config.recipe.columns import ColumnMap
from ehbench.data.rates import Group, joined
from ehbench.data.record import PERIODS, Record
from ehbench.vocabulary import InputError, message

_DAY = 86400.0
_HALF_HOUR = 1800.0


@dataclass(frozen=True)
class AdditionalFile:
    """A file that another recorder wrote of the same run: its map of columns, and by how much its
    samples were taken later [s] than its time says (None where its clock is to tell). Without a
    ``shared_clock`` both times count from their own zero, whatever their clocks say."""

    path: Path
    columns: ColumnMap | None = None
    shift: float | None = None
    shared_clock: bool = True


def lateness(record: Record, path: Path, result: Record, other: AdditionalFile) -> float:
    """By how much the time 0 of an additional file lies after that of the log [s].

    Raises:
        InputError: nothing tells."""
    shift = other.shift or 0.0
    if not other.shared_clock:
        return shift
    clocks = []
    for item in (record, result):
        if (text := item.meta.get("began")) is not None:
            clocks.append(datetime.fromisoformat(text).timestamp())
        elif (text := item.meta.get("time_of_day")) is not None:
            clocks.append(float(text))
    if len(clocks) == 2:
        late, dated = clocks[1] - clocks[0], "began" in record.meta and "began" in result.meta
        # times of day, where one knows no more, are less than half a day off
        return shift + (late if dated else (late + 0.5 * _DAY) % _DAY - 0.5 * _DAY)
    if other.shift is None:
        fields = {"log": path.name, "there": _began(record), "here": _began(result)}
        raise InputError(message("data.no_common_clock", **fields), file=other.path)
    return shift


def with_additional(
    record: Record, path: Path, others: Sequence[tuple[AdditionalFile, Record, float]]
) -> Record:
    """A log with the channels of ``others``: file, record and lateness [s] of each additional one.
    Its time counts on as in ``path``, its own file. The fastest file gives the time base, as the
    fastest table of a file does.

    Raises:
        InputError: a file has a channel that is there already, or no sample at the log's time."""
    groups = [Group(path.name, record.t, channels=dict(record.channels))]
    losses = list(record.losses)
    rates = [record.meta["rates"]] if "rates" in record.meta else []
    for other, result, late in others:
        there = {name for item in groups for name in item.channels}
        if twice := sorted(there & {*result.channels}):
            text = message("data.in_two_files", channels=", ".join(twice))
            raise InputError(text, file=other.path)
        t = result.t + late
        if not ((t >= record.t[0]) & (t <= record.t[-1])).any():
            zones = ""
            if t.size:  # clocks of two time zones are whole half hours apart
                middle = 0.5 * (t[0] + t[-1] - record.t[0] - record.t[-1])
                halves = -round(middle / _HALF_HOUR)
                near = t + halves * _HALF_HOUR
                if halves and near[0] < record.t[-1] and near[-1] > record.t[0]:
                    zones = message("data.two_time_zones", hours=0.5 * halves)
            fields = {"log": path.name, "there": _ends(record, 0.0), "here": _ends(result, late)}
            text = message("data.no_common_time", zones=zones, **fields)
            raise InputError(text, file=other.path)
        groups.append(Group(other.path.name, t, channels=dict(result.channels)))
        losses += [f"{other.path.name}: {loss}" for loss in result.losses]
        rates += [result.meta["rates"]] if "rates" in result.meta else []
    together, brought = joined(groups, losses)
    if not together.t.size:
        raise InputError(message("data.no_common_sample"), file=path)
    meta = record.meta | ({"rates": "; ".join(rates + brought)} if rates + brought else {})
    known = [item.periods for item in (together, record, *(item for _, item, _ in others))]
    if periods := {name: period for each in known for name, period in each.items()}:
        meta |= {PERIODS: json.dumps(periods)}
    record = replace(record, t=together.t, channels=together.channels)
    return replace(record, meta=meta, losses=tuple(losses))


def _began(record: Record) -> str:
    """When a log began, as far as it knows."""
    if (text := record.meta.get("began")) is not None:
        return text.replace("T", " ").replace("+00:00", "")
    if (day := record.meta.get("time_of_day")) is not None:
        minutes, seconds = divmod(float(day), 60.0)
        return f"{int(minutes) // 60:02d}:{int(minutes) % 60:02d}:{seconds:06.3f}"
    return "no clock"


def _ends(record: Record, late: float) -> str:
    """From when to when a log runs, and by which clock."""
    if not record.t.size:
        return "no sample"
    clock = _began(record)
    zero = "" if clock == "no clock" else f" (its time 0 is {clock})"
    first, last = (record.t[[0, -1]] + late).tolist()
    return f"{first:.6g} to {last:.6g} s{zero}"
