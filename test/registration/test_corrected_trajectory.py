# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry import se2, se3
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.registration.corrected_trajectory import CorrectedTrajectory


def path(planar, stamps):
    return Trajectory.from_se2(np.array(stamps, float), np.array(planar, float))


def planar(trajectory, first, last):
    poses = trajectory.between(first, last)
    return Trajectory(*poses).planar()


@pytest.fixture
def straight():
    """1 m/s along x, ten poses a second, until 3 s; a keyframe a second."""
    trajectory = CorrectedTrajectory()
    for step in range(31):
        trajectory.add(0.1 * step, se3.from_se2([0.1 * step, 0, 0]))
    assert trajectory.follow(path([(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)], [0, 1, 2, 3]))
    return trajectory


def test_poses_stay_as_they_came_where_keyframes_stay(straight):
    assert planar(straight, 0, 3) == pytest.approx(np.column_stack([np.arange(31) / 10, np.zeros((31, 2))]), abs=1e-12)


def test_poses_move_with_a_keyframe_that_is_moved_rigidly(straight):
    step = np.array([1.0, 2.0, 0.5])
    straight.follow(Trajectory.from_se2(np.arange(4.0), se2.compose(step, np.array([(k, 0, 0) for k in range(4)]))))
    came = np.column_stack([np.arange(30) / 10, np.zeros((30, 2))])
    assert planar(straight, 0, 2.9)[:30] == pytest.approx(se2.compose(step, came), abs=1e-12)


def test_a_correction_that_differs_between_two_keyframes_is_spread(straight):
    straight.follow(path([(0, 0, 0), (1, 0, 0), (2, 0.4, 0), (3, 0.4, 0)], [0, 1, 2, 3]))
    y = planar(straight, 0, 2.9)[:, 1]
    assert y[:30] == pytest.approx(np.clip(np.arange(30) / 10 - 1, 0, 1) * 0.4, abs=1e-12)


def test_a_jump_at_a_keyframe_that_closed_a_loop_is_none_any_more():
    trajectory = CorrectedTrajectory()
    for step in range(21):
        trajectory.add(0.1 * step, se3.from_se2([0.1 * step, 0.5 if step >= 10 else 0.0, 0]))
        if step == 5:
            assert trajectory.follow(path([(0, 0, 0)], [0]))
    assert trajectory.follow(path([(0, 0.5, 0), (1, 0.5, 0), (2, 0.5, 0)], [0, 1, 2]))
    assert planar(trajectory, 0, 2)[:, 1] == pytest.approx(0.5)


def test_poses_after_the_last_keyframe_hang_on_it(straight):
    for step in range(31, 36):
        straight.add(0.1 * step, se3.from_se2([0.1 * step, 0, 0]))
    straight.follow(path([(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 1, 0)], [0, 1, 2, 3]))
    assert planar(straight, 3.2, 3.3)[:, :2] == pytest.approx(np.array([(3.2, 1), (3.3, 1)]), abs=1e-12)


def test_only_what_is_far_from_where_it_was_has_moved(straight):
    straight.follow(path([(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0.02, 0)], [0, 1, 2, 3]))
    # On the way to the last one, and after it.
    assert straight.moved(0.01, 0.01)[1].tolist() == [False, False, True, True]
    assert not straight.moved(0.01, 0.01)[1].any()


def test_keyframes_count_once_their_poses_have_come():
    trajectory = CorrectedTrajectory()
    keyframes = path([(0, 1, 0), (1, 1, 0)], [0, 1])
    assert trajectory.follow(keyframes)
    trajectory.add(0.0, np.eye(4))
    trajectory.add(0.5, se3.from_se2([0.5, 0, 0]))
    assert planar(trajectory, 0, 0.5)[:, 1] == pytest.approx(0.0)
    assert trajectory.add(1.0, se3.from_se2([1, 0, 0]))
    assert planar(trajectory, 0, 0.5)[:2, 1] == pytest.approx(1.0)


def test_keyframes_of_another_map_are_refused_and_change_nothing(straight):
    assert not straight.follow(path([(9, 9, 0), (9, 9, 0)], [0.0, 1.5]))
    assert planar(straight, 0, 1)[0] == pytest.approx(0.0)


def test_keyframes_of_a_session_that_goes_on_do_not_count(straight):
    stamps, places = [0, 1, 2, 3, 0, 1, 2, 3], [(7, 7, 0)] * 4 + [(k, 1, 0) for k in range(4)]
    assert straight.follow(path(places, stamps))
    assert planar(straight, 0, 2.9)[:30, 1] == pytest.approx(1.0)


