"""The spline under a flow map while it is fitted: its penalties, smoothing and least squares with
growing coefficients.

Coordinates are scaled to 0…1: the opening from the deadband to the largest command, and the root of
the drop. Each coefficient meets a few neighbours only, so the penalised normal matrix is a band.
"""

from __future__ import annotations

from copy import copy
from functools import cache
from typing import Any

import numpy as np

from ehbench.physics.flow_map import bspline_pieces

# a bend in the drop, a soft start, a kink in the opening: the penalty on curvature is this share of
# what it is elsewhere
_BEND, _SOFT, _SHARP = 1e-4, 1e-9, 1e-7
# a spline slope of this share of the rated flow over the command range keeps the map strictly
# increasing
_LEAST_SLOPE = 1e-4
# share of the largest eigenvalue below which one of the penalty is rounding
_ROUNDED = 1e-13
SPANS_U = 12
# half the width of the span that bends at a kink, as a share of the gap between two commands
_NARROW = 0.01

_legendre = cache(np.polynomial.legendre.leggauss)


def _gram(
    pieces: np.ndarray, breaks: np.ndarray, order: int, weight: np.ndarray | float = 1.0
) -> np.ndarray:
    """∫ weight·B_i^(order) B_j^(order) of splines in polynomial pieces (``bspline_pieces``), exact;
    a weight a span.
    """
    values, weights, share = _at_nodes(pieces, breaks, order)
    return np.einsum("jgk,jgl,g,j->kl", values, values, weights, share * weight)


