"""What can be read of an MCAP file, and what cannot: damage is named, never passed on as data."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self
from zlib import crc32

import numpy as np

from ehbench.data.logs.layout import (
    ATTACHMENT,
    CDR_LITTLE_ENDIAN,
    CDR_TYPES,
    CHANNEL,
    CHUNK,
    DATA_END,
    FACTS,
    HEAD_SIZE,
    HEADER,
    INDEX,
    MAGIC,
    MESSAGE,
    METADATA,
    SCHEMA,
    unpack,
)
from ehbench.data.record import floats
from ehbench.data.text import head_of
from ehbench.vocabulary import VOCABULARY, message

if TYPE_CHECKING:
    from mcap.records import Channel, Schema


# a chunk may unpack to anything: [bytes] that a file may unpack to beside so many times its size
LEAST_ROOM = 64 * 2**20
MOST_PACKED = 200
HEADS = (0, 3)  # where eight bytes each hold a message's opcode, length and channel, eleven in all
SCATTERED = 8  # a pattern of messages that repeats less often is read message by message


@dataclass
class Stream:
    """One channel while reading: message layout, labels of its fields (field → ``boom.p_head
    [Pa]``), and the values found, shape (fields, room)."""

    topic: str
    layout: np.dtype
    labels: dict[str, str]
    numbered: bool
    table: np.ndarray
    size: int = 0
    sequences: list[np.ndarray] = field(default_factory=list)
    stamps: list[np.ndarray] = field(default_factory=list)

    @classmethod
    def of(cls, schema: Schema | None, channel: Channel, size: int) -> Self | None:
        """That of a channel in a file of so many bytes, None when it cannot be read.

        CDR aligns each number to its own size, counted from the end of the four bytes that say
        which CDR it is."""
        if schema is None or schema.encoding != "ros2msg" or channel.message_encoding != "cdr":
            return None
        names, offsets = ["#sequence", "#log_time", "#cdr"], [11, 15, 31]
        formats: list[str | np.dtype] = ["<u4", "<u8", "<u4"]
        labels: dict[str, str] = {}
        end = 0
        for text in schema.data.decode().splitlines():
            code, _, comment = text.partition("#")
            words = code.split()
            if not words or "=" in code and words[0] in CDR_TYPES:
                continue
            if words[0] not in CDR_TYPES or len(words) < 2:
                return None
            kind = np.dtype(CDR_TYPES[words[0]])
            end += -end % kind.itemsize
            named = words[1] in channel.metadata
            label = channel.metadata.get(words[1], comment.strip())
            name, unit = head_of(label)
            known = name.rpartition(".")[2] in VOCABULARY
            if (known or named) and (known and named or unit):
                labels[words[1]] = label
                names.append(words[1])
                formats.append(kind)
                offsets.append(HEAD_SIZE + end)
            end += kind.itemsize
        if all(head_of(label)[0] == "t" for label in labels.values()):
            return None
        layout = np.dtype(
            {"names": names, "formats": formats, "offsets": offsets, "itemsize": HEAD_SIZE + end}
        )
        # a guess that saves copies; pages never touched cost nothing
        table = np.empty((len(labels), min(2 * size // layout.itemsize, 1 << 20)))
        return cls(channel.topic, layout, labels, "ehbench" in channel.metadata, table)

    def add(self, messages: np.ndarray) -> None:
        """Append messages of this layout."""
        stop = self.size + messages.size
        if stop > self.table.shape[1]:
            grown = np.empty((len(self.labels), 2 * stop))
            grown[:, : self.size] = self.table[:, : self.size]
            self.table = grown
        for out, name in zip(self.table, self.labels):
            out[self.size : stop] = floats(messages[name])
        self.size = stop
        self.sequences.append(messages["#sequence"].copy())
        self.stamps.append(messages["#log_time"].copy())


class Salvage:
    """What can be read of one MCAP file, and what cannot."""

    def __init__(self, data: bytes) -> None:
        import zstandard
        from mcap.exceptions import McapError

        # what the libraries below raise on bytes that are not what they claim to be
        too_large = (OverflowError, MemoryError, RecursionError)
        libraries = (struct.error, McapError, zstandard.ZstdError)
        self.broken = (ValueError, LookupError, *too_large, *libraries)
        self.zstd, self.unpacker = zstandard, zstandard.ZstdDecompressor()
        self.data = data
        self.streams: dict[int, Stream] = {}
        self.unread: dict[str, None] = {}
        self.meta: dict[str, str] = {}
        self.facts: dict = {}
        self.attachments: dict[str, bytes] = {}
        self.damage: list[str] = []
        self.closed = False
        self.schemas: dict[int, Schema] = {}
        self._seen: set[bytes] = set()
        self._loose = bytearray()
        self._chunks = 0
        self._most = self._room = LEAST_ROOM + MOST_PACKED * len(data)
        data, size = self.data, len(self.data)
        pos = len(MAGIC) if data.startswith(MAGIC) else self._skip(0, message("data.no_mcap_head"))
        while pos < size and not self.closed:
            opcode, length = struct.unpack_from("<BQ", data, pos) if pos + 9 <= size else (0, size)
            start, stop = pos + 9, pos + 9 + length
            if stop > size:
                pos = self._skip(pos, message("data.record_too_long"))
                continue
            try:
                self._take(opcode, start, stop)
            except self.broken as error:
                named = isinstance(error, Unreadable)
                why = str(error) if named else message("data.broken_record")
                if opcode in (CHUNK, ATTACHMENT) and self._framed(opcode, start, stop):
                    self._lose(pos, stop, why)
                else:
                    stop = self._skip(pos, why)
            pos = stop
        sums = (bytes(4), crc32(data[pos:-12]).to_bytes(4, "little"))
        if self.closed and not (data.endswith(MAGIC) and data[-12:-8] in sums):
            self.damage.append(message("data.broken_index"))
        if self._loose and not self._chunks:
            try:
                self._body(bytes(self._loose))
            except self.broken as error:
                self.damage.append(message("data.broken_messages", error=error))

    def _skip(self, pos: int, why: str) -> int:
        """Note that the bytes from ``pos`` to the next chunk are lost; return where that chunk
        begins."""
        data, size = self.data, len(self.data)
        nxt, at = size, pos
        while (at := data.find(b"\x04\x00\x00\x00zstd", at + 1)) >= 0:
            start = at - 28
            if start - 9 > pos and data[start - 9] == CHUNK:
                stop = start + struct.unpack_from("<Q", data, start - 8)[0]
                if stop <= size and self._framed(CHUNK, start, stop):
                    nxt = start - 9
                    break
        self._lose(pos, nxt, why)
        return nxt

    def _lose(self, first: int, last: int, why: str) -> None:
        size = len(self.data)
        self.damage.append(message("data.bytes_lost", first=first, last=last, size=size, why=why))

    def _framed(self, opcode: int, start: int, stop: int) -> bool:
        """Whether the inner lengths of a chunk or attachment agree with the record's length."""
        from mcap.records import Attachment, Chunk

        try:
            unpack(Chunk if opcode == CHUNK else Attachment, self.data[start:stop])
        except self.broken:
            return False
        return True

    def _take(self, opcode: int, start: int, stop: int) -> None:
        """Read one record of the data section; raises what ``broken`` lists when it is damaged."""
        from mcap.records import Attachment, Header, Metadata

        data = self.data
        if opcode == CHUNK:
            self._chunks += 1
            self._chunk(start, stop)
        elif opcode == INDEX:
            if stop - start != 6 + struct.unpack_from("<I", data, start + 2)[0]:
                raise ValueError
        elif opcode == ATTACHMENT:
            (crc,) = struct.unpack_from("<I", data, stop - 4)
            if crc not in (0, crc32(data[start : stop - 4])):
                raise Unreadable(message("data.attachment_checksum"))
            record = unpack(Attachment, data[start:stop])
            if record.name == FACTS:
                self.facts = _facts(record.data)
            else:
                self.attachments[record.name] = record.data
        elif opcode == METADATA:
            record = unpack(Metadata, data[start:stop])
            if record.name != "ehbench":
                self.meta |= {f"{record.name}.{key}": x for key, x in record.metadata.items()}
        elif opcode in (SCHEMA, CHANNEL, MESSAGE):
            self._loose += data[start - 9 : stop]
        elif opcode == DATA_END:
            (crc,) = struct.unpack("<I", data[start:stop])
            self.closed = True
            if crc and not self.damage and crc != crc32(memoryview(data)[: start - 9]):
                self.damage.append(message("data.file_checksum"))
        elif opcode == HEADER:
            unpack(Header, data[start:stop])
        elif opcode < 0x80:
            raise ValueError

    def _chunk(self, start: int, stop: int) -> None:
        from mcap.records import Chunk

        chunk = unpack(Chunk, self.data[start:stop])
        body, size = chunk.data, chunk.uncompressed_size
        if chunk.compression == "zstd":
            if self.zstd.frame_content_size(body) not in (-1, size):
                raise Unreadable(message("data.chunk_sizes"))
            if size > self._room:
                raise Unreadable(message("data.chunks_too_large", limit=self._most / 1e6))
            self._room -= size
            body = self.unpacker.decompress(body, size)
        elif chunk.compression:
            raise Unreadable(message("data.chunk_compression", kind=chunk.compression))
        if chunk.uncompressed_crc not in (0, crc32(body)):
            raise Unreadable(message("data.chunk_checksum"))
        self._body(body)

    def _body(self, body: bytes) -> None:
        """Read the records of a chunk: runs of equally laid out messages at a time."""
        from mcap.records import Channel, Schema

        pos = 0
        while pos < len(body):
            opcode, length = struct.unpack_from("<BQ", body, pos)
            if opcode == MESSAGE:
                pos = self._run(body, pos)
                continue
            raw = body[pos : pos + 9 + length]
            pos += 9 + length
            if raw in self._seen or opcode not in (SCHEMA, CHANNEL):
                continue
            if opcode == SCHEMA:
                schema = unpack(Schema, raw[9:])
                self.schemas[schema.id] = schema
            else:
                channel = unpack(Channel, raw[9:])
                schema = self.schemas.get(channel.schema_id)
                if (stream := Stream.of(schema, channel, len(self.data))) is not None:
                    self.streams[channel.id] = stream
                else:
                    kind = f", {schema.name}" if schema else ""
                    encoding = channel.message_encoding or "no encoding"
                    self.unread[f"{channel.topic} ({encoding}{kind})"] = None
                    self.streams.pop(channel.id, None)
            self._seen.add(raw)

    def _run(self, body: bytes, pos: int) -> int:
        """Read messages from ``pos`` as long as one pattern of channels repeats; return where it
        ends."""
        pattern: dict[int, tuple[int, int]] = {}
        at = pos
        while at < len(body) and body[at] == MESSAGE:
            _, length, id = struct.unpack_from("<BQH", body, at)
            if id in pattern:
                break
            if length < 22 or at + 9 + length > len(body):
                raise ValueError
            pattern[id] = (at - pos, length)
            at += 9 + length
        stride = at - pos
        maximum = (len(body) - pos) // stride
        heads = [
            np.ndarray(maximum, "<u8", body, pos + offset + part, (stride,))
            for offset, _ in pattern.values()
            for part in HEADS
        ]
        count, block = 0, 256  # messages with the opcodes, lengths and channels of the first
        while count < maximum:
            same = np.ones(min(block, maximum - count), bool)
            for head in heads:
                same &= head[count : count + block] == head[0]
            count, block = count + int(np.argmin(np.append(same, False))), 4 * block
            if not same.all():
                break
        if count < SCATTERED < maximum:
            return self._scattered(body, pos)
        for id, (offset, length) in pattern.items():
            stream = self.streams.get(id)
            if stream is None:
                continue
            if 9 + length < stream.layout.itemsize:
                raise _short(stream)
            messages = np.ndarray(count, stream.layout, body, pos + offset, (stride,))
            self._take_messages(stream, messages)
        return pos + stride * count

    def _scattered(self, body: bytes, pos: int) -> int:
        """Read a stretch of messages from ``pos`` whose channels follow one another in no pattern;
        return where it ends."""
        places: dict[int, list[int]] = {}
        end = min(len(body), pos + (1 << 20))
        while pos < end and body[pos] == MESSAGE:
            _, length, id = struct.unpack_from("<BQH", body, pos)
            stop, stream = pos + 9 + length, self.streams.get(id)
            if length < 22 or stop > len(body):
                raise ValueError
            if stream is not None:
                if stop - pos < stream.layout.itemsize:
                    raise _short(stream)
                places.setdefault(id, []).append(pos)
            pos = stop
        whole = np.frombuffer(body, np.uint8)
        for id, starts in places.items():
            stream = self.streams[id]
            bytes_of = np.add.outer(np.array(starts), np.arange(stream.layout.itemsize))
            self._take_messages(stream, whole[bytes_of].view(stream.layout)[:, 0])
        return pos

    @staticmethod
    def _take_messages(stream: Stream, messages: np.ndarray) -> None:
        if ((messages["#cdr"] & 0xFFFF) != CDR_LITTLE_ENDIAN).any():
            raise Unreadable(message("data.message_not_cdr", topic=stream.topic))
        stream.add(messages)


def _short(stream: Stream) -> Unreadable:
    return Unreadable(message("data.short_message", topic=stream.topic))


class Unreadable(ValueError):
    """Damage that has a name."""


def _facts(data: bytes) -> dict[str, Any]:
    """A run's facts as a log holds them: lists of texts and a table of texts.

    Raises:
        ValueError: they are anything else."""
    facts = json.loads(data)
    if not isinstance(facts, dict):
        raise ValueError
    lists, meta = [facts["channels"], facts["losses"]], facts["meta"]
    if not isinstance(meta, dict) or not all(isinstance(each, list) for each in lists):
        raise ValueError
    if not all(isinstance(text, str) for each in (*lists, meta.values()) for text in each):
        raise ValueError
    return facts
