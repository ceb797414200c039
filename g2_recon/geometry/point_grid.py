# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Points in the cells of a hash grid, to find those near a place in time that does not depend on their number."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError
from g2_recon.geometry.sorting import sort_by_counting
from g2_recon.kernels import ZERO, inner_kernel, kernel

Float = NDArray[np.float64]
Int = NDArray[np.int64]

_FEWEST_SLOTS = 64  # a power of two, and so are all table sizes
_ROUNDING = 1e-6  # of squared distances of cells, also where coordinates are those of UTM


class PointGrid(NamedTuple):
    """Points sorted by cubic cells; a tuple of arrays, so that kernels take it as it is.

    points: (N, 3) m, sorted by cell. order: (N,) the number of each before sorting. begin: (C + 1,) where the points of
    a cell begin. cells: (C, 3) coordinates of the occupied cells. slots: (S,) hash table of cell numbers, -1 if empty.
    origin: (3,) m, corner of cell (0, 0, 0). cell: edge of a cell in m.
    """

    points: Float
    order: Int
    begin: Int
    cells: Int
    slots: NDArray[np.int32]
    origin: Float
    cell: float


def point_grid(points: Float, *, cell: float) -> PointGrid:
    """Sort points (N, 3) in metres into cells of the given edge, in time and memory proportional to N.

    To ask for data within a distance, cells of distance / sqrt(3) are fastest: any point of a cell is then near enough.
    Raises InputError where the points are not finite or a cell has no size.
    """
    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise InputError("some points are not finite", where="point grid", advice="remove them first")
    if not (math.isfinite(cell) and cell > 0):
        raise InputError(f"a cell edge of {cell} m", where="point grid", advice="give a length above 0")
    # Axis by axis, and by take: several times as fast as over rows of three.
    origin = np.array([points[:, axis].min() for axis in range(3)]) if len(points) else np.zeros(3)
    number, cells, slots = _number_cells(points, origin, float(cell))
    order, begin = sort_by_counting(number, len(cells))
    return PointGrid(points.take(order, axis=0), order, begin, cells, slots, origin, float(cell))


@inner_kernel
def _slot(i, j, k, slots):  # type: ignore[no-untyped-def]
    # By multiplication, of which the middle bits are the best mixed: Knuth, The Art of Computer Programming, vol. 3,
    # section 6.4; odd factors without a pattern, one an axis.
    value = i * 0x1E3779B97F4A7C15 + j * 0x2545F4914F6CDD1D + k * 0x369DEA0F31A53F85
    return (value >> 32) & (len(slots) - 1)


