# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What the map merger costs with more and more robots that drive at once, at 75 vertical scans a second each.

    python benchmarks/merger_cost.py

Robots are played by another process, from drives through the simulated floor: keyframes as their localizers tell them,
and a cloud of 100 points a vertical scan. Their starts are known, so that all clouds are placed from the beginning. The
table goes to out/benchmarks/collaboration_cost.json, from where benchmarks/collaboration.py takes it to its page, and
the picture to docs/merger_cost.png.
"""

from __future__ import annotations

import argparse
import os
import pickle
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
import report
from collaboration import WINDOW, drive, mapped, true_poses
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rclpy.executors import SingleThreadedExecutor
from report import Row, Table
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header, UInt8MultiArray

from g2_recon.collaboration.alignment import fitted
from g2_recon.geometry.cloud import Cloud, Piece
from g2_recon.geometry.session import Session, SessionPart, session_number
from g2_recon.nodes import conversions
from g2_recon.nodes.keyframes import message_of_part
from g2_recon.nodes.map_merger_node import MapMergerNode
from g2_recon.nodes.ros import LATCHED

ROOT = Path(__file__).parents[1]
ROBOTS = (1, 2, 4, 8)
RATE_HZ, POINTS, PIECE_SCANS = 75, 100, 16
NOTE = """\
CPU time of `map_merger_node` while robots drive at once, each with 75 vertical scans of 100 points a second. callbacks:
share of one core that the node takes to receive, place and hand on; merging: that of the process beside it, which rests
as long as each merging took; median, 99.9 % and longest: CPU time that callbacks take."""


class TimedMerger(MapMergerNode):
    """The merger, with the time that each of its callbacks takes."""

    def __init__(self) -> None:
        self.took: list[float] = []
        super().__init__()

    def _timed(self, action: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*given: Any) -> Any:
            began = time.thread_time()
            try:
                return action(*given)
            finally:
                self.took.append(time.thread_time() - began)

        return timed

    def create_timer(self, period: float, action: Any, *rest: Any, **how: Any) -> Any:
        """See Node."""
        return super().create_timer(period, self._timed(action), *rest, **how)

    def create_subscription(self, kind: Any, topic: str, take: Any, *rest: Any, **how: Any) -> Any:
        """See Node."""
        return super().create_subscription(kind, topic, self._timed(take), *rest, **how)


def parts_until(session: Session, first: int, stamp: float) -> SessionPart:
    """What a robot tells at a time: keyframes from `first` on."""
    count = int(np.searchsorted(session.stamps, stamp, side="right"))
    rows = slice(first, count)
    begins = session.local_maps[session.local_maps < count]
    kept = (session.loops < len(begins)).all(axis=1)
    return SessionPart(
        number=session_number(float(session.stamps[0]), session.points[0], session.kinds[0]),
        count=count,
        revision=count,
        last_stamp=stamp,
        poses=session.poses[:count],
        first=first,
        local_maps=begins,
        loops=session.loops[kept],
        loop_information=session.loop_information[kept],
        **session.of_rows(rows),
    )


def play(sessions: list[Session], seconds: float) -> None:
    """Be the robots, in real time."""
    rclpy.init()
    node = rclpy.create_node("robots")
    keyframes = [node.create_publisher(UInt8MultiArray, f"robot{k}/keyframes", LATCHED) for k in range(len(sessions))]
    clouds = [node.create_publisher(PointCloud2, f"robot{k}/cloud", 1000) for k in range(len(sessions))]
    while not all(publisher.get_subscription_count() for publisher in clouds):
        time.sleep(0.05)
    told = [0] * len(sessions)
    points = np.random.default_rng(0).uniform(-3, 3, (POINTS, 3))
    began = time.monotonic()
    for tick in range(int(seconds * RATE_HZ)):
        for k, session in enumerate(sessions):
            stamp = float(session.stamps[0]) + tick / RATE_HZ
            if (tick + 7 * k) % RATE_HZ == 0:
                part = parts_until(session, told[k], stamp)
                told[k] = part.count
                keyframes[k].publish(message_of_part(part, f"robot{k}/map"))
            head = Header(stamp=conversions.stamp_message(stamp), frame_id=f"robot{k}/map")
            at = session.poses[max(told[k] - 1, 0)]
            cloud = Cloud(points + [at[0], at[1], 0.0], np.broadcast_to([at[0], at[1], 0.5], points.shape))
            clouds[k].publish(conversions.cloud_to_message(head, cloud, Piece(9, tick // PIECE_SCANS), tick))
        time.sleep(max(0.0, began + (tick + 1) / RATE_HZ - time.monotonic()))
    time.sleep(2.0)
    node.destroy_node()
    rclpy.shutdown()


def robot_of(seed: int, begin: float) -> tuple[Session, str]:
    """The session of a robot, and where its map lies, as the parameter `starts` has it."""
    simulation = drive(seed, begin)
    session = mapped(simulation.recording).session
    x, y, yaw = fitted(session.poses, true_poses(session.stamps, simulation))
    return session, f"robot{seed} {x:.3f} {y:.3f} {yaw:.4f}"


def measured(sessions: list[Session], starts: list[str], seconds: float) -> Row:
    """The cost with these robots."""
    with tempfile.NamedTemporaryFile(suffix=".pickle") as file:
        pickle.dump((sessions, seconds), file)
        file.flush()
        rclpy.init(args=["merger", "--ros-args", "-p", "settle:=1000.0", "-p", f"starts:={starts}"])
        node = TimedMerger()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        thread = threading.Thread(target=executor.spin)
        thread.start()
        subprocess.run([sys.executable, __file__, "--play", file.name], check=True, env=dict(os.environ))
        merging = node._merging.process
        cpu = 0.0 if merging is None else cpu_seconds(merging.pid)
    received = node.received
    expected = int(seconds * RATE_HZ) * len(sessions)
    states = [node._state(robot)[1].state for robot in node._robots()]
    took = 1000 * np.array(node.took)
    share = took.sum() / 10 / seconds
    executor.shutdown()
    thread.join()
    row = {
        "robots": len(sessions),
        "aligned": states.count("aligned"),
        "scans received": f"{sum(received[f'robot{k}/cloud'] for k in range(len(sessions)))} of {expected}",
        "callbacks, % of a core": f"{share:.1f}",
        "a robot": f"{share / len(sessions):.1f}",
        "merging, % of a core": f"{100 * cpu / seconds:.1f}",
        "last merging, s": f"{node._merging_takes:.1f}",
        "median, ms": f"{np.median(took):.2f}",
        "99.9 %, ms": f"{np.quantile(took, 0.999):.1f}",
        "longest, ms": f"{took.max():.1f}",
        "memory, MB": f"{report.peak_mb():.0f}",
    }
    node.destroy_node()
    rclpy.shutdown()
    return row


def cpu_seconds(pid: int) -> float:
    """CPU time of another process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def picture(rows: Sequence[Row], path: Path) -> None:
    """Cost against robots."""
    figure = Figure(figsize=(7, 4))
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    robots = [row["robots"] for row in rows]
    for column, style in (("callbacks, % of a core", "o-"), ("merging, % of a core", "s-")):
        axes.plot(robots, [float(row[column]) for row in rows], style, label=column.split(",")[0])
    first = float(rows[0]["callbacks, % of a core"])
    axes.plot(
        robots, [first * count for count in robots], ":", color="gray", label="callbacks of one robot, times robots"
    )
    axes.set_xlabel("robots that drive at once, 75 vertical scans a second each")
    axes.set_ylabel("CPU, % of a core")
    axes.set_xticks(robots)
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the table and the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=40.0, help="so long robots drive (default: 40)")
    parser.add_argument("--robots", type=int, nargs="+", default=ROBOTS, help="so many robots (default: 1 2 4 8)")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    parser.add_argument("--picture", type=Path, default=ROOT / "docs/merger_cost.png")
    parser.add_argument("--play", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.play:
        play(*pickle.loads(given.play.read_bytes()))
        return
    given.out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    robots = [robot_of(k, rng.uniform(0, 1 - WINDOW)) for k in range(max(given.robots))]
    sessions, starts = map(list, zip(*robots, strict=True))
    rows = [measured(sessions[:count], starts[:count], given.seconds) for count in given.robots]
    table = Table("What the merger costs", NOTE, {"": rows}, [given.picture.name])
    report.save(given.out / "collaboration_cost.json", table)
    picture(rows, given.picture)
    sys.stdout.write(table.markdown() + "\n")


if __name__ == "__main__":
    main()
