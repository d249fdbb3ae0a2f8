"""Foreign files as a `Record`: columns become channels in SI by a map, tables of different rates
come on one time base, and what is left out is said."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from ehbench.config.recipe.columns import LEAVE_OUT, ColumnMap, Columns, MappedColumn
from ehbench.data.logs.checks import LABEL, TIMES, check_known, check_time
from ehbench.data.logs.rates import REPEATED, apart, repeated
from ehbench.data.readers import Column, Dialect, Source, Table, open_source
from ehbench.data.record import Record
from ehbench.signals.series import lowpass
from ehbench.signals.timestamps import FEWEST, stamps_of
from ehbench.vocabulary.errors import InputError, LogError, UnitError
from ehbench.vocabulary.quantities import VOCABULARY, quantity
from ehbench.vocabulary.units import from_si

Window = tuple[float, float]
_ALL = (-np.inf, np.inf)
BRIDGED = 5  # samples in a row that a straight line may stand for
GAP = 1.5  # sample times between two samples where one is missing
CLOCK = 1e8  # [s] from which a time counts from 1970
WRONG_RATE = 0.01  # share by which rows may last another time than their stamps say
_NAMED = 4  # places that are told


@dataclass
class Group:
    """The channels of one table: its time [s], its channels in SI, where they are bad, and what
    stood there.
    """

    table: Table
    t: np.ndarray
    began: float | None
    daytime: float | None = None
    channels: dict[str, np.ndarray] = field(default_factory=dict)
    columns: dict[str, Column] = field(default_factory=dict)
    stamped: np.ndarray | None = None  # [s] stamps of rows that a rate counts instead

    @property
    def period(self) -> float:
        """Median time between samples [s]."""
        steps = np.diff(self.t[np.isfinite(self.t)])
        return float(np.median(steps)) if steps.size else np.inf

    def taken(self, rows: np.ndarray, channels: Sequence[str] | None = None) -> Group:
        """The same group with some of its rows, by number, and channels."""
        names = list(self.channels) if channels is None else channels
        columns = {name: self.columns[name].taken(rows) for name in names}
        lines = self.table.lines
        retained = None if lines is None else [lines[int(row)] for row in rows]
        return Group(
            replace(self.table, columns=tuple(columns.values()), lines=retained, words={}),
            self.t[rows],
            self.began,
            self.daytime,
            {name: self.channels[name][rows] for name in names},
            columns,
        )


def read_mapped(
    path: Path, columns: ColumnMap | None, check: bool = True, window: Window | None = None
) -> Record:
    """A log of any format that is read, by a map of its columns; without one, of the columns that
    are named as channels.

    Args:
        path: the file.
        columns: which column is which channel.
        check: refuse bad samples, or leave them out, as the map says.
        window: [s] only what lies inside is checked.

    Raises:
        LogError: no such column, no time, a bad sample inside of the window.
        UnitError: a unit that does not become the channel's.
    """
    source = open_source(path, dialect_of(columns))
    columns = columns or named_channels(source, path)
    losses: list[str] = []
    groups = _groups(source, columns, path)
    for group in groups:
        losses += _short_of(group)
    began, daytime = _one_clock(groups)
    if check and columns.columns.bad_samples == LEAVE_OUT:
        groups = [_without_repeats(group, losses) for group in groups]
    for index, group in enumerate(groups):
        _filter(group, columns)
        if check:
            groups[index] = group = _clean(group, columns, path, window or _ALL, losses)
            _check_time(group, path, window or _ALL)
        groups[index] = _in_time(group, columns)
    for group in groups:
        losses += _gaps(group, window or _ALL)
    t, channels, rates = joined(groups, losses)
    if check and not t.size:
        raise LogError("the log holds no samples", file=path)
    meta = {"rates": "; ".join(rates)} if rates else {}
    if began is not None:
        meta["began"] = datetime.fromtimestamp(began, UTC).isoformat()
    elif daytime is not None:
        meta["time_of_day"] = f"{daytime:.6f}"
    return Record(t, channels, meta, losses=tuple(losses))


def dialect_of(columns: ColumnMap | None) -> Dialect:
    """How a map says that its files are to be read."""
    if columns is None:
        return Dialect()
    message = columns.columns
    return Dialect(*columns.marks, message.skip, message.unit_row, message.encoding, message.table)


def _without_repeats(group: Group, losses: list[str]) -> Group:
    """The group without rows that are the one before once more, as loggers write them twice."""
    again = np.flatnonzero(repeated(group.t, list(group.columns.values())))
    if not again.size:
        return group
    are = "are" if again.size > 1 else "is"
    losses.append(
        f"{_called(group)}: {_rows(again.size)} that {'repeat' if again.size > 1 else 'repeats'} "
        f"the one before {are} left out{_lines(group, again)}"
    )
    return group.taken(np.delete(np.arange(group.t.size), again))


def _check_time(group: Group, path: Path, window: Window) -> None:
    """Refuse a time that stands still or goes back inside of the window."""
    inside = np.flatnonzero((group.t >= window[0]) & (group.t <= window[1]))
    lines = None if group.table.lines is None else [group.table.lines[int(at)] for at in inside]
    try:
        check_time(group.t[inside], file=path, lines=lines)
    except LogError as error:
        hint = 'for a time that is rounded write rate = "1 kHz" in the map'
        if repeated(group.t, list(group.columns.values())).any():
            hint = (
                f'bad_samples = "{LEAVE_OUT}" in the map leaves out rows that repeat the one before'
            )
        hint = f"{error.hint}; {hint}"
        raise LogError(error.message, file=path, line=error.line, hint=hint) from None


def named_channels(source: Source, path: Path) -> ColumnMap:
    """The map of a file whose columns are named as channels, with their units: ``boom.q [deg]``.

    Raises:
        LogError: there is none; says how to make a map.
    """
    results = {}
    for name, (i, j) in source.names().items():
        column = source.tables[i].columns[j]
        label = LABEL.match(name)
        channel, unit = label.groups() if label else (name, column.known_unit)
        channel = "t" if channel.lower() in TIMES else channel.replace("/", ".").strip(".")
        if channel.rpartition(".")[2] in VOCABULARY and unit:
            results[name] = MappedColumn(channel=channel, unit=unit)
    if not any(column.channel != "t" for column in results.values()):
        names = list(source.names())
        there = ", ".join(f"'{item}'" for item in names[:8]) + ", …" * (len(names) > 8)
        raise LogError(
            f"has no column named as a channel: it has {there}",
            file=path,
            hint=f"say what they are: ehbench map {path.name}",
        )
    return ColumnMap(Columns(names=results))


def _groups(source: Source, columns: ColumnMap, path: Path) -> list[Group]:
    """The mapped channels of each table, in SI."""
    places = {name: source.place(name, path) for name in columns.columns.names}
    groups: dict[int, Group] = {}
    for name, mapped in columns.columns.names.items():
        i, j = places[name]
        if mapped.channel == "t":
            continue
        check_known(mapped.channel, **columns.at("names", name))
        if i not in groups:
            t, began, stamped = _time(source, i, columns, places, path)
            daytime = source.tables[i].daytime if began is None else None
            groups[i] = Group(source.tables[i], t, began, daytime, stamped=stamped)
        column = source.tables[i].columns[j]
        groups[i].channels[mapped.channel] = si_of(name, mapped, column, columns, path)
        groups[i].columns[mapped.channel] = column
    if not groups:
        raise InputError("maps no column to a channel", **columns.at())
    return [part for group in groups.values() for part in _parts(group)]


def _parts(group: Group) -> list[Group]:
    """The channels of a table by the rows in which they stand: a group a rate."""
    names = list(group.channels)
    result = apart([group.columns[name] for name in names])
    if len(result) == 1:
        return [group]
    return [
        group.taken(np.flatnonzero(rows), [names[index] for index in item]) for item, rows in result
    ]


def si_of(
    name: str, mapped: MappedColumn, column: Column, columns: ColumnMap, path: Path
) -> np.ndarray:
    """A column in SI, by what a map says of it.

    Raises:
        UnitError: no unit, or one that does not become the channel's.
    """
    message = column.known_unit
    try:
        gain, zero = mapped.line(message)
    except UnitError as error:
        place = columns.at("names", name)
        where = place or {"file": path}
        own = f" (the file says '{column.unit}')" if column.unit and not message else ""
        raise UnitError(
            f"column '{name}': {error.message}{own}", **where, hint=error.hint
        ) from None
    return gain * column.values + zero


def _time(
    source: Source,
    index: int,
    columns: ColumnMap,
    places: Mapping[str, tuple[int, int]],
    path: Path,
) -> tuple[np.ndarray, float | None, np.ndarray | None]:
    """(time [s], wall clock of t = 0 [s since 1970], stamps [s] that it goes by no more) of a
    table: by the rate that the map says, a column of its own, or as the format knows it.
    """
    table = source.tables[index]
    times = [name for name, item in columns.columns.names.items() if item.channel == "t"]
    own = [name for name in times if places[name][0] == index]
    same = [name for name in times if source.tables[places[name][0]].size == table.size]
    began, t = table.began, table.t
    for name in [*own, *same][:1]:
        i, j = places[name]
        t = si_of(name, columns.columns.names[name], source.tables[i].columns[j], columns, path)
        began = source.tables[i].began if began is None else began
    stamped = None
    if columns.columns.rate is not None:
        stamped = t
        t = _counted(t, table.size, float(columns.columns.rate))
    if t is None:
        what = f"table '{table.name}' " if table.name else ""
        raise LogError(
            f"{what}says no time",
            file=path,
            hint='map a column to "t [s]", or write rate = "1 kHz" in the map',
        )
    good = t[np.isfinite(t)]
    if good.size and good[0] > CLOCK:
        began, t = float(good[0]), t - good[0]
    return t, began, stamped


def _counted(t: np.ndarray | None, size: int, rate: float) -> np.ndarray:
    """Time [s] of the rows of a table by their rate [Hz], from 0 on. Where stamps ``t`` stand
    beside them that are finer than the rate, these tell which rows are missing, and no more.
    """
    count = np.arange(size) / rate
    if t is None or not np.isfinite(t).all() or np.mean(np.diff(t) <= 0.0) > REPEATED:
        return count
    stamps = stamps_of(t, 1.0 / rate)
    return count if stamps is None or not stamps.even else stamps.number / rate


def _short_of(group: Group) -> list[str]:
    """A sentence where the rows of a table that a rate counts last another time than their stamps
    do, by more than these are rounded and a hundredth: rows are missing, or the rate is wrong.
    """
    if group.stamped is None or group.t.size < FEWEST or not np.isfinite(group.stamped).all():
        return []
    message, lasts = float(np.ptp(group.stamped)), float(np.ptp(group.t))
    rounded = float(np.percentile(np.abs(np.diff(group.stamped)), 99))
    if abs(message - lasts) <= 2.0 * rounded + WRONG_RATE * lasts:
        return []
    return [
        f"{_called(group)}: by their rate the rows last {lasts:.5g} s, and by their stamps "
        f"{message:.5g} s: rows are missing, or the rate in the map is another"
    ]


def _one_clock(groups: list[Group]) -> tuple[float | None, float | None]:
    """(wall clock [s since 1970], time of day [s since midnight]) of t = 0, that of the first table
    to begin: the others are shifted to it.
    """
    known = [group.began for group in groups if group.began is not None]
    days = [group.daytime for group in groups if group.daytime is not None]
    for group in groups:
        if group.began is not None:
            group.t = group.t + (group.began - min(known))
        elif group.daytime is not None:
            group.t = group.t + (group.daytime - min(days))
    return min(known, default=None), min(days, default=None)


def _filter(group: Group, columns: ColumnMap) -> None:
    """Low-pass what the map asks it for; over bad samples it goes on along a straight line."""
    for name, mapped in columns.columns.names.items():
        if mapped.filter is None or mapped.channel not in group.channels:
            continue
        span = group.period * group.t.size
        if float(mapped.filter) * span < 1.0:
            raise InputError(
                f"a filter of {float(mapped.filter):g} Hz leaves nothing of {span:.4g} s",
                **columns.at("names", name),
            )
        values = group.channels[mapped.channel]
        good = ~_bad(mapped.channel, values)
        if good.sum() > 3 and 0.0 < group.period < np.inf:
            at = np.arange(values.size)
            smooth = lowpass(
                np.interp(at, at[good], values[good]), group.period, float(mapped.filter)
            )
            group.channels[mapped.channel] = np.where(good, smooth, values)


def _clean(
    group: Group, columns: ColumnMap, path: Path, window: Window, losses: list[str]
) -> Group:
    """Refuse bad samples inside of the window, or give the group without them, as the map says: a
    few in a row are bridged, of more the rows are gone.
    """
    count = np.arange(group.t.size)
    timed = np.isfinite(group.t)
    if not timed.any():
        raise LogError("no row has a time", file=path)
    t = np.interp(count, count[timed], group.t[timed])
    inside = (t >= window[0]) & (t <= window[1])
    policies = {name.channel: name.bad_samples for name in columns.columns.names.values()}
    general = columns.columns.bad_samples
    if (lost := np.flatnonzero(~timed & inside)).size:
        if general != LEAVE_OUT:
            line = _line(group, int(lost[0]))
            raise LogError("the time is no number", file=path, line=line, hint=_CURE)
        are = "are" if lost.size > 1 else "is"
        losses.append(f"{_rows(lost.size)} without a time {are} left out{_lines(group, lost)}")
    gone = ~timed
    for channel, values in group.channels.items():
        bad = _bad(channel, values)
        if not bad.any():
            continue
        at = np.flatnonzero(bad & inside & timed)
        if at.size and (policies.get(channel) or general) != LEAVE_OUT:
            raise _bad_sample(group, channel, int(at[0]), path, columns)
        bridged = bad & _short(bad) & ~gone
        _bridge(channel, values, count, bad, bridged)
        gone |= bad & ~bridged & inside
        for some, what in ((at[bridged[at]], "bridged"), (at[~bridged[at]], "left out")):
            if some.size:
                losses.append(_left_out(channel, group, t, some, what))
    return group.taken(np.flatnonzero(~gone)) if gone.any() else group


def _in_time(group: Group, columns: ColumnMap) -> Group:
    """The group with the channels that were written late, or early, put to where they belong; the
    rows at an end for which they have no values are left out.
    """
    late = {
        item.channel: float(item.late)
        for item in columns.columns.names.values()
        if item.late is not None and item.channel in group.channels
    }
    if not any(late.values()):
        return group
    t, slack = group.t, 0.01 * group.period
    for name, by in late.items():
        values = group.channels[name]
        if name.endswith(".command"):
            at = np.searchsorted(t, t + by + slack, side="right") - 1
            group.channels[name] = values[at.clip(0)]
        else:
            group.channels[name] = np.interp(t + by, t, values)
    keep = (t + max(0.0, *late.values()) <= np.nanmax(t) + slack) & (
        t + min(0.0, *late.values()) >= np.nanmin(t) - slack
    )
    if not keep.any():
        message = ", ".join(f"{name} by {1e3 * by:g} ms" for name, by in late.items() if by)
        raise LogError(
            f"nothing is left of {t[-1] - t[0]:.4g} s once what was late is put back: {message}",
            hint="check the unit and the size of 'late' in the map",
        )
    return group.taken(np.flatnonzero(keep))


_CURE = 'bad_samples = "leave out" in the map leaves such samples out and says where'


def _bad(channel: str, values: np.ndarray) -> np.ndarray:
    """Where no number stands that a rig can have."""
    row = quantity(channel)
    return ~(np.isfinite(values) & (values >= row.lower) & (values <= row.upper))


def _bridge(
    channel: str, values: np.ndarray, count: np.ndarray, bad: np.ndarray, bridged: np.ndarray
) -> None:
    """Put a straight line, or the last command, in place of the samples to be bridged."""
    good = np.flatnonzero(~bad)
    if not good.size:
        return
    if channel.endswith(".command"):
        before = np.searchsorted(good, count[bridged], side="right") - 1
        values[bridged] = values[good[before.clip(0)]]
    else:
        values[bridged] = np.interp(count[bridged], good, values[good])


def _short(bad: np.ndarray) -> np.ndarray:
    """Where a run of bad samples is short enough to be bridged, with good ones at both ends."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]])))
    result = np.zeros(bad.size, bool)
    for start, stop in edges.reshape(-1, 2):
        result[start:stop] = stop - start <= BRIDGED and start > 0 and stop < bad.size
    return result


