# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Phase 4: the neurons near the joined borders are trained again, on the joined graph (paper, section 3.4)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, eye_array
from scipy.spatial import cKDTree

from g2_recon.progress import Progress, silent
from g2_recon.reconstruction.som import sums_by_neuron

Float = NDArray[np.float64]

# A neighborhood of width 1 reaches a neuron's direct neighbors with this weight, exp(-1 / 2); farther neurons, which
# it would move by less than a seventh of that, are left out, as the order of the maps is already right.
_NEIGHBOR_PULL = math.exp(-0.5)


@dataclass(frozen=True, slots=True)
class BorderRegion:
    """What takes part in the re-optimization.

    neurons: (A,) numbers of the neurons near joined borders. graph: (A, A) their connections, lattice and joins alike.
    points: (M, 3) the data of these neurons. bmu: (M,) their best matching unit before, as a row of `neurons`.
    """

    neurons: NDArray[np.int64]
    graph: csr_array
    points: Float
    bmu: NDArray[np.int64]


def border_region(
    points: Float,
    bmu: NDArray[np.int64],
    count: int,
    edges: NDArray[np.int64],
    joins: NDArray[np.int64],
    *,
    width: int,
) -> BorderRegion:
    """The neurons at most `width` steps from a joined neuron, and the data of these neurons.

    points: (N, 3), bmu: (N,) neuron of each, count: how many neurons, edges: (E, 2) in the submaps, joins: (J, 2).
    All other neurons and data "are removed from the calculation" (paper).
    """
    links = np.concatenate([edges, joins])
    graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(count, count)).tocsr()
    graph = (graph + graph.T).tocsr()
    near = np.zeros(count, bool)
    near[joins.ravel()] = True
    for _ in range(width):
        near |= graph @ near > 0
    neurons = np.flatnonzero(near)
    row = np.full(count, -1)
    row[neurons] = np.arange(len(neurons))
    taking_part = near[bmu]
    return BorderRegion(neurons, graph[neurons][:, neurons].tocsr(), points[taking_part], row[bmu[taking_part]])


def reoptimize_batch(weights: Float, region: BorderRegion, *, passes: int, progress: Progress = silent) -> Float:
    """Neurons (V, 3) after batch updates of those in the region, with a neighborhood that shrinks from 1 to 0.35."""
    result, local = weights.copy(), weights[region.neurons]
    for number in range(passes):
        width = 0.35 ** (number / max(passes - 1, 1))
        neighborhood = eye_array(len(local)) + math.exp(-0.5 / width**2) * region.graph
        bmu = cKDTree(local).query(region.points)[1]
        total, count = sums_by_neuron(region.points, bmu, len(local))
        pulled = neighborhood @ count
        reached = pulled > 1e-12
        local[reached] = (neighborhood @ total)[reached] / pulled[reached, None]
        progress("re-optimization", number + 1, passes)
    result[region.neurons] = local
    return result


def reoptimize_online(
    weights: Float,
    region: BorderRegion,
    *,
    passes: int,
    learning_rate_start: float,
    learning_rate_end: float,
    seed: int,
    progress: Progress = silent,
) -> Float:
    """Neurons (V, 3) after `passes` presentations of the region's data by the iterative rule.

    The learning rate falls linearly from start to end; the neighborhood has the width 1 that training ended with.
    """
    result = weights.copy()
    local = np.ascontiguousarray(weights[region.neurons])
    rng = np.random.default_rng(seed)
    bmu = region.bmu.copy()
    for number in range(passes):
        done = number / max(passes - 1, 1)
        rate = learning_rate_start + (learning_rate_end - learning_rate_start) * done
        order = rng.permutation(len(region.points))
        _present(region.points, order, bmu, local, region.graph.indptr, region.graph.indices, rate, _NEIGHBOR_PULL)
        progress("re-optimization", number + 1, passes)
    result[region.neurons] = local
    return result


@numba.njit(cache=True, nogil=True)
def _present(points, order, bmu, weights, first, neighbors, rate, neighbor_pull):  # type: ignore[no-untyped-def]
    """One pass over the points in the given order; weights (A, 3) and bmu (M,) are changed in place.

    The best matching unit is found by walking on the graph from the one of the last pass to ever nearer neighbors:
    neurons move little, so this finds the nearest neuron of the neighborhood without looking at all of them.
    """
    for index in order:
        point = points[index]
        best = bmu[index]
        nearest = _squared_distance(weights[best], point)
        improved = True
        while improved:
            improved = False
            center = best
            for k in range(first[center], first[center + 1]):
                distance = _squared_distance(weights[neighbors[k]], point)
                if distance < nearest:
                    nearest, best, improved = distance, neighbors[k], True
        bmu[index] = best
        for axis in range(3):
            weights[best, axis] += rate * (point[axis] - weights[best, axis])
        for k in range(first[best], first[best + 1]):
            for axis in range(3):
                weights[neighbors[k], axis] += rate * neighbor_pull * (point[axis] - weights[neighbors[k], axis])


@numba.njit(cache=True, nogil=True)
def _squared_distance(one, other):  # type: ignore[no-untyped-def]
    return (one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 + (one[2] - other[2]) ** 2
