# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Phase 3 of mode `solid`: an advancing front from all submap borders at once, cheapest triangle first.

Each open half-edge asks for a third vertex; what it can get goes on a heap by cost. A triangle taken from the heap is
added where it is supported by data, agrees with the normals, and where the mesh stays manifold, consistently oriented
and free of overlap. Half-edges that a new triangle opens ask again.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.edges import edges_of, half_edge_numbers
from g2_recon.geometry.intersections import faces_cross
from g2_recon.geometry.point_grid import PointGrid, cell_of, point_grid, points_in_cell
from g2_recon.geometry.triangles import area_vector
from g2_recon.kernels import ZERO, inner_kernel, kernel
from g2_recon.reconstruction.support import triangle_supported

Float = NDArray[np.float64]
Int = NDArray[np.int64]

# A triangle may turn away from the normal at each of its vertices by acos(0.2) = 78 deg: it spans right angles between
# walls, and keeps the two sides of a thin wall apart.
_LEAST_AGREEMENT = 0.2
# Two triangles at an edge may fold by a little over a right angle.
_LEAST_FOLD = -0.1
# Twice the area of a triangle over the square of its longest side; below it is a needle.
_LEAST_SHAPE = 0.05
# What a triangle costs that turns away from a normal, as a share of the spacing; a circumradius is about 0.6 of it.
_TURN_COST = 0.3
# Corners of faces around a vertex may overlap by rounding only, and a new one needs some width; both in rad.
_ANGLE_ROUNDING = 1e-6
_LEAST_ANGLE = 0.02
# Any place on a triangle is within this share of its longest side of one of its corners: 1 / sqrt(3), rounded up.
_FARTHEST_CORNER = 0.57736
# A share of the reach that rounding does not use up.
_REACH_ROUNDING = 1e-9

_FULL_TURN = 2.0 * math.pi


class _Surface(NamedTuple):
    """The growing mesh. Corner 3 f + c is vertex c of face f.

    axes: (V, 2, 3) of the tangent plane at each vertex. used: (1,) faces in use of faces (K, 3). first: (V,) a corner
    at each vertex, or -1; following: (3 K,) the next corner at the same vertex, or -1. start, width: (3 K,) rad, the
    sector of the tangent plane that a corner covers. open_edges: (V,) open half-edges that begin or end at a vertex.
    longest: (V,) m, longest side of the faces at a vertex.
    searches: (1,) searches for crossings so far. looked_at: (K,) the last of them that came by a face, or 0.
    """

    vertices: Float
    normals: Float
    axes: Float
    used: Int
    faces: Int
    first: Int
    following: Int
    start: Float
    width: Float
    open_edges: Int
    longest: Float
    searches: Int
    looked_at: Int


class _Heap(NamedTuple):
    """Triangles by cost, then by vertex numbers, so that the order is the same each time.

    size: (1,) in use. rows: (K, 4) cost and vertex numbers, all of one type so that there is one array to grow.
    """

    size: Int
    rows: Float


def join_submaps(
    vertices: Float,
    normals: Float,
    faces: Int,
    grid: PointGrid,
    *,
    reach: float,
    spacing: float,
    support_distance: float,
) -> Int:
    """The triangles (J, 3) between the borders of the submaps.

    vertices: (V, 3) m; one without a face may be joined too. normals: (V, 3) unit normals of the surface there, towards
    the free side. faces: (F, 3) of all submaps, counterclockwise seen from the free side, each edge in at most two of
    them and then in opposite directions. grid: the data. reach: m, longest side of a triangle, 0: there are none.
    spacing: m, usual distance of neighbors. support_distance: m, data must lie this near to all of a triangle.

    Together with the faces the result is again edge-manifold and consistently oriented, and no new face crosses another
    one. Two fans of faces may still share a vertex (see mesh_repair.split_pinched).
    Raises InputError where the faces given are not manifold or not consistently oriented.
    """
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int64).reshape(-1, 3)
    if not len(vertices) or not reach > 0:
        return np.empty((0, 3), np.int64)
    _check_half_edges(faces, len(vertices))
    normals = np.ascontiguousarray(normals, dtype=np.float64)
    surface, heap = _surface(vertices, normals, faces), _Heap(np.zeros(1, np.int64), np.empty((1024, 4)))
    lookup = point_grid(vertices, cell=reach)
    while True:
        heap = _advance(surface, heap, lookup, grid, float(reach), float(spacing), float(support_distance))
        if not heap.size[0]:
            return surface.faces[len(faces) : surface.used[0]].copy()
        surface = _with_room(surface)


