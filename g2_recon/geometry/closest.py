# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The closest place on a triangle mesh, found in a tree of bounding boxes."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.chunks import in_chunks
from g2_recon.geometry.selection import select
from g2_recon.kernels import ZERO, inner_kernel, kernel

Float = NDArray[np.float64]
Int = NDArray[np.int64]

_LEAF = 4  # faces in a leaf, at most
_LEVELS = 64
_FARTHEST = 1e60  # m; fourth powers of coordinates stay finite

# Below this height, as a share of its longest side, a triangle is taken for its three sides. Rounding (1e-16) over the
# share is what a place in a thinner triangle could be off along it; the share itself is what the sides can be off.
_THIN = 1e-8


class TriangleTree(NamedTuple):
    """A tree of boxes around the triangles of a mesh; a tuple of arrays, so that kernels take it as it is.

    The tree is complete, its 2^d leaves hold almost equally many faces: node 1 is the root, 2 i and 2 i + 1 are the
    parts of node i, and leaf k of L holds the places F k // L to F (k + 1) // L in `order`.

    boxes: (2 L, 6) m, low and high corner of each node, seen from `origin`. corners: (F, 9) m, a, b - a and c - a of
    each face, by place. order: (F,) the face at each place. origin: (3,) m, the middle of the mesh.
    """

    boxes: Float
    corners: Float
    order: Int
    origin: Float


@dataclass(frozen=True, slots=True)
class ClosestPlaces:
    """Where a mesh is closest to each of N points.

    distance: (N,) m, face: (N,), barycentric: (N, 3), weights of the corners of the face, each at least 0, in sum 1.
    Where nothing is within the limit: inf, -1 and NaN. Of several places as close, any one, always the same.
    """

    distance: Float
    face: Int
    barycentric: Float


def closest_on_mesh(
    points: Float, vertices: Float, faces: Int, *, limit: float = math.inf, workers: int = 1
) -> ClosestPlaces:
    """The closest place on a mesh to each point (N, 3), at most `limit` metres away.

    vertices: (V, 3) m, faces: (F, 3); faces of any size and shape, also without area. The result does not depend on
    `workers` (0: one a core). Raises InputError where the mesh has no face, a face names a vertex that is not there, or
    a coordinate is not finite.
    """
    return closest_in_tree(points, triangle_tree(vertices, faces), limit=limit, workers=workers)


def triangle_tree(vertices: Float, faces: Int) -> TriangleTree:
    """The tree of a mesh, for more than one search; arguments and errors as for closest_on_mesh."""
    vertices = _finite(vertices, "vertices")
    faces = np.ascontiguousarray(faces, dtype=np.int64).reshape(-1, 3)
    if len(faces) == 0:
        raise InputError("a mesh without a face", where="closest place", advice="is it a cloud?")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError("a face names a vertex that is not there", where="closest place", advice="this mesh is broken")
    used = vertices[faces]
    origin = (used.min(axis=(0, 1)) + used.max(axis=(0, 1))) / 2
    used = used - origin
    leaves = 1 << max(0, math.ceil(math.log2(len(faces) / _LEAF)))
    order = np.arange(len(faces))
    _sort(order, used.mean(axis=1), leaves)
    used = used[order]
    low, high = _boxes(used.min(axis=1), used.max(axis=1), leaves)
    used[:, 1:] -= used[:, :1]
    return TriangleTree(np.hstack([low, high]), np.ascontiguousarray(used.reshape(-1, 9)), order, origin)


def closest_in_tree(points: Float, tree: TriangleTree, *, limit: float = math.inf, workers: int = 1) -> ClosestPlaces:
    """As closest_on_mesh, for a mesh whose tree is there."""
    if not limit >= 0:
        raise InputError(f"a limit of {limit} m", where="closest place", advice="give a distance of at least 0")
    local = _finite(points, "points") - tree.origin
    distance, face = np.empty(len(local)), np.empty(len(local), np.int64)
    barycentric = np.empty((len(local), 3))
    # Points that follow each other in the order of a coarse grid find the same part of the tree in the cache.
    rows = _near_after_near(local)
    beyond = np.nextafter(limit * limit, np.inf)

    def search(begin: int, end: int) -> None:
        _search(local, rows[begin:end], tree, beyond, distance, face, barycentric)

    in_chunks(search, len(local), workers or os.cpu_count() or 1)
    return ClosestPlaces(distance, face, barycentric)


