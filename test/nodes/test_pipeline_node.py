# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from g2_recon.geometry import se3
from g2_recon.nodes import conversions, pipeline_node
from g2_recon.nodes.ros import LATCHED

ROOT = Path(__file__).parents[2]
SCANS = 20


@pytest.fixture
def bag(tmp_path, niche_scan) -> Path:
    """Two seconds of a drive with both lasers and odometry."""
    types = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / "a bag: 1", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        scan, vertical = (
            writer.add_connection(topic, "sensor_msgs/msg/LaserScan", typestore=types)
            for topic in ("/scan", "/scan_vertical")
        )
        odom = writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=types)
        for step in range(SCANS):
            stamp, pose = 100.0 + 0.1 * step, (0.06 * step, 0.0, 0.0)
            moved = Odometry(header=conversions.header(conversions.stamp_message(stamp), "odom"))
            moved.pose.pose = conversions.pose_message(se3.from_se2(pose))
            for connection, message in (
                (odom, moved),
                (scan, niche_scan(stamp, pose)),
                (vertical, niche_scan(stamp - 0.05)),
            ):
                writer.write(connection, round(stamp * 1e9), serialize_message(message))
    return tmp_path / "a bag: 1"


@pytest.fixture
def start(tmp_path):
    """`start(*arguments)` starts the process; it is killed in every case."""
    started = []

    def begin(*arguments):
        process = subprocess.Popen(
            [sys.executable, "-m", "g2_recon.nodes.pipeline_node", *arguments],
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
            stdout=(tmp_path / "log").open("w"),
            stderr=subprocess.STDOUT,
        )
        started.append(process)
        return process

    yield begin
    for process in started:
        process.kill()
        process.wait()


def test_a_recording_becomes_a_mesh_in_one_process(ros, start, bag, tmp_path):
    harness = ros()
    status = {}

    def note(message):
        status[message.status[0].name] = {pair.key: pair.value for pair in message.status[0].values}

    harness.observer.create_subscription(DiagnosticArray, "/diagnostics", note, 100)
    process = start(
        "--bag", str(bag), "--rate", "2", "--ros-args", "--params-file", str(ROOT / "config/g2.yaml"),
        "-p", f"reconstruct_node:session_dir:={tmp_path}/session",
    )  # fmt: skip

    def said(node, key):
        return status.get(node, {}).get(key)

    # The first of the vertical scans has no pose before it.
    harness.wait_until(lambda: said("/reconstruct_node", "received cloud") == str(SCANS - 1), 60)
    # Each node says so once a second, at a time of its own, and may be heard for the first time only now.
    harness.wait_until(lambda: said("/localizer_node", "localized scans") == str(SCANS), 5)
    assert set(status) == {"/localizer_node", "/registrar_node", "/reconstruct_node", "/replay_node"}
    answer = harness.call(Trigger, "reconstruct_node/reconstruct")
    assert answer.success, answer.message
    meshes = harness.collect(MarkerArray, "mesh", LATCHED)
    harness.wait_until(lambda: meshes)
    assert np.sum([len(marker.points) for marker in meshes[0].markers]) > 100
    assert harness.call(Trigger, "reconstruct_node/save").success
    assert (tmp_path / "session/mesh.ply").is_file()
    process.send_signal(signal.SIGINT)
    assert process.wait(20) == 0, (tmp_path / "log").read_text()
    assert "Traceback" not in (tmp_path / "log").read_text()
    assert "there is no parameter" not in (tmp_path / "log").read_text()


def test_with_sweeps_and_without_a_bag_there_are_the_nodes_of_sweeps(ros, start):
    harness = ros()
    process = start("--lasers", "sweeps", "--ros-args", "-r", "__ns:=/robot1")
    names = harness.observer.get_node_names_and_namespaces
    wanted = {("sweep_node", "/robot1"), ("reconstruct_node", "/robot1")}
    harness.wait_until(lambda: wanted <= set(names()), 60)
    assert {name for name, space in names() if space == "/robot1"} == {"sweep_node", "reconstruct_node"}
    process.send_signal(signal.SIGTERM)
    assert process.wait(20) == 0


def test_a_bag_that_is_not_there_ends_it_with_1_and_one_line(start, tmp_path):
    assert start("--bag", "no/such/bag").wait(60) == 1
    fatal = [line for line in (tmp_path / "log").read_text().splitlines() if "[FATAL]" in line]
    assert len(fatal) == 1 and "no/such/bag: " in fatal[0]


@pytest.mark.parametrize(("options", "code"), [(["--help"], 0), (["--lasers", "none"], 2), (["--rate", "fast"], 2)])
def test_options_are_explained_and_checked(options, code, capsys):
    with pytest.raises(SystemExit) as ended:
        pipeline_node.main(["pipeline_node", *options])
    assert ended.value.code == code
    said = "".join(capsys.readouterr())
    assert "--lasers" in said and "--bag" in said
