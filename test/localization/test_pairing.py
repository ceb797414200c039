# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from g2_recon.geometry import se2
from g2_recon.localization import pairing
from g2_recon.localization.beams import INVALID, POINT, SURFACE, beams

POSE = np.array([0.5, 0.3, 0.4])
MOVED = np.array([0.06, -0.03, 0.03])
DEGREE = math.radians(1)


def seen(scan):
    return beams(scan, range_min=0.1, range_max=40.0)


# Fields of view: bearing of the first beam, beams, and angle between them.
FIELDS = {
    "half a turn": (-math.pi / 2, 181, DEGREE),
    "three quarters, dense": (-0.75 * math.pi, 1081, DEGREE / 4),
    "a turn": (-math.pi, 360, DEGREE),
    "a turn, both ends measured": (-math.pi, 361, DEGREE),
    "a turn, interlaced": (-math.pi + 0.4 * DEGREE, 360, DEGREE),
    "a turn from 0": (0.0, 720, DEGREE / 2),
    "a turn with a gap": (-math.pi + 4 * DEGREE, 352, DEGREE),
    "a narrow one behind": (math.radians(150), 61, DEGREE),
}


@pytest.mark.parametrize("field", FIELDS.values(), ids=FIELDS)
@pytest.mark.parametrize("kind", [POINT, SURFACE])
def test_the_nearest_beam_is_that_of_a_search_among_all(field, kind):
    first, count, increment = field
    rng = np.random.default_rng(0)
    bearings = first + increment * np.arange(count)
    ranges = rng.uniform(2.0, 2.6, count)
    points = ranges[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])
    kinds = rng.choice(np.array([INVALID, POINT, SURFACE], np.uint8), count, p=[0.2, 0.2, 0.6])
    for bearing, distance in zip(rng.uniform(-math.pi, math.pi, 2000), rng.uniform(1.7, 2.9, 2000), strict=True):
        at = distance * np.array([math.cos(bearing), math.sin(bearing)])
        found = pairing.nearest_beam(*at, points, kinds, first, increment, 0.3, kind)
        # A beam that comes a full turn after the first one measures the same place again, and is not looked at.
        away = np.where((kinds >= kind) & (np.arange(count) * increment < 6.28), np.hypot(*(points - at).T), np.inf)
        # Where the limit of the distance touches the outermost beam that is looked at, it may be missed.
        if away.min() < 0.9 * 0.3:
            assert away[found] == away.min()
            assert found >= 0
        elif away.min() >= 0.3:
            assert found < 0


def test_what_lies_outside_the_field_of_view_is_told_from_what_has_no_beam_near(scan_of_room):
    # Bearings from -90 to 90 deg.
    b = seen(scan_of_room(POSE))

    def at(degrees, r):
        x, y = r * math.cos(math.radians(degrees)), r * math.sin(math.radians(degrees))
        return pairing.nearest_beam(x, y, b.points, b.kinds, b.first, b.increment, 0.1, POINT)

    assert [at(degrees, 1.0) for degrees in (180, 120, -120, 97, -97)] == [-2] * 5
    assert [at(degrees, 1.0) for degrees in (-89, 0, 89)] == [-1] * 3
    first, last = np.hypot(*b.points[[0, -1]].T)
    assert (at(-91, first), at(91, last)) == (0, 180)
    assert at(0, 0.01) == -2


def cost_of(pairs, a, b, T_b_a):
    """Errors (M,) of given pairs of beams, at a transform."""
    mine, partners = pairs
    off = se2.transform_points(T_b_a, a.points[mine]) - b.points[partners]
    return (off * b.normals[partners]).sum(axis=1)


def plain_pairs(a, b, T_b_a, max_distance):
    mine, partners = [], []
    for i in np.flatnonzero(a.kinds == SURFACE):
        at = se2.transform_points(T_b_a, a.points[i : i + 1])[0]
        k = pairing.nearest_beam(*at, b.points, b.kinds, b.first, b.increment, max_distance, SURFACE)
        normal = se2.transform_points([0, 0, T_b_a[2]], a.normals[i : i + 1])[0]
        if k >= 0 and normal @ b.normals[k] >= 0.8:
            mine.append(i)
            partners.append(k)
    return np.array(mine), np.array(partners)


