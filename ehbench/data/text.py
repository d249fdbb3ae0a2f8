"""Delimited text: one rule each for encodings, lines, cells, numbers, headers and bad cells."""

from __future__ import annotations

import csv
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ehbench.runtime.disk import DATA, read_bytes
from ehbench.runtime.memory import available, refuse_beyond
from ehbench.vocabulary.errors import LogError
from ehbench.vocabulary.messages import message

COPIES = 8  # of a table, as bytes, text, lines and numbers, while it is read
_GZIP = b"\x1f\x8b"
_MARKS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16", b"\xef\xbb\xbf": "utf-8-sig"}
_LINE_END = re.compile("\r\n|\r|\n")
_COMMA = r"(?:[0-9]+(?:,[0-9]+)?|,[0-9]+)(?:[eE][-+]?[0-9]+)?"
_POINT = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
# by decimal sign; ".," is either, cell by cell
NUMBER = {
    ".": re.compile(rf"[-+]?{_POINT}"),
    ",": re.compile(rf"[-+]?{_COMMA}"),
    ".,": re.compile(rf"[-+]?(?:{_POINT}|{_COMMA})"),
}
_TO_POINT = {
    ".": {},
    ",": {ord(","): ".", ord("."): "x"},  # a point in a number with a comma groups thousands
    ".,": {ord(","): "."},
}
_HOLE = re.compile(r"|[-+]?nan|[-+]?inf(inity)?|n/?a|#n/?a|null|none|-+|[-+]?1\.#\w+", re.I)
_BLOCK = 512  # rows that are read at once
_QUOTED = 60  # characters of a cell in a message


def is_hole(cell: str) -> bool:
    """Whether a cell says that there is no value: blank, NaN, n/a, -, …"""
    return bool(_HOLE.fullmatch(cell))


def lines_of(text: str) -> list[str]:
    """The lines of a text, whatever ends them."""
    lines = _LINE_END.split(text)
    return lines if lines[-1] else lines[:-1]


def text_of(path: Path, encoding: str | None = None) -> tuple[str, str]:
    """(text, encoding) of a file, also of one packed by gzip: UTF-8, UTF-16 with its mark, else
    Windows' own western one.

    Raises:
        LogError: not there, too large, no text, or not in the ``encoding`` required.
    """
    try:
        data = read_bytes(path, DATA, LogError)
    except FileNotFoundError:
        raise LogError(message("data.no_file"), file=path) from None
    data = _unpacked(data, path)
    refuse_beyond(COPIES * len(data), "reading it")
    marked = [name for mark, name in _MARKS.items() if data.startswith(mark)]
    for name in [encoding] if encoding else [*marked, "utf-8", "cp1252", "latin-1"]:
        try:
            text = data.decode(name)
        except (UnicodeDecodeError, LookupError):
            continue
        if "\0" in text:
            break
        return text, name
    if encoding:
        raise LogError(message("data.other_encoding", encoding=encoding), file=path)
    raise LogError(message("data.no_text"), file=path)


def _unpacked(data: bytes, path: Path) -> bytes:
    """The bytes of a file, unpacked where gzip has packed them.

    Raises:
        LogError: broken, or larger than fits.
    """
    if not data.startswith(_GZIP):
        return data
    maximum = int(available() / COPIES)
    unpacker = zlib.decompressobj(31)
    try:
        result = unpacker.decompress(data, maximum)
    except zlib.error as error:
        raise LogError(message("data.bad_gzip", reason=error), file=path) from None
    if unpacker.unconsumed_tail:
        raise LogError(message("data.gzip_too_large", limit=maximum / 1e6), file=path)
    if not unpacker.eof:
        raise LogError(message("data.gzip_breaks_off"), file=path)
    return result


def split(line: str, separator: str) -> list[str]:
    """The cells of a line; a separator ' ' is any white space."""
    if separator == " ":
        return line.replace('"', "").split()
    if '"' not in line:
        return [cell.strip() for cell in line.split(separator)]
    row = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    return [cell.strip() for cell in row]


def cells_of(rows: Sequence[str], separator: str, index: int) -> list[str]:
    """The cells of one column, blank where a row is too short."""
    every = (split(row, separator) for row in rows)
    return [cells[index] if index < len(cells) else "" for cells in every]


