# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Spatial rigid transforms as arrays (..., 4, 4), and the ways into and out of them.

Quaternions are (..., 4) as x, y, z, w, the order of ROS messages and TUM files.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from g2_recon.errors import InputError

Float = NDArray[np.float64]

FARTHEST_M = 1e8
"""No place on Earth is this many metres from the origin of a map."""


def from_se2(pose: ArrayLike) -> Float:
    """Transforms (..., 4, 4) for planar poses (..., 3)."""
    planar = np.asarray(pose, float)
    cos, sin = np.cos(planar[..., 2]), np.sin(planar[..., 2])
    matrix = np.zeros((*planar.shape[:-1], 4, 4))
    matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 0, 3] = cos, -sin, planar[..., 0]
    matrix[..., 1, 0], matrix[..., 1, 1], matrix[..., 1, 3] = sin, cos, planar[..., 1]
    matrix[..., 2, 2] = matrix[..., 3, 3] = 1.0
    return matrix


def from_xyz_rpy(pose: ArrayLike) -> Float:
    """Transform (4, 4) from x, y, z in metres and roll, pitch, yaw in radians (REP-103: fixed axes X, Y, Z).

    Raises InputError unless there are six finite numbers.
    """
    values = np.asarray(pose, float)
    if values.shape != (6,) or not np.isfinite(values).all():
        raise InputError(
            f"a pose needs six finite numbers x y z roll pitch yaw, got {np.asarray(pose).tolist()}",
            advice="give metres and radians",
        )
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", values[3:]).as_matrix()
    matrix[:3, 3] = values[:3]
    return matrix


def to_xyz_rpy(T_a_b: ArrayLike) -> Float:
    """x, y, z in metres and roll, pitch, yaw in radians (6,) of a transform (4, 4), as from_xyz_rpy takes them.

    Where the x axis points straight up or down, only the sum of roll and yaw is given, and yaw is 0.
    """
    matrix = np.asarray(T_a_b, float)
    rotation = matrix[:3, :3]
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    if np.hypot(rotation[0, 0], rotation[1, 0]) < 1e-9:
        roll, yaw = np.arctan2(-rotation[1, 2], rotation[1, 1]), 0.0
    else:
        roll, yaw = np.arctan2(rotation[2, 1], rotation[2, 2]), np.arctan2(rotation[1, 0], rotation[0, 0])
    return np.array([*matrix[:3, 3], roll, pitch, yaw])


def from_quaternion(position: ArrayLike, quaternion: ArrayLike) -> Float:
    """Transforms (..., 4, 4) from positions (..., 3) and quaternions (..., 4), normalized here.

    Raises InputError where a number is not finite or a quaternion is shorter than 0.5 or longer than 2: that is no
    rotation with rounding errors but an unset or broken one.
    """
    xyz, xyzw = np.asarray(position, float), np.asarray(quaternion, float)
    length = np.linalg.norm(xyzw, axis=-1)
    if not (np.isfinite(xyz).all() and np.isfinite(xyzw).all() and ((length > 0.5) & (length < 2)).all()):
        raise InputError("a pose is not finite or its quaternion is not of unit length")
    matrix = np.zeros((*xyz.shape[:-1], 4, 4))
    matrix[..., :3, :3] = Rotation.from_quat(xyzw.reshape(-1, 4)).as_matrix().reshape(*xyz.shape[:-1], 3, 3)
    matrix[..., :3, 3] = xyz
    matrix[..., 3, 3] = 1.0
    return matrix


def to_quaternion(matrix: ArrayLike) -> Float:
    """Quaternions (..., 4) of transforms (..., 4, 4), with w >= 0."""
    rotation = np.asarray(matrix, float)[..., :3, :3]
    xyzw = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.asarray(xyzw.reshape(*rotation.shape[:-2], 4))


def inverse(T_a_b: ArrayLike) -> Float:
    """T_b_a for rigid transforms (..., 4, 4)."""
    matrix = np.asarray(T_a_b, float)
    result = np.zeros_like(matrix)
    transposed = np.swapaxes(matrix[..., :3, :3], -1, -2)
    result[..., :3, :3] = transposed
    result[..., :3, 3] = -(transposed @ matrix[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def orthonormal(T_a_b: ArrayLike) -> Float:
    """The rigid transform (4, 4) nearest to one whose rotation has rounding errors.

    Raises InputError where a number is not finite or beyond all maps, or the upper part is not nearly a rotation.
    """
    matrix = np.asarray(T_a_b, float)
    if matrix.shape != (4, 4) or not (np.abs(matrix) < FARTHEST_M).all():
        raise InputError("a transform is not 4 x 4 finite numbers that a pose can have", advice="check the poses")
    left, stretch, right = np.linalg.svd(matrix[:3, :3])
    if np.abs(stretch - 1).max() > 0.1 or np.linalg.det(left @ right) < 0:
        raise InputError("a transform does not rotate but stretches or mirrors", advice="check the poses")
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = left @ right, matrix[:3, 3]
    return result


def transform_points(T_a_b: ArrayLike, points_b: ArrayLike) -> Float:
    """Points (N, 3) in frame b moved to frame a, by one transform (4, 4) or one a point (N, 4, 4)."""
    matrix, points = np.asarray(T_a_b, float), np.asarray(points_b, float)
    if matrix.ndim == 2:
        return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3])
    return np.asarray(np.einsum("nij,nj->ni", matrix[:, :3, :3], points) + matrix[:, :3, 3])
