# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Planar rigid transforms as arrays (..., 3) of x, y in metres and yaw in radians.

Every function broadcasts over leading dimensions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]

IDENTITY: Float = np.zeros(3)
IDENTITY.flags.writeable = False


def wrap_angle(angle: ArrayLike) -> Float:
    """Angles (...,) in radians brought into [-pi, pi)."""
    return np.asarray((np.asarray(angle, float) + np.pi) % (2 * np.pi) - np.pi)


def compose(T_a_b: ArrayLike, T_b_c: ArrayLike) -> Float:
    """T_a_c = T_a_b * T_b_c for poses (..., 3)."""
    first, second = np.asarray(T_a_b, float), np.asarray(T_b_c, float)
    cos, sin = np.cos(first[..., 2]), np.sin(first[..., 2])
    x = first[..., 0] + cos * second[..., 0] - sin * second[..., 1]
    y = first[..., 1] + sin * second[..., 0] + cos * second[..., 1]
    return np.stack(np.broadcast_arrays(x, y, wrap_angle(first[..., 2] + second[..., 2])), axis=-1)


def inverse(T_a_b: ArrayLike) -> Float:
    """T_b_a for poses (..., 3)."""
    pose = np.asarray(T_a_b, float)
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = -cos * pose[..., 0] - sin * pose[..., 1]
    y = sin * pose[..., 0] - cos * pose[..., 1]
    return np.stack([x, y, wrap_angle(-pose[..., 2])], axis=-1)


def relative(T_a_b: ArrayLike, T_a_c: ArrayLike) -> Float:
    """T_b_c: the second pose seen from the first, for poses (..., 3)."""
    return compose(inverse(T_a_b), T_a_c)


def transform_points(T_a_b: ArrayLike, points_b: ArrayLike) -> Float:
    """Points (N, 2) in frame b moved to frame a by one pose (3,)."""
    x, y, yaw = np.asarray(T_a_b, float)
    points = np.asarray(points_b, float)
    cos, sin = np.cos(yaw), np.sin(yaw)
    return points @ np.array([[cos, sin], [-sin, cos]]) + (x, y)


def from_se3(T_a_b: ArrayLike) -> Float:
    """The planar part (..., 3) of transforms (..., 4, 4); roll, pitch and z are dropped."""
    matrix = np.asarray(T_a_b, float)
    yaw = np.arctan2(matrix[..., 1, 0], matrix[..., 0, 0])
    return np.stack([matrix[..., 0, 3], matrix[..., 1, 3], yaw], axis=-1)
