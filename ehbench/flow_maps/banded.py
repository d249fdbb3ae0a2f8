"""Symmetric band matrices of flow maps, compiled: a fit makes and solves some thousand of them.

A band is that of a matrix whose rows and columns are the coefficients, along the root of the drop
first: ``band[j, k]`` stands in column j, k below the diagonal, shape (coefficients, lines). Beyond
the matrix it is zero."""

from __future__ import annotations

import math

import numpy as np

from ehbench.runtime.compiled import allocating_kernel, kernel


@kernel
def near(x, breaks, pieces, first, values):
    """Writes which splines meet each point, and their values.

    Args:
        x: points, shape (points,).
        breaks: of the splines, ascending.
        pieces: their polynomials (``bspline_pieces``).
        first: number of the first spline that is not zero at a point; −1 is the spline left out.
        values: of it and those after it, that left out as zero, shape (points, degree + 1).
    """
    for i in range(x.shape[0]):
        first[i] = _near_one(x[i], breaks, pieces, values[i])


@kernel
def _near_one(x, breaks, pieces, values):
    """Writes the values of the splines that meet a point; gives back the number of the first."""
    width, j = pieces.shape[2], 0
    while j < breaks.shape[0] - 2 and x >= breaks[j + 1]:
        j += 1
    away = x - breaks[j]
    for k in range(width):
        value = 0.0
        for p in range(width - 1, -1, -1):
            value = value * away + pieces[j, j + k, p]
        values[k] = value
    if j == 0:
        values[0] = 0.0
    return j - 1


@allocating_kernel
def normal(cells, span, along_u, along_s, size):
    """(band of the normal matrix, right side) of weighted flows; those without a weight and those
    up to the deadband have no part in it.

    Args:
        cells: opening [V], weight and flow of each.
        span: deadband and largest opening [V].
        along_u: breaks and pieces of the splines along the opening.
        along_s: (first spline, values) of each flow along the root of the drop, as `near` writes
            them.
        size: rows and columns of coefficients.
    """
    (u, weight, y), (low, high), (breaks, pieces) = cells, span, along_u
    (column, of_s), (rows, columns) = along_s, size
    band, right = np.zeros((rows * columns, 2 * columns + 4)), np.zeros(rows * columns)
    of_u = np.empty(pieces.shape[2])
    for i in range(u.size):
        if weight[i] > 0.0 and u[i] > low:
            x = min((u[i] - low) / (high - low), 1.0)
            at = _near_one(x, breaks, pieces, of_u) * columns + column[i]
            _add_one(of_u, of_s[i], (weight[i], weight[i] * y[i], columns, at), band, right)
    return band, right


@kernel
def _add_one(of_u, of_s, item, band, right):
    """Adds a flow to the band of the normal matrix and to its right side.

    Args:
        of_u: values of the splines that it meets along the opening.
        of_s: the same along the root of the drop.
        one: its weight, its flow times that, coefficients along the root, and the number of the
            first that it meets.
    """
    weight, pull, columns, at = item
    for a in range(of_u.size):
        for b in range(of_s.size):
            low, value = at + a * columns + b, of_u[a] * of_s[b]
            if value != 0.0:  # as those are that were left out, before the first coefficient
                right[low] += pull * value
                share = weight * value
                for c in range(a, of_u.size):
                    for d in range(b if c == a else 0, of_s.size):
                        far = of_u[c] * of_s[d]
                        if far != 0.0:
                            band[low, (c - a) * columns + d - b] += share * far


@kernel
def factorise(band):
    """Writes the Cholesky factor's band over that of a matrix.

    Four columns are taken off the later ones at once, each later number read and written once for
    all four, in the order in which they would go one by one.

    Returns:
        0, or the number of the first column, from 1 on, at which it is not positive definite.
    """
    size, lines = band.shape
    j = 0
    while j < size:
        together = 4 if lines > 4 and j + lines + 3 < size else 1
        for m in range(together):
            own = band[j + m, : min(lines, size - j - m)]
            if not own[0] > 0.0:
                return j + m + 1
            own[0] = math.sqrt(own[0])
            per = 1.0 / own[0]
            for k in range(1, own.size):
                own[k] *= per
            for k in range(1, own.size if together == 1 else 4 - m):
                _take_one(own, k, band[j + m + k])
        if together == 4:
            for k in range(4, lines):
                _take_four(band[j : j + 4], k, band[j + k])
            for k in range(lines, lines + 3):
                for m in range(k - lines + 1, 4):
                    _take_one(band[j + m], k - m, band[j + k])
        j += together
    return 0


