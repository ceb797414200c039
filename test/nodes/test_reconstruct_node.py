# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from threading import Event

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker, MarkerArray

from g2_recon.geometry.cloud import Cloud, Piece
from g2_recon.nodes import conversions
from g2_recon.nodes.reconstruct_node import ReconstructNode
from g2_recon.nodes.ros import LATCHED
from g2_recon.reconstruction import reconstructor
from g2_recon.recording.clouds import read_cloud
from g2_recon.recording.meshes import read_mesh

SMALL = ("-p", "clusters:=4", "-p", "rows:=5", "-p", "columns:=5")


def wall(points=500, seed=0) -> Cloud:
    """A wall at x = 2 m, seen from the origin."""
    rng = np.random.default_rng(seed)
    across = rng.uniform(-1, 1, (points, 2))
    return Cloud(np.column_stack([np.full(points, 2.0), across]), np.zeros((points, 3)))


def value(diagnostics: list, key: str) -> str | None:
    pairs = {pair.key: pair.value for array in diagnostics for pair in array.status[0].values}
    return pairs.get(key)


@pytest.fixture
def node(ros):
    """`node(*arguments)` starts the node and gives the test's end of its topics."""

    def start(*arguments):
        harness = ros(*SMALL, *arguments)
        harness.add(ReconstructNode, threads=4)
        harness.diagnostics = harness.collect(DiagnosticArray, "/diagnostics")

        def send(cloud, frame="map", topic="cloud"):
            message = cloud if isinstance(cloud, PointCloud2) else conversions.cloud_to_message(Header(), cloud)
            message.header.frame_id = frame
            harness.publisher(PointCloud2, topic).publish(message)

        harness.send = send
        harness.wait_for_points = lambda count: harness.wait_until(
            lambda: value(harness.diagnostics, "points") == str(count)
        )
        return harness

    return start


def reconstruct(harness):
    return harness.call(Trigger, "reconstruct_node/reconstruct")


def test_on_request_the_wall_becomes_a_wire_mesh_for_whoever_comes_late(node):
    robot = node()
    robot.send(wall())
    robot.wait_for_points(500)
    answer = reconstruct(robot)
    assert answer.success and answer.message.startswith("500 points, ")
    meshes = robot.collect(MarkerArray, "wire_mesh", LATCHED)
    robot.wait_until(lambda: meshes)
    neurons = np.array([(point.x, point.y, point.z) for marker in meshes[0].markers for point in marker.points])
    np.testing.assert_allclose(neurons[:, 0], 2.0, atol=1e-6)


def test_the_mesh_is_there_for_whoever_comes_late(node):
    robot = node()
    robot.send(wall())
    robot.wait_for_points(500)
    assert reconstruct(robot).success
    meshes = robot.collect(MarkerArray, "mesh", LATCHED)
    robot.wait_until(lambda: meshes)
    assert {marker.type for marker in meshes[0].markers[1:]} == {Marker.TRIANGLE_LIST}


def test_too_few_points_are_refused_with_the_reason(node):
    robot = node()
    robot.send(wall(3))
    robot.wait_for_points(3)
    answer = reconstruct(robot)
    assert not answer.success and "3 distinct usable points" in answer.message


def test_without_a_cloud_the_answer_is_no(node):
    assert not reconstruct(node()).success


def test_clouds_are_taken_in_and_a_second_request_is_refused_during_a_reconstruction(node, monkeypatch):
    begun, may_end = Event(), Event()

    def reconstruct_when_told(cloud, *arguments, **options):
        begun.set()
        assert may_end.wait(60), "never told to go on"
        return reconstructor.reconstruct(cloud, *arguments, **options)

    monkeypatch.setattr("g2_recon.nodes.reconstruct_node.reconstruct", reconstruct_when_told)
    robot = node()
    robot.send(wall(2000))
    robot.wait_for_points(2000)
    first = robot.call_async(Trigger, "reconstruct_node/reconstruct")
    robot.wait_until(begun.is_set)
    second = reconstruct(robot)
    robot.send(wall(100, seed=1))
    robot.wait_for_points(2100)
    assert not second.success and "is being made" in second.message
    may_end.set()
    robot.wait_until(first.done)
    assert first.result().success and first.result().message.startswith("2000 points, ")


def test_points_that_are_not_finite_or_absurdly_far_away_are_counted(node):
    robot = node()
    cloud = wall(10)
    cloud.points[:4] = ((np.nan, 0, 0), (0, np.inf, 0), (0, 0, -np.inf), (1e30, 0, 0))
    robot.send(cloud)
    robot.wait_until(lambda: value(robot.diagnostics, "dropped: point that is not finite or absurdly far away") == "4")


