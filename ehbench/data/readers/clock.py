"""Times as text, as moments and as counts of days or seconds: seconds since the first."""

import calendar
import re
from collections.abc import Iterable, Sequence
from datetime import datetime, timedelta, timezone
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from ehbench.vocabulary import Message, message

_DAY, _HOUR = 86400, 3600
_CLOCK = r"(?:(\d{1,3}):)?(\d{1,2}):(\d{2})(?:[.,:](\d{1,9}))?\s*([AaPp]\.?[Mm]\.?)?"
_ZONE = r"\s*(Z|UTC|[+-]\d{2}:?\d{2})?"
_YEAR = r"(\d{4}|\d{2}(?=[T ;,]+\d{1,2}:))"  # of two digits only before a time of day
_MONTH = r"([^\W\d_]{3,9})\.?"
# the order of day, month and year; "?" is either of the first two
_DATES = (
    ("ymd", r"(\d{4})[-/.](\d{1,2})[-/.](\d{1,2})"),
    ("dmy", rf"(\d{{1,2}})\.(\d{{1,2}})\.{_YEAR}"),
    ("?", rf"(\d{{1,2}})[-/](\d{{1,2}})[-/]{_YEAR}"),
    ("dmy", rf"(\d{{1,2}})[-/. ]*{_MONTH}[-/., ]*{_YEAR}"),
    ("mdy", rf"{_MONTH} (\d{{1,2}}),? {_YEAR}"),
)
_FORMS = (
    *((order, re.compile(rf"{date}(?:[T ;,]+{_CLOCK}{_ZONE})?")) for order, date in _DATES),
    ("days", re.compile(rf"(-?\d+) days?,?()()(?: *\+?{_CLOCK}())?")),
    ("", re.compile(f"()()(){_CLOCK}{_ZONE}")),
)
_MONTHS = {name.lower(): number for number, name in enumerate(calendar.month_abbr) if name}
_MONTHS |= {"mär": 3, "mrz": 3, "mai": 5, "okt": 10, "dez": 12}
# whether it counts days, first and last count of recordings, the day 1970-01-01 in it [s or d]
_EPOCHS = (
    (True, 2.0e4, 8.0e4, 25569.0),  # spreadsheets, since 1899-12-30
    (True, 6.9e5, 8.0e5, 719529.0),  # MATLAB, since year 0
    (False, 2.6e9, 4.6e9, 2082844800.0),  # LabVIEW, since 1904
    (False, 1.0e8, 1.0e10, 0.0),
)
# nanoseconds a tick, first and last count of recordings, the year 1970
_TICKS = ((1, 10**18, 26 * 10**17, 0), (100, 12 * 10**16, 17 * 10**16, 116444736 * 10**9))


class _Stamp(NamedTuple):
    """A text as whole seconds and the rest, whether it has a date, and after how many seconds it
    begins again, 0 for never."""

    whole: int
    rest: float
    dated: bool
    again: int


def clock(cells: Iterable[str], order: str = "mdy") -> tuple[np.ndarray, float | None]:
    """(seconds since the first, NaN where a cell is no time; the first in seconds since 1970, None
    without a date). A time of day alone goes on over midnight, and minutes over the hour.

    Args:
        cells: dates with a time of day, times of day, minutes and seconds, durations.
        order: of day, month and year where slashes are between them."""
    results = [_stamp(cell.strip(), order) for cell in cells]
    known = next(filter(None, results), None)
    if known is None:
        return np.full(len(results), np.nan), None
    seconds = np.array(
        [np.nan if s is None else s.whole - known.whole + (s.rest - known.rest) for s in results]
    )
    if known.again:
        good = np.flatnonzero(np.isfinite(seconds))
        back = np.diff(seconds[good], prepend=seconds[good[:1]]) < -0.5 * known.again
        seconds[good] += known.again * np.cumsum(back)
    return seconds, known.whole + known.rest if known.dated else None


def order_of(cells: Sequence[str]) -> tuple[str, tuple[int, Message] | None]:
    """(order of day, month and year; row and message of the first time that has two readings).

    The order is "dmy" or "mdy" where a number above 12 says so, or where both are the same."""
    pattern = next(pattern for order, pattern in _FORMS if order == "?")
    days = [(row, match) for row, cell in enumerate(cells) if (match := pattern.fullmatch(cell))]
    first, second = (max((int(match[at]) for _, match in days), default=0) for at in (1, 2))
    if first > 12 or second > 12:
        return "dmy" if first > 12 else "mdy", None
    for row, match in days:
        if match[1] != match[2]:
            each = (datetime(2000, int(match[m]), int(match[d])) for m, d in ((2, 1), (1, 2)))
            day, month = (f"{date.day} {date:%B}" for date in each)
            fields = {"cell": match[0], "day": day, "month": month}
            return "mdy", (row, message("data.two_dates", **fields))
    short = next((row for row, cell in enumerate(cells) if re.fullmatch(r"\d+:\d\d", cell)), None)
    if short is not None:
        return "mdy", (short, message("data.two_times", cell=cells[short]))
    return "mdy", None


