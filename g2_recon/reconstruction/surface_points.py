# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Step 0 of mode solid: what a cloud tells about the surface at each of its points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.chunks import in_chunks, taken
from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.point_tree import PointTree, point_tree
from g2_recon.kernels import kernel
from g2_recon.reconstruction.normals import (
    SECTORS,
    LocalPlanes,
    fit_local_planes,
    orient_consistently,
    orient_to_sensor,
    sharper_planes,
)
from g2_recon.reconstruction.usable_points import FEWEST_POINTS, distinct_points

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]
Codes = NDArray[np.uint64]

# A return with fewer others around it has no surface to lie on.
_FEWEST_NEIGHBORS = 4

# A point this many times the noise off the planes of its neighbors is not on their surface.
_OFF_PLANE_NOISE = 4.0

# Weights are per voxel of this part of the spacing of the neurons.
_VOXELS_PER_SPACING = 3

# Morton codes hold 21 bits an axis.
_MOST_VOXELS = 1 << 21

# How often a search that found no plane is repeated over twice the distance.
_WIDENINGS = 2

# Neighbors that spread across their plane by more than this many times the noise do not lie on one; the plane of the
# nearest few is taken instead where they spread by less than this part of that.
_ROUGH = 1.6
_NARROW_NEIGHBORS = 10
_NOISY = 0.06
_FLATTER = 0.6


@dataclass(frozen=True, slots=True)
class SurfacePoints:
    """The points of a cloud that lie on a surface, ordered so that what is near in space is near in the arrays.

    points: (N, 3) m. normals: (N, 3) unit, towards where the point was seen from. weights: (N,) one by the number of
    points in the voxel, so that sums go with area and not with density. noise: m, standard deviation of the points
    across their surface. neighbors: (N, 8) the nearest point in each eighth of the directions along the surface, the
    point itself where there is none; so points hang together across the gaps between scan lines. cells: (N,) Morton
    code of the voxel of each point, ascending; `cells >> 3 * n` are the voxels 2**n times as large. voxel: m, edge
    length of a voxel. kept: (N,) index of each point in the cloud. rejected: how many points of the cloud were not
    kept, by reason.
    """

    points: Float
    normals: Float
    weights: Float
    noise: float
    neighbors: NDArray[np.int32]
    cells: Codes
    voxel: float
    kept: Int
    rejected: dict[str, int]

    def __len__(self) -> int:
        return len(self.points)


