"""HDF5 files, those of netCDF-4 and MAT files of version 7.3 among them, by h5py: data sets of
numbers, a table for those of one group and length."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py

from ehbench.data.readers.cf import converted, since
from ehbench.data.readers.table import Dialect, Gathered, Source, unit_of_attributes
from ehbench.runtime.memory import refuse_beyond
from ehbench.vocabulary import EhbenchError, message


def read(path: Path, dialect: Dialect) -> Source:
    """The data sets of a file, converted as their attributes say, with the units of these."""
    gathered = Gathered()
    losses = gathered.losses
    with h5py.File(path, "r") as file:
        sets = list(_data_sets(file, "", {file.id}, losses))
        sizes = (float(item.size or 0) * max(item.dtype.itemsize, 8) for _, item in sets)
        refuse_beyond(3.0 * sum(sizes), "reading it")
        for name, item in sets:
            if item.is_virtual or item.external:
                losses.append(message("data.in_other_file", name=name))
                continue
            if "MATLAB_object_decode" in item.attrs or h5py.check_ref_dtype(item.dtype):
                by_reference = "MATLAB_object_decode" not in item.attrs
                key = "data.matlab_structs" if by_reference else "data.matlab_object"
                losses.append(message(key, name=name))
                continue
            place, _, last = name.rpartition("/")
            values, unit = None, unit_of_attributes(item.attrs)
            words = h5py.check_enum_dtype(item.dtype) or "MATLAB_empty" in item.attrs
            words = words or item.attrs.get("MATLAB_class") == b"char"
            if item.size and item.dtype.kind in "fiubV" and not words:
                try:
                    values = converted(item[()], item.attrs)
                    values, unit = since(values, unit)
                except (EhbenchError, OSError) as error:  # damaged, or packed by an unknown filter
                    reason = getattr(error, "message", None) or str(error)
                    losses.append(message("data.not_converted", name=name, reason=reason))
                    continue
            if values is None or not gathered.add(place, last, values, unit):
                if (item.size or 0) > 1:
                    losses.append(message("data.not_read", name=name))
    return Source(gathered.tables(), losses=tuple(losses))


def _data_sets(
    group: Any, place: str, seen: set[Any], losses: list[str]
) -> Iterator[tuple[str, Any]]:
    """(name, data set) of all in a group and those below it, each once, by its first name."""
    for key in group:
        name, link = f"{place}{key}", group.get(key, getlink=True)
        if isinstance(link, h5py.ExternalLink):
            losses.append(message("data.in_other_file", name=name))
        if key.startswith("#") or not isinstance(link, h5py.HardLink):
            continue
        item = group[key]
        if item.id in seen:
            continue
        seen.add(item.id)
        if isinstance(item, h5py.Dataset):
            yield name, item
        elif isinstance(item, h5py.Group):
            yield from _data_sets(item, f"{name}/", seen, losses)
