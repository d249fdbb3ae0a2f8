"""What a reader gives: tables of named columns, each table on its own time base."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.data.logs.checks import TIME_NAMES, TIME_UNITS
from ehbench.data.readers.clock import moments, nanoseconds
from ehbench.data.record import floats
from ehbench.data.text import is_hole
from ehbench.vocabulary import LogError, Message, listed, message, shortened
from ehbench.vocabulary.errors import nearest
from ehbench.vocabulary.text import numbered
from ehbench.vocabulary.units import absolute_unit, named_unit

_PLAIN = "m?barg?|psig?|[kM]?Pa|[cm]m|m?V|mA|ms|deg(?:/s)?|rad/s|°(?:C|/s)?|m?m/s|rpm|dps"
_PLAIN += r"|m?[lL]/min|[lL][pP][mM]|gpm|GPM|cm\^?[3³]/(?:s|min)|m\^?[3³]/h"
_UNIT_LAST = (
    r"\[([^\[\]]*)\]\s*$",
    r"\(([^()]*)\)(?:\s*$|;|\s*\[)",
    r"\{([^{}]*)\}\s*$",
    r"(?:^|\s)(?:/|in)\s+(\S+)\s*$",
    r",\s*(\S+)$",
    # at the end of words only such as are hardly anything else
    rf"[\s_]({_PLAIN})$",
    r"^(?:t|time|zeit)[_/](m?s|us)$",
    rf"(?i:^(?:ch|chan|channel|kanal|ai)[\s_]*\d+)({_PLAIN})$",  # CH1V, of an oscilloscope
)
_QUOTIENT = re.compile(rf"(?:^|\s)([^\W\d][^\s/]*)/({_PLAIN})$")  # of ISO 80000: p/bar
_PER_SECOND = re.compile(r"[\s_](deg|rad|[cm]?m)_s$")
_CLOCK_PART = re.compile(r"(.*?)(u|n|micro|nano)?s(?:ecs?|econds?)?(?:\s*[\[(][mun]?s[\])])?")
_SINCE_1970 = 1e8  # from which count on [s] a clock is one since 1970
WIDEST = 256  # columns that a matrix may have


def unit_in(name: str) -> str:
    """The unit that a column's name ends in, '' where it says none: of ``p [bar]``, ``p (bar)``,
    ``p / bar``, ``p/bar``, ``p in bar``, ``p_bar``.
    """
    if result := _PER_SECOND.search(name):
        return f"{result[1]}/s"
    for pattern in _UNIT_LAST:
        if (result := re.search(pattern, name)) and (unit := named_unit(result[1])):
            return unit
    result = _QUOTIENT.search(name)
    return named_unit(result[2]) if result and not named_unit(result[1]) else ""


def unit_of_attributes(attributes: Mapping[str, Any]) -> str:
    """The unit that what stands beside a column says that it is in; '' of none."""
    for key in ("unit", "units", "Unit", "Units", "UNIT", "UNITS"):
        value = attributes.get(key)
        if value is not None and np.size(value) == 1:
            item = np.asarray(value).ravel()[0]
            return item.decode("utf-8", "replace") if isinstance(item, bytes) else str(item)
    return ""


@dataclass(frozen=True, eq=False)
class SourceColumn:
    """A column as the file has it: ``values`` in the file's ``unit`` (its own word for it, '' where
    it says none), NaN where no number stands; ``odd`` is what stands there, by row. ``doubt`` is
    the row of the first cell that can be read in two ways, and what they are.
    """

    name: str
    values: np.ndarray
    unit: str = ""
    odd: Mapping[int, str] = field(default_factory=dict)
    doubt: tuple[int, Message] | None = None

    @property
    def known_unit(self) -> str:
        """Its unit as it is written here, by what the file says or the name ends in; '' of none."""
        return named_unit(self.unit) or unit_in(self.name)

    @property
    def absolute(self) -> str:
        """The unit of its absolute pressures, where the file says that they are; else ''."""
        if unit := absolute_unit(self.unit):
            return unit
        words = re.split(r"[\s_]+", self.name.strip())
        ends = (" ".join(words[at:]) for at in range(len(words)))
        inside = (unit_last[1] for unit_last in re.finditer(r"[\[({]\s*(.+)[\])}]\s*$", self.name))
        return next(filter(None, map(absolute_unit, (*inside, *ends))), "")

    @cached_property
    def filled(self) -> np.ndarray:
        """Where it holds something, be it a word; shape (rows,)."""
        result = np.isfinite(self.values)
        result[[row for row, cell in self.odd.items() if not is_hole(cell)]] = True
        return result

    def taken(self, rows: np.ndarray) -> SourceColumn:
        """The same column with some of its rows, by number."""
        odd = {at: self.odd[int(row)] for at, row in enumerate(rows) if int(row) in self.odd}
        return replace(self, values=self.values[rows], odd=odd)


@dataclass(frozen=True, eq=False)
class SourceTable:
    """Columns of one time base, all of one length.

    ``name`` is that of the group, sheet or topic, '' where a file has one. ``t`` [s] is the time
    where the format itself knows it, else None. ``began`` is the wall clock of t = 0, in seconds
    since 1970 (UTC, or the local time where the file names no zone); None where it says none.
    ``daytime`` is the time of day of t = 0 [s since midnight], where the file says no more than
    that. ``lines`` are the lines of the rows in a text file, ``words`` its columns of words."""

    name: str
    columns: tuple[SourceColumn, ...]
    t: np.ndarray | None = None
    began: float | None = None
    lines: Sequence[int] | None = None
    words: Mapping[str, Sequence[str]] = field(default_factory=dict)
    daytime: float | None = None

    @property
    def size(self) -> int:
        """How many rows it has."""
        return self.columns[0].values.size if self.columns else 0


@dataclass(frozen=True)
class Dialect:
    """How a file is to be read where it does not say so itself; None is looked for.

    ``separator`` and ``decimal`` are characters (' ' is any white space), ``skip`` the lines before
    the header, ``unit_row`` whether a row of units stands below it, ``table`` the sheet, group or
    topic to take alone, ``day_first`` whether 05/11 is in November."""

    separator: str | None = None
    decimal: str | None = None
    skip: int | None = None
    unit_row: bool | None = None
    encoding: str | None = None
    table: str | None = None
    day_first: bool | None = None


@dataclass(frozen=True, eq=False)
class Source:
    """A file as its reader found it: its tables, the dialect of a text file, sentences on what
    could not be read, and the facts of a log that ehbench converted."""

    tables: tuple[SourceTable, ...]
    dialect: Dialect = Dialect()
    losses: tuple[str, ...] = ()
    meta: Mapping[str, str] = field(default_factory=dict)

    def names(self) -> dict[str, tuple[int, int]]:
        """(table, column) by name: a column's own, and ``table/column`` where several tables have
        it.
        """
        count = Counter(column.name for table in self.tables for column in table.columns)
        results = {}
        for i, table in enumerate(self.tables):
            for j, column in enumerate(table.columns):
                name = column.name if count[column.name] == 1 else f"{table.name}/{column.name}"
                results.setdefault(name, (i, j))
        return results

    def place(self, name: str, file: Path) -> tuple[int, int]:
        """(table, column) of a name, or of ``table/column``.

        Raises:
            LogError: there is none, and names the nearest; it holds no numbers.
        """
        known = self.names()
        whole = {
            f"{table.name}/{column.name}": (i, j)
            for i, table in enumerate(self.tables)
            for j, column in enumerate(table.columns)
        }
        at = known.get(name, whole.get(name))
        if at is not None:
            return at
        for table in self.tables:
            cells = table.words.get(name, ())
            if (row := next((row for row, cell in enumerate(cells) if cell), None)) is not None:
                text = message("data.column_of_words", name=name, cell=shortened(cells[row], 60))
                line = table.lines[row] if table.lines else None
                raise LogError(text, file=file, line=line)
        alike = [other for other in known if other.endswith(f"/{name}")]  # in several tables
        there = listed((f"'{other}'" for other in alike or known), 12)
        text = message("data.no_column", name=name, there=there)
        near = text.hint if alike else nearest(name, known, "nearest is '{}'") or text.hint
        raise LogError(text, file=file, hint="; ".join([near, *self.losses[:4]]))


def with_clock(table: SourceTable) -> SourceTable:
    """A table whose whole seconds and the rest of them, in columns beside one another as
    ``stamp.sec`` and ``stamp.nanosec``, are one clock: in the column of the seconds, since the
    first. Others as they are.
    """
    columns = list(table.columns)
    for at, (first, second) in enumerate(pairwise(columns)):
        whole, part = (_CLOCK_PART.fullmatch(column.name.lower()) for column in (first, second))
        if not (whole and part and whole[1] == part[1] and not whole[2] and part[2]):
            continue
        parts = second.values / (1e9 if part[2] in ("n", "nano") else 1e6)
        both = (first.values - first.values[:1]) + parts
        good = np.isfinite(both)
        if not good.all() or np.any(first.values % 1.0) or parts.min() < 0.0 or parts.max() >= 1.0:
            continue
        columns[at] = replace(first, values=both - both[:1], unit="s")
        began = float(first.values[0] + parts[0]) if first.values[0] >= _SINCE_1970 else None
        known = table.began if began is None else began
        return replace(table, columns=tuple(columns), began=known)
    return table


def pivoted(table: SourceTable) -> tuple[SourceTable, ...]:
    """A table of one value a row, which words beside it name, as one of a column for each name:
    those of one time base stand in one table. Others as they are.
    """
    varying = [cells for cells in table.words.values() if len(set(cells)) > 1]
    rows_of: dict[str, list[int]] = {}
    for row, words in enumerate(zip(*varying, strict=True)):
        rows_of.setdefault(" ".join(words), []).append(row)
    rows = {name: np.array(those) for name, those in rows_of.items()}

    def moves(column: SourceColumn, steps: Callable[[np.ndarray], bool]) -> list[bool]:
        return [steps(np.diff(column.values[those])) for those in rows.values()]

    def is_clock(column: SourceColumn) -> bool:
        named = column.name.strip("_").lower() in TIME_NAMES or column.known_unit in TIME_UNITS
        return named and all(moves(column, lambda steps: steps.size > 0 and steps.min() > 0.0))

    def is_value(column: SourceColumn) -> bool:
        return any(moves(column, lambda steps: bool(np.any(steps != 0.0))))

    if not 2 <= len(rows) <= WIDEST or table.t is not None:
        return (table,)
    clocks = [column for column in table.columns if is_clock(column)]
    values = [column for column in table.columns if column not in clocks and is_value(column)]
    if not clocks or len(values) != 1 or values[0].doubt is not None:
        return (table,)
    called = values[0].name.strip("_").lower() == "value"
    if not called and np.all(np.diff(clocks[0].values) > 0.0):  # words beside one signal
        return (table,)
    together: dict[bytes, list[str]] = {}
    for name, those in rows.items():
        together.setdefault(clocks[0].values[those].tobytes(), []).append(name)
    results = []
    for names in together.values():
        first = rows[names[0]]
        columns = (replace(values[0].taken(rows[name]), name=name) for name in names)
        whole = replace(table, columns=(clocks[0].taken(first), *columns), words={})
        lines = [table.lines[row] for row in first] if table.lines else None
        label = table.name if len(together) == 1 else f"{table.name} {names[0]}".strip()
        results.append(replace(whole, name=label, lines=lines))
    return tuple(results)


def column_names(names: Sequence[str]) -> list[str]:
    """Names of columns made unlike: one that is empty by its number, one that comes again by how
    often it came.
    """
    return numbered((name.strip() or f"column {at}" for at, name in enumerate(names, 1)), " ")


def columns_of(
    name: str, values: np.ndarray, unit: str = "", maximum: int = WIDEST
) -> list[tuple[SourceColumn, float | None]]:
    """Columns of what a file has under a name, each with the wall clock of its first value where it
    is of moments: one of a row or column of numbers, several of a matrix, whose longer side is
    time, and of records. Empty where it is of no numbers.

    Raises:
        LogError: an integer that no float is.
    """
    values = np.asarray(values)
    if values.dtype.names:
        parts = [(f"{name}.{key}", values[key]) for key in values.dtype.names]
        return [item for key, part in parts for item in columns_of(key, part, unit, maximum)]
    values = np.squeeze(values)
    if values.ndim == 2:
        table = values if values.shape[0] >= values.shape[1] else values.T
        if table.shape[1] > maximum:
            return []
        return [
            item
            for i in range(table.shape[1])
            for item in columns_of(f"{name}.{i + 1}", table[:, i], unit, maximum)
        ]
    if values.ndim != 1 or values.size < 2:
        return []
    if values.dtype.kind in "mM":
        seconds, began = moments(values)
        return [(SourceColumn(name, seconds, "s"), began)]
    if values.dtype.kind not in "fiub":
        return []
    try:
        return [(SourceColumn(name, floats(values), unit), None)]
    except LogError:
        if unit not in ("", "ns") or (since := nanoseconds(values)) is None:
            raise
        return [(SourceColumn(name, since[0], "ns"), since[1])]


class Gathered:
    """Columns gathered into tables by where they stand and how long they are; ``losses`` are notes
    on those that are refused.
    """

    def __init__(self) -> None:
        self.losses: list[str] = []
        self._columns: dict[tuple[str, int], list[SourceColumn]] = {}
        self._began: dict[tuple[str, int], float | None] = {}

    def add(self, place: str, name: str, values: np.ndarray, unit: str = "") -> bool:
        """Take what a file has under a name; whether there is a column of numbers in it."""
        try:
            result = columns_of(name, values, unit)
        except LogError as error:
            text = message("data.not_converted", name=name, reason=error.message)
            self.losses.append(text)
            return True
        for column, began in result:
            key = (place, column.values.size)
            self._columns.setdefault(key, []).append(column)
            if self._began.get(key) is None:
                self._began[key] = began
        return bool(result)

    def tables(self) -> tuple[SourceTable, ...]:
        """The tables, named by where they stand, and by their length too where that is not
        enough.
        """
        places, results = [place for place, _ in self._columns], []
        for (place, size), columns in self._columns.items():
            names = column_names([column.name for column in columns])
            unlike = tuple(replace(column, name=n) for n, column in zip(names, columns))
            name = place if places.count(place) == 1 else f"{place}[{size}]"
            results.append(SourceTable(name, unlike, None, self._began[place, size]))
        return tuple(results)
