# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Points in the cells of a hash grid, to find those near a place in time that does not depend on their number."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from g2_recon.errors import InputError

Float = NDArray[np.float64]
Int = NDArray[np.int64]


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
    slots: Int
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
    origin = points.min(axis=0) if len(points) else np.zeros(3)
    cells = np.floor((points - origin) / cell).astype(np.int64)
    slots = np.full(_table_size(len(points)), -1, np.int64)
    number, count = _number_cells(cells, slots)
    begin = np.zeros(count + 1, np.int64)
    np.cumsum(np.bincount(number, minlength=count), out=begin[1:])
    order = np.argsort(number, kind="stable")
    return PointGrid(
        np.ascontiguousarray(points[order]), order, begin, cells[order[begin[:-1]]], slots, origin, float(cell)
    )


def _table_size(count: int) -> int:
    """A power of two that leaves at least half of a hash table empty."""
    return 1 << (2 * max(count, 8) - 1).bit_length()


@numba.njit(cache=True, nogil=True)
def _slot(i, j, k, slots):  # type: ignore[no-untyped-def]
    # Teschner et al., "Optimized spatial hashing for collision detection of deformable objects", 2003, section 3.1;
    # the shift mixes the high bits into the low ones that the mask keeps.
    value = (i * 73856093) ^ (j * 19349663) ^ (k * 83492791)
    return (value ^ (value >> 15)) & (len(slots) - 1)


@numba.njit(cache=True, nogil=True)
def _number_cells(cells, slots):  # type: ignore[no-untyped-def]
    """The number (N,) of the cell of each row of cells (N, 3), in order of first occurrence, and how many there are."""
    number = np.empty(len(cells), np.int64)
    first = np.empty(len(cells), np.int64)
    count = 0
    for row in range(len(cells)):
        i, j, k = cells[row, 0], cells[row, 1], cells[row, 2]
        slot = _slot(i, j, k, slots)
        while slots[slot] >= 0:
            known = first[slots[slot]]
            if cells[known, 0] == i and cells[known, 1] == j and cells[known, 2] == k:
                break
            slot = (slot + 1) & (len(slots) - 1)
        if slots[slot] < 0:
            slots[slot] = count
            first[count] = row
            count += 1
        number[row] = slots[slot]
    return number, count


@numba.njit(cache=True, nogil=True)
def points_in_cell(grid, i, j, k):  # type: ignore[no-untyped-def]
    """Begin and end, in grid.points, of the points in the cell (i, j, k)."""
    slot = _slot(i, j, k, grid.slots)
    while grid.slots[slot] >= 0:
        number = grid.slots[slot]
        if grid.cells[number, 0] == i and grid.cells[number, 1] == j and grid.cells[number, 2] == k:
            return grid.begin[number], grid.begin[number + 1]
        slot = (slot + 1) & (len(grid.slots) - 1)
    return 0, 0


@numba.njit(cache=True, nogil=True)
def cell_of(grid, x, y, z):  # type: ignore[no-untyped-def]
    """The cell of a place in metres."""
    return (
        math.floor((x - grid.origin[0]) / grid.cell),
        math.floor((y - grid.origin[1]) / grid.cell),
        math.floor((z - grid.origin[2]) / grid.cell),
    )


@numba.njit(cache=True, nogil=True)
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
                begin, end = points_in_cell(grid, i + di, j + dj, k + dk)
                for row in range(begin, end):
                    dx, dy, dz = grid.points[row, 0] - x, grid.points[row, 1] - y, grid.points[row, 2] - z
                    if dx * dx + dy * dy + dz * dz <= distance * distance:
                        return True
    return False


@numba.njit(cache=True, nogil=True)
def nearest_point(grid, x, y, z, distance):  # type: ignore[no-untyped-def]
    """Number, before sorting, of the point nearest to the place (x, y, z) within `distance` metres; -1 for none."""
    i, j, k = cell_of(grid, x, y, z)
    rings = math.ceil(distance / grid.cell)
    nearest, least = -1, distance * distance
    for di in range(-rings, rings + 1):
        for dj in range(-rings, rings + 1):
            for dk in range(-rings, rings + 1):
                begin, end = points_in_cell(grid, i + di, j + dj, k + dk)
                for row in range(begin, end):
                    dx, dy, dz = grid.points[row, 0] - x, grid.points[row, 1] - y, grid.points[row, 2] - z
                    square = dx * dx + dy * dy + dz * dz
                    if square < least or (square == least and (nearest < 0 or grid.order[row] < nearest)):
                        nearest, least = grid.order[row], square
    return nearest
