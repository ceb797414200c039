# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from g2_recon.errors import InputError
from g2_recon.evaluation.surface import crossing_faces, sample_surface, score_surface, topology
from g2_recon.geometry.mesh import TrueSurface
from g2_recon.reconstruction.intersections import crossing_pairs

# A square of 2 m, and the same 3 cm above.
SQUARE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
TWO = np.array([[0, 1, 2], [0, 2, 3]])
BOX = trimesh.creation.box((1, 2, 3))
SAMPLES = 20_000


def flat(score):
    """All numbers of a score."""
    values = dataclasses.asdict(score)
    shares = [value for at in values.pop("at") for value in at.values()]
    return [*values.pop("topology").values(), *values.values(), *shares]


def test_the_truth_itself_is_perfect():
    score = score_surface(TrueSurface(SQUARE, TWO), SQUARE, TWO, samples=SAMPLES)
    assert score.accuracy_95 == pytest.approx(0, abs=1e-12)
    assert score.completeness_95 == pytest.approx(0, abs=1e-12)
    assert score.normals == pytest.approx(1)
    assert [dataclasses.astuple(at) for at in score.at] == [(0.05, 1, 1, 1), (0.02, 1, 1, 1)]


def test_a_surface_3_cm_beside_the_truth_is_3_cm_off_both_ways():
    score = score_surface(TrueSurface(SQUARE, TWO), SQUARE + (0, 0, 0.03), TWO, samples=SAMPLES)
    for value in (score.accuracy, score.accuracy_95, score.completeness, score.completeness_95):
        assert value == pytest.approx(0.03)
    assert [at.f_score for at in score.at] == [1, 0]


def test_half_of_a_surface_is_accurate_and_not_complete():
    score = score_surface(TrueSurface(SQUARE, TWO), SQUARE * (0.5, 1, 1), TWO, samples=SAMPLES)
    assert score.accuracy == pytest.approx(0, abs=1e-12)
    # Half of the truth is 0 to 1 m off: a mean of 1/4 m. Three standard errors of 20,000 samples: 0.007 m.
    assert score.completeness == pytest.approx(0.25, abs=0.007)
    at = score.at[0]
    # 1.05 of 2 m; three standard errors are 0.011.
    assert (at.precision, at.recall) == (1, pytest.approx(0.525, abs=0.011))
    assert at.f_score == pytest.approx(2 * at.recall / (1 + at.recall))


def test_what_of_the_truth_was_not_seen_does_not_count():
    u, v = (grid.ravel() for grid in np.meshgrid(np.arange(0, 1, 0.05), np.arange(0, 2, 0.05)))
    half = SQUARE * (0.5, 1, 1)
    score = score_surface(TrueSurface(SQUARE, TWO, np.stack([u, v, 0 * u], 1)), half, TWO, samples=SAMPLES)
    # Seen is up to 0.1 m beyond the last hits, at 0.95 m.
    assert score.at[0].recall == 1
    assert 0 < score.completeness < 0.005


def test_a_tilt_of_the_surface_shows_in_its_normals():
    turned = Rotation.from_euler("x", 30, degrees=True).apply(SQUARE - 1) + 1
    score = score_surface(TrueSurface(SQUARE, TWO), turned, TWO, samples=SAMPLES)
    assert score.normals == pytest.approx(np.cos(np.radians(30)))


def test_the_score_does_not_depend_on_which_side_faces_look():
    sides = [score_surface(TrueSurface(SQUARE, TWO), SQUARE, faces, samples=SAMPLES) for faces in (TWO, TWO[:, ::-1])]
    assert sides[0].normals == pytest.approx(sides[1].normals)


@settings(max_examples=6, deadline=None, derandomize=True)
@given(
    angles=st.tuples(*[st.floats(-3, 3)] * 3),
    shift=st.tuples(*[st.floats(-1e3, 1e3)] * 3),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_score_stays_when_mesh_and_truth_move_together(angles, shift, seed):
    rng = np.random.default_rng(seed)
    faces = np.asarray(BOX.faces)
    truth = np.asarray(BOX.vertices)
    mesh = truth + rng.normal(0, 0.03, truth.shape)
    seen, _ = sample_surface(truth, faces, 300, 0)

    def moved(points):
        return Rotation.from_euler("xyz", angles).apply(points) + shift

    here = score_surface(TrueSurface(truth, faces, seen), mesh, faces, samples=SAMPLES)
    there = score_surface(TrueSurface(moved(truth), faces, moved(seen)), moved(mesh), faces, samples=SAMPLES)
    # Samples closest to an edge, some hundred of 20,000, may get the normal of either face.
    assert there.normals == pytest.approx(here.normals, abs=5e-3)
    # Samples beside a threshold may change sides: a few of 20,000.
    assert flat(dataclasses.replace(there, normals=here.normals)) == pytest.approx(flat(here), abs=3e-4)


def test_the_score_does_not_depend_on_the_number_of_workers():
    truth = TrueSurface(np.asarray(BOX.vertices), np.asarray(BOX.faces))
    one, three = (score_surface(truth, SQUARE, TWO, samples=SAMPLES, workers=workers) for workers in (1, 3))
    assert one == three


def test_samples_are_spread_evenly():
    vertices = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 9], [1, 0, 9], [0, 1, 9]])
    points, normals = sample_surface(vertices, np.arange(6).reshape(2, 3), 50_000, 3)
    low = points[:, 2] < 1
    # 16 of 17 parts, and a centroid of 4/3 m; four standard errors.
    assert low.mean() == pytest.approx(16 / 17, abs=0.0043)
    assert points[low].mean(axis=0) == pytest.approx([4 / 3, 4 / 3, 0], abs=0.018)
    assert np.abs(normals[:, 2]).min() == pytest.approx(1)


