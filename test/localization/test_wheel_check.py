# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from g2_recon.localization.wheel_check import WheelCheck

ARC = [(np.sin(a), 1 - np.cos(a), a) for a in np.linspace(0, 12, 300)]


def checked(poses, odometry) -> float:
    check = WheelCheck()
    for pose, wheels in zip(poses, odometry, strict=True):
        check.add(pose, wheels)
    return check.contradiction


def test_the_same_way_in_two_frames_is_no_contradiction():
    moved = [(5 - y, 2 + x, yaw + np.pi / 2) for x, y, yaw in ARC]
    assert checked(moved, ARC) == 0


def test_scans_that_stand_still_contradict_wheels_that_turn():
    assert checked([(0, 0, 0)] * 300, ARC) == 1


def test_a_few_ways_tell_nothing():
    assert checked([(0, 0, 0)] * 9, [(0.5 * step, 0, 0) for step in range(9)]) == 0


def test_wheels_that_stand_still_tell_nothing():
    assert checked(ARC, [(0, 0, 0)] * 300) == 0


def test_what_lies_before_a_gap_of_the_odometry_is_not_compared_with_what_lies_after():
    steps = [(0.4 * step, 0, 0) for step in range(40)]
    gaps = [step if index % 2 else None for index, step in enumerate(steps)]
    assert checked([(0, 0, 0)] * 40, gaps) == 0


@pytest.mark.parametrize(("slip", "told"), [(1.2, False), (2.5, True)])
def test_wheels_that_slip_a_little_are_believed(slip, told):
    wheels = [(0.1 * step, 0, 0) for step in range(100)]
    assert (checked([(x / slip, 0, 0) for x, _, _ in wheels], wheels) > 0.5) == told
