# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

ROOT = Path(__file__).parents[2]
NODES = ("localizer_node", "registrar_node", "sweep_node", "reconstruct_node", "map_merger_node", "replay_node")


@pytest.fixture
def start():
    """`start(node, *arguments)` starts the process of a node; it is killed in every case."""
    started = []

    def begin(node, *arguments):
        process = subprocess.Popen(
            [sys.executable, "-m", f"g2_recon.nodes.{node}", *arguments],
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        started.append(process)
        return process

    yield begin
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture
def long_bag(tmp_path) -> Path:
    """One message now and one in an hour."""
    types = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/text", "std_msgs/msg/Empty", typestore=types)
        for hour in (1, 2):
            writer.write(topic, hour * 3600 * 10**9, bytes(4 + 1))
    return tmp_path / "bag"


def run_module(path, *, timeout):
    """A Python file, run as a module until it ends."""
    return subprocess.run(
        [sys.executable, "-m", path.stem],
        cwd=path.parent,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
        capture_output=True,
        text=True,
        timeout=timeout,
    )


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("node", NODES)
def test_a_node_that_is_told_to_stop_ends_with_0_and_without_a_traceback(ros, start, long_bag, node, stop):
    harness = ros()
    name = f"{node}_{stop.name}"
    process = start(node, "--ros-args", "-p", f"bag:={long_bag}", "-r", f"__node:={name}")
    harness.wait_until(lambda: name in harness.observer.get_node_names())
    process.send_signal(stop)
    output, _ = process.communicate(timeout=20)
    assert process.returncode == 0, output
    assert "Traceback" not in output


def test_a_node_that_is_interrupted_while_it_is_made_ends_with_0(tmp_path):
    """Imports go through `exec`, where Python remembers a KeyboardInterrupt for the end of `python -m`."""
    (tmp_path / "interrupted.py").write_text("""
import faulthandler, sys
from g2_recon.nodes.ros import run

faulthandler.dump_traceback_later(15)
INTERRUPT = "import os, signal, time; os.kill(os.getpid(), signal.SIGINT); time.sleep(9)"
sys.exit(run(lambda: exec(INTERRUPT), None))
""")
    try:
        process = run_module(tmp_path / "interrupted.py", timeout=20)
    except subprocess.TimeoutExpired as late:
        pytest.fail(f"it did not end; where it was after 15 s:\n{late.stderr}")
    assert (process.returncode, process.stderr) == (0, "")


def test_a_process_leaves_when_dds_does_not_end(tmp_path):
    """As Fast DDS does it at times: in a loop that keeps Python's other threads and its signals out."""
    (tmp_path / "endless.py").write_text("""
import ctypes, os, signal, sys
from rclpy.node import Node
from g2_recon.nodes import ros

class Endless(Node):
    def __init__(self):
        super().__init__("endless")
        self.create_timer(0.1, lambda: os.kill(os.getpid(), signal.SIGINT))

    def end(self):
        print("ended", flush=True)

    def destroy_node(self):
        ctypes.PyDLL(None).sleep(60)

ros._LONGEST_END_S = 1.0
sys.exit(ros.run(Endless, None))
""")
    process = run_module(tmp_path / "endless.py", timeout=30)
    assert (process.returncode, process.stdout) == (1, "ended\n")
    assert "in destroy_node" in process.stderr


@pytest.mark.parametrize(
    ("node", "arguments", "told"),
    [
        ("localizer_node", ("-p", "max_range:=1000.0"), "max_range out of range"),
        ("registrar_node", ("-p", "laser_pose:=[1.0]"), "laser_pose needs six numbers"),
        ("reconstruct_node", ("-p", "mode:=best"), "mode"),
        (
            "map_merger_node",
            ("-p", "starts:=['robot1 0 0']"),
            "'robot1 0 0' of starts is not a robot and three numbers",
        ),
        ("replay_node", ("-p", "bag:=no/such/bag"), "no/such/bag: "),
        ("replay_node", ("--params-file", "no_such_file.yaml"), "no_such_file.yaml"),
    ],
)
def test_a_node_that_cannot_start_ends_with_1_and_one_line(start, node, arguments, told):
    process = start(node, "--ros-args", *arguments)
    output, _ = process.communicate(timeout=20)
    assert process.returncode == 1, output
    fatal = [line for line in output.splitlines() if "[FATAL]" in line]
    assert len(fatal) == 1 and told in fatal[0]
    assert "Traceback" not in output


def test_a_misspelled_parameter_is_named(start):
    process = start("localizer_node", "--ros-args", "-p", "max_rang:=5.0")
    end = threading.Timer(20, process.kill)
    end.start()
    assert any("there is no parameter 'max_rang'" in line for line in process.stdout)
    end.cancel()


_COMPILES = """
import numba, sys
from g2_recon.nodes.ros import say_when_kernels_compile
say_when_kernels_compile()
for kernel in (abs, round):
    numba.njit(lambda x, kernel=kernel: kernel(x))(1.5)
"""


def test_a_process_that_compiles_kernels_says_so_once():
    ended = subprocess.run(
        [sys.executable, "-c", _COMPILES],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert (ended.stdout + ended.stderr).count("compiling kernels") == 1


@pytest.mark.parametrize("node", NODES)
def test_a_node_starts_without_what_only_files_need(node):
    """trimesh alone takes half a second."""
    code = f"import sys, g2_recon.nodes.{node}; assert 'trimesh' not in sys.modules"
    subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
        timeout=120,
        check=True,
    )