def numbers(
    rows: Sequence[str], separator: str, decimal: str, columns: Sequence[int]
) -> tuple[np.ndarray, list[dict[int, str]]]:
    """(numbers, shape (rows, columns), NaN where none stands; by column what stands there, by row)
    of some columns.
    """
    values = np.full((len(rows), len(columns)), np.nan)
    odd: list[dict[int, str]] = [{} for _ in columns]
    table = _TO_POINT[decimal]
    for start in range(0, len(rows) if columns else 0, _BLOCK):
        block = rows[start : start + _BLOCK]
        try:
            if separator == decimal:  # numbers in quotes
                raise ValueError
            values[start : start + len(block)] = np.loadtxt(
                (row.translate(table) for row in block) if table else block,
                delimiter=None if separator == " " else separator,
                ndmin=2,
                comments=None,
                usecols=columns,
                quotechar='"',
            )
        except ValueError:
            for at, row in enumerate(block, start):
                cells = split(row, separator)
                for place, index in enumerate(columns):
                    cell = cells[index] if index < len(cells) else ""
                    if NUMBER[decimal].fullmatch(cell):
                        values[at, place] = float(cell.replace(",", "."))
                    else:
                        odd[place][at] = cell[:_QUOTED]
    return values, odd


@dataclass(frozen=True, eq=False)
class TextTable:
    """A table of text whose first line that is neither blank nor a remark (``#``) names its
    columns; ``head`` is that line, ``lines`` are those of the ``rows``.

    Cells are separated by commas, or by semicolons or tabs, where a decimal comma is understood
    too."""

    path: Path
    header: tuple[str, ...]
    separator: str
    head: int
    lines: Sequence[int]
    rows: Sequence[str]

    def cells(self, index: int) -> list[str]:
        """The cells of a column as they stand."""
        return cells_of(self.rows, self.separator, index)

    def numbers(self, columns: Sequence[int]) -> tuple[np.ndarray, list[dict[int, str]]]:
        """As `numbers`, of some columns by number.

        Raises:
            LogError: a row has not as many cells as the header.
        """
        width = len(self.header)
        for line, row in zip(self.lines, self.rows, strict=True):
            if row.count(self.separator) + 1 != width and len(split(row, self.separator)) != width:
                key = "data.row_width_comma" if self.separator == "," else "data.row_width"
                text = message(key, width=len(split(row, self.separator)), header=width)
                raise LogError(text, file=self.path, line=line)
        decimal = "." if self.separator == "," else ".,"
        return numbers(self.rows, self.separator, decimal, columns)

    def floats(self, columns: Sequence[int]) -> np.ndarray:
        """The numbers of some columns, shape (rows, columns), NaN where a cell says that there is
        none.

        Raises:
            LogError: a row has not as many cells as the header, or a cell is no number.
        """
        values, odd = self.numbers(columns)
        for index, cells in zip(columns, odd, strict=True):
            for row, cell in cells.items():
                if not is_hole(cell):
                    raise self.bad_cell(index, row, cell)
        return values

    def bad_cell(self, index: int, row: int, cell: str) -> LogError:
        """The error of a cell that holds no number, with file, line and column."""
        name = self.header[index].split("[")[0].strip()
        key = "data.no_number" if cell else "data.blank"
        return LogError(message(key, name=name, cell=cell), file=self.path, line=self.lines[row])


def text_table(path: Path, example: str) -> TextTable:
    """The table of a text file.

    Args:
        path: the file.
        example: a header as it may be, for the message.

    Raises:
        LogError: not there, no text, or no header.
    """
    text = text_of(path)[0]
    numbered = [
        (number, line)
        for number, line in enumerate(lines_of(text), 1)
        if line.strip(" ,;\t") and not line.lstrip(' "').startswith("#")
    ]
    if not numbered:
        raise LogError(message("data.no_header", example=example), file=path)
    head, header = numbered[0]
    separator = max(",;\t", key=lambda mark: (header.count(mark), mark == ","))
    names = tuple(split(header, separator))
    lines, rows = [line for line, _ in numbered[1:]], [row for _, row in numbered[1:]]
    return TextTable(path, names, separator, head, lines, rows)
