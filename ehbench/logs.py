"""Logs on disk: MCAP written crash-safe, MCAP and CSV read into a `Record`, damage named and never
passed on as data.

The MCAP holds one topic a rate group, messages in little-endian CDR of float64 fields described by
a ros2msg schema. Every chunk repeats its schemas and channels and carries a CRC, so each one can be
read without the others."""

from __future__ import annotations

import io
import json
import os
import re
import struct
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from ehbench.errors import LogError, UnitError
from ehbench.quantities import VOCABULARY, quantity
from ehbench.record import Record
from ehbench.units import from_si, to_si

if TYPE_CHECKING:
    from typing import Self

    import pandas as pd
    from mcap.records import McapRecord

MAGIC = b"\x89MCAP0\r\n"
CHUNK_SIZE = 256 * 1024
FORMAT = "1"
_FACTS = "ehbench/facts.json"  # an attachment and not only a metadata record, because attachments carry a CRC
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX, _ATTACHMENT, _METADATA, _DATA_END = (
    0x01,
    0x02,
    0x03,
    0x04,
    0x05,
    0x06,
    0x07,
    0x09,
    0x0C,
    0x0F,
)
_MESSAGE_HEAD = [
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
    ("cdr", "<u4"),
]
_HEAD_SIZE = np.dtype(_MESSAGE_HEAD).itemsize
_CDR_LITTLE_ENDIAN = 0x0100  # bytes 00 01 00 00
_CDR_TYPES = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "<i2",
    "uint16": "<u2",
    "int32": "<i4",
    "uint32": "<u4",
    "int64": "<i8",
    "uint64": "<u8",
    "float32": "<f4",
    "float64": "<f8",
}
_MEDIA = {
    ".toml": "application/toml",
    ".json": "application/json",
    ".csv": "text/csv",
    ".txt": "text/plain",
}
_LABEL = re.compile(r"\s*(.*?)\s*\[([^\[\]]*)\]\s*$")
_LATEST = 9.2e9  # s; in ns this is the end of int64
_READS = (
    "ehbench reads cdr messages of plain numbers with a ros2msg schema whose channel metadata name each field, "
    "like p_head = 'boom.p_head [Pa]'"
)


