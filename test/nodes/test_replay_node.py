# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan
from std_srvs.srv import SetBool

from g2_recon.errors import InputError
from g2_recon.nodes import conversions
from g2_recon.nodes.replay_node import Playback, ReplayNode
from g2_recon.nodes.ros import LATCHED

SECOND = 10**9
START = 1000 * SECOND
UNKNOWN = "example_msgs/msg/Unknown"


@pytest.fixture
def bag(tmp_path, room_scan) -> Path:
    """Two seconds: 20 scans, an odometry message that was latched, and a type that no ROS has."""
    types = get_typestore(Stores.ROS2_JAZZY)
    types.register(get_types_from_msg("float64 x", UNKNOWN))
    path = tmp_path / "bag"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        scans = writer.add_connection("/scan", "sensor_msgs/msg/LaserScan", typestore=types)
        tf_static = writer.add_connection("/tf_static", "nav_msgs/msg/Odometry", typestore=types)
        other = writer.add_connection("/other", UNKNOWN, typestore=types)
        writer.write(tf_static, START, serialize_message(Odometry(child_frame_id="base_link")))
        writer.write(other, START, bytes(12))
        for number in range(20):
            stamp = START + number * SECOND // 10
            writer.write(scans, stamp, serialize_message(room_scan(stamp / SECOND)))
    return path


@pytest.fixture
def replay(ros, bag):
    """`replay(*arguments)` starts the replay of the bag and collects the scans and the clock."""

    def start(*arguments, namespace=""):
        quick = ("-p", "wait_for_subscribers:=5.0", "-p", "start_delay:=0.2", "-p", f"bag:={bag}")
        harness = ros(*quick, *arguments)
        harness.node = harness.add(ReplayNode)
        harness.finished = harness.node.finished
        harness.times = []
        harness.scans = harness.collect(LaserScan, f"{namespace}/scan")
        harness.observer.create_subscription(
            LaserScan, f"{namespace}/scan", lambda _: harness.times.append(time.monotonic()), 100
        )
        harness.clock = harness.collect(Clock, "/clock")
        harness.latched = harness.collect(Odometry, f"{namespace}/tf_static", LATCHED)
        return harness

    return start


def test_every_message_arrives_as_it_was_recorded(replay, room_scan):
    recording = replay("-p", "rate:=20.0")
    recording.wait_until(lambda: len(recording.scans) == 20)
    assert [scan.header.stamp.nanosec for scan in recording.scans[:3]] == [0, 100_000_000, 200_000_000]
    recorded = room_scan((START + 7 * SECOND // 10) / SECOND)
    assert serialize_message(recording.scans[7]) == serialize_message(recorded)


@pytest.mark.parametrize("rate", [1.0, 4.0])
def test_messages_come_no_sooner_than_they_were_recorded(replay, rate):
    recording = replay("-p", f"rate:={rate}")
    recording.wait_until(lambda: len(recording.times) == 20)
    # How late they are, the first one too, depends on what else the machine does; that nothing drifts is tested below.
    after = np.array(recording.times) - recording.node._starts_at / SECOND
    assert (after > np.arange(20) / 10 / rate - 0.01).all(), after


def test_the_clock_runs_with_the_recording(replay):
    recording = replay("-p", "rate:=2.0")
    recording.wait_until(recording.finished.done)
    stamps = [conversions.stamp_seconds(message.clock) for message in recording.clock]
    assert stamps == sorted(stamps)
    assert (stamps[0], stamps[-1]) == (pytest.approx(1000.0, abs=0.05), pytest.approx(1001.9))
    # 40 times a second of wall time; a busy machine skips some, but none comes sooner.
    assert len(stamps) > 10
    assert np.median(np.diff(stamps)) > 0.9 * 2.0 / 40


def test_the_replay_ends_when_all_is_sent(replay):
    recording = replay("-p", "rate:=20.0")
    recording.wait_until(recording.finished.done)
    assert len(recording.scans) == 20


def test_topics_are_in_the_namespace_of_the_node(replay):
    recording = replay("-p", "rate:=20.0", "-r", "__ns:=/robot1", namespace="/robot1")
    recording.wait_until(lambda: len(recording.scans) == 20)


def test_static_transforms_are_latched(replay):
    recording = replay("-p", "rate:=20.0", "-p", "exit_when_done:=false")
    recording.wait_until(lambda: len(recording.scans) == 20)
    late = recording.collect(Odometry, "tf_static", LATCHED)
    recording.wait_until(lambda: late)
    assert late[0].child_frame_id == "base_link"


def test_a_loop_starts_again(replay):
    recording = replay("-p", "rate:=20.0", "-p", "loop:=true")
    recording.wait_until(lambda: len(recording.scans) > 40)
    assert recording.scans[20] == recording.scans[0]


def test_while_paused_the_clock_stands_still(replay):
    recording = replay("-p", "rate:=4.0")
    recording.wait_until(lambda: len(recording.scans) >= 3)
    assert recording.call(SetBool, "replay_node/pause", SetBool.Request(data=True)).success
    # What was sent before the answer may still be on its way.
    recording.wait_until(lambda: len(recording.clock) >= 5 and recording.clock[-1] == recording.clock[-5])
    scans, clocks = len(recording.scans), len(recording.clock)
    recording.wait_until(lambda: len(recording.clock) >= clocks + 30)
    assert len(recording.scans) == scans
    assert recording.clock[-1] == recording.clock[clocks - 1]
    assert recording.call(SetBool, "replay_node/pause", SetBool.Request(data=False)).success
    recording.wait_until(lambda: len(recording.scans) == 20)


def test_playback_does_not_drift():
    playback = Playback(5.0, START, wall=0)
    assert playback.stamp(3600 * SECOND) == START + 5 * 3600 * SECOND


def test_playback_goes_on_from_where_it_was_held():
    playback = Playback(2.0, START, wall=0)
    playback.pause(True, wall=10)
    assert playback.stamp(1000) == START + 20
    playback.pause(False, wall=1000)
    assert playback.stamp(1005) == START + 30
    assert playback.wait(START + 40, wall=1005) == 5


@pytest.mark.parametrize(("path", "told"), [("", "set the parameter `bag`"), ("no/such/bag", "no/such/bag: ")])
def test_without_a_bag_it_says_so(ros, path, told):
    harness = ros("-p", f"bag:='{path}'")
    with pytest.raises(InputError, match=told):
        harness.add(ReplayNode)
