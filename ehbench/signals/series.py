"""Signals: ringing, transients, fit and correlation as pure functions of arrays; no rig, no record.

A series is sampled evenly; ``y`` is (samples,) or (samples, channels). Correlations are of the
series minus its mean."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise, product
from typing import Any

import numpy as np

from ehbench.signals import oscillation
from ehbench.signals.oscillation import basis, drift, project
from ehbench.vocabulary import message, setting

LEAST_LINE = 8  # samples that show a slope
_SETTLE = 0.02  # [s] that a window between two changes of a command lasts at least
_GRID_DAMPING = (0.02, 0.06, 0.12, 0.22, 0.4)


@dataclass(frozen=True)
class RingingSettings:
    """Numbers of the search for a ringing."""

    samples: int = setting(24, "", "least samples of a window", "four for each number sought")
    cycles: float = setting(1.0, "", "least cycles", "else a drift")
    damped: float = setting(0.6, "", "largest damping ratio", "a step overshoots by 10 %")
    significant: float = setting(40.0, "", "least gain in log likelihood", "noise has less")
    loud: float = setting(0.1, "", "energy that rings, of another series'", "a third in size")
    grid: int = setting(192, "", "samples of the search on a grid", "enough for 24 cycles")
    astray: float = setting(0.5, "", "change of log ω from a start that is another one", "65 %")
    inside: float = setting(0.05, "", "log ω of a start below half the sampling rate", "inside")
    cycle: int = setting(24, "", "samples to a cycle after averaging", "the wave shows")
    share: float = setting(0.3, "", "least share of the residual that it explains", "else noise")
    clear: float = setting(0.9, "", "the same from which it rings whatever the noise", "plain")
    error: float = setting(0.15, "", "largest standard error of the frequency, as a share", "known")


SETTINGS = RingingSettings()


@dataclass(frozen=True)
class Ringing:
    """A lightly damped oscillation found in a window.

    ``natural_frequency`` [rad/s] and ``damping_ratio`` are those of the free oscillation, each with
    its standard error (corrected for coloured residuals); ``cycles`` how many periods pass before
    it has decayed to 5 % or the window ends; ``r_squared`` the share of what the drift leaves that
    the oscillation explains; ``stop`` [s] the last time used. ``drift_time`` [s] is the time
    constant of the drift's exponential (0: none) and ``weights`` what each channel counted for;
    with them `ringing_like` fits another series in the same way; ``energy`` is the mean square that
    the oscillation explains, so weighted. ``ok`` is False when there is nothing to fit, and
    ``reason`` says why in words; the numbers are then nan. ``fitted_damping`` is what the fit says
    where the oscillation is damped too well to ring: no more than a likely value, without an error
    bar."""

    natural_frequency: float = math.nan
    damping_ratio: float = math.nan
    natural_frequency_std: float = math.nan
    damping_ratio_std: float = math.nan
    cycles: float = 0.0
    r_squared: float = 0.0
    stop: float = math.nan
    drift_time: float = 0.0
    weights: tuple[float, ...] = ()
    energy: float = math.nan
    fitted_damping: float = math.nan
    ok: bool = False
    reason: str = ""


def fit_percent(measured: np.ndarray, simulated: np.ndarray) -> float:
    """NRMSE fit ``100 (1 − ‖y − ŷ‖ / ‖y − mean y‖)`` [%]; nan for a constant y."""
    spread = float(np.linalg.norm(measured - np.mean(measured)))
    off = float(np.linalg.norm(measured - simulated))
    return 100.0 * (1.0 - off / spread) if spread > 0.0 else math.nan


def rms(y: np.ndarray) -> float:
    """Root mean square, in the unit of ``y``."""
    return float(np.sqrt(np.mean(np.square(y)))) if y.size else math.nan


def white_noise(y: np.ndarray, each: int = 1) -> float:
    """Standard deviation of the white part of a signal, in its unit; 0 of less than four samples.
    Of one that is interpolated, that of the samples, which stand in every ``each``-th place.

    Of white noise the third difference y₀ − 3y₁ + 3y₂ − y₃ has the variance (1 + 9 + 9 + 1) σ²,
    and a motion that is smooth over four samples hardly any."""
    taken = [y[first::each] for first in range(each)]  # a mean of two samples has less of it
    squares = (np.mean(np.diff(some, 3) ** 2) for some in taken if some.size > 3)
    return float(np.sqrt(max(squares, default=0.0) / 20.0))


def first_of(y: np.ndarray, count: int) -> float:
    """A series' first value by a line through ``count`` samples, or their mean where they are
    few."""
    if count < LEAST_LINE:
        return float(np.mean(y[:count]))
    z = np.linspace(0.0, 1.0, count)
    return float(np.polynomial.polynomial.polyfit(z, y[:count], 1)[0])


def stretches_of(marked: np.ndarray) -> np.ndarray:
    """First entry and the one after the last of each stretch that is marked, shape (stretches, 2),
    of a mask, shape (samples,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2)


