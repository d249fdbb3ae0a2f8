"""ROS 2 bags and MCAP files with ROS messages, by rosbags: a table a topic, a column each number
in its messages."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ehbench.data.readers.table import Dialect, Source, SourceColumn, SourceTable
from ehbench.runtime.memory import refuse_beyond
from ehbench.vocabulary import message

_LONGEST = 64  # numbers in a list of a message
_DEEPEST = 6  # messages in messages
_MESSAGE_UNITS = {
    "sensor_msgs/msg/FluidPressure": {"fluid_pressure": "Pa"},
    "sensor_msgs/msg/Temperature": {"temperature": "degC"},
    "sensor_msgs/msg/Range": {"range": "m"},
    "sensor_msgs/msg/Imu": {"angular_velocity": "rad/s", "linear_acceleration": "m/s^2"},
    "geometry_msgs/msg/WrenchStamped": {"wrench.force": "N"},
}
_BESIDE = ("header.", "layout.")  # what is no reading


def read(path: Path, dialect: Dialect) -> Source:
    """The topics of a bag, on the time of their headers, else on that of the recording."""
    rows: dict[str, list[dict[str, float]]] = {}
    times: dict[str, list[tuple[int, int]]] = {}
    kinds: dict[str, str] = {}
    unread: dict[str, str] = {}
    with Reader(path) as reader:
        refuse_beyond(2000.0 * reader.message_count)
        stores: dict[int, Any] = {}
        for connection, stamp, data in reader.messages():
            topic, kind = connection.topic, connection.msgtype
            if topic in unread or dialect.table not in (None, topic):
                continue
            try:
                if connection.id not in stores:  # by the definition in the file, else the usual
                    described = connection.msgdef.format == MessageDefinitionFormat.MSG
                    store = get_typestore(Stores.EMPTY if described else Stores.LATEST)
                    if described:
                        store.register(get_types_from_msg(connection.msgdef.data, kind))
                    stores[connection.id] = store
                content = stores[connection.id].deserialize_cdr(data, kind)
            except Exception as error:  # not described, or not as it is described
                why = (str(error).splitlines() or [type(error).__name__])[0][:80]
                unread[topic] = f"{topic} ({kind}: {why})"
                continue
            if numbers := dict(_numbers(content)):
                rows.setdefault(topic, []).append(numbers)
                times.setdefault(topic, []).append((stamp, _header(content)))
                kinds[topic] = kind
            elif topic not in rows:
                unread[topic] = f"{topic} ({kind})"
    zeros = [_stamps(stamps).min() for stamps in times.values()]
    zero = int(min(zeros, default=0))
    tables, losses = [], [message("data.topic_not_read", topic=text) for text in unread.values()]
    for topic, content in rows.items():
        table, refused = _table(topic, content, _stamps(times[topic]), zero, kinds[topic])
        tables.append(table)
        losses += refused
    return Source(tuple(tables), losses=tuple(losses))


def _stamps(pairs: list[tuple[int, int]]) -> np.ndarray:
    """Times [ns] of a topic: those of the headers where all have one."""
    stamps = np.array(pairs, np.int64)
    return stamps[:, 1] if (stamps[:, 1] > 0).all() else stamps[:, 0]


def _table(
    topic: str, rows: list[dict[str, float]], stamps: np.ndarray, zero: int, kind: str
) -> tuple[SourceTable, list[str]]:
    """(a topic's numbers by name, in the order of its time, NaN where a message has none; notes on
    integers that no float is)."""
    order = np.argsort(stamps, kind="stable")
    names = dict.fromkeys(name for row in rows for name in row)
    units = _MESSAGE_UNITS.get(kind, {})
    columns, losses = [], []
    for name in names:
        numbers = [row.get(name, np.nan) for row in rows]
        odd = next((n for n in numbers if isinstance(n, int) and int(float(n)) != n), None)
        if odd is not None:
            reason = message("data.integer_rounded", number=odd)
            losses.append(message("data.not_converted", name=f"{topic}/{name}", reason=reason))
            continue
        values = np.array(numbers, float)[order]
        unit = next((unit for part, unit in units.items() if name.startswith(part)), "")
        columns.append(SourceColumn(name, values, unit))
    t = (stamps[order] - zero) / 1e9
    return SourceTable(topic, tuple(columns), t, zero / 1e9 if zero > 0 else None), losses


def _plain(value: Any) -> float:
    """A number of a message, an integer as it is."""
    return int(value) if isinstance(value, (int, np.integer)) else float(value)


def _header(message: Any) -> int:
    """The time [ns] in a message's header, 0 where it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _numbers(message: Any, path: str = "", depth: int = 0) -> Iterator[tuple[str, float]]:
    """(name, number) of all numbers in a message: those of a list by the names that the message has
    for them (joints), else by their place."""
    labels = getattr(message, "name", None)
    labels = list(labels) if isinstance(labels, (list, tuple, np.ndarray)) else []
    for key in (field.name for field in fields(message)):
        value, name = getattr(message, key), f"{path}{key}"
        if key.isupper() or f"{name}.".startswith(_BESIDE):  # a constant, or no reading
            continue
        if isinstance(value, (bool, int, float, np.number, np.bool_)):
            yield name, _plain(value)
        elif isinstance(value, (list, tuple, np.ndarray)) and 0 < len(value) <= _LONGEST:
            places = labels if len(labels) == len(value) else range(len(value))
            for label, item in zip(places, value):
                if isinstance(item, (bool, int, float, np.number, np.bool_)):
                    yield f"{name}.{label}", _plain(item)
                elif depth < _DEEPEST and is_dataclass(item):
                    yield from _numbers(item, f"{name}.{label}.", depth + 1)
        elif depth < _DEEPEST and is_dataclass(value):
            yield from _numbers(value, f"{name}.", depth + 1)
