# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry import se2
from g2_recon.localization import refinement

POSES = np.array([(0.1 * i, 0.02 * i, 0.05 * i) for i in range(24)])
WAYS = 0.1 * np.arange(24)
UNKNOWN = np.full((24, 3), np.nan)
UNBROKEN = np.zeros(24, bool)


def off(poses, truth=POSES):
    """Largest distance in m of poses from where they were, seen from the first one."""
    return np.hypot(*(se2.relative(poses[0], poses) - se2.relative(truth[0], truth))[:, :2].T).max()


def noisy(sigma=0.03):
    poses = POSES + np.random.default_rng(0).normal(0, sigma, POSES.shape)
    poses[0] = POSES[0]
    return poses


@pytest.fixture
def keyframes(scan_of_room, keyframes_of):
    return keyframes_of([scan_of_room(pose, noise=0.005, seed=i) for i, pose in enumerate(POSES)], noisy())


def test_keyframes_off_by_centimetres_come_to_lie_on_one_another(keyframes):
    before = keyframes.poses.copy()
    refined = refinement.refine(keyframes, WAYS, UNKNOWN, UNBROKEN)
    assert off(before) > 0.05
    assert off(refined) < 0.005
    assert refined[0] == pytest.approx(POSES[0], abs=1e-6)
    assert keyframes.poses.tolist() == before.tolist()


def test_wheels_that_slip_hardly_pull_at_keyframes_that_the_walls_hold(keyframes):
    slipping = np.vstack([np.full(3, np.nan), 1.3 * se2.relative(POSES[:-1], POSES[1:])])
    # They claim 70 cm more than there are.
    assert off(refinement.refine(keyframes, WAYS, slipping, UNBROKEN)) < 0.02


def test_the_step_of_the_wheels_over_a_break_does_not_count(keyframes):
    wheels, broken = UNKNOWN.copy(), UNBROKEN.copy()
    wheels[12], broken[12] = (0.4, -0.3, 0.1), True
    assert off(refinement.refine(keyframes, WAYS, wheels, broken)) < 0.005


def test_along_a_bare_corridor_the_wheels_hold(scan_of_corridor, keyframes_of):
    truth = np.array([(0.25 * i, 0, 0) for i in range(24)])
    keyframes = keyframes_of([scan_of_corridor(pose, reach=20) for pose in truth], truth * (0.9, 1, 1))
    wheels = np.vstack([np.full(3, np.nan), np.diff(truth, axis=0)])
    refined = refinement.refine(keyframes, WAYS, wheels, UNBROKEN)
    # The map was a tenth too short, 0.575 m. Beams far apart on a wall wander with the robot, which keeps 1 %.
    assert off(refined, truth) < 0.08


def test_refinement_tells_how_far_it_is(keyframes):
    told = []
    refinement.refine(keyframes, WAYS, UNKNOWN, UNBROKEN, progress=lambda *step: told.append(step))
    assert told == [("refinement", done, 5) for done in range(1, 6)]


def test_neighbors_are_those_along_the_way_and_those_met_again():
    # There and back again: 20 keyframes 0.5 m apart each way.
    there = np.column_stack([0.5 * np.arange(20), np.zeros(20), np.zeros(20)])
    poses = np.vstack([there, there[::-1] + (0, 0.1, 0)])
    ways = 0.5 * np.arange(40)
    first, second = refinement.neighbors(poses, ways)
    pairs = list(zip(first.tolist(), second.tolist(), strict=True))
    assert len(set(pairs)) == len(pairs)
    assert all(i > j for i, j in pairs)
    along_the_way = {(i, i - span) for span in (1, 2, 3, 5, 8) for i in range(span, 40)}
    again = set(pairs) - along_the_way
    assert along_the_way < set(pairs)
    assert all(np.hypot(*(poses[i] - poses[j])[:2]) <= 4.0 and ways[i] - ways[j] > 3.0 for i, j in again)
    # The one beside it is the nearest of those that were passed on the way there.
    assert all((i, 39 - i) in again for i in range(25, 40))
    for i in range(40):
        earlier = sorted(j for k, j in again if k == i)
        assert len(earlier) <= 10
        assert (np.diff(earlier) > 2).all()


def test_two_keyframes_are_neighbors():
    first, second = refinement.neighbors(np.zeros((2, 3)), np.zeros(2))
    assert (first.tolist(), second.tolist()) == ([1], [0])


def test_scans_come_to_lie_where_they_were_taken(keyframes, scan_of_room, keyframes_of):
    keyframes.poses[:] = POSES
    truth = se2.compose(POSES[3:20:4], (0.05, 0.01, 0.02))
    guesses = truth + np.random.default_rng(1).normal(0, 0.02, truth.shape)
    scans = keyframes_of([scan_of_room(pose, noise=0.005, seed=90 + i) for i, pose in enumerate(truth)], guesses)
    points, normals, kinds, _, _ = scans.arrays
    near = np.argsort(np.hypot(*(guesses[:, None] - POSES)[..., :2].transpose(2, 0, 1)), axis=1)
    placed = refinement.place(
        guesses, np.arange(3, 20, 4), near, points, normals, kinds, keyframes.poses, *keyframes.arrays
    )
    assert np.hypot(*(guesses - truth)[:, :2].T).max() > 0.02
    assert np.hypot(*(placed - truth)[:, :2].T).max() < 0.005
    assert np.abs(placed - truth)[:, 2].max() < 0.003
