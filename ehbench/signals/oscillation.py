"""The fit of an oscillation beside a drift to some channels, compiled: a validation makes many.

Least squares over the frequency, the damping and the drift's time constant alone: amplitudes
are eliminated (separable least squares, Golub & Pereyra 1973). The descent is Marquardt's (1963) on
the normal matrix, a number at a bound held as long as the slope points out."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ehbench.runtime.compiled import allocating_kernel, kernel

# share of its length below which what others leave of a column is rounding
_ROUNDED = 1e-14
# share of a wave's sum of squares below which what a drift leaves of it is none
_ALIKE = 1e-10
# where the descent ends: share of the sum of squares gained, how far the point moved at most
_GAIN, _MOVE = 1e-11, 1e-9
_MOST, _TRIES = 50, 20  # steps, and dampings of one
_DAMPING = 1e-3  # at first


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
    result = 0.0
    for i in range(a.size):
        result += a[i] * b[i]
    return result


@kernel
def _put(values, out):
    for i in range(out.size):
        out[i] = values[i]


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
    shares, result = data.shares, 0.0
    shares[:] = 0.0
    for c in range(data.y.shape[0]):
        rest = data.rest[c]
        _put(data.y[c], rest)
        for k in range(data.q.shape[0]):
            share = _dot(data.q[k], data.y[c])
            _less(rest, share, data.q[k])
            for i in range(k + 1):
                shares[i, c] += share * data.back[i, k]
        result += 0.5 * _dot(rest, rest)
    return result


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
    s, rest, result = data.s, data.rest[c], 0.0
    if (parameter == 2) != (column == 5):
        return 0.0
    if parameter == 2:
        for i in range(s.size):
            result += s[i] * data.basis[5, i] * rest[i]
        return result / math.exp(point[2])
    own, other = data.basis[column], data.basis[1 - column]
    sign = 1.0 if column else -1.0
    for i in range(s.size):
        turned = sign * other[i]
        if parameter == 0:
            result += s[i] * (root * turned - zeta * own[i]) * rest[i]
        else:
            result -= s[i] * (own[i] + zeta / root * turned) * rest[i]
    return omega * result


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
            result = 0.0
            for c in range(data.y.shape[0]):
                result += _dot(data.slopes[p, c], data.slopes[other, c])
            matrix[p, other] = matrix[other, p] = result


class Descent(NamedTuple):
    """Room of a descent: the ``gradient`` and normal ``matrix`` at its point, the latter's Cholesky
    ``factor`` with damping, the ``step`` and the point ``to`` which it leads.
    """

    gradient: np.ndarray
    matrix: np.ndarray
    factor: np.ndarray
    step: np.ndarray
    to: np.ndarray


@kernel
def _solved(way, held, damping):
    """Writes the step (matrix + damping·diagonal)⁻¹ gradient of the numbers that are not held, and
    whether there is one.
    """
    n, factor, step = way.step.size, way.factor, way.step
    for j in range(n):
        for i in range(j, n):
            rest = 0.0 if held[i] or held[j] else way.matrix[i, j]
            if i == j:
                rest = 1.0 if held[i] else rest * (1.0 + damping)
            for k in range(j):
                rest -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = rest / factor[j, j]
            elif rest > 0.0:
                factor[j, j] = math.sqrt(rest)
            else:
                return False
    for j in range(n):
        rest = 0.0 if held[j] else way.gradient[j]
        for k in range(j):
            rest -= factor[j, k] * step[k]
        step[j] = rest / factor[j, j]
    for j in range(n - 1, -1, -1):
        rest = step[j]
        for k in range(j + 1, n):
            rest -= factor[k, j] * step[k]
        step[j] = rest / factor[j, j]
    return True


@kernel
def _moved_to(point, bounds, way):
    """Writes where the step leads to, inside the bounds; the largest number it moves by."""
    maximum = 0.0
    for i in range(point.size):
        way.to[i] = min(max(point[i] - way.step[i], bounds[0, i]), bounds[1, i])
        maximum = max(maximum, abs(way.to[i] - point[i]))
    return maximum


@kernel
def _descend(data, point, bounds, way, held):
    """Half the least sum of squares from a point on; writes where it is."""
    cost, damping = _left(point, data), _DAMPING
    for _ in range(_MOST):
        _normal(point, data, way.gradient, way.matrix)
        for i in range(point.size):
            down = -way.gradient[i]
            out = (point[i] <= bounds[0, i] and down < 0.0) or (
                point[i] >= bounds[1, i] and down > 0.0
            )
            held[i] = out or way.matrix[i, i] <= 0.0
        gained = 0.0
        for _ in range(_TRIES):
            if _solved(way, held, damping):
                moved = _moved_to(point, bounds, way)
                gained = cost - _left(way.to, data)
                if gained > 0.0 or moved < _MOVE:
                    break
            damping *= 10.0
        damping *= 0.1
        if not gained > 0.0:
            break
        _put(way.to, point)
        cost -= gained
        if gained < _GAIN * cost:
            break
    return cost


@allocating_kernel
def fit(s, y, tau, point, bounds):
    """The least squares of an oscillation beside a drift, from a point on.

    Args:
        s: [s] from 0 on, shape (samples,).
        y: shape (channels, samples).
        tau: [s], of the drift's exponential; 0 for none.
        point: where it starts, inside its bounds, (log ω [rad/s], ζ) or these and log τ [s], which
            is sought then.
        bounds: of the point, shape (2, numbers).

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
    at, way = (
        point.copy(),
        Descent(np.empty(n), np.empty((n, n)), np.empty((n, n)), np.empty(n), np.empty(n)),
    )
    cost = _descend(data, at, bounds, way, np.zeros(n, np.bool_))
    return at, cost


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
    waves, result = np.empty((2, s.size)), np.zeros(frequencies.size * dampings.size)
    for item in range(result.size):
        _wave(s, frequencies[item // dampings.size], dampings[item % dampings.size], waves)
        (first, both), (_, second) = _twice(waves[0], waves), _twice(waves[1], waves)
        minimum = _ALIKE * first, _ALIKE * second
        for j in range(base.shape[0]):
            a, b = _twice(base[j], waves)
            first, both, second = first - a * a, both - a * b, second - b * b
        if first <= minimum[0]:  # the drift makes this wave
            first, both = math.inf, 0.0
        second -= both * both / first
        if second <= minimum[1]:
            second = math.inf
        for c in range(rest.shape[0]):
            a, b = _twice(rest[c], waves)
            b -= a * both / first
            result[item] += a * a / first + b * b / second
    return result
