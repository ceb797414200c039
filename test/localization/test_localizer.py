# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from g2_recon.config import LocalizationConfig
from g2_recon.errors import InputError
from g2_recon.geometry import se2, se3
from g2_recon.geometry.scan import Scan
from g2_recon.localization.localizer import Localizer

# A circle of 1 m in the room, from the identity on, at half a metre a second with ten scans a second.
FORWARD = np.array([0.05, 0.0, 0.05])
FULL = {"first": -math.pi, "beams": 180, "increment": 2 * math.pi / 180}


def drive(steps=100, step=FORWARD):
    poses = [np.zeros(3)]
    for _ in range(steps - 1):
        poses.append(se2.compose(poses[-1], step))
    return np.array(poses)


def wheels(truth, *, scale=(1.0, 1.0, 1.0), start=(7.0, -3.0, 2.0)):
    """Odometry (N, 3) of a drive, its steps scaled, each alike (3,) or on its own (N - 1, 3)."""
    poses = [np.array(start)]
    for step in se2.relative(truth[:-1], truth[1:]) * scale:
        poses.append(se2.compose(poses[-1], step))
    return np.array(poses)


def localize(scans, odometry=None, *, keep_scans=False, mount=None, **configured):
    localizer = Localizer(
        LocalizationConfig(**configured), np.eye(4) if mount is None else mount, keep_scans=keep_scans
    )
    results = [
        localizer.process(scan, None if odometry is None else odometry[index]) for index, scan in enumerate(scans)
    ]
    return localizer, results


def errors(poses, truth):
    """Distances (N,) in m; results or poses (N, 3) against poses (N, 3) that start anywhere."""
    poses = np.array([getattr(pose, "pose", pose) for pose in poses])
    return np.hypot(*(poses - se2.relative(truth[0], truth))[:, :2].T)


def scans_of(scan, truth, noise=0.01, **settings):
    return [scan(pose, noise=noise, seed=i, stamp=0.1 * i, **settings) for i, pose in enumerate(truth)]


@pytest.mark.parametrize("keep_scans", [False, True])
def test_a_drive_through_a_room_is_followed_without_odometry(scan_of_room, keep_scans):
    truth = drive()
    localizer, results = localize(scans_of(scan_of_room, truth), keep_scans=keep_scans)
    # Noise of 1 cm a beam.
    assert errors(results, truth).max() < 0.02
    assert localizer.unmatched == 0
    assert all(result.matched for result in results)


def test_a_drive_through_a_room_is_followed_with_odometry_that_slips(scan_of_room):
    truth = drive()
    slipping = wheels(truth, scale=(1.3, 1.0, 0.5))
    localizer, results = localize(scans_of(scan_of_room, truth), slipping)
    assert errors(results, truth).max() < 0.03
    assert localizer.unmatched == 0


def test_along_a_bare_corridor_the_pose_follows_odometry(scan_of_corridor):
    truth = drive(60, (0.05, 0, 0))
    _, results = localize(scans_of(scan_of_corridor, truth, reach=30), wheels(truth))
    # Noise tilts the normals, so a few percent of the way are lost to walls that say nothing about it.
    assert results[-1].pose[0] == pytest.approx(truth[-1][0], rel=0.05)
    assert results[-1].pose[1:] == pytest.approx([0, 0], abs=0.02)
    covariance = results[-1].covariance
    assert covariance[0, 0] > 10 * covariance[1, 1]


