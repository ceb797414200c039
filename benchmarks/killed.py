# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Nodes that are killed (SIGKILL) at random moments of a replay and started again: what it costs the mesh.

    python benchmarks/killed.py --kills 20

The replay is held from just before a kill until the node is back, as nothing can see while it is away; what is on its
way to the node at the kill is lost, and the more there is the faster the replay.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger

from g2_recon.evaluation.surface import score_surface
from g2_recon.nodes.conversions import stamp_seconds
from g2_recon.recording.clouds import read_cloud
from g2_recon.recording.meshes import read_mesh
from g2_recon.recording.surfaces import read_true_surface

ROOT = Path(__file__).parents[1]
BAG = ROOT / "bags/first_floor"
NODES = ("localizer_node", "registrar_node", "reconstruct_node")
LENGTH_S = 245.0
# Counts that stand still so long are final; a node that speaks needs so long until it also hears all.
_STILL_S, _CONNECTED_S = 6.0, 2.0


class Run:
    """One replay with its nodes, and what they say."""

    def __init__(self, folder: Path, rate: float) -> None:
        self.folder = folder
        self.status: dict[str, dict[str, str]] = {}
        self.clock = self.began = 0.0
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self._node = rclpy.create_node("benchmark")
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._note, 100)
        self._node.create_subscription(Clock, "/clock", self._on_clock, 10)
        for name in NODES:
            self.start(name)
        self._start("replay_node", "-p", f"bag:={BAG}", "-p", f"rate:={rate}")

    def close(self) -> None:
        """Kill what is left."""
        for process in self.processes.values():
            process.kill()
            process.wait()
        self._node.destroy_node()

    def start(self, name: str) -> None:
        """Start a node and wait until it says something."""
        self.status.pop(f"/{name}", None)
        self._start(name, "-p", f"session_dir:={self.folder}", "-p", "queue_depth:=20000")
        self.wait(lambda: f"/{name}" in self.status)

    def kill(self, name: str) -> None:
        """Kill a node while the replay is held, and start it again."""
        self.call(SetBool, "replay_node/pause", SetBool.Request(data=True))
        self.processes[name].kill()
        self.processes[name].wait()
        self.start(name)
        self._idle(_CONNECTED_S)
        self.call(SetBool, "replay_node/pause", SetBool.Request(data=False))

    def call(self, kind: Any, service: str, request: Any) -> Any:
        """The answer of a service."""
        client = self._node.create_client(kind, service)
        client.wait_for_service(20)
        future = client.call_async(request)
        self.wait(future.done)
        return future.result()

    def wait(self, holds: Callable[[], Any], seconds: float = 600.0) -> None:
        """Wait until something holds."""
        end = time.monotonic() + seconds
        while not holds():
            if time.monotonic() > end:
                raise TimeoutError
            rclpy.spin_once(self._node, timeout_sec=0.05)

    def wait_until_done(self) -> None:
        """Wait for the end of the replay, and until all that was on its way has come."""
        self.wait(lambda: self.processes["replay_node"].poll() is not None)
        before: dict[str, str] = {}
        while (now := {name: values.get("received cloud", "") for name, values in self.status.items()}) != before:
            before = now
            self._idle(_STILL_S)

    def _idle(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        self.wait(lambda: time.monotonic() > end)

    def _start(self, name: str, *arguments: str) -> None:
        self.processes[name] = subprocess.Popen(
            [
                sys.executable,
                "-m",
                f"g2_recon.nodes.{name}",
                "--ros-args",
                "--params-file",
                str(ROOT / "config/g2.yaml"),
            ]
            + list(arguments),
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def _note(self, message: DiagnosticArray) -> None:
        self.status[message.status[0].name] = {pair.key: pair.value for pair in message.status[0].values}

    def _on_clock(self, message: Clock) -> None:
        self.clock = stamp_seconds(message.clock)
        self.began = self.began or self.clock


def measure(kills: int, rate: float, seed: int) -> str:
    """Replay with so many kills of nodes in turn; scores of the mesh, in words."""
    moments = random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        run = Run(Path(folder), rate)
        try:
            for number, moment in enumerate(sorted(moments.uniform(2.0, LENGTH_S - 5.0) for _ in range(kills))):
                run.wait(lambda moment=moment: run.began and run.clock - run.began > moment)
                run.kill(NODES[number % len(NODES)])
            run.wait_until_done()
            answer = run.call(Trigger, "reconstruct_node/reconstruct", Trigger.Request())
            run.call(Trigger, "reconstruct_node/save", Trigger.Request())
        finally:
            run.close()
        if not answer.success:
            return f"{kills} kills: {answer.message}"
        cloud = read_cloud(Path(folder) / "cloud.ply")
        truth = replace(read_true_surface(BAG / "truth/surfaces.npz"), seen=cloud.points)
        score = score_surface(truth, *read_mesh(Path(folder) / "mesh.ply"), thresholds=[0.05])
        return f"{kills} kills: {len(cloud)} points, F5 {100 * score.at[0].f_score:.2f} %"


def main() -> None:
    """Compare a replay with kills to one without; see above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20, help="of localizer, registrar and reconstruction in turn")
    parser.add_argument("--rate", type=float, default=1.0, help="speed of the replay")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rclpy.init()
    for kills in (0, given.kills):
        sys.stdout.write(measure(kills, given.rate, given.seed) + "\n")
        sys.stdout.flush()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
