# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid as GridMessage
from nav_msgs.msg import Path
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Trigger

from g2_recon.config import LocalizationConfig
from g2_recon.errors import InputError
from g2_recon.geometry import se2, se3
from g2_recon.localization.localizer import Localizer
from g2_recon.nodes import conversions
from g2_recon.nodes.localizer_node import LocalizerNode
from g2_recon.nodes.ros import LATCHED
from g2_recon.recording.sessions import read_session, write_session

MOUNTED = ("-p", "laser_pose:=[0.0,0.0,0.3,0.0,0.0,0.0]")
WAY = [(0.25 * step - 1.0, 0.1 * step - 0.5, 0.1 * step) for step in range(9)]


def planar(message: PoseWithCovarianceStamped) -> np.ndarray:
    return se2.from_se3(conversions.pose_matrix(message.pose.pose))


@pytest.fixture
def start(ros, niche_scan):
    """`start(*arguments)` starts the node and gives the test's end of its topics."""

    def started(*arguments):
        harness = ros(*MOUNTED, *arguments)
        harness.add(LocalizerNode)
        harness.scans = harness.publisher(LaserScan, "scan")
        harness.poses = harness.collect(PoseWithCovarianceStamped, "pose")

        def drive(first, way):
            for step, pose in enumerate(way):
                harness.scans.publish(niche_scan(first + 0.1 * step, pose))
            harness.wait_until(lambda: len(harness.poses) >= harness.expected + len(way), 60)
            harness.expected += len(way)

        harness.expected = 0
        harness.drive = drive
        return harness

    return started


@pytest.fixture
def map_of(tmp_path):
    """`map_of(look, way)` is the file of a session of scans by `look` on a way, whose first pose is the origin."""

    def write(look, way):
        localizer = Localizer(LocalizationConfig(keyframe_distance=0.1), np.eye(4))
        for step, pose in enumerate(way):
            localizer.process(conversions.scan_from_message(look(100.0 + 0.1 * step, pose)))
        write_session(tmp_path / "map.npz", localizer.session())
        return tmp_path / "map.npz"

    return write


@pytest.fixture
def map_file(map_of, niche_scan):
    return map_of(niche_scan, WAY)


def in_map(poses):
    return se2.relative(np.array(WAY[0]), np.array(poses))


def test_a_saved_map_is_localized_in_and_stays_as_it_is(map_file, start, tmp_path):
    room = start("-p", f"map:={map_file}", "-p", "mode:=localization", "-p", f"session_dir:={tmp_path}")
    grids = room.collect(GridMessage, "map", LATCHED)
    back = [(x, y, yaw + 2.0) for x, y, yaw in WAY[::-1]]
    room.drive(500.0, back)
    # 2 cm and 0.5 deg: noise-free scans, and a map with the errors of its own drive.
    np.testing.assert_allclose([planar(pose)[:2] for pose in room.poses], in_map(back)[:, :2], atol=0.02)
    turned = se2.wrap_angle(np.array([planar(pose)[2] for pose in room.poses]) - in_map(back)[:, 2])
    np.testing.assert_allclose(turned, 0, atol=math.radians(0.5))
    room.wait_until(lambda: grids and 100 in grids[-1].data)
    trajectories = room.collect(Path, "trajectory", LATCHED)
    count = len(read_session(map_file))
    room.wait_until(lambda: trajectories and len(trajectories[-1].poses) == count)
    assert room.call(Trigger, "localizer_node/save").success
    np.testing.assert_array_equal(read_session(tmp_path / "session.npz").poses, read_session(map_file).poses)


def test_a_saved_map_is_gone_on_in(map_file, start, tmp_path):
    room = start("-p", f"map:={map_file}", "-p", f"session_dir:={tmp_path}", "-p", "keyframe_distance:=0.1")
    way = [(1.5, 0.1 * step, 0.0) for step in range(8)]
    room.drive(500.0, way)
    np.testing.assert_allclose([planar(pose)[:2] for pose in room.poses], in_map(way)[:, :2], atol=0.02)
    assert room.call(Trigger, "localizer_node/save").success
    before, after = read_session(map_file), read_session(tmp_path / "session.npz")
    assert len(after) > len(before)
    np.testing.assert_allclose(after.poses[: len(before)], before.poses, atol=0.02)


def test_an_initial_pose_tells_the_place_in_a_room_that_looks_the_same_from_both_ends(start, map_of, room_scan):
    here = (0.5, 0.3, 0.0)
    room = start("-p", f"map:={map_of(room_scan, [here])}", "-p", "mode:=localization")
    diagnostics = room.collect(DiagnosticArray, "/diagnostics")
    room.scans.publish(room_scan(500.0, here))
    room.wait_until(lambda: room.poses, seconds=60)
    assert room.poses[-1].pose.covariance[0] > 100
    room.wait_until(lambda: any("looking for the place" in d.status[0].message for d in diagnostics))
    message = PoseWithCovarianceStamped()
    message.header.frame_id = "map"
    message.pose.pose = conversions.pose_message(se3.from_se2((0.3, -0.2, 0.1)))
    room.publisher(PoseWithCovarianceStamped, "initialpose").publish(message)
    room.wait_until(lambda: any("initialpose" in pair.key for d in diagnostics for pair in d.status[0].values))
    room.scans.publish(room_scan(500.1, here))
    room.wait_until(lambda: len(room.poses) == 2)
    np.testing.assert_allclose(planar(room.poses[-1]), 0, atol=0.02)
    assert room.poses[-1].pose.covariance[0] < 0.01


def test_a_file_that_is_no_session_ends_the_node_with_a_reason(ros, tmp_path):
    (tmp_path / "session.npz").write_bytes(b"PK but no more")
    harness = ros(*MOUNTED, "-p", f"map:={tmp_path}/session.npz")
    with pytest.raises(InputError, match=r"session\.npz: is no sound NPZ file"):
        harness.add(LocalizerNode)