def _check_half_edges(faces: Int, count: int) -> None:
    edges, face_edges = edges_of(faces, count)
    times = np.bincount(half_edge_numbers(faces, face_edges).ravel())
    if (edges[:, 0] == edges[:, 1]).any() or (times > 1).any():
        raise InputError(
            "an edge is used twice in one direction",
            where="faces of the submaps",
            advice="give manifold, consistently oriented faces",
        )


def _tangent_axes(normals: Float) -> Float:
    """Two unit vectors (V, 2, 3) at right angles to each normal and each other, counterclockwise around it."""
    aside = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normals, aside)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-300)
    return np.ascontiguousarray(np.stack([first, np.cross(normals, first)], axis=1))


def _surface(vertices: Float, normals: Float, faces: Int) -> _Surface:
    count = len(vertices)
    room = len(faces) + count // 2 + 8
    surface = _Surface(
        vertices=vertices,
        normals=normals,
        axes=_tangent_axes(normals),
        used=np.zeros(1, np.int64),
        faces=np.empty((room, 3), np.int64),
        first=np.full(count, -1, np.int64),
        following=np.empty(3 * room, np.int64),
        start=np.empty(3 * room),
        width=np.empty(3 * room),
        open_edges=np.zeros(count, np.int64),
        longest=np.zeros(count),
        searches=np.zeros(1, np.int64),
        looked_at=np.zeros(room, np.int64),
    )
    _add_faces(surface, faces)
    return surface


def _with_room(surface: _Surface) -> _Surface:
    """The surface, with arrays for twice as many faces."""
    of_faces = ("faces", "following", "start", "width", "looked_at")
    arrays = {name: getattr(surface, name) for name in of_faces}
    return surface._replace(**{name: np.concatenate((array, np.zeros_like(array))) for name, array in arrays.items()})


@kernel
def _add_faces(surface, faces):  # type: ignore[no-untyped-def]
    for face in range(len(faces)):
        _add_face(surface, faces[face, 0], faces[face, 1], faces[face, 2])


@inner_kernel
def _add_face(surface, a, b, c):  # type: ignore[no-untyped-def]
    face = surface.used[0]
    surface.used[0] += 1
    surface.faces[face, 0], surface.faces[face, 1], surface.faces[face, 2] = a, b, c
    for corner in range(3):
        begin, end = surface.faces[face, corner], surface.faces[face, (corner + 1) % 3]
        change = 1 if _face_at(surface, end, begin) < 0 else -1
        surface.open_edges[begin] += change
        surface.open_edges[end] += change
    longest = max(
        _distance(surface.vertices, a, b), _distance(surface.vertices, b, c), _distance(surface.vertices, c, a)
    )
    for corner in range(3):
        vertex = surface.faces[face, corner]
        surface.longest[vertex] = max(surface.longest[vertex], longest)
        after, before = surface.faces[face, (corner + 1) % 3], surface.faces[face, (corner + 2) % 3]
        number = 3 * face + corner
        surface.start[number], surface.width[number] = _sector(surface, vertex, after, before)
        surface.following[number] = surface.first[vertex]
        surface.first[vertex] = number


@inner_kernel
def _face_at(surface, begin, end):  # type: ignore[no-untyped-def]
    """The face with the half-edge from begin to end, or -1."""
    corner = surface.first[begin]
    while corner >= 0:
        face = corner // 3
        if surface.faces[face, (corner + 1) % 3] == end:
            return face
        corner = surface.following[corner]
    return -1


