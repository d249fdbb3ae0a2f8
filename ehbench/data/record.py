"""Time series: what a log holds once it is in memory."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ehbench.signals.series import block_averages
from ehbench.vocabulary import LogError, Message, listed, message, plural, quantity
from ehbench.vocabulary.notebook import label, shown, table
from ehbench.vocabulary.quantities import like_channel

if TYPE_CHECKING:
    import pandas as pd

Window = tuple[float, float]  # [s] first and last time
OVERRULED = "data.unit_overruled"
PERIODS = "periods_of_channels"  # the fact of a record that `Record.periods` reads
# messages on samples that are interpolated, or that nothing is missing without
_RECOVERED = (
    *(f"data.{key}" for key in ("samples_bridged", "command_bridged", "samples_missing")),
    *(f"data.{key}" for key in ("numbers_missing", "repeated_rows", "unused_table")),
    "preprocessing.bridged",
    OVERRULED,
)


def lost(notes: Iterable[str]) -> list[str]:
    """Of notes on a log those on what could not be recovered."""
    return [note for note in notes if getattr(note, "key", "") not in _RECOVERED]


def recovered(log: str, notes: Iterable[str]) -> list[Message]:
    """What was interpolated of a log as one message, none where nothing was: the largest share of
    samples of a channel, and the longest gap; before it each unit that a map overrules."""
    known = [note for note in notes if isinstance(note, Message) and note.key in _RECOVERED]
    units, few = [note for note in known if note.key == OVERRULED], [note.fields for note in known]
    shares = [fields["share"] for fields in few if fields.get("share")]
    if not shares:
        return units
    longest = 1e3 * max(fields.get("longest", 0.0) for fields in few)
    fields = {"share": 100.0 * max(shares), "longest": longest}
    return [*units, message("data.interpolated", log=log, **fields)]


def noted_losses(name: str, notes: Iterable[str]) -> tuple[list[str], list[str]]:
    """(what is missing in a log as it was read, in few notes; the other notes, one for each)."""
    missing = [note for note in notes if getattr(note, "key", "") == "data.samples_missing"]
    others = [note for note in notes if note not in missing]
    notes = [*lost(others), *recovered(name, others), *missing]
    return notes, [note for note in others if note not in notes]


@dataclass(frozen=True)
class Record:
    """One recording on one time base.

    ``t`` [s], shape (samples,), strictly increasing; the sample at t is the state at t, and a
    command at t acts from t on. ``channels`` maps names such as ``boom.p_head`` to SI arrays of the
    same shape, in the log's order. ``meta`` are the run's facts as text; ``attachments`` the files
    that travelled with the log; ``losses`` one sentence for each thing a reader could not recover.
    """

    t: np.ndarray
    channels: dict[str, np.ndarray]
    meta: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    losses: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, values in self.channels.items():
            if values.shape != self.t.shape:
                size, t = values.shape[0], self.t.shape[0]
                raise LogError(message("data.samples_of_channel", name=name, size=size, t=t))
            quantity(name)

    def __getitem__(self, name: str) -> np.ndarray:
        """The SI array of a channel.

        Raises:
            LogError: no such channel; names those there are."""
        if name == "t":
            return self.t
        if name not in self.channels:
            like = like_channel(name, list(self.channels))
            raise LogError(message("data.no_channel", name=name, like=like))
        return self.channels[name]

    def __repr__(self) -> str:
        span = f" from {self.t[0]:g} to {self.t[-1]:g} s" if self.t.size else ""
        count = plural(len(self.channels), "channel")
        some = f": {listed(self.channels)}" if self.channels else ""
        return f"<Record: {plural(self.t.size, 'sample')}{span}, {count}{some}>"

    def _repr_html_(self) -> str:
        """Its channels with their unit, range and meaning."""
        rows = []
        for name, values in self.channels.items():
            row = quantity(name)
            ends = (values.min(), values.max()) if values.size else (None, None)
            minimum, maximum = (shown(end, name, row.display) for end in ends)
            rows.append((name, label(row.display), minimum, maximum, row.meaning))
        header = ("channel", "unit", "least", "most", "meaning")
        span = f"{self.t[0]:g} … {self.t[-1]:g} s, " if self.t.size else ""
        return table(header, rows, span + plural(self.t.size, "sample"))

    def __contains__(self, name: str) -> bool:
        return name == "t" or name in self.channels

    def table(self, columns: Sequence[tuple[str, float | None]]) -> np.ndarray:
        """Channels side by side, shape (samples, columns), each with the value [SI] of one that
        there is not.

        Raises:
            LogError: no such channel, where there is no value for it."""
        built = np.empty((self.t.size, len(columns)))
        for i, (name, value) in enumerate(columns):
            built[:, i] = self[name] if value is None or name in self else value
        return built

    @cached_property
    def sample_time(self) -> float:
        """Median time between samples [s]."""
        return float(np.median(np.diff(self.t))) if self.t.size > 1 else float("nan")

    @cached_property
    def periods(self) -> dict[str, float]:
        """The sample time [s] of channels that were read more slowly than they stand here; what is
        no such table says nothing."""
        try:
            known = json.loads(self.meta.get(PERIODS, "{}")).items()
            return {name: float(period) for name, period in known if 0.0 < period < math.inf}
        except (ValueError, TypeError, AttributeError):
            return {}

    def apart(self, channel: str) -> int:
        """How many samples here lie between two that a channel's recorder took."""
        if channel not in self.periods or self.t.size < 2:
            return 1
        return int(np.clip(self.periods[channel] / self.sample_time + 0.5, 1, self.t.size))

    @cached_property
    def even(self) -> bool:
        """Whether it has samples at one rate, three at least."""
        if self.t.size < 3:
            return False
        tick = self.sample_time
        return not np.abs(np.diff(self.t) - tick).max() > 0.01 * tick

    def at(self, samples: Sequence[int] | np.ndarray | slice) -> Record:
        """These samples alone, by number, by a mask or from one to another."""
        if isinstance(samples, np.ndarray) and samples.dtype == bool and samples.all():
            return self
        channels = {name: values[samples] for name, values in self.channels.items()}
        return replace(self, t=self.t[samples], channels=channels)

    def between(self, start: float, stop: float) -> Record:
        """The samples from ``start`` to ``stop`` [s], both included."""
        return self.at((self.t >= start) & (self.t <= stop))

    def frame(self, copy: bool = True) -> pd.DataFrame:
        """A pandas frame: column ``t`` and one SI column a channel; ``frame.attrs`` has ``units``,
        ``meta``, ``losses``. Without ``copy`` its columns are the record's own arrays."""
        import pandas as pd

        frame = pd.DataFrame({"t": self.t, **self.channels}, copy=copy)
        frame.attrs["units"] = {"t": "s", **{name: quantity(name).unit for name in self.channels}}
        frame.attrs["meta"] = dict(self.meta)
        frame.attrs["losses"] = list(self.losses)
        return frame


