# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from g2_recon.geometry import se2
from g2_recon.localization import pairing
from g2_recon.localization.beams import ANY_KIND, CORNER, INVALID, LOOSE, POINT, SURFACE, Beams, beams

IDENTITY = np.zeros(3)
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


def partners(points, to, distance, *, kind=SURFACE, share=0.0, T=IDENTITY):
    """Of points (N, 2) the partners in a scan, given as Beams."""
    points = np.asarray(points, np.float32).reshape(-1, 2)
    rows = np.vstack([points.T, np.zeros_like(points.T)])
    room = pairing.room(len(points))
    return pairing.partners(T, rows, to.points, to.kinds, to.first, to.increment, distance, share, kind, room).tolist()


@pytest.mark.parametrize("field", FIELDS.values(), ids=FIELDS)
@pytest.mark.parametrize("kind", [ANY_KIND, POINT, SURFACE])
@pytest.mark.parametrize("share", [0.0, 0.05])
def test_the_partner_is_that_of_a_search_among_all(field, kind, share):
    first, count, increment = field
    rng = np.random.default_rng(0)
    bearings = first + increment * np.arange(count)
    ranges = rng.uniform(2.0, 2.6, count)
    points = (ranges[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])).astype(np.float32)
    kinds = rng.choice(np.array([INVALID, POINT, SURFACE], np.uint8), count, p=[0.2, 0.2, 0.6])
    to = Beams(points, np.zeros_like(points), kinds, first, increment)
    bearings, distances = rng.uniform(-math.pi, math.pi, 2000), rng.uniform(1.7, 2.9, 2000)
    at = (distances[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])).astype(np.float32)
    found = partners(at, to, 0.3, kind=kind, share=share)
    # A beam that comes a full turn after the first one measures the same place again, and is not looked at.
    other = (kinds & kind > 0) & (np.arange(count) * increment < 6.28)
    away = np.hypot(*(points[None] - at[:, None]).transpose(2, 0, 1))
    away[:, ~other] = np.inf
    limits = 0.3 + share * distances
    # Where the limit of the distance touches the outermost beam that is looked at, it may be missed.
    near, far = away.min(axis=1) < 0.9 * limits, away.min(axis=1) >= limits
    assert np.count_nonzero(near) > 100
    # Distances in single precision may tie: 1e-6 m.
    chosen = away[np.flatnonzero(near), np.array(found)[near]]
    assert chosen == pytest.approx(away[near].min(axis=1), abs=1e-6)
    assert (np.array(found)[far] < 0).all()


def test_what_lies_outside_the_field_of_view_is_told_from_what_has_no_beam_near(scan_of_room):
    # Bearings from -90 to 90 deg.
    b = seen(scan_of_room(POSE))

    def at(r, *degrees):
        angles = np.radians(degrees)
        return partners(r * np.column_stack([np.cos(angles), np.sin(angles)]), b, 0.1, kind=ANY_KIND)

    assert at(1.0, 180, 120, -120, 97, -97) == [pairing.OUT_OF_VIEW] * 5
    assert at(1.0, -89, 0, 89) == [pairing.NO_PARTNER] * 3
    first, last = np.hypot(*b.points[[0, -1]].T)
    assert at(first, -91) + at(last, 91) == [0, 180]
    # At the laser itself there is no bearing.
    assert at(0.01, 0) == [pairing.OUT_OF_VIEW]


def test_bearings_without_the_library_are_those_of_the_library():
    angles = np.linspace(-math.pi, math.pi, 10_001)[:-1]
    rows = np.array([np.cos(angles), np.sin(angles), angles, angles], np.float32)
    _, where, _ = memory = pairing.room(len(angles))
    # Beams of 1e-4 rad, so that the index of a beam tells the bearing.
    none = np.empty((0, 2), np.float32)
    pairing.partners(IDENTITY, rows, none, np.empty(0, np.uint8), -math.pi, 1e-4, 0.1, 0.0, POINT, memory)
    error = se2.wrap_angle(1e-4 * where[0] - math.pi - angles)
    # Half a beam, and 1.2e-5 rad.
    assert np.abs(error).max() < 0.5e-4 + 1.2e-5


