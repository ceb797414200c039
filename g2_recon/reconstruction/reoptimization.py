# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Phase 4: the neurons near the joined borders are trained again, on the joined graph (paper, section 3.4)."""

from __future__ import annotations

import math
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, eye_array
from scipy.sparse.csgraph import shortest_path
from scipy.spatial import cKDTree

from g2_recon.kernels import kernel
from g2_recon.progress import Progress, silent
from g2_recon.reconstruction.som import FAR_OFF, NEVER, Stop, padded, present, sums_by_neuron

Float = NDArray[np.float64]
Int = NDArray[np.int64]

# Progress is told and the call to stop is heard this often.
_PASSES_AT_ONCE = 100
# With fewer points a round a thread would take as long to wake up as to present them.
_WORTH_A_THREAD = 2000


@dataclass(frozen=True, slots=True)
class BorderRegion:
    """What takes part in the re-optimization.

    neurons: (A,) numbers of the neurons near joined borders. graph: (A, A) their connections, lattice and joins alike.
    points: (M, 3) the data of these neurons. bmu: (M,) their best matching unit before, as a row of `neurons`.
    """

    neurons: Int
    graph: csr_array
    points: Float
    bmu: Int


def border_region(
    points: Float,
    bmu: Int,
    count: int,
    edges: Int,
    joins: Int,
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
    submap: Int,
    region: BorderRegion,
    *,
    passes: int,
    learning_rate_start: float,
    learning_rate_end: float,
    seed: int,
    workers: int = 1,
    stop: Stop = NEVER,
    progress: Progress = silent,
) -> Float:
    """Neurons (V, 3) after `passes` presentations of the region's data by the iterative rule.

    submap: (V,). The rule is that of training, on the joined graph: the learning rate falls linearly from start to end,
    the neighborhood has the radius 1 that training ended with, and the lattice distance is the shortest path along
    edges and joins. In each pass the submaps present their data one after the other, each to its own neurons in the
    region and those joined to them; submaps that share no neuron do it at the same time, so the result does not depend
    on the number of workers.
    """
    if not len(region.points):
        return weights.copy()
    middle = region.points.mean(axis=0)
    local = np.ascontiguousarray(weights[region.neurons] - middle, dtype=np.float32)
    parts = _parts(submap[region.neurons], region, middle, seed)
    worthwhile = len(region.points) // (_WORTH_A_THREAD * len(parts.rounds))
    workers = max(1, min(workers or os.cpu_count() or 1, worthwhile))
    shares = [_shared(members, parts.effort, workers) for members in parts.rounds]
    all_done = threading.Barrier(workers)

    def work(worker: int, rates: Float) -> None:
        try:
            for rate in np.split(rates, len(rates)):
                for share in shares:
                    _present_in_turn(share[worker], parts.arrays, local, rate)
                    all_done.wait()
        except BaseException:
            all_done.abort()
            raise

    with ThreadPoolExecutor(workers) as pool:
        for first in range(0, passes, _PASSES_AT_ONCE):
            if stop.is_set():
                break
            done = np.arange(first, min(first + _PASSES_AT_ONCE, passes)) / max(passes - 1, 1)
            rates = learning_rate_start + (learning_rate_end - learning_rate_start) * done
            if workers == 1:
                _present_in_turn(np.concatenate(parts.rounds), parts.arrays, local, rates)
            else:
                for job in [pool.submit(work, worker, rates) for worker in range(workers)]:
                    job.result()
            progress("re-optimization", first + len(done), passes)
    result = weights.copy()
    result[region.neurons] = local + middle
    return result


@dataclass(frozen=True, slots=True)
class _Parts:
    """The region parted into what each submap presents its data to.

    arrays: points, their order, first point of each part, neurons (rows of the region), first neuron of each part,
    pull between the neurons of each part, first of these, random state of each part.
    rounds: numbers of the parts that share no neuron, round by round. effort: (P,) of presenting each part once.
    """

    arrays: tuple[NDArray[Any], ...]
    rounds: list[Int]
    effort: Float


