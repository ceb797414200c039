# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from g2_recon.reconstruction.creases import insert_creases

X, Y, Z = np.eye(3)


def half_edges(faces):
    return np.stack([faces.ravel(), np.roll(faces, -1, axis=1).ravel()], axis=1)


def is_oriented_manifold(faces):
    return len(np.unique(half_edges(faces), axis=0)) == faces.size


def open_edges(faces):
    edges = set(map(tuple, half_edges(faces).tolist()))
    return {(begin, end) for begin, end in edges if (end, begin) not in edges}


def chamfered_edge():
    """A strip between the plane z = 0 and the plane x = 0 that cuts off their edge, four vertices a side."""
    y = np.arange(4) * 0.2
    floor = np.column_stack([np.full(4, 0.1), y, np.zeros(4)])
    wall = np.column_stack([np.zeros(4), y, np.full(4, 0.1)])
    number = np.arange(3)
    faces = np.concatenate(
        [
            np.column_stack([number, number + 1, number + 4]),
            np.column_stack([number + 1, number + 5, number + 4]),
        ]
    )
    normals = np.repeat([Z, X], 4, axis=0)
    return np.concatenate([floor, wall]), faces, normals, np.zeros((8, 3)), np.repeat([0, 1], 4)


def test_an_edge_between_walls_gets_its_vertices_where_the_planes_meet():
    vertices, faces, normals, centers, cluster = chamfered_edge()
    creased = insert_creases(vertices, faces, normals, centers, cluster)
    new = creased.vertices[8:]
    assert len(new) == 7
    # The hold keeps a thousandth of the way of 5 cm.
    assert np.abs(new[:, [0, 2]]).max() < 1e-4


def test_the_parts_of_a_face_lie_in_the_planes():
    vertices, faces, normals, centers, cluster = chamfered_edge()
    creased = insert_creases(vertices, faces, normals, centers, cluster)
    a, b, c = (creased.vertices[creased.faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    assert np.maximum(normal @ X, normal @ Z).min() > 0.999


def test_a_crease_keeps_the_mesh_manifold_and_its_border_where_it_was():
    vertices, faces, normals, centers, cluster = chamfered_edge()
    creased = insert_creases(vertices, faces, normals, centers, cluster)
    assert is_oriented_manifold(creased.faces)
    # Each of the two ends of the strip is divided once.
    assert len(open_edges(creased.faces)) == len(open_edges(faces)) + 2


def test_three_walls_meet_in_their_corner():
    vertices = 0.2 * np.array([[1, 1, 0], [0, 1, 1], [1, 0, 1.0]])
    normals = np.array([Z, X, Y])
    creased = insert_creases(vertices, np.array([[0, 1, 2]]), normals, np.zeros((3, 3)), np.arange(3))
    assert len(creased.faces) == 6
    # The hold keeps a thousandth of the way of 0.23 m.
    assert np.linalg.norm(creased.vertices, axis=1).min() < 5e-4


def test_each_part_knows_the_face_that_it_comes_from():
    vertices, faces, normals, centers, cluster = chamfered_edge()
    creased = insert_creases(vertices, faces, normals, centers, cluster)
    shared = [len(set(part) & set(faces[origin])) for part, origin in zip(creased.faces, creased.origin, strict=True)]
    assert min(shared) >= 1
    assert set(creased.origin) == set(range(len(faces)))


def test_clusters_of_almost_one_plane_get_no_crease():
    vertices, faces, _, centers, cluster = chamfered_edge()
    tilted = np.repeat([Z, (np.sin(0.4), 0, np.cos(0.4))], 4, axis=0)
    creased = insert_creases(vertices, faces, tilted, centers, cluster)
    assert creased.faces.tolist() == faces.tolist()


def test_a_crease_within_one_cluster_is_left_alone():
    vertices, faces, normals, centers, _ = chamfered_edge()
    assert len(insert_creases(vertices, faces, normals, centers, np.zeros(8, int)).vertices) == 8


def test_a_crease_vertex_that_would_turn_a_face_over_is_left_out():
    vertices, faces, normals, centers, cluster = chamfered_edge()
    # The floor's plane lies 6 cm below its first neuron: the crease would come to lie behind the chamfer's end.
    centers = centers.copy()
    centers[4] = (0.09, 0, 0)
    creased = insert_creases(vertices, faces, normals, centers, cluster)
    assert not turned_over(vertices, faces, creased).any()


def turned_over(vertices, faces, creased):
    a, b, c = (vertices[faces[creased.origin][:, corner]] for corner in range(3))
    d, e, f = (creased.vertices[creased.faces[:, corner]] for corner in range(3))
    return np.einsum("fi,fi->f", np.cross(b - a, c - a), np.cross(e - d, f - d)) < 0


def test_no_faces_have_no_creases():
    nothing = np.empty((0, 3))
    creased = insert_creases(nothing, np.empty((0, 3), int), nothing, nothing, np.empty(0, int))
    assert creased.faces.shape == (0, 3)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.05, 0.5]))
def test_any_planes_leave_a_manifold_oriented_finite_mesh(seed, noise):
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(6), np.arange(5))
    vertices = 0.2 * np.column_stack([x.ravel(), y.ravel(), np.zeros(30)]) + rng.normal(0, noise, (30, 3))
    corner = (np.arange(4)[:, None] * 6 + np.arange(5)).ravel()
    faces = np.concatenate(
        [np.column_stack([corner, corner + 1, corner + 7]), np.column_stack([corner, corner + 7, corner + 6])]
    )
    cluster = rng.integers(0, 4, 30)
    direction = rng.normal(size=(4, 3)) + (0, 0, 1)
    normals = (direction / np.linalg.norm(direction, axis=1, keepdims=True))[cluster]
    creased = insert_creases(vertices, faces, normals, rng.uniform(0, 1, (4, 3))[cluster], cluster)
    assert is_oriented_manifold(creased.faces)
    assert np.isfinite(creased.vertices).all()
    assert not turned_over(vertices, faces, creased).any()
    assert creased.faces.max() < len(creased.vertices)
