# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from g2_recon.errors import InputError
from g2_recon.geometry.cloud import Cloud
from g2_recon.reconstruction.clustering.flat import FlatClusters, _connected, flat_clusters
from g2_recon.reconstruction.surface_points import SurfacePoints, prepare

SIZE = np.array([5.0, 4.0, 3.0])


def room(*, noise: float = 0.01, seed: int = 0, density: float = 250.0) -> tuple[Cloud, np.ndarray]:
    """A room of 5 m x 4 m x 3 m seen from its middle, and the face (N,) of each point: 2 * axis + side."""
    rng = np.random.default_rng(seed)
    points, faces = [], []
    for axis in range(3):
        for side in range(2):
            count = int(density * SIZE.prod() / SIZE[axis])
            wall = rng.uniform(0, SIZE, (count, 3))
            wall[:, axis] = SIZE[axis] * side + noise * rng.normal(size=count)
            points.append(wall)
            faces.append(np.full(count, 2 * axis + side))
    stacked = np.vstack(points)
    return Cloud(stacked, np.broadcast_to(SIZE / 2, stacked.shape).copy()), np.concatenate(faces)


def sheet(low: tuple[float, float, float], high: tuple[float, float, float], count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


def scan_line(x: float, sensor: tuple[float, float, float], noise: float = 0.01) -> Cloud:
    """A vertical scan of the wall y = 0 at that x, its ranges with noise."""
    points = np.column_stack([np.full(80, x), np.zeros(80), np.linspace(0.1, 2.5, 80)])
    away = points - sensor
    away *= 1 + noise * np.random.default_rng(0).normal(size=(80, 1)) / np.linalg.norm(away, axis=1, keepdims=True)
    return Cloud(away + sensor, np.tile(sensor, (80, 1)))


def purity(label: np.ndarray, truth: np.ndarray) -> float:
    """The share of points whose cluster has most of its points on the same true surface; no cluster counts as wrong."""
    table = np.zeros((label.max() + 1, truth.max() + 1))
    np.add.at(table, (label[label >= 0], truth[label >= 0]), 1)
    return float(table.max(axis=1).sum() / len(label))


@pytest.mark.parametrize("turn", range(3))
def test_each_cluster_of_a_room_lies_on_one_wall(turn: int) -> None:
    cloud, face = room()
    rotation = Rotation.random(rng=turn)
    surface = prepare(Cloud(rotation.apply(cloud.points), rotation.apply(cloud.sensor)))
    clusters = flat_clusters(surface, seed=turn)
    # Points closer to an edge than the noise belong to either wall: 2 cm of 48 m of edges on 94 m^2 are one percent.
    assert purity(clusters.label, face[surface.kept]) > 0.98


@pytest.mark.parametrize(("lies_on_it", "turned"), [(True, 0.0), (False, 45.0)])
def test_a_single_scan_on_the_plane_of_a_wall_nearby_is_of_that_wall(lies_on_it: bool, turned: float) -> None:
    wall = sheet((0.0, 0.0, 0.0), (3.0, 0.0, 2.5), 4000)
    wall[:, 1] = 0.01 * np.random.default_rng(1).normal(size=4000)
    # Seen at 45 deg, so that without the wall it would face there.
    scan = scan_line(4.2, (2.2, 2.0, 0.6))
    aside = (0.0, 0.0 if lies_on_it else 0.2, 0.0)
    cloud = Cloud(
        np.concatenate([wall, scan.points + aside]),
        np.concatenate([np.tile((1.5, 2.0, 0.6), (4000, 1)), scan.sensor + aside]),
    )
    surface = prepare(cloud)
    clusters = flat_clusters(surface)
    of_scan = np.unique(clusters.label[surface.points[:, 0] > 4.0])
    angles = np.degrees(np.arccos(np.minimum(clusters.normals[of_scan, 1], 1.0)))
    # The noise of 80 points on a wall of a metre and more turns its plane by less than 2 deg.
    assert angles == pytest.approx(turned, abs=2.0)


@pytest.mark.parametrize("seed", range(5))
def test_planes_of_a_room_are_its_walls_whatever_the_seed(seed: int) -> None:
    cloud, face = room()
    surface = prepare(cloud)
    clusters = flat_clusters(surface, seed=seed)
    axis, side = np.divmod(
        np.array([np.bincount(face[surface.kept][clusters.label == k]).argmax() for k in range(len(clusters))]), 2
    )
    each = np.arange(len(clusters))
    inwards = np.where(side == 0, 1.0, -1.0)
    assert (clusters.normals[each, axis] * inwards > np.cos(np.deg2rad(2))).all()
    np.testing.assert_allclose(clusters.centers[each, axis], SIZE[axis] * side, atol=0.01)


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_clusters_are_as_thick_as_the_noise(noise: float) -> None:
    clusters = flat_clusters(prepare(room(noise=noise)[0]))
    assert np.median(clusters.thickness) == pytest.approx(noise, rel=0.15)
    assert clusters.thickness.max() < 2 * noise


def test_both_faces_of_a_thin_wall_are_apart() -> None:
    near, far = sheet((0, 0, 0), (4, 0, 3), 4000), sheet((0, 0.1, 0), (4, 0.1, 3), 4000, seed=1)
    points = np.vstack([near, far])
    sensor = points + np.repeat([(0.0, -2.0, 0.0), (0.0, 2.0, 0.0)], 4000, axis=0)
    surface = prepare(Cloud(points, sensor))
    assert purity(flat_clusters(surface).label, (surface.kept >= 4000).astype(int)) == 1.0


def test_a_small_step_in_a_wall_gets_its_own_clusters() -> None:
    """A niche 15 cm deep and 80 cm wide in a wall 6 m wide."""
    points = sheet((0, 0, 0), (6, 0, 3), 9000)
    niche = (np.abs(points[:, 0] - 3) < 0.4) & (np.abs(points[:, 2] - 1.5) < 0.4)
    points[niche, 1] = 0.15
    surface = prepare(Cloud(points, np.broadcast_to((3.0, -2.0, 1.5), points.shape).copy()))
    assert purity(flat_clusters(surface).label, niche[surface.kept].astype(int)) > 0.99


def test_a_gap_in_a_wall_parts_clusters() -> None:
    points = np.vstack([sheet((0, 0, 0), (1, 0, 2), 1500), sheet((2, 0, 0), (3, 0, 2), 1500)])
    surface = prepare(Cloud(points))
    clusters = flat_clusters(surface, patch_area=10)
    assert len(clusters) == 2
    assert purity(clusters.label, (surface.kept >= 1500).astype(int)) == 1.0


def test_clusters_hang_together_across_gaps_between_scans() -> None:
    x, z = np.meshgrid(np.arange(0, 4, 0.4), np.arange(0, 3, 0.03), indexing="ij")
    wall = np.column_stack([x.ravel(), np.zeros(x.size), z.ravel()])
    clusters = flat_clusters(prepare(Cloud(wall, wall * (1, 0, 0) + (0, 2, 0.35))))
    assert len(clusters) <= 10
    assert (clusters.label >= 0).all()


def test_scraps_too_small_for_a_map_get_no_cluster() -> None:
    points = np.vstack([sheet((0, 0, 0), (3, 0, 3), 4000), sheet((1, 2, 1), (1.1, 2, 1.1), 8)])
    surface = prepare(Cloud(points))
    clusters = flat_clusters(surface)
    np.testing.assert_array_equal(clusters.label < 0, surface.kept >= 4000)


def test_the_result_does_not_depend_on_the_workers() -> None:
    surface = prepare(room(density=1000)[0])
    one, three = flat_clusters(surface, workers=1), flat_clusters(surface, workers=3)
    np.testing.assert_array_equal(one.label, three.label)
    np.testing.assert_array_equal(one.centers, three.centers)


def test_coordinates_of_a_million_metres_change_nothing() -> None:
    cloud, face = room()
    shift = np.array((5e5, 5e6, 300.0))
    surface = prepare(Cloud(cloud.points + shift, cloud.sensor + shift))
    assert purity(flat_clusters(surface).label, face[surface.kept]) > 0.98


def test_points_that_lie_in_a_plane_but_for_rounding_keep_their_cluster() -> None:
    flat = np.stack(np.meshgrid(np.arange(4), np.arange(8), [0]), axis=-1).reshape(-1, 3) * 0.1
    for turn in range(40):
        # Around the origin, where nothing but the points themselves tells how fine coordinates are.
        points = Rotation.random(rng=turn).apply(flat - flat.mean(axis=0))
        clusters = flat_clusters(prepare(Cloud(points), spacing=0.1, radius=0.125, off_plane=0.075), min_area=0.01)
        assert set(clusters.label) - {-1} == set(range(len(clusters)))


def test_a_surface_with_no_large_piece_is_refused() -> None:
    surface = prepare(Cloud(sheet((0, 0, 0), (0.05, 0.05, 0.05), 50)))
    with pytest.raises(InputError, match="hangs together covers"):
        flat_clusters(surface)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(10, 300),
    scale=st.sampled_from([0.05, 0.3, 1.0]),
    grid=st.booleans(),
    thin=st.sampled_from([0.0, 1e-9, 0.1, 1.0]),
    seen=st.booleans(),
    origin=st.sampled_from([0.0, 1e6]),
)
def test_any_cloud_gives_finite_planes_or_a_clear_error(
    seed: int, count: int, scale: float, grid: bool, thin: float, seen: bool, origin: float
) -> None:
    rng = np.random.default_rng(seed)
    points = rng.integers(0, 5, (count, 3)) * scale if grid else rng.normal(size=(count, 3)) * scale
    points = points * (1, 1, thin) + origin
    try:
        surface = prepare(Cloud(points, points + rng.normal(size=points.shape) if seen else None))
        clusters = flat_clusters(surface, seed=seed % 10)
    except InputError:
        return
    assert_sound(surface, clusters)


