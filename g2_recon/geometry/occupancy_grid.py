# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""An occupancy grid: which cells of the floor are free, which are occupied, and which are not known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2_recon.errors import InputError
from g2_recon.geometry import se2

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""Values of a cell, as in nav_msgs/OccupancyGrid; those from 0 to 100 are the probability in % that it is occupied."""

MOST_CELLS = 400_000_000
"""No grid has more cells than this, a square of 1 km at 5 cm: what asks for more is broken."""


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """Square cells on the floor, in the conventions of nav_msgs/OccupancyGrid.

    resolution: m, edge of a cell. origin: (3,) x, y, yaw in the map frame of the lower left corner of cell (0, 0), from
    where columns go along x and rows along y. cells: (height, width) int8, -1 unknown, else 0 to 100 %.
    """

    resolution: float
    origin: NDArray[np.float64]
    cells: NDArray[np.int8]

    def __post_init__(self) -> None:
        if not (np.isfinite(self.resolution) and self.resolution > 0):
            raise InputError(f"an occupancy grid needs cells of some size, got {self.resolution} m")
        if self.origin.shape != (3,) or not np.isfinite(self.origin).all():
            raise InputError("the origin of an occupancy grid is a finite x, y, yaw")
        if self.cells.ndim != 2 or self.cells.dtype != np.int8:
            raise InputError(f"the cells of a grid are a matrix of int8, got {self.cells.dtype} {self.cells.shape}")
        if self.cells.size and not UNKNOWN <= self.cells.min() <= self.cells.max() <= OCCUPIED:
            raise InputError("the cells of an occupancy grid go from -1 to 100")

    def at(self, points: ArrayLike) -> NDArray[np.int8]:
        """The values (N,) of the cells in which points (N, 2) in metres in the map frame lie; unknown outside."""
        height, width = self.cells.shape
        column, row = (se2.transform_points(se2.inverse(self.origin), points) / self.resolution).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        values = np.full(len(inside), UNKNOWN, np.int8)
        values[inside] = self.cells[row[inside].astype(np.int64), column[inside].astype(np.int64)]
        return values

    def outline(self) -> NDArray[np.float64]:
        """The four corners (4, 2) of the grid in metres in the map frame, counterclockwise from the origin."""
        height, width = self.cells.shape
        corners = self.resolution * np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
        return se2.transform_points(self.origin, corners)
