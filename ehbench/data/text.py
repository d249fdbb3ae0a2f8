"""Delimited text: one rule each for encodings, lines, cells, numbers, headers and bad cells."""

import csv
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from ehbench.runtime.disk import DATA, read_bytes
from ehbench.runtime.memory import available, refuse_beyond
from ehbench.vocabulary import LogError, Message, message
from ehbench.vocabulary.units import named_unit

COPIES = 8  # of a table, as bytes, text, lines and numbers, while it is read
_MARKS = {
    b"\xff\xfe\0\0": "utf-32",
    b"\xff\xfe": "utf-16",
    b"\xfe\xff": "utf-16",
    b"\xef\xbb\xbf": "utf-8-sig",
}
_LINE_END = re.compile("\r\n|\r|\n")
_OTHER = {".": ",", ",": "."}
_GROUPING = "\u00a0\u202f\u2009'\u2019"  # spaces and apostrophes, which only ever group digits
_MINUS = {0x2212: "-"}
_FORTRAN = {ord("d"): "e", ord("D"): "e"}
_PADDING = re.compile(rb"\0{4,}\Z")  # of a file that a recorder made larger beforehand
_QUOTES = re.compile(r'(?:^|[,;|\t])\s*"[^"]*(?:""[^"]*)*$')  # a cell that goes on in the next line
_CLOSES = re.compile(r'[^"]*(?:""[^"]*)*"\s*(?:[,;|\t]|$)')  # the rest of such a cell
_LINES_OF_A_CELL = 8
_HOLE = re.compile(r"|[-+]?nan|[-+]?inf(inity)?|n/?a|#n/?a|null|none|-+|[-+]?1\.#\w+", re.I)
# a mark before three digits: the decimal sign, or what groups them
_TWO_READINGS = re.compile(r"[-+\u2212]?[1-9][0-9]{0,2}([.,])[0-9]{3}")
_BLOCK = 512  # rows that are read at once
_HEAD = re.compile(r"\s*(.*?)\s*(?:\[\s*([^\[\]]*?)\s*\])?\s*")
_MEASURED = re.compile(r"(.*[0-9.,])\s*([^\W\d_].*|%|°.*)")
_QUOTED = 60  # characters of a cell in a message


def is_hole(cell: str) -> bool:
    """Whether a cell says that there is no value: blank, NaN, n/a, -, …"""
    return bool(_HOLE.fullmatch(cell))


@lru_cache(maxsize=2)
def _grammar(decimal: str) -> str:
    """The pattern of a number: digits, grouped in threes by one mark or not, decimals, exponent."""
    grouped = rf"[1-9][0-9]{{0,2}}(?P<mark>[{_GROUPING}{_OTHER[decimal]}])[0-9]{{3}}"
    whole = rf"(?:{grouped}(?:(?P=mark)[0-9]{{3}})*|[0-9]+)"
    tail = "[0-9]*" if decimal == "." else "[0-9]+"
    sign = re.escape(decimal)
    return rf"[-+\u2212]?(?:{whole}(?:{sign}{tail})?|{sign}[0-9]+)(?:[eEdD][-+\u2212]?[0-9]+)?"


@lru_cache(maxsize=1 << 16)
def number(cell: str, decimal: str = ".") -> float | None:
    """The number of a cell under a decimal sign, None where it holds none."""
    if not re.fullmatch(_grammar(decimal), cell):
        return None
    dropped = dict.fromkeys(map(ord, _GROUPING + _OTHER[decimal]))
    return float(cell.translate(dropped | _MINUS | _FORTRAN | {ord(decimal): "."}))


def measured(cell: str, decimal: str = ".") -> tuple[str, str] | None:
    """(number as it stands, unit) of a cell such as ``0.01 sec``, None of any other."""
    match = _MEASURED.fullmatch(cell)
    known = match and number(match[1], decimal) is not None and named_unit(match[2])
    return (match[1], match[2]) if match and known else None


def head_of(cell: str) -> tuple[str, str]:
    """(name, unit) of a cell that heads a column, ``boom.q [deg]``; '' where it says no unit."""
    match = _HEAD.fullmatch(cell)
    return (match[1], match[2] or "") if match else (cell, "")


def _holds(text: str, separator: str, mark: str, pattern: str) -> bool:
    """Whether a cell with a mark in it is of a pattern."""
    ends = '["]' if separator == mark else rf'["\s{separator}]'
    return mark in text and bool(re.search(rf"(?:^|{ends}){pattern}(?=$|{ends})", text, re.M))


