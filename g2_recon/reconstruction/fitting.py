# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Fit of the curved parts of a mesh to their data: the triangles, not only the neurons, lie amid the points.

Neurons are on the surface; triangles between them cut its bends short. Moving the vertices along their normals until
the points lie evenly on both sides of the triangles halves that error.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.linalg import cg

from g2_recon.geometry.closest import closest_on_mesh
from g2_recon.geometry.edges import edges_of
from g2_recon.geometry.triangles import area_vectors, unit, vertex_normals

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

_ROUNDS = 2
# How much an uneven movement counts beside the squared distances of the points of a vertex, some fifteen: less lets the
# surface follow the noise of single points.
_SMOOTHNESS = 10.0
# Without any point a vertex stays where it is.
_HOLD = 1e-3
_PRECISION = 1e-6


def fit_to_points(vertices: Float, faces: Int, free: Mask, points: Float, *, limit: float, workers: int = 1) -> Float:
    """The vertices (V, 3) with the free ones (V,) moved along their normals, so that the mesh fits the points (N, 3).

    Least squares of the distances of the points from the triangles, as far as these are nearer than `limit` (m), plus
    the unevenness of the movement (its graph Laplacian, squared); in two rounds, as the closest places change.
    """
    touched = free[faces].any(axis=1)
    if not touched.any() or not len(points):
        return vertices
    # One more ring of faces, so that points beyond the free ones have a closest place of their own.
    ring = np.zeros(len(vertices), bool)
    ring[faces[touched]] = True
    around = faces[ring[faces].any(axis=1)]
    unevenness = _laplacian(faces[touched], free)
    vertices = vertices.copy()
    for _ in range(_ROUNDS):
        normals = vertex_normals(vertices, around)
        slopes, distances = _distances(vertices, around, free, normals, points, limit, workers)
        matrix = slopes.T @ slopes + _SMOOTHNESS * (unevenness.T @ unevenness) + _HOLD * eye_array(slopes.shape[1])
        step, _ = cg(matrix.tocsr(), slopes.T @ distances, rtol=_PRECISION)
        vertices[free] += step[:, None] * normals[free]
    return vertices


def _distances(
    vertices: Float, faces: Int, free: Mask, normals: Float, points: Float, limit: float, workers: int
) -> tuple[csr_array, Float]:
    """Signed distances (M,) m of the points above free faces, and how they fall with each free vertex (M, free)."""
    places = closest_on_mesh(points, vertices, faces, limit=limit, workers=workers)
    hit = faces[places.face]
    # Closest to a corner, a point may be anywhere beyond it.
    inside = (places.face >= 0) & free[hit].any(axis=1) & ((places.barycentric > 1e-6).sum(axis=1) >= 2)
    hit, share = hit[inside], places.barycentric[inside]
    normal = unit(area_vectors(vertices, hit))
    distance = np.einsum("mi,mi->m", points[inside] - vertices[hit[:, 0]], normal)
    slope = share * np.einsum("mki,mi->mk", normals[hit], normal)
    number = np.cumsum(free) - 1
    row, corner = np.nonzero(free[hit])
    shape = (len(hit), int(free.sum()))
    return csr_array((slope[row, corner], (row, number[hit[row, corner]])), shape=shape), distance


def _laplacian(faces: Int, free: Mask) -> csr_array:
    """How far each free vertex moves beyond the mean of its neighbors: (free, free); the others stay."""
    edges, _ = edges_of(faces, len(free))
    ends = np.concatenate([edges, edges[:, ::-1]])
    ends = ends[free[ends[:, 0]]]
    number = np.cumsum(free) - 1
    count = int(free.sum())
    neighbors = np.maximum(np.bincount(number[ends[:, 0]], minlength=count), 1)
    both = number[ends[free[ends[:, 1]]]]
    graph = csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))
    return csr_array(eye_array(count) - diags_array(1.0 / neighbors) @ graph)
