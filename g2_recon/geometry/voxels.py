# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Cubes in space, to thin clouds and to tell where there are enough points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g2_recon.geometry.cloud import Cloud

_BITS = 21
# A sensor that is away along an axis by a smaller share of its distance may be there to either side of a point.
_BY_CHANCE = 0.2


def voxel_numbers(points: NDArray[np.float64], edge: float) -> NDArray[np.int64]:
    """A number (N,) for the cube of `edge` metres that each of the points (N, 3) lies in.

    It is the same for two cubes only where they are more than two million cubes apart.
    """
    cells = np.floor(points / edge).astype(np.int64) & (2**_BITS - 1)
    return np.asarray((cells[:, 0] << 2 * _BITS) | (cells[:, 1] << _BITS) | cells[:, 2])


def sided_voxel_numbers(cloud: Cloud, edge: float) -> NDArray[np.int64]:
    """A number (N,) for the cube of `edge` metres that each point lies in and the octant that it was seen from.

    So the two sides of a thin wall are told apart. Where no sensor is known, it is the octant of the cube instead.
    """
    if cloud.sensor is None:
        return voxel_numbers(cloud.points, edge / 2)
    return _numbers_of_octants(cloud.points, cloud.sensor > cloud.points, edge)


def numbers_of_same_side(cloud: Cloud, edge: float) -> NDArray[np.int64]:
    """The two numbers (2, N) under which points may be counted that show the same side of a surface as each point does.

    A vertical scan has its sensor hardly away from a point along the way of the robot, so that it is chance on which
    side of it, and the other one on the way back. So beside the number of `sided_voxel_numbers`, under which points are
    counted, there is that of the octant across the lesser of x and y, if the sensor is less than a fifth of its
    distance away along it; else -1, which no cube has. Who sees the other side of a surface is farther to its side than
    that, or looks along it; and above and below stay apart.
    """
    own = sided_voxel_numbers(cloud, edge)
    if cloud.sensor is None:
        return np.stack([own, np.full(len(cloud), -1)])
    away = cloud.sensor - cloud.points
    rows, lesser = np.arange(len(cloud)), np.abs(away[:, :2]).argmin(axis=1)
    beyond = away > 0
    beyond[rows, lesser] ^= True
    across = _numbers_of_octants(cloud.points, beyond, edge)
    by_chance = np.abs(away[rows, lesser]) < _BY_CHANCE * np.linalg.norm(away, axis=1)
    return np.stack([own, np.where(by_chance, across, -1)])


def _numbers_of_octants(points: NDArray[np.float64], beyond: NDArray[np.bool_], edge: float) -> NDArray[np.int64]:
    """beyond: (N, 3) on which side of its point an octant lies along each axis."""
    return voxel_numbers(edge * (np.floor(points / edge) + np.where(beyond, 0.75, 0.25)), edge / 2)


class VoxelFilter:
    """Lets through the first point in each cube."""

    def __init__(self, edge: float) -> None:
        """`edge`: of the cubes in metres."""
        self._edge = edge
        self._taken: set[int] = set()

    def first(self, points: NDArray[np.float64]) -> NDArray[np.intp]:
        """Indices, in order, of those of the points (N, 3) that are the first in their cubes, now and before."""
        numbers, rows = np.unique(voxel_numbers(points, self._edge), return_index=True)
        new = [row for number, row in zip(numbers.tolist(), rows.tolist(), strict=True) if number not in self._taken]
        self._taken.update(numbers.tolist())
        return np.sort(np.array(new, np.intp))


class VoxelCounts:
    """How many points there are in each cube; it takes 12 bytes for one with a point."""

    def __init__(self) -> None:
        self._numbers: NDArray[np.int64] = np.empty(0, np.int64)
        self._counts: NDArray[np.int32] = np.empty(0, np.int32)

    def add(self, numbers: NDArray[np.int64], times: int = 1) -> None:
        """Count points in the cubes of these numbers (N,), each so many times; -1 takes points away again."""
        new, counts = np.unique(numbers, return_counts=True)
        counts = (times * counts).astype(np.int32)
        rows, known = self._find(new)
        self._counts[rows[known]] += counts[known]
        self._numbers = np.insert(self._numbers, rows[~known], new[~known])
        self._counts = np.insert(self._counts, rows[~known], counts[~known])
        if not self._counts.all():
            some = self._counts != 0
            self._numbers, self._counts = self._numbers[some], self._counts[some]

    def of(self, numbers: NDArray[np.int64]) -> NDArray[np.int32]:
        """The count of the cube of each number; both are of any shape."""
        rows, known = self._find(numbers)
        counts = np.zeros(numbers.shape, np.int32)
        counts[known] = self._counts[rows[known]]
        return counts

    def _find(self, numbers: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Where the numbers are, or would have to be, and whether they are there."""
        rows = np.searchsorted(self._numbers, numbers)
        known = rows < len(self._numbers)
        known[known] = self._numbers[rows[known]] == numbers[known]
        return rows, known
