"""Attributes by which netCDF and HDF5 files say how stored numbers convert: the CF conventions,
sections 2.5.1, 4.4 and 8.1."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from ehbench.data.readers.clock import clock
from ehbench.vocabulary import LogError, message
from ehbench.vocabulary.units import factor

_SINCE = re.compile(r"\s*(\w+)\s+since\s+([\d-]+)(?:[T ]([\d:.]+))?\s*(\S*)\s*")
_CF_ATTRIBUTES = ("_FillValue", "missing_value", "valid_min", "valid_max", "valid_range")


def converted(values: np.ndarray, attributes: Mapping[str, Any]) -> np.ndarray:
    """What stored numbers stand for: ``values * scale_factor + add_offset``, NaN where nothing was
    written and where a stored number is not valid.

    Raises:
        LogError: such an attribute is no number.
    """
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
        LogError: the date is not understood.
    """
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
