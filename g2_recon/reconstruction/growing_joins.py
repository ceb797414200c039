# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Phases 3 and 4 of a cloud that grows: new submaps are joined to the faces there are, and what is around finished."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from g2_recon.config import ReconstructionConfig
from g2_recon.geometry.mesh import Mesh
from g2_recon.geometry.point_grid import point_grid
from g2_recon.geometry.point_tree import are_near
from g2_recon.progress import Progress
from g2_recon.reconstruction.growing_state import State, renumbered
from g2_recon.reconstruction.mesh_of_submaps import (
    NO_FACES,
    Sheet,
    data_of,
    finished,
    join,
    sound_cells,
    usual_edge,
    without_scraps,
)
from g2_recon.reconstruction.sewing import MADE_ANEW, sewn
from g2_recon.reconstruction.solid import check_covered, reported
from g2_recon.reconstruction.support import supported

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Where a larger share of the faces is joined anew, all are: it takes no longer.
_MOST_JOINED = 0.5


class _Some(NamedTuple):
    """Some of what there is. points: rows (n,) of those on a surface. neurons: (v,). faces: mask (F,)."""

    points: Int
    neurons: Int
    faces: Mask


def join_changed(state: State, config: ReconstructionConfig, progress: Progress) -> Mesh:
    """Phases 3 and 4: join the cells of new submaps to the faces there are and finish what is around; the mesh."""
    check_covered(state.neurons.places)

    def work() -> Mesh:
        faces, sheet = _changed_only(state, config) or _joined(state, _all_of(state), config)
        mesh = without_scraps(sheet, config)
        check_covered(mesh.faces)
        state.neurons, state.faces, state.sheet = replace(state.neurons, cells=NO_FACES), faces, sheet
        state.loose, state.gone = np.zeros(len(state.loose), bool), np.empty((0, 3))
        return mesh

    return reported(work, "joining", progress)


def _changed_only(state: State, config: ReconstructionConfig) -> tuple[Int, Sheet] | None:
    """The faces and the sheet where only what is around changes is joined and finished; None where it is too much.

    Creases, bends, borders and holes hang on what is within some cells.
    """
    if state.sheet is None:
        return None
    workers = config.workers or os.cpu_count() or 1
    changed = np.concatenate([state.neurons.places[state.loose], state.gone])
    if not len(changed):
        return state.faces, state.sheet
    some = _some_around(state, changed, config, workers)
    if some is None:
        return None
    faces, new = _joined(state, some, config)
    sheet = sewn(changed, state.sheet, new, config.spacing, workers)
    return None if sheet is None else (np.concatenate([state.faces[~some.faces], faces]), sheet)


def _some_around(state: State, changed: Float, config: ReconstructionConfig, workers: int) -> _Some | None:
    """What is around the places (M, 3) that have changed; None where that is most of it."""
    distance = MADE_ANEW * config.spacing
    neurons = are_near(state.neurons.places, changed, distance, workers)
    faces: Mask = np.asarray(neurons[state.faces].any(axis=1))
    if not faces.any() or faces.mean() > _MOST_JOINED:
        return None
    neurons[state.faces[faces]] = True
    owner = state.points.owner
    points = state.points.on_surface & np.where(owner >= 0, neurons[owner], False)
    free = np.flatnonzero(state.points.on_surface & (owner < 0))
    points[free] = are_near(state.points.own[free], changed, distance, workers)
    return _Some(np.flatnonzero(points), np.flatnonzero(neurons), faces)


def _all_of(state: State) -> _Some:
    points = np.flatnonzero(state.points.on_surface)
    return _Some(points, np.arange(len(state.neurons.places)), np.ones(len(state.faces), bool))


def _joined(state: State, some: _Some, config: ReconstructionConfig) -> tuple[Int, Sheet]:
    """The faces (F, 3), and the sheet that they become, of some of what there is and of all new cells."""
    known, rows = state.neurons, some.neurons
    data = data_of(
        state.points.own[some.points],
        renumbered(state.points.neighbors, some.points),
        config,
        config.workers or os.cpu_count() or 1,
    )
    number = np.full(len(known.places) + 1, -1)
    number[rows] = np.arange(len(rows))
    neurons = known.take(rows, cells=number[known.cells], owner=number[state.points.owner[some.points]])
    sound = sound_cells(neurons, data, number[state.faces[some.faces]])
    # As of all, so that the front goes as far as it would there.
    edge = usual_edge(known, np.concatenate([state.faces[~some.faces], rows[sound]]), config)
    joined = join(neurons, sound, data, config, edge=edge)
    # Elsewhere the front would only try again what it could not do before.
    where = state.loose[rows][joined.faces].any(axis=1) | (np.arange(len(joined.faces)) < len(sound))
    joined = Sheet(joined.vertices, joined.faces[where], joined.submap[where])
    return rows[joined.faces], finished(joined, neurons, data, config)


def leave_what_has_data(state: State, config: ReconstructionConfig) -> None:
    """Take the faces away under which points are gone."""
    workers = config.workers or os.cpu_count() or 1
    near = config.support_distance or config.spacing
    grid = point_grid(state.points.own, cell=near / math.sqrt(3))
    stays = supported(state.neurons.places, state.faces, grid, near, workers)
    state.loose = state.loose.copy()
    state.loose[state.faces[~stays]] = True
    state.faces = state.faces[stays]


def leave_out_submaps(state: State, stale: NDArray[np.int32]) -> None:
    """Take the submaps of these names away, and the faces that touch them."""
    known = state.neurons
    keep = ~np.isin(known.submap, stale)
    number = np.where(keep, np.cumsum(keep) - 1, -1)
    state.gone = np.concatenate([state.gone, known.places[~keep]])
    state.neurons = known.take(keep, cells=NO_FACES, owner=np.empty(0, np.int64))
    owner = state.points.owner
    owner = np.where(owner >= 0, number[owner], -1).astype(np.int32)
    state.points = replace(state.points, owner=owner)
    stays = keep[state.faces].all(axis=1)
    loose = np.zeros(len(keep), bool)
    loose[state.faces[~stays]] = True
    state.loose = loose[keep]
    state.faces = number[state.faces[stays]]
