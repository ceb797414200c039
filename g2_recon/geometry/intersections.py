# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Which triangles of a mesh cross each other."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.point_grid import cell_of, point_grid, points_in_cell

Float = NDArray[np.float64]
Int = NDArray[np.int64]

# What two triangles may reach into each other, as a share of their size, and still only touch: rounding.
_TOUCH = 1e-7


def crossing_pairs(vertices: Float, faces: Int, *, among: NDArray[np.bool_] | None = None) -> Int:
    """Pairs (P, 2) of faces that cross or overlap, smaller number first, sorted.

    Faces that share an edge are not looked at; those that share a vertex may touch there.
    vertices: (V, 3) m, faces: (F, 3) of about one size (the search is over the size of the largest).
    among: (F,) only pairs with at least one of these faces.
    """
    if len(faces) < 2:
        return np.empty((0, 2), np.int64)
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int64)
    corners = vertices[faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    largest = float((high - low).max())
    if among is None:
        among = np.ones(len(faces), bool)
    grid = point_grid(low, cell=max(largest, 1e-9))
    pairs = _crossing_pairs(vertices, faces, low, high, grid, largest, among)
    return np.asarray(pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))])


@numba.njit(cache=True, nogil=True)
def _crossing_pairs(vertices, faces, low, high, grid, largest, among):  # type: ignore[no-untyped-def]
    """Candidates are the faces whose lower corner of the bounding box, which the grid holds, is near enough."""
    pairs: Int = np.empty((64, 2), np.int64)
    count = 0
    for face in np.flatnonzero(among):
        first = cell_of(grid, low[face, 0] - largest, low[face, 1] - largest, low[face, 2] - largest)
        last = cell_of(grid, high[face, 0], high[face, 1], high[face, 2])
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                for k in range(first[2], last[2] + 1):
                    begin, end = points_in_cell(grid, i, j, k)
                    for row in range(begin, end):
                        other = grid.order[row]
                        seen_from_other = among[other] and other <= face
                        if seen_from_other or _boxes_apart(low, high, face, other):
                            continue
                        if faces_cross(vertices, faces[face], faces[other]):
                            if count == len(pairs):
                                pairs = np.concatenate((pairs, np.empty_like(pairs)))
                            pairs[count, 0], pairs[count, 1] = min(face, other), max(face, other)
                            count += 1
    return pairs[:count]


@numba.njit(cache=True, nogil=True)
def _boxes_apart(low, high, one, other):  # type: ignore[no-untyped-def]
    apart = False
    for axis in range(3):
        apart |= low[one, axis] > high[other, axis] or low[other, axis] > high[one, axis]
    return apart


@numba.njit(cache=True, nogil=True)
def faces_cross(vertices, one, other):  # type: ignore[no-untyped-def]
    """Whether two faces (3,) cross or overlap by more than rounding; never if they share an edge or have no area.

    The interval test of Möller, "A fast triangle-triangle intersection test", 1997: the faces cross where the pieces
    that they cut from the line common to their planes overlap. A shared vertex is an end of both pieces.
    """
    shared = 0
    for i in range(3):
        for j in range(3):
            shared += one[i] == other[j]
    if shared >= 2:
        return False
    normal_one, size_one = _normal(vertices, one)
    normal_other, size_other = _normal(vertices, other)
    if _is_zero(normal_one) or _is_zero(normal_other):
        return False
    touch = _TOUCH * max(size_one, size_other)
    height_one = _heights(vertices, one, other, normal_other, touch)
    height_other = _heights(vertices, other, one, normal_one, touch)
    if _on_one_side(height_one) or _on_one_side(height_other):
        return False
    # Before the line, which means little where the planes are almost one.
    if _separates(vertices, one, other, normal_one, touch) or _separates(vertices, other, one, normal_other, touch):
        return False
    if _is_zero(height_one) or _is_zero(height_other):
        return True
    x = normal_one[1] * normal_other[2] - normal_one[2] * normal_other[1]
    y = normal_one[2] * normal_other[0] - normal_one[0] * normal_other[2]
    z = normal_one[0] * normal_other[1] - normal_one[1] * normal_other[0]
    length = math.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return False
    base = one[0]
    line = (x / length, y / length, z / length)
    begin_one, end_one = _piece(vertices, one, base, line, height_one)
    begin_other, end_other = _piece(vertices, other, base, line, height_other)
    return min(end_one, end_other) - max(begin_one, begin_other) > touch


