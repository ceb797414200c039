# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The last steps of mode `solid`: borders out to their data, small loops closed, no crossings, no pinches."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.edges import edges_of, half_edge_numbers, is_open
from g2_recon.geometry.intersections import crossing_pairs
from g2_recon.geometry.point_grid import PointGrid
from g2_recon.geometry.triangles import area_vector, area_vectors, unit, vertex_normals
from g2_recon.geometry.union_find import linked
from g2_recon.kernels import inner_kernel, kernel
from g2_recon.reconstruction.support import supported

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

# How far the copies of a pinched vertex move into their own fans, as a share of their way to the middle of the fan:
# apart enough that no reader of the mesh merges them again, near enough that nobody sees it.
_PART = 0.005

# Where the data of a border vertex ends: at this quantile of its points, and a gap between them beyond, of which no
# more counts than this share of the limit.
_END = 0.98
_FARTHEST_BEYOND = 0.35

# What closes a hole may turn away from the surface around it by acos(0.2) = 78 deg.
_LEAST_AGREEMENT = 0.2
_SMALL_PIECE = 32

# A hole of less area than this part of its length squared is a slit; a square has 1 / 16 of it.
_SLIT = 0.02

# A fold has no more edges; what closes a hole with more of them faces as its surroundings do.
_FEW_EDGES = 8

# Twice the area of a triangle over the square of its longest side; below it is a needle.
_LEAST_SHAPE = 0.05

# m^2, what an edge that the mesh has already costs a triangulation: more than any hole.
_TAKEN = 1e6

# How much of its way from home a vertex keeps, round by round, while one of its faces crosses another one.
_KEPT_OF_WAY = (0.5, 0.5, 0.5, 0.0, 0.0)


def split_pinched(vertices: Float, faces: Int) -> tuple[Float, Int, Int]:
    """A vertex for each fan of faces: vertices (V', 3) m, faces (F, 3), and the vertex (V',) that each was made from.

    At a pinched vertex two or more fans meet in a point, which half-edge structures cannot hold. The given vertices
    come first; the first fan keeps the vertex. The vertices of a pinch are moved apart by a two-hundredth of the way to
    the middle of their fan.
    """
    fan, origin = _fans(faces, len(vertices))
    pinched = np.bincount(origin, minlength=len(vertices)) > 1
    first = np.full(len(vertices), -1)
    first[origin[::-1]] = np.arange(len(origin))[::-1]
    is_first = first[origin] == np.arange(len(origin))
    number = np.where(is_first, origin, len(vertices) + np.cumsum(~is_first) - 1)
    split = number[fan].reshape(-1, 3)
    source = np.concatenate([np.arange(len(vertices)), origin[~is_first]])
    placed = vertices[source]
    moved = pinched[source]
    middle = _fan_middles(placed, split[moved[split].any(axis=1)])[moved]
    placed[moved] += _PART * (middle - placed[moved])
    return placed, split, source


def _fans(faces: Int, count: int) -> tuple[Int, Int]:
    """The fan (3 F,) of each corner of the faces, and the vertex (fans,) that each fan is around.

    Corners at one vertex belong to one fan where their faces share an edge at that vertex.
    """
    one, other = _neighbors_at_edges(edges_of(faces, count)[1])
    # Half-edge h runs from corner h to after[h]; of two faces at an edge, the corners at the same vertex are linked.
    after = np.roll(np.arange(faces.size).reshape(-1, 3), -1, axis=1).ravel()
    same_way = faces.ravel()[one] == faces.ravel()[other]
    fan, first_corner = linked(
        np.concatenate([one, after[one]]),
        np.concatenate([np.where(same_way, other, after[other]), np.where(same_way, after[other], other)]),
        faces.size,
    )
    return fan, faces.ravel()[first_corner]


def _neighbors_at_edges(face_edges: Int) -> tuple[Int, Int]:
    """Pairs of half-edges (P,), (P,) that follow each other among those (F, 3) of one edge; a half-edge is a corner."""
    before = _before_at_edge(face_edges.reshape(-1))
    other = np.flatnonzero(before >= 0)
    return before[other], other


