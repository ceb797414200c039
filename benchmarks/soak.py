# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What the nodes take of memory over a long time: a robot that stands for ten minutes, then drives where it knows all.

    python benchmarks/soak.py [--rate 4]

A simulated robot drives once through all rooms, stands for ten minutes, and drives through the same rooms for ten more.
The recording is replayed, no faster than poses come, to real nodes in processes of their own, which keep their
journals. Memory is what /proc calls RssAnon, which does not hang on what other processes share. What comes after the
first minute of standing, and of driving, is compared with that minute: journals on the disk may grow, memory may not.
The reconstruction takes more while it works than between, so medians of a minute and the most are told, each beside its
like.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from nodes import NODES, begin
from numpy.typing import NDArray
from report import Row, Table, page, save
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

from g2_recon.config import SimulationConfig
from g2_recon.geometry.recording import Recording
from g2_recon.geometry.scan import Scan
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.nodes.conversions import stamp_seconds
from g2_recon.recording.bag_writing import write_bag
from g2_recon.simulation.simulator import REST, START, simulate
from g2_recon.simulation.tours import FULL_TOUR

ROOT = Path(__file__).parents[1]
OUT = ROOT / "out/benchmarks"
PICTURE = ROOT / "docs/soak.png"

STANDING_S = DRIVING_S = 600.0
MINUTE_S = 60.0
# From where the tour ends to where it begins.
_BACK = ((5.40, 4.20), (5.40, 1.00))
# Memory is looked at so often, s of wall time: an update of the mesh takes less than a second, and what it takes most
# less than a tenth of that.
_PERIOD_S = 0.02
# The replay is held where poses are so much older than its clock, until they are not, s.
_MOST_BEHIND_S, _FEW_BEHIND_S = 3.0, 0.5
# What the replay had sent is done when memory has stood still for so long, s of wall time.
_AFTERWARDS_S = 20.0

Float = NDArray[np.float64]


def recording_of_soak(seed: int = 0) -> tuple[Recording, float]:
    """The recording, and the stamp at which the robot begins to stand."""
    config = SimulationConfig(seed=seed)
    # One tour to know the rooms, then as many as it takes; the robot stands in the rest after the first one.
    whole = simulate(config, legs=[*FULL_TOUR, _BACK] * 3 + [*FULL_TOUR])
    sparse = SimulationConfig(horizontal_every=1000, vertical_every=1000)
    stops = float(simulate(sparse, legs=FULL_TOUR).trajectory.stamps[-1]) - 0.2 * REST
    end = stops + DRIVING_S
    recording = whole.recording
    odometry = recording.odometry
    before = odometry.stamps <= stops
    driving = ~before & (odometry.stamps <= end)
    stands = stops + np.arange(1, int(STANDING_S * config.odometry_rate)) / config.odometry_rate
    last = int(np.flatnonzero(before)[-1])
    rows = np.concatenate([np.flatnonzero(before), np.full(len(stands), last), np.flatnonzero(driving)])
    stamps = np.concatenate([odometry.stamps[before], stands, odometry.stamps[driving] + STANDING_S])
    return replace(
        recording,
        scans=list(_with_standing(recording.scans, stops, end)),
        scans_vertical=list(_with_standing(recording.scans_vertical, stops, end)),
        odometry=Trajectory(stamps, odometry.positions[rows], odometry.quaternions[rows]),
    ), stops


def _with_standing(scans: list[Scan], stops: float, end: float) -> Iterable[Scan]:
    """Scans until `stops`, those of the rest there over and over, and those until `end` later by so much."""
    before = [scan for scan in scans if scan.stamp <= stops]
    resting = [scan for scan in before if scan.stamp > stops - 0.6 * REST]
    period = before[-1].stamp - before[-2].stamp
    yield from before
    for number in range(int(STANDING_S / period) - 1):
        yield replace(resting[number % len(resting)], stamp=before[-1].stamp + (number + 1) * period)
    for scan in scans:
        if stops < scan.stamp <= end:
            yield replace(scan, stamp=scan.stamp + STANDING_S)


