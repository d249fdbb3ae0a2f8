"""The fit of an oscillation, against least squares by differences of projections."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from ehbench.signals import oscillation

SCALE = np.array([0.1, 0.1, 0.5])
LOW, HIGH = np.array([-np.inf, -0.05, np.log(2e-3)]), np.array([np.inf, 0.95, np.log(2.0)])


def series(seed, zeta, noise):
    """(s [s], two channels of one oscillation beside a drift, shape (samples, 2), its log ω)."""
    rng = np.random.default_rng(seed)
    s, omega = np.arange(400) * 1e-3, rng.uniform(30.0, 120.0)
    damped = omega * np.sqrt(1.0 - zeta**2)
    waves = np.cos(damped * s[:, None] + rng.uniform(0.0, 6.0, 2)) * rng.uniform(0.5, 2.0, 2)
    drift = rng.standard_normal(2) * s[:, None] + np.exp(-s / 0.06)[:, None]
    y = np.exp(-zeta * omega * s)[:, None] * waves + drift
    return s, y + noise * rng.standard_normal(y.shape), float(np.log(omega))


def columns(s, omega, zeta, tau):
    damped, z = omega * np.sqrt(1.0 - zeta**2), s / s[-1]
    made = [np.exp(-zeta * omega * s) * wave(damped * s) for wave in (np.cos, np.sin)]
    made += [np.ones_like(z), z, z**2]
    return np.column_stack(made + ([np.exp(-s / tau)] if tau else []))


def outside(basis, y):
    return y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]


def left(point, s, y, tau):
    tau = np.exp(point[2]) if len(point) > 2 else tau
    return outside(columns(s, np.exp(point[0]), point[1], tau), y).ravel()


@pytest.mark.parametrize("tau, sought", [(0.0, 2), (0.05, 2), (0.05, 3)])
@pytest.mark.parametrize("zeta, noise", [(0.05, 1e-6), (0.3, 0.05), (-0.08, 0.01), (0.1, 1.0)])
def test_the_least_squares_are_those_of_scipy(zeta, noise, tau, sought):
    for seed in range(3):
        s, y, log_omega = series(seed, zeta, noise)
        start = np.array([log_omega + 0.06, 0.15, np.log(0.05)])[:sought]
        bounds = np.stack([LOW, HIGH])[:, :sought].copy()
        point, cost = oscillation.fit(s, y, tau, start, bounds)
        wanted = least_squares(
            left, start, bounds=bounds, x_scale=SCALE[:sought], args=(s, y, tau), xtol=1e-12
        )
        assert cost == pytest.approx(0.5 * np.sum(left(point, s, y, tau) ** 2), rel=1e-9)
        assert cost <= wanted.cost * (1.0 + 1e-9) + 1e-12
        assert np.all(point >= bounds[0]) and np.all(point <= bounds[1])
        np.testing.assert_allclose(point[:2], wanted.x[:2], atol=1e-4 * max(1.0, 20.0 * noise))


def test_what_an_oscillation_explains_is_a_projection():
    dampings, count = (0.02, 0.2, 0.6), 200
    y = np.random.default_rng(5).standard_normal((count, 2))
    frequencies, waves = oscillation.waves(count, dampings)
    assert frequencies[0] == pytest.approx(2 * np.pi / (count - 1))
    assert frequencies[-1] == pytest.approx(2 * np.pi / 8)
    s = np.arange(count) * 1.0
    rest = outside(columns(s, 1.0, 0.1, 0.0)[:, 2:], y)
    for i in range(0, frequencies.size, 9):
        for j, zeta in enumerate(dampings):
            beyond = outside(columns(s, frequencies[i], zeta, 0.0), y)
            exact = np.sum(rest**2) - np.sum(beyond**2)
            found = np.sum((waves[i, j] @ rest) ** 2)
            assert found == pytest.approx(exact, rel=1e-7, abs=1e-9 * np.sum(rest**2))
