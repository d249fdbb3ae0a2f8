"""What samples say together: quantiles and shares with limits, and inputs that matter."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

TAIL = 0.5 * (1.0 - 0.95)  # on each side of a 95 % interval
QUANTILES = (0.05, 0.5, 0.95, 0.99)


class Quantile(NamedTuple):
    """A quantile: ``share``, value, ends of its 95 % interval, None with too few samples."""

    share: float
    value: float
    low: float | None
    high: float | None


def quantile(values: np.ndarray, share: float, alike: float = 1.0) -> Quantile:
    """A quantile with a distribution-free interval from order statistics: the number of samples
    below the quantile is binomial (Conover, Practical Nonparametric Statistics, 3.2).

    Args:
        values: finite, shape (samples,), at least one.
        share: of the quantile, above 0 and below 1.
        alike: samples that count as one, as they share what was drawn."""
    from scipy.stats import binom

    ordered, count = np.sort(values), max(1, int(values.size / alike))
    first, last = int(binom.ppf(TAIL, count, share)) - 1, int(binom.isf(TAIL, count, share))
    low = float(ordered[first * values.size // count]) if first >= 0 else None
    high = float(ordered[-(-(last + 1) * values.size // count) - 1]) if last < count else None
    return Quantile(share, float(np.quantile(values, share)), low, high)


class Share(NamedTuple):
    """How many of how many, as a share with its 95 % interval."""

    count: int
    of: int
    share: float
    low: float
    high: float


def share(count: int, of: int, alike: float = 1.0) -> Share:
    """A share with its exact interval (Clopper and Pearson 1934); ``alike`` as for `quantile`."""
    from scipy.special import betaincinv

    if not of:
        return Share(0, 0, math.nan, 0.0, 1.0)
    met, missed = count / alike, (of - count) / alike
    low = 0.0 if not met else float(betaincinv(met, missed + 1, TAIL))
    high = 1.0 if not missed else float(betaincinv(met + 1, missed, 1.0 - TAIL))
    return Share(count, of, count / of, low, high)


class Sensitivity(NamedTuple):
    """How much an input moves a measure: ``first`` and ``total`` Sobol indices ± 95 % half widths,
    or ``rank`` coefficient of a regression; None: not of this kind."""

    key: str
    rank: float | None = None
    first: float | None = None
    first_error: float | None = None
    total: float | None = None
    total_error: float | None = None


def rank_regression(
    keys: Sequence[str], inputs: np.ndarray, values: np.ndarray
) -> tuple[list[Sensitivity], float]:
    """(standardised rank-regression coefficients, the share of the ranks' variance that they
    explain): the linear regression of ranks on ranks (Saltelli and Sobol 1995).

    Args:
        keys: of the inputs.
        inputs: shape (samples, inputs); those that do not vary get nan.
        values: finite, shape (samples,)."""
    from scipy.stats import rankdata

    x, y = rankdata(inputs, axis=0), rankdata(values)
    spread = x.std(axis=0)
    moving = spread > 0.0
    if values.size <= moving.sum() + 1 or not y.std():
        return [Sensitivity(key) for key in keys], math.nan
    a = (x[:, moving] - x[:, moving].mean(axis=0)) / spread[moving]
    b = (y - y.mean()) / y.std()
    coefficients, *_ = np.linalg.lstsq(a, b, rcond=None)
    explained = 1.0 - float(np.mean((b - a @ coefficients) ** 2))
    result = np.full(len(keys), np.nan)
    result[moving] = coefficients
    return [
        Sensitivity(key, rank=None if math.isnan(item) else item)
        for key, item in zip(keys, result.tolist(), strict=True)
    ], explained


def scores(codes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The number of a text in a regression of ranks: the mean rank of its samples.

    Args:
        codes: a number for each text, shape (samples,).
        values: of the measure, finite, shape (samples,)."""
    from scipy.stats import rankdata

    ranks, (_, at) = rankdata(values), np.unique(codes, return_inverse=True)
    return (np.bincount(at, ranks) / np.bincount(at))[at]


def sobol(keys: Sequence[str], values: np.ndarray, count: int, seed: int) -> list[Sensitivity]:
    """First-order and total Sobol indices of a saltelli design, with bootstrap half widths.

    Args:
        keys: of the inputs.
        values: finite, in the order of the design: A, B, then A with each column of B in turn.
        count: samples in A.
        seed: of the bootstrap."""
    from scipy.stats import sobol_indices

    size = len(keys)
    f_a, f_b = values[:count], values[count : 2 * count]
    f_ab = values[2 * count :].reshape(size, count)

    def indices(f_a: np.ndarray, f_b: np.ndarray, f_ab: np.ndarray):
        # shapes as scipy has them: (outputs, n), (outputs, n), (inputs, outputs, n)
        func = {"f_A": f_a[None, :], "f_B": f_b[None, :], "f_AB": f_ab[:, None, :]}
        result = sobol_indices(func=func, n=count)
        return np.atleast_1d(result.first_order), np.atleast_1d(result.total_order)

    first, total = indices(f_a, f_b, f_ab)
    rng, draws = np.random.default_rng(seed), []
    for _ in range(200):
        at = rng.integers(0, count, count)
        draws.append(indices(f_a[at], f_b[at], f_ab[:, at]))
    half = 1.96 * np.std(np.array(draws), axis=0)
    return [
        Sensitivity(key, None, *map(float, (first[i], half[0][i], total[i], half[1][i])))
        for i, key in enumerate(keys)
    ]
