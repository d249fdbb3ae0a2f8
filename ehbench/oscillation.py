"""The fit of an oscillation beside a drift to some channels, compiled: a validation makes many.

Least squares over the frequency, the damping and the drift's time constant alone: amplitudes are
eliminated (separable least squares, Golub & Pereyra 1973). The descent is the trust region
reflective one of Branch, Coleman & Li (1999), as SciPy's ``least_squares`` has it, on the normal
matrix: three numbers at most are sought."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ehbench.compiled import allocating_kernel, kernel

# share of its length below which what others leave of a column is rounding
_ROUNDED = 1e-14
# share of a wave's sum of squares below which what a drift leaves of it is none
_ALIKE = 1e-10
# where the descent ends: share of the sum of squares gained, share of the point moved, slope
_GAIN, _MOVE, _SLOPE = 1e-9, 1e-7, 1e-8
_MOST = 30  # points at most
_CLOSE, _TURNS = 0.01, 10  # of the search for a step as long as the region is wide


class Series(NamedTuple):
    """What is fitted, and room to work: ``s`` [s], shape (samples,); ``y``, shape (channels,
    samples); ``tau`` [s], the time constant of the drift's exponential where that is not sought, 0
    for none.

    ``basis`` and its orthonormal columns ``q``, shape (columns, samples); ``back``, by which the
    basis makes these, shape (columns, columns); ``shares``, of the basis in the channels, shape
    (columns, channels); ``rest``, what is left, and ``slopes``, its derivatives, shape (3,
    channels, samples)."""

    s: np.ndarray
    y: np.ndarray
    tau: float
    basis: np.ndarray
    q: np.ndarray
    back: np.ndarray
    shares: np.ndarray
    rest: np.ndarray
    slopes: np.ndarray


@kernel
def _columns(point, data):
    """Writes the basis: e^(−ζ ω s)·(cos ω_d s, sin ω_d s), a parabola and e^(−s/τ)."""
    omega, zeta = math.exp(point[0]), point[1]
    tau = math.exp(point[2]) if point.size > 2 else data.tau
    damped = omega * math.sqrt(max(1e-6, 1.0 - zeta * zeta))
    s, basis = data.s, data.basis
    for i in range(s.size):
        envelope, z = math.exp(-zeta * omega * s[i]), s[i] / s[s.size - 1]
        basis[0, i] = envelope * math.cos(damped * s[i])
        basis[1, i] = envelope * math.sin(damped * s[i])
        basis[2, i], basis[3, i], basis[4, i] = 1.0, z, z * z
        if basis.shape[0] > 5:
            basis[5, i] = math.exp(-s[i] / tau)


@kernel
def _dot(a, b):
    found = 0.0
    for i in range(a.size):
        found += a[i] * b[i]
    return found


@kernel
def _put(values, out):
    for i in range(out.size):
        out[i] = values[i]


@kernel
def _stretch(values, share):
    for i in range(values.size):
        values[i] *= share


@kernel
def _less(a, share, b):
    """Takes a share of b off a."""
    for i in range(a.size):
        a[i] -= share * b[i]


@kernel
def _orthonormal(data):
    """Writes orthonormal columns, by Gram and Schmidt, each twice; of a column that the ones before
    it make, zero.
    """
    back, q = data.back, data.q
    back[:] = 0.0
    for k in range(q.shape[0]):
        own = q[k]
        _put(data.basis[k], own)
        length = math.sqrt(_dot(own, own))
        back[k, k] = 1.0
        for _ in range(2):
            for j in range(k):
                share = _dot(q[j], own)
                _less(own, share, q[j])
                for i in range(j + 1):
                    back[i, k] -= share * back[i, j]
        left = math.sqrt(_dot(own, own))
        per = 1.0 / left if left > _ROUNDED * length else 0.0
        for i in range(own.size):
            own[i] *= per
        for i in range(k + 1):
            back[i, k] *= per


@kernel
def _left(point, data):
    """Half the sum of squares of what the basis leaves; writes that, and the shares of the basis.

    Args:
        point: (log ω, ζ) or (log ω, ζ, log τ).
    """
    _columns(point, data)
    _orthonormal(data)
    shares, found = data.shares, 0.0
    shares[:] = 0.0
    for c in range(data.y.shape[0]):
        rest = data.rest[c]
        _put(data.y[c], rest)
        for k in range(data.q.shape[0]):
            share = _dot(data.q[k], data.y[c])
            _less(rest, share, data.q[k])
            for i in range(k + 1):
                shares[i, c] += share * data.back[i, k]
        found += 0.5 * _dot(rest, rest)
    return found


@kernel
def _moved(point, data):
    """Writes by how much the oscillation and the drift's exponential move, by log ω, ζ and log τ.

    Returns:
        The number of numbers sought.
    """
    omega, zeta = math.exp(point[0]), point[1]
    root = math.sqrt(max(1e-6, 1.0 - zeta * zeta))
    s, basis, slopes = data.s, data.basis, data.slopes
    for c in range(data.y.shape[0]):
        a, b = data.shares[0, c], data.shares[1, c]
        for i in range(s.size):
            along, wave = omega * s[i], a * basis[0, i] + b * basis[1, i]
            turned = b * basis[0, i] - a * basis[1, i]
            slopes[0, c, i] = along * (root * turned - zeta * wave)
            slopes[1, c, i] = -along * (wave + zeta / root * turned)
    if point.size > 2:
        tau = math.exp(point[2])
        for c in range(data.y.shape[0]):
            for i in range(s.size):
                slopes[2, c, i] = data.shares[5, c] * s[i] / tau * basis[5, i]
    return point.size


@kernel
def _pull(point, parameter, column, c, data):
    """A derivative of a column of the basis, times what is left of channel c."""
    omega, zeta = math.exp(point[0]), point[1]
    root = math.sqrt(max(1e-6, 1.0 - zeta * zeta))
    s, rest, found = data.s, data.rest[c], 0.0
    if (parameter == 2) != (column == 5):
        return 0.0
    if parameter == 2:
        for i in range(s.size):
            found += s[i] * data.basis[5, i] * rest[i]
        return found / math.exp(point[2])
    own, other = data.basis[column], data.basis[1 - column]
    sign = 1.0 if column else -1.0
    for i in range(s.size):
        turned = sign * other[i]
        if parameter == 0:
            found += s[i] * (root * turned - zeta * own[i]) * rest[i]
        else:
            found -= s[i] * (own[i] + zeta / root * turned) * rest[i]
    return omega * found


@kernel
def _normal(point, data, gradient, matrix):
    """Writes the gradient and JᵀJ of what `_left` left at a point: its slopes are −(A + Aᵀ) y with
    A = (1 − QQᵀ) Φ′ Φ⁻ (Golub & Pereyra 1973).
    """
    count = _moved(point, data)
    for p in range(count):
        gradient[p] = 0.0
        for c in range(data.y.shape[0]):
            moved = data.slopes[p, c]
            gradient[p] -= _dot(moved, data.rest[c])
            pulls = (
                _pull(point, p, 0, c, data),
                _pull(point, p, 1, c, data),
                _pull(point, p, 5, c, data) if p == 2 else 0.0,
            )
            for k in range(data.q.shape[0]):
                turned = data.back[0, k] * pulls[0] + data.back[1, k] * pulls[1]
                if p == 2:
                    turned += data.back[5, k] * pulls[2]
                _less(moved, _dot(data.q[k], moved) - turned, data.q[k])
    for p in range(count):
        for other in range(p + 1):
            found = 0.0
            for c in range(data.y.shape[0]):
                found += _dot(data.slopes[p, c], data.slopes[other, c])
            matrix[p, other] = matrix[other, p] = found


class Region(NamedTuple):
    """Where a step is sought, and room to work: bounds ``low`` and ``high`` of the point ``x``, the
    slope ``g`` and normal matrix ``b`` there, ``d`` by which a step is scaled, slope and matrix
    scaled, the ``step`` scaled, and its way in the point; all of them sought numbers long."""

    low: np.ndarray
    high: np.ndarray
    x: np.ndarray
    g: np.ndarray
    b: np.ndarray
    d: np.ndarray
    slope: np.ndarray
    matrix: np.ndarray
    step: np.ndarray
    turned: np.ndarray
    down: np.ndarray
    way: np.ndarray
    factor: np.ndarray


@kernel
def _divided(at, alpha, right, out):
    """Writes (matrix + α)⁻¹ right; whether the matrix is positive definite."""
    n, factor = right.size, at.factor
    for j in range(n):
        for i in range(j, n):
            rest = at.matrix[i, j] + (alpha if i == j else 0.0)
            for k in range(j):
                rest -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = rest / factor[j, j]
            elif rest > 0.0:
                factor[j, j] = math.sqrt(rest)
            else:
                return False
    for j in range(n):
        rest = right[j]
        for k in range(j):
            rest -= factor[j, k] * out[k]
        out[j] = rest / factor[j, j]
    for j in range(n - 1, -1, -1):
        rest = out[j]
        for k in range(j + 1, n):
            rest -= factor[k, j] * out[k]
        out[j] = rest / factor[j, j]
    return True


@kernel
def _long(at, alpha, radius):
    """(by how much the step for α is longer than the region is wide, how that falls with α, whether
    there is one); writes the step.
    """
    if not _divided(at, alpha, at.slope, at.step):
        return 0.0, 0.0, False
    length = math.sqrt(_dot(at.step, at.step))
    _divided(at, alpha, at.step, at.way)
    return length - radius, -_dot(at.step, at.way) / length, True


@kernel
def _within(at, radius, alpha):
    """Writes the step to the least of the quadratic within the region (Moré 1978).

    Returns:
        The damping α that it takes; the last one is given.
    """
    over, fall, whole = _long(at, 0.0, radius)
    if whole and over <= 0.0:
        _stretch(at.step, -1.0)
        return 0.0
    least = -over / fall if whole else 0.0
    most = math.sqrt(_dot(at.slope, at.slope)) / radius
    if alpha == 0.0 and not whole:
        alpha = max(0.001 * most, math.sqrt(least * most))
    for _ in range(_TURNS):
        if alpha < least or alpha > most:
            alpha = max(0.001 * most, math.sqrt(least * most))
        over, fall, _ = _long(at, alpha, radius)
        if over < 0.0:
            most = alpha
        least = max(least, alpha - over / fall)
        alpha -= (over + radius) * over / fall / radius
        if abs(over) < _CLOSE * radius:
            break
    _divided(at, alpha, at.slope, at.step)
    share = -radius / math.sqrt(_dot(at.step, at.step))
    _stretch(at.step, share)
    return alpha


@kernel
def _room(at, way, begin, share, out):
    """How much of a scaled way leads from the point, moved by a share of ``begin``, to a bound;
    writes 1 for the numbers that meet it.
    """
    found = math.inf
    for i in range(way.size):
        step, x = at.d[i] * way[i], at.x[i] + share * at.d[i] * begin[i]
        out[i] = math.inf
        if step != 0.0:
            out[i] = max((at.low[i] - x) / step, (at.high[i] - x) / step)
        found = min(found, out[i])
    for i in range(way.size):
        out[i] = 1.0 if out[i] == found else 0.0
    return found


@kernel
def _value(at, one, other):
    """½ oneᵀ matrix other."""
    found = 0.0
    for i in range(one.size):
        found += 0.5 * one[i] * _dot(at.matrix[i], other)
    return found


@kernel
def _lowest(curve, slope, low, high):
    """(where a parabola through zero is least between two places, its value)."""
    at = low if low * (curve * low + slope) <= high * (curve * high + slope) else high
    if curve != 0.0:
        inner = -0.5 * slope / curve
        if low < inner < high and inner * (curve * inner + slope) < at * (curve * at + slope):
            at = inner
    return at, at * (curve * at + slope)


@kernel
def _reflected(at, radius, theta, room):
    """The value at the least along the step turned round at the bound it meets; writes that way.
    The step ends on the bound, ``room`` are the numbers that meet it.

    Args:
        room: share of the step that leads to the bound.
    """
    step, turned = at.step, at.turned
    squares, along = _dot(turned, turned), _dot(step, turned)
    rest = _dot(step, step) - radius * radius
    root = math.sqrt(max(along * along - squares * rest, 0.0))
    pull = -(along + math.copysign(root, along))
    to_end = max(pull / squares, rest / pull) if pull != 0.0 else 0.0
    to_bound = _room(at, turned, step, 1.0, at.way)
    most = min(to_bound, to_end)
    if most <= 0.0:
        return math.inf
    low, high = (1.0 - theta) * room / most, theta * to_bound if most == to_bound else to_end
    if low > high:
        return math.inf
    slope = _dot(at.slope, turned) + 2.0 * _value(at, step, turned)
    share, value = _lowest(_value(at, turned, turned), slope, low, high)
    value += _value(at, step, step) + _dot(at.slope, step)
    for i in range(step.size):
        turned[i] = step[i] + share * turned[i]
    return value


@kernel
def _chosen(at, radius, theta):
    """What the quadratic gains by the step, by the one turned round at a bound or by one straight
    down, whichever is best inside the bounds; writes that step.
    """
    step, turned, down, zero = at.step, at.turned, at.down, at.way
    room = _room(at, step, step, 0.0, zero)
    if room >= 1.0:
        return -_value(at, step, step) - _dot(at.slope, step)
    for i in range(step.size):
        step[i] *= room
        turned[i] = step[i] / room * (1.0 - 2.0 * zero[i])
    bent = _reflected(at, radius, theta, room)
    _stretch(step, theta)
    straight = _value(at, step, step) + _dot(at.slope, step)
    for i in range(step.size):
        down[i] = -at.slope[i]
    to_end = radius / math.sqrt(_dot(down, down))
    to_bound = _room(at, down, down, 0.0, zero)
    most = theta * to_bound if to_bound < to_end else to_end
    share, falls = _lowest(_value(at, down, down), _dot(at.slope, down), 0.0, most)
    if straight < bent and straight < falls:
        return -straight
    for i in range(step.size):
        step[i] = turned[i] if bent < straight and bent < falls else share * down[i]
    return -min(bent, falls)


@kernel
def _scaled(at, scale):
    """Writes the way of scaling by the room to the bounds that the slope points to, and slope and
    matrix scaled; the largest slope scaled so.
    """
    n, largest = at.x.size, 0.0
    for i in range(n):
        room, bent = 1.0, 0.0
        if at.g[i] < 0.0 and at.high[i] < math.inf:
            room, bent = at.high[i] - at.x[i], -1.0
        elif at.g[i] > 0.0 and at.low[i] > -math.inf:
            room, bent = at.x[i] - at.low[i], 1.0
        largest = max(largest, abs(at.g[i] * room))
        at.d[i] = math.sqrt(room / scale[i] if bent != 0.0 else room) * scale[i]
        at.step[i] = at.g[i] * bent * scale[i]
    for i in range(n):
        at.slope[i] = at.d[i] * at.g[i]
        for j in range(n):
            at.matrix[i, j] = at.d[i] * at.b[i, j] * at.d[j]
        at.matrix[i, i] += at.step[i]
    return largest


@kernel
def _moves(at, radius, theta, alpha, to):
    """(what a step should gain, its scaled length, its length, its damping); writes where it leads
    to, inside the bounds.
    """
    alpha = _within(at, radius, alpha)
    gain, length = _chosen(at, radius, theta), 0.0
    for i in range(to.size):
        step = at.d[i] * at.step[i]
        length += step * step
        to[i] = at.x[i] + step
        if to[i] <= at.low[i] or to[i] >= at.high[i]:
            share = 1e-15 * max(1.0, abs(to[i]))
            to[i] = at.low[i] + share if to[i] <= at.low[i] else at.high[i] - share
    return gain, math.sqrt(_dot(at.step, at.step)), math.sqrt(length), alpha


@kernel
def _descend(data, at, scale, to):
    """Half the least sum of squares from the region's point on; writes where it is."""
    x, cost = at.x, _left(at.x, data)
    _normal(x, data, at.g, at.b)
    _scaled(at, scale)
    radius = 0.0
    for i in range(x.size):
        radius += (x[i] / at.d[i]) ** 2
    radius, alpha, count, done = math.sqrt(radius), 0.0, 1, False
    radius = 1.0 if radius == 0.0 else radius
    while not done and count < _MOST:
        steep = _scaled(at, scale)
        theta, gained = max(0.995, 1.0 - steep), -1.0
        done = steep < _SLOPE
        while not done and gained <= 0.0 and count < _MOST:
            wanted, length, moved, alpha = _moves(at, radius, theta, alpha, to)
            new = _left(to, data)
            count += 1
            if not math.isfinite(new):
                radius = 0.25 * length
                continue
            gained = cost - new
            ratio = gained / wanted if wanted > 0.0 else 0.0
            before = radius
            if ratio < 0.25:
                radius = 0.25 * length
            elif ratio > 0.75 and length > 0.95 * radius:
                radius *= 2.0
            done = gained < _GAIN * cost and ratio > 0.25
            done = done or moved < _MOVE * (_MOVE + math.sqrt(_dot(x, x)))
            alpha *= before / radius
        if gained > 0.0:
            _put(to, x)
            cost -= gained
            if not done:
                _normal(x, data, at.g, at.b)
    return cost


