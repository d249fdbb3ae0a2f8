"""Logs read into a `Record`: MCAP and CSV, SI, with what is missing said."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ehbench.config.recipe.columns import ColumnMap, load_columns
from ehbench.data.logs.checks import check_record, check_time, inside, label_of, part_of
from ehbench.data.logs.layout import MAGIC
from ehbench.data.logs.mapped import Window, read_mapped
from ehbench.data.logs.salvage import Salvage, Stream
from ehbench.data.logs.text import read_csv
from ehbench.data.readers import reader_of
from ehbench.data.record import Record
from ehbench.runtime.disk import DATA, read_bytes
from ehbench.vocabulary.errors import LogError
from ehbench.vocabulary.quantities import quantity
from ehbench.vocabulary.units import to_si

if TYPE_CHECKING:
    import pandas as pd

_READS = (
    "ehbench reads cdr messages of plain numbers with a ros2msg schema whose channel metadata "
    "name each field, like p_head = 'boom.p_head [Pa]'; other messages by a map: ehbench map FILE"
)


def read_log(
    path: str | Path, check: bool = True, columns: ColumnMap | str | Path | None = None
) -> pd.DataFrame:
    """A log as a pandas frame: column ``t`` [s], one SI column a channel; units, meta and losses
    are in ``frame.attrs``.

    Example:
        frame = ehbench.read_log("datasets/slide_servo/steps/press_no_load.mcap")
        frame.attrs["units"]["press.p_head"], frame["press.p_head"].max()

    Arguments and errors as in `read_record`.
    """
    return read_record(path, check, columns).frame(copy=False)


def read_record(
    path: str | Path,
    check: bool = True,
    columns: ColumnMap | str | Path | None = None,
    window: Window | None = None,
) -> Record:
    """A log in SI: MCAP, CSV, or any other format that is read (`ehbench.data.readers`).

    A truncated, killed or damaged MCAP gives its sound chunks; ``losses`` then says what is
    missing. Topics of different rates come on the time base of the fastest, the others held at
    their last value.

    Args:
        path: the file.
        check: refuse data that `check_record` refuses.
        columns: a map of the file's columns, or the file of one; without it they have to be named
            as channels.
        window: [s] what lies outside is not checked, and may be NaN.

    Raises:
        LogError: no log, nothing in it, or nothing that can be read; what `check_record` finds.
        UnitError: a channel without unit or with a wrong one; a value outside the plausible range.
    """
    path = Path(path)
    if columns is not None:
        columns = columns if isinstance(columns, ColumnMap) else load_columns(columns)
        return read_mapped(path, columns, check, window)
    if path.suffix.lower() != ".mcap" and reader_of(path).module not in ("delimited", "ros"):
        return read_mapped(path, None, check, window)
    if path.suffix.lower() == ".db3" or path.is_dir():
        return read_mapped(path, None, check, window)
    try:
        data = read_bytes(path, DATA, LogError)
    except FileNotFoundError:
        raise LogError("cannot be read: there is no such file", file=path) from None
    if not data:
        raise LogError("the file is empty", file=path)
    if path.suffix.lower() != ".mcap" and not data.startswith(MAGIC):
        return read_csv(path, data, check, window)
    record = read_mcap(path, data)
    if check:
        check_record(part_of(record, inside(record.t, window)), path)
    return record


def read_mcap(path: Path, data: bytes) -> Record:
    result = Salvage(data)
    if not data.startswith(MAGIC) and not result.streams:
        raise LogError(
            "is no MCAP file",
            file=path,
            hint=f"MCAP begins with {MAGIC!r}, this begins with {data[:8]!r}",
        )
    streams = [stream for stream in result.streams.values() if stream.size]
    losses = list(result.damage)
    if not streams:
        if losses:
            raise LogError("no sample can be recovered: " + "; ".join(losses), file=path)
        if result.unread:
            raise LogError(
                "holds no topic that ehbench reads: " + ", ".join(result.unread),
                file=path,
                hint=_READS,
            )
        raise LogError(
            "the log holds no samples" + ("" if result.closed else " and breaks off"), file=path
        )
    first = min(int(stream.stamps[0][0]) for stream in streams)
    groups = [_group(stream, first, path, losses) for stream in streams]
    t, channels = _merge(groups, path, losses)
    if not result.closed:
        last = f"{t[-1]:.9g} s" if t.size else "unknown"
        losses.append(
            f"the log breaks off: its last good sample is at t = {last}, "
            "what came after it is missing"
        )
    losses += [f"topic not read: {topic}" for topic in result.unread]
    order = [name for name in result.facts.get("channels", ()) if name in channels]
    if without := [name for name in result.facts.get("channels", ()) if name not in channels]:
        losses.append("no samples of " + ", ".join(without))
    channels = {name: channels[name] for name in dict.fromkeys([*order, *channels])}
    if any(stream.numbered for stream in streams) and not result.facts:
        losses.append("the run's facts (meta) are lost")
    meta = {**result.meta, **result.facts.get("meta", {})}
    return Record(t, channels, meta, result.attachments, (*result.facts.get("losses", ()), *losses))


def _group(
    stream: Stream, first: int, path: Path, losses: list[str]
) -> tuple[str, np.ndarray, dict[str, np.ndarray]]:
    """One topic as (topic, t [s], channels in SI); appends to ``losses`` what the message numbers
    show to be missing.
    """
    channels: dict[str, np.ndarray] = {}
    for values, text in zip(stream.table[:, : stream.size], stream.labels.values()):
        name, unit = label_of(text, file=path)
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
                f"{stream.topic}: the first {numbers[0]} samples, before t = {t[0]:.9g} s, "
                "are missing"
            )
        missing = np.diff(numbers).astype(np.int64) - 1
        for at in np.flatnonzero(missing):
            losses.append(
                f"{stream.topic}: {missing[at]} samples between t = {t[at]:.9g} and "
                f"{t[at + 1]:.9g} s are missing"
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
                check_time(times, file=path, name=name)
            fixed = np.searchsorted(t, base, side="right") - 1
            values = {name: each[fixed.clip(0)] for name, each in values.items()}
            start, stop = max(start, t[0]), min(stop, t[-1] + period(t))
        channels.update(values)
    keep = (base >= start) & (base <= stop)
    if not keep.all():
        losses.append(
            f"{int((~keep).sum())} samples are left out: not all topics have values there"
        )
        base, channels = base[keep], {name: values[keep] for name, values in channels.items()}
    return base, channels
