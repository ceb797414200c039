# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The merger with robots that are played by the test."""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import simulated_sweeps

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header, UInt8MultiArray, UInt32MultiArray
from std_srvs.srv import Trigger

from g2_recon.geometry import se2, se3
from g2_recon.geometry.cloud import Cloud, Piece
from g2_recon.nodes import conversions
from g2_recon.nodes import ros as ros_of_nodes
from g2_recon.nodes.keyframes import message_of_part
from g2_recon.nodes.map_merger_node import MapMergerNode
from g2_recon.nodes.ros import LATCHED
from g2_recon.reconstruction.collected_cloud import CollectedCloud

USUAL = ("-p", "settle:=0.3", "-p", "stale_after:=60.0")


class Robot:
    """A robot that tells a session and a cloud, and what is asked of it."""

    def __init__(self, harness, name, session, parts, *, frame=None):
        self.name, self.session, self.frame = name, session, frame or f"{name}/map"
        self.parts = list(parts(session, size=40))
        self.asked = []
        node = harness.observer
        self.keyframes = node.create_publisher(UInt8MultiArray, f"/{name}/keyframes", LATCHED)
        self.cloud = node.create_publisher(PointCloud2, f"/{name}/cloud", 1000)
        node.create_subscription(UInt32MultiArray, f"/{name}/keyframes_wanted", self._answer, 10)
        node.create_subscription(UInt32MultiArray, f"/{name}/cloud_wanted", self.asked.append, 10)
        harness.wait_until(lambda: self.cloud.get_subscription_count() and self.keyframes.get_subscription_count())

    def tell(self, part):
        self.keyframes.publish(message_of_part(part, self.frame))

    def tell_all(self):
        for part in self.parts:
            self.tell(part)

    def _answer(self, request):
        _, first = request.data
        rows = slice(first, first + 40)
        self.tell(dataclasses.replace(self.parts[-1], first=first, **self.session.of_rows(rows)))

    def show(self, k, number, sequence, *, revision=0, frame=None):
        """A point at the laser of a keyframe."""
        at = np.array([[*self.session.poses[k, :2], 0.5]])
        head = Header(frame_id=frame or self.frame, stamp=conversions.stamp_message(self.session.stamps[k]))
        piece = Piece(5, number, revision)
        self.cloud.publish(conversions.cloud_to_message(head, Cloud(at, at), piece, sequence))


@pytest.fixture
def start(ros, sessions, parts):
    """`start(*arguments)` starts a merger; `robot(name)` is one that is played."""

    def started(*arguments):
        # What is given later counts.
        harness = ros(*USUAL, *arguments)
        # The process that merges takes some seconds to start.
        harness.wait_until = partial(harness.wait_until, seconds=90)
        harness.node = harness.add(MapMergerNode)
        harness.collected = CollectedCloud()
        harness.frames = set()
        harness.told = harness.collect(DiagnosticArray, "/alignments", LATCHED)
        harness.maps = harness.collect(OccupancyGrid, "/map", LATCHED)

        def take(message):
            harness.frames.add(message.header.frame_id)
            cloud = conversions.usable_points(conversions.cloud_from_message(message))
            harness.collected.add(cloud, conversions.piece_from_message(message))

        harness.observer.create_subscription(PointCloud2, "/cloud", take, 1000)
        harness.robot = lambda name, session=None, **how: Robot(
            harness, name, sessions[name] if session is None else session, parts, **how
        )
        harness.state = lambda name: {s.name: dict_of(s)["state"] for s in harness.told[-1].status}.get(name)
        harness.status = lambda name: next((s for s in harness.told[-1].status if s.name == name), None)
        return harness

    return started


def dict_of(status):
    return {pair.key: pair.value for pair in status.values}


def test_robots_are_found_and_come_into_one_map(start, sessions):
    harness = start()
    robots = [harness.robot(name) for name in sessions]
    for robot in robots:
        robot.tell_all()
        robot.show(5, 0, 0)
    harness.wait_until(lambda: harness.told and [harness.state(name) for name in sessions] == ["aligned"] * 3)
    harness.wait_until(lambda: len(harness.collected) == 3)
    assert harness.frames == {"world"}
    assert harness.maps[-1].header.frame_id == "world"
    values = dict_of(harness.status("two"))
    T = np.array([float(values[key]) for key in ("x", "y", "yaw")])
    place = se2.compose(T, sessions["two"].poses[5])
    off = np.linalg.norm(harness.collected.cloud().points[:, :2] - place[:2], axis=1)
    # m: the transform is that of the end of the way, and maps are bent a little.
    assert off.min() < 0.05


