"""JSON by pandas: records, one a line or in an array, or an object of columns; read on as text."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from ehbench.data.readers.delimited import tables_of
from ehbench.data.readers.excel import text_line
from ehbench.data.readers.table import Dialect, Source
from ehbench.data.text import lines_of, text_of
from ehbench.vocabulary import LogError, message


def read(path: Path, dialect: Dialect) -> Source:
    """The records of a file as a table; what is nested in one is a column ``outer.inner``.

    Raises:
        LogError: no JSON, or other than records."""
    text, encoding = text_of(path, dialect.encoding)
    content, losses = _content(text)
    frame = pd.DataFrame()
    if isinstance(content, dict) and all(isinstance(item, list) for item in content.values()):
        frame = pd.DataFrame(content)
    elif isinstance(content, list) and all(isinstance(item, dict) for item in content):
        frame = pd.json_normalize(content)
    if frame.empty:
        raise LogError(message("data.no_records"))
    # pyrefly: ignore[bad-argument-type]
    rows = frame.astype(object).where(frame.notna(), None).itertuples(index=False)
    lines = [text_line(map(str, frame.columns)), *map(text_line, rows)]
    plain = Dialect("\t", ".", dialect.skip, dialect.unit_row, day_first=dialect.day_first)
    (table, *_), _ = tables_of(lines, plain)
    known = Dialect(encoding=encoding, day_first=dialect.day_first)
    return Source((replace(table, lines=None),), known, losses)


def _content(text: str) -> tuple[Any, tuple[str, ...]]:
    """(what stands in a text of JSON, or in each of its lines; notes on lines that are none)."""
    try:
        return json.loads(text), ()
    except ValueError as error:
        records, losses = [], []
        for number, line in enumerate(lines_of(text), 1):
            try:
                records += [json.loads(line)] if line.strip() else []
            except ValueError:
                losses.append(message("data.no_json_line", line=number))
        if len(records) <= len(losses):
            raise error
        return records, tuple(losses)
