# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A pose graph whose edges are quadratic: what two scans say about each other, and what the wheels say.

An edge holds the transform T_j_i at which it was measured, and the cost of leaving it: with d the step from there,
d^T H d / 2 + g^T d. A direction that the scans do not determine, such as along a bare corridor, has no cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as sparse_linalg
from numpy.typing import NDArray

from g2_recon.geometry import se2
from g2_recon.geometry.se2_kernels import relative, wrap
from g2_recon.kernels import kernel

Float = NDArray[np.float64]
Int = NDArray[np.int64]

_HELD = 1e8


@dataclass(frozen=True, slots=True)
class Edges:
    """M edges between poses: T_j_i (M, 3) of i = first (M,), j = second (M,), with hessians and gradients there."""

    first: Int
    second: Int
    T: Float
    hessians: Float
    gradients: Float

    def __len__(self) -> int:
        return len(self.first)

    def __getitem__(self, rows: NDArray[np.generic] | slice) -> Edges:
        return Edges(self.first[rows], self.second[rows], self.T[rows], self.hessians[rows], self.gradients[rows])


def measured(first: Int, second: Int, T: Float, information: Float) -> Edges:
    """Edges that pull towards T_j_i (M, 3) with an information (M, 3, 3)."""
    return Edges(first, second, T, information, np.zeros((len(T), 3)))


def joined(*parts: Edges) -> Edges:
    """All edges of the parts."""
    return Edges(
        np.concatenate([p.first for p in parts]),
        np.concatenate([p.second for p in parts]),
        np.concatenate([p.T for p in parts]),
        np.concatenate([p.hessians for p in parts]),
        np.concatenate([p.gradients for p in parts]),
    )


def at_poses(poses: Float, edges: Edges) -> Edges:
    """The same edges as if they had been measured at the poses (N, 3)."""
    T, gradients = _moved(poses, edges.first, edges.second, edges.T, edges.hessians, edges.gradients)
    return Edges(edges.first, edges.second, T, edges.hessians, gradients)


@kernel
def _moved(poses, first, second, T, hessians, gradients):  # type: ignore[no-untyped-def]
    """T_j_i (M, 3) at poses (N, 3), and what the gradients (M, 3) at T are there."""
    now, there = np.empty_like(T), gradients.copy()
    for m in range(len(first)):
        T_j_i = relative(poses[second[m]], poses[first[m]])
        d = T_j_i - T[m]
        d[2] = wrap(d[2])
        for u in range(3):
            # Number by number; see se2_kernels.inverse_3x3.
            now[m, u] = T_j_i[u]
            for v in range(3):
                there[m, u] += hessians[m, u, v] * d[v]
    return now, there


