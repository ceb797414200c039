# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from g2_recon.config import LocalizationConfig
from g2_recon.geometry import se2, se3
from g2_recon.geometry.scan import Scan
from g2_recon.localization.localizer import Localizer
from g2_recon.localization.map_localizer import MapLocalizer

FULL = {"first": -math.pi, "beams": 180, "increment": 2 * math.pi / 180}
CONFIG = LocalizationConfig(keyframe_distance=0.4, keyframe_angle=0.3)


@pytest.fixture(scope="module")
def session(scan_of_halls, drive_along, way_around_the_halls):
    """A map of the halls in their own frame, as of a drive around them."""
    localizer = Localizer(CONFIG, np.eye(4))
    way = drive_along(way_around_the_halls, step=0.2, turn=0.15)
    localizer.reset(way[0])
    for i, pose in enumerate(way):
        step = np.zeros(3) if not i else se2.relative(way[0], pose)
        localizer.process(scan_of_halls(pose, noise=0.01, seed=i, stamp=0.1 * i, **FULL), step)
    return localizer.session()


def follow(localizer, scan, way, *, odometry=True, seed=500, stamp=1000.0, start=0, **settings):
    """Results on a way (N, 3); odometry is that of the way, and goes on where it begins elsewhere."""
    results = []
    for i, pose in enumerate(way):
        seen = scan(pose, noise=0.01, seed=seed + i, stamp=stamp + 0.1 * i, **(FULL | settings))
        results.append(localizer.process(seen, se2.relative(way[0], pose) + start if odometry else None))
    return results


def errors(results, truth):
    return np.hypot(*(np.array([result.pose for result in results]) - truth)[:, :2].T)


@pytest.mark.parametrize("odometry", [True, False])
def test_a_robot_that_wakes_up_anywhere_is_followed_in_the_map(session, scan_of_halls, drive_along, odometry):
    # Against the way of the map.
    way = drive_along([(13, 4), (13, 1), (1, 1), (1, 5)], step=0.1, turn=0.1)
    localizer = MapLocalizer(CONFIG, np.eye(4), session)
    results = follow(localizer, scan_of_halls, way, odometry=odometry)
    found = next(i for i, result in enumerate(results) if result.matched)
    assert found < 20
    assert all(result.matched for result in results[found:])
    assert localizer.unmatched == found
    # Noise of 1 cm a beam, and a map that has closed no loop: it is off by some centimetres at the far end.
    assert errors(results[found:], way[found:]).max() < 0.15
    assert not any(result.keyframe for result in results)
    covariances = np.array([result.covariance for result in results])
    assert (np.sqrt(covariances[found:, 0, 0]) < 0.1).all()
    assert (np.sqrt(covariances[:found, 0, 0]) > 100).all()


def test_the_map_stays_as_it_is(session, scan_of_halls, drive_along):
    localizer = MapLocalizer(CONFIG, np.eye(4), session, keep_scans=True)
    points, keyframes = localizer.point_map(), localizer.keyframes()
    way = drive_along([(1, 1), (8, 1)], step=0.2)
    follow(localizer, scan_of_halls, way)
    localizer.finish()
    np.testing.assert_array_equal(localizer.point_map(), points)
    np.testing.assert_array_equal(localizer.keyframes().positions, keyframes.positions)
    assert localizer.session() is session
    assert localizer.loops == 0
    assert len(localizer.trajectory()) == len(localizer.causal_trajectory()) == len(way)


def test_a_robot_carried_away_is_lost_and_found(session, scan_of_halls, drive_along):
    localizer = MapLocalizer(CONFIG, np.eye(4), session)
    before = drive_along([(1, 1), (5, 1)], step=0.1)
    after = drive_along([(13, 6), (13, 9), (6, 9)], step=0.1)
    results = follow(localizer, scan_of_halls, before)
    assert results[-1].matched
    kidnapped = follow(localizer, scan_of_halls, after, start=before[-1] - before[0], stamp=1100.0)
    sure = np.array([result.matched and result.covariance[0, 0] < 0.2**2 for result in kidnapped])
    found = np.argmax(sure)
    assert 0 < found < 40
    assert all(sure[found:])
    assert errors(kidnapped[found:], after[found:]).max() < 0.15


