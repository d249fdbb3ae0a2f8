"""Standard errors of a least-squares fit to logs whose residuals are coloured and whose starts are
estimated with it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ehbench.identification.search import LEVEL
from ehbench.signals.series import correlation_time

FAINT = 1e-12  # share of the largest eigenvalue of a normal matrix that is rounding


@dataclass(frozen=True, eq=False)
class Block:
    """What one log says of its ``channels``: sensitivities of its scaled residuals to the
    parameters (samples, channels, parameters) and to its start's nuisances (samples, channels,
    nuisances), the residuals (samples, channels), where the nuisances stand [prior standard
    deviations], the ``readings`` (samples, channels) and the standard error of a resting one
    (channels,), zero where they are no counts, in units of the residuals' scales."""

    channels: tuple[str, ...]
    jacobian: np.ndarray
    start_jacobian: np.ndarray
    residuals: np.ndarray
    shifts: np.ndarray
    readings: np.ndarray
    coarse: np.ndarray


@dataclass(frozen=True, eq=False)
class Eliminated:
    """A log's least squares with its nuisances taken out: by how much the best nuisances follow the
    parameters (``gain``, shape (nuisances, parameters)), their own best step ``move``, and what
    stays for the parameters: normal matrix and gradient; ``known`` is the normal matrix if the
    nuisances were known, ``inner`` the nuisances' covariance if the parameters were."""

    gain: np.ndarray
    move: np.ndarray
    normal: np.ndarray
    gradient: np.ndarray
    known: np.ndarray
    inner: np.ndarray

    def std(self, covariance: np.ndarray) -> np.ndarray:
        """Standard errors of the nuisances [prior standard deviations], by the covariance of the
        parameters."""
        whole = self.inner + self.gain @ covariance @ self.gain.T
        return np.sqrt(np.diag(whole))


def eliminate(block: Block, weight: float) -> Eliminated:
    """A log's nuisances eliminated; ``weight`` is a prior's, `initial_states.prior_weight`."""
    p, n = block.jacobian.shape[-1], len(block.shifts)
    whole = np.concatenate(
        [block.jacobian, block.start_jacobian, block.residuals[..., None]], axis=-1
    )
    whole = whole.reshape(-1, p + n + 1)
    square = whole.T @ whole
    inner = square[p : p + n, p : p + n] + weight * np.eye(n)
    pull = square[p : p + n, -1] + weight * block.shifts
    gain, move = np.linalg.solve(inner, square[p : p + n, :p]), -np.linalg.solve(inner, pull)
    normal = square[:p, :p] - square[:p, p : p + n] @ gain
    gradient = square[:p, -1] - gain.T @ pull
    inner = weight * np.linalg.inv(inner) if n else inner
    return Eliminated(gain, move, 0.5 * (normal + normal.T), gradient, square[:p, :p], inner)


@dataclass(frozen=True)
class Prior:
    """What is known of the parameters beside the data: inverse standard deviations in search
    coordinates (zero: nothing), by what the parameters are off their prior values, in the same
    coordinates, and the weight of a prior beside a sample."""

    sharpness: np.ndarray
    off: np.ndarray
    weight: float

    @property
    def normal(self) -> np.ndarray:
        return np.diag(self.weight * self.sharpness**2)

    @property
    def gradient(self) -> np.ndarray:
        return self.weight * self.sharpness**2 * self.off


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariances of the search coordinates: ``hac`` and ``acf``, ``counts`` by the resolution of
    the readings alone, and where the logs disagree ``jackknife``; ``fixed``, of the errors of fixed
    numbers, comes on top of each.

    ``alone`` is the standard error each parameter would have if all the others were known,
    ``quantile`` that of the 95 % interval by ``hac`` and ``acf``, ``from_data`` the share of each
    parameter's information that is not its prior's, ``from_starts`` the share of its variance that
    it has because the logs' starts are estimated."""

    hac: np.ndarray
    acf: np.ndarray
    counts: np.ndarray
    jackknife: np.ndarray | None
    logs: int
    alone: np.ndarray
    quantile: float
    from_data: np.ndarray
    from_starts: np.ndarray
    fixed: np.ndarray

    def error(self, k: int) -> tuple[float, float, str]:
        """(standard error, quantile of the 95 % interval, where it is from) of parameter k:
        whichever gives the widest interval."""
        from scipy.special import stdtrit  # scipy.stats is half a second to import

        results = [
            (math.sqrt(max(matrix[k, k], 0.0) + self.fixed[k, k]), self.quantile, source)
            for matrix, source in ((self.hac, "hac"), (self.acf, "acf"), (self.counts, "counts"))
        ]
        if self.jackknife is not None:
            quantile = float(stdtrit(self.logs - 1, 0.5 + 0.5 * LEVEL))
            std = math.sqrt(self.jackknife[k, k] + self.fixed[k, k])
            results.append((std, quantile, "jackknife"))
        return max(results, key=lambda item: item[0] * item[1])

    @property
    def correlation(self) -> np.ndarray:
        """Of ``hac``."""
        return correlation_of(self.hac)

    @property
    def whole(self) -> np.ndarray:
        """``hac`` with the errors of fixed numbers."""
        return self.hac + self.fixed

    @property
    def from_fixed(self) -> np.ndarray:
        """The share of each parameter's variance that errors of fixed numbers cause."""
        return np.diag(self.fixed) / np.maximum(np.diag(self.whole), 1e-300)


