"""MCAP logs written crash-safe: what was flushed can be read, however the process ends."""

from __future__ import annotations

import json
import os
import re
import struct
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from zlib import crc32

import numpy as np

from ehbench.data.logs.checks import check_known, check_time
from ehbench.data.logs.layout import (
    CDR_LITTLE_ENDIAN,
    FACTS,
    FOOTER,
    FORMAT,
    INDEX,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    pack,
)
from ehbench.data.record import Record
from ehbench.runtime.disk import replacing
from ehbench.vocabulary import LogError, message, quantity
from ehbench.vocabulary.text import unlike

if TYPE_CHECKING:
    from typing import Self

    from mcap.records import AttachmentIndex, Channel, ChunkIndex, Schema

# a flipped bit takes one chunk: so much data, or so much time, is in one at most
CHUNK_SIZE = 64 * 1024  # [bytes], or thrice its schemas where those are large
CHUNK_TIME = 0.5  # [s]
_MEDIA = {
    ".toml": "application/toml",
    ".json": "application/json",
    ".csv": "text/csv",
    ".txt": "text/plain",
}
_LATEST = 9.2e9  # s; in ns this is the end of int64


class _Topic(NamedTuple):
    """One topic while writing: its channel id, the columns it takes, its schema and channel
    records, its message layout."""

    id: int
    columns: np.ndarray
    schema: Schema
    channel: Channel
    layout: np.dtype


