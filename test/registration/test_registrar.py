# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from collections import Counter

import numpy as np
import pytest

from g2_recon.config import RegistrationConfig, SimulationConfig
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import concatenate
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.registration import registrar as registrar_module
from g2_recon.registration.registrar import Registrar
from g2_recon.simulation.simulator import simulate

UP = se3.from_xyz_rpy([0, 0, 0.5, 0, -np.pi / 2, 0])


def scan(stamp, ranges=(1.0, 1.0, 1.0), time_increment=0.0):
    spacing = np.pi / (len(ranges) - 1)
    return Scan(stamp, np.array(ranges, np.float32), -np.pi / 2, spacing, time_increment=time_increment)


def moving(x):
    return se3.from_se2([x, 0.0, 0.0])


def registrar(**settings):
    return Registrar(RegistrationConfig(**settings), UP)


def test_a_vertical_scan_stands_across_the_way_of_the_robot():
    stage = registrar()
    stage.add_pose(0.0, moving(3.0))
    stage.add_scan(scan(0.0))
    (registered,) = stage.take()
    assert registered.cloud.points == pytest.approx(np.array([[3, -1, 0.5], [3, 0, 1.5], [3, 1, 0.5]]), abs=1e-6)
    assert registered.cloud.sensor == pytest.approx(np.tile([3, 0, 0.5], (3, 1)))


def test_each_beam_is_placed_by_the_pose_at_its_own_time():
    stage = registrar(max_gap=2.0)
    stage.add_pose(0.0, moving(0.0))
    stage.add_pose(1.0, moving(1.0))
    stage.add_scan(scan(0.0, time_increment=0.25))
    (registered,) = stage.take()
    assert registered.cloud.points[:, 0] == pytest.approx([0, 0.25, 0.5])
    assert registered.cloud.sensor[:, 0] == pytest.approx([0, 0.25, 0.5])


def test_a_scan_waits_for_the_pose_of_its_last_beam():
    stage = registrar(max_gap=10.0)
    stage.add_pose(0.0, moving(0))
    stage.add_scan(scan(0.5, time_increment=0.5))
    assert stage.take() == []
    stage.add_pose(1.4, moving(1))
    assert stage.take() == []
    stage.add_pose(1.5, moving(1))
    assert len(stage.take()) == 1
    assert stage.waiting == 0


def test_scans_may_come_in_any_order():
    stage = registrar()
    for stamp in (0.0, 0.1, 0.2, 0.3):
        stage.add_pose(stamp, moving(stamp))
    for stamp in (0.25, 0.05, 0.15):
        stage.add_scan(scan(stamp))
    assert [registered.stamp for registered in stage.take()] == [0.25, 0.05, 0.15]


@pytest.mark.parametrize(
    ("stamp", "reason"), [(-1.0, "before the first pose"), (0.75, "no pose within 0.5 s"), (5.0, "after the last pose")]
)
def test_a_scan_without_a_pose_is_dropped_and_counted_by_reason(stamp, reason):
    stage = registrar()
    stage.add_pose(0.0, moving(0))
    stage.add_pose(2.0, moving(1))
    stage.add_scan(scan(stamp))
    assert stage.finish() == []
    assert stage.drops == {reason: 1}


def test_a_scan_is_given_up_when_much_newer_ones_wait_too():
    stage = registrar(max_wait=1.0)
    stage.add_pose(0.0, moving(0))
    for stamp in (0.5, 1.0, 1.6, 1.7):
        stage.add_scan(scan(stamp))
    assert stage.drops == {"no pose came for 1 s": 1}
    assert stage.waiting == 3


def test_a_single_scan_far_ahead_makes_it_give_up_no_other():
    stage = registrar(max_wait=1.0)
    stage.add_pose(0.0, moving(0))
    for stamp in (0.1, 1e6, 0.2):
        stage.add_scan(scan(stamp))
    stage.add_pose(0.3, moving(0))
    assert [registered.stamp for registered in stage.take()] == [0.1, 0.2]
    assert stage.drops == {}


def test_a_scan_that_comes_again_is_counted_and_not_placed_twice():
    stage = registrar()
    stage.add_pose(0.0, moving(0))
    stage.add_pose(0.2, moving(0))
    for stamp in (0.1, 0.15, 0.1):
        stage.add_scan(scan(stamp))
    assert len(stage.take()) == 2
    assert stage.drops == {"duplicate: its stamp came before": 1}


