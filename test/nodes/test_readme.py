# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The tables of the README say what the running nodes have."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from g2_recon.nodes.localizer_node import LocalizerNode
from g2_recon.nodes.map_merger_node import MapMergerNode
from g2_recon.nodes.reconstruct_node import ReconstructNode
from g2_recon.nodes.registrar_node import RegistrarNode
from g2_recon.nodes.replay_node import ReplayNode
from g2_recon.nodes.sweep_node import SweepNode

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
BAG = ROOT / "bags/first_floor"
# Stands for the robots of the merger.
ROBOT = "robot1"
NODES = {
    "localizer_node": LocalizerNode,
    "registrar_node": RegistrarNode,
    "sweep_node": SweepNode,
    "reconstruct_node": ReconstructNode,
    "map_merger_node": MapMergerNode,
    "replay_node": ReplayNode,
}
# What every node of rclpy has.
OF_ROS = {"/rosout", "/parameter_events"}
RECORDED = {"/scan", "/scan_vertical", "/odom", "/tf_static"}


def rows(title: str) -> list[list[str]]:
    """The cells of the table under a title."""
    section = README.split(f"### {title}\n")[1].split("\n#")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def topics(title: str) -> dict[str, set[tuple[str, str]]]:
    """Topics and their types by node; an empty cell stands for the node above it."""
    table: dict[str, set[tuple[str, str]]] = {}
    node = ""
    for name, topic, kind, _ in rows(title):
        node = name.strip("`") or node
        table.setdefault(node, set()).add((topic.strip("`").replace("<robot>", ROBOT), kind))
    return table


def type_name(kind: type) -> str:
    return f"{kind.__module__.split('.')[0]}/{kind.__name__}"


@pytest.fixture(scope="module")
def running():
    """A node of each kind."""
    import rclpy

    rclpy.init(args=["test", "--ros-args", "-p", f"replay_node:bag:={BAG}", "-p", f"robots:=[{ROBOT}]"])
    nodes = {name: create() for name, create in NODES.items()}
    yield nodes
    for node in nodes.values():
        node.destroy_node()
    rclpy.shutdown()


@pytest.mark.parametrize("name", NODES)
def test_subscribed_topics(running, name):
    found = {
        (subscription.topic_name.lstrip("/"), type_name(subscription.msg_type))
        for subscription in running[name].subscriptions
        if subscription.topic_name not in OF_ROS
    }
    assert topics("Subscribed topics").get(name, set()) == found


@pytest.mark.parametrize("name", NODES)
def test_published_topics(running, name):
    told = topics("Published topics")
    published = {
        (publisher.topic_name, type_name(publisher.msg_type))
        for publisher in running[name].publishers
        if publisher.topic_name not in OF_ROS | (RECORDED if name == "replay_node" else set())
    }
    expected = {(topic if topic.startswith("/") else f"/{topic}", kind) for topic, kind in told[name] | told["all"]}
    assert published == expected


def test_services(running):
    told = {(name.strip("` "), kind) for names, kind, _ in rows("Services") for name in names.split(",")}
    of_ros = re.compile(r"/(get|set|list|describe)_(parameters?(_types|s_atomically)?|type_description)$")
    found = {
        (node.resolve_service_name(service.srv_name), type_name(service.srv_type))
        for node in running.values()
        for service in node.services
        if not of_ros.search(service.srv_name)
    }
    assert told == found
