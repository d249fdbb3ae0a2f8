"""HDF5 files and MAT files of version 7.3, by h5py: data sets of numbers, a table for those of one
group and length."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ehbench.data.readers.table import Dialect, Gathered, Source
from ehbench.runtime.memory import refuse_beyond
from ehbench.vocabulary.messages import message

_UNITS = ("unit", "units", "Unit", "Units", "UNIT", "UNITS")


def read(path: Path, dialect: Dialect) -> Source:
    """The data sets of a file, with the units of their attributes."""
    gathered, losses, sets = Gathered(), [], []
    with h5py.File(path, "r") as file:

        def take(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and not name.startswith("#"):
                sets.append((name, item))

        file.visititems(take)
        sizes = (float(item.size or 0) * max(item.dtype.itemsize, 8) for _, item in sets)
        refuse_beyond(3.0 * sum(sizes), "reading it")
        for name, item in sets:
            place, _, own = name.rpartition("/")
            fixed = item.dtype.kind in "fiubV" and "MATLAB_empty" not in item.attrs
            if not (fixed and gathered.add(place, own, item[()], _unit(item.attrs))):
                if (item.size or 0) > 1:
                    losses.append(message("data.not_read", name=name))
    return Source(gathered.tables(), losses=tuple(losses))


def _unit(attributes: Any) -> str:
    """The unit that a data set says it is in."""
    for key in _UNITS:
        value = attributes.get(key)
        if value is not None and np.size(value) == 1:
            item = np.asarray(value).ravel()[0]
            return item.decode("utf-8", "replace") if isinstance(item, bytes) else str(item)
    return ""
