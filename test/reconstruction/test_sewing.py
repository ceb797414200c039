# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry.edges import edges_of, half_edge_numbers
from g2_recon.reconstruction.mesh_of_submaps import Sheet
from g2_recon.reconstruction.sewing import MADE_ANEW, sewn

CELL = 0.2
HERE = np.array([[0.0, 0.0, 0.0]])


def plane(half=15, seed=0):
    """Two triangles a cell, so many cells to each side of the origin; vertices lie a little aside, at random."""
    along = np.arange(-half, half + 1)
    count = len(along)
    x, y = np.meshgrid(along, along, indexing="ij")
    aside = np.random.default_rng(seed).uniform(-0.2, 0.2, (count * count, 3))
    number = np.arange(count * count).reshape(count, count)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    places = CELL * (np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]) + aside)
    return Sheet(places, faces, np.zeros(len(faces), np.int64))


def cut_out(sheet, keep, seed=1):
    """The faces of a mask, faces and vertices in another order, their first corners, too, and names one higher."""
    rng = np.random.default_rng(seed)
    faces, submap = sheet.faces[keep], sheet.submap[keep] + 1
    used = rng.permutation(np.unique(faces))
    number = np.full(len(sheet.vertices), -1)
    number[used] = np.arange(len(used))
    turned = (rng.integers(0, 3, len(faces))[:, None] + np.arange(3)) % 3
    order = rng.permutation(len(faces))
    return Sheet(sheet.vertices[used], number[np.take_along_axis(faces, turned, axis=1)][order], submap[order])


def away(sheet):
    """Cells from the origin (F,) to the nearest corner of each face."""
    return np.linalg.norm(sheet.vertices[sheet.faces], axis=2).min(axis=1) / CELL


def around(sheet, cells=MADE_ANEW):
    return cut_out(sheet, away(sheet) < cells)


def without(sheet, gone):
    return Sheet(sheet.vertices, sheet.faces[~gone], sheet.submap[~gone])


def surface(sheet):
    """Corners of the faces, in an order of their own."""
    corners = np.round(sheet.vertices[sheet.faces], 9)
    first = np.lexsort(corners.transpose(2, 0, 1), axis=1)[:, :1]
    turned = np.take_along_axis(corners, ((first + np.arange(3)) % 3)[:, :, None], axis=1).reshape(-1, 9)
    return turned[np.lexsort(turned.T)]


def assert_manifold(sheet):
    _, face_edges = edges_of(sheet.faces, len(sheet.vertices))
    assert np.bincount(half_edge_numbers(sheet.faces, face_edges).ravel()).max() == 1


def test_where_nothing_differs_all_stays_but_the_names_around():
    before = plane()
    after = sewn(HERE, before, around(before), CELL, 1)
    np.testing.assert_array_equal(after.vertices, before.vertices)
    np.testing.assert_array_equal(after.faces, before.faces)
    assert (after.submap[away(before) < 6] == 1).all()
    assert (after.submap[away(before) > 7] == 0).all()


def test_a_hole_near_a_change_is_taken_over_and_so_is_what_fills_it():
    whole = plane()
    holed = without(whole, away(whole) < 1.5)
    for before, then in ((whole, holed), (holed, whole)):
        after = sewn(HERE, before, around(then), CELL, 2)
        np.testing.assert_array_equal(surface(after), surface(then))
        assert len(np.unique(after.faces)) == len(after.vertices)
        assert_manifold(after)


def test_other_triangles_between_the_same_vertices_replace_those_before():
    before = plane()
    faces = before.faces.copy()
    half = len(faces) // 2
    turned = np.flatnonzero((away(before)[:half] < 2) & (away(before)[half:] < 2))
    a, b, c = faces[turned].T
    d = faces[half + turned, 2]
    faces[turned], faces[half + turned] = np.column_stack([a, b, d]), np.column_stack([b, c, d])
    other = Sheet(before.vertices, faces, before.submap)
    after = sewn(HERE, before, around(other), CELL, 1)
    assert 8 < len(turned) < 40
    np.testing.assert_array_equal(surface(after), surface(other))
    assert_manifold(after)


