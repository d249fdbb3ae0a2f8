"""An operating point under the pressure feedback, in linear form: its poles, its margins, bandwidth
and stability limit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ehbench.control.functions import HEAD, METERED, PATH_FLOWS, RAISED, Circuit, coupled
from ehbench.tune.linear import AT_ZERO, LinearModel, are_rates, first_valve, write_delay
from ehbench.tune.operating_point import FED, INTO, OperatingPoint
from ehbench.tune.results import Margins
from ehbench.tune.stability import OpenLoop, gain_margin, phase_margin
from ehbench.vocabulary.codes import FUNCTIONS


@dataclass(frozen=True)
class Law:
    """The pressure feedback in linear form: ``Q = A v_d − K_p F(s) P``, off-side ``Q = A v_d +
    off_gain·(set-point − P)``.

    ``washout`` ω_w and ``ramp_washout`` ω_r [rad/s], ``F = s/(s + ω_w)·s/(s + ω_r)``, 0 for none;
    ``off_gain`` [m³/(s·Pa)]; ``delay`` [s] from pressure to command; ``feedback`` the metered
    chamber's pressure, or the load force over the metered area."""

    washout: float
    off_gain: float
    delay: float
    ramp_washout: float = 0.0
    feedback: Literal["metered", "load"] = "metered"

    def without_feedback(self) -> Law:
        """The same law with neither feedback: at K_p = 0 the off-side is not held either."""
        return replace(self, washout=0.0, ramp_washout=0.0, off_gain=0.0)


@dataclass(frozen=True)
class Loop:
    """An operating point under the control law with K_p left open: ``ẋ = (a + K_p b c) x + d v_d +
    e f``, ``v = x[0]``.

    ``b`` is the feedback flow's way in, ``c`` what is fed back [Pa], so the root locus is that of
    ``1 + K_p L``, L = −c (s − a)⁻¹ b. ``off`` is the part of a that the off-side's pressure control
    makes, of rank one. Poles beyond ``fastest`` [rad/s] are those of the delay's Padé form, whose
    states are ``late``. States are scaled; ``v`` stays in m/s."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray
    e: np.ndarray
    off: np.ndarray
    fastest: float
    delay: float
    late: slice

    def closed(self, gain: float | np.ndarray) -> np.ndarray:
        """State matrix at a gain [m³/(s·Pa)], or a stack of them."""
        return self.a + np.multiply.outer(np.asarray(gain), np.outer(self.b, self.c))

    def damping_ratio(self, gain: float | np.ndarray) -> np.ndarray:
        """Least damping ratio of the closed loop at a gain, or at each of several."""
        return damping_ratio(np.linalg.eigvals(self.closed(gain)), self.fastest)


def close(linear: LinearModel, point: OperatingPoint, circuit: Circuit, law: Law) -> Loop:
    """The loop of a linear model under the control law.

    The valve level inverts each edge at its measured drop: ``δu = (δQ − slope·δΔp)/gain``, with
    pressures ``delay`` old (Padé form). Where one command serves both ends the path that sets the
    motion decides it."""
    function = FUNCTIONS.index(point.function)
    areas = np.array([circuit.area_head, circuit.area_rod])
    head = METERED[function] == HEAD
    sources = [1, 2, *(i for i, name in enumerate(linear.states) if name == "p_supply")]
    size, fixed = len(linear.a), 2 * len(sources) if law.delay > 0 else 0
    corners = [corner for corner in (law.washout, law.ramp_washout) if corner > 0]
    total = size + fixed + len(corners)
    a = np.zeros((total, total))
    a[:size, :size] = linear.a
    seen = _seen(a, sources, size, law.delay)
    back = seen[0 if head else 1].copy()
    if law.feedback == "load":
        back = (areas[0] * seen[0] - areas[1] * seen[1]) / (areas[0] if head else -areas[1])
    for at, corner in enumerate(corners, size + fixed):
        a[at] = corner * back
        a[at, at] -= corner
        back[at] -= 1.0
    # chamber flows (Q1, Q2) for the pressures seen, for the feedback flow, for v_d
    held_flow = _off_side_flows(law, seen, function)
    way_in = np.array([-1.0, 0.0]) if head else np.array([0.0, 1.0])
    orders, off = np.zeros((2, len(linear.valves), total))
    direct, drive = np.zeros((2, len(linear.valves)))
    together = coupled(circuit, function)
    for path in point.paths:
        if together and not path.metering:
            continue
        i, share = linear.valves.index(path.valve), PATH_FLOWS[function, path.path]
        orders[i] = path.slope * INTO[path.path] @ seen[:2] / path.gain
        if path.path in FED and len(seen) > 2:
            orders[i] -= path.slope * seen[2] / path.gain
        off[i] = share @ held_flow / path.gain
        direct[i], drive[i] = share @ way_in / path.gain, share @ areas / path.gain
    put = np.zeros((total, len(linear.valves)))
    put[:size] = linear.b
    a += put @ (orders + off)
    e = np.zeros(total)
    e[:size] = linear.e
    scale = np.full(total, 1.0e6)
    scale[:size] = _sizes(linear.states)
    ratio = scale / scale[:, None]
    fastest = min(2.5 / law.delay if fixed else math.inf, linear.fastest)
    fastest = math.inf if linear.swing > fastest else fastest  # what swings counts in any case
    return Loop(
        a * ratio,
        put @ direct / scale,
        back * scale,
        put @ drive / scale,
        e / scale,
        put @ off * ratio,
        fastest,
        law.delay,
        slice(size, size + fixed),
    )


def _off_side_flows(law: Law, seen: np.ndarray, function: int) -> np.ndarray:
    """Chamber flows (Q1, Q2) [m³/s] with which the off-side's law answers the pressures seen."""
    flows = np.zeros((2, seen.shape[1]))
    if METERED[function] != HEAD:
        flows[0] = -law.off_gain * seen[0]
    elif RAISED[function]:
        flows[1] = law.off_gain * (seen[1] - seen[0])
    else:
        flows[1] = law.off_gain * seen[1]
    return flows


