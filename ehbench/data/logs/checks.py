"""What a log must be: known channels with units, a time that goes on, plausible values."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.data.record import Record
from ehbench.vocabulary.errors import LogError, UnitError
from ehbench.vocabulary.quantities import VOCABULARY, quantity
from ehbench.vocabulary.units import from_si, to_si

LABEL = re.compile(r"\s*(.*?)\s*\[([^\[\]]*)\]\s*$")

SIDE_BY_SIDE = 16  # rows of a table that are scanned as one
TIMES = ("t", "time", "zeit", "timestamp", "seconds", "sec")  # what a time may be called


def check_record(
    record: Record,
    file: str | Path | None = None,
    *,
    lines: Sequence[int] | None = None,
    units: Mapping[str, str] | None = None,
) -> None:
    """Refuse data that no rig can have recorded.

    Args:
        record: what was read.
        file: where it came from, for the message.
        lines: the line of each sample in a text file.
        units: the unit each channel was written in, for the message.

    Raises:
        LogError: no samples, a time or value that is not finite, a time that stands still or goes
            back.
        UnitError: a value outside the plausible range of its quantity; says which unit would fit.
    """
    if not record.t.size:
        raise LogError("the log holds no samples", file=file)
    check_time(record.t, file=file, lines=lines)
    tables: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for name, values in record.channels.items():
        row, (low, high) = quantity(name), _ends(values, tables)
        if row.lower <= low and high <= row.upper and np.isfinite(low) and np.isfinite(high):
            continue
        finite = np.isfinite(values)
        at = int(np.argmin(finite & (values >= row.lower) & (values <= row.upper)))
        line = lines[at] if lines is not None else None
        where = "" if line else f" at t = {record.t[at]:.9g} s"
        if not finite[at]:
            raise LogError(
                f"{name} is {values[at]}{where}",
                file=file,
                line=line,
                hint="a log holds finite numbers only",
            )
        unit = (units or {}).get(name, row.unit)
        written = from_si(values[at], unit, row)
        hint = "check the unit and the sign"
        fits = [
            u
            for u in (row.display, row.unit)
            if u != unit and row.lower <= to_si(written, u, row) <= row.upper
        ]
        if fits:
            hint = f"in {fits[0]} it would be plausible: check the unit"
        bounds = " to ".join(f"{from_si(bound, unit, row):g}" for bound in (row.lower, row.upper))
        raise UnitError(
            f"{name} = {written:g} {unit}{where} lies outside {bounds} {unit}",
            file=file,
            line=line,
            hint=hint,
        )


def _ends(values: np.ndarray, tables: dict[int, tuple[np.ndarray, np.ndarray]]) -> tuple[Any, Any]:
    """(least, largest) of a channel, nan where it has one. Where it is a whole column of a table,
    all columns are scanned at once and kept in ``tables``: that is ten times as fast.
    """
    whole = values.base
    if (
        not isinstance(whole, np.ndarray)
        or (whole.ndim, whole.dtype) != (2, values.dtype)
        or not whole.flags.c_contiguous
        or (values.size, values.strides) != (whole.shape[0], whole.strides[:1])
    ):
        side_by_side = np.ascontiguousarray(values)  # twice as fast to scan
        return side_by_side.min(), side_by_side.max()
    if id(whole) not in tables:
        tables[id(whole)] = (_over_rows(np.minimum, whole), _over_rows(np.maximum, whole))
    at = (values.ctypes.data - whole.ctypes.data) // whole.strides[1]
    low, high = tables[id(whole)]
    return low[at], high[at]


def _over_rows(least: np.ufunc, whole: np.ndarray) -> np.ndarray:
    """The least or largest of each column of a table that lies row by row in memory.

    Several rows count as one long one at first: numpy goes row by row, which takes it longer to
    begin than to compare."""
    columns = whole.shape[1]
    many = min(SIDE_BY_SIDE, len(whole))
    even = len(whole) // many * many
    result = least.reduce(whole[:even].reshape(-1, many * columns)).reshape(many, columns)
    return least.reduce(np.concatenate([result, whole[even:]]))


def inside(t: np.ndarray, window: tuple[float, float] | None) -> np.ndarray:
    """Which times [s] lie inside a window; all where none does."""
    keep = np.ones(t.size, bool) if window is None else (t >= window[0]) & (t <= window[1])
    return keep if keep.any() else ~keep


def part_of(record: Record, keep: np.ndarray) -> Record:
    """The samples of a record that a mask keeps."""
    if keep.all():
        return record
    channels = {name: values[keep] for name, values in record.channels.items()}
    return replace(record, t=record.t[keep], channels=channels)


def check_time(
    t: np.ndarray,
    file: str | Path | None = None,
    lines: Sequence[int] | None = None,
    name: str = "the time",
) -> None:
    """Raise LogError unless ``t`` [s] is finite and increases strictly."""
    finite = np.isfinite(t)
    good = finite & np.concatenate([[True], np.diff(np.where(finite, t, 0.0)) > 0])
    if good.all():
        return
    at = int(np.argmin(good))
    line = lines[at] if lines is not None else None
    before, now = float(t[at - 1]), float(t[at])
    if not finite[at]:
        raise LogError(
            f"{name} is {now}", file=file, line=line, hint="a log holds finite numbers only"
        )
    how = "stands still at" if now == before else f"goes back from {before:.9g} s to"
    raise LogError(
        f"{name} {how} {now:.9g} s",
        file=file,
        line=line,
        hint="each sample must be later than the one before; where a clock began again, put what "
        "comes after into a file of its own",
    )


def check_known(name: str, *, file: str | Path | None = None, line: int | None = None) -> None:
    """Raise LogError, naming the nearest name, unless ``name`` is a channel of the vocabulary."""
    *path, word = name.split(".")
    if word in VOCABULARY and all(path):
        return
    plain = word.strip().lower()
    near = ["t"] if plain in TIMES else get_close_matches(plain, VOCABULARY, 1, cutoff=0.5)
    nearest = ".".join([*path, *near])
    hint = (
        f"nearest is '{nearest}'" + ", written 't [s]'" * (near == ["t"])
        if near
        else "a name ends in a word such as q, x, p_head, p_rod or command"
    )
    if path and all(path) and near != ["t"] and plain.isidentifier():
        hint += f"; if '{plain}' is a valve, its command is '{name}.command'"
    raise LogError(f"unknown channel '{name}'", file=file, line=line, hint=hint)


def label_of(text: str, *, file: str | Path, line: int | None = None) -> tuple[str, str]:
    """``boom.p_head [kPa]`` as (name, unit), both known."""
    match = LABEL.match(text)
    name, unit = match.groups() if match else (text.split("(")[0].strip(), "")
    check_known(name, file=file, line=line)
    row = quantity(name)
    if not unit.strip() and row.unit != "dimensionless":
        raise UnitError(
            f"'{text.strip()}' has no unit",
            file=file,
            line=line,
            hint=f"write it like '{name} [{row.display}]'",
        )
    try:
        to_si(0.0, unit, row)
    except UnitError as error:
        raise UnitError(
            f"'{text.strip()}': {error.message}", file=file, line=line, hint=error.hint
        ) from None
    return name, unit
