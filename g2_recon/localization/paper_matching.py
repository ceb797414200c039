# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Scan matching: ICP of the points of one scan against a map of points."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.geometry import se2

Float = NDArray[np.float64]

_CONVERGED_TRANSLATION_M = 2e-4
_CONVERGED_ROTATION_RAD = 1e-4
_GATE_SHRINKS = 0.6
_FEWEST_PAIRS = 3
# A laser with millimetre resolution never matches better than this; it also keeps exact data from dividing by zero.
_FINEST_RMS_M = 1e-3
# What a pair is trusted with against the first guess, in metres. Far above the noise of a laser, since neighboring
# beams err together: by the map, by the pairing, by what moved.
_PAIR_SIGMA_M = 0.05


class Reference(Protocol):
    """A map that finds nearest points of like normal, such as PointMap."""

    def nearest(self, points: Float, normals: Float, max_distance: float) -> tuple[Float, Float, Float]:
        """The partner of each point (N, 2) with normal (N, 2): point (N, 2), normal (N, 2) and distance (N,) in metres.

        The distance is inf where there is no partner nearer than `max_distance`.
        """


@dataclass(frozen=True, slots=True)
class MatchResult:
    """What ICP found.

    pose: (3,) x, y, yaw of T_map_base. information: (3, 3) its inverse covariance, from the residuals of the pairs.
    inliers: share of the points that kept a partner. rms: m, root mean square residual of the pairs. iterations: how
    many were run. converged: whether the pose came to rest.
    """

    pose: Float
    information: Float
    inliers: float
    rms: float
    iterations: int
    converged: bool


def match(
    points: Float,
    normals: Float,
    reference: Reference,
    guess: ArrayLike,
    *,
    max_correspondence: float,
    min_correspondence: float,
    max_iterations: int,
    guess_sigma: ArrayLike = (np.inf, np.inf, np.inf),
) -> MatchResult:
    """Move points (N, 2) with normals (N, 2) of the robot frame onto the reference; ICP after Besl and McKay (1992).

    Each iteration pairs every point with its nearest reference point, rejects pairs that do not fit, and takes one
    Gauss-Newton step on the distances that remain, to the tangent of the reference (Chen and Medioni, 1992). The
    paper's "improvements of outlier point rejection" are two limits: pairs beyond a gate that shrinks from
    `max_correspondence` to `min_correspondence` (m) are rejected, and so are those beyond three times the median
    distance, which keeps people and moved furniture from pulling at the pose.

    guess_sigma: (3,) m, m, rad, how uncertain the guess is. It decides where the pairs say nothing, as they do along
    a bare corridor.
    """
    start = np.asarray(guess, float)
    pose = start.copy()
    prior = np.diag(_PAIR_SIGMA_M**2 / np.asarray(guess_sigma, float) ** 2 + _FINEST_RMS_M**2)
    gate = max_correspondence
    for iteration in range(1, max_iterations + 1):
        moved = se2.transform_points(pose, points)
        turned = se2.transform_points((0.0, 0.0, pose[2]), normals)
        partner, normal, distance = reference.nearest(moved, turned, gate)
        kept = reject_outliers(distance, min_correspondence)
        if np.count_nonzero(kept) < _FEWEST_PAIRS:
            return MatchResult(pose, np.zeros((3, 3)), 0.0, np.inf, iteration, False)
        hessian, gradient, squared = normal_equations(moved, partner, normal, kept, pose)
        step = -np.linalg.solve(hessian + prior, gradient + prior @ (pose - start))
        pose = pose + step
        at_rest = math.hypot(step[0], step[1]) < _CONVERGED_TRANSLATION_M and abs(step[2]) < _CONVERGED_ROTATION_RAD
        if at_rest and gate <= min_correspondence:
            break
        gate = min_correspondence if at_rest else max(min_correspondence, _GATE_SHRINKS * gate)
    pose[2] = se2.wrap_angle(pose[2])
    rms = math.sqrt(squared / np.count_nonzero(kept))
    information = hessian / max(rms, _FINEST_RMS_M) ** 2 + prior / _PAIR_SIGMA_M**2
    return MatchResult(pose, information, float(np.mean(kept)), rms, iteration, at_rest)


@numba.njit(cache=True, nogil=True)
def reject_outliers(distance: Float, floor: float) -> NDArray[np.bool_]:
    """Mask (N,) of the pairs worth keeping, for pair distances (N,) in metres, inf where there is no pair.

    A pair is rejected beyond three times the median distance, but never below `floor` metres.
    """
    paired = distance[distance < np.inf]
    limit = max(3.0 * np.median(paired), floor) if len(paired) else 0.0
    return distance <= limit


