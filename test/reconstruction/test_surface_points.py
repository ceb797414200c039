# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.point_tree import point_tree
from g2_recon.reconstruction.normals import LocalPlanes, fit_local_planes
from g2_recon.reconstruction.surface_points import SurfacePoints, prepare
from g2_recon.reconstruction.usable_points import usable_points


def scanned_wall(*, along: float, between: float, noise: float = 0.0, size: float = 4.0) -> Cloud:
    """A wall at y = 0 scanned in vertical planes from a robot that drives along it at a distance of 2 m."""
    rng = np.random.default_rng(1)
    x, z = np.meshgrid(np.arange(0, size, between), np.arange(0, 3, along), indexing="ij")
    wall = np.column_stack([x.ravel(), np.zeros(x.size), z.ravel()])
    sensor = wall * (1, 0, 0) + (0, 2, 0.35)
    ray = wall - sensor
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return Cloud(wall + noise * rng.normal(size=(len(wall), 1)) * ray, sensor)


def sphere(count: int) -> np.ndarray:
    direction = np.random.default_rng(2).normal(size=(count, 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def corner(spacing: float = 0.05) -> np.ndarray:
    """A floor z = 0 and a wall x = 0 that meet along the y axis."""
    a, b = np.meshgrid(np.arange(0.5, 40) * spacing, np.arange(0.5, 40) * spacing, indexing="ij")
    zero = np.zeros(a.size)
    return np.vstack([np.column_stack([a.ravel(), b.ravel(), zero]), np.column_stack([zero, b.ravel(), a.ravel()])])


def test_normals_face_the_sensor() -> None:
    surface = prepare(scanned_wall(along=0.04, between=0.06, noise=0.01))
    assert np.median(surface.normals[:, 1]) > 0.99
    assert (surface.normals[:, 1] > 0).all()


@pytest.mark.parametrize("between", [0.2, 0.4, 0.6])
def test_normals_are_found_across_wide_gaps_between_scans(between: float) -> None:
    surface = prepare(scanned_wall(along=0.03, between=between, noise=0.01, size=12 * between))
    assert np.quantile(surface.normals[:, 1], 0.05) > 0.9


def test_the_line_of_a_single_scan_faces_the_sensor() -> None:
    points = np.column_stack([np.zeros((80, 2)), np.linspace(0.1, 2.5, 80)])
    # The scan runs across the wall y = 0 at 45 deg, and nothing beside it tells how the wall goes on.
    sensor = np.tile([2.0, 2.0, 0.6], (80, 1))
    ray = points - sensor
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    surface = prepare(Cloud(points + 0.01 * np.random.default_rng(0).normal(size=(80, 1)) * ray, sensor))
    assert surface.normals @ (np.sqrt(0.5), np.sqrt(0.5), 0.0) == pytest.approx(1.0, abs=0.03)


def test_points_hang_together_across_wide_gaps_between_scans() -> None:
    surface = prepare(scanned_wall(along=0.03, between=0.4))
    reach = np.abs(surface.points[surface.neighbors, 0] - surface.points[:, None, 0]).max(axis=1)
    assert (reach > 0.3).all()


def test_normals_are_sharp_at_a_crease() -> None:
    points = corner()
    surface = prepare(Cloud(points, np.broadcast_to((1.0, 1.0, 1.0), points.shape)))
    floor = surface.points[:, 2] == 0
    expected = np.where(floor[:, None], (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    assert np.mean(np.einsum("ij,ij->i", surface.normals, expected) > 0.99) > 0.95


@pytest.mark.parametrize("noise", [0.0, 0.005, 0.02])
def test_noise_is_estimated(noise: float) -> None:
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(0, 4, (6000, 2)), noise * rng.normal(size=6000)])
    # A fifth: the planes through 24 points follow the noise a little, and the best of them are preferred.
    assert prepare(Cloud(points)).noise == pytest.approx(noise, rel=0.2, abs=1e-9)


def test_isolated_returns_are_left_out_and_counted() -> None:
    wall = scanned_wall(along=0.04, between=0.06)
    stray = np.array([[1.0, 1.0, 1.0], [3.0, 1.0, 2.0]])
    surface = prepare(Cloud(np.vstack([wall.points, stray]), np.vstack([wall.sensor, stray + (0, 1, 0)])))
    assert surface.rejected == {"isolated": 2}
    assert surface.kept.max() < len(wall)


def test_points_off_the_surface_of_their_neighbors_are_left_out() -> None:
    wall = scanned_wall(along=0.04, between=0.06)
    stray = np.array([[2.0, 0.2, 1.0]])
    surface = prepare(Cloud(np.vstack([wall.points, stray]), np.vstack([wall.sensor, stray + (0, 1, 0)])))
    assert surface.rejected == {"off the surface of their neighbors": 1}


def test_each_point_names_its_place_in_the_cloud() -> None:
    wall = scanned_wall(along=0.04, between=0.06, noise=0.01)
    surface = prepare(wall)
    np.testing.assert_allclose(surface.points, wall.points[surface.kept], atol=1e-12)


def test_weights_go_with_area_and_not_with_density() -> None:
    rng = np.random.default_rng(4)
    dense, sparse = rng.uniform((0, 0), (2, 2), (40_000, 2)), rng.uniform((2, 0), (4, 2), (10_000, 2))
    plane = np.vstack([dense, sparse])
    surface = prepare(Cloud(np.column_stack([plane, np.zeros(len(plane))])))
    left = surface.points[:, 0] < 2
    # A voxel of the sparse half stays empty with a probability of exp(-11); one more row of voxels is cut in two.
    assert surface.weights[left].sum() == pytest.approx(surface.weights[~left].sum(), rel=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_a_closed_surface_without_sensor_faces_outwards(seed: int) -> None:
    points = Rotation.random(rng=seed).apply(sphere(4000))
    surface = prepare(Cloud(points))
    assert (np.einsum("ij,ij->i", surface.normals, surface.points) > 0.9).all()


def test_each_of_several_closed_surfaces_faces_outwards() -> None:
    points = np.vstack([sphere(3000), sphere(3000) + (4, 0, 0)])
    surface = prepare(Cloud(points))
    center = np.where(surface.points[:, :1] > 2, (4.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert (np.einsum("ij,ij->i", surface.normals, surface.points - center) > 0.9).all()


def test_the_result_does_not_depend_on_the_workers() -> None:
    wall = scanned_wall(along=0.02, between=0.03, noise=0.01)
    one, three = prepare(wall, workers=1), prepare(wall, workers=3)
    np.testing.assert_array_equal(one.normals, three.normals)
    np.testing.assert_array_equal(one.neighbors, three.neighbors)


def test_coordinates_of_a_million_metres_change_nothing() -> None:
    wall = scanned_wall(along=0.04, between=0.06, noise=0.01)
    shift = np.array((5e5, 5e6, 300.0))
    near, far = prepare(wall), prepare(Cloud(wall.points + shift, wall.sensor + shift))
    order, far_order = np.argsort(near.kept), np.argsort(far.kept)
    # Rounding of the coordinates is 1e-9 m; over 10 cm that is 1e-8 rad, over neighbors almost on a line more.
    np.testing.assert_allclose(near.normals[order], far.normals[far_order], atol=1e-5)


def test_planes_agree_with_a_plain_eigendecomposition() -> None:
    points = np.random.default_rng(5).normal(size=(50, 3))
    planes = LocalPlanes.blank(50)
    fit_local_planes(
        points, None, np.arange(50), point_tree(points), radius=1.5, neighbors=12, workers=1, planes=planes
    )
    for row, point in enumerate(points):
        distance = np.linalg.norm(points - point, axis=1)
        nearest = np.argsort(distance)[:12]
        own = points[nearest[distance[nearest] < 1.5]]
        assert planes.found[row] == len(own)
        if len(own) > 3:
            square, axes = np.linalg.eigh((own - own.mean(axis=0)).T @ (own - own.mean(axis=0)))
            np.testing.assert_allclose(planes.middles[row], own.mean(axis=0), atol=1e-12)
            assert abs(planes.normals[row] @ axes[:, 0]) == pytest.approx(1.0)
            assert planes.deviation[row] == pytest.approx(np.sqrt(max(square[0], 0.0) / (len(own) - 3)), abs=1e-9)


def test_one_neighbor_is_noted_in_each_direction() -> None:
    # The nearest of each eighth of the directions around the middle, and one farther off behind each.
    angle = np.deg2rad(np.arange(22.5, 360, 45))
    ring = np.column_stack([np.cos(angle), 0.9 * np.sin(angle), np.zeros(8)])
    points = np.vstack([np.zeros((2, 3)), ring, 1.5 * ring])
    planes = LocalPlanes.blank(len(points))
    fit_local_planes(
        points, None, np.array([0]), point_tree(points), radius=5.0, neighbors=20, workers=1, planes=planes
    )
    assert sorted(planes.around[0]) == list(range(2, 10))


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.random.default_rng(0).uniform(-1e6, 1e6, (200, 3)), "far off"),
        (np.random.default_rng(0).uniform(-100, 100, (200, 3)), "larger spacing"),
    ],
)
def test_what_has_no_surface_is_refused(points: np.ndarray, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        prepare(Cloud(points))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 120),
    scale=st.sampled_from([1e-6, 0.05, 0.5, 3.0]),
    grid=st.booleans(),
    flat=st.booleans(),
    seen=st.booleans(),
    origin=st.sampled_from([0.0, 1e6]),
)
def test_any_cloud_gives_finite_unit_normals_or_a_clear_error(
    seed: int, count: int, scale: float, grid: bool, flat: bool, seen: bool, origin: float
) -> None:
    rng = np.random.default_rng(seed)
    points = rng.integers(0, 4, (count, 3)) * scale if grid else rng.normal(size=(count, 3)) * scale
    points = points * (1, 1, 0 if flat else 1) + origin
    try:
        cloud, _ = usable_points(Cloud(points, points + rng.normal(size=points.shape) if seen else None))
        surface = prepare(cloud)
    except InputError:
        return
    assert_sound(surface)


def assert_sound(surface: SurfacePoints) -> None:
    np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1.0)
    assert np.isfinite(surface.noise)
    assert (surface.weights > 0).all()
    assert ((surface.neighbors >= 0) & (surface.neighbors < len(surface))).all()
