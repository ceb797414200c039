# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The edges and half-edges of a triangle mesh, numbered in time proportional to its size.

A half-edge is an edge in the direction that a face runs through it; of an edge e, half-edge 2 e leads to the larger
vertex and 2 e + 1 to the smaller one, so that `number ^ 1` runs in the other direction.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g2_recon.kernels import kernel

Int = NDArray[np.int64]
Mask = NDArray[np.bool_]


def edges_of(faces: Int, count: int) -> tuple[Int, Int]:
    """The edges (E, 2) of faces (F, 3) over `count` vertices, and the edge (F, 3) that follows each corner of a face.

    Each edge is named once, smaller vertex first, in ascending order.
    """
    return tuple(_edges_of(np.ascontiguousarray(faces, dtype=np.int64).reshape(-1, 3), count))


def half_edge_numbers(faces: Int, face_edges: Int) -> Int:
    """The half-edge (F, 3) that follows each corner of faces (F, 3) with these edges (F, 3), see edges_of."""
    return 2 * face_edges + (faces > faces[:, [1, 2, 0]])


def is_open(faces: Int, count: int) -> Mask:
    """Mask (F, 3) of the half-edges of faces (F, 3) over `count` vertices that no face has in the other direction."""
    edges, face_edges = edges_of(faces, count)
    half_edge = half_edge_numbers(faces, face_edges)
    used = np.zeros(2 * len(edges), bool)
    used[half_edge] = True
    return np.asarray(~used[half_edge ^ 1])


@kernel
def _edges_of(faces, count):  # type: ignore[no-untyped-def]
    """Half-edges sorted by counting at the smaller vertex, then by insertion among the few that it has."""
    begin = np.zeros(count + 1, np.int64)
    for face in range(len(faces)):
        for corner in range(3):
            begin[min(faces[face, corner], faces[face, (corner + 1) % 3]) + 1] += 1
    for vertex in range(count):
        begin[vertex + 1] += begin[vertex]
    end = begin[:-1].copy()
    larger, half_edge = np.empty(3 * len(faces), np.int64), np.empty(3 * len(faces), np.int64)
    for face in range(len(faces)):
        for corner in range(3):
            one, other = faces[face, corner], faces[face, (corner + 1) % 3]
            low, high = min(one, other), max(one, other)
            place = end[low]
            end[low] += 1
            while place > begin[low] and larger[place - 1] > high:
                larger[place], half_edge[place] = larger[place - 1], half_edge[place - 1]
                place -= 1
            larger[place], half_edge[place] = high, 3 * face + corner
    edges, face_edges = np.empty((len(larger), 2), np.int64), np.empty((len(faces), 3), np.int64)
    size = 0
    for vertex in range(count):
        for place in range(begin[vertex], begin[vertex + 1]):
            if place == begin[vertex] or larger[place] != larger[place - 1]:
                edges[size, 0], edges[size, 1] = vertex, larger[place]
                size += 1
            face_edges[half_edge[place] // 3, half_edge[place] % 3] = size - 1
    return edges[:size].copy(), face_edges
