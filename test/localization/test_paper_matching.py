# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry import se2
from g2_recon.localization.paper_matching import match, reject_outliers, rigid_motion
from g2_recon.localization.point_map import PointMap

LIMITS = {"max_correspondence": 0.5, "min_correspondence": 0.1, "max_iterations": 100}


def points_of(scan):
    return scan.points()[0]


def map_of(scan):
    point_map = PointMap(spacing=0.01, reach=50)
    point_map.add(points_of(scan))
    point_map.focus((0, 0))
    return point_map


@pytest.fixture
def dense_map(scan_of_room):
    """The room, with a point each centimetre or nearer."""
    return map_of(scan_of_room((0, 0, 0), beams=3601))


@pytest.mark.parametrize("pose", [(0.1, 0.05, 0.05), (-0.2, 0.1, -0.1), (0, 0, 0.15), (0.1, -0.1, 0)])
def test_a_known_displacement_comes_back(scan_of_room, dense_map, pose):
    result = match(points_of(scan_of_room(pose)), dense_map, (0, 0, 0), **LIMITS)
    assert result.converged
    # Points of the map are 1 cm apart: half of that is what a single pair may be off along a wall.
    assert np.hypot(*(result.pose - pose)[:2]) < 0.005
    assert abs(result.pose[2] - pose[2]) < 0.002


def test_people_in_the_way_do_not_pull_at_the_pose(scan_of_room, dense_map):
    pose = (0.1, 0.05, 0.05)
    scan = scan_of_room(pose)
    scan.ranges[60:96] *= 0.8
    result = match(points_of(scan), dense_map, (0, 0, 0), **LIMITS)
    assert np.hypot(*(result.pose - pose)[:2]) < 0.01
    assert 0.7 < result.inliers < 0.85


def test_a_scan_far_from_the_map_has_no_inliers(scan_of_room, dense_map):
    result = match(points_of(scan_of_room((0, 0, 0))), dense_map, (50, 50, 0), **LIMITS)
    assert result.inliers == 0
    assert not result.converged
    assert result.pose == pytest.approx([50, 50, 0])


def test_information_is_that_of_the_residuals(scan_of_room, dense_map):
    points, pose = points_of(scan_of_room((0, 0, 0), noise=0.01)), np.array([0.0, 0.0, 0.0])
    result = match(points, dense_map, pose, **LIMITS)

    def residuals(at):
        return (se2.transform_points(at, points) - dense_map.nearest(moved, 1.0)[0])[kept].ravel()

    moved = se2.transform_points(result.pose, points)
    kept = reject_outliers(dense_map.nearest(moved, 0.1)[1], 0.1)
    steps = 1e-6 * np.eye(3)
    jacobian = np.stack([(residuals(result.pose + d) - residuals(result.pose - d)) / 2e-6 for d in steps], axis=1)
    expected = jacobian.T @ jacobian / np.mean(residuals(result.pose) ** 2)
    # The last step, of less than 0.2 mm, lies between the two.
    assert result.information == pytest.approx(expected, rel=0.02, abs=0.02 * np.abs(expected).max())


def test_pairs_far_beyond_the_median_are_rejected():
    distances = np.array([0.05, 0.06, 0.07, 0.5, np.inf])
    assert reject_outliers(distances, 0.01).tolist() == [True, True, True, False, False]


def test_pairs_within_the_floor_are_kept_whatever_the_median():
    assert reject_outliers(np.array([0.001, 0.001, 0.09]), 0.1).all()


def test_without_pairs_nothing_is_kept():
    assert not reject_outliers(np.full(4, np.inf), 0.1).any()


@pytest.mark.parametrize("pose", [(1.0, -2.0, 0.3), (0.0, 0.0, 3.0), (-5.0, 1.0, -1.6)])
def test_a_rigid_motion_is_found_in_one_step(pose):
    points = np.random.default_rng(0).normal(size=(20, 2)) + (3, 4)
    assert rigid_motion(points, se2.transform_points(pose, points)) == pytest.approx(pose)


def test_the_rigid_motion_is_that_of_the_singular_value_decomposition():
    """Umeyama (1991), equations 40 to 42, without scale."""
    rng = np.random.default_rng(1)
    points = rng.normal(size=(30, 2))
    partners = se2.transform_points((0.5, 0.2, 0.7), points) + rng.normal(0, 0.1, (30, 2))
    covariance = (partners - partners.mean(axis=0)).T @ (points - points.mean(axis=0))
    u, _, vt = np.linalg.svd(covariance)
    rotation = u @ np.diag([1, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    x, y, yaw = rigid_motion(points, partners)
    assert [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]] == pytest.approx(rotation)
    assert (x, y) == pytest.approx(partners.mean(axis=0) - rotation @ points.mean(axis=0))
