"""Flowmeter readings of a foreign file, by a map of its columns, as the lines of one of our own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ehbench.config.recipe.columns import LEAVE_OUT, WORDS, ColumnMap
from ehbench.data.logs.mapped import dialect_of, si_of
from ehbench.data.readers import Source, Table, open_source
from ehbench.vocabulary.errors import LogError
from ehbench.vocabulary.quantities import quantity
from ehbench.vocabulary.text import quoted

MAY_LACK = ("temperature",)  # what a reading may go without
_NAMED = 12  # lines that are told


def mapped_readings(
    path: Path, columns: ColumnMap, losses: list[str] | None = None
) -> list[tuple[int, str]] | None:
    """(line in the file, text) of a header and rows as `read_flowmeter` takes them, in SI. Without
    a column of valves the file is of the valve that its name says, and so is each of several tables
    that have all columns of the map. None where the map names no
    column: the file's own names are `read_flowmeter`'s.

    Args:
        losses: gets a sentence on rows that are left out as the map allows.

    Raises:
        LogError: a column that is not there, a cell that is no number.
        UnitError: a unit that does not become the quantity's.
    """
    if not columns.columns.names:
        return None
    source = open_source(path, dialect_of(columns))
    sheets = alike(source, list(columns.columns.names))
    if len(sheets) < 2:
        own = Path(path.name.removesuffix(".gz")).stem
        return _lines(source, source.tables[0], own, path, columns, losses)
    results: list[tuple[int, str]] = []
    for table in sheets:  # each of the valve that its name says
        item = replace(source, tables=(table,))
        results += _lines(item, table, table.name, path, columns, losses)[bool(results) :]
    return results


def alike(source: Source, names: Sequence[str] | None = None) -> list[Table]:
    """The tables of a workbook that have all columns of some names; without names those of the
    first. A sheet for each valve, with the same columns, is one workbook of readings.
    """
    has = [{*(column.name for column in item.columns), *item.words} for item in source.tables]
    required = set(names) if names is not None else has[0] if has else set()
    return [table for table, there in zip(source.tables, has, strict=True) if required <= there]


def _lines(
    source: Source,
    table: Table,
    valve: str,
    path: Path,
    columns: ColumnMap,
    losses: list[str] | None,
) -> list[tuple[int, str]]:
    """(line, text) of a header and of the rows of one table."""
    cells: dict[str, Sequence[str]] = {}
    bad = np.zeros(table.size, bool)
    for name, mapped in columns.columns.names.items():
        what = mapped.channel.rpartition(".")[2]
        if what in WORDS and name in table.words:
            cells[what] = [quoted(text) for text in table.words[name]]
            continue
        column = table.columns[_place(source, name, path)]
        if what in WORDS:
            cells[what] = [f"{value:g}" for value in column.values]
        elif what != "t":
            values = si_of(name, mapped, column, columns, path)
            lacking = ~np.isfinite(values)
            optional = lacking if what in MAY_LACK else np.zeros(table.size, bool)
            bad |= lacking & ~optional
            cells[f"{what} [{quantity(what).unit}]"] = [
                "" if blank else repr(float(value))
                for value, blank in zip(values, optional, strict=True)
            ]
    lines = list(table.lines or range(2, table.size + 2))
    if bad.any() and columns.columns.bad_samples != LEAVE_OUT:
        raise LogError(
            "a cell holds no number",
            file=path,
            line=lines[int(np.argmax(bad))],
            hint=f'bad_samples = "{LEAVE_OUT}" in the map leaves such rows out',
        )
    if bad.any() and losses is not None:
        some = ", ".join(str(lines[row]) for row in np.flatnonzero(bad)[:_NAMED])
        are = "readings are" if bad.sum() > 1 else "reading is"
        losses.append(
            f"{path.name}: {bad.sum()} {are} left out, with a cell that holds no number: line "
            f"{some}{', …' * (int(bad.sum()) > _NAMED)}"
        )
    cells.setdefault("valve", [quoted(valve)] * table.size)
    rows = [
        (line, ",".join(row))
        for line, row, gone in zip(lines, zip(*cells.values()), bad)
        if not gone
    ]
    return [(lines[0] - 1, ",".join(cells)), *rows]


def _place(source, name: str, path: Path) -> int:
    """The column of a name in the first table."""
    table, column = source.place(name, path)
    if table:
        raise LogError(
            f"'{name}' is in another table than the first",
            file=path,
            hint=f'say which to take: table = "{source.tables[table].name}"',
        )
    return column
