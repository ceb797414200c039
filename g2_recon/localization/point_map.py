# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The global point map that grows as the robot goes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

Float = NDArray[np.float64]


# How far apart, in metres, two surfaces at a right angle count as: a beam looks for its partner among points of like
# normal, so the two faces of a thin wall stay apart.
_NORMAL_SCALE_M = 0.3


class PointMap:
    """Points with normals in the map frame, thinned to a spacing, with nearest-neighbor search near the robot.

    The kd-tree covers the points within `reach` of the place that `focus` was called with last, so that its cost
    follows what the laser can see and not the size of the building.
    """

    def __init__(self, *, spacing: float, reach: float) -> None:
        """`spacing`: m between points at least; `reach`: m around the focus that is searched."""
        self._spacing = spacing
        self._reach = reach
        self._rows = np.empty((1024, 4))
        self._count = 0
        self._local = np.empty((0, 4))
        self._tree = cKDTree(self._local)

    def __len__(self) -> int:
        return self._count

    @property
    def points(self) -> Float:
        """All points (N, 2), in the order in which they were added; not to be written to."""
        return self._rows[: self._count, :2]

    def add(self, points: Float, normals: Float) -> int:
        """Add those of the points (N, 2) with unit normals (N, 2) that have no like map point within the spacing.

        Returns how many were added.
        """
        first = _first_in_each_cell(_with_normals(points, normals), self._spacing)
        _, _, distance = self.nearest(points[first], normals[first], self._spacing)
        fresh = first[distance == np.inf]
        count = self._count + len(fresh)
        if count > len(self._rows):
            grown = np.empty((2 * count, 4))
            grown[: self._count] = self._rows[: self._count]
            self._rows = grown
        self._rows[self._count : count] = np.hstack([points[fresh], normals[fresh]])
        self._count = count
        return len(fresh)

    def focus(self, position: ArrayLike) -> None:
        """Make the points within reach of a position (2,) the ones that `nearest` finds."""
        offset = self.points - np.asarray(position, float)[:2]
        near = np.einsum("ij,ij->i", offset, offset) <= self._reach**2
        self._local = self._rows[: self._count][near]
        tree_rows = _with_normals(self._local[:, :2], self._local[:, 2:])
        self._tree = cKDTree(tree_rows, balanced_tree=False, compact_nodes=False)

    def nearest(self, points: Float, normals: Float, max_distance: float) -> tuple[Float, Float, Float]:
        """The partner in the map of each point (N, 2) with unit normal (N, 2): point (N, 2), normal (N, 2), distance.

        The distance (N,) in metres grows with the angle between the normals; it is inf where no map point is nearer
        than `max_distance`.
        """
        if not len(self._local):
            return np.zeros_like(points), np.zeros_like(points), np.full(len(points), np.inf)
        distance, index = self._tree.query(_with_normals(points, normals), distance_upper_bound=max_distance)
        found = self._local[np.minimum(index, len(self._local) - 1)]
        return found[:, :2], found[:, 2:], distance


def _with_normals(points: Float, normals: Float) -> Float:
    return np.hstack([points, _NORMAL_SCALE_M * normals])


def _first_in_each_cell(rows: Float, size: float) -> NDArray[np.intp]:
    """Indices, in order, of the first of rows (N, D) in each cubic cell of `size` metres."""
    cell = np.floor(rows / size).astype(np.int64)
    return np.sort(np.unique(cell, axis=0, return_index=True)[1])
