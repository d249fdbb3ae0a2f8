"""A black box beside the model: a linear ARX for each channel, fitted to the same logs as the model
and run freely on those that judge it.

    y(k) = Σ a(i) y(k − i) + Σ b(i, j) u_j(k − i) + c      (Ljung, System Identification, 1999, 4.2)

y counts from its level before the first command, u_j are the commands of the channel's cylinder,
each direction for itself: the two areas of a cylinder differ. Where it predicts a channel better
than the model, the model lacks what the logs hold."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ehbench.data.record import Record, block_averages
from ehbench.preprocessing.observations import column
from ehbench.signals import series
from ehbench.validation.results import BlackBox, LogResult
from ehbench.vocabulary import message, setting


@dataclass(frozen=True)
class BaselineSettings:
    """Numbers of the black box beside the model."""

    orders: tuple[int, ...] = setting(
        (1, 2, 3, 4, 6), "", "orders tried", "a valve, an oil spring and a line have six states"
    )
    ticks: tuple[float, ...] = setting(
        (1e-3, 2e-3, 5e-3, 1e-2, 2e-2),
        "s",
        "times over which samples are averaged, tried",
        "noise biases an ARX on fast samples; slower ones lose the ringing",
    )
    rows: int = setting(
        5, "", "rows of data for each coefficient, at least", "fewer are followed, not predicted"
    )
    better: float = setting(
        0.5,
        "",
        "share of the model's squared error below which the black box is clearly better",
        "as for a cause of the residual: it explains more than half of the squares",
    )


SETTINGS = BaselineSettings()


class Arx(NamedTuple):
    """A fitted ARX of a channel: ``poles`` a(i), shape (order,), ``inputs`` b(i, j) and c, shape
    (2 (order + 1) · commands + 1,), on means over ``tick`` [s]."""

    channel: str
    commands: tuple[str, ...]
    tick: float
    poles: np.ndarray
    inputs: np.ndarray

    def runs(self, record: Record) -> bool:
        """Whether a record has what it needs, from its first samples to its end."""
        spans = self.tick * (self.poles.size + 1)
        return _usable(record, self.channel, self.commands) and bool(np.ptp(record.t) > spans)

    def run(self, record: Record) -> np.ndarray:
        """The channel on a record's commands from its first few samples on, at the record's
        times; not finite where it is unstable."""
        from scipy.signal import lfilter, lfiltic

        t, y, u, level = _signals(record, self.channel, self.commands, self.tick)
        order = self.poles.size
        polynomial = np.concatenate([[1.0], -self.poles])
        drive = _regressors(u, order) @ self.inputs
        past = lfiltic([1.0], polynomial, y[order - 1 :: -1])
        free = lfilter([1.0], polynomial, drive, zi=past)[0]
        return level + np.interp(record.t, t, np.concatenate([y[:order], free]))


@np.errstate(over="ignore", invalid="ignore")  # a free run may grow beyond all numbers
def black_boxes(
    results: Sequence[LogResult],
    records: Sequence[Record],
    training: Sequence[tuple[str, Record]] = (),
) -> tuple[list[LogResult], BlackBox, list[str]]:
    """(the results with the fits of black boxes, what these are, a sentence for each channel that
    they predict clearly better than the model).

    They are fitted to ``training`` and to the logs that the model was fitted to; where there are
    none, to the first that is held out, and then they are shown only.

    Args:
        results: of each log.
        records: of each log, all of it.
        training: name and record of further logs that the model was fitted to."""
    pairs = list(zip(results, records, strict=True))
    known = [*training, *((log.name, record) for log, record in pairs if log.status == "fitted")]
    held_out = [pair for pair in pairs if pair[0].status == "held_out"]
    counts = bool(known)
    if not known:
        known = [(log.name, record) for log, record in held_out[:1]]
        held_out = held_out[1:]
    channels = {
        item.channel for log, _ in held_out for item in log.channels if item.fit_percent is not None
    }
    boxes = {name: fit(name, [record for _, record in known]) for name in sorted(channels)}
    shown = {log.name: _with_fits(log, record, boxes) for log, record in held_out}
    better = [text for log in shown.values() for text in _better(log)] if counts else []
    orders = {name: (box.poles.size, box.tick) for name, box in boxes.items() if box is not None}
    names = tuple(name for name, _ in known) if orders else ()
    return [shown.get(log.name, log) for log in results], BlackBox(names, counts, orders), better


@np.errstate(over="ignore", invalid="ignore")
def fit(channel: str, records: Sequence[Record]) -> Arx | None:
    """The ARX of a channel whose free run is the nearest to these records, over `SETTINGS.orders`
    and `SETTINGS.ticks`; None where they do not support one."""
    cylinder = channel.partition(".")[0]
    commands = tuple(
        name
        for name in records[0].channels
        if name.startswith(f"{cylinder}.") and name.endswith(".command")
        if any(name in record and np.ptp(record[name]) > 0.0 for record in records)
    )
    usable = [record for record in records if _usable(record, channel, commands)]
    if not commands or not usable:
        return None
    finest = max(record.sample_time for record in usable)
    best, lowest = None, np.inf
    for tick in dict.fromkeys(max(tick, finest) for tick in SETTINGS.ticks):
        for order in SETTINGS.orders:
            box = _least_squares(channel, commands, tick, order, usable)
            if box is None:
                continue
            off = (box.run(record) - _values(record, channel) for record in usable)
            error = sum(float(np.sum(item**2)) for item in off)
            if error < lowest:  # never where it is not finite
                best, lowest = box, error
    return best


def _usable(record: Record, channel: str, commands: Sequence[str]) -> bool:
    known = all(name in record for name in commands)
    return record.even and known and column(record, channel, record) is not None


def _values(record: Record, channel: str) -> np.ndarray:
    values = column(record, channel, record)
    assert values is not None  # `_usable` has asked
    return values


def _signals(
    record: Record, channel: str, commands: Sequence[str], tick: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """(means over ``tick`` of times, of the channel beyond its level, of the commands by direction,
    shape (blocks, 2 commands), the level)."""
    each = max(1, round(tick / record.sample_time))
    u = np.column_stack([record[name] - record[name][0] for name in commands])
    values, moved = _values(record, channel), np.flatnonzero(np.any(u != 0.0, axis=1))
    level = float(np.mean(values[: max(moved[0], each) if moved.size else each]))
    parts = record.t, values - level, np.hstack([np.maximum(u, 0.0), np.minimum(u, 0.0)])
    t, y, u = (block_averages(part, each) for part in parts)
    return t, y, u, level


def _regressors(u: np.ndarray, order: int) -> np.ndarray:
    """Commands from now to ``order`` samples ago, and 1; rows from sample ``order`` on."""
    count = len(u) - order
    past = [u[order - i : order - i + count] for i in range(order + 1)]
    return np.hstack([*past, np.ones((count, 1))])


def _least_squares(
    channel: str, commands: tuple[str, ...], tick: float, order: int, records: Sequence[Record]
) -> Arx | None:
    """The ARX of an order, None where there are too few samples."""
    tables, outputs = [], []
    for record in records:
        _, y, u, _ = _signals(record, channel, commands, tick)
        if len(y) > 2 * order:
            past = [y[order - i : len(y) - i] for i in range(1, order + 1)]
            tables.append(np.column_stack([*past, _regressors(u, order)]))
            outputs.append(y[order:])
    if not tables or len(table := np.concatenate(tables)) < SETTINGS.rows * table.shape[1]:
        return None
    size = np.abs(table).max(axis=0)
    size[size == 0.0] = 1.0
    numbers = np.linalg.lstsq(table / size, np.concatenate(outputs), rcond=None)[0] / size
    return Arx(channel, commands, tick, numbers[:order], numbers[order:])


def _with_fits(log: LogResult, record: Record, boxes: Mapping[str, Arx | None]) -> LogResult:
    """A log's result with the fits of black boxes on the part that counts."""
    low, high = log.scored or (-np.inf, np.inf)
    keep = (record.t >= low) & (record.t <= high)
    items = []
    for item in log.channels:
        box = boxes.get(item.channel)
        if box is not None and item.fit_percent is not None and box.runs(record):
            values = _values(record, item.channel)[keep]
            fitted = series.fit_percent(values, box.run(record)[keep])
            item = replace(item, baseline_percent=fitted if np.isfinite(fitted) else None)
        items.append(item)
    return replace(log, channels=tuple(items))


def _better(log: LogResult) -> Iterator[str]:
    for item in log.channels:
        fit, box = item.fit_percent, item.baseline_percent
        if fit is None or box is None:
            continue
        if (100.0 - box) ** 2 < SETTINGS.better * (100.0 - fit) ** 2:
            yield message(
                "validation.black_box", log=log.name, channel=item.channel, fit=fit, black_box=box
            )
