# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Surface normals: planes through the neighbors of each point, and which of their two sides is the outer one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from g2_recon.geometry.chunks import in_chunks
from g2_recon.geometry.point_tree import BLOCK, PointTree, nearest_to_block
from g2_recon.kernels import ZERO, inner_kernel, kernel

Float = NDArray[np.float64]

# Directions along a surface in which a point has one neighbor each.
SECTORS = 8

_JACOBI_SWEEPS = 8

# Neighbors this many times longer than wide are a line. So is what lies in one plane with the sensor: that is the scan.
_LINE = 8.0
_EDGE_ON = np.cos(np.deg2rad(87.0))

# Points on one side of a thin wall that make a plane of their own.
_FEWEST = 6

# A point takes over the plane of a neighbor that it fits this much better, so many times in turn.
_BETTER = 0.5
_SHARPENINGS = 3


class LocalPlanes(NamedTuple):
    """Planes through the neighbors of N points; a tuple of arrays, so that kernels take it as it is.

    middles: (N, 3) m, means of the neighbors. normals: (N, 3) unit, towards the sensor, of arbitrary sign without one.
    deviation: (N,) m, of the neighbors across the plane. spans: (N,) whether they determine it, and are not only a line
    of one scan. found: (N,) how many they are, the point itself among them. around: (N, 8) the nearest neighbor in each
    eighth of the directions along the plane, -1 where there is none; points at the same place are in no direction.
    """

    middles: Float
    normals: Float
    deviation: Float
    spans: NDArray[np.bool_]
    found: NDArray[np.int64]
    around: NDArray[np.int32]

    @staticmethod
    def blank(size: int) -> LocalPlanes:
        """Of `size` points without any plane."""
        return LocalPlanes(
            middles=np.empty((size, 3)),
            normals=np.empty((size, 3)),
            deviation=np.empty(size),
            spans=np.zeros(size, bool),
            found=np.zeros(size, np.int64),
            around=np.empty((size, SECTORS), np.int32),
        )


def fit_local_planes(
    points: Float,
    sensor: Float | None,
    rows: NDArray[np.int64],
    tree: PointTree,
    *,
    radius: float,
    neighbors: int,
    workers: int,
    planes: LocalPlanes,
    places: NDArray[np.int64] | None = None,
) -> None:
    """Fit a plane to the nearest `neighbors` in the tree within `radius` (m) of each of the points `rows` (M,).

    points, sensor: (N, 3) m. The planes are filled in at `places` (M,), by default the rows; where the tree does not
    hold all points, only at those whose neighbors span one, and not `found`. Rows that are near each other should
    follow each other.
    """
    seen_from = np.empty((0, 3)) if sensor is None else sensor
    into = rows if places is None else places

    def fit(begin: int, end: int) -> None:
        _fit_local_planes(points, seen_from, rows[begin:end], tree, neighbors, radius, planes, into[begin:end])

    in_chunks(fit, len(rows), workers)


