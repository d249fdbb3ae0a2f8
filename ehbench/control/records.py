"""Structured records: numbers with names, as kernels and Python alike take them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


def record_type(fields: Sequence[tuple[Any, ...]]) -> np.dtype:
    """The type of a record with fields (name, type) or (name, type, shape), read as
    ``record.name``.
    """
    return np.dtype((np.record, np.dtype(list(fields), align=True)))


def reals(names: Sequence[str]) -> list[tuple[str, str]]:
    """Fields of one real number each."""
    return [(name, "f8") for name in names]


def blank(kind: np.dtype) -> np.record:
    """A record of a type, all zeros."""
    return np.zeros(1, kind)[0]


def numbers(record: np.record, names: Sequence[str]) -> dict[str, float]:
    """Some fields of a record by name, as plain numbers."""
    return {name: float(record[name]) for name in names}