@kernel
def _number_cells(points, origin, cell):  # type: ignore[no-untyped-def]
    """The number (N,) of the cell of each point, in order of first occurrence, the cells (C, 3), and the table of them.

    The table grows with the cells, so that it stays small where a cell has many points, and is at most an eighth full,
    so that a search ends at once.
    """
    number = np.empty(len(points), np.int32)
    cells: Int = np.empty((_FEWEST_SLOTS // 8, 3), np.int64)
    slots = np.full(_FEWEST_SLOTS, -1, np.int32)
    count = 0
    for row in range(len(points)):
        i = math.floor((points[row, 0] - origin[0]) / cell)
        j = math.floor((points[row, 1] - origin[1]) / cell)
        k = math.floor((points[row, 2] - origin[2]) / cell)
        slot = _slot(i, j, k, slots)
        while slots[slot] >= 0:
            known = slots[slot]
            if cells[known, 0] == i and cells[known, 1] == j and cells[known, 2] == k:
                break
            slot = (slot + 1) & (len(slots) - 1)
        if slots[slot] < 0:
            slots[slot] = count
            cells[count, 0], cells[count, 1], cells[count, 2] = i, j, k
            count += 1
            number[row] = count - 1
            if count == len(cells):
                cells = np.concatenate((cells, np.empty_like(cells)))
                slots = _table(cells, count, 2 * len(slots))
        else:
            number[row] = slots[slot]
    return number, cells[:count].copy(), slots


@inner_kernel
def _table(cells, count, size):  # type: ignore[no-untyped-def]
    """A hash table of the first cells."""
    slots = np.full(size, -1, np.int32)
    for number in range(count):
        slot = _slot(cells[number, 0], cells[number, 1], cells[number, 2], slots)
        while slots[slot] >= 0:
            slot = (slot + 1) & (size - 1)
        slots[slot] = number
    return slots


@kernel
def points_in_cell(grid, i, j, k):  # type: ignore[no-untyped-def]
    """Begin and end, in grid.points, of the points in the cell (i, j, k)."""
    slot = _slot(i, j, k, grid.slots)
    while grid.slots[slot] >= 0:
        number = grid.slots[slot]
        if grid.cells[number, 0] == i and grid.cells[number, 1] == j and grid.cells[number, 2] == k:
            return grid.begin[number], grid.begin[number + 1]
        slot = (slot + 1) & (len(grid.slots) - 1)
    return 0, 0


@inner_kernel
def cell_of(grid, x, y, z):  # type: ignore[no-untyped-def]
    """The cell of a place in metres."""
    return (
        math.floor((x - grid.origin[0]) / grid.cell),
        math.floor((y - grid.origin[1]) / grid.cell),
        math.floor((z - grid.origin[2]) / grid.cell),
    )


@kernel
def has_point_near(grid, x, y, z, distance):  # type: ignore[no-untyped-def]
    """Whether a point lies within `distance` metres of the place (x, y, z)."""
    i, j, k = cell_of(grid, x, y, z)
    if grid.cell * 1.7320508 <= distance:
        begin, end = points_in_cell(grid, i, j, k)
        if end > begin:
            return True
    rings = math.ceil(distance / grid.cell)
    for di in range(-rings, rings + 1):
        for dj in range(-rings, rings + 1):
            for dk in range(-rings, rings + 1):
                if _gap(grid, i + di, j + dj, k + dk, x, y, z) > distance * distance:
                    continue
                begin, end = points_in_cell(grid, i + di, j + dj, k + dk)
                for row in range(begin, end):
                    if _squared_distance(grid, row, x, y, z) <= distance * distance:
                        return True
    return False


@kernel
def nearest_point(grid, x, y, z, distance):  # type: ignore[no-untyped-def]
    """Number, before sorting, of the point nearest to the place (x, y, z) within `distance` metres; -1 for none."""
    i, j, k = cell_of(grid, x, y, z)
    nearest, least = _nearer_in_cell(grid, i, j, k, x, y, z, ZERO - 1, distance * distance)
    rings = math.ceil(distance / grid.cell)
    for di in range(-rings, rings + 1):
        for dj in range(-rings, rings + 1):
            for dk in range(-rings, rings + 1):
                if (di == 0 and dj == 0 and dk == 0) or _gap(grid, i + di, j + dj, k + dk, x, y, z) > least:
                    continue
                nearest, least = _nearer_in_cell(grid, i + di, j + dj, k + dk, x, y, z, nearest, least)
    return nearest


@inner_kernel
def _nearer_in_cell(grid, i, j, k, x, y, z, nearest, least):  # type: ignore[no-untyped-def]
    """The point nearest to a place, and its squared distance: one of the cell (i, j, k), or the nearest before."""
    begin, end = points_in_cell(grid, i, j, k)
    for row in range(begin, end):
        square = _squared_distance(grid, row, x, y, z)
        if square < least or (square == least and (nearest < 0 or grid.order[row] < nearest)):
            nearest, least = grid.order[row], square
    return nearest, least


@inner_kernel
def _squared_distance(grid, row, x, y, z):  # type: ignore[no-untyped-def]
    dx, dy, dz = grid.points[row, 0] - x, grid.points[row, 1] - y, grid.points[row, 2] - z
    return dx * dx + dy * dy + dz * dz


@inner_kernel
def _gap(grid, i, j, k, x, y, z):  # type: ignore[no-untyped-def]
    """Squared distance of a place from the cell (i, j, k), a little less for rounding."""
    low_x, low_y, low_z = grid.origin[0] + i * grid.cell, grid.origin[1] + j * grid.cell, grid.origin[2] + k * grid.cell
    dx = max(low_x - x, x - low_x - grid.cell, 0.0)
    dy = max(low_y - y, y - low_y - grid.cell, 0.0)
    dz = max(low_z - z, z - low_z - grid.cell, 0.0)
    return (1.0 - _ROUNDING) * (dx * dx + dy * dy + dz * dz)
