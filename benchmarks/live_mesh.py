# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The live mesh: how soon new data shows in it, and how near it comes to the offline mesh of the same data.

    python benchmarks/live_mesh.py --clouds FOLDER

FOLDER holds floor_rot.npz: `points` with `sensor` and the `scan` (N,) that each is of, and the truth beside them. The
scans of it, and those of bags/first_floor, are sent to a reconstruct_node in a process of its own, one a message, as a
registrar does; then a third of them once more from 5 cm higher up, as after a closed loop, and once more from where
they were. A scan is shown once a message of `mesh` has its stamp or that of a later one. Meanwhile another process
calls ~/pause again and again: what it takes to answer is how long the executor was held.
"""

from __future__ import annotations

import argparse
import os
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Lock, Thread

import numpy as np
import rclpy
from nodes import BAG, OUT, ROOT, processor_s
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from report import Row, Table, page, save
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker, MarkerArray

from g2_recon.config import G2ReconConfig, ReconstructionConfig
from g2_recon.evaluation.surface import score_surface
from g2_recon.geometry.cloud import Cloud, Piece, concatenate
from g2_recon.geometry.mesh import TrueSurface
from g2_recon.nodes import conversions
from g2_recon.nodes.ros import reliable_qos
from g2_recon.pipeline import localize, register
from g2_recon.reconstruction.reconstructor import reconstruct
from g2_recon.recording.bags import read_bag
from g2_recon.recording.surfaces import read_true_surface

# So many scans a message of the correction, as the registrar has them in a piece; moved by so much, m.
_SCANS_A_PIECE = 16
_CORRECTION_M = 0.05
# All that was sent is shown, or never will be.
_LONGEST_S = 60.0
_QUIET_S = 2.5
# Between two calls of the service.
_ASKING_S = 0.05
_ANSWERED_S = 5.0


@dataclass(frozen=True, slots=True)
class Scene:
    """A cloud in pieces and the surface that it was measured on."""

    name: str
    pieces: list[Cloud]
    truth: TrueSurface

    def whole(self) -> Cloud:
        """All pieces."""
        return concatenate(self.pieces)

    def f5(self, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> float:
        """F5 in percent."""
        return 100 * score_surface(self.truth, vertices, faces, thresholds=[0.05]).at[0].f_score


def floor(path: Path) -> Scene:
    """A floor of a building, scan by scan."""
    data = np.load(path)
    order = np.argsort(data["scan"], kind="stable")
    starts = np.flatnonzero(np.diff(data["scan"][order])) + 1
    whole = Cloud(data["points"].astype(float), data["sensor"].astype(float))
    return Scene(path.stem, [whole.select(rows) for rows in np.split(order, starts)], read_true_surface(path))


def first_floor() -> Scene:
    """The recording of the package, as it is registered offline; pieces of about a scan."""
    recording, settings = read_bag(BAG), G2ReconConfig()
    trajectory = localize(recording, settings.localization).trajectory
    cloud = register(recording, trajectory, settings.registration).cloud
    pieces = [cloud.select(rows) for rows in np.array_split(np.arange(len(cloud)), len(cloud) // 170)]
    truth = read_true_surface(BAG / "truth/surfaces.npz")
    return Scene("bags/first_floor", pieces, TrueSurface(truth.vertices, truth.faces, cloud.points))


class Watched:
    """A reconstruct_node, what it shows, and how soon."""

    def __init__(self, rebuild: str) -> None:
        self._node = rclpy.create_node("benchmark")
        qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        # As bytes: to make objects of a whole mesh takes longer than what is to be measured.
        self._node.create_subscription(MarkerArray, "mesh", self._on_mesh, qos, raw=True)
        self._clouds = self._node.create_publisher(PointCloud2, "cloud", reliable_qos(10_000))
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._thread = Thread(target=self._executor.spin, daemon=True)
        self._thread.start()
        self._taking = Lock()
        self.messages: list[bytes] = []
        self._stamp = 0
        self.waiting: list[tuple[int, float]] = []
        self.delays: list[float] = []
        self.last_shown = 0.0
        self._process = subprocess.Popen(
            [sys.executable, "-m", "g2_recon.nodes.reconstruct_node", "--ros-args", "-p", f"rebuild:={rebuild}"]
            + ["-p", "rebuild_period:=1.0", "-p", "queue_depth:=10000"],
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
            stderr=subprocess.DEVNULL,
        )
        self._asked, asks = get_context("spawn").Pipe()
        self._asker = get_context("spawn").Process(target=_ask, args=(asks,), daemon=True)
        self._asker.start()
        # Lest one wait for an asker that is gone.
        asks.close()
        wait(lambda: self._clouds.get_subscription_count() > 0)
        while not self.answers():
            time.sleep(0.1)

    def close(self) -> None:
        """Kill the node."""
        self._asker.kill()
        self._asker.join()
        self._process.kill()
        self._process.wait()
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()

    def send(self, cloud: Cloud, piece: int, revision: int = 0) -> None:
        """Send a cloud, with a stamp one second after that of the one before."""
        self._stamp += 1
        head = Header(stamp=conversions.stamp_message(float(self._stamp)), frame_id="map")
        message = conversions.cloud_to_message(head, cloud, Piece(1, piece, revision))
        with self._taking:
            self.waiting.append((self._stamp, time.monotonic()))
        self._clouds.publish(message)

    def answers(self) -> list[float]:
        """What a service that has nothing to do took to answer, s, since this was asked before."""
        self._asked.send(None)
        return list(self._asked.recv())

    def settle(self) -> None:
        """Wait until the mesh has shown all that was sent, and what is shown has stood still."""
        wait(lambda: not self.waiting, _LONGEST_S)
        wait(lambda: time.monotonic() - self.last_shown > _QUIET_S, _LONGEST_S)

    def reconstruct(self) -> str:
        """~/reconstruct."""
        client = self._node.create_client(Trigger, "reconstruct_node/reconstruct")
        client.wait_for_service(10)
        future = client.call_async(Trigger.Request())
        wait(future.done, _LONGEST_S)
        return str(future.result().message)

    def begin(self) -> None:
        """Count what the node uses from here on."""
        self._began, self._used = time.monotonic(), processor_s([self._process.pid])

    def figures(self) -> Row:
        """What a row says of the node; delays are those since this was asked before."""
        answers = 1e3 * np.array(self.answers())
        with self._taking:
            delays, self.delays = 1e3 * np.array(self.delays), []
        took, used = time.monotonic() - self._began, processor_s([self._process.pid]) - self._used
        return {
            "shown after ms, median": f"{np.median(delays):.0f}" if len(delays) else "",
            "95 %": f"{np.quantile(delays, 0.95):.0f}" if len(delays) else "",
            "most": f"{delays.max():.0f}" if len(delays) else "",
            "answers ms, 99 %": f"{np.quantile(answers, 0.99):.1f}" if len(answers) else "",
            "answers, most": f"{answers.max():.1f}" if len(answers) else "",
            "cores": f"{used / took:.2f}",
            "MB": f"{self._memory_mb():.0f}",
        }

    def _memory_mb(self) -> float:
        """Of the node, now."""
        status = Path(f"/proc/{self._process.pid}/status").read_text()
        return int(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1]) / 1024

    def _on_mesh(self, message: bytes) -> None:
        now = time.monotonic()
        stamp = _stamp_s(message)
        with self._taking:
            self.messages.append(message)
            self.delays += [now - sent for number, sent in self.waiting if number <= stamp]
            self.waiting = [(number, sent) for number, sent in self.waiting if number > stamp]
        self.last_shown = now


def _stamp_s(message: bytes) -> int:
    """Seconds of the stamp of a MarkerArray, which is that of all of its markers: behind its head and their number."""
    return int(struct.unpack_from("<i", message, 8)[0])


class Shown:
    """What a viewer shows of messages of `mesh`."""

    def __init__(self) -> None:
        self._corners: dict[tuple[str, int], NDArray[np.float64]] = {}

    def take(self, message: MarkerArray) -> None:
        """Do what a message says."""
        for marker in message.markers:
            if marker.action == Marker.DELETEALL:
                self._corners.clear()
            elif marker.action == Marker.DELETE:
                self._corners.pop((marker.ns, marker.id), None)
            else:
                self._corners[marker.ns, marker.id] = np.array([(p.x, p.y, p.z) for p in marker.points])

    def mesh(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Vertices and faces; corners at one place are one vertex."""
        vertices, number = np.unique(np.concatenate(list(self._corners.values())), axis=0, return_inverse=True)
        return vertices, number.reshape(-1, 3)


