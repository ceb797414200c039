# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid as GridMessage
from nav_msgs.msg import Odometry, Path
from sensor_msgs.msg import LaserScan, PointCloud2
from std_srvs.srv import SetBool, Trigger

from g2_recon.geometry import se2, se3
from g2_recon.nodes import conversions
from g2_recon.nodes.localizer_node import LocalizerNode
from g2_recon.nodes.ros import LATCHED
from g2_recon.recording.clouds import read_cloud
from g2_recon.recording.occupancy_maps import read_map
from g2_recon.recording.sessions import read_session
from g2_recon.recording.trajectories import read_tum

MOUNTED = ("-p", "laser_pose:=[0.0,0.0,0.3,0.0,0.0,0.0]")
STEPS = [(0.1 * step, 0.0, 0.02 * step) for step in range(8)]


def odometry(stamp, pose) -> Odometry:
    message = Odometry()
    message.header.frame_id = "odom"
    message.header.stamp = conversions.stamp_message(stamp)
    message.pose.pose = conversions.pose_message(se3.from_se2(pose))
    return message


def planar(message: PoseWithCovarianceStamped) -> np.ndarray:
    return se2.from_se3(conversions.pose_matrix(message.pose.pose))


def value(diagnostics: list, key: str) -> str | None:
    pairs = {pair.key: pair.value for array in diagnostics for pair in array.status[0].values}
    return pairs.get(key)


@pytest.fixture
def drive(ros, room_scan):
    """`drive(*arguments)` starts the node and gives the test's end of its topics."""

    def start(*arguments):
        harness = ros(*(arguments or MOUNTED))
        harness.add(LocalizerNode)
        harness.scans = harness.publisher(LaserScan, "scan")
        harness.poses = harness.collect(PoseWithCovarianceStamped, "pose")
        harness.scan = lambda stamp, pose=(0.0, 0.0, 0.0): harness.scans.publish(room_scan(stamp, pose))
        harness.wait_for_poses = lambda count: harness.wait_until(lambda: len(harness.poses) >= count)
        return harness

    return start


def test_every_scan_gets_a_pose_with_its_own_stamp(drive):
    room = drive()
    for step, pose in enumerate(STEPS):
        room.scan(100.0 + 0.1 * step, pose)
    room.wait_for_poses(len(STEPS))
    stamps = [conversions.stamp_seconds(pose.header.stamp) for pose in room.poses]
    np.testing.assert_allclose(stamps, 100 + 0.1 * np.arange(len(STEPS)), atol=1e-9)


def test_poses_are_where_the_robot_is(drive):
    room = drive()
    for step, pose in enumerate(STEPS):
        room.scan(100.0 + 0.1 * step, pose)
    room.wait_for_poses(len(STEPS))
    assert {pose.header.frame_id for pose in room.poses} == {"map"}
    # 2 cm and 0.5 deg: the points of the room are 5 cm apart in the map.
    np.testing.assert_allclose([planar(pose)[:2] for pose in room.poses], [pose[:2] for pose in STEPS], atol=0.02)
    np.testing.assert_allclose([planar(pose)[2] for pose in room.poses], [p[2] for p in STEPS], atol=math.radians(0.5))


def test_a_scan_waits_for_the_odometry_of_its_time(drive):
    room = drive()
    odom = room.publisher(Odometry, "odom")
    odom.publish(odometry(99.95, (0, 0, 0)))
    room.scan(99.95)
    room.wait_for_poses(1)
    room.scan(100.0)
    with pytest.raises(AssertionError, match="in vain"):
        room.wait_until(lambda: len(room.poses) > 1, seconds=0.3)
    odom.publish(odometry(100.05, (0, 0, 0)))
    room.wait_for_poses(2)


def test_odometry_that_stops_holds_no_scan_back(drive):
    room = drive()
    room.publisher(Odometry, "odom").publish(odometry(100.0, (0, 0, 0)))
    for step in range(10):
        room.scan(100.1 + 0.1 * step)
    room.wait_for_poses(10)


def test_odometry_leads_where_the_laser_sees_nothing(drive, room_scan):
    room = drive()
    diagnostics = room.collect(DiagnosticArray, "/diagnostics")
    odom = room.publisher(Odometry, "odom")
    stamps = (100.0, 100.5, 101.0)
    for stamp, x in zip(stamps, (0.0, 0.25, 0.5), strict=True):
        odom.publish(odometry(stamp, (x, 0, 0)))
    room.wait_until(lambda: value(diagnostics, "received odom") == "3")
    blind = room_scan(100.0)
    for stamp in stamps:
        blind.header.stamp = conversions.stamp_message(stamp)
        blind.ranges = [math.inf] * 360
        room.scans.publish(blind)
    room.wait_for_poses(3)
    np.testing.assert_allclose(planar(room.poses[-1]), (0.5, 0, 0), atol=1e-6)
    room.wait_until(lambda: "deg in the map: sigma" in (value(diagnostics, "position is known least") or ""))


