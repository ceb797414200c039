# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from g2_recon.geometry import se2
from g2_recon.geometry.scan import Scan
from g2_recon.localization.beams import beams
from g2_recon.localization.tracking import LEAST_QUALITY, Tracker

STEP = np.array([0.1, 0.0, 0.05])


def seen(scan):
    return beams(scan, range_min=0.1, range_max=40.0)


def drive(count, step=STEP):
    poses = [np.array([0.0, 0.0, 0.0])]
    for _ in range(count - 1):
        poses.append(se2.compose(poses[-1], step))
    return np.array(poses)


@pytest.fixture
def room(scan_of_room, keyframes_of):
    """A tracker with the first keyframes of a drive through the room, and the pose of the scan to come."""
    truth = drive(13)
    return Tracker(keyframes_of([scan_of_room(pose) for pose in truth[:12]], truth[:12])), truth


def off(placement, pose):
    return np.hypot(*(placement.pose - pose)[:2])


def test_a_scan_is_placed_by_the_step_of_the_wheels(room, scan_of_room):
    tracker, truth = room
    placement = tracker.track(seen(scan_of_room(truth[12])), truth[11], STEP + (0.03, -0.02, 0.03))
    assert placement.matched
    assert placement.quality > 0.95
    assert placement.inliers > 0.9
    assert off(placement, truth[12]) < 0.005
    assert abs(placement.pose[2] - truth[12, 2]) < 0.003
    assert (np.linalg.eigvalsh(placement.information) > 0).all()


def test_without_wheels_a_scan_is_placed_by_the_step_before(scan_of_room, keyframes_of):
    # Faster than any search from a standstill reaches.
    step = np.array([0.5, 0.0, 0.1])
    truth = drive(6, step)
    keyframes = keyframes_of([scan_of_room(pose) for pose in truth[:4]], truth[:4])
    tracker = Tracker(keyframes)
    assert off(tracker.track(seen(scan_of_room(truth[4])), truth[3], step), truth[4]) < 0.01
    keyframes.add(seen(scan_of_room(truth[4])), truth[4])
    tracker.moved()
    placement = tracker.track(seen(scan_of_room(truth[5])), truth[4], None)
    assert placement.matched
    assert off(placement, truth[5]) < 0.01


@pytest.mark.parametrize("error", [(0.25, 0.2, 0.0), (-0.2, 0.1, 0.3), (0.0, 0.0, -0.33)])
def test_a_step_that_errs_by_decimetres_or_by_a_third_of_a_radian_is_searched_right(room, scan_of_room, error):
    tracker, truth = room
    placement = tracker.track(seen(scan_of_room(truth[12])), truth[11], STEP + error)
    assert placement.matched
    assert off(placement, truth[12]) < 0.02


def test_wheels_that_come_late_are_told_by_what_they_claim_of_the_way_together(scan_of_corridor, keyframes_of):
    tracker = Tracker(keyframes_of([], []))
    tracker._history.extend([(np.zeros(3), STEP)] * 3)
    late = list(tracker._late(4 * STEP * (1, 1, 0)))
    # They stood still for three scans of the way that was found, and then jump by four steps.
    found = se2.compose(se2.compose(STEP, STEP), STEP)
    assert late[-1] == pytest.approx(se2.relative(found, [0.4, 0, 0]))
    # Of two scans, three and four together.
    assert len(late) == 3
    tracker._history.append((np.full(3, np.nan), STEP))
    assert list(tracker._late(STEP)) == []


@pytest.mark.parametrize("ranges", [np.full(181, np.nan), np.full(181, np.inf), np.empty(0), np.full(8, 2.0)], ids=len)
def test_a_scan_that_shows_no_surface_is_not_matched_and_follows_the_wheels(room, ranges):
    tracker, truth = room
    scan = Scan(0.0, ranges.astype(np.float32), -1.5, 0.01)
    placement = tracker.track(seen(scan), truth[11], STEP)
    assert not placement.matched
    assert placement.pose == pytest.approx(se2.compose(truth[11], STEP))
    assert (placement.quality, placement.inliers) == (0, 0)


