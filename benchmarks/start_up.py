# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""How soon after its start a node is heard, and works when its kernels have to be compiled.

    python benchmarks/start_up.py [--starts 10] [--first]

A node is heard when another process has its first diagnostics: alone, and while the others run. With several around,
Fast DDS lets one that was there before find a new one at times only when it announces itself again, every 3 s; so it is
measured with one that does so every 0.2 s, too, and with a node of rclpy that does nothing but publish. With --first,
nodes are started with no kernels on the disk, each alone and all at once, and work when they say so.
"""

from __future__ import annotations

import argparse
import itertools
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from nodes import NODES, OUT, Watch, begin
from report import Table, page, save

# Between two announcements of the process that listens, s: the default of Fast DDS, and often.
_PERIODS_S = (3.0, 0.2)
_LONGEST_S = 300.0
_PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"

# What a node says when it has no kernels, when it works, and when it has them all.
_SAID = {
    "says so after s": "compiling kernels",
    "works after s": "kernels are compiled",
    "has all kernels after s": "all kernels are compiled",
}

_BARE = "bare_node"
_BARE_NODE = """
import time
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
rclpy.init()
publisher = rclpy.create_node("bare_node").create_publisher(DiagnosticArray, "/diagnostics", 10)
while True:
    publisher.publish(DiagnosticArray(status=[DiagnosticStatus(name="/bare_node")]))
    time.sleep(0.05)
"""

_PROFILE = """<?xml version="1.0" encoding="UTF-8" ?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <participant profile_name="listener" is_default_profile="true"><rtps><builtin><discovery_config>
    <leaseAnnouncement><nanosec>{}</nanosec></leaseAnnouncement>
  </discovery_config></builtin></rtps></participant>
</profiles>
"""


@contextmanager
def hearing(watch: Watch, name: str) -> Iterator[float]:
    """A node that runs, and how long after its start it was heard."""
    watch.status.clear()
    began = time.monotonic()
    process = begin(name) if name != _BARE else begin_bare()
    try:
        watch.spin_until(lambda: f"/{name}" in watch.status, _LONGEST_S)
        yield time.monotonic() - began
    finally:
        # Not killed: who is killed counts as there for another 20 s.
        process.send_signal(signal.SIGINT)
        process.wait(_LONGEST_S)
        # What it said last, lest it be taken for the next one.
        end = time.monotonic() + 0.5
        watch.spin_until(lambda: time.monotonic() > end)


def heard_after_s(watch: Watch, name: str) -> float:
    """How long after its start a node is heard."""
    with hearing(watch, name) as took:
        return took


def begin_bare() -> subprocess.Popen[bytes]:
    """Start a node that does nothing but publish."""
    return subprocess.Popen([sys.executable, "-c", _BARE_NODE], stderr=subprocess.DEVNULL)


def heard(period: float, starts: int) -> list[dict[str, Any]]:
    """Rows of a table: each node, heard by a process that announces itself so often."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ.pop(_PROFILES, None)
        if period < 1:
            profile = Path(folder) / "profile.xml"
            profile.write_text(_PROFILE.format(round(1e9 * period)))
            os.environ[_PROFILES] = str(profile)
        rclpy.init()
        watch = Watch()
        # Of this process only, not of the nodes.
        os.environ.pop(_PROFILES, None)
        rows = []
        for name, others in itertools.product((_BARE, *NODES), (False, True)):
            with ExitStack() as running:
                beside = [other for other in NODES if other != name] if others else []
                for other in beside:
                    running.enter_context(hearing(watch, other))
                took = [heard_after_s(watch, name) for _ in range(starts)]
            rows.append(
                {
                    "node": name,
                    "announced every s": f"{period:g}",
                    "beside it": len(beside),
                    "heard after s, median": f"{np.median(took):.1f}",
                    "90 %": f"{np.quantile(took, 0.9):.1f}",
                    "most": f"{max(took):.1f}",
                }
            )
        return rows


def first_start(*names: str) -> list[dict[str, Any]]:
    """Rows of a table: nodes that are started at once and have no kernels yet."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as running:
        began, logs = time.monotonic(), {name: Path(folder) / name for name in names}
        for name, log in logs.items():
            process = begin(name, cache=str(Path(folder) / "cache"), log=running.enter_context(log.open("wb")))
            running.callback(process.wait)
            running.callback(process.terminate)
        said = _when_said(logs, began)
        return [
            {"node": name, "started": "alone" if len(names) == 1 else "with the others"}
            | {column: f"{said[name, words]:.1f}" for column, words in _SAID.items()}
            for name in names
        ]


def _when_said(logs: dict[str, Path], began: float) -> dict[tuple[str, str], float]:
    """How long after the beginning, s, each of some logs held what it is to hold in the end."""
    end = time.monotonic() + _LONGEST_S
    awaited = set(itertools.product(logs, _SAID.values()))
    said: dict[tuple[str, str], float] = {}
    while awaited:
        if time.monotonic() > end:
            raise TimeoutError(f"never said: {awaited}")
        time.sleep(0.05)
        texts = {name: log.read_text() for name, log in logs.items()}
        come = {(name, words) for name, words in awaited if words in texts[name]}
        said |= dict.fromkeys(come, time.monotonic() - began)
        awaited -= come
    return said


def main() -> None:
    """Measure; see above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--starts", type=int, default=10, help="of each node and listener")
    parser.add_argument("--first", action="store_true", help="start each without kernels on the disk, too")
    given = parser.parse_args()
    sections: dict[str, list[dict[str, Any]]] = {"": []}
    for period in _PERIODS_S:
        # A profile is read once in a process.
        with get_context("spawn").Pool(1) as pool:
            sections[""] += pool.apply(heard, (period, given.starts))
    if given.first:
        sections["The first start ever"] = [row for name in NODES for row in first_start(name)] + first_start(*NODES)
    OUT.mkdir(parents=True, exist_ok=True)
    note = f"{given.starts} starts of each. The load of the machine was {os.getloadavg()[1]:.1f} at the end."
    save(OUT / "start_up.json", Table("Start-up", note, sections))
    sys.stdout.write(page("", [OUT / "start_up.json"]))


if __name__ == "__main__":
    main()
