# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Processes that are killed go on where they were, and what hinders that is said."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import LaserScan, PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from g2_recon.config import LocalizationConfig
from g2_recon.geometry import se2, se3
from g2_recon.geometry.cloud import Cloud, Piece
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.localization.localizer import Localizer
from g2_recon.nodes import conversions, journals
from g2_recon.nodes.localizer_node import LocalizerNode
from g2_recon.nodes.reconstruct_node import ReconstructNode
from g2_recon.nodes.ros import LATCHED
from g2_recon.reconstruction.collected_cloud import CollectedCloud
from g2_recon.recording.clouds import read_cloud
from g2_recon.recording.journal import Journal
from g2_recon.recording.sessions import read_session, write_session
from g2_recon.recording.trajectories import read_tum

ROOT = Path(__file__).parents[2]
MOUNTED = ("-p", "laser_pose:=[0.0,0.0,0.3,0.0,0.0,0.0]", "-p", "keyframe_distance:=0.1")
SMALL = ("-p", "clusters:=4", "-p", "rows:=5", "-p", "columns:=5")
WAY = [(0.15 * step - 1.0, 0.05 * step - 0.5, 0.1 * step) for step in range(12)]


@pytest.fixture
def robot(ros, tmp_path):
    """A session in tmp_path; `robot.start(node, *arguments)` starts its process, `robot.kill()` kills it.

    DDS takes 20 s to notice that a process was killed: each process has a namespace of its own.
    """
    harness = ros()
    harness.process = None
    harness.lives = 0

    def start(node, *arguments):
        harness.lives += 1
        harness.space = f"/life{harness.lives}"
        harness.node = f"{harness.space}/{node}"
        harness.diagnostics = []
        command = [sys.executable, "-m", f"g2_recon.nodes.{node}", "--ros-args", "-p", f"session_dir:={tmp_path}"]
        harness.process = subprocess.Popen(
            [*command, "-r", f"__ns:={harness.space}", *arguments],
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
        )
        harness.wait_until(lambda: harness.diagnostics, 60)

    def kill():
        harness.process.kill()
        harness.process.wait()

    def until_they_came(publish, *topics):
        """A node learns of a publisher later than that of it, and misses what is sent before: publish again."""

        def came():
            if len(harness.diagnostics) < 2:
                return False
            lacking = any(harness.value(f"received {topic}") == "0" for topic in topics)
            if lacking:
                harness.diagnostics.clear()
                publish()
            return not lacking

        harness.wait_until(came, 60)

    def note(message):
        if message.status[0].name == harness.node:
            harness.diagnostics.append(message)

    harness.observer.create_subscription(DiagnosticArray, "/diagnostics", note, 100)
    harness.start, harness.kill, harness.until_they_came = start, kill, until_they_came
    harness.value = lambda key: {pair.key: pair.value for pair in harness.diagnostics[-1].status[0].values}.get(key)
    yield harness
    if harness.process is not None:
        kill()


@pytest.fixture
def drive(robot, niche_scan):
    """`drive(first, last)` sends the scans of these steps of the way, and gives the poses that come back."""

    def go(first, last, *, later=0.0, look=niche_scan):
        poses = robot.collect(PoseWithCovarianceStamped, f"{robot.space}/pose")
        scans = robot.publisher(LaserScan, f"{robot.space}/scan")
        first_scan, *others = [look(100.0 + later + 0.2 * step, WAY[step]) for step in range(first, last)]
        robot.until_they_came(lambda: scans.publish(first_scan), "scan")
        for scan in others:
            scans.publish(scan)
        robot.wait_until(lambda: len(poses) == last - first, 60)
        return np.array([se2.from_se3(conversions.pose_matrix(pose.pose.pose)) for pose in poses])

    return go


def in_map(poses):
    return se2.relative(np.array(WAY[0]), np.array(poses))


def test_a_localizer_that_is_killed_goes_on_in_its_map_and_loses_no_scan(robot, drive, tmp_path):
    robot.start("localizer_node", *MOUNTED)
    drive(0, 5)
    robot.kill()
    robot.start("localizer_node", *MOUNTED)
    found = drive(5, 8)
    # 2 cm and 0.5 deg: noise-free scans, and a map with the errors of its own drive.
    np.testing.assert_allclose(found, in_map(WAY[5:8]), atol=0.02)
    robot.kill()
    robot.start("localizer_node", *MOUNTED)
    np.testing.assert_allclose(drive(8, 12), in_map(WAY[8:]), atol=0.02)
    trajectories = robot.collect(PathMessage, f"{robot.space}/trajectory", LATCHED)
    robot.wait_until(lambda: trajectories and len(trajectories[-1].poses) == 12)
    assert robot.call(Trigger, f"{robot.node}/save").success
    trajectory = read_tum(tmp_path / "trajectory.tum")
    np.testing.assert_allclose(trajectory.stamps, 100.0 + 0.2 * np.arange(12), atol=1e-6)
    np.testing.assert_allclose(trajectory.planar(), in_map(WAY), atol=0.02)
    assert len(read_session(tmp_path / "session.npz")) == 12