@kernel
def _take_one(own, k, after):
    """Takes a column of a factor off the matrix's column ``after``, k columns on."""
    share, rest = own[k], own[k:]
    for i in range(rest.size):
        after[i] -= share * rest[i]


@kernel
def _take_four(four, k, after):
    """Takes four columns of a factor, one after another, off the matrix's column k columns on from
    the first of them.
    """
    last = four.shape[1] - 1
    p, q, r, s = four[0], four[1], four[2], four[3]
    a, b, c, d = p[k:], q[k - 1 : last], r[k - 2 : last - 1], s[k - 3 : last - 2]
    n, e, f, g, h = a.size, a[0], b[0], c[0], d[0]
    for i in range(n):
        after[i] = after[i] - e * a[i] - f * b[i] - g * c[i] - h * d[i]
    after[n] = after[n] - f * q[last] - g * r[last - 1] - h * s[last - 2]
    after[n + 1] = after[n + 1] - g * r[last] - h * s[last - 1]
    after[n + 2] = after[n + 2] - h * s[last]


@kernel
def forward(factor, values):
    """Divides values by a Cholesky factor, in place."""
    size, lines = factor.shape
    for j in range(size):
        own, after = factor[j, : min(lines, size - j)], values[j:]
        after[0] /= own[0]
        share = after[0]
        for k in range(1, own.size):
            after[k] -= share * own[k]


@allocating_kernel
def half_squares(factor, rows):
    """Of each row its squares once it is divided by a Cholesky factor, summed; shape (rows,)."""
    result = np.zeros(rows.shape[0])
    for i in range(rows.shape[0]):
        begin = 0  # up to its first number a row stays zero
        while begin < rows.shape[1] - 1 and rows[i, begin] == 0.0:
            begin += 1
        values = rows[i, begin:].copy()
        forward(factor[begin:], values)
        for value in values:
            result[i] += value * value
    return result


@kernel
def backward(factor, values):
    """Divides values by the transpose of a Cholesky factor, in place."""
    size, lines = factor.shape
    for j in range(size - 1, -1, -1):
        own, after = factor[j, : min(lines, size - j)], values[j:]
        rest = after[0]
        for k in range(1, own.size):
            rest -= own[k] * after[k]
        after[0] = rest / own[0]


@kernel
def penalise(band, penalties, smoothing, out):
    """Writes the band of the penalised normal matrix: times their smoothing on top, the Kronecker
    products of what penalises along the opening and of what does along the root of the drop.

    Only neighbours meet: three after one another along u, four along s.

    Args:
        penalties: ∫ of squared curvature and of squares along u, and the same along s.
    """
    bent_u, mass_u, bent_s, mass_s = penalties
    rows, columns = bent_u.shape[0], bent_s.shape[0]
    by_u, by_s = smoothing[0], smoothing[1]
    for j in range(band.shape[0]):
        for k in range(band.shape[1]):
            out[j, k] = band[j, k]
    for row in range(rows):
        for after in range(row, min(row + 3, rows)):
            of_bent, of_mass = bent_u[row, after], mass_u[row, after]
            for column in range(columns):
                low, apart = row * columns + column, (after - row) * columns - column
                begin = column if after == row else max(column - 3, 0)
                for other in range(begin, min(column + 4, columns)):
                    along, across = mass_s[column, other], bent_s[column, other]
                    bent = by_u * (of_bent * along) + by_s * (of_mass * across)
                    out[low, apart + other] += bent


@allocating_kernel
def least(band, penalties, smoothing, right, whole):
    """The least of ½·cᵀ·matrix·c − rightᵀ·c of a penalised normal matrix.

    Args:
        penalties: as in `penalise`.
        whole: whether the point is asked for.

    Returns:
        (point if asked for, rightᵀ times it, log determinant of the matrix or nan where it is not
        positive definite).
    """
    factor, values = np.empty_like(band), right.copy()
    penalise(band, penalties, smoothing, factor)
    if factorise(factor):
        return values, math.nan, math.nan
    forward(factor, values)
    gain, logarithm = 0.0, 0.0
    for j in range(values.size):
        gain += values[j] * values[j]
        logarithm += math.log(factor[j, 0])
    if whole:
        backward(factor, values)
    return values, gain, 2.0 * logarithm