@pytest.mark.parametrize("backwards", [False, True], ids=["forwards", "backwards"])
def test_hessian_and_gradient_are_those_of_the_weighted_cost_by_differences(scan_of_room, backwards):
    a, b = seen(scan_of_room(se2.compose(POSE, MOVED), noise=0.01)), seen(scan_of_room(POSE, noise=0.01, seed=1))
    T_b_a = MOVED + (0.02, 0.01, -0.02)
    hessian, gradient = np.zeros((3, 3)), np.zeros(3)
    inliers, viewed = pairing.accumulate(
        T_b_a, a.points, a.normals, a.kinds, b.points, b.normals, b.kinds, b.first, b.increment, 0.3, 0.05, 1,
        backwards, hessian, gradient,
    )  # fmt: skip
    pairs = plain_pairs(a, b, T_b_a, 0.3)
    # The variable is T_b_a, or its inverse.
    variable = se2.inverse(T_b_a) if backwards else T_b_a

    def errors(x):
        return cost_of(pairs, a, b, se2.inverse(x) if backwards else x)

    jacobian = np.column_stack([(errors(variable + h) - errors(variable - h)) / 2e-6 for h in 1e-6 * np.eye(3)])
    error = errors(variable)
    weights = 1 / (1 + (error / 0.05) ** 2) ** 2
    assert len(error) > 100
    # Central differences of 1e-6 m err by 1e-9 at ranges of metres.
    assert hessian == pytest.approx(jacobian.T @ (weights[:, None] * jacobian), abs=1e-5)
    assert gradient == pytest.approx(jacobian.T @ (weights * error), abs=1e-6)
    assert inliers == np.count_nonzero(np.abs(error) < 2.5 * 0.05)
    assert viewed >= len(error)


def test_one_step_of_gauss_newton_takes_back_a_small_displacement(scan_of_room, keyframes_of):
    poses = np.array([POSE, se2.compose(POSE, MOVED)])
    keyframes = keyframes_of([scan_of_room(pose, beams=361) for pose in poses], poses)
    truth = se2.relative(poses[0], poses[1])
    off = np.array([0.015, -0.01, 0.005])
    hessian, gradient, inliers, viewed = pairing.pair(truth + off, 1, 0, *keyframes.arrays, 0.2, 0.1, 1)
    reached = truth + off - np.linalg.solve(hessian, gradient)
    # Second order in a step of 2 cm and 0.3 deg, and the corners.
    assert np.hypot(*(reached - truth)[:2]) < 0.001
    assert abs(reached[2] - truth[2]) < 0.0005
    assert inliers > 0.95 * viewed > 500


@pytest.mark.parametrize("several", [pairing.pairs, pairing.few_pairs])
def test_many_pairs_are_each_what_one_pair_says(scan_of_room, keyframes_of, several):
    poses = np.array([se2.compose(POSE, part * MOVED) for part in range(4)])
    keyframes = keyframes_of([scan_of_room(pose) for pose in poses], poses)
    first, second = np.array([1, 2, 3, 3]), np.array([0, 0, 1, 2])
    T_j_i, hessians, gradients, counts = several(poses, first, second, *keyframes.arrays, 0.2, 0.1)
    assert T_j_i == pytest.approx(se2.relative(poses[second], poses[first]), abs=1e-12)
    for m in range(4):
        one = pairing.pair(T_j_i[m], first[m], second[m], *keyframes.arrays, 0.2, 0.1, 1)
        assert hessians[m].tolist() == one[0].tolist()
        assert gradients[m].tolist() == one[1].tolist()
        assert tuple(counts[m]) == one[2:]


def agreement(a_points, b):
    kinds = np.full(len(a_points), POINT, np.uint8)
    return pairing.agreement(np.zeros(3), a_points, kinds, b.points, b.kinds, b.first, b.increment, 1)


def test_points_on_walls_agree_those_in_free_space_contradict_and_hidden_ones_say_nothing(scan_of_room):
    b = seen(scan_of_room(POSE))
    # Away from the corners of the room, behind which a part is hidden and before which walls are near.
    flat = b.points[b.kinds == SURFACE]
    assert agreement(flat, b) == (len(flat), 0)
    assert agreement(0.5 * flat, b) == (0, len(flat))
    assert agreement(2.0 * flat, b) == (0, 0)
    assert agreement(-0.5 * flat[20:-20], b) == (0, 0)


