# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Robots and the merger as processes that are cut off, killed and started anew: nothing recorded is missing."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import LaserScan, PointCloud2
from std_msgs.msg import UInt8MultiArray, UInt32MultiArray

from g2_recon.geometry.scan import Scan
from g2_recon.nodes import conversions
from g2_recon.nodes.ros import LATCHED, sensor_qos
from g2_recon.reconstruction.collected_cloud import CollectedCloud

ROOT = Path(__file__).parents[2]
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
# A robot keeps a journal of its keyframes, and no message for those that are not there.
ROBOT = """
import sys
from g2_recon.nodes.localizer_node import LocalizerNode
from g2_recon.nodes.registrar_node import RegistrarNode
from g2_recon.nodes.ros import run_together

sys.exit(run_together([LocalizerNode, RegistrarNode], sys.argv))
"""
MOUNTED = """
/**/localizer_node:
  ros__parameters:
    laser_pose: [0.0, 0.0, 0.3, 0.0, 0.0, 0.0]
    session_dir: {folder}
/**/registrar_node:
  ros__parameters:
    laser_pose: [0.0, 0.0, 0.3, 0.0, -1.5707963, 0.0]
    new_points: 0.0
    scan_distance: 0.0
"""
BEAMS = 20
# Scans are 10 cm apart along the way of a robot that drives slowly, and so far in time, s.
STEP_S = 0.4


class Robot:
    """A robot on the floor: its process, and what it sees as the test lets it drive.

    `reaches`: whether it is in touch with the merger. Its nodes are in a namespace of their own, and the test hands on
    what they and the merger tell each other, as the radio does.
    """

    def __init__(self, harness, name, way, scans, folder):
        self.harness, self.name, self.way, self.scans, self.folder = harness, name, way, scans, folder
        self.space = f"/on_board/{name}"
        self.reaches = True
        self.step = 0
        self.points = 0
        self.poses, self.clouds = [], []
        self.process = None
        node = harness.observer
        self._hand_on(UInt8MultiArray, "keyframes", outward=True, qos=LATCHED)
        self._hand_on(PointCloud2, "cloud", outward=True, qos=1000)
        for topic in ("keyframes_wanted", "cloud_wanted"):
            self._hand_on(UInt32MultiArray, topic, outward=False, qos=1000)
        node.create_subscription(PoseWithCovarianceStamped, f"{self.space}/pose", self.poses.append, 1000)
        self.level = node.create_publisher(LaserScan, f"{self.space}/scan", sensor_qos(1000))
        self.upright = node.create_publisher(LaserScan, f"{self.space}/scan_vertical", sensor_qos(1000))

    def _hand_on(self, kind, topic, *, outward, qos):
        inside, outside = f"{self.space}/{topic}", f"/{self.name}/{topic}"
        publisher = self.harness.observer.create_publisher(kind, outside if outward else inside, qos)

        def hand_on(message):
            if topic == "cloud":
                self.clouds.append(message)
            if self.reaches:
                publisher.publish(message)

        self.harness.observer.create_subscription(kind, inside if outward else outside, hand_on, qos)

    def start(self):
        self.folder.mkdir(exist_ok=True)
        parameters = self.folder / "robot.yaml"
        parameters.write_text(MOUNTED.format(folder=self.folder))
        given = ["-r", f"__ns:={self.space}", "-p", f"frame_prefix:={self.name}/", "--params-file", str(parameters)]
        command = [sys.executable, "-c", ROBOT, "--ros-args", *given]
        self.told_before = self.harness.alive.get(f"{self.space}/registrar_node", 0)
        self.process = subprocess.Popen(command, cwd=ROOT, env=ENVIRONMENT)

    def wait_until_it_runs(self):
        name = f"{self.space}/registrar_node"
        self.harness.wait_until(lambda: self.harness.alive.get(name, 0) > self.told_before + 1, 90)

    def kill(self):
        self.process.kill()
        self.process.wait()

    def drive(self, steps):
        """So many scans on, each with a vertical one; wait until all is localized and registered."""
        expected = len(self.poses)
        for step in range(self.step, min(self.step + steps, len(self.scans))):
            scan = self.scans[step]
            self.level.publish(conversions.scan_to_message(scan))
            vertical = Scan(scan.stamp, np.full(BEAMS, 1.5, np.float32), -0.5, 1.0 / BEAMS, frame_id="vertical")
            self.upright.publish(conversions.scan_to_message(vertical))
            expected += 1
            self.points += BEAMS
            self.step += 1
            if step % 10 == 0:
                self.harness.wait_until(lambda expected=expected: len(self.poses) >= expected, 90)
        self.harness.wait_until(lambda: len(self.poses) >= expected, 90)
        stamp = self.scans[self.step - 1].stamp
        self.harness.wait_until(
            lambda: self.clouds and conversions.stamp_seconds(self.clouds[-1].header.stamp) > stamp - 1e-3, 60
        )


