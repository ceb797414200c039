# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
import simulated_sweeps

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState, LaserScan, PointCloud2
from std_srvs.srv import Trigger

from g2_recon.config import SimulationConfig
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import ALL_PIECES, Cloud
from g2_recon.nodes import conversions
from g2_recon.nodes.sweep_node import SweepNode
from g2_recon.recording.clouds import read_cloud
from g2_recon.recording.trajectories import read_tum
from g2_recon.simulation.simulator import LASER_TILT_POSE, simulate

MOUNT = se3.from_xyz_rpy([0.15, 0.0, 0.75, 0.0, 0.0, 0.0])
MOUNTED = ("-p", "laser_pose:=[0.15,0.0,0.75,0.0,0.0,0.0]")
STOPS = [simulated_sweeps.stop(5.0, 3.0, 10.0), simulated_sweeps.stop(6.0, 3.3, 25.0)]


def values(diagnostics: list) -> dict[str, str]:
    return {pair.key: pair.value for array in diagnostics for pair in array.status[0].values}


def odometry(stamp, T_odom_base):
    message = Odometry(header=conversions.header(conversions.stamp_message(stamp), "odom"))
    message.pose.pose = conversions.pose_message(T_odom_base)
    return message


@pytest.fixture(scope="module")
def sweeps():
    rectangles, rng = simulated_sweeps.furnished_room(), np.random.default_rng(0)
    return [Cloud(simulated_sweeps.sweep(rectangles, at, rng)) for at in STOPS]


@pytest.fixture
def drive(ros):
    """`drive(*arguments)` starts the node and gives the test's end of its topics."""

    def start(*arguments):
        harness = ros(*(arguments or MOUNTED))
        harness.add(SweepNode)
        harness.clouds = harness.collect(PointCloud2, "cloud")
        harness.poses = harness.collect(PoseWithCovarianceStamped, "sweep_pose")
        harness.diagnostics = harness.collect(DiagnosticArray, "/diagnostics")
        publisher = harness.publisher(PointCloud2, "sweep")

        def sweep(stamp, cloud):
            head = conversions.header(conversions.stamp_message(stamp), "laser")
            publisher.publish(conversions.cloud_to_message(head, cloud))

        harness.sweep = sweep
        return harness

    return start


def test_sweeps_become_clouds_in_the_map_and_poses_of_the_robot(drive, sweeps):
    robot = drive()
    for number, cloud in enumerate(sweeps):
        robot.sweep(100.0 + number, cloud)
    robot.wait_until(lambda: len(robot.poses) == len(robot.clouds) == 2)
    assert robot.clouds[1].header.frame_id == "map"
    assert conversions.stamp_seconds(robot.clouds[1].header.stamp) == pytest.approx(101.0)
    # Without odometry the map is the frame of the first laser.
    T_map_base = conversions.pose_matrix(robot.poses[1].pose.pose)
    true = se3.inverse(STOPS[0]) @ STOPS[1] @ se3.inverse(MOUNT)
    assert np.linalg.norm(T_map_base[:3, 3] - true[:3, 3]) < 0.01
    assert 0 < robot.poses[1].pose.covariance[0] < 0.01**2
    cloud = conversions.cloud_from_message(robot.clouds[1])
    assert np.linalg.norm(cloud.sensor[0] - (se3.inverse(STOPS[0]) @ STOPS[1])[:3, 3]) < 0.01


def test_a_sweep_waits_for_the_odometry_of_its_time(drive, sweeps):
    robot = drive()
    odom = robot.publisher(Odometry, "odom")
    odom.publish(odometry(99.9, np.eye(4)))
    robot.wait_until(lambda: values(robot.diagnostics).get("received odom") == "1")
    robot.sweep(100.0, sweeps[0])
    robot.wait_until(lambda: values(robot.diagnostics).get("sweeps that wait for odometry") == "1")
    odom.publish(odometry(100.1, np.eye(4)))
    robot.wait_until(lambda: robot.poses)
    assert conversions.pose_matrix(robot.poses[0].pose.pose) == pytest.approx(np.eye(4), abs=1e-9)


def test_a_sweep_that_cannot_be_used_is_dropped_and_counted_and_the_node_goes_on(drive, sweeps):
    robot = drive()
    robot.sweep(100.0, Cloud(np.full((9, 3), np.nan)))
    robot.sweep(101.0, sweeps[0])
    robot.wait_until(lambda: len(robot.clouds) == 1)
    robot.wait_until(lambda: values(robot.diagnostics).get("dropped: unusable sweep") == "1")