def test_where_the_other_scan_measured_nothing_nothing_is_contradicted(scan_of_room):
    scan = scan_of_room(POSE)
    free = 0.5 * seen(scan).points
    scan.ranges[80:101] = np.inf
    # Beside what was measured stands the last beam that was.
    same, against = agreement(free[80:101], seen(scan))
    assert (same, against) == (0, 2)


def test_agreements_count_both_ways_over_all_references(scan_of_room, keyframes_of):
    poses = np.array([POSE, se2.compose(POSE, MOVED)])
    keyframes = keyframes_of([scan_of_room(pose) for pose in poses], poses)
    points, _, kinds, firsts, increments = keyframes.arrays
    scan = seen(scan_of_room(POSE))
    # Half a meter off, so that there is something to contradict.
    pose = POSE + (0.5, 0.5, 0)
    expected = np.zeros(2, int)
    for k in range(2):
        T = se2.relative(poses[k], pose)
        expected += pairing.agreement(T, scan.points, scan.kinds, points[k], kinds[k], firsts[k], increments[k], 2)
        expected += pairing.agreement(
            se2.inverse(T), points[k], kinds[k], scan.points, scan.kinds, scan.first, scan.increment, 2
        )
    found = pairing.agreements(
        pose, scan.points, scan.kinds, scan.first, scan.increment, np.arange(2), poses, points, kinds, firsts,
        increments, 2,
    )  # fmt: skip
    assert found == tuple(expected)
    assert min(found) > 0


def match(scan, keyframes, start, guess, prior):
    a = seen(scan)
    return pairing.match(
        np.asarray(start, float), np.asarray(guess, float), a.points, a.normals, a.kinds,
        np.arange(len(keyframes)), keyframes.poses, *keyframes.arrays, 0.35, 0.12, 0.08, 0.045, 10, prior,
    )  # fmt: skip


@pytest.mark.parametrize("off", [(0.1, 0.05, 0.05), (-0.2, 0.1, -0.1), (0, 0, 0.15), (0.2, -0.1, 0)])
def test_a_scan_laid_on_keyframes_comes_to_lie_where_it_was_taken(scan_of_room, keyframes_of, off):
    poses = np.array([POSE, se2.compose(POSE, (0.2, 0, 0.1)), se2.compose(POSE, (0.4, 0.1, -0.1))])
    keyframes = keyframes_of([scan_of_room(pose, beams=361) for pose in poses], poses)
    truth = se2.compose(POSE, (0.3, -0.05, 0.2))
    prior = 1e-6 * np.eye(3)
    pose, inliers, _, viewed = match(scan_of_room(truth, beams=361), keyframes, truth + off, truth + off, prior)
    assert np.hypot(*(pose - truth)[:2]) < 0.002
    assert abs(pose[2] - truth[2]) < 0.001
    assert inliers > 0.9
    assert viewed > 500


def test_along_a_corridor_the_guess_holds_the_pose_and_across_it_the_walls(scan_of_corridor, keyframes_of):
    poses = np.array([(x, 0.1, 0.1) for x in (0.0, 0.25, 0.5)])
    keyframes = keyframes_of([scan_of_corridor(pose, reach=20) for pose in poses], poses)
    guess = np.array([0.9, 0.25, 0.18])
    prior = np.diag([0.05, 0.05, 0.05])
    pose, _, hessian, _ = match(scan_of_corridor((0.75, 0.1, 0.1), reach=20), keyframes, guess, guess, prior)
    assert pose[0] == pytest.approx(0.9, abs=0.005)
    assert pose[1:] == pytest.approx([0.1, 0.1], abs=0.005)
    assert hessian[0, 0] < 1.0 < 50 < hessian[1, 1]


def test_without_references_a_scan_stays_at_the_guess(scan_of_room, keyframes_of):
    guess = np.array([1.0, 2.0, 3.0])
    pose, inliers, hessian, viewed = match(scan_of_room(POSE), keyframes_of([], []), guess, guess, np.eye(3))
    assert pose == pytest.approx(guess)
    assert (inliers, viewed) == (0, 0)
    assert hessian == pytest.approx(np.eye(3))
