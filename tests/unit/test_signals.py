"""Signals: ringing against closed forms, correlations against known processes."""

import math

import numpy as np
import pytest

from ehbench.signals import series

RATE = 1000.0


def oscillation(omega, zeta, duration, phase=0.7):
    t = np.arange(0.0, duration, 1.0 / RATE)
    damped = omega * math.sqrt(1.0 - zeta**2)
    return t, np.exp(-zeta * omega * t) * np.cos(damped * t + phase)


def coloured(rng, n, pole):
    """A first-order autoregressive series of unit variance; its autocorrelation is pole^k."""
    from scipy.signal import lfilter

    noise = rng.standard_normal(n + 500)
    return lfilter([math.sqrt(1.0 - pole**2)], [1.0, -pole], noise)[500:]


@pytest.mark.parametrize(
    "hertz, zeta, duration",
    [(4.0, 0.1, 1.5), (4.0, 0.1, 3.0), (20.0, 0.05, 2.0), (3.0, 0.3, 1.0), (40.0, 0.2, 3.0)],
)
def test_ringing_in_noise_offset_and_drift(hertz, zeta, duration):
    omega = 2 * math.pi * hertz
    t, wave = oscillation(omega, zeta, duration)
    noise = 0.05 * np.random.default_rng(1).standard_normal(t.size)
    found = series.ringing(t, 3.0 + 0.5 * t - 0.3 * t**2 + 0.4 * np.exp(-t / 0.1) + wave + noise)
    assert found.ok, found.reason
    # four of its own standard errors: one in 16 000 fails by chance
    assert abs(found.natural_frequency - omega) < 4.0 * found.natural_frequency_std
    assert abs(found.damping_ratio - zeta) < 4.0 * found.damping_ratio_std
    assert found.natural_frequency_std < 0.03 * omega


def test_ringing_is_exact_without_noise():
    t, wave = oscillation(25.0, 0.08, 1.2)
    found = series.ringing(t, 2.0 - 0.4 * t + 5.0 * wave)
    # the fit works on means over blocks of samples, which keep the poles
    assert found.natural_frequency == pytest.approx(25.0, rel=1e-4)
    assert found.damping_ratio == pytest.approx(0.08, abs=1e-4)
    assert found.r_squared > 0.9999


def test_standard_errors_of_ringing_cover():
    omega, zeta = 30.0, 0.1
    t, wave = oscillation(omega, zeta, 1.0)
    hits = 0
    for seed in range(40):
        found = series.ringing(t, wave + 0.1 * coloured(np.random.default_rng(seed), t.size, 0.8))
        hits += abs(found.natural_frequency - omega) < 1.96 * found.natural_frequency_std
    # of 40 intervals that cover with 95 %, 33 or fewer do so once in 2000
    assert hits >= 34


def test_channels_share_one_oscillation():
    t, wave = oscillation(25.0, 0.1, 1.0)
    _, other = oscillation(25.0, 0.1, 1.0, phase=2.0)
    rng = np.random.default_rng(2)
    noisy = [each + 0.3 * rng.standard_normal(t.size) for each in (wave, other)]
    both = np.column_stack([1e5 * noisy[0] + 2e6, 0.01 * noisy[1]])
    alone, joint = series.ringing(t, both[:, 0]), series.ringing(t, both)
    assert joint.ok and abs(joint.natural_frequency - 25.0) < 4 * joint.natural_frequency_std
    assert joint.natural_frequency_std < alone.natural_frequency_std
    dead = np.column_stack([both, np.full(t.size, 3.0)])
    found = series.ringing(t, dead).natural_frequency
    assert found == pytest.approx(joint.natural_frequency, rel=1e-9)


def test_ringing_says_why_there_is_none():
    t = np.arange(0.0, 1.0, 1.0 / RATE)
    rng = np.random.default_rng(3)
    assert "nothing moves" in series.ringing(t, np.full(t.size, 4.2)).reason
    assert "samples" in series.ringing(t[:10], t[:10]).reason
    for y in (
        rng.standard_normal(t.size) + 3 * t,
        1 - np.exp(-t / 0.1) + 0.01 * rng.standard_normal(t.size),
        t**2 + 1e-9 * rng.standard_normal(t.size),
    ):
        found = series.ringing(t, y)
        assert not found.ok and found.reason and math.isnan(found.natural_frequency)