@kernel
def _differentiate(T_j_i, yaw, J):  # type: ignore[no-untyped-def]
    """Derivative J (3, 6) of T_j_i by the poses of i and of j, whose yaw is given."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    J[0, 0], J[0, 1], J[1, 0], J[1, 1] = cos, sin, -sin, cos
    J[0, 3], J[0, 4], J[1, 3], J[1, 4] = -cos, -sin, sin, -cos
    J[0, 5], J[1, 5] = T_j_i[1], -T_j_i[0]
    J[2, 2], J[2, 5] = 1.0, -1.0


@kernel
def linearize(poses, first, second, T, hessians, gradients, weights):  # type: ignore[no-untyped-def]
    """Blocks (M, 6, 6) and (M, 6) of the normal equations for i then j, and squared deviations (M,) d^T H d."""
    count = len(first)
    blocks = np.empty((count, 6, 6))
    pulls = np.empty((count, 6))
    squared = np.empty(count)
    J = np.zeros((3, 6))
    HJ = np.empty((3, 6))
    slope = np.empty(3)
    for m in range(count):
        i, j = first[m], second[m]
        now = relative(poses[j], poses[i])
        d = now - T[m]
        d[2] = wrap(d[2])
        _differentiate(now, poses[j, 2], J)
        H = hessians[m]
        squared[m] = 0.0
        for u in range(3):
            slope[u] = H[u, 0] * d[0] + H[u, 1] * d[1] + H[u, 2] * d[2]
            squared[m] += d[u] * slope[u]
            slope[u] += gradients[m, u]
            for v in range(6):
                HJ[u, v] = weights[m] * (H[u, 0] * J[0, v] + H[u, 1] * J[1, v] + H[u, 2] * J[2, v])
        for u in range(6):
            pulls[m, u] = weights[m] * (J[0, u] * slope[0] + J[1, u] * slope[1] + J[2, u] * slope[2])
            for v in range(6):
                blocks[m, u, v] = J[0, u] * HJ[0, v] + J[1, u] * HJ[1, v] + J[2, u] * HJ[2, v]
    return blocks, pulls, squared


def deviations(poses: Float, edges: Edges) -> Float:
    """d^T H d (M,) of the edges at poses (N, 3)."""
    weights = np.ones(len(edges))
    *_, squared = linearize(poses, edges.first, edges.second, edges.T, edges.hessians, edges.gradients, weights)
    return np.asarray(squared)


def solve(poses: Float, edges: Edges, *, held: int = 0, weights: Float | None = None) -> tuple[Float, Float]:
    """One Gauss-Newton step: the poses (N, 3) after it, and d^T H d (M,) of the edges before it; `held` stays."""
    if weights is None:
        weights = np.ones(len(edges))
    factors, right, squared = _factorized(poses, edges, weights, held)
    moved = poses - factors.solve(right).reshape(len(poses), 3)
    moved[:, 2] = se2.wrap_angle(moved[:, 2])
    return moved, squared


def covariance(poses: Float, edges: Edges, weights: Float, wanted: Sequence[int], *, held: int = 0) -> Float:
    """Joint covariance (3 W, 3 W) of the wanted poses in the frame of the poses (N, 3); `held` is exactly known.

    Hessians count as information matrices.
    """
    factors, _, _ = _factorized(poses, edges, weights, held)
    rows = (3 * np.asarray(wanted)[:, None] + np.arange(3)).ravel()
    units = np.zeros((3 * len(poses), len(rows)))
    units[rows, np.arange(len(rows))] = 1.0
    return np.ascontiguousarray(factors.solve(units)[rows])


def covariance_between(joint: Float, j: Float, i: Float) -> Float:
    """Covariance (3, 3) of T_j_i, as edges measure it, of poses i and j (3,) with a joint covariance (6, 6) of i, j."""
    jacobian = np.zeros((3, 6))
    _differentiate(relative(j, i), j[2], jacobian)
    return np.asarray(jacobian @ joint @ jacobian.T)


def _factorized(poses: Float, edges: Edges, weights: Float, held: int) -> tuple[sparse_linalg.SuperLU, Float, Float]:
    """The normal equations of a step at the poses (N, 3): factors, right side (3 N,), and d^T H d (M,) of the edges."""
    count = len(poses)
    blocks, pulls, squared = linearize(
        poses, edges.first, edges.second, edges.T, edges.hessians, edges.gradients, weights
    )
    # As SciPy keeps them: of a large map, indices of twice the size would be most of the memory that this takes.
    ends = np.column_stack([edges.first, edges.second]).astype(np.int32)
    rows = (3 * ends[:, :, None] + np.arange(3, dtype=np.int32)).reshape(-1, 6)
    diagonal = np.full(3 * count, 1e-6)
    diagonal[3 * held : 3 * held + 3] = _HELD
    matrix = sparse.coo_matrix(
        (blocks.ravel(), (np.repeat(rows, 6, axis=1).ravel(), np.tile(rows, (1, 6)).ravel())),
        shape=(3 * count, 3 * count),
    ).tocsc()
    columns = np.repeat(np.arange(3 * count, dtype=np.int32), np.diff(matrix.indptr))
    on_diagonal = matrix.indices == columns
    if np.count_nonzero(on_diagonal) == 3 * count:
        # Several times as fast as the sum of two matrices.
        matrix.data[on_diagonal] += diagonal
    else:
        matrix = matrix + sparse.diags(diagonal, format="csc")
    right = np.bincount(rows.ravel(), pulls.ravel(), 3 * count)
    # What is positive definite needs no pivots; looking for some would undo the order that keeps the factors sparse.
    symmetric = {"SymmetricMode": True}
    factors = sparse_linalg.splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
    return factors, np.asarray(right, float), squared


@kernel
def solve_window(poses, start, first, second, T, hessians, gradients, rounds):  # type: ignore[no-untyped-def]
    """Gauss-Newton on the poses from `start` on, dense, all earlier ones held; edges wholly before it do not count.

    Changes poses (N, 3) in place.
    """
    size = 3 * (len(poses) - start)
    weights = np.ones(len(first))
    for _ in range(rounds):
        blocks, pulls, _ = linearize(poses, first, second, T, hessians, gradients, weights)
        matrix = np.zeros((size, size))
        right = np.zeros(size)
        for k in range(size):
            matrix[k, k] = 1e-6
        for m in range(len(first)):
            at = (3 * (first[m] - start), 3 * (second[m] - start))
            for a in range(2):
                if at[a] < 0:
                    continue
                for u in range(3):
                    right[at[a] + u] += pulls[m, 3 * a + u]
                for b in range(2):
                    if at[b] < 0:
                        continue
                    for u in range(3):
                        for v in range(3):
                            matrix[at[a] + u, at[b] + v] += blocks[m, 3 * a + u, 3 * b + v]
        step = np.linalg.solve(matrix, right)
        for k in range(start, len(poses)):
            for u in range(3):
                poses[k, u] -= step[3 * (k - start) + u]
            poses[k, 2] = wrap(poses[k, 2])
