# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Phases 3 and 4 of mode solid: from trained submaps to one mesh of triangles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2_recon.config import ReconstructionConfig
from g2_recon.geometry.mesh import Mesh
from g2_recon.geometry.point_grid import PointGrid, point_grid
from g2_recon.geometry.triangles import area_vectors
from g2_recon.reconstruction.advancing_front import join_submaps
from g2_recon.reconstruction.creases import insert_creases
from g2_recon.reconstruction.fitting import fit_to_points
from g2_recon.reconstruction.flat_submaps import FlatSubmaps
from g2_recon.reconstruction.mesh_repair import (
    bridge_pinches,
    extend_borders,
    fill_small_loops,
    large_pieces,
    remove_crossings,
    split_pinched,
)
from g2_recon.reconstruction.support import on_own_data, supported
from g2_recon.reconstruction.surface_points import SurfacePoints

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

# A triangle between submaps has sides of at most this many thetas of the usual edge: its apex faces an edge.
_REACH = 1.25
# A border moves outwards by less than one cell.
_FARTHEST_EXTENSION = 0.9
# The fit looks for data of a triangle in this part of a cell around it.
_FARTHEST_FIT = 0.25
# Holes of at most so many edges are closed: eight, a cell and what is around it, until creases and the ends of the data
# have their vertices, as a lid over a corner of the room would cut that off. Strips half a cell wide have more of them.
_JOINED_HOLE, _FINISHED_HOLE = 8, 16
# Coordinates are whole multiples of this share of the spacing, a micrometre at 20 cm: faces of one wall would else be
# coplanar to the last bit, which exact tests of other tools take for overlap.
_GRAIN = 5e-6
# A cell whose triangle turns away from the surface of its neurons by more than 73 deg is folded.
_LEAST_AGREEMENT = 0.3

NO_FACES = np.empty((0, 3), np.int64)


@dataclass(frozen=True, slots=True)
class Neurons:
    """The neurons that have data.

    places, normals, centers: (V, 3), a center is a point of the tangent plane. submap: (V,). bent: (V,) whether it lies
    on a bend. cells: (C, 3) triangles of the lattices. owner: (N,) the neuron of each point, -1 for none.
    """

    places: Float
    normals: Float
    centers: Float
    submap: Int
    bent: Mask
    cells: Int
    owner: Int

    def take(self, rows: Int | Mask, *, cells: Int, owner: Int) -> Neurons:
        """Some of them; cells and owner as these are numbered then."""
        return Neurons(
            places=self.places[rows],
            normals=self.normals[rows],
            centers=self.centers[rows],
            submap=self.submap[rows],
            bent=self.bent[rows],
            cells=cells,
            owner=owner,
        )


@dataclass(frozen=True, slots=True)
class Sheet:
    """A mesh in the making: vertices (V, 3) m, the neurons first; faces (F, 3) and the submap (F,) of each."""

    vertices: Float
    faces: Int
    submap: Int


@dataclass(frozen=True, slots=True)
class Data:
    """The points (N, 3), the neighbors (N, 8) of each as in SurfacePoints, and a grid of them.

    near: m, so near they must lie to a triangle to support it. workers: on them.
    """

    points: Float
    neighbors: NDArray[np.int32]
    grid: PointGrid
    near: float
    workers: int


def mesh_of_submaps(
    surface: SurfacePoints, submaps: FlatSubmaps, owner: Int, config: ReconstructionConfig, workers: int
) -> Mesh:
    """The mesh of all submaps. owner: (N,) the neuron of each point of the surface, -1 for none."""
    data = data_of(surface.points, surface.neighbors, config, workers)
    neurons = with_data(submaps, owner)
    sound = sound_cells(neurons, data)
    joined = join(neurons, sound, data, config, edge=usual_edge(neurons, sound, config))
    return without_scraps(finished(joined, neurons, data, config), config)


def data_of(points: Float, neighbors: NDArray[np.int32], config: ReconstructionConfig, workers: int) -> Data:
    """The data of a mesh: points (N, 3) on the surface and their neighbors (N, 8)."""
    near = config.support_distance or config.spacing
    # In cells of this size any point of an occupied one is near enough.
    return Data(points, neighbors, point_grid(points, cell=near / math.sqrt(3)), near, workers)


