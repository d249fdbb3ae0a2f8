"""Excel workbooks, by openpyxl: a table a sheet, its header looked for as in a text file."""

import re
import zipfile
from collections.abc import Iterable
from datetime import date, datetime, time, timedelta
from pathlib import Path
from typing import Any

from openpyxl import load_workbook

from ehbench.data.readers.delimited import tables_of
from ehbench.data.readers.table import Dialect, Source
from ehbench.runtime.memory import refuse_beyond
from ehbench.vocabulary import LogError, message

_TAB = "\t"
_THREE_DECIMALS = re.compile(r"-?\d+\.\d{3}")
_SWELLS = 12  # bytes held for one of a sheet's XML
# a cell with a formula and without the number that it comes to
_UNCALCULATED = re.compile(
    rb'<(?:\w+:)?c r="([A-Z]+)(\d+)"[^>]*>\s*<(?:\w+:)?f(?:[^>]*/>|[^>]*>[^<]*</(?:\w+:)?f>)'
    rb"\s*(?:<(?:\w+:)?v\s*/>|<(?:\w+:)?v>\s*</(?:\w+:)?v>)?\s*</(?:\w+:)?c>"
)


def read(path: Path, dialect: Dialect) -> Source:
    """The sheets that hold rows of numbers, as they were last calculated."""
    with zipfile.ZipFile(path) as packed:
        fixed = sum(item.file_size for item in packed.infolist())
    refuse_beyond(_SWELLS * fixed)
    # a path by its ending, an open file by its content
    file = path.open("rb")
    book: Any = load_workbook(file, read_only=True, data_only=True)
    tables, losses = [], []
    plain = Dialect(_TAB, None, dialect.skip, dialect.unit_row)
    try:
        for sheet in book.worksheets:
            if dialect.table not in (None, sheet.title):
                continue
            with zipfile.ZipFile(path) as packed:
                places = _UNCALCULATED.findall(packed.read(sheet._worksheet_path))
            for column, row in reversed(dict(reversed(places)).items()):
                name, cell = (f"{sheet.title}!{at.decode()}" for at in (column, column + row))
                losses.append(message("data.never_calculated", name=name, cell=cell))
            sheet.reset_dimensions()  # or each row is as wide as the farthest cell
            lines = [text_line(map(_shown, row)) for row in sheet.iter_rows()]
            try:
                tables += tables_of(lines, plain, sheet.title)[0]
            except LogError:  # a sheet of words
                continue
    finally:
        book.close()
        file.close()
    return Source(tuple(tables), losses=tuple(losses))


def _shown(cell: Any) -> Any:
    """What a cell holds, in percent where the sheet shows it so."""
    value = cell.value
    if isinstance(value, (int, float)) and "%" in cell.number_format:
        return f"{_text(100.0 * value)} %"
    return value


def text_line(cells: Iterable[Any]) -> str:
    """A row of values as a line of text between tabs."""
    return _TAB.join(map(_text, cells))


def _text(cell: Any) -> str:
    """A cell as a text file would have it."""
    if cell is None:
        return ""
    if isinstance(cell, bool):
        return str(int(cell))
    if isinstance(cell, datetime):
        return cell.isoformat(" ")
    if isinstance(cell, (date, time)):
        return cell.isoformat()
    if isinstance(cell, timedelta):
        return repr(cell.total_seconds())
    if isinstance(cell, float):  # three decimals must not look like grouped digits
        return f"{cell!r}e0" if _THREE_DECIMALS.fullmatch(repr(cell)) else repr(cell)
    return " ".join(str(cell).split())
