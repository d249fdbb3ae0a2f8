"""Margins, bandwidth and stability limit of a loop, by python-control where it has them."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np

from ehbench.tune.loop import Loop, damping_ratio, dominant
from ehbench.tune.results import Margins


def violations(result: Margins, demands: dict[str, float]) -> list[str]:
    """Words for the demands that margins do not keep."""
    return [
        key.replace("_", " ") for key, demand in demands.items() if getattr(result, key) < demand
    ]


def margins(loop: Loop, gain: float) -> Margins:
    """Margins of the feedback loop and of the off-side loop, each with the other closed, and
    bandwidth at a gain [m³/(s·Pa)].
    """
    least_gain, least_phase = math.inf, math.inf
    for system in _open_loops(loop, gain):
        g, p = _stability(system)
        least_gain, least_phase = min(least_gain, g), min(least_phase, p)
    return Margins(least_gain, least_phase, bandwidth(loop, gain))


def system_of(a: np.ndarray, b: np.ndarray, c: np.ndarray):
    import control

    return control.ss(a, b[:, None], c[None, :], 0.0)


def speed_of(loop: Loop, gain: float):
    """Speed over desired speed."""
    return system_of(loop.closed(gain), loop.d, np.eye(loop.a.shape[0])[0])


def _open_loops(loop: Loop, gain: float) -> list:
    """Loop transfer functions of the feedback, and of the off-side pressure control if there is
    one.
    """
    systems = [system_of(loop.a, gain * loop.b, -loop.c)] if gain > 0 else []
    u, s, v = np.linalg.svd(loop.off)
    if s[0] > 0:
        systems.append(system_of(loop.closed(gain) - loop.off, s[0] * u[:, 0], -v[0]))
    return systems


def _stability(system) -> tuple[float, float]:
    """(gain margin as a factor, phase margin [rad]); inf where there is none, 0 where the closed
    loop is unstable.
    """
    import control

    closed = np.linalg.eigvals(system.A - system.B @ system.C)
    if damping_ratio(closed) < 0.0:
        return 0.0, 0.0
    with warnings.catch_warnings():
        # python-control looks for roots of polynomials of widely spread coefficients, and says so
        warnings.filterwarnings(
            "ignore",
            message=".*(ill-conditioned|badly conditioned|overflow|divide by zero|invalid value).*",
        )
        gains, phases, _, crossings, _, _ = control.stability_margins(system, returnall=True)
    up = [g for g in np.atleast_1d(gains) if g > 1.0]
    return min(up, default=math.inf), math.radians(
        min(np.abs(np.atleast_1d(phases)), default=math.inf)
    )


def bandwidth(loop: Loop, gain: float) -> float:
    """First frequency [rad/s] at which speed over desired speed falls 3 dB below its value at
    standstill; inf if it does not.

    On a grid of 200 frequencies a decade pair, between them by interpolation; python-control does
    the same one by one."""
    a, n = loop.closed(gain), loop.a.shape[0]
    size = np.abs(np.linalg.eigvals(a))
    omega = np.geomspace(1e-2, 10.0, 400) * np.abs(
        dominant(np.linalg.eigvals(loop.a), loop.fastest)
    )
    grid = np.concatenate([[1e-3 * min(omega[0], size[size > 0].min())], omega])
    reply = np.linalg.solve(
        1j * grid[:, None, None] * np.eye(n) - a, np.broadcast_to(loop.d, (grid.size, n))[..., None]
    )[:, 0, 0]
    level = np.log(np.abs(reply) / np.abs(reply[0])) + 0.5 * math.log(2.0)
    below = np.flatnonzero(level < 0)
    if not below.size:
        return math.inf
    k = int(below[0])
    part = level[k - 1] / (level[k - 1] - level[k])
    return float(np.exp((1 - part) * np.log(grid[k - 1]) + part * np.log(grid[k])))


def gain_limit(loop: Loop, gains: np.ndarray) -> float:
    """The gain [m³/(s·Pa)] above which the closed loop is unstable; inf if not within ``gains``, 0
    if it is never stable.
    """
    from scipy.optimize import brentq

    def rightmost(gain):
        return np.linalg.eigvals(loop.closed(gain)).real.max(axis=-1)

    growth = rightmost(gains)
    calm = (
        1e-9 * np.abs(loop.a).max()
    )  # a pole at zero, such as that of a chamber which nothing holds, is stable
    stable = growth < calm
    if not stable.any():
        return 0.0
    first = int(stable.argmax())
    after = np.flatnonzero(~stable[first:])
    if not after.size:
        return math.inf
    at = first + int(after[0])
    low, high = gains[at - 1], gains[at]
    limit: Any = brentq(
        lambda g: rightmost(g) - calm, low, high, rtol=np.float64(1e-9), xtol=1e-9 * high
    )
    return float(limit)
