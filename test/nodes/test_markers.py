# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from builtin_interfaces.msg import Time
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from g2_recon.geometry.mesh import Mesh, WireMesh
from g2_recon.nodes import markers
from g2_recon.nodes.markers import Drawing, MarkerTopic, drawings_of_mesh, drawings_of_wire_mesh, serialized

HEAD = Header(stamp=Time(sec=7, nanosec=5), frame_id="map")
MESH = Mesh(np.arange(12.0).reshape(4, 3), np.array([[0, 1, 2], [0, 2, 3], [1, 2, 3]]), np.array([4, 2, 4]))


def make_wire_mesh() -> WireMesh:
    vertices = np.arange(18.0).reshape(6, 3)
    edges = np.array([[0, 1], [1, 2], [3, 4], [4, 5], [2, 3]])
    return WireMesh(vertices, edges, np.array([0, 0, 0, 7, 7, 7]), np.array([False] * 4 + [True]))


def read(data: bytes) -> list[Marker]:
    return deserialize_message(data, MarkerArray).markers


def places(marker: Marker) -> np.ndarray:
    return np.array([(point.x, point.y, point.z) for point in marker.points]).reshape(-1, 3)


def actions(marker_list: list[Marker]) -> list[tuple[int, str, int]]:
    return [(marker.action, marker.ns, marker.id) for marker in marker_list]


class Publisher:
    """In place of that of a node: keeps what is published."""

    def __init__(self) -> None:
        self.sent: list[list[Marker]] = []
        self.subscribers = 0

    def publish(self, data: bytes) -> None:
        self.sent.append(read(data))

    def get_subscription_count(self) -> int:
        return self.subscribers

    def create_publisher(self, kind: type, topic: str, qos: object) -> Publisher:
        return self


@pytest.fixture
def topic():
    publisher = Publisher()
    shown = MarkerTopic(publisher, "mesh")
    shown.publisher = publisher
    return shown


def triangles(**places_of) -> dict:
    """Drawings named a1 and so on, each of one triangle at a place."""
    corners = np.eye(3)
    return {
        (name[0], int(name[1:])): Drawing(Marker.TRIANGLE_LIST, corners + at, (1.0, 0.0, 0.0, 1.0))
        for name, at in places_of.items()
    }


def test_a_wire_mesh_becomes_a_list_of_lines_a_submap_and_one_for_the_joins_of_each():
    mesh = make_wire_mesh()
    drawn = read(serialized(HEAD, drawings_of_wire_mesh(mesh)))
    assert [(marker.ns, marker.id) for marker in drawn] == [("wire_mesh", 0), ("wire_mesh", 7), ("joins", 0)]
    assert {marker.type for marker in drawn} == {Marker.LINE_LIST}
    np.testing.assert_array_equal(
        np.concatenate([places(marker) for marker in drawn]), mesh.vertices[mesh.edges].reshape(-1, 3)
    )


def test_a_mesh_becomes_one_list_of_triangles_a_submap():
    second, fourth = read(serialized(HEAD, drawings_of_mesh(MESH)))
    assert (second.id, len(second.points), fourth.id, len(fourth.points)) == (2, 3, 4, 6)
    assert {second.type, fourth.type} == {Marker.TRIANGLE_LIST}
    np.testing.assert_array_equal(places(second), MESH.vertices[[0, 2, 3]])


def test_an_empty_mesh_has_nothing_to_draw():
    assert drawings_of_mesh(Mesh(np.empty((0, 3)), np.empty((0, 3), np.int64), np.empty(0, np.int64))) == {}


def test_markers_are_drawn_as_they_are():
    for marker in read(serialized(HEAD, drawings_of_wire_mesh(make_wire_mesh()))):
        assert marker.header == HEAD
        assert marker.action == Marker.ADD
        assert marker.pose.orientation.w == 1.0
        assert marker.color.a == 1.0
        assert 0 < marker.scale.x <= 0.1


def test_neighboring_submaps_have_colors_that_differ():
    colors = [drawing.color for drawing in drawings_of_mesh(MESH).values()]
    assert np.abs(np.subtract(*colors)).max() > 0.1


def test_by_height_what_is_as_high_has_the_same_color():
    mesh = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 2]]), np.array([[0, 1, 2]]), np.array([0]))
    (marker,) = read(serialized(HEAD, drawings_of_mesh(mesh, by_height=True)))
    assert marker.colors[0] == marker.colors[1] != marker.colors[2]


def test_by_error_good_faces_are_blue_bad_ones_red_and_those_without_points_gray():
    drawings = drawings_of_mesh(MESH, np.array([0.0, 0.2, np.nan]))
    good, unknown = drawings["mesh", 4].colors[[0, 3]]
    bad = drawings["mesh", 2].colors[0]
    assert good[2] > 2 * good[0] and bad[0] > 2 * bad[2]
    assert unknown[0] == unknown[1] == unknown[2]


def test_the_error_of_a_vertex_is_the_mean_of_the_known_ones_around_it():
    np.testing.assert_allclose(markers.vertex_errors(MESH, np.array([0.1, 0.3, np.nan])), [0.2, 0.1, 0.2, 0.3])


