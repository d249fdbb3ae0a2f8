"""A table of columns as Parquet, a stretch of rows at a time: plain pages, no compression, no
library. The format's field numbers are those of parquet.thrift.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

_INT64, _DOUBLE, _BYTES = 2, 5, 6  # physical types
_I32, _I64, _BINARY, _LIST, _STRUCT = 5, 6, 8, 9, 12  # of the thrift compact protocol
_UTF8, _PLAIN, _RLE = 0, 0, 3
KINDS = {"int": _INT64, "float": _DOUBLE, "text": _BYTES}


class Parquet:
    """A Parquet file being written.

    Args:
        path: of the file.
        columns: (name, ``int``, ``float`` or ``text``) of each; none may be missing in a row.
    """

    def __init__(self, path: Path, columns: Sequence[tuple[str, str]]) -> None:
        self._columns = columns
        self._file = path.open("wb")
        self._at = self._file.write(b"PAR1")
        self._groups: list[bytes] = []
        self._rows = 0

    def add(self, columns: Sequence[Sequence]) -> None:
        """A stretch of rows, column by column."""
        count, chunks, size = len(columns[0]), [], 0
        for (name, kind), values in zip(self._columns, columns, strict=True):
            data = _plain(kind, values)
            sizes = [(1, _I32, 0), (2, _I32, len(data)), (3, _I32, len(data))]
            page = [(1, _I32, count), (2, _I32, _PLAIN), (3, _I32, _RLE), (4, _I32, _RLE)]
            head = _struct([*sizes, (5, _STRUCT, _struct(page))])
            start, whole = self._at, len(head) + len(data)
            self._at += self._file.write(head) + self._file.write(data)
            about = [
                (1, _I32, KINDS[kind]),
                (2, _LIST, _list(_I32, [_zigzag(_PLAIN)])),
                (3, _LIST, _list(_BINARY, [_bytes(name.encode())])),
                (4, _I32, 0),
                (5, _I64, count),
                (6, _I64, whole),
                (7, _I64, whole),
                (9, _I64, start),
            ]
            chunks.append(_struct([(2, _I64, start), (3, _STRUCT, _struct(about))]))
            size += whole
        rows = [(1, _LIST, _list(_STRUCT, chunks)), (2, _I64, size), (3, _I64, count)]
        self._groups.append(_struct(rows))
        self._rows += count

    def close(self) -> None:
        """Write the footer, without which nothing of the file can be read."""
        schema = [_struct([(4, _BINARY, b"rows"), (5, _I32, len(self._columns))])]
        for name, kind in self._columns:
            fields = [(1, _I32, KINDS[kind]), (3, _I32, 0), (4, _BINARY, name.encode())]
            schema.append(_struct(fields + ([(6, _I32, _UTF8)] if kind == "text" else [])))
        footer = _struct(
            [
                (1, _I32, 1),
                (2, _LIST, _list(_STRUCT, schema)),
                (3, _I64, self._rows),
                (4, _LIST, _list(_STRUCT, self._groups)),
                (6, _BINARY, b"ehbench"),
            ]
        )
        self._file.write(footer + struct.pack("<I", len(footer)) + b"PAR1")
        self._file.close()


def _plain(kind: str, values: Sequence) -> bytes:
    """Values one after the other, texts behind their lengths."""
    if kind == "text":
        texts = [str(value).encode() for value in values]
        return b"".join(struct.pack("<I", len(text)) + text for text in texts)
    return np.asarray(values, "<i8" if kind == "int" else "<f8").tobytes()


def _varint(number: int) -> bytes:
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


def _zigzag(number: int) -> bytes:
    return _varint(2 * number if number >= 0 else -2 * number - 1)


def _bytes(text: bytes) -> bytes:
    return _varint(len(text)) + text


def _list(kind: int, items: Sequence[bytes]) -> bytes:
    """A list in the compact protocol, its items written already."""
    head = bytes([len(items) << 4 | kind]) if len(items) < 15 else bytes([0xF0 | kind])
    return head + (b"" if len(items) < 15 else _varint(len(items))) + b"".join(items)


def _struct(fields: Sequence[tuple[int, int, int | bytes]]) -> bytes:
    """A structure in the compact protocol: (field number, kind, number or bytes) in order."""
    out, last = bytearray(), 0
    for number, kind, value in fields:
        out.append((number - last) << 4 | kind)
        last = number
        if isinstance(value, int):
            out += _zigzag(value)
        else:
            out += _bytes(value) if kind == _BINARY else value
    return bytes(out + b"\0")