def test_a_single_pose_far_ahead_is_not_used_and_two_are():
    stage = registrar(max_wait=1.0)
    stage.add_pose(0.0, moving(0))
    stage.add_pose(1e6, moving(9))
    stage.add_scan(scan(0.1))
    stage.add_pose(0.2, moving(0))
    assert [registered.stamp for registered in stage.take()] == [0.1]
    assert stage.drops == {"pose far ahead of all others": 1}
    # The robot stood in a lift for a while.
    stage.add_pose(100.0, moving(1))
    stage.add_pose(100.1, moving(1))
    stage.add_pose(100.2, moving(1))
    stage.add_scan(scan(100.15))
    assert [registered.stamp for registered in stage.take()] == [100.15]


@pytest.mark.parametrize(("stamp", "x"), [(0.1, np.nan), (0.1, np.inf), (np.nan, 1.0)])
def test_a_pose_that_is_not_finite_is_counted(stamp, x):
    stage = registrar()
    stage.add_pose(0.0, moving(0))
    stage.add_pose(stamp, moving(x))
    stage.add_scan(scan(0.05))
    stage.add_pose(0.2, moving(2))
    (registered,) = stage.take()
    assert registered.cloud.points[:, 0] == pytest.approx(0.5)
    assert stage.drops == {"pose that is not finite": 1}


def test_a_pose_that_comes_again_changes_nothing():
    stage = registrar()
    for _ in range(3):
        stage.add_pose(0.0, moving(0))
        stage.add_pose(0.2, moving(2))
    stage.add_scan(scan(0.1))
    assert stage.take()[0].cloud.points[:, 0] == pytest.approx(1.0)


@pytest.mark.parametrize("ranges", [(np.nan, np.inf, -np.inf), (0.0, 0.0, 0.0), (0.1, 99.0, -1.0)])
def test_a_scan_without_a_measurement_is_counted(ranges):
    stage = registrar()
    stage.add_pose(0.0, moving(0))
    stage.add_scan(scan(0.0, ranges))
    assert stage.take() == []
    assert stage.drops == {"no beam in range": 1}


def test_memory_does_not_grow_with_time():
    stage = registrar()
    for index in range(3000):
        stage.add_pose(index * 0.01, moving(0))
        stage.add_scan(scan(index * 0.01))
        stage.take()
    # Twice what 2 s hold, as those before are forgotten together.
    assert len(stage._trajectory) < 500


def path(planar, stamps=None):
    """Keyframes at x, y, yaw, one a second."""
    planar = np.reshape(planar, (-1, 3))
    return Trajectory.from_se2(np.arange(float(len(planar))) if stamps is None else stamps, planar)


