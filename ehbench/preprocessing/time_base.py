"""The time base of a log: stamps that are not even, and gaps.

Stamps that jitter are put on the beats of their rate. A few missing samples are bridged, at longer
gaps the log is cut into parts. Each part is a log by itself: nothing is known of the gap, so a
simulation begins anew after it, from an initial state of its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ehbench.data.record import Record
from ehbench.signals.timestamps import Timestamps, timestamps_of
from ehbench.vocabulary.errors import LogError
from ehbench.vocabulary.messages import Message, message
from ehbench.vocabulary.settings import setting


@dataclass(frozen=True)
class TimeSettings:
    """Numbers of uneven time bases and gaps."""

    even: float = setting(
        0.01, "", "share of the sample time by which time may be off and count as even", "rounding"
    )
    jitter: float = setting(
        0.25, "", "share of the sample time by which a sample may be early or late", "below a half"
    )
    bridged: int = setting(5, "", "missing samples in a row that are interpolated", "short ones")
    rare: float = setting(
        0.4, "", "gaps a sample from which the log has another rate", "the median step is a gap"
    )
    shortest: float = setting(0.25, "s", "least length of a part between gaps", "it must move")
    share: float = setting(0.1, "", "least length of a part, share of the longest", "it must count")
    change: float = setting(
        0.02, "", "share of a command's range by which it changes in a part", "above its noise"
    )


SETTINGS = TimeSettings()
_NAMED = 4  # gaps that are listed


def evened(name: str, record: Record) -> tuple[Record, list[Message]]:
    """The record on an even time base, and a message if that took resampling: readings
    interpolated, commands constant.

    Raises:
        LogError: samples are missing, or their stamps are not those of one rate, early and late.
    """
    steps = np.diff(record.t)
    tick = record.sample_time
    if np.abs(steps - tick).max() <= SETTINGS.even * tick:
        return record, []
    even = (record.t[-1] - record.t[0]) / (record.t.size - 1)
    off = np.abs(steps - even)
    worst = int(np.argmax(off))
    # a step ends in two samples, one early and one late
    if off[worst] > (2.0 * SETTINGS.jitter + SETTINGS.even) * even:
        stamps = timestamps_of(record.t)
        if stamps is not None and stamps.even and not stamps.missing.any():
            return _on_beats(record, stamps)
        at = int(np.argmax(np.abs(steps - tick)))
        fields = {"gap": 1e3 * steps[at], "time": record.t[at], "step": 1e3 * tick}
        raise LogError(message("preprocessing.not_even", log=name, **fields))
    t = np.linspace(record.t[0], record.t[-1], record.t.size)
    fixed = (
        np.searchsorted(record.t, t + (SETTINGS.jitter + SETTINGS.even) * even, side="right") - 1
    )
    channels = {
        channel: values[fixed] if channel.endswith(".command") else np.interp(t, record.t, values)
        for channel, values in record.channels.items()
    }
    fields = {"gap": 1e3 * steps[worst], "time": record.t[worst], "rate": 1.0 / even}
    return replace(record, t=t, channels=channels), [message("preprocessing.resampled", **fields)]


def _on_beats(record: Record, stamps: Timestamps) -> tuple[Record, list[Message]]:
    """A record with stamps that jitter on the beats of their rate, and a message: readings
    by straight lines between their stamps, commands each at its beat.
    """
    beats = record.t[0] - stamps.off[0] + stamps.period * stamps.number
    channels = {
        name: y if name.endswith(".command") else np.interp(beats, record.t, y)
        for name, y in record.channels.items()
    }
    early, late = 1e3 * max(0.0, -stamps.off.min()), 1e3 * max(0.0, stamps.off.max())
    rate = f"{1.0 / stamps.period:.5g} Hz"
    note = message("preprocessing.jitter", early=early, late=late, rate=rate)
    return replace(record, t=beats, channels=channels), [note]


class LogPart(NamedTuple):
    """A part of a log: ``name`` and samples."""

    name: str
    record: Record


def parts_of(
    name: str, record: Record, *, driven: bool = False, within: tuple[float, float] | None = None
) -> tuple[list[LogPart], list[Message]]:
    """(the log, or its parts between gaps; messages on the gaps and on what is left out).

    A log of which nothing would be left, or whose time is wrong in another way, comes back as it
    is: `evened` says what is wrong with it.

    Args:
        name: of the log, which its parts have with their number.
        record: the log.
        driven: leave out parts in which no command changes.
        within: [s] the span that counts; parts outside of it are left out.
    """
    whole = [LogPart(name, record)]
    if record.t.size < 3:
        return whole, []
    steps, missing = np.diff(record.t), _missing(record)
    gaps = np.flatnonzero(missing >= 1.0)
    if not gaps.size or gaps.size > SETTINGS.rare * steps.size or np.any(steps <= 0.0):
        return whole, []
    few, many = (
        gaps[part] for part in (missing[gaps] <= SETTINGS.bridged, missing[gaps] > SETTINGS.bridged)
    )
    edges = [0, *(many + 1).tolist(), record.t.size]
    spans = list(zip(edges[:-1], edges[1:], strict=True))
    retained = _retained(record, spans, driven, within)
    if not retained:
        return whole, []
    results = [
        LogPart(
            name if len(retained) == 1 else f"{name}_part{number}",
            _bridged(record, start, stop, few, missing),
        )
        for number, (start, stop) in enumerate(retained, 1)
    ]
    left_out = [span for span in spans if span not in retained]
    notes = []
    if few.size:
        shown = _gap_list(record, few, missing)
        share = float(missing[few].sum() / (record.t.size + missing[few].sum()))
        fields = {"share": share, "longest": float(steps[few].max())}
        notes.append(message("preprocessing.bridged", log=name, gaps=shown, **fields))
    if many.size:
        shown = _gap_list(record, many, missing)
        notes.append(message("preprocessing.cut", log=name, gaps=shown))
    return results, [*notes, *_parts_notes(name, record, results, left_out)]


def _missing(record: Record) -> np.ndarray:
    """Samples that are missing after each but the last, by its step alone, or, where stamps are
    off by more than that, by all of them; shape (samples − 1,).
    """
    tick, steps = record.sample_time, np.diff(record.t)
    slack = (2.0 * SETTINGS.jitter + SETTINGS.even) * tick
    missing = np.where(steps > tick + slack, np.rint(steps / tick) - 1, 0)
    if np.any(np.abs(steps - (missing + 1) * tick) > slack):
        stamps = timestamps_of(record.t)
        if stamps is not None and stamps.even:
            return stamps.missing
    return missing


def _retained(
    record: Record,
    spans: Sequence[tuple[int, int]],
    driven: bool,
    within: tuple[float, float] | None,
) -> list[tuple[int, int]]:
    """The parts, first sample and the one after the last, that are long enough."""
    low, high = (-np.inf, np.inf) if within is None else within
    t = record.t
    inside = [
        (start, stop)
        for start, stop in spans
        if np.count_nonzero((t[start:stop] >= low) & (t[start:stop] <= high)) > 2
    ]
    maximum = max((stop - start for start, stop in inside), default=0)
    minimum = max(SETTINGS.shortest / record.sample_time, SETTINGS.share * maximum)
    long = [span for span in inside if span[1] - span[0] >= minimum]
    return [span for span in long if not driven or _changes(record, *span)]


def _changes(record: Record, start: int, stop: int) -> bool:
    """Whether a command changes in a part by more than a little of its range."""
    commands = [y for name, y in record.channels.items() if name.endswith(".command")]
    return any(np.ptp(y[start:stop]) > SETTINGS.change * np.ptp(y) for y in commands)


def _bridged(
    record: Record, start: int, stop: int, gaps: np.ndarray, missing: np.ndarray
) -> Record:
    """A part with its few missing samples: readings by straight lines, commands by the last one."""
    part = record.at(np.arange(start, stop))
    inside = [int(gap) for gap in gaps if start <= gap < stop - 1]
    if not inside:
        return part
    ends = ((record.t[gap], record.t[gap + 1], int(missing[gap]) + 2) for gap in inside)
    new = [np.linspace(*each)[1:-1] for each in ends]
    t = np.sort(np.concatenate([part.t, *new]))
    fixed = np.searchsorted(part.t, t, side="right") - 1
    channels = {
        name: y[fixed] if name.endswith(".command") else np.interp(t, part.t, y)
        for name, y in part.channels.items()
    }
    return replace(part, t=t, channels=channels)


def _gap_list(record: Record, gaps: np.ndarray, missing: np.ndarray) -> str:
    """The first of some gaps, and how many there are."""
    some = ", ".join(
        f"{1e3 * (record.t[gap + 1] - record.t[gap]):.4g} ms after t = {record.t[gap]:.6g} s "
        f"({missing[gap]:.0f})"
        for gap in gaps[:_NAMED]
    )
    return some + (f", … ({gaps.size} gaps)" if gaps.size > _NAMED else "")


def _parts_notes(
    name: str, record: Record, parts: Sequence[LogPart], left_out: Sequence[tuple[int, int]]
) -> Iterator[Message]:
    """Which parts are used, and which are not."""
    if len(parts) > 1 or left_out:
        spans = ", ".join(
            f"{part.name} from {part.record.t[0]:.6g} to {part.record.t[-1]:.6g} s"
            for part in parts
        )
        yield message("preprocessing.parts", log=name, parts=spans)
    if left_out:
        spans = ", ".join(
            f"{record.t[start]:.6g} to {record.t[stop - 1]:.6g} s" for start, stop in left_out
        )
        yield message("preprocessing.parts_left_out", log=name, spans=spans)
