"""MAT files up to version 7, by SciPy: vectors, matrices and structs of numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, whosmat

from ehbench.data.readers.table import Dialect, Gathered, Source, SourceTable
from ehbench.runtime.memory import refuse_beyond
from ehbench.vocabulary.messages import message

_DEEPEST = 8  # structs in structs
_PACKED = 20  # numbers that a byte of a packed file may stand for


def read(path: Path, dialect: Dialect) -> Source:
    """The variables of a file; fields of structs by ``struct.field``."""
    try:
        sizes = [np.prod(shape, dtype=float) for _, shape, _ in whosmat(str(path))]
    except TypeError:  # it holds an object of MATLAB's own, such as a timetable
        sizes = [_PACKED * path.stat().st_size]
    refuse_beyond(24.0 * sum(sizes), "reading it")
    result = loadmat(str(path), squeeze_me=True, struct_as_record=False, appendmat=False)
    gathered, losses = Gathered(), []
    for name, value in result.items():
        if not name.startswith("__"):
            _add(gathered, "", name, value, losses)
    names, units = (getattr(result.get(word), "__dict__", {}) for word in ("names", "units"))
    tables = tuple(_labelled(table, names, units) for table in gathered.tables())
    return Source(tables, losses=tuple(losses))


def _labelled(
    table: SourceTable, names: Mapping[str, Any], units: Mapping[str, Any]
) -> SourceTable:
    """A table with the names and units that structs ``names`` and ``units`` of the file give its
    variables.
    """
    columns = tuple(
        replace(
            column,
            name=str(names.get(column.name, column.name)),
            unit=str(units.get(column.name, column.unit)),
        )
        for column in table.columns
    )
    return replace(table, columns=columns)


def _add(gathered: Gathered, place: str, name: str, value: Any, losses: list[str]) -> None:
    """Take a variable, or the fields of a struct."""
    whole = f"{place}.{name}" if place else name
    if fields := getattr(value, "_fieldnames", None):
        if whole.count(".") < _DEEPEST:
            for field in fields:
                _add(gathered, whole, field, getattr(value, field), losses)
        return
    array = np.asarray(value)
    if hasattr(value, "dtype") and value.dtype.names and "s2" in value.dtype.names:
        losses.append(message("data.matlab_object", name=whole))
    elif array.dtype == object and array.size and hasattr(array.flat[0], "_fieldnames"):
        for index, item in enumerate(array.flat, 1):
            _add(gathered, place, f"{name}({index})", item, losses)
    elif not gathered.add(place, whole, array) and array.size > 1 and array.dtype.kind != "U":
        losses.append(message("data.not_read", name=whole))