def _ask(asked: Connection) -> None:
    """Call ~/pause again and again, and tell what the answers took."""
    rclpy.init()
    node = rclpy.create_node("asker")
    client = node.create_client(SetBool, "reconstruct_node/pause")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    client.wait_for_service()
    took: list[float] = []
    known = False
    while True:
        began = time.monotonic()
        future = client.call_async(SetBool.Request(data=False))
        # Not spin_until_future_complete, which takes longer each time: it leaves something behind.
        while not future.done() and time.monotonic() - began < _ANSWERED_S:
            executor.spin_once(timeout_sec=0.1)
        # A node that was just found may not have found who asks, and its answer is lost.
        known = known or future.done()
        if known:
            took.append(time.monotonic() - began)
        if asked.poll(_ASKING_S):
            asked.recv()
            asked.send(took)
            took = []


def wait(holds, seconds: float = 120.0) -> None:  # type: ignore[no-untyped-def]
    """Wait until something holds."""
    end = time.monotonic() + seconds
    while not holds():
        if time.monotonic() > end:
            raise TimeoutError
        time.sleep(0.01)


@contextmanager
def watched(rebuild: str) -> Iterator[Watched]:
    """A node that is killed at the end."""
    node = Watched(rebuild)
    try:
        yield node
    finally:
        node.close()