def test_wheels_lead_over_the_time_in_which_a_localizer_was_away(robot, niche_scan):
    """Without them, the robot would be looked for where it was, 4 m from where it is."""

    def life(first, way):
        robot.start("localizer_node", *MOUNTED)
        poses = robot.collect(PoseWithCovarianceStamped, f"{robot.space}/pose")
        wheels = robot.publisher(Odometry, f"{robot.space}/odom")
        scans = robot.publisher(LaserScan, f"{robot.space}/scan")

        def publish(step):
            stamp = first + 0.2 * step
            # So even the first scan comes before the first odometry.
            scans.publish(niche_scan(stamp, way[step]))
            message = Odometry(header=conversions.header(conversions.stamp_message(stamp + 0.01), "odom"))
            message.pose.pose = conversions.pose_message(se3.from_se2(way[step]))
            wheels.publish(message)

        robot.until_they_came(lambda: publish(0), "scan", "odom")
        for step in range(1, len(way)):
            publish(step)
        robot.wait_until(lambda: len(poses) == len(way), 60)
        robot.kill()
        return np.array([se2.from_se3(conversions.pose_matrix(pose.pose.pose)) for pose in poses])

    before = [(-2.0 + 0.1 * step, -1.5, 0.0) for step in range(3)]
    after = [(2.0 + 0.1 * step, 1.0, 3.0) for step in range(3)]
    for first, way in ((100.0, before), (110.0, after)):
        found = life(first, way)
        np.testing.assert_allclose(found, se2.relative(np.array(before[0]), np.array(way)), atol=0.02)


def test_a_localizer_that_comes_back_much_later_looks_for_its_place_in_its_map(robot, drive):
    robot.start("localizer_node", *MOUNTED)
    drive(0, 8)
    robot.kill()
    robot.start("localizer_node", *MOUNTED)
    # The robot has been carried.
    np.testing.assert_allclose(drive(1, 3, later=3600.0), in_map(WAY[1:3]), atol=0.02)


def test_in_a_map_that_stays_as_it_is_a_killed_localizer_knows_where_it_was(robot, drive, room_scan, tmp_path):
    """The room looks the same from both ends."""
    localizer = Localizer(LocalizationConfig(), np.eye(4))
    localizer.process(conversions.scan_from_message(room_scan(10.0, WAY[0])))
    write_session(tmp_path / "map.npz", localizer.session())
    arguments = (*MOUNTED, "-p", f"map:={tmp_path}/map.npz", "-p", "mode:=localization")
    robot.start("localizer_node", *arguments)
    given = PoseWithCovarianceStamped(header=Header(frame_id="map"))
    given.pose.pose = conversions.pose_message(se3.from_se2((0.0, 0.0, 0.0)))
    robot.publisher(PoseWithCovarianceStamped, f"{robot.space}/initialpose").publish(given)
    robot.wait_until(lambda: robot.value("received initialpose") == "1")
    np.testing.assert_allclose(drive(0, 3, look=room_scan), in_map(WAY[:3]), atol=0.02)
    robot.kill()
    robot.start("localizer_node", *arguments)
    np.testing.assert_allclose(drive(3, 4, look=room_scan), in_map(WAY[3:4]), atol=0.02)


def test_a_reset_forgets_what_was_gone_on_from_and_keeps_it_beside(robot, drive, tmp_path):
    robot.start("localizer_node", *MOUNTED)
    drive(0, 3)
    robot.kill()
    robot.start("localizer_node", *MOUNTED)
    assert robot.call(Trigger, f"{robot.node}/reset").success
    np.testing.assert_allclose(drive(3, 4), 0, atol=1e-9)
    assert Journal(tmp_path / "localizer.journal.before").damaged == 0


def test_a_recording_that_is_replayed_once_more_starts_a_new_map(robot, drive):
    robot.start("localizer_node", *MOUNTED)
    drive(0, 8)
    robot.kill()
    robot.start("localizer_node", *MOUNTED)
    np.testing.assert_allclose(drive(0, 2), in_map(WAY[:2]), atol=0.02)


