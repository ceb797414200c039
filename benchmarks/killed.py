# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Nodes that are killed (SIGKILL) at random moments of a replay and started again: what it costs the mesh.

    python benchmarks/killed.py --kills 20

Each node is killed so often in a replay of its own, which is compared with replays without kills. Where the machine is
busy with other things, nodes lag behind, and what waits for them would be lost: so the replay is held until they have
caught up, goes on for a random part of a second, is held again, and the node is killed at once. The replay is held
until it is back, as nothing can see while it is away. What is on its way to the node at the kill is lost. At the end
~/refine and ~/reconstruct are called, as after any drive.
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

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from report import Row, Table, page, save
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger

from g2_recon.evaluation.surface import score_surface
from g2_recon.geometry import se2
from g2_recon.nodes.conversions import stamp_seconds
from g2_recon.recording.clouds import read_cloud
from g2_recon.recording.meshes import read_mesh
from g2_recon.recording.surfaces import read_true_surface
from g2_recon.recording.trajectories import read_tum

ROOT = Path(__file__).parents[1]
OUT = ROOT / "out/benchmarks"
BAG = ROOT / "bags/first_floor"
NODES = ("localizer_node", "registrar_node", "reconstruct_node")
LENGTH_S = 245.0
# Counts that stand still so long are final; a node that speaks needs so long until it also hears all.
_STILL_S, _CONNECTED_S = 6.0, 2.0
# Diagnostics come once a second: what they count has not changed from one to the next.
_CAUGHT_UP_S = 2.5


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

    def kill(self, name: str, flowing: float) -> None:
        """Kill a node that gets data, for so many s since it had caught up, and start it again."""
        self._hold(True)
        self.wait_until_still(_CAUGHT_UP_S)
        self._hold(False)
        self._idle(flowing)
        self._hold(True)
        self.processes[name].kill()
        self.processes[name].wait()
        self.start(name)
        self._idle(_CONNECTED_S)
        self._hold(False)

    def _hold(self, held: bool) -> None:
        self.call(SetBool, "replay_node/pause", SetBool.Request(data=held))

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
        self.wait_until_still()

    def wait_until_still(self, seconds: float = _STILL_S) -> None:
        """Wait until no node has received or made anything for so long."""
        before: dict[str, str] = {}
        while (now := self._counts()) != before:
            before = now
            self._idle(seconds)

    def _counts(self) -> dict[str, str]:
        """What tells how far the nodes are."""
        counting = ("received", "localized", "registered", "pieces", "scans that wait", "points")
        return {
            f"{name} {key}": value
            for name in map("/{}".format, NODES)
            for key, value in self.status.get(name, {}).items()
            if key.startswith(counting)
        }

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


def measure(killed: str, kills: int, rate: float, seed: int) -> Row:
    """A row of the table: a replay with so many kills of a node."""
    moments = random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        run = Run(Path(folder), rate)
        try:
            for moment in sorted(moments.uniform(2.0, LENGTH_S - 5.0) for _ in range(kills)):
                run.wait(lambda moment=moment: run.began and run.clock - run.began > moment)
                run.kill(killed, moments.uniform(0.1, 1.0))
            run.wait_until_done()
            refined = run.call(Trigger, "localizer_node/refine", Trigger.Request())
            run.wait_until_still()
            answer = run.call(Trigger, "reconstruct_node/reconstruct", Trigger.Request())
            for name in ("localizer_node", "reconstruct_node"):
                run.call(Trigger, f"{name}/save", Trigger.Request())
            status = dict(run.status)
        finally:
            run.close()
        if not (refined.success and answer.success):
            raise RuntimeError(f"{refined.message}; {answer.message}")
        cloud = read_cloud(Path(folder) / "cloud.ply")
        truth = replace(read_true_surface(BAG / "truth/surfaces.npz"), seen=cloud.points)
        score = score_surface(truth, *read_mesh(Path(folder) / "mesh.ply"), thresholds=[0.05]).at[0]
        trajectory = read_tum(Path(folder) / "trajectory.tum")
        true, known = read_tum(BAG / "truth/trajectory.tum").interpolate(trajectory.stamps)
        off = (trajectory.planar() - se2.from_se3(true))[known]
        return {
            "killed": killed or "none",
            "kills": kills,
            "poses": len(trajectory),
            "mean off, mm": f"{1000 * np.hypot(off[:, 0], off[:, 1]).mean():.1f}",
            "vertical scans": status["/registrar_node"].get("scans kept to be placed anew", ""),
            "points": len(cloud),
            "F5": f"{100 * score.f_score:.2f}",
        }


def main() -> None:
    """Compare replays with kills to those without; see above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20, help="of each node")
    parser.add_argument("--without", type=int, default=2, help="how many replays without kills")
    parser.add_argument("--rate", type=float, default=1.0, help="speed of the replay")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--nodes", nargs="*", default=NODES, choices=NODES, help="to be killed")
    given = parser.parse_args()
    rclpy.init()
    rows: list[Row] = []
    for killed, kills in [("", 0)] * given.without + [(name, given.kills) for name in given.nodes]:
        rows.append(measure(killed, kills, given.rate, given.seed))
        sys.stderr.write(f"{rows[-1]}\n")
        OUT.mkdir(parents=True, exist_ok=True)
        note = (
            f"bags/first_floor at {given.rate:g} times real time; off: the saved trajectory from the true one; F5 in "
            f"percent, of the cloud of the same row. The load of the machine was {os.getloadavg()[1]:.1f} at the end."
        )
        save(OUT / "killed.json", Table("Nodes that are killed", note, {"": rows}))
    rclpy.shutdown()
    sys.stdout.write(page("", [OUT / "killed.json"]))


if __name__ == "__main__":
    main()
