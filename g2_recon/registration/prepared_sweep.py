# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A sweep made ready for matching: thinned evenly, with normals, a tree and what its laser saw in which direction."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
import small_gicp
from numpy.typing import NDArray

from g2_recon.config import SweepConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud

Float = NDArray[np.float64]

# Fewer points in different places do not make a surface whose place could be told.
_FEWEST_POINTS = 50
_NEIGHBORS = 10
# A sweep this large is one in millimetres, not one of a building in metres.
_IMPLAUSIBLE_MEDIAN_M = 200.0

_BIN = math.radians(2.0)
_AZIMUTHS, _ELEVATIONS = 180, 90


@dataclass(frozen=True)
class PreparedSweep:
    """A sweep in its own frame, whose origin is where the laser was.

    points: (M, 3) m, one a voxel. normals: (M, 3) unit. gicp, tree: the same as small_gicp wants them. nearest:
    (180, 90) m, the shortest range seen in each 2 deg of azimuth and elevation and those beside it, NaN where nothing
    was. measured: (N, 3) all points that count.
    """

    points: Float
    normals: Float
    gicp: small_gicp.PointCloud
    tree: small_gicp.KdTree
    nearest: Float
    measured: Float

    @cached_property
    def radius(self) -> float:
        """Root of the mean squared distance of the points from the laser in metres."""
        return float(np.sqrt(np.mean(np.sum(self.points**2, axis=1))))

    def pairs(self, places: Float) -> tuple[NDArray[np.int64], Float]:
        """The nearest point (K,) to each place (K, 3) in the frame of the sweep, and its distance (K,) in metres."""
        rows, squared = self.tree.batch_nearest_neighbor_search(places)
        return np.asarray(rows, np.int64), np.sqrt(squared)

    def seen_through(self, places: Float, margin: float) -> NDArray[np.bool_]:
        """Mask (K,) of the places (K, 3) behind which the laser saw something: nothing can have been there."""
        return np.asarray(before(places, self.nearest, margin))


def prepare(sweep: Cloud | Float, config: SweepConfig) -> PreparedSweep:
    """Make a sweep, points (N, 3) in metres in the frame of its laser, ready for matching.

    Points that are not finite, or nearer or farther than the settings say, do not count. Raises InputError where too
    few are left, or they all are in nearly the same place.
    """
    points = usable(sweep.points if isinstance(sweep, Cloud) else np.asarray(sweep, float), config)
    thinned = small_gicp.voxelgrid_sampling(points, config.voxel).points()[:, :3]
    if len(thinned) < _FEWEST_POINTS:
        raise InputError(
            f"a sweep of {len(points)} points fills {len(thinned)} voxels of {config.voxel:g} m only: too few to match",
            advice="leave it out, or check its unit (metres; set scale) and voxel",
        )
    cloud = small_gicp.PointCloud(thinned)
    tree = small_gicp.KdTree(cloud)
    small_gicp.estimate_normals_covariances(cloud, tree, _NEIGHBORS)
    return PreparedSweep(
        points=np.ascontiguousarray(cloud.points()[:, :3]),
        normals=np.ascontiguousarray(cloud.normals()[:, :3]),
        gicp=cloud,
        tree=tree,
        nearest=_nearest(points),
        measured=points,
    )


def usable(points: Float, config: SweepConfig) -> Float:
    """The points (K, 3) of (N, 3) that count, in metres. Raises InputError, with what was wrong, where none does."""
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"a sweep needs points of shape (N, 3), got {points.shape}")
    with np.errstate(invalid="ignore", over="ignore"):
        ranges = config.scale * np.sqrt(np.sum(points**2, axis=1))
        kept = points[(ranges >= config.min_range) & (ranges <= config.max_range)] * config.scale
    if len(kept):
        return np.ascontiguousarray(kept)
    if not len(points):
        raise InputError("the sweep holds no point", advice="leave it out")
    if not np.isfinite(ranges).any():
        raise InputError(f"none of the {len(points)} points of the sweep is finite", advice="leave it out")
    middle = float(np.median(ranges[np.isfinite(ranges)]))
    raise InputError(
        f"none of the {len(points)} points of the sweep is {config.min_range:g} to {config.max_range:g} m from the "
        f"laser, half of them are nearer than {middle:.3g} m",
        advice="if the unit is not metres, set scale, such as 0.001 for millimetres",
    )


def implausible_scale(points: Float, config: SweepConfig) -> str:
    """What to warn of where the unit of a sweep (N, 3) cannot be metres; empty where it can be."""
    with np.errstate(invalid="ignore", over="ignore"):
        ranges = config.scale * np.sqrt(np.sum(points**2, axis=1))
    finite = ranges[np.isfinite(ranges)]
    if not len(finite) or np.median(finite) < _IMPLAUSIBLE_MEDIAN_M:
        return ""
    return (
        f"half of its points are farther than {np.median(finite):.0f} m from the laser; if that is millimetres, set "
        f"scale to {0.001 * config.scale:g}"
    )


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


@numba.njit(cache=True, nogil=True)
def _bin(x, y, z):  # type: ignore[no-untyped-def]
    """Azimuth and elevation bin of a place, and how far it is from the laser."""
    flat = math.hypot(x, y)
    azimuth = int((math.atan2(y, x) + math.pi) / _BIN) % _AZIMUTHS
    elevation = min(int((math.atan2(z, flat) + math.pi / 2) / _BIN), _ELEVATIONS - 1)
    return azimuth, elevation, math.hypot(flat, z)


@numba.njit(cache=True, nogil=True)
def look(points, image):  # type: ignore[no-untyped-def]
    """Lower each bin of an image (180, 90) to the range of the nearest of points (N, 3) in it."""
    for row in range(len(points)):
        azimuth, elevation, distance = _bin(points[row, 0], points[row, 1], points[row, 2])
        image[azimuth, elevation] = min(image[azimuth, elevation], distance)


@numba.njit(cache=True, nogil=True)
def before(places, image, margin):  # type: ignore[no-untyped-def]
    """Mask (K,) of the places (K, 3) nearer than what an image of ranges has, by a margin in metres and a bin."""
    result = np.zeros(len(places), np.bool_)
    for row in range(len(places)):
        azimuth, elevation, distance = _bin(places[row, 0], places[row, 1], places[row, 2])
        result[row] = image[azimuth, elevation] > distance * (1 + _BIN) + margin
    return result
