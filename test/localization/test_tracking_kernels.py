# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from g2_recon.geometry import se2
from g2_recon.localization import likelihood, pairing
from g2_recon.localization.beams import beams
from g2_recon.localization.tracking_kernels import FINE_RESOLUTION_M, is_near, match_on_latest, slid, wheel_sigma

POSE = np.array([0.5, 0.3, 0.4])
SIGMA = np.array([0.04, 0.05, 0.1])
SPANS = np.array([1, 2, 3, 5])
STEP = np.array([0.1, 0.0, 0.05])


def seen(scan):
    return beams(scan, range_min=0.1, range_max=40.0)


def test_the_wheels_are_less_sure_the_farther_and_the_more_the_robot_turned():
    assert wheel_sigma(np.zeros(3)) == pytest.approx([0.02, 0.02, 0.05])
    assert wheel_sigma(np.array([0.3, -0.4, -0.5])) == pytest.approx([0.07, 0.07, 0.15])


def test_nearness_is_judged_in_the_frame_of_the_guess():
    guess = np.array([1.0, 2.0, math.pi / 2])
    # 0.2 ahead and 0.1 to the left, as seen from the guess.
    pose = np.array([0.9, 2.2, math.pi / 2 - 0.05])
    assert is_near(pose, guess, np.array([0.101, 0.051, 0.026]), 2.0)
    for axis in range(3):
        most = np.array([0.101, 0.051, 0.026])
        most[axis] -= 0.002
        assert not is_near(pose, guess, most, 2.0)


def drive(scan_of_room, keyframes_of, count=7):
    poses = [POSE]
    for _ in range(count - 1):
        poses.append(se2.compose(poses[-1], STEP))
    scans = [scan_of_room(pose, noise=0.01, seed=i) for i, pose in enumerate(poses)]
    return keyframes_of(scans[:-1], poses[:-1]), seen(scans[-1]), np.array(poses)


@pytest.mark.parametrize("segment", [0, 3, 5])
def test_a_scan_is_matched_on_the_latest_keyframes_of_the_segment(scan_of_room, keyframes_of, segment):
    keyframes, b, poses = drive(scan_of_room, keyframes_of)
    start = poses[-1] + (0.03, -0.02, 0.01)
    pose, inliers, hessian, information, agreeing, quality = match_on_latest(
        start, start, SIGMA, 0.02, 5, b.points, b.normals, b.kinds, b.first, b.increment,
        SPANS, segment, keyframes.poses, *keyframes.arrays,
    )  # fmt: skip
    # What the parts say, put together in Python.
    references = np.array([6 - span for span in SPANS if 6 - span >= segment])
    prior = np.diag((pairing.PAIR_SIGMA_M / SIGMA) ** 2)
    scan = b.points, b.normals, b.kinds
    matched, share, total, _ = pairing.match(
        start, start, *scan, references, keyframes.poses, *keyframes.arrays, 0.35, 0.12, 0.08, 0.045, 5, prior
    )
    same, against = pairing.agreements(
        matched, *scan, b.first, b.increment, references, keyframes.poses, *keyframes.arrays, 2
    )
    assert pose.tolist() == matched.tolist()
    assert inliers == share
    assert hessian.tolist() == total.tolist()
    assert information == pytest.approx((total - prior) / 0.02**2 + np.diag(1 / SIGMA**2), rel=1e-9)
    assert agreeing == same > 100
    assert quality == same / (same + 2 * against)
    assert np.hypot(*(pose - poses[-1])[:2]) < 0.01


def slide(scan, pose, *, drawn, cells=1000):
    """A scan, drawn where it was taken or not at all, slid along x from a pose (3,), wherever it is expected."""
    b = seen(scan)
    grid = np.zeros((cells, cells), np.uint8)
    x0 = y0 = -0.5 * cells * FINE_RESOLUTION_M
    if drawn:
        there = b.points[None], b.kinds[None], np.zeros((1, 3))
        likelihood.splat(grid, *there, x0, y0, FINE_RESOLUTION_M, likelihood.bell(FINE_RESOLUTION_M, 0.06))
    weak = np.array([1.0, 0.0])
    return slid(pose, np.eye(3), 0.0, weak, pose, 0.0, b.points, b.normals, b.kinds, b.increment, grid, x0, y0)


def test_a_scan_slides_along_the_weak_direction_to_where_it_fits(scan_of_room):
    pose = np.array([0.2, 0.0, 0.0])
    there, information = slide(scan_of_room(np.zeros(3)), pose, drawn=True)
    # Half a cell, as the likelihood is one value a cell.
    assert there == pytest.approx([0, 0, 0], abs=0.025)
    assert there[1:].tolist() == [0, 0]
    assert information == pytest.approx(np.diag([1 + 1 / 0.02**2, 1, 1]))


def test_where_all_places_fit_alike_nothing_slides(scan_of_room):
    pose = np.array([0.2, 0.0, 0.0])
    there, information = slide(scan_of_room(np.zeros(3)), pose, drawn=False)
    assert there.tolist() == pose.tolist()
    assert information.tolist() == np.eye(3).tolist()
