# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Step 1 of mode solid: clusters that stay flat, so that they are the walls.

Lloyd's iteration with planes for centers, after variational shape approximation (Cohen-Steiner, Alliez, Desbrun, 2004),
here on points: a point p with normal n costs a cluster with center c and plane normal m

    |p - c|^2 / patch_size^2  +  (m . (p - c))^2 / flatness^2  +  normal_weight (1 - n . m).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.chunks import in_chunks
from g2_recon.geometry.point_tree import BLOCK, nearest_to_block, point_tree
from g2_recon.geometry.union_find import groups, link
from g2_recon.kernels import kernel
from g2_recon.reconstruction.surface_points import SurfacePoints, first_of_runs

Float = NDArray[np.float64]
Int = NDArray[np.int64]

# Clusters are found on one point a voxel; their seeds first spread on this many of those for each cluster.
_SAMPLE_PER_SEED = 80
_SEED_ITERATIONS = 15
_ITERATIONS = 12
_DIVISIONS_AFTER = (3, 5, 7)

# So many points of a cluster off its plane, one a voxel, are worth a cluster: a cell of the lattice has as many.
_LEAST_MISFITS = 9

# A cluster is bent where its points lie this part of the flatness, or this many times the noise, off its plane.
_THICK_FLATNESS = 0.5
_THICK_NOISE = 2.0

# A normal parts the two sides of a bend as strongly as this distance, in patch sizes.
_SPLIT_NORMAL = 2.5

# A flatness of less times the noise would slice a noisy wall into layers.
_LEAST_FLATNESS_NOISE = 4.5
_TRIM = 2.5
_TRIM_ROUNDS = 2

# Points that spread this part as far across a line as along it are a line, and so are those that spread by this many
# times the noise across it, all in one plane: in that of a scan ranges spread, and nothing across it.
_LINE = 0.02
_LINE_NOISE = 2.0
_IN_SCAN_NOISE = 0.5
# Such a line is on the plane of a cluster at most this many patch sizes away that it is this many times the noise off.
_NEAR_WALL = 3.0
_ON_WALL_NOISE = 2.0

# A deviation comes from sums of squares: less than this share of the length of a cluster is rounding. Taken for what it
# seems, all points of a plane without noise could be trimmed off it.
_ROUNDING = 1e-7

# Where the products xx xy xz yy yz zz are among the moments.
_SYMMETRIC = np.array([[4, 5, 6], [5, 7, 8], [6, 8, 9]])

# How often points of pieces too small for a cluster look for a cluster among their neighbors.
_ADOPTIONS = 4

# A cluster of less than this many least areas is no wall of its own where this share of it fits its neighbors well, at
# this share of the cost of a turn by 90 deg.
_SMALL = 4.0
_ALMOST_ALL = 0.9
_WELL = 0.25

# Voxels four times as large count the area; those eight times as large share one list of near clusters.
_AREA_LEVEL = 2
_BLOCK_LEVEL = 3
_NEAR_CLUSTERS = 32
_ANY = 1e300  # m^2, a limit that is none

# Points a task; results do not depend on the number of workers.
_CHUNK = 16384


@dataclass(frozen=True, slots=True)
class FlatClusters:
    """Clusters of points, each about a plane.

    label: (N,) cluster from 0, -1 for none. centers: (K, 3) m. normals: (K, 3) unit, to the side from which the points
    were seen. thickness: (K,) m, standard deviation of the points across the plane.
    """

    label: Int
    centers: Float
    normals: Float
    thickness: Float

    def __len__(self) -> int:
        return len(self.centers)


@dataclass(frozen=True, slots=True)
class _Costs:
    """What counts in the cost of a point, per square metre, per square metre and per unit of 1 - cos."""

    distance: float
    height: float
    turn: float


