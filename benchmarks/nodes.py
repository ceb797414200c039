# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The nodes of a robot, in processes of their own, on a replay of bags/first_floor: how soon, how much, what is lost.

    python benchmarks/nodes.py [--rates 1 4] [--every-scan] [--cores 0,1]

A node is ready when its first diagnostics come. What a scan takes to its pose, and a vertical scan to its cloud after
the first pose that covers it has come, is measured by whoever subscribes, so two ways through DDS are in it. Cores and
memory are those of the three nodes together, from the first scan to the last; memory is what /proc calls Pss: what
processes share counts once. The recording holds 25 of the 75 horizontal scans of each second, and 3 of the 75 vertical
ones; with --every-scan, the same drive is replayed with all of them.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import SingleThreadedExecutor
from report import Table, page, save
from sensor_msgs.msg import LaserScan, PointCloud2

from g2_recon.config import SimulationConfig
from g2_recon.nodes import conversions
from g2_recon.nodes.ros import reliable_qos, sensor_qos
from g2_recon.recording.bag_writing import write_bag
from g2_recon.simulation.simulator import simulate

ROOT = Path(__file__).parents[1]
OUT = ROOT / "out/benchmarks"
BAG = ROOT / "bags/first_floor"
NODES = ("localizer_node", "registrar_node", "reconstruct_node")
# Until counts that stand still are final.
_STILL_S = 5.0


class Watch:
    """What comes when, by topic and stamp in nanoseconds, and what the nodes say of themselves."""

    def __init__(self) -> None:
        self.node = rclpy.create_node("benchmark")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.came: dict[str, dict[int, float]] = {name: {} for name in ("scan", "scan_vertical", "pose", "cloud")}
        self.status: dict[str, dict[str, str]] = {}
        # Of vertical scans: how long the last beam is measured after the first.
        self.lasted: dict[int, int] = {}
        for topic, kind, qos in (
            ("scan", LaserScan, sensor_qos(10_000)),
            ("scan_vertical", LaserScan, sensor_qos(10_000)),
            ("pose", PoseWithCovarianceStamped, reliable_qos(10_000)),
            ("cloud", PointCloud2, reliable_qos(10_000)),
        ):
            self.node.create_subscription(kind, topic, self._taker(topic), qos)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._note, 100)

    def spin_until(self, holds: Callable[[], Any], seconds: float = 900.0) -> None:
        """Take what comes until something holds."""
        end = time.monotonic() + seconds
        while not holds():
            if time.monotonic() > end:
                raise TimeoutError
            self.executor.spin_once(timeout_sec=0.05)

    def _taker(self, topic: str) -> Callable[[Any], None]:
        def take(message: Any) -> None:
            now = time.monotonic()
            if topic == "cloud" and (piece := conversions.piece_from_message(message)) and piece.revision:
                return
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            self.came[topic].setdefault(stamp, now)
            if topic == "scan_vertical":
                self.lasted[stamp] = math.ceil(1e9 * message.time_increment * (len(message.ranges) - 1))

        return take

    def _note(self, message: DiagnosticArray) -> None:
        self.status[message.status[0].name] = {pair.key: pair.value for pair in message.status[0].values}


def begin(
    name: str, *arguments: str, cache: str | None = None, log: IO[bytes] | None = None
) -> subprocess.Popen[bytes]:
    """Start a node. cache: the folder of its kernels, where it is not the usual one. log: where it writes it."""
    command = [sys.executable, "-m", f"g2_recon.nodes.{name}", "--ros-args"]
    return subprocess.Popen(
        [*command, "--params-file", str(ROOT / "config/g2.yaml"), "-p", "queue_depth:=20000", *arguments],
        cwd=ROOT,
        env=os.environ
        | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
        | ({} if cache is None else {"NUMBA_CACHE_DIR": cache}),
        stdout=subprocess.DEVNULL,
        stderr=log or subprocess.DEVNULL,
    )


def processor_s(pids: list[int]) -> float:
    """Processor time so far of these processes."""
    ticks = [Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split() for pid in pids]
    return sum(int(each[11]) + int(each[12]) for each in ticks) / os.sysconf("SC_CLK_TCK")


