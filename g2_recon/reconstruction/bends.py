# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Whether the points of a cluster lie on a bend, such as a column or a vault, rather than on a plane."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from g2_recon.kernels import inner_kernel, kernel

Float = NDArray[np.float64]

# A bend is one where it turns points out of the plane by more than this share of the noise, or of the spacing ...
_LEAST_NOISE = 0.4
_LEAST_SPACING = 0.005
# ... and where it is no accident: the sum of squares that it explains, in units of what is left per point. Chance
# alone gives three; noise that is correlated along a scan, ten times as much.
_LEAST_EVIDENCE = 40.0
# Points this many standard deviations off are not counted, in so many rounds.
_TRIM = 2.5
_ROUNDS = 3
# A fit of six coefficients to fewer points says nothing.
_FEWEST = 12


@kernel
def fit_bend(x, y, z, weights, spacing, noise):  # type: ignore[no-untyped-def]
    """The bend that points x, y, z (N,) with weights (N,) lie on: coefficients (6,) and deviation in metres.

    It is the surface z = c0 + c1 x + c2 y + c3 x^2 + c4 x y + c5 y^2 in the frame of a cluster, whose z axis is the
    normal of its plane; the deviation is the standard deviation of the points across it, infinite where a plane
    describes them as well. spacing: m, of neurons. noise: m, of points.
    """
    size = 0.0
    for i in range(len(x)):
        size = max(size, abs(x[i]), abs(y[i]))
    if len(x) < _FEWEST or size == 0.0:
        return np.zeros(6), np.inf
    coefficients, variance, explained, count = _fit(x, y, z, weights, 1.0 / size, _TRIM * noise)
    bent = explained > max(_LEAST_NOISE * noise, _LEAST_SPACING * spacing) ** 2
    if not (bent and count * explained > _LEAST_EVIDENCE * variance):
        return np.zeros(6), np.inf
    for i in range(1, 6):
        coefficients[i] /= size if i < 3 else size * size
    return coefficients, np.sqrt(variance)


def onto_bend(coefficients: Float, points: Float) -> Float:
    """Points (N, 3) moved along z onto bends, one for all (6,) or one each (N, 6)."""
    x, y = points[:, 0], points[:, 1]
    monomials = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    return np.column_stack([x, y, (monomials * coefficients).sum(axis=1)])


def bend_normals(coefficients: Float, points: Float) -> Float:
    """Unit normals (N, 3), z upwards, of bends, one for all (6,) or one each (N, 6), above or below points (N, 3)."""
    x, y = points[:, 0], points[:, 1]
    _, b, c, d, e, f = coefficients.T
    normal = np.column_stack([-(b + 2 * d * x + e * y), -(c + e * x + 2 * f * y), np.ones(len(points))])
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


@inner_kernel
def _fit(x, y, z, weights, scale, slack):  # type: ignore[no-untyped-def]
    """The weighted least-squares fit, repeated without the points farther off than `slack` and 2.5 deviations.

    Coefficients (6,) in scaled coordinates, variance across the bend, variance that it explains beyond a plane, and the
    number of points that count.
    """
    coefficients = np.zeros(6)
    limit = np.inf
    variance = explained = 0.0
    count = 0
    row = np.empty(6)
    for _ in range(_ROUNDS):
        matrix, right, square, total = np.zeros((6, 6)), np.zeros(6), 0.0, 0.0
        count = 0
        for i in range(len(x)):
            u, v, off = x[i] * scale, y[i] * scale, z[i]
            row[0], row[1], row[2], row[3], row[4], row[5] = 1.0, u, v, u * u, u * v, v * v
            for a in range(6):
                off -= row[a] * coefficients[a]
            if abs(off) > limit:
                continue
            count += 1
            w = weights[i]
            total += w
            square += w * z[i] * z[i]
            for a in range(6):
                right[a] += w * row[a] * z[i]
                for b in range(a + 1):
                    matrix[a, b] += w * row[a] * row[b]
        if count < _FEWEST:
            return coefficients, 0.0, 0.0, 0
        for a in range(6):
            matrix[a, a] += 1e-9 * total
        _solve(matrix, right, coefficients)
        # The first three coefficients are those of a plane.
        by_plane = right[0] * right[0] + right[1] * right[1] + right[2] * right[2]
        by_bend = right[3] * right[3] + right[4] * right[4] + right[5] * right[5]
        variance = max(square - by_plane - by_bend, 0.0) / total
        explained = by_bend / total
        limit = max(slack, _TRIM * np.sqrt(variance))
    return coefficients, variance, explained, count


@inner_kernel
def _solve(matrix, right, solution):  # type: ignore[no-untyped-def]
    """Solve equations with a symmetric, positive definite matrix (Golub & Van Loan, Matrix Computations, section 4.2).

    Only its lower triangle is looked at, and becomes that of its Cholesky factor. Of the normal equations of a fit,
    right becomes what each unknown adds to those before it: its square is what the sum of squared residuals loses.
    """
    size = len(right)
    for a in range(size):
        for b in range(a):
            for c in range(b):
                matrix[a, b] -= matrix[a, c] * matrix[b, c]
            matrix[a, b] /= matrix[b, b]
            matrix[a, a] -= matrix[a, b] * matrix[a, b]
            right[a] -= matrix[a, b] * right[b]
        matrix[a, a] = math.sqrt(matrix[a, a])
        right[a] /= matrix[a, a]
    for a in range(size - 1, -1, -1):
        solution[a] = right[a]
        for b in range(a + 1, size):
            solution[a] -= matrix[b, a] * solution[b]
        solution[a] /= matrix[a, a]
