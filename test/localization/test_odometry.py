# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry import se2
from g2_recon.localization.odometry import OdometrySteps


def steps_of(odometry, *, stamps=None, T_base_laser=se2.IDENTITY, use=True):
    steps = OdometrySteps(np.asarray(T_base_laser, float), use=use)
    stamps = np.zeros(len(odometry)) if stamps is None else stamps
    return steps, [steps.step(stamp, pose) for stamp, pose in zip(stamps, odometry, strict=True)]


def test_the_first_scan_has_no_step_and_the_others_the_way_since_the_one_before():
    _, steps = steps_of([(1, 2, np.pi / 2), (1, 2.3, np.pi / 2), (1, 2.3, np.pi / 2 + 0.1)])
    assert steps[0] is None
    assert steps[1] == pytest.approx([0.3, 0, 0])
    assert steps[2] == pytest.approx([0, 0, 0.1])


def test_the_step_is_that_of_the_laser_and_not_of_the_base():
    mount = np.array([0.4, 0.1, 0.3])
    poses = np.array([(0, 0, 0), (0, 0, 0.2), (0.1, 0, 0.2)])
    _, steps = steps_of(poses, T_base_laser=mount)
    lasers = se2.compose(poses, mount)
    assert steps[1] == pytest.approx(se2.relative(lasers[0], lasers[1]))
    assert steps[2] == pytest.approx(se2.relative(lasers[1], lasers[2]))
    # Turning on the spot swings the laser along a chord.
    assert np.hypot(*steps[1][:2]) == pytest.approx(2 * np.hypot(0.4, 0.1) * np.sin(0.1))


@pytest.mark.parametrize(("elapsed", "farthest"), [(0.0, 3.0), (0.1, 1.0), (2.0, 10.5)])
def test_a_step_is_a_jump_beyond_half_a_metre_and_5_metres_a_second_and_3_metres_without_time(elapsed, farthest):
    stamps = [100.0, 100.0 + elapsed]
    near, near_steps = steps_of([(0, 0, 0), (0, farthest - 0.01, 0)], stamps=stamps)
    far, far_steps = steps_of([(0, 0, 0), (0, farthest + 0.01, 0)], stamps=stamps)
    assert near_steps[1] == pytest.approx([0, farthest - 0.01, 0])
    assert near.jumps == 0
    assert far_steps[1] is None
    assert far.jumps == 1


def test_a_robot_that_swings_a_long_arm_has_not_jumped():
    steps, (_, step) = steps_of([(0, 0, 0), (0, 0, 3.0)], T_base_laser=[2.0, 0, 0])
    assert steps.jumps == 0
    assert np.hypot(*step[:2]) == pytest.approx(4 * np.sin(1.5))


@pytest.mark.parametrize("spike", [5.0, -1e6, 1e300])
def test_a_spike_jumps_there_and_back_and_then_odometry_goes_on(spike):
    steps, found = steps_of([(0, 0, 0), (0.1, 0, 0), (spike, 0, 0), (0.3, 0, 0), (0.4, 0, 0)])
    assert steps.jumps == 2
    assert [step is None for step in found] == [True, False, True, True, False]
    assert found[-1] == pytest.approx([0.1, 0, 0])


def test_time_that_runs_backwards_counts_as_time():
    steps, found = steps_of([(0, 0, 0), (3, 0, 0)], stamps=[10.0, 9.0])
    assert steps.jumps == 0
    assert found[1] == pytest.approx([3, 0, 0])


@pytest.mark.parametrize("unknown", [None, (np.nan, 0, 0), (0, 0, np.inf)])
def test_odometry_that_is_unknown_gives_no_step_to_it_nor_from_it_and_is_no_jump(unknown):
    steps, found = steps_of([(0, 0, 0), unknown, (9, 0, 0), (9.1, 0, 0)])
    assert [step is None for step in found] == [True, True, True, False]
    assert steps.jumps == 0


def test_without_use_there_are_neither_steps_nor_jumps():
    steps, found = steps_of([(0, 0, 0), (0.1, 0, 0), (99, 0, 0)], use=False)
    assert found == [None] * 3
    assert steps.jumps == 0
