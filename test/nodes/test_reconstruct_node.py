# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from threading import Event

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker, MarkerArray

from g2_recon.config import ReconstructionConfig
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
        harness.node = harness.add(ReconstructNode)
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
    assert {marker.type for marker in shown_by(meshes).values()} == {Marker.TRIANGLE_LIST}


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


def strip(begin, end, seed=0) -> Cloud:
    """A wall at y = 2 m from x = begin to end, seen from y = 0, 1000 points a metre."""
    rng = np.random.default_rng(seed)
    count = int(1000 * (end - begin))
    x = rng.uniform(begin, end, count)
    points = np.column_stack([x, np.full(count, 2.0), rng.uniform(-1, 1, count)])
    return Cloud(points, points * (1, 0, 0))


def shown_by(messages: list[MarkerArray]) -> dict[tuple[str, int], Marker]:
    """The markers as RViz has them after these messages."""
    shown: dict[tuple[str, int], Marker] = {}
    for marker in (marker for message in messages for marker in message.markers):
        if marker.action == Marker.DELETEALL:
            shown.clear()
        elif marker.action == Marker.DELETE:
            shown.pop((marker.ns, marker.id), None)
        else:
            shown[marker.ns, marker.id] = marker
    return shown


def farthest(messages: list[MarkerArray]) -> float:
    """The largest x in metres of what is shown."""
    return max((point.x for marker in shown_by(messages).values() for point in marker.points), default=-np.inf)


LIVE = ("-p", "rebuild:=continuous")
NAMES = ("points", "sensor")


def test_new_points_show_in_the_mesh_without_being_asked_for(node):
    robot = node(*LIVE)
    meshes = robot.collect(MarkerArray, "mesh", LATCHED)
    for number in range(4):
        robot.send(piece(strip(2 * number, 2 * number + 2, seed=number), 1, number, 0))
        robot.wait_until(lambda end=2 * number + 2: farthest(meshes) > end - 0.3)
    assert len(shown_by(meshes)) >= 4


def test_a_late_subscriber_sees_the_same_as_one_that_was_there_all_the_time(node):
    robot = node(*LIVE)
    early = robot.collect(MarkerArray, "mesh", LATCHED)
    for number in range(3):
        robot.send(piece(strip(4 * number, 4 * number + 4, seed=number), 1, number, 0))
        robot.wait_until(lambda end=4 * number + 4: farthest(early) > end - 0.3)
    late = robot.collect(MarkerArray, "mesh", LATCHED)
    robot.wait_until(lambda: late and shown_by(late).keys() == shown_by(early).keys())
    for name, marker in shown_by(early).items():
        assert shown_by(late)[name].points == marker.points


def test_only_submaps_that_changed_are_sent(node):
    robot = node(*LIVE)
    robot.send(piece(strip(0, 12), 1, 0, 0))
    meshes = robot.collect(MarkerArray, "mesh", LATCHED)
    robot.wait_until(lambda: farthest(meshes) > 11.7)
    count = len(shown_by(meshes))
    robot.send(piece(strip(12, 13, seed=1), 1, 1, 0))
    robot.wait_until(lambda: farthest(meshes) > 12.7)
    (changes,) = [message.markers for message in meshes if message.markers[0].action != Marker.DELETEALL]
    assert 0 < len(changes) < count / 2
    assert all(point.x > 8 for marker in changes for point in marker.points)


def test_a_piece_that_is_moved_leaves_nothing_of_its_old_place_in_the_live_mesh(node):
    robot = node(*LIVE)
    meshes = robot.collect(MarkerArray, "mesh", LATCHED)
    for number in range(3):
        robot.send(piece(strip(4 * number, 4 * number + 4, seed=number), 1, number, 0))
    robot.wait_until(lambda: farthest(meshes) > 11.7)
    moved = strip(8, 12, seed=2)
    robot.send(piece(Cloud(moved.points - (0, 0, 5), moved.sensor - (0, 0, 5)), 1, 2, 1))

    def has_moved() -> bool:
        corners = [(p.x, p.z) for marker in shown_by(meshes).values() for p in marker.points]
        return min(z for _, z in corners) < -4 and max(x for x, z in corners if z > -2) < 8.3

    robot.wait_until(has_moved)