def _decides(text: str, separator: str, decimal: str) -> bool:
    """Whether a number of a text is one under this decimal sign alone."""
    digits = rf"[-+\u22120-9{_GROUPING}{_OTHER[decimal].replace(separator, '')}]*"
    either = rf'{_TWO_READINGS.pattern}(?:$|["\s{separator}])'
    pattern = rf"(?!{either})(?={digits}\{decimal}){_grammar(decimal)}"
    return _holds(text, separator, decimal, pattern)


def two_readings(
    rows: Sequence[str], separator: str, decimal: str, columns: Sequence[int]
) -> dict[int, tuple[int, Message]]:
    """By column, (row, message) of its first number that another decimal sign makes a thousand
    times as large or small, where no other number of the file says which sign it is, or none of
    the column that its digits are grouped."""
    text, other = "\n".join(rows), _OTHER[decimal]
    decided = separator == other or _decides(text, separator, decimal)
    marks = [other] if decided else [other, decimal]
    either = _TWO_READINGS.pattern
    marks = [x for x in marks if _holds(text, separator, x, either.replace("[.,]", rf"[{x}]"))]
    results: dict[int, tuple[int, Message]] = {}
    grouped = set()
    for at, row in enumerate(rows if marks else ()):
        if not any(mark in row for mark in marks):
            continue
        cells = split(row, separator)
        for index in columns:
            cell = cells[index] if index < len(cells) else ""
            match = _TWO_READINGS.fullmatch(cell)
            if match is None:
                if other in cell and number(cell, decimal) is not None:
                    grouped.add(index)
            elif match[1] in marks and index not in results:
                each = {"point": number(cell, "."), "comma": number(cell, ",")}
                results[index] = (at, message("data.two_readings", cell=cell, **each))
    return {index: result for index, result in results.items() if index not in grouped}


def lines_of(text: str) -> list[str]:
    """The lines of a text, whatever ends them. A cell in quotes that goes on over several lines
    stands in its first, and those after it are blank."""
    lines = _LINE_END.split(text)
    lines = lines if lines[-1] else lines[:-1]
    for at, line in enumerate(lines if '"' in text else ()):
        rest, last = line, at
        while _QUOTES.search(rest):
            ends = range(last + 1, min(last + _LINES_OF_A_CELL, len(lines)))
            last = next((n for n in ends if '"' in lines[n].replace('""', "")), at)
            closed = _CLOSES.match(lines[last]) if last > at else None
            if closed is None:
                break
            rest = lines[last][closed.end() :]
        else:
            lines[at] = " ".join(lines[at : last + 1])
            lines[at + 1 : last + 1] = [""] * (last - at)
    return lines


def text_of(path: Path, encoding: str | None = None) -> tuple[str, str]:
    """(text, encoding) of a file, also of one packed by gzip: UTF-8, UTF-16, else Windows' own
    western one.

    Raises:
        LogError: not there, too large, no text, or not in the ``encoding`` required."""
    try:
        data = read_bytes(path, DATA, LogError)
    except FileNotFoundError:
        raise LogError(message("data.no_file"), file=path) from None
    if data.startswith(b"\x1f\x8b"):  # gzip
        maximum = int(available() / COPIES)
        unpacker = zlib.decompressobj(31)
        try:
            data = unpacker.decompress(data, maximum)
        except zlib.error as error:
            raise LogError(message("data.bad_gzip", reason=error), file=path) from None
        if unpacker.unconsumed_tail:
            raise LogError(message("data.gzip_too_large", limit=maximum / 1e6), file=path)
        if not unpacker.eof:
            raise LogError(message("data.gzip_breaks_off"), file=path)
    refuse_beyond(COPIES * len(data))
    marked = [name for mark, name in _MARKS.items() if data.startswith(mark)]
    data = _PADDING.sub(b"", data)
    if not marked and b"\0" in data:  # every second byte of western text in UTF-16
        low_first = data[1::2].count(0) >= data[::2].count(0)
        marked = ["utf-16-le" if low_first else "utf-16-be"]
    for name in [encoding] if encoding else [*marked, "utf-8", "cp1252", "latin-1"]:
        try:
            text = data.decode(name)
        except (UnicodeDecodeError, LookupError):
            continue
        if "\0" in text:
            break
        return text.replace("\ufeff", ""), name  # also within, where files were put together
    if encoding:
        raise LogError(message("data.other_encoding", encoding=encoding), file=path)
    raise LogError(message("data.no_text"), file=path)