@dataclass(frozen=True, slots=True)
class _Sample:
    """Points (M, 3) with normals (M, 3) and weights (M,); the block (M,) of each, ascending; middles (B, 3) of blocks.

    Points of one block are near each other, at most `reach` (m) from its middle. noise: m, across the surface.
    """

    points: Float
    normals: Float
    weights: Float
    block: Int
    middles: Float
    reach: float
    noise: float

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True)
class _Planes:
    """Centers (K, 3), normals (K, 3), thickness (K,) and weight (K,) of clusters, and whether they are lines (K,)."""

    centers: Float
    normals: Float
    thickness: Float
    weight: Float
    line: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.centers)


def flat_clusters(
    surface: SurfacePoints,
    *,
    patch_area: float = 1.6,
    patch_size: float = 0.8,
    flatness: float = 0.04,
    normal_weight: float = 2.0,
    min_area: float = 0.04,
    gap: float = 0.4,
    seed: int = 0,
    workers: int = 1,
) -> FlatClusters:
    """Part a surface into flat clusters that hang together.

    patch_area: m^2 of surface for one cluster at first; bends, edges and gaps part them further. patch_size, flatness:
    m, how far a point may well be from the center of its cluster and from its plane; flatness is at least 4.5 times the
    noise. min_area: m^2, pieces that are smaller go to clusters next to them where they fit, else to none. gap: m, over
    more than that no cluster hangs together. The result does not depend on `workers`.

    Raises InputError where no piece is large enough.
    """
    flatness = max(flatness, _LEAST_FLATNESS_NOISE * surface.noise)
    bent = max(_THICK_FLATNESS * flatness, _THICK_NOISE * surface.noise)
    costs = _Costs(1 / patch_size**2, 1 / flatness**2, normal_weight)
    origin = surface.points.mean(axis=0)
    everything = _sample(surface, origin, slice(None))
    thinned = _sample(surface, origin, first_of_runs(surface.cells))
    planes = _seeded(thinned, costs, _area(surface) / patch_area, seed, workers)
    planes = _flattened(thinned, planes, costs, bent, workers)
    label = _assign(everything, planes, costs, workers)
    label = _connected(everything.points, surface.neighbors, label, gap)
    planes = _fit(everything, label, workers)
    label = _without_scraps(everything, surface, label, planes, costs, min_area)
    planes = _trimmed_fit(everything, label, workers)
    planes = _lines_on_planes(everything, label, planes, patch_size)
    return FlatClusters(label, planes.centers + origin, planes.normals, planes.thickness)


def _sample(surface: SurfacePoints, origin: Float, rows: Int | slice) -> _Sample:
    """The points `rows` of the surface, relative to origin."""
    points = surface.points[rows] - origin
    code = surface.cells[rows] >> np.uint64(3 * _BLOCK_LEVEL)
    first = first_of_runs(code)
    count = np.diff(np.append(first, len(points)))
    middles = np.add.reduceat(points, first) / count[:, None]
    return _Sample(
        points=points,
        normals=surface.normals[rows],
        weights=surface.weights if len(points) == len(surface) else np.ones(len(points)),
        block=np.repeat(np.arange(len(first)), count),
        middles=middles,
        reach=surface.voxel * 2**_BLOCK_LEVEL * np.sqrt(3),
        noise=surface.noise,
    )


def _area(surface: SurfacePoints) -> float:
    """The area of the surface in m^2, from the voxels that it passes.

    A plane with unit normal n passes |n_x| + |n_y| + |n_z| voxels for each of its area that could hold one.
    """
    code = surface.cells >> np.uint64(3 * _AREA_LEVEL)
    first = first_of_runs(code)
    x, y, z = np.abs(surface.normals.T)
    crossed = np.add.reduceat(x + y + z, first) / np.diff(np.append(first, len(code)))
    return float((1 / crossed).sum()) * (surface.voxel * 2**_AREA_LEVEL) ** 2


