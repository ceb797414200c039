# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The beams of a scan as localization uses them: points and surface normals, in order of bearing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.geometry.scan import Scan
from g2_recon.kernels import inner_kernel, kernel

Float32 = NDArray[np.float32]

# Of NumPy, as Numba would compile what they are handed to for each Python int anew.
INVALID, POINT, SURFACE, CORNER = np.uint8(0), np.uint8(1), np.uint8(2), np.uint8(4)
"""What a beam is: no measurement, a point, a point on a surface with a known normal, a point clearly on no surface.

A point that is none of the latter may lie on a wall seen at so flat an angle that its beams are far apart. Such wander
along with the robot.
"""
LOOSE = POINT | CORNER
ANY_KIND = SURFACE | LOOSE
"""Of kinds, one bit each."""

# Neighboring beams farther apart than this (m, and share of the range, and m at most) do not lie on one surface.
_GAP_M, _GAP_SHARE, _LARGEST_GAP_M = 0.15, 0.12, 1.0
# Beams to either side that a line is laid through: so many, and with dense beams all within this distance.
_NEIGHBORS = 4
_NEIGHBORHOOD_M = 0.08
_FEWEST_ON_LINE = 4
# A line is one if its points scatter less than this across it, in metres and as a share of their scatter along it.
_LINE_SIGMA_M = 0.03
_LINE_SHARE = 0.17
# A beam is on a sparsely seen wall if it is off the line through two neighbors by less than this, m; beyond them by the
# more, up to so many times.
_SPARSE_M, _FARTHEST_BEYOND = 0.04, 3.0


@dataclass(frozen=True, slots=True)
class Beams:
    """A scan in the planar laser frame, x forward, y left, whichever way up the laser is mounted.

    points: (B, 2) m. normals: (B, 2) unit, towards the laser, zero where unknown. kinds: (B,) INVALID, POINT,
    SURFACE or CORNER. first, increment: rad, bearing of the first beam, and from beam to beam (above 0).
    """

    points: Float32
    normals: Float32
    kinds: NDArray[np.uint8]
    first: float
    increment: float


def beams(
    scan: Scan,
    *,
    range_min: float,
    range_max: float,
    upside_down: bool = False,
    twist: ArrayLike = (0.0, 0.0, 0.0),
) -> Beams:
    """The beams of a scan, ranges limited in metres, each moved to where it lies at the stamp of the scan.

    twist: (3,) m/s, m/s, rad/s, velocity of the laser in its own frame; it counts where the scan has a time increment.
    """
    sign = -1.0 if upside_down else 1.0
    first, increment = sign * scan.angle_min, sign * scan.angle_increment
    near, far = max(scan.range_min, range_min), min(scan.range_max, range_max)
    points, kinds = _points(
        np.asarray(scan.ranges, np.float32), near, far, first, increment, scan.time_increment, np.asarray(twist, float)
    )
    if increment < 0:
        first += increment * (len(points) - 1)
    return Beams(points, surface_normals(points, kinds), kinds, first, abs(increment))


@kernel
def _points(ranges, near, far, first, increment, time_increment, twist):  # type: ignore[no-untyped-def]
    """Points (B, 2) and kinds (B,) of beams with the smallest bearing first; measurements are those of Scan.valid.

    Each point is seen from where a laser with this twist (3,) was at the time of its beam, and moved to time 0.
    """
    count = len(ranges)
    points = np.zeros((count, 2), np.float32)
    kinds = np.zeros(count, np.uint8)
    # As exact as the ranges themselves, so that one at a limit counts.
    near, far = np.float32(near), np.float32(far)
    for i in range(count):
        if not (ranges[i] > 0 and near <= ranges[i] <= far and ranges[i] < np.inf):
            continue
        bearing, time = first + i * increment, i * time_increment
        turn = twist[2] * time
        # The way along an arc: V(turn) * v * t, with V close to a rotation by half the turn.
        cos, sin = math.cos(turn / 2), math.sin(turn / 2)
        beam = i if increment > 0 else count - 1 - i
        points[beam, 0] = ranges[i] * math.cos(bearing + turn) + time * (cos * twist[0] - sin * twist[1])
        points[beam, 1] = ranges[i] * math.sin(bearing + turn) + time * (sin * twist[0] + cos * twist[1])
        kinds[beam] = POINT
    return points, kinds