@kernel
def _before_at_edge(edge):  # type: ignore[no-untyped-def]
    before = np.empty(len(edge), np.int64)
    last = np.full(len(edge), -1, np.int64)
    for half_edge in range(len(edge)):
        before[half_edge] = last[edge[half_edge]]
        last[edge[half_edge]] = half_edge
    return before


def _fan_middles(vertices: Float, faces: Int) -> Float:
    """For each vertex (V, 3) the mean of the middles of its faces; itself where it has none."""
    middle = np.repeat(vertices[faces].mean(axis=1), 3, axis=0)
    count = np.bincount(faces.ravel(), minlength=len(vertices))
    total = _sums(faces.ravel(), middle, len(vertices))
    return np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], vertices)


def bridge_pinches(vertices: Float, faces: Int, grid: PointGrid, *, support_distance: float) -> Int:
    """Triangles (T, 3) that join pieces of the mesh which touch in no more than a vertex, one for two pieces.

    Without it the pieces come apart where pinches are split. A triangle lies between two border edges at the vertex,
    one of each piece. It has data within `support_distance` (m), agrees with the normals at its corners, leaves the
    mesh manifold and oriented, and crosses no face. Those with short sides go first.
    """
    triangles, joined = _between_pieces(vertices, faces)
    sides = np.linalg.norm(vertices[triangles] - vertices[np.roll(triangles, 1, axis=1)], axis=2).max(axis=1)
    area = area_vectors(vertices, triangles)
    agreement = np.einsum("tki,ti->tk", vertex_normals(vertices, faces)[triangles], unit(area)).min(axis=1)
    good = (agreement > _LEAST_AGREEMENT) & (np.linalg.norm(area, axis=1) > _LEAST_SHAPE * sides**2)
    half_edges = _half_edges(triangles) @ [len(vertices), 1]
    good &= ~np.isin(half_edges, _half_edges(faces) @ [len(vertices), 1]).any(axis=1)
    good &= supported(vertices, triangles, grid, support_distance)
    rows = np.flatnonzero(good)
    rows = rows[np.lexsort((*triangles[rows].T, sides[rows]))]
    triangles, joined, half_edges = triangles[rows], joined[rows], half_edges[rows]
    mesh = np.concatenate([faces, triangles])
    pairs = crossing_pairs(vertices, mesh, among=np.arange(len(mesh)) >= len(faces)) - len(faces)
    return triangles[_linking(joined, half_edges, pairs)]


def _linking(joined: Int, half_edges: Int, crossing: Int) -> Mask:
    """Mask (T,) of the triangles to take, one after the other, each for two pieces (T, 2) that are not linked yet.

    half_edges: (T, 3) as numbers; none is taken twice. crossing: (P, 2) triangles that cross, below 0 for a face.
    """
    taken: set[int] = set()
    chosen = np.zeros(len(joined), bool)
    crossed: list[set[int]] = [set() for _ in joined]
    for one, other in crossing.tolist():
        crossed[max(one, other)].add(min(one, other))
    group = np.arange(joined.max(initial=-1) + 1)
    for number, (pieces, own) in enumerate(zip(joined, half_edges.tolist(), strict=True)):
        one, other = group[pieces]
        blocked = any(earlier < 0 or chosen[earlier] for earlier in crossed[number])
        if one != other and not blocked and taken.isdisjoint(own):
            chosen[number] = True
            taken.update(own)
            group[group == other] = one
    return chosen


