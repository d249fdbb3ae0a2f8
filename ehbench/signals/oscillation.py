"""The fit of an oscillation on top of a drift to some channels.

Least squares over the frequency, the damping and the drift's time constant alone: amplitudes are
eliminated (separable least squares, Golub & Pereyra 1973)."""

import math
from functools import lru_cache
from typing import Any

import numpy as np

# by how much log ω, ζ and log τ move alike
_SCALE = np.array([0.1, 0.1, 0.5])
_SAME = 1e-10  # share of a wave's sum of squares below which the drift makes all of it


def drift(s: np.ndarray, tau: float) -> np.ndarray:
    """Columns of the drift over s [s]: a parabola, and e^(−s/τ) if τ > 0."""
    z = s / s[-1]
    columns = [np.ones_like(z), z, z * z]
    return np.stack(columns + [np.exp(-s / tau)] if tau > 0.0 else columns, axis=-1)


def basis(s: np.ndarray, omega: float, zeta: float, tau: float) -> np.ndarray:
    """Columns of the oscillation, e^(−ζ ω s)·(cos ω_d s, sin ω_d s), and of the drift."""
    damped = omega * math.sqrt(max(1e-6, 1.0 - zeta * zeta))
    envelope = np.exp(-zeta * omega * s)
    waves = envelope * np.cos(damped * s), envelope * np.sin(damped * s)
    return np.column_stack([*waves, drift(s, tau)])


def project(columns: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(orthonormal columns of the same span, the part of y outside of it)."""
    q, _ = np.linalg.qr(columns)
    return q, y - q @ (q.T @ y)


def fit(
    s: np.ndarray, y: np.ndarray, tau: float, start: np.ndarray, bounds: np.ndarray
) -> tuple[np.ndarray, float]:
    """(point of least squares of an oscillation on top of a drift, half their sum there).

    Args:
        s: [s] from 0 on, shape (samples,).
        y: shape (samples, channels).
        tau: [s], of the drift's exponential; 0 for none.
        start: inside the bounds, (log ω [rad/s], ζ) or these and log τ [s], which is sought then.
        bounds: of the point, shape (2, numbers)."""
    from scipy.optimize import least_squares

    def residuals(point: np.ndarray) -> np.ndarray:
        columns = basis(s, math.exp(point[0]), point[1], _tau(point, tau))
        return project(columns, y)[1].ravel()

    def slopes(point: np.ndarray) -> np.ndarray:
        """−(A + Aᵀ) y with A = (1 − Φ Φ⁺) Φ′ Φ⁺ (Golub & Pereyra 1973)."""
        omega, zeta, time = math.exp(point[0]), point[1], _tau(point, tau)
        columns = basis(s, omega, zeta, time)
        inverse = np.linalg.pinv(columns)
        shares = inverse @ y
        rest = y - columns @ shares
        root = math.sqrt(max(1e-6, 1.0 - zeta * zeta))
        wave, along = columns[:, :2], omega * s[:, None]
        turned = np.column_stack([-wave[:, 1], wave[:, 0]])
        moved = [along * (root * turned - zeta * wave), -along * (wave + zeta / root * turned)]
        parts = [slice(0, 2)] * 2
        if point.size > 2:
            moved.append(s[:, None] / time * columns[:, 5:])
            parts.append(slice(5, 6))
        result = []
        for slope, part in zip(moved, parts, strict=True):
            shift = slope @ shares[part]
            shift -= columns @ (inverse @ shift)
            result.append((-shift - inverse[part].T @ (slope.T @ rest)).ravel())
        return np.stack(result, axis=-1)

    jacobian: Any = slopes
    result = least_squares(
        residuals, start, jacobian, bounds, x_scale=_SCALE[: start.size], ftol=1e-11, xtol=1e-9
    )
    return result.x, float(result.cost)


def _tau(point: np.ndarray, tau: float) -> float:
    return math.exp(point[2]) if point.size > 2 else tau


@lru_cache(16)
def waves(count: int, dampings: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """(frequencies [rad a sample] from a period in the window to an eighth of the rate, orthonormal
    oscillations outside of a parabola, shape (frequencies, dampings, 2, count); zero where none is
    left)."""
    s = np.arange(count, dtype=float)
    lowest, highest = 2.0 * math.pi / s[-1], 2.0 * math.pi / 8.0
    frequencies = np.geomspace(lowest, max(highest, 1.1 * lowest), 48)
    zeta = np.array(dampings)[:, None]
    omega = frequencies[:, None, None]
    turned = np.exp((1j * np.sqrt(1.0 - zeta**2) - zeta) * omega * s)
    pairs = np.stack([turned.real, turned.imag], axis=2)
    squares = np.sum(pairs**2, axis=-1)
    base, _ = np.linalg.qr(drift(s, 0.0))
    pairs -= (pairs @ base) @ base.T
    for k, other in ((0, None), (1, 0)):
        wave = pairs[:, :, k]
        if other is not None:
            first = pairs[:, :, other]
            wave -= np.sum(wave * first, axis=-1, keepdims=True) * first
        left = np.sum(wave**2, axis=-1)
        inside = left > _SAME * squares[:, :, k]
        wave *= np.where(inside, 1.0 / np.sqrt(np.where(inside, left, 1.0)), 0.0)[..., None]
    return frequencies, pairs
