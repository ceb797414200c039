# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What comes in on a topic: how much, how often, how old; and, in words, what keeps more from coming."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from difflib import SequenceMatcher
from time import monotonic
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
    qos_policy_name_from_kind,
)
from rclpy.topic_endpoint_info import TopicEndpointInfo

from g2_recon.nodes import conversions

# Rates are counted over so many seconds, so that slow topics have one, too.
_RATE_OVER_S = 5
# Stamps farther from the clock of the node are those of another clock.
_ANOTHER_CLOCK_S = 1e5
_MOST_SIMILAR = 3
# Topics of the nodes themselves: one of them is not meant where another one is missing.
_OWN_TOPICS = {"scan", "scan_vertical", "scan_tilt", "sweep", "cloud", "point_map", "odom", "pose", "trajectory"}


class Input:
    """One topic that a node has subscribed to."""

    def __init__(self, node: Node, kind: type, topic: str, qos: QoSProfile) -> None:
        """`topic` as the node names it, before remapping."""
        self._node = node
        self._kind = kind
        self._qos = qos
        self._name = topic
        self.topic = node.resolve_topic_name(topic)
        self.count = 0
        self.lost = 0
        self.newest_stamp = -math.inf
        self._refused_policy = ""
        self._came = -math.inf
        self._counts: deque[tuple[float, int]] = deque([(monotonic(), 0)], maxlen=_RATE_OVER_S + 1)

    def events(self) -> SubscriptionEventCallbacks:
        """What the middleware tells about the subscription."""

        def refused(event: Any) -> None:
            self._refused_policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
            self._node.get_logger().warning(self.lack() or f"a publisher of `{self.topic}` has an unfit QoS")

        def lost(event: Any) -> None:
            self.lost += event.total_count_change

        return SubscriptionEventCallbacks(incompatible_qos=refused, message_lost=lost)

    def note(self, message: Any) -> None:
        """Count a message that has come."""
        self.count += 1
        self._came = monotonic()
        if hasattr(message, "header"):
            self.newest_stamp = conversions.stamp_seconds(message.header.stamp)

    def taken(self) -> None:
        """The node is done with the message: while it was busy, nothing could come."""
        self._came = monotonic()

    def tick(self) -> None:
        """Take note of the count; once a second."""
        self._counts.append((monotonic(), self.count))

    @property
    def silent_for(self) -> float:
        """Seconds since the last message came; infinite before the first."""
        return monotonic() - self._came

    def rate(self) -> float:
        """Messages a second, Hz."""
        (start, before), (end, now) = self._counts[0], self._counts[-1]
        return (now - before) / (end - start) if end > start else 0.0

    def figures(self) -> Iterator[tuple[str, str]]:
        """Names and values for the diagnostics."""
        yield f"received {self._name}", str(self.count)
        if not self.count:
            return
        yield f"rate of {self._name}", f"{self.rate():.1f} Hz"
        yield f"silence of {self._name}", f"{self.silent_for:.2f} s"
        if math.isfinite(self.newest_stamp):
            age = self._node.get_clock().now().nanoseconds * 1e-9 - self.newest_stamp
            known = abs(age) < _ANOTHER_CLOCK_S
            yield f"age of {self._name}", f"{age:.3f} s" if known else "its stamps are of another clock"

    def lack(self) -> str:
        """Words for why nothing has come yet; empty if something has."""
        if self.count:
            return ""
        publishers = self._node.get_publishers_info_by_topic(self._name)
        if not publishers:
            return f"waiting for `{self.topic}`: no publisher{self._instead()}"
        faults = [fault for fault in map(self._fault, publishers) if fault]
        if len(faults) == len(publishers):
            return faults[0]
        return f"waiting for `{self.topic}`: nothing came yet"

    def _fault(self, publisher: TopicEndpointInfo) -> str:
        """Why nothing can come from a publisher; empty if something can."""
        wanted = _message_name(self._kind)
        who = f"publisher of `{self.topic}`"
        if publisher.node_name and not publisher.node_name.startswith("_"):
            who += f" ({_full_name(publisher)})"
        if publisher.topic_type != wanted:
            return f"{who} sends {publisher.topic_type}, not {wanted}: remap one of the two topics"
        compatible, reason = qos_check_compatible(publisher.qos_profile, self._qos)
        if compatible != QoSCompatibility.ERROR:
            return ""
        offered, asked = publisher.qos_profile, self._qos
        if asked.reliability == ReliabilityPolicy.RELIABLE and offered.reliability == ReliabilityPolicy.BEST_EFFORT:
            return f"{who} offers best effort, reliable asked: set its reliability to reliable"
        if asked.durability == DurabilityPolicy.TRANSIENT_LOCAL and offered.durability == DurabilityPolicy.VOLATILE:
            return f"{who} offers volatile, transient local asked: set its durability to transient local"
        return f"{who} has an unfit QoS: {' '.join(reason.split()) or self._refused_policy}"

    def _instead(self) -> str:
        """Topics of the right type that somebody publishes, and how to take the one most alike."""
        wanted = _message_name(self._kind)
        found = [
            topic
            for topic, kinds in self._node.get_topic_names_and_types()
            if wanted in kinds
            and topic != self.topic
            and self._node.count_publishers(topic)
            and not self._is_own(topic)
        ]
        if not found:
            return ""
        found.sort(key=lambda topic: (-SequenceMatcher(None, topic, self.topic).ratio(), topic))
        more = f" (and {', '.join(f'`{topic}`' for topic in found[1:_MOST_SIMILAR])})" if len(found) > 1 else ""
        kind = wanted.rsplit("/", 1)[-1]
        return f"; there is `{found[0]}`{more} with {kind}: remap with -r {self._name}:={found[0]}"

    def _is_own(self, topic: str) -> bool:
        """Whether another input of the nodes is meant by a topic."""
        return topic in {self._node.resolve_topic_name(name) for name in _OWN_TOPICS - {self._name}}


def _message_name(kind: type) -> str:
    """As the graph names a message type: sensor_msgs/msg/LaserScan."""
    package, middle, *_ = kind.__module__.split(".")
    return f"{package}/{middle}/{kind.__name__}"


def _full_name(publisher: TopicEndpointInfo) -> str:
    return f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"
