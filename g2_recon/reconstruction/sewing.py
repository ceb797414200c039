# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What has changed of a mesh is sewn into what was there before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from g2_recon.geometry.point_tree import are_near
from g2_recon.geometry.union_find import linked
from g2_recon.reconstruction.mesh_of_submaps import Sheet, without_loose_vertices

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Cells away from a change: what differs so near has come of it; faces are compared up to here, and have their vertices
# up to here.
_OF_CHANGE, _COMPARED, _VERTICES = 3.0, 6.0, 8.0
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
    asked, new_asked = (are_near(sheet.vertices, changed, _VERTICES * cell, workers) for sheet in (before, new))
    number, added = _numbers(before, new, asked, new_asked, _SAME * cell)
    vertices = np.concatenate([before.vertices, new.vertices[added]])
    inside = are_near(vertices, changed, _COMPARED * cell, workers)
    vertices[number[inside[number]]] = new.vertices[inside[number]]
    faces, submap = number[new.faces], before.submap.copy()
    looked_at, new_looked_at = (np.flatnonzero(inside[each].any(axis=1)) for each in (before.faces, faces))
    same, new_same = _in_both(before.faces[looked_at], faces[new_looked_at], len(vertices))
    submap[looked_at[same]] = new.submap[new_looked_at[new_same]]
    gone, come = np.delete(looked_at, same), np.delete(new_looked_at, new_same)
    piece = _hanging_together(np.concatenate([before.faces[gone], faces[come]]), len(vertices))
    uncertain, of_change = np.zeros((2, len(vertices)), bool)
    uncertain[piece[~inside]] = True
    of_change[piece[are_near(vertices, changed, _OF_CHANGE * cell, workers)]] = True
    if (uncertain & of_change).any():
        return None
    gone, come = gone[~uncertain[piece[before.faces[gone, 0]]]], come[~uncertain[piece[faces[come, 0]]]]
    stays = np.ones(len(before.faces), bool)
    stays[gone] = False
    mesh = without_loose_vertices(vertices, np.concatenate([before.faces[stays], faces[come]]))
    return Sheet(*mesh, np.concatenate([submap[stays], new.submap[come]]))


def _numbers(before: Sheet, new: Sheet, of_before: Mask, of_new: Mask, tolerance: float) -> tuple[Int, Int]:
    """The number (W,) of each vertex of the new sheet, and those (A,) that were not there before: theirs come last.

    One of the mask of_new is one of of_before where the two are nearest to each other, and within the tolerance (m).
    """
    among, rows = _used(before, of_before), _used(new, of_new)
    number = np.full(len(new.vertices), _UNKNOWN)
    if len(among) and len(rows):
        old, come = before.vertices[among], new.vertices[rows]
        distance, place = cKDTree(old).query(come, distance_upper_bound=tolerance)
        near = np.flatnonzero(distance < np.inf)
        # Copies of a vertex lie close to each other: each has one that it is.
        same = near[cKDTree(come).query(old[place[near]])[1] == near]
        number[rows[same]] = among[place[same]]
    added = np.flatnonzero(number == _UNKNOWN)
    number[added] = len(before.vertices) + np.arange(len(added))
    return number, added


def _used(sheet: Sheet, which: Mask) -> Int:
    """Vertices of the mask that have a face."""
    used = np.zeros(len(which), bool)
    used[sheet.faces] = True
    return np.flatnonzero(used & which)


def _in_both(some: Int, others: Int, count: int) -> tuple[Int, Int]:
    """Which of some faces (F, 3) are also among others (G, 3), and which these are there; `count` vertices.

    Each corner of a face may be its first.
    """
    # Beyond 2 million vertices two faces may have the same number, but they will not meet here.
    keys, others_keys = (_first_corner_least(faces) @ [count**2, count, 1] for faces in (some, others))
    _, one, other = np.intersect1d(keys, others_keys, return_indices=True)
    return one, other


def _first_corner_least(faces: Int) -> Int:
    first = faces.argmin(axis=1)[:, None]
    return np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)


def _hanging_together(faces: Int, count: int) -> Int:
    """The piece (count,) that each vertex is of: faces that share one are of one piece."""
    one, other = faces[:, [0, 0]].ravel(), faces[:, 1:].ravel()
    return np.asarray(linked(one, other, count)[0])