def _left_out(channel: str, group: Group, t: np.ndarray, at: np.ndarray, what: str) -> str:
    """A sentence on samples that are left out."""
    if what == "bridged":
        how = "the last is held" if channel.endswith(".command") else "bridged by a straight line"
        some = ", ".join(f"{t[item]:.6g}" for item in at[:_NAMED]) + ", …" * (at.size > _NAMED)
        return f"{channel}: {_samples(at.size)} left out at t = {some} s{_lines(group, at)}: {how}"
    span = f"between t = {t[at[0]]:.6g} and {t[at[-1]]:.6g} s"
    return f"{channel}: {_samples(at.size)} left out {span}{_lines(group, at)}, with their rows"


def _samples(count: int) -> str:
    return f"{count} bad sample{'s are' if count != 1 else ' is'}"


def _rows(count: int) -> str:
    return f"{count} row{'s' * (count != 1)}"


def _line(group: Group, at: int) -> int | None:
    return None if group.table.lines is None else group.table.lines[at]


def _lines(group: Group, at: np.ndarray) -> str:
    if group.table.lines is None:
        return ""
    some = ", ".join(str(group.table.lines[int(item)]) for item in at[:_NAMED])
    return f" (line{'s' * (at.size > 1)} {some}{', …' * (at.size > _NAMED)})"


