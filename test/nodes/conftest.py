# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Real ROS, kept apart from all other ROS on this machine and its network."""

from __future__ import annotations

import array
import os
import platform
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest

try:
    import rclpy
    from builtin_interfaces.msg import Time
    from sensor_msgs.msg import LaserScan
    from std_msgs.msg import Header

    from g2_recon.nodes.executor import NodeExecutor
except ImportError:
    if os.environ.get("CI") == "true" and platform.machine() == "x86_64":
        raise

# Processes that a test starts inherit both. Domains above 101 need ports that the system hands out to others.
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


class Ros:
    """The nodes of one test, each on an executor and a thread of its own, and an observer that talks to them."""

    def __init__(self, *arguments: str) -> None:
        rclpy.init(args=["test", *(("--ros-args", *arguments) if arguments else ())])
        self._running: list[tuple[Any, Any, threading.Thread]] = []
        self.observer = self.add(lambda: rclpy.create_node("observer", use_global_arguments=False))

    def close(self) -> None:
        for node, executor, thread in self._running:
            executor.shutdown()
            thread.join(10)
            node.destroy_node()
        rclpy.shutdown()

    def add(self, create: Callable[[], Any]) -> Any:
        """Create a node and let it run."""
        node = create()
        executor = NodeExecutor()
        executor.add_node(node)
        thread = threading.Thread(target=executor.spin)
        self._running.append((node, executor, thread))
        thread.start()
        return node

    def alive(self) -> bool:
        """Whether no node ended by a fault."""
        return all(thread.is_alive() for _, _, thread in self._running)

    def collect(self, kind: type, topic: str, qos: Any = 1000) -> list[Any]:
        """A list that fills with the messages of a topic that has a publisher."""
        received: list[Any] = []
        self.observer.create_subscription(kind, topic, received.append, qos)
        self.wait_until(lambda: self.observer.count_publishers(topic) > 0)
        return received

    def publisher(self, kind: type, topic: str, qos: Any = 1000) -> Any:
        """A publisher that has its subscriber."""
        publisher = self.observer.create_publisher(kind, topic, qos)
        self.wait_until(lambda: publisher.get_subscription_count() > 0)
        return publisher

    def call(self, kind: Any, name: str, request: Any = None) -> Any:
        """The answer of a service."""
        future = self.call_async(kind, name, request)
        self.wait_until(future.done)
        return future.result()

    def call_async(self, kind: Any, name: str, request: Any = None) -> Any:
        """The future of the answer of a service."""
        client = self.observer.create_client(kind, name)
        assert client.wait_for_service(10)
        return client.call_async(kind.Request() if request is None else request)

    @staticmethod
    def wait_until(holds: Callable[[], Any], seconds: float = 20.0) -> None:
        """Wait until something holds; fail if it takes too long."""
        end = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < end, "waited in vain"
            time.sleep(0.005)


def _starts() -> Iterator[Callable[..., Ros]]:
    with ExitStack() as ends:

        def start(*arguments: str) -> Ros:
            started = Ros(*arguments)
            ends.callback(started.close)
            return started

        yield start


@pytest.fixture
def ros() -> Iterator[Callable[..., Ros]]:
    """`ros(*arguments)` starts ROS for one test, with command line arguments as after --ros-args."""
    yield from _starts()


@pytest.fixture(scope="module")
def module_ros() -> Iterator[Ros]:
    """ROS for all tests of a module that look at one long run."""
    started = Ros()
    yield started
    started.close()


@pytest.fixture(scope="module")
def module_ros_with() -> Iterator[Callable[..., Ros]]:
    """The same, started by the module with arguments of its own."""
    yield from _starts()


@pytest.fixture
def room_scan() -> Callable[..., LaserScan]:
    """`room_scan(stamp, pose)`: what a laser at x, y, yaw in a room of 6 m x 4 m around the origin sees all around."""

    def look(stamp: float, pose: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> LaserScan:
        x, y, yaw = pose
        angles = np.linspace(-np.pi, np.pi, 360, endpoint=False)
        cos, sin = np.cos(angles + yaw), np.sin(angles + yaw)
        with np.errstate(divide="ignore"):
            along_x = (np.where(cos > 0, 3.0, -3.0) - x) / cos
            along_y = (np.where(sin > 0, 2.0, -2.0) - y) / sin
        return LaserScan(
            header=Header(stamp=Time(sec=int(stamp), nanosec=round(stamp % 1 * 1e9)), frame_id="laser"),
            angle_min=-np.pi,
            angle_max=float(angles[-1]),
            angle_increment=float(angles[1] - angles[0]),
            range_min=0.1,
            range_max=30.0,
            ranges=array.array("f", np.minimum(along_x, along_y).astype(np.float32).tobytes()),
        )

    return look


@pytest.fixture
def niche_scan(room_scan: Callable[..., LaserScan]) -> Callable[..., LaserScan]:
    """As `room_scan`, of a room that looks the same from nowhere else: a box of 1 m x 0.5 m stands in its corner."""

    def look(stamp: float, pose: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> LaserScan:
        scan = room_scan(stamp, pose)
        x, y, yaw = pose
        angles = np.linspace(-np.pi, np.pi, 360, endpoint=False) + yaw
        cos, sin = np.cos(angles), np.sin(angles)
        with np.errstate(divide="ignore", invalid="ignore"):
            front, side = (2.0 - x) / cos, (1.5 - y) / sin
            front[~((front > 0) & (y + front * sin >= 1.5))] = np.inf
            side[~((side > 0) & (x + side * cos >= 2.0))] = np.inf
        ranges = np.minimum.reduce([np.array(scan.ranges), front, side])
        scan.ranges = array.array("f", ranges.astype(np.float32).tobytes())
        return scan

    return look
