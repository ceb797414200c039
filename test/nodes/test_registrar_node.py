# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
from rclpy.serialization import serialize_message
from sensor_msgs.msg import LaserScan, PointCloud2
from std_msgs.msg import Header, UInt32
from std_srvs.srv import Trigger

from g2_recon.geometry.cloud import ALL_PIECES
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.nodes import conversions
from g2_recon.nodes.registrar_node import RegistrarNode
from g2_recon.nodes.ros import LATCHED
from g2_recon.recording.journal import Journal

MOUNTED = ("-p", f"laser_pose:=[0.0,0.0,0.6,0.0,{-math.pi / 2},0.0]")


def value(diagnostics: list, key: str) -> str | None:
    pairs = {pair.key: pair.value for array in diagnostics for pair in array.status[0].values}
    return pairs.get(key)


@pytest.fixture
def drive(ros, room_scan):
    """`drive(*arguments)` starts the node and gives the test's end of its topics."""

    def start(*arguments):
        harness = ros(*(arguments or MOUNTED))
        harness.node = harness.add(RegistrarNode)
        harness.clouds = harness.collect(PointCloud2, "cloud")
        harness.diagnostics = harness.collect(DiagnosticArray, "/diagnostics")
        scans = harness.publisher(LaserScan, "scan_vertical")
        poses = harness.publisher(PoseWithCovarianceStamped, "pose")
        harness.scan = lambda stamp: scans.publish(room_scan(stamp))

        def pose(stamp, planar=(0.0, 0.0, 0.0), frame="map"):
            head = Header(stamp=conversions.stamp_message(stamp), frame_id=frame)
            poses.publish(conversions.planar_pose_message(head, planar, np.eye(3)))

        harness.pose = pose
        return harness

    return start


def test_a_scan_becomes_a_cloud_in_the_map_with_its_stamp(drive):
    robot = drive()
    robot.pose(99.9)
    robot.scan(100.0)
    robot.pose(100.1)
    robot.wait_until(lambda: robot.clouds)
    assert conversions.stamp_seconds(robot.clouds[0].header.stamp) == pytest.approx(100.0)
    assert robot.clouds[0].header.frame_id == "map"


def test_points_lie_where_the_laser_of_the_moving_robot_saw_them(drive):
    robot = drive()
    robot.pose(99.9, (1.0, 0.0, 0.0))
    robot.scan(100.0)
    robot.pose(100.1, (3.0, 0.0, 0.0))
    robot.wait_until(lambda: robot.clouds)
    cloud = conversions.cloud_from_message(robot.clouds[0])
    # The laser at (2, 0, 0.6) scans the plane across the way; the walls of the scan's own room are 2 m to each side.
    np.testing.assert_allclose(cloud.sensor, np.broadcast_to((2.0, 0.0, 0.6), cloud.points.shape), atol=1e-5)
    np.testing.assert_allclose(cloud.points[:, 0], 2.0, atol=1e-5)
    np.testing.assert_allclose([cloud.points[:, 1].min(), cloud.points[:, 1].max()], [-2.0, 2.0], atol=1e-5)


def test_no_scan_is_lost_when_poses_come_late(drive):
    robot = drive()
    for step in range(20):
        robot.scan(100.0 + 0.05 * step)
    for step in range(22):
        robot.pose(99.95 + 0.05 * step, (0.1 * step, 0.0, 0.0))
    robot.wait_until(lambda: len(robot.clouds) == 20)


def test_a_scan_for_which_no_pose_comes_is_counted(drive):
    robot = drive(*MOUNTED, "-p", "max_wait:=1.0")
    robot.pose(99.0)
    robot.scan(100.0)
    robot.scan(102.0)
    robot.scan(102.1)
    robot.wait_until(lambda: value(robot.diagnostics, "dropped: scan, no pose came for 1 s") == "1")


def test_poses_in_another_frame_are_dropped_and_counted(drive):
    robot = drive()
    robot.pose(100.0, frame="odom")
    robot.wait_until(lambda: value(robot.diagnostics, "dropped: pose in another frame") == "1")


def test_one_wrong_stamp_far_ahead_takes_nothing_back(drive):
    robot = drive()
    robot.pose(99.9)
    robot.scan(100.0)
    robot.pose(1e6)
    robot.scan(1e6)
    robot.pose(100.1)
    robot.scan(100.2)
    robot.pose(100.3, (0.2, 0.0, 0.0))
    robot.wait_until(lambda: len(robot.clouds) >= 2)
    assert [conversions.piece_from_message(cloud).number for cloud in robot.clouds] == [0, 0]
    robot.wait_until(lambda: value(robot.diagnostics, "dropped: pose far ahead of all others") == "1")


def test_a_duplicate_scan_is_counted(drive):
    robot = drive()
    robot.pose(99.9)
    robot.scan(100.0)
    robot.scan(100.0)
    robot.pose(100.1)
    robot.wait_until(lambda: value(robot.diagnostics, "dropped: scan, duplicate: its stamp came before") == "1")
    assert len(robot.clouds) == 1


def trajectory(planar, stamps):
    return conversions.path_message(Header(frame_id="map"), Trajectory.from_se2(stamps, planar))


def drive_a_metre(robot):
    """Keyframes at 100 and 101 s, at x = 0 and 1 m, and a scan between."""
    robot.pose(100.0)
    robot.scan(100.5)
    robot.pose(100.5, (0.5, 0.0, 0.0))
    robot.pose(101.0, (1.0, 0.0, 0.0))
    robot.wait_until(lambda: robot.clouds)