def _seeded(sample: _Sample, costs: _Costs, clusters: float, seed: int, workers: int) -> _Planes:
    """About so many clusters that are compact and face one way, by k-means of positions and normals.

    The first centers are spread over the surface by its order in space.
    """
    rng = np.random.default_rng(seed)
    count = int(np.clip(round(clusters), 1, len(sample)))
    rows = np.sort(rng.choice(len(sample), min(len(sample), count * _SAMPLE_PER_SEED), replace=False))
    part = replace(
        sample,
        points=sample.points[rows],
        normals=sample.normals[rows],
        weights=sample.weights[rows],
        block=sample.block[rows],
    )
    start = ((np.arange(count) + rng.random(count)) * len(part) / count).astype(np.int64)
    planes = _Planes(part.points[start], part.normals[start], np.zeros(count), np.ones(count), np.zeros(count, bool))
    compact = replace(costs, height=0.0)
    for _ in range(_SEED_ITERATIONS):
        planes = _fit(part, _assign(part, planes, compact, workers), workers)
    return planes


def _flattened(sample: _Sample, planes: _Planes, costs: _Costs, bent: float, workers: int) -> _Planes:
    """Lloyd's iteration with planes; on the way, clusters are divided that do not fit their plane.

    First what lies off the plane becomes a cluster of its own; what is still thicker than `bent` (m) is cut in two.
    """
    for iteration in range(1, _ITERATIONS + 1):
        label = _assign(sample, planes, costs, workers)
        if iteration in _DIVISIONS_AFTER:
            label = _numbered(label)
            label = _numbered(_without_misfits(sample, label, _fit(sample, label, workers), costs))
            label = _split(sample, label, _fit(sample, label, workers).thickness > bent, np.sqrt(costs.distance))
        planes = _fit(sample, label, workers)
    return planes


def _numbered(label: Int) -> Int:
    """The same clusters (M,), numbered from 0 without gaps."""
    used = np.bincount(label) > 0
    return (np.cumsum(used) - 1)[label]


def _without_misfits(sample: _Sample, label: Int, planes: _Planes, costs: _Costs) -> Int:
    """Labels (M,) after the points of a cluster that its plane does not fit became a cluster, where they are many."""
    cost = _misfits(sample.points, sample.normals, label, planes.centers, planes.normals, costs.height, costs.turn)
    rows = np.flatnonzero(cost > costs.turn)
    many = np.bincount(label[rows], minlength=len(planes)) >= _LEAST_MISFITS
    rows = rows[many[label[rows]]]
    label = label.copy()
    label[rows] += len(planes)
    return label


@kernel
def _misfits(points, normals, label, centers, planes, height, turn):  # type: ignore[no-untyped-def]
    """What the height and the turn of each point cost (M,) in its cluster."""
    cost = np.empty(len(points))
    for i in range(len(points)):
        cost[i] = _misfit(points, normals, i, centers, planes, label[i], height, turn)
    return cost


@kernel(inline="always")
def _misfit(points, normals, i, centers, planes, k, height, turn):  # type: ignore[no-untyped-def]
    """What the height and the turn of point i cost in cluster k."""
    off, cos = 0.0, 0.0
    for axis in range(3):
        off += (points[i, axis] - centers[k, axis]) * planes[k, axis]
        cos += normals[i, axis] * planes[k, axis]
    return off * off * height + (1.0 - cos) * turn


def _split(sample: _Sample, label: Int, which: NDArray[np.bool_], scale: float) -> Int:
    """Labels (M,) after cutting the clusters `which` (K,) across the direction of most variance.

    The direction is one in positions and normals together, so that a bend is cut where it bends.
    """
    rows = np.flatnonzero(which[label])
    if not len(rows):
        return label
    clusters, own = np.unique(label[rows], return_inverse=True)
    own = own.reshape(-1)
    features = np.hstack([scale * sample.points[rows], _SPLIT_NORMAL * sample.normals[rows]])
    count = np.bincount(own)
    features -= np.stack([np.bincount(own, column) / count for column in features.T], axis=1)[own]
    scatter = np.empty((len(clusters), 6, 6))
    for a in range(6):
        for b in range(a + 1):
            scatter[:, a, b] = scatter[:, b, a] = np.bincount(own, features[:, a] * features[:, b])
    direction = np.linalg.eigh(scatter)[1][:, :, -1]
    beyond = np.einsum("ij,ij->i", features, direction[own]) > 0
    label = label.copy()
    label[rows[beyond]] = len(which) + own[beyond]
    return label


