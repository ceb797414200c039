# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Mode solid: the phases of the paper with what it names as future work (section 7), to a mesh of triangles.

Flat clusters that are the walls, maps as large as these, batch training, an optimizing join, and triangles throughout.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from g2_recon.config import ReconstructionConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.edges import edges_of
from g2_recon.geometry.mesh import Mesh, WireMesh
from g2_recon.progress import Progress, silent
from g2_recon.reconstruction.clustering.flat import FlatClusters, flat_clusters
from g2_recon.reconstruction.flat_submaps import FlatSubmaps, train_submaps
from g2_recon.reconstruction.mesh_of_submaps import mesh_of_submaps
from g2_recon.reconstruction.own_frame import own_frame
from g2_recon.reconstruction.result import Reconstruction
from g2_recon.reconstruction.surface_points import SurfacePoints, prepare

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Result = TypeVar("Result")

# Everything scales with the spacing of the neurons; these shares of it were found at 20 cm, which suits a building.
NORMAL_RADIUS = 1.25
_OFF_PLANE = 0.75
_PATCH_CELLS = 40.0
_PATCH_SIZE = 4.0
_FLATNESS = 0.2
# Over more than this many spacings, or support distances, no cell has data near all of it, so that a lattice over them
# would have none at all: scans farther apart, as those of a robot that turns, get a strip each.
_GAP = 2.0


def reconstruct_solid(cloud: Cloud, config: ReconstructionConfig, *, progress: Progress = silent) -> Reconstruction:
    """Reconstruct a surface as a manifold, consistently oriented mesh of triangles.

    Raises InputError where the cloud has too few points on a surface, or these cover none of it.
    """
    workers = config.workers or os.cpu_count() or 1
    frame = own_frame(cloud.points)
    surface = reported(lambda: find_surface(frame.of(cloud, workers=workers), config, workers), "normals", progress)
    clusters = reported(lambda: find_clusters(surface, config, workers), "clustering", progress)
    submaps, owner = build_submaps(surface, clusters, config, workers, progress)
    mesh = reported(lambda: mesh_of_submaps(surface, submaps, owner, config, workers), "joining", progress)
    check_covered(mesh.faces)
    mesh = replace(mesh, vertices=frame.back(mesh.vertices))
    error = np.linalg.norm(surface.points - submaps.vertices[owner], axis=1)[owner >= 0].mean()
    return Reconstruction(
        wire_mesh=wire_of(mesh),
        mesh=mesh,
        points=len(surface),
        left_out=surface.rejected,
        clusters=len(clusters),
        quantization_error=float(error),
    )


def find_surface(cloud: Cloud, config: ReconstructionConfig, workers: int) -> SurfacePoints:
    """Phase 0: normals, noise and area weights, without points that are on no surface."""
    return prepare(
        cloud,
        spacing=config.spacing,
        radius=NORMAL_RADIUS * config.spacing,
        off_plane=_OFF_PLANE * config.spacing,
        workers=workers,
    )


def find_clusters(surface: SurfacePoints, config: ReconstructionConfig, workers: int) -> FlatClusters:
    """Phase 1: clusters that are flat and hang together. Raises InputError where there is none."""
    cell = config.spacing**2
    clusters = flat_clusters(
        surface,
        patch_area=config.patch_area or _PATCH_CELLS * cell,
        patch_size=_PATCH_SIZE * config.spacing,
        flatness=config.flatness or _FLATNESS * config.spacing,
        min_area=cell,
        gap=_GAP * max(config.support_distance or 0.0, config.spacing),
        seed=config.seed,
        workers=workers,
    )
    if not len(clusters) or (clusters.label < 0).all():
        raise InputError("the cloud holds no patch of surface", advice="choose a smaller spacing")
    return clusters


def build_submaps(
    surface: SurfacePoints, clusters: FlatClusters, config: ReconstructionConfig, workers: int, progress: Progress
) -> tuple[FlatSubmaps, Int]:
    """Phase 2: a map a cluster, trained in parallel; and the neuron (N,) of each point, -1 where it has no cluster."""
    member = clusters.label >= 0
    submaps = train_submaps(
        surface.points[member],
        surface.weights[member],
        clusters.label[member],
        clusters.centers,
        clusters.normals,
        clusters.thickness,
        spacing=config.spacing,
        noise=surface.noise,
        epochs=config.epochs,
        lattice=config.lattice,
        workers=workers,
        progress=progress,
    )
    owner = np.full(len(surface), -1)
    owner[member] = submaps.bmu
    return submaps, owner


def check_covered(found: Float | Int) -> None:
    """Raises InputError where no neurons, or no faces, were found."""
    if not len(found):
        raise InputError(
            "the cloud holds no patch of surface that its points cover",
            advice="choose a larger spacing where points are far apart, or a smaller one where the surface is small",
        )


def wire_of(mesh: Mesh) -> WireMesh:
    """The vertices and edges of a mesh as a wire mesh; a vertex belongs to the lowest submap among its faces."""
    submap = np.full(len(mesh.vertices), mesh.submap.max(initial=0))
    np.minimum.at(submap, mesh.faces.ravel(), np.repeat(mesh.submap, 3))
    edges, _ = edges_of(mesh.faces, len(mesh.vertices))
    return WireMesh(mesh.vertices, edges, submap, submap[edges[:, 0]] != submap[edges[:, 1]])


def reported(step: Callable[[], Result], stage: str, progress: Progress) -> Result:
    """What a step returns; its beginning and end are told."""
    progress(stage, 0, 1)
    result = step()
    progress(stage, 1, 1)
    return result