@inner_kernel
def _is_border(surface, vertex):  # type: ignore[no-untyped-def]
    return surface.first[vertex] < 0 or surface.open_edges[vertex] > 0


@inner_kernel
def _sector(surface, vertex, after, before):  # type: ignore[no-untyped-def]
    """Start and width, in rad counterclockwise in the tangent plane, of the corner between two neighbors."""
    start = _direction(surface, vertex, after)
    return start, (_direction(surface, vertex, before) - start) % _FULL_TURN


@kernel
def _direction(surface, vertex, neighbor):  # type: ignore[no-untyped-def]
    x, y = 0.0, 0.0
    for axis in range(3):
        step = surface.vertices[neighbor, axis] - surface.vertices[vertex, axis]
        x += step * surface.axes[vertex, 0, axis]
        y += step * surface.axes[vertex, 1, axis]
    return math.atan2(y, x)


@inner_kernel
def _sector_is_free(surface, vertex, after, before):  # type: ignore[no-untyped-def]
    """Whether a new corner at the vertex covers no part of the tangent plane that a face covers already."""
    start, width = _sector(surface, vertex, after, before)
    if width < _LEAST_ANGLE or width > math.pi:
        return False
    corner = surface.first[vertex]
    while corner >= 0:
        from_new = (surface.start[corner] - start) % _FULL_TURN
        from_old = (start - surface.start[corner]) % _FULL_TURN
        if from_new < width - _ANGLE_ROUNDING or from_old < surface.width[corner] - _ANGLE_ROUNDING:
            return False
        corner = surface.following[corner]
    return True


@inner_kernel
def _distance(vertices, one, other):  # type: ignore[no-untyped-def]
    x = vertices[one, 0] - vertices[other, 0]
    y = vertices[one, 1] - vertices[other, 1]
    z = vertices[one, 2] - vertices[other, 2]
    return math.sqrt(x * x + y * y + z * z)


@kernel
def _cost(surface, a, b, c, folded_to, reach, spacing):  # type: ignore[no-untyped-def]
    """Circumradius plus a share of the spacing for turning away from the normals, in m; infinite where not allowed.

    folded_to: unit normal of the face beyond the edge from a to b.
    """
    vertices, normals = surface.vertices, surface.normals
    ab, bc, ca = _distance(vertices, a, b), _distance(vertices, b, c), _distance(vertices, c, a)
    if bc > reach or ca > reach:
        return np.inf
    x, y, z = area_vector(vertices, a, b, c)
    double_area = math.sqrt(x * x + y * y + z * z)
    longest = max(ab, bc, ca)
    if double_area <= _LEAST_SHAPE * longest * longest:
        return np.inf
    x, y, z = x / double_area, y / double_area, z / double_area
    if x * folded_to[0] + y * folded_to[1] + z * folded_to[2] < _LEAST_FOLD:
        return np.inf
    agreement = min(
        x * normals[a, 0] + y * normals[a, 1] + z * normals[a, 2],
        x * normals[b, 0] + y * normals[b, 1] + z * normals[b, 2],
        x * normals[c, 0] + y * normals[c, 1] + z * normals[c, 2],
    )
    if agreement < _LEAST_AGREEMENT:
        return np.inf
    return ab * bc * ca / (2.0 * double_area) + _TURN_COST * spacing * (1.0 - agreement)


@inner_kernel
def _fits(surface, a, b, c):  # type: ignore[no-untyped-def]
    """Whether the face (a, b, c) has its three half-edges free and ends at a border."""
    return (
        _is_border(surface, c)
        and _face_at(surface, a, b) < 0
        and _face_at(surface, b, c) < 0
        and _face_at(surface, c, a) < 0
    )


