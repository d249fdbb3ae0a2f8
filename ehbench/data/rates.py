"""Tables of several rates: signals that take turns in one table, and tables on one time base."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ehbench.data.logs.checks import check_time
from ehbench.data.readers import SourceColumn
from ehbench.data.record import PERIODS, Record, Window, resampled
from ehbench.signals.timestamps import SETTINGS as TIMESTAMP
from ehbench.signals.timestamps import missing_rows
from ehbench.vocabulary import LogError, listed, message, plural, quantity, setting


@dataclass(frozen=True)
class RateSettings:
    """How signals of a foreign file are told apart and brought together."""

    bridged: int = setting(5, "", "bad or missing samples in a row that a line bridges", "short")
    gap: float = setting(
        1.5, "", "sample times between two samples from which one is missing", "half a sample late"
    )
    wrong_rate: float = setting(
        0.01, "", "share by which rows may last another time than stamps", "clocks differ less"
    )
    repeated: float = setting(
        0.05, "", "share of rows above which a standing time is rounded", "repeats are rare"
    )
    slower: float = setting(
        1.5, "", "times the rows between values from which a signal has its own rate", "2 in theory"
    )
    shared: float = setting(
        0.1, "", "share of rows up to which two signals take turns", "messages collide at times"
    )
    fewest: int = setting(4, "", "values that tell a rate", "three steps have a median")


SETTINGS = RateSettings()


@dataclass
class Group:
    """The channels of one table at one rate: the table's name, the lines of its rows in a text
    file, its time [s], wall clock of t = 0 [s since 1970] and time of day [s], its channels in SI
    and the columns they are from.

    ``stamped`` [s] are stamps of rows that a rate counts instead; ``resolution`` [s] is what times
    are rounded to."""

    name: str
    t: np.ndarray
    lines: Sequence[int] | None = None
    began: float | None = None
    daytime: float | None = None
    channels: dict[str, np.ndarray] = field(default_factory=dict)
    columns: dict[str, SourceColumn] = field(default_factory=dict)
    stamped: np.ndarray | None = None
    resolution: float = 0.0

    @property
    def period(self) -> float:
        """Median time between samples [s] where it goes on."""
        steps = np.diff(self.t[np.isfinite(self.t)])
        steps = steps[steps > 0.0]
        return float(np.median(steps)) if steps.size else np.inf

    @property
    def title(self) -> str:
        """The table by its name, else its first channels."""
        return f"table '{self.name}'" if self.name else listed(self.channels)

    @property
    def repeated(self) -> np.ndarray:
        """Where a row is the one before once more: its time and all its cells. Nowhere in a table
        whose time stands still often, as one that is rounded does."""
        same = np.concatenate([[False], self.t[1:] == self.t[:-1]])
        if not 0.0 < same.mean() <= SETTINGS.repeated:
            return np.zeros(self.t.size, bool)
        for column in self.columns.values():
            values = column.values
            same[1:] &= (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
            for row in np.flatnonzero(same):
                same[row] &= column.odd.get(int(row)) == column.odd.get(int(row) - 1)
        return same

    def without_repeats(self, losses: list[str]) -> Group:
        """The same without rows that are the one before once more, as loggers write them twice."""
        again = np.flatnonzero(self.repeated)
        if not again.size:
            return self
        rows, lines = plural(again.size, "row"), lines_text(self, again)
        losses.append(message("data.repeated_rows", group=self.title, rows=rows, lines=lines))
        return self.taken(np.delete(np.arange(self.t.size), again))

    def check_time(self, path: Path, window: Window | None) -> None:
        """Refuse a time that stands still or goes back inside of the window."""
        inside = np.flatnonzero(in_window(self.t, window))
        lines = None if self.lines is None else [self.lines[int(at)] for at in inside]
        try:
            check_time(self.t[inside], file=path, lines=lines)
        except LogError as error:
            again = self.repeated.any()
            cure = message("data.leave_repeats_out" if again else "data.give_a_rate")
            hint = f"{error.hint}; {cure}"
            raise LogError(error.message, file=path, line=error.line, hint=hint) from None

    def wrong_rate(self) -> list[str]:
        """A note where its rows, which a rate counts, last another time than their stamps do, by
        more than these are rounded and a hundredth: rows are missing, or the rate is wrong."""
        stamps = self.stamped if self.t.size >= TIMESTAMP.fewest else None
        if stamps is None or not np.isfinite(stamps).all():
            return []
        stamped, lasts = float(np.ptp(stamps)), float(np.ptp(self.t))
        rounded = float(np.percentile(np.abs(np.diff(stamps)), 99))
        if abs(stamped - lasts) <= 2.0 * rounded + SETTINGS.wrong_rate * lasts:
            return []
        return [message("data.wrong_rate", group=self.title, rows=lasts, stamps=stamped)]

    def line(self, row: int) -> int | None:
        """The line of a row in a text file, None in any other."""
        return None if self.lines is None else self.lines[int(row)]

    def taken(self, rows: np.ndarray, channels: Sequence[str] | None = None) -> Group:
        """The same group with some of its rows, by number, and channels."""
        names = list(self.channels) if channels is None else channels
        lines = None if self.lines is None else [self.lines[int(row)] for row in rows]
        values = {name: self.channels[name][rows] for name in names}
        columns = {name: self.columns[name].taken(rows) for name in names}
        about = self.name, self.t[rows], lines, self.began, self.daytime
        return Group(*about, values, columns, resolution=self.resolution)


def in_window(t: np.ndarray, window: Window | None) -> np.ndarray:
    """Which times [s] lie inside a window; a NaN lies in none."""
    first, last = window or (-np.inf, np.inf)
    return (t >= first) & (t <= last)


def range_of(channel: str, values: np.ndarray, travel: float | None = None) -> tuple[float, float]:
    """What a rig can have of a channel, with most of its values [SI]: of a position that moves by
    at most ``travel``, all within two travels of the median, wherever it is counted from."""
    row, good = quantity(channel), values[np.isfinite(values)]
    if travel is not None and good.size:
        middle = float(np.median(good))
        if np.median(np.abs(good - middle)) <= 2.0 * travel:  # else its unit is wrong
            return max(row.lower, middle - 2.0 * travel), min(row.upper, middle + 2.0 * travel)
    return row.lower, row.upper


def is_bad(channel: str, values: np.ndarray, travel: float | None = None) -> np.ndarray:
    """Where no number stands that a rig can have; ``travel`` as in `range_of`."""
    low, high = range_of(channel, values, travel)
    return ~(np.isfinite(values) & (values >= low) & (values <= high))


def lines_text(group: Group, at: np.ndarray) -> str:
    """The lines of some rows of a text file, in brackets; '' of any other file."""
    if group.lines is None:
        return ""
    return f" (line{'s' * (at.size > 1)} {listed(map(group.line, at))})"


def apart(columns: Sequence[SourceColumn]) -> list[tuple[list[int], np.ndarray]]:
    """(columns by number, the rows that are theirs) of the signals of a table that stand in the
    same rows. A signal has rows of its own where it stands in every second row of another or more
    seldom, or where the two take turns; one that is missing here and there has not, nor one that
    is missing for a while. Loggers of a bus write a row for each message, blank in all other
    columns."""
    groups: list[tuple[list[int], np.ndarray]] = []
    for index, column in enumerate(columns):
        filled = column.filled
        near = next((group for group in groups if not _take_turns(filled, group[1])), None)
        if near is None:
            groups.append(([index], filled.copy()))
        else:
            near[0].append(index)
            near[1][:] |= filled
    return groups


def _take_turns(item: np.ndarray, other: np.ndarray) -> bool:
    """Whether two signals, by the rows that hold them, are of different messages."""
    if np.array_equal(item, other):
        return False
    rows = [np.flatnonzero(item), np.flatnonzero(other)]
    if min(some.size for some in rows) < SETTINGS.fewest:
        return False
    steps = [float(np.median(np.diff(some))) for some in rows]
    if max(steps) >= SETTINGS.slower * min(steps):
        return True
    first, last = max(some[0] for some in rows), min(some[-1] for some in rows)
    inside = min(int(((some >= first) & (some <= last)).sum()) for some in rows)
    return inside >= SETTINGS.fewest and int((item & other).sum()) <= SETTINGS.shared * inside


def joined(groups: Sequence[Group], losses: list[str]) -> tuple[Record, list[str]]:
    """(all channels, a note on each other rate) on the time base of the fastest table; readings of
    the others lie on straight lines between their samples, commands are held. Rows that not all
    tables have values for are left out, and ``losses`` says so."""
    rates: list[str] = []
    periods: dict[str, float] = {}
    base = min(groups, key=lambda group: group.period)
    t, channels, keep = base.t, dict(base.channels), np.ones(base.t.size, bool)
    for group in groups:
        if group is base:
            continue
        good = np.isfinite(group.t) & (np.diff(group.t, prepend=-np.inf) > 0)
        times = group.t[good]
        values = {name: y[good] for name, y in group.channels.items()}
        if np.array_equal(times, t):
            channels |= values
            continue
        channels |= resampled(values, times, t)
        before = np.searchsorted(times, t, side="right") - 1
        last = times[-1] + (group.period if np.isfinite(group.period) else 0.0)
        hole = np.append(times, np.inf)[before + 1] - times[before.clip(0)]
        hole = (hole > (SETTINGS.bridged + SETTINGS.gap) * group.period) & (before < times.size - 1)
        keep &= (t >= times[0]) & (t <= last) & ~(hole & (times[before.clip(0)] != t))
        if abs(group.period - base.period) > 0.01 * base.period:
            rate, to = 1 / group.period, 1 / base.period
            rates.append(message("data.other_rate", group=group.title, rate=rate, base=to))
            periods |= dict.fromkeys(values, group.period)
    if not keep.all():
        slack, noted = max(group.period for group in groups), keep
        if keep.any():  # tables begin and end a sample of the slowest apart, which is no loss
            first, end = t[keep][[0, -1]]
            noted = keep | ((t < first) & (first - t[0] <= slack))
            noted |= (t > end) & (t[-1] - end <= slack)
        if lost := int((~noted).sum()):
            losses.append(message("data.rows_uncovered", rows=plural(lost, "row")))
    facts = {PERIODS: json.dumps(periods)} if periods else {}
    return Record(t, channels, facts).at(keep), rates


def gaps(group: Group, window: Window | None) -> list[str]:
    """A note on where samples are missing inside of the window."""
    t = group.t[in_window(group.t, window)]
    if not 0.0 < group.period < np.inf:
        return []
    slack = (SETTINGS.gap - 1.0) * group.period + group.resolution
    missing = missing_rows(t, group.period, slack)
    at = np.flatnonzero(missing)
    if not at.size:
        return []
    each = (f"{missing[i]:.0f} between t = {t[i]:.6g} and {t[i + 1]:.6g} s" for i in at)
    short = at[missing[at] <= SETTINGS.bridged]
    fields = {
        "group": group.title,
        "samples": plural(int(missing.sum()), "sample"),
        "where": listed(each, kind="gaps"),
        "share": float(missing[short].sum() / (t.size + missing.sum())),
        "longest": float((t[short + 1] - t[short]).max(initial=0.0)),
    }
    return [message("data.samples_missing", **fields)]
