"""What a reader gives, from a child process to the one that waits for it: facts as JSON, then the
numbers as they lie in memory. Nothing of it is code."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ehbench.data.readers.table import Dialect, Source, SourceColumn, SourceTable
from ehbench.vocabulary import EhbenchError, LogError, Message

_CLASSES = {kind.__name__: kind for kind in (Source, SourceTable, SourceColumn, Dialect)}
_WIDTH = np.dtype(float).itemsize


def send(pipe: BinaryIO, result: Source | EhbenchError) -> None:
    """Write what a reader gave."""
    arrays: list[np.ndarray] = []
    if isinstance(result, EhbenchError):
        text = Message(result.message, result.key, result.fields, result.hint or "")
        facts = {"error": _plain(text, arrays)}
    else:
        facts = {"source": _plain(result, arrays)}
    head = json.dumps({**facts, "lengths": [array.size for array in arrays]}, default=str).encode()
    pipe.write(len(head).to_bytes(_WIDTH, "little"))
    pipe.write(head.ljust(-(-len(head) // _WIDTH) * _WIDTH))
    for array in arrays:
        pipe.write(np.ascontiguousarray(array, float).data)


def received(data: bytearray, path: Path) -> Source:
    """What `send` wrote of a file; its numbers stay where they are in ``data``.

    Raises:
        LogError: the reader refused the file."""
    size = int.from_bytes(data[:_WIDTH], "little")
    facts = json.loads(bytes(data[_WIDTH : _WIDTH + size]))
    rest = np.frombuffer(data, float, offset=_WIDTH + -(-size // _WIDTH) * _WIDTH)
    arrays = iter(np.split(rest, np.cumsum(facts["lengths"], dtype=int)))
    if error := facts.get("error"):
        raise LogError(_whole(error, arrays), file=path)
    return _whole(facts["source"], arrays)


def _plain(value: Any, arrays: list[np.ndarray]) -> Any:
    """A value as JSON has it; its arrays of numbers go to ``arrays``."""
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return {"array": value.size}
    if isinstance(value, Message):
        about = (str(value), value.key, value.fields, value.hint)
        return {"message": [_plain(item, arrays) for item in about]}
    if type(value) in _CLASSES.values():
        items = [_plain(getattr(value, item.name), arrays) for item in fields(value)]
        return {"class": type(value).__name__, "fields": items}
    if isinstance(value, Mapping):
        return {"mapping": [[_plain(key, arrays), _plain(value[key], arrays)] for key in value]}
    if isinstance(value, (tuple, list, range)):
        return [_plain(item, arrays) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def _whole(value: Any, arrays: Iterator[np.ndarray]) -> Any:
    """A value again, from what `_plain` made of it."""
    if isinstance(value, list):
        return tuple(_whole(item, arrays) for item in value)
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return next(arrays)
    if "message" in value:
        return Message(*_whole(value["message"], arrays))
    if "class" in value:
        return _CLASSES[value["class"]](*_whole(value["fields"], arrays))
    return {_whole(key, arrays): _whole(item, arrays) for key, item in value["mapping"]}
