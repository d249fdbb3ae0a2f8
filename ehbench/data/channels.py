"""Foreign files as a `Record`: by a map, columns become channels in SI, on one time base; bad
samples are refused, bridged, or left out with their rows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import numpy as np

from ehbench.config.recipe.columns import LEAVE_OUT, ColumnMap, Columns, MappedColumn
from ehbench.data.logs.checks import TIME_NAMES, check_known
from ehbench.data.rates import (
    SETTINGS,
    Group,
    Window,
    apart,
    gaps,
    in_window,
    is_bad,
    joined,
    lines_text,
    range_of,
)
from ehbench.data.readers import Dialect, Source, SourceColumn, open_source
from ehbench.data.readers.clock import since_1970
from ehbench.data.record import Record, resampled
from ehbench.data.text import head_of
from ehbench.signals.oddities import continuous
from ehbench.signals.series import lowpass, stretches_of
from ehbench.signals.timestamps import resolution, timestamps_of, unrounded, unwrapped
from ehbench.vocabulary import VOCABULARY, Message, from_si, listed, message, plural, quantity
from ehbench.vocabulary.errors import InputError, LogError, UnitError

DAYS = ("d", "day", "days")  # units of a time that spreadsheets count


def read_mapped(
    path: Path, columns: ColumnMap | None, check: bool = True, window: Window | None = None
) -> Record:
    """A log of any format that is read, by a map of its columns, which says whether bad samples are
    refused or left out; without one, of the columns that are named as channels. Other arguments as
    in `ehbench.data.read`.

    Raises:
        LogError: no such column, no time, a bad sample inside of the window.
        UnitError: a unit that does not become the channel's."""
    source = open_source(path, dialect_of(columns))
    if columns is None or not columns.columns.names:  # the file's own names
        names, given = named_channels(source, path), columns or ColumnMap(Columns())
        keys = given.columns.model_copy(update={"names": names.columns.names})
        columns = replace(given, columns=keys)
    mapping = _Mapping(path, columns, source)
    groups = mapping.groups()
    losses: list[str] = [note for group in groups for note in group.wrong_rate()]
    for name, mapped in columns.columns.names.items():
        losses += overruled(name, mapped, mapping.column(name), path)
    of_text = source.dialect.separator is not None  # tables below one another
    used = {index for index, _ in mapping.places.values()}
    for index, table in enumerate(source.tables if of_text else ()):
        if index not in used:
            fields = {"table": table.name, "line": (table.lines or [0])[0]}
            losses.append(message("data.unused_table", **fields))
    # the others are shifted to the first table that begins, by its wall clock or its time of day
    began = min((group.began for group in groups if group.began is not None), default=None)
    daytime = min((group.daytime for group in groups if group.daytime is not None), default=None)
    for group in groups:
        if group.began is not None and began is not None:
            group.t = group.t + (group.began - began)
        elif group.daytime is not None and daytime is not None:
            group.t = group.t + (group.daytime - daytime)
    if check and columns.columns.bad_samples == LEAVE_OUT:
        groups = [group.without_repeats(losses) for group in groups]
    for index, group in enumerate(groups):
        _filter(group, columns)
        if check:
            group = clean(group, columns, path, window, losses)
            group.check_time(path, window)
        groups[index] = _in_time(group, columns)
    for group in groups:
        losses += gaps(group, window)
    record, rates = joined(groups, losses)
    if check and not record.t.size:
        raise LogError(message("data.no_samples"), file=path)
    meta = dict(source.meta) | record.meta | ({"rates": "; ".join(rates)} if rates else {})
    if began is not None:
        meta["began"] = datetime.fromtimestamp(began, UTC).isoformat()
    elif daytime is not None:
        meta["time_of_day"] = f"{daytime:.6f}"
    return replace(record, meta=meta, losses=tuple(losses))


def dialect_of(columns: ColumnMap | None) -> Dialect:
    """How a map says that its files are to be read."""
    if columns is None:
        return Dialect()
    keys = columns.columns
    return Dialect(
        *columns.marks, keys.skip, keys.unit_row, keys.encoding, keys.table, keys.day_first
    )


