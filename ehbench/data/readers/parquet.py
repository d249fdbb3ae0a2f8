"""Parquet tables, by pyarrow."""

import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ehbench.data.readers.table import Dialect, Gathered, Source, unit_of_attributes
from ehbench.runtime.memory import refuse_beyond
from ehbench.vocabulary import message


def read(path: Path, dialect: Dialect) -> Source:
    """The columns of a table; their units from the metadata of its fields."""
    with path.open("rb") as source, pq.ParquetFile(source) as file:
        rows, schema = file.metadata.num_rows, file.schema_arrow
        refuse_beyond(24.0 * rows * len(schema))
        table = file.read(use_threads=False)  # this is a child of a fork
    gathered = Gathered()
    for field, chunks in zip(schema, table.columns):
        about, values = field.metadata or {}, _values(field, chunks)
        if values is None:
            gathered.losses.append(message("data.not_read", name=field.name))
            continue
        unit = unit_of_attributes({key.decode("utf-8", "replace"): about[key] for key in about})
        gathered.add("", field.name, values, unit)
    meta = {}
    with suppress(AttributeError, KeyError, TypeError, ValueError):  # another program's
        items = json.loads(schema.metadata[b"ehbench"])["meta"].items()
        meta = {key: text for key, text in items if isinstance(text, str)}
    return Source(gathered.tables(), losses=tuple(gathered.losses), meta=meta)


def _values(field: pa.Field, chunks: pa.ChunkedArray) -> np.ndarray | None:
    """A column as numbers, moments or durations of numpy, NaN or NaT where it is null; None where
    it is of something else."""
    kind, types = chunks.type, pa.types
    extension = isinstance(kind, pa.BaseExtensionType)
    if extension or b"ARROW:extension:name" in (field.metadata or {}):
        return None  # what its numbers stand for, its own library knows
    if types.is_dictionary(kind):
        chunks, kind = chunks.cast(kind.value_type), kind.value_type
    if types.is_time(kind):  # of day
        width = pa.int32() if types.is_time32(kind) else pa.int64()
        chunks = chunks.cast(width).cast(pa.int64()).cast(pa.duration(kind.unit))
    elif types.is_boolean(kind):
        chunks = chunks.cast(pa.int8())
    elif types.is_decimal(kind) or types.is_null(kind):
        chunks = chunks.cast(pa.float64())
    elif not types.is_primitive(kind):
        return None
    return chunks.to_numpy(zero_copy_only=False)
