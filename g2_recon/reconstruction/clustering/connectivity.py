# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Clusters that hang together: a map must not span the free space between two objects."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

# Cells per gap: coarse enough to be fast, fine enough that a path of occupied cells has no hole of a whole gap.
_CELLS_PER_GAP = 4


def split_disconnected(
    points: NDArray[np.float64], label: NDArray[np.int64], *, gap: float, min_points: int
) -> NDArray[np.int64]:
    """The clusters (N,) after parting those that fall into pieces more than about `gap` metres apart.

    points: (N, 3). label: (N,) clusters from 0. A piece with fewer than `min_points` points goes to the cluster of
    the nearest point of a larger piece, whichever cluster that is in; where all pieces are that small the clusters stay
    as they are. Numbered from 0 without gaps.
    """
    cell, center, cell_label = _occupied_cells(points, label, gap / _CELLS_PER_GAP)
    pairs = cKDTree(center).query_pairs(gap, output_type="ndarray")
    pairs = pairs[cell_label[pairs[:, 0]] == cell_label[pairs[:, 1]]]
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(center), len(center)))
    piece = connected_components(graph, directed=False)[1][cell]
    large = (np.bincount(piece) >= min_points)[piece]
    if not large.any():
        return label
    if not large.all():
        nearest = cKDTree(points[large]).query(points[~large])[1]
        piece[~large] = piece[large][nearest]
    return np.unique(piece, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _occupied_cells(
    points: NDArray[np.float64], label: NDArray[np.int64], size: float
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
    """Cell (N,) of each point, and the centroid (M, 3) and cluster (M,) of each cell; clusters share no cell."""
    place = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    shape = (int(label.max()) + 1, *(place.max(axis=0) + 1).tolist())
    if math.prod(shape) < 2**62:
        # One number a cell is sorted much faster than four.
        number = np.ravel_multi_index((label, *place.T), shape)
        _, first, cell, count = np.unique(number, return_index=True, return_inverse=True, return_counts=True)
    else:
        _, first, cell, count = np.unique(
            np.column_stack([label, place]), axis=0, return_index=True, return_inverse=True, return_counts=True
        )
    cell = cell.reshape(-1)
    total = np.stack([np.bincount(cell, points[:, axis], len(count)) for axis in range(3)], axis=1)
    return cell, total / count[:, None], label[first]