def _parts(submap: Int, region: BorderRegion, middle: Float, seed: int) -> _Parts:
    """The parts, one a submap (A,) that has neurons in the region."""
    number = np.unique(submap, return_inverse=True)[1].reshape(-1)
    count = int(number.max()) + 1
    part_of_point = number[region.bmu]
    by_part = np.argsort(part_of_point, kind="stable")
    points = np.bincount(part_of_point, minlength=count)
    own = csr_array((np.ones(len(number)), (number, np.arange(len(number)))), shape=(count, len(number)))
    reached = ((own + own @ region.graph) > 0).astype(float).tocsr()
    reached.sort_indices()
    neurons = np.split(reached.indices, reached.indptr[1:-1])
    pull = [_pull(region.graph[part][:, part]).ravel() for part in neurons]
    return _Parts(
        arrays=(
            np.ascontiguousarray((region.points - middle)[by_part], dtype=np.float32),
            np.concatenate([np.arange(size, dtype=np.int32) for size in points]),
            _starts(points),
            reached.indices.astype(np.int64),
            _starts([len(part) for part in neurons]),
            np.concatenate(pull),
            _starts([len(part) for part in pull]),
            2 * (seed + np.arange(count, dtype=np.uint64)) + np.uint64(1),
        ),
        rounds=_rounds((reached @ reached.T).tocsr()),
        effort=points * np.array([len(part) for part in neurons], float),
    )


def _pull(graph: csr_array) -> NDArray[np.float32]:
    """What `present` wants (n, padded(n)) for a neighborhood of radius 1 on a graph of n neurons; see train_online."""
    count = graph.shape[0]
    pull = np.zeros((count, padded(count)), np.float32)
    pull[:, :count] = np.exp(-2.0 * shortest_path(graph, directed=False, unweighted=True) ** 2)
    return pull


def _starts(sizes: Int | list[int]) -> Int:
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


def _rounds(shared: csr_array) -> list[Int]:
    """Parts round by round, such that no two of a round share a neuron: greedy coloring, most neighbors first."""
    color = np.full(shared.shape[0], -1)
    for part in np.argsort(-np.diff(shared.indptr), kind="stable").tolist():
        taken = set(color[shared.indices[shared.indptr[part] : shared.indptr[part + 1]]].tolist())
        color[part] = next(free for free in range(len(color)) if free not in taken)
    return [np.flatnonzero(color == which) for which in range(int(color.max()) + 1)]


def _shared(members: Int, effort: Float, workers: int) -> list[Int]:
    """The members of a round for each worker, the largest first to whoever has least to do."""
    shares: list[list[int]] = [[] for _ in range(workers)]
    load = np.zeros(workers)
    for part in members[np.argsort(-effort[members], kind="stable")].tolist():
        least = int(load.argmin())
        shares[least].append(part)
        load[least] += effort[part]
    return [np.array(share, np.int64) for share in shares]


@kernel
def _present_in_turn(which, arrays, weights, rates):  # type: ignore[no-untyped-def]
    """For each rate, each of these parts presents its points once; weights (A, 3) are changed in place."""
    points, order, first_point, neurons, first_neuron, pull, first_pull, states = arrays
    for rate in rates:
        for part in which:
            begin, end = first_point[part], first_point[part + 1]
            own = neurons[first_neuron[part] : first_neuron[part + 1]]
            local = np.full((3, padded(len(own))), np.float32(FAR_OFF), np.float32)
            for i in range(len(own)):
                for axis in range(3):
                    local[axis, i] = weights[own[i], axis]
            # All parts together do not fit into the cache of a core; one part does, and copied it comes in one go.
            data = points[begin:end].copy()
            shares = pull[first_pull[part] : first_pull[part + 1]].copy().reshape(len(own), local.shape[1])
            present(data, local, shares, rate, order[begin:end], states[part : part + 1])
            for i in range(len(own)):
                for axis in range(3):
                    weights[own[i], axis] = local[axis, i]