def _sizes(names: Sequence[str]) -> np.ndarray:
    """Usual sizes of the states: m/s, MPa, mm, what sways m/s, V, 100 V/s."""
    sizes = np.ones(len(names))
    sizes[1 : first_valve(names)] = 1.0e6
    sizes[are_rates(names)] = 100.0
    sizes[[name.endswith((".mount_deflection", ".sway")) for name in names]] = 1.0e-3
    sizes[[name.endswith(".sway_speed") for name in names]] = 1.0
    return sizes


def _seen(a: np.ndarray, sources: Sequence[int], size: int, delay: float) -> np.ndarray:
    """Pressures as the controller has them, of head, rod and a supply that follows them, over all
    states, shape (sources, states); ``sources`` are their own states.

    A delay [s] is written into ``a``, with states from ``size`` on."""
    seen = np.zeros((len(sources), len(a)))
    seen[range(len(sources)), sources] = 1.0
    if delay > 0:
        for k, source in enumerate(sources):
            at = size + 2 * k
            a[at + 1, source], seen[k, at + 1] = write_delay(a, at, delay)
    return seen


def damping_ratio(poles: Any, fastest: float = math.inf) -> np.ndarray:
    """Least damping ratio of the poles along the last axis: −Re s/|s|; 1 for real stable poles, −1
    for real unstable ones.

    Poles at zero, such as that of a chamber which nothing holds, do not count, nor stable ones
    beyond ``fastest`` [rad/s]."""
    size, counts = np.abs(poles), _counts(poles, fastest)
    return np.where(counts, -poles.real / np.where(counts, size, 1.0), 1.0).min(axis=-1)


def _counts(poles: Any, fastest: float) -> np.ndarray:
    """Which of the poles along the last axis `damping_ratio` counts."""
    size = np.abs(poles)
    nonzero = size > AT_ZERO * size.max(axis=-1, keepdims=True)
    return nonzero & ((size < fastest) | (poles.real > 0.0))


def dominant(poles: Any, fastest: float = math.inf) -> complex:
    """The least damped of the poles that `damping_ratio` counts, upper half; the slowest if all are
    real."""
    among = poles[_counts(poles, fastest)]
    best = among[np.lexsort((np.abs(among), -among.real / np.abs(among)))[0]]
    return complex(best.real, abs(best.imag))


def violations(result: Margins, demands: dict[str, float]) -> list[str]:
    """Words for the demands that margins do not keep."""
    return [
        key.replace("_", " ") for key, demand in demands.items() if getattr(result, key) < demand
    ]


def margins(loop: Loop, gain: float) -> Margins:
    """Margins of the feedback and the off-side's loop, each with the other closed, and the
    bandwidth."""
    loops = _open_loops(loop, gain)
    if any(item.growth() > 0.0 for item in loops):
        return Margins(0.0, 0.0, bandwidth(loop, gain))
    return Margins(
        min((gain_margin(item) for item in loops), default=math.inf),
        min((phase_margin(item) for item in loops), default=math.inf),
        bandwidth(loop, gain),
    )


def system_of(a: np.ndarray, b: np.ndarray, c: np.ndarray):
    import control

    return control.ss(a, b[:, None], c[None, :], 0.0)


def speed_of(loop: Loop, gain: float):
    """Speed over desired speed."""
    return system_of(loop.closed(gain), loop.d, np.eye(len(loop.a))[0])


def _open_loops(loop: Loop, gain: float) -> list[OpenLoop]:
    """The loop of the feedback, and of the off-side pressure control if there is one."""
    late = loop.delay, loop.late
    loops = [OpenLoop(loop.a, gain * loop.b, -loop.c, *late)] if gain > 0 else []
    u, s, v = np.linalg.svd(loop.off)
    if s[0] > 0:
        loops.append(OpenLoop(loop.closed(gain) - loop.off, s[0] * u[:, 0], -v[0], *late))
    return loops


def bandwidth(loop: Loop, gain: float) -> float:
    """First frequency [rad/s] at which speed over desired speed falls 3 dB below its value at
    standstill; inf if it does not.

    On a grid of 200 frequencies a decade pair, between them by interpolation; python-control does
    the same one by one."""
    a, n = loop.closed(gain), len(loop.a)
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
    """Gain [m³/(s·Pa)] above which the loop is unstable; inf beyond ``gains``, 0 if it is never
    stable."""
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
