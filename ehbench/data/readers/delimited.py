"""Tables as text, of any dialect: CSV with remarks and rows of facts above the header, a row of
units below it, decimal commas, times of day, gzip."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

from ehbench.data.readers.clock import clock, is_date, is_time, nanoseconds, order_of, time_of_day
from ehbench.data.readers.table import (
    Dialect,
    Source,
    SourceColumn,
    SourceTable,
    column_names,
    unit_in,
)
from ehbench.data.text import (
    cells_of,
    is_hole,
    lines_of,
    long_integers,
    number,
    numbers,
    split,
    text_of,
    two_readings,
)
from ehbench.vocabulary.errors import LogError
from ehbench.vocabulary.messages import message
from ehbench.vocabulary.units import absolute_unit, named_unit

_REMARKS = ("#", "%", "//")
_UNIT_HEADS = ("unit", "units", "einheit", "einheiten", "unité", "unidad")
_BRACKETED = re.compile(r"\(.*\)|\[.*\]")
# how a row of units writes a time of day: hh:mm:ss, HH:MM:SS.fff, dd.mm.yyyy hh:mm:ss,ms, h:m:s
_CLOCK_FORM = re.compile(
    r"([dmyjat]{1,4}[-./][dmyjat]{1,4}[-./][dmyjat]{1,4}[ t;]*)?"
    r"h{1,2}:m{1,2}(:s{1,2}[.,:]?[msfz0]*)?",
    re.I,
)
_HEADS = 6  # rows of facts between the header and the numbers
_LOOKED_AT = 200  # lines that tell a dialect
_TOGETHER = 20  # lines in a row that are looked at: signals of several rates take turns


@dataclass(frozen=True)
class _Layout:
    """Where things stand in the lines: the header (None without one), the units, the first row of
    numbers; ``kinds`` says of each column whether it is of numbers, times or words.
    """

    header: int | None
    units: int | None
    first: int
    kinds: tuple[str, ...]


def read(path: Path, dialect: Dialect) -> Source:
    """The table of a text file; what the dialect leaves open is looked for."""
    text, encoding = text_of(path, dialect.encoding)
    table, result = table_of(lines_of(text), dialect)
    return Source((table,), replace(result, encoding=encoding))


def table_of(lines: Sequence[str], dialect: Dialect, name: str = "") -> tuple[SourceTable, Dialect]:
    """The table in lines of text, and the dialect that it is in.

    Raises:
        LogError: no rows of numbers.
    """
    separator, decimal = _marks(lines, dialect)
    layout = _layout(lines, separator, decimal, dialect)
    top = [] if layout.header is None else split(_bare(lines[layout.header]), separator)
    units = [] if layout.units is None else split(_bare(lines[layout.units]), separator)
    width = len(layout.kinds)
    names = column_names((top + [""] * width)[:width])
    at = [n for n in range(layout.first, len(lines)) if _is_row(lines[n], separator)]
    rows = [lines[n] for n in at]
    of_numbers = [index for index, kind in enumerate(layout.kinds) if kind == "numbers"]
    values, odd = numbers(rows, separator, decimal, of_numbers)
    doubts = {} if dialect.decimal else two_readings(rows, separator, decimal, of_numbers)
    long, began = long_integers(rows, separator, values, of_numbers), None
    for index in long:
        if since := nanoseconds(cells_of(rows, separator, index)):
            values[:, of_numbers.index(index)], began = since
        else:
            doubts[index] = long[index]
    cells = {
        index: cells_of(rows, separator, index)
        for index, kind in enumerate(layout.kinds)
        if kind != "numbers"
    }
    kinds = _dated(cells, layout.kinds)
    columns, daytime, words = [], None, {}
    for index, kind in enumerate(kinds):
        if kind == "numbers":
            place = of_numbers.index(index)
            unit = _cell_unit(units[index]) if index < len(units) else ""
            unit = unit or "ns" * (index in long and index not in doubts)
            if index < len(top) and names[index] != top[index]:  # numbered behind its unit
                unit = unit or unit_in(top[index])
            doubt = doubts.get(index)
            columns.append(SourceColumn(names[index], values[:, place], unit, odd[place], doubt))
            continue
        if kind == "words":
            words[names[index]] = cells[index]
            continue
        order, doubt = order_of(cells[index])
        if dialect.day_first is not None:
            order, doubt = "dmy" if dialect.day_first else "mdy", None
        column, start = clock(cells[index], order)
        began = start if began is None else began
        if daytime is None and start is None:
            daytime = time_of_day(cells[index])
        columns.append(SourceColumn(names[index], column, "s", {}, doubt))
    daytime = None if began is not None else daytime
    table = SourceTable(name, tuple(columns), None, began, [n + 1 for n in at], words, daytime)
    skip = layout.first if layout.header is None else layout.header
    units_below = layout.units is not None
    return table, Dialect(separator, decimal, skip, units_below, day_first=dialect.day_first)


def _dated(cells: dict[int, list[str]], kinds: Sequence[str]) -> tuple[str, ...]:
    """What each column holds, once the dates of a column without times of day stand before the
    times of the first one without dates: they are words then, and ``cells`` has both together.
    """
    results = list(kinds)
    times = [index for index, kind in enumerate(kinds) if kind == "times"]
    dates = [index for index in times if all(is_date(cell) for cell in cells[index] if cell)]
    alone = [index for index in times if clock(cells[index][:_LOOKED_AT])[1] is None]
    if dates and alone:
        both = zip(cells[dates[0]], cells[alone[0]], strict=True)
        cells[alone[0]] = [f"{date} {time}" if time else "" for date, time in both]
        results[dates[0]] = "words"
    return tuple(results)


def _bare(line: str) -> str:
    return line.lstrip("#%/ ") if line.lstrip().startswith(_REMARKS) else line


def _is_row(line: str, separator: str) -> bool:
    return bool(line.strip(" \t" + separator)) and not line.lstrip().startswith(_REMARKS)


def _kind(cell: str, decimal: str) -> str:
    """What a cell holds: a number, a time of day, nothing, or words."""
    if number(cell, decimal) is not None:
        return "numbers"
    if is_hole(cell):
        return "holes"
    return "times" if is_time(cell) else "words"


def _marks(lines: Sequence[str], dialect: Dialect) -> tuple[str, str]:
    """(separator, decimal sign) with which most cells are numbers: of the second half of the lines,
    as facts stand above the numbers.
    """
    shown = _some([line for line in lines[dialect.skip or 0 :] if _is_row(line, "")])
    best, maximum = (",", "."), -1.0
    # between tabs a blank is part of a cell: "1 570" is no number, and not 1
    blank = [] if all("\t" in line for line in shown) else [" "]
    for separator in [dialect.separator] if dialect.separator else [",", ";", "\t", *blank]:
        for decimal in [dialect.decimal] if dialect.decimal else [".", ","]:
            if separator == decimal and not any('"' in line for line in shown):
                continue
            score = 0.0
            for line in shown:
                kinds = [_kind(cell, decimal) for cell in split(line, separator)]
                good = kinds.count("numbers") + kinds.count("times")
                score += good * (good / max(len(kinds) - kinds.count("holes"), 1))
            if score > maximum:
                best, maximum = (separator, decimal), score
    return best


def _some(rows: Sequence) -> list:
    """Rows that tell of all: of the second half, as facts stand above the numbers, some in a row
    from places all over it.
    """
    half = rows[len(rows) // 2 :]
    step = max(-(-len(half) // (_LOOKED_AT // _TOGETHER)), _TOGETHER)
    return [row for at in range(0, len(half), step) for row in half[at : at + _TOGETHER]]


def _layout(lines: Sequence[str], separator: str, decimal: str, dialect: Dialect) -> _Layout:
    """Where the header, the units and the numbers stand."""
    skip = dialect.skip or 0
    at = [n for n in range(skip, len(lines)) if _is_row(lines[n], separator)]
    kinds = _kinds_of([split(lines[n], separator) for n in at], decimal)
    if not kinds:
        raise LogError(message("data.no_rows_of_numbers"))

    def fits(n: int, share: float) -> bool:
        row = [_kind(cell, decimal) for cell in split(lines[n], separator)]
        row += ["holes"] * (len(kinds) - len(row))
        requested = [got for got, kind in zip(row, kinds) if kind != "words"]
        good = requested.count("numbers") + requested.count("times")
        if requested[:1] == ["words"]:
            return False
        fine = good + requested.count("holes")
        return len(row) >= len(kinds) and good > 0 and fine >= share * len(requested)

    strict = next((i for i, n in enumerate(at) if fits(n, 1.0)), None)
    if strict is None:
        raise LogError(message("data.no_rows_of_numbers"))
    window = range(strict, min(strict + _HEADS, len(at)))
    words = [i for i in window if not fits(at[i], 0.5)]
    if words and words[0] - strict <= 2 and words[-1] + 1 < len(at):  # numbers among the facts
        strict = words[-1] + 1
    while strict > 0 and fits(at[strict - 1], 0.5):  # a row with a broken cell is a row still
        strict -= 1
    first = at[strict]
    if dialect.skip is not None:
        above = [n for n in range(skip, first) if lines[n].strip(" \t" + separator)][:2]
        units = above[1] if dialect.unit_row and len(above) > 1 else None
        return _Layout(above[0] if above else None, units, first, kinds)
    header, units = _heads(lines, range(skip, first), separator, len(kinds))
    if dialect.unit_row is False:
        header, units = (header if units is None else units), None
    return _Layout(header, units, first, kinds)


def _kinds_of(rows: Sequence[Sequence[str]], decimal: str) -> tuple[str, ...]:
    """What each column mostly holds, of the rows as wide as most; the blank ones at the end left
    out.
    """
    shown = _some(rows)
    widths = Counter(len(row) for row in shown)
    if not widths:
        return ()
    width = max(widths, key=lambda size: (widths[size] * min(size, 2), size))
    results = []
    for at, column in enumerate(zip(*(row for row in shown if len(row) == width))):
        kinds = Counter(_kind(cell, decimal) for cell in column)
        if set(kinds) == {"holes"}:  # a slow signal: where it stands at all
            filled = (row[at] for row in rows if len(row) == width and row[at])
            kinds += Counter(_kind(cell, decimal) for cell in islice(filled, _TOGETHER))
        holes = kinds.pop("holes", 0)
        results.append(kinds.most_common(1)[0][0] if kinds else "holes" if holes else "words")
    while results and results[-1] == "holes":
        results.pop()
    results = ["words" if kind == "holes" else kind for kind in results]
    return tuple(results) if "numbers" in results else ()


def _heads(
    lines: Sequence[str], above: range, separator: str, width: int
) -> tuple[int | None, int | None]:
    """(line of the header, line of the units) of the lines above the numbers."""
    wide: list[list[str]] = []
    at: list[int] = []
    for n in reversed(above):
        if not lines[n].strip(" \t" + separator):
            if wide:
                break
            continue
        cells = split(_bare(lines[n]), separator)[:width]
        filled = [cell for cell in cells if cell.strip("-")]
        if len(cells) < width or len(filled) < min(width, 2) or len(wide) == _HEADS:
            break
        if sum(number(cell) is not None for cell in filled) < 0.5 * len(filled):
            wide.append(filled)
            at.append(n)
    for index, cells in enumerate(wide[:-1]):
        head = cells[0].strip(": ").lower().removeprefix("trace_")
        units = cells[1:] if head in _UNIT_HEADS else cells
        known = sum(map(_is_unit, units))
        # three in four below names that are none: a recorder may have words of its own for one
        mostly = known >= 0.75 * len(units) and not any(map(_is_unit, wide[index + 1]))
        all_of_it = known == len(units) or all(map(_BRACKETED.fullmatch, units))
        if units and (mostly or all_of_it):
            names = index + 1
            if len(set(wide[names])) < len(wide[names]):  # another row tells the columns apart
                others = (i for i, row in enumerate(wide) if len(set(row)) == len(row))
                names = next((i for i in others if i != index), names)
            return at[names], at[index]
    return (at[0], None) if at else (None, None)


def _is_unit(cell: str) -> bool:
    plain = cell.strip(" []()")
    return bool(named_unit(cell) or absolute_unit(cell) or _CLOCK_FORM.fullmatch(plain))


def _cell_unit(cell: str) -> str:
    """The unit that a cell says; one that is not known here without the brackets about it."""
    if cell.lower() in _UNIT_HEADS:
        return ""
    plain = cell.strip() if absolute_unit(cell) else cell.strip(" []()")
    return named_unit(cell) or plain
