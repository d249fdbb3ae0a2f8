"""Which samples of a log a model was fitted to: by the rows themselves, whatever file they are in.

A row is the readings of all channels at one time. A copy of a log under another name, in another
format or with more samples has the same rows; another window of the same log has not. A copy that
was rounded or put on another time base has no such rows, but its noise is that of the fitted
samples, where a second recording of the same test has noise of its own."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ehbench.data.record import Record
from ehbench.diagnosis.recordings import STILL
from ehbench.validation.results import Overlap
from ehbench.vocabulary import MAD, setting


@dataclass(frozen=True)
class SampleSettings:
    """Numbers by which samples of two logs are the same."""

    same: float = setting(
        1.0e-6, "", "share of a channel's size by which readings of a sample may differ", "rounding"
    )
    on_time: float = setting(0.3, "", "share of the sample time likewise", "below a half")
    rows: int = setting(8, "", "least rows in a run", "fewer are a boundary of two windows")
    probes: int = setting(24, "", "rows searched for the shift of a copy's time", "some are found")
    agree: float = setting(0.5, "", "share of the probes that must agree on the shift", "half")
    block: int = setting(64, "", "samples over which two noises are compared", "none by chance")
    quiet: int = setting(4, "", "blocks between two equal ones that count as equal", "standstill")
    noise: float = setting(
        0.6, "", "largest rms difference of readings of one sample, in noises", "rounding makes 0.5"
    )
    finest: float = setting(0.1, "", "quantile of a channel's steps that is fine", "its counts")
    fine: float = setting(0.5, "", "share of the noise below which a step is fine", "its counts")


SETTINGS = SampleSettings()


class FittedSamples(NamedTuple):
    """Samples that a model was fitted to: time [s], shape (samples,), and channels [SI]; ``digest``
    is the SHA-256 of their file.
    """

    log: str
    t: np.ndarray
    channels: Mapping[str, np.ndarray]
    digest: str = ""


def overlaps(
    record: Record, fitted: Sequence[FittedSamples], digest: str = ""
) -> tuple[Overlap, ...]:
    """Where a record has the very samples that a model was fitted to, in the order of time; but for
    those at a standstill, which tell nothing of a model: simulations of one seed share their noise.

    Args:
        record: evenly sampled.
        fitted: the samples.
        digest: SHA-256 of the record's file; in one that was fitted to, the time alone tells.
    """
    results = []
    for rows in fitted:
        if digest and digest == rows.digest:
            within = (record.t >= rows.t[0]) & (record.t <= rows.t[-1])
            results += _runs(record.t, within, rows)
        else:
            results += _overlaps(record, rows) or _same_noise(record, rows)
    commands = [y for name, y in record.channels.items() if name.endswith(".command")]
    moved = [y for name, y in record.channels.items() if name.endswith((".x", ".q"))]

    def stands(run: Overlap) -> bool:
        inside = (record.t >= run.start) & (record.t <= run.stop)
        driven = np.any([y[inside] != y[inside][0] for y in commands], axis=0)
        ways = [np.ptp(y[inside]) for y in moved]
        still = max(ways) <= STILL * max(map(np.ptp, moved))
        return bool(still and np.count_nonzero(driven) < SETTINGS.rows)

    if commands and moved:
        results = [run for run in results if not stands(run)]
    return tuple(sorted(results, key=lambda item: (item.start, item.log)))


def _overlaps(record: Record, rows: FittedSamples) -> list[Overlap]:
    names = [name for name in rows.channels if name in record]
    if not names or rows.t.size < SETTINGS.rows or record.t.size < SETTINGS.rows:
        return []
    mine = np.column_stack([record[name] for name in names])
    theirs = np.column_stack([rows.channels[name] for name in names])
    allowed = SETTINGS.same * np.maximum(np.max(np.abs(theirs), axis=0), 1.0e-12)

    def matched(shift: float) -> np.ndarray:
        """Which rows of the record stand among the fitted ones, these moved by ``shift`` [s]."""
        required = record.t - shift
        at = np.clip(np.searchsorted(rows.t, required), 1, rows.t.size - 1)
        at = at - (required - rows.t[at - 1] < rows.t[at] - required)
        near = np.abs(rows.t[at] - required) <= SETTINGS.on_time * record.sample_time
        return near & np.all(np.abs(theirs[at] - mine) <= allowed, axis=1)

    same = matched(_shift(record.t, mine, rows.t, theirs, allowed))
    return [
        run
        for run in _runs(record.t, same, rows)
        # at rest any two logs are alike
        if np.any(np.ptp(mine[(record.t >= run.start) & (record.t <= run.stop)], axis=0) > allowed)
    ]


def _same_noise(record: Record, rows: FittedSamples) -> list[Overlap]:
    """Where a record has the noise of fitted samples, though not their rows."""
    if min(rows.t.size, record.t.size) < SETTINGS.block:
        return []
    shared = {name: values for name, values in rows.channels.items() if name in record}
    # of white noise: the median of third differences, which steps and ringing hardly touch
    levels = {
        name: MAD * float(np.median(np.abs(np.diff(values, 3)))) / math.sqrt(20.0)
        for name, values in shared.items()
    }
    names = [name for name, values in shared.items() if _tells(values, levels[name])]
    if not names:
        return []
    noise = np.array([levels[name] for name in names])
    mine = np.column_stack([record[name] for name in names])
    theirs = np.column_stack([rows.channels[name] for name in names])
    best: np.ndarray = np.zeros(record.t.size, dtype=bool)
    for shift in {0.0, _aligned(record.t, mine / noise, rows.t, theirs / noise)}:
        same = _same_blocks(record.t - shift, mine / noise, rows.t, theirs / noise)
        best = max(best, same, key=np.count_nonzero)
    at = np.flatnonzero(best)
    tick = max(float(np.median(np.diff(record.t))), float(np.median(np.diff(rows.t))))
    for first, last in zip(at[:-1], at[1:], strict=True):  # blocks between that were too quiet
        if record.t[last] - record.t[first] < SETTINGS.quiet * SETTINGS.block * tick:
            best[first:last] = True
    return _runs(record.t, best, rows)


def _tells(y: np.ndarray, noise: float) -> bool:
    """Whether a channel has a noise of its own, not only that of its counts: the smallest steps
    between its readings are finer than its noise.
    """
    steps = np.diff(np.unique(y))
    fine = steps.size > 0 and float(np.quantile(steps, SETTINGS.finest)) < SETTINGS.fine * noise
    return fine and noise > SETTINGS.same * float(np.max(np.abs(y)))


def _same_blocks(
    t: np.ndarray, mine: np.ndarray, when: np.ndarray, theirs: np.ndarray
) -> np.ndarray:
    """Which samples of ``mine``, shape (samples, channels), stand in blocks in which ``theirs`` is
    nearer than its noise, which is 1: half at least of the channels that have some there.

    Each is compared at the other's times, on straight lines between samples, and the slower also
    with the faster's means over its sample time.
    """
    slower, faster = ((t, mine), (when, theirs))
    if np.median(np.diff(t)) < np.median(np.diff(when)):
        slower, faster = faster, slower
    same = np.zeros(t.size, dtype=bool)
    for item, other, between in (
        (slower, faster, _interpolated),
        (slower, faster, _sample_means),
        (faster, slower, _interpolated),
    ):
        inside = (item[0] >= other[0][0]) & (item[0] <= other[0][-1])
        at, y = item[0][inside], item[1][inside]
        if at.size < SETTINGS.block:
            continue
        left = y - between(at, *other)
        for first in range(0, at.size - SETTINGS.block + 1, SETTINGS.block):
            block = slice(first, first + SETTINGS.block)
            noisy = _rms(np.diff(y[block], 3, axis=0)) > SETTINGS.agree * math.sqrt(20.0)
            near = _rms(left[block])[noisy] < SETTINGS.noise
            if noisy.any() and np.mean(near) >= SETTINGS.agree:
                same |= (t >= at[first]) & (t <= at[block.stop - 1])
    return same


def _rms(y: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(y**2, axis=0))


def _interpolated(at: np.ndarray, t: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Channels between their samples, on straight lines."""
    return np.column_stack([np.interp(at, t, column) for column in y.T])