def test_poses_may_come_late_and_twice():
    trajectory = CorrectedTrajectory()
    for stamp in (0.0, 0.2, 0.1, 0.2):
        trajectory.add(stamp, se3.from_se2([stamp, 0, 0]))
    assert len(trajectory) == 3
    assert planar(trajectory, 0, 1)[:, 0] == pytest.approx([0, 0.1, 0.2])


def test_the_way_is_that_of_the_localizer_after_a_closed_loop():
    """Twice round, with headings that drift; after the first round the error is spread over all keyframes."""
    rng = np.random.default_rng(0)
    steps = np.column_stack([np.full(400, 0.1), np.zeros(400), np.full(400, np.pi / 100)])
    drifting = steps + rng.normal(0, [0.002, 0.002, 0.002], steps.shape)
    trajectory = CorrectedTrajectory()
    pose, keyframes, hung = np.zeros(3), [], []
    for i, step in enumerate(drifting):
        if i % 8 == 0:
            keyframes.append(pose)
            if i == 200:
                error = se2.compose(np.zeros(3), se2.inverse(pose))
                share = np.linspace(0, 1, len(keyframes))[:, None]
                keyframes = list(se2.compose(share * error, np.array(keyframes)))
                pose = keyframes[-1]
        hung.append((len(keyframes) - 1, se2.compose(se2.inverse(keyframes[-1]), pose)))
        trajectory.add(0.1 * i, se3.from_se2(pose))
        if i % 25 == 24:
            assert trajectory.follow(path(keyframes, 0.8 * np.arange(len(keyframes))))
        pose = se2.compose(pose, step)
    assert trajectory.follow(path(keyframes, 0.8 * np.arange(len(keyframes))))
    of_localizer = np.array([se2.compose(keyframes[k], offset) for k, offset in hung])
    off = planar(trajectory, 0, 1e3) - of_localizer
    correction = np.abs(error[:2]).max()
    # In m: between two keyframes it is a step there and spread here, over one of 25.
    assert np.abs(off[:, :2]).max() < correction / 20
    assert correction > 0.1


def test_thinned_poses_say_the_same_in_the_spans_that_are_kept(straight):
    moved = path([(0, 0, 0), (1, 0.3, 0), (2, 0.5, 0), (3, 0.4, 0)], [0, 1, 2, 3])
    straight.follow(moved)
    spans = [(0.55, 0.62), (0.6, 0.85), (1.72, 1.73)]
    before = [planar(straight, *span) for span in spans]
    straight.thin(2.5, spans)
    # 0, 0.5 to 0.9, 1.7, 1.8 and all from the last one before 2.5 s on.
    assert len(straight) == 1 + 5 + 2 + 7
    for span, known in zip(spans, before, strict=True):
        assert planar(straight, *span) == pytest.approx(known, abs=0)
    assert planar(straight, 2.45, 3)[:, 0] == pytest.approx(np.arange(24, 31) / 10)
    # What was thinned once is let alone; of what came since, the ends stay.
    straight.thin(2.85, [])
    assert len(straight) == 15 - 2


def test_thinned_poses_still_place_keyframes_that_are_told_late():
    """It stands for a minute, drives round a bend, stands again."""
    rng = np.random.default_rng(0)
    share = np.clip(np.arange(1200) / 10 - 60, 0, 20) / 20
    way = np.column_stack([4 * share, np.sin(3 * share), share]) + rng.normal(0, [0.001, 0.001, 0.0005], (1200, 3))
    whole, thinned = CorrectedTrajectory(), CorrectedTrajectory()
    for step, pose in enumerate(way):
        whole.add(0.1 * step, se3.from_se2(pose))
        thinned.add(0.1 * step, se3.from_se2(pose))
    for until in range(10, 120, 10):
        thinned.thin(until, [(70.0, 70.1)])
    # 200 of the drive, 100 that are not looked at yet, and few of the 900 while it stood.
    assert len(thinned) < 330
    keyframes = path(way[::7], 0.7 * np.arange(len(way[::7])))
    keyframes.positions[:] += (0.5, 0.7, 0)
    assert whole.follow(keyframes) and thinned.follow(keyframes)
    assert planar(thinned, 70.0, 70.1)[:, :2] == pytest.approx(planar(whole, 70.0, 70.1)[:, :2], abs=0.005)


def test_poses_of_an_hour_without_a_scan_take_no_memory():
    trajectory = CorrectedTrajectory()
    for step in range(36_000):
        trajectory.add(0.1 * step, se3.from_se2([0.3, 0, 0]))
        if step % 600 == 0:
            trajectory.thin(0.1 * step - 60, [])
    assert len(trajectory) < 1500
