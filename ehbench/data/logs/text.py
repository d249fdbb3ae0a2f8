"""CSV logs: a header that names channels with their units, and rows of numbers."""

from pathlib import Path

import numpy as np

from ehbench.data.logs.checks import check_record, inside, label_of
from ehbench.data.record import Record, Window
from ehbench.data.text import is_hole, number, text_table
from ehbench.vocabulary import InputError, LogError, message, quantity, to_si

_EXAMPLE = "t [s],boom.q [rad]"


def read_csv(path: Path, check: bool, window: Window | None = None) -> Record:
    """A CSV log whose header names channels with their units; arguments as in `ehbench.data.read`.

    Raises:
        LogError, UnitError: with file, line and column."""
    table = text_table(path, _EXAMPLE)
    where = {"file": path, "line": table.head}
    if all(number(cell) is not None for cell in table.header):
        raise LogError(message("data.header_missing", example=_EXAMPLE), file=path, line=table.head)
    try:
        labels = [label_of(cell, **where) for cell in table.header]
    except InputError as error:
        hint = f"{error.hint}; " + message("data.or_a_map", file=path.name)
        raise type(error)(error.message, hint=hint, **where) from None
    names = [name for name, _ in labels]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise LogError(message("data.column_twice", name=twice), **where)
    if "t" not in names or len(names) < 2:
        raise LogError(message("data.no_time_or_channel", example=_EXAMPLE), **where)
    if not table.rows:
        raise LogError(message("data.no_rows"), **where)
    values, odd = table.numbers(range(len(names)))
    count, t = np.arange(len(values)), values[:, names.index("t")]
    timed = np.isfinite(t)
    keep = inside(np.interp(count, count[timed], t[timed]) if timed.any() else t, window)
    bad = [
        (row, index, cell)
        for index, cells in enumerate(odd)
        for row, cell in cells.items()
        if keep[row] and not (cell and is_hole(cell))
    ]
    if bad:
        row, index, cell = min(bad)
        raise table.bad_cell(index, row, cell)
    channels = {
        name: to_si(values[:, i].copy(), unit, quantity(name))
        for i, (name, unit) in enumerate(labels)
    }
    record = Record(channels.pop("t"), channels)
    if check:
        lines = np.array(table.lines)[keep].tolist()
        check_record(record.at(keep), path, lines=lines, units=dict(labels))
    return record
