# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The lattice of a self-organizing map: which neurons are neighbors, and how far apart two are on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import shortest_path


@dataclass(frozen=True, slots=True)
class Lattice:
    """A rectangular lattice of n = rows * columns neurons, numbered row by row.

    coordinates: (n, 2) place of each neuron on the lattice, in steps. edges: (E, 2) closest neighbors.
    cells: (C, 4) the corners of each mesh, counterclockwise in the lattice plane. border: (n,) mask of the neurons on
    the rim. steps: (n, n) shortest path between neurons in steps (paper, section 3.2).
    """

    rows: int
    columns: int
    coordinates: NDArray[np.float64]
    edges: NDArray[np.int64]
    cells: NDArray[np.int64]
    border: NDArray[np.bool_]
    steps: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.coordinates)

    @property
    def longest_path(self) -> int:
        """Steps between the two neurons that are farthest apart."""
        return int(self.steps.max())


def rectangular(rows: int, columns: int) -> Lattice:
    """A lattice in which each neuron has the neighbors above, below, left and right of it."""
    number = np.arange(rows * columns).reshape(rows, columns)
    along_columns = np.stack([number[:-1].ravel(), number[1:].ravel()], axis=1)
    along_rows = np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], axis=1)
    edges = np.concatenate([along_columns, along_rows]).astype(np.int64)
    corners = [number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]]
    row, column = np.divmod(number.ravel(), columns)
    return Lattice(
        rows=rows,
        columns=columns,
        coordinates=np.stack([row, column], axis=1).astype(float),
        edges=edges,
        cells=np.stack([corner.ravel() for corner in corners], axis=1).astype(np.int64),
        border=(row == 0) | (row == rows - 1) | (column == 0) | (column == columns - 1),
        steps=_shortest_paths(edges, rows * columns),
    )


def _shortest_paths(edges: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count)).tocsr()
    return shortest_path(graph, directed=False, unweighted=True).astype(np.int64)