def test_a_scan_of_another_place_is_not_believed_and_follows_the_wheels(room, scan_of_halls):
    tracker, truth = room
    placement = tracker.track(seen(scan_of_halls((7.0, 1.0, 0.0))), truth[11], STEP)
    assert not placement.matched
    assert placement.quality < LEAST_QUALITY
    assert placement.pose == pytest.approx(se2.compose(truth[11], STEP))


def test_along_a_bare_corridor_only_the_wheels_inform(scan_of_corridor, keyframes_of):
    truth = drive(6, (0.1, 0, 0))
    tracker = Tracker(keyframes_of([scan_of_corridor(pose, reach=20) for pose in truth[:5]], truth[:5]))
    placement = tracker.track(seen(scan_of_corridor(truth[5], reach=20)), truth[4], np.array([0.13, 0.03, 0.02]))
    assert placement.matched
    assert placement.pose == pytest.approx([0.53, 0, 0], abs=0.01)
    information = placement.information
    # A step of 13 cm is trusted within 2 cm and a tenth of it.
    assert information[0, 0] == pytest.approx(1 / 0.0334**2, rel=0.1)
    assert information[1, 1] > 10 * information[0, 0]


def test_wheels_that_stand_still_while_the_robot_drives_do_not_hold_it_back_and_are_said_to_err(room, scan_of_room):
    tracker, truth = room
    last = tracker.track(seen(scan_of_room(truth[12])), truth[11], STEP)
    assert not last.wheels_err
    pose = se2.compose(truth[12], STEP)
    placement = tracker.track(seen(scan_of_room(pose)), last.pose, np.zeros(3))
    assert placement.matched and placement.wheels_err
    assert off(placement, pose) < 0.005


@pytest.mark.parametrize("turn", [0.9, -1.2, 2.1])
@pytest.mark.parametrize("wheels", [True, False], ids=["wheels", "no wheels"])
def test_a_turn_that_nothing_foretold_is_searched_for(scan_of_room, keyframes_of, turn, wheels):
    # All around, so that both scans see the same; where they do not, nothing can be known.
    settings = {"beams": 360, "first": -np.pi, "increment": np.radians(1.0)}
    truth = drive(12)
    tracker = Tracker(keyframes_of([scan_of_room(pose, **settings) for pose in truth], truth))
    pose = se2.compose(truth[-1], (0.05, 0.0, turn))
    placement = tracker.track(seen(scan_of_room(pose, **settings)), truth[-1], np.zeros(3) if wheels else None)
    assert placement.matched
    assert off(placement, pose) < 0.02
    assert abs(se2.wrap_angle(placement.pose[2] - pose[2])) < 0.01


def test_niches_hold_a_scan_along_a_corridor_without_wheels(scan_of_halls, drive_along, keyframes_of):
    truth = drive_along([(1, 1), (12, 1)], step=0.1)
    keyframes = keyframes_of(
        [scan_of_halls(pose, noise=0.01, seed=i) for i, pose in enumerate(truth[:21:2])], truth[:21:2]
    )
    tracker = Tracker(keyframes)
    last = truth[20]
    for i in range(21, 101):
        scan = seen(scan_of_halls(truth[i], noise=0.01, seed=i))
        last = tracker.track(scan, last, None).pose
        if i % 3 == 0:
            keyframes.add(scan, last)
            tracker.moved()
    # Of 8 m, past three niches.
    assert np.hypot(*(last - truth[100])[:2]) < 0.15


def test_keyframes_before_the_segment_do_not_count(room, scan_of_room):
    tracker, truth = room
    tracker.segment = 12
    keyframes = tracker._keyframes
    away = np.array([50.0, 0.0, 1.0])
    keyframes.add(seen(scan_of_room(truth[11])), away)
    placement = tracker.track(seen(scan_of_room(truth[12])), away, STEP)
    assert placement.matched
    assert off(placement, se2.compose(away, STEP)) < 0.01
