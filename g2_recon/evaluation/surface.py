# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""How good a mesh is, measured against the exact surface.

Accuracy and completeness as in Seitz et al., "A comparison and evaluation of multi-view stereo reconstruction
algorithms", 2006; precision, recall and F-score as in Knapitsch et al., "Tanks and Temples", 2017, section 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from g2_recon.errors import InputError
from g2_recon.geometry.closest import TriangleTree, closest_in_tree, triangle_tree
from g2_recon.geometry.intersections import faces_cross
from g2_recon.geometry.mesh import TrueSurface
from g2_recon.kernels import inner_kernel, kernel
from g2_recon.progress import Progress, silent

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

THRESHOLDS_M = (0.05, 0.02)
SAMPLES = 300_000

_SEED_TRUTH, _SEED_MESH = 1, 2
_SEEN_M = 0.10
_WELD_M = 1e-6
_LEVELS = 64


@dataclass(frozen=True, slots=True)
class ThresholdScore:
    """Shares, 0 to 1, at a distance threshold in metres.

    precision: of the mesh nearer than the threshold to the truth; recall: of the truth nearer than it to the mesh;
    f_score: their harmonic mean.
    """

    threshold: float
    precision: float
    recall: float
    f_score: float


@dataclass(frozen=True, slots=True)
class Topology:
    """How the faces of a mesh hang together, once vertices within a micrometre of each other are one.

    vertices, faces: how many there are before that, vertices without a face not counted. boundary_edges: edges of one
    face; loops: connected parts of the boundary. nonmanifold_edges: edges of more than two faces;
    nonmanifold_vertices: those, not on such an edge, where several fans of faces meet. components: connected parts.
    self_intersecting: share, 0 to 1, of the faces that cross or overlap another one, neighbors at an edge apart.
    """

    vertices: int
    faces: int
    boundary_edges: int
    loops: int
    nonmanifold_edges: int
    nonmanifold_vertices: int
    self_intersecting: float
    components: int


@dataclass(frozen=True, slots=True)
class SurfaceScore:
    """A mesh against the truth; lengths in metres.

    accuracy, accuracy_95: distance from the mesh to the truth, mean and 95 % quantile; completeness, completeness_95:
    from the truth to the mesh. normals: mean |cos| of the angle between normals, both ways. at: a score a threshold.
    """

    accuracy: float
    accuracy_95: float
    completeness: float
    completeness_95: float
    normals: float
    at: tuple[ThresholdScore, ...]
    topology: Topology


def score_surface(
    truth: TrueSurface,
    vertices: Float,
    faces: Int,
    *,
    thresholds: Sequence[float] = THRESHOLDS_M,
    samples: int = SAMPLES,
    workers: int = 1,
    progress: Progress = silent,
) -> SurfaceScore:
    """Score a mesh, vertices (V, 3) in metres in the frame of the truth and faces (F, 3), by samples of both.

    Where the truth says what was seen, what of it is farther than 10 cm from all that does not count. thresholds: m.
    The result does not depend on `workers` (0: one a core). Raises InputError where a mesh has no area, names vertices
    that are not there or is not finite, or where nothing of the truth was seen.
    """
    truth_tree, mesh_tree = triangle_tree(truth.vertices, truth.faces), triangle_tree(vertices, faces)
    on_truth, on_truth_normals = sample_surface(truth.vertices, truth.faces, samples, _SEED_TRUTH, where="truth")
    if truth.seen is not None:
        near = cKDTree(truth.seen).query(on_truth, distance_upper_bound=_SEEN_M, workers=workers or -1)[0] < _SEEN_M
        on_truth, on_truth_normals = on_truth[near], on_truth_normals[near]
        if len(on_truth) == 0:
            raise InputError("nothing of it was seen", where="truth", advice="are the hits in its frame, in metres?")
    on_mesh, on_mesh_normals = sample_surface(vertices, faces, samples, _SEED_MESH, where="mesh")
    progress("scoring", 1, 4)
    to_truth = closest_in_tree(on_mesh, truth_tree, workers=workers)
    progress("scoring", 2, 4)
    to_mesh = closest_in_tree(on_truth, mesh_tree, workers=workers)
    progress("scoring", 3, 4)
    truth_normals = _areas_and_normals(truth.vertices, truth.faces)[1][to_truth.face]
    mesh_normals = _areas_and_normals(vertices, faces)[1][to_mesh.face]
    cosines = [np.abs((truth_normals * on_mesh_normals).sum(1)), np.abs((mesh_normals * on_truth_normals).sum(1))]
    score = SurfaceScore(
        accuracy=float(to_truth.distance.mean()),
        accuracy_95=float(np.quantile(to_truth.distance, 0.95)),
        completeness=float(to_mesh.distance.mean()),
        completeness_95=float(np.quantile(to_mesh.distance, 0.95)),
        normals=float((cosines[0].mean() + cosines[1].mean()) / 2),
        at=tuple(_score_at(float(threshold), to_truth.distance, to_mesh.distance) for threshold in thresholds),
        topology=topology(vertices, faces),
    )
    progress("scoring", 4, 4)
    return score


