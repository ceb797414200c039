# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Keyframes of a robot on their way to the map merger: told as they come, and once more to whoever lacks some."""

from __future__ import annotations

import sys
from array import array
from zlib import crc32

import numpy as np
from std_msgs.msg import MultiArrayDimension, MultiArrayLayout, UInt8MultiArray, UInt32MultiArray

from g2_recon.geometry.session import SessionPart, session_number
from g2_recon.localization.localizer import Localizer
from g2_recon.nodes.ros import LATCHED, reliable_qos
from g2_recon.nodes.stage_node import StageNode
from g2_recon.recording.session_parts import pack_part, unpack_part

# A message has so many keyframes at most: 0.2 MB of 181 beams.
_TOGETHER = 64
_REQUESTS = 10


class KeyframeSender:
    """The topics `keyframes` and `keyframes_wanted` of a localizer.

    Once a second it is told how many keyframes there are, with those that are new; so whoever has fewer knows, and asks
    for the others by session and number of the first one.
    """

    def __init__(self, node: StageNode) -> None:
        self._node = node
        self._localizer: Localizer | None = None
        self._frame = ""
        self._publisher = node.create_publisher(UInt8MultiArray, "keyframes", LATCHED)
        self.begin_anew()
        node.listen(UInt32MultiArray, "keyframes_wanted", self._on_wanted, reliable_qos(_REQUESTS))

    def begin_anew(self) -> None:
        """The map is another one."""
        self._number: int | None = None
        self._told = self._told_revision = -1
        self._graph: tuple[np.ndarray, ...] = ()

    def tell(self, localizer: Localizer, frame: str) -> None:
        """Tell what is new in the map of a localizer, in the frame of that name."""
        self._localizer, self._frame = localizer, frame
        part = self._part(max(self._told, 0))
        if part is not None:
            self._told, self._told_revision = part.first + len(part.stamps), part.revision
            self._publish(part)

    def _on_wanted(self, message: UInt32MultiArray) -> None:
        """Somebody lacks keyframes of a session from a number on."""
        if len(message.data) != 2:
            self._node.drop("unusable request", "keyframes_wanted needs the session and the number of a keyframe")
        elif message.data[0] == self._number and (part := self._part(message.data[1], with_poses=True)) is not None:
            self._publish(part)

    def _part(self, first: int, *, with_poses: bool = False) -> SessionPart | None:
        """The keyframes from a number on, as many as fit in a message; None where there is no map."""
        localizer = self._localizer
        if localizer is None or not (count := localizer.keyframe_count):
            return None
        if self._number is None:
            begin = localizer.growth(0, sys.maxsize, most=1)
            self._number = session_number(float(begin.stamps[0]), begin.points[0], begin.kinds[0])
        # With a keyframe at least, for the graph that comes with it.
        known = min(first, count - 1)
        growth = localizer.growth(known, sys.maxsize, most=_TOGETHER + 1)
        self._graph = self._graph if growth.graph is None else growth.graph
        revision = crc32(b"".join(np.ascontiguousarray(a).tobytes() for a in (growth.poses, *self._graph)))
        chosen = slice(first - known, first - known + _TOGETHER)
        begins, loops, information = growth.graph or _NO_GRAPH
        told = with_poses or revision != self._told_revision or len(growth.stamps[chosen])
        return SessionPart(
            number=self._number,
            count=count,
            revision=revision,
            last_stamp=localizer.latest_stamp,
            poses=growth.poses if told else growth.poses[:0],
            first=min(first, count),
            **growth.of_rows(chosen),
            local_maps=begins,
            loops=loops,
            loop_information=information,
        )

    def _publish(self, part: SessionPart) -> None:
        self._publisher.publish(message_of_part(part, self._frame))


_NO_GRAPH = np.empty(0, np.int64), np.empty((0, 2), np.int64), np.empty((0, 3, 3))


def message_of_part(part: SessionPart, frame: str) -> UInt8MultiArray:
    """A part as bytes; the label of their dimension is the frame of the map."""
    content = pack_part(part)
    size = MultiArrayDimension(label=frame, size=len(content), stride=len(content))
    return UInt8MultiArray(layout=MultiArrayLayout(dim=[size]), data=array("B", content))


def part_of_message(message: UInt8MultiArray) -> tuple[SessionPart, str]:
    """The part, and the frame of its map. Raises InputError where the bytes are none."""
    dimensions = message.layout.dim
    return unpack_part(message.data.tobytes()), dimensions[0].label if dimensions else ""