def prepare(
    cloud: Cloud,
    *,
    spacing: float = 0.2,
    radius: float = 0.25,
    neighbors: int = 24,
    off_plane: float = 0.15,
    workers: int = 1,
) -> SurfacePoints:
    """Estimate normals, noise and area weights of a cloud, and leave out what is on no surface.

    cloud: of usable_points, finite and not on one line. spacing: m, of the neurons to come. A normal is that of the
    `neighbors` nearest points within `radius` (m); where these lie on a line, as those of one scan do, farther ones are
    taken, up to four times the radius. Points with fewer than four neighbors within the radius are left out, and so are
    points off the planes of their neighbors by more than `off_plane` (m) and four times the noise. The result does not
    depend on `workers`.

    Raises InputError where fewer than ten distinct points remain, or where they spread over more than 2**21 voxels of a
    third of the spacing.
    """
    voxel = spacing / _VOXELS_PER_SPACING
    origin = np.array([column.min() for column in cloud.points.T])
    cells, kept = _spatial_order(cloud.points - origin, voxel)
    points = taken(cloud.points, kept, workers)
    points -= origin
    sensor = None
    if cloud.sensor is not None:
        sensor = taken(cloud.sensor, kept, workers)
        sensor -= origin
    planes, noise = _local_planes(points, sensor, cells, radius, neighbors, workers)
    # Of a large cloud each of these takes much memory: it goes when there is the one of the good points.
    middles, normals, deviation, spans, found, around = planes
    del planes
    isolated = found - 1 < _FEWEST_NEIGHBORS
    off = ~isolated & (_median_distances(points, normals, around, workers) > max(_OFF_PLANE_NOISE * noise, off_plane))
    good = np.flatnonzero(~isolated & ~off)
    around = _links_among(around, good, workers)
    points = taken(points, good, workers)
    if distinct_points(points) < FEWEST_POINTS:
        raise InputError(
            f"only {len(good)} of {len(cloud)} points have neighbors on one surface within {radius:g} m",
            advice="choose a larger spacing; is the cloud in metres?",
        )
    cells, kept = cells[good], kept[good]
    middles = taken(middles, good, workers)
    normals = taken(normals, good, workers)
    deviation, spans = deviation[good], spans[good]
    if sensor is None:
        normals = orient_consistently(points, normals, around)
    plane = sharper_planes(points, middles, normals, deviation, around, workers)
    normals = taken(normals, plane, workers)
    if sensor is not None:
        normals = orient_to_sensor(points, normals, taken(sensor, good, workers), workers)
    rejected = {
        "isolated": int(np.count_nonzero(isolated)),
        "off the surface of their neighbors": int(np.count_nonzero(off)),
    }
    return SurfacePoints(
        points=points + origin,
        normals=normals,
        weights=_one_by_count(cells),
        noise=_noise_of(deviation[plane], spans[plane], noise),
        neighbors=around,
        cells=cells,
        voxel=voxel,
        kept=kept,
        rejected={reason: number for reason, number in rejected.items() if number},
    )


def first_of_runs(codes: Codes) -> Int:
    """The index of the first of each run of equal codes (N,): one point a voxel."""
    return np.flatnonzero(np.concatenate([[True], codes[1:] != codes[:-1]]))


def _spatial_order(points: Float, voxel: float) -> tuple[Codes, Int]:
    """Morton codes of the voxels of points (N, 3) from 0, ascending, and the order of the points that this takes."""
    extent = float(points.max())
    if extent >= _MOST_VOXELS * voxel:
        raise InputError(
            f"the cloud is {extent:g} m wide, more than {_MOST_VOXELS} voxels of {voxel:g} m",
            advice="leave out points that are far off, or choose a larger spacing",
        )
    # As fine as the codes can be, so that the order is one of places and hardly ever that of the input.
    finer = int(np.log2(_MOST_VOXELS * voxel / extent) - 1e-9) if extent > 0 else 0
    codes = _morton_codes(points, voxel / 2**finer)
    order = np.argsort(codes, kind="stable")
    return codes[order] >> np.uint64(3 * finer), order