def test_a_world_that_nothing_is_known_of_is_not_told(start):
    harness = start("-p", "robots:=[one,four]")
    one = harness.robot("one")
    one.show(5, 0, 0)
    harness.wait_until(lambda: harness.told and harness.state("four") == "waiting")
    assert harness.state("one") == "waiting"
    assert "waiting for `/four/keyframes`: no publisher" in harness.status("four").message
    assert "x" not in dict_of(harness.status("one"))
    assert len(harness.collected) == 0


def test_keyframes_that_are_lacking_are_asked_for(start, sessions):
    harness = start()
    one = harness.robot("one")
    one.tell(one.parts[-1])
    key = "keyframes"
    harness.wait_until(
        lambda: (
            harness.told and harness.status("one") and dict_of(harness.status("one"))[key] == str(len(sessions["one"]))
        )
    )


def test_clouds_that_are_lacking_are_asked_for_until_they_come_anew(start):
    harness = start()
    one = harness.robot("one")
    one.show(5, 0, 0)
    one.show(30, 2, 3)
    harness.wait_until(lambda: one.asked)
    assert list(one.asked[0].data) == [5, 1, 3]
    lacking = harness.node._gaps
    one.show(20, 1, 4, revision=1)
    harness.wait_until(lambda: not any(lacking.values()))
    one.tell_all()
    harness.wait_until(lambda: len(harness.collected) == 3)


def test_a_robot_that_falls_silent_is_stale_and_keeps_what_it_told(start):
    harness = start("-p", "stale_after:=2.0")
    one = harness.robot("one")
    one.tell_all()
    harness.wait_until(lambda: harness.told and harness.state("one") == "stale")
    harness.wait_until(lambda: "aligned" in harness.status("one").message)
    status = harness.status("one")
    assert status.level == DiagnosticStatus.STALE
    assert "what it told before is kept; aligned" in status.message
    assert "x" in dict_of(status)
    one.tell(one.parts[-1])
    harness.wait_until(lambda: harness.state("one") == "aligned")


def test_what_is_unusable_is_counted_and_the_rest_goes_on(start):
    harness = start()
    one = harness.robot("one")
    one.keyframes.publish(UInt8MultiArray(data=b"nothing"))
    harness.wait_until(lambda: harness.node.drops["unusable keyframes"] == 1)
    one.tell_all()
    harness.wait_until(lambda: harness.told and harness.state("one") == "aligned")
    one.show(5, 0, 0, frame="odd")
    harness.wait_until(lambda: harness.node.drops["cloud in another frame"] == 1)
    one.cloud.publish(conversions.cloud_to_message(Header(frame_id="one/map"), Cloud(np.ones((1, 3)))))
    harness.wait_until(lambda: harness.node.drops["cloud that says nothing of its piece"] == 1)


def test_a_reset_takes_back_what_was_handed_on_and_asks_for_what_robots_still_have(start):
    harness = start()
    one = harness.robot("one")
    one.tell_all()
    one.show(5, 0, 0)
    harness.wait_until(lambda: len(harness.collected) == 1)
    assert harness.call(Trigger, "/map_merger_node/reset").success
    harness.wait_until(lambda: len(harness.collected) == 0)
    one.tell(one.parts[-1])
    harness.wait_until(lambda: harness.state("one") == "aligned")


def test_a_start_that_is_known_is_where_the_world_is(start):
    harness = start("-p", "starts:=['one 5.0 1.0 1.5']")
    harness.robot("one").tell_all()
    harness.wait_until(lambda: harness.told and harness.state("one") == "aligned")
    values = dict_of(harness.status("one"))
    assert [float(values[key]) for key in ("x", "y", "yaw")] == pytest.approx([5.0, 1.0, 1.5])


