"""Gaps in a log: a few missing samples are bridged, at longer ones the log is cut into parts.

Each part is a log of its own from there on: what happened in the gap is not known, so a simulation
begins anew behind it, from a start of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ehbench.data.record import Record
from ehbench.preprocessing.preparation import EVEN, JITTER
from ehbench.signals.timestamps import stamps_of

BRIDGED = 5  # samples in a row that a straight line may stand for
RARE = 0.05  # gaps a sample, from which on it is not gaps that a log has but another rate
SHORTEST, SHARE = 0.25, 0.1  # [s] of a part, and share of the longest one, that it has at least
CHANGES = 0.02  # share of a command's range by which it must change in a part to ask something
_NAMED = 4  # gaps that are told


class Part(NamedTuple):
    """A part of a log: ``name`` and samples."""

    name: str
    record: Record


def parts_of(
    name: str, record: Record, *, driven: bool = False, within: tuple[float, float] | None = None
) -> tuple[list[Part], list[str]]:
    """(the log, or its parts between gaps; a sentence on each gap and on what is left out).

    A log of which nothing would be left, or whose time is wrong in another way, comes back as it
    is: `preprocessing.evened` says what is wrong with it.

    Args:
        name: of the log, which its parts have with their number.
        record: the log.
        driven: leave out parts in which no command changes.
        within: [s] the span that counts; parts outside of it are left out.
    """
    whole = [Part(name, record)]
    if record.t.size < 3:
        return whole, []
    steps, missing = np.diff(record.t), _missing(record)
    gaps = np.flatnonzero(missing >= 1.0)
    if not gaps.size or gaps.size > RARE * steps.size or np.any(steps <= 0.0):
        return whole, []
    few, many = (gaps[part] for part in (missing[gaps] <= BRIDGED, missing[gaps] > BRIDGED))
    edges = [0, *(many + 1).tolist(), record.t.size]
    spans = list(zip(edges[:-1], edges[1:], strict=True))
    retained = _kept(record, spans, driven, within)
    if not retained:
        return whole, []
    results = [
        Part(
            name if len(retained) == 1 else f"{name}_part{number}",
            _bridged(record, start, stop, few, missing),
        )
        for number, (start, stop) in enumerate(retained, 1)
    ]
    left_out = [span for span in spans if span not in retained]
    return results, [
        *_sentences(name, record, few, missing, "bridged, readings by straight lines"),
        *_sentences(name, record, many, missing, "the log is cut there"),
        *_taken(name, record, results, left_out),
    ]


def _missing(record: Record) -> np.ndarray:
    """Samples that are missing behind each but the last, by its step alone, or, where stamps are
    off by more than that tells, by all of them; shape (samples − 1,).
    """
    tick, steps = record.sample_time, np.diff(record.t)
    slack = (2.0 * JITTER + EVEN) * tick
    missing = np.where(steps > tick + slack, np.rint(steps / tick) - 1, 0)
    if np.any(np.abs(steps - (missing + 1) * tick) > slack):
        stamps = stamps_of(record.t)
        if stamps is not None and stamps.even:
            return stamps.missing
    return missing


def _kept(
    record: Record,
    spans: Sequence[tuple[int, int]],
    driven: bool,
    within: tuple[float, float] | None,
) -> list[tuple[int, int]]:
    """The parts, first sample and the one behind the last, that tell enough."""
    low, high = (-np.inf, np.inf) if within is None else within
    t = record.t
    inside = [
        (start, stop)
        for start, stop in spans
        if np.count_nonzero((t[start:stop] >= low) & (t[start:stop] <= high)) > 2
    ]
    maximum = max((stop - start for start, stop in inside), default=0)
    minimum = max(SHORTEST / record.sample_time, SHARE * maximum)
    long = [span for span in inside if span[1] - span[0] >= minimum]
    return [span for span in long if not driven or _changes(record, *span)]


def _changes(record: Record, start: int, stop: int) -> bool:
    """Whether a command changes in a part by more than a little of its range."""
    commands = [y for name, y in record.channels.items() if name.endswith(".command")]
    return any(np.ptp(y[start:stop]) > CHANGES * np.ptp(y) for y in commands)


def _bridged(
    record: Record, start: int, stop: int, gaps: np.ndarray, missing: np.ndarray
) -> Record:
    """A part with its few missing samples: readings by straight lines, commands by the last one."""
    part = record.at(np.arange(start, stop))
    own = [int(gap) for gap in gaps if start <= gap < stop - 1]
    if not own:
        return part
    new = [
        np.linspace(record.t[gap], record.t[gap + 1], int(missing[gap]) + 2)[1:-1] for gap in own
    ]
    t = np.sort(np.concatenate([part.t, *new]))
    fixed = np.searchsorted(part.t, t, side="right") - 1
    channels = {
        name: y[fixed] if name.endswith(".command") else np.interp(t, part.t, y)
        for name, y in part.channels.items()
    }
    return replace(part, t=t, channels=channels)


def _sentences(
    name: str, record: Record, gaps: np.ndarray, missing: np.ndarray, what: str
) -> list[str]:
    """What is done about some gaps."""
    if not gaps.size:
        return []
    some = ", ".join(
        f"{1e3 * (record.t[gap + 1] - record.t[gap]):.4g} ms pass after t = {record.t[gap]:.6g} s "
        f"({missing[gap]:.0f})"
        for gap in gaps[:_NAMED]
    )
    more = f", … ({gaps.size} gaps)" if gaps.size > _NAMED else ""
    return [f"{name}: samples are missing, {some}{more}: {what}"]


def _taken(
    name: str, record: Record, parts: Sequence[Part], left_out: Sequence[tuple[int, int]]
) -> list[str]:
    """Which parts are taken, and which are not."""
    results = []
    if len(parts) > 1 or left_out:
        spans = ", ".join(
            f"{part.name} from {part.record.t[0]:.6g} to {part.record.t[-1]:.6g} s"
            for part in parts
        )
        logs = "a log with a start of its own" if len(parts) == 1 else "logs with own starts"
        results.append(f"{name}: taken as {logs}: {spans}")
    if left_out:
        spans = ", ".join(
            f"{record.t[start]:.6g} to {record.t[stop - 1]:.6g} s" for start, stop in left_out
        )
        results.append(
            f"{name}: too short, or without a command that changes, so left out: {spans}"
        )
    return results