def counts(vertices, faces):
    found = topology(np.array(vertices, float), np.array(faces))
    return found.boundary_edges, found.loops, found.nonmanifold_edges, found.nonmanifold_vertices, found.components


def test_a_closed_surface_has_no_boundary():
    assert counts(BOX.vertices, BOX.faces) == (0, 0, 0, 0, 1)


def test_vertices_in_one_place_are_one_vertex():
    assert counts(BOX.vertices[BOX.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3)) == (0, 0, 0, 0, 1)


def test_a_vertex_a_millimetre_away_is_another_one():
    vertices = np.concatenate([SQUARE[[0, 1, 2]], SQUARE[[0, 2, 3]] - (1e-3, 0, 0)])
    assert counts(vertices, [[0, 1, 2], [3, 4, 5]]) == (6, 2, 0, 0, 2)


def test_an_open_surface_has_a_loop_for_each_hole():
    faces = np.delete(BOX.faces, [0, np.flatnonzero((~np.isin(BOX.faces, BOX.faces[0])).sum(1) >= 2)[0]], axis=0)
    assert counts(BOX.vertices, faces)[0] == 6


def test_three_faces_at_an_edge_are_no_manifold():
    assert counts([*SQUARE, [1, 1, 1]], [*TWO, [0, 2, 4]])[2:] == (1, 0, 1)


@pytest.mark.parametrize("other", [[0, 4, 5], [0, 5, 4]])
def test_two_fans_at_a_vertex_are_a_pinch(other):
    assert counts([*SQUARE, [-1, 0, 0], [0, -1, 0]], [*TWO, other])[2:] == (0, 1, 1)


def test_faces_that_look_opposite_ways_still_make_one_fan():
    assert counts(SQUARE, [[0, 1, 2], [0, 3, 2]]) == (4, 1, 0, 0, 1)


def test_faces_without_area_do_not_count_as_edges():
    found = topology(SQUARE, np.concatenate([TWO, [[0, 0, 1]]]))
    assert (found.faces, found.vertices, found.boundary_edges, found.nonmanifold_edges) == (3, 4, 4, 0)


def test_a_face_that_crosses_another_one_makes_two_of_three_self_intersecting():
    vertices = [*SQUARE, [1.5, 0.5, -1], [1.6, 0.5, -1], [1.5, 0.5, 1]]
    assert topology(np.array(vertices, float), np.array([*TWO, [4, 5, 6]])).self_intersecting == pytest.approx(2 / 3)


def test_a_face_that_is_there_twice_intersects_itself():
    assert crossing_faces(SQUARE, np.array([[0, 1, 2], [0, 2, 3], [2, 1, 0]])).tolist() == [True, False, True]


@pytest.mark.parametrize("faces", [np.empty((0, 3), int), TWO[:1]])
def test_fewer_than_two_faces_do_not_cross(faces):
    assert crossing_faces(SQUARE, faces).tolist() == [False] * len(faces)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(2, 80))
def test_faces_of_all_sizes_cross_where_a_search_of_all_pairs_says_so(seed, count):
    rng = np.random.default_rng(seed)
    corners = rng.uniform(0, 2, (count, 1, 3)) + 10.0 ** rng.uniform(-2, 0.5, (count, 1, 1)) * rng.normal(
        size=(count, 3, 3)
    )
    vertices, faces = corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)
    expected = np.zeros(count, bool)
    expected[crossing_pairs(vertices, faces).reshape(-1)] = True
    assert np.array_equal(crossing_faces(vertices, faces), expected)


@pytest.mark.parametrize(
    ("truth", "vertices", "faces", "said"),
    [
        (TrueSurface(SQUARE, TWO), SQUARE, np.empty((0, 3), int), "without a face"),
        (TrueSurface(SQUARE, TWO), SQUARE * 0, TWO, "mesh: no face has an area"),
        (TrueSurface(SQUARE, TWO), SQUARE * (1, np.nan, 1), TWO, "not finite"),
        (TrueSurface(SQUARE, TWO[:0]), SQUARE, TWO, "without a face"),
        (TrueSurface(SQUARE * 0, TWO), SQUARE, TWO, "truth: no face has an area"),
        (TrueSurface(SQUARE, TWO, SQUARE + 50), SQUARE, TWO, "truth: nothing of it was seen"),
    ],
)
def test_what_cannot_be_scored_is_refused(truth, vertices, faces, said):
    with pytest.raises(InputError, match=said):
        score_surface(truth, vertices, faces, samples=100)