def _bad_sample(
    group: Group, channel: str, at: int, path: Path, columns: ColumnMap
) -> LogError | UnitError:
    """The error of a bad sample."""
    row, value, column = quantity(channel), group.channels[channel][at], group.columns[channel]
    line = _line(group, at)
    where = "" if line else f" at t = {group.t[at]:.9g} s"
    if np.isfinite(value):
        bounds = " to ".join(f"{from_si(b, row.display, row):g}" for b in (row.lower, row.upper))
        shown = f"{from_si(value, row.display, row):g} {row.display}"
        return UnitError(
            f"{channel} = {shown}{where} lies outside {bounds} {row.display}",
            file=path,
            line=line,
            hint=f"check unit, scale and sign of column '{column.name}', or write "
            f'bad_samples = "{LEAVE_OUT}"',
        )
    odd = column.odd.get(at)
    what = f"is {value:g}" if odd is None else f"'{odd}' is no number" if odd else "is blank"
    return LogError(f"{channel}: {what}{where}", file=path, line=line, hint=_CURE)


def joined(
    groups: Sequence[Group], losses: list[str]
) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
    """(time [s], all channels, a sentence on each other rate) on the time base of the fastest
    table; readings of the others lie on straight lines between their samples, commands are held.
    Rows that not all tables have values for are left out, and ``losses`` says so.
    """
    rates = []
    base = min(groups, key=lambda group: group.period)
    t, channels, keep = base.t, dict(base.channels), np.ones(base.t.size, bool)
    for group in groups:
        if group is base:
            continue
        good = np.isfinite(group.t) & (np.diff(group.t, prepend=-np.inf) > 0)
        own, before = group.t[good], np.searchsorted(group.t[good], t, side="right") - 1
        if np.array_equal(own, t):
            channels.update({name: values[good] for name, values in group.channels.items()})
            continue
        ends = own[-1] + group.period if np.isfinite(group.period) else own[-1]
        covered = (t >= own[0]) & (t <= ends)
        after = np.append(own, np.inf)[before + 1] - own[before.clip(0)]
        holes = covered & (after > (1 + GAP) * group.period) & (before < own.size - 1)
        holes &= own[before.clip(0)] != t
        keep &= covered & ~holes
        for name, values in group.channels.items():
            fixed = values[good][before.clip(0)]
            line = np.interp(t, own, values[good])
            channels[name] = fixed if name.endswith(".command") else line
        if abs(group.period - base.period) > 0.01 * base.period:
            rates.append(
                f"{_called(group)}: {1 / group.period:.4g} Hz, brought to {1 / base.period:.4g} Hz"
            )
    if not keep.all():
        losses += _uncovered(t, keep, max(group.period for group in groups))
        t, channels = t[keep], {name: values[keep] for name, values in channels.items()}
    return t, channels, rates


