# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry import se2
from g2_recon.localization import smoothing
from g2_recon.localization.beams import beams
from g2_recon.localization.keyframes import Keyframes
from g2_recon.localization.smoothing import Smoother

TRUTH = np.array([(0.08 * i, 0.02 * i, 0.04 * i) for i in range(30)])
UNKNOWN = np.full(3, np.nan)


def smooth(scan, truth, guesses, *, odometry=None, segment=0, **settings):
    """Add scans one by one at guessed steps (N, 3) after the smoothed ones before."""
    keyframes = Keyframes()
    smoother = Smoother(keyframes)
    for i, pose in enumerate(truth):
        seen = beams(scan(pose, noise=0.005, seed=i, **settings), range_min=0.1, range_max=40.0)
        last = keyframes.poses[-1] if i else truth[0]
        keyframes.add(seen, se2.compose(last, guesses[i]) if i else truth[0])
        smoother.add(UNKNOWN if odometry is None else odometry[i], 0 if i < segment else segment)
    return keyframes.poses.copy(), smoother


def steps(truth):
    return np.vstack([np.zeros(3), se2.relative(truth[:-1], truth[1:])])


def off(poses, truth):
    return np.hypot(*(poses - truth)[:, :2].T).max()


def test_keyframes_guessed_by_centimetres_come_to_lie_on_one_another(scan_of_room):
    noise = np.random.default_rng(0).normal(0, (0.03, 0.03, 0.02), TRUTH.shape)
    poses, _ = smooth(scan_of_room, TRUTH, steps(TRUTH) + noise)
    assert off(poses, TRUTH) < 0.015
    assert poses[0].tolist() == TRUTH[0].tolist()


def test_along_a_bare_corridor_the_wheels_hold(scan_of_corridor):
    truth = np.array([(0.25 * i, 0, 0) for i in range(20)])
    guesses = steps(truth) * (0.7, 1, 1)
    with_wheels, _ = smooth(scan_of_corridor, truth, guesses, odometry=steps(truth), reach=20)
    without, _ = smooth(scan_of_corridor, truth, guesses, reach=20)
    # Noise tilts the normals, so that walls that say nothing of the way hold a little to the guess, 30 % too short.
    assert with_wheels[-1, 0] == pytest.approx(truth[-1, 0], rel=0.07)
    assert without[-1, 0] == pytest.approx(0.7 * truth[-1, 0], rel=0.1)
    assert with_wheels[:, 1] == pytest.approx(0, abs=0.02)


def test_poses_before_a_new_segment_stay(scan_of_room):
    before, _ = smooth(scan_of_room, TRUTH[:15], steps(TRUTH)[:15])
    # The guess leads astray at the break; nothing of the old segment may hold the new one to itself.
    guesses = steps(TRUTH)
    guesses[15] += (2.0, 1.0, 0.5)
    poses, _ = smooth(scan_of_room, TRUTH, guesses, segment=15)
    assert poses[:15].tolist() == before.tolist()
    assert poses[15] == pytest.approx(se2.compose(before[14], guesses[15]))
    assert off(se2.relative(poses[15], poses[15:]), se2.relative(TRUTH[15], TRUTH[15:])) < 0.015


def test_only_the_window_is_kept(scan_of_room, monkeypatch):
    monkeypatch.setattr(smoothing, "_ROOM", 400)
    there = np.vstack([TRUTH, TRUTH[::-1]])
    _, smoother = smooth(scan_of_room, there, steps(there), beams=61)
    assert list(smoother._begins) == list(range(59 - 33, 60))
    assert len(smoother._wheels) == 3
    window = smoother._edges.since(smoother._begins[26])
    assert window.first.min() == 26 and window.first.max() == 59
    # Rows that have been moved to make room are still those of their keyframes.
    assert smoother._edges._first > 0
    assert (np.diff(window.first) >= 0).all()
    poses = smoother._keyframes.poses
    assert pytest.approx(se2.relative(poses[window.second], poses[window.first]), abs=0.02) == window.T


def test_a_lone_keyframe_stays(scan_of_room):
    poses, smoother = smooth(scan_of_room, TRUTH[:1], steps(TRUTH))
    assert poses.tolist() == TRUTH[:1].tolist()
    assert smoother.latest() is None
