"""Tables as text, of any dialect: CSV with remarks and rows of facts above the header, a row of
units below it, decimal commas, times of day, gzip."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ehbench.data.readers.clock import clock, is_date, nanoseconds, order_of, time_of_day
from ehbench.data.readers.layout import (
    LOOKED_AT,
    layout_of,
    marks_of,
    names_of,
    sections_of,
    units_of,
)
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
    lines_of,
    long_integers,
    measured,
    numbers,
    split,
    text_of,
    two_readings,
)


def read(path: Path, dialect: Dialect) -> Source:
    """The tables of a text file; what the dialect leaves open is looked for."""
    text, encoding = text_of(path, dialect.encoding)
    tables, result = tables_of(lines_of(text), dialect)
    return Source(tables, replace(result, encoding=encoding))


def tables_of(
    lines: Sequence[str], dialect: Dialect, name: str = ""
) -> tuple[tuple[SourceTable, ...], Dialect]:
    """The tables in lines of text, and the dialect that the first is in. Of several each is named
    by its number.

    Raises:
        LogError: no rows of numbers."""
    marks = marks_of(lines, dialect)
    sections = sections_of(lines, marks, dialect)
    numbered = range(1, len(sections) + 1) if len(sections) > 1 else [""]
    free = replace(dialect, skip=None, unit_row=None)
    each = zip(sections, numbered, [dialect, *[free] * len(sections)])
    results = [_table_of(section, marks, own, f"{name} {of}".strip()) for section, of, own in each]
    return tuple(table for table, _ in results), results[0][1]


def _table_of(
    section: tuple[int, Sequence[str]], marks: tuple[str, str], dialect: Dialect, name: str
) -> tuple[SourceTable, Dialect]:
    """A table, and the dialect that it is in."""
    before, lines = section
    separator, decimal = marks
    layout = layout_of(lines, marks, dialect)
    top, units = names_of(lines, layout, separator), units_of(lines, layout, separator)
    width = len(layout.kinds)
    names = column_names((top + [""] * width)[:width])
    rows, units_of_cells = _without_units([lines[n] for n in layout.rows], marks)
    of_numbers = [index for index, kind in enumerate(layout.kinds) if kind == "numbers"]
    places = {index: place for place, index in enumerate(of_numbers)}
    widest = 0 if separator == "\t" else max(width, len(top))  # no number holds a tab
    values, odd = numbers(rows, separator, decimal, of_numbers, widest)
    doubts = {} if dialect.decimal else two_readings(rows, separator, decimal, of_numbers)
    doubts |= long_integers(rows, separator, values, of_numbers)
    # parts of a microsecond since some year
    large = [index for index, place in places.items() if values[:1, place] >= 1e17]
    since = {index: nanoseconds(cells_of(rows, separator, index)) for index in large}
    ticks, began = {index: count for index, count in since.items() if count}, None
    for index, count in ticks.items():
        values[:, places[index]], began = count
        doubts.pop(index, None)
    cells = {
        index: cells_of(rows, separator, index)
        for index, kind in enumerate(layout.kinds)
        if kind != "numbers"
    }
    kinds = _dated(cells, layout.kinds)
    columns, daytime, words = [], None, {}
    for index, kind in enumerate(kinds):
        if kind == "numbers":
            place = places[index]
            unit = units_of_cells.get(index, "".join(units[index : index + 1]))
            unit = "ns" if index in ticks else unit
            if index < len(top) and names[index] != top[index]:  # numbered behind its unit
                unit = unit or unit_in(top[index])
            doubt = doubts.get(index)
            columns.append(SourceColumn(names[index], values[:, place], unit, odd[place], doubt))
            continue
        if kind in ("words", "blank"):
            if kind == "words" or any(cells[index][1:]):
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
    start, step = layout.clock or (0.0, 0.0)
    t = start + step * np.arange(len(rows)) if step else None
    daytime = None if began is not None else daytime
    numbered = [before + n + 1 for n in layout.rows]
    table = SourceTable(name, tuple(columns), t, began, numbered, words, daytime)
    skip = layout.first if layout.header is None else layout.header
    return table, Dialect(*marks, skip, layout.units is not None, day_first=dialect.day_first)


def _without_units(rows: list[str], marks: tuple[str, str]) -> tuple[list[str], dict[int, str]]:
    """(rows, unit by column) once the units that stand behind numbers are taken away: those of the
    first row. A cell in another unit stays as it is."""
    separator, decimal = marks
    first = enumerate(split(rows[0], separator) if separator != " " else ())
    units = {index: pair[1] for index, cell in first if (pair := measured(cell, decimal))}
    results = []
    for row in rows if units else ():
        cells = split(row, separator)
        for index, unit in units.items():
            pair = measured(cells[index], decimal) if index < len(cells) else None
            if pair and pair[1] == unit:
                cells[index] = pair[0]
        results.append(separator.join(f'"{x}"' if separator in x else x for x in cells))
    return results or rows, units


def _dated(cells: dict[int, list[str]], kinds: Sequence[str]) -> tuple[str, ...]:
    """What each column holds, once the dates of a column without times of day stand before the
    times of the first one without dates: they are words then, and ``cells`` has both together."""
    results = list(kinds)
    times = [index for index, kind in enumerate(kinds) if kind == "times"]
    dates = [index for index in times if all(is_date(cell) for cell in cells[index] if cell)]
    some = {index: cells[index][:LOOKED_AT] for index in times if index not in dates}
    alone = [index for index, shown in some.items() if clock(shown, order_of(shown)[0])[1] is None]
    if dates and alone:
        both = zip(cells[dates[0]], cells[alone[0]], strict=True)
        cells[alone[0]] = [f"{date} {time}" if time else "" for date, time in both]
        results[dates[0]] = "words"
    return tuple(results)