def test_what_was_merged_is_saved_and_forgotten_when_told_to(drive, sweeps, tmp_path):
    robot = drive(*MOUNTED, "-p", f"session_dir:={tmp_path}")
    assert "no sweep" in robot.call(Trigger, "sweep_node/save").message
    for number, cloud in enumerate(sweeps):
        robot.sweep(100.0 + number, cloud)
    robot.wait_until(lambda: len(robot.clouds) == 2)
    assert robot.call(Trigger, "sweep_node/save").success
    assert len(read_cloud(tmp_path / "cloud.ply")) == 2 * 36200
    assert read_tum(tmp_path / "poses.tum").stamps.tolist() == [100.0, 101.0]
    assert robot.call(Trigger, "sweep_node/reset").success
    assert "no sweep" in robot.call(Trigger, "sweep_node/save").message


def pieces(robot):
    return [conversions.piece_from_message(cloud) for cloud in robot.clouds]


def test_sweeps_that_a_later_one_moves_are_published_anew(drive, sweeps):
    # However little they are moved.
    robot = drive(*MOUNTED, "-p", "correction_distance:=0.0")
    for number, cloud in enumerate([*sweeps, sweeps[0]]):
        robot.sweep(100.0 + number, cloud)
    robot.wait_until(lambda: any(piece.number == 1 and piece.revision > 0 for piece in pieces(robot)))
    assert len({piece.source for piece in pieces(robot)}) == 1
    assert [piece.number for piece in pieces(robot) if piece.revision == 0] == [0, 1, 2]


def test_whoever_comes_late_gets_the_sweeps_before(drive, sweeps):
    robot = drive()
    robot.sweep(100.0, sweeps[0])
    robot.wait_until(lambda: robot.clouds)
    late = robot.collect(PointCloud2, "cloud")
    robot.wait_until(lambda: late)
    piece = conversions.piece_from_message(late[0])
    assert (piece.number, piece.revision) == (0, 1)
    assert len(conversions.cloud_from_message(late[0])) == len(sweeps[0])


def test_a_reset_takes_the_sweeps_back(drive, sweeps):
    robot = drive()
    robot.sweep(100.0, sweeps[0])
    robot.wait_until(lambda: robot.clouds)
    assert robot.call(Trigger, "sweep_node/reset").success
    robot.wait_until(lambda: len(robot.clouds) == 2)
    assert pieces(robot)[1].number == ALL_PIECES
    assert pieces(robot)[1].source == pieces(robot)[0].source


def test_scans_of_a_tilting_laser_become_sweeps(drive):
    pose = ",".join(f"{number:.3f}" for number in LASER_TILT_POSE)
    robot = drive("-p", f"laser_pose:=[{pose}]")
    joints, scans = robot.publisher(JointState, "joint_states"), robot.publisher(LaserScan, "scan_tilt")
    odom = robot.publisher(Odometry, "odom")
    recording = simulate(SimulationConfig(setup="sweeping", horizontal_every=9)).recording
    # The first two of the six sweeps, and the scan that ends the second.
    breaks = np.flatnonzero(np.diff([scan.stamp for scan in recording.scans_tilt]) > 1.0)
    last = int(breaks[1]) + 2
    end = recording.scans_tilt[last - 1].stamp + 1.0
    # Few enough for the queues, as all come at once.
    driven = range(0, int((recording.odometry.stamps < end).sum()), 5)
    tilted = range(0, int((recording.tilt_stamps < end).sum()), 5)
    matrices = recording.odometry.matrices()
    for index in driven:
        odom.publish(odometry(float(recording.odometry.stamps[index]), matrices[index]))
    for index in tilted:
        head = conversions.header(conversions.stamp_message(float(recording.tilt_stamps[index])), "")
        joints.publish(JointState(header=head, name=["tilt"], position=[float(recording.tilt_angles[index])]))
    told = {"received odom": len(driven), "received joint_states": len(tilted)}
    robot.wait_until(lambda: all(values(robot.diagnostics).get(key) == str(count) for key, count in told.items()))
    for scan in recording.scans_tilt[:last]:
        scans.publish(conversions.scan_to_message(scan))
    robot.wait_until(lambda: len(robot.clouds) == 2)
    assert values(robot.diagnostics).get("dropped: sweeps in which the robot moved") is None


def test_diagnostics_say_what_is_waited_for(drive):
    robot = drive()
    robot.wait_until(lambda: any("waiting for `/sweep`" in each.status[0].message for each in robot.diagnostics))
