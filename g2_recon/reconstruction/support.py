# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Which triangles lie on data."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.chunks import in_chunks
from g2_recon.geometry.point_grid import PointGrid, has_point_near, nearest_point
from g2_recon.kernels import inner_kernel, kernel

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Where a triangle is looked at for data: its center, near its corners and near the middle of its sides.
_PLACES = np.array(
    [[1 / 3, 1 / 3, 1 / 3], [0.6, 0.2, 0.2], [0.2, 0.6, 0.2], [0.2, 0.2, 0.6]]
    + [[0.45, 0.45, 0.1], [0.45, 0.1, 0.45], [0.1, 0.45, 0.45]]
)


def supported(vertices: Float, faces: Int, grid: PointGrid, distance: float, workers: int = 1) -> Mask:
    """Mask (F,) of the faces (F, 3) with data within `distance` metres of each of seven places on them.

    It keeps doors and windows open: a submap may span them, the data does not.
    """
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int64)
    mask = np.zeros(len(faces), np.bool_)
    in_chunks(
        lambda begin, end: _fill_supported(vertices, faces, grid, float(distance), begin, end, mask),
        len(faces),
        workers,
    )
    return mask


@inner_kernel
def triangle_supported(vertices, a, b, c, grid, distance):  # type: ignore[no-untyped-def]
    """Whether data lies within `distance` metres of each of the seven places on the triangle of vertices a, b, c."""
    for row in range(len(_PLACES)):
        u, v, w = _PLACES[row, 0], _PLACES[row, 1], _PLACES[row, 2]
        x = u * vertices[a, 0] + v * vertices[b, 0] + w * vertices[c, 0]
        y = u * vertices[a, 1] + v * vertices[b, 1] + w * vertices[c, 1]
        z = u * vertices[a, 2] + v * vertices[b, 2] + w * vertices[c, 2]
        if not has_point_near(grid, x, y, z, distance):
            return False
    return True


@kernel
def _fill_supported(vertices, faces, grid, distance, begin, end, mask):  # type: ignore[no-untyped-def]
    for face in range(begin, end):
        mask[face] = triangle_supported(vertices, faces[face, 0], faces[face, 1], faces[face, 2], grid, distance)


def on_own_data(
    vertices: Float, faces: Int, submap: Int, grid: PointGrid, label: Int, distance: float, workers: int = 1
) -> Mask:
    """Mask (F,) of the faces (F, 3) for which the point nearest to their middle belongs to their own submap.

    Others reach over the data of a neighbor, who covers it as well. submap: (F,). label: (N,) the submap of each point,
    -1 for none. distance: m, farther points do not count.
    """
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    middle = vertices[faces].mean(axis=1)
    mask = np.zeros(len(faces), np.bool_)
    in_chunks(
        lambda begin, end: _on_own_data(middle, submap, grid, label, distance, begin, end, mask), len(faces), workers
    )
    return mask


@kernel
def _on_own_data(middle, submap, grid, label, distance, begin, end, mask):  # type: ignore[no-untyped-def]
    for face in range(begin, end):
        nearest = nearest_point(grid, middle[face, 0], middle[face, 1], middle[face, 2], distance)
        mask[face] = nearest >= 0 and label[nearest] == submap[face]