@kernel
def _fit_local_planes(points, sensor, rows, tree, neighbors, radius, planes, places):  # type: ignore[no-untyped-def]
    middles, normals, deviation, spans, neighbors_found, around = planes
    everywhere = len(tree.number) == len(points)
    block, found = np.empty((BLOCK, 3)), np.empty(BLOCK, np.int64)
    squared, nearest = np.empty((BLOCK, neighbors)), np.empty((BLOCK, neighbors), np.int64)
    away, matrix, axes = np.empty((neighbors, 3)), np.empty((3, 3)), np.empty((3, 3))
    square, spread = np.empty(3), np.empty(3)
    begin = ZERO
    while begin < len(rows):
        size = _block_at(points, rows, begin, radius, block)
        nearest_to_block(tree, block[:size], radius * radius, squared, nearest, found)
        for b in range(size):
            row, place, number = rows[begin + b], places[begin + b], found[b]
            x, y, z = block[b, 0], block[b, 1], block[b, 2]
            for attempt in range(2):
                # Sums are relative to the point itself so that large coordinates cost no precision.
                sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
                for n in range(number):
                    leaf, i = nearest[b, n] // BLOCK, nearest[b, n] % BLOCK
                    dx, dy, dz = tree.leaves[leaf, 0, i] - x, tree.leaves[leaf, 1, i] - y, tree.leaves[leaf, 2, i] - z
                    away[n, 0], away[n, 1], away[n, 2] = dx, dy, dz
                    sx, sy, sz = sx + dx, sy + dy, sz + dz
                    xx, xy, xz = xx + dx * dx, xy + dx * dy, xz + dx * dz
                    yy, yz, zz = yy + dy * dy, yz + dy * dz, zz + dz * dz
                share = 1.0 / max(number, 1)
                matrix[0, 0] = xx - sx * sx * share
                matrix[1, 1] = yy - sy * sy * share
                matrix[2, 2] = zz - sz * sz * share
                matrix[0, 1] = matrix[1, 0] = xy - sx * sy * share
                matrix[0, 2] = matrix[2, 0] = xz - sx * sz * share
                matrix[1, 2] = matrix[2, 1] = yz - sy * sz * share
                _principal_axes(matrix, axes, square)
                for a in range(3):
                    # Three degrees of freedom of the noise went into the plane.
                    spread[a] = np.sqrt(max(square[a], 0.0) / max(number - 3, 1))
                is_plane = spread[1] * _LINE > spread[2]
                edge_on = False
                if len(sensor):
                    rx, ry, rz = sensor[row, 0] - x, sensor[row, 1] - y, sensor[row, 2] - z
                    height = axes[0, 0] * rx + axes[1, 0] * ry + axes[2, 0] * rz
                    if height < 0:
                        for a in range(3):
                            axes[a, 0] = -axes[a, 0]
                    edge_on = abs(height) < _EDGE_ON * np.sqrt(rx * rx + ry * ry + rz * rz)
                    is_plane &= not edge_on
                if attempt:
                    break
                kept = _on_one_side(points, sensor, tree.number, nearest[b], number, axes)
                if kept == number or kept < _FEWEST:
                    break
                number = kept
            if everywhere:
                neighbors_found[place] = found[b]
            elif not is_plane:
                continue
            if edge_on and _face_sensor(axes, rx, ry, rz):
                spread[0] = spread[1]
            spans[place], deviation[place] = is_plane, spread[0]
            middles[place, 0], middles[place, 1], middles[place, 2] = x + sx * share, y + sy * share, z + sz * share
            for a in range(3):
                normals[place, a] = axes[a, 0]
            around[place] = -1
            for n in range(number):
                dx, dy, dz = away[n, 0], away[n, 1], away[n, 2]
                if dx == 0.0 and dy == 0.0 and dz == 0.0:
                    continue
                u = dx * axes[0, 2] + dy * axes[1, 2] + dz * axes[2, 2]
                v = dx * axes[0, 1] + dy * axes[1, 1] + dz * axes[2, 1]
                sector = (4 if v < 0 else 0) + (2 if u < 0 else 0) + (1 if abs(v) > abs(u) else 0)
                if around[place, sector] < 0:
                    around[place, sector] = tree.number[nearest[b, n]]
        begin += size


@kernel(inline="always")
def _face_sensor(axes, rx, ry, rz):  # type: ignore[no-untyped-def]
    """Turn the normal in `axes` about the line of a scan, to face the sensor at (rx, ry, rz); whether it could be.

    The plane through a line and the sensor is that of the scan. Of those that the line may lie on, the one at right
    angles to it is least wrong.
    """
    along = rx * axes[0, 2] + ry * axes[1, 2] + rz * axes[2, 2]
    x, y, z = rx - along * axes[0, 2], ry - along * axes[1, 2], rz - along * axes[2, 2]
    length = np.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return False
    axes[0, 0], axes[1, 0], axes[2, 0] = x / length, y / length, z / length
    return True


@inner_kernel
def _on_one_side(points, sensor, number, places, count, axes):  # type: ignore[no-untyped-def]
    """How many of the first `count` places, put in front, hold points seen from the side that the normal looks to.

    The two faces of a thin wall are nearer to each other than the points on them, but seen from opposite sides. All
    where too few would remain for a plane.
    """
    if not len(sensor):
        return count
    facing = 0
    for _ in range(2):
        kept = 0
        for n in range(count):
            j = number[places[n]]
            height = 0.0
            for a in range(3):
                height += axes[a, 0] * (sensor[j, a] - points[j, a])
            if height >= 0.0:
                if facing:
                    places[kept] = places[n]
                kept += 1
        facing = kept
        if kept == count or kept < _FEWEST:
            break
    return facing


