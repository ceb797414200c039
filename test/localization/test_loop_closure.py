# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry import se2
from g2_recon.localization import branch_and_bound
from g2_recon.localization.loop_closure import LoopCloser, register

SPAN = 12


def locals_of(scan, truth, keyframes_of, *, drift=(0.0, 0.0, 0.0), **settings):
    """A closer with a local map every SPAN keyframes, whose poses drift by so much a metre."""
    poses = [truth[0]]
    for step in se2.relative(truth[:-1], truth[1:]):
        poses.append(se2.compose(poses[-1], step + np.hypot(*step[:2]) * np.array(drift)))
    scans = [scan(pose, noise=0.005, seed=i, **settings) for i, pose in enumerate(truth)]
    keyframes = keyframes_of(scans, poses)
    closer = LoopCloser()
    ways = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
    for first in range(0, len(truth) - SPAN + 1, SPAN):
        closer.add(keyframes, first, first + SPAN, ways[first + SPAN // 2])
    return closer


def references(closer, truth):
    return truth[[m.reference for m in closer.maps]]


def off(closer, truth):
    there = references(closer, truth)
    apart = se2.relative(closer.poses[0], closer.poses) - se2.relative(there[0], there)
    return np.hypot(*apart[:, :2].T)


@pytest.fixture(scope="module")
def around(drive_along, way_around_the_halls):
    return drive_along([*way_around_the_halls, (9, 1)], step=0.4, turn=0.4)


def test_a_place_passed_again_after_a_drift_is_recognized_and_the_graph_takes_the_drift_back(
    scan_of_halls, keyframes_of, around
):
    closer = locals_of(scan_of_halls, around, keyframes_of, drift=(0.01, 0.005, 0.004))
    drifted = off(closer, around)
    assert closer.close(len(closer.maps) - 1) > 0
    closer.optimize()
    assert drifted[-1] > 0.5
    assert off(closer, around)[-1] < 0.15
    for j, c, T, _ in closer.loops:
        there = references(closer, around)
        error = T - se2.relative(there[j], there[c])
        assert np.hypot(*error[:2]) < 0.1
        assert abs(error[2]) < 0.02


def test_what_was_just_left_is_no_loop(scan_of_halls, keyframes_of, around):
    closer = locals_of(scan_of_halls, around[:72], keyframes_of)
    assert [closer.close(c) for c in range(len(closer.maps))] == [0] * len(closer.maps)
    assert closer.loops == []


def test_a_loop_is_not_closed_twice(scan_of_halls, keyframes_of, around):
    closer = locals_of(scan_of_halls, around, keyframes_of)
    last = len(closer.maps) - 1
    for _ in range(4):
        closer.close(last)
    pairs = [(a, b) for a, b, _, _ in closer.loops]
    assert len(pairs) == len(set(pairs)) > 0


def test_rooms_that_do_not_look_alike_are_not_taken_for_one_another(
    scan_of_halls, scan_of_room, keyframes_of, drive_along
):
    # The truth in the halls for a while, then that of another room at the place where the drive began.
    halls = drive_along([(1, 1), (13, 1), (13, 6)], step=0.4, turn=0.4)[:36]
    room = np.column_stack([1 + 0.1 * np.arange(24), np.ones(24), np.zeros(24)])
    scans = [scan_of_halls(pose) for pose in halls] + [scan_of_room(pose - (2, 1, 0)) for pose in room]
    poses = np.vstack([halls, room])
    keyframes = keyframes_of(scans, poses)
    closer = LoopCloser()
    for c in range(5):
        closer.add(keyframes, SPAN * c, SPAN * (c + 1), 20.0 * c)
    assert closer.close(4) == 0
    assert closer.tried > 0
    assert closer.loops == []


def test_along_a_corridor_a_loop_informs_across_it_only(scan_of_corridor, keyframes_of, monkeypatch):
    # There, back on the spot, and there again.
    there = np.column_stack([0.4 * np.arange(48), np.zeros(48), np.zeros(48)])
    truth = np.vstack([there, there[:24]])
    scans = [scan_of_corridor(pose, reach=12) for pose in truth]
    keyframes = keyframes_of(scans, truth)
    closer = LoopCloser()
    for c in range(6):
        closer.add(keyframes, SPAN * c, SPAN * (c + 1), 20.0 * c)
    # All places along it score alike; this is one of them.
    monkeypatch.setattr(branch_and_bound, "find", lambda *given: (given[4].copy(), 1.0))
    assert closer.close(5) > 0
    assert closer.ambiguous > 0
    information = closer.loops[0][3]
    assert information[0, 0] < 1e-3 * information[1, 1]


def test_a_loop_that_contradicts_the_graph_is_rejected(scan_of_halls, keyframes_of, around):
    closer = locals_of(scan_of_halls, around, keyframes_of)
    there = references(closer, around)
    last = len(closer.maps) - 1
    true = se2.relative(there[0], there[last])
    information = np.diag([400.0, 400.0, 1e4])
    before = closer.poses.copy()
    assert not closer._accept(0, last, true + (9.0, 0, 1.5), information)
    assert closer.rejected == 1
    assert closer.poses.tolist() == before.tolist()
    assert closer._accept(0, last, true + (0.3, 0, 0.02), information)
    assert len(closer.loops) == 1


def test_a_way_is_shorter_over_a_loop(scan_of_halls, keyframes_of, around):
    closer = locals_of(scan_of_halls, around, keyframes_of)
    last = len(closer.maps) - 1
    ways = np.array([m.way for m in closer.maps])
    assert closer._ways(last) == pytest.approx(ways[-1] - ways)
    closer.loops.append((0, last, np.zeros(3), np.eye(3)))
    # Half a metre over the loop.
    assert closer._ways(last) == pytest.approx(np.minimum(ways[-1] - ways, 0.5 + ways - ways[0]))


def test_a_group_of_keyframes_is_laid_on_another_one(scan_of_halls, keyframes_of, around):
    keyframes = keyframes_of([scan_of_halls(pose) for pose in around[:16]], around[:16])
    fixed, moving = np.arange(0, 16, 2), np.arange(1, 16, 2)
    off = np.array([0.1, -0.08, 0.03])
    T, inliers, _, same, against = register(off, moving, around[moving], fixed, around, *keyframes.arrays, 1)
    # The truth is the identity.
    assert np.hypot(*T[:2]) < 0.01
    assert abs(T[2]) < 0.003
    # The rest are corners that one sees and the next does not.
    assert inliers > 0.8
    assert same > 0.95 * (same + against) > 0


def test_groups_too_far_apart_to_see_the_same_have_no_inliers(scan_of_halls, keyframes_of, around):
    keyframes = keyframes_of([scan_of_halls(pose) for pose in around[:4]], around[:4])
    start = np.array([50.0, 0, 0])
    T, inliers, _, same, against = register(
        start, np.array([0, 1]), around[:2], np.array([2, 3]), around[:4], *keyframes.arrays, 1
    )
    assert T.tolist() == start.tolist()
    assert (inliers, same, against) == (0.0, 0, 0)


def moved_apart(closer):
    """Move each local map by a step of its own, as loops do; the poses before."""
    before = closer.poses.copy()
    rng = np.random.default_rng(0)
    closer.poses = se2.compose(rng.normal(0, 0.02, before.shape), before)
    return before


def test_keyframes_follow_their_local_maps_and_the_way_does_not_tear_between_them(scan_of_halls, keyframes_of, around):
    closer = locals_of(scan_of_halls, around[:72], keyframes_of)
    poses = around[:72].copy()
    before = moved_apart(closer)
    moved = closer.carried_along(poses, before, np.zeros(len(poses), bool))
    assert moved[[m.reference for m in closer.maps]] == pytest.approx(closer.poses, abs=1e-12)
    changed = se2.relative(moved[:-1], moved[1:]) - se2.relative(poses[:-1], poses[1:])
    # Two maps differ by 0.1 m at most, here and far from the origin, which twelve keyframes share.
    assert np.hypot(*changed[:, :2].T).max() < 0.05


def test_where_track_was_lost_keyframes_move_with_their_own_local_map(scan_of_halls, keyframes_of, around):
    closer = locals_of(scan_of_halls, around[: 2 * SPAN], keyframes_of)
    poses, broken = around[: 2 * SPAN].copy(), np.arange(2 * SPAN) == SPAN
    before = moved_apart(closer)
    steps = se2.compose(closer.poses, se2.inverse(before))
    moved = closer.carried_along(poses, before, broken)
    assert moved == pytest.approx(se2.compose(np.repeat(steps, SPAN, axis=0), poses), abs=1e-12)


def test_a_local_map_is_where_its_keyframes_were_smoothed_to(scan_of_halls, keyframes_of, around):
    closer = locals_of(scan_of_halls, around[:36], keyframes_of)
    smoothed = closer._keyframes.snapshot()
    smoothed.poses[:] += (0.1, 0.0, 0.01)
    closer.take_poses(smoothed)
    assert closer.poses == pytest.approx(smoothed.poses[[m.reference for m in closer.maps]], abs=0)


def test_loops_show_how_far_the_way_drifts_and_how_far_they_err_themselves():
    rng, drifts, loops = np.random.default_rng(0), 4.0, 0.25
    closer = LoopCloser()
    closer.poses = np.column_stack([5.0 * np.arange(30), np.zeros(30), np.zeros(30)])
    closer._sequence = [(np.array([5.0, 0, 0]), np.eye(3))] * 29
    closer._drifts = [np.diag([0.003, 0.003, 0.0005]) ** 2] * 29
    closer._pair_sigma = 0.02
    information = np.diag([1 / 0.05**2, 1 / 0.05**2, 1 / 0.01**2])
    of_loop = np.linalg.inv(closer._of_loops(information, 1.0))
    for _ in range(300):
        c = int(rng.integers(1, 30))
        off = rng.multivariate_normal(np.zeros(3), drifts * closer._between(0, c, 1.0, 1.0) + loops * of_loop)
        closer._learn_scales(0, c, se2.relative(closer.poses[0], closer.poses[c]) - off, information)
    # Of 900 numbers, some hundred speak for each; the first guess still counts a little.
    assert closer.drift_scale == pytest.approx(drifts, rel=0.25)
    assert closer.loop_scale == pytest.approx(loops, rel=0.25)
