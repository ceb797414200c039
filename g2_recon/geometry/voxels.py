# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Cubes in space, to thin clouds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_BITS = 21


def voxel_numbers(points: NDArray[np.float64], edge: float) -> NDArray[np.int64]:
    """A number (N,) for the cube of `edge` metres that each of the points (N, 3) lies in.

    It is the same for two cubes only where they are more than two million cubes apart.
    """
    cells = np.floor(points / edge).astype(np.int64) & (2**_BITS - 1)
    return np.asarray((cells[:, 0] << 2 * _BITS) | (cells[:, 1] << _BITS) | cells[:, 2])


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
