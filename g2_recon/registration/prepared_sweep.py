# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A sweep made ready for matching: thinned evenly, with normals, a tree and what its laser saw in which direction."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import small_gicp
from numpy.typing import NDArray

from g2_recon.config import SweepConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.kernels import inner_kernel, kernel

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Fewer points in different places do not make a surface whose place could be told.
_FEWEST_POINTS = 50
_NEIGHBORS = 10
# A sweep this large is one in millimetres, not one of a building in metres.
_IMPLAUSIBLE_MEDIAN_M = 200.0

# A neighborhood this much thinner than wide is a plane.
_FLAT = 0.02
_FEWEST_ON_PLANE = 5

_BIN = math.radians(2.0)
_AZIMUTHS, _ELEVATIONS = 180, 90

# Numbers of cubes are sorted by digits of so many bits.
_DIGIT_BITS = 11
_DIGITS = 1 << _DIGIT_BITS


@dataclass(frozen=True, slots=True)
class PreparedSweep:
    """A sweep in its own frame, whose origin is where the laser was.

    points: (M, 3) m, one a voxel. normals: (M, 3) unit. flat: (M,) whether a point lies on a plane with those around
    it. gicp, tree: the same as small_gicp wants them. nearest: (180, 90) m, the shortest range seen in each 2 deg of
    azimuth and elevation and those beside it, NaN where nothing was. measured: (N, 3) all points that count. paired:
    points or measured, what point-to-point ICP looks for in another sweep at last.
    """

    points: Float
    normals: Float
    flat: Mask
    gicp: small_gicp.PointCloud
    tree: small_gicp.KdTree
    nearest: Float
    measured: Float
    paired: Float

    def pairs(self, places: Float) -> tuple[Int, Float]:
        """The nearest point (K,) to each place (K, 3) in the frame of the sweep, and its distance (K,) in metres."""
        rows, squared = self.tree.batch_nearest_neighbor_search(places)
        return np.asarray(rows, np.int64), np.sqrt(squared)

    def seen_through(self, places: Float, margin: float) -> Mask:
        """Mask (K,) of the places (K, 3) behind which the laser saw something: nothing can have been there."""
        return np.asarray(before(places, self.nearest, margin))


def prepare(sweep: Cloud | Float, config: SweepConfig) -> PreparedSweep:
    """Make a sweep, points (N, 3) in metres in the frame of its laser, ready for matching.

    Points that are not finite, or nearer or farther than the settings say, do not count. Raises InputError where too
    few are left, or they all are in nearly the same place.
    """
    points = usable(sweep.points if isinstance(sweep, Cloud) else np.asarray(sweep, float), config)
    thinned, flat = _thinned(points, config.voxel)
    if len(thinned) < _FEWEST_POINTS:
        raise InputError(
            f"a sweep of {len(points)} points fills {len(thinned)} voxels of {config.voxel:g} m only: too few to match",
            advice="leave it out, or check its unit (metres; set scale) and voxel",
        )
    cloud = small_gicp.PointCloud(thinned)
    tree = small_gicp.KdTree(cloud)
    small_gicp.estimate_normals_covariances(cloud, tree, _NEIGHBORS)
    kept = np.ascontiguousarray(cloud.points()[:, :3])
    return PreparedSweep(
        points=kept,
        normals=np.ascontiguousarray(cloud.normals()[:, :3]),
        flat=flat,
        gicp=cloud,
        tree=tree,
        nearest=_nearest(points),
        measured=points,
        paired=points if config.all_points else kept,
    )


def usable(points: Float, config: SweepConfig) -> Float:
    """The points (K, 3) of (N, 3) that count, in metres. Raises InputError, with what was wrong, where none does."""
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"a sweep needs points of shape (N, 3), got {points.shape}")
    kept = within(np.ascontiguousarray(points, np.float64), config.scale, config.min_range, config.max_range)
    if len(kept):
        return np.asarray(kept)
    if not len(points):
        raise InputError("the sweep holds no point", advice="leave it out")
    with np.errstate(invalid="ignore", over="ignore"):
        ranges = config.scale * np.sqrt(np.einsum("ij,ij->i", points, points))
    if not np.isfinite(ranges).any():
        raise InputError(f"none of the {len(points)} points of the sweep is finite", advice="leave it out")
    middle = float(np.median(ranges[np.isfinite(ranges)]))
    raise InputError(
        f"none of the {len(points)} points of the sweep is {config.min_range:g} to {config.max_range:g} m from the "
        f"laser, half of them are nearer than {middle:.3g} m",
        advice="if the unit is not metres, set scale, such as 0.001 for millimetres",
    )


@kernel
def within(points, scale, nearest, farthest):  # type: ignore[no-untyped-def]
    """Those of the points (N, 3) whose distance from the origin is between two, once they are scaled, scaled (K, 3)."""
    kept = np.empty((len(points), 3))
    count = 0
    for row in range(len(points)):
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        distance = scale * math.sqrt(x * x + y * y + z * z)
        if nearest <= distance <= farthest:
            kept[count, 0], kept[count, 1], kept[count, 2] = scale * x, scale * y, scale * z
            count += 1
    return kept[:count].copy()