@inner_kernel
def _ask(surface, heap, lookup, a, b, reach, spacing):  # type: ignore[no-untyped-def]
    """Put on the heap what the free half-edge from a to b, opposite to a face, can get."""
    face = surface.faces[_face_at(surface, b, a)]
    x, y, z = area_vector(surface.vertices, face[0], face[1], face[2])
    length = max(math.sqrt(x * x + y * y + z * z), 1e-300)
    folded_to = (x / length, y / length, z / length)
    # A third vertex within reach of both ends lies within reach of their middle too.
    x = 0.5 * (surface.vertices[a, 0] + surface.vertices[b, 0])
    y = 0.5 * (surface.vertices[a, 1] + surface.vertices[b, 1])
    z = 0.5 * (surface.vertices[a, 2] + surface.vertices[b, 2])
    i, j, k = cell_of(lookup, x, y, z)
    low, high = _box_within(surface.vertices, a, b, reach)
    for di in range(-1, 2):
        for dj in range(-1, 2):
            for dk in range(-1, 2):
                begin, end = points_in_cell(lookup, i + di, j + dj, k + dk)
                for row in range(begin, end):
                    # In the lookup what is near lies together; the numbers of vertices lead all over the memory.
                    if not _in_box(lookup.points, row, low, high, _REACH_ROUNDING * reach):
                        continue
                    c = lookup.order[row]
                    if c in (a, b):
                        continue
                    cost = _cost(surface, a, b, c, folded_to, reach, spacing)
                    if cost < np.inf and _fits(surface, a, b, c):
                        heap = _push(heap, cost, a, b, c)
    return heap


@inner_kernel
def _crosses_surface(surface, lookup, a, b, c, longest):  # type: ignore[no-untyped-def]
    """Whether the face (a, b, c) would cross one that is there; longest: m, side of any face."""
    vertices = surface.vertices
    new = (a, b, c)
    surface.searches[0] += 1
    low = (
        min(vertices[a, 0], vertices[b, 0], vertices[c, 0]),
        min(vertices[a, 1], vertices[b, 1], vertices[c, 1]),
        min(vertices[a, 2], vertices[b, 2], vertices[c, 2]),
    )
    high = (
        max(vertices[a, 0], vertices[b, 0], vertices[c, 0]),
        max(vertices[a, 1], vertices[b, 1], vertices[c, 1]),
        max(vertices[a, 2], vertices[b, 2], vertices[c, 2]),
    )
    beyond = _FARTHEST_CORNER * longest
    first = cell_of(lookup, low[0] - beyond, low[1] - beyond, low[2] - beyond)
    last = cell_of(lookup, high[0] + beyond, high[1] + beyond, high[2] + beyond)
    for i in range(first[0], last[0] + 1):
        for j in range(first[1], last[1] + 1):
            for k in range(first[2], last[2] + 1):
                begin, end = points_in_cell(lookup, i, j, k)
                for row in range(begin, end):
                    if not _in_box(lookup.points, row, low, high, beyond):
                        continue
                    vertex = lookup.order[row]
                    if not _in_box(lookup.points, row, low, high, _FARTHEST_CORNER * surface.longest[vertex]):
                        continue
                    corner = surface.first[vertex]
                    while corner >= 0:
                        face = corner // 3
                        if surface.looked_at[face] < surface.searches[0]:
                            surface.looked_at[face] = surface.searches[0]
                            old = (surface.faces[face, 0], surface.faces[face, 1], surface.faces[face, 2])
                            if _meets_box(vertices, old, low, high) and faces_cross(vertices, new, old):
                                return True
                        corner = surface.following[corner]
    return False


@inner_kernel
def _box_within(vertices, a, b, reach):  # type: ignore[no-untyped-def]
    """Low and high corner of a box around all that is within reach of both vertices."""
    return (
        (
            max(vertices[a, 0], vertices[b, 0]) - reach,
            max(vertices[a, 1], vertices[b, 1]) - reach,
            max(vertices[a, 2], vertices[b, 2]) - reach,
        ),
        (
            min(vertices[a, 0], vertices[b, 0]) + reach,
            min(vertices[a, 1], vertices[b, 1]) + reach,
            min(vertices[a, 2], vertices[b, 2]) + reach,
        ),
    )


