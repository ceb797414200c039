# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Whether the points of a cluster lie on a bend, such as a column or a vault, rather than on a plane."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

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


@dataclass(frozen=True, slots=True)
class Bend:
    """The surface z = c0 + c1 x + c2 y + c3 x^2 + c4 x y + c5 y^2, in the frame of a cluster, metres.

    coefficients: (6,). deviation: m, standard deviation of the points across it.
    """

    coefficients: Float
    deviation: float

    def onto(self, points: Float) -> Float:
        """The points (N, 3) moved along z onto the surface."""
        x, y = points[:, 0], points[:, 1]
        return np.column_stack([x, y, _monomials(x, y) @ self.coefficients])

    def normals(self, points: Float) -> Float:
        """Unit normals (N, 3), z upwards, of the surface above or below the points (N, 3)."""
        x, y = points[:, 0], points[:, 1]
        _, b, c, d, e, f = self.coefficients
        normal = np.column_stack([-(b + 2 * d * x + e * y), -(c + e * x + 2 * f * y), np.ones(len(points))])
        return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def fit_bend(points: Float, weights: Float, *, spacing: float, noise: float) -> Bend | None:
    """The bend that points (N, 3) with weights (N,) lie on, or None where a plane describes them as well.

    The points are in a frame whose z axis is the normal of their plane. spacing: m, of neurons. noise: m, of points.
    """
    size = float(np.abs(points[:, :2]).max(initial=0.0))
    if len(points) < 12 or size == 0.0:
        return None
    coefficients, variance, explained, count = _fit(points, weights, 1.0 / size, _TRIM * noise)
    if not np.isfinite(coefficients).all():
        return None
    bent = explained > max(_LEAST_NOISE * noise, _LEAST_SPACING * spacing) ** 2
    if not (bent and count * explained > _LEAST_EVIDENCE * variance):
        return None
    powers = np.array([0, 1, 1, 2, 2, 2])
    return Bend(coefficients / size**powers, float(np.sqrt(variance)))


def _monomials(x: Float, y: Float) -> Float:
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])


@numba.njit(cache=True, nogil=True)
def _fit(points, weights, scale, slack):  # type: ignore[no-untyped-def]
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
        for i in range(len(points)):
            x, y, z = points[i, 0] * scale, points[i, 1] * scale, points[i, 2]
            row[0], row[1], row[2], row[3], row[4], row[5] = 1.0, x, y, x * x, x * y, y * y
            off = z
            for a in range(6):
                off -= row[a] * coefficients[a]
            if abs(off) > limit:
                continue
            count += 1
            w = weights[i]
            total += w
            square += w * z * z
            for a in range(6):
                right[a] += w * row[a] * z
                for b in range(a + 1):
                    matrix[a, b] += w * row[a] * row[b]
        if count < 12:
            return np.full(6, np.nan), 0.0, 0.0, 0
        for a in range(6):
            for b in range(a):
                matrix[b, a] = matrix[a, b]
            matrix[a, a] += 1e-9 * total
        coefficients[:] = np.linalg.solve(matrix, right)
        plane = np.linalg.solve(np.ascontiguousarray(matrix[:3, :3]), right[:3])
        variance = max(square - np.dot(right, coefficients), 0.0) / total
        explained = max(np.dot(right, coefficients) - np.dot(right[:3], plane), 0.0) / total
        limit = max(slack, _TRIM * np.sqrt(variance))
    return coefficients, variance, explained, count
