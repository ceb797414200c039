# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.config import LocalizationConfig
from g2_recon.geometry import se2
from g2_recon.geometry.scan import Scan
from g2_recon.localization.beams import beams
from g2_recon.localization.collecting import Collector, latest

FORWARD = np.array([0.05, 0.0, 0.05])


def seen(scan):
    return beams(scan, range_min=0.1, range_max=40.0)


def circle(steps):
    poses = [np.zeros(3)]
    for _ in range(steps - 1):
        poses.append(se2.compose(poses[-1], FORWARD))
    return poses


@pytest.mark.parametrize("step", [None, FORWARD])
def test_scans_are_kept_where_the_robot_has_moved_on_and_lie_as_they_were_taken(scan_of_room, step):
    collector = Collector(LocalizationConfig(keyframe_distance=0.2, keyframe_angle=0.15))
    poses = circle(60)
    kept = [
        collector.add(seen(scan_of_room(pose, noise=0.01, seed=i)), step if i else None) for i, pose in enumerate(poses)
    ]
    assert kept[0]
    assert 15 <= sum(kept) == len(collector.keyframes) <= 20
    truth = np.array(poses)[np.flatnonzero(kept)]
    # Noise of 1 cm a beam.
    np.testing.assert_allclose(collector.keyframes.poses, truth, atol=0.02)
    np.testing.assert_allclose(collector.pose, poses[-1], atol=0.02)


def test_scans_from_before_a_jump_are_forgotten_and_the_way_goes_on(scan_of_room, scan_of_halls):
    collector = Collector(LocalizationConfig())
    for i, pose in enumerate(circle(20)):
        collector.add(seen(scan_of_room(pose, noise=0.01, seed=i)), FORWARD)
    before = collector.pose
    for i in range(6):
        collector.add(seen(scan_of_halls((1, 3, 1.5), noise=0.01, seed=i)), np.zeros(3))
    assert len(collector.keyframes) == 1
    np.testing.assert_allclose(collector.pose, before, atol=0.1)


def test_a_scan_without_beams_is_not_kept_and_the_pose_follows_odometry():
    collector = Collector(LocalizationConfig())
    nothing = seen(Scan(0.0, np.full(181, np.inf, np.float32), -1.5, 0.01))
    for _ in range(10):
        assert not collector.add(nothing, FORWARD)
    np.testing.assert_allclose(collector.pose, circle(11)[-1], atol=1e-9)
    assert not len(collector.keyframes)


def test_memory_does_not_grow_with_a_long_search(scan_of_room):
    collector = Collector(LocalizationConfig(keyframe_distance=0.01, keyframe_angle=0.01))
    for i, pose in enumerate(circle(250)):
        assert collector.add(seen(scan_of_room(pose, noise=0.005, seed=i, beams=61)), FORWARD)
        assert len(collector.keyframes) <= 96
    assert len(collector.keyframes) >= 32


def test_the_latest_keyframes_are_looked_for_together():
    assert latest(1).tolist() == [0]
    assert latest(5).tolist() == [0, 1, 2, 3, 4]
    assert latest(5, 3).tolist() == [3, 4]
    rows = latest(100)
    assert len(rows) == 12 and rows[0] == 68 and rows[-1] == 99
