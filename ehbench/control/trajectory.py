"""What a cylinder shall do: tables of x_d, v_d, a_d, j_d with continuous jerk, velocity steps, and
the shaping of a step.

A table has one row a tick, columns X, V, A, J [m, m/s, m/s², m/s³]."""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from ehbench.control.records import blank, reals
from ehbench.runtime.compiled import kernel, record
from ehbench.runtime.memory import rows_of
from ehbench.vocabulary import InputError, message


class Reference(NamedTuple):
    """Desired stroke x [m], speed v, acceleration a, jerk j [SI], extension positive; a row of a
    table."""

    x: float
    v: float
    a: float
    j: float


X, V, A, J = range(4)  # columns of a table, the orders of the derivative
ORDERS = 4
PREVIEWED = 2  # columns that `with_preview` adds
Profile = Literal["ramp", "seventh"]
# peaks of the seventh-order polynomial s(τ) = 35τ⁴ − 84τ⁵ + 70τ⁶ − 20τ⁷ and of the quintic speed
# ramp 10τ³ − 15τ⁴ + 6τ⁵
_SEVENTH = np.array([0.0, 0.0, 0.0, 0.0, 35.0, -84.0, 70.0, -20.0])
_SEVENTH_SPEED, _SEVENTH_ACCELERATION, _SEVENTH_JERK = (
    35.0 / 16.0,
    84.0 * math.sqrt(5.0) / 25.0,
    52.5,
)
_QUINTIC = np.array([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])
_QUINTIC_SLOPE, _QUINTIC_CURVE = 15.0 / 8.0, 10.0 / math.sqrt(3.0)


def _polynomial(coefficients: np.ndarray, tau: np.ndarray, order: int) -> np.ndarray:
    """The ``order``-th derivative (−1: integral from 0) of a polynomial, ascending coefficients."""
    poly = np.polynomial.Polynomial(coefficients)
    return (poly.integ() if order < 0 else poly.deriv(order) if order else poly)(tau)


class _Move:
    """A move from rest to rest over ``distance`` > 0; ``at(t)`` gives (n, 4)."""

    def __init__(
        self, distance: float, speed: float, acceleration: float, jerk: float, profile: Profile
    ) -> None:
        self.distance, self.profile = distance, profile
        if profile == "seventh":
            self.time = max(
                _SEVENTH_SPEED * distance / speed,
                math.sqrt(_SEVENTH_ACCELERATION * distance / acceleration),
                math.cbrt(_SEVENTH_JERK * distance / jerk),
            )
            return
        # ramp up and down cover speed·ramp together; a short move never reaches the full speed
        short = min(
            math.sqrt(distance * acceleration / _QUINTIC_SLOPE),
            math.cbrt(distance**2 * jerk / _QUINTIC_CURVE),
        )
        self.speed = min(speed, short)
        self.ramp = max(
            _QUINTIC_SLOPE * self.speed / acceleration,
            math.sqrt(_QUINTIC_CURVE * self.speed / jerk),
        )
        self.time = self.ramp + distance / self.speed

    def at(self, t: np.ndarray) -> np.ndarray:
        out = np.zeros((t.size, ORDERS))
        if self.profile == "seventh":
            for order in range(ORDERS):
                out[:, order] = (
                    self.distance * _polynomial(_SEVENTH, t / self.time, order) / self.time**order
                )
            return out
        # the second half mirrors the first
        late = t > 0.5 * self.time
        u = np.where(late, self.time - t, t)
        tau = np.minimum(u / self.ramp, 1.0)
        beyond = u - np.minimum(u, self.ramp)
        half = [self.speed * (self.ramp * _polynomial(_QUINTIC, tau, -1) + beyond)]
        half += [
            self.speed * _polynomial(_QUINTIC, tau, order) / self.ramp**order for order in range(3)
        ]
        out[:, X] = np.where(late, self.distance - half[0], half[0])
        out[:, V] = half[1]
        out[:, A] = np.where(late, -half[2], half[2])
        out[:, J] = half[3]
        return out


