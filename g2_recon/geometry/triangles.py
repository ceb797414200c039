# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Areas and normals of triangles, and of vertices amid them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2_recon.kernels import kernel

Float = NDArray[np.float64]
Int = NDArray[np.int64]

_NO_LENGTH = 1e-300  # below it a vector has no direction


@kernel
def area_vector(vertices, a, b, c):  # type: ignore[no-untyped-def]
    """Normal (x, y, z) of a triangle with vertices a, b, c, as long as twice its area, in m^2."""
    ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
    vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


def area_vectors(vertices: Float, faces: Int) -> Float:
    """Normals (F, 3) of faces (F, 3) over vertices (V, 3) in metres, as long as twice their area, in m^2."""
    return np.asarray(_area_vectors(_contiguous(vertices, np.float64), _contiguous(faces, np.int64)))


def vertex_normals(vertices: Float, faces: Int) -> Float:
    """Unit normals (V, 3), means over the faces (F, 3) at each vertex by area; zero where there is none."""
    faces = _contiguous(faces, np.int64)
    return unit(np.asarray(_vertex_sums(area_vectors(vertices, faces), faces, len(vertices))))


def unit(vectors: Float) -> Float:
    """Vectors (N, 3) at length one; what has no length stays zero."""
    x, y, z = vectors.T
    length = np.sqrt(x * x + y * y + z * z)
    return np.asarray(vectors / np.maximum(length, _NO_LENGTH)[:, None])


def _contiguous(rows: NDArray[Any], dtype: type) -> NDArray[Any]:
    return np.ascontiguousarray(rows, dtype).reshape(-1, 3)


@kernel
def _area_vectors(vertices, faces):  # type: ignore[no-untyped-def]
    vectors = np.empty((len(faces), 3))
    for face in range(len(faces)):
        vectors[face, 0], vectors[face, 1], vectors[face, 2] = area_vector(
            vertices, faces[face, 0], faces[face, 1], faces[face, 2]
        )
    return vectors


@kernel
def _vertex_sums(vectors, faces, count):  # type: ignore[no-untyped-def]
    """The sum (count, 3) over the faces at each vertex of a vector (F, 3) each."""
    sums = np.zeros((count, 3))
    for face in range(len(faces)):
        for corner in range(3):
            for axis in range(3):
                sums[faces[face, corner], axis] += vectors[face, axis]
    return sums
