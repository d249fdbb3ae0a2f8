"""One pump for several cylinders: where a motion would draw more than the pump gives, time along it
runs slower, so that all speeds are cut in one proportion and every cylinder keeps to its way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

RESERVE = 0.1  # share of the pump's flow that is left for what controllers correct
SMOOTH = 0.15  # [s] of desired time over which the pace changes


@dataclass(frozen=True)
class Pace:
    """How fast time runs along a desired motion, one row a tick of real time.

    ``at`` [s] of the desired motion; ``pace`` σ = d(at)/dt, 1 where nothing is cut, and its
    derivatives ``rate`` [1/s] and ``bend`` [1/s²] in real time."""

    at: np.ndarray
    pace: np.ndarray
    rate: np.ndarray
    bend: np.ndarray

    def of(self, values: np.ndarray, tick: float) -> np.ndarray:
        """Values of the desired motion, a row a tick, as they come in real time."""
        rows = np.arange(len(values)) * tick
        flat = values.reshape(len(values), -1)
        taken = np.column_stack([np.interp(self.at, rows, column) for column in flat.T])
        return taken.reshape((self.at.size, *values.shape[1:]))

    def table(self, desired: np.ndarray, tick: float) -> np.ndarray:
        """A table of x, v, a, j in real time: ``v = v̂ σ``, ``a = â σ² + v̂ σ̇``,
        ``j = ĵ σ³ + 3 â σ σ̇ + v̂ σ̈``.
        """
        x, v, a, j = self.of(desired, tick).T
        s, rate, bend = self.pace, self.rate, self.bend
        columns = [x, v * s, a * s**2 + v * rate, j * s**3 + 3.0 * a * s * rate + v * bend]
        return np.ascontiguousarray(np.column_stack(columns))


def pace_of(flow: np.ndarray, limit: float, tick: float) -> Pace | None:
    """The pace at which a motion draws no more than a limit; None where it never would.

    The least share that the flow allows within SMOOTH on either side, smoothed over as much by a
    bell that ends there: so it is nowhere above what the flow allows, and its second derivative is
    continuous.

    Args:
        flow: that the desired motion draws [m³/s], a row a tick.
        limit: [m³/s], > 0.
        tick: [s].
    """
    from scipy.ndimage import minimum_filter1d

    share = np.minimum(1.0, limit / np.maximum(flow, 1e-3 * limit))
    if (share == 1.0).all():
        return None
    half = max(1, round(SMOOTH / tick))
    bell = (1.0 - (np.arange(-half, half + 1) / (half + 1.0)) ** 2) ** 3
    minimum = minimum_filter1d(share, 2 * half + 1, mode="nearest")
    pace = np.convolve(np.pad(minimum, half, mode="edge"), bell / bell.sum(), mode="valid")
    slope = np.gradient(pace, tick)
    curve = np.gradient(slope, tick)
    # real time at each row of the desired motion, then the other way round
    real = np.concatenate([[0.0], np.cumsum(0.5 * tick * (1.0 / pace[1:] + 1.0 / pace[:-1]))])
    rows = np.arange(flow.size) * tick
    at = np.interp(np.arange(int(np.ceil(real[-1] / tick - 1e-9)) + 1) * tick, real, rows)
    sigma, first, second = (np.interp(at, rows, item) for item in (pace, slope, curve))
    return Pace(at, sigma, first * sigma, second * sigma**2 + first**2 * sigma)