def test_noise_seldom_passes_for_ringing():
    t = np.arange(0.0, 1.0, 1.0 / RATE)
    white = slow = 0
    for seed in range(30):
        white += series.ringing(t, np.random.default_rng(seed).standard_normal(t.size)).ok
        slow += series.ringing(t, coloured(np.random.default_rng(seed), t.size, 0.95)).ok
    assert white == 0
    assert slow <= 5  # measured 5 %; a slow random walk does look like a decaying wave now and then


def test_ringing_like_sees_the_other_series_the_same_way():
    t, wave = oscillation(25.0, 0.1, 1.0)
    y = wave + 0.2 * t + 0.05 * np.random.default_rng(4).standard_normal(t.size)
    first = series.ringing(t, y)
    again = series.ringing_like(t, y, first)
    assert again.natural_frequency == pytest.approx(first.natural_frequency, rel=1e-6)
    assert again.damping_ratio == pytest.approx(first.damping_ratio, abs=1e-6)
    assert again.stop == pytest.approx(first.stop)
    for share in (0.55, 1.9):
        _, faster = oscillation(25.0 * share, 0.15, 1.0)
        found = series.ringing_like(t, 7.0 * faster, first)
        assert found.natural_frequency == pytest.approx(25.0 * share, rel=1e-3), share
    assert not series.ringing_like(t, y, series.Ringing(reason="none")).ok
    assert not series.ringing_like(t, np.zeros(t.size), first).ok


def test_a_series_that_rings_as_another_is_not_silent_beside_what_else_it_does():
    """What bends beside a wave lasts for many samples: few of them are independent, and a noiseless
    wave does not stand out of it, though half as high as the other's."""
    t, wave = oscillation(160.0, 0.03, 0.3)
    recorded = series.ringing(t, wave + 0.2 * np.random.default_rng(5).standard_normal(t.size))
    bend = np.sin(60.0 * t) * np.exp(-4.0 * t)
    found = series.ringing_like(t, 0.5 * wave + 0.35 * bend, recorded)
    assert found.ok, found.reason
    assert found.natural_frequency == pytest.approx(160.0, rel=0.03)
    assert found.r_squared < 0.8, "or it would stand out by itself"
    quiet = 0.02 * wave + 0.05 * np.random.default_rng(6).standard_normal(t.size)
    assert "no oscillation" in series.ringing_like(t, quiet, recorded).reason


@pytest.mark.parametrize("hertz", [25.0, 41.0, 45.0])
def test_no_frequency_beyond_half_the_sampling_rate_is_found(hertz):
    """At 100 samples a second 59 Hz look like 41 Hz."""
    t = np.arange(150) * 0.01
    omega = 2.0 * math.pi * hertz
    wave = np.exp(-0.02 * omega * t) * np.sin(omega * t)
    first = series.ringing(t, wave + 0.05 * np.random.default_rng(1).standard_normal(t.size))
    again = series.ringing_like(t, wave, first)
    for found in (first, again, series.ringing(t, wave, (2.0 * omega, 0.02))):
        assert found.natural_frequency == pytest.approx(omega, rel=0.01)


def test_fit_percent_and_low_pass():
    y = np.sin(np.linspace(0.0, 9.0, 200))
    assert series.fit_percent(y, y) == 100.0
    assert series.fit_percent(y, np.full(200, y.mean())) == pytest.approx(0.0, abs=1e-12)
    assert series.fit_percent(y, y + 0.1 * np.std(y)) == pytest.approx(90.0)
    assert math.isnan(series.fit_percent(np.ones(5), np.zeros(5)))
    t = np.arange(0.0, 4.0, 1.0 / RATE)
    middle = slice(1000, 3000)
    for hertz, gain in ((0.5, 1.0), (10.0, 0.5), (100.0, 1e-4)):
        wave = np.cos(2 * math.pi * hertz * (t - 2.0))
        out = series.lowpass(wave, 1.0 / RATE, 10.0)
        # bilinear Butterworth twice: 1/(1 + (f/fc)⁴), warped by less than 1 % at these frequencies
        assert out[2000] == pytest.approx(gain, rel=0.1, abs=1e-3)
        assert np.allclose(out[middle], gain * wave[middle], atol=0.02)
    assert np.array_equal(series.lowpass(t, 1.0 / RATE, 600.0), t)