@pytest.mark.parametrize(
    ("frame", "sent"),
    [("one/map", {"/tf": "one/map"}), ("map", {"/tf": "one/map", "/one/tf": "map"})],
    ids=["one tree for all", "a tree for each"],
)
def test_both_styles_of_tf_work(start, monkeypatch, frame, sent):
    """tf2, which the package index does not hold, is played by what is sent to it."""
    transforms = {}

    class OwnTree:
        def publish(self, message):
            transforms["/one/tf"] = message.transforms[0]

    create = MapMergerNode.create_publisher
    shared = SimpleNamespace(sendTransform=lambda transform: transforms.update({"/tf": transform}))
    monkeypatch.setattr(ros_of_nodes, "tf2_ros", SimpleNamespace(TransformBroadcaster=lambda node: shared))
    monkeypatch.setattr(ros_of_nodes, "tf2_msgs", SimpleNamespace(TFMessage=SimpleNamespace))
    monkeypatch.setattr(
        MapMergerNode,
        "create_publisher",
        lambda self, kind, *rest, **how: OwnTree() if kind is SimpleNamespace else create(self, kind, *rest, **how),
    )
    harness = start("-p", "starts:=['one 5.0 1.0 1.5']")
    robot = harness.robot("one", frame=frame)
    assert not transforms
    robot.tell_all()
    harness.wait_until(lambda: set(transforms) == set(sent))
    for tree, child in sent.items():
        assert (transforms[tree].header.frame_id, transforms[tree].child_frame_id) == ("world", child)
        T = se2.from_se3(conversions.transform_matrix(transforms[tree].transform))
        np.testing.assert_allclose(T, (5.0, 1.0, 1.5), atol=1e-6)


def test_a_robot_that_makes_sweeps_is_stale_once_it_is_gone_and_not_from_one_stop_to_the_next(start):
    harness = start("-p", "stale_after:=1.0")
    publisher = harness.observer.create_publisher(PointCloud2, "/anna/cloud", 1000)
    harness.wait_until(publisher.get_subscription_count)
    at = simulated_sweeps.stop(3, 3, 10)
    points = simulated_sweeps.sweep(simulated_sweeps.furnished_room(), at, np.random.default_rng(0))
    head = Header(frame_id="anna/map", stamp=conversions.stamp_message(100.0))
    publisher.publish(conversions.cloud_to_message(head, Cloud(points, np.zeros_like(points)), Piece(1, 0), 0))
    harness.wait_until(lambda: harness.told and harness.state("anna") == "aligned")
    harness.wait_until(lambda: harness.node.inputs["anna/cloud"].silent_for > 1.5)
    told = len(harness.told)
    harness.wait_until(lambda: len(harness.told) > told + 1)
    assert harness.state("anna") == "aligned"
    harness.observer.destroy_publisher(publisher)
    harness.wait_until(lambda: harness.state("anna") == "stale")


def test_robots_that_make_sweeps_are_found_and_come_into_one_world(start):
    harness = start()
    rectangles, rng = simulated_sweeps.furnished_room(), np.random.default_rng(0)
    stop = simulated_sweeps.stop
    begin = se3.from_xyz_rpy([4.0, -2.5, 0.0, 0.0, 0.0, 2.2])
    for number, (name, T_building_map, stops) in enumerate(
        [
            ("anna", np.eye(4), [stop(3, 3, 10), stop(12, 3.5, 170)]),
            ("bert", begin, [stop(8, 3, 160), stop(5, 4.5, -20)]),
        ]
    ):
        publisher = harness.observer.create_publisher(PointCloud2, f"/{name}/cloud", 1000)
        harness.wait_until(publisher.get_subscription_count)
        for piece, at in enumerate(stops):
            T = se3.inverse(T_building_map) @ at
            points = se3.transform_points(T, simulated_sweeps.sweep(rectangles, at, rng))
            cloud = Cloud(points, np.tile(T[:3, 3], (len(points), 1)))
            head = Header(frame_id=f"{name}/map", stamp=conversions.stamp_message(100.0 + 10 * piece + number))
            publisher.publish(conversions.cloud_to_message(head, cloud, Piece(number, piece), piece))
    harness.wait_until(lambda: harness.told and harness.state("bert") == harness.state("anna") == "aligned")
    values = dict_of(harness.status("bert"))
    assert values["sweeps"] == "2"
    assert values["frame"] == "bert/map"
    found = [float(values[key]) for key in ("x", "y", "yaw")]
    # m, rad: 5 cm and half a degree are wanted.
    assert found[:2] == pytest.approx([4.0, -2.5], abs=0.05)
    assert found[2] == pytest.approx(2.2, abs=math.radians(0.5))
    harness.wait_until(lambda: len(harness.collected) == harness.node._merger.cloud.points)