def measure(bag: Path, rate: float, session: Path) -> tuple[Float, dict[str, Float]]:
    """Stamps (N,) of the replay and memory (N,) in MB of each node then, until all is done."""
    node = rclpy.create_node("benchmark")
    clock = [0.0]
    pose = [0.0]
    node.create_subscription(Clock, "/clock", lambda message: clock.append(stamp_seconds(message.clock)), 10)
    node.create_subscription(
        PoseWithCovarianceStamped, "pose", lambda message: pose.append(stamp_seconds(message.header.stamp)), 10
    )
    pause = node.create_client(SetBool, "replay_node/pause")
    held = False
    processes = {
        name: begin(name, "-p", "use_sim_time:=true", "-p", f"session_dir:={session / name}") for name in NODES
    }
    replay = begin("replay_node", "-p", f"bag:={bag}", "-p", f"rate:={rate}", "-p", "wait_for_subscribers:=60.0")
    stamps: list[float] = []
    memory: dict[str, list[float]] = {name: [] for name in NODES}
    ended = 0.0
    try:
        while not ended or time.monotonic() < ended + _AFTERWARDS_S:
            until = time.monotonic() + _PERIOD_S
            while time.monotonic() < until:
                rclpy.spin_once(node, timeout_sec=max(0.0, until - time.monotonic()))
                del clock[:-1], pose[:-1]
                behind = clock[-1] - pose[-1] if pose[-1] else 0.0
                if held != (behind > (_FEW_BEHIND_S if held else _MOST_BEHIND_S)):
                    held = not held
                    pause.call_async(SetBool.Request(data=held))
            # What is done after the end of the replay is of no minute, but of what comes later.
            stamps.append(clock[-1] + (time.monotonic() - ended if ended else 0.0))
            for name, process in processes.items():
                memory[name].append(anonymous_mb(process.pid))
            if not ended and replay.poll() is not None:
                ended = time.monotonic()
    finally:
        for process in (*processes.values(), replay):
            process.kill()
            process.wait()
        node.destroy_node()
    return np.array(stamps), {name: np.array(values) for name, values in memory.items()}


def anonymous_mb(pid: int) -> float:
    """Memory of a process that is no file."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("RssAnon")).split()[1]) / 1024


def rows_of(stamps: Float, memory: dict[str, Float], stands: float) -> list[Row]:
    """What each node takes, and all of them, in the first minute of a part of the recording and after that."""
    rows = []
    for part, since, lasts, until in (
        ("standing", stands, STANDING_S, STANDING_S),
        ("driving", stands + STANDING_S, DRIVING_S, np.inf),
    ):
        for name, values in [*memory.items(), ("all", np.sum(list(memory.values()), axis=0))]:
            first, later, last = (
                values[(stamps > since + begin) & (stamps <= since + end)]
                for begin, end in ((0, MINUTE_S), (MINUTE_S, until), (lasts - MINUTE_S, lasts))
            )
            rows.append(
                {
                    "part": part,
                    "node": name,
                    "median, first minute": f"{np.median(first):.1f}",
                    "last minute": f"{np.median(last):.1f}",
                    "growth, %": f"{100 * (np.median(last) / np.median(first) - 1):.1f}",
                    "most, first minute": f"{first.max():.1f}",
                    "most, later": f"{later.max():.1f}",
                    "growth of the most, %": f"{100 * (later.max() / first.max() - 1):.1f}",
                }
            )
    return rows


def picture(stamps: Float, memory: dict[str, Float], stands: float, path: Path) -> None:
    """Memory over time."""
    figure = Figure(figsize=(8, 4))
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    minutes = (stamps - START) / 60
    began = stamps > 0
    for name, values in memory.items():
        axes.plot(minutes[began], values[began], label=name)
    for stamp in (stands, stands + STANDING_S):
        axes.axvline((stamp - START) / 60, color="gray", linestyle=":")
    axes.set_xlabel("simulated minutes: a tour, ten of standing, ten of driving")
    axes.set_ylabel("memory, MB (RssAnon)")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110, metadata={"Software": None})


def main() -> None:
    """Measure; see above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--rate",
        type=float,
        default=1.0,
        help="speed of the replay; with more than 1, more comes between two updates of the mesh",
    )
    given = parser.parse_args()
    rclpy.init()
    with tempfile.TemporaryDirectory() as folder:
        recording, stands = recording_of_soak()
        write_bag(Path(folder) / "soak", recording)
        stamps, memory = measure(Path(folder) / "soak", given.rate, Path(folder))
    rclpy.shutdown()
    OUT.mkdir(parents=True, exist_ok=True)
    np.savez(OUT / "soak.npz", stamps=stamps, stands=stands, **memory)
    picture(stamps, memory, stands, PICTURE)
    note = (
        f"Memory (RssAnon) of each node in MB, at up to {given.rate:g} times real time. "
        f"The load of the machine was {os.getloadavg()[1]:.1f} at the end."
    )
    table = Table("Ten minutes of standing, ten of driving", note, {"": rows_of(stamps, memory, stands)}, ["soak.png"])
    save(OUT / "soak.json", table)
    sys.stdout.write(page("", [OUT / "soak.json"]))


if __name__ == "__main__":
    main()
