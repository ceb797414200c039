# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What the nodes around a stage have in common: parameters, counts, diagnostics, and the pose of a laser."""

from __future__ import annotations

import math
import re
import traceback
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Iterable, Sequence
from pathlib import Path
from threading import Thread
from time import monotonic
from typing import Any, Generic, TypeVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from numpy.typing import NDArray
from pydantic import BaseModel
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool, Trigger

from g2_recon.errors import InputError
from g2_recon.geometry import se3
from g2_recon.nodes import parameters
from g2_recon.nodes.inputs import Input
from g2_recon.nodes.kernels import KernelCompiler
from g2_recon.nodes.memory import give_back_memory, memory_mb
from g2_recon.nodes.ros import Transforms

Settings = TypeVar("Settings", bound=BaseModel)
Message = TypeVar("Message")
Content = TypeVar("Content")

# Time that jumps back by more than this is a recording that starts again; less is disorder of a recording.
_JUMP_S = 1.0
# How often diagnostics come; what they say is also logged when they have said it so many times: at the start,
# everything is missing.
_PERIOD_S = 1.0
_LOGGED_AFTER = 4
# At first it is looked so often, and so many times, whether somebody listens: what comes before that is lost.
_LOOK_S, _LOOKS = 0.1, 50
# So often what messages have left of memory is given back, s: it takes a tenth of a millisecond.
_TRIM_PERIOD_S = 60.0
# A stream that has been silent for so long has stopped.
_SILENT_S = 2.0
# How often it is looked whether kernels are compiled, and how long what was held is then handed on at a time.
_COMPILED_PERIOD_S, _HAND_ON_S = 0.1, 0.01