def test_broken_odometry_is_dropped_and_counted(drive):
    room = drive()
    diagnostics = room.collect(DiagnosticArray, "/diagnostics")
    broken = odometry(100.0, (0, 0, 0))
    broken.pose.pose.orientation.w = 0.0
    room.publisher(Odometry, "odom").publish(broken)
    room.wait_until(lambda: value(diagnostics, "dropped: unusable odometry") == "1")


def test_a_broken_scan_is_dropped_and_counted(drive, room_scan):
    room = drive()
    diagnostics = room.collect(DiagnosticArray, "/diagnostics")
    broken = room_scan(100.0)
    broken.angle_increment = math.nan
    room.scans.publish(broken)
    room.wait_until(lambda: value(diagnostics, "dropped: unusable scan") == "1")


def test_without_the_pose_of_the_laser_diagnostics_say_what_to_do(drive):
    room = drive("-p", "map_frame:=map")
    diagnostics = room.collect(DiagnosticArray, "/diagnostics")
    room.scan(100.0)
    room.wait_until(lambda: value(diagnostics, "dropped: scan of a laser with unknown pose") == "1")
    assert diagnostics[-1].status[0].message == "no transform base_link <- laser: set `laser_pose` or publish it"


def test_diagnostics_name_the_topic_that_is_missing(ros):
    harness = ros(*MOUNTED)
    harness.add(LocalizerNode)
    diagnostics = harness.collect(DiagnosticArray, "/diagnostics")
    harness.wait_until(lambda: diagnostics)
    assert diagnostics[-1].status[0].message == "waiting for `/scan`: no publisher"


def test_whoever_comes_late_gets_trajectory_and_map(drive):
    room = drive(*MOUNTED, "-p", "keyframe_distance:=0.05")
    for step, pose in enumerate(STEPS):
        room.scan(100.0 + 0.1 * step, pose)
    room.wait_for_poses(len(STEPS))
    trajectories = room.collect(Path, "trajectory", LATCHED)
    maps = room.collect(PointCloud2, "point_map", LATCHED)
    room.wait_until(lambda: trajectories and len(trajectories[-1].poses) == len(STEPS))
    room.wait_until(lambda: maps and maps[-1].width > 100)
    grids = room.collect(GridMessage, "map", LATCHED)
    room.wait_until(lambda: grids and 100 in grids[-1].data and 0 in grids[-1].data)
    assert grids[-1].header.frame_id == "map"


def test_the_occupancy_grid_is_published_only_when_it_has_changed(drive):
    room = drive()
    grids = room.collect(GridMessage, "map", LATCHED)
    room.scan(100.0)
    room.wait_until(lambda: grids)
    for step in range(3):
        room.scan(100.1 + 0.1 * step)
    room.wait_for_poses(4)
    with pytest.raises(AssertionError, match="in vain"):
        room.wait_until(lambda: len(grids) > 1, seconds=2.5)


def test_after_a_reset_the_occupancy_grid_holds_only_what_was_seen_since(drive):
    room = drive(*MOUNTED, "-p", "keyframe_distance:=0.05", "-p", "grid_resolution:=0.1")
    grids = room.collect(GridMessage, "map", LATCHED)
    for step, pose in enumerate(STEPS):
        room.scan(100.0 + 0.1 * step, pose)
    room.wait_until(lambda: grids and 0 in grids[-1].data)
    room.call(Trigger, "localizer_node/reset")
    grids.clear()
    room.scan(101.0)
    # One scan alone decides no cell.
    room.wait_until(lambda: grids)
    assert set(grids[-1].data) == {-1}


def test_time_that_jumps_back_starts_a_new_map(drive):
    room = drive()
    trajectories = room.collect(Path, "trajectory", LATCHED)
    room.scan(100.0)
    room.scan(100.1, (0.3, 0.0, 0.0))
    room.wait_for_poses(2)
    room.scan(50.0, (0.3, 0.0, 0.0))
    room.wait_for_poses(3)
    np.testing.assert_allclose(planar(room.poses[-1]), 0, atol=1e-9)
    room.wait_until(lambda: any(not trajectory.poses for trajectory in trajectories))


