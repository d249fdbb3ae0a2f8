"""Where things stand in lines of text: the marks between cells, the tables, their headers, units
and first rows of numbers."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress, islice, zip_longest

from ehbench.data.logs.checks import TIME_NAMES, TIME_UNITS
from ehbench.data.readers.clock import is_time
from ehbench.data.readers.table import Dialect, unit_in
from ehbench.data.text import is_hole, measured, number, split
from ehbench.vocabulary import LogError, UnitError, message, shortened
from ehbench.vocabulary.units import absolute_unit, factor, named_unit

_REMARKS = ("#", "%", "//")
# what the first cell of a row above the numbers calls it
_NAME_HEADS = (
    *("name", "names", "tracename", "channel name", "kanalname", "columns", "fields", "spalten"),
)
_UNIT_HEADS = (
    *("unit", "units", "einheit", "einheiten", "unité", "unidad", "vunit", "y_unit_label"),
    "vertical units",
)
_CLOCK_HEADS = ("sampletime[ms]",)  # above a time, which the names call a name
# what facts above the numbers call the clock of rows: in seconds, or a rate in hertz
_STEP_HEADS = (
    *("delta_x", "hresolution", "increment", "x increment", "xincrement", "tinc", "dt", "clock"),
    *("sampling period", "sample period", "sampling interval", "sample interval", "sample time"),
    *("abtastzeit", "abtastintervall"),
)
_RATE_HEADS = (
    *("sample rate", "sampling rate", "samplerate", "sample frequency", "sampling frequency"),
    *("abtastrate", "abtastfrequenz"),
)
_START_HEADS = ("x0", "hoffset", "start", "t0", "x origin", "xorigin")
_TIME_NAMES = (*TIME_NAMES, "x_value")
_FACT = re.compile(r"([^:=]+)[:=](.*)")  # a title and what it says
_REMARKED = re.compile(r"\s*(?:[#%]|//)[#%/ ]*([^\W\d][^:=,;|\t()\[\]{}]*)[:=](.*)")
# a further cell with a title of its own
_TITLED = re.compile(r"[,;|\t]\s*[^\W\d][^,;|\t]*[:=](?!\d)")
_BRACKETED = re.compile(r"\(.*\)|\[.*\]")
# how a row of units writes a time of day: hh:mm:ss, HH:MM:SS.fff, dd.mm.yyyy hh:mm:ss,ms, h:m:s
_CLOCK_FORM = re.compile(
    r"([dmyjat]{1,4}[-./][dmyjat]{1,4}[-./][dmyjat]{1,4}[ t;]*)?"
    r"h{1,2}:m{1,2}(:s{1,2}[.,:]?[msfz0]*)?",
    re.I,
)
_NUMERIC = (*"0123456789+-.,;\u2212",)  # first characters of rows of numbers
_HEADS = 6  # rows of facts between the header and the numbers
LOOKED_AT = 200  # lines that tell a dialect
_TOGETHER = 20  # lines in a row that are looked at: signals of several rates take turns


@dataclass(frozen=True)
class TextLayout:
    """Where things stand in the lines: the header (None without one), the units, the first row of
    numbers; ``kinds`` says of each column whether it is of numbers, times or words; ``rows`` are
    the lines of the numbers; ``clock`` is (start, step) [s] of rows without a time of their own,
    where the rows above say it.
    """

    header: int | None
    units: int | None
    first: int
    kinds: tuple[str, ...]
    rows: Sequence[int]
    clock: tuple[float, float] | None = None


def bare(line: str) -> str:
    """A line without the sign that makes it a remark, and without the title of names or units."""
    title, said = _remarked(line)
    if title in (*_NAME_HEADS, *_UNIT_HEADS):
        return said
    return line.lstrip("#%/ ") if line.lstrip().startswith(_REMARKS) else line


def _remarked(line: str) -> tuple[str, str]:
    """The title of a remark such as ``#UNITS:V`` and what it says; blank of any other line, as of
    a header each of whose cells says something of its own.
    """
    match = _REMARKED.fullmatch(line)
    return (_label(match[1]), match[2]) if match and not _TITLED.search(match[2]) else ("", "")


def is_row(line: str, separator: str) -> bool:
    """Whether a line is neither blank nor a remark."""
    if line[:1].isdigit():  # as most, so that long files are read in less time
        return True
    return bool(line.strip(" \t" + separator)) and not line.lstrip().startswith(_REMARKS)


def _kind(cell: str, decimal: str) -> str:
    """What a cell holds: a number, a time of day, nothing, or words."""
    if number(cell, decimal) is not None or measured(cell, decimal):
        return "numbers"
    if is_hole(cell):
        return "holes"
    return "times" if is_time(cell) else "words"


def marks_of(lines: Sequence[str], dialect: Dialect) -> tuple[str, str]:
    """(separator, decimal sign) with which most cells are numbers: of the second half of the lines,
    as facts stand above the numbers.
    """
    shown = _some([line for line in lines[dialect.skip or 0 :] if is_row(line, "")])
    best, maximum = (",", "."), -1.0
    # between tabs a blank is part of a cell: "1 570" is no number, and not 1
    blank = [] if all("\t" in line for line in shown) else [" "]
    for separator in [dialect.separator] if dialect.separator else [",", ";", "\t", "|", *blank]:
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
    step = max(-(-len(half) // (LOOKED_AT // _TOGETHER)), _TOGETHER)
    return [row for at in range(0, len(half), step) for row in half[at : at + _TOGETHER]]


def layout_of(lines: Sequence[str], marks: tuple[str, str], dialect: Dialect) -> TextLayout:
    """Where the header, the units and the numbers of a table stand.

    Raises:
        LogError: no rows of numbers.
    """
    separator, decimal = marks
    skip = dialect.skip or 0
    at = [n for n in range(skip, len(lines)) if is_row(lines[n], separator)]
    kinds, slow = _kinds_of([lines[n] for n in at], marks)
    if not kinds:
        raise _without_numbers(lines, at)

    def fits(n: int, share: float, titled: bool = False) -> bool:
        row = [_kind(cell, decimal) for cell in split(lines[n], separator)]
        row += ["holes"] * (len(kinds) - len(row))
        if not titled and kinds[0] == "blank" and row[0] != "holes":
            return False
        counts = (
            index not in slow and kind in ("numbers", "times") for index, kind in enumerate(kinds)
        )
        requested = list(compress(row, counts))
        good = requested.count("numbers") + requested.count("times")
        if requested[:1] == ["words"]:
            return False
        fine = good + requested.count("holes")
        return len(row) >= len(kinds) and good > 0 and fine >= share * len(requested)

    strict = next((i for i, n in enumerate(at) if fits(n, 1.0)), None)
    if strict is None:
        raise _without_numbers(lines, at)
    window = range(strict, min(strict + _HEADS, len(at)))
    words = [i for i in window if not fits(at[i], 0.5)]
    if words and words[0] - strict <= 2 and words[-1] + 1 < len(at):  # numbers among the facts
        strict = words[-1] + 1
    while strict > 0 and fits(at[strict - 1], 0.5):  # a row with a broken cell is a row still
        strict -= 1
    if at[strict - 1 : strict] == [at[strict] - 1] and fits(at[strict] - 1, 1.0, True):
        strict -= 1  # its title calls this row the first of the numbers
    strict = 0 if all(fits(n, 1.0, True) for n in at[:strict]) else strict  # facts beside numbers
    first, rows = at[strict], at[strict:]
    titled = _titled(lines, range(first), separator, len(kinds), _UNIT_HEADS)
    if dialect.skip is not None:
        above = [n for n in range(skip, first) if lines[n].strip(" \t" + separator)][:2]
        below = above[1] if len(above) > 1 else None
        last = split(lines[above[1]], separator) if len(above) > 1 else []
        below = below if titled is None or any(map(_is_unit, last)) else titled
        below = below if dialect.unit_row else None
        header = above[0] if above else None
        return _clocked(TextLayout(header, below, first, kinds, rows), lines, marks)
    header, units = _heads(lines, range(skip, first), separator, kinds)
    units = titled if units is None else units
    if dialect.unit_row is False:
        header, units = (header if units in (None, titled) else units), None
    return _clocked(TextLayout(header, units, first, kinds, rows), lines, marks)


def _without_numbers(lines: Sequence[str], rows: Sequence[int]) -> LogError:
    """The error of lines without rows of numbers, of which some ``rows`` are no remarks."""
    if not rows:
        return LogError(message("data.no_rows_of_numbers"))
    text = shortened(lines[rows[-1]].strip(), 60)
    return LogError(message("data.only_header", text=text))


def _titled(
    lines: Sequence[str], above: range, separator: str, width: int, titles: Sequence[str]
) -> int | None:
    """The last line above the numbers whose first cell, or before whose cells in a remark, is a
    title of some, and that says something of most columns; None of none.
    """
    for n in reversed(above):
        row, remarked = split(bare(lines[n]), separator), _remarked(lines[n])[0]
        title, cells = (remarked, row) if remarked else (_label(row[0]), row[1:])
        if title in titles and len(row) >= width and any(cells):
            return n
    return None


def _clocked(layout: TextLayout, lines: Sequence[str], marks: tuple[str, str]) -> TextLayout:
    """The layout with the clock of its rows, where the lines above say it and no column is one."""
    names, units = names_of(lines, layout, marks[0]), units_of(lines, layout, marks[0])
    for kind, name, unit in zip_longest(layout.kinds, names, units, fillvalue=""):
        is_time = name.lower() in _TIME_NAMES or (unit or unit_in(name)) in TIME_UNITS
        if kind == "times" or (kind == "numbers" and is_time):
            return layout
    lines = lines[: layout.first]
    step, rate = _fact(lines, marks, _STEP_HEADS, "s"), _fact(lines, marks, _RATE_HEADS, "Hz")
    step = 1.0 / rate if rate and not step else step
    start = _fact(lines, marks, _START_HEADS, "s") or 0.0
    return replace(layout, clock=(start, step) if step and step > 0.0 else None)


def _fact(
    lines: Sequence[str], marks: tuple[str, str], titles: Sequence[str], unit: str
) -> float | None:
    """The number, in a unit, that the last line with a title says of all columns: beside or below
    the title, or in its own cell behind a mark. None of several or none.
    """
    separator, decimal = marks
    for line, below in reversed([*zip(lines, [*lines[1:], ""])]):
        cells, under = (split(bare(text), separator) for text in (line, below))
        facts = [(cells[0], cells[1:]), *((title, [cell]) for title, cell in zip(cells, under))]
        each = (_FACT.fullmatch(bare(text)) for text in (line, *cells))
        facts += [(match[1], [match[2]]) for match in each if match]
        for title, values in facts:
            if _label(_BRACKETED.sub("", title)) not in titles:
                continue
            texts = (text.strip(f' "{separator}') for text in values)
            pairs = {measured(text, decimal) or (text, unit_in(title)) for text in texts if text}
            known = {(number(text, decimal), of or unit) for text, of in pairs}
            value, of = known.pop() if len(known) == 1 else (None, unit)
            if value is not None:
                try:
                    return value * factor(named_unit(of) or of, unit)
                except UnitError:
                    return None
    return None


def _kinds_of(
    rows: Sequence[str], marks: tuple[str, str]
) -> tuple[tuple[str, ...], frozenset[int]]:
    """(what each column mostly holds, of the rows as wide as most, the blank ones at the end left
    out; the columns that are mostly blank).
    """
    separator, decimal = marks
    shown = [split(row, separator) for row in _some(rows)]
    widths = Counter(len(row) for row in shown)
    if not widths:
        return (), frozenset()
    width = max(widths, key=lambda size: (widths[size] * min(size, 2), size))
    results, every, slow = [], [], set()
    for at, column in enumerate(zip(*(row for row in shown if len(row) == width))):
        kinds = Counter(_kind(cell, decimal) for cell in column)
        if set(kinds) == {"holes"}:  # a slow signal: where it stands at all
            slow.add(at)
            every = every or [split(row, separator) for row in rows]
            filled = (row[at] for row in every if len(row) == width and row[at])
            some = Counter(_kind(cell, decimal) for cell in islice(filled, _TOGETHER))
            lone = some.total() < 2  # a fact, and no signal
            some = Counter() if lone else some
            kinds += some if at or "numbers" in some or "times" in some else Counter()
        holes = kinds.pop("holes", 0)
        results.append(kinds.most_common(1)[0][0] if kinds else "holes" if holes else "words")
    while results and results[-1] == "holes":
        results.pop()
    first = ["blank" if kind == "holes" else kind for kind in results[:1]]
    results = [*first, *("words" if kind == "holes" else kind for kind in results[1:])]
    return tuple(results) if "numbers" in results else (), frozenset(slow)


def _heads(
    lines: Sequence[str], above: range, separator: str, kinds: Sequence[str]
) -> tuple[int | None, int | None]:
    """(line of the header, line of the units) of the lines above the numbers."""
    block, width = [], len(kinds)
    for n in reversed(above):
        if lines[n].strip(" \t" + separator):
            block.append(n)
        elif block:
            break
    within = range(block[-1] if block else above.stop, above.stop)
    names, units = (
        _titled(lines, within, separator, width, titles) for titles in (_NAME_HEADS, _UNIT_HEADS)
    )
    rows = {n: split(bare(lines[n]), separator)[:width] for n in (names, *block) if n is not None}
    # a title before each column's name, or above no numbers, or units below the names
    many = names is not None and (kinds[0] == "blank" or rows[names].count(rows[names][0]) > 1)
    if names is not None and (units is not None or many):
        own = {n: [cell for cell in row if cell and cell != row[0]] for n, row in rows.items()}
        # one name comes again: another row tells the columns apart
        tells = (n for n, row in own.items() if row and len(set(row)) == len(row))
        return next(tells, names), units
    wide, at = _wide_rows(lines, above, separator, width)
    if at == [units]:  # without names
        return None, units
    for index, cells in enumerate(wide[:-1]):
        units = cells[1:] if _label(cells[0]) in _UNIT_HEADS else cells
        known = sum(map(_is_unit, units))
        # three in four below names that are none: a recorder may have words of its own for one
        mostly = known >= 0.75 * len(units) and not any(map(_is_unit, wide[index + 1]))
        all_of_it = known == len(units) or all(map(_BRACKETED.fullmatch, units))
        if units and (mostly or all_of_it):
            return at[index + 1], at[index]
        unlike = len(set(cells)) == len(cells) and _is_of_words(lines[at[index]], (separator, "."))
        if unlike and _label(_BRACKETED.sub("", cells[0])) in _TIME_NAMES:  # facts about it
            return at[index], None
    if wide and at[0] > above.start and all(map(_is_unit, wide[0])):  # of numbered channels
        names = split(bare(lines[at[0] - 1]), separator)[:width]
        if len(list(filter(None, names))) == len(wide[0]):
            return at[0] - 1, at[0]
    return (at[0], None) if at else (None, None)


def _wide_rows(
    lines: Sequence[str], above: range, separator: str, width: int
) -> tuple[list[list[str]], list[int]]:
    """(cells that are filled, line) of each row of words above the numbers that may name columns or
    their units, the last first."""
    wide: list[list[str]] = []
    at: list[int] = []
    below = False  # whether remarks stand below the header, which is none itself then
    for n in reversed(above):
        if not lines[n].strip(" \t" + separator):
            if wide:
                break
            continue
        cells = _names_in(lines, n, separator, width)[:width]
        if cells[0].endswith(":") or all("=" in cell for cell in cells):  # facts
            continue
        filled = [cell for cell in cells if cell.strip("-")]
        is_remark = not is_row(lines[n], separator)
        title = _remarked(lines[n])[0]
        is_fact = title not in ("", *_NAME_HEADS, *_UNIT_HEADS)
        if is_remark and (len(cells) < width or is_fact) and not wide:
            below = True
            continue
        if is_fact or (
            (is_remark and below)
            or len(cells) < width
            or len(filled) < min(width, 2)
            or len(wide) == _HEADS
        ):
            break
        if sum(number(cell) is not None for cell in filled) < 0.5 * len(filled):
            wide.append(filled)
            at.append(n)
    return wide, at


def _names_in(lines: Sequence[str], n: int, separator: str, width: int) -> list[str]:
    """The cells of a line of names; blank is the first above rows that R counts without a name."""
    cells = split(bare(lines[n]), separator)
    if len(cells) != width - 1:
        return cells
    counted = [split(line, separator)[0] for line in lines[n + 1 : n + 3]] == ["1", "2"]
    return ["", *cells] if counted else cells


def _is_unit(cell: str) -> bool:
    plain = cell.strip(" []()")
    return bool(named_unit(cell) or absolute_unit(cell) or _CLOCK_FORM.fullmatch(plain))


def _label(cell: str) -> str:
    return cell.strip(": ").lower().removeprefix("trace_")


def sections_of(
    lines: Sequence[str], marks: tuple[str, str], dialect: Dialect
) -> list[tuple[int, list[str]]]:
    """(line before it, lines) of each table. A table begins with rows of words that name its
    columns, behind a blank line or amid numbers; under the head of the one before it goes on, and
    that head is blank. ``dialect`` is that of the first table.
    """

    def layout(first: int, end: int, dialect: Dialect) -> TextLayout | None:
        """Of a table; None of facts, whose first column are words, or that are one row."""
        try:
            result = layout_of(lines[first:end], marks, dialect)
        except LogError:
            return None
        few = end - first - result.first < _TOGETHER
        facts = len(result.rows) < 2 or (few and result.kinds[0] == "words")
        return None if facts else result

    def heads(first: int, of: TextLayout) -> list[str]:
        """The lines of its names and units."""
        return [lines[first + n] for n in (of.header, of.units) if n is not None]

    at = [n for n, line in enumerate(lines) if line.strip(" \t,;")]
    begins = [
        later
        for before, later in zip(at, at[1:])
        if later > before + 1
        and _kind(split(lines[later], marks[0])[0], marks[1]) == "words"
        or lines[later].lstrip('" \t[')[:1].isalpha()
        and lines[before].lstrip('" \t')[:1] in _NUMERIC
        and _is_of_words(lines[later], marks)
    ]
    free, result = replace(dialect, skip=None, unit_row=None), [*lines]
    firsts, facts, above = [0], None, None  # facts: where rows of words may begin the next
    for begin, end in zip(begins, [*begins[1:], len(lines)]):
        facts = begin if facts is None else facts
        here = layout(begin, end, free)
        if here is None:
            continue
        if here.header is None:  # rows that go on below a remark
            facts = None
            continue
        named = [cell for cell in split(bare(lines[begin + here.header]), marks[0]) if cell]
        if 2 * len(named) < len(here.kinds):
            continue
        above = above or layout(firsts[-1], facts, dialect if len(firsts) == 1 else free)
        if above is None:  # facts above the first table
            pass
        elif here.clock is None and heads(begin, here) == heads(firsts[-1], above):
            result[facts : begin + here.first] = [""] * (begin + here.first - facts)
        else:
            firsts.append(facts)
            above = None
        facts = None
    ends = [*firsts[1:], len(lines)]
    return [(first, result[first:end]) for first, end in zip(firsts, ends)]


def _is_of_words(line: str, marks: tuple[str, str]) -> bool:
    cells = {cell for cell in split(line, marks[0]) if cell}
    return len(cells) > 1 and all(_kind(cell, marks[1]) == "words" for cell in cells)


def names_of(lines: Sequence[str], layout: TextLayout, separator: str) -> list[str]:
    """The cells of the header; none without one."""
    width = len(layout.kinds)
    top = [] if layout.header is None else _names_in(lines, layout.header, separator, width)
    if top and _label(top[0]) in _NAME_HEADS:  # the title of a row is the name of no column
        above = range(layout.first)
        at = _titled(lines, above, separator, width, _CLOCK_HEADS)
        clock = "" if at is None else split(lines[at], separator)[0]
        if clock or top.count(top[0]) > 1:
            top = [clock if cell == top[0] else cell for cell in top]
    return top


def units_of(lines: Sequence[str], layout: TextLayout, separator: str) -> list[str]:
    """The unit that each cell of the row of units says; one that is not known here without the
    brackets about it. None without such a row.
    """
    cells = [] if layout.units is None else split(bare(lines[layout.units]), separator)
    plain = [cell.strip() if absolute_unit(cell) else cell.strip(" []()") for cell in cells]
    return [
        ""
        if _label(cell) in _UNIT_HEADS
        else text
        if absolute_unit(cell)
        else named_unit(cell) or named_unit(re.sub(r"\s*\(.*\)|^\w+:", "", cell)) or text
        for cell, text in zip(cells, plain)
    ]
