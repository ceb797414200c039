# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""replay_node: what a bag holds, with its timing, and /clock."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from importlib import import_module
from time import monotonic_ns
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.task import Future
from rosgraph_msgs.msg import Clock

from g2_recon.errors import InputError
from g2_recon.nodes.parameters import ReplayParameters
from g2_recon.nodes.ros import LATCHED, reliable_qos, run
from g2_recon.nodes.stage_node import StageNode
from g2_recon.recording.bags import RecordedMessage, messages

_SECOND_NS = 1_000_000_000
# As often as `ros2 bag play --clock` does by itself. Each time wakes all nodes that run on it.
_CLOCK_PERIOD_NS = _SECOND_NS // 40
_LOG_PERIOD_NS = 5 * _SECOND_NS
_LONGEST_ACKNOWLEDGMENT = Duration(seconds=5)
# Best-effort subscribers acknowledge nothing; this long after the last message they have it.
_LINGER_NS = _SECOND_NS // 2
# So that ~/pause is answered even where messages cannot be sent as fast as asked.
_MESSAGES_AT_ONCE = 200


class Playback:
    """Which time of the recording it is at a wall time; both in nanoseconds, without drift."""

    def __init__(self, rate: float, stamp: int, wall: int) -> None:
        """`stamp` is played at `wall`, `rate` times as fast as it was recorded."""
        self.rate = rate
        self.paused = False
        self._stamp, self._wall = stamp, wall

    def stamp(self, wall: int) -> int:
        """The time in the recording."""
        return self._stamp if self.paused else self._stamp + int((wall - self._wall) * self.rate)

    def wait(self, stamp: int, wall: int) -> int:
        """Wall time from `wall` until `stamp` is played."""
        return max(0, int((stamp - self.stamp(wall)) / self.rate))

    def set_rate(self, rate: float, wall: int) -> None:
        """Go on at another rate."""
        self._stamp, self._wall = self.stamp(wall), wall
        self.rate = rate

    def pause(self, paused: bool, wall: int) -> None:
        """Hold the time, or let it go on from where it was held."""
        if paused != self.paused:
            self._stamp, self._wall = self.stamp(wall), wall
            self.paused = paused


