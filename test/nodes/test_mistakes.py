# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What a newcomer does wrong is told by the diagnostics, in words that say what to do."""

from __future__ import annotations

import math

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import LaserScan, PointCloud2

from g2_recon.geometry import se3
from g2_recon.nodes import conversions, stage_node
from g2_recon.nodes.localizer_node import LocalizerNode
from g2_recon.nodes.reconstruct_node import ReconstructNode
from g2_recon.nodes.registrar_node import RegistrarNode

LEVEL = ("-p", "laser_pose:=[0.0,0.0,0.3,0.0,0.0,0.0]")
UPRIGHT = ("-p", f"laser_pose:=[0.0,0.0,0.6,0.0,{-math.pi / 2},0.0]")
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.fixture
def start(ros, monkeypatch):
    """`start(node, *arguments)` starts a node that tells ten times a second how it is, and listens to it."""
    monkeypatch.setattr(stage_node, "_PERIOD_S", 0.1)

    def started(node, *arguments):
        harness = ros(*arguments)
        harness.add(node)
        harness.diagnostics = harness.collect(DiagnosticArray, "/diagnostics")
        harness.said = lambda: harness.diagnostics[-1].status[0].message if harness.diagnostics else ""
        harness.value = lambda key: (
            {pair.key: pair.value for pair in harness.diagnostics[-1].status[0].values}.get(key)
            if harness.diagnostics
            else None
        )
        harness.wait_for = lambda words: harness.wait_until(lambda: words in harness.said(), seconds=30)
        harness.offer = lambda kind, topic, qos=10: harness.observer.create_publisher(kind, topic, qos)
        return harness

    return started


def odometry(stamp, pose):
    message = Odometry()
    message.header.stamp = conversions.stamp_message(stamp)
    message.pose.pose = conversions.pose_message(se3.from_se2(pose))
    return message


def test_for_a_wrong_topic_the_right_one_is_named(start):
    robot = start(LocalizerNode, *LEVEL)
    robot.offer(LaserScan, "/base_scan")
    robot.offer(LaserScan, "/rear")
    robot.wait_for(
        "waiting for `/scan`: no publisher; there is `/base_scan` (and `/rear`) with LaserScan: "
        "remap with -r scan:=/base_scan"
    )


def test_in_a_namespace_the_topic_outside_of_it_is_named(start):
    robot = start(LocalizerNode, *LEVEL, "-r", "__ns:=/robot1")
    robot.offer(LaserScan, "/scan")
    robot.wait_for(
        "waiting for `/robot1/scan`: no publisher; there is `/scan` with LaserScan: remap with -r scan:=/scan"
    )


def test_the_other_laser_is_no_replacement(start):
    robot = start(LocalizerNode, *LEVEL)
    robot.offer(LaserScan, "/scan_vertical")
    robot.wait_until(lambda: len(robot.diagnostics) >= 5)
    assert robot.said() == "waiting for `/scan`: no publisher"


def test_a_topic_of_another_type_is_told(start):
    robot = start(LocalizerNode, *LEVEL)
    # One participant cannot have two types of one topic.
    other = rclpy.Context()
    rclpy.init(context=other)
    try:
        lidar = rclpy.create_node("lidar", context=other)
        lidar.create_publisher(PointCloud2, "/scan", 10)
        robot.wait_for(
            "publisher of `/scan` (/lidar) sends sensor_msgs/msg/PointCloud2, not sensor_msgs/msg/LaserScan: "
            "remap one of the two topics"
        )
        lidar.destroy_node()
    finally:
        rclpy.shutdown(context=other)


@pytest.mark.parametrize(
    ("node", "kind", "topic"),
    [(ReconstructNode, PointCloud2, "cloud"), (RegistrarNode, PoseWithCovarianceStamped, "pose")],
)
def test_a_publisher_with_a_quality_of_service_that_does_not_fit_is_named(start, room_scan, node, kind, topic):
    robot = start(node, *(UPRIGHT if node is RegistrarNode else ()))
    if node is RegistrarNode:
        robot.publisher(LaserScan, "scan_vertical").publish(room_scan(100.0))
    robot.offer(kind, topic, BEST_EFFORT)
    robot.wait_for(
        f"publisher of `/{topic}` (/observer) offers best effort, reliable asked: set its reliability to reliable"
    )


def test_missing_odometry_is_told(start, room_scan):
    robot = start(LocalizerNode, *LEVEL)
    robot.offer(Odometry, "/wheel_odom")
    robot.publisher(LaserScan, "scan").publish(room_scan(100.0))
    robot.wait_for(
        "no odometry: waiting for `/odom`: no publisher; there is `/wheel_odom` with Odometry: remap with "
        "-r odom:=/wheel_odom; scans are matched without it; if there is none, set use_odometry to false"
    )