def _uncovered(t: np.ndarray, keep: np.ndarray, slack: float) -> list[str]:
    """A sentence on the rows that not all tables cover: tables begin and end a sample of the
    slowest apart, which is no loss.
    """
    if keep.any():
        first, last = t[keep][[0, -1]]
        keep = keep | ((t < first) & (first - t[0] <= slack))
        keep |= (t > last) & (t[-1] - last <= slack)
    lost = int((~keep).sum())
    if not lost:
        return []
    are = "are" if lost > 1 else "is"
    return [f"{_rows(lost)} {are} left out: not all tables have values there"]


def _called(group: Group) -> str:
    names = list(group.channels)
    some = ", ".join(names[:_NAMED]) + ", …" * (len(names) > _NAMED)
    return f"table '{group.table.name}'" if group.table.name else some


def _gaps(group: Group, window: Window) -> list[str]:
    """A sentence on where samples are missing inside of the window."""
    t = group.t[(group.t >= window[0]) & (group.t <= window[1])]
    if not 0.0 < group.period < np.inf:
        return []
    missing = np.where((steps := np.diff(t) / group.period) > GAP, np.rint(steps - 1.0), 0.0)
    if np.any(np.abs(steps - missing - 1.0) > GAP - 1.0):  # late stamps, by which no step tells
        stamps = stamps_of(t)
        missing = stamps.missing if stamps is not None and stamps.even else missing
    at = np.flatnonzero(missing)
    if not at.size:
        return []
    few = [
        f"{missing[item]:.0f} between t = {t[item]:.6g} and {t[item + 1]:.6g} s"
        for item in at[:_NAMED]
    ]
    more = f", … ({at.size} gaps)" if at.size > _NAMED else ""
    total = missing.sum()
    are = f"{total:.0f} sample{'s are' if total > 1 else ' is'} missing"
    return [f"{_called(group)}: about {are}, {', '.join(few)}{more}"]