class ReplayNode(StageNode[ReplayParameters]):
    """Publishes each recorded message as it is at its time; one timer is set to whatever is due next."""

    def __init__(self) -> None:
        """Raises InputError where the bag cannot be read."""
        super().__init__("replay_node", ReplayParameters)
        if not self.settings.bag:
            raise InputError("no bag is given", where="replay_node", advice="set the parameter `bag` to its path")
        self.finished = Future()
        self._first, self._last, types = _overview(self.settings.bag)
        self._publishers_by_topic = self._advertise(types)
        self._clock_publisher = self.create_publisher(Clock, "/clock", reliable_qos(1))
        self._messages: Iterator[RecordedMessage] = iter(())
        self._next: RecordedMessage | None = None
        self._playback: Playback | None = None
        self._sent = 0
        self._created = monotonic_ns()
        self._starts_at: int | None = None
        self._ends_at: int | None = None
        self._clock_due = self._log_due = 0
        self.offer_pause()
        self._timer = self.create_timer(0.05, self._tick, clock=self.steady_clock)

    def waiting_for(self) -> str:
        """See StageNode."""
        return "" if self._starts_at is not None else self._lacking()

    def settings_changed(self) -> None:
        """See StageNode."""
        if self._playback is not None:
            self._playback.set_rate(self.settings.rate, monotonic_ns())

    def figures(self) -> dict[str, object]:
        """See StageNode."""
        return {"sent messages": self._sent}

    def _advertise(self, types: dict[str, str]) -> dict[str, Publisher]:
        """A publisher for each topic whose message type is installed here."""
        publishers = {}
        for topic, name in types.items():
            message_type = _message_type(name)
            if message_type is None:
                self.get_logger().info(f"{topic} is not replayed: {name} is not installed")
                continue
            qos = self._qos(topic)
            publishers[topic] = self.create_publisher(message_type, topic.lstrip("/"), qos)
        if not publishers:
            raise InputError("no topic can be replayed", where=self.settings.bag)
        return publishers

    def _qos(self, topic: str) -> QoSProfile:
        latched = topic.rsplit("/", 1)[-1] in ("tf_static", "map", "robot_description")
        return LATCHED if latched else reliable_qos(self.settings.queue_depth)

    def _tick(self) -> None:
        """Do what is due and set the timer to what is due next."""
        now = monotonic_ns()
        if self._ends_at is not None:
            self._end(now)
        elif self._playback is not None:
            self._play(self._playback, now)
        elif self._starts_at is not None:
            self._start(now)
        else:
            self._await_subscribers(now)

    def _wake_in(self, nanoseconds: int) -> None:
        self._timer.timer_period_ns = max(nanoseconds, 100_000)
        self._timer.reset()

    def _lacking(self) -> str:
        lacking = [
            topic for topic, publisher in self._publishers_by_topic.items() if not publisher.get_subscription_count()
        ]
        return f"waiting for subscribers of {', '.join(lacking)}" if lacking else ""

    def _await_subscribers(self, now: int) -> None:
        lacking = self._lacking()
        if lacking and now - self._created < self.settings.wait_for_subscribers * _SECOND_NS:
            self.say_once("subscribers", f"{lacking}, at most {self.settings.wait_for_subscribers:g} s")
            return
        if lacking:
            self.get_logger().warning(f"no longer {lacking}: starting without them")
        self._starts_at = now + int(self.settings.start_delay * _SECOND_NS)
        self._wake_in(self._starts_at - now)

    def _start(self, now: int) -> None:
        seconds = (self._last - self._first) / _SECOND_NS
        self.get_logger().info(f"replaying {seconds:.1f} s of {self.settings.bag} at rate {self.settings.rate:g}")
        self._messages = messages(self.settings.bag)
        self._next = next(self._messages, None)
        self._playback = Playback(self.settings.rate, self._first, now)
        self._clock_due, self._log_due = now, now + _LOG_PERIOD_NS
        self._play(self._playback, now)

    def _play(self, playback: Playback, now: int) -> None:
        playback.pause(self.paused, now)
        stamp = min(playback.stamp(now), self._last)
        if now >= self._clock_due:
            self._clock_publisher.publish(Clock(clock=_time(stamp)))
            self._clock_due = max(self._clock_due + _CLOCK_PERIOD_NS, now)
        self._send_until(stamp)
        if now >= self._log_due:
            self._log_due = now + _LOG_PERIOD_NS
            self._log_progress(stamp)
        if self._next is None:
            self._finish_pass(now)
            return
        now = monotonic_ns()
        wait = self._clock_due - now
        self._wake_in(wait if playback.paused else min(wait, playback.wait(self._next.stamp_ns, now)))

    def _send_until(self, stamp: int) -> None:
        for _ in range(_MESSAGES_AT_ONCE):
            if self._next is None or self._next.stamp_ns > stamp:
                return
            publisher = self._publishers_by_topic.get(self._next.topic)
            if publisher is not None:
                publisher.publish(bytes(self._next.cdr))
                self._sent += 1
            self._next = next(self._messages, None)

    def _log_progress(self, stamp: int) -> None:
        done, total = (stamp - self._first) / _SECOND_NS, (self._last - self._first) / _SECOND_NS
        self.get_logger().info(f"{done:.1f} of {total:.1f} s{', paused' if self.paused else ''}")

    def _finish_pass(self, now: int) -> None:
        """At the end of the bag: start again, or wait until all is received."""
        if self.settings.loop:
            self.get_logger().info("starting again")
            self._start(now)
            return
        # Whoever runs on this clock must see that the last message is past.
        self._clock_publisher.publish(Clock(clock=_time(self._last)))
        for topic, publisher in self._publishers_by_topic.items():
            if not publisher.wait_for_all_acked(_LONGEST_ACKNOWLEDGMENT):
                self.get_logger().warning(f"not all of {topic} was acknowledged")
        self.get_logger().info(f"all {self._sent} messages are sent")
        self._ends_at = monotonic_ns() + _LINGER_NS
        self._wake_in(_LINGER_NS)

    def _end(self, now: int) -> None:
        self._timer.cancel()
        if self.settings.exit_when_done:
            self.finished.set_result(None)


def _overview(bag: str) -> tuple[int, int, dict[str, str]]:
    """First and last stamp in ns, and the message type of each topic. Raises InputError where there is none."""
    types: dict[str, str] = {}
    first = last = None
    for message in messages(bag):
        types.setdefault(message.topic, message.msgtype)
        first = message.stamp_ns if first is None else first
        last = message.stamp_ns
    if first is None or last is None:
        raise InputError("the bag holds no messages", where=bag)
    return first, last, types


def _message_type(name: str) -> Any | None:
    """The class of a message type such as sensor_msgs/msg/LaserScan, None if it is not installed."""
    package, *_, message = name.split("/")
    try:
        return getattr(import_module(f"{package}.msg"), message, None)
    except ImportError:
        return None


def _time(nanoseconds: int) -> Time:
    return Time(sec=nanoseconds // _SECOND_NS, nanosec=nanoseconds % _SECOND_NS)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; the exit code."""
    return run(ReplayNode, args)


if __name__ == "__main__":
    sys.exit(main())