@numba.njit(cache=True, nogil=True)
def _normal(vertices, face):  # type: ignore[no-untyped-def]
    """Unit normal of a face and its longest side along an axis; the normal of a face without area is zero."""
    a, b, c = face[0], face[1], face[2]
    ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
    vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = math.sqrt(x * x + y * y + z * z)
    size = max(abs(ux), abs(uy), abs(uz), abs(vx), abs(vy), abs(vz))
    if length == 0.0:
        return (0.0, 0.0, 0.0), size
    return (x / length, y / length, z / length), size


@numba.njit(cache=True, nogil=True)
def _heights(vertices, face, other, normal, touch):  # type: ignore[no-untyped-def]
    """How far the corners of a face are off the plane of the other; 0 within rounding and for shared vertices."""
    a, b, c = other[0], other[1], other[2]
    x = (vertices[a, 0] + vertices[b, 0] + vertices[c, 0]) / 3
    y = (vertices[a, 1] + vertices[b, 1] + vertices[c, 1]) / 3
    z = (vertices[a, 2] + vertices[b, 2] + vertices[c, 2]) / 3
    return (
        _height(vertices, face[0], other, normal, x, y, z, touch),
        _height(vertices, face[1], other, normal, x, y, z, touch),
        _height(vertices, face[2], other, normal, x, y, z, touch),
    )


@numba.njit(cache=True, nogil=True)
def _height(vertices, vertex, other, normal, x, y, z, touch):  # type: ignore[no-untyped-def]
    if vertex == other[0] or vertex == other[1] or vertex == other[2]:
        return 0.0
    height = (
        (vertices[vertex, 0] - x) * normal[0]
        + (vertices[vertex, 1] - y) * normal[1]
        + (vertices[vertex, 2] - z) * normal[2]
    )
    return height if abs(height) > touch else 0.0


@numba.njit(cache=True, nogil=True)
def _is_zero(values):  # type: ignore[no-untyped-def]
    return values[0] == 0.0 and values[1] == 0.0 and values[2] == 0.0


@numba.njit(cache=True, nogil=True)
def _on_one_side(height):  # type: ignore[no-untyped-def]
    return (height[0] > 0 and height[1] > 0 and height[2] > 0) or (height[0] < 0 and height[1] < 0 and height[2] < 0)


@numba.njit(cache=True, nogil=True)
def _piece(vertices, face, base, line, height):  # type: ignore[no-untyped-def]
    """Begin and end of what a face cuts from a line through its plane, along the line from the vertex `base`."""
    begin, end = np.inf, -np.inf
    for i in range(3):
        j = (i + 1) % 3
        along_i = _along(vertices, face[i], base, line)
        if height[i] == 0.0:
            begin, end = min(begin, along_i), max(end, along_i)
        elif height[i] * height[j] < 0.0:
            along_j = _along(vertices, face[j], base, line)
            along = along_i + (along_j - along_i) * height[i] / (height[i] - height[j])
            begin, end = min(begin, along), max(end, along)
    return begin, end


@numba.njit(cache=True, nogil=True)
def _along(vertices, vertex, base, line):  # type: ignore[no-untyped-def]
    return (
        (vertices[vertex, 0] - vertices[base, 0]) * line[0]
        + (vertices[vertex, 1] - vertices[base, 1]) * line[1]
        + (vertices[vertex, 2] - vertices[base, 2]) * line[2]
    )


@numba.njit(cache=True, nogil=True)
def _separates(vertices, face, other, normal, touch):  # type: ignore[no-untyped-def]
    """Whether the upright plane through a side of the face has the face on one side and all of the other one beyond."""
    for i in range(3):
        a, b, c = face[i], face[(i + 1) % 3], face[(i + 2) % 3]
        dx, dy, dz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        x = normal[1] * dz - normal[2] * dy
        y = normal[2] * dx - normal[0] * dz
        z = normal[0] * dy - normal[1] * dx
        length = math.sqrt(x * x + y * y + z * z)
        if length == 0.0:
            continue
        inward = (x / length, y / length, z / length)
        if _along(vertices, c, a, inward) < 0.0:
            inward = (-inward[0], -inward[1], -inward[2])
        farthest = -np.inf
        for j in range(3):
            farthest = max(farthest, _along(vertices, other[j], a, inward))
        if farthest <= touch:
            return True
    return False
