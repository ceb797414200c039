# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The launch files at work, where `launch` is installed and a workspace with g2_recon is sourced.

`launch_pytest` does not work with every pytest: the launch service runs in a process of its own.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("launch_ros", reason="launch is not installed")

import ament_index_python.packages as ament_index
from diagnostic_msgs.msg import DiagnosticArray

LAUNCH = Path(__file__).parents[2] / "launch"
RUN = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

file, *given = sys.argv[1:]
source = PythonLaunchDescriptionSource(file)
service = LaunchService()
arguments = [tuple(argument.split(":=")) for argument in given]
service.include_launch_description(LaunchDescription([IncludeLaunchDescription(source, launch_arguments=arguments)]))
sys.exit(service.run())
"""

try:
    ament_index.get_package_share_directory("g2_recon")
except ament_index.PackageNotFoundError:
    pytest.skip("no workspace with g2_recon is sourced", allow_module_level=True)


@pytest.fixture
def launched(ros):
    """`launched(name, *arguments)` starts a launch file and gives the diagnostics of each node by its name."""
    processes = []

    def start(name, *arguments):
        harness = ros()
        harness.status = {}

        def note(message):
            harness.status[message.status[0].name] = {pair.key: pair.value for pair in message.status[0].values}

        harness.observer.create_subscription(DiagnosticArray, "/diagnostics", note, 100)
        command = [sys.executable, "-c", RUN, str(LAUNCH / f"{name}.launch.py"), *arguments]
        harness.process = subprocess.Popen(command, env=os.environ, start_new_session=True)
        processes.append(harness.process)
        return harness

    yield start
    for process in processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
            process.wait(30)


def test_a_replay_comes_to_clouds_in_its_namespace(launched):
    harness = launched("replay", "rate:=20.0", "namespace:=replayed")
    harness.wait_until(lambda: int(harness.status.get("/replayed/reconstruct_node", {}).get("points", 0)) > 1000, 120)
    assert {"/replayed/localizer_node", "/replayed/registrar_node"} <= set(harness.status)


def test_a_robot_with_sweeps_has_the_nodes_of_sweeps(launched):
    harness = launched("robot", "lasers:=sweeps")
    harness.wait_until(lambda: len(harness.status) >= 2, 60)
    assert set(harness.status) == {"/sweep_node", "/reconstruct_node"}


def test_robots_are_started_each_in_its_namespace_with_one_merger_and_one_mesh(launched, tmp_path):
    file = tmp_path / "robots.yaml"
    file.write_text("/**/map_merger_node: {ros__parameters: {robots: [anna, bert]}}\n")
    harness = launched("robots", f"config:={file}", "here:=anna", "tf:=own")
    expected = {"/anna/localizer_node", "/anna/registrar_node", "/map_merger_node", "/reconstruct_node"}
    harness.wait_until(lambda: len(harness.status) >= 4, 60)
    assert set(harness.status) == expected


def test_a_robot_that_the_file_does_not_name_is_refused(launched):
    harness = launched("robots", "here:=nobody")
    assert harness.process.wait(30) == 1


def test_other_lasers_are_refused(launched):
    harness = launched("robot", "lasers:=none")
    assert harness.process.wait(30) == 1
