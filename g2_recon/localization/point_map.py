# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The global point map that grows as the robot goes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from g2_recon.kernels import inner_kernel, kernel

Float = NDArray[np.float64]

# A table of cells begins with so many places, a power of two, and a place without a cell holds this.
_PLACES, _NOTHING = 1024, -(1 << 63)


class PointMap:
    """Points in the map frame, thinned to a spacing, with nearest-neighbor search near the robot.

    The kd-tree covers the points within `reach` of the place that `focus` was called with last, so that its cost
    follows what the laser can see and not the size of the building.
    """

    def __init__(self, *, spacing: float, reach: float) -> None:
        """`spacing`: m between points at least; `reach`: m around the focus that is searched."""
        self._spacing = spacing
        self._reach = reach
        self._rows = np.empty((1024, 2))
        self._count = 0
        self._local = np.empty((0, 2))
        self._tree = cKDTree(self._local)

    def __len__(self) -> int:
        return self._count

    @property
    def points(self) -> Float:
        """All points (N, 2), in the order in which they were added; not to be written to."""
        return self._rows[: self._count]

    def add(self, points: Float) -> int:
        """Add those of the points (N, 2) that have no map point within the spacing; returns how many were added."""
        first = points[first_in_each_cell(points, self._spacing)]
        fresh = first[self.nearest(first, self._spacing)[1] == np.inf]
        count = self._count + len(fresh)
        if count > len(self._rows):
            grown = np.empty((2 * count, 2))
            grown[: self._count] = self.points
            self._rows = grown
        self._rows[self._count : count] = fresh
        self._count = count
        return len(fresh)

    def focus(self, position: ArrayLike) -> None:
        """Make the points within reach of a position (2,) the ones that `nearest` finds."""
        offset = self.points - np.asarray(position, float)[:2]
        self._local = self.points[np.einsum("ij,ij->i", offset, offset) <= self._reach**2]
        self._tree = cKDTree(self._local, balanced_tree=False, compact_nodes=False)

    def nearest(self, points: Float, max_distance: float) -> tuple[Float, Float]:
        """The map point (N, 2) nearest to each point (N, 2), and its distance (N,) in metres.

        The distance is inf where no map point is nearer than `max_distance`.
        """
        if not len(self._local):
            return np.zeros_like(points), np.full(len(points), np.inf)
        distance, index = self._tree.query(points, distance_upper_bound=max_distance)
        return self._local[np.minimum(index, len(self._local) - 1)], distance


@kernel
def first_in_each_cell(points, size):  # type: ignore[no-untyped-def]
    """Indices, in order, of the first of the points (N, 2) in each square cell of `size` metres."""
    first, found = np.empty(len(points), np.int64), 0
    table = np.full(_PLACES, _NOTHING, np.int64)
    for row in range(len(points)):
        new, table = _taken(table, found, _cell(points[row, 0], points[row, 1], size))
        if new:
            first[found] = row
            found += 1
    return first[:found].copy()


@kernel
def map_of_keyframes(poses, points, kinds, spacing):  # type: ignore[no-untyped-def]
    """The points (N, 2) of keyframes at T_map_laser (K, 3), whose beams are (K, B, 2) and (K, B), thinned to a spacing.

    A beam of kind 0 is no measurement.
    """
    thinned, found = np.empty((_PLACES, 2)), 0
    table = np.full(_PLACES, _NOTHING, np.int64)
    for k in range(len(poses)):
        cos, sin = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        for beam in range(kinds.shape[1]):
            if kinds[k, beam] == 0:
                continue
            x, y = float(points[k, beam, 0]), float(points[k, beam, 1])
            x, y = poses[k, 0] + cos * x - sin * y, poses[k, 1] + sin * x + cos * y
            new, table = _taken(table, found, _cell(x, y, spacing))
            if not new:
                continue
            if found == len(thinned):
                grown = np.empty((2 * found, 2))
                grown[:found] = thinned
                thinned = grown
            thinned[found, 0], thinned[found, 1] = x, y
            found += 1
    return thinned[:found].copy()


@inner_kernel
def _cell(x, y, size):  # type: ignore[no-untyped-def]
    """One number for the cell of a point; it is unique up to 2^31 cells from the origin."""
    return (math.floor(x / size) << 32) ^ (math.floor(y / size) & 0xFFFFFFFF)


@kernel
def _taken(table, count, cell):  # type: ignore[no-untyped-def]
    """Whether a cell is new in a table that holds so many, and the table with it, which may be a larger one."""
    place = _place(table, cell)
    if table[place] == cell:
        return False, table
    table[place] = cell
    if 2 * count < len(table):
        return True, table
    larger = np.full(4 * len(table), _NOTHING, np.int64)
    for known in table:
        if known != _NOTHING:
            larger[_place(larger, known)] = known
    return True, larger


@kernel
def _place(table, cell):  # type: ignore[no-untyped-def]
    """Where a cell is in a table, or would have to be."""
    last = len(table) - 1
    mixed = cell * -7046029254386353131  # 2^64 over the golden ratio: cells beside each other come far apart
    place = (mixed ^ (mixed >> 29)) & last
    while table[place] != _NOTHING and table[place] != cell:
        place = (place + 1) & last
    return place