def correlation_of(covariance: np.ndarray) -> np.ndarray:
    """The correlation matrix of a covariance."""
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    return covariance / np.outer(size, size)


def covariance_of(
    blocks: Sequence[Block], prior: Prior, fixed: Sequence[np.ndarray] = ()
) -> Covariance:
    """Covariance of a least-squares solution whose residuals are coloured.

    Sandwiches ``H⁻¹ M H⁻¹`` with ``H = Σ JᵀJ`` over the logs, J without what a log's nuisances can
    do as well. M is once the long-run covariance of the scores ``s_t = J_tᵀ r_t`` of each log,
    Bartlett weights to four correlation times of the scores (``hac``, Newey & West 1987), and once
    ``Σ JᵀRJ``, R the autocovariance of each channel's residual over all logs, flat-top weights to
    twice its last significant lag (``acf``, Politis 2003). Both take the quantile of fixed b
    (Kiefer & Vogelsang 2005). Where the scores of three logs or more disagree by more than their
    long-run covariance explains, each log is left out in turn, one Gauss–Newton step
    (``jackknife``); directions that one log alone informs are left to the sandwich.

    Readings in counts Δ without noise are all off alike where they read alike: M is then
    ``Σ gᵀg Δ²/12`` over the values of each channel, g the sum of J at one of them (``counts``).

    ``fixed`` is by log what one standard error of each fixed number changes of the residuals, F of
    shape (samples, channels, numbers). It moves the solution by a column of ``C = −H⁻¹ Σ JᵀF``:
    their covariance is ``C Cᵀ`` (Schmidt 1966)."""
    solved = [eliminate(block, prior.weight) for block in blocks]
    data = np.sum([item.normal for item in solved], axis=0)
    total = data + prior.normal
    root = _inverse_root(total)
    inverse = root @ root.T
    known_starts = _inverse_root(np.sum([item.known for item in solved], axis=0) + prior.normal)
    pairs = [*zip(blocks, solved, strict=True)]
    free = [block.jacobian - block.start_jacobian @ item.gain for block, item in pairs]
    scores = [np.einsum("tci,tc->ti", j, b.residuals) for j, b in zip(free, blocks, strict=True)]
    times = [max(map(correlation_time, score.T), default=0.0) for score in scores]
    reaches = [min(len(s) // 4, math.ceil(4.0 * t)) for s, t in zip(scores, times, strict=True)]
    prior_parts = [prior.weight**2 * item.gain.T @ item.gain for item in solved]
    meats = [
        _weighed(score, 1.0 - np.arange(reach + 1) / (reach + 1.0)) + known
        for score, reach, known in zip(scores, reaches, prior_parts, strict=True)
    ]
    known = prior.weight**2 * np.diag(prior.sharpness**2)
    # where nothing is known rounding would, and a variance could come out below zero
    known += FAINT * np.diag(np.diag(total))
    hac = np.sum(meats, axis=0) + known
    acf = _by_autocovariance(free, blocks) + np.sum(prior_parts, axis=0) + known
    moves = [np.einsum("tci,tcj->ij", part, off) for part, off in zip(free, fixed, strict=False)]
    moved = inverse @ np.sum(moves, axis=0) if moves else np.zeros((len(inverse), 1))
    b = float(np.mean([r / len(s) for r, s in zip(reaches, scores, strict=True)]))
    informed = np.maximum(np.diag(total), 1e-300)
    ideal = np.sum(known_starts**2, axis=1) / np.maximum(np.diag(inverse), 1e-300)
    return Covariance(
        inverse @ hac @ inverse,
        inverse @ acf @ inverse,
        inverse @ (_by_counts(free, blocks) + np.sum(prior_parts, axis=0) + known) @ inverse,
        _jackknife(solved, meats, root),
        len(blocks),
        np.sqrt(np.diag(hac)) / informed,
        1.96 + 2.97 * b + 0.416 * b**2,
        np.maximum(1.0 - np.diag(prior.normal) * np.diag(inverse), 0.0),
        np.maximum(1.0 - ideal, 0.0),
        moved @ moved.T,
    )


def _inverse_root(normal: np.ndarray) -> np.ndarray:
    """R with ``R Rᵀ`` the inverse of a normal matrix, of whose directions none counts for nothing
    at all."""
    diagonal = np.diag(normal)
    size = np.sqrt(np.maximum(diagonal, 1e-30 * np.max(diagonal, initial=1e-270)))
    values, vectors = np.linalg.eigh(normal / np.outer(size, size))
    minimum = FAINT * np.max(values, initial=0.0) or 1.0  # 1: nothing counts, or there is nothing
    return vectors / np.sqrt(np.maximum(values, minimum)) / size[:, None]


class Release(NamedTuple):
    """What the last parameter would do if it were free: its step, the step's standard error, what
    the cost would fall by for it, and the steps of the others that follow it."""

    move: float
    std: float
    gain: float
    follow: np.ndarray


def release_of(blocks: Sequence[Block], prior: Prior, minimum: float) -> Release:
    """What freeing the last of the parameters would do, all others following it, to first order;
    its standard error is by what would be left then, infinite where the cost would fall by less
    than ``minimum``."""
    solved = [eliminate(block, prior.weight) for block in blocks]
    normal = np.sum([item.normal for item in solved], axis=0) + prior.normal
    pull = np.sum([item.gradient for item in solved], axis=0) + prior.gradient
    step, without = _step(normal, pull), _step(normal[:-1, :-1], pull[:-1])
    gain = float(pull[:-1] @ without - pull @ step)
    result = Release(float(step[-1]), math.inf, gain, step[:-1] - without)
    if gain < minimum:
        return result
    after = []
    for block, item in zip(blocks, solved, strict=True):
        left = (
            block.residuals
            + block.jacobian @ step
            + block.start_jacobian @ (item.move - item.gain @ step)
        )
        after.append(replace(block, residuals=left))
    std, *_ = covariance_of(after, prior).error(len(pull) - 1)
    return result._replace(std=std)


def gains_of(blocks: Sequence[Block], prior: Prior) -> np.ndarray:
    """By how much the cost would fall for each of the parameters that are behind those of the
    prior, were it freed alone of them, to first order; shape (parameters behind,)."""
    solved, count = [eliminate(block, prior.weight) for block in blocks], len(prior.sharpness)
    normal = np.sum([item.normal for item in solved], axis=0)
    pull = np.sum([item.gradient for item in solved], axis=0)
    normal[:count, :count] += prior.normal
    pull[:count] += prior.gradient
    without, result = -float(pull[:count] @ _step(normal[:count, :count], pull[:count])), []
    for k in range(count, len(pull)):
        which = [*range(count), k]
        step = _step(normal[np.ix_(which, which)], pull[which])
        result.append(-float(pull[which] @ step) - without)
    return np.array(result)


def _step(normal: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """The step to the minimum of least squares by their normal matrix and gradient."""
    root = _inverse_root(normal)
    return -root @ (root.T @ pull)


def _weighed(series: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """``Σ_lag w(lag) Σ_t s_t s_{t−lag}ᵀ`` over positive and negative lags of a series (samples,
    columns), by Fourier transforms; ``weights`` from lag 0 on."""
    n = len(series)
    size = 1 << (2 * n - 1).bit_length()
    kernel = np.zeros(size)
    kernel[: len(weights)] = weights
    kernel[size - len(weights) + 1 :] = weights[:0:-1]
    turned = np.fft.rfft(series, size, axis=0) * np.fft.rfft(kernel).real[:, None]
    result = series.T @ np.fft.irfft(turned, size, axis=0)[:n]
    return 0.5 * (result + result.T)


def _by_autocovariance(slopes: Sequence[np.ndarray], blocks: Sequence[Block]) -> np.ndarray:
    """``Σ JᵀRJ`` over logs and channels."""
    p = slopes[0].shape[-1]
    result = np.zeros((p, p))
    for channel in sorted({channel for block in blocks for channel in block.channels}):
        having = [
            (
                part[:, block.channels.index(channel)],
                block.residuals[:, block.channels.index(channel)],
            )
            for part, block in zip(slopes, blocks, strict=True)
            if channel in block.channels
        ]
        weights = _flat_top([left for _, left in having])
        result += np.sum([_weighed(part, weights[: len(part)]) for part, _ in having], axis=0)
    return result


def _by_counts(free: Sequence[np.ndarray], blocks: Sequence[Block]) -> np.ndarray:
    """``Σ gᵀg Δ²/12`` over channels and the values that they read, all logs together."""
    p = free[0].shape[-1]
    result = np.zeros((p, p))
    for channel in sorted({channel for block in blocks for channel in block.channels}):
        values, columns, error = [], [], 0.0
        for part, block in zip(free, blocks, strict=True):
            if channel in block.channels:
                i = block.channels.index(channel)
                values.append(block.readings[:, i])
                columns.append(part[:, i])
                error = max(error, float(block.coarse[i]))
        if error > 0.0 and p:
            which = np.unique(np.concatenate(values), return_inverse=True)[1]
            whole = np.concatenate(columns)
            sums = np.stack([np.bincount(which, column) for column in whole.T], axis=-1)
            result += error**2 * sums.T @ sums
    return result


def _flat_top(series: Sequence[np.ndarray]) -> np.ndarray:
    """Autocovariances of series that share them, from lag 0 on, tapered: whole up to the last
    significant lag, then down to nothing at twice it."""
    maximum = max(1, min(len(item) for item in series) // 4)
    total, count = np.zeros(maximum + 1), 0
    for item in series:
        size = 1 << (2 * len(item) - 1).bit_length()
        power = np.abs(np.fft.rfft(item, size)) ** 2
        total += np.fft.irfft(power, size)[: maximum + 1]
        count += int(np.count_nonzero(item))
    if total[0] <= 0.0:
        return np.zeros(1)
    small = np.abs(total / total[0]) < 2.0 * math.sqrt(math.log10(max(count, 10)) / count)
    quiet = np.convolve(small[1:], np.ones(5), "valid") >= 5.0
    last = int(np.argmax(quiet)) if quiet.any() else maximum // 2
    if last == 0:
        return total[:1] / count
    lags = np.arange(min(2 * last, maximum) + 1)
    return total[: len(lags)] / count * np.minimum(1.0, 2.0 - lags / last)


def _jackknife(
    solved: Sequence[Eliminated], meats: Sequence[np.ndarray], root: np.ndarray
) -> np.ndarray | None:
    """Covariance by leaving out one log at a time, where the gradients of three logs or more, which
    sum to nothing at the solution, are larger than their covariances explain; ``root`` is a square
    root of the inverse of the normal matrix."""
    from scipy.special import chdtri

    if len(solved) < 3:
        return None
    size = np.sqrt(np.maximum(np.diag(np.sum(meats, axis=0)), 1e-300))
    total, freedom = 0.0, -len(size)
    for item, meat in zip(solved, meats, strict=True):
        values, vectors = np.linalg.eigh(meat / np.outer(size, size))
        some = values > 1e-6 * values[-1]
        along = vectors[:, some].T @ (item.gradient / size)
        total += float(np.sum(along**2 / values[some]))
        freedom += int(np.count_nonzero(some))
    # noise alone would make them do so in one case of a hundred
    if freedom <= 0 or total <= float(chdtri(freedom, 0.01)):
        return None
    count, p = len(solved), len(root)
    moves = np.empty((count, p))
    for k, item in enumerate(solved):
        keep, turned = np.linalg.eigh(np.eye(p) - root.T @ item.normal @ root)
        fixed = np.where(keep > 0.05, 1.0 / np.maximum(keep, 0.05), 0.0)
        moves[k] = root @ (turned @ (fixed * (turned.T @ (root.T @ item.gradient))))
    moves -= moves.mean(axis=0)
    return (count - 1) / count * moves.T @ moves
