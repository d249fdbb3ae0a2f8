"""The spline under a flow map while it is fitted: its penalties, smoothing and least squares with
growing coefficients.

Coordinates are scaled to 0…1: the opening from the deadband to the largest command, and the root of
the drop. A coefficient meets two neighbours along the opening and three along the root, so a normal
matrix is a symmetric band: ``band[k, j]`` is its number in column j, k below the diagonal, as in
LAPACK; the coefficients along the opening come first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np

from ehbench.physics.flow_map import bspline_pieces
from ehbench.vocabulary import message, setting


@dataclass(frozen=True)
class SplineSettings:
    """Numbers of the spline under a flow map."""

    spans: int = setting(12, "", "largest number of spans along the opening", "noise")
    room: float = setting(1e-6, "", "narrowest first span, share of the commands", "arithmetic")
    bend: float = setting(1e-4, "", "penalty left at a sharp bend in the drop", "free")
    soft: float = setting(1e-9, "", "penalty left over the spans of a soft start", "free")
    sharp: float = setting(1e-7, "", "penalty left at a kink in the opening", "free in its digits")
    slope: float = setting(1e-4, "", "smallest slope, rated flow over the range", "invertible")
    narrow: float = setting(0.01, "", "half width of a kink's span, of the gap", "a jump")


SETTINGS = SplineSettings()


_gauss = cache(np.polynomial.legendre.leggauss)  # nodes and weights on −1…1


class Axis:
    """B-splines along a coordinate scaled to 0…1, but for the first.

    ``mass`` is ∫ of their products, ``curvature`` that of their second derivatives, each span times
    its ``stiffness``, and ``bends`` its root, shape (nodes, splines); ``volume`` the logarithm of
    the mass's determinant, ``eigenvalues`` those of the curvature with the mass, the first, of a
    straight line, zero. ``kink``: it may bend sharply at a break."""

    kink = False

    def __init__(
        self, breaks: np.ndarray, degree: int, stiffness: np.ndarray | None = None
    ) -> None:
        self.breaks, self.degree = breaks, degree
        self.pieces = bspline_pieces(breaks, degree)[:, 1:]
        self.size = self.pieces.shape[1]
        self.stiffness = np.ones(breaks.size - 1) if stiffness is None else stiffness
        knots = np.concatenate([breaks[:1].repeat(degree), breaks, breaks[-1:].repeat(degree)])
        # coefficients of the coordinate itself
        self.centres = np.convolve(knots, np.full(degree, 1.0 / degree), "valid")[2:-1]
        squares, self.bends = self._quadrature(0), self._quadrature(2)
        self.bends *= np.sqrt(self.stiffness.repeat(degree - 1))[:, None]
        self.mass, self.curvature = squares.T @ squares, self.bends.T @ self.bends
        factor = np.linalg.cholesky(self.mass)
        self.volume = 2.0 * float(np.log(np.diag(factor)).sum())
        # squares of singular values have twice the digits of eigenvalues
        values = np.linalg.svd(np.linalg.solve(factor, self.bends.T), compute_uv=False)[::-1] ** 2
        self.eigenvalues = np.pad(values, (self.size - values.size, 0))
        self.eigenvalues[0] = 0.0

    def _quadrature(self, order: int) -> np.ndarray:
        """Derivatives of an order at Gauss's nodes times the root of their weights, (nodes,
        splines)."""
        pieces = self.pieces
        for _ in range(order):
            pieces = pieces[..., 1:] * np.arange(1, pieces.shape[-1])
        nodes, weights = _gauss(pieces.shape[-1])
        width = np.diff(self.breaks)[:, None]
        powers = (0.5 * (nodes + 1.0) * width)[..., None] ** np.arange(pieces.shape[-1])
        root = np.sqrt(0.5 * width * weights)[..., None]
        return (root * np.einsum("jkp,jgp->jgk", pieces, powers)).reshape(-1, self.size)

    def bent(self, k: int) -> Axis:
        """The same axis, free to bend sharply at its inner break k."""
        stiffness = self.stiffness.copy()
        stiffness[k - 1 : k + 1] = SETTINGS.bend
        other = Axis(self.breaks, self.degree, stiffness)
        other.kink = True
        return other

    def graded(self, power: float) -> Axis:
        """The same axis, freer to bend towards zero: stiffness as a power of the coordinate."""
        middle = 0.5 * (self.breaks[1:] + self.breaks[:-1])
        return Axis(self.breaks, self.degree, np.maximum(middle**power, SETTINGS.bend))

    def at(self, x: np.ndarray) -> np.ndarray:
        """Values at x, shape (points, splines)."""
        j = np.searchsorted(self.breaks[1:-1], x, side="right")
        powers = (x - self.breaks[j])[:, None] ** np.arange(self.degree + 1)
        return np.einsum("xkp,xp->xk", self.pieces[j], powers)


class OneColumn(Axis):
    """In place of the root of the drop where no drop was measured: the flow goes by the opening."""

    def __init__(self) -> None:
        self.breaks, self.size = np.zeros(2), 1
        # pyrefly: ignore[bad-override-mutable-attribute]
        self.volume, self.eigenvalues = 0.0, np.zeros(1)
        self.mass, self.curvature, self.bends = np.eye(1), np.zeros((1, 1)), np.zeros((1, 1))
        self.centres = np.ones(1)

    def at(self, x: np.ndarray) -> np.ndarray:
        return np.ones((x.size, 1))


class Spline:
    """The spline of one deadband on opening and root of drop.

    Args:
        deadband: [V].
        above: [V] the commands above it.
        along_s: along the root of the drop.
        soft: free to curve over the first spans.
        kinks: [V] openings where it may bend sharply.
        rising: [V] its flow grows with the opening up to the break next to it, and falls above."""

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
        # a spline of degree 2 rings without end if its knots are the places read
        inner = 0.5 * (above[1:] + above[:-1])
        if inner.size >= SETTINGS.spans:
            inner = np.quantile(inner, np.linspace(0, 1, SETTINGS.spans + 1)[1:-1])
        if soft:
            inner = np.append(above[0], inner)
        kinks = tuple(kink for kink in kinks if max(above[0], deadband) < kink < self.top)
        for kink in kinks:
            k = int(np.searchsorted(above, kink))
            reach = SETTINGS.narrow * (above[k] - above[k - 1])
            retained = inner[(inner <= above[k - 1]) | (inner >= above[k])]
            inner = np.sort(np.append(retained, (kink - reach, kink + reach)))
        # a deadband may be tried beyond the first commands that pass flow: those of a leak
        inner = inner[inner > deadband + SETTINGS.room * (self.top - deadband)]
        stiffness = np.ones(inner.size + 1)
        stiffness[: 2 * soft] = SETTINGS.soft
        stiffness[[int(np.searchsorted(inner, kink)) for kink in kinks]] = SETTINGS.sharp
        breaks = np.concatenate([[0.0], (inner - deadband) / (self.top - deadband), [1.0]])
        self.along_u, self.along_s = Axis(breaks, 2, stiffness), along_s
        self.rows, self.columns = self.along_u.size, along_s.size
        self.size = self.rows * self.columns
        # 1 for a coefficient whose increment along the opening must not be negative, −1 for one
        # whose must not be positive
        sign = np.ones((self.rows, self.columns))
        if rising < self.top:
            sign[max(int(np.argmin(np.abs(self.volts - rising))), 1) + 1 :] = -1.0
        self.sign = sign.T.ravel()
        # coefficients of the least map, u·s
        self.floor = SETTINGS.slope * np.outer(along_s.centres, self.along_u.centres).ravel()

    @property
    def volts(self) -> np.ndarray:
        """The breaks along the opening [V]."""
        return self.deadband + self.along_u.breaks * (self.top - self.deadband)

    @cached_property
    def penalties(self) -> tuple[np.ndarray, np.ndarray]:
        """Bands of the penalties on the curvature along opening and root: Kronecker products."""
        pairs, u, s = _pairs(self.rows, self.columns), self.along_u, self.along_s
        along_u = pairs.band(u.curvature[pairs.rows][None], s.mass[pairs.columns][None])
        return along_u, pairs.band(u.mass[pairs.rows][None], s.curvature[pairs.columns][None])

    def factors(self, u: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The splines along opening [V] and scaled root; shapes (points, rows) and (points,
        columns)."""
        share = np.clip((u - self.deadband) / (self.top - self.deadband), 0.0, 1.0)
        return self.along_u.at(share), self.along_s.at(s)

    def design(self, u: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Flow per coefficient at openings [V] and scaled roots; shape (points, coefficients)."""
        of_u, of_s = self.factors(u, s)
        return (of_s[:, :, None] * of_u[:, None, :]).reshape(u.size, -1)

    def normal(
        self, factors: tuple[np.ndarray, np.ndarray], weight: np.ndarray, y: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(band of the normal matrix, right side) of weighted flows, by their `factors`."""
        (of_u, of_s), pairs = factors, _pairs(self.rows, self.columns)
        weighed, (i, j), (k, m) = weight[:, None] * of_u, pairs.rows, pairs.columns
        band = pairs.band(weighed[:, i] * of_u[:, j], of_s[:, k] * of_s[:, m])
        return band, (of_s.T @ (weighed * y[:, None])).ravel()

    def penalised(self, band: np.ndarray, smoothing: np.ndarray) -> np.ndarray:
        """The band of a normal matrix with the penalties times their smoothing."""
        along_u, along_s = self.penalties
        whole = smoothing[0] * along_u
        whole += smoothing[1] * along_s
        whole += band
        return whole

    def free(
        self, band: np.ndarray, right: np.ndarray, smoothing: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """(coefficients without the constraint, log determinant of the penalised normal matrix over
        the prior's).

        Args:
            band: of the normal matrix, as `normal` gives it.

        Raises:
            LinAlgError: the penalised normal matrix is not positive definite."""
        # pyrefly: ignore[missing-module-attribute]
        from scipy.linalg.lapack import dpbsv

        whole = self.penalised(band, smoothing)
        factor, result, info = dpbsv(whole, right, lower=1, overwrite_ab=1)
        if info:
            raise np.linalg.LinAlgError(message("flow_maps.not_definite"))
        along_u, along_s = self.along_u, self.along_s
        prior = smoothing[0] * along_u.eigenvalues[:, None] + smoothing[1] * along_s.eigenvalues
        volume = self.columns * along_u.volume + self.rows * along_s.volume
        determinant = 2.0 * float(np.log(factor[0]).sum()) - volume
        return result, determinant - float(np.log(prior.ravel()[1:]).sum())

    def roughness(self, coefficients: np.ndarray, smoothing: np.ndarray) -> float:
        """What the penalties, times their smoothing, make of coefficients."""
        table = self.table(coefficients)
        along_u, along_s = self.along_u.bends @ table, table @ self.along_s.bends.T
        return float(
            smoothing[0] * np.sum((along_u @ self.along_s.mass) * along_u)
            + smoothing[1] * np.sum((self.along_u.mass @ along_s) * along_s)
        )

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
            near: a first guess of these; by default those that are wrong without the constraint."""

        def grown(above: np.ndarray) -> np.ndarray:
            return self.sign * self.increments(above).T.ravel()

        free, determinant = self.free(band, right, smoothing)
        wrong = grown(free - self.floor) < 0
        if not wrong.any():
            return free, determinant, wrong
        whole = self.penalised(band, smoothing)
        right = right - times(whole, self.floor)

        def slope(above: np.ndarray) -> np.ndarray:
            return self.sign * self.over_steps(times(whole, above) - right)

        for guess in (near, wrong):
            if guess is not None and guess.size == wrong.size:
                above, tied = pivoted(
                    lambda zero: self._tied(whole, right, zero), grown, slope, guess
                )
                if above is not None:
                    return self.floor + above, determinant, tied
        return self.floor + self.by_nnls(whole, right), determinant, wrong

    def _tied(self, band: np.ndarray, right: np.ndarray, zero: np.ndarray) -> np.ndarray:
        """Coefficients of least ½·cᵀ·matrix·c − rightᵀ·c of which those at ``zero`` do not grow
        along u."""
        # pyrefly: ignore[missing-module-attribute]
        from scipy.linalg.lapack import dpbsv

        index = np.where(zero, -1, np.arange(self.size)).reshape(self.columns, self.rows)
        last = np.maximum.accumulate(index, axis=1).ravel()
        unknown = np.append(np.cumsum(~zero) - 1, -1)[last]  # of each coefficient, −1 for zero
        pairs = _pairs(self.rows, self.columns)
        low, high = unknown[pairs.first], unknown[pairs.second]
        some = np.flatnonzero((low >= 0) & (high >= 0))
        low, high = low[some], high[some]
        apart = np.abs(low - high)
        # of two coefficients that are one unknown, both orders count
        both = (apart == 0) & (pairs.line[some] > 0)
        values = band.T.ravel()[pairs.place[some]] * (1.0 + both)
        count, height = int(unknown.max()) + 1, int(apart.max(initial=0)) + 1
        place = np.minimum(low, high) * height + apart
        small = np.bincount(place, values, count * height).reshape(count, height).T
        pull = np.bincount(unknown + 1, right, count + 1)[1:]
        _, solved, info = dpbsv(small, pull, lower=1, overwrite_ab=1)
        if info:
            raise np.linalg.LinAlgError(message("flow_maps.not_definite"))
        return np.append(solved, 0.0)[unknown]

    def by_nnls(self, band: np.ndarray, right: np.ndarray) -> np.ndarray:
        """What `solve` looks for, above the floor, by an active set: slow, but it always ends."""
        from scipy.optimize import nnls

        steps = self.over_steps(self.over_steps(full(band)).T)
        factor = np.linalg.cholesky(np.outer(self.sign, self.sign) * steps)
        pull = np.linalg.solve(factor, self.sign * self.over_steps(right))
        grown = self.sign * nnls(factor.T, pull, maxiter=50 * right.size)[0]
        return np.cumsum(grown.reshape(self.columns, self.rows), axis=1).ravel()

    def table(self, coefficients: np.ndarray) -> np.ndarray:
        """Coefficients as a table, shape (rows, columns)."""
        return coefficients.reshape(self.columns, self.rows).T

    def over_steps(self, values: np.ndarray) -> np.ndarray:
        """Derivatives by the coefficients, along the first axis, as those by their increments along
        u."""
        table = values.reshape(self.columns, self.rows, -1)
        return np.cumsum(table[:, ::-1], axis=1)[:, ::-1].reshape(values.shape)

    def increments(self, coefficients: np.ndarray) -> np.ndarray:
        """What the coefficients grow by along u, shape (rows, columns)."""
        return np.diff(self.table(coefficients), axis=0, prepend=0.0)


class _Pairs(NamedTuple):
    """Which coefficients meet: pairs of ``rows`` and pairs of ``columns``, and of each number of a
    band that is not zero its ``line``, its column ``first`` and its row ``second``; ``source`` and
    ``place``: its places in a flat table of row pairs by column pairs and in a flat band."""

    rows: tuple[np.ndarray, np.ndarray]
    columns: tuple[np.ndarray, np.ndarray]
    line: np.ndarray
    first: np.ndarray
    second: np.ndarray
    source: np.ndarray
    place: np.ndarray
    shape: tuple[int, int]

    def band(self, of_rows: np.ndarray, of_columns: np.ndarray) -> np.ndarray:
        """The band of Σ Uᵢ ⊗ Sᵢ, of whose matrices the pairs are given, shapes (items, pairs)."""
        band = np.zeros(self.shape[0] * self.shape[1])
        band[self.place] = (of_rows.T @ of_columns).ravel()[self.source]
        return band.reshape(self.shape).T


@cache
def _pairs(rows: int, columns: int) -> _Pairs:
    apart = [np.abs(np.subtract.outer(np.arange(n), np.arange(n))) for n in (rows, columns)]
    (i, j), (k, m) = np.nonzero(apart[0] <= 2), np.nonzero(apart[1] <= 3)
    first = np.add.outer(i, k * rows).ravel()
    second = np.add.outer(j, m * rows).ravel()
    source = np.flatnonzero(second >= first)
    first, second = first[source], second[source]
    shape = rows * columns, 3 * rows + 3
    line = second - first
    return _Pairs((i, j), (k, m), line, first, second, source, first * shape[1] + line, shape)


def full(band: np.ndarray) -> np.ndarray:
    """The symmetric matrix of which the band is given."""
    size = band.shape[1]
    matrix = np.zeros((size, size))
    for k, line in enumerate(band[:size]):
        np.fill_diagonal(matrix[k:, : size - k], line[: size - k])
    return matrix + np.tril(matrix, -1).T


def times(band: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Product of a symmetric matrix, of which the band is given, with a vector."""
    # pyrefly: ignore[missing-module-attribute]
    from scipy.linalg.blas import dsbmv

    return dsbmv(len(band) - 1, 1.0, band, values, lower=1)


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
        zero: a first guess of the steps that are zero."""
    tolerance = 1e-12 * np.abs(slope(np.zeros(zero.size))).max()
    for _ in range(50):
        point = solve(zero)
        wrong = np.where(zero, slope(point) < -tolerance, steps(point) < 0.0)
        if not wrong.any():
            return point, zero
        zero = zero ^ wrong
    return None, zero
