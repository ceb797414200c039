# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What the nodes around a stage have in common: parameters, counts, diagnostics, and the pose of a laser."""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from numpy.typing import NDArray
from pydantic import BaseModel
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from g2_recon.errors import InputError
from g2_recon.geometry import se3
from g2_recon.nodes import parameters
from g2_recon.nodes.ros import Transforms

Settings = TypeVar("Settings", bound=BaseModel)
Message = TypeVar("Message")
Content = TypeVar("Content")

# Time that jumps back by more than this is a recording that starts again; less is disorder of a recording.
_JUMP_S = 1.0


class StageNode(Node, Generic[Settings]):
    """A node that counts what it receives and drops, and says so on /diagnostics once a second."""

    def __init__(self, name: str, model: type[Settings]) -> None:
        """Raises ConfigError where a parameter is wrong."""
        super().__init__(name)
        self.settings = parameters.declare(self, model)
        self.received: Counter[str] = Counter()
        self.drops: Counter[str] = Counter()
        self.paused = False
        self._said: set[str] = set()
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Not on ROS time: without a /clock, diagnostics are what one needs.
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._diagnostics_timer = self.create_timer(1.0, self._publish_diagnostics, clock=self.steady_clock)

    def waiting_for(self) -> str:
        """What the node lacks to go on, in words; empty while it goes on."""
        return ""

    def figures(self) -> dict[str, object]:
        """What else the diagnostics tell, by name."""
        return {}

    def drop(self, reason: str, detail: str = "") -> None:
        """Count something that is not used; the first of each reason is also logged."""
        self.drops[reason] += 1
        self.say_once(reason, f"dropped: {reason}{': ' if detail else ''}{detail}; more such are only counted")

    def usable(self, convert: Callable[[Message], Content], message: Message, what: str) -> Content | None:
        """What a conversion makes of a message, or None, counted, where that raises InputError."""
        try:
            return convert(message)
        except InputError as error:
            self.drop(f"unusable {what}", str(error))
            return None

    def say_once(self, key: str, text: str) -> None:
        """Log a warning, only once for each key."""
        if key not in self._said:
            self._said.add(key)
            self.get_logger().warning(text)

    def not_received(self, topic: str) -> str:
        """Words for a topic on which nothing has come yet; empty if something has."""
        if self.received[topic]:
            return ""
        lack = "nothing came yet" if self.count_publishers(topic) else "no publisher"
        return f"waiting for `{self.resolve_topic_name(topic)}`: {lack}"

    def offer_trigger(self, name: str, action: Callable[[], str], *, group: CallbackGroup | None = None) -> None:
        """A Trigger service: success with the text that `action` returns, or failure with that of its InputError."""

        def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                response.message = action()
                response.success = True
            except InputError as error:
                response.message = str(error)
                self.get_logger().warning(f"{name}: {error}")
            except ExternalShutdownException:
                raise
            except Exception as error:
                # A fault in here must not end the node and lose what it has collected.
                response.message = f"internal error: {error!r}"
                self.get_logger().error(f"{name}: {traceback.format_exc()}")
            return response

        self.create_service(Trigger, name, answer, callback_group=group)

    def offer_pause(self) -> None:
        """The service ~/pause: true stops taking in messages, false goes on."""

        def answer(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
            self.paused = bool(request.data)
            response.success = True
            response.message = "paused" if self.paused else "running"
            return response

        self.create_service(SetBool, "~/pause", answer)

    def _publish_diagnostics(self) -> None:
        waiting = self.waiting_for()
        status = DiagnosticStatus(
            name=self.get_fully_qualified_name(),
            level=DiagnosticStatus.WARN if waiting else DiagnosticStatus.OK,
            message=waiting or ("paused" if self.paused else "running"),
        )
        values: dict[str, object] = {f"received {topic}": count for topic, count in self.received.items()}
        values |= {f"dropped: {reason}": count for reason, count in self.drops.items()}
        values |= self.figures()
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)


def session_folder(session_dir: str) -> Path:
    """The folder to save to. Raises InputError where none is set."""
    if not session_dir:
        raise InputError("there is no folder to save to", advice="set the parameter `session_dir`")
    return Path(session_dir).expanduser()


class LaserMount:
    """The pose of a laser on the robot, from the parameter `laser_pose` or, if that is empty, from TF."""

    def __init__(self, node: StageNode, laser_pose: tuple[float, ...], base_frame: str, transforms: Transforms) -> None:
        """Raises InputError where `laser_pose` is not empty and not six finite numbers."""
        self._node = node
        self._base_frame = base_frame
        self._transforms = transforms
        self._T_base_laser = se3.from_xyz_rpy(laser_pose) if laser_pose else None
        self.waiting_for = ""

    def find(self, laser_frame: str) -> NDArray[np.float64] | None:
        """T_base_laser (4, 4), or None, said once, while it is not known."""
        if self._T_base_laser is None:
            self._T_base_laser = self._transforms.look_up(self._base_frame, laser_frame)
        lack = f"no transform {self._base_frame} <- {laser_frame}: set `laser_pose` or publish it"
        self.waiting_for = lack if self._T_base_laser is None else ""
        if self.waiting_for:
            self._node.say_once("laser_pose", lack)
        return self._T_base_laser


class JumpDetector:
    """Tells when the stamps of a stream start again from an earlier time."""

    def __init__(self, ahead: float = np.inf) -> None:
        """`ahead`: s; a stamp so far ahead of the newest one does not count until the next one says the same."""
        self._ahead = ahead
        self._doubtful = self._newest = -np.inf

    def jumped_back(self, stamp: float) -> bool:
        """Whether this stamp in seconds lies far before the newest one; the stamp is then the newest."""
        if stamp > self._newest + self._ahead > -np.inf:
            before, self._doubtful = self._doubtful, stamp
            if abs(stamp - before) > _JUMP_S:
                return False
        jumped = stamp < self._newest - _JUMP_S
        self._newest = stamp if jumped else max(self._newest, stamp)
        return bool(jumped)
