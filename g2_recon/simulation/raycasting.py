# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Where rays meet axis-aligned rectangles."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from g2_recon.simulation.building import Rectangles

EDGE_TOLERANCE = 1e-9
"""Metres by which a rectangle reaches over its edges, so that no ray slips between two that share one."""


def cast(rectangles: Rectangles, origins: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances (N,) in metres to the first rectangle along each ray, +inf where there is none.

    origins, directions: (N, 3) in the frame of the rectangles; directions of unit length.
    """
    distances = np.empty(len(origins))
    first_of_axis = np.searchsorted(rectangles.axis, np.arange(4))
    _cast(
        np.ascontiguousarray(origins),
        np.ascontiguousarray(directions),
        first_of_axis,
        rectangles.offset,
        rectangles.low - EDGE_TOLERANCE,
        rectangles.high + EDGE_TOLERANCE,
        distances,
    )
    return distances


@numba.njit(cache=True)
def _cast(  # pragma: no cover
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    first_of_axis: NDArray[np.int64],
    offset: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    distances: NDArray[np.float64],
) -> None:
    for ray in range(len(origins)):
        nearest = np.inf
        for axis in range(3):
            if directions[ray, axis] == 0.0:
                continue
            u, v = (1 if axis == 0 else 0), (1 if axis == 2 else 2)
            scale = 1.0 / directions[ray, axis]
            for r in range(first_of_axis[axis], first_of_axis[axis + 1]):
                distance = (offset[r] - origins[ray, axis]) * scale
                if 0.0 < distance < nearest:
                    at_u = origins[ray, u] + distance * directions[ray, u]
                    at_v = origins[ray, v] + distance * directions[ray, v]
                    if low[r, 0] <= at_u <= high[r, 0] and low[r, 1] <= at_v <= high[r, 1]:
                        nearest = distance
        distances[ray] = nearest