def test_outside_of_the_map_the_pose_follows_the_way_with_growing_doubt_and_is_back_after(
    session, scan_of_halls, drive_along
):
    localizer = MapLocalizer(CONFIG, np.eye(4), session)
    way = drive_along([(1, 1), (9, 1)], step=0.1)
    results = []
    for i, pose in enumerate(way):
        seen = scan_of_halls(pose, noise=0.01, seed=i, stamp=0.1 * i, **FULL)
        if 25 <= i < 50:
            seen = Scan(0.1 * i, np.full(180, np.inf, np.float32), -math.pi, 2 * math.pi / 180)
        results.append(localizer.process(seen, se2.relative(way[0], pose)))
    assert not any(result.matched for result in results[25:50])
    spread = [result.covariance[0, 0] for result in results[24:50]]
    assert (np.diff(spread) > 0).all()
    assert errors(results[25:50], way[25:50]).max() < 0.15
    assert results[-1].matched
    assert errors(results[-5:], way[-5:]).max() < 0.15


def test_a_pose_that_is_given_is_looked_around(session, scan_of_halls):
    truth = np.array([5.0, 9.2, 0.4])
    localizer = MapLocalizer(CONFIG, np.eye(4), session)
    # Little is seen: without the given pose nothing would be sure.
    seen = scan_of_halls(truth, noise=0.01, seed=7, reach=2.5)
    assert not localizer.process(seen).matched
    localizer.set_pose(truth + (0.3, -0.5, 0.2))
    result = localizer.process(seen)
    assert result.matched
    error = result.pose - truth
    # Along the wall little holds it, as the covariance says.
    assert error @ np.linalg.solve(result.covariance, error) < 16
    localizer.reset(truth + (0.2, 0.2, -0.1))
    assert localizer.process(seen).matched


def test_a_given_pose_where_nothing_fits_counts_until_the_place_is_found(session, scan_of_halls, drive_along):
    way = drive_along([(13, 6), (13, 9), (6, 9)], step=0.1)
    localizer = MapLocalizer(CONFIG, np.eye(4), session)
    localizer.set_pose([5.0, 4.9, 0.0])
    results = follow(localizer, scan_of_halls, way)
    assert not results[0].matched
    np.testing.assert_allclose(results[0].pose, [5.0, 4.9, 0.0])
    assert errors(results[-1:], way[-1:])[0] < 0.15


def test_the_pose_is_that_of_the_robot_however_the_laser_is_mounted(session, scan_of_halls, drive_along):
    mount = se3.from_xyz_rpy([0.2, 0.1, 0.4, math.pi, 0, 0.3])
    way = drive_along([(1, 3), (1, 1), (6, 1)], step=0.1, turn=0.1)
    localizer = MapLocalizer(CONFIG, mount, session)
    results = follow(
        localizer, lambda pose, **s: scan_of_halls(se2.compose(pose, se2.from_se3(mount)), upside_down=True, **s), way
    )
    assert errors(results[-10:], way[-10:]).max() < 0.15


def test_memory_does_not_grow_where_the_robot_stands(session, scan_of_halls):
    localizer = MapLocalizer(CONFIG, np.eye(4), session)
    for i in range(200):
        localizer.process(scan_of_halls((1.2, 6.0, 2.0), noise=0.005, seed=i % 5, **FULL))
    held = [localizer._stamps, localizer._scans, localizer._near, localizer._collector.keyframes, localizer._causal]
    assert [len(each) <= 40 for each in held] == [True] * 5
    assert len(localizer._keyframes) == len(session)