# --- writing
# -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Topic:
    """One topic while writing: its channel id, the columns it takes, its schema and channel
    records, its message layout.
    """

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
        from mcap.records import Attachment, AttachmentIndex, Header, Metadata, MetadataIndex
        from zstandard import ZstdCompressor

        self.path = Path(path)
        self.channels = tuple(channels)
        meta, attachments = dict(meta or {}), dict(attachments or {})
        if _FACTS in attachments:
            raise LogError(f"the attachment name '{_FACTS}' is taken by the log itself", file=path)
        self._topics = _topics(self.channels, _groups(self.channels, groups, path))
        self._prefix = b"".join(
            _pack(record)
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
        self._new_chunk()
        try:
            self._file = open(self.path, "xb")  # noqa: SIM115
        except FileExistsError:
            raise LogError(
                "exists already, and a log never overwrites a recording",
                file=path,
                hint="choose another name",
            ) from None
        except OSError as error:
            raise LogError(f"cannot be written: {error.strerror}", file=path) from error
        self._write(MAGIC + _pack(Header("ros2", "ehbench")))
        record = Metadata("ehbench", meta)
        self._indexes.append(MetadataIndex(self._offset, self._write(_pack(record)), record.name))
        facts = json.dumps(
            {"channels": self.channels, "losses": list(losses), "meta": meta}, indent=1
        ).encode()
        for name, data in {_FACTS: facts, **attachments}.items():
            record = Attachment(
                0, 0, name, _MEDIA.get(Path(name).suffix, "application/octet-stream"), data
            )
            offset = self._offset
            length = self._write(_pack(record))
            self._indexes.append(
                AttachmentIndex(offset, length, 0, 0, len(data), name, record.media_type)
            )
        self._sync = sync
        self._synced = -np.inf
        self._maybe_sync()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def append(self, t: float, values: Sequence[float], topic: str | None = None) -> None:
        """Add one sample: ``values`` [SI] in the order of ``channels``, or of the topic's channels.
        Errors as in `extend`.
        """
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
            ValueError: the shapes do not match.
        """
        topics = list(self._topics.values()) if topic is None else [self._topics[topic]]
        t, values = np.asarray(t, dtype=float), np.asarray(values, dtype=float)
        width = len(self.channels) if topic is None else topics[0].columns.size
        if values.shape != (t.size, width):
            raise ValueError(f"values have the shape {values.shape}, not {(t.size, width)}")
        if not t.size:
            return
        before = max(self._last[each.id] for each in topics)
        if not (np.isfinite(t).all() and np.abs(t).max() < _LATEST):
            raise LogError(
                "a sample has no usable time",
                file=self.path,
                hint="times are finite seconds below 9.2e9",
            )
        _check_time(t if before == -np.inf else np.concatenate([[before], t]), file=self.path)
        for each in topics:
            self._last[each.id] = float(t[-1])
        row = np.dtype([(str(each.id), each.layout) for each in topics])
        done = 0
        while done < t.size:
            stop = min(t.size, done + max(1, (CHUNK_SIZE - self._size) // row.itemsize))
            self._add(topics, row, t[done:stop], values[done:stop], own=topic is not None)
            done = stop
            if self._size + row.itemsize > CHUNK_SIZE:
                self._finish_chunk()
        self._maybe_sync()

    def _add(
        self, topics: list[_Topic], row: np.dtype, t: np.ndarray, values: np.ndarray, own: bool
    ) -> None:
        stamps = np.rint(t * 1e9).astype(np.int64)
        if self._span is None:
            self._shift = max(
                0, -int(stamps[0])
            )  # MCAP has no time below zero; the field t keeps it
        stamps = (stamps + self._shift).clip(0).astype(np.uint64)
        first, last = int(stamps[0]), int(stamps[-1])
        self._span = (
            (first, last)
            if self._span is None
            else (min(first, self._span[0]), max(last, self._span[1]))
        )
        self._chunk_span = (min(first, self._chunk_span[0]), max(last, self._chunk_span[1]))
        rows = np.zeros(t.size, row)
        for topic in topics:
            part, start = rows[str(topic.id)], row.fields[str(topic.id)][1]
            count = self._count[topic.id]
            part["opcode"] = _MESSAGE
            part["length"] = topic.layout.itemsize - 9
            part["channel"] = topic.id
            part["sequence"] = np.arange(count, count + t.size) & 0xFFFFFFFF
            part["log_time"] = part["publish_time"] = stamps
            part["cdr"] = _CDR_LITTLE_ENDIAN
            part["data"][:, 0] = t
            part["data"][:, 1:] = values if own else values[:, topic.columns]
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

    def _finish_chunk(self) -> None:
        from mcap.records import Chunk, ChunkIndex

        if not self._entries:
            return
        body, (first, last) = b"".join(self._body), self._chunk_span
        packed = self._compress(body)
        offset = self._offset
        length = self._write(_pack(Chunk("zstd", packed, last, first, crc32(body), len(body))))
        indexes, start = {}, self._offset
        for id, parts in self._entries.items():
            entries = b"".join(parts)
            indexes[id] = self._offset
            self._write(struct.pack("<BQHI", _INDEX, 6 + len(entries), id, len(entries)) + entries)
        self._chunks.append(
            ChunkIndex(
                length,
                offset,
                "zstd",
                len(packed),
                last,
                self._offset - start,
                indexes,
                first,
                len(body),
            )
        )
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
            self._write(_pack(DataEnd(self._crc)))
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
            for packed in (b"".join(map(_pack, group)) for group in groups if group):
                offsets += _pack(SummaryOffset(packed[0], start + len(summary), len(packed)))
                summary += packed
            footer = struct.pack("<BQQQ", _FOOTER, 20, start, start + len(summary))
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
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    part.unlink(missing_ok=True)
    columns = list(record.channels.values())
    try:
        with LogWriter(
            part,
            list(record.channels),
            record.meta,
            record.attachments,
            sync=None,
            losses=record.losses,
        ) as writer:
            for start in range(0, record.t.size, 1 << 15):
                block = slice(start, start + (1 << 15))
                writer.extend(record.t[block], np.stack([each[block] for each in columns], axis=1))
        os.replace(part, path)
    except LogError as error:
        raise type(error)(error.message, file=path, hint=error.hint) from error
    except OSError as error:
        raise LogError(f"cannot be written: {error.strerror}", file=path) from error
    finally:
        part.unlink(missing_ok=True)


def _groups(
    channels: Sequence[str], groups: Mapping[str, Sequence[str]] | None, path: str | Path
) -> dict[str, list[str]]:
    """Topic → channels, checked: every channel is known and in exactly one topic."""
    for name in channels:
        _known(name, file=path)
    groups = {"/rig": channels} if groups is None else groups
    listed = [name for names in groups.values() for name in names]
    if not listed or sorted(listed) != sorted(set(channels)) or len(listed) != len(channels):
        raise LogError(
            "a log has at least one channel, and each channel is in exactly one topic", file=path
        )
    return {topic: list(names) for topic, names in groups.items()}


def _topics(channels: Sequence[str], groups: Mapping[str, Sequence[str]]) -> dict[str, _Topic]:
    from mcap.records import Channel, Schema

    topics, types = {}, set()
    for id, (topic, names) in enumerate(groups.items(), 1):
        word = topic.strip("/").replace("/", ".")
        fields = ["t"]
        for name in names:
            fields.append(_unique(_ros_name(name.removeprefix(word + ".")), fields))
        labels = ["t [s]", *(f"{name} [{quantity(name).unit}]" for name in names)]
        words = [part.capitalize() for part in re.findall(r"[A-Za-z0-9]+", topic)]
        kind = _unique(
            "".join(words) if words and words[0][0].isalpha() else "T" + "".join(words), types
        )
        types.add(kind)
        text = "".join(f"float64 {name}  # {label}\n" for name, label in zip(fields, labels))
        metadata = {"ehbench": FORMAT, "offered_qos_profiles": "", **dict(zip(fields, labels))}
        topics[topic] = _Topic(
            id,
            np.array([channels.index(name) for name in names]),
            Schema(id, text.encode(), "ros2msg", f"ehbench/msg/{kind}"),
            Channel(id, topic, "cdr", metadata, id),
            np.dtype([*_MESSAGE_HEAD, ("data", "<f8", (len(fields),))]),
        )
    return topics


def _ros_name(name: str) -> str:
    """A channel name as a ROS field name: letters a–z first, then letters, digits and single
    underscores.
    """
    word = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    return word if word[:1].isalpha() else f"c_{word}".rstrip("_")


def _unique(word: str, taken: Sequence[str] | set[str]) -> str:
    tries = (
        word if n == 1 else f"{word}_{n}" if word[0].islower() else f"{word}{n}"
        for n in range(1, len(taken) + 2)
    )
    return next(each for each in tries if each not in taken)


def _pack(record: McapRecord) -> bytes:
    from mcap.data_stream import RecordBuilder

    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


# --- reading
# -----------------------------------------------------------------------------------------------------


def read_log(path: str | Path, check: bool = True) -> pd.DataFrame:
    """A log as a pandas frame: column ``t`` [s], one SI column a channel; units, meta and losses
    are in ``frame.attrs``.

    Example:
        frame = ehbench.read_log("datasets/slide_servo/steps/press_no_load.mcap")
        frame.attrs["units"]["press.p_head"], frame["press.p_head"].max()

    Arguments and errors as in `read_record`.
    """
    return read_record(path, check).frame()


def read_record(path: str | Path, check: bool = True) -> Record:
    """A log in SI from ``.mcap`` or ``.csv``.

    A truncated, killed or damaged MCAP gives its sound chunks; ``losses`` then says what is
    missing. Topics of different rates come on the time base of the fastest, the others held at
    their last value.

    Args:
        path: the file.
        check: refuse data that `check_record` refuses.

    Raises:
        LogError: no log, nothing in it, or nothing that can be read; what `check_record` finds.
        UnitError: a channel without unit or with a wrong one; a value outside the plausible range.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise LogError(f"cannot be read: {error.strerror}", file=path) from error
    if not data:
        raise LogError("the file is empty", file=path)
    if path.suffix.lower() == ".csv":
        return _read_csv(path, data, check)
    if path.suffix.lower() == ".mcap" or data.startswith(MAGIC):
        record = _read_mcap(path, data)
        if check:
            check_record(record, path)
        return record
    raise LogError("is no log", file=path, hint="logs are .mcap or .csv")


def check_record(
    record: Record,
    file: str | Path | None = None,
    *,
    lines: Sequence[int] | None = None,
    units: Mapping[str, str] | None = None,
) -> None:
    """Refuse data that no rig can have recorded.

    Args:
        record: what was read.
        file: where it came from, for the message.
        lines: the line of each sample in a text file.
        units: the unit each channel was written in, for the message.

    Raises:
        LogError: no samples, a time or value that is not finite, a time that stands still or goes
            back.
        UnitError: a value outside the plausible range of its quantity; says which unit would fit.
    """
    if not record.t.size:
        raise LogError("the log holds no samples", file=file)
    _check_time(record.t, file=file, lines=lines)
    for name, values in record.channels.items():
        row, low, high = quantity(name), values.min(), values.max()
        if row.lower <= low and high <= row.upper and np.isfinite(low) and np.isfinite(high):
            continue
        finite = np.isfinite(values)
        at = int(np.argmin(finite & (values >= row.lower) & (values <= row.upper)))
        line = lines[at] if lines is not None else None
        where = "" if line else f" at t = {record.t[at]:.9g} s"
        if not finite[at]:
            raise LogError(
                f"{name} is {values[at]}{where}",
                file=file,
                line=line,
                hint="a log holds finite numbers only",
            )
        unit = (units or {}).get(name, row.unit)
        written = from_si(values[at], unit, row)
        hint = "check the unit and the sign"
        fits = [
            u
            for u in (row.display, row.unit)
            if u != unit and row.lower <= to_si(written, u, row) <= row.upper
        ]
        if fits:
            hint = f"in {fits[0]} it would be plausible: check the unit"
        bounds = " to ".join(f"{from_si(bound, unit, row):g}" for bound in (row.lower, row.upper))
        raise UnitError(
            f"{name} = {written:g} {unit}{where} lies outside {bounds} {unit}",
            file=file,
            line=line,
            hint=hint,
        )


def _check_time(
    t: np.ndarray,
    file: str | Path | None = None,
    lines: Sequence[int] | None = None,
    name: str = "the time",
) -> None:
    """Raise LogError unless ``t`` [s] is finite and increases strictly."""
    finite = np.isfinite(t)
    good = finite & np.concatenate([[True], np.diff(np.where(finite, t, 0.0)) > 0])
    if good.all():
        return
    at = int(np.argmin(good))
    line = lines[at] if lines is not None else None
    before, now = float(t[at - 1]), float(t[at])
    if not finite[at]:
        raise LogError(
            f"{name} is {now}", file=file, line=line, hint="a log holds finite numbers only"
        )
    how = "stands still at" if now == before else f"goes back from {before:.9g} s to"
    raise LogError(
        f"{name} {how} {now:.9g} s",
        file=file,
        line=line,
        hint="each sample must be later than the one before",
    )


def _known(name: str, *, file: str | Path | None = None, line: int | None = None) -> None:
    """Raise LogError, naming the nearest name, unless ``name`` is a channel of the vocabulary."""
    *path, word = name.split(".")
    if word in VOCABULARY and all(path):
        return
    near = get_close_matches(word.strip().lower(), VOCABULARY, 1, cutoff=0.5)
    nearest = ".".join([*path, *near])
    hint = (
        f"nearest is '{nearest}'"
        if near
        else "a name ends in a word such as q, x, p_head, p_rod or command"
    )
    raise LogError(f"unknown channel '{name}'", file=file, line=line, hint=hint)


def _label(text: str, *, file: str | Path, line: int | None = None) -> tuple[str, str]:
    """``boom.p_head [kPa]`` as (name, unit), both known."""
    match = _LABEL.match(text)
    name, unit = match.groups() if match else (text.split("(")[0].strip(), "")
    _known(name, file=file, line=line)
    row = quantity(name)
    if not unit.strip() and row.unit != "dimensionless":
        raise UnitError(
            f"'{text.strip()}' has no unit",
            file=file,
            line=line,
            hint=f"write it like '{name} [{row.display}]'",
        )
    try:
        to_si(0.0, unit, row)
    except UnitError as error:
        raise UnitError(
            f"'{text.strip()}': {error.message}", file=file, line=line, hint=error.hint
        ) from None
    return name, unit


# --- CSV
# ---------------------------------------------------------------------------------------------------------


def _read_csv(path: Path, data: bytes, check: bool) -> Record:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise LogError(
            "is not UTF-8 text", file=path, line=line, hint="save the table as CSV in UTF-8"
        ) from None
    rows = [
        (n, row)
        for n, row in enumerate(text.splitlines(), 1)
        if row.strip() and not row.lstrip().startswith("#")
    ]
    if not rows:
        raise LogError(
            "the file holds no header and no samples",
            file=path,
            hint="the header is like t [s],boom.q [rad]",
        )
    head, header = rows.pop(0)
    comma = max(",;\t", key=header.count)
    cells = [cell.strip().strip('"') for cell in header.split(comma)]
    if all(_number(cell) is not None for cell in cells):
        raise LogError(
            "the header is missing",
            file=path,
            line=head,
            hint="the header is like t [s],boom.q [rad]",
        )
    labels = [_label(cell, file=path, line=head) for cell in cells]
    names = [name for name, _ in labels]
    for name in names:
        if names.count(name) > 1:
            raise LogError(f"there are {names.count(name)} columns '{name}'", file=path, line=head)
    if "t" not in names or len(names) < 2:
        hint = "the header is like t [s],boom.q [rad]"
        raise LogError(
            "a log needs a column 't [s]' and at least one channel", file=path, line=head, hint=hint
        )
    if not rows:
        raise LogError("there are no samples below the header", file=path, line=head)
    try:
        table = np.loadtxt((row for _, row in rows), delimiter=comma, ndmin=2, comments=None)
    except ValueError:
        table = None
    if table is None or table.shape[1] != len(names):
        raise _first_bad_cell(path, rows, comma, names)
    values = {
        name: to_si(table[:, i].copy(), unit, quantity(name))
        for i, (name, unit) in enumerate(labels)
    }
    record = Record(values.pop("t"), values)
    if check:
        check_record(record, path, lines=[n for n, _ in rows], units=dict(labels))
    return record


def _number(cell: str) -> float | None:
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return None


def _first_bad_cell(
    path: Path, rows: list[tuple[int, str]], comma: str, names: list[str]
) -> LogError:
    """The error for a table that is no table of numbers."""
    for line, row in rows:
        cells = row.split(comma)
        if len(cells) != len(names):
            return LogError(
                f"{len(cells)} values, but the header names {len(names)} columns",
                file=path,
                line=line,
            )
        for name, cell in zip(names, cells):
            if _number(cell) is None:
                what = f"'{cell.strip()}' is no number" if cell.strip() else "is empty"
                return LogError(
                    f"{name}: {what}", file=path, line=line, hint="numbers are like 1.5 or -2e3"
                )
    return LogError("is no table of numbers", file=path)


# --- MCAP
# --------------------------------------------------------------------------------------------------------


@dataclass
class _Stream:
    """One channel while reading: message layout, labels of its fields, and the values found, shape
    (fields, room).
    """

    topic: str
    layout: np.dtype
    labels: dict[str, str]
    numbered: bool
    table: np.ndarray
    size: int = 0
    sequences: list[np.ndarray] = field(default_factory=list)
    stamps: list[np.ndarray] = field(default_factory=list)

    def add(self, messages: np.ndarray) -> None:
        """Append messages of this layout."""
        stop = self.size + messages.size
        if stop > self.table.shape[1]:
            grown = np.empty((len(self.labels), 2 * stop))
            grown[:, : self.size] = self.table[:, : self.size]
            self.table = grown
        for out, name in zip(self.table, self.labels):
            out[self.size : stop] = messages[name]
        self.size = stop
        self.sequences.append(messages["#sequence"].copy())
        self.stamps.append(messages["#log_time"].copy())


class _Salvage:
    """What can be read of one MCAP file, and what cannot."""

    def __init__(self, data: bytes) -> None:
        import zstandard
        from mcap.exceptions import McapError

        # what the libraries below raise on bytes that are not what they claim to be
        self.broken = (
            struct.error,
            ValueError,
            LookupError,
            OverflowError,
            MemoryError,
            McapError,
            zstandard.ZstdError,
        )
        self.zstd = zstandard
        self.data = data
        self.streams: dict[int, _Stream] = {}
        self.unread: dict[str, None] = {}
        self.meta: dict[str, str] = {}
        self.facts: dict = {}
        self.attachments: dict[str, bytes] = {}
        self.damage: list[str] = []
        self.closed = False
        self.schemas: dict[int, McapRecord] = {}
        self._seen: set[bytes] = set()
        self._loose = bytearray()
        self._chunks = 0
        self._scan()

    def _scan(self) -> None:
        data, size = self.data, len(self.data)
        pos = (
            len(MAGIC)
            if data.startswith(MAGIC)
            else self._skip(0, "the file does not begin as MCAP does")
        )
        while pos < size and not self.closed:
            opcode, length = struct.unpack_from("<BQ", data, pos) if pos + 9 <= size else (0, size)
            start, stop = pos + 9, pos + 9 + length
            if stop > size:
                pos = self._skip(pos, "a record runs past the end of the file")
                continue
            try:
                self._take(opcode, start, stop)
            except self.broken as error:
                why = (
                    str(error)
                    if isinstance(error, _Unreadable)
                    else "a record is not what it claims to be"
                )
                if opcode in (_CHUNK, _ATTACHMENT) and self._framed(opcode, start, stop):
                    self.damage.append(f"bytes {pos} to {stop} of {size} are lost: {why}")
                else:
                    stop = self._skip(pos, why)
            pos = stop
        sums = (bytes(4), crc32(data[pos:-12]).to_bytes(4, "little"))
        if self.closed and not (data.endswith(MAGIC) and data[-12:-8] in sums):
            self.damage.append(
                "the index at the end of the file is damaged, no sample is missing by that"
            )
        if self._loose and not self._chunks:
            try:
                self._body(bytes(self._loose))
            except self.broken as error:
                self.damage.append(f"the messages are damaged: {error}")

    def _skip(self, pos: int, why: str) -> int:
        """Note that the bytes from ``pos`` to the next chunk are lost; return where that chunk
        begins.
        """
        data, size = self.data, len(self.data)
        nxt, at = size, pos
        while (at := data.find(b"\x04\x00\x00\x00zstd", at + 1)) >= 0:
            start = at - 28
            if start - 9 > pos and data[start - 9] == _CHUNK:
                stop = start + struct.unpack_from("<Q", data, start - 8)[0]
                if stop <= size and self._framed(_CHUNK, start, stop):
                    nxt = start - 9
                    break
        self.damage.append(f"bytes {pos} to {nxt} of {size} are lost: {why}")
        return nxt

    def _framed(self, opcode: int, start: int, stop: int) -> bool:
        """Whether the inner lengths of a chunk or attachment agree with the record's length."""
        try:
            if opcode == _CHUNK:
                (name,) = struct.unpack_from("<I", self.data, start + 28)
                at = start + 32 + name
                return (
                    at + 8 <= stop and at + 8 + struct.unpack_from("<Q", self.data, at)[0] == stop
                )
            at = start + 16
            for _ in range(2):
                at += 4 + struct.unpack_from("<I", self.data, at)[0]
            return at + 12 + struct.unpack_from("<Q", self.data, at)[0] == stop
        except struct.error:
            return False

    def _take(self, opcode: int, start: int, stop: int) -> None:
        """Read one record of the data section; raises what ``broken`` lists when it is damaged."""
        from mcap.records import Attachment, Header, Metadata

        data = self.data
        if opcode == _CHUNK:
            self._chunks += 1
            self._chunk(start, stop)
        elif opcode == _INDEX:
            if stop - start != 6 + struct.unpack_from("<I", data, start + 2)[0]:
                raise ValueError
        elif opcode == _ATTACHMENT:
            (crc,) = struct.unpack_from("<I", data, stop - 4)
            if not self._framed(opcode, start, stop) or crc not in (
                0,
                crc32(data[start : stop - 4]),
            ):
                raise _Unreadable("the checksum of an attachment does not match")
            record = _unpack(Attachment, data[start:stop])
            if record.name == _FACTS:
                self.facts = json.loads(record.data)
                if [type(self.facts[key]) for key in ("channels", "losses", "meta")] != [
                    list,
                    list,
                    dict,
                ]:
                    raise ValueError
            else:
                self.attachments[record.name] = record.data
        elif opcode == _METADATA:
            record = _unpack(Metadata, data[start:stop])
            if record.name != "ehbench":
                self.meta.update(
                    {f"{record.name}.{key}": value for key, value in record.metadata.items()}
                )
        elif opcode in (_SCHEMA, _CHANNEL, _MESSAGE):
            self._loose += data[start - 9 : stop]
        elif opcode == _DATA_END:
            (crc,) = struct.unpack("<I", data[start:stop])
            self.closed = True
            if crc and not self.damage and crc != crc32(memoryview(data)[: start - 9]):
                self.damage.append(
                    "the file's checksum does not match: something besides the samples read is damaged"
                )
        elif opcode == _HEADER:
            _unpack(Header, data[start:stop])
        elif opcode < 0x80:
            raise ValueError

    def _chunk(self, start: int, stop: int) -> None:
        if not self._framed(_CHUNK, start, stop):
            raise ValueError
        size, crc, name = struct.unpack_from("<QII", self.data, start + 16)
        kind = self.data[start + 32 : start + 32 + name]
        packed = memoryview(self.data)[start + 40 + name : stop]
        if kind == b"zstd":
            if self.zstd.frame_content_size(packed) not in (-1, size):
                raise _Unreadable("the sizes of a chunk do not match")
            body = self.zstd.decompress(packed, size)
        elif kind == b"":
            body = bytes(packed)
        else:
            raise _Unreadable(
                f"a chunk is compressed with {kind.decode(errors='replace')}, ehbench reads zstd"
            )
        if crc not in (0, crc32(body)):
            raise _Unreadable("the checksum of a chunk does not match")
        self._body(body)

    def _body(self, body: bytes) -> None:
        """Read the records of a chunk: runs of equally laid out messages at a time."""
        pos = 0
        while pos < len(body):
            opcode, length = struct.unpack_from("<BQ", body, pos)
            if opcode == _MESSAGE:
                pos = self._run(body, pos)
                continue
            raw = body[pos : pos + 9 + length]
            if opcode in (_SCHEMA, _CHANNEL) and raw not in self._seen:
                self._declare(opcode, raw[9:])
                self._seen.add(raw)
            pos += 9 + length

    def _declare(self, opcode: int, raw: bytes) -> None:
        from mcap.records import Channel, Schema

        if opcode == _SCHEMA:
            schema = _unpack(Schema, raw)
            self.schemas[schema.id] = schema
            return
        channel = _unpack(Channel, raw)
        schema = self.schemas.get(channel.schema_id)
        fields = _fields(schema, channel)
        if fields is None:
            kind = f", {schema.name}" if schema else ""
            self.unread[f"{channel.topic} ({channel.message_encoding or 'no encoding'}{kind})"] = (
                None
            )
            self.streams.pop(channel.id, None)
        else:
            layout, labels = fields
            room = min(
                2 * len(self.data) // layout.itemsize, 1 << 20
            )  # a guess that saves copies; pages never touched cost nothing
            table = np.empty((len(labels), room))
            self.streams[channel.id] = _Stream(
                channel.topic, layout, labels, "ehbench" in channel.metadata, table
            )

    def _run(self, body: bytes, pos: int) -> int:
        """Read messages from ``pos`` as long as one pattern of channels repeats; return where it
        ends.
        """
        pattern: dict[int, tuple[int, int]] = {}
        at = pos
        while at < len(body) and body[at] == _MESSAGE:
            _, length, id = struct.unpack_from("<BQH", body, at)
            if id in pattern:
                break
            if length < 22 or at + 9 + length > len(body):
                raise ValueError
            pattern[id] = (at - pos, length)
            at += 9 + length
        stride = at - pos
        rows = np.frombuffer(body, np.uint8, (len(body) - pos) // stride * stride, pos).reshape(
            -1, stride
        )
        same = np.ones(len(rows), bool)
        for offset, _ in pattern.values():
            same &= (rows[:, offset : offset + 11] == rows[0, offset : offset + 11]).all(axis=1)
        count = len(rows) if same.all() else int(np.argmin(same))
        for id, (offset, length) in pattern.items():
            stream = self.streams.get(id)
            if stream is None:
                continue
            if 9 + length < stream.layout.itemsize:
                raise _Unreadable(f"a message of {stream.topic} is shorter than its schema says")
            messages = np.ndarray(count, stream.layout, body, pos + offset, (stride,))
            if ((messages["#cdr"] & 0xFFFF) != _CDR_LITTLE_ENDIAN).any():
                raise _Unreadable(f"a message of {stream.topic} is not in little-endian CDR")
            stream.add(messages)
        return pos + stride * count


class _Unreadable(ValueError):
    """Damage that has a name."""


def _unpack(kind: type[McapRecord], raw: bytes) -> McapRecord:
    from mcap.data_stream import ReadDataStream

    stream = ReadDataStream(io.BytesIO(raw))
    record = kind.read(stream)
    if stream.count != len(raw):
        raise ValueError
    return record


def _fields(
    schema: McapRecord | None, channel: McapRecord
) -> tuple[np.dtype, dict[str, str]] | None:
    """The message layout and the labels (field → ``boom.p_head [Pa]``) of a channel, None when it
    cannot be read.

    CDR aligns each number to its own size, counted from the end of the four bytes that say which
    CDR it is."""
    if schema is None or schema.encoding != "ros2msg" or channel.message_encoding != "cdr":
        return None
    names, formats, offsets, labels, end = (
        ["#sequence", "#log_time", "#cdr"],
        ["<u4", "<u8", "<u4"],
        [11, 15, 31],
        {},
        0,
    )
    for text in schema.data.decode().splitlines():
        code, _, comment = text.partition("#")
        words = code.split()
        if not words or "=" in code and words[0] in _CDR_TYPES:
            continue
        if words[0] not in _CDR_TYPES or len(words) < 2:
            return None
        kind = np.dtype(_CDR_TYPES[words[0]])
        end += -end % kind.itemsize
        named = words[1] in channel.metadata
        label = channel.metadata.get(words[1], comment.strip())
        known = label.split("[")[0].strip().rpartition(".")[2] in VOCABULARY
        if (known or named) and (known and named or _LABEL.match(label)):
            labels[words[1]] = label
            names.append(words[1])
            formats.append(kind)
            offsets.append(_HEAD_SIZE + end)
        end += kind.itemsize
    if all(label.split("[")[0].strip() == "t" for label in labels.values()):
        return None
    return np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": _HEAD_SIZE + end}
    ), labels