@inner_kernel
def _block_at(points, rows, begin, radius, block):  # type: ignore[no-untyped-def]
    """Copy points from points[rows[begin]] on into the block, those within the radius of it along each axis."""
    size = 0
    # A block that has begun in a leaf of the tree ends there, if the rows are in the order of the tree.
    for i in range(begin, min(begin + BLOCK - begin % BLOCK, len(rows))):
        for a in range(3):
            block[size, a] = points[rows[i], a]
            # Places far from each other are slower to search for together than each on its own.
            if abs(block[size, a] - block[0, a]) > radius:
                return size
        size += 1
    return size


@inner_kernel
def _principal_axes(matrix, axes, square):  # type: ignore[no-untyped-def]
    """Eigenvectors (columns of axes) and ascending eigenvalues of a symmetric matrix.

    Cyclic Jacobi rotations (Golub & Van Loan, Matrix Computations, section 8.5): exact for degenerate matrices too.
    """
    axes[:] = 0.0
    for a in range(3):
        axes[a, a] = 1.0
    # Six numbers stay in registers, where an array of nine would not.
    xx, xy, xz, yy, yz, zz = matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[1, 1], matrix[1, 2], matrix[2, 2]
    size = xx + yy + zz
    for _ in range(_JACOBI_SWEEPS):
        if abs(xy) + abs(xz) + abs(yz) <= 1e-14 * size:
            break
        tangent, cosine, sine = _rotation(xx, yy, xy)
        xx, yy, xy = xx - tangent * xy, yy + tangent * xy, 0.0
        xz, yz = cosine * xz - sine * yz, sine * xz + cosine * yz
        _rotate(axes, 0, 1, cosine, sine)
        tangent, cosine, sine = _rotation(xx, zz, xz)
        xx, zz, xz = xx - tangent * xz, zz + tangent * xz, 0.0
        xy, yz = cosine * xy - sine * yz, sine * xy + cosine * yz
        _rotate(axes, 0, 2, cosine, sine)
        tangent, cosine, sine = _rotation(yy, zz, yz)
        yy, zz, yz = yy - tangent * yz, zz + tangent * yz, 0.0
        xy, xz = cosine * xy - sine * xz, sine * xy + cosine * xz
        _rotate(axes, 1, 2, cosine, sine)
    square[0], square[1], square[2] = xx, yy, zz
    for a, b in ((0, 1), (1, 2), (0, 1)):
        if square[b] < square[a]:
            square[a], square[b] = square[b], square[a]
            for c in range(3):
                axes[c, a], axes[c, b] = axes[c, b], axes[c, a]