def measure(scene: Scene, rebuild: str, rate: float) -> list[Row]:
    """Rows of the table: while it grows, at its full size, after a correction, after ~/reconstruct."""
    offline = reconstruct(scene.whole(), ReconstructionConfig()).mesh
    rows: list[Row] = []
    messages: list[int] = []

    def note(what: str) -> None:
        # Meshes are looked at in the end: meanwhile it would hold what is to be sent, and the processor.
        rows.append({"cloud": scene.name, "points": len(scene.whole()), "what": what} | node.figures())
        messages.append(len(node.messages))

    with watched(rebuild) as node:
        node.begin()
        began = time.monotonic()
        for number, cloud in enumerate(scene.pieces):
            node.send(cloud, number // _SCANS_A_PIECE)
            time.sleep(max(0.0, began + number / rate - time.monotonic()))
            if number == len(scene.pieces) * 9 // 10:
                # What is shown from here on is at nine tenths of the size or more.
                note("while it grows to 90 %")
        node.settle()
        note("to its end")
        node.begin()
        count = -(-len(scene.pieces) // _SCANS_A_PIECE)
        for revision, lift in ((1, _CORRECTION_M), (2, 0.0)):
            for number in range(count // 3, 2 * count // 3):
                part = concatenate(scene.pieces[number * _SCANS_A_PIECE : (number + 1) * _SCANS_A_PIECE])
                up = np.array([0.0, 0.0, lift])
                sensor = None if part.sensor is None else part.sensor + up
                node.send(Cloud(part.points + up, sensor), number, revision)
            node.settle()
        note("a third of it moved and back")
        node.begin()
        node.reconstruct()
        time.sleep(_QUIET_S)
        note("after ~/reconstruct")
    shown, offline_f5 = Shown(), scene.f5(offline.vertices, offline.faces)
    for row, begin, end in zip(rows, [0, *messages], messages, strict=False):
        for message in node.messages[begin:end]:
            shown.take(deserialize_message(message, MarkerArray))
        vertices, faces = shown.mesh()
        f5 = scene.f5(vertices, faces)
        row |= {"F5": f"{f5:.2f}", "offline": f"{offline_f5:.2f}", "faces": len(faces)}
    return rows


def main() -> None:
    """Measure; see above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clouds", type=Path, help="folder with floor_rot.npz; without it only the recording")
    parser.add_argument("--rebuild", default="continuous", choices=["continuous", "every_n_seconds"])
    parser.add_argument("--rate", type=float, default=10.0, help="scans a second; a robot at 0.5 m/s has one each 8 cm")
    given = parser.parse_args()
    scenes = [floor(given.clouds / "floor_rot.npz")] if given.clouds else []
    scenes.append(first_floor())
    rclpy.init()
    rows = [row for scene in scenes for row in measure(scene, given.rebuild, given.rate)]
    rclpy.shutdown()
    OUT.mkdir(parents=True, exist_ok=True)
    note = (
        f"`rebuild: {given.rebuild}`, {given.rate:g} scans a second. Answers are those of a service that has nothing "
        "to do, over DDS and back; cores and MB are those of the node; F5 in percent. "
        f"The load of the machine was {os.getloadavg()[1]:.1f} at the end, that of this benchmark included."
    )
    save(OUT / "live_mesh.json", Table("The live mesh", note, {"": rows}))
    whole = page(HEAD, [OUT / f"{name}.json" for name in ("live_mesh", "nodes", "killed", "soak", "start_up")])
    sys.stdout.write(whole)
    (OUT / "live_benchmarks.md").write_text(whole)


HEAD = """# Benchmarks of the nodes

Made by

    python benchmarks/nodes.py
    python benchmarks/live_mesh.py --clouds FOLDER
    python benchmarks/killed.py
    python benchmarks/soak.py
    python benchmarks/start_up.py --first

with the clouds of [the benchmarks of surfaces](benchmarks.md); this page is copied from `out/benchmarks/`.
Times tell what a robot would see only on a quiet machine: with a load of 9 on 2 cores, all waits are several times too
long. F5, faces, cores and memory hardly depend on it.
"""


if __name__ == "__main__":
    main()
