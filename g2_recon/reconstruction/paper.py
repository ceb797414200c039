# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Mode paper: reconstruction as it was published, in its four phases (section 3)."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from g2_recon.config import ReconstructionConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.mesh import Mesh, WireMesh
from g2_recon.progress import Progress, silent
from g2_recon.reconstruction.clustering.connectivity import split_disconnected
from g2_recon.reconstruction.clustering.k_means import centers, k_means
from g2_recon.reconstruction.clustering.neural_gas import neural_gas
from g2_recon.reconstruction.joining import join_borders
from g2_recon.reconstruction.lattice import Lattice, make_lattice
from g2_recon.reconstruction.reoptimization import border_region, reoptimize_batch, reoptimize_online
from g2_recon.reconstruction.result import Reconstruction
from g2_recon.reconstruction.som import Stop, best_matching_units, spread_over, train_batch, train_online
from g2_recon.reconstruction.triangulation import face_towards_sensor, split_cells

Float = NDArray[np.float64]
Int = NDArray[np.int64]

# A cluster that spans free space is divided and the centers are improved again, so that the number of clusters stays
# as asked; what still falls into pieces after so many rounds is divided for good.
_CLUSTERING_ROUNDS = 4
# A cloud that falls into more pieces a cluster is not sampled densely enough to hang together.
_MOST_PIECES = 20
# The batch rule would shrink each map by about a cell if it ended with the neighborhood of 1 of the iterative rule.
_BATCH_WIDTH_END = 0.35


@dataclass(frozen=True, slots=True)
class Submaps:
    """The trained maps of all clusters as one graph; map k holds the neurons k * n to (k + 1) * n - 1.

    weights: (V, 3) m. submap: (V,). edges: (E, 2). cells: (C, 4) and triangles: (T, 3), see Lattice.
    border: (V,) mask. bmu: (N,) neuron of each point, of the map of its cluster.
    """

    weights: Float
    submap: Int
    edges: Int
    cells: Int
    triangles: Int
    border: NDArray[np.bool_]
    bmu: Int


def reconstruct_as_published(
    cloud: Cloud, config: ReconstructionConfig, *, progress: Progress = silent
) -> Reconstruction:
    """Cluster the cloud, build a submap a cluster, join the submaps, re-optimize their borders.

    All points must be finite. The strips between submaps stay open: "currently, the joins are exploited as a logical
    connections" (section 5).
    """
    label = initial_clustering(cloud.points, config, progress)
    submaps = build_submaps(cloud.points, label, config, progress)
    joins = join_borders(submaps.weights, submaps.submap, submaps.edges, submaps.border, theta=config.theta)
    progress("joining", 1, 1)
    weights = reoptimize_borders(cloud.points, submaps, joins, config, progress)
    distance, bmu = cKDTree(weights).query(cloud.points)
    mesh = triangulate(cloud, weights, submaps, bmu)
    progress("triangulation", 1, 1)
    return Reconstruction(
        wire_mesh=WireMesh(
            weights,
            np.concatenate([submaps.edges, joins]),
            submaps.submap,
            np.arange(len(submaps.edges) + len(joins)) >= len(submaps.edges),
        ),
        mesh=mesh,
        points=len(cloud),
        left_out={},
        clusters=int(label.max()) + 1,
        quantization_error=float(distance.mean()),
    )