def split(line: str, separator: str) -> list[str]:
    """The cells of a line; a separator ' ' is any white space."""
    if separator == " ":
        return re.split(r"[ \t]+", line.replace('"', "").strip())
    if '"' not in line:
        return [cell.strip() for cell in line.split(separator)]
    row = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    return [cell.strip() for cell in row]


def cells_of(rows: Sequence[str], separator: str, index: int) -> list[str]:
    """The cells of one column, blank where a row is too short."""
    every = (split(row, separator) for row in rows)
    return [cells[index] if index < len(cells) else "" for cells in every]


def numbers(
    rows: Sequence[str], separator: str, decimal: str, columns: Sequence[int], width: int = 0
) -> tuple[np.ndarray, list[dict[int, str]]]:
    """(numbers, shape (rows, columns), NaN where none stands; by column what stands there, by row)
    of some columns. A row with a number behind ``width`` cells, 0 for any number of them, has none:
    one of its cells was taken for two."""
    values = np.full((len(rows), len(columns)), np.nan)
    odd: list[dict[int, str]] = [{} for _ in columns]
    # a point beside decimal commas groups digits, and no library reads these
    to_point = {} if decimal == "." else {ord(","): ".", ord("."): "x"}
    for start in range(0, len(rows) if columns else 0, _BLOCK):
        block = rows[start : start + _BLOCK]
        table = to_point if all(map(str.isascii, block)) else to_point | _MINUS
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
                    value = number(cell, decimal)
                    if value is None:
                        odd[place][at] = cell[:_QUOTED]
                    else:
                        values[at, place] = value
    for at, row in enumerate(rows if width else ()):
        if separator == " " or row.count(separator) >= width:
            parts = split(row, separator)
            if any(number(cell, decimal) is not None for cell in parts[width:]):
                values[at], count = np.nan, len(parts)
                for cells in odd:
                    cells[at] = message("data.row_width", width=count, header=width)
    return values, odd


def long_integers(
    rows: Sequence[str], separator: str, values: np.ndarray, columns: Sequence[int]
) -> dict[int, tuple[int, Message]]:
    """By column, (row, message) of its first integer that no float is: beyond 2^53 not all are."""
    results: dict[int, tuple[int, Message]] = {}
    for place, index in enumerate(columns):
        large = np.isfinite(values[:, place]) & (np.abs(values[:, place]) >= 2.0**53)
        for row in np.flatnonzero(large):
            cell = split(rows[int(row)], separator)[index].lstrip("0")
            if cell.isdecimal() and int(cell) != int(values[row, place]):
                results[index] = (int(row), message("data.integer_rounded", number=cell))
                break
    return results


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
            LogError: a row has not as many cells as the header, or a number has two readings."""
        width = len(self.header)
        for line, row in zip(self.lines, self.rows, strict=True):
            if row.count(self.separator) + 1 != width and len(split(row, self.separator)) != width:
                key = "data.row_width_comma" if self.separator == "," else "data.row_width"
                text = message(key, width=len(split(row, self.separator)), header=width)
                raise LogError(text, file=self.path, line=line)
        text, mark = "\n".join(self.rows), self.separator
        comma = mark != "," and _decides(text, mark, ",") and not _decides(text, mark, ".")
        decimal = "," if comma else "."
        values, odd = numbers(self.rows, mark, decimal, columns)
        doubts = two_readings(self.rows, mark, decimal, columns)
        doubts |= long_integers(self.rows, mark, values, columns)
        for index, (row, doubt) in doubts.items():
            text = message("data.column_error", name=self.header[index], error=doubt, unit="")
            raise LogError(text, file=self.path, line=self.lines[row], hint=doubt.hint)
        return values, odd

    def floats(self, columns: Sequence[int]) -> np.ndarray:
        """The numbers of some columns, shape (rows, columns), NaN where a cell says that there is
        none.

        Raises:
            LogError: a row has not as many cells as the header, or a cell is no number."""
        values, odd = self.numbers(columns)
        for index, cells in zip(columns, odd, strict=True):
            for row, cell in cells.items():
                if not is_hole(cell):
                    raise self.bad_cell(index, row, cell)
        return values

    def bad_cell(self, index: int, row: int, cell: str) -> LogError:
        """The error of a cell that holds no number, with file, line and column."""
        name, _ = head_of(self.header[index])
        key = "data.no_number" if cell else "data.blank"
        return LogError(message(key, name=name, cell=cell), file=self.path, line=self.lines[row])


def text_table(path: Path, example: str) -> TextTable:
    """The table of a text file; ``example`` is a header as it may be, for the message.

    Raises:
        LogError: not there, no text, or no header."""
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
