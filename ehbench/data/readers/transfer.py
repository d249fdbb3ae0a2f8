"""What a reader gives, from a child process to the one that waits for it: facts as JSON, then the
numbers as they lie in memory. Nothing of it is code."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ehbench.data.readers.table import Dialect, Source, SourceColumn, SourceTable
from ehbench.vocabulary.errors import EhbenchError, LogError
from ehbench.vocabulary.messages import Message

_WIDTH = np.dtype(float).itemsize


def send(pipe: BinaryIO, result: Source | EhbenchError) -> None:
    """Write what a reader gave."""
    arrays: list[np.ndarray] = []
    if isinstance(result, Source):
        tables = [_table(table, arrays) for table in result.tables]
        losses = [_text(loss) for loss in result.losses]
        facts = {"tables": tables, "dialect": asdict(result.dialect), "losses": losses}
        facts["lengths"] = [array.size for array in arrays]
    else:
        text = Message(result.message, result.key, result.fields, result.hint or "")
        facts = {"error": _text(text)}
    head = json.dumps(facts, default=str).encode()
    for part in (len(head).to_bytes(_WIDTH, "little"), head.ljust(-(-len(head) // 8) * 8)):
        pipe.write(part)
    for array in arrays:
        pipe.write(np.ascontiguousarray(array, float).data)


def received(data: bytearray, path: Path) -> Source:
    """What `send` wrote of a file; its numbers stay where they are in ``data``.

    Raises:
        LogError: the reader refused the file.
    """
    size = int.from_bytes(data[:_WIDTH], "little")
    facts = json.loads(bytes(data[_WIDTH : _WIDTH + size]))
    if error := facts.get("error"):
        raise LogError(Message(**error), file=path)
    rest = np.frombuffer(data, float, offset=_WIDTH + -(-size // 8) * 8)
    arrays = iter(np.split(rest, np.cumsum(facts["lengths"])))
    tables = []
    for table in facts["tables"]:
        columns = []
        for column in table["columns"]:
            odd = {int(row): cell for row, cell in column["odd"].items()}
            doubt = column["doubt"] and (column["doubt"][0], Message(**column["doubt"][1]))
            about = (column["unit"], odd, doubt)
            columns.append(SourceColumn(column["name"], next(arrays), *about))
        t = next(arrays) if table["timed"] else None
        about = (table["began"], table["lines"], table["words"], table["daytime"])
        tables.append(SourceTable(table["name"], tuple(columns), t, *about))
    losses = tuple(Message(**loss) for loss in facts["losses"])
    return Source(tuple(tables), Dialect(**facts["dialect"]), losses)


def _text(text: str) -> dict[str, Any]:
    """A sentence with its key and fields."""
    fields = dict(getattr(text, "fields", {}))
    about = {"key": getattr(text, "key", ""), "hint": getattr(text, "hint", "")}
    return {"text": str(text), "fields": fields, **about}


def _table(table: SourceTable, arrays: list[np.ndarray]) -> dict[str, Any]:
    """The facts of a table; its numbers go to ``arrays``."""
    columns = []
    for column in table.columns:
        arrays.append(column.values)
        doubt = column.doubt and (column.doubt[0], _text(column.doubt[1]))
        facts = {"name": column.name, "unit": column.unit, "odd": dict(column.odd)}
        columns.append({**facts, "doubt": doubt})
    if table.t is not None:
        arrays.append(table.t)
    return {
        "name": table.name,
        "columns": columns,
        "timed": table.t is not None,
        "began": table.began,
        "lines": None if table.lines is None else list(table.lines),
        "words": {name: list(cells) for name, cells in table.words.items()},
        "daytime": table.daytime,
    }