def test_a_vertex_that_has_moved_a_little_is_where_the_new_sheet_has_it_and_one_that_moved_far_too():
    before = plane()
    for step in (0.01 * CELL, 0.5 * CELL):
        moved = Sheet(before.vertices.copy(), before.faces, before.submap)
        moved.vertices[np.linalg.norm(before.vertices, axis=1) < 1.5 * CELL, 2] += step
        after = sewn(HERE, before, around(moved), CELL, 1)
        np.testing.assert_array_equal(surface(after), surface(moved))
        assert_manifold(after)


def test_what_differs_where_the_new_sheet_is_cut_off_stays_as_it_was():
    before = plane()
    # As where borders are moved outwards, and small pieces left out.
    cut = around(before)
    cut.vertices[np.linalg.norm(cut.vertices, axis=1) > 8 * CELL, 2] += 0.3
    cut = without(cut, np.linalg.norm(cut.vertices[cut.faces[:, 0]] - (8 * CELL, 0, 0), axis=1) < 1.9 * CELL)
    after = sewn(HERE, before, cut, CELL, 1)
    np.testing.assert_array_equal(surface(after), surface(before))


def test_a_piece_apart_from_the_change_is_of_the_new_sheet_where_it_ends_before_the_cut():
    before = plane()
    apart = np.linalg.norm(before.vertices[before.faces].mean(axis=1) - (4.5 * CELL, 0, 0), axis=1) < 0.7 * CELL
    holed = without(before, apart)
    assert apart.any()
    after = sewn(HERE, before, around(holed), CELL, 1)
    np.testing.assert_array_equal(surface(after), surface(holed))


def test_a_change_that_reaches_to_the_cut_asks_for_all_anew():
    before = plane()
    slit = without(before, np.abs(before.vertices[before.faces].mean(axis=1)[:, 1]) < 0.5 * CELL)
    assert sewn(HERE, before, around(slit), CELL, 1) is None


def test_copies_of_a_vertex_that_lie_close_to_each_other_are_told_apart():
    before = plane()
    # Faces above the x axis hang on copies of the vertices there, a hundredth of a cell away.
    on_axis = np.flatnonzero(np.abs(before.vertices[:, 1]) < 0.4 * CELL)
    copy = np.arange(len(before.vertices))
    copy[on_axis] = len(before.vertices) + np.arange(len(on_axis))
    above = before.vertices[before.faces].mean(axis=1)[:, 1] > 0
    faces = np.where(above[:, None], copy[before.faces], before.faces)
    split = Sheet(
        np.concatenate([before.vertices, before.vertices[on_axis] + (0, 0.01 * CELL, 0)]), faces, before.submap
    )
    holed = without(split, away(split) < 1.5)
    after = sewn(HERE, split, around(holed), CELL, 1)
    np.testing.assert_array_equal(surface(after), surface(holed))
    assert_manifold(after)


@pytest.mark.parametrize("seed", range(8))
def test_any_change_is_the_same_as_in_the_whole_sheet(seed):
    rng = np.random.default_rng(seed)
    before = plane(seed=seed)
    changed = rng.uniform(-3, 3, (3, 3)) * CELL * (1, 1, 0)

    def off(sheet):
        return np.linalg.norm(sheet.vertices[sheet.faces][:, :, None] - changed, axis=3).min(axis=(1, 2)) / CELL

    then = without(before, (rng.random(len(before.faces)) < 0.5) & (off(before) < 2.5))
    after = sewn(changed, before, cut_out(then, off(then) < MADE_ANEW, seed), CELL, 1)
    np.testing.assert_array_equal(surface(after), surface(then))
    assert_manifold(after)
