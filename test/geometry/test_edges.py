# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from g2_recon.geometry.edges import edges_of, half_edge_numbers, is_open


def some_faces(seed):
    """Faces with three different corners each, in any direction, of which some share edges with many others."""
    rng = np.random.default_rng(seed)
    return np.array([rng.permutation(9)[:3] for _ in range(rng.integers(1, 30))]), 10


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_edges_are_the_pairs_of_corners_each_once_in_order(seed):
    faces, count = some_faces(seed)
    edges, face_edges = edges_of(faces, count)
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2)
    assert edges.tolist() == np.unique(ends.reshape(-1, 2), axis=0).tolist()
    assert (edges[face_edges] == ends).all()


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_a_half_edge_is_open_where_no_face_runs_back_through_it(seed):
    faces, count = some_faces(seed)
    begin, end = faces, np.roll(faces, -1, axis=1)
    back = set(zip(end.ravel().tolist(), begin.ravel().tolist(), strict=True))
    expected = [pair not in back for pair in zip(begin.ravel().tolist(), end.ravel().tolist(), strict=True)]
    assert is_open(faces, count).ravel().tolist() == expected


def test_the_two_half_edges_of_an_edge_differ_in_the_last_bit():
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    number = half_edge_numbers(faces, edges_of(faces, 4)[1])
    assert number[0, 1] == number[1, 0] ^ 1
    assert len(np.unique(number)) == 6


@pytest.mark.parametrize("count", [0, 5])
def test_without_faces_there_is_no_edge(count):
    edges, face_edges = edges_of(np.empty((0, 3), np.int64), count)
    assert edges.shape == (0, 2)
    assert face_edges.shape == (0, 3)
    assert is_open(np.empty((0, 3), np.int64), count).shape == (0, 3)