@numba.njit(cache=True, nogil=True)
def normal_equations(
    moved: Float, partner: Float, normal: Float, kept: NDArray[np.bool_], pose: Float
) -> tuple[Float, Float, float]:
    """Hessian (3, 3), gradient (3,) and summed squared residual of the kept pairs, for a step added to pose (3,).

    moved: (N, 2) points placed by the pose, partner: (N, 2) their map points, normal: (N, 2) of these. The residual
    of a pair is its distance along the normal.
    """
    hessian = np.zeros((3, 3))
    gradient = np.zeros(3)
    squared = 0.0
    for i in range(len(moved)):
        if not kept[i]:
            continue
        x, y = normal[i, 0], normal[i, 1]
        turn = y * (moved[i, 0] - pose[0]) - x * (moved[i, 1] - pose[1])
        error = x * (moved[i, 0] - partner[i, 0]) + y * (moved[i, 1] - partner[i, 1])
        squared += error * error
        gradient[0] += x * error
        gradient[1] += y * error
        gradient[2] += turn * error
        hessian[0, 0] += x * x
        hessian[0, 1] += x * y
        hessian[0, 2] += x * turn
        hessian[1, 1] += y * y
        hessian[1, 2] += y * turn
        hessian[2, 2] += turn * turn
    hessian[1, 0], hessian[2, 0], hessian[2, 1] = hessian[0, 1], hessian[0, 2], hessian[1, 2]
    return hessian, gradient, squared


# Neighboring beams farther apart than this (m, and share of the range) do not lie on one surface.
_SURFACE_GAP_M = 0.15
_SURFACE_GAP_SHARE = 0.12
# Beams on either side that a line is laid through: so many, and with dense beams all within this distance; and how many
# points it takes.
_NEIGHBORS = 4
_NEIGHBORHOOD_M = 0.08
_FEWEST_ON_LINE = 4
# A line is one if its points scatter less than this across it, in metres and as a share of their scatter along it.
_LINE_SIGMA_M = 0.03
_LINE_SHARE = 0.17


@numba.njit(cache=True, nogil=True)
def beam_normals(points: Float, beams: NDArray[np.int64]) -> Float:
    """Unit normals (N, 2) of the points (N, 2) of one scan in the laser frame, towards the laser; zero where unclear.

    beams: (N,) ascending beam indices. A line is laid through a point and its neighbors (principal axis of their
    scatter), up to four beams or 8 cm to each side, as far as they lie on one surface.
    """
    normal = np.zeros((len(points), 2))
    for i in range(len(points)):
        gap = max(_SURFACE_GAP_M, _SURFACE_GAP_SHARE * math.hypot(points[i, 0], points[i, 1]))
        first = i
        while first > 0 and _belongs(points, i, first - 1) and _adjacent(points, beams, first - 1, first, gap):
            first -= 1
        last = i
        while (
            last + 1 < len(points) and _belongs(points, i, last + 1) and _adjacent(points, beams, last, last + 1, gap)
        ):
            last += 1
        count = last + 1 - first
        if count < _FEWEST_ON_LINE:
            continue
        mean_x = mean_y = xx = xy = yy = 0.0
        for k in range(first, last + 1):
            mean_x += points[k, 0] / count
            mean_y += points[k, 1] / count
        for k in range(first, last + 1):
            x, y = points[k, 0] - mean_x, points[k, 1] - mean_y
            xx, xy, yy = xx + x * x / count, xy + x * y / count, yy + y * y / count
        middle, spread = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
        across, along = math.sqrt(max(middle - spread, 0.0)), math.sqrt(middle + spread)
        if across > _LINE_SIGMA_M or across > _LINE_SHARE * along:
            continue
        angle = 0.5 * math.atan2(2 * xy, xx - yy)
        x, y = -math.sin(angle), math.cos(angle)
        towards = -1.0 if x * points[i, 0] + y * points[i, 1] > 0 else 1.0
        normal[i, 0], normal[i, 1] = towards * x, towards * y
    return normal


@numba.njit(cache=True, nogil=True)
def _adjacent(points, beams, one, other, gap):  # type: ignore[no-untyped-def]
    near = math.hypot(points[one, 0] - points[other, 0], points[one, 1] - points[other, 1]) <= gap
    return near and beams[other] - beams[one] == 1


@numba.njit(cache=True, nogil=True)
def _belongs(points, center, other):  # type: ignore[no-untyped-def]
    distance = math.hypot(points[center, 0] - points[other, 0], points[center, 1] - points[other, 1])
    return abs(center - other) <= _NEIGHBORS or distance <= _NEIGHBORHOOD_M