def point_to_point(
    waypoints: Sequence[float],
    *,
    speed: float,
    acceleration: float,
    jerk: float,
    tick: float,
    hold: float | Sequence[float] = 0.0,
    profile: Profile = "ramp",
) -> np.ndarray:
    """Moves from rest to rest through waypoints, as fast as the limits allow; returns the table,
    shape (samples, 4).

    All columns are continuous. ``ramp``: quintic ramps of speed around a constant speed, faster on
    long moves. ``seventh``: one polynomial ``35τ⁴ − 84τ⁵ + 70τ⁶ − 20τ⁷`` a move, smoother.

    Args:
        waypoints: strokes [m], the start first.
        speed, acceleration, jerk: limits [m/s, m/s², m/s³], > 0.
        tick: between rows [s].
        hold: rest at each waypoint, the first included [s]: one number, or one for each waypoint.

    Raises:
        InputError: a limit, tick or hold that is none, fewer than one waypoint.
    """
    limits = {"speed": speed, "acceleration": acceleration, "jerk": jerk, "tick": tick}
    for name, value in limits.items():
        if not (math.isfinite(value) and value > 0):
            raise InputError(message("control.limit_range", name=name, value=value))
    points = np.asarray(waypoints, float)
    holds = np.full(points.size, hold, float) if np.ndim(hold) == 0 else np.asarray(hold, float)
    if points.ndim != 1 or not points.size or not np.isfinite(points).all():
        raise InputError(message("control.no_waypoints"))
    if holds.shape != points.shape or not np.isfinite(holds).all() or (holds < 0).any():
        raise InputError(message("control.wrong_hold"))
    moves = [
        _Move(abs(d), speed, acceleration, jerk, profile) if d else None for d in np.diff(points)
    ]
    spans = np.zeros(2 * points.size - 1)
    spans[0::2], spans[1::2] = holds, [0.0 if move is None else move.time for move in moves]
    starts = np.concatenate([[0.0], np.cumsum(spans)])
    # the last row is the first at or after the end, so that the table ends at rest
    rows_of(float(starts[-1]), 1.0 / tick)
    samples = math.ceil(starts[-1] / tick - 1e-9) + 1
    t = np.arange(samples) * tick
    table = np.zeros((samples, ORDERS))
    table[:, X] = points[
        np.clip(np.searchsorted(starts[1::2], t, side="right"), 0, points.size - 1)
    ]
    for index, move in enumerate(moves):
        if move is None:
            continue
        begin = starts[2 * index + 1]
        during = (t >= begin) & (t < begin + move.time)
        part = math.copysign(1.0, points[index + 1] - points[index]) * move.at(t[during] - begin)
        part[:, X] += points[index]
        table[during] = part
    return table


def velocity_steps(
    levels: Sequence[float],
    *,
    duration: float | Sequence[float],
    tick: float,
    rest: float = 0.0,
    x: float = 0.0,
) -> np.ndarray:
    """Steps of desired speed, each held for its duration and followed by ``rest``; returns the
    table, shape (samples, 4).

    The steps are ideal: acceleration and jerk are 0 throughout, and the stroke is the exact
    integral. 30, 70, 100 % of a full speed are ``levels=[0.3 * full, 0.7 * full, full]``.

    Args:
        levels: speeds [m/s].
        duration: of each level [s]: one number, or one for each; rounded to whole ticks.
        tick: between rows [s].
        rest: at speed 0, before the first level and after each [s].
        x: stroke at the start [m].

    Raises:
        InputError: a time that is none, or counts that differ.
    """
    speeds = np.asarray(levels, float)
    times = (
        np.full(speeds.size, duration, float)
        if np.ndim(duration) == 0
        else np.asarray(duration, float)
    )
    usable = speeds.ndim == 1 and speeds.size and times.shape == speeds.shape
    if not (
        usable
        and tick > 0
        and (times > 0).all()
        and rest >= 0
        and np.isfinite(speeds).all()
        and np.isfinite(times).all()
    ):
        raise InputError(message("control.wrong_steps"))
    rows_of(float(times.sum()) + rest * (times.size + 1), 1.0 / tick)
    idle = np.zeros(round(rest / tick))
    parts = [idle]
    for speed, time in zip(speeds, times, strict=True):
        parts += [np.full(max(1, round(time / tick)), speed), idle]
    v = np.concatenate([*parts, [0.0]])
    table = np.zeros((v.size, ORDERS))
    table[:, V] = v
    table[1:, X] = np.cumsum(v[:-1]) * tick
    table[:, X] += x
    return table


SHAPING_NAMES = ("acceleration_max", "jerk_max", "natural_frequency", "damping_ratio")
# the shaping of a commanded speed ("trajectory modification", thesis Table B.2), see `pack_shaping`
SHAPING = record(*reals(SHAPING_NAMES))
# its memory: shaped speed [m/s], acceleration [m/s²], jerk [m/s³]
SHAPED = record(*reals(("speed", "acceleration", "jerk")))


@kernel
def reference_of(row):
    """The `Reference` in a row of a table."""
    return Reference(row[0], row[1], row[2], row[3])


