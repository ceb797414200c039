# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Planar transforms (3,) x, y (m), yaw (rad) for use inside Numba kernels; `se2` holds the same for arrays."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from g2_recon.kernels import inner_kernel, kernel

Float = NDArray[np.float64]


@kernel
def wrap(angle: float) -> float:
    """The angle in rad brought into [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


@kernel
def compose(T_a_b: Float, T_b_c: Float) -> Float:
    """T_a_c."""
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    result = np.empty(3)
    result[0] = T_a_b[0] + cos * T_b_c[0] - sin * T_b_c[1]
    result[1] = T_a_b[1] + sin * T_b_c[0] + cos * T_b_c[1]
    result[2] = wrap(T_a_b[2] + T_b_c[2])
    return result


@kernel
def relative(T_a_b: Float, T_a_c: Float) -> Float:
    """T_b_c."""
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    x, y = T_a_c[0] - T_a_b[0], T_a_c[1] - T_a_b[1]
    result = np.empty(3)
    result[0] = cos * x + sin * y
    result[1] = -sin * x + cos * y
    result[2] = wrap(T_a_c[2] - T_a_b[2])
    return result


@kernel
def inverse(T_a_b: Float) -> Float:
    """T_b_a."""
    return relative(T_a_b, np.zeros(3))


@kernel
def is_within(change: Float, most: Float) -> bool:
    """Whether no component of a change (3,) is larger than allowed (3,)."""
    return bool(abs(change[0]) <= most[0] and abs(change[1]) <= most[1] and abs(change[2]) <= most[2])


@inner_kernel
def carried(covariance: Float, x: float, y: float) -> Float:
    """Covariance (3, 3) of a pose that is rigidly connected, x, y away, to one with the given covariance (3, 3)."""
    lever = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
    return lever @ covariance @ lever.T


@inner_kernel
def solve_3x3(A: Float, b: Float) -> Float:
    """X (3,) with A x = b, for a symmetric positive definite A (3, 3), by its Cholesky factors."""
    a = math.sqrt(A[0, 0])
    d, g = A[1, 0] / a, A[2, 0] / a
    e = math.sqrt(A[1, 1] - d * d)
    h = (A[2, 1] - g * d) / e
    k = math.sqrt(A[2, 2] - g * g - h * h)
    u = b[0] / a
    v = (b[1] - d * u) / e
    w = (b[2] - g * u - h * v) / k
    x = np.empty(3)
    x[2] = w / k
    x[1] = (v - h * x[2]) / e
    x[0] = (u - d * x[1] - g * x[2]) / a
    return x


@kernel
def inverse_3x3(A: Float) -> Float:
    """The inverse (3, 3) of a symmetric positive definite A (3, 3).

    Its rows are written number by number: an array written into a slice comes with errors in words, which take seconds
    to compile.
    """
    inverted = np.empty((3, 3))
    unit = np.zeros(3)
    for k in range(3):
        unit[:] = 0.0
        unit[k] = 1.0
        row = solve_3x3(A, unit)
        for u in range(3):
            inverted[k, u] = row[u]
    return 0.5 * (inverted + inverted.T)


@kernel
def weakest(A: Float) -> tuple[float, Float]:
    """The lesser eigenvalue of a symmetric A (2, 2), or of the upper left of a larger one, and its direction (2,)."""
    mean, half, b = 0.5 * (A[0, 0] + A[1, 1]), 0.5 * (A[0, 0] - A[1, 1]), A[0, 1]
    direction = np.empty(2)
    angle = 0.5 * math.atan2(b, half)
    direction[0], direction[1] = -math.sin(angle), math.cos(angle)
    return mean - math.hypot(half, b), direction
