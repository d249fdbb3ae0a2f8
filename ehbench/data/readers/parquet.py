"""Parquet tables, by pyarrow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from ehbench.data.readers.table import (
    Dialect,
    Source,
    SourceColumn,
    SourceTable,
    columns_of,
    numbered,
)
from ehbench.runtime.memory import refuse_beyond
from ehbench.vocabulary.messages import message

_UNITS = (b"unit", b"units", b"Unit", b"Units")


def read(path: Path, dialect: Dialect) -> Source:
    """The columns of a table; their units from the metadata of its fields."""
    with path.open("rb") as source, pq.ParquetFile(source) as file:
        rows, schema = file.metadata.num_rows, file.schema_arrow
        refuse_beyond(24.0 * rows * len(schema), "reading it")
        table = file.read()
    columns: list[SourceColumn] = []
    began, losses = None, []
    for field, chunks in zip(schema, table.columns):
        unit = next(((field.metadata or {}).get(key) for key in _UNITS if field.metadata), None)
        try:
            values = chunks.to_numpy(zero_copy_only=False)
            if values.dtype == object:  # numbers with nothing between them, or words
                values = np.array([np.nan if value is None else float(value) for value in values])
        except (TypeError, ValueError, NotImplementedError):
            losses.append(message("data.not_read", name=field.name))
            continue
        for column, first in columns_of(
            field.name, values, (unit or b"").decode("utf-8", "replace")
        ):
            columns.append(column)
            began = first if began is None else began
    names = numbered([column.name for column in columns])
    built = tuple(SourceColumn(name, item.values, item.unit) for name, item in zip(names, columns))
    return Source((SourceTable("", built, None, began),), losses=tuple(losses))