def wall(seed) -> PointCloud2:
    rng = np.random.default_rng(seed)
    points = np.column_stack([np.full(200, 2.0), rng.uniform(-1, 1, (200, 2))])
    return conversions.cloud_to_message(Header(frame_id="map"), Cloud(points, np.zeros_like(points)))


def test_a_reconstruction_that_is_killed_has_all_clouds_again(robot, tmp_path):
    for number in range(2):
        robot.start("reconstruct_node", *SMALL)
        assert robot.value("points") == str(200 * number)
        robot.publisher(PointCloud2, f"{robot.space}/cloud").publish(wall(number))
        robot.wait_until(lambda number=number: robot.value("points") == str(200 * (number + 1)))
        robot.kill()
    robot.start("reconstruct_node", *SMALL)
    assert robot.call(Trigger, f"{robot.node}/save").success
    expected = np.concatenate([conversions.cloud_from_message(wall(number)).points for number in range(2)])
    np.testing.assert_array_equal(read_cloud(tmp_path / "cloud.ply").points, expected.astype(np.float32))


def told(harness, words) -> DiagnosticStatus:
    harness.wait_until(lambda: any(words in array.status[0].message for array in harness.diagnostics))
    return harness.diagnostics[-1].status[0]


@pytest.mark.parametrize(("node", "name"), [(LocalizerNode, "localizer.journal"), (ReconstructNode, "clouds.journal")])
def test_a_folder_that_cannot_be_written_is_said_and_the_node_goes_on_in_memory(ros, room_scan, tmp_path, node, name):
    (tmp_path / "file").write_text("")
    harness = ros("-p", f"session_dir:={tmp_path}/file", *(MOUNTED if node is LocalizerNode else SMALL))
    harness.add(node)
    harness.diagnostics = harness.collect(DiagnosticArray, "/diagnostics")
    status = told(harness, f"{tmp_path}/file/{name}: cannot be written: File exists; choose another folder")
    assert status.level == DiagnosticStatus.ERROR and "the node goes on in memory" in status.message
    if node is LocalizerNode:
        poses = harness.collect(PoseWithCovarianceStamped, "pose")
        harness.publisher(LaserScan, "scan").publish(room_scan(100.0))
        harness.wait_until(lambda: poses)


def test_a_disk_that_fills_up_is_said_and_the_node_goes_on_in_memory(ros, tmp_path, monkeypatch):
    harness = ros("-p", f"session_dir:={tmp_path}", *SMALL)
    harness.add(ReconstructNode)
    harness.diagnostics = harness.collect(DiagnosticArray, "/diagnostics")
    publisher = harness.publisher(PointCloud2, "cloud")
    publisher.publish(wall(0))
    harness.wait_until(lambda: (tmp_path / "clouds.journal").stat().st_size > 1000)

    def full(file, content, begin):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(os, "pwrite", full)
    publisher.publish(wall(1))
    told(harness, "cannot be written: No space left on device; choose another folder or make room")
    monkeypatch.undo()
    publisher.publish(wall(2))
    harness.wait_until(
        lambda: "600" in [pair.value for pair in harness.diagnostics[-1].status[0].values if pair.key == "points"]
    )
    journal = Journal(tmp_path / "clouds.journal")
    assert len(list(journal.records())) == 1
    journal.close()


def test_a_hostile_journal_is_counted_and_the_node_goes_on(ros, tmp_path):
    journal = Journal(tmp_path / "clouds.journal")
    for payload in (b"", b"\xff", b"\x05cloud" + bytes(3), b"\x05cloud" + b"\xff" * 200, b"\x03odd"):
        journal.append(payload)
    journal.close()
    harness = ros("-p", f"session_dir:={tmp_path}", *SMALL)
    node = harness.add(ReconstructNode)
    assert sum(node.drops.values()) == 5
    diagnostics = harness.collect(DiagnosticArray, "/diagnostics")
    harness.publisher(PointCloud2, "cloud").publish(wall(0))
    harness.wait_until(
        lambda: diagnostics and ("points", "200") in [(p.key, p.value) for p in diagnostics[-1].status[0].values]
    )