def _between_pieces(vertices: Float, faces: Int) -> tuple[Int, Int]:
    """Triangles (T, 3) between border edges of two pieces at one vertex, and the two pieces (T, 2)."""
    one, other = _neighbors_at_edges(edges_of(faces, len(vertices))[1])
    piece, _ = linked(one // 3, other // 3, len(faces))
    is_border = is_open(faces, len(vertices))
    border, own = _half_edges(faces)[is_border], piece[np.nonzero(is_border)[0]]
    order = np.argsort(border[:, 0], kind="stable")
    first, last = (np.searchsorted(border[order, 0], border[:, 1], side=side) for side in ("left", "right"))
    arriving = np.repeat(np.arange(len(border)), last - first)
    place = np.arange(len(arriving)) - np.repeat(np.cumsum(last - first) - (last - first), last - first)
    leaving = order[first[arriving] + place]
    apart = (own[arriving] != own[leaving]) & (border[arriving, 0] != border[leaving, 1])
    arriving, leaving = arriving[apart], leaving[apart]
    triangles = np.column_stack([border[leaving, 1], border[arriving, 1], border[arriving, 0]])
    return triangles, np.column_stack([own[arriving], own[leaving]])


def border_half_edges(faces: Int, count: int) -> Int:
    """The half-edges (B, 2) of faces (F, 3) over `count` vertices that no face has in the other direction."""
    return np.asarray(_half_edges(faces)[is_open(faces, count)])


def _half_edges(faces: Int) -> Int:
    """The two vertices (F, 3, 2) of the half-edge after each corner."""
    return np.stack([faces, faces[:, [1, 2, 0]]], axis=2)


def extend_borders(
    vertices: Float,
    faces: Int,
    normals: Float,
    points: Float,
    neighbors: NDArray[np.int32],
    owner: Int,
    *,
    limit: float,
) -> Float:
    """The vertices (V, 3) with those on open borders moved outwards in their tangent plane, to where their data ends.

    Neurons stand amid their data, so the mesh would end half a cell too early. normals: (V, 3), zero at a crease
    vertex. points: (N, 3) m. neighbors: (N, m) points around each, itself for none. owner: (N,) the vertex that each
    point belongs to, or -1. A vertex moves by the 98 % quantile of its points' offsets in the outward direction, and by
    the gap between points in that direction: where the surface ends it does so before one gap more, and in a shadow it
    goes on. It moves at most by `limit` (m); with fewer than three points it stays. A crease vertex
    goes along its crease as far as its neighbors on the border go.
    """
    is_border = is_open(faces, len(vertices))
    border = _half_edges(faces)[is_border]
    outward = _outward_directions(vertices, faces, normals, is_border)
    on_border = (outward != 0).any(axis=1)
    rows = np.flatnonzero((owner >= 0) & on_border[owner])
    mine = owner[rows]
    offset = np.einsum("ni,ni->n", points[rows] - vertices[mine], outward[mine])
    end, count = _quantiles(offset, mine, _END, len(vertices))
    gap = _gaps(points, neighbors, rows, mine, outward)
    beyond = np.minimum(gap, _FARTHEST_BEYOND * limit)
    length = np.where(count >= 3, np.minimum(np.maximum(end, 0) + beyond, limit), 0)
    step = length[:, None] * outward
    crease, along = _steps_along_creases(border, np.asarray((normals == 0).all(axis=1)), normals, step)
    step[crease] = along
    return np.asarray(vertices + step)


def _gaps(points: Float, neighbors: NDArray[np.int32], rows: Int, owner: Int, direction: Float) -> Float:
    """Median (V,) m over the points `rows` (M,) of each owner of how far the next point along its direction (V, 3) is.

    Neighbors (N, m) that are more than 45 deg aside do not count; 0 where there is none.
    """
    next_one = _next_along(points, neighbors, rows, owner, direction)
    known = np.isfinite(next_one)
    return _quantiles(next_one[known], owner[known], 0.5, len(direction))[0]


@kernel
def _next_along(points, neighbors, rows, owner, direction):  # type: ignore[no-untyped-def]
    """How far (M,) the nearest neighbor of each of the rows is along the direction of its owner, either way."""
    result = np.full(len(rows), np.inf)
    for i in range(len(rows)):
        way = direction[owner[i]]
        for j in neighbors[rows[i]]:
            along = square = 0.0
            for axis in range(3):
                step = points[j, axis] - points[rows[i], axis]
                along += step * way[axis]
                square += step * step
            if square < 2.0 * along * along:
                result[i] = min(result[i], abs(along))
    return result


# Neighbors whose normals spread less than this, as an eigenvalue of the mean of n n^T, share one plane: about 25 deg.
_ONE_PLANE = 0.05


def _steps_along_creases(border: Int, crease: Mask, normals: Float, step: Float) -> tuple[Int, Float]:
    """The crease vertices (C,) on the border, and for each the mean step (C, 3) of its neighbors there.

    Of the mean only that counts which keeps to the planes of all these neighbors.
    """
    links = np.concatenate([border, border[:, ::-1]])
    links = links[crease[links[:, 0]]]
    vertex, own = np.unique(links[:, 0], return_inverse=True)
    own, count = own.reshape(-1), len(vertex)
    neighbors = np.bincount(own, minlength=count)[:, None]
    mean = _sums(own, step[links[:, 1]], count) / neighbors
    around = normals[links[:, 1]]
    products = np.einsum("ni,nj->nij", around, around).reshape(-1, 9)
    planes = (_sums(own, products, count) / neighbors).reshape(-1, 3, 3)
    value, axes = np.linalg.eigh(planes)
    along = np.einsum("vij,vi->vj", axes, mean) * (value < _ONE_PLANE)
    return vertex, np.asarray(np.einsum("vij,vj->vi", axes, along))


def _outward_directions(vertices: Float, faces: Int, normals: Float, is_border: Mask) -> Float:
    """Unit vectors (V, 3) off the surface in the tangent plane of each border vertex; zero for others.

    is_border: (F, 3) of the half-edges.
    """
    begin, end = _half_edges(faces)[is_border].T
    # As long as the edge, so that a long side counts for more.
    away = np.cross(vertices[end] - vertices[begin], unit(area_vectors(vertices, faces[np.nonzero(is_border)[0]])))
    both = np.concatenate([begin, end])
    total = _sums(both, np.tile(away, (2, 1)), len(vertices))
    total -= np.einsum("vi,vi->v", total, normals)[:, None] * normals
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray(np.where(length > 1e-9, total / np.maximum(length, 1e-9), 0.0))


def _quantiles(value: Float, group: Int, quantile: float, count: int) -> tuple[Float, Int]:
    """The linear quantile (count,) of the values (N,) of each group, 0 for an empty one, and the sizes (count,)."""
    order = np.lexsort((value, group))
    ordered = np.append(value[order], 0.0)
    size = np.bincount(group, minlength=count)
    place = np.cumsum(size) - size + quantile * np.maximum(size - 1, 0)
    low = np.minimum(np.floor(place).astype(np.int64), len(value))
    high = np.minimum(np.ceil(place).astype(np.int64), len(value))
    result = ordered[low] + (place - low) * (ordered[high] - ordered[low])
    return np.where(size > 0, result, 0.0), size


def large_pieces(vertices: Float, faces: Int, *, least_area: float, least_faces: int = 1) -> Mask:
    """Mask (F,) of the faces in pieces of so many faces and so much area (m^2); a piece hangs together by edges."""
    if not len(faces):
        return np.zeros(0, bool)
    one, other = _neighbors_at_edges(edges_of(faces, len(vertices))[1])
    piece, _ = linked(one // 3, other // 3, len(faces))
    area = np.bincount(piece, 0.5 * np.linalg.norm(area_vectors(vertices, faces), axis=1))
    return np.asarray(((area >= least_area) & (np.bincount(piece) >= least_faces))[piece])


def remove_crossings(
    vertices: Float, faces: Int, home: Float, *, among: Mask | None = None, workers: int = 1
) -> tuple[Float, Mask]:
    """Vertices (V, 3) and a mask (F,) of the faces to keep, such that no face crosses another one.

    Vertices that were moved for looks go back towards `home` (V, 3), where they came from, as far as it takes; of faces
    that cross even so, as few as possible are dropped, later ones first. among: (F,) faces that may cross another one.
    """
    vertices = vertices.copy()
    pairs = crossing_pairs(vertices, faces, among=among, workers=workers)
    for share in _KEPT_OF_WAY:
        moved = np.zeros(len(vertices), bool)
        moved[faces[pairs].ravel()] = True
        moved &= (vertices != home).any(axis=1)
        if not moved.any():
            break
        vertices[moved] = home[moved] + share * (vertices[moved] - home[moved])
        touched: Mask = np.asarray(moved[faces].any(axis=1))
        settled = pairs[~touched[pairs].any(axis=1)]
        pairs = np.concatenate([settled, crossing_pairs(vertices, faces, among=touched, workers=workers)])
    keep = np.ones(len(faces), bool)
    keep[_cover(pairs)] = False
    return vertices, keep


def _cover(pairs: Int) -> list[int]:
    """Members that together are in every pair, each time the one in the most pairs, of equals the largest."""
    covering = []
    while len(pairs):
        member, count = np.unique(pairs, return_counts=True)
        chosen = int(member[count == count.max()].max())
        covering.append(chosen)
        pairs = pairs[(pairs != chosen).all(axis=1)]
    return covering


def fill_small_loops(
    vertices: Float,
    faces: Int,
    grid: PointGrid,
    *,
    support_distance: float,
    max_edges: int = 8,
) -> Int:
    """Triangles (T, 3) that close the holes with at most `max_edges` edges, where data supports them.

    Each hole gets the triangulation of least area (Barequet and Sharir, "Filling gaps in the boundary of a polyhedron",
    1995, section 3.2), of those whose new edges the mesh does not have yet. A hole stays open where data lies farther
    than `support_distance` (m) from one of its triangles, where the mesh would not stay manifold and oriented, where it
    would get a lid of more than one triangle or its own back, or where a new face would cross another one.
    """
    normals = vertex_normals(vertices, faces)
    loops, size = _small_loops(vertices, faces, normals, max_edges)
    edges, _ = edges_of(faces, len(vertices))
    triangles, loop = _least_area(np.ascontiguousarray(vertices), loops, size, edges @ [len(vertices), 1])
    support = np.bincount(loop, supported(vertices, triangles, grid, support_distance), len(loops))
    accepted = support == size - 2
    agreement = _agreement(vertices, triangles, loop, len(loops), normals)
    accepted &= (np.abs(agreement) > _LEAST_AGREEMENT) | (size == 3) | _is_slit(vertices, triangles, loop, loops)
    # What lies on the back of its surroundings closes a fold there; around a piece hardly larger it would be its back.
    accepted &= (agreement > 0) | ((size <= _FEW_EDGES) & ~_around_small_pieces(vertices, faces, loops))
    accepted &= _keeps_manifold(faces, triangles, loop, size, accepted, len(vertices))
    while True:
        chosen = accepted[loop]
        mesh = np.concatenate([faces, triangles[chosen]])
        crossing = crossing_pairs(vertices, mesh, among=np.arange(len(mesh)) >= len(faces))
        crossing = crossing[crossing >= len(faces)] - len(faces)
        if not len(crossing):
            return np.asarray(triangles[chosen])
        accepted[loop[chosen][crossing]] = False


def _agreement(vertices: Float, triangles: Int, loop: Int, count: int, normals: Float) -> Float:
    """Cosine (count,) of the angle between the triangles of each loop and the surface around, mean over their area.

    loop: (T,) of each triangle. normals: (V, 3); the surface around is that at the corners of the triangles. A lid on
    the end of a column has about 0.
    """
    area = area_vectors(vertices, triangles)
    along = np.einsum("ti,tki->t", area, normals[triangles]) / 3
    size = np.bincount(loop, np.linalg.norm(area, axis=1), count)
    return np.asarray(np.bincount(loop, along, count) / np.maximum(size, 1e-300))


def _is_slit(vertices: Float, triangles: Int, loop: Int, loops: Int) -> Mask:
    """Mask (L,) of the loops (L, E) so narrow for their length that it says nothing which way their triangles look."""
    area = np.bincount(loop, np.linalg.norm(area_vectors(vertices, triangles), axis=1) / 2, len(loops))
    following = np.where(np.roll(loops, -1, axis=1) < 0, loops[:, :1], np.roll(loops, -1, axis=1))
    sides = np.linalg.norm(vertices[following] - vertices[loops], axis=2)
    return np.asarray(area < _SLIT * np.sum(sides, axis=1, where=loops >= 0) ** 2)


def _around_small_pieces(vertices: Float, faces: Int, loops: Int) -> Mask:
    """Mask (L,) of the loops around pieces of the mesh with fewer than 32 faces."""
    large = large_pieces(vertices, faces, least_area=0.0, least_faces=_SMALL_PIECE)
    in_small = np.zeros(len(vertices), bool)
    in_small[faces[~large]] = True
    return np.asarray(in_small[loops[:, 0]])


def _small_loops(vertices: Float, faces: Int, normals: Float, max_edges: int) -> tuple[Int, Int]:
    """Holes of at most `max_edges` edges: vertices (L, max_edges) in the order of new faces, and how many (L,)."""
    half_edges = border_half_edges(faces, len(vertices))[:, ::-1]
    half_edges = np.ascontiguousarray(half_edges[np.lexsort((half_edges[:, 1], half_edges[:, 0]))])
    begin = np.concatenate([[0], np.cumsum(np.bincount(half_edges[:, 0], minlength=len(vertices)))])
    return tuple(_walk_loops(np.ascontiguousarray(vertices), normals, half_edges, begin, max_edges))


def _sums(group: Int, vectors: Float, count: int) -> Float:
    """The sum (count, D) of the vectors (N, D) of each group (N,)."""
    total = np.zeros((count, vectors.shape[1]))
    for axis in range(vectors.shape[1]):
        total[:, axis] = np.bincount(group, vectors[:, axis], count)
    return total


@kernel
def _walk_loops(vertices, normals, half_edges, begin, max_edges):  # type: ignore[no-untyped-def]
    loops = np.full((len(half_edges) // 3 + 1, max_edges), -1, np.int64)
    sizes = np.zeros(len(loops), np.int64)
    found = 0
    walked = np.zeros(len(half_edges), np.bool_)
    for start in range(len(half_edges)):
        if walked[start]:
            continue
        size, edge = 0, start
        while size < max_edges:
            loops[found, size] = half_edges[edge, 0]
            size += 1
            edge = _next_half_edge(vertices, normals, half_edges, begin, edge)
            if edge == start:
                break
        if edge != start or size < 3 or _repeats(loops[found, :size]):
            continue
        sizes[found] = size
        found += 1
        for _ in range(size):
            walked[edge] = True
            edge = _next_half_edge(vertices, normals, half_edges, begin, edge)
    return loops[:found], sizes[:found]


@inner_kernel
def _repeats(values):  # type: ignore[no-untyped-def]
    for i in range(len(values)):
        for j in range(i):
            if values[i] == values[j]:
                return True
    return False


@inner_kernel
def _next_half_edge(vertices, normals, half_edges, begin, edge):  # type: ignore[no-untyped-def]
    """The half-edge that bounds the same gap: at a pinched vertex, the next one clockwise from the one arrived by."""
    came_from, vertex = half_edges[edge, 0], half_edges[edge, 1]
    first, last = begin[vertex], begin[vertex + 1]
    if last - first == 1:
        return first
    best, least = first, np.inf
    for candidate in range(first, last):
        angle = _turn(vertices, normals[vertex], vertex, half_edges[candidate, 1], came_from)
        if angle < least:
            best, least = candidate, angle
    return best


@kernel
def _turn(vertices, normal, vertex, one, other):  # type: ignore[no-untyped-def]
    """Angle counterclockwise around the normal from one neighbor of a vertex to another one, in (0, 2 pi]."""
    x, y, z = vertices[vertex, 0], vertices[vertex, 1], vertices[vertex, 2]
    ux, uy, uz = vertices[one, 0] - x, vertices[one, 1] - y, vertices[one, 2] - z
    vx, vy, vz = vertices[other, 0] - x, vertices[other, 1] - y, vertices[other, 2] - z
    length = max(math.sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]), 1e-300)
    nx, ny, nz = normal[0] / length, normal[1] / length, normal[2] / length
    un = ux * nx + uy * ny + uz * nz
    vn = vx * nx + vy * ny + vz * nz
    cosine = ux * vx + uy * vy + uz * vz - un * vn
    sine = nx * (uy * vz - uz * vy) + ny * (uz * vx - ux * vz) + nz * (ux * vy - uy * vx)
    angle = math.atan2(sine, cosine) % (2.0 * math.pi)
    return angle if angle > 0 else 2.0 * math.pi


@kernel
def _least_area(vertices, loops, sizes, edges):  # type: ignore[no-untyped-def]
    """Triangles (T, 3) of all loops, triangulated with the least area, and the loop (T,) of each.

    edges: ascending numbers of those that the mesh has, smaller vertex times V plus larger one; none is made again
    where that can be helped.
    """
    total = 0
    for size in sizes:
        total += size - 2
    triangles, loop_of = np.empty((total, 3), np.int64), np.empty(total, np.int64)
    count = 0
    for loop in range(len(loops)):
        size, corners = sizes[loop], loops[loop]
        area, cut = np.zeros((size, size)), np.zeros((size, size), np.int64)
        for gap in range(2, size):
            for i in range(size - gap):
                j = i + gap
                area[i, j] = np.inf
                for k in range(i + 1, j):
                    value = area[i, k] + area[k, j] + _area(vertices, corners[i], corners[k], corners[j])
                    if value < area[i, j]:
                        area[i, j], cut[i, j] = value, k
                if gap < size - 1:
                    low, high = min(corners[i], corners[j]), max(corners[i], corners[j])
                    if _is_among(edges, low * len(vertices) + high):
                        area[i, j] += _TAKEN
        waiting = [(0, size - 1)]
        while len(waiting) > 0:
            i, j = waiting.pop()
            if j - i < 2:
                continue
            k = cut[i, j]
            triangles[count, 0], triangles[count, 1], triangles[count, 2] = corners[i], corners[k], corners[j]
            loop_of[count] = loop
            count += 1
            waiting.append((i, k))
            waiting.append((k, j))
    return triangles, loop_of


@inner_kernel
def _is_among(numbers, wanted):  # type: ignore[no-untyped-def]
    """Whether a number is one of these (N,), which ascend."""
    begin, end = 0, len(numbers)
    while begin < end:
        middle = (begin + end) // 2
        if numbers[middle] == wanted:
            return True
        if numbers[middle] < wanted:
            begin = middle + 1
        else:
            end = middle
    return False


@inner_kernel
def _area(vertices, a, b, c):  # type: ignore[no-untyped-def]
    x, y, z = area_vector(vertices, a, b, c)
    return 0.5 * math.sqrt(x * x + y * y + z * z)


def _keeps_manifold(faces: Int, triangles: Int, loop: Int, size: Int, accepted: Mask, count: int) -> Mask:
    """Mask (L,) of the accepted loops whose triangles use no half-edge that a face or an earlier loop uses."""
    both = np.concatenate([faces, triangles])
    half_edge = half_edge_numbers(both, edges_of(both, count)[1])
    used = np.zeros(2 * both.size, bool)
    used[half_edge[: len(faces)]] = True
    begin = 3 * np.concatenate([[0], np.cumsum(size - 2)])
    return np.asarray(_take_half_edges(half_edge[len(faces) :].reshape(-1), begin, accepted, used))


@kernel
def _take_half_edges(half_edges, begin, accepted, used):  # type: ignore[no-untyped-def]
    """Which of the accepted loops, one after the other, get all their half-edges [begin[loop], begin[loop + 1])."""
    good = np.zeros(len(accepted), np.bool_)
    for loop in range(len(accepted)):
        if not accepted[loop]:
            continue
        taken = begin[loop]
        while taken < begin[loop + 1] and not used[half_edges[taken]]:
            used[half_edges[taken]] = True
            taken += 1
        good[loop] = taken == begin[loop + 1]
        if not good[loop]:
            used[half_edges[begin[loop] : taken]] = False
    return good
