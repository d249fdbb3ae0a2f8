"""Records of a controller's numbers: gains, rules, memory."""

from collections import namedtuple
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from ehbench.runtime.compiled import table


def reals(names: Sequence[str]) -> list[tuple[str, str]]:
    """Fields of one real number each, for `ehbench.runtime.compiled.record`."""
    return [(name, "f8") for name in names]


def blank(layout: np.dtype) -> np.record:
    """One record of a layout, all zero."""
    return table(1, layout)[0]


def rows_of(layout: np.dtype, row: np.record | None) -> np.recarray:
    """A table of one row, ``row`` or all zero: kernels give back tables, but no records."""
    rows = table(1, layout)
    if row is not None:
        rows[0] = row
    return rows


def numbers(row: np.record, names: Sequence[str]) -> dict[str, float]:
    """Some fields of a record by name, as plain numbers."""
    return {name: float(row[name]) for name in names}


def constants(settings: Any) -> Any:
    """The numbers of a method's settings as kernels read them: a named tuple is a constant
    there."""
    names = [field.name for field in fields(settings)]
    return namedtuple(type(settings).__name__, names)(*(getattr(settings, n) for n in names))