def test_clouds_that_were_replaced_are_left_out_of_the_journal_and_nothing_is_lost(ros, tmp_path, monkeypatch):
    monkeypatch.setattr(journals, "_FEW_BYTES", 0)
    path = tmp_path / "clouds.journal"

    def piece(number, revision, seed):
        cloud = conversions.cloud_from_message(wall(seed))
        return conversions.cloud_to_message(Header(frame_id="map"), cloud, Piece(7, number, revision))

    harness = ros("-p", f"session_dir:={tmp_path}", *SMALL)
    node = harness.add(ReconstructNode)
    publisher = harness.publisher(PointCloud2, "cloud")
    publisher.publish(wall(0))
    publisher.publish(piece(0, 0, 1))
    harness.wait_until(lambda: len(node._collected) == 400)
    one = path.stat().st_size / 2
    for revision in range(1, 13):
        publisher.publish(piece(0, revision, 10 + revision))
        if revision % 4 == 0:
            publisher.publish(piece(revision, 0, 40 + revision))
    harness.wait_until(lambda: node.received["cloud"] == 17)
    # Five of them count; what was replaced after the first copy was begun may be left until the next one.
    harness.wait_until(lambda: path.stat().st_size < 12 * one)
    publisher.publish(piece(20, 0, 30))
    harness.wait_until(lambda: len(node._collected) == 1200)
    expected = node._collected.cloud().points
    collected = CollectedCloud()
    for payload in node._journal.journal.records():
        message = deserialize_message(payload[1 + payload[0] :], PointCloud2)
        collected.add(conversions.cloud_from_message(message), conversions.piece_from_message(message), topic="cloud")
    np.testing.assert_array_equal(collected.cloud().points, expected)


def test_a_registrar_that_is_killed_still_moves_the_points_of_its_life_before(robot, room_scan):
    """Whoever collected them then has each point once, where the keyframes have the robot now."""
    collected = CollectedCloud()
    mounted = ("-p", f"laser_pose:=[0.0,0.0,0.6,0.0,{-np.pi / 2},0.0]")

    def collect(message):
        collected.add(
            conversions.usable_points(conversions.cloud_from_message(message)), conversions.piece_from_message(message)
        )

    def live(first, last, keyframe_x):
        """Scans of these seconds, from 1 m further each, and a first keyframe that turned out to be elsewhere."""
        robot.start("registrar_node", *mounted)
        robot.observer.create_subscription(PointCloud2, f"{robot.space}/cloud", collect, 1000)
        poses = robot.publisher(PoseWithCovarianceStamped, f"{robot.space}/pose")
        scans = robot.publisher(LaserScan, f"{robot.space}/scan_vertical")
        path = robot.publisher(PathMessage, f"{robot.space}/trajectory", LATCHED)

        def publish(second):
            for step in range(3):
                head = Header(stamp=conversions.stamp_message(100.0 + second + 0.2 * step), frame_id="map")
                poses.publish(conversions.planar_pose_message(head, (float(second), 0.0, 0.0), np.eye(3)))
            scans.publish(room_scan(100.1 + second))

        robot.until_they_came(lambda: publish(first), "pose", "scan_vertical")
        for second in range(first + 1, last):
            publish(second)
        robot.wait_until(lambda: robot.value("registered scans") == str(last))
        keyframe = Trajectory(np.array([100.0]), np.array([[keyframe_x, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0, 1.0]]))
        path.publish(conversions.path_message(Header(frame_id="map"), keyframe))
        per_scan = len(scan_points)
        robot.wait_until(lambda: np.array_equal(seconds_seen(), np.arange(last) + keyframe_x), 20)
        assert len(collected) == last * per_scan
        robot.kill()

    def seconds_seen():
        return np.unique(np.round(collected.cloud().points[:, 0], 4))

    scan_points = conversions.scan_from_message(room_scan(100.0)).points(range_min=0.2, range_max=30.0)[1]
    live(0, 3, 0.0)
    live(3, 5, 0.5)


def test_a_registrar_that_was_reset_does_not_go_on_where_it_was(robot, room_scan):
    mounted = ("-p", f"laser_pose:=[0.0,0.0,0.6,0.0,{-np.pi / 2},0.0]")
    robot.start("registrar_node", *mounted)
    poses = robot.publisher(PoseWithCovarianceStamped, f"{robot.space}/pose")
    scans = robot.publisher(LaserScan, f"{robot.space}/scan_vertical")

    def publish():
        for stamp in (100.0, 100.2):
            head = Header(stamp=conversions.stamp_message(stamp), frame_id="map")
            poses.publish(conversions.planar_pose_message(head, (0.0, 0.0, 0.0), np.eye(3)))
        scans.publish(room_scan(100.1))

    robot.until_they_came(publish, "pose", "scan_vertical")
    robot.wait_until(lambda: robot.value("registered scans") == "1")
    assert robot.call(Trigger, f"{robot.node}/reset").success
    robot.kill()
    robot.start("registrar_node", *mounted)
    assert robot.value("registered scans") == "0"
