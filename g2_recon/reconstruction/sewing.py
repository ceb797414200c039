# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What has changed of a mesh is sewn into what was there before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from g2_recon.reconstruction.mesh_of_submaps import Sheet
from g2_recon.reconstruction.support import are_near

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Cells away from a change: what differs so near has come of it; both sheets are compared up to here.
_OF_CHANGE, _COMPARED = 3.0, 6.0
MADE_ANEW = 9.0
"""So many cells away from a change the new sheet has to reach: where it is cut off it differs from the whole."""

# A vertex may be the same if it has moved by less than so many cells: bends are fitted to no more than a precision.
_SAME = 0.02

_UNKNOWN = -1


def sewn(changed: Float, before: Sheet, new: Sheet, cell: float, workers: int) -> Sheet | None:
    """The sheet before (V, 3) with what the new one has otherwise near the places (M, 3) that have changed.

    Both are the same but for pieces that hang together, and each piece can be of the one or of the other. A piece that
    reaches so far from all changes that the cut of the new sheet may show in it stays as it was; None where such a one
    is also near a change: then all has to be made anew. Faces and vertices that stay keep their order.
    """
    inside, new_inside = (are_near(sheet.vertices, changed, _COMPARED * cell, workers) for sheet in (before, new))
    number = _found_again(before, new, inside, new_inside, _SAME * cell)
    added, known = np.flatnonzero(number == _UNKNOWN), np.flatnonzero(number != _UNKNOWN)
    number[added] = len(before.vertices) + np.arange(len(added))
    vertices = np.concatenate([before.vertices, new.vertices[added]])
    vertices[number[known]] = new.vertices[known]
    inside = np.concatenate([inside, new_inside[added]])
    faces = number[new.faces]
    gone, come = _only_in_one(before.faces, faces, inside)
    differing = np.concatenate([before.faces[gone], faces[come]])
    piece = _hanging_together(differing, len(vertices))
    uncertain, of_change = np.zeros((2, len(vertices)), bool)
    uncertain[piece[~inside]] = True
    corners = np.unique(differing)
    of_change[piece[corners[are_near(vertices[corners], changed, _OF_CHANGE * cell, workers)]]] = True
    if (uncertain & of_change).any():
        return None
    gone, come = gone[~uncertain[piece[before.faces[gone, 0]]]], come[~uncertain[piece[faces[come, 0]]]]
    stays = np.ones(len(before.faces), bool)
    stays[gone] = False
    used, corners = np.unique(np.concatenate([before.faces[stays], faces[come]]), return_inverse=True)
    return Sheet(
        vertices[used],
        corners.reshape(-1, 3).astype(np.int64),
        np.concatenate([before.submap[stays], new.submap[come]]),
    )


def _found_again(before: Sheet, new: Sheet, of_before: Mask, of_new: Mask, tolerance: float) -> Int:
    """Which vertex of the sheet before each one (W,) of the new one is, of those that masks name; -1 for none."""
    number = np.full(len(new.vertices), _UNKNOWN)
    among, rows = _used(before, of_before), _used(new, of_new)
    if len(among) and len(rows):
        old, come = before.vertices[among], new.vertices[rows]
        distance, place = cKDTree(old).query(come, distance_upper_bound=tolerance)
        near = np.flatnonzero(distance < np.inf)
        # Copies of a vertex lie close to each other: each has one that it is.
        same = near[cKDTree(come).query(old[place[near]])[1] == near]
        number[rows[same]] = among[place[same]]
    return number


def _used(sheet: Sheet, which: Mask) -> Int:
    """Vertices of the mask that have a face."""
    used = np.zeros(len(which), bool)
    used[sheet.faces] = True
    return np.flatnonzero(used & which)


def _only_in_one(some: Int, others: Int, inside: Mask) -> tuple[Int, Int]:
    """Which of the faces (F, 3) with a vertex inside (V,) are not among others (G, 3), and the other way round.

    Each corner of a face may be its first.
    """
    one, other = np.flatnonzero(inside[some].any(axis=1)), np.flatnonzero(inside[others].any(axis=1))
    size = len(inside)
    keys, their_keys = (_in_order(faces) @ [size**2, size, 1] for faces in (some[one], others[other]))
    return one[~np.isin(keys, their_keys)], other[~np.isin(their_keys, keys)]


def _in_order(faces: Int) -> Int:
    first = faces.argmin(axis=1)[:, None]
    return np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)


def _hanging_together(faces: Int, count: int) -> Int:
    """The piece (count,) that each vertex is of: faces that share one are of one piece."""
    one, other = faces[:, [0, 0]].ravel(), faces[:, 1:].ravel()
    graph = csr_array((np.ones(len(one), bool), (one, other)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])
