"""Which samples of a log a model was fitted to: by the rows themselves, whatever file they are in.

A row is the readings of all channels at one time. A copy of a log under another name, in another
format or with more samples has the same rows; another window of the same log has not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ehbench.record import Record
from ehbench.validation.results import Overlap

SAME = 1.0e-6  # share of a channel's size by which two readings of one sample may differ
ON_TIME = 0.3  # share of the sample time likewise
LEAST_ROWS = 8  # fewer in a run are a boundary that two windows share
PROBES = 24  # rows looked for to find by how much the time of a copy is shifted
AGREE = 0.5  # share of the probes found that must agree on the shift


class Rows(NamedTuple):
    """Samples that a model was fitted to: time [s], shape (samples,), and channels [SI]; ``digest``
    is the SHA-256 of their file.
    """

    log: str
    t: np.ndarray
    channels: Mapping[str, np.ndarray]
    digest: str = ""


def overlaps(record: Record, fitted: Sequence[Rows], digest: str = "") -> tuple[Overlap, ...]:
    """Where a record has the very samples that a model was fitted to, in the order of time.

    Args:
        record: evenly sampled.
        fitted: the samples.
        digest: SHA-256 of the record's file; in one that was fitted to, the time alone tells.
    """
    found = []
    for rows in fitted:
        if digest and digest == rows.digest:
            within = (record.t >= rows.t[0]) & (record.t <= rows.t[-1])
            found += _runs(record.t, within, rows)
        else:
            found += _overlaps(record, rows)
    return tuple(sorted(found, key=lambda one: (one.start, one.log)))


def _overlaps(record: Record, rows: Rows) -> list[Overlap]:
    names = [name for name in rows.channels if name in record]
    if not names or rows.t.size < LEAST_ROWS or record.t.size < LEAST_ROWS:
        return []
    mine = np.column_stack([record[name] for name in names])
    theirs = np.column_stack([rows.channels[name] for name in names])
    allowed = SAME * np.maximum(np.max(np.abs(theirs), axis=0), 1.0e-12)

    def matched(shift: float) -> np.ndarray:
        """Which rows of the record stand among the fitted ones, these moved by ``shift`` [s]."""
        wanted = record.t - shift
        at = np.clip(np.searchsorted(rows.t, wanted), 1, rows.t.size - 1)
        at = at - (wanted - rows.t[at - 1] < rows.t[at] - wanted)
        near = np.abs(rows.t[at] - wanted) <= ON_TIME * record.sample_time
        return near & np.all(np.abs(theirs[at] - mine) <= allowed, axis=1)

    same = max(
        (matched(shift) for shift in {0.0, _shift(record.t, mine, rows.t, theirs, allowed)}),
        key=np.count_nonzero,
    )
    return [
        one
        for one in _runs(record.t, same, rows)
        if _moves(mine[(record.t >= one.start) & (record.t <= one.stop)], allowed)
    ]


def _moves(readings: np.ndarray, allowed: np.ndarray) -> bool:
    """Whether readings, shape (samples, channels), change: at rest any two logs are alike."""
    return bool(np.any(np.ptp(readings, axis=0) > allowed))


def _runs(t: np.ndarray, same: np.ndarray, rows: Rows) -> list[Overlap]:
    """The stretches of samples that are marked, but for single ones."""
    at = np.flatnonzero(same)
    tick = max(float(np.median(np.diff(t))), float(np.median(np.diff(rows.t))))
    return [
        Overlap(rows.log, float(t[run[0]]), float(t[run[-1]]), int(run.size))
        for run in np.split(at, np.flatnonzero(np.diff(t[at]) > 2.5 * tick) + 1)
        if run.size >= LEAST_ROWS
    ]


def _shift(
    t: np.ndarray, mine: np.ndarray, when: np.ndarray, theirs: np.ndarray, allowed: np.ndarray
) -> float:
    """By how much [s] the time of a copy is later: what most of some rows found in it say; 0 where
    they do not agree.
    """
    probes = np.unique(np.linspace(0, when.size - 1, PROBES).astype(int))
    shifts = []
    for probe in probes:
        hits = np.flatnonzero(np.all(np.abs(mine - theirs[probe]) <= allowed, axis=1))
        if hits.size == 1:
            shifts.append(float(t[hits[0]] - when[probe]))
    if not shifts:
        return 0.0
    middle = float(np.median(shifts))
    near = np.abs(np.array(shifts) - middle) <= ON_TIME * float(np.median(np.diff(when)))
    return middle if np.mean(near) >= AGREE else 0.0
