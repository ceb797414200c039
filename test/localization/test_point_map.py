# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from g2_recon.geometry import se2
from g2_recon.localization.point_map import PointMap, map_of_keyframes


def filled(points, spacing=0.1, reach=100.0):
    point_map = PointMap(spacing=spacing, reach=reach)
    point_map.add(points)
    point_map.focus((0, 0))
    return point_map


def test_nearest_agrees_with_looking_at_all_points():
    rng = np.random.default_rng(0)
    point_map, queries = filled(rng.uniform(-5, 5, (500, 2))), rng.uniform(-6, 6, (100, 2))
    distances = cdist(queries, point_map.points)
    found, distance = point_map.nearest(queries, 0.5)
    near = distances.min(axis=1) < 0.5
    assert np.isfinite(distance).tolist() == near.tolist()
    assert distance[near] == pytest.approx(distances.min(axis=1)[near])
    assert found[near] == pytest.approx(point_map.points[distances.argmin(axis=1)[near]])


def test_seeing_the_same_wall_again_adds_nothing():
    wall = np.column_stack([np.linspace(0, 5, 51), np.zeros(51)])
    point_map = filled(wall)
    assert point_map.add(wall + (0.01, 0.02)) == 0


def test_standing_still_for_an_hour_does_not_grow_the_map():
    rng = np.random.default_rng(0)
    wall = np.column_stack([np.linspace(0, 5, 200), np.zeros(200)])
    point_map = filled(wall, spacing=0.05)
    sizes = []
    for _ in range(500):
        point_map.add(wall + rng.normal(0, 0.01, wall.shape))
        point_map.focus((0, 0))
        sizes.append(len(point_map))
    assert sizes[-1] - sizes[100] <= 0.05 * sizes[100]


def test_what_is_out_of_reach_of_the_focus_is_not_searched():
    point_map = filled(np.array([[0.0, 0], [50, 0]]), reach=10)
    assert np.isinf(point_map.nearest(np.array([[50.0, 0]]), 1.0)[1]).all()
    point_map.focus((45, 0))
    assert point_map.nearest(np.array([[50.0, 0]]), 1.0)[1] == pytest.approx([0])


def test_an_empty_map_finds_nothing():
    assert np.isinf(PointMap(spacing=0.1, reach=10).nearest(np.zeros((3, 2)), 1.0)[1]).all()


def test_the_map_keeps_what_it_has_while_it_grows():
    rng = np.random.default_rng(0)
    point_map = PointMap(spacing=1e-6, reach=10)
    batches = [rng.uniform(-5, 5, (900, 2)) for _ in range(5)]
    for batch in batches:
        point_map.add(batch)
    assert point_map.points.tolist() == np.concatenate(batches).tolist()


def test_the_map_of_keyframes_is_the_first_measured_point_in_each_cell():
    rng = np.random.default_rng(1)
    poses, points = rng.uniform(-3, 3, (300, 3)), rng.uniform(-2, 2, (300, 7, 2)).astype(np.float32)
    kinds = rng.integers(0, 3, (300, 7)).astype(np.uint8)
    taken, expected = set(), []
    for pose, seen, kind in zip(poses, points, kinds, strict=True):
        for point in se2.transform_points(pose, seen[kind > 0].astype(float)):
            cell = tuple(np.floor(point / 0.3))
            if cell not in taken:
                taken.add(cell)
                expected.append(point)
    assert map_of_keyframes(poses, points, kinds, 0.3) == pytest.approx(np.array(expected), abs=1e-12)
    assert map_of_keyframes(poses[:0], points[:0], kinds[:0], 0.3).shape == (0, 2)
