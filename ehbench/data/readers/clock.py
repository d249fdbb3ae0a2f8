"""Times of day as text in seconds."""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta, timezone

import numpy as np

_DAY = 86400
_TIME = r"(\d{1,2}):(\d{2}):(\d{2})(?:[.,:](\d{1,9}))?\s*([AaPp]\.?[Mm]\.?)?"
_ZONE = r"\s*(Z|UTC|[+-]\d{2}:?\d{2})?"
_FORMS = (
    ("ymd", re.compile(r"(\d{4})[-/.](\d{1,2})[-/.](\d{1,2})[T ;]\s*" + _TIME + _ZONE)),
    ("dmy", re.compile(r"(\d{1,2})[.](\d{1,2})[.](\d{4})[T ;,]\s*" + _TIME + _ZONE)),
    ("mdy", re.compile(r"(\d{1,2})[-/](\d{1,2})[-/](\d{4})[T ;,]\s*" + _TIME + _ZONE)),
    ("", re.compile("()()()" + _TIME + "()")),
)


def clock(cells: Iterable[str]) -> tuple[np.ndarray, float | None]:
    """(seconds since the first, NaN where a cell is no time of day; the first in seconds since
    1970, None without a date). A time of day alone goes on over midnight.
    """
    results = [_stamp(cell.strip()) for cell in cells]
    known = [item for item in results if item is not None]
    if not known:
        return np.full(len(results), np.nan), None
    whole, parts, dated = known[0]
    seconds = np.array([np.nan if s is None else s[0] - whole + (s[1] - parts) for s in results])
    if not dated:
        good = np.flatnonzero(np.isfinite(seconds))
        days = np.cumsum(np.diff(seconds[good], prepend=seconds[good[:1]]) < -0.5 * _DAY)
        seconds[good] += _DAY * days
    return seconds, whole + parts if dated else None


def time_of_day(cells: Iterable[str]) -> float | None:
    """Seconds since midnight of the first cell that is a time of day, None where none is."""
    result = next(filter(None, (_stamp(cell.strip()) for cell in cells)), None)
    return None if result is None else (result[0] + result[1]) % _DAY


def moments(values: np.ndarray) -> tuple[np.ndarray, float | None]:
    """(seconds since the first, NaN where there is none; the first in seconds since 1970) of
    numpy's moments of time.
    """
    whole = values.astype("datetime64[ns]")
    known = ~np.isnat(whole)
    if not known.any():
        return np.full(values.size, np.nan), None
    first = whole[known][0]
    seconds = np.where(known, (whole - first) / np.timedelta64(1, "ns") / 1e9, np.nan)
    return seconds, float(first.astype(np.int64)) / 1e9


def _stamp(cell: str) -> tuple[int, float, bool] | None:
    """(whole seconds, the rest, whether there is a date) of a text."""
    for order, pattern in _FORMS:
        if (match := pattern.fullmatch(cell)) is None:
            continue
        *day, hour, minute, second, rest, half, zone = match.groups()
        clock = int(hour) % 12 + 12 * (half[0] in "pP") if half else int(hour)
        parts = float(f"0.{rest}") if rest else 0.0
        if not order:
            return clock * 3600 + int(minute) * 60 + int(second), parts, False
        date = {key: int(text) for key, text in zip(order, day)}
        try:
            moment = datetime(
                date["y"], date["m"], date["d"], clock, int(minute), int(second), tzinfo=_zone(zone)
            )
        except (ValueError, OverflowError):
            return None
        return int(moment.timestamp()), parts, True
    return None


def _zone(text: str | None) -> timezone:
    if text in (None, "", "Z", "UTC"):
        return UTC
    hours, minutes = int(text[1:3]), int(text[-2:])
    return timezone((-1 if text[0] == "-" else 1) * timedelta(hours=hours, minutes=minutes))