def initial_clustering(points: Float, config: ReconstructionConfig, progress: Progress = silent) -> Int:
    """Phase 1: the cluster (N,) of each point (N, 3); clusters hang together.

    There are as many as asked, but no more than leave one point a neuron; a few more where free space divides them.
    """
    neurons = config.rows * config.columns
    clusters = int(np.clip(len(points) // neurons, 1, config.clusters))
    label = _clusters(points, clusters, config, start=None)
    for done in range(_CLUSTERING_ROUNDS):
        pieces = split_disconnected(points, label, gap=config.cluster_gap, min_points=max(neurons // 4, 4))
        progress("clustering", done + 1, _CLUSTERING_ROUNDS)
        if pieces.max() == label.max():
            break
        if pieces.max() >= _MOST_PIECES * clusters:
            raise InputError(
                f"the clusters fall into {pieces.max() + 1} pieces more than {config.cluster_gap:g} m apart",
                advice="choose a larger cluster_gap; is the cloud in metres?",
            )
        largest = np.argsort(np.bincount(pieces), kind="stable")[::-1][:clusters]
        label = _clusters(points, clusters, config, start=centers(points, pieces)[largest])
    progress("clustering", _CLUSTERING_ROUNDS, _CLUSTERING_ROUNDS)
    return pieces


def _clusters(points: Float, clusters: int, config: ReconstructionConfig, *, start: Float | None) -> Int:
    if config.clustering == "neural_gas":
        return neural_gas(points, clusters, seed=config.seed, presentations=config.presentations, start=start)
    return k_means(points, clusters, seed=config.seed, start=start)


def build_submaps(points: Float, label: Int, config: ReconstructionConfig, progress: Progress = silent) -> Submaps:
    """Phase 2: one self-organizing map a cluster, trained in parallel.

    Each map has its own seed, so the result does not depend on the number of workers.
    """
    lattice = make_lattice(config.lattice, config.rows, config.columns)
    members = np.split(np.argsort(label, kind="stable"), np.cumsum(np.bincount(label))[:-1])
    weights = np.empty((len(members), len(lattice), 3))
    bmu = np.empty(len(points), np.int64)

    def train(number: int, stop: Stop) -> None:
        own = points[members[number]]
        weights[number] = _trained(own, lattice, config, seed=config.seed + number, stop=stop)
        bmu[members[number]] = best_matching_units(own, weights[number]) + number * len(lattice)

    _in_parallel(train, [len(member) for member in members], config.workers, progress)
    offsets = (len(lattice) * np.arange(len(members)))[:, None, None]
    return Submaps(
        weights=weights.reshape(-1, 3),
        submap=np.repeat(np.arange(len(members)), len(lattice)),
        edges=(lattice.edges + offsets).reshape(-1, 2),
        cells=(lattice.cells + offsets).reshape(-1, 4),
        triangles=(lattice.triangles + offsets).reshape(-1, 3),
        border=np.tile(lattice.border, len(members)),
        bmu=bmu,
    )


def _trained(points: Float, lattice: Lattice, config: ReconstructionConfig, *, seed: int, stop: Stop) -> Float:
    start = spread_over(points, lattice)
    if config.training == "batch":
        return train_batch(points, start, lattice, epochs=config.epochs, width_end=_BATCH_WIDTH_END)
    return train_online(
        points,
        start,
        lattice,
        passes=config.passes,
        learning_rate_start=config.learning_rate_start,
        learning_rate_end=config.learning_rate_end,
        seed=seed,
        stop=stop,
    )


def _in_parallel(work: Callable[[int, Stop], None], sizes: list[int], workers: int, progress: Progress) -> None:
    """Do `work(i, stop)` for each i, the largest first so that no worker is left alone with it at the end."""
    largest_first = np.argsort(sizes)[::-1].tolist()
    stop = Stop()
    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        try:
            for done, _ in enumerate(pool.map(lambda number: work(number, stop), largest_first), start=1):
                progress("training", done, len(sizes))
        finally:
            # After an exception, such as a user's interrupt, nobody waits for the maps that are still in training.
            stop.set()
            pool.shutdown(cancel_futures=True)


def reoptimize_borders(
    points: Float, submaps: Submaps, joins: Int, config: ReconstructionConfig, progress: Progress = silent
) -> Float:
    """Phase 4: neurons (V, 3) after those near joined borders were trained again on the joined graph."""
    if not len(joins) or config.border_width == 0:
        return submaps.weights
    region = border_region(
        points, submaps.bmu, len(submaps.weights), submaps.edges, joins, width=config.border_width - 1
    )
    if config.training == "batch":
        return reoptimize_batch(submaps.weights, region, passes=config.epochs, progress=progress)
    return reoptimize_online(
        submaps.weights,
        submaps.submap,
        region,
        passes=config.border_passes or config.passes,
        learning_rate_start=config.learning_rate_start,
        learning_rate_end=config.learning_rate_end,
        seed=config.seed,
        workers=config.workers,
        progress=progress,
    )


def triangulate(cloud: Cloud, weights: Float, submaps: Submaps, bmu: Int) -> Mesh:
    """The meshes of the lattices as triangles: "each rectangle is split into two triangles" (section 5).

    bmu: (N,) neuron of each point of the cloud.
    """
    faces = np.concatenate([submaps.triangles, split_cells(weights, submaps.cells)])
    submap = submaps.submap[faces[:, 0]]
    return Mesh(weights, face_towards_sensor(weights, faces, submap, cloud, bmu), submap)
