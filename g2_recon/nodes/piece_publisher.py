# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A cloud that is published in pieces, and anew where pieces have moved and for whoever lacks some of them."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from secrets import randbits
from time import monotonic
from typing import Any, Protocol

from builtin_interfaces.msg import Time
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt32MultiArray

from g2_recon.geometry.cloud import Piece
from g2_recon.nodes import conversions
from g2_recon.nodes.ros import reliable_qos
from g2_recon.nodes.stage_node import StageNode
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

    @property
    def released(self) -> int:
        """How many scans cannot be handed out anew."""

    def renew(self) -> RegisteredCloud | None:
        """The next of them, all of it; None where there is none."""

    def renew_all(self) -> None:
        """Have all pieces handed out anew."""

    def renew_pieces(self, numbers: Iterable[int]) -> None:
        """Have these pieces handed out anew."""


class PiecePublisher:
    """Publishes what a stage hands out on the topic `cloud`; what is renewed goes out some milliseconds at a time.

    Listens to `cloud_wanted`, where whoever lacks messages names them by their sequence numbers.

    source: of the pieces. former_sources: those of lives of the node before, whose points this one publishes anew.
    renewed: how many pieces have been published once more.
    """

    def __init__(self, node: StageNode[Any], frame: str, depth: int) -> None:
        """frame: of the map. depth: of the queues."""
        self._node, self._frame = node, frame
        self._pieces: Pieces | None = None
        self.renewed = self._subscribers = 0
        self._newest_stamp, self._published = Time(), False
        self.former_sources: list[int] = []
        self._begin_source()
        self._publisher = node.create_publisher(PointCloud2, "cloud", reliable_qos(depth))
        self._timer = node.create_timer(_RENEW_PERIOD_S, self._renew, clock=node.steady_clock, autostart=False)
        node.create_timer(_WATCH_PERIOD_S, self._watch_subscribers, clock=node.steady_clock)
        node.listen(UInt32MultiArray, "cloud_wanted", self._on_wanted, reliable_qos(depth))

    def _begin_source(self) -> None:
        """Of each message of the source, by its sequence number, which piece it was of."""
        self.source, self._sent = randbits(32), array("I")

    def follow(self, pieces: Pieces) -> None:
        """Publish anew what this stage says, from now on."""
        self._pieces = pieces

    def publish(self, registered: RegisteredCloud) -> None:
        """Publish points now, also those that do not wait to be renewed."""
        if not self._published:
            # Whoever is there already gets all from now on, but may have what lives before have published.
            self._subscribers = 0 if self.former_sources else self._publisher.get_subscription_count()
            self._published = True
        self._newest_stamp = conversions.stamp_message(registered.stamp)
        head = conversions.header(self._newest_stamp, self._frame)
        piece = Piece(self.source, registered.piece, registered.revision)
        self._publisher.publish(conversions.cloud_to_message(head, registered.cloud, piece, len(self._sent)))
        self._sent.append(registered.piece)

    def renew_if_needed(self) -> None:
        """Publish what waits to be handed out, when there is time."""
        if self._pieces is not None and self._pieces.to_renew and self._timer.is_canceled():
            self._timer.reset()

    def take_back(self) -> None:
        """Say that no point of before holds; what comes is of another source."""
        self._say_taken_back(self.former_sources)
        if self._published:
            self._say_taken_back([self.source])
        self.former_sources.clear()
        self._published = False
        self._begin_source()

    def _say_taken_back(self, sources: Iterable[int]) -> None:
        head = conversions.header(self._newest_stamp, self._frame)
        for source in sources:
            self._publisher.publish(conversions.no_pieces_message(head, source))

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
            # Points of scans that are kept no more would not come again.
            if not self._pieces.released:
                self._say_taken_back(self.former_sources)
            self._pieces.renew_all()
            self.renew_if_needed()

    def _on_wanted(self, message: UInt32MultiArray) -> None:
        """Somebody lacks the messages from one sequence number to before another of a source."""
        if len(message.data) != 3:
            self._node.drop("unusable request", "cloud_wanted needs source, first and end of the sequence numbers")
            return
        source, begin, end = message.data
        if self._pieces is not None and source == self.source:
            self._pieces.renew_pieces(self._sent[begin:end])
            self.renew_if_needed()
