"""Timestamps that jitter about an even rate: which rows are missing, and which are merely early or
late.

A bus or a busy computer stamps a sample when it gets to it. A late stamp makes the step before it
long and the next one short, a missing row makes it long for good. But all stamps lie about the
beats of one clock, however many of these are missing. So the clock is estimated first, by the
circular mean of the stamps over its period, block by block, and each row gets the beat next to its
stamp."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ehbench.vocabulary import setting


@dataclass(frozen=True)
class TimestampSettings:
    """Numbers of timestamps that jitter."""

    rms: float = setting(0.25, "", "rms error of stamps, of the sample time", "below a half")
    largest: float = setting(1.0, "", "the same at most", "a row")
    fewest: int = setting(20, "", "timestamps that show a rate", "jitter averages out")
    coarse: float = setting(0.1, "", "resolution that counts, of the sample time", "rounding")
    coarsest: float = setting(4.0, "", "the same that hides the rate", "rows a step")
    lossy: float = setting(0.75, "", "the same at which lost rows show", "steps of 1 or 2")
    fewest_long: int = setting(10, "", "odd steps of rounded stamps with a rate", "no losses")
    rounded: float = setting(0.6, "", "error of rounded stamps, of their resolution", "a half")
    block: int = setting(50, "", "rows that show the clock's beats", "jitter averages out")


SETTINGS = TimestampSettings()
_TURNS = (2.0**16, 2.0**32)


class Timestamps(NamedTuple):
    """An even rate of timestamps.

    Attributes:
        period: [s] of the rate.
        number: of each row on that rate, from 0 on, increasing; shape (rows,).
        off: [s] by which each stamp is late of its number, mean 0; shape (rows,)."""

    period: float
    number: np.ndarray
    off: np.ndarray

    @property
    def missing(self) -> np.ndarray:
        """Rows that are missing after each but the last; shape (rows − 1,)."""
        return np.diff(self.number) - 1

    @property
    def even(self) -> bool:
        """Whether the stamps are those of an even rate, early or late by less than a row."""
        rms, largest = float(np.sqrt(np.mean(self.off**2))), float(np.abs(self.off).max())
        return rms <= SETTINGS.rms * self.period and largest <= SETTINGS.largest * self.period


class Resolution(NamedTuple):
    """What numbers are rounded to: a step of decimals, and that of floats of 32 bits; 0 of none."""

    decimal: float
    narrow: float


def resolution(values: np.ndarray) -> Resolution:
    """The step between neighbours of the numbers that these are written in."""
    known = np.abs(values[np.isfinite(values)])
    if not known.size or not known.any():
        return Resolution(0.0, 0.0)
    top = known.max()  # which a power of ten may exceed as it is rounded
    largest = known[known >= min(top, 10.0 ** np.floor(np.log10(top)))]
    with np.errstate(over="ignore"):
        single = largest.astype(np.float32)
    narrow = float(np.spacing(single.max())) if np.array_equal(single, largest) else 0.0
    for decimal in 10.0 ** -np.arange(10):
        whole = largest / decimal
        if np.abs(whole - np.rint(whole)).max() <= 1e-6 + 4.0 * np.spacing(whole.max()):
            return Resolution(float(decimal), narrow)
    return Resolution(0.0, narrow)


def unrounded(t: np.ndarray, step: float) -> np.ndarray:
    """Times [s] of an even rate, where these are off it by half the ``step`` [s] of their rounding
    and too often for missing samples, or have rows missing on its beats; others as they are."""
    steps = np.diff(t)
    if not np.isfinite(t).all() or t.size < SETTINGS.fewest or steps.min() < 0.0:
        return t
    tick = (t[-1] - t[0]) / steps.size
    odd = np.abs(steps - np.median(steps)) > 0.5 * step
    if not SETTINGS.coarse * tick <= step <= SETTINGS.coarsest * tick or not odd.any():
        return t
    count = np.arange(t.size)
    even = np.polyval(np.polyfit(count, t, 1), count)
    fits = np.abs(even - t).max() <= SETTINGS.rounded * step
    if fits and odd.sum() >= SETTINGS.fewest_long:
        return even
    stamps = timestamps_of(t) if step <= SETTINGS.lossy * tick else None
    if stamps is None or np.abs(stamps.off).max() > SETTINGS.rounded * step:
        return t
    return t[0] - stamps.off[0] + stamps.period * stamps.number


def rate_of_rounded(t: np.ndarray) -> float:
    """Rows a unit of increasing times that are rounded to several rows: those between the first and
    the last change."""
    ends = np.flatnonzero(np.diff(t) > 0.0)[[0, -1]] + 1
    first, last = ends if ends[0] < ends[1] else (0, t.size - 1)
    return float((last - first) / (t[last] - t[first]))


def unwrapped(counts: np.ndarray) -> np.ndarray:
    """Counts of a clock of 16 or 32 bits that go on where it begins again: where that makes no step
    longer than the longest of the others. Others as they are, such as of a clock that was reset."""
    rows = np.flatnonzero(np.isfinite(counts))
    y = counts[rows]
    steps = np.diff(y)
    back = steps < 0.0
    if not back.any() or back.all() or np.any(y != np.rint(y)):
        return counts
    for turn in _TURNS:
        if np.ptp(y) < turn and np.all(steps[back] + turn <= steps[~back].max()):
            result = counts.copy()
            result[rows[1:]] += turn * np.cumsum(back)
            return result
    return counts


def timestamps_of(t: np.ndarray, period: float | None = None) -> Timestamps | None:
    """The rows of timestamps on an even rate; none where they are too few to show one.

    Args:
        t: [s] increasing, shape (rows,).
        period: [s] of the rate, where it is known."""
    fewest = SETTINGS.fewest
    if t.size < fewest:
        return None
    spans = t[fewest - 1 :] - t[: 1 - fewest]
    tick = float(np.median(spans)) / (fewest - 1) if period is None else period
    if not tick > 0.0:
        return None
    number = _beats(t, tick)
    if period is None:
        tick = float(np.polyfit(number - number[0], t - t[0], 1)[0])
    number = _beats(t, tick)
    off = t - tick * number
    return Timestamps(tick, number, off - off.mean())


def missing_rows(t: np.ndarray, period: float, slack: float) -> np.ndarray:
    """Missing rows after each, shape (rows − 1,): by steps, or by all stamps where they are off by
    more than ``slack`` [s]."""
    steps = np.diff(t)
    missing = np.where(steps > period + slack, np.rint(steps / period) - 1, 0)
    if np.any(np.abs(steps - (missing + 1) * period) > slack):
        stamps = timestamps_of(t)
        return stamps.missing if stamps is not None and stamps.even else missing
    return missing


def _beats(t: np.ndarray, period: float) -> np.ndarray:
    """By row the beat of a clock of a ``period`` [s] next to its stamp; of several stamps at one
    beat the last keeps it."""
    cycles = (t - t[0]) / period
    blocks = np.array_split(np.arange(t.size), max(1, t.size // SETTINGS.block))
    turned = np.exp(2j * np.pi * cycles)
    phases = np.unwrap([np.angle(turned[block].sum()) for block in blocks]) / (2.0 * np.pi)
    centres = [cycles[block].mean() for block in blocks]
    number = np.rint(cycles - np.interp(cycles, centres, phases)).astype(int)
    rows = np.arange(t.size)
    # number[i] = min over j >= i of number[j] − (j − i)
    number = np.minimum.accumulate((number - rows)[::-1])[::-1] + rows
    return number - number[0]
