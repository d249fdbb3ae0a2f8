"""Standard errors of a least-squares fit to logs whose residuals are coloured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ehbench.identification.search import LEVEL
from ehbench.signals import correlation_time


@dataclass(frozen=True)
class Covariance:
    """Covariances of the search coordinates: ``hac`` and, with three logs or more, ``jackknife``;
    ``alone`` is the standard error each parameter would have if all the others were known."""

    hac: np.ndarray
    jackknife: np.ndarray | None
    logs: int
    alone: np.ndarray
    meat: np.ndarray
    gradient: np.ndarray

    def error(self, k: int) -> tuple[float, float, str]:
        """(standard error, quantile of the 95 % interval, where it is from) of parameter k:
        whichever gives the wider interval.
        """
        from scipy.stats import norm, t

        normal = float(norm.ppf(0.5 + 0.5 * LEVEL))
        hac = math.sqrt(max(self.hac[k, k], 0.0))
        if self.jackknife is not None:
            jack, quantile = (
                math.sqrt(max(self.jackknife[k, k], 0.0)),
                float(t.ppf(0.5 + 0.5 * LEVEL, self.logs - 1)),
            )
            if jack * quantile > hac * normal:
                return jack, quantile, "jackknife"
        return hac, normal, "hac"

    @property
    def correlation(self) -> np.ndarray:
        size = np.sqrt(np.maximum(np.diag(self.hac), 1e-300))
        return self.hac / np.outer(size, size)


def covariance_of(slopes: Sequence[np.ndarray], left: Sequence[np.ndarray]) -> Covariance:
    """Covariance of a least-squares solution whose residuals are coloured.

    Sandwich ``H⁻¹ M H⁻¹`` with ``H = Σ JᵀJ`` and M the long-run covariance of the scores ``s_t =
    J_tᵀ r_t`` of each log, Bartlett weights to four correlation times of the scores (Newey & West
    1987). Jackknife: each log left out in turn, one Gauss–Newton step; directions that one log
    alone informs are left to the sandwich.

    Args:
        slopes: by log, shape (samples, channels, parameters).
        left: residuals by log, shape (samples, channels).
    """
    information = [np.einsum("tci,tcj->ij", part, part) for part in slopes]
    scores = [np.einsum("tci,tc->ti", part, rest) for part, rest in zip(slopes, left, strict=True)]
    total = np.sum(information, axis=0)
    size = np.sqrt(np.maximum(np.diag(total), 1e-300))
    values, vectors = np.linalg.eigh(total / np.outer(size, size))
    root = vectors / np.sqrt(np.maximum(values, 1e-12 * values[-1])) / size[:, None]
    inverse = root @ root.T
    meat = np.sum([_long_run(score) for score in scores], axis=0)
    alone = np.sqrt(np.maximum(np.diag(meat), 0.0)) / np.maximum(np.diag(total), 1e-300)
    jackknife = None
    count = len(slopes)
    if count >= 3:
        moves = np.empty((count, len(size)))
        for k in range(count):
            keep, turned = np.linalg.eigh(np.eye(len(size)) - root.T @ information[k] @ root)
            held = np.where(keep > 0.05, 1.0 / np.maximum(keep, 0.05), 0.0)
            moves[k] = root @ (turned @ (held * (turned.T @ (root.T @ np.sum(scores[k], axis=0)))))
        moves -= moves.mean(axis=0)
        jackknife = (count - 1) / count * moves.T @ moves
    gradient = np.sum([np.sum(score, axis=0) for score in scores], axis=0)
    return Covariance(inverse @ meat @ inverse, jackknife, count, alone, meat, gradient)


def _long_run(score: np.ndarray) -> np.ndarray:
    """n times the long-run covariance of a series of scores, shape (samples, parameters) →
    (parameters, parameters).
    """
    n = len(score)
    reach = min(n // 4, math.ceil(4.0 * max(correlation_time(column) for column in score.T)))
    result = score.T @ score
    for lag in range(1, reach + 1):
        product = score[lag:].T @ score[:-lag]
        result += (1.0 - lag / (reach + 1.0)) * (product + product.T)
    return result
