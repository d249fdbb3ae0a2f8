"""MCAP logs written crash-safe: what was flushed can be read, however the process ends."""

from __future__ import annotations

import json
import os
import re
import struct
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
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

    from mcap.records import McapRecord

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


@dataclass(frozen=True)
class _Topic:
    """One topic while writing: its channel id, the columns it takes, its schema and channel
    records, its message layout."""

    id: int
    columns: np.ndarray
    schema: McapRecord
    channel: McapRecord
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
        meta, attachments = dict(meta or {}), dict(attachments or {})
        if FACTS in attachments:
            raise LogError(message("data.attachment_taken", name=FACTS), file=path)
        self._topics = _topics(self.channels, _groups(self.channels, groups, path))
        self._prefix = b"".join(
            pack(record)
            for topic in self._topics.values()
            for record in (topic.schema, topic.channel)
        )
        self._compress = ZstdCompressor().compress
        self._crc = self._offset = self._shift = 0
        self._count = {topic.id: 0 for topic in self._topics.values()}
        self._last = {topic.id: -np.inf for topic in self._topics.values()}
        self._indexes: list[McapRecord] = []
        self._chunks: list[McapRecord] = []
        self._span: tuple[int, int] | None = None
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
            self._head(meta, attachments, losses)
            self._maybe_sync()
        except BaseException:
            with suppress(OSError):  # a full disk takes no more of it now either
                self._file.close()
            raise

    def _head(
        self, meta: dict[str, str], attachments: dict[str, bytes], losses: Sequence[str]
    ) -> None:
        """Write what stands before the samples."""
        from mcap.records import Attachment, AttachmentIndex, Header, Metadata, MetadataIndex

        self._write(MAGIC + pack(Header("ros2", "ehbench")))
        record = Metadata("ehbench", meta)
        self._indexes.append(MetadataIndex(self._offset, self._write(pack(record)), record.name))
        facts = {"channels": self.channels, "losses": list(losses), "meta": meta}
        for name, data in {FACTS: json.dumps(facts, indent=1).encode(), **attachments}.items():
            kind = _MEDIA.get(Path(name).suffix, "application/octet-stream")
            offset = self._offset
            length = self._write(pack(Attachment(0, 0, name, kind, data)))
            self._indexes.append(AttachmentIndex(offset, length, 0, 0, len(data), name, kind))

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
        width = len(self.channels) if topic is None else topics[0].columns.size
        if values.shape != (t.size, width):
            raise ValueError(f"values have the shape {values.shape}, not {(t.size, width)}")
        if not t.size:
            return
        before = max(self._last[each.id] for each in topics)
        if not (np.isfinite(t).all() and np.abs(t).max() < _LATEST):
            raise LogError(message("data.no_usable_time"), file=self.path)
        check_time(t if before == -np.inf else np.concatenate([[before], t]), file=self.path)
        for each in topics:
            self._last[each.id] = float(t[-1])
        row = np.dtype([(str(each.id), each.layout) for each in topics])
        done = 0
        while done < t.size:
            if t[done] - self._begin >= CHUNK_TIME:
                self._finish_chunk()
            begin = self._begin if self._entries else float(t[done])
            fit = done + max(1, (self._most - self._size) // row.itemsize)
            stop = min(fit, int(np.searchsorted(t, begin + CHUNK_TIME)), t.size)
            stop = max(stop, done + 1)
            self._begin = begin
            self._add(topics, row, t[done:stop], values[done:stop], selected=topic is not None)
            done = stop
            if self._size + row.itemsize > self._most:
                self._finish_chunk()
        self._maybe_sync()

    def _add(
        self, topics: list[_Topic], row: np.dtype, t: np.ndarray, values: np.ndarray, selected: bool
    ) -> None:
        stamps = np.rint(t * 1e9).astype(np.int64)
        if self._span is None:  # MCAP has no time below zero; the field t keeps it
            self._shift = max(0, -int(stamps[0]))
        stamps = (stamps + self._shift).clip(0).astype(np.uint64)
        first, last = int(stamps[0]), int(stamps[-1])
        before = self._span or (first, last)
        self._span = min(first, before[0]), max(last, before[1])
        self._chunk_span = (min(first, self._chunk_span[0]), max(last, self._chunk_span[1]))
        rows = np.zeros(t.size, row)
        places: Any = row.fields
        for topic in topics:
            part, start = rows[str(topic.id)], places[str(topic.id)][1]
            count = self._count[topic.id]
            part["opcode"] = MESSAGE
            part["length"] = topic.layout.itemsize - 9
            part["channel"] = topic.id
            part["sequence"] = np.arange(count, count + t.size) & 0xFFFFFFFF
            part["log_time"] = part["publish_time"] = stamps
            part["cdr"] = CDR_LITTLE_ENDIAN
            part["data"][:, 0] = t
            part["data"][:, 1:] = values if selected else values[:, topic.columns]
            self._count[topic.id] = count + t.size
            index = np.empty((t.size, 2), "<u8")
            index[:, 0] = stamps
            index[:, 1] = self._size + start + row.itemsize * np.arange(t.size)
            self._entries.setdefault(topic.id, []).append(index.tobytes())
        self._body.append(rows.tobytes())
        self._size += rows.nbytes

    def _new_chunk(self) -> None:
        self._body: list[bytes] = [self._prefix]
        self._size = len(self._prefix)
        self._entries: dict[int, list[bytes]] = {}
        self._chunk_span = (2**64, 0)
        self._begin = np.inf  # [s] time of its first sample

    def _finish_chunk(self) -> None:
        from mcap.records import Chunk, ChunkIndex

        if not self._entries:
            return
        body, (first, last) = b"".join(self._body), self._chunk_span
        packed = self._compress(body)
        offset = self._offset
        length = self._write(pack(Chunk("zstd", packed, last, first, crc32(body), len(body))))
        indexes, start = {}, self._offset
        for id, parts in self._entries.items():
            entries = b"".join(parts)
            indexes[id] = self._offset
            self._write(struct.pack("<BQHI", INDEX, 6 + len(entries), id, len(entries)) + entries)
        ends, size = (last, self._offset - start, indexes, first), len(body)
        self._chunks.append(ChunkIndex(length, offset, "zstd", len(packed), *ends, size))
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
            first, last = self._span or (0, 0)
            kinds = [type(index).__name__ for index in self._indexes]
            topics = self._topics.values()
            statistics = Statistics(
                kinds.count("AttachmentIndex"),
                len(topics),
                {id: n for id, n in self._count.items() if n},
                len(self._chunks),
                sum(self._count.values()),
                last,
                first,
                kinds.count("MetadataIndex"),
                len(topics),
            )
            groups = [
                [topic.schema for topic in topics],
                [topic.channel for topic in topics],
                [statistics],
                self._chunks,
                [index for index, kind in zip(self._indexes, kinds) if kind == "AttachmentIndex"],
                [index for index, kind in zip(self._indexes, kinds) if kind == "MetadataIndex"],
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


def _groups(
    channels: Sequence[str], groups: Mapping[str, Sequence[str]] | None, path: str | Path
) -> dict[str, list[str]]:
    """Topic → channels, checked: every channel is known and in exactly one topic."""
    for name in channels:
        check_known(name, file=path)
    groups = {"/rig": channels} if groups is None else groups
    listed = [name for names in groups.values() for name in names]
    if not listed or sorted(listed) != sorted(set(channels)) or len(listed) != len(channels):
        raise LogError(message("data.topics_of_channels"), file=path)
    return {topic: list(names) for topic, names in groups.items()}


def _topics(channels: Sequence[str], groups: Mapping[str, Sequence[str]]) -> dict[str, _Topic]:
    from mcap.records import Channel, Schema

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
            np.array([channels.index(name) for name in names]),
            Schema(id, text.encode(), "ros2msg", f"ehbench/msg/{kind}"),
            Channel(id, topic, "cdr", metadata, id),
            np.dtype([*MESSAGE_HEAD, ("data", "<f8", (len(fields),))]),
        )
    return topics
