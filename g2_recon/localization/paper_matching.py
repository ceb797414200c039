# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Scan matching: ICP of the points of one scan against a map of points."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.geometry import se2

Float = NDArray[np.float64]

_CONVERGED_TRANSLATION_M = 2e-4
_CONVERGED_ROTATION_RAD = 1e-4
_GATE_SHRINKS = 0.6
_FEWEST_PAIRS = 3
# A laser with millimetre resolution never matches better than this; it also keeps exact data from dividing by zero.
_FINEST_SIGMA_M = 1e-3


class Reference(Protocol):
    """A map that finds nearest points, such as PointMap."""

    def nearest(self, points: Float, max_distance: float) -> tuple[Float, Float]:
        """The map point (N, 2) nearest to each point (N, 2), and its distance (N,) in metres.

        The distance is inf where there is no map point nearer than `max_distance`.
        """


@dataclass(frozen=True, slots=True)
class MatchResult:
    """What ICP found.

    pose: (3,) x, y, yaw of T_map_base. information: (3, 3) its inverse covariance, from the residuals of the pairs.
    inliers: share of the points that kept a partner. converged: whether the pose came to rest.
    """

    pose: Float
    information: Float
    inliers: float
    converged: bool


def match(
    points: Float,
    reference: Reference,
    guess: ArrayLike,
    *,
    max_correspondence: float,
    min_correspondence: float,
    max_iterations: int,
) -> MatchResult:
    """Move points (N, 2) of the robot frame, N > 0, onto the reference; ICP after Besl and McKay (1992).

    Each iteration pairs every point with its nearest reference point, rejects the pairs that do not fit, and takes the
    rigid motion that brings the rest together. The paper improves "outlier point rejection" and does not say how; here
    it has two limits: pairs beyond a gate that shrinks from `max_correspondence` to `min_correspondence` (m) are
    rejected, and so are those beyond three times the median distance.
    """
    pose = np.array(guess, float)
    gate = max_correspondence
    for _ in range(max_iterations):
        moved = se2.transform_points(pose, points)
        partners, distances = reference.nearest(moved, gate)
        kept = reject_outliers(distances, min_correspondence)
        if np.count_nonzero(kept) < _FEWEST_PAIRS:
            return MatchResult(pose, np.zeros((3, 3)), 0.0, False)
        before, pose = pose, se2.compose(rigid_motion(moved[kept], partners[kept]), pose)
        step = se2.relative(before, pose)
        at_rest = math.hypot(step[0], step[1]) < _CONVERGED_TRANSLATION_M and abs(step[2]) < _CONVERGED_ROTATION_RAD
        if at_rest and gate <= min_correspondence:
            break
        gate = min_correspondence if at_rest else max(min_correspondence, _GATE_SHRINKS * gate)
    information = _information(moved[kept] - before[:2], distances[kept])
    return MatchResult(pose, information, float(np.mean(kept)), at_rest)


def reject_outliers(distances: Float, floor: float) -> NDArray[np.bool_]:
    """Mask (N,) of the pairs worth keeping, for pair distances (N,) in metres, inf where there is no pair.

    A pair is rejected beyond three times the median distance, but never below `floor` metres.
    """
    paired = distances[distances < np.inf]
    return distances <= (max(3.0 * float(np.median(paired)), floor) if len(paired) else 0.0)


def rigid_motion(points: Float, partners: Float) -> Float:
    """The motion (3,) x, y, yaw that brings points (N, 2) nearest to their partners (N, 2), in least squares.

    The closed form of Umeyama (1991); in the plane the angle needs no singular value decomposition.
    """
    center, target = points.mean(axis=0), partners.mean(axis=0)
    x, y = (points - center).T
    u, v = (partners - target).T
    yaw = math.atan2(x @ v - y @ u, x @ u + y @ v)
    shift = target - se2.transform_points((0.0, 0.0, yaw), center[None])[0]
    return np.array([shift[0], shift[1], yaw])


def _information(arms: Float, distances: Float) -> Float:
    """J^T J / sigma^2 (3, 3) of pairs, with arms (N, 2) from the robot to its points, and distances (N,) in metres.

    sigma is that of one coordinate of the residuals.
    """
    variance = max(float(np.mean(distances**2)) / 2, _FINEST_SIGMA_M**2)
    x, y = arms.sum(axis=0)
    count = len(arms)
    return np.array([[count, 0, -y], [0, count, x], [-y, x, np.sum(arms**2)]]) / variance