def test_stamps_that_step_back_a_little_are_no_new_start(drive):
    room = drive()
    for step, stamp in enumerate((100.0, 100.9, 100.1)):
        room.scan(stamp, (0.1 * step, 0.0, 0.0))
    room.wait_for_poses(3)
    assert planar(room.poses[-1])[0] == pytest.approx(0.2, abs=0.02)


def test_reset_starts_a_new_map(drive):
    room = drive()
    room.scan(100.0)
    room.scan(100.1, (0.3, 0.0, 0.0))
    room.wait_for_poses(2)
    assert room.call(Trigger, "localizer_node/reset").success
    room.scan(100.2, (0.3, 0.0, 0.0))
    room.wait_for_poses(3)
    np.testing.assert_allclose(planar(room.poses[-1]), 0, atol=1e-9)


def test_an_initial_pose_starts_a_new_map_there(drive):
    room = drive()
    message = PoseWithCovarianceStamped()
    message.header.frame_id = "map"
    message.pose.pose = conversions.pose_message(se3.from_se2((1, 2, 0.5)))
    diagnostics = room.collect(DiagnosticArray, "/diagnostics")
    room.publisher(PoseWithCovarianceStamped, "initialpose").publish(message)
    room.wait_until(lambda: value(diagnostics, "received initialpose") == "1")
    room.scan(100.0)
    room.wait_for_poses(1)
    np.testing.assert_allclose(planar(room.poses[-1]), (1, 2, 0.5), atol=1e-9)


def test_while_paused_scans_are_counted_but_not_used(drive):
    room = drive()
    diagnostics = room.collect(DiagnosticArray, "/diagnostics")
    assert room.call(SetBool, "localizer_node/pause", SetBool.Request(data=True)).success
    room.scan(100.0)
    room.wait_until(lambda: value(diagnostics, "dropped: scan while paused") == "1")
    assert room.call(SetBool, "localizer_node/pause", SetBool.Request(data=False)).success
    room.scan(100.1)
    room.wait_for_poses(1)
    assert room.poses[0].header.stamp == Time(sec=100, nanosec=100_000_000)


def test_save_writes_trajectory_and_map(drive, tmp_path):
    room = drive(*MOUNTED, "-p", f"session_dir:={tmp_path}/session")
    for step in range(3):
        room.scan(100.0 + 0.1 * step, (0.3 * step, 0.0, 0.0))
    room.wait_for_poses(3)
    answer = room.call(Trigger, "localizer_node/save")
    assert answer.success and str(tmp_path) in answer.message
    assert len(read_tum(tmp_path / "session/trajectory.tum")) == 3
    assert len(read_cloud(tmp_path / "session/point_map.ply")) > 100
    grid = read_map(tmp_path / "session/map.yaml")
    assert grid.at([(0.0, 0.0), (0.6, 0.0)]).tolist() == [0, 0]
    assert (grid.cells == 100).sum() > 100
    assert len(read_session(tmp_path / "session/session.npz")) == 3


def test_save_without_a_folder_says_which_parameter_to_set(drive):
    room = drive()
    room.scan(100.0)
    room.wait_for_poses(1)
    answer = room.call(Trigger, "localizer_node/save")
    assert not answer.success and "session_dir" in answer.message


def test_refine_answers_when_the_map_is_refined_and_told(drive):
    room = drive()
    answer = room.call(Trigger, "localizer_node/refine")
    assert not answer.success and "there is nothing to refine" in answer.message
    for step in range(4):
        room.scan(100.0 + 0.1 * step, (0.3 * step, 0.0, 0.0))
    room.wait_for_poses(4)
    trajectories = room.collect(Path, "trajectory", LATCHED)
    both = [room.call_async(Trigger, "localizer_node/refine") for _ in range(2)]
    room.wait_until(lambda: all(future.done() for future in both))
    assert [future.result().message for future in both] == ["refined 4 keyframes, with 0 closed loops"] * 2
    room.wait_until(lambda: trajectories and len(trajectories[-1].poses) == 4)
    places = [pose.pose.position.x for pose in trajectories[-1].poses]
    # Noise-free scans.
    np.testing.assert_allclose(places, [0.0, 0.3, 0.6, 0.9], atol=0.01)
    room.scan(100.5, (1.0, 0.0, 0.0))
    room.wait_for_poses(5)
    np.testing.assert_allclose(planar(room.poses[-1]), (1.0, 0.0, 0.0), atol=0.01)
