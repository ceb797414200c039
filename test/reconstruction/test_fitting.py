# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from g2_recon.geometry.closest import closest_on_mesh
from g2_recon.reconstruction.fitting import fit_to_points


def on_sphere(count: int, noise: float, seed: int = 0) -> np.ndarray:
    """Points (N, 3) near a sphere of 1 m around the origin."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    return direction / np.linalg.norm(direction, axis=1)[:, None] * (1 + rng.normal(0, noise, (count, 1)))


def sphere() -> tuple[np.ndarray, np.ndarray]:
    """An octahedron whose faces are divided twice, its 66 vertices on a sphere of 1 m, normals outwards."""
    vertices = np.vstack([np.eye(3), -np.eye(3)])
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    for _ in range(2):
        ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        edges, number = np.unique(ends, axis=0, return_inverse=True)
        ab, bc, ca = (number.reshape(-1, 3) + len(vertices)).T
        a, b, c = faces.T
        vertices = np.vstack([vertices, vertices[edges].mean(axis=1)])
        vertices /= np.linalg.norm(vertices, axis=1)[:, None]
        faces = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return vertices, faces


def off(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> float:
    """Root mean square distance of points from the mesh, m."""
    return float(np.sqrt(np.mean(closest_on_mesh(points, vertices, faces).distance ** 2)))


def test_the_fit_halves_the_error_of_a_coarse_sphere() -> None:
    """Triangles between vertices on the sphere are all within it; afterwards they are on both sides."""
    vertices, faces = sphere()
    truth = on_sphere(20_000, 0.0, seed=1)
    everywhere = np.ones(len(vertices), bool)
    fitted = fit_to_points(vertices, faces, everywhere, on_sphere(8000, 0.01), limit=0.2)
    assert off(fitted, faces, truth) < 0.5 * off(vertices, faces, truth)
    assert (np.linalg.norm(fitted, axis=1) > 1).all()


def test_vertices_that_are_not_free_stay_where_they_are() -> None:
    vertices, faces = sphere()
    free = vertices[:, 2] > 0.1
    fitted = fit_to_points(vertices, faces, free, on_sphere(8000, 0.01), limit=0.2)
    np.testing.assert_array_equal(fitted[~free], vertices[~free])
    assert (np.linalg.norm(fitted[free] - vertices[free], axis=1) > 0.005).all()


def test_the_vertices_given_are_not_changed() -> None:
    vertices, faces = sphere()
    before = vertices.copy()
    fit_to_points(vertices, faces, np.ones(len(vertices), bool), on_sphere(1000, 0.01), limit=0.2)
    np.testing.assert_array_equal(vertices, before)


def test_vertices_move_along_their_normals() -> None:
    vertices, faces = sphere()
    fitted = fit_to_points(vertices, faces, np.ones(len(vertices), bool), on_sphere(8000, 0.0), limit=0.2)
    moved = fitted - vertices
    # On a sphere normals are radial; where faces of different size meet, the mean of these is off by up to 10 deg.
    assert (np.einsum("vi,vi->v", moved, vertices) > 0.98 * np.linalg.norm(moved, axis=1)).all()


@pytest.mark.parametrize("lacking", ["points", "free vertices"])
def test_without_anything_to_fit_all_stays(lacking: str) -> None:
    vertices, faces = sphere()
    points = on_sphere(0 if lacking == "points" else 100, 0.0)
    free = np.full(len(vertices), lacking == "points")
    np.testing.assert_array_equal(fit_to_points(vertices, faces, free, points, limit=0.2), vertices)


def test_points_farther_off_than_the_limit_do_not_count() -> None:
    vertices, faces = sphere()
    everywhere, points = np.ones(len(vertices), bool), on_sphere(4000, 0.01)
    far = 1.5 * on_sphere(4000, 0.0, seed=2)
    one = fit_to_points(vertices, faces, everywhere, points, limit=0.2)
    other = fit_to_points(vertices, faces, everywhere, np.concatenate([points, far]), limit=0.2)
    assert other == pytest.approx(one, abs=1e-9)


def test_a_free_vertex_without_points_moves_no_farther_than_those_around_it() -> None:
    vertices, faces = sphere()
    points = on_sphere(8000, 0.0)
    everywhere, hole = np.ones(len(vertices), bool), vertices[:, 2] > 0.9
    fitted = fit_to_points(vertices, faces, everywhere, points[points[:, 2] < 0.8], limit=0.2)
    moved = np.linalg.norm(fitted - vertices, axis=1)
    assert hole.sum() == 5
    around = (vertices[:, 2] > 0.6) & ~hole
    assert moved[hole].max() < moved[around].max()


def test_the_result_does_not_depend_on_the_workers() -> None:
    vertices, faces = sphere()
    everywhere, points = np.ones(len(vertices), bool), on_sphere(5000, 0.01)
    one, three = (fit_to_points(vertices, faces, everywhere, points, limit=0.2, workers=w) for w in (1, 3))
    np.testing.assert_array_equal(one, three)
