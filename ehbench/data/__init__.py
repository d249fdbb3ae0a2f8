"""Recordings of any format in, logs in and out. `read` is the front door."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

    from ehbench.config.recipe.columns import ColumnMap
    from ehbench.data.additional import AdditionalFile
    from ehbench.data.record import Record, Window


def read(
    path: str | Path,
    columns: ColumnMap | str | Path | None = None,
    *,
    check: bool = True,
    window: Window | None = None,
    additional: Sequence[AdditionalFile] = (),
) -> Record:
    """A log in SI: MCAP, CSV, or any other format that is read (`ehbench.data.readers`).

    A truncated, killed or damaged MCAP gives its sound chunks; ``losses`` then says what is
    missing. Tables and topics of different rates come on the time base of the fastest, readings on
    straight lines between their samples, commands held.

    Args:
        path: the file.
        columns: a map of the file's columns, or the file of one; without it they have to be named
            as channels.
        check: refuse what no rig can have recorded (`ehbench.data.logs.check_record`).
        window: [s] what lies outside is not checked, and may be NaN.
        additional: files that other recorders wrote of the same run; their channels come with it.

    Raises:
        LogError: no log, nothing in it, or nothing that can be read; what the check refuses.
        UnitError: a channel without unit or with a wrong one; a value outside the plausible range.
        InputError: an additional file that has nothing in common with the log."""
    path = Path(path)
    record = _read(path, columns, check, window)
    if not additional:
        return record
    from ehbench.data.additional import lateness, with_additional

    whole = window is None or window == (-math.inf, math.inf)
    others = []
    for other in additional:
        result = _read(other.path, other.columns, check and whole, None)
        late = lateness(record, path, result, other)
        if window is not None and not whole:
            shifted = window[0] - late, window[1] - late
            result = _read(other.path, other.columns, check, shifted)
        others.append((other, result, late))
    return with_additional(record, path, others)


def _read(
    path: Path, columns: ColumnMap | str | Path | None, check: bool, window: Window | None
) -> Record:
    """One file, as `read` reads it."""
    from ehbench.config.recipe.columns import ColumnMap, load_columns
    from ehbench.data.readers import reader_of

    if columns is None:
        reader = reader_of(path)
        if reader.module == "delimited":
            from ehbench.data.logs.text import read_csv

            return read_csv(path, check, window)
        if reader.module == "ros" and path.is_file() and path.suffix.lower() != ".db3":
            from ehbench.data.logs.reading import read_mcap

            return read_mcap(path, check, window)
    elif not isinstance(columns, ColumnMap):
        columns = load_columns(columns)
    from ehbench.data.channels import read_mapped

    return read_mapped(path, columns, check, window)


def read_log(
    path: str | Path, check: bool = True, columns: ColumnMap | str | Path | None = None
) -> pd.DataFrame:
    """A log as a pandas frame: column ``t`` [s], one SI column a channel; units, meta and losses
    are in ``frame.attrs``.

    Example:
        frame = ehbench.read_log("datasets/slide_servo/steps/press_no_load.mcap")
        frame.attrs["units"]["press.p_head"], frame["press.p_head"].max()

    Arguments and errors as in `read`."""
    return read(path, columns, check=check).frame(copy=False)
