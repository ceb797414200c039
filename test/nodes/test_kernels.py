# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The first start ever: kernels are compiled beside a node that answers and loses nothing meanwhile."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import LaserScan
from std_srvs.srv import SetBool

from g2_recon import warm_up
from g2_recon.nodes import conversions, kernels, stage_node
from g2_recon.nodes.localizer_node import LocalizerNode

ROOT = Path(__file__).parents[2]
MOUNTED = ("-p", "laser_pose:=[0.0,0.0,0.3,0.0,0.0,0.0]")


class Compiler:
    """Says that it compiles until it is told to be done."""

    def __init__(self, parts, held_for):
        self._parts = parts
        self.compiled = []

    def parts_left(self):
        return tuple(part for part in self._parts if part not in self.compiled)

    def close(self):
        self._parts = ()


def test_while_kernels_are_compiled_a_node_answers_and_holds_what_comes_in_its_order(ros, room_scan, monkeypatch):
    monkeypatch.setattr(stage_node, "KernelCompiler", Compiler)
    harness = ros(*MOUNTED)
    node = harness.add(LocalizerNode)
    diagnostics = harness.collect(DiagnosticArray, "/diagnostics")
    poses = harness.collect(PoseWithCovarianceStamped, "pose")
    scans = harness.publisher(LaserScan, "scan")
    stamps = [100.0 + 0.1 * step for step in range(5)]
    for step, stamp in enumerate(stamps[:4]):
        scans.publish(room_scan(stamp, (0.1 * step, 0.0, 0.0)))
    words = "compiling kernels, this first time ever: 4 messages wait"
    harness.wait_until(lambda: any(words in array.status[0].message for array in diagnostics))
    assert harness.call(SetBool, "localizer_node/pause", SetBool.Request(data=False)).success
    assert not poses
    # The others may still be compiled.
    node._compiler.compiled.append("tracking")
    harness.wait_until(lambda: len(poses) == 4)
    scans.publish(room_scan(stamps[4], (0.4, 0.0, 0.0)))
    harness.wait_until(lambda: len(poses) == 5)
    assert [conversions.stamp_seconds(pose.header.stamp) for pose in poses] == pytest.approx(stamps)


def test_parts_are_compiled_one_after_the_other(monkeypatch):
    begun = []
    popen = subprocess.Popen

    def begin(command, **_):
        begun.append(command[-1])
        return popen([sys.executable, "-c", ""])

    monkeypatch.setattr(kernels.subprocess, "Popen", begin)
    monkeypatch.setattr(kernels, "are_cached", lambda part: part == "localization")
    compiler = kernels.KernelCompiler(["tracking", "localization", "registration"])
    assert compiler.parts_left() == ("tracking", "registration")
    while compiler.parts_left():
        if compiler._process is not None:
            compiler._process.wait()
    assert begun == ["tracking", "registration"]


@pytest.mark.skipif(not Path("/proc/self/autogroup").exists(), reason="Linux only")
def test_only_what_messages_wait_for_is_compiled_at_full_priority(monkeypatch):
    popen, waits = subprocess.Popen, [sys.executable, "-c", "input()"]
    monkeypatch.setattr(kernels.subprocess, "Popen", lambda command, **how: popen(waits, stdin=subprocess.PIPE, **how))
    monkeypatch.setattr(kernels, "are_cached", lambda part: False)
    compiler = kernels.KernelCompiler(["tracking", "localization", "reconstruction"], "tracking")
    own, niceness = os.getpriority(os.PRIO_PROCESS, 0), {}
    while compiler.parts_left():
        while compiler._to_be_lowered:
            # Another session was lowered less than 0.1 s ago.
            compiler.parts_left()
        process = compiler._process
        of_session = int(Path(f"/proc/{process.pid}/autogroup").read_text().split()[-1])
        niceness[compiler.parts_left()[0]] = os.getpriority(os.PRIO_PROCESS, process.pid), of_session
        process.communicate(b"\n")
    assert niceness == {
        "tracking": (own, 0),
        "localization": (max(19, own), 19),
        "reconstruction": (max(10, own), 10),
    }


def test_where_all_kernels_are_on_the_disk_none_is_compiled(monkeypatch):
    monkeypatch.setattr(kernels, "are_cached", lambda part: True)
    compiler = kernels.KernelCompiler(list(kernels._LATE))
    assert not compiler.parts_left()


def test_kernels_on_the_disk_are_loaded_before_the_first_scan(ros):
    code = """
import rclpy
from g2_recon.localization import tracking_kernels
from g2_recon.nodes.localizer_node import LocalizerNode
rclpy.init()
node = LocalizerNode()
node._loading.join()
print(len(tracking_kernels.match_on_latest.overloads))
node.destroy_node()
"""
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    assert done.stdout == "1\n", done


def test_where_kernels_are_compiled_beside_nothing_waits_to_load_them(ros, monkeypatch):
    monkeypatch.setattr(stage_node, "KernelCompiler", Compiler)
    node = ros(*MOUNTED).add(LocalizerNode)
    assert node._loading is None


def test_each_part_can_be_compiled_and_is_not_on_an_empty_disk(tmp_path):
    assert set(kernels._LATE) == set(warm_up.PARTS)
    code = """
from g2_recon.nodes.kernels import _LATE, _is_cached
print([name for names in _LATE.values() for name in names if _is_cached(name)])
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert done.stdout == "[]\n", done
