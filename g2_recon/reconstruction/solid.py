# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Mode solid: the phases of the paper with what it names as future work (section 7), to a mesh of triangles.

Flat clusters that are the walls, maps as large as these, batch training, an optimizing join, and triangles throughout.
"""

from __future__ import annotations

import math
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
from g2_recon.geometry.point_grid import PointGrid, point_grid
from g2_recon.progress import Progress, silent
from g2_recon.reconstruction.advancing_front import join_submaps
from g2_recon.reconstruction.clustering.flat import FlatClusters, flat_clusters
from g2_recon.reconstruction.creases import insert_creases
from g2_recon.reconstruction.fitting import fit_to_points
from g2_recon.reconstruction.flat_submaps import FlatSubmaps, train_submaps
from g2_recon.reconstruction.mesh_repair import (
    extend_borders,
    fill_small_loops,
    large_pieces,
    remove_crossings,
    split_pinched,
)
from g2_recon.reconstruction.own_frame import own_frame
from g2_recon.reconstruction.result import Reconstruction
from g2_recon.reconstruction.support import on_own_data, supported
from g2_recon.reconstruction.surface_points import SurfacePoints, prepare

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Result = TypeVar("Result")

# Everything scales with the spacing of the neurons; these shares of it were found at 20 cm, which suits a building.
_RADIUS = 1.25
_OFF_PLANE = 0.75
_PATCH_CELLS = 40.0
_PATCH_SIZE = 4.0
_FLATNESS = 0.2
# A triangle between submaps has sides of at most this many thetas of the usual edge: its apex faces an edge.
_REACH = 1.25
# A border moves outwards by less than one cell.
_FARTHEST_EXTENSION = 0.9
# The fit looks for data of a triangle in this part of a cell around it.
_FARTHEST_FIT = 0.25
# A piece of less than this many cells, such as the strip that a single scan saw, or of a single face is no surface
# that one would see.
_LEAST_PIECE = 0.5
# Coordinates are whole multiples of this share of the spacing, a micrometre at 20 cm: faces of one wall would else be
# coplanar to the last bit, which exact tests of other tools take for overlap.
_GRAIN = 5e-6
# A cell whose triangle turns away from the surface of its neurons by more than 73 deg is folded.
_LEAST_AGREEMENT = 0.3


def reconstruct_solid(cloud: Cloud, config: ReconstructionConfig, *, progress: Progress = silent) -> Reconstruction:
    """Reconstruct a surface as a manifold, consistently oriented mesh of triangles.

    Raises InputError where the cloud has too few points on a surface, or these cover none of it.
    """
    workers = config.workers or os.cpu_count() or 1
    frame = own_frame(cloud.points)
    surface = _reported(lambda: find_surface(frame.of(cloud), config, workers), "normals", progress)
    clusters = _reported(lambda: find_clusters(surface, config, workers), "clustering", progress)
    submaps, owner = build_submaps(surface, clusters, config, workers, progress)
    mesh = _reported(lambda: triangulate(surface, submaps, owner, config, workers), "joining", progress)
    if not len(mesh.faces):
        raise InputError(
            "the cloud holds no patch of surface that its points cover",
            advice="choose a larger spacing where points are far apart, or a smaller one where the surface is small",
        )
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
        radius=_RADIUS * config.spacing,
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


def triangulate(
    surface: SurfacePoints, submaps: FlatSubmaps, owner: Int, config: ReconstructionConfig, workers: int
) -> Mesh:
    """Phases 3 and 4: cells where there is data, an optimizing join, creases, and borders fitted to the data."""
    near = config.support_distance or config.spacing
    # In cells of this size any point of an occupied one is near enough.
    grid = point_grid(surface.points, cell=near / math.sqrt(3))
    used = submaps.hits > 0
    number = np.where(used, np.cumsum(used) - 1, -1)
    owner = np.where(owner >= 0, number[owner], -1)
    neurons, normals, submap = submaps.vertices[used], submaps.normals[used], submaps.submap[used]
    cells = number[submaps.faces[sound_cells(submaps, grid, near)]]
    point_submap = np.where(owner >= 0, submap[owner], -1)
    cells = cells[on_own_data(neurons, cells, submap[cells[:, 0]], grid, point_submap, near)]
    cells = cells[remove_crossings(neurons, cells, neurons)[1]]
    edge = _usual_edge(neurons, cells, config.spacing)
    joins = join_submaps(
        neurons, normals, cells, grid, reach=_REACH * config.theta * edge, spacing=edge, support_distance=near
    )
    joined = np.concatenate([cells, joins])
    joined, joined_submap = _filled(neurons, joined, submap[joined[:, 0]], grid, near)
    creased = insert_creases(neurons, joined, normals, submaps.center[used], submap)
    vertices, faces, face_submap = creased.vertices, creased.faces, joined_submap[creased.origin]
    # Without a normal a crease vertex moves along its crease only.
    normals = np.concatenate([normals, np.zeros((len(vertices) - len(normals), 3))])
    bent = submaps.bent[submap]
    free = np.concatenate([bent, touching(faces, bent, len(vertices))[len(bent) :]])
    near_bent = touching(faces, free, len(vertices))
    fitted = fit_to_points(
        vertices,
        faces,
        free,
        surface.points[(owner >= 0) & near_bent[owner]],
        limit=_FARTHEST_FIT * config.spacing,
        workers=workers,
    )
    limit = _FARTHEST_EXTENSION * config.spacing
    extended = extend_borders(fitted, faces, normals, surface.points, surface.neighbors, owner, limit=limit)
    vertices, sound = remove_crossings(extended, faces, vertices)
    faces, face_submap = _filled(vertices, faces[sound], face_submap[sound], grid, near)
    vertices, faces, kept = _parted(vertices, faces, _GRAIN * config.spacing)
    face_submap = face_submap[kept]
    large = large_pieces(vertices, faces, least_area=_LEAST_PIECE * config.spacing**2)
    vertices, faces = _without_unused(vertices, faces[large])
    return Mesh(vertices, faces, face_submap[large])


def sound_cells(submaps: FlatSubmaps, grid: PointGrid, support_distance: float) -> NDArray[np.bool_]:
    """Mask (F,) of the triangles of cells that are covered by data and not folded, and whose neurons have data."""
    first, second, third = (submaps.vertices[submaps.faces[:, corner]] for corner in range(3))
    normal = np.cross(second - first, third - first)
    length = np.linalg.norm(normal, axis=1)
    along = np.einsum("fi,fi->f", normal, submaps.normals[submaps.faces[:, 0]])
    return np.asarray(
        supported(submaps.vertices, submaps.faces, grid, support_distance)
        & (along > _LEAST_AGREEMENT * length)
        & (submaps.hits[submaps.faces] > 0).all(axis=1)
    )


def wire_of(mesh: Mesh) -> WireMesh:
    """The vertices and edges of a mesh as a wire mesh; a vertex belongs to the lowest submap among its faces."""
    submap = np.full(len(mesh.vertices), len(mesh.submap) + 1)
    np.minimum.at(submap, mesh.faces.ravel(), np.repeat(mesh.submap, 3))
    edges, _ = edges_of(mesh.faces, len(mesh.vertices))
    return WireMesh(mesh.vertices, edges, submap, submap[edges[:, 0]] != submap[edges[:, 1]])


def touching(faces: Int, which: NDArray[np.bool_], count: int) -> NDArray[np.bool_]:
    """Mask (count,) of the vertices that share a face with one of `which` (count,) or its first vertices."""
    mask = np.zeros(count, bool)
    mask[: len(which)] = which
    mask[faces[mask[faces].any(axis=1)]] = True
    return mask


def _usual_edge(vertices: Float, faces: Int, spacing: float) -> float:
    """Median length in metres of an edge of the cells; the spacing where there are none."""
    if not len(faces):
        return spacing
    return float(np.median(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1)))


def _filled(vertices: Float, faces: Int, submap: Int, grid: PointGrid, near: float) -> tuple[Int, Int]:
    """Faces (F', 3) and their submaps after small holes with data in them are closed; a new face takes a neighbor's."""
    new = fill_small_loops(vertices, faces, grid, support_distance=near)
    beside = np.zeros(len(vertices), np.int64)
    beside[faces] = submap[:, None]
    return np.concatenate([faces, new]), np.concatenate([submap, beside[new[:, 0]]])


def _parted(vertices: Float, faces: Int, grain: float) -> tuple[Float, Int, Int]:
    """Vertices (V', 3) in multiples of the grain (m), faces (F', 3), one fan a vertex, and which (F',) faces stay.

    The copies of a vertex move into their fans, which may take one through another where that lies around it, and so
    may rounding. A face is dropped there; it may leave two fans behind, so this is repeated.
    """
    kept: Int = np.arange(len(faces))
    while True:
        parted, split, _ = split_pinched(vertices, faces)
        parted = np.round(parted / grain) * grain
        _, sound = remove_crossings(parted, split, parted)
        if sound.all():
            return parted, split, kept
        faces, kept = faces[sound], kept[sound]


def _without_unused(vertices: Float, faces: Int) -> tuple[Float, Int]:
    used, number = np.unique(faces, return_inverse=True)
    return vertices[used], number.reshape(-1, 3).astype(np.int64)


def _reported(step: Callable[[], Result], stage: str, progress: Progress) -> Result:
    progress(stage, 0, 1)
    result = step()
    progress(stage, 1, 1)
    return result
