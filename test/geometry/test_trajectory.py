# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from g2_recon.errors import InputError
from g2_recon.geometry import se2, se3
from g2_recon.geometry.trajectory import PoseBuffer, Trajectory


def straight(stamps):
    """1 m/s along x while turning by 0.1 rad/s."""
    stamps = np.asarray(stamps, float)
    return Trajectory.from_se2(stamps, np.column_stack([stamps, np.zeros(len(stamps)), 0.1 * stamps]))


@pytest.mark.parametrize("count", [0, 1, 255, 256, 257, 1000])
def test_planar_poses_are_those_of_their_matrices(count):
    poses = np.random.default_rng(count).uniform(-10, 10, (count, 3))
    trajectory, twin = (
        Trajectory.from_se2(np.arange(count), poses),
        Trajectory.from_matrices(np.arange(count), se3.from_se2(poses)),
    )
    assert np.array_equal(trajectory.positions, twin.positions)
    assert np.array_equal(trajectory.quaternions, twin.quaternions)


def test_between_two_poses_position_and_heading_are_interpolated():
    transforms, known = straight([0.0, 1.0]).interpolate([0.25])
    assert known.all()
    assert se2.from_se3(transforms[0]) == pytest.approx([0.25, 0, 0.025])


def test_nothing_is_extrapolated():
    transforms, known = straight([0.0, 1.0]).interpolate([-0.01, 0.5, 1.01])
    assert known.tolist() == [False, True, False]
    assert np.isnan(transforms[[0, 2]]).all()


def test_nothing_is_interpolated_across_a_gap():
    _, known = straight([0.0, 1.0, 5.0]).interpolate([0.5, 3.0, 5.0], max_gap=2.0)
    assert known.tolist() == [True, False, True]


def test_of_poses_with_equal_stamps_the_last_counts():
    trajectory = Trajectory.from_se2([0.0, 1.0, 1.0], [[0, 0, 0], [1, 0, 0], [9, 0, 0]])
    assert trajectory.interpolate([1.0])[0][0, 0, 3] == pytest.approx(9)


def test_stamps_that_step_backwards_are_looked_up_by_time():
    trajectory = straight([0.0, 2.0, 1.0, 3.0])
    assert trajectory.interpolate([1.5])[0][0, 0, 3] == pytest.approx(1.5)


def test_a_single_pose_is_known_at_its_own_time_only():
    _, known = straight([1.0]).interpolate([1.0, 1.5])
    assert known.tolist() == [True, False]


def test_an_empty_trajectory_knows_nothing():
    transforms, known = straight([]).interpolate([1.0])
    assert not known.any()
    assert transforms.shape == (1, 4, 4)


def test_heading_turns_the_short_way_through_pi():
    trajectory = Trajectory.from_se2([0.0, 1.0], [[0, 0, np.pi - 0.1], [0, 0, -np.pi + 0.1]])
    yaw = se2.from_se3(trajectory.interpolate([0.5])[0])[0, 2]
    assert abs(yaw) == pytest.approx(np.pi)


def test_length_is_the_way_along_all_poses():
    assert straight([0.0, 1.0, 3.0]).length() == pytest.approx(3.0)


def test_arrays_of_different_lengths_are_refused():
    with pytest.raises(InputError):
        Trajectory(np.zeros(2), np.zeros((3, 3)), np.zeros((2, 4)))


def test_resampling_keeps_the_path():
    again = straight(np.linspace(0, 2, 5)).resampled(0.1)
    assert len(again) == 20
    assert again.planar()[:, 0] == pytest.approx(again.stamps)


@given(st.permutations(range(8)), st.floats(0, 7))
def test_a_buffer_filled_in_any_order_looks_up_like_the_trajectory(order, stamp):
    trajectory = straight(np.arange(8.0))
    buffer = PoseBuffer()
    for index in order:
        buffer.add(float(index), trajectory.matrices()[index])
    found, known = buffer.interpolate([stamp])
    assert known.all()
    assert found == pytest.approx(trajectory.interpolate([stamp])[0], abs=1e-9)


def test_a_buffer_keeps_what_later_look_ups_need_and_no_more():
    buffer = PoseBuffer()
    for stamp in range(10):
        buffer.add(float(stamp), se3.from_se2([stamp, 0, 0]))
    buffer.drop_before(4.5)
    assert len(buffer) == 6
    assert buffer.interpolate([4.5])[1].all()
    assert not buffer.interpolate([3.5])[1].any()


def test_a_pose_sent_again_replaces_the_first():
    buffer = PoseBuffer()
    for x in (1.0, 2.0):
        buffer.add(0.0, se3.from_se2([x, 0, 0]))
    assert len(buffer) == 1
    assert buffer.interpolate([0.0])[0][0, 0, 3] == 2.0


def test_a_cleared_buffer_is_empty():
    buffer = PoseBuffer()
    buffer.add(0.0, np.eye(4))
    buffer.clear()
    assert len(buffer) == 0
    assert buffer.last_stamp == -np.inf


def on_a_curve(stamps):
    """A body at 0.5 m/s that turns at 1 rad/s."""
    return {t: se3.from_se2([0.5 * np.sin(t), 0.5 * (1 - np.cos(t)), t]) for t in stamps}


def test_a_body_is_thought_to_go_on_as_it_went():
    buffer = PoseBuffer()
    for stamp, pose in on_a_curve([0.0, 0.04]).items():
        buffer.add(stamp, pose)
    assert buffer.ahead(0.07, 0.1) == pytest.approx(on_a_curve([0.07])[0.07], abs=1e-3)  # m: an arc, drawn straight
    assert buffer.ahead(0.04, 0.1) == pytest.approx(on_a_curve([0.04])[0.04], abs=1e-9)


def test_what_comes_after_a_time_makes_no_difference_to_the_pose_ahead():
    buffer = PoseBuffer()
    for stamp in (0.0, 0.04):
        buffer.add(stamp, se3.from_se2([stamp, 0, 0]))
    before = buffer.ahead(0.05, 0.1)
    buffer.add(0.08, se3.from_se2([7, 7, 0]))
    assert np.array_equal(buffer.ahead(0.05, 0.1), before)


@pytest.mark.parametrize(("stamp", "longest"), [(0.09, 0.1), (0.07, 0.02), (0.02, 0.1)])
def test_nothing_is_known_ahead_where_the_next_pose_is_missing_or_there_is_but_one(stamp, longest):
    buffer = PoseBuffer()
    for known in (0.0, 0.04):
        buffer.add(known, se3.from_se2([known, 0, 0]))
    if stamp < 0.04:
        buffer = PoseBuffer()
        buffer.add(0.0, np.eye(4))
    assert buffer.ahead(stamp, longest) is None
