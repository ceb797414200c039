# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The beams of a scan as localization uses them: points and surface normals, in order of bearing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.geometry.scan import Scan

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

INVALID, POINT, SURFACE = 0, 1, 2
"""What a beam is: no measurement, a point, a point on a surface with a known normal."""

# Neighboring beams farther apart than this (m, and share of the range, and m at most) do not lie on one surface.
_GAP_M, _GAP_SHARE, _LARGEST_GAP_M = 0.15, 0.12, 1.0
# Beams to either side that a line is laid through: so many, and with dense beams all within this distance.
_NEIGHBORS = 4
_NEIGHBORHOOD_M = 0.08
_FEWEST_ON_LINE = 4
# A line is one if its points scatter less than this across it, in metres and as a share of their scatter along it.
_LINE_SIGMA_M = 0.03
_LINE_SHARE = 0.17


@dataclass(frozen=True, slots=True)
class Beams:
    """A scan in the planar laser frame, x forward, y left, whichever way up the laser is mounted.

    points: (B, 2) m. normals: (B, 2) unit, towards the laser, zero where unknown. kinds: (B,) INVALID, POINT or
    SURFACE. first, increment: rad, bearing of the first beam, and from beam to beam (above 0).
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
    kinds = scan.valid(range_min=range_min, range_max=range_max).astype(np.uint8)
    bearings = scan.angles()
    ranges = np.where(kinds != INVALID, scan.ranges, 0.0).astype(float)
    times = scan.time_increment * np.arange(len(ranges), dtype=float)
    if upside_down:
        bearings = -bearings
    increment = -scan.angle_increment if upside_down else scan.angle_increment
    if increment < 0:
        bearings, ranges, kinds, times = bearings[::-1], ranges[::-1], kinds[::-1].copy(), times[::-1]
    points = np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings)])
    if scan.time_increment:
        points = _deskewed(points, times, np.asarray(twist, float))
    normals = surface_normals(points, kinds)
    first = float(bearings[0]) if len(bearings) else 0.0
    return Beams(points.astype(np.float32), normals.astype(np.float32), kinds, first, abs(increment))


def _deskewed(points: Float, times: Float, twist: Float) -> Float:
    """Points (B, 2), each seen from where a laser with this twist (3,) was at its time (B,), moved to time 0."""
    turn = twist[2] * times
    cos, sin = np.cos(turn), np.sin(turn)
    # The way along an arc: V(turn) * v * t, with V close to a rotation by half the turn.
    half_cos, half_sin = np.cos(turn / 2), np.sin(turn / 2)
    x = cos * points[:, 0] - sin * points[:, 1] + times * (half_cos * twist[0] - half_sin * twist[1])
    y = sin * points[:, 0] + cos * points[:, 1] + times * (half_sin * twist[0] + half_cos * twist[1])
    return np.column_stack([x, y])


@numba.njit(cache=True, nogil=True)
def surface_normals(points: Float, kinds: NDArray[np.uint8]) -> Float:
    """Unit normals (B, 2) of points (B, 2) in order of bearing, towards the laser; zero where there is no surface.

    A line is laid through a point and its neighbors (principal axis of their scatter), up to four beams or 8 cm to
    each side, as far as they lie on one surface. `kinds` becomes SURFACE where there is a normal.
    """
    count = len(points)
    normals = np.zeros((count, 2))
    surface = np.zeros(count, np.bool_)
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
        surface[i] = True
    for i in range(count):
        if surface[i]:
            kinds[i] = SURFACE
    return normals


@numba.njit(cache=True, nogil=True)
def _continues(points, center, one, other, gap):  # type: ignore[no-untyped-def]
    """Whether beam `other`, next to beam `one`, belongs to the neighborhood of beam `center`."""
    if math.hypot(points[one, 0] - points[other, 0], points[one, 1] - points[other, 1]) > gap:
        return False
    if abs(center - other) <= _NEIGHBORS:
        return True
    return math.hypot(points[center, 0] - points[other, 0], points[center, 1] - points[other, 1]) <= _NEIGHBORHOOD_M
