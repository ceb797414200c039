# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Which triangles of a mesh cross each other."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.chunks import in_chunks
from g2_recon.geometry.point_grid import PointGrid, cell_of, point_grid, points_in_cell
from g2_recon.geometry.triangles import area_vector
from g2_recon.kernels import inner_kernel, kernel

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

# What two triangles may reach into each other, as a share of their size, and still only touch: rounding.
_TOUCH = 1e-7
# The search is over cells this many times as large as the usual face, for speed; the largest face goes through at most
# so many of them an axis.
_CELL = 2.0
_MOST_CELLS = 16
_CELLS_A_TASK = 2048


def crossing_pairs(vertices: Float, faces: Int, *, among: Mask | None = None, workers: int = 1) -> Int:
    """Pairs (P, 2) of faces that cross or overlap, smaller number first, sorted.

    Faces that share an edge are not looked at; those that share a vertex may touch there.
    vertices: (V, 3) m, faces: (F, 3), most of about one size, which the time depends on.
    among: (F,) only pairs with at least one of these faces. The result does not depend on `workers`.
    """
    if len(faces) < 2:
        return np.empty((0, 2), np.int64)
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int64)
    boxes, cell = _boxes(vertices, faces)
    if among is None:
        among = np.ones(len(faces), bool)
        grid, face = _grid_of_cells(boxes, cell)
    else:
        number = np.flatnonzero(_meets(boxes, cell, _grid_of_cells(boxes[among], cell)[0]))
        grid, face = _grid_of_cells(boxes[number], cell)
        face = number[face]
    parts = in_chunks(
        lambda begin, end: _crossing_pairs(vertices, faces, boxes, cell, among, grid, face, begin, end),
        len(grid.cells),
        workers,
        chunk=_CELLS_A_TASK,
    )
    pairs = np.concatenate([np.empty((0, 2), np.int64), *parts])
    return np.asarray(pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))])


@kernel
def _boxes(vertices, faces):  # type: ignore[no-untyped-def]
    """Low and high corner (F, 6) of the box around each face in metres, and the edge of a cell for the search."""
    boxes = np.empty((len(faces), 6))
    total = largest = 0.0
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        side = 0.0
        for axis in range(3):
            boxes[face, axis] = min(vertices[a, axis], vertices[b, axis], vertices[c, axis])
            boxes[face, axis + 3] = max(vertices[a, axis], vertices[b, axis], vertices[c, axis])
            side = max(side, boxes[face, axis + 3] - boxes[face, axis])
        total += side
        largest = max(largest, side)
    return boxes, max(_CELL * total / len(faces), largest / _MOST_CELLS, 1e-9)


def _grid_of_cells(boxes: Float, cell: float) -> tuple[PointGrid, Int]:
    """A grid with each box (F, 6) in each of the cells that it touches, and the box of each entry, sorted by cell."""
    cells, box = _touched_cells(boxes, cell)
    grid = point_grid(cells, cell=1.0)
    return grid, box[grid.order]


@inner_kernel
def _cell_range(low, high, cell):  # type: ignore[no-untyped-def]
    return range(math.floor(low / cell), math.floor(high / cell) + 1)


@inner_kernel
def _count_touched(boxes, cell):  # type: ignore[no-untyped-def]
    count = 0
    for box in range(len(boxes)):
        touched = 1
        for axis in range(3):
            touched *= len(_cell_range(boxes[box, axis], boxes[box, axis + 3], cell))
        count += touched
    return count


@kernel
def _touched_cells(boxes, cell):  # type: ignore[no-untyped-def]
    count = _count_touched(boxes, cell)
    cells: Float = np.empty((count, 3))
    box_of: Int = np.empty(count, np.int64)
    entry = 0
    for box in range(len(boxes)):
        for i in _cell_range(boxes[box, 0], boxes[box, 3], cell):
            for j in _cell_range(boxes[box, 1], boxes[box, 4], cell):
                for k in _cell_range(boxes[box, 2], boxes[box, 5], cell):
                    cells[entry, 0], cells[entry, 1], cells[entry, 2] = i, j, k
                    box_of[entry] = box
                    entry += 1
    return cells, box_of


@kernel
def _meets(boxes, cell, grid):  # type: ignore[no-untyped-def]
    """Mask (F,) of the boxes that touch a cell of the grid."""
    meets = np.zeros(len(boxes), np.bool_)
    for box in range(len(boxes)):
        for i in _cell_range(boxes[box, 0], boxes[box, 3], cell):
            for j in _cell_range(boxes[box, 1], boxes[box, 4], cell):
                for k in _cell_range(boxes[box, 2], boxes[box, 5], cell):
                    begin, end = points_in_cell(grid, *cell_of(grid, float(i), float(j), float(k)))
                    meets[box] |= end > begin
    return meets