def named_channels(source: Source, path: Path) -> ColumnMap:
    """The map of a file whose columns are named as channels, with their units: ``boom.q [deg]``.

    Raises:
        LogError: there is none; says how to make a map."""
    results = {}
    for name, (i, j) in source.names().items():
        channel, unit = head_of(name)
        unit = unit or source.tables[i].columns[j].known_unit
        channel = "t" if channel.lower() in TIME_NAMES else channel.replace("/", ".").strip(".")
        if channel.rpartition(".")[2] in VOCABULARY and unit:
            results[name] = MappedColumn(channel=channel, unit=unit)
    if not any(column.channel != "t" for column in results.values()):
        there = listed((f"'{name}'" for name in source.names()), 8)
        raise LogError(message("data.no_named_channel", there=there, file=path.name), file=path)
    return ColumnMap(Columns(names=results))


def si_of(
    name: str,
    mapped: MappedColumn,
    column: SourceColumn,
    columns: ColumnMap,
    path: Path,
    lines: Sequence[int] | None = None,
) -> np.ndarray:
    """A column in SI, by what a map says of it.

    Raises:
        UnitError: no unit, or one that does not become the channel's.
        LogError: a cell can be read in two ways."""
    if column.doubt is not None:
        row, doubt = column.doubt
        text = message("data.column_error", name=name, error=doubt, unit="")
        raise LogError(text, file=path, line=lines[row] if lines else None, hint=doubt.hint)
    unit = column.known_unit
    try:
        gain, zero = mapped.line(unit)
    except UnitError as error:
        key = "data.unit_of_file" if column.unit and not unit else "data.column_error"
        text = message(key, name=name, error=error.message, unit=column.unit)
        where = columns.at("names", name) or {"file": path}
        gauge = column.absolute and message("vocabulary.instead_gauge", gauge=column.absolute)
        raise UnitError(text, hint=gauge or error.hint, **where) from None
    return gain * column.values + zero


def overruled(name: str, mapped: MappedColumn, column: SourceColumn, path: Path) -> list[Message]:
    """A note on a column whose unit in the file is another than in the map, or absolute where the
    map takes nothing away."""
    unit = column.known_unit
    if column.absolute and mapped.unit and not (mapped.offset or mapped.neutral or mapped.from_):
        unit = f"{column.absolute}a"
    elif not mapped.overrules(unit):
        return []
    fields = {"file": path.name, "name": name, "unit": unit}
    return [message("data.unit_overruled", mapped=mapped.unit, **fields)]


