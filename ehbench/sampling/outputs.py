"""The table of a study, a row a sample in their order, as CSV and Parquet."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.recipe import Measure
from ehbench.config.rig import Rig
from ehbench.sampling.design import Design
from ehbench.sampling.journal import Journal
from ehbench.sampling.measures import row_of
from ehbench.vocabulary import Quantity, from_si
from ehbench.vocabulary.text import quoted


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
    """The table in memory: ``inputs``, shape (samples, inputs), texts by their place in ``texts``;
    ``measures`` as shown, shape (samples, measures)."""

    inputs: np.ndarray
    texts: tuple[tuple[str, ...], ...]
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
    kinds = [(column.head, "text" if column.is_text else "float") for column in design.columns]
    front = [("sample", "int"), ("hash", "text"), ("code", "int"), ("status", "text")]
    columns = [
        *front,
        *kinds,
        *((measure.head, "float") for measure in measures),
        ("message", "text"),
    ]
    size = design.size
    inputs = np.full((size, len(design.columns)), np.nan)
    numbers = np.full((size, len(measures)), np.nan)
    codes, status = np.zeros(size, np.int16), []
    texts: list[dict[str, int]] = [{} for _ in design.columns]
    with (
        (folder / "samples.csv").open("w", encoding="utf-8", errors="surrogateescape") as csv,
        _parquet(folder / "samples.parquet", columns) as add,
    ):
        csv.write(",".join(quoted(name) for name, _ in columns) + "\n")
        samples = journal.samples()
        while rows := list(islice(samples, 4096)):
            lines = []
            for item in rows:
                digest = hash_of(key, design.settings(item.index))
                values = [float(c.shown(v)) for c, v in zip(measures, item.measures, strict=True)]
                cells = [*design.cells(design.inputs(item.index)), *values, item.message]
                lines.append([item.index, digest, item.code, item.status, *cells])
            add([*zip(*lines, strict=True)])
            csv.writelines(",".join(_cell(cell) for cell in line) + "\n" for line in lines)
            for line in lines:
                index, last = line[0], 4 + len(kinds)
                codes[index], numbers[index] = line[2], line[last:-1]
                status.append(line[3])
                for at, cell in enumerate(line[4:last]):
                    is_text = isinstance(cell, str)
                    inputs[index, at] = (
                        texts[at].setdefault(cell, len(texts[at])) if is_text else cell
                    )
    return Rows(inputs, tuple(tuple(text) for text in texts), numbers, codes, tuple(status))


@contextmanager
def _parquet(
    path: Path, columns: Sequence[tuple[str, str]]
) -> Iterator[Callable[[Sequence[Sequence]], None]]:
    """Takes stretches of rows, column by column, as a Parquet file; without pyarrow, none."""
    try:
        import pyarrow
        from pyarrow.parquet import ParquetWriter
    except ImportError:
        yield lambda columns: None
        return
    kinds = {"int": pyarrow.int64(), "float": pyarrow.float64(), "text": pyarrow.string()}
    schema = pyarrow.schema([(name, kinds[kind]) for name, kind in columns])
    with ParquetWriter(path, schema) as writer:
        yield lambda columns: writer.write(pyarrow.table(list(columns), schema=schema))


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return quoted(str(value))
