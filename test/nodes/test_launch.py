# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What `ros2 launch`, RViz and Foxglove would use is checked against the package: none is on the package index."""

from __future__ import annotations

import ast
import importlib.util
import json
from pathlib import Path

import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from rclpy.qos import DurabilityPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible

from g2_recon.nodes.localizer_node import LocalizerNode
from g2_recon.nodes.pipeline_node import STAGES as PIPELINES
from g2_recon.nodes.reconstruct_node import ReconstructNode
from g2_recon.nodes.registrar_node import RegistrarNode

ROOT = Path(__file__).parents[2]
STAGES = {"localizer_node": LocalizerNode, "registrar_node": RegistrarNode, "reconstruct_node": ReconstructNode}
SCANS = {"scan", "scan_vertical"}
ARGUMENTS = {
    "robot": {"namespace", "config", "lasers", "frame_prefix", "mesh", "use_sim_time"},
    "replay": {"bag", "rate", "rviz", "namespace", "config", "lasers"},
    "robots": {"config", "here", "merger", "world", "tf", "lasers", "use_sim_time"},
}
NODES = {
    "robot": {"localizer_node", "registrar_node", "sweep_node", "reconstruct_node"},
    "replay": {"replay_node"},
    "robots": {"map_merger_node", "reconstruct_node"},
}
FILES = {
    "robot": {"config/g2.yaml"},
    "replay": {"config/g2.yaml", "bags/first_floor", "rviz/g2_recon.rviz", "launch/robot.launch.py"},
    "robots": {"config/robots.yaml", "launch/robot.launch.py"},
}
DISPLAYS = [
    display
    for display in yaml.safe_load((ROOT / "rviz/g2_recon.rviz").read_text())["Visualization Manager"]["Displays"]
    if "Topic" in display
]
LAYOUT = json.loads((ROOT / "rviz/foxglove.json").read_text())


@pytest.fixture(params=["robot", "replay", "robots"])
def name(request) -> str:
    """A launch file."""
    return request.param


@pytest.fixture
def tree(name) -> ast.Module:
    return ast.parse((ROOT / f"launch/{name}.launch.py").read_text())


def calls(tree, name: str) -> list[ast.Call]:
    found = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    return [call for call in found if isinstance(call.func, ast.Name) and call.func.id == name]


def texts(tree) -> set[str]:
    return {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}


def test_launch_files_start_nodes_that_there_are(name, tree):
    started = {text for text in texts(tree) if text.endswith("_node")}
    assert started == NODES[name]
    assert all(importlib.util.find_spec(f"g2_recon.nodes.{node}") for node in started)


def test_the_nodes_of_a_robot_are_those_of_the_pipeline():
    code = ast.parse((ROOT / "launch/robot.launch.py").read_text())
    staged = [[argument.value for argument in call.args] for call in calls(code, "stage")]
    for lasers, nodes in PIPELINES.items():
        assert {node for node, *only_with in staged if not only_with or only_with == [lasers]} == set(nodes)


def test_every_argument_is_described(name, tree):
    declared = calls(tree, "DeclareLaunchArgument")
    assert {call.args[0].value for call in declared} == ARGUMENTS[name]
    assert all(any(keyword.arg == "description" for keyword in call.keywords) for call in declared)


def test_only_arguments_that_are_declared_are_used(name, tree):
    assert {call.args[0].value for call in calls(tree, "LaunchConfiguration")} <= ARGUMENTS[name]


@pytest.mark.parametrize("name", ["replay", "robots"])
def test_whoever_includes_the_robot_sets_all_arguments_that_it_has(name):
    code = ast.parse((ROOT / f"launch/{name}.launch.py").read_text())
    (include,) = calls(code, "IncludeLaunchDescription")
    (given,) = [node for node in ast.walk(include) if isinstance(node, ast.Dict)]
    assert {key.value for key in given.keys} == ARGUMENTS["robot"]


def test_files_that_are_named_are_there(name):
    code = (ROOT / f"launch/{name}.launch.py").read_text()
    for file in FILES[name]:
        folder, child = file.split("/")
        assert f'share / "{folder}" / "{child}"' in code
        assert (ROOT / file).exists()
    assert code.count("share / ") == len(FILES[name])


@pytest.fixture(scope="module")
def offered():
    """The QoS of every publisher of the stages, by topic."""
    import rclpy

    rclpy.init(args=["test"])
    nodes = [create() for create in STAGES.values()]
    profiles = {
        publisher.topic_name.lstrip("/"): publisher.qos_profile for node in nodes for publisher in node.publishers
    }
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown()
    return profiles


@pytest.fixture(scope="module")
def published(offered) -> set[str]:
    """The topics that the stages publish for others to look at."""
    return {topic for topic in offered if topic not in ("rosout", "parameter_events", "diagnostics", "keyframes")}


@pytest.mark.parametrize("display", DISPLAYS, ids=lambda display: display["Name"])
def test_rviz_shows_topics_that_there_are_with_a_qos_that_fits(offered, display):
    topic = display["Topic"]
    asked = QoSProfile(
        depth=topic["Depth"],
        reliability=ReliabilityPolicy[topic["Reliability Policy"].upper().replace(" ", "_")],
        durability=DurabilityPolicy[topic["Durability Policy"].upper().replace(" ", "_")],
    )
    if topic["Value"] in SCANS:
        assert asked.reliability == ReliabilityPolicy.BEST_EFFORT
    else:
        assert qos_check_compatible(offered[topic["Value"]], asked)[0] != QoSCompatibility.ERROR


def test_rviz_shows_all_that_the_stages_publish(published):
    assert {display["Topic"]["Value"] for display in DISPLAYS} == published | SCANS


def test_foxglove_shows_all_that_the_stages_publish_and_the_diagnostics(published):
    panels = LAYOUT["configById"]
    shown = {topic.lstrip("/") for panel in panels.values() for topic in panel.get("topics", {})}
    assert shown == published | SCANS
    assert panels["DiagnosticSummary!g2recon"]["topicToRender"] == "/diagnostics"
    assert panels["3D!g2recon"]["publish"]["poseEstimateTopic"] == "/initialpose"


def test_every_panel_of_foxglove_has_its_place():
    placed = {LAYOUT["layout"]["first"], LAYOUT["layout"]["second"]}
    assert placed == set(LAYOUT["configById"])
