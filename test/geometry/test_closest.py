# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from g2_recon.errors import InputError
from g2_recon.geometry.closest import closest_in_tree, closest_on_mesh, triangle_tree

TRIANGLE = np.array([[0.0, 0, 0], [4, 0, 0], [0, 3, 0]])
ONE = np.array([[0, 1, 2]])


def on_segments(points, a, b):
    """Distance (N, F) to segments, the plain way."""
    side = b - a
    length = np.maximum((side**2).sum(1), 1e-300)
    at = np.clip(((points[:, None] - a) * side).sum(2) / length, 0, 1)
    return np.linalg.norm(points[:, None] - a - at[..., None] * side, axis=2)


def distances(points, vertices, faces):
    """Distance (N, F) of each point to each face: to its plane above the face, else to its sides."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    result = np.min([on_segments(points, *side) for side in ((a, b), (b, c), (c, a))], axis=0)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(length, 1e-300)[:, None]
    inside = np.ones(result.shape, bool)
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(end - start, points[:, None] - start) * normal).sum(2) > 0
    height = np.abs(((points[:, None] - a) * normal).sum(2))
    return np.where(inside & (length > 0), np.minimum(height, result), result)


def place(vertices, faces, found):
    return np.einsum("nk,nki->ni", found.barycentric, vertices[faces[found.face]])


def check(points, vertices, faces, tolerance):
    """The distance is that of brute force, and the face and the weights are those of a place at that distance."""
    found = closest_on_mesh(points, vertices, faces)
    expected = distances(points, vertices, faces)
    assert found.distance == pytest.approx(expected.min(axis=1), abs=tolerance)
    assert expected[np.arange(len(points)), found.face] == pytest.approx(expected.min(axis=1), abs=tolerance)
    assert found.barycentric.min() >= 0
    assert found.barycentric.sum(axis=1) == pytest.approx(1, abs=1e-12)
    reached = np.linalg.norm(place(vertices, faces, found) - points, axis=1)
    assert reached == pytest.approx(found.distance, abs=tolerance)


def soup(rng, count):
    """Triangles of 1 mm to 10 m, slivers among them, that share some vertices."""
    size = 10.0 ** rng.uniform(-3, 1, (count, 1, 1))
    shape = rng.normal(size=(count, 3, 3)) * np.where(rng.random((count, 1, 1)) < 0.3, [1, 1e-3, 1e-6], 1.0)
    vertices = (rng.uniform(-5, 5, (count, 1, 3)) + size * shape).reshape(-1, 3)
    faces = np.arange(3 * count).reshape(-1, 3)
    faces[rng.random(faces.shape) < 0.2] = rng.integers(3 * count)
    return vertices, faces


@settings(max_examples=60, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 70), reach=st.sampled_from([0.1, 3.0, 100.0, 1e6]))
def test_it_is_what_brute_force_finds_in_a_soup_of_triangles(seed, count, reach):
    rng = np.random.default_rng(seed)
    vertices, faces = soup(rng, count)
    points = np.concatenate([rng.normal(0, reach, (20, 3)), vertices[rng.integers(len(vertices), size=10)]])
    # Rounding of coordinates, and at most 1e-8 of the 30 m of a large triangle that is that thin.
    check(points, vertices, faces, tolerance=1e-15 * reach + 3e-7)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1))
def test_ordinary_triangles_are_exact_to_rounding(seed):
    rng = np.random.default_rng(seed)
    check(rng.normal(0, 2, (40, 3)), rng.normal(size=(60, 3)), np.arange(60).reshape(-1, 3), tolerance=1e-13)


def test_each_region_of_a_triangle_has_its_closest_place():
    cases = {
        (1, 1, 2): (1, 1, 0),
        (-1, -2, 0): (0, 0, 0),
        (6, -1, 0): (4, 0, 0),
        (-1, 7, 0): (0, 3, 0),
        (2, -1, 0): (2, 0, 0),
        (-1, 2, 0): (0, 2, 0),
        (2 + 3, 1.5 + 4, 0): (2, 1.5, 0),
    }
    points, expected = np.array(list(cases), float), np.array(list(cases.values()), float)
    found = closest_on_mesh(points, TRIANGLE, ONE)
    assert place(TRIANGLE, ONE, found) == pytest.approx(expected, abs=1e-12)
    assert found.distance == pytest.approx(np.linalg.norm(points - expected, axis=1), abs=1e-12)


def test_far_from_the_origin_places_are_as_exact_as_the_coordinates():
    rng = np.random.default_rng(0)
    # Multiples of 2^-20 m: shifted by a whole number, they are the same numbers.
    vertices, points = (np.round(rng.normal(size=(n, 3)) * 2**20) / 2**20 for n in (300, 500))
    faces = np.arange(300).reshape(-1, 3)
    here = closest_on_mesh(points, vertices, faces)
    there = closest_on_mesh(points + 1e6, vertices + 1e6, faces)
    assert np.array_equal(there.face, here.face)
    assert there.distance == pytest.approx(here.distance, abs=1e-12)


@pytest.mark.parametrize(
    "corners", [[[0, 0, 0]] * 3, [[0, 0, 0], [1, 0, 0], [3, 0, 0]], [[0, 0, 0], [0, 0, 0], [3, 0, 0]]]
)
def test_a_face_without_area_is_a_segment_or_a_point(corners):
    vertices = np.array(corners, float)
    points = np.array([[-1.0, 0, 0], [2, 1, 0], [2, 0, 0], [5, 0, 0]])
    check(points, vertices, ONE, tolerance=1e-12)


def test_walls_and_slivers_go_together():
    """A wall of 10 m beside 1,000 slivers of a centimetre."""
    x = np.linspace(0, 10, 1001)
    strip = np.column_stack([np.repeat(x, 2), np.tile([0.0, 0.01], 1001), np.zeros(2002)])
    first = np.arange(0, 2000, 2)[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [1, 3, 2], 2002 + np.array([[0, 1, 2], [0, 2, 3]])])
    vertices = np.concatenate([strip, [[0, 0, 0], [10, 0, 0], [10, 0, 3], [0, 0, 3]]])
    check(np.random.default_rng(0).uniform([-1, -1, -1], [11, 1, 4], (300, 3)), vertices, faces, tolerance=1e-12)


def test_beyond_the_limit_there_is_no_place():
    points = np.array([[1.0, 1, 0.5], [1, 1, 0.5000001], [1, 1, 0], [9e9, 0, 0]])
    found = closest_on_mesh(points, TRIANGLE, ONE, limit=0.5)
    assert found.distance.tolist() == [0.5, np.inf, 0.0, np.inf]
    assert found.face.tolist() == [0, -1, 0, -1]
    assert np.isnan(found.barycentric).all(axis=1).tolist() == [False, True, False, True]


def test_a_limit_changes_nothing_within_it():
    rng = np.random.default_rng(1)
    vertices, faces = soup(rng, 200)
    points = rng.normal(0, 4, (500, 3))
    free, bound = (closest_on_mesh(points, vertices, faces, limit=limit) for limit in (np.inf, 1.0))
    assert 50 < (free.distance <= 1.0).sum() < 450
    assert np.array_equal(bound.distance, np.where(free.distance <= 1.0, free.distance, np.inf))


def test_the_result_does_not_depend_on_the_number_of_workers():
    rng = np.random.default_rng(2)
    tree = triangle_tree(*soup(rng, 500))
    points = rng.normal(0, 4, (30_000, 3))
    one, three = (closest_in_tree(points, tree, workers=workers) for workers in (1, 3))
    for name in ("distance", "face", "barycentric"):
        assert np.array_equal(getattr(one, name), getattr(three, name))


def test_no_points_have_no_places():
    found = closest_on_mesh(np.empty((0, 3)), TRIANGLE, ONE)
    assert (found.distance.shape, found.face.shape, found.barycentric.shape) == ((0,), (0,), (0, 3))


@pytest.mark.parametrize(
    ("points", "vertices", "faces", "limit", "said"),
    [
        (TRIANGLE, TRIANGLE, np.empty((0, 3), int), 1.0, "without a face"),
        (TRIANGLE, TRIANGLE, [[0, 1, 3]], 1.0, "not there"),
        (TRIANGLE, TRIANGLE, [[0, 1, -1]], 1.0, "not there"),
        ([[0, 0, np.nan]], TRIANGLE, ONE, 1.0, "some points are not finite"),
        (TRIANGLE, np.full((3, 3), np.inf), ONE, 1.0, "some vertices are not finite"),
        (TRIANGLE, TRIANGLE, ONE, np.nan, "limit of nan"),
        (TRIANGLE, TRIANGLE, ONE, -1.0, "limit of -1"),
    ],
)
def test_what_cannot_be_searched_is_refused(points, vertices, faces, limit, said):
    with pytest.raises(InputError, match=said):
        closest_on_mesh(np.array(points), vertices, np.array(faces), limit=limit)
