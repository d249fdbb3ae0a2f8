"""The table of a study, a row a sample in their order, as CSV and Parquet."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.recipe import Measure
from ehbench.config.rig import Rig
from ehbench.sampling.design import Design
from ehbench.sampling.journal import Journal
from ehbench.sampling.measures import row_of
from ehbench.vocabulary import Quantity, from_si


@dataclass(frozen=True)
class MeasureColumn:
    """A column of measures: name, shown unit or '', quantity if known, if stopped samples have
    it."""

    name: str
    unit: str
    row: Quantity | None
    of_stops: bool

    @classmethod
    def of(cls, item: Measure, rig: Rig | None) -> MeasureColumn:
        """The column of a measure, in the unit that it asks for, else in the rig's."""
        row = row_of(item)
        unit = item.unit or ("" if row is None else row.display)
        if row is not None and not item.unit and rig is not None:
            unit = rig.unit_of(row.name)
        first = (item.result or "").split(".")[0]
        stops = (
            item.stopped or item.since == "stop" or first in ("stop", "after", "stopped", "code")
        )
        return cls(item.label, "" if unit == "dimensionless" else unit, row, stops)

    @property
    def head(self) -> str:
        """As a table heads it."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def shown(self, value: Any) -> Any:
        """An SI value, or array, in the column's unit."""
        return value if self.row is None or not self.unit else from_si(value, self.unit, self.row)


@dataclass(frozen=True)
class Rows:
    """The table in memory: ``inputs``, shape (samples, inputs), a text by the number of its first
    place among those of its column; ``measures`` as shown, shape (samples, measures)."""

    inputs: np.ndarray
    measures: np.ndarray
    codes: np.ndarray
    status: tuple[str, ...]


def hash_of(key: str, settings: Any) -> str:
    """What a sample depends on, as 16 hex digits."""
    text = json.dumps(settings, sort_keys=True, default=str)
    return hashlib.sha256(f"{key}{text}".encode()).hexdigest()[:16]


def write_tables(
    folder: Path, design: Design, measures: Sequence[MeasureColumn], journal: Journal, key: str
) -> Rows:
    """Write ``samples.csv``, with pyarrow ``samples.parquet`` as well, of every sample of a
    journal: its inputs by the design, then its measures. The table also comes back."""
    import pandas as pd

    rows = []
    for item in journal.samples():
        digest = hash_of(key, design.settings(item.index))
        values = (float(c.shown(v)) for c, v in zip(measures, item.measures, strict=True))
        front = (item.index, digest, item.code, item.status)
        rows.append((*front, *design.cells(design.inputs(item.index)), *values, item.message))
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    heads = [column.head for column in (*design.columns, *measures)]
    names = ["sample", "hash", "code", "status", *heads, "message"]
    table = pd.DataFrame(dict(enumerate(columns)))
    table.to_csv(folder / "samples.csv", header=names, index=False, errors="surrogateescape")
    with suppress(ImportError):
        import pyarrow
        from pyarrow.parquet import write_table

        with (folder / "samples.parquet").open("wb") as file:  # its own names are UTF-8
            write_table(pyarrow.table(columns, names=names), file)
    last = 4 + len(design.columns)
    inputs = [pd.factorize(y)[0] if y.dtype.kind == "U" else y for y in columns[4:last]]
    nothing = np.empty((len(rows), 0))
    x, y = (np.column_stack([nothing, *part]) for part in (inputs, columns[last:-1]))
    return Rows(x, y, columns[2], tuple(columns[3].tolist()))