@inner_kernel
def _in_box(points, row, low, high, margin):  # type: ignore[no-untyped-def]
    """Whether a point is in the box or at most the margin outside of it along an axis."""
    inside = True
    for axis in range(3):
        inside &= low[axis] - margin <= points[row, axis] <= high[axis] + margin
    return inside


@inner_kernel
def _meets_box(vertices, face, low, high):  # type: ignore[no-untyped-def]
    """Whether the box around a face meets another one."""
    a, b, c = face
    for axis in range(3):
        if max(vertices[a, axis], vertices[b, axis], vertices[c, axis]) < low[axis]:
            return False
        if min(vertices[a, axis], vertices[b, axis], vertices[c, axis]) > high[axis]:
            return False
    return True


@kernel
def _advance(surface, heap, lookup, grid, reach, spacing, support_distance):  # type: ignore[no-untyped-def]
    """Add faces until the front has come to rest, where the heap ends empty, or no further one has room.

    heap: empty at first, then as it was returned.
    """
    longest = reach
    for vertex in range(len(surface.longest)):
        longest = max(longest, surface.longest[vertex])
    if heap.size[0] == 0:
        for face in range(surface.used[0]):
            for corner in range(3):
                begin, end = surface.faces[face, corner], surface.faces[face, (corner + 1) % 3]
                if _face_at(surface, end, begin) < 0:
                    heap = _ask(surface, heap, lookup, end, begin, reach, spacing)
    while heap.size[0] > 0 and surface.used[0] < len(surface.faces):
        a, b, c = _pop(heap)
        if not _fits(surface, a, b, c):
            continue
        if not (_sector_is_free(surface, a, b, c) and _sector_is_free(surface, b, c, a)):
            continue
        if not _sector_is_free(surface, c, a, b):
            continue
        if not triangle_supported(surface.vertices, a, b, c, grid, support_distance):
            continue
        if _crosses_surface(surface, lookup, a, b, c, longest):
            continue
        _add_face(surface, a, b, c)
        if _face_at(surface, c, b) < 0:
            heap = _ask(surface, heap, lookup, c, b, reach, spacing)
        if _face_at(surface, a, c) < 0:
            heap = _ask(surface, heap, lookup, a, c, reach, spacing)
    return heap


@inner_kernel
def _before(heap, one, other):  # type: ignore[no-untyped-def]
    for column in range(4):
        if heap.rows[one, column] != heap.rows[other, column]:
            return heap.rows[one, column] < heap.rows[other, column]
    return False


@inner_kernel
def _swap(heap, one, other):  # type: ignore[no-untyped-def]
    for column in range(4):
        kept = heap.rows[one, column]
        heap.rows[one, column] = heap.rows[other, column]
        heap.rows[other, column] = kept


@inner_kernel
def _push(heap, cost, a, b, c):  # type: ignore[no-untyped-def]
    place = heap.size[0]
    if place == len(heap.rows):
        rows = np.empty((2 * place, 4))
        for row in range(place):
            for column in range(4):
                rows[row, column] = heap.rows[row, column]
        heap = _Heap(heap.size, rows)
    heap.size[0] += 1
    heap.rows[place, 0], heap.rows[place, 1], heap.rows[place, 2], heap.rows[place, 3] = cost, a, b, c
    while place > 0 and _before(heap, place, (place - 1) // 2):
        _swap(heap, place, (place - 1) // 2)
        place = (place - 1) // 2
    return heap


@inner_kernel
def _pop(heap):  # type: ignore[no-untyped-def]
    """Remove the cheapest triangle."""
    a, b, c = int(heap.rows[0, 1]), int(heap.rows[0, 2]), int(heap.rows[0, 3])
    heap.size[0] -= 1
    size = heap.size[0]
    place = ZERO
    _swap(heap, place, size)
    while 2 * place + 1 < size:
        child = 2 * place + 1
        if child + 1 < size and _before(heap, child + 1, child):
            child += 1
        if not _before(heap, child, place):
            break
        _swap(heap, child, place)
        place = child
    return a, b, c