def test_after_a_request_the_mesh_is_that_of_all_points_at_once(node, tmp_path):
    robot = node(*LIVE, "-p", f"session_dir:={tmp_path}")
    meshes = robot.collect(MarkerArray, "mesh", LATCHED)
    clouds = [strip(4 * number, 4 * number + 4, seed=number) for number in range(3)]
    for number, cloud in enumerate(clouds):
        robot.send(piece(cloud, 1, number, 0))
        robot.wait_until(lambda end=4 * number + 4: farthest(meshes) > end - 0.3)
    assert reconstruct(robot).success
    assert robot.call(Trigger, "reconstruct_node/save").success
    # Through float32, as the messages are.
    whole = Cloud(*(np.concatenate([getattr(c, n) for c in clouds]).astype(np.float32).astype(float) for n in NAMES))
    offline = reconstructor.reconstruct(whole, ReconstructionConfig()).mesh
    vertices, faces = read_mesh(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(faces, offline.faces)
    np.testing.assert_allclose(vertices, offline.vertices, atol=1e-5)  # m; the file holds float32


def test_every_n_seconds_the_mesh_waits_for_its_time(node):
    robot = node("-p", "rebuild:=every_n_seconds", "-p", "rebuild_period:=3600.0")
    meshes = robot.collect(MarkerArray, "mesh", LATCHED)
    robot.send(piece(strip(0, 4), 1, 0, 0))
    robot.wait_until(lambda: farthest(meshes) > 3.7)
    robot.send(piece(strip(4, 8, seed=1), 1, 1, 0))
    robot.wait_for_points(8000)
    assert farthest(meshes) < 4.3
    assert robot.node.set_parameters([Parameter("rebuild_period", value=0.1)])[0].successful
    robot.wait_until(lambda: farthest(meshes) > 7.7)


def test_colors_change_while_the_node_runs(node):
    robot = node(*LIVE)
    meshes = robot.collect(MarkerArray, "mesh", LATCHED)
    robot.send(piece(strip(0, 4), 1, 0, 0))
    robot.wait_until(lambda: farthest(meshes) > 3.7)
    assert not any(marker.colors for marker in shown_by(meshes).values())
    for color_by in ("height", "error"):
        before = [list(marker.colors) for marker in shown_by(meshes).values()]
        assert robot.node.set_parameters([Parameter("color_by", value=color_by)])[0].successful
        robot.wait_until(lambda old=before: [list(m.colors) for m in shown_by(meshes).values()] != old)
        for marker in shown_by(meshes).values():
            assert len(marker.colors) == len(marker.points)


def test_too_few_points_for_a_live_mesh_are_told_in_the_diagnostics(node):
    robot = node(*LIVE)
    robot.send(wall(3))
    robot.wait_until(lambda: any("3 distinct usable points" in d.status[0].message for d in robot.diagnostics))
    robot.send(wall(2000, seed=1))
    meshes = robot.collect(MarkerArray, "mesh", LATCHED)
    robot.wait_until(lambda: shown_by(meshes))


def test_what_is_forgotten_is_not_shown_again(node):
    robot = node(*LIVE)
    meshes = robot.collect(MarkerArray, "mesh", LATCHED)
    robot.send(piece(strip(0, 4), 1, 0, 0))
    robot.wait_until(lambda: farthest(meshes) > 3.7)
    assert robot.call(Trigger, "reconstruct_node/reset").success
    robot.wait_until(lambda: not shown_by(meshes))
    robot.send(piece(strip(8, 12), 2, 0, 0))
    robot.wait_until(lambda: farthest(meshes) > 11.7)
    assert min(point.x for marker in shown_by(meshes).values() for point in marker.points) > 7.7