def _at_nodes(
    pieces: np.ndarray, breaks: np.ndarray, order: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(B^(order) at the nodes of Gauss of every span, shape (spans, nodes, splines), the nodes'
    weights, half the spans' widths).
    """
    for _ in range(order):
        pieces = pieces[..., 1:] * np.arange(1, pieces.shape[-1])
    nodes, weights = _legendre(pieces.shape[-1])
    width = np.diff(breaks)
    x = 0.5 * (nodes + 1)[None, :] * width[:, None]
    values = np.einsum("jkp,jgp->jgk", pieces, x[..., None] ** np.arange(pieces.shape[-1]))
    return values, weights, 0.5 * width


class Axis:
    """B-splines along a coordinate scaled to 0…1, but for the first, with ∫ of squares and of
    squared curvature.
    """

    def __init__(self, breaks: np.ndarray, degree: int) -> None:
        self.breaks, self.pieces = breaks, bspline_pieces(breaks, degree)
        self.size, self.kink = self.pieces.shape[1] - 1, False
        self.mass = _gram(self.pieces, breaks, 0)[1:, 1:]
        self.stiffen(np.ones(breaks.size - 1))
        knots = np.concatenate([breaks[:1].repeat(degree), breaks, breaks[-1:].repeat(degree)])
        self.centres = np.convolve(knots, np.full(degree, 1.0 / degree), "valid")[
            2:-1
        ]  # coefficients of x itself

    def stiffen(self, stiffness: np.ndarray) -> None:
        from scipy.linalg import eigh

        self.stiffness = stiffness
        self.bend = _gram(self.pieces, self.breaks, 2, stiffness)[1:, 1:]
        self.eigen = eigh(self.bend, self.mass, eigvals_only=True)
        if self.eigen[1] < _ROUNDED * self.eigen[-1]:
            self.eigen = self._small_eigen()
        self.eigen[0] = 0.0  # a straight line is free

    def _small_eigen(self) -> np.ndarray:
        """The eigenvalues where the least are lost in the rounding of the largest, as beside the
        narrow span of a kink: squares of singular values, which keep twice the digits.
        """
        values, weights, share = _at_nodes(self.pieces, self.breaks, 2)
        root = np.sqrt(weights * (share * self.stiffness)[:, None])
        rows = (root[..., None] * values[..., 1:]).reshape(-1, self.size)
        factor = np.linalg.cholesky(self.mass)
        found = np.linalg.svd(np.linalg.solve(factor, rows.T), compute_uv=False)[::-1] ** 2
        return np.concatenate([np.zeros(self.size - found.size), found])

    def bent(self, k: int) -> Axis:
        """The same axis, free to bend sharply at its inner break k."""
        stiffness = self.stiffness.copy()
        stiffness[k - 1 : k + 1] = _BEND
        return self.stiffened(stiffness, kink=True)

    def graded(self, power: float) -> Axis:
        """The same axis, freer to bend towards zero: stiffness as a power of the coordinate."""
        return self.stiffened(
            np.maximum((0.5 * (self.breaks[1:] + self.breaks[:-1])) ** power, _BEND)
        )

    def stiffened(self, stiffness: np.ndarray, kink: bool = False) -> Axis:
        """The same axis with a stiffness a span, by which its curvature counts."""
        other = copy(self)
        other.kink = kink
        other.stiffen(stiffness)
        return other

    def at(self, x: np.ndarray) -> np.ndarray:
        """Values at x, shape (points, splines)."""
        j = np.clip(np.searchsorted(self.breaks, x, side="right") - 1, 0, self.breaks.size - 2)
        powers = (x - self.breaks[j])[:, None] ** np.arange(self.pieces.shape[-1])
        return np.einsum("xkp,xp->xk", self.pieces[j, 1:], powers)


class OneColumn(Axis):
    """In place of the root of the drop where no drop was measured: the flow goes by the opening."""

    def __init__(self) -> None:
        self.breaks, self.size, self.kink = np.array([0.0, 1.0]), 1, False
        self.mass, self.bend, self.eigen = np.eye(1), np.zeros((1, 1)), np.zeros(1)
        self.stiffness, self.centres = np.ones(1), np.ones(1)

    def stiffen(self, stiffness: np.ndarray) -> None:
        self.stiffness = stiffness

    def at(self, x: np.ndarray) -> np.ndarray:
        return np.ones((x.size, 1))


class Spline:
    """The spline of one deadband on opening and root of drop scaled to 0…1: design, penalties,
    fit.

    It may bend sharply at the openings ``kinks`` [V]. Its flow grows with the opening up to the
    break nearest to ``rising`` [V], and falls above it."""

    def __init__(
        self,
        deadband: float,
        above: np.ndarray,
        along_s: Axis,
        soft: bool = False,
        kinks: tuple[float, ...] = (),
        rising: float = np.inf,
    ) -> None:
        self.deadband, self.top = deadband, float(above[-1])
        inner = 0.5 * (
            above[1:] + above[:-1]
        )  # a spline of degree 2 rings without end if its knots are the places read
        if inner.size > SPANS_U - 1:
            inner = np.quantile(inner, np.linspace(0, 1, SPANS_U + 1)[1:-1])
        if soft:
            inner = np.append(above[0], inner)
        kinks = tuple(kink for kink in kinks if above[0] < kink < self.top)
        for kink in kinks:
            inner = _kinked(inner, above, kink)
        self.along_u = Axis(
            np.concatenate([[0.0], (inner - deadband) / (self.top - deadband), [1.0]]), 2
        )
        if soft or kinks:
            stiffness = np.ones(inner.size + 1)
            stiffness[: 2 * soft] = _SOFT
            stiffness[[int(np.searchsorted(inner, kink)) for kink in kinks]] = _SHARP
            self.along_u.stiffen(stiffness)
        self.along_s = along_s
        self.rows, self.columns = self.along_u.size, along_s.size
        self.sign = self._signs(rising)
        self.bend_u, self.bend_s = (
            np.kron(self.along_u.bend, along_s.mass),
            np.kron(self.along_u.mass, along_s.bend),
        )
        self.bands = self.banded(self.bend_u), self.banded(self.bend_s)
        self.mass = (
            self.columns * np.linalg.slogdet(self.along_u.mass)[1]
            + self.rows * np.linalg.slogdet(along_s.mass)[1]
        )
        self.floor = _LEAST_SLOPE * np.kron(
            self.along_u.centres, along_s.centres
        )  # coefficients of the least map, u·s

    def design(self, u: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Flow per coefficient at openings [V] and scaled roots, zero up to the deadband; shape
        (points, coefficients).
        """
        x = np.clip((u - self.deadband) / (self.top - self.deadband), 0.0, 1.0)
        return (self.along_u.at(x)[:, :, None] * self.along_s.at(s)[:, None, :]).reshape(x.size, -1)

    def banded(self, matrix: np.ndarray) -> np.ndarray:
        """The lower band of a symmetric matrix over the coefficients: splines meet their neighbours
        only.
        """
        column = np.arange(len(matrix))
        row = column + np.arange(2 * self.columns + 4)[:, None]
        return matrix[np.minimum(row, column[-1]), column]

    def free(self, band: np.ndarray, right: np.ndarray, smoothing: np.ndarray):
        """(coefficients without the constraint, log determinant of the penalised normal matrix over
        the prior's).
        """
        from scipy.linalg import lapack

        routines: Any = lapack  # what scipy.linalg calls, without its looks at the arguments
        band = band + smoothing[0] * self.bands[0] + smoothing[1] * self.bands[1]
        factor, info = routines.dpbtrf(band, lower=True)
        if info:
            raise np.linalg.LinAlgError(f"the normal matrix is not positive definite ({info})")
        prior = (
            smoothing[0] * self.along_u.eigen[:, None] + smoothing[1] * self.along_s.eigen
        ).ravel()[1:]
        determinant = 2 * np.log(factor[0]).sum() - self.mass - np.log(prior).sum()
        return routines.dpbtrs(factor, right, lower=True)[0], determinant

    def matrix(self, gram: np.ndarray, smoothing: np.ndarray) -> np.ndarray:
        """The penalised normal matrix."""
        return gram + smoothing[0] * self.bend_u + smoothing[1] * self.bend_s

    def solve(self, gram: np.ndarray, right: np.ndarray, smoothing: np.ndarray):
        """(coefficients with increments along u of at least those of ``floor``, or at most where
        the flow falls; determinant as ``free``).
        """
        free, determinant = self.free(self.banded(gram), right, smoothing)
        wrong = self.sign * self.increments(free - self.floor).ravel() < 0
        if not wrong.any():
            return free, determinant
        matrix = self.matrix(gram, smoothing)
        right = self.sign * self.over_steps(right - matrix @ self.floor)
        steps = self.over_steps(self.over_steps(matrix).T)
        steps = self.sign * non_negative(self.sign[:, None] * steps * self.sign, right, wrong)
        return self.floor + np.cumsum(
            steps.reshape(self.rows, self.columns), axis=0
        ).ravel(), determinant

    def _signs(self, rising: float) -> np.ndarray:
        """1 for each coefficient whose increment along the opening must not be negative, −1 for
        each whose must not be positive.
        """
        row = np.arange(self.rows)
        if rising < self.top:
            volts = self.deadband + self.along_u.breaks * (self.top - self.deadband)
            row = row - max(int(np.argmin(np.abs(volts - rising))), 1)
        else:
            row = row - self.rows
        return np.repeat(np.where(row > 0, -1.0, 1.0), self.columns)

    def over_steps(self, values: np.ndarray) -> np.ndarray:
        """Derivatives by the coefficients, along the first axis, as derivatives by their increments
        along u.
        """
        return np.cumsum(values.reshape(self.rows, self.columns, -1)[::-1], axis=0)[::-1].reshape(
            values.shape
        )

    def increments(self, coefficients: np.ndarray) -> np.ndarray:
        return np.diff(coefficients.reshape(self.rows, self.columns), axis=0, prepend=0.0)


def _kinked(inner: np.ndarray, above: np.ndarray, kink: float) -> np.ndarray:
    """Inner breaks with a narrow span about a kink, and no other between the commands beside it."""
    k = int(np.searchsorted(above, kink))
    reach = _NARROW * (above[k] - above[k - 1])
    kept = inner[(inner <= above[k - 1]) | (inner >= above[k])]
    return np.sort(np.append(kept, (kink - reach, kink + reach)))


def non_negative(matrix: np.ndarray, right: np.ndarray, zero: np.ndarray) -> np.ndarray:
    """x ≥ 0 of least ½·xᵀ·matrix·x − rightᵀ·x by block pivoting (Portugal, Júdice, Vicente 1994),
    ``zero`` as a first guess.
    """
    from scipy.linalg import cho_factor, cho_solve
    from scipy.optimize import nnls

    x, zero = np.zeros(right.size), zero.copy()
    least = 1e-12 * np.abs(right).max()
    for _ in range(50):
        x[zero] = 0.0
        x[~zero] = cho_solve(
            cho_factor(matrix[np.ix_(~zero, ~zero)], check_finite=False),
            right[~zero],
            check_finite=False,
        )
        wrong = np.where(zero, matrix @ x - right < -least, x < 0.0)
        if not wrong.any():
            return x
        zero ^= wrong
    factor = np.linalg.cholesky(matrix)  # it may go round in circles
    return nnls(factor.T, np.linalg.solve(factor, right), maxiter=50 * right.size)[0]
