# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The global point map that grows as the robot goes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

Float = NDArray[np.float64]

# The points of so many keyframes are placed and thinned at once: those of a long way would take far more memory than
# the map.
_PLACED_AT_ONCE = 128


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


def first_in_each_cell(points: Float, size: float) -> NDArray[np.intp]:
    """Indices, in order, of the first of the points (N, 2) in each square cell of `size` metres."""
    cell = np.floor(points / size).astype(np.int64)
    # One number a cell, which sorts much faster than two; it is unique up to 2^31 cells from the origin.
    return np.sort(np.unique((cell[:, 0] << 32) ^ (cell[:, 1] & 0xFFFFFFFF), return_index=True)[1])


def map_of_keyframes(poses: Float, points: NDArray[np.float32], kinds: NDArray[np.uint8], spacing: float) -> Float:
    """The points (N, 2) of keyframes at T_map_laser (K, 3), whose beams are (K, B, 2) and (K, B), thinned to a spacing.

    A beam of kind 0 is no measurement.
    """
    clouds: list[Float] = [np.empty((0, 2))]
    for begin in range(0, len(poses), _PLACED_AT_ONCE):
        some = slice(begin, begin + _PLACED_AT_ONCE)
        cloud = _placed(poses[some], points[some], kinds[some])
        clouds.append(cloud[first_in_each_cell(cloud, spacing)])
    joined = np.concatenate(clouds)
    return joined[first_in_each_cell(joined, spacing)]


def _placed(poses: Float, points: NDArray[np.float32], kinds: NDArray[np.uint8]) -> Float:
    """The points (N, 2) of keyframes in the map."""
    keyframe, beam = np.nonzero(kinds)
    x, y = points[keyframe, beam].T.astype(float)
    at_x, at_y, cos, sin = (each[keyframe] for each in (*poses[:, :2].T, np.cos(poses[:, 2]), np.sin(poses[:, 2])))
    return np.column_stack([at_x + cos * x - sin * y, at_y + sin * x + cos * y])
