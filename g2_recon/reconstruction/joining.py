# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Phase 3: the submaps are joined where their borders come near each other (paper, section 3.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Float = NDArray[np.float64]


def join_borders(
    weights: Float, submap: NDArray[np.int64], edges: NDArray[np.int64], border: NDArray[np.bool_], *, theta: float
) -> NDArray[np.int64]:
    """The joins (J, 2), pairs of neurons of different submaps, smaller number first.

    weights: (V, 3) neurons of all submaps, submap: (V,), edges: (E, 2) within the submaps, border: (V,) rim neurons.
    For each border neuron the nearest border neuron of each other submap is its candidate; the two are joined if
    their distance is below `theta` times the mean distance of both to their lattice neighbors (paper, figure 3).
    """
    rim = np.flatnonzero(border)
    spacing = mean_neighbor_distance(weights, edges)
    reach = theta * float(spacing[rim].max(initial=0.0))
    pairs = cKDTree(weights[rim]).query_pairs(reach, output_type="ndarray")
    one, other = rim[pairs].reshape(-1, 2).T
    apart = submap[one] != submap[other]
    one, other = np.r_[one[apart], other[apart]], np.r_[other[apart], one[apart]]
    distance = np.linalg.norm(weights[one] - weights[other], axis=1)
    # Of each neuron and each other submap, the first row after this sort is the nearest candidate.
    order = np.lexsort((other, distance, submap[other], one))
    one, other, distance = one[order], other[order], distance[order]
    nearest = np.ones(len(one), bool)
    nearest[1:] = (one[1:] != one[:-1]) | (submap[other][1:] != submap[other][:-1])
    joined = nearest & (distance < theta * 0.5 * (spacing[one] + spacing[other]))
    return np.unique(np.sort(np.stack([one[joined], other[joined]], axis=1), axis=1), axis=0)


def mean_neighbor_distance(weights: Float, edges: NDArray[np.int64]) -> Float:
    """Mean distance (V,) in metres of each neuron to its lattice neighbors; 0 where it has none."""
    length = np.linalg.norm(weights[edges[:, 0]] - weights[edges[:, 1]], axis=1)
    total = np.bincount(edges.ravel(), np.repeat(length, 2), len(weights))
    return total / np.maximum(np.bincount(edges.ravel(), minlength=len(weights)), 1)