def implausible_scale(points: Float, config: SweepConfig) -> str:
    """What to warn of where the unit of a sweep (N, 3) cannot be metres; empty where it can be."""
    with np.errstate(invalid="ignore", over="ignore"):
        ranges = config.scale * np.sqrt(np.einsum("ij,ij->i", points, points))
    finite = ranges[np.isfinite(ranges)]
    if not len(finite) or np.median(finite) < _IMPLAUSIBLE_MEDIAN_M:
        return ""
    return (
        f"half of its points are farther than {np.median(finite):.0f} m from the laser; if that is millimetres, set "
        f"scale to {0.001 * config.scale:g}"
    )


def _thinned(points: Float, voxel: float) -> tuple[Float, Mask]:
    """Points (M, 3), one in each cube of edge `voxel` (m) that any of (N, 3) is in, and whether on the plane there."""
    means, counts, keys, steps = middles_of_cubes(points, voxel)
    return tuple(flatten(means, counts, keys, steps))


@kernel
def middles_of_cubes(points, edge):  # type: ignore[no-untyped-def]
    """The mean (M, 3) of those of the points (N, 3) in each cube of `edge` (m) that holds any, and their number (M,).

    Also the numbers (M,) of the cubes, ascending, and the steps (2,) between cubes beside each other in x and in y; in
    z it is 1, and no cube is beside one at the other end of the room.
    """
    count = len(points)
    cells, low, high = np.empty((count, 3), np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    for axis in range(3):
        low[axis] = high[axis] = math.floor(points[0, axis] / edge)
        for row in range(count):
            cell = math.floor(points[row, axis] / edge)
            cells[row, axis] = cell
            low[axis], high[axis] = min(low[axis], cell), max(high[axis], cell)
    # With an empty cube at each end.
    steps = np.empty(2, np.int64)
    steps[1] = high[2] - low[2] + 3
    steps[0] = steps[1] * (high[1] - low[1] + 3)
    key = np.empty(count, np.int64)
    for row in range(count):
        x, y, z = cells[row, 0] - low[0] + 1, cells[row, 1] - low[1] + 1, cells[row, 2] - low[2] + 1
        key[row] = x * steps[0] + y * steps[1] + z
    order = _ascending(key, (high[0] - low[0] + 2) * steps[0])
    means, counts, keys = np.zeros((count, 3)), np.zeros(count), np.empty(count, np.int64)
    found = -1
    for row in order:
        if found < 0 or key[row] != keys[found]:
            found += 1
            keys[found] = key[row]
        counts[found] += 1.0
        for axis in range(3):
            means[found, axis] += points[row, axis]
    for cube in range(found + 1):
        for axis in range(3):
            means[cube, axis] /= counts[cube]
    return means[: found + 1], counts[: found + 1], keys[: found + 1], steps


@inner_kernel
def _ascending(keys, beyond):  # type: ignore[no-untyped-def]
    """The order (N,) of numbers (N,) from 0 to below `beyond`, those alike as they come: digit by digit, last first."""
    order, other = np.arange(len(keys)), np.empty(len(keys), np.int64)
    shift = 0
    while beyond >> shift > 0:
        place = np.zeros(_DIGITS + 1, np.int64)
        for key in keys:
            place[(key >> shift & (_DIGITS - 1)) + 1] += 1
        for digit in range(_DIGITS):
            place[digit + 1] += place[digit]
        for row in order:
            digit = keys[row] >> shift & (_DIGITS - 1)
            other[place[digit]] = row
            place[digit] += 1
        order, other = other, order
        shift += _DIGIT_BITS
    return order


@kernel
def flatten(points, counts, keys, steps):  # type: ignore[no-untyped-def]
    """Points (M, 3), those that lie on a plane with those in the 26 cubes around them moved onto it; and which (M,).

    A wall near the border of cubes leaves the tail of its noise in cubes of their own, which would count as much as
    the others: weighted by how many points (M,) each cube had, the plane is where the wall is. keys: (M,) numbers of
    the cubes, ascending; steps: (2,) between cubes beside each other in x and in y; in z it is 1. Smallest eigenvalue
    and its vector after O. K. Smith, "Eigenvalues of a symmetric 3 x 3 matrix", CACM 4(4), 1961.
    """
    result, flat = points.copy(), np.zeros(len(points), np.bool_)
    columns = np.zeros(9, np.int64)
    neighbors = np.empty(27, np.int64)
    A = np.empty((3, 3))
    center = np.empty(3)
    normal = np.empty(3)
    for row in range(len(points)):
        found = 0
        for column in range(9):
            # Keys ascend, so where a column of three cubes begins moves on from row to row.
            lowest = keys[row] + (column // 3 - 1) * steps[0] + (column % 3 - 1) * steps[1] - 1
            at = columns[column]
            while at < len(keys) and keys[at] < lowest:
                at += 1
            columns[column] = at
            while at < len(keys) and keys[at] <= lowest + 2:
                neighbors[found] = at
                found += 1
                at += 1
        total = 0.0
        center[:] = 0.0
        for k in neighbors[:found]:
            total += counts[k]
            for u in range(3):
                center[u] += counts[k] * points[k, u]
        center /= total
        A[:] = 0.0
        for k in neighbors[:found]:
            for u in range(3):
                for v in range(3):
                    A[u, v] += counts[k] / total * (points[k, u] - center[u]) * (points[k, v] - center[v])
        mean = (A[0, 0] + A[1, 1] + A[2, 2]) / 3
        off = A[0, 1] ** 2 + A[0, 2] ** 2 + A[1, 2] ** 2
        p = math.sqrt(((A[0, 0] - mean) ** 2 + (A[1, 1] - mean) ** 2 + (A[2, 2] - mean) ** 2 + 2 * off) / 6)
        if found < _FEWEST_ON_PLANE or p <= 0.0:
            continue
        b00, b11, b22 = (A[0, 0] - mean) / p, (A[1, 1] - mean) / p, (A[2, 2] - mean) / p
        b01, b02, b12 = A[0, 1] / p, A[0, 2] / p, A[1, 2] / p
        half = (b00 * (b11 * b22 - b12 * b12) - b01 * (b01 * b22 - b12 * b02) + b02 * (b01 * b12 - b11 * b02)) / 2
        angle = math.acos(min(max(half, -1.0), 1.0)) / 3
        largest = mean + 2 * p * math.cos(angle)
        smallest = mean + 2 * p * math.cos(angle + 2 * math.pi / 3)
        middle = 3 * mean - largest - smallest
        if smallest > _FLAT * middle:
            continue
        # The normal is across all rows of A minus the smallest eigenvalue: the longest cross product of two of them.
        longest = 0.0
        for u in range(3):
            v = (u + 1) % 3
            a0, a1, a2 = A[u, 0], A[u, 1], A[u, 2]
            c0, c1, c2 = A[v, 0], A[v, 1], A[v, 2]
            if u == 0:
                a0 -= smallest
            elif u == 1:
                a1 -= smallest
            else:
                a2 -= smallest
            if v == 0:
                c0 -= smallest
            elif v == 1:
                c1 -= smallest
            else:
                c2 -= smallest
            n0, n1, n2 = a1 * c2 - a2 * c1, a2 * c0 - a0 * c2, a0 * c1 - a1 * c0
            length = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
            if length > longest:
                longest = length
                normal[0], normal[1], normal[2] = n0 / length, n1 / length, n2 / length
        if longest > 0.0:
            off_plane = 0.0
            for u in range(3):
                off_plane += normal[u] * (points[row, u] - center[u])
            for u in range(3):
                result[row, u] = points[row, u] - off_plane * normal[u]
            flat[row] = True
    return result, flat


def _nearest(points: Float) -> Float:
    """The image of ranges of a sweep, see PreparedSweep.nearest."""
    image = np.full((_AZIMUTHS, _ELEVATIONS), np.inf)
    look(points, image)
    empty = np.isinf(image)
    # The direction of a beam and the place it hit are not exact, and surfaces run across the bins.
    around = np.minimum(np.minimum(np.roll(image, 1, axis=0), np.roll(image, -1, axis=0)), image)
    padded = np.pad(around, ((0, 0), (1, 1)), constant_values=np.inf)
    image = np.minimum(np.minimum(padded[:, :-2], padded[:, 2:]), around)
    image[empty] = np.nan
    return image


@inner_kernel
def _bin(x, y, z):  # type: ignore[no-untyped-def]
    """Azimuth and elevation bin of a place, and how far it is from the laser."""
    across = math.sqrt(x * x + y * y)
    azimuth = int((math.atan2(y, x) + math.pi) / _BIN) % _AZIMUTHS
    elevation = min(int((math.atan2(z, across) + math.pi / 2) / _BIN), _ELEVATIONS - 1)
    return azimuth, elevation, math.sqrt(across * across + z * z)


@kernel
def look(points, image):  # type: ignore[no-untyped-def]
    """Lower each bin of an image (180, 90) to the range of the nearest of points (N, 3) in it."""
    for row in range(len(points)):
        azimuth, elevation, distance = _bin(points[row, 0], points[row, 1], points[row, 2])
        image[azimuth, elevation] = min(image[azimuth, elevation], distance)


@kernel
def before(places, image, margin):  # type: ignore[no-untyped-def]
    """Mask (K,) of the places (K, 3) nearer than what an image of ranges has, by a margin in metres and a bin."""
    result = np.zeros(len(places), np.bool_)
    for row in range(len(places)):
        azimuth, elevation, distance = _bin(places[row, 0], places[row, 1], places[row, 2])
        result[row] = image[azimuth, elevation] > distance * (1 + _BIN) + margin
    return result