def test_picked_are_beams_of_a_kind():
    points = np.arange(12, dtype=np.float32).reshape(6, 2)
    kinds = np.array([SURFACE, POINT, SURFACE, INVALID, INVALID, SURFACE], np.uint8)
    assert pairing.picked(points, -points, kinds, SURFACE, 1).T.tolist() == [
        [0, 1, 0, -1],
        [4, 5, -4, -5],
        [10, 11, -10, -11],
    ]
    assert pairing.picked(points, -points, kinds, ANY_KIND, 2)[0].tolist() == [0, 4]


def cost_of(pairs, a, b, T_b_a, *, backwards):
    """Errors (M,) of given pairs of beams on surfaces, and (2 M,) of loose ones in the frame that stays."""
    (mine, partners), (loose, others) = pairs
    off = se2.transform_points(T_b_a, a.points[mine]) - b.points[partners]
    if backwards:
        apart = a.points[loose] - se2.transform_points(se2.inverse(T_b_a), b.points[others])
    else:
        apart = se2.transform_points(T_b_a, a.points[loose]) - b.points[others]
    return (off * b.normals[partners]).sum(axis=1), apart.T.ravel()


def plain_pairs(a, b, T_b_a, distance, loose):
    mine = np.flatnonzero(a.kinds == SURFACE)
    found = np.array(partners(a.points[mine], b, distance, T=T_b_a))
    normals = se2.transform_points([0, 0, T_b_a[2]], a.normals[mine])
    fits = (found >= 0) & ((normals * b.normals[found]).sum(axis=1) >= 0.8)
    others = np.flatnonzero(a.kinds & loose)
    near = np.array(partners(a.points[others], b, distance, kind=loose, share=0.5 * b.increment, T=T_b_a), int)
    return (mine[fits], found[fits]), (others[near >= 0], near[near >= 0])


@pytest.mark.parametrize("loose", [CORNER, LOOSE])
@pytest.mark.parametrize("backwards", [False, True], ids=["forwards", "backwards"])
def test_hessian_and_gradient_are_those_of_the_weighted_cost_by_differences(scan_of_halls, backwards, loose):
    pose = np.array([1.5, 0.9, 0.1])
    scans = scan_of_halls(se2.compose(pose, MOVED), noise=0.01), scan_of_halls(pose, noise=0.01, seed=1)
    for scan in scans:
        # Table legs, of one beam each.
        scan.ranges[20::30] *= 0.6
    a, b = seen(scans[0]), seen(scans[1])
    T_b_a = MOVED + (0.02, 0.01, -0.02)
    hessian, gradient = np.zeros((3, 3)), np.zeros(3)
    inliers, viewed = pairing.accumulate(
        T_b_a, pairing.parted(a.points, a.normals, a.kinds, loose, 1), b.points, b.normals, b.kinds, b.first,
        b.increment, 0.3, 0.05, backwards, hessian, gradient, pairing.room(181), loose,
    )  # fmt: skip
    pairs = plain_pairs(a, b, T_b_a, 0.3, loose)
    # The variable is T_b_a, or its inverse.
    variable = se2.inverse(T_b_a) if backwards else T_b_a

    def errors(x):
        return np.concatenate(cost_of(pairs, a, b, se2.inverse(x) if backwards else x, backwards=backwards))

    jacobian = np.column_stack([(errors(variable + h) - errors(variable - h)) / 2e-6 for h in 1e-6 * np.eye(3)])
    error, apart = cost_of(pairs, a, b, T_b_a, backwards=backwards)
    assert len(error) > 50
    assert len(apart) > 2
    weights = 1 / (1 + (error / 0.05) ** 2) ** 2
    # From where the beams meet b, with a kernel that is wider where they are apart.
    ranges = np.hypot(*se2.transform_points(T_b_a, a.points[pairs[1][0]]).T)
    width = 0.05 + 0.3 * b.increment * ranges
    squared = apart.reshape(2, -1) ** 2
    loosely = (0.045 / width) ** 2 / (1 + squared.sum(axis=0) / width**2) ** 2
    weights = np.concatenate([weights, loosely, loosely])
    # The kernel's errors are in single precision: 1e-6 m at ranges of metres, hundredfold by a sum of 100 beams.
    assert hessian == pytest.approx(jacobian.T @ (weights[:, None] * jacobian), rel=1e-4, abs=1e-2)
    assert gradient == pytest.approx(jacobian.T @ (weights * np.concatenate([error, apart])), rel=1e-4, abs=1e-3)
    assert inliers == np.count_nonzero(np.abs(error) < 2.5 * 0.05)
    assert viewed >= len(error)