def floats(values: np.ndarray) -> np.ndarray:
    """Numbers as floats.

    Raises:
        LogError: an integer that no float is: beyond 2^53 not all are."""
    result = values.astype(float)
    if values.dtype.kind in "iu":
        for row in np.flatnonzero(np.abs(result) >= 2.0**53):
            if int(result[row]) != int(values[row]):
                raise LogError(message("data.integer_rounded", number=int(values[row])))
    return result


def resampled(
    channels: Mapping[str, np.ndarray], t: np.ndarray, at: np.ndarray, slack: float = 0.0
) -> dict[str, np.ndarray]:
    """Channels sampled at ``t`` [s] as they are at other times: readings on straight lines between
    their samples, commands as the last one, which may come ``slack`` [s] late."""
    last = (np.searchsorted(t, at + slack, side="right") - 1).clip(0)
    return {
        name: y[last] if name.endswith(".command") else np.interp(at, t, y)
        for name, y in channels.items()
    }


@dataclass(frozen=True)
class BlockAverages:
    """A recording as means of ``each`` successive samples, at their mean time, without commands."""

    record: Record
    each: int

    @classmethod
    def of(cls, record: Record, each: int) -> BlockAverages:
        """Of a recording, or of a simulation along it."""
        channels = {
            name: block_averages(y, each)
            for name, y in record.channels.items()
            if not name.endswith(".command")
        }
        return cls(replace(record, t=block_averages(record.t, each), channels=channels), each)


def payloads_of(record: Record) -> list[tuple[float, str | None]]:
    """(time [s], payload from then on, None for none) that a log says were carried, the first from
    its first sample on.

    Raises:
        LogError: the log's facts are damaged."""
    steps = [(-math.inf, record.meta.get("payload", "none"))]
    try:
        changes = json.loads(record.meta.get("payload_change", "[]"))
        steps += [(float(at), str(name)) for at, name in changes]
    except (ValueError, TypeError):
        raise LogError(message("data.bad_payload_changes")) from None
    first, last = float(record.t[0]), float(record.t[-1])
    results: list[tuple[float, str | None]] = []
    for at, name in steps:
        if at <= first:
            results.clear()
        if at <= last:
            results.append((max(at, first), None if name in ("", "none") else name))
    return results
