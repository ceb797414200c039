# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Whatever the types of messages allow is sent to running nodes: none dies, none says NaN, each drop is counted."""

from __future__ import annotations

import array
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.msg import Path as PathMessage
from sensor_msgs.msg import LaserScan, PointCloud2, PointField
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from g2_recon.geometry.cloud import ALL_PIECES, Cloud, Piece
from g2_recon.nodes import conversions
from g2_recon.nodes.localizer_node import LocalizerNode
from g2_recon.nodes.reconstruct_node import ReconstructNode
from g2_recon.nodes.registrar_node import RegistrarNode
from g2_recon.nodes.ros import LATCHED

MOUNTED = (
    *("-p", "localizer_node:laser_pose:=[0.0,0.0,0.3,0.0,0.0,0.0]"),
    *("-p", f"registrar_node:laser_pose:=[0.0,0.0,0.6,0.0,{-math.pi / 2},0.0]"),
    *("-p", "reconstruct_node:rebuild:=continuous"),
    # Poses and maps that the localizer makes of fuzzed scans would reset the registrar at any moment.
    *("-r", "registrar_node:pose:=told_pose", "-r", "registrar_node:trajectory:=told_trajectory"),
)
# Without shrinking, which would take minutes with running nodes.
FUZZED = settings(
    max_examples=60,
    deadline=None,
    phases=(Phase.explicit, Phase.generate),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)

number = st.floats(width=32)
stamps = st.builds(Time, sec=st.integers(-(2**31), 2**31 - 1), nanosec=st.integers(0, 2**32 - 1)) | st.builds(
    Time, sec=st.integers(100, 130), nanosec=st.integers(0, 10**9 - 1)
)
frames = st.sampled_from(["map", "laser", ""]) | st.text(
    st.characters(min_codepoint=1, max_codepoint=0x2FFF), max_size=5
)
headers = st.builds(Header, stamp=stamps, frame_id=frames)
ranges = st.lists(number | st.floats(0.5, 6.0, width=32), max_size=40) | st.lists(
    st.floats(1.0, 6.0, width=32), min_size=181, max_size=181
)


@st.composite
def scans(draw) -> LaserScan:
    """A laser scan; half of them are plausible but for one thing or two."""
    message = LaserScan(
        header=draw(headers),
        angle_min=-math.pi / 2,
        angle_max=math.pi / 2,
        angle_increment=math.pi / 180,
        range_min=0.1,
        range_max=30.0,
        ranges=draw(ranges),
    )
    for name in draw(st.sets(st.sampled_from(sorted(NUMBERS)), max_size=2) | st.just(NUMBERS)):
        setattr(message, name, draw(number))
    return message


NUMBERS = {"angle_min", "angle_max", "angle_increment", "time_increment", "scan_time", "range_min", "range_max"}


@st.composite
def odometries(draw) -> Odometry:
    """Odometry; most of it is plausible but for a number or two."""
    message = Odometry(header=draw(headers), child_frame_id=draw(frames))
    position, turn = message.pose.pose.position, message.pose.pose.orientation
    position.x, position.y, turn.w = draw(st.floats(-1, 1)), draw(st.floats(-1, 1)), 1.0
    for name in draw(
        st.sets(st.sampled_from(["position.x", "position.z", "orientation.y", "orientation.w"]), max_size=2)
    ):
        part, coordinate = name.split(".")
        setattr(getattr(message.pose.pose, part), coordinate, draw(st.floats()))
    return message


@st.composite
def clouds(draw) -> PointCloud2:
    """A cloud: points and where they were seen from, of a piece, with a field or number changed; or any bytes."""
    rows = draw(st.lists(st.tuples(*[number | st.floats(-3, 3, width=32)] * 6), max_size=30))
    columns = np.array(rows, float).reshape(-1, 6)
    piece = Piece(*draw(st.tuples(st.integers(0, 2), st.integers(0, 3) | st.integers(0, 2**32 - 1), st.integers(0, 3))))
    with np.errstate(over="ignore"):
        message = conversions.cloud_to_message(
            draw(headers), Cloud(columns[:, :3], columns[:, 3:]), draw(st.none() | st.just(piece))
        )
    if draw(st.booleans()):
        message.header.frame_id = "map"
    if draw(st.booleans()):
        return message
    for name in draw(st.sets(st.sampled_from(["height", "width", "point_step", "row_step"]))):
        setattr(message, name, draw(st.integers(0, 2**32 - 1) | st.integers(0, 40)))
    if draw(st.booleans()):
        message.data = array.array("B", draw(st.binary(max_size=60)))
    if draw(st.booleans()):
        name = draw(st.sampled_from(["x", "vy", "source", "rgb", ""]))
        message.fields = [
            *message.fields,
            PointField(name=name, offset=draw(st.integers(0, 2**32 - 1)), datatype=draw(st.integers(0, 255)), count=1),
        ]
    message.is_bigendian = draw(st.booleans())
    return message