@kernel(inline="always")
def _rotation(first, second, product):  # type: ignore[no-untyped-def]
    """Tangent, cosine and sine of the rotation that takes the product of two axes away."""
    if product == 0.0:
        return 0.0, 1.0, 0.0
    theta = (second - first) / (2.0 * product)
    tangent = (1.0 if theta >= 0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
    cosine = 1.0 / np.sqrt(tangent * tangent + 1.0)
    return tangent, cosine, tangent * cosine


@kernel(inline="always")
def _rotate(axes, p, q, cosine, sine):  # type: ignore[no-untyped-def]
    for a in range(3):
        first, second = axes[a, p], axes[a, q]
        axes[a, p] = cosine * first - sine * second
        axes[a, q] = sine * first + cosine * second


def sharper_planes(
    points: Float,
    middles: Float,
    normals: Float,
    deviation: Float,
    neighbors: NDArray[np.int32],
    workers: int = 1,
) -> NDArray[np.int64]:
    """For each point the one (N,) among those around it whose plane it lies on better than on its own, or itself.

    The neighbors of a point at a crease are on both of its sides and their plane is on neither; those of a point
    farther from the crease are on one. middles, normals: (N, 3) planes. deviation: (N,) m, of the neighbors across
    them. neighbors: (N, m), the point itself for none. A plane is better where its deviation and the distance of the
    point from it, taken together, are less than half. The result does not depend on `workers`.
    """
    variance = deviation**2
    owner: NDArray[np.int64] = np.arange(len(points))
    for _ in range(_SHARPENINGS):
        owner = _next_owner(points, middles, normals, variance, neighbors, owner, workers)
    return owner


def _next_owner(
    points: Float,
    middles: Float,
    normals: Float,
    variance: Float,
    neighbors: NDArray[np.int32],
    owner: NDArray[np.int64],
    workers: int,
) -> NDArray[np.int64]:
    result = np.empty_like(owner)

    def fill(begin: int, end: int) -> None:
        _fill_next_owner(points, middles, normals, variance, neighbors, owner, begin, end, result)

    in_chunks(fill, len(points), workers)
    return result


@kernel
def _fill_next_owner(  # type: ignore[no-untyped-def]
    points, middles, normals, variance, neighbors, owner, begin, end, result
):
    for i in range(begin, end):
        result[i] = owner[i]
        least = _BETTER**2 * _misfit(points, i, middles, normals, variance, owner[i])
        for s in range(neighbors.shape[1]):
            j = owner[neighbors[i, s]]
            # Most planes are not even flat enough.
            if variance[j] < least:
                misfit = _misfit(points, i, middles, normals, variance, j)
                if misfit < least:
                    least = misfit
                    result[i] = j


@kernel(inline="always")
def _misfit(points, point, middles, normals, variance, plane):  # type: ignore[no-untyped-def]
    height = 0.0
    for a in range(3):
        height += (points[point, a] - middles[plane, a]) * normals[plane, a]
    return variance[plane] + height * height


def orient_to_sensor(points: Float, normals: Float, sensor: Float, workers: int = 1) -> Float:
    """Normals (N, 3) turned towards where each point was seen from; all arrays (N, 3)."""
    turned = np.empty_like(normals)

    def turn(begin: int, end: int) -> None:
        part = slice(begin, end)
        away = np.einsum("ij,ij->i", normals[part], sensor[part] - points[part]) < 0
        turned[part] = np.where(away[:, None], -normals[part], normals[part])

    in_chunks(turn, len(points), workers)
    return turned


def orient_consistently(points: Float, normals: Float, neighbors: NDArray[np.int32]) -> Float:
    """Normals (N, 3) with signs that agree along the surface, outwards on closed objects.

    neighbors: (N, m), the point itself for none. The sign spreads over the spanning tree along which normals turn
    least (Hoppe et al., "Surface Reconstruction from Unorganized Points", 1992, section 3.3). It starts, on each
    connected piece, where the piece is farthest from its middle: there a closed object faces away from the middle.
    """
    count = len(points)
    tree, piece = _least_turning_tree(normals, neighbors)
    start = _outermost(points, piece)
    # One more node, linked to the start of each piece, makes one tree of the forest.
    root = csr_array((np.ones(len(start)), (np.full(len(start), count), start)), shape=(count + 1, count + 1))
    tree.resize((count + 1, count + 1))
    order, parent = breadth_first_order(tree + root, count, directed=False)
    middle = _means(points, piece)
    sign = np.ones(count + 1)
    outwards = np.einsum("ij,ij->i", normals[start], points[start] - middle[piece[start]]) >= 0
    sign[start] = np.where(outwards, 1.0, -1.0)
    _spread_signs(normals, order, parent, sign)
    return normals * sign[:count, None]


def _least_turning_tree(normals: Float, neighbors: NDArray[np.int32]) -> tuple[csr_array, NDArray[np.int32]]:
    """The spanning forest over the neighbors along which normals turn least, and the piece (N,) of each point."""
    count, most = neighbors.shape
    own = np.repeat(np.arange(count, dtype=np.int32), most)
    other = neighbors.ravel()
    linked = own != other
    own, other = own[linked], other[linked]
    turn = 1.0 - np.abs(np.einsum("ij,ij->i", normals[own], normals[other]))
    # A weight of zero would mean no link.
    graph = coo_array((turn + 1e-9, (np.minimum(own, other), np.maximum(own, other))), shape=(count, count))
    graph.sum_duplicates()
    tree = csr_array(minimum_spanning_tree(graph.tocsr()))
    return tree, connected_components(tree, directed=False)[1]


def _outermost(points: Float, piece: NDArray[np.int32]) -> NDArray[np.intp]:
    """The point of each piece that is farthest from the mean of the piece."""
    distance = np.linalg.norm(points - _means(points, piece)[piece], axis=1)
    order = np.lexsort((-distance, piece))
    return order[np.searchsorted(piece[order], np.arange(piece.max() + 1))]


def _means(points: Float, piece: NDArray[np.int32]) -> Float:
    total = np.stack([np.bincount(piece, column) for column in points.T], axis=1)
    return total / np.bincount(piece)[:, None]


@kernel
def _spread_signs(normals, order, parent, sign):  # type: ignore[no-untyped-def]
    root = order[0]
    for i in order[1:]:
        j = parent[i]
        if j != root:
            agreement = 0.0
            for a in range(3):
                agreement += normals[i, a] * normals[j, a]
            sign[i] = sign[j] if agreement >= 0 else -sign[j]