def _finite(points: Float, name: str) -> Float:
    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
    if not (np.abs(points) < _FARTHEST).all():
        raise InputError(f"some {name} are not finite", where="closest place", advice="remove them first")
    return points


def _near_after_near(points: Float) -> Int:
    """An order (N,) of points (N, 3) in which neighbors mostly follow each other: Morton's, of 1024 cells an axis."""
    if len(points) == 0:
        return np.empty(0, np.int64)
    low, high = points.min(axis=0), points.max(axis=0)
    cells = (points - low) * (1023 / max(float((high - low).max()), 1e-300))
    code = np.zeros(len(points), np.int64)
    for axis in range(3):
        bits = cells[:, axis].astype(np.int64)
        # Two empty bits after each of ten.
        for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
            bits = (bits | (bits << shift)) & mask
        code |= bits << axis
    return np.argsort(code, kind="stable")


@kernel
def _sort(order, centers, leaves):  # type: ignore[no-untyped-def]
    """Halve the faces again and again at the median of their centers (F, 3), across the longest side of these.

    The order (F,) and the centers are changed in place.
    """
    parts = 1
    while parts < leaves:
        for part in range(parts):
            begin, end = len(order) * part // parts, len(order) * (part + 1) // parts
            middle = len(order) * (2 * part + 1) // (2 * parts)
            axis, longest = ZERO, -1.0
            for candidate in range(3):
                low, high = np.inf, -np.inf
                for row in range(begin, end):
                    low = min(low, centers[row, candidate])
                    high = max(high, centers[row, candidate])
                if high - low > longest:
                    axis, longest = candidate, high - low
            select(centers, order, axis, begin, end, middle)
        parts *= 2