@allocating_kernel
def tied(band, right, own):
    """The least of ½·cᵀ·matrix·c − rightᵀ·c where several coefficients are one unknown.

    Args:
        own: which unknown each coefficient is, −1 for zero; ascending but for these.

    Returns:
        (coefficients, whether the matrix is positive definite).
    """
    size, lines = band.shape
    some, used = np.zeros(lines, np.int64), 0  # lines of the band that are not all zero
    for k in range(lines):
        for j in range(size - k):
            if band[j, k] != 0.0:
                some[used] = k
                used += 1
                break
    count, apart = 0, 0
    for j in range(size):
        count = max(count, own[j] + 1)
        if own[j] >= 0:
            for k in some[:used]:
                if j + k < size and own[j + k] >= 0 and band[j, k] != 0.0:
                    apart = max(apart, abs(own[j] - own[j + k]))
    matrix, pull = np.zeros((count, apart + 1)), np.zeros(count + 1)
    for j in range(size):
        item = own[j]
        if item >= 0:
            pull[item] += right[j]
            for k in some[:used]:
                other = own[j + k] if j + k < size else -1
                if other >= 0 and band[j, k] != 0.0:
                    # of two coefficients that are one unknown, both orders count
                    times = 2.0 if k and item == other else 1.0
                    matrix[min(item, other), abs(item - other)] += times * band[j, k]
    fails = factorise(matrix)
    if not fails:
        forward(matrix, pull[:count])
        backward(matrix, pull[:count])
    result = np.empty(size)
    for j in range(size):
        result[j] = pull[own[j]] if own[j] >= 0 else 0.0
    return result, not fails


@allocating_kernel
def times(band, values):
    """Product of a symmetric matrix, of which the band is given, with a vector."""
    size, lines = band.shape
    result = np.zeros(size)
    for j in range(size):
        own = band[j, 0] * values[j]
        for k in range(1, min(lines, size - j)):
            own += band[j, k] * values[j + k]
            result[j + k] += band[j, k] * values[j]
        result[j] += own
    return result


@allocating_kernel
def explained(factor, band):
    """Trace of a matrix's inverse times another matrix: of the one the band of its Cholesky factor
    is given, of the other the band.

    Within the band the inverse follows from the factor, from its last column on (Takahashi, Fagan,
    Chen 1973); the whole inverse would take as many columns as it has to be solved for.
    """
    size, lines = factor.shape
    inverse, own, result = np.zeros((size, size)), np.empty(lines), 0.0
    for j in range(size - 1, -1, -1):
        additional, per = min(lines, size - j), 1.0 / factor[j, 0]
        own[:] = 0.0
        for i in range(1, additional):
            _take_row(factor[j, i], inverse[j + i, j + 1 : j + additional], own[1:additional])
        for k in range(1, additional):
            own[k] *= per
            inverse[j, j + k] = inverse[j + k, j] = own[k]
            result += 2.0 * own[k] * band[j, k]
        inverse[j, j] = per
        for k in range(1, additional):
            inverse[j, j] -= factor[j, k] * own[k]
        inverse[j, j] *= per
        result += inverse[j, j] * band[j, 0]
    return result


@kernel
def _take_row(share, row, after):
    """Takes a share of a row off another."""
    for i in range(row.size):
        after[i] -= share * row[i]


@allocating_kernel
def gram(pieces, order, powers, share):
    """∫ weight·B_i^(order) B_j^(order) of splines in polynomial pieces (``bspline_pieces``), exact
    but for the last bits: the least eigenvalues of a soft penalty hang on these, so the order of
    the sums is part of it.

    Args:
        powers: of the places in a span where Gauss's rule asks, shape (spans, nodes, powers).
        share: of a node's value in the integral: (by node, by span).
    """
    (spans, splines, size), (by_node, by_span) = pieces.shape, share
    result, values = np.zeros((splines, splines)), np.empty(size)
    for j in range(spans):
        for g in range(powers.shape[1]):
            for k in range(size):  # of a spline's degree, and one more, meet in a span
                even, odd = 0.0, 0.0
                for p in range(order, size):
                    factor = 1.0
                    for d in range(order):
                        factor *= p - d
                    term = factor * pieces[j, j + k, p] * powers[j, g, p - order]
                    if (p - order) % 2:
                        odd += term
                    else:
                        even += term
                values[k] = even + odd
            for k in range(size):
                for i in range(size):
                    result[j + k, j + i] += values[k] * values[i] * by_node[g] * by_span[j]
    return result
