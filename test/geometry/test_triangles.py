# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry.triangles import area_vector, area_vectors, unit, vertex_normals

RNG = np.random.default_rng(0)
VERTICES = RNG.normal(size=(20, 3))
FACES = np.array([RNG.permutation(18)[:3] for _ in range(40)])


def cross_products(vertices, faces):
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def test_area_vectors_are_the_cross_products_of_the_sides():
    assert (area_vectors(VERTICES, FACES) == cross_products(VERTICES, FACES)).all()
    assert area_vector(VERTICES, *FACES[3]) == tuple(cross_products(VERTICES, FACES)[3])


def test_they_take_single_precision_and_no_face_at_all():
    assert area_vectors(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)).tolist() == [[1.0, 1.0, 1.0]]
    assert area_vectors(VERTICES, np.empty((0, 3), np.int64)).shape == (0, 3)


def test_vertex_normals_are_means_over_the_faces_at_a_vertex_by_area():
    area = cross_products(VERTICES, FACES)
    expected = np.array([area[(vertex == FACES).any(axis=1)].sum(axis=0) for vertex in range(18)])
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert vertex_normals(VERTICES, FACES)[:18] == pytest.approx(expected, abs=1e-12)


def test_a_vertex_without_a_face_has_no_normal():
    assert (vertex_normals(VERTICES, FACES)[18:] == 0).all()


def test_unit_vectors_keep_their_direction_and_zero_stays_zero():
    assert unit(np.array([[0.0, 3.0, 4.0], [0.0, 0.0, 0.0], [-1e-100, 0.0, 0.0]])) == pytest.approx(
        np.array([[0, 0.6, 0.8], [0, 0, 0], [-1, 0, 0]])
    )
