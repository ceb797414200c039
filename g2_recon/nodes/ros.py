# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What all nodes need of ROS: quality of service, start and end of a process, and TF where it is installed."""

from __future__ import annotations

import faulthandler
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from types import FrameType
from typing import Any, NoReturn

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from numba.core.event import Event, Listener, register
from numpy.typing import ArrayLike, NDArray
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from g2_recon.errors import G2ReconError
from g2_recon.nodes import conversions
from g2_recon.nodes.executor import NodeExecutor
from g2_recon.nodes.fast_dds import use_profile
from g2_recon.nodes.memory import save_memory
from g2_recon.switching import switch_soon

# What DDS may take to end a process.
_LONGEST_END_S = 10.0


def _if_installed(name: str) -> Any | None:
    try:
        return import_module(name)
    except ImportError:
        return None


# The ROS wheels of the Python package index do not hold it.
tf2_ros: Any = _if_installed("tf2_ros")
tf2_msgs: Any = _if_installed("tf2_msgs.msg")

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Maps and meshes: whoever comes late gets the last one (REP-2003)."""


def sensor_qos(depth: int) -> QoSProfile:
    """Sensor data (REP-2003): takes what any publisher offers; the queue is for bursts and replays."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


def reliable_qos(depth: int) -> QoSProfile:
    """What stages hand on to each other: nothing may be lost."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE)


def run(create: Callable[[], Node], args: Sequence[str] | None) -> int:
    """Spin a node as `run_together` does."""
    return run_together([create], args)


def run_together(create: Sequence[Callable[[], Node]], args: Sequence[str] | None) -> int:
    """Spin nodes until they are told to stop, or the future `finished` of one that has it is done; the exit code.

    0 after SIGINT, SIGTERM, a shutdown or a finished node; 1, with one line, where a node cannot start because of what
    it was given, and with a traceback where DDS does not end, which leaves the process at once.
    """
    with _interrupted_once():
        return _run(create, args)


class _Interrupted(BaseException):
    """SIGINT, in place of KeyboardInterrupt.

    Python ends as if nobody had caught it where a KeyboardInterrupt passes through `exec`, as dataclasses call it in
    imports.
    """


@contextmanager
def _interrupted_once() -> Iterator[None]:
    """Let SIGINT raise _Interrupted, once: it must not break the ending that it has begun."""

    def interrupt(number: int, frame: FrameType | None) -> NoReturn:
        signal.signal(number, lambda number, frame: None)
        raise _Interrupted

    before = signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _run(create: Sequence[Callable[[], Node]], args: Sequence[str] | None) -> int:
    save_memory()
    use_profile()
    try:
        rclpy.init(args=None if args is None else list(args))
    except RuntimeError as error:
        rclpy.logging.get_logger("g2_recon").fatal(" ".join(str(error).split()))
        return 1
    nodes: list[Node] = []
    executor: NodeExecutor | None = None
    say_when_kernels_compile()
    switch_soon()
    try:
        # Before the nodes, which take a while: rclpy complains of an executor made when a signal has ended its context.
        executor = NodeExecutor()
        nodes.extend(make() for make in create)
        # What was imported stays: to look through it again and again for garbage would hold all threads for 0.1 s.
        gc.freeze()
        for node in nodes:
            executor.add_node(node)
        futures = [node.finished for node in nodes if hasattr(node, "finished")]
        # As spin_until_future_complete, which leaves a callback in the future for each message that comes.
        while rclpy.ok() and not any(future.done() for future in futures):
            executor.spin_once()
    except G2ReconError as error:
        rclpy.logging.get_logger("g2_recon").fatal(str(error))
        return 1
    except (_Interrupted, ExternalShutdownException):
        pass
    except Exception:
        # A signal ends the context under the hands of a callback; what fails then is no fault.
        if rclpy.ok():
            raise
    finally:
        _end(nodes, executor)
    return 0


def _end(nodes: Sequence[Node], executor: NodeExecutor | None) -> None:
    """End all there is, whatever fails of it; what is beside a node first, which works with what DDS has.

    Fast DDS may wait for a callback of its own for ever, with a whole processor, and neither a thread of Python nor a
    second Ctrl-C gets a turn then (https://github.com/eProsima/Fast-DDS/issues/6513). The process leaves with 1 and a
    traceback where it takes too long.
    """
    # SIGTERM or a fault may have begun it; SIGINT must not break it either.
    signal.signal(signal.SIGINT, lambda number, frame: None)
    with ExitStack() as last_first:
        last_first.callback(faulthandler.cancel_dump_traceback_later)
        last_first.callback(_shut_down)
        for node in nodes:
            last_first.callback(node.destroy_node)
        # Not sys.stderr, which a process without one does not have.
        last_first.callback(faulthandler.dump_traceback_later, _LONGEST_END_S, exit=True, file=2)
        for node in nodes:
            if hasattr(node, "end"):
                last_first.callback(node.end)
        if executor is not None:
            last_first.callback(executor.shutdown, timeout_sec=1.0)


def _shut_down() -> None:
    # What rclpy does on a signal may shut down at the very same moment; one of the two comes too late then.
    with suppress(RuntimeError):
        rclpy.try_shutdown()


def yield_processor() -> None:
    """Let this thread, and those that it starts, have a processor only while nobody else wants it (Linux)."""
    if sys.platform == "linux":
        with suppress(OSError):
            os.sched_setscheduler(threading.get_native_id(), os.SCHED_IDLE, os.sched_param(0))


class RobotTransforms:
    """TF from the world to the maps of robots, in both styles that there are.

    Where all robots share one tree, the names of their frames begin with that of the robot: `robot1/map` goes there.
    Where each has a tree of its own with the same names, its `map` goes into that, on `<robot>/tf`, and as `robot1/map`
    into the shared one, for whoever looks at all.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.available = tf2_ros is not None
        self._own: dict[str, Any] = {}
        if self.available:
            self._broadcaster = tf2_ros.TransformBroadcaster(node)

    def send(self, stamp: Time, world: str, robot: str, frame: str, T_world_map: ArrayLike) -> None:
        """Broadcast where the map of a robot, whose frame has this name, lies in the world (4, 4)."""
        prefixed = frame.startswith(f"{robot}/")
        shared = frame if prefixed else f"{robot}/{frame or 'map'}"
        self._broadcaster.sendTransform(conversions.transform_message(stamp, world, shared, T_world_map))
        if not prefixed and frame:
            if robot not in self._own:
                self._own[robot] = self._node.create_publisher(tf2_msgs.TFMessage, f"{robot}/tf", reliable_qos(100))
            message = conversions.transform_message(stamp, world, frame, T_world_map)
            self._own[robot].publish(tf2_msgs.TFMessage(transforms=[message]))


class _CompileListener(Listener):
    """Says once that a kernel is being compiled, which nobody would guess of a node that does not answer."""

    def __init__(self) -> None:
        self._said = False

    def on_start(self, event: Event) -> None:
        if not self._said:
            self._said = True
            rclpy.logging.get_logger("g2_recon").warning(
                "compiling kernels: the first time ever, work begins after half a minute or more, and scans wait; "
                "`python -m g2_recon.warm_up` does it beforehand"
            )

    def on_end(self, event: Event) -> None:
        pass


def say_when_kernels_compile() -> None:
    """From now on, log a warning when Numba compiles a kernel that it does not find on disk."""
    register("numba:compile", _CompileListener())


class Transforms:
    """TF where tf2_ros is installed; without it every look-up says that it knows nothing."""

    def __init__(self, node: Node) -> None:
        self.available = tf2_ros is not None
        if not self.available:
            node.get_logger().info("tf2_ros is not installed: transforms are neither read nor sent")
            return
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)
        self._broadcaster = tf2_ros.TransformBroadcaster(node)

    def look_up(self, target: str, source: str) -> NDArray[np.float64] | None:
        """The latest T_target_source (4, 4), or None where there is none yet."""
        if not self.available:
            return None
        try:
            found = self._buffer.lookup_transform(target, source, rclpy.time.Time())
        except tf2_ros.TransformException:
            return None
        return conversions.transform_matrix(found.transform)

    def send(self, stamp: Time, parent: str, child: str, T_parent_child: ArrayLike) -> None:
        """Broadcast a transform (4, 4)."""
        if self.available:
            self._broadcaster.sendTransform(conversions.transform_message(stamp, parent, child, T_parent_child))