def finished(joined: Sheet, neurons: Neurons, data: Data, config: ReconstructionConfig) -> Sheet:
    """Submaps that are joined, with their creases and borders."""
    creased = crease(joined, neurons)
    fitted = fit_bends(creased, neurons, data, config)
    extended = extend(fitted, creased, neurons, data, config)
    return finish(extended, data, config)


def with_data(submaps: FlatSubmaps, owner: Int) -> Neurons:
    """The neurons that are covered by data, numbered anew, and the cells between them."""
    used = submaps.covered
    number = np.where(used, np.cumsum(used) - 1, -1)
    submap = submaps.submap[used]
    return Neurons(
        places=submaps.vertices[used],
        normals=submaps.normals[used],
        centers=submaps.center[used],
        submap=submap,
        bent=submaps.bent[submap],
        cells=number[submaps.faces[used[submaps.faces].all(axis=1)]],
        owner=np.where(owner >= 0, number[owner], -1),
    )


def sound_cells(neurons: Neurons, data: Data, known: Int = NO_FACES) -> Int:
    """The cells (C', 3) that are covered by data, that of their own submap, are not folded and cross no other.

    known: (K, 3) faces between the neurons that are sound already and come first in the result.
    """
    cells = neurons.cells
    normal = area_vectors(neurons.places, cells)
    along = np.einsum("fi,fi->f", normal, neurons.normals[cells[:, 0]])
    upright = along > _LEAST_AGREEMENT * np.linalg.norm(normal, axis=1)
    cells = cells[upright & supported(neurons.places, cells, data.grid, data.near, data.workers)]
    label = np.where(neurons.owner >= 0, neurons.submap[neurons.owner], -1)
    submap = neurons.submap[cells[:, 0]]
    cells = cells[on_own_data(neurons.places, cells, submap, data.grid, label, data.near, data.workers)]
    faces = np.concatenate([known, cells])
    new = np.arange(len(faces)) >= len(known)
    return np.asarray(
        faces[remove_crossings(neurons.places, faces, neurons.places, among=new, workers=data.workers)[1]]
    )


def usual_edge(neurons: Neurons, faces: Int, config: ReconstructionConfig) -> float:
    """The usual length, m, of the edges of cells; faces: (F, 3) these, and maybe others."""
    cells = faces[(neurons.submap[faces] == neurons.submap[faces[:, :1]]).all(axis=1)]
    if not len(cells):
        return config.spacing
    return float(np.median(np.linalg.norm(neurons.places[cells[:, 0]] - neurons.places[cells[:, 1]], axis=1)))


def join(neurons: Neurons, sound: Int, data: Data, config: ReconstructionConfig, *, edge: float) -> Sheet:
    """Phase 3: the strips between the submaps, and the small holes that the front left.

    sound: (F, 3) the cells of the submaps, and strips that are there already. edge: m, usual length in the cells of all
    submaps, of which these may be some.
    """
    joins = join_submaps(
        neurons.places,
        neurons.normals,
        sound,
        data.grid,
        reach=_REACH * config.theta * edge,
        spacing=edge,
        support_distance=data.near,
    )
    faces = np.concatenate([sound, joins])
    joined = Sheet(neurons.places, faces, neurons.submap[faces[:, 0]])
    faces = _filled(joined, data, max_edges=_JOINED_HOLE).faces
    return Sheet(neurons.places, faces, neurons.submap[faces[:, 0]])


def crease(sheet: Sheet, neurons: Neurons) -> Sheet:
    """Vertices where the planes of neighboring submaps meet."""
    creased = insert_creases(sheet.vertices, sheet.faces, neurons.normals, neurons.centers, neurons.submap)
    return Sheet(creased.vertices, creased.faces, sheet.submap[creased.origin])


def fit_bends(sheet: Sheet, neurons: Neurons, data: Data, config: ReconstructionConfig) -> Sheet:
    """Phase 4, where the surface is curved: the triangles, not only the neurons, lie amid the points."""
    count = len(sheet.vertices)
    # A crease moves where it touches a bend.
    free = np.concatenate([neurons.bent, _touching(sheet.faces, neurons.bent, count)[len(neurons.bent) :]])
    around = _touching(sheet.faces, free, count)
    points = data.points[(neurons.owner >= 0) & around[neurons.owner]]
    limit = _FARTHEST_FIT * config.spacing
    vertices = fit_to_points(sheet.vertices, sheet.faces, free, points, limit=limit, workers=data.workers)
    return Sheet(vertices, sheet.faces, sheet.submap)


