# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Reconstruction of a surface by clusters and self-organizing maps, in the four phases of the paper (section 3)."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2_recon.config import ReconstructionConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud, concatenate
from g2_recon.geometry.mesh import Mesh, WireMesh
from g2_recon.progress import Progress, silent
from g2_recon.reconstruction.clustering.connectivity import split_disconnected
from g2_recon.reconstruction.clustering.k_means import centers, k_means
from g2_recon.reconstruction.joining import join_borders
from g2_recon.reconstruction.lattice import Lattice, rectangular
from g2_recon.reconstruction.normals import estimate_normals
from g2_recon.reconstruction.reoptimization import border_region, reoptimize_batch, reoptimize_online
from g2_recon.reconstruction.som import best_matching_units, spread_over, train_batch, train_online
from g2_recon.reconstruction.triangulation import face_towards_sensor, split_cells, supported

Float = NDArray[np.float64]
Int = NDArray[np.int64]

FEWEST_POINTS = 10

# A cluster that spans free space is divided and the centers are improved again, so that the number of clusters stays
# as asked; what still falls into pieces after so many rounds is divided for good.
_CLUSTERING_ROUNDS = 4


@dataclass(frozen=True, slots=True)
class Reconstruction:
    """The result: the wire mesh, the triangles, and counts.

    points: how many points were used. left_out: how many were not, by reason. quantization_error: m, mean distance of
    a point to its best matching unit.
    """

    wire_mesh: WireMesh
    mesh: Mesh
    points: int
    left_out: dict[str, int]
    clusters: int
    quantization_error: float


@dataclass(frozen=True, slots=True)
class Submaps:
    """The trained maps of all clusters as one graph; map k holds the neurons k * n to (k + 1) * n - 1.

    weights: (V, 3) m. submap: (V,). edges: (E, 2). cells: (C, 4). border: (V,) mask. bmu: (N,) neuron of each point.
    """

    weights: Float
    submap: Int
    edges: Int
    cells: Int
    border: NDArray[np.bool_]
    bmu: Int


def reconstruct(cloud: Cloud, config: ReconstructionConfig, *, progress: Progress = silent) -> Reconstruction:
    """Reconstruct the surface that a cloud was measured on.

    Raises InputError where the cloud has too few distinct points for a surface.
    """
    cloud, left_out = usable_points(cloud, config)
    label = initial_clustering(cloud, config, progress)
    submaps = build_submaps(cloud.points, label, config, progress)
    joins = join_borders(submaps.weights, submaps.submap, submaps.edges, submaps.border, theta=config.theta)
    progress("joining", 1, 1)
    weights = reoptimize_borders(cloud.points, submaps, joins, config, progress)
    mesh = triangulate(cloud, weights, submaps, config)
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
        left_out=left_out,
        clusters=int(label.max()) + 1,
        quantization_error=float(np.linalg.norm(cloud.points - weights[submaps.bmu], axis=1).mean()),
    )


def usable_points(cloud: Cloud, config: ReconstructionConfig) -> tuple[Cloud, dict[str, int]]:
    """The cloud without what cannot be surface, and how many points were left out, by reason.

    Raises InputError where fewer than ten distinct points, or none off a line, remain.
    """
    finite = cloud.finite()
    left_out = {"not finite": len(cloud) - len(finite)}
    good = finite
    if finite.sensor is not None and config.min_sensor_distance > 0:
        distance = np.linalg.norm(finite.points - finite.sensor, axis=1)
        good = finite.select(distance >= config.min_sensor_distance)
    left_out["nearer to the sensor than min_sensor_distance"] = len(finite) - len(good)
    distinct = len(np.unique(good.points, axis=0))
    if distinct < FEWEST_POINTS:
        raise InputError(
            f"the cloud has {distinct} distinct usable points of {len(cloud)}",
            advice=f"a surface needs at least {FEWEST_POINTS}",
        )
    extent = np.linalg.svd(np.cov(good.points.T), compute_uv=False)
    if extent[1] <= 1e-12 * extent[0]:
        raise InputError("all points of the cloud lie on one line", advice="a surface needs points beside it")
    return good, {reason: count for reason, count in left_out.items() if count}