class LogWriter:
    """Writes an MCAP log as the samples come, so that a killed process leaves a file that can be
    read.

    Finished chunks are flushed and synced to disk every ``sync`` seconds of wall time;
    ``sync=None`` leaves that to the end, and then the bytes depend on the samples alone; ``cut``
    says whether a sync ended a chunk before it was full, so that they do not. Use it as a context
    manager: leaving the block, also by an exception, writes the index. A file that exists is never
    overwritten.

    Args:
        path: the file to make.
        channels: names such as ``boom.p_head``; their values are SI.
        meta: the run's facts as text.
        attachments: files that travel with the log, by name.
        groups: topic → its channels, each channel in one topic; by default one topic ``/rig``,
            since all have one rate.
        sync: [s] wall time between two syncs.
        losses: what was missing already in a log that is written again.

    Raises:
        LogError: the file exists or cannot be made; a channel is unknown, doubled or in no topic.
    """

    def __init__(
        self,
        path: str | Path,
        channels: Sequence[str],
        meta: Mapping[str, str] | None = None,
        attachments: Mapping[str, bytes] | None = None,
        groups: Mapping[str, Sequence[str]] | None = None,
        *,
        sync: float | None = 1.0,
        losses: Sequence[str] = (),
    ) -> None:
        from zstandard import ZstdCompressor

        self.path = Path(path)
        self.channels = tuple(channels)
        attachments = dict(attachments or {})
        if FACTS in attachments:
            raise LogError(message("data.attachment_taken", name=FACTS), file=path)
        groups = {"/rig": self.channels} if groups is None else groups
        self._topics = _topics(self.channels, groups, path)
        ids = [topic.id for topic in self._topics.values()]
        records = [(topic.schema, topic.channel) for topic in self._topics.values()]
        self._prefix = b"".join(map(pack, chain(*records)))
        self._compress = ZstdCompressor().compress
        self._crc = self._offset = 0
        self._begin = -np.inf  # [s] time of the first sample of the chunk
        self._shift: int | None = None  # [ns] of the time that MCAP has: none of it below zero
        self._count, self._last = dict.fromkeys(ids, 0), dict.fromkeys(ids, -np.inf)
        self._attachments: list[AttachmentIndex] = []
        self._chunks: list[ChunkIndex] = []
        self.cut = False
        self._most = max(CHUNK_SIZE, 3 * len(self._prefix))
        self._new_chunk()
        try:
            self._file = open(self.path, "xb")  # noqa: SIM115
        except FileExistsError:
            raise LogError(message("data.log_exists"), file=path) from None
        except OSError as error:
            text = message("data.unwritable", reason=error.strerror)
            raise LogError(text, file=path) from error
        self._sync = sync
        self._synced = -np.inf
        try:
            self._head(dict(meta or {}), attachments, losses)
            self._maybe_sync()
        except BaseException:
            with suppress(OSError):  # a full disk takes no more of it now either
                self._file.close()
            raise

    def _head(
        self, meta: dict[str, str], attachments: dict[str, bytes], losses: Sequence[str]
    ) -> None:
        """Write what stands before the samples."""
        from mcap.records import Header, Metadata, MetadataIndex

        self._write(MAGIC + pack(Header("ros2", "ehbench")))
        self._facts = {"channels": self.channels, "losses": list(losses), "meta": meta}
        offset = self._offset
        self._metadata = MetadataIndex(
            offset, self._write(pack(Metadata("ehbench", meta))), "ehbench"
        )
        self._attach(FACTS, json.dumps(self._facts, indent=1).encode())
        for name, data in attachments.items():
            self._attach(name, data)

    def _attach(self, name: str, data: bytes) -> None:
        from mcap.records import Attachment, AttachmentIndex

        kind, offset = _MEDIA.get(Path(name).suffix, "application/octet-stream"), self._offset
        length = self._write(pack(Attachment(0, 0, name, kind, data)))
        self._attachments.append(AttachmentIndex(offset, length, 0, 0, len(data), name, kind))

    def lose(self, what: str) -> None:
        """Say what is missing from now on: the facts are written once more, and the last count."""
        self._facts["losses"].append(what)
        self._attach(FACTS, json.dumps(self._facts, indent=1).encode())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def append(self, t: float, values: Sequence[float], topic: str | None = None) -> None:
        """Add one sample: ``values`` [SI] in the order of ``channels``, or of the topic's channels.
        Errors as in `extend`."""
        self.extend(np.array([t], dtype=float), np.asarray(values, dtype=float)[None, :], topic)

    def extend(self, t: np.ndarray, values: np.ndarray, topic: str | None = None) -> None:
        """Add many samples.

        Args:
            t: [s] shape (samples,), later than all before.
            values: [SI] shape (samples, channels), in the order of ``channels``, or of one topic's
                channels.
            topic: write this topic only, when topics have different rates.

        Raises:
            LogError: the time stands still, goes back or is not finite.
            ValueError: the shapes do not match."""
        topics = list(self._topics.values()) if topic is None else [self._topics[topic]]
        t, values = np.asarray(t, dtype=float), np.asarray(values, dtype=float)
        places = {id: columns for id, columns, *_ in topics}
        if topic is not None:  # its channels alone
            places = {topics[0].id: np.arange(topics[0].columns.size)}
        width = len(self.channels) if topic is None else topics[0].columns.size
        if values.shape != (t.size, width):
            raise ValueError(f"values have the shape {values.shape}, not {(t.size, width)}")
        if not t.size:
            return
        if not (np.isfinite(t).all() and np.abs(t).max() < _LATEST):
            raise LogError(message("data.no_usable_time"), file=self.path)
        before = max(self._last[id] for id in places)
        check_time(t if before == -np.inf else np.concatenate([[before], t]), file=self.path)
        self._last |= dict.fromkeys(places, float(t[-1]))
        row = np.dtype([(str(each.id), each.layout) for each in topics])
        done = 0
        while done < t.size:
            if t[done] - self._begin >= CHUNK_TIME:
                self._finish_chunk()
            if not self._entries:
                self._begin = float(t[done])
            fit = done + (self._most - self._size) // row.itemsize
            stop = max(min(fit, int(np.searchsorted(t, self._begin + CHUNK_TIME))), done + 1)
            self._add(row, places, t[done:stop], values[done:stop])
            done = stop
            if self._size + row.itemsize > self._most:
                self._finish_chunk()
        self._maybe_sync()

    def _add(
        self, row: np.dtype, places: Mapping[int, np.ndarray], t: np.ndarray, values: np.ndarray
    ) -> None:
        """Add samples to the chunk, by the columns of each topic's id."""
        stamps = np.rint(t * 1e9).astype(np.int64)
        if self._shift is None:
            self._shift = max(0, -int(stamps[0]))
        stamps = (stamps + self._shift).clip(0).astype(np.uint64)
        rows = np.zeros(t.size, row)
        for id, columns in places.items():
            part, count = rows[str(id)], self._count[id]
            part["opcode"] = MESSAGE
            part["length"] = part.dtype.itemsize - 9
            part["channel"] = id
            part["sequence"] = np.arange(count, count + t.size) & 0xFFFFFFFF
            part["log_time"] = part["publish_time"] = stamps
            part["cdr"] = CDR_LITTLE_ENDIAN
            part["data"][:, 0] = t
            part["data"][:, 1:] = values[:, columns]
            self._count[id] = count + t.size
            start = self._size + part.ctypes.data - rows.ctypes.data
            offsets = start + row.itemsize * np.arange(t.size, dtype=np.uint64)
            entries = np.stack([stamps, offsets.astype(np.uint64)], axis=1)
            self._entries.setdefault(id, []).append(entries)
        self._body.append(rows.tobytes())
        self._size += rows.nbytes

    def _new_chunk(self) -> None:
        self._body: list[bytes] = [self._prefix]
        self._size = len(self._prefix)
        self._entries: dict[int, list[np.ndarray]] = {}  # times [ns] and places, by topic

    def _finish_chunk(self) -> None:
        from mcap.records import Chunk, ChunkIndex

        if not self._entries:
            return
        each = {id: np.concatenate(parts) for id, parts in self._entries.items()}
        first = int(min(entries[0, 0] for entries in each.values()))
        last = int(max(entries[-1, 0] for entries in each.values()))
        body = b"".join(self._body)
        packed, offset = self._compress(body), self._offset
        length = self._write(pack(Chunk("zstd", packed, last, first, crc32(body), len(body))))
        indexes, start = {}, self._offset
        for id, entries in each.items():
            indexes[id], size = self._offset, entries.nbytes
            self._write(struct.pack("<BQHI", INDEX, 6 + size, id, size) + entries.tobytes())
        ends = (last, self._offset - start, indexes, first)
        self._chunks.append(ChunkIndex(length, offset, "zstd", len(packed), *ends, len(body)))
        self._new_chunk()

    def _maybe_sync(self) -> None:
        if self._sync is not None and time.monotonic() - self._synced >= self._sync:
            self.flush()
            self._synced = time.monotonic()

    def flush(self) -> None:
        """Bring all samples so far to the disk."""
        self.cut |= bool(self._entries)
        self._finish_chunk()
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Write what is left and the index, and close the file; closing twice does nothing."""
        from mcap.records import DataEnd, Statistics, SummaryOffset

        if self._file.closed:
            return
        try:
            self._finish_chunk()
            self._write(pack(DataEnd(self._crc)))
            topics, chunks = self._topics.values(), self._chunks
            statistics = Statistics(
                attachment_count=len(self._attachments),
                channel_count=len(topics),
                channel_message_counts={id: n for id, n in self._count.items() if n},
                chunk_count=len(chunks),
                message_count=sum(self._count.values()),
                message_end_time=max((chunk.message_end_time for chunk in chunks), default=0),
                message_start_time=min((chunk.message_start_time for chunk in chunks), default=0),
                metadata_count=1,
                schema_count=len(topics),
            )
            groups = [
                [topic.schema for topic in topics],
                [topic.channel for topic in topics],
                [statistics],
                chunks,
                self._attachments,
                [self._metadata],
            ]
            start, summary, offsets = self._offset, b"", b""
            for packed in (b"".join(map(pack, group)) for group in groups if group):
                offsets += pack(SummaryOffset(packed[0], start + len(summary), len(packed)))
                summary += packed
            footer = struct.pack("<BQQQ", FOOTER, 20, start, start + len(summary))
            tail = summary + offsets + footer
            self._write(tail + struct.pack("<I", crc32(tail)) + MAGIC)
            self._file.flush()
            os.fsync(self._file.fileno())
        finally:
            self._file.close()

    def _write(self, data: bytes) -> int:
        self._file.write(data)
        self._crc = crc32(data, self._crc)
        self._offset += len(data)
        return len(data)


def write_log(path: str | Path, record: Record) -> None:
    """Write a whole record as MCAP, under a temporary name until it is complete; the same record
    gives the same bytes.

    Raises:
        LogError: a channel is unknown, the time does not increase, or the file cannot be written.
    """
    path = Path(path)
    columns = list(record.channels.values())
    try:
        with (
            replacing(path) as part,
            LogWriter(
                part,
                list(record.channels),
                record.meta,
                record.attachments,
                sync=None,
                losses=record.losses,
            ) as writer,
        ):
            for start in range(0, record.t.size, 1 << 15):
                block = slice(start, start + (1 << 15))
                writer.extend(record.t[block], np.stack([each[block] for each in columns], axis=1))
    except LogError as error:
        raise type(error)(error.message, file=path, hint=error.hint) from error
    except OSError as error:
        text = message("data.unwritable", reason=error.strerror)
        raise LogError(text, file=path) from error


def _topics(
    channels: Sequence[str], groups: Mapping[str, Sequence[str]], path: str | Path
) -> dict[str, _Topic]:
    """Topics by name; every channel is known and in exactly one of them.

    Raises:
        LogError: it is not."""
    from mcap.records import Channel, Schema

    for name in channels:
        check_known(name, file=path)
    listed = sorted(name for names in groups.values() for name in names)
    if not listed or listed != sorted(set(channels)) or len(listed) != len(channels):
        raise LogError(message("data.topics_of_channels"), file=path)
    topics, types = {}, set()
    for id, (topic, names) in enumerate(groups.items(), 1):
        word = topic.strip("/").replace("/", ".")
        fields = ["t"]
        for name in names:  # letters a to z first, then letters, digits and single underscores
            plain = re.sub(r"[^a-z0-9]+", "_", name.removeprefix(word + ".").lower()).strip("_")
            plain = plain if plain[:1].isalpha() else f"c_{plain}".rstrip("_")
            fields.append(unlike(plain, fields))
        labels = ["t [s]", *(f"{name} [{quantity(name).unit}]" for name in names)]
        words = [part.capitalize() for part in re.findall(r"[A-Za-z0-9]+", topic)]
        kind = "".join(words) if words and words[0][0].isalpha() else "T" + "".join(words)
        kind = unlike(kind, types, "")
        types.add(kind)
        text = "".join(f"float64 {name}  # {label}\n" for name, label in zip(fields, labels))
        metadata = {"ehbench": FORMAT, "offered_qos_profiles": "", **dict(zip(fields, labels))}
        topics[topic] = _Topic(
            id,
            np.array([channels.index(name) for name in names], int),
            Schema(id, text.encode(), "ros2msg", f"ehbench/msg/{kind}"),
            Channel(id, topic, "cdr", metadata, id),
            np.dtype([*MESSAGE_HEAD, ("data", "<f8", (len(fields),))]),
        )
    return topics