class StageNode(Node, Generic[Settings]):
    """A node that counts what it receives and drops, and says so on /diagnostics once a second."""

    def __init__(self, name: str, model: type[Settings]) -> None:
        """Raises ConfigError where a parameter is wrong."""
        super().__init__(name)
        declared = parameters.declare(self, model)
        self.settings = parameters.effective(declared)
        parameters.follow(self, declared, self._take_settings)
        self.inputs: dict[str, Input] = {}
        self.drops: Counter[str] = Counter()
        self.faults: dict[str, str] = {}
        self.paused = False
        self._said: set[str] = set()
        # What came while kernels are compiled, with what takes it; None once nothing is held any more.
        self._compiler: KernelCompiler | None = None
        self._loading: Thread | None = None
        self._held: deque[tuple[Input, Callable[[Any], None], Any]] | None = None
        self._held_for = ""
        self._lasting: Counter[str] = Counter()
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Not on ROS time: without a /clock, diagnostics are what one needs.
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._looks = 0
        self._diagnostics_timer = self.create_timer(_LOOK_S, self._begin_diagnostics, clock=self.steady_clock)
        self.create_timer(_TRIM_PERIOD_S, give_back_memory, clock=self.steady_clock)

    def waiting_for(self) -> str:
        """What the node lacks to go on, in words; empty while it goes on."""
        return ""

    def settings_changed(self) -> None:
        """Called when `settings` are new ones; only the live parameters can differ."""

    def doubts(self) -> Iterable[str]:
        """What is most likely wrong though the node goes on, in words that tell what to do."""
        return ()

    def figures(self) -> dict[str, object]:
        """What else the diagnostics tell, by name."""
        return {}

    @property
    def received(self) -> Counter[str]:
        """How many messages have come, by topic."""
        return Counter({topic: source.count for topic, source in self.inputs.items()})

    def listen(
        self, kind: type, topic: str, take: Callable[[Any], None], qos: QoSProfile, *, raw: bool = False
    ) -> None:
        """Subscribe; what comes is counted before `take` gets it, and the diagnostics tell what is missing.

        raw: `take` gets the bytes of the message.
        """
        source = self.inputs[topic] = Input(self, kind, topic, qos)

        def receive(message: Any) -> None:
            source.note(message)
            if self._held is not None:
                self._held.append((source, take, message))
                return
            take(message)
            source.taken()

        self.create_subscription(kind, topic, receive, qos, event_callbacks=source.events(), raw=raw)

    def compile_beside(self, *parts: str, hold: bool = True, load: Callable[[], None] | None = None) -> None:
        """Where this is the first time ever, compile kernels (see g2_recon.warm_up) in a process beside the node.

        hold: messages wait, in their order, until the first of the parts is compiled. load: runs those that are
        compiled, in a thread beside, as the first message would else wait until they have come from the disk.
        """
        self._held_for = parts[0]
        self._compiler = KernelCompiler(parts, self._held_for if hold else "")
        if not self._compiler.parts_left():
            if load is not None:
                self._loading = Thread(target=load, name="loading kernels")
                self._loading.start()
            return
        self.get_logger().warning(
            "compiling kernels, this first time ever: work begins in half a minute or more, and what comes until then "
            "waits; `python -m g2_recon.warm_up` does it beforehand"
        )
        self._held = deque() if hold and self._held_for in self._compiler.parts_left() else None
        self._compiled_timer = self.create_timer(_COMPILED_PERIOD_S, self._look_at_compiler, clock=self.steady_clock)

    @property
    def compiling(self) -> Sequence[str]:
        """The parts that are still being compiled beside."""
        return () if self._compiler is None else self._compiler.parts_left()

    def end(self) -> None:
        """End what goes on beside; does nothing the second time."""
        if self._compiler is not None:
            self._compiler.close()
        if self._loading is not None:
            self._loading.join()

    def destroy_node(self) -> None:
        """See Node."""
        self.end()
        super().destroy_node()

    def _look_at_compiler(self) -> None:
        """Hand on what was held, some milliseconds at a time, once the first part is compiled."""
        left = self.compiling
        if self._held is None:
            if not left:
                self._compiled_timer.cancel()
                self.get_logger().info("all kernels are compiled")
            return
        if self._held_for in left:
            return
        end = monotonic() + _HAND_ON_S
        while self._held and monotonic() < end:
            source, take, message = self._held.popleft()
            take(message)
            source.taken()
        if not self._held:
            self._held = None
            self.get_logger().info("the kernels are compiled, and what waited for them is done")

    def drop(self, reason: str, detail: str = "") -> None:
        """Count something that is not used; the first of each reason is also logged."""
        self.drops[reason] += 1
        self.say_once(reason, f"dropped: {reason}{': ' if detail else ''}{detail}; more such are only counted")

    def fail(self, what: str, text: str) -> None:
        """Say at once, and from now on in the diagnostics, that something does not work any more."""
        if what not in self.faults:
            self.get_logger().error(text)
        self.faults[what] = text

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
        return self.inputs[topic].lack()

    def stopped(self, topic: str) -> str:
        """Words for a stream that has not come yet or does not come any more; empty while it does."""
        silent = self.inputs[topic].silent_for
        if not self.inputs[topic].count or silent < _SILENT_S:
            return self.not_received(topic)
        return f"`{self.inputs[topic].topic}` has stopped: nothing came for {silent:.0f} s"

    def offer_trigger(
        self, name: str, action: Callable[[], str | Awaitable[str]], *, group: CallbackGroup | None = None
    ) -> None:
        """A Trigger service: success with the text that `action` returns, or failure with that of its InputError.

        A coroutine may wait for what other callbacks do, in a reentrant group.
        """

        async def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                told = action()
                response.message = told if isinstance(told, str) else await told
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

    def _take_settings(self, settings: Settings) -> None:
        self.settings = parameters.effective(settings)
        self.settings_changed()

    def _begin_diagnostics(self) -> None:
        """Publish diagnostics as soon as somebody has found the topic, and each second."""
        self._looks += 1
        heard = self._diagnostics.get_subscription_count() > 0
        if heard or self._looks == _LOOKS:
            self.destroy_timer(self._diagnostics_timer)
            self._diagnostics_timer = self.create_timer(_PERIOD_S, self._publish_diagnostics, clock=self.steady_clock)
        if heard or self._looks % round(_PERIOD_S / _LOOK_S) == 0:
            self._publish_diagnostics()

    def _publish_diagnostics(self) -> None:
        for source in self.inputs.values():
            source.tick()
        waiting = self._waiting_for_kernels() or self.waiting_for()
        doubts = "; ".join(filter(None, [self._no_clock(), *([waiting] if waiting else self.doubts())]))
        self._log_what_lasts(doubts)
        level = DiagnosticStatus.ERROR if self.faults else DiagnosticStatus.WARN if doubts else DiagnosticStatus.OK
        state = "paused" if self.paused else "waiting" if waiting else "running"
        status = DiagnosticStatus(
            name=self.get_fully_qualified_name(),
            level=level,
            message="; ".join(filter(None, [*self.faults.values(), doubts])) or state,
        )
        values: dict[str, object] = {"state": state}
        for source in self.inputs.values():
            values |= source.figures()
        values |= {f"dropped: {reason}": count for reason, count in self.drops.items()}
        values |= {
            f"dropped: `{topic}` lost by the network": source.lost
            for topic, source in self.inputs.items()
            if source.lost
        }
        values |= self.figures()
        values["memory"] = f"{memory_mb():.0f} MB"
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def _waiting_for_kernels(self) -> str:
        if self._held is None:
            return ""
        return f"compiling kernels, this first time ever: {len(self._held)} messages wait"

    def _no_clock(self) -> str:
        """Words for simulated time that nobody gives."""
        simulated = self.get_parameter("use_sim_time").value
        if not simulated or self.get_clock().now().nanoseconds or self.count_publishers("/clock"):
            return ""
        return (
            "use_sim_time is true, but `/clock` has no publisher: replay with a clock (`ros2 bag play --clock`, or "
            "replay_node), or set use_sim_time to false"
        )

    def _log_what_lasts(self, text: str) -> None:
        """Log, once, what the diagnostics have said for some time, whatever the numbers in it."""
        key = re.sub(r"[\d.]+", "#", text)
        self._lasting = Counter({key: self._lasting[key] + 1}) if text else Counter()
        if self._lasting[key] == _LOGGED_AFTER:
            self.say_once(key, text)


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

    @property
    def tilt(self) -> float | None:
        """The angle in rad between the plane of the scans and the floor, from 0 to pi/2; None while not known."""
        T = self._T_base_laser
        return None if T is None else math.acos(min(1.0, abs(float(T[2, 2]))))

    def find(self, laser_frame: str) -> NDArray[np.float64] | None:
        """T_base_laser (4, 4), or None, said once, while it is not known."""
        if self._T_base_laser is None:
            self._T_base_laser = self._look_up(laser_frame)
        lack = f"no transform {self._base_frame} <- {laser_frame}: set `laser_pose` or publish it"
        self.waiting_for = lack if self._T_base_laser is None else ""
        if self.waiting_for:
            self._node.say_once("laser_pose", lack)
        return self._T_base_laser

    def _look_up(self, laser_frame: str) -> NDArray[np.float64] | None:
        """T_base_laser as TF has it; drivers leave out the prefix that other frames of the robot have."""
        found = self._transforms.look_up(self._base_frame, laser_frame)
        prefix = getattr(self._node.settings, "frame_prefix", "")
        if found is None and prefix:
            found = self._transforms.look_up(self._base_frame, prefix + laser_frame)
        return found


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