def with_preview(table: np.ndarray, speed: np.ndarray, ahead: float, tick: float) -> np.ndarray:
    """A table of references with PREVIEWED columns more at its end: the smallest and the largest
    desired speed [m/s] from each row on for a time.

    Args:
        table: shape (samples, a multiple of ORDERS).
        speed: v_d [m/s], shape (samples,); what follows its end is the last.
        ahead: that time [s].
        tick: between rows [s].
    """
    minimum, largest, seen = speed.copy(), speed.copy(), 1
    span = min(round(ahead / tick) + 1, speed.size)
    while seen < span:
        more = min(seen, span - seen)
        minimum[:-more] = np.minimum(minimum[:-more], minimum[more:])
        largest[:-more] = np.maximum(largest[:-more], largest[more:])
        seen += more
    return np.ascontiguousarray(np.column_stack([table, minimum, largest]))


@kernel
def speeds_soon(row):
    """(smallest, largest) speed [m/s] to come, see `with_preview`; without it the present one."""
    columns = row.shape[0]
    if columns % ORDERS == PREVIEWED:
        return row[columns - 2], row[columns - 1]
    return row[V], row[V]


@kernel
def shape_speed(v_d, tick, shaping, shaped):
    """Move the ``shaped`` speed one tick towards ``v_d`` [m/s], in place; returns it.

    Second-order filter ω²/(s² + 2ζω s + ω²); or, with limits, the time-optimal approach within
    them; or ``v_d`` itself."""
    if shaping.natural_frequency > 0.0:
        filter_speed(v_d, tick, shaping, shaped)
    elif shaping.acceleration_max > 0.0:
        limit_speed(v_d, tick, shaping, shaped)
    else:
        shaped.speed, shaped.acceleration, shaped.jerk = v_d, 0.0, 0.0
    return shaped.speed


@kernel
def filter_speed(v_d, tick, shaping, shaped):
    """One tick of the second-order filter, exact for a ``v_d`` held over the tick."""
    omega, zeta = shaping.natural_frequency, shaping.damping_ratio
    e, rate = shaped.speed - v_d, shaped.acceleration
    decay = math.exp(-zeta * omega * tick)
    if zeta < 1.0:
        wd = omega * math.sqrt(1.0 - zeta * zeta)
        c, s = math.cos(wd * tick), math.sin(wd * tick) / wd
    elif zeta > 1.0:
        wd = omega * math.sqrt(zeta * zeta - 1.0)
        c, s = math.cosh(wd * tick), math.sinh(wd * tick) / wd
    else:
        c, s = 1.0, tick
    shaped.speed = v_d + decay * (e * (c + zeta * omega * s) + rate * s)
    shaped.acceleration = decay * (rate * (c - zeta * omega * s) - e * omega * omega * s)
    shaped.jerk = -omega * omega * (shaped.speed - v_d) - 2.0 * zeta * omega * shaped.acceleration


@kernel
def limit_speed(v_d, tick, shaping, shaped):
    """One tick within acceleration_max and jerk_max, time-optimal without overshoot (Han's
    fhan)."""
    maximum, jerk = shaping.acceleration_max, shaping.jerk_max
    e = v_d - shaped.speed
    if jerk <= 0.0:
        shaped.acceleration = math.copysign(min(abs(e) / tick, maximum), e)
        shaped.speed += tick * shaped.acceleration
        return
    step = jerk * tick
    y = tick * shaped.acceleration - e
    if abs(y) > step * tick:
        aim = shaped.acceleration + math.copysign(
            0.5 * (math.sqrt(step * step + 8.0 * jerk * abs(y)) - step), y
        )
    else:
        aim = shaped.acceleration + y / tick
    change = -aim * jerk / step if abs(aim) <= step else -math.copysign(jerk, aim)
    shaped.speed += tick * shaped.acceleration
    before = shaped.acceleration
    shaped.acceleration = min(max(before + tick * change, -maximum), maximum)
    shaped.jerk = (shaped.acceleration - before) / tick


def pack_shaping(
    *,
    acceleration_max: float | None = None,
    jerk_max: float | None = None,
    natural_frequency: float | None = None,
    damping_ratio: float | None = None,
) -> np.record:
    """The record of type SHAPING for `shape_speed`. Nothing given: the step goes through as it is.

    Args:
        acceleration_max, jerk_max: limits [m/s², m/s³]; the jerk only with the acceleration.
        natural_frequency, damping_ratio: of the second-order filter [rad/s, 1].

    Raises:
        InputError: a number that is not positive, half a pair, or both kinds at once.
    """
    given = (acceleration_max, jerk_max, natural_frequency, damping_ratio)
    for name, value in zip(SHAPING_NAMES, given, strict=True):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise InputError(message("control.shaping_range", name=name, value=value))
    limited = acceleration_max is not None
    filtered = natural_frequency is not None
    if (
        filtered != (damping_ratio is not None)
        or (jerk_max is not None and not limited)
        or (limited and filtered)
    ):
        raise InputError(message("control.shaping_incomplete"))
    shaping = blank(SHAPING)
    for name, value in zip(SHAPING_NAMES, given, strict=True):
        shaping[name] = 0.0 if value is None else value
    return shaping