def test_points_are_published_anew_where_the_localizer_moved_the_way(drive):
    robot = drive()
    drive_a_metre(robot)
    paths = robot.publisher(Path, "trajectory", LATCHED)
    paths.publish(trajectory([(0, 0, 0), (1, 0, 0)], [100.0, 101.0]))
    paths.publish(trajectory([(0, 5, 0), (1, 5, 0)], [100.0, 101.0]))
    robot.wait_until(lambda: len(robot.clouds) == 2)
    pieces = [conversions.piece_from_message(cloud) for cloud in robot.clouds]
    assert pieces[1] == dataclasses.replace(pieces[0], revision=1)
    sensor = conversions.cloud_from_message(robot.clouds[1]).sensor
    np.testing.assert_allclose(sensor, np.broadcast_to((0.5, 5.0, 0.6), sensor.shape), atol=1e-5)


def test_whoever_comes_late_gets_what_was_before(drive):
    robot = drive()
    drive_a_metre(robot)
    late = robot.collect(PointCloud2, "cloud")
    robot.wait_until(lambda: late)
    before = conversions.cloud_from_message(robot.clouds[0])
    np.testing.assert_array_equal(conversions.cloud_from_message(late[0]).points, before.points)
    assert conversions.piece_from_message(late[0]).revision == 1


def test_a_trajectory_of_another_map_takes_the_points_back(drive):
    robot = drive()
    drive_a_metre(robot)
    paths = robot.publisher(Path, "trajectory", LATCHED)
    paths.publish(trajectory([(0, 0, 0), (1, 0, 0)], [100.0, 101.0]))
    robot.wait_until(lambda: value(robot.diagnostics, "received trajectory") == "1")
    paths.publish(trajectory([(0, 0, 0)], [100.7]))
    robot.wait_until(lambda: len(robot.clouds) == 2)
    assert conversions.piece_from_message(robot.clouds[1]).number == ALL_PIECES


@pytest.mark.parametrize("broken", [math.nan, 1e9])
def test_a_broken_trajectory_is_counted_and_moves_nothing(drive, broken):
    robot = drive()
    drive_a_metre(robot)
    message = trajectory([(0, 0, 0), (1, 0, 0)], [100.0, 101.0])
    message.poses[1].pose.position.y = broken
    robot.publisher(Path, "trajectory", LATCHED).publish(message)
    robot.wait_until(lambda: value(robot.diagnostics, "dropped: unusable trajectory") == "1")
    assert len(robot.clouds) == 1


def test_an_empty_trajectory_makes_it_forget_the_poses_of_the_old_map(drive):
    robot = drive()
    robot.pose(99.9)
    robot.pose(100.3)
    # Messages of two topics overtake each other.
    robot.wait_until(lambda: value(robot.diagnostics, "received pose") == "2")
    robot.publisher(Path, "trajectory", LATCHED).publish(Path())
    robot.wait_until(lambda: value(robot.diagnostics, "received trajectory") == "1")
    robot.scan(100.1)
    robot.scan(100.4)
    robot.pose(100.35, (5.0, 0.0, 0.0))
    robot.pose(100.5, (5.0, 0.0, 0.0))
    robot.wait_until(lambda: robot.clouds)
    assert conversions.stamp_seconds(robot.clouds[0].header.stamp) == pytest.approx(100.4)


def test_a_recording_that_starts_again_is_registered_again(drive):
    robot = drive()
    for received in (3, 6):
        robot.pose(99.9)
        robot.scan(100.0)
        robot.pose(100.1)
        robot.pose(110.0)
        robot.wait_until(lambda received=received: value(robot.diagnostics, "received pose") == str(received))
    pieces = [conversions.piece_from_message(cloud) for cloud in robot.clouds]
    # What was published before is taken back.
    assert [piece.number for piece in pieces] == [0, ALL_PIECES, 0]
    assert pieces[0].source == pieces[1].source != pieces[2].source


def test_without_the_pose_of_the_laser_diagnostics_say_what_to_do(drive):
    robot = drive("-p", "map_frame:=map")
    robot.scan(100.0)
    told = "no transform base_link <- laser: set `laser_pose` or publish it"
    robot.wait_until(lambda: any(told in array.status[0].message for array in robot.diagnostics))


def test_reset_forgets_waiting_scans(drive):
    robot = drive()
    robot.scan(100.0)
    robot.wait_until(lambda: value(robot.diagnostics, "scans that wait for a pose") == "1")
    assert robot.call(Trigger, "registrar_node/reset").success
    robot.wait_until(lambda: value(robot.diagnostics[-1:], "scans that wait for a pose") == "0")


def test_what_a_life_before_has_published_is_taken_back_also_from_whoever_is_there_already(drive, tmp_path):
    journal = Journal(tmp_path / "scans.journal")
    journal.append(b"\x06source" + serialize_message(UInt32(data=5)))
    journal.close()
    robot = drive(*MOUNTED, "-p", f"session_dir:={tmp_path}")
    robot.wait_until(lambda: robot.node._cloud._subscribers == 1)
    robot.pose(99.9)
    robot.scan(100.0)
    robot.pose(100.1)

    def pieces():
        return [conversions.piece_from_message(cloud) for cloud in robot.clouds]

    robot.wait_until(lambda: (5, ALL_PIECES) in [(piece.source, piece.number) for piece in pieces()])
    # What came of this life meanwhile comes once more.
    robot.wait_until(lambda: pieces()[-1].revision == 1)
