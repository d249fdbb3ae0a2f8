"""The spline under a flow map while it is fitted: its penalties, smoothing and least squares with
growing coefficients.

Coordinates are scaled to 0…1: the opening from the deadband to the largest command, and the root of
the drop. Each coefficient meets a few neighbours only, so the penalised normal matrix is a band.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from functools import cache
from typing import Any

import numpy as np

from ehbench.flow_maps import banded
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


@cache
def _rule(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(places 0…1 of so many nodes of Gauss, their weights, powers as many as nodes)."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1), weights, np.arange(count)


def _gram(pieces: np.ndarray, breaks: np.ndarray, order: int, weight: np.ndarray) -> np.ndarray:
    """∫ weight·B_i^(order) B_j^(order) of splines in polynomial pieces (``bspline_pieces``), exact;
    a weight a span.
    """
    powers, weights, share = _nodes(breaks, pieces.shape[-1] - order)
    return banded.gram(pieces, order, powers, (weights, share * weight))


def _nodes(breaks: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(powers of the places of so many nodes of Gauss in every span, shape (spans, nodes, powers),
    the nodes' weights, half the spans' widths).
    """
    places, weights, powers = _rule(count)
    width = breaks[1:] - breaks[:-1]
    x = places * width[:, None]
    return x[..., None] ** powers, weights, 0.5 * width


