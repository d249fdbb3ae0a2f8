"""Time stamps that jitter about an even rate: which rows are missing, and which are merely early or
late.

A bus or a busy computer stamps a sample when it gets to it. One step between two stamps then tells
little: a late stamp makes the step before it long and the next one short, a missing row makes it
long for good. But all stamps lie about the beats of one clock, however many of these are missing.
So the clock is told first, by the circular mean of the stamps over its period, block by block, and
each row gets the beat next to its stamp."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

EARLY = 0.25  # rms share of the sample time by which stamps may be off an even rate …
MOST = 1.0  # … and at most
FEWEST = 20  # stamps that tell a rate
_SPAN = 20  # rows over which steps tell a first guess of the rate, which jitter blurs the less
_BLOCK = 50  # rows that tell where the clock's beats lie
_TURNS = 2  # the second with the rate that the first has found


class Stamps(NamedTuple):
    """What time stamps tell of an even rate.

    Attributes:
        period: [s] of the rate.
        number: of each row on that rate, from 0 on, increasing; shape (rows,).
        off: [s] by which each stamp is late of its number, mean 0; shape (rows,).
    """

    period: float
    number: np.ndarray
    off: np.ndarray

    @property
    def missing(self) -> np.ndarray:
        """Rows that are missing behind each but the last; shape (rows − 1,)."""
        return np.diff(self.number) - 1

    @property
    def even(self) -> bool:
        """Whether the stamps are those of an even rate, early or late by less than a row."""
        rms = float(np.sqrt(np.mean(self.off**2)))
        return rms <= EARLY * self.period and float(np.abs(self.off).max()) <= MOST * self.period


def stamps_of(t: np.ndarray, period: float | None = None) -> Stamps | None:
    """The rows of time stamps on an even rate; none where they are too few to tell one.

    Args:
        t: [s] increasing, shape (rows,).
        period: [s] of the rate, where it is known.
    """
    if t.size < FEWEST:
        return None
    spans = t[_SPAN - 1 :] - t[: 1 - _SPAN]
    message = float(np.median(spans)) / (_SPAN - 1) if period is None else period
    if not message > 0.0:
        return None
    number = _beats(t, message)
    for _ in range(_TURNS - 1):
        if period is None:
            message = float(np.polyfit(number - number[0], t - t[0], 1)[0])
        number = _beats(t, message)
    off = t - message * number
    return Stamps(message, number, off - off.mean())


def _beats(t: np.ndarray, period: float) -> np.ndarray:
    """By row, the beat of a clock of a ``period`` [s] that is next to its stamp, from 0 on; of
    several stamps at one beat the last keeps it, and those before are late ones of earlier beats.
    """
    cycles = (t - t[0]) / period
    blocks = np.array_split(np.arange(t.size), max(1, t.size // _BLOCK))
    turned = np.exp(2j * np.pi * cycles)
    phases = np.unwrap([np.angle(turned[block].sum()) for block in blocks]) / (2.0 * np.pi)
    centres = [cycles[block].mean() for block in blocks]
    number = np.rint(cycles - np.interp(cycles, centres, phases)).astype(int)
    rows = np.arange(t.size)
    # number[i] = min over j >= i of number[j] − (j − i)
    number = np.minimum.accumulate((number - rows)[::-1])[::-1] + rows
    return number - number[0]