@pytest.fixture(scope="module")
def robot(module_ros_with):
    """The nodes of a robot, and what they say."""
    harness = module_ros_with(*MOUNTED)
    harness.localizer = harness.add(LocalizerNode)
    harness.registrar = harness.add(RegistrarNode)
    harness.reconstruction = harness.add(ReconstructNode)
    harness.to = {
        topic: harness.publisher(kind, topic)
        for kind, topic in (
            (LaserScan, "scan"),
            (LaserScan, "scan_vertical"),
            (Odometry, "odom"),
            (PointCloud2, "cloud"),
        )
    }
    harness.to["pose"] = harness.publisher(PoseWithCovarianceStamped, "told_pose")
    harness.said = {
        topic: harness.collect(kind, topic, qos)
        for kind, topic, qos in (
            *((PoseWithCovarianceStamped, "pose", 1000), (PathMessage, "trajectory", LATCHED)),
            *((OccupancyGrid, "map", LATCHED), (PointCloud2, "point_map", LATCHED), (MarkerArray, "mesh", LATCHED)),
        )
    }
    return harness


def send(robot, topic, node, messages, accounted):
    """Send messages to a node; each must be used, wait or be counted as dropped."""
    before = node.received[topic]
    for message in messages:
        robot.to[topic].publish(message)
    # A node beside may publish on the topic, too.
    robot.wait_until(lambda: node.received[topic] >= before + len(messages))
    robot.wait_until(lambda: accounted() == node.received[topic] or not robot.alive())
    assert robot.alive()


def dropped(node, *words):
    return sum(count for reason, count in node.drops.items() if any(word in reason for word in words))


def finite(*numbers) -> bool:
    return bool(np.isfinite(numbers).all())


def place(pose) -> tuple[float, ...]:
    at, turn = pose.position, pose.orientation
    return at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w


def test_any_scans_and_odometry_make_finite_poses_and_maps(robot, room_scan):
    node = robot.localizer
    robot.to["scan"].publish(room_scan(100.0))
    robot.wait_until(lambda: node.received["scan"])

    @FUZZED
    @given(st.lists(scans(), min_size=1, max_size=4), st.lists(odometries(), max_size=3))
    def run(scan_messages, odometry_messages):
        send(robot, "odom", node, odometry_messages, lambda: node.received["odom"])
        used = lambda: node.figures()["localized scans"] + node.figures()["scans that wait for odometry"]  # noqa: E731
        send(robot, "scan", node, scan_messages, lambda: used() + dropped(node, "scan"))

    run()
    assert node.figures()["localized scans"] > 0
    robot.wait_until(lambda: robot.said["trajectory"] and robot.said["point_map"])
    for message in robot.said["pose"]:
        assert finite(*place(message.pose.pose), *message.pose.covariance)
    for message in robot.said["trajectory"]:
        assert all(finite(*place(pose.pose)) for pose in message.poses)
    for message in robot.said["point_map"]:
        assert np.isfinite(conversions.cloud_from_message(message).points).all()
    for message in robot.said["map"]:
        assert finite(message.info.resolution, *place(message.info.origin))


def test_any_vertical_scans_and_poses_make_finite_clouds(robot, room_scan):
    node, seen = robot.registrar, []
    robot.observer.create_subscription(PointCloud2, "cloud", seen.append, 1000)
    for stamp in (100.0, 100.2):
        head = conversions.header(conversions.stamp_message(stamp), "map")
        robot.to["pose"].publish(conversions.planar_pose_message(head, np.zeros(3), np.eye(3)))
    robot.to["scan_vertical"].publish(room_scan(100.1))
    robot.wait_until(lambda: node.received["scan_vertical"])

    def accounted():
        registrar = node.figures()
        later = registrar.get("scans that wait for a pose", 0)
        lost = sum(count for key, count in registrar.items() if key.startswith("dropped: scan"))
        return registrar["registered scans"] + later + lost + dropped(node, "scan")

    @FUZZED
    @given(st.lists(scans(), min_size=1, max_size=4), st.lists(odometries(), max_size=4))
    def run(scan_messages, pose_messages):
        poses = [PoseWithCovarianceStamped(header=each.header, pose=each.pose) for each in pose_messages]
        send(robot, "pose", node, poses, lambda: node.received["pose"])
        send(robot, "scan_vertical", node, scan_messages, accounted)

    run()
    assert node.figures()["registered scans"] > 0
    robot.wait_until(lambda: seen)
    for message in seen:
        piece = conversions.piece_from_message(message)
        if piece is None or piece.number != ALL_PIECES:
            assert np.isfinite(conversions.cloud_from_message(message).points).all()


def test_any_clouds_make_finite_meshes(robot):
    node = robot.reconstruction

    @FUZZED
    @given(st.lists(clouds(), min_size=1, max_size=5))
    def run(messages):
        send(robot, "cloud", node, messages, lambda: node.figures()["accepted clouds"] + dropped(node, "cloud"))

    run()
    assert node.figures()["accepted clouds"] > 0
    for marker in (marker for message in robot.said["mesh"] for marker in message.markers):
        assert all(finite(point.x, point.y, point.z) for point in marker.points)