def extend(sheet: Sheet, home: Sheet, neurons: Neurons, data: Data, config: ReconstructionConfig) -> Sheet:
    """Phase 4, at borders that stay open: out to where the data ends. What crosses then goes back towards `home`."""
    # Without a normal a crease vertex moves along its crease only.
    normals = np.concatenate([neurons.normals, np.zeros((len(sheet.vertices) - len(neurons.normals), 3))])
    extended = extend_borders(
        sheet.vertices,
        sheet.faces,
        normals,
        data.points,
        data.neighbors,
        neurons.owner,
        limit=_FARTHEST_EXTENSION * config.spacing,
    )
    vertices, sound = remove_crossings(extended, sheet.faces, home.vertices, workers=data.workers)
    return Sheet(vertices, sheet.faces[sound], sheet.submap[sound])


def finish(sheet: Sheet, data: Data, config: ReconstructionConfig) -> Sheet:
    """The sheet with small holes closed, and one fan of faces a vertex."""
    grain = _GRAIN * config.spacing
    sheet = _with(sheet, bridge_pinches(sheet.vertices, sheet.faces, data.grid, support_distance=data.near))
    # Only where no two fans share a vertex has each hole a border of its own.
    vertices, faces, _ = split_pinched(sheet.vertices, sheet.faces)
    sheet = _filled(Sheet(vertices, faces, sheet.submap), data, max_edges=_FINISHED_HOLE)
    sheet = _parted(sheet, grain, data.workers)
    # Where a face was dropped there may be a hole again.
    return _filled(sheet, data, max_edges=_FINISHED_HOLE)


def without_scraps(sheet: Sheet, config: ReconstructionConfig) -> Mesh:
    """The mesh of a sheet."""
    # A piece of less than a cell is no surface that one would see.
    large = large_pieces(sheet.vertices, sheet.faces, least_area=config.spacing**2)
    return Mesh(*without_loose_vertices(sheet.vertices, sheet.faces[large]), sheet.submap[large])


def without_loose_vertices(vertices: Float, faces: Int) -> tuple[Float, Int]:
    """The vertices (V', 3) that have a face, in their order, and the faces (F, 3) between them."""
    used, number = np.unique(faces, return_inverse=True)
    return vertices[used], number.reshape(-1, 3).astype(np.int64)


def _filled(sheet: Sheet, data: Data, *, max_edges: int) -> Sheet:
    """The sheet with holes of so many edges closed where there is data."""
    return _with(
        sheet,
        fill_small_loops(sheet.vertices, sheet.faces, data.grid, support_distance=data.near, max_edges=max_edges),
    )


def _with(sheet: Sheet, new: Int) -> Sheet:
    """The sheet with new faces (T, 3); each takes the submap of a neighbor."""
    beside = np.zeros(len(sheet.vertices), np.int64)
    beside[sheet.faces] = sheet.submap[:, None]
    return Sheet(sheet.vertices, np.concatenate([sheet.faces, new]), np.concatenate([sheet.submap, beside[new[:, 0]]]))


def _parted(sheet: Sheet, grain: float, workers: int) -> Sheet:
    """The sheet with coordinates in multiples of the grain (m), one fan of faces a vertex, and no crossings.

    The copies of a vertex move into their fans, which may take one through another where that lies around it, and so
    may rounding. A face is dropped there; it may leave two fans behind, so this is repeated.
    """
    corners = None
    while True:
        vertices, faces, _ = split_pinched(sheet.vertices, sheet.faces)
        vertices = np.round(vertices / grain) * grain
        # What stays where it was has been looked at.
        moved = None if corners is None else (vertices[faces] != corners).any(axis=(1, 2))
        _, sound = remove_crossings(vertices, faces, vertices, among=moved, workers=workers)
        if sound.all():
            return Sheet(vertices, faces, sheet.submap)
        corners = vertices[faces[sound]]
        sheet = Sheet(sheet.vertices, sheet.faces[sound], sheet.submap[sound])


def _touching(faces: Int, which: Mask, count: int) -> Mask:
    """Mask (count,) of the vertices that share a face with one of `which`, a mask of all or the first of them."""
    mask = np.zeros(count, bool)
    mask[: len(which)] = which
    mask[faces[mask[faces].any(axis=1)]] = True
    return mask