@kernel
def _morton_codes(points, voxel):  # type: ignore[no-untyped-def]
    codes = np.empty(len(points), np.uint64)
    for i in range(len(points)):
        code = np.uint64(0)
        for axis in range(3):
            # Spread the bits of the coordinate so that two places stay free between them.
            b = np.uint64(points[i, axis] / voxel)
            b = (b | (b << np.uint64(32))) & np.uint64(0x1F00000000FFFF)
            b = (b | (b << np.uint64(16))) & np.uint64(0x1F0000FF0000FF)
            b = (b | (b << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
            b = (b | (b << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
            b = (b | (b << np.uint64(2))) & np.uint64(0x1249249249249249)
            code |= b << np.uint64(axis)
        codes[i] = code
    return codes


def _local_planes(
    points: Float, sensor: Float | None, cells: Codes, radius: float, neighbors: int, workers: int
) -> tuple[LocalPlanes, float]:
    """Fit a plane to the neighbors of each point, wider and coarser where the nearest ones do not span one.

    Also the noise in m, before narrower planes were taken.
    """
    tree = point_tree(points, workers=workers)
    local = LocalPlanes.blank(len(points))
    fit = partial(fit_local_planes, points, sensor, neighbors=neighbors, workers=workers, planes=local)
    fit(tree.number, tree, radius=radius)
    for widening in range(_WIDENINGS):
        rows = np.flatnonzero(~local.spans & (local.found > _FEWEST_NEIGHBORS))
        if len(rows):
            coarse = point_tree(points, first_of_runs(cells >> np.uint64(3 * widening)), workers=workers)
            fit(rows, coarse, radius=radius * 2 ** (widening + 1))
    noise = _noise_of(local.deviation, local.spans, 0.0)
    _refit_narrow(points, sensor, tree, local, noise, radius, workers)
    return local, noise


def _noise_of(deviation: Float, spans: Mask, unknown: float) -> float:
    """Median deviation of the planes (N,) that their neighbors span; `unknown` where there is none."""
    return float(np.median(deviation[spans])) if spans.any() else unknown


def _refit_narrow(
    points: Float, sensor: Float | None, tree: PointTree, local: LocalPlanes, noise: float, radius: float, workers: int
) -> None:
    """Where the neighbors of a point do not lie on one plane, take the plane of the nearest ones if these do.

    On a beam, a jamb or another face not much wider than the neighborhood, wider neighborhoods bend round its edges.
    """
    rows = np.flatnonzero(local.spans & (local.deviation > _ROUGH * noise))
    if not len(rows) or noise > _NOISY * radius:
        return
    narrow = LocalPlanes.blank(len(rows))
    fit_local_planes(
        points,
        sensor,
        rows,
        tree,
        radius=radius,
        neighbors=_NARROW_NEIGHBORS,
        workers=workers,
        planes=narrow,
        places=np.arange(len(rows)),
    )
    better = narrow.spans & (narrow.deviation < _FLATTER * local.deviation[rows])
    for name in ("middles", "normals", "deviation"):
        getattr(local, name)[rows[better]] = getattr(narrow, name)[better]


def _median_distances(points: Float, normals: Float, around: NDArray[np.int32], workers: int) -> Float:
    """Median distance (N,) of each point from the planes of its neighbors."""
    result = np.empty(len(points))
    in_chunks(
        lambda begin, end: _fill_median_distances(points, normals, around, begin, end, result), len(points), workers
    )
    return result


@kernel
def _fill_median_distances(points, normals, around, begin, end, result):  # type: ignore[no-untyped-def]
    distance = np.empty(around.shape[1])
    for i in range(begin, end):
        count = 0
        for j in around[i]:
            if j >= 0:
                off = 0.0
                for axis in range(3):
                    off += (points[i, axis] - points[j, axis]) * normals[j, axis]
                place = count
                while place > 0 and distance[place - 1] > abs(off):
                    distance[place] = distance[place - 1]
                    place -= 1
                distance[place] = abs(off)
                count += 1
        result[i] = 0.5 * (distance[(count - 1) // 2] + distance[count // 2]) if count else 0.0


def _links_among(around: NDArray[np.int32], good: Int, workers: int) -> NDArray[np.int32]:
    """Neighbors (M, 8) of the good points (M,), numbered among them; the point itself for none or one not good."""
    number = np.full(len(around), -1, np.int32)
    number[good] = np.arange(len(good), dtype=np.int32)
    links = np.empty((len(good), SECTORS), np.int32)
    in_chunks(lambda begin, end: _fill_links(around, good, number, begin, end, links), len(good), workers)
    return links


@kernel
def _fill_links(around, good, number, begin, end, links):  # type: ignore[no-untyped-def]
    for i in range(begin, end):
        for s in range(SECTORS):
            j = around[good[i], s]
            links[i, s] = number[j] if j >= 0 and number[j] >= 0 else i


def _one_by_count(codes: Codes) -> Float:
    """One by the number of equal codes, for each of ascending codes (N,)."""
    first = first_of_runs(codes)
    count = np.diff(np.append(first, len(codes)))
    return np.repeat(1.0 / count, count)