@kernel
def _crossing_pairs(  # type: ignore[no-untyped-def]
    vertices, faces, boxes, cell, among, grid, face, first_cell, last_cell
):
    """Candidates are the faces of one cell of the grid; two that share several cells meet in the first of them.

    boxes: (F, 6). face: (E,) of each entry of the grid.
    """
    pairs: Int = np.empty((64, 2), np.int64)
    count = 0
    for number in range(first_cell, last_cell):
        begin, end = grid.begin[number], grid.begin[number + 1]
        place = (grid.points[begin, 0], grid.points[begin, 1], grid.points[begin, 2])
        for row in range(begin, end):
            one = face[row]
            for column in range(row + 1, end):
                other = face[column]
                if _boxes_apart(boxes, one, other) or not (among[one] or among[other]):
                    continue
                if not _is_first_of_both(boxes, one, other, cell, place):
                    continue
                if faces_cross(vertices, _corners(faces, one), _corners(faces, other)):
                    if count == len(pairs):
                        pairs = np.concatenate((pairs, np.empty_like(pairs)))
                    pairs[count, 0], pairs[count, 1] = one, other
                    count += 1
    return pairs[:count]


@kernel
def _corners(faces, face):  # type: ignore[no-untyped-def]
    return faces[face, 0], faces[face, 1], faces[face, 2]


@inner_kernel
def _boxes_apart(boxes, one, other):  # type: ignore[no-untyped-def]
    apart = False
    for axis in range(3):
        apart |= boxes[one, axis] > boxes[other, axis + 3] or boxes[other, axis] > boxes[one, axis + 3]
    return apart


@inner_kernel
def _is_first_of_both(boxes, one, other, cell, place):  # type: ignore[no-untyped-def]
    """Whether the cell at a place is the first one that both boxes touch."""
    first = True
    for axis in range(3):
        first &= math.floor(max(boxes[one, axis], boxes[other, axis]) / cell) == place[axis]
    return first


@inner_kernel
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
    area_one = area_vector(vertices, one[0], one[1], one[2])
    area_other = area_vector(vertices, other[0], other[1], other[2])
    touch = _TOUCH * max(_size(vertices, one), _size(vertices, other))
    # Before the line, which means little where the planes are almost one, and first of all as most neighbors end here.
    if _separates(vertices, one, other, area_one, touch) or _separates(vertices, other, one, area_other, touch):
        return False
    normal_one, normal_other = _unit(area_one), _unit(area_other)
    if _is_zero(normal_one) or _is_zero(normal_other):
        return False
    height_one = _heights(vertices, one, other, normal_other, touch)
    height_other = _heights(vertices, other, one, normal_one, touch)
    if _on_one_side(height_one) or _on_one_side(height_other):
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


@kernel
def _size(vertices, face):  # type: ignore[no-untyped-def]
    """The longer of two sides of a face, each along its longest axis."""
    size = 0.0
    for axis in range(3):
        first = vertices[face[0], axis]
        size = max(size, abs(vertices[face[1], axis] - first), abs(vertices[face[2], axis] - first))
    return size


@inner_kernel
def _unit(vector):  # type: ignore[no-untyped-def]
    """The vector at length 1; zero if it is zero."""
    x, y, z = vector
    length = math.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return 0.0, 0.0, 0.0
    return x / length, y / length, z / length


@inner_kernel
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


@inner_kernel
def _height(vertices, vertex, other, normal, x, y, z, touch):  # type: ignore[no-untyped-def]
    if vertex == other[0] or vertex == other[1] or vertex == other[2]:
        return 0.0
    height = (
        (vertices[vertex, 0] - x) * normal[0]
        + (vertices[vertex, 1] - y) * normal[1]
        + (vertices[vertex, 2] - z) * normal[2]
    )
    return height if abs(height) > touch else 0.0


@inner_kernel
def _is_zero(values):  # type: ignore[no-untyped-def]
    return values[0] == 0.0 and values[1] == 0.0 and values[2] == 0.0


@inner_kernel
def _on_one_side(height):  # type: ignore[no-untyped-def]
    return (height[0] > 0 and height[1] > 0 and height[2] > 0) or (height[0] < 0 and height[1] < 0 and height[2] < 0)


@inner_kernel
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


@inner_kernel
def _along(vertices, vertex, base, line):  # type: ignore[no-untyped-def]
    return (
        (vertices[vertex, 0] - vertices[base, 0]) * line[0]
        + (vertices[vertex, 1] - vertices[base, 1]) * line[1]
        + (vertices[vertex, 2] - vertices[base, 2]) * line[2]
    )


@inner_kernel
def _separates(vertices, face, other, area, touch):  # type: ignore[no-untyped-def]
    """Whether the upright plane through a side of the face has the face on one side and all of the other one beyond.

    area: normal of the face, of any length.
    """
    for i in range(3):
        a, b, c = face[i], face[(i + 1) % 3], face[(i + 2) % 3]
        dx, dy, dz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        inward = (area[1] * dz - area[2] * dy, area[2] * dx - area[0] * dz, area[0] * dy - area[1] * dx)
        squared = inward[0] * inward[0] + inward[1] * inward[1] + inward[2] * inward[2]
        if squared == 0.0:
            continue
        if _along(vertices, c, a, inward) < 0.0:
            inward = (-inward[0], -inward[1], -inward[2])
        farthest = max(
            _along(vertices, other[0], a, inward),
            _along(vertices, other[1], a, inward),
            _along(vertices, other[2], a, inward),
        )
        if farthest <= 0.0 or farthest * farthest <= touch * touch * squared:
            return True
    return False