def block_averages(y: np.ndarray, each: int) -> np.ndarray:
    """Means of ``each`` successive samples along the first axis; what fills no mean at the end is
    left out."""
    count = len(y) // each
    return y[: count * each].reshape(count, each, *y.shape[1:]).mean(axis=1)


def lowpass(y: np.ndarray, sample_time: float, cutoff: float, order: int = 2) -> np.ndarray:
    """``y`` through a Butterworth low-pass of an order, run forwards and backwards: no phase, −6 dB
    at ``cutoff`` [Hz].

    Linear, so that filtering a residual is filtering both signals. A cutoff at or above Nyquist
    leaves ``y`` as it is."""
    if cutoff >= 0.5 / sample_time:
        return np.asarray(y, dtype=float)
    from scipy.signal import sosfilt

    y = np.asarray(y, dtype=float)
    sections, settled = _butterworth(order, cutoff, sample_time)
    settled = settled.reshape(*settled.shape, *(1 for _ in y.shape[1:]))
    pad = min(y.shape[0] - 1, max(9, round(3.0 / (cutoff * sample_time))))
    # odd about its ends, as SciPy's `sosfiltfilt`, which designs where to begin at each call
    before, after = 2.0 * y[:1] - y[pad:0:-1], 2.0 * y[-1:] - y[-2 : -pad - 2 : -1]
    long = np.concatenate([before, y, after])
    for _ in range(2):
        long = sosfilt(sections, long, axis=0, zi=settled * long[:1])[0][::-1]
    return long[pad : pad + y.shape[0]]


@lru_cache(32)
def _butterworth(order: int, cutoff: float, sample_time: float) -> tuple[np.ndarray, np.ndarray]:
    """(sections of a Butterworth low-pass, their states under a lasting 1)."""
    from scipy.signal import butter, sosfilt_zi

    sections: Any = butter(order, cutoff, fs=1.0 / sample_time, output="sos")
    return sections, sosfilt_zi(sections)


def transients(
    t: np.ndarray, commands: np.ndarray, minimum: float | np.ndarray = 0.0
) -> list[slice]:
    """Windows between command changes: each begins where a command has just changed and ends before
    the next change.

    Windows shorter than 20 ms are passed over, so changes that follow each other closely
    are one, and a ramp has none before its end; what precedes the first change is no transient.

    Args:
        t: time [s], shape (samples,).
        commands: [V], shape (samples,) or (samples, valves).
        minimum: [V], one number or one a valve: a command has changed when it is off its last level
            by more."""
    table = _as_table(commands)
    changed: set[int] = set()
    for u, dead in zip(table.T, np.broadcast_to(minimum, table.shape[1]), strict=True):
        at = 0
        while (off := np.abs(u[at:] - u[at]) > dead).any():
            at += int(np.argmax(off))
            changed.add(at)
    edges = [*sorted(changed), len(t)]
    return [
        slice(first, stop)
        for first, stop in pairwise(edges)
        if stop - first > 1 and t[stop - 1] - t[first] >= _SETTLE
    ]