def is_time(cell: str) -> bool:
    """Whether a cell is a time, in whatever order its day and month stand."""
    return any(_stamp(cell, order) is not None for order in ("mdy", "dmy"))


def is_date(cell: str) -> bool:
    """Whether a cell is a date without a time of day."""
    return ":" not in cell and is_time(cell.strip()) and not re.fullmatch(r"-?\d+ days?,?", cell)


def time_of_day(cells: Iterable[str]) -> float | None:
    """Seconds since midnight of the first cell that is a time of day, None where none is."""
    result = next(filter(None, (_stamp(cell.strip(), "mdy") for cell in cells)), None)
    known = result is not None and (result.dated or result.again == _DAY)
    return (result.whole + result.rest) % _DAY if known and result is not None else None


def since_1970(seconds: float, days: bool) -> float | None:
    """The wall clock [s since 1970] of a count [s] since the beginning of some calendar, which a
    file may count in ``days``; None of one that counts from a beginning of its own."""
    count = seconds / _DAY if days else seconds
    for of_days, low, high, zero in _EPOCHS:
        if of_days == days and low <= count < high:
            return (count - zero) * (_DAY if days else 1.0)
    return None


def nanoseconds(cells: Iterable[Any]) -> tuple[np.ndarray, float] | None:
    """(nanoseconds since the first, the first in seconds since 1970) of integers, or their text,
    that count nanoseconds since 1970, or as Windows does tenths of a microsecond since 1601; None
    of others, and of such as go back."""
    texts = [str(cell) for cell in cells]
    counts = [int(text) for text in texts if text.isdecimal() and len(text) in (18, 19)]
    if len(counts) != len(texts) or any(later < count for count, later in pairwise(counts)):
        return None
    for tick, low, high, zero in _TICKS:
        if counts and low <= counts[0] <= counts[-1] < high:
            since = np.array([float((count - counts[0]) * tick) for count in counts])
            return since, (counts[0] - zero) * tick / 1e9
    return None


def moments(values: np.ndarray) -> tuple[np.ndarray, float | None]:
    """(seconds since the first, NaN where there is none; the first in seconds since 1970, None of
    durations) of numpy's moments or durations."""
    of_durations = values.dtype.kind == "m"
    whole = values.astype("timedelta64[ns]" if of_durations else "datetime64[ns]")
    known = ~np.isnat(whole)
    if not known.any():
        return np.full(values.size, np.nan), None
    first = whole[known][0]
    seconds = np.where(known, (whole - first) / np.timedelta64(1, "ns") / 1e9, np.nan)
    return seconds, None if of_durations else float(first.astype(np.int64)) / 1e9


def _stamp(cell: str, slashed: str) -> _Stamp | None:
    for order, pattern in _FORMS:
        if (match := pattern.fullmatch(cell)) is None:
            continue
        *day, hour, minute, second, rest, half, zone = match.groups()
        if order not in ("", "days") and hour is None and minute is not None and rest is None:
            hour, minute, second = minute, second, None  # 25.11.2026 10:05
        hours = int(hour or 0)
        hours = hours % 12 + 12 * (half[0] in "pP") if half else hours
        whole = hours * _HOUR + int(minute or 0) * 60 + int(second or 0)
        parts = float(f"0.{rest}") if rest else 0.0
        if order == "days":
            return _Stamp(int(day[0]) * _DAY + whole, parts, False, 0)
        if not order:
            return _Stamp(whole, parts, False, _HOUR if hour is None else _DAY)
        date = dict(zip(slashed if order == "?" else order, day, strict=True))
        month = _MONTHS.get(date["m"][:3].lower(), 0) if date["m"].isalpha() else int(date["m"])
        year = int(date["y"]) + 2000 * (len(date["y"]) == 2)
        try:
            ahead = timedelta()
            if zone not in (None, "", "Z", "UTC"):
                ahead = timedelta(hours=int(zone[1:3]), minutes=int(zone[-2:]))
            ahead = -ahead if zone and zone[0] == "-" else ahead
            midnight = datetime(year, month, int(date["d"]), tzinfo=timezone(ahead))
            return _Stamp(int(midnight.timestamp()) + whole, parts, True, 0)
        except (ValueError, OverflowError):
            return None
    return None