@dataclass(frozen=True)
class _Mapping:
    path: Path
    columns: ColumnMap
    source: Source

    @cached_property
    def places(self) -> dict[str, tuple[int, int]]:
        """(table, column) of each name of the map."""
        return {name: self.source.place(name, self.path) for name in self.columns.columns.names}

    def groups(self) -> list[Group]:
        """The mapped channels in SI, those of one table and one rate together: by the rows in which
        they stand, a group a rate."""
        groups: dict[tuple[int, str], Group] = {}
        for name, mapped in self.columns.columns.names.items():
            if mapped.channel == "t":
                continue
            check_known(mapped.channel, **self.columns.at("names", name))
            index, time = self.places[name][0], self._time_of(name)
            if (index, time) not in groups:
                groups[index, time] = self._timed(index, time)
            group = groups[index, time]
            group.channels[mapped.channel] = self._si(name)
            group.columns[mapped.channel] = self.column(name)
        if not groups:
            raise InputError(message("data.maps_nothing"), **self.columns.at())
        times, results = [index for index, _ in groups], []
        for (index, _), group in groups.items():
            if times.count(index) > 1:  # a time shorter than its table: blank rows follow it
                filled = [np.isfinite(group.t), *(item.filled for item in group.columns.values())]
                group = group.taken(np.flatnonzero(np.any(filled, axis=0)))
            names = list(group.channels)
            parts = apart([group.columns[name] for name in names])
            if len(parts) == 1:
                results.append(group)
                continue
            for places, rows in parts:
                results.append(group.taken(np.flatnonzero(rows), [names[at] for at in places]))
        return results

    def _time_of(self, name: str) -> str:
        """The column of time of another column: of those in its table the nearest to its left,
        else the first; else one of a table as long; '' of none."""
        tables, (index, place) = self.source.tables, self.places[name]
        times = [
            (item, *self.places[item])
            for item, mapped in self.columns.columns.names.items()
            if mapped.channel == "t"
        ]
        here = sorted((j, item) for item, i, j in times if i == index)
        left = [item for j, item in here if j < place]
        right = [item for j, item in here if j > place]
        same = [item for item, i, _ in times if tables[i].size == tables[index].size]
        return [*left[-1:], *right[:1], *same[:1], ""][0]

    def column(self, name: str) -> SourceColumn:
        """The column of a name."""
        table, column = self.places[name]
        return self.source.tables[table].columns[column]

    def _si(self, name: str) -> np.ndarray:
        mapped = self.columns.columns.names[name]
        lines, column = self.source.tables[self.places[name][0]].lines, self.column(name)
        if mapped.channel == "t":
            column = replace(column, values=unwrapped(column.values))
        elif mapped.channel.endswith((".q", ".x")):
            column = replace(column, values=continuous(column.values))
        return si_of(name, mapped, column, self.columns, self.path, lines)

    def _timed(self, index: int, time: str) -> Group:
        """A table with its time, and no channel yet: by the rate that the map says, a column of
        time, or as the format knows it."""
        table = self.source.tables[index]
        began, t = table.began, table.t
        if time:
            t, of = self._si(time), self.source.tables[self.places[time][0]]
            began = of.began if began is None else began
        stamped, step = None, 0.0
        if self.columns.columns.rate is not None:
            stamped = t
            rate = float(self.columns.columns.rate)
            t = np.arange(table.size) / rate
            if stamped is not None and np.isfinite(stamped).all():
                # stamps that are finer than the rate tell which rows are missing
                fine = np.mean(np.diff(stamped) <= 0.0) <= SETTINGS.repeated
                stamps = timestamps_of(stamped, 1.0 / rate) if fine else None
                t = stamps.number / rate if stamps is not None and stamps.even else t
        elif t is not None and time:
            values = unwrapped(self.column(time).values)
            values = values[np.isfinite(values)]
            if values.size == t.size and np.ptp(values) > 0.0:
                coarse, scale = resolution(values), float(np.ptp(t) / np.ptp(values))
                even = unrounded(t, max(coarse) * scale)
                step = coarse.narrow * scale if even is t else 0.0
                t = even
        if t is None:
            what = f"table '{table.name}' " if table.name else ""
            raise LogError(message("data.no_time", table=what), file=self.path)
        good = t[np.isfinite(t)]
        days = time != "" and self.columns.columns.names[time].unit in DAYS
        if good.size and (moment := since_1970(float(good[0]), days)) is not None:
            began, t = moment, t - good[0]
        daytime = table.daytime if began is None else None
        about = {"stamped": stamped, "resolution": step}
        return Group(table.name, t, table.lines, began, daytime, **about)


def _filter(group: Group, columns: ColumnMap) -> None:
    """Low-pass what the map asks it for; over bad samples it goes on along a straight line."""
    for name, mapped in columns.columns.names.items():
        if mapped.filter is None or mapped.channel not in group.channels:
            continue
        span, cutoff = group.period * group.t.size, float(mapped.filter)
        if cutoff * span < 1.0:
            text = message("data.filter_of_short_log", frequency=cutoff, span=span)
            raise InputError(text, **columns.at("names", name))
        values = group.channels[mapped.channel]
        good = ~is_bad(mapped.channel, values, columns.travels.get(mapped.channel))
        if good.sum() > 3 and 0.0 < group.period < np.inf:
            at = np.arange(values.size)
            smooth = lowpass(np.interp(at, at[good], values[good]), group.period, cutoff)
            group.channels[mapped.channel] = np.where(good, smooth, values)


def _in_time(group: Group, columns: ColumnMap) -> Group:
    """The group with the channels that were written late, or early, put to where they belong, on
    straight lines between their samples: a command too, which may be late by part of a sample time.
    The rows at an end for which they have no values are left out."""
    late = {
        item.channel: float(item.late)
        for item in columns.columns.names.values()
        if item.late is not None and item.channel in group.channels
    }
    if not any(late.values()):
        return group
    t, slack = group.t, 0.01 * group.period
    for name, by in late.items():
        group.channels[name] = np.interp(t + by, t, group.channels[name])
    keep = t + max(0.0, *late.values()) <= np.nanmax(t) + slack
    keep &= t + min(0.0, *late.values()) >= np.nanmin(t) - slack
    if not keep.any():
        shifts = ", ".join(f"{name} by {1e3 * by:g} ms" for name, by in late.items() if by)
        raise LogError(message("data.nothing_in_time", span=t[-1] - t[0], shifts=shifts))
    return group.taken(np.flatnonzero(keep))