def correlation(x: np.ndarray, u: np.ndarray, lags: int) -> np.ndarray:
    """Sample correlation of x(t) with u(t − k), k = −lags … lags, shape (2·lags + 1,); zero where
    either is constant.

    Positive k: u comes before x. Divided by the full sample count (biased, as Bartlett's formulas
    assume)."""
    a, b = x - np.mean(x), u - np.mean(u)
    n = len(a)
    scale = float(np.linalg.norm(a) * np.linalg.norm(b))
    if scale == 0.0:
        return np.zeros(2 * lags + 1)
    size = 1 << (2 * n - 1).bit_length()
    item = np.fft.rfft(a, size)
    other = item if u is x else np.fft.rfft(b, size)
    full = np.fft.irfft(item * np.conj(other), size)
    reach = min(lags, n - 1)
    result = np.zeros(2 * lags + 1)
    both = np.concatenate([full[size - reach :], full[: reach + 1]])
    result[lags - reach : lags + reach + 1] = both / scale
    return result


def autocorrelation(x: np.ndarray, lags: int) -> np.ndarray:
    """Sample autocorrelation at lags 0 … lags, shape (lags + 1,)."""
    return correlation(x, x, lags)[lags:]


def correlation_time(x: np.ndarray) -> float:
    """Integrated correlation time ``1 + 2 Σ ρ(k)`` in samples, at least 1: so many samples count as
    one independent one.

    Summed to the first lag beyond five times the sum so far (Sokal 1997), at most a quarter of the
    series."""
    return _settled_sum(autocorrelation(x, max(1, len(x) // 4))[1:])


def _settled_sum(terms: np.ndarray) -> float:
    """``1 + 2 Σ`` of terms at lags 1, 2, …, to the first lag beyond five times the sum so far; at
    least 1."""
    total = 1.0 + 2.0 * np.cumsum(terms)
    beyond = np.flatnonzero(np.arange(1, terms.size + 1) >= 5.0 * np.maximum(total, 1.0))
    return float(max(1.0, total[beyond[0]] if beyond.size else np.max(total)))


def autocorrelation_band(x: np.ndarray, lags: int) -> np.ndarray:
    """Half-width within which r(k), k = 0 … lags, stays in 95 of 100 cases if x is
    uncorrelated from lag k on.

    Bartlett's formula for a moving average, ``var r(k) = (1 + 2 Σ_{0<i<k} r(i)²)/n`` (Box & Jenkins
    2.1.13): short-lived colour widens the band at longer lags instead of failing there. At lag 1 it
    is the white band 1.96/√n."""
    r = autocorrelation(x, lags)
    tail = np.concatenate([[0.0, 0.0], np.cumsum(r[1:-1] ** 2)])[: lags + 1]
    return _two_sided() * np.sqrt((1.0 + 2.0 * tail) / len(x))


def correlation_band(x: np.ndarray, u: np.ndarray) -> float:
    """Half-width within which r_xu(k) stays in 95 of 100 cases if x and u are independent,
    whatever their colour.

    Bartlett's formula ``var r_xu = Σ_i ρ_x(i) ρ_u(i) / n``, the sum tapered and cut where it has
    settled as in `correlation_time`; never below the white band 1.96/√n."""
    n = len(x)
    maximum = max(1, n // 4)
    both = autocorrelation(x, maximum)[1:] * autocorrelation(u, maximum)[1:]
    both *= 1.0 - np.arange(1, maximum + 1) / n
    return float(_two_sided() * math.sqrt(_settled_sum(both) / n))


def _two_sided() -> float:
    """Standard deviations on each side that hold 95 % of a normal distribution."""
    from statistics import NormalDist

    return NormalDist().inv_cdf(0.975)


def ringing(
    t: np.ndarray, y: np.ndarray, guess: tuple[float, float] | None = None, trim: bool = True
) -> Ringing:
    """The lightly damped oscillation that all channels of ``y`` share, beside drift and noise.

    Least squares of ``e^(−ζ ω s) (a cos ω_d s + b sin ω_d s) + c0 + c1 s + c2 s² + d e^(−s/τ)``, s
    from the window's start and ``ω_d = ω √(1 − ζ²)``; a…d are each channel's own and are eliminated
    (separable least squares, Golub & Pereyra 1973), the exponential is kept only where it pays.
    Without a ``guess`` the whole range from one period in the window to an eighth of the sampling
    rate is searched first, over the window and its halves; nothing beyond half of that rate is
    found, where samples cannot tell one frequency from another.

    Args:
        t: [s], shape (samples,), even.
        y: any unit, shape (samples,) or (samples, channels).
        guess: (ω [rad/s], ζ) to start from instead of the search.
        trim: leave out what comes after the oscillation has decayed; keep False to use exactly the
            window given."""
    y = _as_table(y)
    if len(t) < SETTINGS.samples:
        return Ringing(reason=message("signals.few_samples", count=len(t)))
    spread = np.std(y, axis=0)
    moves = spread > 1e-9 * np.max(np.abs(y), axis=0)
    weight = np.where(moves, 1.0 / np.maximum(spread, 1e-300), 0.0)
    if not np.any(weight):
        return Ringing(reason=message("signals.nothing_moves"))
    s, y = np.asarray(t - t[0], dtype=float), y - np.mean(y, axis=0)
    (omega, zeta), used = guess or (0.0, 0.0), len(s)
    if guess is None:
        omega, zeta, used = _search(s, y[:, weight > 0.0] * weight[weight > 0.0])
    begun, block = (omega, zeta), _block(s, omega)
    used = max(SETTINGS.samples, used // block)
    s, y = block_averages(s, block), block_averages(y, block)
    first, s = s[0], s - s[0]
    floor, tau = 1e-3 * spread, 0.0
    for drifts in ((0.0,), (0.0, 0.1), None):
        if trim and (guess is not None or drifts != (0.0,)):
            required = max(4.0 / max(zeta * omega, 1e-9), 2.5 * 2 * math.pi / omega)
            reached = int(np.searchsorted(s, required, side="right"))
            used = min(len(s), max(SETTINGS.samples, reached))
        taus = (tau,) if drifts is None else tuple(share * s[used - 1] for share in drifts)
        starts = [(omega, zeta)]
        if abs(math.log(omega / begun[0])) > SETTINGS.astray:  # a drift that the window before left
            starts.append(begun)
        omega, zeta, tau = _refine(s[:used], y[:used] * weight, starts, taus)
        _, left = project(basis(s[:used], omega, zeta, tau), y[:used])
        size = np.maximum(np.sqrt(np.mean(left**2, axis=0)), np.maximum(floor, 1e-300))
        weight = np.where(weight > 0.0, 1.0 / size, 0.0)
    return _judge(s[:used], y[:used], weight, omega, zeta, tau, float(t[0] + first))


def ringing_like(
    t: np.ndarray, y: np.ndarray, like: Ringing, guess: tuple[float, float] | None = None
) -> Ringing:
    """The oscillation of ``y`` seen exactly as that of another series was: the same window, drift
    and channel weights.

    What the method does to one it does to the other, so the two compare. A series rings if its
    oscillation has a tenth of the other's energy, about a third of its amplitude, or if it stands
    out as `ringing` asks. That alone would be too much of a simulation: what is left there is no
    noise but lasts, so that few samples of it are independent. The search starts at
    ``guess`` (ω [rad/s], ζ), by default around what the other series does; in a simulation, which
    has no noise, a free search would find oscillations far too small for a recording to show.

    Args:
        t, y: as for `ringing`, covering the window of ``like`` from its start.
        like: of the other series."""
    if not like.ok:
        return Ringing(reason=message("signals.other_silent"))
    y = _as_table(y)
    damping, shares = max(like.damping_ratio, 0.05), (1.0, 0.5, 0.7, 1.4, 2.0)
    starts = [guess] if guess else [(like.natural_frequency * x, damping) for x in shares]
    block = _block(t - t[0], like.natural_frequency)
    s, y, weight = block_averages(t - t[0], block), block_averages(y, block), np.array(like.weights)
    used = int(np.searchsorted(t[0] + s, like.stop + 1e-9))
    if used < SETTINGS.samples:
        return Ringing(reason=message("signals.not_covered"))
    first, s, y = s[0], s[:used] - s[0], y[:used] - np.mean(y[:used], axis=0)
    if not np.any(np.ptp(y * weight, axis=0) > 0.0):
        return Ringing(reason=message("signals.nothing_moves"))
    omega, zeta, tau = _refine(s, y * weight, starts, (like.drift_time,), free_drift=False)
    start, loud = float(t[0] + first), SETTINGS.loud * like.energy
    return _judge(s, y, weight, omega, zeta, tau, start, loud)


def _as_table(y: np.ndarray) -> np.ndarray:
    y = np.asarray(y, dtype=float)
    return y[:, None] if y.ndim == 1 else y


def _block(s: np.ndarray, omega: float) -> int:
    """Samples to average before the fit: enough stay to see the oscillation, and the window."""
    enough = int(2 * math.pi / omega / (s[1] * SETTINGS.cycle))
    return max(1, min(enough, len(s) // SETTINGS.samples))


def _search(s: np.ndarray, y: np.ndarray) -> tuple[float, float, int]:
    """(ω, ζ, samples) of the best fit on a grid, over the window and its halves."""
    best = (-math.inf, 2 * math.pi / s[-1], 0.1, len(s))
    for halving in range(6):
        used = len(s) >> halving
        if used < max(SETTINGS.samples, SETTINGS.grid // 4) and halving > 0:
            break
        block = max(1, used // SETTINGS.grid)
        count = used // block
        z, w = block_averages(s[:used], block), block_averages(y[:used], block)
        frequencies, columns = oscillation.waves(count, _GRID_DAMPING)
        _, rest = project(drift(z - z[0], 0.0), w)
        explained = np.sum((columns @ rest) ** 2, axis=(2, 3)).ravel()
        total = float(np.sum(rest**2))
        if total <= 0.0:
            continue
        share = np.minimum(explained / total, 1.0 - 1e-6)
        at = int(np.argmax(share))
        score = -count * math.log1p(-float(share[at]))
        if score > best[0]:
            row, column = divmod(at, len(_GRID_DAMPING))
            omega = float(frequencies[row]) / float(z[1] - z[0])
            best = (score, omega, _GRID_DAMPING[column], used)
    return best[1:]


def _refine(
    s: np.ndarray,
    y: np.ndarray,
    starts: Sequence[tuple[float, float]],
    taus: Sequence[float],
    free_drift: bool = True,
) -> tuple[float, float, float]:
    """(ω, ζ, τ) of the best least-squares minimum near ``starts`` (ω, ζ) and ``taus``, 0 for
    none."""
    n = y.size
    best = (math.inf, starts[0][0], starts[0][1], 0.0)
    highest = math.log(math.pi / s[1])  # beyond it, samples are those of a slower oscillation too
    for (omega, zeta), tau in product(starts, taus):
        bounds = [(-math.inf, highest), (-0.05, 0.95)]
        start = [min(math.log(omega), highest - SETTINGS.inside), min(max(zeta, 0.0), 0.9)]
        if tau > 0.0 and free_drift:
            low, high = math.log(s[2]), math.log(2.0 * s[-1])
            bounds.append((low, high))
            start.append(min(max(math.log(tau), low + 1e-6), high - 1e-6))
        limits = np.array(bounds).T
        result, left = oscillation.fit(s, y, tau, np.array(start), limits)
        paid = (y.shape[1] + 1) * math.log(n) if tau > 0.0 else 0.0
        score = n * math.log(max(2.0 * left / n, 1e-300)) + paid
        if score < best[0]:
            time = math.exp(result[2]) if len(result) > 2 else tau
            best = score, math.exp(result[0]), float(result[1]), time
    return best[1:]


def _standard_errors(s, y, omega, zeta, tau, residual, colour) -> tuple[float, float]:
    """Of ω [rad/s] and ζ, from the slopes of what the fit leaves over.

    Args:
        residual: sum of squares of what is left over, in the weights of ``y``.
        colour: samples of it that count as one independent one."""
    step = 1e-4
    moves = np.eye(3)[: 3 if tau > 0.0 else 2] * step
    slopes = np.empty((y.size, len(moves)))
    for column, (dw, dz, dt) in enumerate(moves):
        up = project(basis(s, omega * math.exp(dw), zeta + dz, tau * math.exp(dt)), y)[1]
        down = project(basis(s, omega * math.exp(-dw), zeta - dz, tau * math.exp(-dt)), y)[1]
        slopes[:, column] = ((up - down) / (2 * step)).ravel()
    freedom = max(1, y.size - 6 * y.shape[1] - 2)
    covariance = np.linalg.pinv(slopes.T @ slopes) * residual / freedom * colour
    return float(omega * math.sqrt(covariance[0, 0])), float(math.sqrt(covariance[1, 1]))


def _judge(s, y, weight, omega, zeta, tau, start, loud=math.inf) -> Ringing:
    """The result with standard errors, or the reason why it is none.

    Args:
        loud: mean square, in the weights given, from which on it rings whatever else moves."""
    weights, y = tuple(float(w) for w in weight), y[:, weight > 0.0] * weight[weight > 0.0]
    _, left = project(basis(s, omega, zeta, tau), y)
    _, rest = project(drift(s, tau), y)
    n, residual, total = len(s), float(np.sum(left**2)), float(np.sum(rest**2))
    share = 1.0 - residual / total if total > 0.0 else 0.0
    span = float(s[-1])
    lasts = min(span, 3.0 / max(zeta * omega, 1e-9))
    cycles = omega * math.sqrt(max(0.0, 1.0 - zeta**2)) / (2 * math.pi) * lasts
    exact = not residual > 1e-12 * max(total, 1e-300)
    colour = 1.0 if exact else max(correlation_time(column) for column in left.T)
    std_omega, std_zeta = _standard_errors(s, y, omega, zeta, tau, residual, colour)
    evidence = n / colour * math.log(total / max(residual, 1e-12 * total)) if total > 0.0 else 0.0
    reason, fitted = "", math.nan
    energy = (total - residual) / n
    # what is left over is then the model's error, not noise to be judged by
    plain = energy >= loud or (share > SETTINGS.clear and cycles > 2.0 * SETTINGS.cycles)
    if not plain and (evidence < SETTINGS.significant or share < SETTINGS.share):
        reason = message("signals.no_oscillation", share=max(share, 0.0))
    elif zeta > SETTINGS.damped or (cycles < SETTINGS.cycles and zeta * omega * span > 3.0):
        reason, fitted = message("signals.damped"), zeta
    elif cycles < SETTINGS.cycles:
        reason = message("signals.few_cycles", cycles=cycles)
    elif std_omega > SETTINGS.error * omega:
        reason = message("signals.vague_frequency", share=std_omega / omega)
    if reason:
        return Ringing(
            reason=reason, cycles=cycles, r_squared=share, stop=start + span, fitted_damping=fitted
        )
    return Ringing(
        natural_frequency=omega,
        damping_ratio=zeta,
        natural_frequency_std=std_omega,
        damping_ratio_std=std_zeta,
        cycles=cycles,
        r_squared=share,
        stop=start + span,
        drift_time=float(tau),
        weights=weights,
        energy=energy,
        ok=True,
    )