@kernel
def surface_normals(points: Float32, kinds: NDArray[np.uint8]) -> Float32:
    """Unit normals (B, 2) of points (B, 2) in order of bearing, towards the laser; zero where there is no surface.

    A line is laid through a point and its neighbors (principal axis of their scatter), up to four beams or 8 cm to
    each side, as far as they lie on one surface. `kinds` becomes SURFACE where there is a normal, and CORNER where
    there is clearly no surface.
    """
    normals = np.zeros((len(points), 2), np.float32)
    _lay_lines(points, kinds, normals)
    for i in range(len(points)):
        if normals[i, 0] != 0 or normals[i, 1] != 0:
            kinds[i] = SURFACE
        elif kinds[i] != INVALID and not _on_sparse_wall(points, kinds, i):
            kinds[i] = CORNER
    return normals


@kernel
def normals_of_scans(points: Float32, kinds: NDArray[np.uint8]) -> Float32:
    """The normals (N, B, 2) of scans, as `surface_normals` gave them when it gave them their kinds (N, B)."""
    normals = np.zeros(points.shape, np.float32)
    for k in range(len(points)):
        _lay_lines(points[k], kinds[k], normals[k])
    return normals


@inner_kernel
def _lay_lines(points, kinds, normals):  # type: ignore[no-untyped-def]
    """Write the normals (B, 2) of a scan where points lie on a line; which of them are INVALID is all of the kinds."""
    count = len(points)
    for i in range(count):
        if kinds[i] == INVALID:
            continue
        gap = min(max(_GAP_M, _GAP_SHARE * math.hypot(points[i, 0], points[i, 1])), _LARGEST_GAP_M)
        first = i
        while first > 0 and kinds[first - 1] != INVALID and _continues(points, i, first, first - 1, gap):
            first -= 1
        last = i
        while last + 1 < count and kinds[last + 1] != INVALID and _continues(points, i, last, last + 1, gap):
            last += 1
        n = last + 1 - first
        if n < _FEWEST_ON_LINE:
            continue
        mean_x = mean_y = xx = xy = yy = 0.0
        for k in range(first, last + 1):
            mean_x += points[k, 0] / n
            mean_y += points[k, 1] / n
        for k in range(first, last + 1):
            x, y = points[k, 0] - mean_x, points[k, 1] - mean_y
            xx, xy, yy = xx + x * x / n, xy + x * y / n, yy + y * y / n
        middle, spread = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
        across, along = math.sqrt(max(middle - spread, 0.0)), math.sqrt(middle + spread)
        if across > _LINE_SIGMA_M or across > _LINE_SHARE * along:
            continue
        angle = 0.5 * math.atan2(2 * xy, xx - yy)
        x, y = -math.sin(angle), math.cos(angle)
        towards = -1.0 if x * points[i, 0] + y * points[i, 1] > 0 else 1.0
        normals[i, 0], normals[i, 1] = towards * x, towards * y


@inner_kernel
def _on_sparse_wall(points, kinds, i):  # type: ignore[no-untyped-def]
    """Whether a beam lies on the line through two of its neighbors, however far apart they are."""
    for first in range(max(0, i - 2), min(i, len(points) - 3) + 1):
        one = first if first != i else i + 1
        other = first + 2 if first + 2 != i else i - 1
        if kinds[one] == INVALID or kinds[other] == INVALID:
            continue
        dx, dy = points[other, 0] - points[one, 0], points[other, 1] - points[one, 1]
        length = math.hypot(dx, dy)
        off = abs(dx * (points[i, 1] - points[one, 1]) - dy * (points[i, 0] - points[one, 0]))
        away = max(
            math.hypot(points[i, 0] - points[one, 0], points[i, 1] - points[one, 1]),
            math.hypot(points[i, 0] - points[other, 0], points[i, 1] - points[other, 1]),
        )
        if off < _SPARSE_M * min(max(length, away), _FARTHEST_BEYOND * length):
            return True
    return False


@inner_kernel
def _continues(points, center, one, other, gap):  # type: ignore[no-untyped-def]
    """Whether beam `other`, next to beam `one`, belongs to the neighborhood of beam `center`."""
    if math.hypot(points[one, 0] - points[other, 0], points[one, 1] - points[other, 1]) > gap:
        return False
    if abs(center - other) <= _NEIGHBORS:
        return True
    return math.hypot(points[center, 0] - points[other, 0], points[center, 1] - points[other, 1]) <= _NEIGHBORHOOD_M
