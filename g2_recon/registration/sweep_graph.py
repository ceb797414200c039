# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A pose graph of sweeps in 6 degrees of freedom: the poses that all matches together make most likely.

F. Lu, E. Milios: "Globally consistent range scan alignment for environment mapping", Autonomous Robots 4, 1997, solved
by Gauss-Newton on sparse normal equations. A step of a pose is three metres along the axes of the map, then three
radians about them through the pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as sparse_linalg
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from g2_recon.geometry import se3

Float = NDArray[np.float64]

_ITERATIONS = 20
_DONE = 1e-7
_HELD = 1e12
# Free directions stay where they are.
_DAMPING = 1e-6
# Deviations, in standard deviations of all six directions together, beyond which an edge pulls no harder (Huber).
_HUBER = 5.0


@dataclass(frozen=True, slots=True)
class Edge:
    """T_first_second (4, 4) as measured, with the information (6, 6) of a step of it, see sweep_matching.Match."""

    first: int
    second: int
    T: Float
    information: Float


def optimize(poses: Float, edges: Sequence[Edge], *, held: int = 0) -> Float:
    """Poses T_map_sweep (N, 4, 4) that fit the edges best, from where they are; pose `held` stays."""
    poses = np.array(poses)
    for _ in range(_ITERATIONS):
        matrix, right = _normal_equations(poses, edges, held)
        step = np.asarray(sparse_linalg.spsolve(matrix, right), float).reshape(-1, 6)
        poses[:, :3, 3] += step[:, :3]
        turns = np.asarray(Rotation.from_rotvec(step[:, 3:]).as_matrix())
        poses[:, :3, :3] = np.matmul(turns, poses[:, :3, :3])
        if bool((step**2 < _DONE**2).all()):
            break
    return poses


def covariances(poses: Float, edges: Sequence[Edge], which: Sequence[int], *, held: int = 0) -> Float:
    """Covariances (W, 6, 6) of poses `which` of (N, 4, 4) relative to the one that is held, in the order of ROS."""
    if not len(which):
        return np.empty((0, 6, 6))
    matrix, _ = _normal_equations(poses, edges, held)
    factors = sparse_linalg.splu(matrix)
    result = np.empty((len(which), 6, 6))
    for row, index in enumerate(which):
        # Only six columns of the inverse are wanted at a time; all of it would not be sparse.
        own = slice(6 * index, 6 * index + 6)
        columns = np.zeros((matrix.shape[0], 6))
        columns[own] = np.eye(6)
        result[row] = factors.solve(columns)[own]
    return result


def deviation(poses: Float, edge: Edge) -> float:
    """How far the poses (N, 4, 4) are from an edge, in standard deviations of all six directions together."""
    error, _ = _linearized(poses[edge.first], poses[edge.second], edge.T)
    return math.sqrt(max(float(error @ edge.information @ error), 0.0))


def _normal_equations(poses: Float, edges: Sequence[Edge], held: int) -> tuple[sparse.csc_matrix, Float]:
    size = 6 * len(poses)
    diagonal = np.full(size, _DAMPING)
    diagonal[6 * held : 6 * held + 6] = _HELD
    rows, columns, values = [np.arange(size)], [np.arange(size)], [diagonal]
    right = np.zeros(size)
    for edge in edges:
        error, J = _linearized(poses[edge.first], poses[edge.second], edge.T)
        weighted = edge.information * min(1.0, _HUBER / max(deviation(poses, edge), 1e-9))
        at = np.concatenate([6 * edge.first + np.arange(6), 6 * edge.second + np.arange(6)])
        right[at] -= J.T @ weighted @ error
        rows.append(np.repeat(at, 12))
        columns.append(np.tile(at, 12))
        values.append((J.T @ weighted @ J).ravel())
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.coo_matrix(entries, shape=(size, size)).tocsc(), right


def _linearized(T_map_first: Float, T_map_second: Float, T_first_second: Float) -> tuple[Float, Float]:
    """How far (6,) two poses are from what was measured, and how that changes (6, 12) with steps of both."""
    to_first = T_map_first[:3, :3].T
    apart = T_map_second[:3, 3] - T_map_first[:3, 3]
    turned = to_first @ T_map_second[:3, :3] @ T_first_second[:3, :3].T
    error = np.concatenate([to_first @ apart - T_first_second[:3, 3], Rotation.from_matrix(turned).as_rotvec()])
    J = np.zeros((6, 12))
    J[:3, :3], J[:3, 6:9] = -to_first, to_first
    J[:3, 3:6] = to_first @ _cross(apart)
    J[3:, 3:6], J[3:, 9:] = -to_first, to_first
    return error, J


def _cross(vector: Float) -> Float:
    """The matrix (3, 3) that multiplies as a cross product does."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def odometry_edge(first: int, second: int, T_first_second: Float, *, per_metre: float, angle: float) -> Edge:
    """What odometry says of a drive: standard deviations in m a metre (one metre at least), and of angles in rad."""
    metres = per_metre * max(float(np.linalg.norm(T_first_second[:3, 3])), 1.0)
    return Edge(first, second, T_first_second, np.diag(np.repeat([metres**-2.0, angle**-2.0], 3)))


def relative(T_map_first: Float, T_map_second: Float) -> Float:
    """T_first_second (4, 4)."""
    return np.asarray(se3.inverse(T_map_first) @ T_map_second)