def test_transients_lie_between_command_changes():
    t = np.arange(100) * 0.01
    u = np.zeros((100, 2))
    u[20:60, 0], u[61:, 1] = 3.0, 2.0
    assert series.transients(t, u) == [slice(20, 60), slice(61, 100)]
    assert series.transients(t, u[:, 0]) == [slice(20, 60), slice(60, 100)]
    assert series.transients(t, np.ones(100)) == []
    rough = u + 0.01 * np.random.default_rng(8).standard_normal(u.shape)
    assert series.transients(t, rough, minimum=0.1) == [slice(20, 60), slice(61, 100)]
    ramp = np.clip((t - 0.2) / 0.3, 0.0, 1.0)
    assert [window.stop for window in series.transients(t, ramp)] == [100]


@pytest.mark.parametrize(
    "marks, stretches",
    [("", []), ("000", []), ("111", [[0, 3]]), ("1001101", [[0, 1], [3, 5], [6, 7]])],
)
def test_stretches_of_a_mask(marks, stretches):
    mask = np.array([mark == "1" for mark in marks], bool)
    assert series.stretches_of(mask).tolist() == stretches


def test_correlation_has_its_sign_scale_and_time():
    u = np.random.default_rng(5).standard_normal(4000)
    x = np.roll(u, 3)
    r = series.correlation(x, u, 10)
    assert np.argmax(r) == 10 + 3 and r[13] == pytest.approx(1.0, abs=0.01)
    assert series.autocorrelation(u, 5)[0] == pytest.approx(1.0)
    assert np.array_equal(series.correlation(np.ones(50), u[:50], 4), np.zeros(9))
    direct = [
        np.sum((x - x.mean())[k:] * (u - u.mean())[: x.size - k]) / (x.size * x.std() * u.std())
        for k in range(11)
    ]
    assert np.allclose(r[10:], direct)
    for pole in (0.0, 0.5, 0.9):
        times = [
            series.correlation_time(coloured(np.random.default_rng(seed), 4000, pole))
            for seed in range(20)
        ]
        # Σ ρ^k = (1 + ρ)/(1 − ρ), of which the sum to five correlation times misses up to 10 %, and
        # as much scatter
        assert np.mean(times) == pytest.approx((1 + pole) / (1 - pole), rel=0.15)


def test_bands_allow_for_colour():
    rng, outside, white = np.random.default_rng(6), [], []
    for _ in range(200):
        e = rng.standard_normal(601)
        x = e[1:] + 0.9 * e[:-1]
        r, band = series.autocorrelation(x, 20), series.autocorrelation_band(x, 20)
        outside.append(np.mean(np.abs(r[2:]) > band[2:]))
        white.append(np.mean(np.abs(r[2:]) > 1.96 / math.sqrt(x.size)))
        assert abs(r[1]) > band[1]
        assert band[1] == pytest.approx(1.96 / math.sqrt(x.size), rel=1e-3)
    assert np.mean(outside) == pytest.approx(0.05, abs=0.02)  # 200 series of 19 correlated lags
    assert np.mean(white) > 0.08  # what the band for white noise would have said
    rng, outside, white = np.random.default_rng(7), [], []
    for _ in range(150):
        x, u = coloured(rng, 1500, 0.9), coloured(rng, 1500, 0.9)
        r = series.correlation(x, u, 20)
        outside.append(np.mean(np.abs(r) > series.correlation_band(x, u)))
        white.append(np.mean(np.abs(r) > 1.96 / math.sqrt(1500)))
    # 150 series of 41 strongly correlated lags
    assert np.mean(outside) == pytest.approx(0.05, abs=0.03)
    assert np.mean(white) > 0.3


@pytest.mark.parametrize("shape", [(1,), (2,), (300,), (300, 3)])
def test_lowpass_is_scipys_to_the_bit(shape):
    from scipy.signal import butter, sosfiltfilt

    y = np.random.default_rng(3).standard_normal(shape)
    pad = min(shape[0] - 1, 75)
    there = sosfiltfilt(butter(2, 40.0, fs=1e3, output="sos"), y, axis=0, padlen=pad)
    np.testing.assert_array_equal(series.lowpass(y, 1e-3, 40.0), there)
