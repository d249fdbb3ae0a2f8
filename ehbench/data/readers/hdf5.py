"""HDF5 files, those of netCDF-4 and MAT files of version 7.3 among them, by h5py: data sets of
numbers, a table for those of one group and length, converted by the CF conventions."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ehbench.data.readers.clock import clock
from ehbench.data.readers.table import Dialect, Gathered, Source, unit_of_attributes
from ehbench.runtime.memory import refuse_beyond
from ehbench.vocabulary import EhbenchError, LogError, message
from ehbench.vocabulary.units import factor

_SINCE = re.compile(r"\s*(\w+)\s+since\s+([\d-]+)(?:[T ]([\d:.]+))?\s*(\S*)\s*")
_CF_ATTRIBUTES = ("_FillValue", "missing_value", "valid_min", "valid_max", "valid_range")


def read(path: Path, dialect: Dialect) -> Source:
    """The data sets of a file, converted as their attributes say, with the units of these."""
    gathered = Gathered()
    losses = gathered.losses
    with h5py.File(path, "r") as file:
        sets = list(_data_sets(file, "", {file.id}, losses))
        sizes = (float(item.size or 0) * max(item.dtype.itemsize, 8) for _, item in sets)
        refuse_beyond(3.0 * sum(sizes))
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


def converted(values: np.ndarray, attributes: Mapping[str, Any]) -> np.ndarray:
    """What stored numbers stand for: ``values * scale_factor + add_offset``, NaN where nothing was
    written and where a stored number is not valid.

    Raises:
        LogError: such an attribute is no number."""
    keys = [key for key in ("scale_factor", "add_offset", *_CF_ATTRIBUTES) if key in attributes]
    unsigned = str(attributes.get("_Unsigned", "")).strip("b'\"").lower() == "true"
    if values.dtype.kind not in "fiu" or not (keys or unsigned):
        return values
    signed = values.dtype
    if unsigned and signed.kind == "i":
        values = values.view(signed.str.replace("i", "u"))
    about: dict[str, np.ndarray] = {}
    for key in keys:
        number = np.atleast_1d(attributes[key])
        sizes = {"valid_range": (2,), "missing_value": range(1, number.size + 1)}.get(key, (1,))
        if number.dtype.kind not in "fiu" or number.size not in sizes:
            raise LogError(message("data.attribute_no_number", key=key, value=attributes[key]))
        if key in _CF_ATTRIBUTES and unsigned and number.dtype.kind == "i":
            number = number.astype(signed).view(values.dtype)
        # a mark of 1e20 is another number in float32, as the stored ones are
        about[key] = number.astype(values.dtype if values.dtype.kind == "f" else float)
    result = values.astype(float)
    bad = np.zeros(values.shape, bool)
    for key in ("_FillValue", "missing_value"):
        bad |= np.isin(result, about.get(key, []))
    low, high = about.get("valid_range", (-np.inf, np.inf))
    bad |= (result < about.get("valid_min", low)) | (result > about.get("valid_max", high))
    scale, offset = attributes.get("scale_factor", 1.0), attributes.get("add_offset", 0.0)
    return np.where(bad, np.nan, result * np.ravel(scale)[0] + np.ravel(offset)[0])


def since(values: np.ndarray, unit: str) -> tuple[np.ndarray, str]:
    """(moments of time, '') where the unit names their zero, like ``s since 2026-03-01 12:00:00``;
    else (values, unit).

    Raises:
        LogError: the date is not understood."""
    if (match := _SINCE.fullmatch(unit)) is None or values.dtype.kind not in "fiu":
        return values, unit
    word, date, time, zone = match.groups()
    zero = clock([f"{date} {time or '00:00:00'}{zone}"])[1]
    if zero is None:
        raise LogError(message("data.no_moment", unit=unit))
    seconds = values.astype(float) * factor(word, "s")
    missing = ~np.isfinite(seconds)
    moments = np.where(missing, 0.0, 1e9 * seconds).round().astype(np.int64) + round(1e9 * zero)
    return np.where(missing, np.datetime64("NaT"), moments.astype("datetime64[ns]")), ""