def _assign(sample: _Sample, planes: _Planes, costs: _Costs, workers: int) -> Int:
    """The cheapest cluster (M,) for each point among the 32 whose centers are nearest to its block."""
    tree = point_tree(planes.centers)
    label = np.empty(len(sample), np.int64)

    def assign(begin: int, end: int) -> None:
        part = slice(begin, end)
        block = sample.block[part]
        distance, near = _nearest_centers(tree, sample.middles[block[0] : block[-1] + 1])
        _assign_points(
            sample.points[part],
            sample.normals[part],
            block - block[0],
            near,
            np.maximum(distance - sample.reach, 0.0) ** 2 * costs.distance,
            planes.centers,
            planes.normals,
            costs.distance,
            costs.height,
            costs.turn,
            label[part],
        )

    in_chunks(assign, len(sample), workers, chunk=_CHUNK)
    return label


@kernel
def _nearest_centers(tree, middles):  # type: ignore[no-untyped-def]
    """Distance (B, k) m and number (B, k) of the 32 centers nearest to the middle of each block, or of all."""
    count = min(_NEAR_CLUSTERS, len(tree.number))
    distance, number = np.empty((len(middles), count)), np.empty((len(middles), count), np.int64)
    found = np.empty(BLOCK, np.int64)
    for begin in range(0, len(middles), BLOCK):
        part = slice(begin, min(begin + BLOCK, len(middles)))
        nearest_to_block(tree, middles[part], _ANY, distance[part], number[part], found)
    for b in range(len(middles)):
        for n in range(count):
            distance[b, n], number[b, n] = np.sqrt(distance[b, n]), tree.number[number[b, n]]
    return distance, number


@kernel(fastmath=True)
def _assign_points(points, normals, block, near, least, centers, planes, distance, height, turn, label):  # type: ignore[no-untyped-def]
    for i in range(len(points)):
        best = np.inf
        for candidate in range(near.shape[1]):
            if least[block[i], candidate] >= best:
                break
            k = near[block[i], candidate]
            dx, dy, dz = points[i, 0] - centers[k, 0], points[i, 1] - centers[k, 1], points[i, 2] - centers[k, 2]
            cost = (dx * dx + dy * dy + dz * dz) * distance
            if cost >= best:
                continue
            off = dx * planes[k, 0] + dy * planes[k, 1] + dz * planes[k, 2]
            cos = normals[i, 0] * planes[k, 0] + normals[i, 1] * planes[k, 1] + normals[i, 2] * planes[k, 2]
            cost += off * off * height + (1.0 - cos) * turn
            if cost < best:
                best = cost
                label[i] = k


@kernel
def _connected(points, neighbors, label, gap):  # type: ignore[no-untyped-def]
    """The clusters (N,) after parting those that do not hang together, numbered by their first points.

    Points hang together over neighbors (N, m) that are not farther than the gap (m).
    """
    parent = np.arange(len(label))
    for i in range(len(label)):
        for j in neighbors[i]:
            x, y, z = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
            if label[j] == label[i] and x * x + y * y + z * z <= gap * gap:
                link(parent, i, np.int64(j))
    return groups(parent)[0]


