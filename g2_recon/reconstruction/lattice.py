# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The lattice of a self-organizing map: which neurons are neighbors, and how far apart two are on it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import shortest_path

Kind = Literal["rectangular", "hexagonal", "triangular"]


@dataclass(frozen=True)
class Lattice:
    """A lattice of n = rows * columns neurons, numbered row by row.

    coordinates: (n, 2) place of each neuron on the lattice, in steps. edges: (E, 2) closest neighbors.
    cells: (C, 4) the corners of each rectangular mesh, to be cut into two triangles once the map is trained.
    triangles: (T, 3) the corners of each triangular mesh. A lattice has either cells or triangles; both run
    counterclockwise in the lattice plane. border: (n,) mask of the neurons on the rim.
    """

    rows: int
    columns: int
    coordinates: NDArray[np.float64]
    edges: NDArray[np.int64]
    cells: NDArray[np.int64]
    triangles: NDArray[np.int64]
    border: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.coordinates)

    @cached_property
    def steps(self) -> NDArray[np.int64]:
        """Shortest path (n, n) between neurons in steps (paper, section 3.2)."""
        ends, count = self.edges.T, len(self)
        graph = coo_array((np.ones(len(self.edges)), (ends[0], ends[1])), shape=(count, count)).tocsr()
        return shortest_path(graph, directed=False, unweighted=True).astype(np.int64)

    @property
    def longest_path(self) -> int:
        """Steps between the two neurons that are farthest apart."""
        return int(self.steps.max())


def make_lattice(kind: Kind, rows: int, columns: int) -> Lattice:
    """The lattice of that name."""
    return {"rectangular": rectangular, "hexagonal": hexagonal, "triangular": triangular}[kind](rows, columns)


def rectangular(rows: int, columns: int) -> Lattice:
    """A lattice in which each neuron has the neighbors above, below, left and right of it."""
    row, column = _places(rows, columns)
    return _lattice(rows, columns, np.stack([row, column], axis=1).astype(float), diagonals=None)


def hexagonal(rows: int, columns: int) -> Lattice:
    """A lattice in which each inner neuron has six neighbors, all one step off: SOM_PAK's "hexa".

    Every other row is shifted by half a step, and rows are sqrt(3) / 2 steps apart.
    """
    row, column = _places(rows, columns)
    coordinates = np.stack([row * math.sqrt(0.75), column + 0.5 * (row % 2)], axis=1)
    # Where the next row is the shifted one, its neuron of the same column is nearer to the next column of this row.
    return _lattice(rows, columns, coordinates, diagonals=np.arange(rows - 1) % 2 == 1)


def triangular(rows: int, columns: int) -> Lattice:
    """A rectangular lattice with one diagonal of each cell as an edge too.

    "The map itself will create the triangulation" (paper, section 7), and its borders are straight.
    """
    row, column = _places(rows, columns)
    coordinates = np.stack([row, column], axis=1).astype(float)
    return _lattice(rows, columns, coordinates, diagonals=np.ones(rows - 1, bool))


def _places(rows: int, columns: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    row, column = np.divmod(np.arange(rows * columns), columns)
    return row, column


def _lattice(
    rows: int, columns: int, coordinates: NDArray[np.float64], *, diagonals: NDArray[np.bool_] | None
) -> Lattice:
    """The lattice with neurons at `coordinates`, its cells whole or cut.

    diagonals: (rows - 1,) true where the cells above a row are cut from their first to their third corner, false where
    from the second to the fourth; None leaves them whole.
    """
    number = np.arange(rows * columns, dtype=np.int64).reshape(rows, columns)
    edges = [np.stack([number[:-1].ravel(), number[1:].ravel()], axis=1)]
    edges += [np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], axis=1)]
    corners = (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:])
    cells = np.stack([corner.ravel() for corner in corners], axis=1)
    triangles = np.empty((0, 3), np.int64)
    if diagonals is not None:
        first_to_third = np.repeat(diagonals, columns - 1)[:, None]
        edges += [np.where(first_to_third, cells[:, [0, 2]], cells[:, [1, 3]])]
        one = np.where(first_to_third, cells[:, [0, 1, 2]], cells[:, [0, 1, 3]])
        other = np.where(first_to_third, cells[:, [0, 2, 3]], cells[:, [1, 2, 3]])
        triangles, cells = np.stack([one, other], axis=1).reshape(-1, 3), cells[:0]
    row, column = _places(rows, columns)
    return Lattice(
        rows=rows,
        columns=columns,
        coordinates=coordinates,
        edges=np.concatenate(edges),
        cells=cells,
        triangles=triangles,
        border=(row == 0) | (row == rows - 1) | (column == 0) | (column == columns - 1),
    )
