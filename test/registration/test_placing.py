# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from g2_recon.geometry import se3
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.registration.placing import place_beams, pose_at

MOUNT = se3.from_xyz_rpy([0.1, -0.2, 0.6, 0.2, -1.4, 0.3])


def poses(count, seed=0):
    """T_map_base at irregular times, turned at random, quaternions with either sign."""
    rng = np.random.default_rng(seed)
    quaternions = Rotation.random(count, rng=rng).as_quat()
    return Trajectory(np.cumsum(rng.uniform(0.1, 1.0, count)), rng.normal(0, 5, (count, 3)), quaternions)


def placed_plainly(in_laser, times, trajectory, max_gap):
    T_map_base, known = trajectory.interpolate(times, max_gap=max_gap)
    T_map_laser = T_map_base @ MOUNT
    points = se3.transform_points(T_map_laser, np.column_stack([in_laser, np.zeros(len(in_laser))]))
    return points, T_map_laser[:, :3, 3], known


@pytest.mark.parametrize("order", ["ascending", "descending", "any"])
def test_beams_are_placed_as_by_plain_numpy(order):
    trajectory = poses(20)
    rng = np.random.default_rng(1)
    times = np.sort(rng.uniform(trajectory.stamps[0] - 0.5, trajectory.stamps[-1] + 0.5, 500))
    times[::50] = trajectory.stamps[:10]
    times = {"ascending": times, "descending": times[::-1].copy(), "any": rng.permutation(times)}[order]
    in_laser = rng.uniform(-8, 8, (500, 2))
    arrays = trajectory.stamps, trajectory.positions, trajectory.quaternions
    points, sensor, known = place_beams(in_laser, times, *arrays, MOUNT, 0.8)
    expected = placed_plainly(in_laser, times, trajectory, 0.8)
    assert np.array_equal(known, expected[2])
    assert 50 < known.sum() < 450
    np.testing.assert_allclose(points[known], expected[0][known], atol=1e-9)
    np.testing.assert_allclose(sensor[known], expected[1][known], atol=1e-9)


def test_without_a_pose_nothing_is_known():
    empty = np.empty(0), np.empty((0, 3)), np.empty((0, 4))
    assert not place_beams(np.ones((3, 2)), np.arange(3.0), *empty, MOUNT, 1.0)[2].any()


def test_a_single_pose_holds_for_its_own_time_only():
    one = poses(1)
    times = np.array([one.stamps[0], one.stamps[0] + 1e-3])
    known = place_beams(np.ones((2, 2)), times, one.stamps, one.positions, one.quaternions, MOUNT, 1.0)[2]
    assert known.tolist() == [True, False]


def test_the_pose_at_a_time_is_that_of_plain_numpy():
    trajectory = poses(20)
    arrays = trajectory.stamps, trajectory.positions, trajectory.quaternions
    begin, end = trajectory.stamps[[0, -1]]
    for time in np.r_[np.random.default_rng(1).uniform(begin, end, 50), trajectory.stamps]:
        pose = se3.from_quaternion(*(np.array([part]) for part in pose_at(time, *arrays)))
        np.testing.assert_allclose(pose, trajectory.interpolate([time])[0], atol=1e-9)


def test_before_the_first_pose_and_after_the_last_one_the_robot_stands():
    for count in (1, 5):
        trajectory = poses(count)
        arrays = trajectory.stamps, trajectory.positions, trajectory.quaternions
        for time, row in ((trajectory.stamps[0] - 1.0, 0), (trajectory.stamps[-1] + 1.0, -1)):
            position, quaternion = pose_at(time, *arrays)
            np.testing.assert_allclose(position, trajectory.positions[row])
            np.testing.assert_allclose(abs(quaternion @ trajectory.quaternions[row]), 1.0)
