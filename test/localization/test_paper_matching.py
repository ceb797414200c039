# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry import se2
from g2_recon.localization.paper_matching import beam_normals, match, normal_equations, reject_outliers
from g2_recon.localization.point_map import PointMap

LIMITS = {"max_correspondence": 0.5, "min_correspondence": 0.1, "max_iterations": 50}


def surface_points(scan):
    points, beams = scan.points()
    normals = beam_normals(points, beams)
    known = normals.any(axis=1)
    return points[known], normals[known]


def map_of(scan):
    point_map = PointMap(spacing=0.01, reach=50)
    point_map.add(*surface_points(scan))
    point_map.focus((0, 0))
    return point_map


@pytest.mark.parametrize("pose", [(0.1, 0.05, 0.05), (-0.2, 0.1, -0.1), (0, 0, 0.15), (0.25, -0.1, 0)])
def test_a_known_displacement_comes_back_within_a_millimetre(scan_of_room, pose):
    result = match(*surface_points(scan_of_room(pose)), map_of(scan_of_room((0, 0, 0))), (0, 0, 0), **LIMITS)
    assert result.converged
    assert np.hypot(*(result.pose - pose)[:2]) < 0.001
    assert abs(result.pose[2] - pose[2]) < 0.0005


def test_people_in_the_way_do_not_pull_at_the_pose(scan_of_room):
    pose = (0.1, 0.05, 0.05)
    scan = scan_of_room(pose)
    scan.ranges[60:96] *= 0.8
    result = match(*surface_points(scan), map_of(scan_of_room((0, 0, 0))), (0, 0, 0), **LIMITS)
    assert np.hypot(*(result.pose - pose)[:2]) < 0.005
    assert 0.7 < result.inliers < 0.85


def test_a_scan_far_from_the_map_has_no_inliers(scan_of_room):
    result = match(*surface_points(scan_of_room((0, 0, 0))), map_of(scan_of_room((0, 0, 0))), (50, 50, 0), **LIMITS)
    assert result.inliers == 0
    assert not result.converged
    assert result.pose == pytest.approx([50, 50, 0])


def test_information_says_that_a_corridor_is_not_measured_along_itself(scan_of_corridor):
    reference = map_of(scan_of_corridor((0, 0, 0)))
    information = match(*surface_points(scan_of_corridor((0, 0, 0))), reference, (0, 0, 0), **LIMITS).information
    assert information[0, 0] < 1e-3 * information[1, 1]


def test_the_stated_uncertainty_fits_the_errors_made(scan_of_room):
    reference = map_of(scan_of_room((0, 0, 0)))
    normalized = []
    for seed in range(200):
        scan = scan_of_room((0.05, 0.02, 0.01), noise=0.01, seed=seed)
        result = match(*surface_points(scan), reference, (0, 0, 0), **LIMITS)
        error = result.pose - (0.05, 0.02, 0.01)
        normalized.append(error @ result.information @ error / 3)
    # The mean of a normalized squared error of three dimensions is 1; a factor of 2 is what ICP's pairing costs.
    assert 0.5 < np.mean(normalized) < 2


def test_pairs_far_beyond_the_median_are_rejected():
    distance = np.array([0.05, 0.06, 0.07, 0.5, np.inf])
    assert reject_outliers(distance, 0.01).tolist() == [True, True, True, False, False]


def test_pairs_within_the_floor_are_kept_whatever_the_median():
    assert reject_outliers(np.array([0.001, 0.001, 0.09]), 0.1).all()


def test_without_pairs_nothing_is_kept():
    assert not reject_outliers(np.full(4, np.inf), 0.1).any()


def test_normal_equations_are_those_of_the_residuals():
    rng = np.random.default_rng(0)
    points, partner = rng.normal(size=(20, 2)), rng.normal(size=(20, 2))
    normal = rng.normal(size=(20, 2))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    pose, kept = np.array([0.3, -0.2, 0.5]), rng.random(20) < 0.8

    def residuals(at):
        return np.einsum("ij,ij->i", se2.transform_points(at, points) - partner, normal)[kept]

    step = 1e-6 * np.eye(3)
    jacobian = np.stack([(residuals(pose + d) - residuals(pose - d)) / 2e-6 for d in step], axis=1)
    hessian, gradient, squared = normal_equations(se2.transform_points(pose, points), partner, normal, kept, pose)
    assert hessian == pytest.approx(jacobian.T @ jacobian, rel=1e-5)
    assert gradient == pytest.approx(jacobian.T @ residuals(pose), rel=1e-5)
    assert squared == pytest.approx(np.sum(residuals(pose) ** 2))


def test_normals_of_walls_stand_on_them_and_look_at_the_laser(scan_of_room):
    points, beams = scan_of_room((0, 0, 0)).points()
    normals = beam_normals(points, beams)
    known = normals.any(axis=1)
    assert known.mean() > 0.8
    # All walls of the room are parallel to an axis; beside a corner a line is laid through some of the other wall.
    assert np.mean(np.abs(normals[known]).max(axis=1) > 0.9999) > 0.8
    assert (np.einsum("ij,ij->i", normals, points) <= 0).all()


def test_normals_agree_with_a_plain_principal_axis(scan_of_room):
    points, beams = scan_of_room((0, 0, 0), noise=0.003).points()
    normals = beam_normals(points, beams)
    for i in np.flatnonzero(normals.any(axis=1))[20:150:10]:
        gap = max(0.15, 0.12 * np.linalg.norm(points[i]))
        jump = np.linalg.norm(np.diff(points, axis=0), axis=1) > gap
        group = np.r_[0, np.cumsum(jump)]
        near = points[(np.abs(np.arange(len(points)) - i) <= 4) & (group == group[i])]
        across = np.linalg.svd(near - near.mean(axis=0))[2][1]
        assert abs(across @ normals[i]) == pytest.approx(1, abs=1e-9)


def test_beams_that_are_not_neighbors_make_no_line():
    points = np.column_stack([np.ones(9), np.linspace(-0.2, 0.2, 9)])
    assert beam_normals(points, np.arange(9)).any()
    assert not beam_normals(points, 2 * np.arange(9)).any()


def test_dense_beams_have_normals_too(scan_of_room):
    points, beams = scan_of_room((0, 0, 0), beams=1441, noise=0.005).points()
    assert beam_normals(points, beams).any(axis=1).mean() > 0.8