def test_a_cloud_in_another_frame_is_dropped_and_counted(node):
    robot = node()
    robot.send(wall(), frame="odom")
    robot.wait_until(lambda: value(robot.diagnostics, "dropped: cloud in another frame") == "1")


def test_a_broken_cloud_is_dropped_and_counted(node):
    robot = node()
    broken = conversions.cloud_to_message(Header(), wall())
    broken.data = broken.data[:-1]
    robot.send(broken)
    robot.wait_until(lambda: value(robot.diagnostics, "dropped: unusable cloud") == "1")


def test_clouds_of_several_robots_are_put_together(node):
    robot = node("-p", "cloud_topics:=[robot1/cloud,robot2/cloud]")
    robot.send(wall(300), topic="robot1/cloud")
    robot.send(wall(200, seed=1), topic="robot2/cloud")
    robot.wait_for_points(500)


def piece(cloud, *numbers):
    return conversions.cloud_to_message(Header(), cloud, Piece(*numbers))


def test_a_piece_that_is_placed_anew_leaves_nothing_of_the_old_place_in_cloud_and_mesh(node, tmp_path):
    robot = node("-p", f"session_dir:={tmp_path}")
    robot.send(piece(wall(300), 1, 0, 0))
    robot.send(piece(wall(400, seed=1), 1, 1, 0))
    robot.wait_for_points(700)
    moved = Cloud(wall(300).points + (5.0, 0.0, 0.0), np.zeros((300, 3)))
    robot.send(piece(moved, 1, 0, 1))
    # The old place again, by a message that was overtaken.
    robot.send(piece(wall(300), 1, 0, 0))
    robot.send(piece(Cloud(moved.points + (0, 0.001, 0), moved.sensor), 1, 1, 1))
    robot.wait_for_points(600)
    assert value(robot.diagnostics, "dropped: cloud of an older revision") == "1"
    assert reconstruct(robot).success
    assert robot.call(Trigger, "reconstruct_node/save").success
    assert read_cloud(tmp_path / "cloud.ply").points[:, 0].min() == pytest.approx(7.0)
    assert read_mesh(tmp_path / "mesh.ply")[0][:, 0].min() > 6.5


def test_points_that_their_source_takes_back_are_gone(node):
    robot = node()
    robot.send(piece(wall(300), 1, 0, 0))
    robot.send(piece(wall(200, seed=1), 2, 0, 0))
    robot.wait_for_points(500)
    robot.send(conversions.no_pieces_message(Header(), 1))
    robot.wait_for_points(200)
    assert value(robot.diagnostics, "dropped: point that is not finite or absurdly far away") is None


def test_save_writes_cloud_and_meshes(node, tmp_path):
    robot = node("-p", f"session_dir:={tmp_path}")
    robot.send(wall())
    robot.wait_for_points(500)
    assert reconstruct(robot).success
    assert robot.call(Trigger, "reconstruct_node/save").success
    assert len(read_cloud(tmp_path / "cloud.ply")) == 500
    assert len(read_mesh(tmp_path / "mesh.ply")[1]) > 0
    assert (tmp_path / "wire_mesh.ply").stat().st_size > 0


def test_save_before_a_reconstruction_writes_the_cloud_and_says_so(node, tmp_path):
    robot = node("-p", f"session_dir:={tmp_path}")
    robot.send(wall())
    robot.wait_for_points(500)
    answer = robot.call(Trigger, "reconstruct_node/save")
    assert answer.success and "call ~/reconstruct first" in answer.message
    assert {file.name for file in tmp_path.iterdir()} == {"cloud.ply", "clouds.journal"}


def test_save_to_a_place_that_cannot_be_written_says_so(node, tmp_path):
    (tmp_path / "file").write_text("")
    robot = node("-p", f"session_dir:={tmp_path}/file")
    robot.send(wall())
    robot.wait_for_points(500)
    answer = robot.call(Trigger, "reconstruct_node/save")
    assert not answer.success and "cannot be written" in answer.message


def test_reset_forgets_the_points_and_clears_what_is_shown(node):
    robot = node()
    robot.send(wall())
    robot.wait_for_points(500)
    assert reconstruct(robot).success
    assert robot.call(Trigger, "reconstruct_node/reset").success
    meshes = robot.collect(MarkerArray, "mesh", LATCHED)
    robot.wait_until(lambda: meshes)
    assert [marker.action for marker in meshes[-1].markers] == [Marker.DELETEALL]
    assert not reconstruct(robot).success


def test_while_paused_clouds_are_counted_but_not_used(node):
    robot = node()
    assert robot.call(SetBool, "reconstruct_node/pause", SetBool.Request(data=True)).success
    robot.send(wall())
    robot.wait_until(lambda: value(robot.diagnostics, "dropped: cloud while paused") == "1")
    assert value(robot.diagnostics, "points") == "0"