def _sample_means(at: np.ndarray, t: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Means of channels over a sample time about each of some times: differences of their running
    sums.
    """
    half, tick = 0.5 * float(np.median(np.diff(at))), float(np.median(np.diff(t)))
    edges = np.append(t - 0.5 * tick, t[-1] + 0.5 * tick)
    sums = np.vstack([np.zeros(y.shape[1]), np.cumsum(y * tick, axis=0)])
    return (_interpolated(at + half, edges, sums) - _interpolated(at - half, edges, sums)) / (
        2.0 * half
    )


def _aligned(t: np.ndarray, mine: np.ndarray, when: np.ndarray, theirs: np.ndarray) -> float:
    """By how much [s] a record is later than fitted samples that it looks most alike: the peak of
    the correlation of the channel that moves most, refined by least squares.
    """
    from scipy.signal import correlate

    column = int(np.argmax(np.std(theirs, axis=0)))
    y, other = mine[:, column], theirs[:, column]
    tick = float(np.median(np.diff(when)))
    grid = np.arange(t[0], t[-1], tick)
    first, second = np.diff(np.interp(grid, t, y)), np.diff(other)
    lag = int(np.argmax(correlate(first, second, "full"))) - (second.size - 1)
    shift = float(t[0] - when[0]) + lag * tick
    slope = np.gradient(other, when)
    for _ in range(4):
        inside = (t - shift >= when[0]) & (t - shift <= when[-1])
        steep = np.interp(t[inside] - shift, when, slope)
        left = y[inside] - np.interp(t[inside] - shift, when, other)
        if not (steep**2).sum() > 0.0:
            break
        shift -= float(np.clip((left @ steep) / (steep @ steep), -tick, tick))
    return shift


def _runs(t: np.ndarray, same: np.ndarray, rows: FittedSamples) -> list[Overlap]:
    """The stretches of samples that are marked, but for single ones."""
    at = np.flatnonzero(same)
    tick = max(float(np.median(np.diff(t))), float(np.median(np.diff(rows.t))))
    return [
        Overlap(rows.log, float(t[run[0]]), float(t[run[-1]]), int(run.size))
        for run in np.split(at, np.flatnonzero(np.diff(t[at]) > 2.5 * tick) + 1)
        if run.size >= SETTINGS.rows
    ]


def _shift(
    t: np.ndarray, mine: np.ndarray, when: np.ndarray, theirs: np.ndarray, allowed: np.ndarray
) -> float:
    """By how much [s] the time of a copy is later: what most of some rows found in it say; 0 where
    they do not agree.
    """
    probes = np.unique(np.linspace(0, when.size - 1, SETTINGS.probes).astype(int))
    shifts = []
    for probe in probes:
        hits = np.flatnonzero(np.all(np.abs(mine - theirs[probe]) <= allowed, axis=1))
        if hits.size == 1:
            shifts.append(float(t[hits[0]] - when[probe]))
    if not shifts:
        return 0.0
    middle = float(np.median(shifts))
    near = np.abs(np.array(shifts) - middle) <= SETTINGS.on_time * float(np.median(np.diff(when)))
    return middle if np.mean(near) >= SETTINGS.agree else 0.0
