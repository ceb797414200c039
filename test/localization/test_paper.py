# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.config import LocalizationConfig
from g2_recon.geometry import se2, se3
from g2_recon.geometry.scan import Scan
from g2_recon.localization.paper import PaperLocalizer

FORWARD = np.array([0.02, 0.0, 0.01])
# What the paper states for its localization. The first scans need it: a map of one scan is coarse.
PRECISION_M = 0.05


def drive(steps=150, step=FORWARD):
    """True poses of a robot that goes round in a circle of 2 m in the room, starting at the identity."""
    poses = [np.zeros(3)]
    for _ in range(steps - 1):
        poses.append(se2.compose(poses[-1], step))
    return np.array(poses)


def localize(scans, odometry=None, **settings):
    localizer = PaperLocalizer(LocalizationConfig(**settings), np.eye(4))
    results = [
        localizer.process(scan, None if odometry is None else odometry[index]) for index, scan in enumerate(scans)
    ]
    return localizer, results


def errors(results, truth):
    return np.array([np.hypot(*(result.pose - pose)[:2]) for result, pose in zip(results, truth, strict=True)])


def test_a_drive_through_a_room_is_followed_without_odometry(scan_of_room):
    truth = drive()
    _, results = localize([scan_of_room(pose, noise=0.01, seed=i) for i, pose in enumerate(truth)])
    assert errors(results, truth).mean() < 0.01
    assert all(result.matched for result in results[1:])


def test_bad_odometry_is_put_right_by_the_scans(scan_of_room):
    truth = drive()
    slipping = drive(step=FORWARD * (1.3, 1.0, 0.5))
    _, results = localize([scan_of_room(pose, noise=0.01, seed=i) for i, pose in enumerate(truth)], slipping)
    assert errors(results, truth).mean() < 0.01


@pytest.mark.parametrize("ranges", [np.nan, np.inf, -np.inf, 0.0], ids=str)
def test_without_valid_beams_the_pose_follows_odometry_and_the_loss_is_counted(scan_of_room, ranges):
    truth = drive(20)
    scans = [scan_of_room(pose) for pose in truth]
    blind = Scan(0.0, np.full(181, ranges, np.float32), -np.pi / 2, np.pi / 180, 0.0, 80.0)
    localizer, results = localize(scans[:10] + [blind] * 5 + scans[15:], truth)
    assert errors(results, truth).max() < PRECISION_M
    assert localizer.unmatched == 5
    assert [result.matched for result in results[10:15]] == [False] * 5
    assert np.trace(results[14].covariance) > 2 * np.trace(results[9].covariance)


def test_odometry_that_is_not_a_number_is_not_used(scan_of_room):
    truth = drive(30)
    odometry = truth.copy()
    odometry[10:20] = np.nan
    _, results = localize([scan_of_room(pose) for pose in truth], odometry)
    assert errors(results, truth).max() < PRECISION_M


@pytest.mark.parametrize("spike", [5.0, 1e4, 1e300])
def test_odometry_that_jumps_is_not_followed_and_counted(scan_of_room, spike):
    truth = drive(30)
    odometry = truth.copy()
    odometry[12, 0] += spike
    odometry[20:, 1] -= spike
    localizer, results = localize([scan_of_room(pose) for pose in truth], odometry)
    assert errors(results, truth).max() < PRECISION_M
    assert localizer.odometry_jumps == 3


def test_odometry_is_not_looked_at_where_it_is_switched_off(scan_of_room):
    truth = drive(30)
    wild = np.random.default_rng(0).normal(0, 5, truth.shape)
    _, results = localize([scan_of_room(pose) for pose in truth], wild, use_odometry=False)
    assert errors(results, truth).max() < PRECISION_M


def test_a_rejected_scan_does_not_enter_the_map(scan_of_room):
    localizer, _ = localize([scan_of_room((0, 0, 0))])
    before = localizer.point_map()
    other_place = scan_of_room((1.5, 1.0, 2.0))
    result = localizer.process(other_place, None)
    assert not result.matched
    assert localizer.point_map().tolist() == before.tolist()


def test_a_laser_off_the_center_of_the_robot_gives_the_pose_of_the_robot(scan_of_room):
    T_base_laser = se3.from_xyz_rpy([0.2, 0.1, 0.4, 0, 0, 0.3])
    truth = drive(80)
    localizer = PaperLocalizer(LocalizationConfig(), T_base_laser)
    scans = [scan_of_room(se2.compose(pose, se2.from_se3(T_base_laser))) for pose in truth]
    assert errors([localizer.process(scan) for scan in scans], truth).max() < PRECISION_M


def test_a_laser_mounted_upside_down_gives_the_pose_of_the_robot(scan_of_room):
    truth = drive(80)
    localizer = PaperLocalizer(LocalizationConfig(), se3.from_xyz_rpy([0, 0, 0.4, np.pi, 0, 0]))
    scans = [scan_of_room(pose, upside_down=True) for pose in truth]
    assert errors([localizer.process(scan) for scan in scans], truth).max() < PRECISION_M


def test_standing_still_adds_no_keyframe(scan_of_room):
    _, results = localize([scan_of_room((0, 0, 0), noise=0.01, seed=i) for i in range(50)])
    assert [result.keyframe for result in results] == [True] + [False] * 49


def test_after_a_reset_the_map_starts_again_where_it_is_told(scan_of_room):
    localizer, _ = localize([scan_of_room(pose) for pose in drive(40)])
    localizer.reset((5.0, 6.0, 1.0))
    assert localizer.process(scan_of_room((0, 0, 0))).pose == pytest.approx([5, 6, 1])
    assert len(localizer.trajectory()) == 1


def test_the_trajectory_holds_a_pose_a_scan_in_the_order_of_the_scans(scan_of_room):
    truth = drive(12)
    scans = [scan_of_room(pose, stamp=float(-i)) for i, pose in enumerate(truth)]
    localizer, results = localize(scans)
    assert localizer.trajectory().stamps.tolist() == [-float(i) for i in range(12)]
    assert localizer.trajectory().planar() == pytest.approx(np.array([result.pose for result in results]))
    assert len(localizer.keyframes()) == sum(result.keyframe for result in results)


def test_the_same_scans_give_the_same_poses(scan_of_room):
    scans = [scan_of_room(pose, noise=0.01, seed=i) for i, pose in enumerate(drive(30))]
    once, again = (localize(scans)[0].trajectory() for _ in range(2))
    assert once.positions.tolist() == again.positions.tolist()