def test_odometry_that_comes_late_is_waited_for(scan_of_corridor, scan_of_halls):
    truth = drive(60, (0.05, 0, 0))
    late = wheels(truth)
    # It stands still for four scans, and then jumps by all of the way.
    late = late[np.arange(60) // 5 * 5]
    for scan, reach, bound in ((scan_of_halls, 80, 0.03), (scan_of_corridor, 30, 0.35)):
        start = np.array([1, 1, 0]) if scan is scan_of_halls else np.zeros(3)
        localizer, results = localize(scans_of(scan, start + truth, reach=reach), late)
        # In the bare corridor there is nothing else to go by, and four steps may be missing.
        assert errors(results, truth)[::5].max() < bound
        assert localizer.odometry_jumps == 0
        assert localizer.unmatched == 0


@pytest.mark.parametrize("spike", [5.0, 1e4, 1e300])
def test_odometry_that_jumps_is_not_followed_and_counted(scan_of_room, spike):
    truth = drive(40)
    odometry = truth.copy()
    odometry[12, 0] += spike
    odometry[20:, 1] -= spike
    localizer, results = localize(scans_of(scan_of_room, truth), odometry)
    assert errors(results, truth).max() < 0.02
    assert localizer.odometry_jumps == 3


def test_odometry_that_is_not_a_number_is_not_used(scan_of_room):
    truth = drive(40)
    odometry = truth.copy()
    odometry[10:20] = np.nan
    localizer, results = localize(scans_of(scan_of_room, truth), odometry)
    assert errors(results, truth).max() < 0.02
    assert localizer.odometry_jumps == 0


def test_odometry_is_not_looked_at_where_it_is_switched_off(scan_of_room):
    truth = drive(40)
    wild = np.random.default_rng(0).normal(0, 0.2, truth.shape)
    scans = scans_of(scan_of_room, truth)
    with_it, without = localize(scans, wild, use_odometry=False)[1], localize(scans)[1]
    assert [result.pose.tolist() for result in with_it] == [result.pose.tolist() for result in without]


@pytest.mark.parametrize("ranges", [np.nan, np.inf, -np.inf, 0.0], ids=str)
def test_without_valid_beams_the_pose_follows_odometry_and_the_loss_is_counted(scan_of_room, ranges):
    truth = drive(40)
    scans = scans_of(scan_of_room, truth)
    scans[10:20] = [Scan(0.1 * i, np.full(181, ranges, np.float32), -1.5, 0.01) for i in range(10, 20)]
    localizer, results = localize(scans, wheels(truth))
    assert errors(results, truth).max() < 0.02
    assert [result.matched for result in results] == [not 10 <= i < 20 for i in range(40)]
    assert localizer.unmatched == 10
    assert np.trace(results[19].covariance) > 2 * np.trace(results[9].covariance)
    assert not any(localizer._broken)


def test_scans_without_beams_before_and_on_the_way_do_no_harm(scan_of_room):
    truth = drive(30)
    scans = scans_of(scan_of_room, truth)
    nothing = Scan(0.0, np.empty(0, np.float32), -1.5, 0.01)
    localizer, results = localize([nothing] * 3 + scans[:10] + [nothing] * 2 + scans[12:], keep_scans=True)
    assert [result.matched for result in results] == [False] * 3 + [True] * 10 + [False] * 2 + [True] * 18
    assert results[2].pose == pytest.approx([0, 0, 0])
    assert errors(results[3:], truth).max() < 0.02
    localizer.finish()
    assert len(localizer.trajectory()) == 33


def test_the_number_of_beams_may_change_on_the_way(scan_of_room):
    truth = drive(60)
    scans = scans_of(scan_of_room, truth[:20])
    scans += [scan_of_room(pose, noise=0.01, seed=i, beams=361) for i, pose in enumerate(truth[20:40])]
    scans += [scan_of_room(pose, noise=0.01, seed=i, beams=91) for i, pose in enumerate(truth[40:])]
    localizer, results = localize(scans, keep_scans=True)
    assert errors(results, truth).max() < 0.03
    localizer.finish()
    assert np.hypot(*(localizer.trajectory().planar() - truth)[:, :2].T).max() < 0.03


@pytest.mark.parametrize("first", [-math.pi, 0.0, -math.pi + 0.01])
def test_a_laser_that_sees_all_around_may_begin_anywhere(scan_of_room, first):
    truth = drive(60)
    _, results = localize(scans_of(scan_of_room, truth, **(FULL | {"first": first})))
    assert errors(results, truth).max() < 0.02


def test_scans_may_be_interlaced(scan_of_room):
    truth = drive(60)
    half = math.radians(0.5)
    scans = [
        scan_of_room(pose, noise=0.01, seed=i, beams=180, increment=2 * half, first=-math.pi / 2 + i % 2 * half)
        for i, pose in enumerate(truth)
    ]
    _, results = localize(scans)
    assert errors(results, truth).max() < 0.02


def test_a_laser_off_the_center_of_the_robot_gives_the_pose_of_the_robot(scan_of_room):
    mount = se3.from_xyz_rpy([0.2, 0.1, 0.4, 0, 0, 0.3])
    truth = drive(80)
    scans = scans_of(scan_of_room, se2.compose(truth, se2.from_se3(mount)))
    for odometry in (None, wheels(truth)):
        _, results = localize(scans, odometry, mount=mount)
        assert errors(results, truth).max() < 0.02


def test_a_laser_mounted_upside_down_gives_the_pose_of_the_robot(scan_of_room):
    truth = drive(80)
    scans = scans_of(scan_of_room, truth, upside_down=True)
    _, results = localize(scans, mount=se3.from_xyz_rpy([0, 0, 0.4, np.pi, 0, 0]))
    assert errors(results, truth).max() < 0.02


def test_standing_still_for_long_adds_nothing_to_memory(scan_of_room):
    localizer, _ = localize(scans_of(scan_of_room, drive(20)))
    still = [scan_of_room(drive(20)[-1], noise=0.01, seed=i, beams=61) for i in range(10)]

    def sizes():
        held = [
            localizer._keyframe_stamps, localizer._wheel_steps, localizer._ways, localizer._broken, localizer._stamps,
            localizer._owners, localizer._offsets, localizer._causal, localizer._scans, localizer._keyframes,
            localizer._loops.maps,
        ]  # fmt: skip
        return [len(each) for each in held]

    for scan in still:
        localizer.process(scan)
    before = sizes()
    for i in range(2000):
        localizer.process(still[i % 10])
    # A scan that noise puts 2 cm from the one before is kept.
    assert np.subtract(sizes(), before).max() <= 20
    assert sizes()[9] == before[9]


def test_a_trajectory_holds_a_pose_a_scan_in_the_order_of_the_scans_where_they_are_kept(scan_of_room):
    truth = drive(30)
    scans = [scan_of_room(pose, stamp=float(-i)) for i, pose in enumerate(truth)]
    localizer, results = localize(scans, keep_scans=True)
    assert localizer.trajectory().stamps.tolist() == [-float(i) for i in range(30)]
    causal = localizer.causal_trajectory()
    assert causal.planar() == pytest.approx(np.array([result.pose for result in results]))
    assert len(localizer.keyframes()) == sum(result.keyframe for result in results)


def test_after_a_reset_the_map_starts_again_where_it_is_told(scan_of_room):
    localizer, _ = localize(scans_of(scan_of_room, drive(40)))
    localizer.reset((5.0, 6.0, 1.0))
    assert localizer.process(scan_of_room((0, 0, 0))).pose == pytest.approx([5, 6, 1])
    assert len(localizer.trajectory()) == 1
    assert localizer.loops == localizer.unmatched == localizer.odometry_jumps == 0


def test_the_map_is_the_walls(scan_of_room, off_the_walls_of_the_room):
    localizer, _ = localize(scans_of(scan_of_room, drive(60), noise=0.005))
    points = localizer.point_map()
    assert len(points) > 100
    assert np.median(off_the_walls_of_the_room(points)) < 0.01
    cells = np.floor(points / 0.05)
    assert len(np.unique(cells, axis=0)) == len(points)


def test_a_localizer_without_scans_is_empty_and_can_be_finished():
    localizer = Localizer(LocalizationConfig(), np.eye(4), keep_scans=True)
    localizer.finish()
    assert len(localizer.trajectory()) == len(localizer.keyframes()) == len(localizer.point_map()) == 0


garbage = st.lists(st.lists(st.floats(width=32) | st.floats(0.125, 10, width=32), max_size=40), min_size=1, max_size=12)


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(garbage, st.lists(st.tuples(*[st.floats()] * 3), min_size=12, max_size=12), st.integers(0, 8))
def test_whatever_comes_poses_are_finite(scan_of_room, garbage, odometry, sane):
    scans = [scan_of_room(pose) for pose in drive(sane)] if sane else []
    scans += [Scan(0.1 * i, np.array(ranges, np.float32), -1.5, 0.08) for i, ranges in enumerate(garbage)]
    localizer, results = localize(scans[:12], odometry, keep_scans=True)
    localizer.finish()
    assert np.isfinite([result.pose for result in results]).all()
    assert np.isfinite([result.covariance for result in results]).all()
    assert np.isfinite(localizer.trajectory().planar()).all()


def whole_drive(localizer, truth):
    """Errors (N,) in m of the trajectory as it is known now."""
    return errors(localizer.trajectory().planar(), truth)


@pytest.fixture(scope="module")
def truth_in_the_halls(drive_along, way_around_the_halls):
    # Once around the block, and the first corridor again.
    return drive_along([*way_around_the_halls, (11, 1)], step=0.25, turn=0.15)


@pytest.fixture(scope="module")
def scans_of_the_halls(scan_of_halls, truth_in_the_halls):
    # It sees 6 m, and so no corridor from end to end.
    return scans_of(scan_of_halls, truth_in_the_halls, noise=0.01, reach=6, beams=121)


@pytest.fixture(scope="module")
def slipping_in_the_halls(truth_in_the_halls):
    # In the third corridor, which comes back, the wheels claim 30 % too much.
    return wheels(truth_in_the_halls, scale=np.where(truth_in_the_halls[1:, 1:2] > 8.5, (1.3, 1, 1), (1, 1, 1)))


@pytest.fixture(scope="module")
def in_the_halls(scans_of_the_halls, slipping_in_the_halls):
    """What comes out: poses as they came, at the end and after `finish`, and covariances as they came."""

    def run(**configured):
        localizer, results = localize(scans_of_the_halls, slipping_in_the_halls, keep_scans=True, **configured)
        as_they_came, at_the_end = np.array([result.pose for result in results]), localizer.trajectory().planar()
        localizer.finish()
        covariances = np.array([result.covariance for result in results])
        return localizer, as_they_came, at_the_end, localizer.trajectory().planar(), covariances

    return run


@pytest.fixture(scope="module")
def closed(in_the_halls):
    return in_the_halls()


def test_a_loop_of_corridors_closes_and_takes_back_the_drift(closed, in_the_halls, truth_in_the_halls):
    localizer, came, end, *_ = closed
    drifted, drifted_came, drifted_end, *_ = in_the_halls(loop_closure=False)
    assert localizer.loops > 0
    assert drifted.loops == 0
    assert localizer.unmatched == 0
    # More than a metre, and a third of it.
    assert errors(drifted_came, truth_in_the_halls)[-1] > 0.8
    assert errors(came, truth_in_the_halls)[-1] < 0.6 * errors(drifted_came, truth_in_the_halls)[-1]
    assert errors(end, truth_in_the_halls).mean() < 0.7 * errors(drifted_end, truth_in_the_halls).mean()


def test_closed_loops_make_poses_surer_and_say_how_much_the_way_has_drifted(closed, in_the_halls):
    localizer, *_, covariances = closed
    drifted, *_, drifted_covariances = in_the_halls(loop_closure=False)
    spreads, drifted_spreads = (np.trace(c[:, :2, :2], axis1=1, axis2=2) for c in (covariances, drifted_covariances))
    assert (np.linalg.eigvalsh(covariances) > 0).all()
    # Wheels that slip by a third make it drift far more than was expected on the way.
    scale = localizer._uncertainty.drift_scale
    assert scale > 2
    assert drifted._uncertainty.drift_scale == 1
    assert spreads[-1] < 0.9 * scale * drifted_spreads[-1]


def test_finishing_improves_a_drive_whose_wheels_slipped(closed, truth_in_the_halls):
    _, _, end, finished, _ = closed
    assert errors(finished, truth_in_the_halls).mean() < 0.9 * errors(end, truth_in_the_halls).mean()


def test_the_same_scans_give_the_same_poses_to_the_last_bit(closed, in_the_halls):
    again = in_the_halls()
    for one, other in zip(closed[1:], again[1:], strict=True):
        assert one.tolist() == other.tolist()


def test_finishing_keeps_a_drive_that_is_right(scan_of_room):
    truth = drive()
    localizer, _ = localize(scans_of(scan_of_room, truth, noise=0.02), keep_scans=True)
    told = []
    for _ in range(2):
        localizer.finish(progress=lambda *step: told.append(step))
        # Noise of 2 cm a beam leaves some millimetres.
        assert whole_drive(localizer, truth).mean() < 0.01
    assert ("refinement", 5, 5) in told


@pytest.fixture(scope="module")
def refined(scans_of_the_halls, slipping_in_the_halls):
    """A localizer as on a robot, refined at the end."""
    localizer, _ = localize(scans_of_the_halls, slipping_in_the_halls)
    localizer.begin_refinement()
    assert localizer.take_refinement()
    return localizer


def test_refining_beside_does_with_keyframes_what_finishing_does(refined, closed):
    np.testing.assert_array_equal(refined.keyframes().planar(), closed[0].keyframes().planar())
    assert not refined.take_refinement()


def test_after_a_refinement_the_graph_of_loops_is_at_rest(refined):
    assert refined.loops > 0
    before = refined._loops.poses.copy()
    np.testing.assert_array_equal(before, refined._keyframes.poses[[m.reference for m in refined._loops.maps]])
    refined._loops.optimize()
    # Solved in floating point.
    np.testing.assert_allclose(refined._loops.poses, before, atol=1e-9)


def test_after_a_refinement_the_drive_goes_on_where_the_robot_is(
    scans_of_the_halls, slipping_in_the_halls, truth_in_the_halls, closed
):
    count = len(scans_of_the_halls) - 20
    localizer, _ = localize(scans_of_the_halls[:count], slipping_in_the_halls)
    localizer.begin_refinement()
    came = [localizer.process(scans_of_the_halls[i], slipping_in_the_halls[i]) for i in range(count, count + 10)]
    refined = localizer.keyframe_count - sum(result.keyframe for result in came)
    ways = se2.relative(localizer._keyframes.poses[refined - 1], localizer._keyframes.poses[refined:])
    assert len(ways)
    assert localizer.take_refinement()
    # What came meanwhile is moved as one with the last keyframe that was refined.
    moved = se2.relative(localizer._keyframes.poses[refined - 1], localizer._keyframes.poses[refined:])
    np.testing.assert_allclose(moved, ways, atol=1e-9)
    later = [localizer.process(scans_of_the_halls[i], slipping_in_the_halls[i]) for i in range(count + 10, count + 20)]
    truth = se2.relative(truth_in_the_halls[0], truth_in_the_halls)[count + 10 : count + 20]
    off = np.hypot(*(np.array([result.pose for result in later]) - truth)[:, :2].T)
    # As far as the finished drive is off at its end, and some centimetres of what came since.
    finished = np.hypot(*(closed[3][-1] - se2.relative(truth_in_the_halls[0], truth_in_the_halls)[-1])[:2])
    assert off.max() < finished + 0.05
    assert all(result.matched for result in later)


def test_a_reset_forgets_a_refinement(scan_of_room):
    localizer, _ = localize(scans_of(scan_of_room, drive(), noise=0.01))
    localizer.begin_refinement()
    localizer.reset()
    assert not localizer.refining
    assert not localizer.take_refinement()
    localizer.begin_refinement()
    assert not localizer.take_refinement()


def test_a_robot_carried_away_begins_a_new_segment_that_joins_the_map_where_it_knows_its_place(
    scan_of_halls, drive_along
):
    # Carried from the left corridor to the right one, where it goes on as it was headed, against its way before.
    before = drive_along([(1, 1), (13, 1), (13, 9), (1, 9), (1, 4)], step=0.25, turn=0.15)
    after = drive_along([(12.8, 8), (13, 1), (3, 1)], step=0.25, turn=0.15)
    truth = np.vstack([before, after])
    odometry = wheels(before)
    odometry = np.vstack([odometry, wheels(after, start=odometry[-1])])
    localizer, results = localize(scans_of(scan_of_halls, truth, **FULL), odometry, keep_scans=True)
    lost = np.flatnonzero([not result.matched for result in results])
    # The new segment begins once five scans in a row do not fit.
    assert lost.tolist() == list(range(len(before), len(before) + 5))
    assert localizer.unmatched == 5
    assert sum(localizer._broken) == 1
    assert localizer.loops > 0
    assert errors(results, truth)[-1] < 0.1
    off = whole_drive(localizer, truth)
    assert off[: len(before)].max() < 0.15
    assert off[len(before) + 5 :].max() < 0.15
    localizer.finish()
    off = whole_drive(localizer, truth)
    assert off[: len(before)].max() < 0.1
    assert off[len(before) + 5 :].max() < 0.1


def test_no_local_map_reaches_over_a_break(scan_of_halls, scan_of_room, drive_along):
    localizer = Localizer(LocalizationConfig(), np.eye(4))
    before = iter(drive_along([(1, 1), (13, 1)], step=0.25))
    # Where a local map has just begun with one keyframe.
    while not (localizer._loops.maps and localizer._map_begins == len(localizer._keyframes) - 1):
        localizer.process(scan_of_halls(next(before), **FULL))
    for pose in drive(120, 2 * FORWARD):
        localizer.process(scan_of_room(pose, **FULL))
    assert sum(localizer._broken) == 1
    covered = [k for local in localizer._loops.maps for k in range(local.first, local.last)]
    assert covered == list(range(len(covered)))
    assert len(localizer._loops.maps) > 2
    for local in localizer._loops.maps:
        assert not any(localizer._broken[local.first + 1 : local.last])


def test_a_session_holds_the_map_and_can_be_gone_on_from(closed, scan_of_halls, truth_in_the_halls):
    localizer = closed[0]
    session = localizer.session()
    np.testing.assert_array_equal(session.poses, localizer._keyframes.poses)
    assert len(session.loops) > 0
    other = Localizer(LocalizationConfig(), np.eye(4))
    other.resume(session, truth_in_the_halls[0])
    np.testing.assert_array_equal(other.keyframes().positions, localizer.keyframes().positions)
    np.testing.assert_array_equal(other.keyframes().stamps, localizer.keyframes().stamps)
    np.testing.assert_array_equal(other.point_map(), localizer.point_map())
    assert other.loops == len(session.loops)
    again = other.session()
    for name in ("poses", "points", "ways", "broken", "local_maps", "loops", "loop_information"):
        np.testing.assert_array_equal(getattr(again, name), getattr(session, name), err_msg=name)
    result = other.process(scan_of_halls(truth_in_the_halls[0]))
    assert result.keyframe
    assert other.session().broken.tolist() == [*session.broken.tolist(), True]


def test_without_a_keyframe_there_is_no_session():
    with pytest.raises(InputError, match="there is no map to save"):
        Localizer(LocalizationConfig(), np.eye(4)).session()