def test_where_no_odometry_is_asked_for_none_is_missing(start, room_scan):
    robot = start(LocalizerNode, *LEVEL, "-p", "use_odometry:=false")
    robot.publisher(LaserScan, "scan").publish(room_scan(100.0))
    robot.wait_for("running")
    assert robot.diagnostics[-1].status[0].level == DiagnosticStatus.OK


def test_odometry_that_stops_is_told(start, room_scan):
    robot = start(LocalizerNode, *LEVEL)
    robot.publisher(Odometry, "odom").publish(odometry(100.0, (0, 0, 0)))
    scans = robot.publisher(LaserScan, "scan")
    for stamp in (100.0, 103.0):
        scans.publish(room_scan(stamp))
    robot.wait_for("no odometry since 100.0 s: `/odom` has stopped or comes late")


def test_a_laser_that_falls_silent_is_told(start, room_scan):
    robot = start(LocalizerNode, *LEVEL)
    robot.publisher(LaserScan, "scan").publish(room_scan(100.0))
    robot.wait_for("`/scan` has stopped: nothing came for ")


def test_the_mounting_of_swapped_lasers_tells_that_they_are(start, room_scan):
    robot = start(LocalizerNode, *UPRIGHT, "-p", "use_odometry:=false")
    robot.publisher(LaserScan, "scan").publish(room_scan(100.0))
    robot.wait_for("the laser of `scan` stands upright, 90 deg from level: exchange it with that of `scan_vertical`")


def test_a_level_laser_for_vertical_scans_is_told(start, room_scan):
    robot = start(RegistrarNode, *LEVEL)
    robot.publisher(PoseWithCovarianceStamped, "pose").publish(
        PoseWithCovarianceStamped(header=conversions.header(conversions.stamp_message(100.0), "map"))
    )
    robot.publisher(LaserScan, "scan_vertical").publish(room_scan(100.0))
    robot.wait_for("the laser of `scan_vertical` lies level, tilted by 0 deg only: exchange it with that of `scan`")


def test_scans_across_a_corridor_instead_of_along_it_contradict_the_wheels(start, room_scan):
    robot = start(LocalizerNode, *LEVEL)
    odom, scans = robot.publisher(Odometry, "odom"), robot.publisher(LaserScan, "scan")
    for step in range(60):
        odom.publish(odometry(100.0 + 0.2 * step, (0.1 * step, 0, 0)))
        scans.publish(room_scan(100.0 + 0.2 * step))
    robot.wait_for("of the last metres: perhaps both lasers are swapped")


def test_poses_that_do_not_come_are_told_with_the_time(start, room_scan):
    robot = start(RegistrarNode, *UPRIGHT)
    head = conversions.header(conversions.stamp_message(10.1), "map")
    robot.publisher(PoseWithCovarianceStamped, "pose").publish(
        conversions.planar_pose_message(head, (0, 0, 0), [[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    )
    robot.publisher(LaserScan, "scan_vertical").publish(room_scan(12.3))
    robot.wait_for("no pose yet at 12.3 s, the newest is of 10.1 s")


def test_simulated_time_without_a_clock_is_told(start):
    robot = start(LocalizerNode, *LEVEL, "-p", "use_sim_time:=true")
    robot.wait_for("use_sim_time is true, but `/clock` has no publisher: replay with a clock (`ros2 bag play --clock`")


def test_what_is_missing_is_also_logged_once(start):
    robot = start(LocalizerNode, *LEVEL)
    log = robot.collect(Log, "/rosout")
    robot.wait_until(lambda: len(robot.diagnostics) >= 8)
    assert [line.msg for line in log if "waiting for" in line.msg] == ["waiting for `/scan`: no publisher"]


def test_rates_ages_and_memory_are_told(start, room_scan):
    robot = start(LocalizerNode, *LEVEL)
    scans = robot.publisher(LaserScan, "scan")
    for step in range(50):
        scans.publish(room_scan(100.0 + 0.1 * step))
    robot.wait_until(lambda: robot.value("received scan") == "50" and robot.value("beams that fit the map"))
    assert float(robot.value("rate of scan").removesuffix(" Hz")) > 0
    assert float(robot.value("silence of scan").removesuffix(" s")) < 10
    assert robot.value("age of scan") == "its stamps are of another clock"
    assert float(robot.value("memory").removesuffix(" MB")) > 30
    assert robot.value("beams that fit the map").endswith("%")