def _read_mcap(path: Path, data: bytes) -> Record:
    found = _Salvage(data)
    if not data.startswith(MAGIC) and not found.streams:
        raise LogError(
            "is no MCAP file",
            file=path,
            hint=f"MCAP begins with {MAGIC!r}, this begins with {data[:8]!r}",
        )
    streams = [stream for stream in found.streams.values() if stream.size]
    losses = list(found.damage)
    if not streams:
        if losses:
            raise LogError("no sample can be recovered: " + "; ".join(losses), file=path)
        if found.unread:
            raise LogError(
                "holds no topic that ehbench reads: " + ", ".join(found.unread),
                file=path,
                hint=_READS,
            )
        raise LogError(
            "the log holds no samples" + ("" if found.closed else " and breaks off"), file=path
        )
    first = min(int(stream.stamps[0][0]) for stream in streams)
    groups = [_group(stream, first, path, losses) for stream in streams]
    t, channels = _merge(groups, path, losses)
    if not found.closed:
        last = f"{t[-1]:.9g} s" if t.size else "unknown"
        losses.append(
            f"the log breaks off: its last good sample is at t = {last}, what came after it is missing"
        )
    losses += [f"topic not read: {topic}" for topic in found.unread]
    order = [name for name in found.facts.get("channels", ()) if name in channels]
    if without := [name for name in found.facts.get("channels", ()) if name not in channels]:
        losses.append("no samples of " + ", ".join(without))
    channels = {name: channels[name] for name in dict.fromkeys([*order, *channels])}
    if any(stream.numbered for stream in streams) and not found.facts:
        losses.append("the run's facts (meta) are lost")
    meta = {**found.meta, **found.facts.get("meta", {})}
    return Record(t, channels, meta, found.attachments, (*found.facts.get("losses", ()), *losses))


