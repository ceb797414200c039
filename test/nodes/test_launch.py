# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What `ros2 launch` and RViz would use is checked against the package, since neither is on the package index."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path

import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from rclpy.qos import DurabilityPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible

from g2_recon.nodes.localizer_node import LocalizerNode
from g2_recon.nodes.reconstruct_node import ReconstructNode
from g2_recon.nodes.registrar_node import RegistrarNode

ROOT = Path(__file__).parents[2]
LAUNCH = ROOT / "launch/g2_recon.launch.py"
STAGES = {"localizer_node": LocalizerNode, "registrar_node": RegistrarNode, "reconstruct_node": ReconstructNode}
CODE = LAUNCH.read_text()
CALLS = [node for node in ast.walk(ast.parse(CODE)) if isinstance(node, ast.Call)]
DISPLAYS = yaml.safe_load((ROOT / "rviz/g2_recon.rviz").read_text())["Visualization Manager"]["Displays"]


def calls(name: str) -> list[ast.Call]:
    return [call for call in CALLS if isinstance(call.func, ast.Name) and call.func.id == name]


def test_it_starts_nodes_that_there_are():
    texts = {node.value for node in ast.walk(ast.parse(CODE)) if isinstance(node, ast.Constant)}
    started = {text for text in texts if isinstance(text, str) and text.endswith("_node")}
    assert started == {"localizer_node", "registrar_node", "reconstruct_node", "replay_node"}
    assert all(importlib.util.find_spec(f"g2_recon.nodes.{name}") for name in started)


def test_every_argument_is_described():
    declared = calls("DeclareLaunchArgument")
    assert {call.args[0].value for call in declared} == {"bag", "rate", "config", "namespace", "rviz"}
    assert all(any(keyword.arg == "description" for keyword in call.keywords) for call in declared)


@pytest.mark.parametrize("file", ["config/g2.yaml", "rviz/g2_recon.rviz"])
def test_files_that_it_names_are_there(file):
    folder, name = file.split("/")
    assert f'share / "{folder}" / "{name}"' in CODE
    assert (ROOT / file).is_file()


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


@pytest.mark.parametrize("display", [display for display in DISPLAYS if "Topic" in display], ids=lambda d: d["Name"])
def test_rviz_shows_topics_that_there_are_with_a_qos_that_fits(offered, display):
    topic = display["Topic"]
    asked = QoSProfile(
        depth=topic["Depth"],
        reliability=ReliabilityPolicy[topic["Reliability Policy"].upper().replace(" ", "_")],
        durability=DurabilityPolicy[topic["Durability Policy"].upper().replace(" ", "_")],
    )
    if topic["Value"] in ("scan", "scan_vertical"):
        assert asked.reliability == ReliabilityPolicy.BEST_EFFORT
    else:
        assert qos_check_compatible(offered[topic["Value"]], asked)[0] != QoSCompatibility.ERROR


def test_rviz_shows_all_that_the_stages_publish(offered):
    shown = {display["Topic"]["Value"] for display in DISPLAYS if "Topic" in display}
    published = {topic for topic in offered if topic not in ("rosout", "parameter_events", "diagnostics")}
    assert published <= shown