def initial_clustering(cloud: Cloud, config: ReconstructionConfig, progress: Progress = silent) -> Int:
    """Phase 1: the cluster (N,) of each point; clusters hang together.

    There are as many as asked, but no more than leave one point a neuron; a few more where free space divides them.
    """
    neurons = config.rows * config.columns
    clusters = int(np.clip(len(cloud) // neurons, 1, config.clusters))
    features = clustering_features(cloud, config)
    label = k_means(features, clusters, seed=config.seed)
    for done in range(_CLUSTERING_ROUNDS):
        pieces = split_disconnected(cloud.points, label, gap=config.cluster_gap, min_points=max(neurons // 4, 4))
        progress("clustering", done + 1, _CLUSTERING_ROUNDS)
        if pieces.max() == label.max():
            break
        largest = np.argsort(np.bincount(pieces), kind="stable")[::-1][:clusters]
        label = k_means(features, clusters, seed=config.seed, start=centers(features, pieces)[largest])
    progress("clustering", _CLUSTERING_ROUNDS, _CLUSTERING_ROUNDS)
    return pieces


def clustering_features(cloud: Cloud, config: ReconstructionConfig) -> Float:
    """What the clustering works on: positions (N, 3); in mode solid also where the surface faces.

    A turn of the surface then counts as a distance of `flatness` metres, so that clusters stay on one wall.
    """
    if config.mode == "paper" or config.flatness == 0:
        return cloud.points
    normal = estimate_normals(cloud, workers=config.workers or -1)
    if cloud.sensor is None:
        # The sign of such normals means nothing; their outer product does not have one.
        normal = (normal[:, :, None] * normal[:, None, :]).reshape(-1, 9)
    return np.hstack([cloud.points, config.flatness * normal])


def build_submaps(points: Float, label: Int, config: ReconstructionConfig, progress: Progress = silent) -> Submaps:
    """Phase 2: one self-organizing map a cluster, trained in parallel.

    Each map has its own seed, so the result does not depend on the number of workers.
    """
    lattice = rectangular(config.rows, config.columns)
    members = np.split(np.argsort(label, kind="stable"), np.cumsum(np.bincount(label))[:-1])
    weights = np.empty((len(members), len(lattice), 3))
    bmu = np.empty(len(points), np.int64)

    def train(number: int) -> None:
        own = points[members[number]]
        weights[number] = _trained(own, lattice, config, seed=config.seed + number)
        bmu[members[number]] = best_matching_units(own, weights[number]) + number * len(lattice)

    _in_parallel(train, [len(member) for member in members], config.workers, progress)
    offsets = (len(lattice) * np.arange(len(members)))[:, None, None]
    return Submaps(
        weights=weights.reshape(-1, 3),
        submap=np.repeat(np.arange(len(members)), len(lattice)),
        edges=(lattice.edges + offsets).reshape(-1, 2),
        cells=(lattice.cells + offsets).reshape(-1, 4),
        border=np.tile(lattice.border, len(members)),
        bmu=bmu,
    )


def _trained(points: Float, lattice: Lattice, config: ReconstructionConfig, *, seed: int) -> Float:
    start = spread_over(points, lattice)
    if config.mode == "solid":
        return train_batch(points, start, lattice, epochs=config.epochs, width_end=config.neighborhood_end)
    return train_online(
        points,
        start,
        lattice,
        passes=config.passes,
        learning_rate_start=config.learning_rate_start,
        learning_rate_end=config.learning_rate_end,
        seed=seed,
    )


def _in_parallel(work: Callable[[int], None], sizes: list[int], workers: int, progress: Progress) -> None:
    """Do `work(i)` for each i, the largest first so that no worker is left alone with it at the end."""
    largest_first = np.argsort(sizes)[::-1]
    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        for done, _ in enumerate(pool.map(work, largest_first.tolist()), start=1):
            progress("training", done, len(sizes))


def reoptimize_borders(
    points: Float, submaps: Submaps, joins: Int, config: ReconstructionConfig, progress: Progress = silent
) -> Float:
    """Phase 4: neurons (V, 3) after those near joined borders were trained again on the joined graph."""
    if not len(joins) or config.border_width == 0:
        return submaps.weights
    region = border_region(
        points, submaps.bmu, len(submaps.weights), submaps.edges, joins, width=config.border_width - 1
    )
    if config.mode == "solid":
        return reoptimize_batch(submaps.weights, region, passes=config.border_passes, progress=progress)
    return reoptimize_online(
        submaps.weights,
        region,
        passes=config.border_passes,
        learning_rate_start=config.learning_rate_start,
        learning_rate_end=config.learning_rate_end,
        seed=config.seed,
        progress=progress,
    )


def triangulate(cloud: Cloud, weights: Float, submaps: Submaps, config: ReconstructionConfig) -> Mesh:
    """The lattice cells as triangles; in mode solid only where there is data."""
    faces = split_cells(weights, submaps.cells)
    if config.mode == "solid":
        faces = faces[supported(weights, faces, cloud.points, distance=config.support_distance)]
    submap = submaps.submap[faces[:, 0]]
    return Mesh(weights, face_towards_sensor(weights, faces, submap, cloud, submaps.bmu), submap)


class Reconstructor:
    """Collects clouds as they come and reconstructs what there is on request."""

    def __init__(self, config: ReconstructionConfig) -> None:
        self._config = config
        self._clouds: list[Cloud] = []

    def add_cloud(self, cloud: Cloud) -> None:
        """Add points in the map frame."""
        self._clouds.append(cloud)

    def cloud(self) -> Cloud:
        """All points so far."""
        if len(self._clouds) > 1:
            self._clouds = [concatenate(self._clouds)]
        return self._clouds[0] if self._clouds else concatenate([])

    def reconstruct(self, *, progress: Progress = silent) -> Reconstruction:
        """Reconstruct from all points so far; see the function of the same name."""
        return reconstruct(self.cloud(), self._config, progress=progress)

    def reset(self) -> None:
        """Forget all points."""
        self._clouds = []