def _without_scraps(
    sample: _Sample, surface: SurfacePoints, label: Int, planes: _Planes, costs: _Costs, min_area: float
) -> Int:
    """The clusters (N,) from 0 without those of less than `min_area` (m^2), whose points go to neighboring clusters.

    A point goes to the cluster of the neighbor whose plane fits it best, or to -1 where none fits.
    """
    area = planes.weight * surface.voxel**2
    if not (area >= min_area).any():
        raise InputError(
            f"no part of the surface that hangs together covers {min_area:g} m^2",
            advice="choose a smaller spacing, or a larger one where the points are far apart",
        )
    small = area < _SMALL * min_area
    adopted = _adopted(sample, surface, np.where(small[label], -1, label), planes, costs, _WELL * costs.turn)
    count = np.bincount(label, minlength=len(planes))
    dissolved = small & (np.bincount(label, adopted >= 0, len(planes)) >= _ALMOST_ALL * count)
    label = np.where(dissolved[label], adopted, label)
    large = (area >= min_area) & ~dissolved
    label = np.where((label >= 0) & large[label], label, -1)
    label = _adopted(sample, surface, label, planes, costs, costs.turn)
    number = np.cumsum(large) - 1
    return np.where(label < 0, -1, number[label])


def _adopted(sample: _Sample, surface: SurfacePoints, label: Int, planes: _Planes, costs: _Costs, limit: float) -> Int:
    """The labels (N,) after points without a cluster, -1, took that of the neighbor whose plane fits them best.

    Where the misfit with all of them is more than `limit` they stay without.
    """
    label = label.copy()
    rows = np.flatnonzero(label < 0)
    for _ in range(_ADOPTIONS):
        label[rows] = _adopting(
            sample.points,
            sample.normals,
            rows,
            surface.neighbors,
            label,
            planes.centers,
            planes.normals,
            costs.height,
            costs.turn,
            limit,
        )
        rows = rows[label[rows] < 0]
    return label


@kernel
def _adopting(  # type: ignore[no-untyped-def]
    points, normals, rows, neighbors, label, centers, planes, height, turn, limit
):
    """The cluster (n,) among those of the neighbors of each of the rows (n,) that it costs least, below the limit."""
    best = np.full(len(rows), -1)
    for n in range(len(rows)):
        least = limit
        for j in neighbors[rows[n]]:
            if label[j] >= 0:
                cost = _misfit(points, normals, rows[n], centers, planes, label[j], height, turn)
                if cost < least:
                    best[n], least = label[j], cost
    return best


def _fit(sample: _Sample, label: Int, workers: int) -> _Planes:
    """Planes of the clusters 0 to K - 1; those without points are left out, points with label -1 count for none."""
    anchor = _anchors(sample.points, label, int(label.max()) + 1)
    return _planes(_moments(sample, label, anchor, None, workers), anchor, sample.noise)


@kernel
def _anchors(points, label, count):  # type: ignore[no-untyped-def]
    """One of its points (count, 3) for each cluster, the last."""
    anchor = np.zeros((count, 3))
    for i in range(len(points)):
        if label[i] >= 0:
            for axis in range(3):
                anchor[label[i], axis] = points[i, axis]
    return anchor


def _trimmed_fit(sample: _Sample, label: Int, workers: int) -> _Planes:
    """Planes of the clusters without the points that are 2.5 standard deviations off them, found in two rounds."""
    planes = _fit(sample, label, workers)
    for _ in range(_TRIM_ROUNDS):
        limit = _TRIM * np.maximum(planes.thickness, sample.noise)
        moments = _moments(sample, label, planes.centers, (planes.normals, limit), workers)
        planes = _planes(moments, planes.centers, sample.noise)
    return planes


def _lines_on_planes(sample: _Sample, label: Int, planes: _Planes, patch_size: float) -> _Planes:
    """The planes; those of lines, which have none of their own, turned to that of a cluster nearby that they lie on.

    A wall goes on beyond where scans are dense: a line on the plane of one is of that wall. patch_size: m.
    """
    lines, walls = np.flatnonzero(planes.line), np.flatnonzero(~planes.line)
    rows = np.flatnonzero((label >= 0) & planes.line[label])
    rows = rows[np.argsort(label[rows], kind="stable")]
    begin = np.searchsorted(label[rows], [*lines, len(planes)])
    normals = planes.normals.copy()
    for k, first, last in zip(lines, begin[:-1], begin[1:], strict=True):
        near = walls[np.linalg.norm(planes.centers[walls] - planes.centers[k], axis=1) < _NEAR_WALL * patch_size]
        near = near[planes.normals[near] @ planes.normals[k] > 0]
        across = np.einsum("ki,ki->k", planes.centers[near], planes.normals[near])
        off = np.sqrt(
            np.mean((planes.normals[near] @ sample.points[rows[first:last]].T - across[:, None]) ** 2, axis=1)
        )
        if len(near) and off.min() < _ON_WALL_NOISE * sample.noise:
            normals[k] = planes.normals[near[np.argmin(off)]]
    return replace(planes, normals=normals)