@allocating_kernel
def fit(s, y, tau, point, bounds, scale):
    """The least squares of an oscillation beside a drift, from a point on.

    Args:
        s: [s] from 0 on, shape (samples,).
        y: shape (channels, samples).
        tau: [s], of the drift's exponential; 0 for none.
        point: where it starts, inside its bounds, (log ω [rad/s], ζ) or these and log τ [s], which
            is sought then.
        bounds: of the point, shape (2, numbers).
        scale: of the point's numbers.

    Returns:
        (the point there, half the sum of squares that is left).
    """
    n, channels, columns = point.size, y.shape[0], 6 if tau > 0.0 else 5
    data = Series(
        s,
        y,
        tau,
        np.empty((columns, s.size)),
        np.empty((columns, s.size)),
        np.empty((columns, columns)),
        np.empty((columns, channels)),
        np.empty_like(y),
        np.empty((3, channels, s.size)),
    )
    rows, square = np.empty((8, n)), np.empty((3, n, n))
    at = Region(
        bounds[0].copy(),
        bounds[1].copy(),
        point.copy(),
        rows[0],
        square[0],
        rows[1],
        rows[2],
        square[1],
        rows[3],
        rows[4],
        rows[5],
        rows[6],
        square[2],
    )
    cost = _descend(data, at, scale, rows[7])
    return at.x, cost