def memory_mb(pid: int) -> float:
    """What a process takes, of a page that several share its part."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1024


def measure(bag: Path, rate: float) -> dict[str, Any]:
    """A row of the table: one replay."""
    watch = Watch()
    processes = {}
    ready = []
    try:
        for name in NODES:
            started = time.monotonic()
            processes[name] = begin(name, "-p", "use_sim_time:=true")
            watch.spin_until(lambda name=name: f"/{name}" in watch.status)
            ready.append(time.monotonic() - started)
        pids = [process.pid for process in processes.values()]
        replay = processes["replay_node"] = begin("replay_node", "-p", f"bag:={bag}", "-p", f"rate:={rate}")
        watch.spin_until(lambda: watch.came["scan"])
        began, used = time.monotonic(), processor_s(pids)
        watch.spin_until(lambda: replay.poll() is not None)
        took, used = time.monotonic() - began, processor_s(pids) - used
        before: dict[str, int] = {}
        while before != (now := {topic: len(came) for topic, came in watch.came.items()}):
            before, end = now, time.monotonic() + _STILL_S
            watch.spin_until(lambda end=end: time.monotonic() > end)
        return _row(watch, rate, ready, used / took, [memory_mb(pid) for pid in pids])
    finally:
        for process in processes.values():
            process.kill()
            process.wait()
        watch.executor.shutdown()
        watch.node.destroy_node()


def _row(watch: Watch, rate: float, ready: list[float], cores: float, memory: list[float]) -> dict[str, Any]:
    came = watch.came
    to_pose = np.array([came["pose"][stamp] - at for stamp, at in came["scan"].items() if stamp in came["pose"]])
    stamps = np.array(sorted(came["pose"]))
    to_cloud = []
    for stamp, at in came["cloud"].items():
        if stamp not in watch.lasted:
            continue
        row = int(np.searchsorted(stamps, stamp + watch.lasted[stamp]))
        if row < len(stamps):
            to_cloud.append(at - max(came["pose"][int(stamps[row])], came["scan_vertical"][stamp]))
    return {
        "speed": f"{rate:g}",
        "ready s": " ".join(f"{each:.1f}" for each in ready),
        "scans": len(came["scan"]),
        "poses": len(came["pose"]),
        "pose after ms, median": f"{1e3 * np.median(to_pose):.1f}",
        "pose, 99 %": f"{1e3 * np.quantile(to_pose, 0.99):.1f}",
        "vertical scans": len(came["scan_vertical"]),
        "clouds": len(came["cloud"]),
        "cloud after ms, median": f"{1e3 * np.median(to_cloud):.1f}",
        "cloud, 99 %": f"{1e3 * np.quantile(to_cloud, 0.99):.1f}",
        "dropped": sum(int(n) for s in watch.status.values() for key, n in s.items() if key.startswith("dropped")),
        "cores": f"{cores:.2f}",
        "MB": f"{sum(memory):.0f}",
        "of each": " ".join(f"{each:.0f}" for each in memory),
    }


def main() -> None:
    """Measure; see above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", type=float, nargs="+", default=[1.0, 4.0], help="speeds of the replay")
    parser.add_argument("--every-scan", action="store_true", help="replay the drive with all scans, too")
    parser.add_argument("--cores", help="processors to run on, such as 0,1; default: all")
    given = parser.parse_args()
    if given.cores:
        os.sched_setaffinity(0, {int(core) for core in given.cores.split(",")})
    rclpy.init()
    rows = [measure(BAG, rate) for rate in given.rates]
    if given.every_scan:
        with tempfile.TemporaryDirectory() as folder:
            bag = Path(folder) / "every_scan"
            write_bag(bag, simulate(SimulationConfig(horizontal_every=1, vertical_every=1)).recording)
            rows += [measure(bag, rate) for rate in given.rates]
    rclpy.shutdown()
    OUT.mkdir(parents=True, exist_ok=True)
    load = os.getloadavg()[1]
    note = (
        "Speed: times real time. Ready: localizer, registrar, reconstruction, one after the other, kernels compiled. "
        f"The load of the machine was {load:.1f} at the end, that of the nodes and the replay included."
    )
    save(OUT / "nodes.json", Table("A recording replayed", note, {"": rows}))
    sys.stdout.write(page("", [OUT / "nodes.json"]))


if __name__ == "__main__":
    main()