@pytest.fixture
def site(ros, floor, seen, tmp_path):
    """Three robots and a merger, and what somebody has who collects the joint cloud."""
    harness = ros()
    harness.alive, harness.values, harness.states = {}, {}, {}
    harness.collected = CollectedCloud()

    def note(message):
        for status in message.status:
            harness.alive[status.name] = harness.alive.get(status.name, 0) + 1
            harness.values[status.name] = {pair.key: pair.value for pair in status.values}

    def note_states(message):
        harness.states = {s.name: {pair.key: pair.value for pair in s.values} for s in message.status}

    def collect(message):
        cloud = conversions.usable_points(conversions.cloud_from_message(message))
        harness.collected.add(cloud, conversions.piece_from_message(message))

    harness.observer.create_subscription(DiagnosticArray, "/diagnostics", note, 1000)
    harness.observer.create_subscription(DiagnosticArray, "/alignments", note_states, LATCHED)
    harness.observer.create_subscription(PointCloud2, "/cloud", collect, 1000)
    walls, ways = floor
    harness.robots = []
    for number, (name, way) in enumerate(ways.items()):
        rng = np.random.default_rng(number)
        stamps = 1000.0 * (number + 1) + STEP_S * np.arange(len(way))
        scans = [seen(walls, pose, stamp, rng) for stamp, pose in zip(stamps, way, strict=True)]
        scans = [replace(scan, frame_id="laser") for scan in scans]
        harness.robots.append(Robot(harness, name, way, scans, tmp_path / name))

    def start_merger():
        before = harness.alive.get("/map_merger_node", 0)
        command = [sys.executable, "-m", "g2_recon.nodes.map_merger_node", "--ros-args", "-p", "settle:=1.0"]
        harness.merger = subprocess.Popen(
            [*command, "-p", f"session_dir:={tmp_path}/merger"], cwd=ROOT, env=ENVIRONMENT
        )
        harness.wait_until(lambda: harness.alive.get("/map_merger_node", 0) > before + 1, 90)

    def kill_merger():
        harness.merger.kill()
        harness.merger.wait()

    harness.start_merger, harness.kill_merger = start_merger, kill_merger
    yield harness
    for process in [harness.merger, *(robot.process for robot in harness.robots)]:
        if process is not None:
            process.kill()
            process.wait()


def is_whole(harness):
    """Whether all robots are in the map, with all points that they have recorded."""
    states = [harness.states.get(robot.name, {}).get("place") for robot in harness.robots]
    return states == ["aligned"] * 3 and len(harness.collected) == sum(robot.points for robot in harness.robots)


def test_whoever_is_cut_off_or_killed_comes_back_and_nothing_recorded_is_missing(site):
    one, two, three = site.robots
    site.start_merger()
    for robot in site.robots:
        robot.start()
    for robot in site.robots:
        robot.wait_until_it_runs()
        robot.drive(80)
    # Robot 2 drives on where the radio does not reach, for a minute of its time.
    two.reaches = False
    two.drive(150)
    assert two.scans[two.step].stamp - two.scans[two.step - 150].stamp > 59.9
    # Robot 3 is killed and started anew.
    three.kill()
    three.start()
    three.wait_until_it_runs()
    three.drive(120)
    two.reaches = True
    # The merger is killed, and robots drive on meanwhile.
    site.kill_merger()
    one.drive(120)
    site.start_merger()
    for robot in site.robots:
        robot.drive(1000)
    site.wait_until(lambda: is_whole(site), 120)
    assert [site.states[robot.name]["sessions"] for robot in site.robots] == ["1"] * 3