def _moments(sample: _Sample, label: Int, anchor: Float, slab: tuple[Float, Float] | None, workers: int) -> Float:
    """Sums (K, 13) over each cluster: weights, offsets from the anchors (K, 3), their products, and normals.

    slab: only points whose offset along the first (K, 3) is at most the second (K,).
    """
    normals, limit = slab or (np.zeros_like(anchor), np.zeros(len(anchor)))

    def accumulate(begin: int, end: int) -> Float:
        part = slice(begin, end)
        sums = np.zeros((len(anchor), 13))
        _accumulate(
            sample.points[part],
            sample.normals[part],
            sample.weights[part],
            label[part],
            anchor,
            normals,
            limit,
            sums,
        )
        return sums

    # Chunks are the same, and added in the same order, on any number of workers.
    total = np.zeros((len(anchor), 13))
    for sums in in_chunks(accumulate, len(sample), workers, chunk=_CHUNK):
        total += sums
    return total


@kernel
def _accumulate(points, normals, weights, label, anchor, planes, limit, sums):  # type: ignore[no-untyped-def]
    for i in range(len(points)):
        k = label[i]
        if k < 0:
            continue
        x, y, z = points[i, 0] - anchor[k, 0], points[i, 1] - anchor[k, 1], points[i, 2] - anchor[k, 2]
        if abs(x * planes[k, 0] + y * planes[k, 1] + z * planes[k, 2]) > limit[k]:
            continue
        w = weights[i]
        row = sums[k]
        row[0] += w
        row[1] += w * x
        row[2] += w * y
        row[3] += w * z
        row[4] += w * x * x
        row[5] += w * x * y
        row[6] += w * x * z
        row[7] += w * y * y
        row[8] += w * y * z
        row[9] += w * z * z
        row[10] += w * normals[i, 0]
        row[11] += w * normals[i, 1]
        row[12] += w * normals[i, 2]


def _planes(moments: Float, anchor: Float, noise: float) -> _Planes:
    """Planes from the sums (K, 13) of clusters, without clusters of no weight."""
    used = moments[:, 0] > 0
    moments, anchor = moments[used], anchor[used]
    weight = moments[:, 0]
    mean = moments[:, 1:4] / weight[:, None]
    scatter = moments[:, _SYMMETRIC] / weight[:, None, None] - mean[:, :, None] * mean[:, None, :]
    square, axes = np.linalg.eigh(scatter)
    facing = moments[:, 10:]
    normals = np.where(np.einsum("ij,ij->i", axes[:, :, 0], facing)[:, None] < 0, -axes[:, :, 0], axes[:, :, 0])
    # Points that spread along a line, or coincide, have no plane of their own: they lie as their normals say.
    length = np.linalg.norm(facing, axis=1)
    scan = (square[:, 0] <= (_IN_SCAN_NOISE * noise) ** 2) & (square[:, 1] <= (_LINE_NOISE * noise) ** 2)
    line = ((square[:, 1] <= _LINE**2 * square[:, 2]) | scan) & (length > 0)
    normals[line] = facing[line] / length[line, None]
    variance = np.einsum("ij,ijk,ik->i", normals, scatter, normals)
    thickness = np.sqrt(np.maximum(variance, _ROUNDING**2 * square[:, 2]))
    return _Planes(anchor + mean, normals, thickness, weight, line)
