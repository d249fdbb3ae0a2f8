"""How an MCAP log is laid out: records, the head of a message, CDR."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from mcap.records import McapRecord

MAGIC = b"\x89MCAP0\r\n"
FORMAT = "1"
# an attachment and not only a metadata record, because attachments carry a CRC
FACTS = "ehbench/facts.json"

# opcodes of records
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX = range(1, 8)
ATTACHMENT, METADATA, DATA_END = 0x09, 0x0C, 0x0F

CDR_LITTLE_ENDIAN = 0x0100  # bytes 00 01 00 00
CDR_TYPES = {
    **{"bool": "u1", "byte": "u1", "char": "u1", "float32": "<f4", "float64": "<f8"},
    **{f"int{8 * size}": f"<i{size}" for size in (1, 2, 4, 8)},
    **{f"uint{8 * size}": f"<u{size}" for size in (1, 2, 4, 8)},
}

MESSAGE_HEAD = [
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
    ("cdr", "<u4"),
]
HEAD_SIZE = np.dtype(MESSAGE_HEAD).itemsize


def pack(record: McapRecord) -> bytes:
    """A record as it lies in the file."""
    from mcap.data_stream import RecordBuilder

    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def unpack(kind: Any, raw: bytes) -> Any:
    """A record of that kind from its bytes, behind opcode and length.

    Raises:
        ValueError: it is longer or shorter than its bytes."""
    from mcap.data_stream import ReadDataStream

    stream = ReadDataStream(io.BytesIO(raw))
    record = kind.read(stream)
    if stream.count != len(raw):
        raise ValueError
    return record