texts = st.text(st.characters(min_codepoint=32, max_codepoint=0x2FFF), max_size=9)


@given(texts, st.lists(st.tuples(texts, st.integers(0, 5), st.booleans()), max_size=6), st.booleans())
def test_the_bytes_are_read_as_the_message(frame, contents, delete_all):
    """In all alignments, which the lengths of the texts and the colors make."""
    head = Header(stamp=Time(sec=-3, nanosec=9), frame_id=frame)
    drawings, expected = {}, []
    if delete_all:
        expected.append((3, "", 0))
    for number, (name, rows, colored) in enumerate(contents):
        corners = np.random.default_rng(number).normal(size=(3 * rows, 3))
        colors = np.full((3 * rows, 4), 0.25, np.float32) if colored else None
        drawings[name, number] = Drawing(Marker.TRIANGLE_LIST, corners, (0.5, 0.25, 0.0, 1.0), colors)
        expected.append((0, name, number))
    data = serialized(head, drawings, delete_all=delete_all)
    message = deserialize_message(data, MarkerArray)
    assert actions(message.markers) == expected
    # Padding holds whatever was there before.
    assert len(serialize_message(message)) == len(data)
    for marker, drawing in zip(message.markers[delete_all:], drawings.values(), strict=True):
        np.testing.assert_array_equal(places(marker), drawing.corners)
        assert marker.header == head
        assert marker.colors == [ColorRGBA(r=0.25, g=0.25, b=0.25, a=0.25)] * (
            0 if drawing.colors is None else len(drawing.corners)
        )


def test_only_what_was_added_modified_and_deleted_is_sent(topic):
    topic.show(HEAD, triangles(a1=0, a2=0, a3=0), 0.0)
    topic.show(HEAD, triangles(a1=0, a2=5, a4=0), 0.5)
    assert actions(topic.publisher.sent[0]) == [(3, "", 0), (0, "a", 1), (0, "a", 2), (0, "a", 3)]
    assert actions(topic.publisher.sent[1]) == [(2, "a", 3), (0, "a", 2), (0, "a", 4)]


def test_what_is_as_before_is_not_sent(topic):
    topic.show(HEAD, triangles(a1=0), 0.0)
    topic.show(HEAD, triangles(a1=1e-5), 0.5)
    assert len(topic.publisher.sent) == 1


def test_many_small_steps_are_sent_once_they_add_up(topic):
    for step in range(100):
        topic.show(HEAD, triangles(a1=5e-6 * step, a2=0), 0.1)
    assert places(topic.publisher.sent[-1][-1])[0, 1] == pytest.approx(5e-6 * 99, abs=1e-4)


def test_once_nothing_changes_any_more_the_message_that_is_kept_holds_all(topic):
    topic.show(HEAD, triangles(a1=0, a2=0), 0.0)
    topic.show(HEAD, triangles(a1=0, a2=5), 0.5)
    topic.settle(1.0)
    assert len(topic.publisher.sent) == 2
    topic.settle(2.0)
    topic.settle(3.0)
    assert len(topic.publisher.sent) == 3
    assert actions(topic.publisher.sent[2]) == [(3, "", 0), (0, "a", 1), (0, "a", 2)]


def test_whoever_subscribes_gets_all_at_once_and_again_when_both_ends_know_each_other(topic):
    topic.show(HEAD, triangles(a1=0, a2=0), 0.0)
    topic.publisher.subscribers = 1
    topic.settle(10.0)
    topic.settle(10.2)
    topic.settle(11.2)
    topic.settle(13.0)
    everything = [(3, "", 0), (0, "a", 1), (0, "a", 2)]
    assert [actions(sent) for sent in topic.publisher.sent] == [everything] * 3


def test_while_something_changes_all_the_time_all_is_sent_every_ten_seconds(topic):
    for second in range(12):
        topic.show(HEAD, triangles(a1=0, a2=second), second)
    whole = [number for number, sent in enumerate(topic.publisher.sent) if sent[0].action == Marker.DELETEALL]
    assert whole == [0, 10]


def test_a_subscriber_that_takes_every_message_sees_what_is_shown(topic):
    """Whatever comes and goes; the markers as RViz keeps them, by namespace and number."""
    rng, seen = np.random.default_rng(0), {}
    for second in range(30):
        shown = triangles(**{f"a{number}": float(rng.integers(3)) for number in rng.permutation(8)[: rng.integers(9)]})
        topic.show(HEAD, shown, second)
        for marker in [marker for sent in topic.publisher.sent for marker in sent]:
            if marker.action == Marker.DELETEALL:
                seen.clear()
            elif marker.action == Marker.DELETE:
                del seen[marker.ns, marker.id]
            else:
                seen[marker.ns, marker.id] = places(marker)
        topic.publisher.sent.clear()
        assert seen.keys() == shown.keys()
        for name, drawing in shown.items():
            np.testing.assert_array_equal(seen[name], drawing.corners)


def test_after_clear_nothing_is_shown_also_to_late_subscribers(topic):
    topic.show(HEAD, triangles(a1=0), 0.0)
    topic.clear(HEAD)
    topic.publisher.subscribers = 1
    topic.settle(5.0)
    assert actions(topic.publisher.sent[-1]) == [(3, "", 0)]
