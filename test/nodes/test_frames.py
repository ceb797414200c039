# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Frames and TF; tf2, which the package index does not hold, is played by a stand-in of the parts that are used."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from sensor_msgs.msg import LaserScan

from g2_recon.geometry import se2, se3
from g2_recon.nodes import conversions
from g2_recon.nodes import ros as ros_of_nodes
from g2_recon.nodes.localizer_node import LocalizerNode

MOUNTED = ("-p", "laser_pose:=[0.0,0.0,0.3,0.0,0.0,0.0]")


@pytest.fixture
def tf(monkeypatch):
    """What TF knows, by target and source frame, and what was sent to it."""
    stub = SimpleNamespace(known={}, sent=[])

    class Buffer:
        def lookup_transform(self, target, source, time):
            if (target, source) not in stub.known:
                raise LookupError
            return conversions.transform_message(time.to_msg(), target, source, stub.known[target, source])

    monkeypatch.setattr(
        ros_of_nodes,
        "tf2_ros",
        SimpleNamespace(
            Buffer=Buffer,
            TransformListener=lambda buffer, node: None,
            TransformBroadcaster=lambda node: SimpleNamespace(sendTransform=stub.sent.append),
            TransformException=LookupError,
        ),
    )
    return stub


@pytest.fixture
def start(ros, room_scan):
    """`start(*arguments)` starts the localizer and gives the test's end of its topics."""

    def started(*arguments):
        harness = ros(*arguments)
        harness.node = harness.add(LocalizerNode)
        scans, odom = harness.publisher(LaserScan, "scan"), harness.publisher(Odometry, "odom")
        harness.poses = harness.collect(PoseWithCovarianceStamped, "pose")

        def drive(stamp, pose, wheels=None):
            if wheels is not None:
                message = Odometry(header=conversions.header(conversions.stamp_message(stamp), "odom"))
                message.pose.pose = conversions.pose_message(se3.from_se2(wheels))
                odom.publish(message)
                harness.wait_until(lambda: harness.node.inputs["odom"].newest_stamp == pytest.approx(stamp))
            expected = len(harness.poses) + 1
            scans.publish(room_scan(stamp, pose))
            harness.wait_until(lambda: len(harness.poses) == expected)

        harness.drive = drive
        return harness

    return started


def test_map_to_odom_is_sent_and_never_map_to_the_robot(tf, start):
    robot = start(*MOUNTED)
    robot.drive(100.0, (0, 0, 0), wheels=(5, 1, 0.5))
    robot.drive(100.1, (0.2, 0, 0), wheels=(5.2, 1, 0.5))
    assert {(sent.header.frame_id, sent.child_frame_id) for sent in tf.sent} == {("map", "odom")}
    T_map_odom = conversions.transform_matrix(tf.sent[-1].transform)
    T_map_base = T_map_odom @ se3.from_se2((5.2, 1, 0.5))
    # 2 cm and 0.5 deg, as of the pose itself.
    np.testing.assert_allclose(se2.from_se3(T_map_base), (0.2, 0, 0), atol=0.02)
    assert tf.sent[-1].header.stamp == robot.poses[-1].header.stamp


def test_without_odometry_nothing_is_sent(tf, start):
    start(*MOUNTED).drive(100.0, (0, 0, 0))
    assert tf.sent == []


def test_publish_tf_turns_it_off_and_on(tf, start):
    robot = start(*MOUNTED, "-p", "publish_tf:=false")
    robot.drive(100.0, (0, 0, 0), wheels=(0, 0, 0))
    assert tf.sent == []
    assert robot.node.set_parameters([Parameter("publish_tf", value=True)])[0].successful
    robot.drive(100.1, (0, 0, 0), wheels=(0, 0, 0))
    assert len(tf.sent) == 1


def test_the_prefix_goes_before_all_frames_that_are_parameters(tf, start):
    robot = start(*MOUNTED, "-p", "frame_prefix:=robot1/")
    robot.drive(100.0, (0, 0, 0), wheels=(0, 0, 0))
    assert robot.poses[0].header.frame_id == "robot1/map"
    assert (tf.sent[0].header.frame_id, tf.sent[0].child_frame_id) == ("robot1/map", "robot1/odom")


@pytest.mark.parametrize(
    ("arguments", "frames"),
    [
        ((), ("base_link", "laser")),
        (("-p", "frame_prefix:=robot1/"), ("robot1/base_link", "laser")),
        (("-p", "frame_prefix:=robot1/"), ("robot1/base_link", "robot1/laser")),
    ],
)
def test_the_pose_of_the_laser_comes_from_tf_with_or_without_the_prefix(tf, start, arguments, frames):
    tf.known[frames] = se3.from_xyz_rpy((0.5, 0, 0.3, 0, 0, 0))
    robot = start(*(arguments or ("-p", "use_odometry:=true")))
    robot.drive(100.0, (0, 0, 0))
    assert len(robot.poses) == 1


def test_without_tf_all_but_transforms_works(start):
    robot = start(*MOUNTED)
    robot.drive(100.0, (0, 0, 0), wheels=(0, 0, 0))
    assert robot.poses[0].header.frame_id == "map"