@kernel
def _boxes(face_low, face_high, leaves):  # type: ignore[no-untyped-def]
    """Low and high corners (2 L, 3) of the nodes; row 0 is not used."""
    low, high = np.full((2 * leaves, 3), np.inf), np.full((2 * leaves, 3), -np.inf)
    for leaf in range(leaves):
        for row in range(len(face_low) * leaf // leaves, len(face_low) * (leaf + 1) // leaves):
            for axis in range(3):
                low[leaves + leaf, axis] = min(low[leaves + leaf, axis], face_low[row, axis])
                high[leaves + leaf, axis] = max(high[leaves + leaf, axis], face_high[row, axis])
    for node in range(leaves - 1, 0, -1):
        for axis in range(3):
            low[node, axis] = min(low[2 * node, axis], low[2 * node + 1, axis])
            high[node, axis] = max(high[2 * node, axis], high[2 * node + 1, axis])
    return low, high


@kernel
def _search(points, rows, tree, beyond, distance, face, barycentric):  # type: ignore[no-untyped-def]
    """Fill in the rows; `beyond` (m^2) is what a squared distance must be below."""
    nodes, gaps = np.empty(_LEVELS, np.int64), np.empty(_LEVELS)
    for row in rows:
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        place, squared, v, w = closest_place(tree, x, y, z, beyond, nodes, gaps)
        if place < 0:
            distance[row], face[row] = np.inf, -1
            barycentric[row, 0] = barycentric[row, 1] = barycentric[row, 2] = np.nan
        else:
            distance[row], face[row] = math.sqrt(squared), tree.order[place]
            barycentric[row, 0], barycentric[row, 1], barycentric[row, 2] = max(1.0 - v - w, 0.0), v, w


@inner_kernel
def closest_place(tree, x, y, z, beyond, nodes, gaps):  # type: ignore[no-untyped-def]
    """Place in the tree, squared distance (m^2) and weights of b and c of what is closest to (x, y, z) from the origin.

    The place is -1 where nothing is nearer than `beyond` (m^2). nodes, gaps: (64,) room for the nodes still to visit.
    """
    leaves, count = len(tree.boxes) // 2, len(tree.order)
    best, best_v, best_w, found = beyond, 0.0, 0.0, -1
    nodes[0], gaps[0], top = 1, 0.0, 1
    while top > 0:
        top -= 1
        node = nodes[top]
        if gaps[top] >= best:
            continue
        while node < leaves:
            near, far = 2 * node, 2 * node + 1
            near_gap, far_gap = _gap(tree.boxes, near, x, y, z), _gap(tree.boxes, far, x, y, z)
            if far_gap < near_gap:
                near, near_gap, far, far_gap = far, far_gap, near, near_gap
            if far_gap < best:
                nodes[top], gaps[top] = far, far_gap
                top += 1
            if near_gap >= best:
                break
            node = near
        else:
            leaf = node - leaves
            for place in range(count * leaf // leaves, count * (leaf + 1) // leaves):
                squared, v, w = _closest_on_triangle(tree.corners[place], x, y, z, best)
                if squared < best:
                    best, best_v, best_w, found = squared, v, w, place
    return found, best, best_v, best_w


@inner_kernel
def _gap(boxes, node, x, y, z):  # type: ignore[no-untyped-def]
    """Squared distance from a box."""
    dx = max(boxes[node, 0] - x, x - boxes[node, 3], 0.0)
    dy = max(boxes[node, 1] - y, y - boxes[node, 4], 0.0)
    dz = max(boxes[node, 2] - z, z - boxes[node, 5], 0.0)
    return dx * dx + dy * dy + dz * dz


@inner_kernel
def _closest_on_triangle(corners, x, y, z, best):  # type: ignore[no-untyped-def]
    """Squared distance and weights of b and c of the closest place on a triangle; any that is not below `best`.

    The regions are those of Ericson, Real-Time Collision Detection, 2005, section 5.1.5. The weights come from the
    normal (section 3.4), which stays exact in thin triangles, where the products of products of 5.1.5 cancel.
    """
    ux, uy, uz = corners[3], corners[4], corners[5]
    vx, vy, vz = corners[6], corners[7], corners[8]
    px, py, pz = x - corners[0], y - corners[1], z - corners[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    area = nx * nx + ny * ny + nz * nz
    uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    longest = max(uu, vv, uu + vv - 2.0 * uv)
    is_thin = area <= _THIN * _THIN * longest * longest
    weight_v = weight_w = weight_u = -1.0
    if not is_thin:
        height = nx * px + ny * py + nz * pz
        if height * height >= best * area:
            return np.inf, 0.0, 0.0
        weight_v = (nx * (py * vz - pz * vy) + ny * (pz * vx - px * vz) + nz * (px * vy - py * vx)) / area
        weight_w = (nx * (uy * pz - uz * py) + ny * (uz * px - ux * pz) + nz * (ux * py - uy * px)) / area
        weight_u = 1.0 - weight_v - weight_w
        if weight_u >= 0.0 and weight_v >= 0.0 and weight_w >= 0.0:
            return height * height / area, weight_v, weight_w
    squared, v, w = np.inf, 0.0, 0.0
    # What is closest lies on a side that the point is beyond.
    if weight_w < 0.0:
        at = _along(px, py, pz, ux, uy, uz, uu)
        squared, v, w = _squared(px - at * ux, py - at * uy, pz - at * uz), at, 0.0
    if weight_v < 0.0:
        at = _along(px, py, pz, vx, vy, vz, vv)
        other = _squared(px - at * vx, py - at * vy, pz - at * vz)
        if other < squared:
            squared, v, w = other, 0.0, at
    if weight_u < 0.0:
        sx, sy, sz = vx - ux, vy - uy, vz - uz
        qx, qy, qz = px - ux, py - uy, pz - uz
        at = _along(qx, qy, qz, sx, sy, sz, _squared(sx, sy, sz))
        other = _squared(qx - at * sx, qy - at * sy, qz - at * sz)
        if other < squared:
            squared, v, w = other, 1.0 - at, at
    return squared, v, w


@inner_kernel
def _squared(x, y, z):  # type: ignore[no-untyped-def]
    return x * x + y * y + z * z


@inner_kernel
def _along(px, py, pz, sx, sy, sz, squared):  # type: ignore[no-untyped-def]
    """How far along the side s, as a share of it, the closest place to p is."""
    if squared == 0.0:
        return 0.0
    return min(max((px * sx + py * sy + pz * sz) / squared, 0.0), 1.0)
