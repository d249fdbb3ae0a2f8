"""MCAP logs read into a `Record`: SI, with notes on what is missing."""

from pathlib import Path

import numpy as np

from ehbench.data.logs.checks import check_record, check_time, inside, label_of
from ehbench.data.logs.layout import MAGIC
from ehbench.data.logs.salvage import Salvage, Stream
from ehbench.data.rates import Group, joined
from ehbench.data.record import Record, Window
from ehbench.runtime.disk import DATA, read_bytes
from ehbench.vocabulary import LogError, message, placed, quantity, to_si


def read_mcap(path: Path, check: bool = True, window: Window | None = None) -> Record:
    """An MCAP log; arguments and errors as in `ehbench.data.read`."""
    data = read_bytes(path, DATA, LogError)
    if not data:
        raise LogError(message("data.empty_file"), file=path)
    with placed({"file": path}):
        result = Salvage(data)
    if not data.startswith(MAGIC) and not result.streams:
        begins = data[: len(MAGIC)]
        raise LogError(message("data.no_mcap", magic=MAGIC, begins=begins), file=path)
    streams = [stream for stream in result.streams.values() if stream.size]
    losses = list(result.damage)
    if not streams:
        if losses:
            raise LogError(message("data.nothing_recovered", why="; ".join(losses)), file=path)
        if result.unread:
            raise LogError(
                message("data.no_known_topic", topics=", ".join(result.unread)), file=path
            )
        key = "data.no_samples" if result.closed else "data.no_samples_breaks_off"
        raise LogError(message(key), file=path)
    first = min(int(stream.stamps[0][0]) for stream in streams)
    groups = [_group(stream, first, path, losses) for stream in streams]
    names = [name for group in groups for name in group.channels]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise LogError(message("data.in_two_topics", name=twice), file=path)
    for group in groups if len(groups) > 1 else ():
        check_time(group.t, file=path, name=group.name)
    record, rates = joined(groups, losses)
    t, channels = record.t, record.channels
    if not result.closed:
        losses.append(message("data.breaks_off", last=f"{t[-1]:.9g} s" if t.size else "unknown"))
    losses += [message("data.topic_not_read", topic=topic) for topic in result.unread]
    listed = result.facts.get("channels", ())
    if without := [name for name in listed if name not in channels]:
        losses.append(message("data.channels_without_samples", channels=", ".join(without)))
    order = dict.fromkeys([*(name for name in listed if name in channels), *channels])
    channels = {name: channels[name] for name in order}
    if any(stream.numbered for stream in streams) and not result.facts:
        losses.append(message("data.facts_lost"))
    meta = {**result.meta, **result.facts.get("meta", {}), **record.meta}
    meta |= {"rates": "; ".join(rates)} if rates else {}
    losses = (*result.facts.get("losses", ()), *losses)
    record = Record(t, channels, meta, result.attachments, losses)
    if check:
        check_record(record.at(inside(record.t, window)), path)
    return record


def _group(stream: Stream, first: int, path: Path, losses: list[str]) -> Group:
    """One topic; appends to ``losses`` what the message numbers show to be missing."""
    channels: dict[str, np.ndarray] = {}
    for values, text in zip(stream.table[:, : stream.size], stream.labels.values()):
        name, unit = label_of(text, file=path)
        if name in channels:
            raise LogError(message("data.topic_twice", topic=stream.topic, name=name), file=path)
        channels[name] = to_si(values, unit, quantity(name))
    t = channels.pop("t", None)
    if t is None:
        t = (np.concatenate(stream.stamps).astype(np.int64) - first) / 1e9
    if stream.numbered:
        numbers = np.concatenate(stream.sequences)
        topic = stream.topic
        if numbers[0]:
            losses.append(message("data.first_missing", topic=topic, count=numbers[0], t=t[0]))
        missing = np.diff(numbers).astype(np.int64) - 1
        at = np.flatnonzero(missing > 0)
        if at.size:
            longest = int(at[np.argmax(missing[at])])
            fields = {"topic": topic, "count": missing[at].sum()}
            fields |= {"most": missing[longest], "first": t[longest], "last": t[longest + 1]}
            losses.append(message("data.numbers_missing", **fields))
    return Group(stream.topic, t, channels=channels)