def test_a_scan_farther_from_the_others_than_the_gap_is_a_cluster_of_its_own() -> None:
    along, up = (grid.ravel() for grid in np.meshgrid([*np.arange(0.0, 1.0, 0.05), 1.6], np.arange(0.0, 3.0, 0.04)))
    points = np.column_stack([along, np.zeros_like(along), up])
    surface = prepare(Cloud(points, points + (0.0, 2.0, 0.0)))
    alone = surface.points[:, 0] > 1.2
    assert purity(flat_clusters(surface, patch_area=10, gap=0.4).label, alone.astype(int)) == 1.0
    assert len(flat_clusters(surface, patch_area=10, gap=0.8)) == 1


def assert_sound(surface: SurfacePoints, clusters: FlatClusters) -> None:
    assert clusters.label.shape == (len(surface),)
    assert set(clusters.label) - {-1} == set(range(len(clusters)))
    assert np.isfinite(clusters.centers).all()
    assert np.isfinite(clusters.thickness).all()
    np.testing.assert_allclose(np.linalg.norm(clusters.normals, axis=1), 1.0)


def test_clusters_are_parted_as_by_a_graph() -> None:
    rng = np.random.default_rng(0)
    neighbors = rng.integers(0, 500, (500, 2)).astype(np.int32)
    label = rng.integers(0, 4, 500)
    rows, columns = np.repeat(np.arange(500), 2), neighbors.ravel()
    points = rng.random((500, 3))
    near = np.linalg.norm(points[rows] - points[columns], axis=1) < 0.8
    same = (label[rows] == label[columns]) & near
    assert 0 < near.sum() < len(near)
    graph = coo_array((np.ones(same.sum()), (rows[same], columns[same])), shape=(500, 500))
    assert (_connected(points, neighbors, label, 0.8) == connected_components(graph, directed=False)[1]).all()
