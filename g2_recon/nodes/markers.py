# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Meshes as markers: one list of lines or triangles a submap, of which only those that changed are sent again.

Messages are written as bytes, from whole arrays: making an object of each corner of a large mesh would take the time
that the callbacks of the node need.
"""

from __future__ import annotations

import colorsys
import math
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from threading import Lock

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from g2_recon.geometry.mesh import Mesh, WireMesh
from g2_recon.nodes.memory import give_back_memory

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Colors = NDArray[np.float32]
Name = tuple[str, int]

_LINE_WIDTH_M = 0.01
# Neighboring submaps have neighboring numbers; steps of the golden ratio give them hues that differ.
_HUE_STEP = (math.sqrt(5) - 1) / 2
_GRAY = (0.9, 0.9, 0.9, 1.0)
# Colors by height repeat after a story; by error, all from this one on is red.
_STORY_M = 3.0
_LARGE_ERROR_M = 0.05
# From blue to red; a full turn would end where it began.
_SCALE = np.array([colorsys.hsv_to_rgb(2 / 3 * (1 - step / 255), 0.8, 0.95) for step in range(256)])
# A marker whose corners and colors moved by less stays as it was sent.
_SAME_M = 1e-4
_SAME_COLOR = 1 / 64
# More than the last message, so that none is lost to a subscriber that is slow to take them; not many, as each may hold
# the whole mesh.
_QOS = QoSProfile(depth=3, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Who subscribes gets all that is shown, and again after so long, as two ends of a connection match at different times;
# so does everybody once nothing more has changed for so long.
_SETTLED_S = 1.0
# While something changes all the time, all is sent this often.
_WHOLE_S = 10.0


@dataclass(frozen=True, slots=True)
class Drawing:
    """What one marker shows.

    kind: Marker.LINE_LIST or TRIANGLE_LIST. corners: (n, 3) m, two or three for each line or triangle. color: red,
    green, blue and alpha, 0 to 1. colors: (n, 4) of each corner, where these differ.
    """

    kind: int
    corners: Float
    color: tuple[float, float, float, float]
    colors: Colors | None = None

    def is_like(self, other: Drawing | None) -> bool:
        """Whether nobody would see the difference."""
        if other is None or self.color != other.color or self.corners.shape != other.corners.shape:
            return False
        if (self.colors is None) != (other.colors is None):
            return False
        if not _close(self.corners, other.corners, _SAME_M):
            return False
        return self.colors is None or other.colors is None or _close(self.colors, other.colors, _SAME_COLOR)


def _close(one: NDArray, other: NDArray, limit: float) -> bool:
    return bool(np.abs(one - other).max(initial=0) <= limit)


def drawings_of_mesh(mesh: Mesh, errors: Float | None = None, *, by_height: bool = False) -> dict[Name, Drawing]:
    """A list of triangles for each submap, by its number.

    Its color tells the submap; or that of each corner tells its height, or that of each face its error (F,) m.
    """
    drawings = {}
    for submap, rows in _groups(mesh.submap):
        corners = mesh.vertices[mesh.faces[rows]].reshape(-1, 3)
        colors = None if errors is None else np.repeat(_error_colors(errors[rows]), 3, axis=0)
        if by_height:
            colors = _height_colors(corners)
        drawings["mesh", submap] = Drawing(Marker.TRIANGLE_LIST, corners, _submap_color(submap), colors)
    return drawings


def drawings_of_wire_mesh(
    mesh: WireMesh, errors: Float | None = None, *, by_height: bool = False
) -> dict[Name, Drawing]:
    """A list of lines for each submap, by its number, and one for the joins that begin at it.

    Colors are as those of a mesh, with errors (V,) m of the neurons; joins are gray beside colors by submap.
    """
    drawings = {}
    for name, which in (("wire_mesh", ~mesh.join), ("joins", mesh.join)):
        edges = mesh.edges[which]
        for submap, rows in _groups(mesh.submap[edges[:, 0]]):
            ends = edges[rows].ravel()
            color = _GRAY if name == "joins" else _submap_color(submap)
            colors = None if errors is None else _error_colors(errors[ends])
            if by_height:
                colors = _height_colors(mesh.vertices[ends])
            drawings[name, submap] = Drawing(Marker.LINE_LIST, mesh.vertices[ends], color, colors)
    return drawings


def vertex_errors(mesh: Mesh, errors: Float) -> Float:
    """The mean error (V,) of the faces around each vertex that have one (F,); NaN where none has."""
    known = np.isfinite(errors)
    corners, values = mesh.faces[known].ravel(), np.repeat(errors[known], 3)
    count = np.bincount(corners, minlength=len(mesh.vertices))
    return np.where(count > 0, np.bincount(corners, values, len(mesh.vertices)) / np.maximum(count, 1), np.nan)


class MarkerTopic:
    """A latched topic that shows drawings; it may be used by any thread.

    A message says what was added, modified and deleted, or, after a marker that deletes all, everything that is shown.
    The latter comes for whoever subscribes, once nothing changes any more, and every ten seconds while it does; so the
    message that is kept for late subscribers holds all, or is followed by one that does.
    """

    def __init__(self, node: Node, topic: str) -> None:
        self._publisher = node.create_publisher(MarkerArray, topic, _QOS)
        self._head = Header()
        self._shown: dict[Name, Drawing] = {}
        self._lock = Lock()
        self._subscribers = 0
        # When the last message, and the last one with everything, were sent; when all is due to be sent.
        self._sent = self._whole = -math.inf
        self._due = math.inf

    def show(self, head: Header, drawings: Mapping[Name, Drawing], now: float) -> None:
        """Show these drawings from now on, a time in seconds that only goes on, in place of those before."""
        with self._lock:
            changed = {name: new for name, new in drawings.items() if not new.is_like(self._shown.get(name))}
            gone = [name for name in self._shown if name not in drawings]
            if not changed and not gone and self._sent > -math.inf:
                return
            # What is like before stays as it was sent, so that small steps do not add up.
            self._shown = {name: changed.get(name) or self._shown[name] for name in drawings}
            self._head = head
            if len(changed) == len(drawings) or now - self._whole >= _WHOLE_S:
                self._send_all(now)
            else:
                self._publisher.publish(serialized(head, changed, gone))
                self._sent, self._due = now, now + _SETTLED_S

    def clear(self, head: Header) -> None:
        """Show nothing; also whoever comes late is told so."""
        with self._lock:
            self._head, self._shown, self._due = head, {}, math.inf
            self._publisher.publish(serialized(head, {}, delete_all=True))

    def settle(self, now: float) -> None:
        """To be called a few times a second: sends everything where it is due."""
        with self._lock:
            before, self._subscribers = self._subscribers, self._publisher.get_subscription_count()
            if self._subscribers > before and self._shown:
                self._send_all(now)
                self._due = now + _SETTLED_S
            elif now >= self._due:
                self._send_all(now)

    def _send_all(self, now: float) -> None:
        self._publisher.publish(serialized(self._head, self._shown, delete_all=True))
        # Few messages are larger; nothing else may give back what it took for a long time.
        give_back_memory()
        self._sent = self._whole = now
        self._due = math.inf


def serialized(
    head: Header, drawings: Mapping[Name, Drawing], gone: Iterable[Name] = (), *, delete_all: bool = False
) -> bytes:
    """The bytes of a MarkerArray: markers to be deleted, all there are or those `gone`, then one for each drawing."""
    writer = _Writer()
    names = list(gone)
    writer.numbers("I", delete_all + len(names) + len(drawings))
    if delete_all:
        _write_marker(writer, head, "", 0, Marker.DELETEALL, None)
    for namespace, number in names:
        _write_marker(writer, head, namespace, number, Marker.DELETE, None)
    for (namespace, number), drawing in drawings.items():
        _write_marker(writer, head, namespace, number, Marker.ADD, drawing)
    return writer.message()


class _Writer:
    """Bytes of a message in CDR (OMG, DDS-XTypes 1.3, section 7.4, version 1): all is aligned to its size.

    Arrays are not copied before the message is put together.
    """

    def __init__(self) -> None:
        self._parts: list[bytes | memoryview] = []
        self._size = 0

    def message(self) -> bytes:
        return b"".join([b"\x00\x01\x00\x00", *self._parts])

    def numbers(self, kinds: str, *values: float) -> None:
        """Numbers of kinds of one size, as for struct.pack."""
        self._align(struct.calcsize("<" + kinds[-1]))
        self._add(struct.pack("<" + kinds, *values))

    def text(self, text: str) -> None:
        data = text.encode() + b"\0"
        self.numbers("I", len(data))
        self._add(data)

    def rows(self, values: NDArray) -> None:
        """A sequence of rows (n, m) of floats or doubles."""
        self.numbers("I", len(values))
        if len(values):
            self._align(values.itemsize)
            self._add(values.reshape(-1).view(np.uint8).data)

    def _align(self, size: int) -> None:
        self._add(b"\0" * (-self._size % size))

    def _add(self, data: bytes | memoryview) -> None:
        self._parts.append(data)
        self._size += len(data)


_NOTHING = Drawing(Marker.ARROW, np.empty((0, 3)), (0.0, 0.0, 0.0, 0.0))


def _write_marker(
    writer: _Writer, head: Header, namespace: str, number: int, action: int, drawing: Drawing | None
) -> None:
    """A marker, field by field in the order of visualization_msgs/Marker."""
    shown = drawing or _NOTHING
    size = _LINE_WIDTH_M if shown.kind == Marker.LINE_LIST else 1.0
    _write_header(writer, head)
    writer.text(namespace)
    writer.numbers("iii", number, shown.kind, action)
    writer.numbers("7d", 0, 0, 0, 0, 0, 0, 1)  # pose
    writer.numbers("3d", size, size, size)  # scale
    writer.numbers("4f", *shown.color)
    writer.numbers("iI", 0, 0)  # lifetime
    writer.numbers("?", False)  # frame_locked
    writer.rows(np.ascontiguousarray(shown.corners, "<f8"))
    writer.rows(np.empty((0, 4), "<f4") if shown.colors is None else np.ascontiguousarray(shown.colors, "<f4"))
    writer.text("")  # texture_resource
    _write_header(writer, Header())  # texture
    writer.text("")
    writer.numbers("I", 0)
    writer.numbers("I", 0)  # uv_coordinates
    writer.text("")  # text
    writer.text("")  # mesh_resource
    writer.text("")  # mesh_file
    writer.numbers("I", 0)
    writer.numbers("?", False)  # mesh_use_embedded_materials


def _write_header(writer: _Writer, head: Header) -> None:
    writer.numbers("iI", head.stamp.sec, head.stamp.nanosec)
    writer.text(head.frame_id)


def _groups(labels: Int) -> Iterable[tuple[int, Int]]:
    """Each label and the rows that have it, by label."""
    order = np.argsort(labels, kind="stable")
    names, starts = np.unique(labels[order], return_index=True)
    # Without rows there is no name, but still one empty part.
    return zip(names.tolist(), np.split(order, starts[1:]), strict=False)


def _submap_color(submap: int) -> tuple[float, float, float, float]:
    return (*colorsys.hsv_to_rgb(submap * _HUE_STEP % 1.0, 0.6, 0.95), 1.0)


def _height_colors(places: Float) -> Colors:
    # There and back again, so that no color jumps.
    share = np.abs((places[:, 2] / _STORY_M + 1.0) % 2.0 - 1.0)
    return _on_scale(share)


def _error_colors(errors: Float) -> Colors:
    colors = _on_scale(np.minimum(np.nan_to_num(errors) / _LARGE_ERROR_M, 1.0))
    colors[np.isnan(errors)] = _GRAY
    return colors


def _on_scale(share: Float) -> Colors:
    """Colors (n, 4) from blue at 0 to red at 1."""
    rgb = _SCALE[np.rint(255 * share).astype(np.int64)]
    return np.hstack([rgb, np.ones((len(rgb), 1))]).astype(np.float32)
