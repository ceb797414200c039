# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from g2_recon.geometry.intersections import crossing_pairs

TRIANGLE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
APART = np.array([[0, 1, 2], [3, 4, 5]])


def cross(other, faces=APART):
    return len(crossing_pairs(np.concatenate([TRIANGLE, np.array(other, float)]), np.array(faces))) == 1


def test_a_triangle_through_another_one_crosses_it():
    assert cross([[0.2, 0.2, -1], [0.3, 0.2, 1], [0.2, 0.3, 1]])


def test_a_triangle_above_another_one_does_not_cross_it():
    assert not cross(TRIANGLE + (0, 0, 0.01))


def test_a_triangle_through_the_plane_beside_another_one_does_not_cross_it():
    assert not cross([[0.8, 0.8, -1], [0.9, 0.8, 1], [0.8, 0.9, 1]])


def test_triangles_of_one_plane_cross_where_they_overlap():
    assert cross(TRIANGLE + (0.2, 0.2, 0))


def test_triangles_of_one_plane_that_touch_do_not_cross():
    assert not cross(TRIANGLE + (1, 0, 0))


def test_a_triangle_that_contains_another_one_crosses_it():
    assert cross([[-5, -5, 0], [5, -5, 0], [0, 5, 0]])


def test_triangles_that_share_a_vertex_may_touch_there():
    assert not cross([[-1, 0, 0], [0, -1, 0.5]], [[0, 1, 2], [0, 3, 4]])


def test_triangles_that_share_a_vertex_cross_beyond_it():
    assert cross([[0.5, 0.5, -0.3], [0.5, 0.5, 0.4]], [[0, 1, 2], [0, 3, 4]])


def test_triangles_of_one_plane_that_share_a_vertex_overlap_beside_it():
    assert cross([[1, 1, 0], [-1, 2, 0]], [[0, 1, 2], [0, 3, 4]])


def test_triangles_that_share_an_edge_are_neighbors():
    assert not cross([[1, 1, 0]], [[0, 1, 2], [2, 1, 3]])


def test_only_pairs_with_a_chosen_face_are_looked_at():
    vertices = np.concatenate([TRIANGLE, TRIANGLE[:, [2, 0, 1]] + (0.2, 0.2, -0.1), TRIANGLE + (0.1, 0.1, 0)])
    faces = np.arange(9).reshape(3, 3)
    chosen = crossing_pairs(vertices, faces, among=np.array([True, False, False]))
    everything = crossing_pairs(vertices, faces)
    assert chosen.tolist() == [pair for pair in everything.tolist() if 0 in pair]
    assert len(everything) > len(chosen)


def test_neighbors_around_a_vertex_in_almost_one_plane_do_not_cross():
    # Beside a crease of a cube: one plane to within a micrometre.
    vertices = np.array([[0.4032, 0, 0.9488], [0.4516, 1e-6, 1], [0.4016, 1e-6, 1], [0.35, 1e-6, 1], [0.3, 0, 0.9487]])
    assert len(crossing_pairs(vertices, np.array([[1, 2, 0], [0, 3, 4]]))) == 0


def test_a_face_without_area_crosses_nothing():
    assert not cross([[0.2, 0.2, -1], [0.2, 0.2, 0], [0.2, 0.2, 1]])


@pytest.mark.parametrize("faces", [np.empty((0, 3), int), np.array([[0, 1, 2]])])
def test_fewer_than_two_faces_cannot_cross(faces):
    assert crossing_pairs(TRIANGLE, faces).shape == (0, 2)


def segment_through_triangle(p, q, triangle):
    """By signs of volumes: the plain twin of the interval test, for general position."""
    a, b, c = triangle
    ends = np.linalg.det([a - p, b - p, c - p]) * np.linalg.det([a - q, b - q, c - q]) < 0
    around = [np.linalg.det([p - u, q - u, v - u]) for u, v in ((a, b), (b, c), (c, a))]
    return ends and (min(around) > 0 or max(around) < 0)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_triangles_cross_exactly_where_a_side_of_one_goes_through_the_other(seed):
    corners = np.random.default_rng(seed).uniform(0, 1, (12, 3, 3))
    found = set(map(tuple, crossing_pairs(corners.reshape(-1, 3), np.arange(36).reshape(-1, 3)).tolist()))
    for i in range(12):
        for j in range(i + 1, 12):
            sides = [(corners[i][k - 1], corners[i][k], corners[j]) for k in range(3)]
            sides += [(corners[j][k - 1], corners[j][k], corners[i]) for k in range(3)]
            assert ((i, j) in found) == any(segment_through_triangle(*side) for side in sides)


def test_large_and_small_faces_cross_as_if_each_pair_were_alone():
    rng = np.random.default_rng(0)
    size = np.where(rng.random(60) < 0.1, 3.0, 0.2)
    vertices = (rng.uniform(0, 1, (60, 1, 3)) + size[:, None, None] * rng.normal(0, 0.5, (60, 3, 3))).reshape(-1, 3)
    faces = np.arange(180).reshape(-1, 3)
    expected = [[i, j] for i in range(60) for j in range(i + 1, 60) if len(crossing_pairs(vertices, faces[[i, j]]))]
    assert len(expected) > 20
    assert crossing_pairs(vertices, faces).tolist() == expected
    chosen = rng.random(60) < 0.1
    assert crossing_pairs(vertices, faces, among=chosen).tolist() == [p for p in expected if chosen[p].any()]
    assert crossing_pairs(vertices, faces, workers=3).tolist() == expected