def _group(
    stream: _Stream, first: int, path: Path, losses: list[str]
) -> tuple[str, np.ndarray, dict[str, np.ndarray]]:
    """One topic as (topic, t [s], channels in SI); appends to ``losses`` what the message numbers
    show to be missing.
    """
    channels: dict[str, np.ndarray] = {}
    for values, text in zip(stream.table[:, : stream.size], stream.labels.values()):
        name, unit = _label(text, file=path)
        if name in channels:
            raise LogError(f"topic {stream.topic} has '{name}' twice", file=path)
        channels[name] = to_si(values, unit, quantity(name))
    t = channels.pop("t", None)
    if t is None:
        t = (np.concatenate(stream.stamps).astype(np.int64) - first) / 1e9
    if stream.numbered:
        numbers = np.concatenate(stream.sequences)
        if numbers[0]:
            losses.append(
                f"{stream.topic}: the first {numbers[0]} samples, before t = {t[0]:.9g} s, are missing"
            )
        missing = np.diff(numbers).astype(np.int64) - 1
        for at in np.flatnonzero(missing):
            losses.append(
                f"{stream.topic}: {missing[at]} samples between t = {t[at]:.9g} and {t[at + 1]:.9g} s are missing"
            )
    return stream.topic, t, channels


def _merge(
    groups: list[tuple[str, np.ndarray, dict[str, np.ndarray]]], path: Path, losses: list[str]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """All topics on the time base of the fastest, the slower ones held at their last value
    (zero-order hold).
    """

    def period(t: np.ndarray) -> float:
        return float(np.median(np.diff(t))) if t.size > 1 else np.inf

    _, base, _ = min(groups, key=lambda group: period(group[1]))
    channels: dict[str, np.ndarray] = {}
    start, stop = -np.inf, np.inf
    for topic, t, values in groups:
        if twice := next((name for name in values if name in channels), None):
            raise LogError(
                f"'{twice}' is in two topics", file=path, hint="a channel is logged once"
            )
        if not np.array_equal(t, base):
            for name, times in ((topic, t), ("the time", base)):
                _check_time(times, file=path, name=name)
            held = np.searchsorted(t, base, side="right") - 1
            values = {name: each[held.clip(0)] for name, each in values.items()}
            start, stop = max(start, t[0]), min(stop, t[-1] + period(t))
        channels.update(values)
    keep = (base >= start) & (base <= stop)
    if not keep.all():
        losses.append(
            f"{int((~keep).sum())} samples are left out: not all topics have values there"
        )
        base, channels = base[keep], {name: values[keep] for name, values in channels.items()}
    return base, channels
