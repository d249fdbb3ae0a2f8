"""CSV logs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ehbench.data.logs.checks import check_record, inside, label_of, part_of
from ehbench.data.logs.mapped import Window
from ehbench.data.readers.delimited import COPIES, unpacked
from ehbench.data.record import Record
from ehbench.runtime.memory import refuse_beyond
from ehbench.vocabulary.errors import InputError, LogError
from ehbench.vocabulary.quantities import quantity
from ehbench.vocabulary.units import to_si


def read_csv(path: Path, data: bytes, check: bool, window: Window | None = None) -> Record:
    """A CSV log whose header names channels with their units.

    Args:
        path: the file, for messages; its bytes are ``data``.
        check: refuse data that `check_record` refuses.
        window: [s] what lies outside may be no number.
    """
    text = _decoded(path, data)
    rows = [
        (n, row)
        for n, row in enumerate(text.splitlines(), 1)
        if row.strip() and not row.lstrip().startswith("#")
    ]
    if not rows:
        raise LogError(
            "the file holds no header and no samples",
            file=path,
            hint="the header is like t [s],boom.q [rad]",
        )
    head, header = rows.pop(0)
    comma = max(",;\t", key=header.count)
    cells = [cell.strip().strip('"') for cell in header.split(comma)]
    if all(_number(cell) is not None for cell in cells):
        raise LogError(
            "the header is missing",
            file=path,
            line=head,
            hint="the header is like t [s],boom.q [rad]",
        )
    try:
        labels = [label_of(cell, file=path, line=head) for cell in cells]
    except InputError as error:
        hint = f"{error.hint}; or say what the columns are: ehbench map {path.name}"
        raise type(error)(error.message, file=path, line=head, hint=hint) from None
    names = [name for name, _ in labels]
    for name in names:
        if names.count(name) > 1:
            raise LogError(f"there are {names.count(name)} columns '{name}'", file=path, line=head)
    if "t" not in names or len(names) < 2:
        hint = "the header is like t [s],boom.q [rad]"
        raise LogError(
            "a log needs a column 't [s]' and at least one channel", file=path, line=head, hint=hint
        )
    if not rows:
        raise LogError("there are no samples below the header", file=path, line=head)
    lines = [n for n, _ in rows]
    table = _table(path, rows, comma, names, window)
    values = {
        name: to_si(table[:, i].copy(), unit, quantity(name))
        for i, (name, unit) in enumerate(labels)
    }
    record = Record(values.pop("t"), values)
    if check:
        keep = inside(record.t, window)
        retained = np.array(lines)[keep].tolist()
        check_record(part_of(record, keep), path, lines=retained, units=dict(labels))
    return record


def _decoded(path: Path, data: bytes) -> str:
    """The text of a file in UTF-8, packed by gzip or not."""
    data = unpacked(data, path)
    try:
        refuse_beyond(COPIES * len(data), "reading it")
    except InputError as error:
        raise LogError(error.message, file=path, hint=error.hint) from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise LogError(
            "is not UTF-8 text",
            file=path,
            line=line,
            hint="save the table as CSV in UTF-8, or say what its columns are: ehbench map FILE",
        ) from None


def _table(
    path: Path,
    rows: list[tuple[int, str]],
    comma: str,
    names: list[str],
    window: Window | None,
) -> np.ndarray:
    """The numbers of the rows; those outside of the window may be none, and are NaN then.

    Raises:
        LogError: a row of another width, a cell inside of the window that is no number.
    """
    try:
        table = np.loadtxt((row for _, row in rows), delimiter=comma, ndmin=2, comments=None)
        if table.shape[1] == len(names):
            return table
    except ValueError:
        pass
    whole = [(line, row) for line, row in rows if len(row.split(comma)) == len(names)]
    if window is None or len(whole) < len(rows):
        raise _first_bad_cell(path, rows, comma, names)
    cells = [[_number(cell) for cell in row.split(comma)] for _, row in rows]
    table = np.array([[np.nan if item is None else item for item in row] for row in cells])
    t = table[:, names.index("t")]
    timed = np.isfinite(t)
    if not timed.any():
        raise _first_bad_cell(path, rows, comma, names)
    count = np.arange(t.size)
    t = np.interp(count, count[timed], t[timed])
    requested = np.flatnonzero((t >= window[0]) & (t <= window[1]))
    if any(None in cells[at] for at in requested):
        raise _first_bad_cell(path, [rows[at] for at in requested], comma, names)
    return table


def _number(cell: str) -> float | None:
    try:
        return float(cell) if cell.isascii() and "_" not in cell else None
    except ValueError:
        return None


def _first_bad_cell(
    path: Path, rows: list[tuple[int, str]], comma: str, names: list[str]
) -> LogError:
    """The error for a table that is no table of numbers."""
    for line, row in rows:
        cells = row.split(comma)
        if len(cells) != len(names):
            return LogError(
                f"{len(cells)} values, but the header names {len(names)} columns",
                file=path,
                line=line,
            )
        for name, cell in zip(names, cells):
            if _number(cell) is None:
                what = f"'{cell.strip()}' is no number" if cell.strip() else "is empty"
                return LogError(
                    f"{name}: {what}", file=path, line=line, hint="numbers are like 1.5 or -2e3"
                )
    return LogError("is no table of numbers", file=path)