def test_one_step_of_gauss_newton_takes_back_a_small_displacement(scan_of_room, keyframes_of):
    poses = np.array([POSE, se2.compose(POSE, MOVED)])
    keyframes = keyframes_of([scan_of_room(pose, beams=361) for pose in poses], poses)
    truth = se2.relative(poses[0], poses[1])
    off = np.array([0.015, -0.01, 0.005])
    hessian, gradient, inliers, viewed = pairing.pair(truth + off, 1, 0, *keyframes.arrays, 0.2, 0.1, CORNER, 1)
    reached = truth + off - np.linalg.solve(hessian, gradient)
    # Second order in a step of 2 cm and 0.3 deg, and the corners.
    assert np.hypot(*(reached - truth)[:2]) < 0.001
    assert abs(reached[2] - truth[2]) < 0.0005
    assert inliers > 0.95 * viewed > 500


def test_many_pairs_are_each_what_one_pair_says(scan_of_room, keyframes_of):
    poses = np.array([se2.compose(POSE, part * MOVED) for part in range(4)])
    keyframes = keyframes_of([scan_of_room(pose) for pose in poses], poses)
    first, second = np.array([1, 2, 3, 3]), np.array([0, 0, 1, 2])
    T_j_i, hessians, gradients, counts = pairing.pairs(poses, first, second, *keyframes.arrays, 0.2, 0.1, CORNER, 1)
    assert T_j_i == pytest.approx(se2.relative(poses[second], poses[first]), abs=1e-12)
    for m in range(4):
        one = pairing.pair(T_j_i[m], first[m], second[m], *keyframes.arrays, 0.2, 0.1, CORNER, 1)
        assert hessians[m].tolist() == one[0].tolist()
        assert gradients[m].tolist() == one[1].tolist()
        assert tuple(counts[m]) == one[2:]


def agreement(a_points, b):
    kinds = np.full(len(a_points), POINT, np.uint8)
    rows = pairing.picked(a_points, a_points, kinds, POINT, 1)
    return pairing.agreement(IDENTITY, rows, b.points, b.kinds, b.first, b.increment, pairing.room(len(a_points)))


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
    points, normals, kinds, firsts, increments = keyframes.arrays
    scan, memory = seen(scan_of_room(POSE)), pairing.room(181)
    rows = pairing.picked(scan.points, scan.normals, scan.kinds, ANY_KIND, 2)
    # Half a meter off, so that there is something to contradict.
    pose = POSE + (0.5, 0.5, 0)
    expected = np.zeros(2, int)
    for k in range(2):
        T = se2.relative(poses[k], pose)
        expected += pairing.agreement(T, rows, points[k], kinds[k], firsts[k], increments[k], memory)
        back = pairing.picked(points[k], normals[k], kinds[k], ANY_KIND, 2)
        expected += pairing.agreement(se2.inverse(T), back, scan.points, scan.kinds, scan.first, scan.increment, memory)
    found = pairing.agreements(
        pose, scan.points, scan.normals, scan.kinds, scan.first, scan.increment,
        np.arange(2), poses, *keyframes.arrays, 2,
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
