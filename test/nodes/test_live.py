# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The way live: four processes over real DDS, a recording at 2.5 times real time, a mesh at the end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from g2_recon.nodes.ros import LATCHED
from g2_recon.recording.bags import messages

ROOT = Path(__file__).parents[2]
BAG = ROOT / "bags/first_floor"
STAGES = ("localizer_node", "registrar_node", "reconstruct_node")
RATE = 2.5
# The first start ever compiles kernels.
LONGEST_START_S, LONGEST_RECONSTRUCTION_S = 60.0, 120.0
# A machine that is busy with other things falls behind a replay at this rate: it gets queues for all of the recording,
# and time to work them off.
QUEUE_DEPTH = 10_000
LONGEST_BACKLOG_S = 120.0


@pytest.fixture(scope="module")
def live(tmp_path_factory, module_ros) -> Iterator[SimpleNamespace]:
    """The end of a live run: diagnostics, answer, wire mesh, and the processes after SIGINT."""
    logs = tmp_path_factory.mktemp("live")
    processes: dict[str, subprocess.Popen] = {}

    def start(name: str, *arguments: str) -> None:
        command = [sys.executable, "-m", f"g2_recon.nodes.{name}", "--ros-args"]
        with (logs / name).open("w") as log:
            processes[name] = subprocess.Popen(
                [*command, "--params-file", str(ROOT / "config/g2.yaml"), *arguments],
                cwd=ROOT,
                env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    try:
        run = SimpleNamespace(processes=processes, logs=logs, status={})
        _run(run, module_ros, start)
        yield run
    finally:
        for process in processes.values():
            process.kill()
            process.wait()


def _run(run: SimpleNamespace, ros, start) -> None:
    def note(message: DiagnosticArray) -> None:
        run.status[message.status[0].name] = {pair.key: pair.value for pair in message.status[0].values}

    ros.observer.create_subscription(DiagnosticArray, "/diagnostics", note, 100)
    for name in STAGES:
        start(name, "-p", "use_sim_time:=true", "-p", f"queue_depth:={QUEUE_DEPTH}")
    ros.wait_until(lambda: {f"/{name}" for name in STAGES} <= run.status.keys(), LONGEST_START_S)

    started = time.monotonic()
    start("replay_node", "-p", f"bag:={BAG}", "-p", f"rate:={RATE}", "-p", f"queue_depth:={QUEUE_DEPTH}")
    assert run.processes["replay_node"].wait(300) == 0, (run.logs / "replay_node").read_text()
    run.replayed_in = time.monotonic() - started
    _wait_while_it_goes_on(run)

    future = ros.call_async(Trigger, "reconstruct_node/reconstruct")
    ros.wait_until(future.done, LONGEST_RECONSTRUCTION_S)
    run.answer = future.result()
    meshes = ros.collect(MarkerArray, "wire_mesh", LATCHED)
    ros.wait_until(lambda: meshes)
    run.wire_mesh = meshes[-1]

    for name in STAGES:
        run.processes[name].send_signal(signal.SIGINT)
    run.codes = {name: run.processes[name].wait(20) for name in STAGES}


def _wait_while_it_goes_on(run: SimpleNamespace) -> None:
    """Wait until the counts of the diagnostics, which come once a second, have stood still for some seconds."""
    end = time.monotonic() + LONGEST_BACKLOG_S
    before: dict = {}
    while before != (now := {name: dict(values) for name, values in run.status.items()}) and time.monotonic() < end:
        before = now
        time.sleep(4)


def distances(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Exact distance in metres of each point (N, 3) to the nearest triangle."""
    triangles = vertices[faces]
    nearest = []
    for point in points:
        closest = trimesh.triangles.closest_point(triangles, np.broadcast_to(point, (len(faces), 3)))
        nearest.append(np.linalg.norm(closest - point, axis=1).min())
    return np.array(nearest)


def test_no_scan_is_lost(live):
    recorded = Counter(message.topic.lstrip("/") for message in messages(BAG))
    status = live.status
    assert int(status["/localizer_node"]["localized scans"]) == recorded["scan"]
    registered = int(status["/registrar_node"]["registered scans"])
    # In a room that it has just left the robot sees hardly anything new; elsewhere its scans are 17 cm apart.
    not_needed = sum(int(value) for key, value in status["/registrar_node"].items() if "not needed" in key)
    assert registered + not_needed == recorded["scan_vertical"]
    assert not_needed < 0.1 * recorded["scan_vertical"]
    # Each as it comes, and those that the localizer moved once more.
    anew = int(status["/registrar_node"]["pieces placed anew"])
    assert int(status["/reconstruct_node"]["received cloud"]) == registered + anew


def test_nothing_is_dropped(live):
    assert not [key for values in live.status.values() for key in values if key.startswith("dropped")]


def test_the_replay_keeps_its_rate(live):
    stamps = [message.stamp_ns for message in messages(BAG)]
    # 30 s: start of the process, wait for subscribers, its end, on a busy machine.
    assert live.replayed_in < (stamps[-1] - stamps[0]) / 1e9 / RATE + 30


def test_the_reconstruction_tells_its_counts(live):
    assert live.answer.success, live.answer.message
    assert all(word in live.answer.message for word in ("points", "clusters", "neurons", "joins", "faces"))


def test_neurons_of_the_latched_wire_mesh_lie_within_10_cm_of_the_true_surfaces_on_average(live):
    points = np.array([(p.x, p.y, p.z) for marker in live.wire_mesh.markers for p in marker.points])
    truth = np.load(BAG / "truth/surfaces.npz")
    neurons = np.unique(points, axis=0)
    assert len(neurons) > 1000
    assert distances(neurons, truth["truth_vertices"], truth["truth_faces"]).mean() <= 0.10


def test_all_processes_end_well(live):
    assert live.codes == dict.fromkeys(STAGES, 0)
    assert not [name for name in live.processes if "Traceback" in (live.logs / name).read_text()]