def _score_at(threshold: float, to_truth: Float, to_mesh: Float) -> ThresholdScore:
    precision, recall = float((to_truth < threshold).mean()), float((to_mesh < threshold).mean())
    f_score = 2 * precision * recall / max(precision + recall, 1e-9)
    return ThresholdScore(threshold, precision, recall, f_score)


def sample_surface(vertices: Float, faces: Int, count: int, seed: int, *, where: str = "mesh") -> tuple[Float, Float]:
    """Points (count, 3) spread evenly over a mesh, in metres, and the unit normal (count, 3) at each.

    Raises InputError, with the name `where`, if no face has an area.
    """
    area, normal = _areas_and_normals(vertices, faces)
    total = area.sum()
    if not total > 0:
        raise InputError("no face has an area", where=where, advice="is it in metres?")
    rng = np.random.default_rng(seed)
    face = rng.choice(len(faces), count, p=area / total)
    uv = rng.random((count, 2))
    over = uv.sum(1) > 1
    uv[over] = 1 - uv[over]
    a, b, c = (vertices[faces[face, corner]] for corner in range(3))
    return a + uv[:, :1] * (b - a) + uv[:, 1:] * (c - a), normal[face]


def _areas_and_normals(vertices: Float, faces: Int) -> tuple[Float, Float]:
    """Area (F,) in m^2 and unit normal (F, 3) of each face; the normal of a face without area is zero."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return length / 2, cross / np.maximum(length, 1e-15)[:, None]


def topology(vertices: Float, faces: Int) -> Topology:
    """Count what keeps a mesh, vertices (V, 3) in metres and faces (F, 3), from being a clean closed surface.

    MeshLab counts self-intersecting faces otherwise: also those that only touch and, by rounding, some that lie apart
    in one plane; of those that overlap in one plane, not those that share a vertex or are parallel to a coordinate
    plane.
    """
    welded_vertices, welded = _weld(vertices, faces)
    count = len(welded_vertices)
    begin, end = welded, np.roll(welded, -1, axis=1)
    keys, edge, uses = np.unique(
        np.minimum(begin, end) * count + np.maximum(begin, end), return_inverse=True, return_counts=True
    )
    ends = np.stack([keys // max(count, 1), keys % max(count, 1)], axis=1)
    border = ends[uses == 1]
    return Topology(
        vertices=len(np.unique(faces)),
        faces=len(faces),
        boundary_edges=len(border),
        loops=_parts(border, count),
        nonmanifold_edges=int((uses > 2).sum()),
        nonmanifold_vertices=_pinched(welded, edge.reshape(-1), uses, ends, count),
        self_intersecting=float(crossing_faces(welded_vertices, welded).sum()) / max(len(faces), 1),
        components=_parts(ends, count),
    )


def _weld(vertices: Float, faces: Int) -> tuple[Float, Int]:
    """The mesh with one vertex for all within a micrometre, without the faces that this leaves no area."""
    # + 0.0 makes 0 of -0.
    _, first, number = np.unique(np.round(vertices / _WELD_M) + 0.0, axis=0, return_index=True, return_inverse=True)
    welded = number.reshape(-1)[faces]
    keeps = (welded != np.roll(welded, -1, axis=1)).all(axis=1)
    return vertices[first], np.ascontiguousarray(welded[keeps])


def _parts(pairs: Int, count: int) -> int:
    """How many connected parts the vertices of the edges (E, 2) form."""
    if len(pairs) == 0:
        return 0
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return len(np.unique(connected_components(graph, directed=False)[1][pairs[:, 0]]))


def _pinched(faces: Int, edge: Int, uses: Int, ends: Int, count: int) -> int:
    """How many vertices off the edges of more than two faces have more than one fan of faces.

    edge: (3 F,) the number of the edge from each corner to the next; uses: (E,) its faces; ends: (E, 2) its vertices.
    """
    if len(faces) == 0:
        return 0
    order = np.argsort(edge, kind="stable")
    first = (np.cumsum(uses) - uses)[uses == 2]
    one, other = order[first], order[first + 1]
    following = np.roll(np.arange(faces.size).reshape(-1, 3), -1, axis=1).reshape(-1)
    corners = faces.reshape(-1)
    # Of two faces at an edge, the corners at the same vertex are of one fan.
    same_way = corners[one] == corners[other]
    links = np.concatenate(
        [
            np.stack([one, np.where(same_way, other, following[other])], axis=1),
            np.stack([following[one], np.where(same_way, following[other], other)], axis=1),
        ]
    )
    graph = coo_array((np.ones(len(links), bool), (links[:, 0], links[:, 1])), shape=(faces.size, faces.size))
    fan = connected_components(graph, directed=False)[1]
    _, a_corner = np.unique(fan, return_index=True)
    fans = np.bincount(corners[a_corner], minlength=count)
    fans[ends[uses > 2].reshape(-1)] = 0
    return int((fans > 1).sum())


def crossing_faces(vertices: Float, faces: Int) -> Mask:
    """Mask (F,) of the faces that cross or overlap another one, or are the same; neighbors at an edge are left alone.

    vertices: (V, 3) m, faces: (F, 3), of any size.
    """
    if len(faces) < 2:
        return np.zeros(len(faces), bool)
    vertices, faces = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
    tree = triangle_tree(vertices, faces)
    corners = vertices[faces] - tree.origin
    return np.asarray(_crossing_faces(vertices, faces, corners.min(axis=1), corners.max(axis=1), tree))


@kernel
def _crossing_faces(vertices, faces, low, high, tree: TriangleTree):  # type: ignore[no-untyped-def]
    crosses = np.zeros(len(faces), np.bool_)
    leaves, count = len(tree.boxes) // 2, len(faces)
    nodes = np.empty(_LEVELS, np.int64)
    for face in range(count):
        nodes[0], top = 1, 1
        while top > 0:
            top -= 1
            node = nodes[top]
            if _is_off(tree.boxes[node, :3], tree.boxes[node, 3:], low[face], high[face]):
                continue
            if node < leaves:
                nodes[top], nodes[top + 1] = 2 * node, 2 * node + 1
                top += 2
                continue
            leaf = node - leaves
            for place in range(count * leaf // leaves, count * (leaf + 1) // leaves):
                other = tree.order[place]
                is_told = crosses[face] and crosses[other]
                if other <= face or is_told or _is_off(low[other], high[other], low[face], high[face]):
                    continue
                if _is_same(faces[face], faces[other]) or faces_cross(vertices, faces[face], faces[other]):
                    crosses[face] = crosses[other] = True
    return crosses


@inner_kernel
def _is_off(low, high, other_low, other_high):  # type: ignore[no-untyped-def]
    """Whether two boxes are apart."""
    apart = False
    for axis in range(3):
        apart |= low[axis] > other_high[axis] or other_low[axis] > high[axis]
    return apart


@inner_kernel
def _is_same(one, other):  # type: ignore[no-untyped-def]
    shared = 0
    for i in range(3):
        for j in range(3):
            shared += one[i] == other[j]
    return shared == 3
