# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A cloud that is published in pieces, and anew where pieces have moved and for whoever subscribes late."""

from __future__ import annotations

from secrets import randbits
from time import monotonic
from typing import Protocol

from builtin_interfaces.msg import Time
from rclpy.clock import Clock
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from g2_recon.geometry.cloud import Piece
from g2_recon.nodes import conversions
from g2_recon.nodes.ros import reliable_qos
from g2_recon.registration.registered_cloud import RegisteredCloud

# Pieces are published anew for so long at a time, and what comes in has its turn in between, s.
_RENEW_S, _RENEW_PERIOD_S = 0.005, 0.015
# How often it is looked whether somebody subscribes who lacks what was before, s.
_WATCH_PERIOD_S = 0.5


class Pieces(Protocol):
    """The stage that a cloud comes from: a registrar or a sweep merger."""

    @property
    def to_renew(self) -> int:
        """How many pieces wait to be handed out."""

    def renew(self) -> RegisteredCloud | None:
        """The next of them, all of it; None where there is none."""

    def renew_all(self) -> None:
        """Have all pieces handed out anew."""


class PiecePublisher:
    """Publishes what a stage hands out on the topic `cloud`; what is renewed goes out some milliseconds at a time."""

    def __init__(self, node: Node, frame: str, depth: int, clock: Clock) -> None:
        """frame: of the map. depth: of the queue. clock: of the timers, one that never stops."""
        self._frame = frame
        self._pieces: Pieces | None = None
        self.renewed = self._subscribers = 0
        self._source, self._newest_stamp, self._published = randbits(32), Time(), False
        self._publisher = node.create_publisher(PointCloud2, "cloud", reliable_qos(depth))
        self._timer = node.create_timer(_RENEW_PERIOD_S, self._renew, clock=clock)
        self._timer.cancel()
        node.create_timer(_WATCH_PERIOD_S, self._watch_subscribers, clock=clock)

    def follow(self, pieces: Pieces) -> None:
        """Publish anew what this stage says, from now on."""
        self._pieces = pieces

    def publish(self, registered: RegisteredCloud) -> None:
        """Publish points now, also those that do not wait to be renewed."""
        if not self._published:
            self._subscribers = self._publisher.get_subscription_count()
            self._published = True
        self._newest_stamp = conversions.stamp_message(registered.stamp)
        head = conversions.header(self._newest_stamp, self._frame)
        piece = Piece(self._source, registered.piece, registered.revision)
        self._publisher.publish(conversions.cloud_to_message(head, registered.cloud, piece))

    def renew_if_needed(self) -> None:
        """Publish what waits to be handed out, when there is time."""
        if self._pieces is not None and self._pieces.to_renew and self._timer.is_canceled():
            self._timer.reset()

    def take_back(self) -> None:
        """Say that no point of before holds; what comes is of another source."""
        if self._published:
            head = conversions.header(self._newest_stamp, self._frame)
            self._publisher.publish(conversions.no_pieces_message(head, self._source))
        self._source, self._published = randbits(32), False

    def _renew(self) -> None:
        """Publish pieces that have moved, as many as there is time for."""
        end = monotonic() + _RENEW_S
        while self._pieces is not None and (renewed := self._pieces.renew()):
            self.publish(renewed)
            self.renewed += renewed.revision > 0
            if monotonic() > end:
                return
        self._timer.cancel()

    def _watch_subscribers(self) -> None:
        """Whoever comes late gets all that was before."""
        before, self._subscribers = self._subscribers, self._publisher.get_subscription_count()
        if self._subscribers > before and self._pieces is not None:
            self._pieces.renew_all()
            self.renew_if_needed()