@kernel
def _wave(s, omega, zeta, waves):
    """Writes e^(−ζ ω s)·(cos ω_d s, sin ω_d s), each sample turned and shrunk from the one before.

    Args:
        s: [s] from 0 on, even.
    """
    damped, a, b = omega * math.sqrt(1.0 - zeta * zeta), 1.0, 0.0
    shrunk = math.exp(-zeta * omega * s[1])
    along, across = shrunk * math.cos(damped * s[1]), shrunk * math.sin(damped * s[1])
    for i in range(s.size):
        waves[0, i], waves[1, i] = a, b
        a, b = a * along - b * across, a * across + b * along


@kernel
def _twice(values, waves):
    """The products of some values with both waves."""
    a, b = 0.0, 0.0
    for i in range(values.size):
        a += values[i] * waves[0, i]
        b += values[i] * waves[1, i]
    return a, b


@allocating_kernel
def explained(s, base, rest, frequencies, dampings):
    """Sums of squares of channels that oscillations explain beside a drift, in one row: by damping
    within a frequency.

    Args:
        s: [s] from 0 on, even, shape (samples,).
        base: orthonormal columns of the drift, shape (columns, samples).
        rest: what they leave of the channels, shape (channels, samples).
        frequencies: ω [rad/s].
        dampings: damping ratios.
    """
    waves, found = np.empty((2, s.size)), np.zeros(frequencies.size * dampings.size)
    for one in range(found.size):
        _wave(s, frequencies[one // dampings.size], dampings[one % dampings.size], waves)
        (first, both), (_, second) = _twice(waves[0], waves), _twice(waves[1], waves)
        least = _ALIKE * first, _ALIKE * second
        for j in range(base.shape[0]):
            a, b = _twice(base[j], waves)
            first, both, second = first - a * a, both - a * b, second - b * b
        if first <= least[0]:  # the drift makes this wave
            first, both = math.inf, 0.0
        second -= both * both / first
        if second <= least[1]:
            second = math.inf
        for c in range(rest.shape[0]):
            a, b = _twice(rest[c], waves)
            b -= a * both / first
            found[one] += a * a / first + b * b / second
    return found