def driven(keyframes=4, **settings):
    """A registrar that keeps scans: 1 m/s along x, ten poses and scans a second, a keyframe a second."""
    stage = Registrar(RegistrationConfig(**settings), UP, keep_scans=True)
    for step in range(10 * keyframes - 9):
        stage.add_pose(0.1 * step, moving(0.1 * step))
        stage.add_scan(scan(0.1 * step))
        if step % 10 == 0:
            assert stage.follow(path([(k, 0, 0) for k in range(step // 10 + 1)]))
    return stage


def collect(stage):
    """What somebody has who takes in all that is handed out, piece by piece, and how much of it was anew."""
    pieces, anew = {}, 0
    for registered in stage.take():
        pieces.setdefault(registered.piece, []).append(registered.cloud)
    while (renewed := stage.renew()) is not None:
        pieces[renewed.piece] = [renewed.cloud]
        anew += 1
    return concatenate([cloud for _, clouds in sorted(pieces.items()) for cloud in clouds]), anew


def test_points_follow_the_keyframes_that_are_moved():
    stage = driven()
    assert stage.follow(path([(0, 0, 0), (1, 0, 0), (2, 1, 0), (3, 2, 0)]))
    cloud, anew = collect(stage)
    x = cloud.sensor[:, 0]
    assert cloud.sensor[:, 1] == pytest.approx(np.maximum(x - 1, 0), abs=1e-9)
    # Of four; the scan at keyframe 1 is in a piece with those before, and on the way that has moved.
    assert anew == 3


def test_what_is_not_moved_is_not_handed_out_anew():
    stage = driven()
    assert stage.follow(path([(k, 0, 0) for k in range(4)]))
    assert stage.to_renew == 0


@pytest.mark.parametrize(("y", "yaw", "anew"), [(0.009, 0, 0), (0.011, 0, 2), (0, 0.0016, 0), (0, 0.0018, 2)])
def test_a_small_correction_waits_until_it_is_worth_it(y, yaw, anew):
    stage = driven()
    assert stage.follow(path([(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, y, yaw)]))
    assert collect(stage)[1] == anew


def test_small_corrections_that_add_up_are_made():
    stage = driven()
    for y in (0.004, 0.008, 0.012):
        assert stage.follow(path([(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, y, 0)]))
    assert collect(stage)[1] == 2


def test_the_points_of_a_piece_handed_out_anew_are_all_its_points():
    stage = driven()
    whole = collect(driven())[0]
    stage.renew_all()
    cloud, anew = collect(stage)
    assert anew == 4
    assert np.array_equal(cloud.points, whole.points)


def test_each_time_a_piece_has_a_newer_revision():
    stage = driven()
    revisions = []
    for _ in range(3):
        stage.renew_all()
        revisions.append([renewed.revision for renewed in iter(stage.renew, None)])
    assert revisions == [[1] * 4, [2] * 4, [3] * 4]


def test_a_registrar_that_keeps_no_scans_has_nothing_to_hand_out_anew():
    stage = registrar()
    stage.add_pose(0.0, moving(0))
    stage.add_scan(scan(0.0))
    stage.renew_all()
    assert stage.renew() is None


def test_keyframes_of_another_map_are_told():
    stage = driven()
    assert not stage.follow(path([(0, 0, 0), (1, 0, 0)], stamps=[0.0, 1.5]))


def test_the_oldest_scans_are_released_and_stay_where_they_are():
    stage = driven(kept_scans=15)
    assert stage.kept <= 15
    assert stage.kept + stage.released == 31
    assert stage.follow(path([(k, 1, 0) for k in range(4)]))
    assert [round(renewed.stamp, 6) for renewed in iter(stage.renew, None)] == [3.0]


def test_a_released_scan_is_not_replaced_by_later_ones_of_its_piece():
    stage = Registrar(RegistrationConfig(kept_scans=1), UP, keep_scans=True)
    for step in range(5):
        stage.add_pose(0.1 * step, moving(0.1 * step))
        stage.add_scan(scan(0.1 * step))
    stage.renew_all()
    cloud, anew = collect(stage)
    assert sorted(set(cloud.points[:, 0].round(6))) == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert anew <= 1


def test_pieces_are_small_though_the_robot_stands_and_no_keyframe_comes():
    stage = Registrar(RegistrationConfig(scan_distance=0), UP, keep_scans=True)
    for step in range(300):
        stage.add_pose(0.1 * step, moving(0))
        stage.add_scan(scan(0.1 * step, np.ones(181)))
    counts = Counter(registered.piece for registered in stage.take())
    # 3000 beams.
    assert max(counts.values()) == 16
    assert len(counts) == 19


def test_scans_are_needed_where_the_robot_has_moved_on_or_turned():
    rng = np.random.default_rng(0)
    stage = Registrar(RegistrationConfig(scan_distance=0.1, scan_angle=0.05), UP, keep_scans=True)
    # It stands at 0 m, drives on, turns at 1 m and stands there; what it is told of its place is off by millimetres.
    way = [(0, 0, 0)] * 50 + [(0.05 * k, 0, 0) for k in range(1, 21)] + [(1, 0, 0.03 * k) for k in range(1, 21)]
    way += [(1, 0, 0.6)] * 50
    for step, pose in enumerate(way):
        noise = rng.uniform(-0.001, 0.001, 3)
        stage.add_pose(0.1 * step, se3.from_se2(np.array(pose) + noise))
        stage.add_scan(scan(0.1 * step))
    taken = [round(10 * registered.stamp) for registered in stage.take()]
    # One of where it stands, and of the others each second or third.
    assert taken[0] == 0
    assert 51 <= taken[1] <= 52
    assert 87 <= taken[-1] <= 90
    assert set(np.diff(taken[1:])) <= {2, 3}
    assert stage.kept == len(taken)
    assert stage.too_near == len(way) - len(taken)
    assert stage.drops == {}


@pytest.mark.parametrize("setting", ["scan_distance", "scan_angle"])
def test_all_scans_are_handed_out_where_that_is_asked_for(setting):
    stage = Registrar(RegistrationConfig(**{setting: 0, "new_points": 0}), UP, keep_scans=True)
    for step in range(1000):
        stage.add_pose(0.1 * step, moving(0))
        stage.add_scan(scan(0.1 * step))
    assert stage.kept == 1000


def test_scans_that_overtake_each_other_are_as_near_as_others():
    kept = []
    for late in (0, 30):
        stage = Registrar(RegistrationConfig(), UP, keep_scans=True)
        # 0.3 m/s, 75 scans a second, of which each second one comes 0.4 s late.
        for step in range(780):
            stage.add_pose(step / 75, moving(0.3 * step / 75))
            for comes in (step, step - late) if late else (step,):
                if 0 <= comes < 750 and (late == 0 or (comes == step) == (comes % 2 == 0)):
                    stage.add_scan(scan(comes / 75))
        kept.append(stage.kept)
        assert stage.kept + stage.too_near == 750
    assert kept[0] == pytest.approx(60, abs=2)
    assert kept[1] <= 2 * kept[0]


def test_a_scan_with_more_beams_is_needed_though_the_robot_has_not_moved_on():
    stage = Registrar(RegistrationConfig(), UP, keep_scans=True)
    for step, beams in enumerate([1, 3, 3, 4, 181, 181, 150, 1]):
        ranges = np.full(181, np.nan)
        ranges[:beams] = 1.0
        stage.add_pose(0.1 * step, moving(0))
        stage.add_scan(scan(0.1 * step, ranges))
    assert [len(registered.cloud) for registered in stage.take()] == [1, 3, 181]


def test_a_voxel_keeps_its_first_point():
    stage = registrar(voxel=0.5)
    for step in range(11):
        stage.add_pose(0.1 * step, moving(0.1 * step))
        stage.add_scan(scan(0.1 * step))
    points = concatenate([registered.cloud for registered in stage.take()]).points
    # Three beams, and cubes that begin at 0, 0.5 and 1 m on the way.
    assert sorted(set(points[:, 0].round(6))) == [0.0, 0.5, 1.0]
    assert len(points) == 9


def test_a_piece_placed_anew_is_thinned_anew():
    stage = driven(voxel=0.5)
    assert stage.follow(path([(k, 0.3, 0) for k in range(4)]))
    cloud, _ = collect(stage)
    cubes = np.floor(cloud.points / 0.5).astype(int)
    # At the borders of pieces two may lie in one cube.
    assert len(np.unique(cubes, axis=0)) >= len(cloud) - 3 * 3
    assert cloud.sensor[:, 1] == pytest.approx(0.3)


def test_after_a_reset_nothing_is_left():
    stage = registrar()
    stage.add_pose(0.0, moving(0))
    stage.add_scan(scan(0.0))
    stage.reset()
    assert stage.take() == []
    stage.add_scan(scan(0.0))
    assert stage.take() == []


def test_with_the_true_trajectory_points_lie_on_the_surfaces():
    simulation = simulate(SimulationConfig(range_noise=0.0, mixed_pixels=False, vertical_every=400))
    recording, truth = simulation.recording, simulation.trajectory
    stage = Registrar(RegistrationConfig(), recording.T_base_laser_vertical)
    for scan_vertical in recording.scans_vertical:
        nearby = np.abs(truth.stamps - scan_vertical.stamp) < 0.1
        for stamp, T_map_base in zip(truth.stamps[nearby], truth.matrices()[nearby], strict=True):
            stage.add_pose(stamp, T_map_base)
        stage.add_scan(scan_vertical)
    points = np.concatenate([registered.cloud.points for registered in stage.take()])
    assert stage.drops == {}
    error = np.linalg.norm(points - simulation.clean_vertical, axis=1)
    # The laser counts whole millimetres.
    assert error.max() < 0.001


def drive_again(stage, passes, *, begin=0, keyframes=(), x=0.0, turned=0.0):
    """Passes through the same 5 m of a tunnel of 1 m radius: 50 scans of 600 beams and a keyframe each."""
    told = list(keyframes)
    for number in range(begin, begin + passes):
        for step in range(50):
            stamp = 0.1 * (50 * number + step)
            stage.add_pose(stamp, se3.from_se2([x + 0.1 * step, 0.0, turned]))
            if step == 0:
                told.append((stamp, x, 0.0, turned))
                assert stage.follow(keyframes_at(told))
            stage.add_scan(scan(stamp, np.ones(600)))
    return told


def keyframes_at(told):
    stamps, *poses = np.array(told).T
    return Trajectory.from_se2(stamps, np.column_stack(poses))


def test_what_was_seen_again_and_again_is_not_needed_any_more():
    stage = Registrar(RegistrationConfig(), UP, keep_scans=True)
    # The latest 30 pieces do not count: each has five scans.
    told = drive_again(stage, 5)
    known = stage.kept
    drive_again(stage, 20, begin=5, keyframes=told)
    assert stage.kept == len(stage.take()) == known < 250
    assert stage.nothing_new + stage.too_near == 25 * 50 - known
    assert stage.nothing_new > 800
    assert stage.drops == {}


def test_what_was_seen_on_the_way_there_is_known_on_the_way_back():
    # Whoever leans forward sees all from the other direction along the way when it comes back.
    leaning = se3.from_xyz_rpy([0, 0, 0.5, 0, 0.1 - np.pi / 2, 0])
    stage = Registrar(RegistrationConfig(), leaning, keep_scans=True)
    told = drive_again(stage, 8)
    known = stage.kept
    drive_again(stage, 1, begin=8, keyframes=told, turned=np.pi)
    # At each end there is a little that was not seen from there.
    assert stage.kept - known < 10


def test_all_scans_are_handed_out_where_none_has_to_see_anything_new():
    stage = Registrar(RegistrationConfig(new_points=0.0), UP, keep_scans=True)
    drive_again(stage, 6)
    assert stage.kept == 300


def test_what_is_new_is_handed_out_beside_what_is_known():
    stage = Registrar(RegistrationConfig(), UP, keep_scans=True)
    told = drive_again(stage, 8)
    known = stage.kept
    drive_again(stage, 1, begin=8, keyframes=told, x=20.0)
    assert stage.kept == known + 50


def test_a_place_is_not_known_any_more_where_what_was_seen_of_it_is_moved_away():
    stage = Registrar(RegistrationConfig(), UP, keep_scans=True)
    told = drive_again(stage, 8)
    known = stage.kept
    elsewhere = [(stamp, x, 30.0, yaw) for stamp, x, _, yaw in told]
    assert stage.follow(keyframes_at(elsewhere))
    while stage.renew():
        pass
    drive_again(stage, 1, begin=8, keyframes=elsewhere)
    assert stage.kept == known + 50


def test_scans_that_are_kept_no_more_need_not_come_again():
    stage = Registrar(RegistrationConfig(kept_scans=160), UP, keep_scans=True)
    told = drive_again(stage, 5)
    known = stage.kept + stage.released
    drive_again(stage, 5, begin=5, keyframes=told)
    assert stage.released > 0
    assert stage.kept + stage.released == known


def test_a_long_drive_is_placed_anew_with_the_poses_around_its_scans(monkeypatch):
    """Ten minutes, half of them standing, then the keyframes are moved: as if all poses had been kept."""

    def driven_long():
        stage = Registrar(RegistrationConfig(), UP, keep_scans=True)
        way = 0.02 * np.where(np.arange(6000) % 1000 < 500, 1.0, 0.0).cumsum()
        keyframes = [(0.0, 0.0)]
        for step, x in enumerate(way):
            stage.add_pose(0.1 * step, moving(x))
            if step % 4 == 0:
                stage.add_scan(scan(0.1 * step + 0.03, time_increment=0.02))
            if x > keyframes[-1][1] + 0.25:
                keyframes.append((0.1 * step, x))
                assert stage.follow(path([(x, 0, 0) for _, x in keyframes], [stamp for stamp, _ in keyframes]))
        stage.take()
        stamps, xs = np.array(keyframes).T
        stage.follow(path(np.column_stack([xs, np.sin(xs / 10), np.cos(xs / 10) / 10]), stamps))
        clouds = []
        while registered := stage.renew():
            clouds.append(registered.cloud)
        return stage, concatenate(clouds).points

    thin, points = driven_long()
    monkeypatch.setattr(registrar_module, "_ALL_POSES_KEPT_S", np.inf)
    whole, expected = driven_long()
    assert len(expected) > 700
    assert np.array_equal(points, expected)
    assert len(thin._trajectory) < len(whole._trajectory) * 0.75
    assert thin.drops == whole.drops == {}
