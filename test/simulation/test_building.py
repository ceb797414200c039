# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from g2_recon.simulation.building import Building, box, first_floor, room, surfaces, triangles

BLOCK = box((0, 5), (0, 4), (-1, 3))


def areas(vertices, faces):
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    return np.linalg.norm(np.cross(second - first, third - first), axis=1) / 2


def enclosed_volume(vertices, faces):
    """Volume of what the faces enclose, after Gauss; negative where they look inwards."""
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->", first, np.cross(second, third)) / 6)


def test_a_room_has_six_faces_that_look_inwards():
    rectangles = surfaces(Building(BLOCK, (room((1, 4), (1, 3), 2.5),), ()))
    vertices, faces = triangles(rectangles)
    assert len(rectangles.axis) == 6
    assert enclosed_volume(vertices, faces) == pytest.approx(-3 * 2 * 2.5)


def test_surfaces_of_touching_boxes_are_counted_once():
    cupboard = (box((1, 2), (1, 2), (0, 1)), box((1, 2), (1, 2), (1, 2)))
    vertices, faces = triangles(surfaces(Building(BLOCK, (room((1, 4), (1, 3), 2.5),), cupboard)))
    empty_room = 2 * (3 * 2 + 3 * 2.5 + 2 * 2.5)
    hidden_by_cupboard, added_by_cupboard = 1 + 2 * 2, 1 + 2 * 2
    assert areas(vertices, faces).sum() == pytest.approx(empty_room - hidden_by_cupboard + added_by_cupboard)


def test_an_opening_to_the_outside_leaves_a_hole():
    window = box((4, 5), (1.5, 2.5), (1, 2))
    vertices, faces = triangles(surfaces(Building(BLOCK, (room((1, 4), (1, 3), 2.5), window), ())))
    assert areas(vertices, faces).sum() == pytest.approx(2 * (3 * 2 + 3 * 2.5 + 2 * 2.5) - 1 + 4)


def test_rectangles_are_sorted_by_axis():
    assert (np.diff(surfaces(first_floor()).axis) >= 0).all()


def test_carved_and_placed_boxes_have_volume_and_lie_in_the_block():
    building = first_floor()
    low = np.array([part.low for part in (*building.carved, *building.placed)])
    high = np.array([part.high for part in (*building.carved, *building.placed)])
    assert (low < high).all() and (low >= building.block.low).all() and (high <= building.block.high).all()


def test_the_toilets_have_a_lower_ceiling():
    rectangles = surfaces(first_floor())
    ceilings = (rectangles.axis == 2) & (rectangles.side < 0) & (rectangles.offset > 2.2)
    assert {2.3, 2.8} == set(rectangles.offset[ceilings].round(3))