def clean(
    group: Group, columns: ColumnMap, path: Path, window: Window | None, losses: list[str]
) -> Group:
    """Refuse bad samples inside of the window, or give the group without them, as the map says: a
    few in a row are bridged, of more the rows are gone.

    Raises:
        LogError, UnitError: a bad sample that the map does not allow; no row has a time."""
    count = np.arange(group.t.size)
    timed = np.isfinite(group.t)
    if not timed.any():
        raise LogError(message("data.no_row_timed"), file=path)
    t = np.interp(count, count[timed], group.t[timed])
    inside = in_window(t, window)
    policies = {item.channel: item.bad_samples for item in columns.columns.names.values()}
    general = columns.columns.bad_samples
    if (lost := np.flatnonzero(~timed & inside)).size:
        if general != LEAVE_OUT:
            text = message("data.row_without_time")
            odd = next(iter(group.columns.values())).odd.get(int(lost[0]))
            line, hint = group.line(lost[0]), text.hint
            text = odd if isinstance(odd, Message) else text  # of the whole row
            raise LogError(text, file=path, line=line, hint=hint)
        rows, lines = plural(lost.size, "row"), lines_text(group, lost)
        losses.append(message("data.rows_without_time", rows=rows, lines=lines))
    gone, found = ~timed, {}
    for channel, values in group.channels.items():
        travel = columns.travels.get(channel)
        bad = is_bad(channel, values, travel)
        if not bad.any():
            continue
        at = np.flatnonzero(bad & inside & timed)
        if at.size and (policies.get(channel) or general) != LEAVE_OUT:
            raise _bad_sample(group, channel, int(at[0]), path, travel)
        bridged = bad & _short(bad) & ~gone
        if bridged.any():
            good = {channel: values[~bad]}
            values[bridged] = resampled(good, count[~bad], count[bridged])[channel]
        gone |= bad & ~bridged & inside
        found[channel] = at
        for some, is_bridged in ((at[bridged[at]], True), (at[~bridged[at]], False)):
            if some.size:
                losses.append(_left_out(channel, group, t, some, is_bridged))
    if gone[inside].all() and found:
        worst = max(found, key=lambda name: found[name].size)
        at = int(found[worst][0])
        error = _bad_sample(group, worst, at, path, columns.travels.get(worst))
        hint = message("data.none_left", column=group.columns[worst].name)
        raise type(error)(error.message, file=path, line=error.line, hint=hint)
    return group.taken(np.flatnonzero(~gone)) if gone.any() else group


def _short(bad: np.ndarray) -> np.ndarray:
    """Where a run of bad samples is short enough to be bridged, with good ones at both ends."""
    result = np.zeros(bad.size, bool)
    for start, stop in stretches_of(bad):
        few = stop - start <= SETTINGS.bridged
        result[start:stop] = few and start > 0 and stop < bad.size
    return result


def _left_out(channel: str, group: Group, t: np.ndarray, at: np.ndarray, is_bridged: bool) -> str:
    samples, lines = plural(at.size, "bad sample"), lines_text(group, at)
    if not is_bridged:
        first, last = t[at[0]], t[at[-1]]
        fields = {"channel": channel, "samples": samples, "lines": lines}
        return message("data.rows_left_out", first=first, last=last, **fields)
    some = listed(f"{item:.6g}" for item in t[at])
    key = "data.command_bridged" if channel.endswith(".command") else "data.samples_bridged"
    run = 1 + max(map(len, np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)))
    fields = {"share": at.size / t.size, "longest": run * group.period}
    return message(key, channel=channel, samples=samples, times=some, lines=lines, **fields)


def _bad_sample(
    group: Group, channel: str, at: int, path: Path, travel: float | None
) -> LogError | UnitError:
    row, value, column = quantity(channel), group.channels[channel][at], group.columns[channel]
    line = group.line(at)
    where = "" if line else f" at t = {group.t[at]:.9g} s"
    if np.isfinite(value):
        low, high = range_of(channel, group.channels[channel], travel)
        ends = {"low": low, "high": high, "value": value}
        fields = {key: from_si(x, row.display, row) for key, x in ends.items()}
        fields |= {"channel": channel, "column": column.name, "unit": row.display}
        return UnitError(message("data.bad_value", where=where, **fields), file=path, line=line)
    odd = column.odd.get(at)
    what = f"is {value:g}" if odd is None else f"'{odd}' is no number" if odd else "is blank"
    what = odd if isinstance(odd, Message) else what
    text = message("data.bad_sample", channel=channel, what=what, where=where)
    return LogError(text, file=path, line=line)
