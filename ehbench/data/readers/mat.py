"""MAT files up to version 7, by SciPy: vectors, matrices and structs of numbers, with the names and
units that Simulink, ControlDesk and PicoScope write beside them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, whosmat

from ehbench.data.readers.table import Dialect, Gathered, Source, column_names
from ehbench.runtime.memory import refuse_beyond
from ehbench.vocabulary import message

_DEEPEST = 8  # structs in structs
_PACKED = 20  # numbers that a byte of a packed file may stand for
# what recorders call the numbers of a struct, their name and their unit
_DATA, _NAMES = ("data", "values", "value"), ("name", "label", "title", "signalname")
_UNIT_FIELDS = ("unit", "units")


def read(path: Path, dialect: Dialect) -> Source:
    """The variables of a file; fields of structs by ``struct.field``."""
    try:
        sizes = [np.prod(shape, dtype=float) for _, shape, _ in whosmat(str(path))]
    except TypeError:  # it holds an object of MATLAB's own, such as a timetable
        sizes = [_PACKED * path.stat().st_size]
    refuse_beyond(24.0 * sum(sizes))
    result = loadmat(str(path), squeeze_me=True, struct_as_record=False, appendmat=False)
    gathered = Gathered()
    for name, value in result.items():
        if not name.startswith("__"):
            _add(gathered, "", name, value)
    names, units, meta = (
        getattr(result.get(word), "__dict__", {}) for word in ("names", "units", "meta")
    )
    if names.get("t") != "t":  # facts of another program
        meta = {}
    meta = {key: text for key, text in meta.items() if isinstance(text, str)}
    start, step = result.get("Tstart"), result.get("Tinterval")  # of a PicoScope
    tables = []
    for table in gathered.tables():
        labels = column_names([str(names.get(item.name, item.name)) for item in table.columns])
        columns = tuple(
            replace(item, name=label, unit=str(units.get(item.name, item.unit)))
            for item, label in zip(table.columns, labels)
        )
        t = table.t
        if isinstance(start, Real) and isinstance(step, Real) and not table.name:
            t = float(start) + float(step) * np.arange(table.size)
        tables.append(replace(table, columns=columns, t=t))
    return Source(tuple(tables), losses=tuple(gathered.losses), meta=meta)


def _add(gathered: Gathered, place: str, name: str, value: Any) -> None:
    """Take a variable by its whole name, or the fields of a struct; ``place`` is the struct that it
    is in."""
    if fields := getattr(value, "_fieldnames", None):
        if name.count(".") < _DEEPEST:
            content = {field: getattr(value, field) for field in fields}
            _add_struct(gathered, place, name, content)
        else:
            gathered.losses.append(message("data.not_read", name=name))
        return
    array = np.asarray(value)
    if hasattr(value, "dtype") and value.dtype.names and "s2" in value.dtype.names:
        gathered.losses.append(message("data.matlab_object", name=name))
    elif array.dtype == object and array.size and hasattr(array.flat[0], "_fieldnames"):
        for index, item in enumerate(array.flat, 1):
            _add(gathered, place, f"{name}({index})", item)
    elif not gathered.add(place, name, array) and array.size > 1 and array.dtype.kind != "U":
        gathered.losses.append(message("data.not_read", name=name))


def _add_struct(gathered: Gathered, place: str, name: str, content: Mapping[str, Any]) -> None:
    """Take the fields of a struct. One with a single vector of numbers is a channel: it stands
    among those beside it, by its label and with its unit."""
    known = {field.lower(): item for field, item in content.items()}

    def text_of(words: Sequence[str]) -> str:
        return next((v for w in words if isinstance(v := known.get(w), str) and v.strip()), "")

    vectors = [field for field, item in content.items() if _is_vector(item)]
    clocks = np.atleast_1d(np.asarray(known.get("x"), object))  # of ControlDesk, each Y on its X
    clocked = clocks.size > 1 and all(hasattr(clock, "_fieldnames") for clock in clocks)
    for field, item in content.items():
        if field == "time" and "signals" in known and _is_vector(item):  # Simulink's, in seconds
            gathered.add(name, f"{name}.{field}", item, "s")
        elif field.lower() in _DATA and _is_vector(item):
            where, label = place if len(vectors) == 1 else name, text_of(_NAMES)
            if not gathered.add(where, label or f"{name}.{field}", item, text_of(_UNIT_FIELDS)):
                gathered.losses.append(message("data.not_read", name=f"{name}.{field}"))
        elif field.lower() == "y" and clocked and not _is_vector(item):
            for index, channel in enumerate(np.atleast_1d(np.asarray(item, object)), 1):
                clock = getattr(channel, "XIndex", 1)
                _add(gathered, f"{name}.X({clock})", f"{name}.{field}({index})", channel)
        elif field.lower() == "x" and clocked:
            for index, channel in enumerate(clocks, 1):
                _add(gathered, f"{name}.X({index})", f"{name}.X({index})", channel)
        else:
            _add(gathered, name, f"{name}.{field}", item)


def _is_vector(item: Any) -> bool:
    return isinstance(item, np.ndarray) and item.dtype.kind in "fiub" and item.size > 1