def _at_nodes(
    pieces: np.ndarray, breaks: np.ndarray, order: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(B^(order) at the nodes of Gauss of every span, shape (spans, nodes, splines), the nodes'
    weights, half the spans' widths).
    """
    for _ in range(order):
        pieces = pieces[..., 1:] * np.arange(1, pieces.shape[-1])
    powers, weights, share = _nodes(breaks, pieces.shape[-1])
    return np.einsum("jkp,jgp->jgk", pieces, powers), weights, share


class Axis:
    """B-splines along a coordinate scaled to 0…1, but for the first, with ∫ of squares, the
    logarithm of its determinant, and ∫ of squared curvature.
    """

    def __init__(
        self, breaks: np.ndarray, degree: int, stiffness: np.ndarray | None = None
    ) -> None:
        self.breaks, self.pieces = breaks, bspline_pieces(breaks, degree)
        self.size, self.kink = self.pieces.shape[1] - 1, False
        self.mass = _gram(self.pieces, breaks, 0, np.ones(breaks.size - 1))[1:, 1:].copy()
        self.volume = float(np.linalg.slogdet(self.mass)[1])
        self.stiffen(np.ones(breaks.size - 1) if stiffness is None else stiffness)
        knots = np.concatenate([breaks[:1].repeat(degree), breaks, breaks[-1:].repeat(degree)])
        self.centres = np.convolve(knots, np.full(degree, 1.0 / degree), "valid")[
            2:-1
        ]  # coefficients of x itself

    def stiffen(self, stiffness: np.ndarray) -> None:
        self.stiffness = stiffness
        self.bend = _gram(self.pieces, self.breaks, 2, stiffness)[1:, 1:].copy()
        self.eigen = eigenvalues(self.bend, self.mass)
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
        result = np.linalg.svd(np.linalg.solve(factor, rows.T), compute_uv=False)[::-1] ** 2
        return np.concatenate([np.zeros(self.size - result.size), result])

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
        j = self._span(x)
        powers = (x - self.breaks[j])[:, None] ** np.arange(self.pieces.shape[-1])
        return np.einsum("xkp,xp->xk", self.pieces[j, 1:], powers)

    def near(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(number of the first spline that is not zero at x, values of it and those after it, shape
        (points, degree + 1)); number −1 is the spline left out, its value zero.
        """
        first, values = np.empty(x.size, np.int64), np.empty((x.size, self.pieces.shape[-1]))
        banded.near(x, self.breaks, self.pieces, first, values)
        return first, values

    def _span(self, x: np.ndarray) -> np.ndarray:
        return np.clip(np.searchsorted(self.breaks, x, side="right") - 1, 0, self.breaks.size - 2)


class OneColumn(Axis):
    """In place of the root of the drop where no drop was measured: the flow goes by the opening."""

    def __init__(self) -> None:
        self.breaks, self.size, self.kink = np.array([0.0, 1.0]), 1, False
        self.volume = 0.0
        self.mass, self.bend, self.eigen = np.eye(1), np.zeros((1, 1)), np.zeros(1)
        self.stiffness, self.centres = np.ones(1), np.ones(1)

    def stiffen(self, stiffness: np.ndarray) -> None:
        self.stiffness = stiffness

    def at(self, x: np.ndarray) -> np.ndarray:
        return np.ones((x.size, 1))

    def near(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(x.size, np.int64), np.ones((x.size, 1))


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
        inner = _between(tuple(above.tolist()))
        if soft:
            inner = np.append(above[0], inner)
        kinks = tuple(kink for kink in kinks if above[0] < kink < self.top)
        for kink in kinks:
            inner = _kinked(inner, above, kink)
        stiffness = np.ones(inner.size + 1)
        stiffness[: 2 * soft] = _SOFT
        stiffness[[int(np.searchsorted(inner, kink)) for kink in kinks]] = _SHARP
        breaks = np.concatenate([[0.0], (inner - deadband) / (self.top - deadband), [1.0]])
        self.along_u = Axis(breaks, 2, stiffness)
        self.along_s = along_s
        self.rows, self.columns = self.along_u.size, along_s.size
        self.sign = self._signs(rising)
        self.penalties = self.along_u.bend, self.along_u.mass, along_s.bend, along_s.mass
        self.mass = self.columns * self.along_u.volume + self.rows * along_s.volume
        # coefficients of the least map, u·s
        self.floor = _LEAST_SLOPE * np.outer(self.along_u.centres, along_s.centres).ravel()

    def design(self, u: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Flow per coefficient at openings [V] and scaled roots, zero up to the deadband; shape
        (points, coefficients).
        """
        x = np.clip((u - self.deadband) / (self.top - self.deadband), 0.0, 1.0)
        return (self.along_u.at(x)[:, :, None] * self.along_s.at(s)[:, None, :]).reshape(x.size, -1)

    def normal(
        self, u: np.ndarray, s: np.ndarray, weight: np.ndarray, y: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(band of the normal matrix, right side) of weighted flows at openings [V] and scaled
        roots, but those up to the deadband.
        """
        span, along = (self.deadband, self.top), (self.along_u.breaks, self.along_u.pieces)
        size = self.rows, self.columns
        return banded.normal((u, weight, y), span, along, self.along_s.near(s), size)

    def penalised(self, band: np.ndarray, smoothing: np.ndarray) -> np.ndarray:
        """The band of the penalised normal matrix."""
        whole = np.empty_like(band)
        banded.penalise(band, self.penalties, smoothing, whole)
        return whole

    def free(
        self, band: np.ndarray, right: np.ndarray, smoothing: np.ndarray, whole: bool = True
    ) -> tuple[np.ndarray, float, float]:
        """(coefficients without the constraint if the ``whole`` is asked for, what they explain,
        log determinant of the penalised normal matrix over the prior's).

        Args:
            band: of the normal matrix, as `normal` gives it.

        Raises:
            LinAlgError: the penalised normal matrix is not positive definite.
        """
        result, gain, determinant = banded.least(band, self.penalties, smoothing, right, whole)
        if math.isnan(determinant):
            raise np.linalg.LinAlgError("the normal matrix is not positive definite")
        prior = (
            smoothing[0] * self.along_u.eigen[:, None] + smoothing[1] * self.along_s.eigen
        ).ravel()[1:]
        return result, gain, determinant - self.mass - float(np.log(prior).sum())

    def solve(
        self,
        band: np.ndarray,
        right: np.ndarray,
        smoothing: np.ndarray,
        near: np.ndarray | None = None,
    ) -> tuple[np.ndarray, float, np.ndarray]:
        """(coefficients with increments along u of at least those of ``floor``, or at most where
        the flow falls; determinant as ``free``; which increments are just those).

        Args:
            near: a first guess of these; by default those that are wrong without the constraint.
        """
        free, _, determinant = self.free(band, right, smoothing)
        wrong = self.sign * self.increments(free - self.floor).ravel() < 0
        if not wrong.any():
            return free, determinant, wrong
        band = self.penalised(band, smoothing)
        right = right - banded.times(band, self.floor)

        def slope(above: np.ndarray) -> np.ndarray:
            return self.sign * self.over_steps(banded.times(band, above) - right)

        def grown(above: np.ndarray) -> np.ndarray:
            return self.sign * self.increments(above).ravel()

        above, tied = None, wrong
        for guess in (near, wrong):
            if above is None and guess is not None and guess.size == wrong.size:
                above, tied = pivoted(
                    lambda zero: self._tied(band, right, zero), grown, slope, guess
                )
        if above is None:
            above = self._by_nnls(band, right)
        return self.floor + above, determinant, tied

    def _tied(self, band: np.ndarray, right: np.ndarray, zero: np.ndarray) -> np.ndarray:
        """Coefficients of least ½·cᵀ·matrix·c − rightᵀ·c of which some do not grow along u: each of
        these is that of the opening before, or zero.
        """
        size = right.size
        own = np.where(zero, -1, np.cumsum(~zero) - 1).reshape(self.rows, self.columns)
        at = np.arange(size).reshape(own.shape)
        last = np.maximum.accumulate(np.where(own >= 0, at, -1), axis=0).ravel()
        own = np.append(own.ravel(), -1)[last]  # which unknown each coefficient is, −1 for zero
        result, sound = banded.tied(band, right, own)
        if not sound:
            raise np.linalg.LinAlgError("the normal matrix of what grows is not positive definite")
        return result

    def _by_nnls(self, band: np.ndarray, right: np.ndarray) -> np.ndarray:
        """What `solve` looks for, above the floor, by an active set: slow, but it comes to an
        end.
        """
        from scipy.optimize import nnls

        steps = self.over_steps(self.over_steps(full(band)).T)
        factor = np.linalg.cholesky(self.sign[:, None] * steps * self.sign)
        pull = np.linalg.solve(factor, self.sign * self.over_steps(right))
        grown = self.sign * nnls(factor.T, pull, maxiter=50 * right.size)[0]
        return np.cumsum(grown.reshape(self.rows, self.columns), axis=0).ravel()

    def _signs(self, rising: float) -> np.ndarray:
        """1 for each coefficient whose increment along the opening must not be negative, −1 for
        each whose must not be positive.
        """
        sign = np.ones((self.rows, self.columns))
        if rising < self.top:
            volts = self.deadband + self.along_u.breaks * (self.top - self.deadband)
            sign[max(int(np.argmin(np.abs(volts - rising))), 1) + 1 :] = -1.0
        return sign.ravel()

    def over_steps(self, values: np.ndarray) -> np.ndarray:
        """Derivatives by the coefficients, along the first axis, as derivatives by their increments
        along u.
        """
        return np.cumsum(values.reshape(self.rows, self.columns, -1)[::-1], axis=0)[::-1].reshape(
            values.shape
        )

    def increments(self, coefficients: np.ndarray) -> np.ndarray:
        """What the coefficients grow by along u, shape (rows, columns)."""
        result = coefficients.reshape(self.rows, self.columns).copy()
        result[1:] -= result[:-1].copy()
        return result


@cache
def _between(above: tuple[float, ...]) -> np.ndarray:
    """Breaks between commands: a spline of degree 2 rings without end if its knots are the places
    read.
    """
    read = np.array(above)
    inner = 0.5 * (read[1:] + read[:-1])
    few = inner.size <= SPANS_U - 1
    return inner if few else np.quantile(inner, np.linspace(0, 1, SPANS_U + 1)[1:-1])


def _kinked(inner: np.ndarray, above: np.ndarray, kink: float) -> np.ndarray:
    """Inner breaks with a narrow span about a kink, and no other between the commands beside it."""
    k = int(np.searchsorted(above, kink))
    reach = _NARROW * (above[k] - above[k - 1])
    retained = inner[(inner <= above[k - 1]) | (inner >= above[k])]
    return np.sort(np.append(retained, (kink - reach, kink + reach)))


@cache
def _routines() -> Any:
    """What scipy.linalg calls, without its looks at the arguments."""
    from scipy.linalg import lapack

    return lapack


def cholesky(band: np.ndarray) -> np.ndarray:
    """Band of the Cholesky factor of a symmetric matrix of which the band is given.

    Raises:
        LinAlgError: the matrix is not positive definite.
    """
    factor = band.copy()
    if info := banded.factorise(factor):
        raise np.linalg.LinAlgError(f"the normal matrix is not positive definite ({info})")
    return factor


def eigenvalues(matrix: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Those λ, ascending, at which ``matrix − λ·mass`` is singular, both symmetric.

    Raises:
        LinAlgError: the mass is not positive definite.
    """
    values, _, info = _routines().dsygvd(matrix, mass, jobz="N", uplo="L")
    if info:
        raise np.linalg.LinAlgError(f"no eigenvalues of the penalty ({info})")
    return values


def full(band: np.ndarray) -> np.ndarray:
    """The symmetric matrix of which the band is given."""
    size = len(band)
    matrix = np.zeros((size, size))
    for k, line in enumerate(band.T[:size]):
        np.fill_diagonal(matrix[k:, : size - k], line[: size - k])
    return matrix + np.tril(matrix, -1).T


def pivoted(
    solve: Callable[[np.ndarray], np.ndarray],
    steps: Callable[[np.ndarray], np.ndarray],
    slope: Callable[[np.ndarray], np.ndarray],
    zero: np.ndarray,
) -> tuple[np.ndarray | None, np.ndarray]:
    """(the point of a quadratic's least whose ``steps`` are ≥ 0, by block pivoting (Portugal,
    Júdice, Vicente 1994), None where it goes round in circles; which of its steps are zero).

    Args:
        solve: the least with the steps that are marked at zero.
        steps: of a point.
        slope: derivatives by the steps at a point.
        zero: a first guess of the steps that are zero.
    """
    minimum = 1e-12 * np.abs(slope(np.zeros(zero.size))).max()
    for _ in range(50):
        point = solve(zero)
        wrong = np.where(zero, slope(point) < -minimum, steps(point) < 0.0)
        if not wrong.any():
            return point, zero
        zero = zero ^ wrong
    return None, zero
