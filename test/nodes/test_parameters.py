# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

import rclpy
from rclpy.parameter import Parameter

from g2_recon import config
from g2_recon.errors import ConfigError
from g2_recon.nodes import parameters
from g2_recon.nodes.parameters import (
    LocalizerParameters,
    MapMergerParameters,
    ReconstructParameters,
    RegistrarParameters,
    ReplayParameters,
    SweepParameters,
)

ROOT = Path(__file__).parents[2]
MODELS = {
    "localizer_node": LocalizerParameters,
    "registrar_node": RegistrarParameters,
    "sweep_node": SweepParameters,
    "reconstruct_node": ReconstructParameters,
    "map_merger_node": MapMergerParameters,
    "replay_node": ReplayParameters,
}


@pytest.fixture
def declared(ros):
    """`declared(name, *arguments)` declares the parameters of a node that is started with the arguments."""

    def declare(name, *arguments, namespace=""):
        node = ros(*arguments).add(lambda: rclpy.create_node(name, namespace=namespace))
        return parameters.declare(node, MODELS[name]), node

    return declare


@pytest.mark.parametrize("name", MODELS)
def test_without_values_parameters_have_the_defaults_of_the_model(declared, name):
    values, _ = declared(name)
    assert values == MODELS[name]()


@pytest.mark.parametrize("name", MODELS)
def test_every_parameter_says_what_it_means(declared, name):
    _, node = declared(name)
    for setting in config.settings(MODELS[name]):
        descriptor = node.describe_parameter(setting.name)
        assert setting.meaning and setting.meaning in descriptor.description
        assert setting.unit in descriptor.description
        assert descriptor.read_only == (setting.name not in MODELS[name].live)


@pytest.mark.parametrize("name", MODELS)
def test_every_number_has_its_range(declared, name):
    _, node = declared(name)
    for setting in config.settings(MODELS[name]):
        descriptor = node.describe_parameter(setting.name)
        limits = [*descriptor.floating_point_range, *descriptor.integer_range]
        if setting.type in (int, float):
            assert [(limit.from_value, limit.to_value) for limit in limits] == [(setting.minimum, setting.maximum)]


def test_choices_are_told(declared):
    _, node = declared("reconstruct_node")
    assert node.describe_parameter("mode").additional_constraints == "one of: solid, paper"


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("localizer_node", "max_range:=1000.0", "max_range out of range"),
        ("localizer_node", "max_range:=.nan", "max_range"),
        ("localizer_node", "max_range:=5", "a decimal number needs a point"),
        ("localizer_node", "max_iterations:=0", "max_iterations out of range"),
        ("localizer_node", "laser_pose:=[1.0,2.0]", "six numbers"),
        ("localizer_node", "min_range:=9.0", "min_range"),
        ("reconstruct_node", "mode:=best", "mode"),
        ("reconstruct_node", "cloud_topics:=3", "cloud_topics"),
    ],
)
def test_a_wrong_value_is_refused_in_one_line_that_names_it(declared, name, value, told):
    arguments = ["-p", value] + (["-p", "max_range:=1.0"] if value.startswith("min_range") else [])
    with pytest.raises(ConfigError, match=told) as refused:
        declared(name, *arguments)
    assert name in str(refused.value)
    assert "\n" not in str(refused.value)


def test_an_empty_pose_is_no_pose(declared):
    values, _ = declared("localizer_node", "-p", "laser_pose:=[]")
    assert values.laser_pose == ()


@pytest.mark.parametrize("name", MODELS)
def test_what_is_live_is_a_parameter(name):
    assert MODELS[name].live <= set(MODELS[name].model_fields)


@pytest.fixture
def followed(declared):
    """`followed(name)`: a node whose parameters can be changed, and the settings that it takes."""

    def follow(name, *arguments):
        settings, node = declared(name, *arguments)
        taken = []
        parameters.follow(node, settings, taken.append)
        return node, taken

    return follow


def test_what_is_not_live_cannot_be_changed_while_the_node_runs(followed):
    node, taken = followed("localizer_node")
    answer = node.set_parameters([Parameter("max_range", value=10.0)])[0]
    assert not answer.successful and "read-only" in answer.reason
    assert taken == []


@pytest.mark.parametrize(
    ("name", "parameter", "value"),
    [
        ("localizer_node", "odometry_wait", 0.5),
        ("registrar_node", "max_wait", 5.0),
        ("reconstruct_node", "spacing", 0.3),
        ("reconstruct_node", "mode", "paper"),
        ("replay_node", "rate", 2.5),
    ],
)
def test_a_live_parameter_is_changed(followed, name, parameter, value):
    node, taken = followed(name)
    assert node.set_parameters([Parameter(parameter, value=value)])[0].successful
    assert [getattr(settings, parameter) for settings in taken] == [value]


@pytest.mark.parametrize(
    ("name", "parameter", "value", "told"),
    [
        ("localizer_node", "odometry_wait", 11.0, "odometry_wait out of range"),
        ("reconstruct_node", "spacing", float("nan"), "spacing"),
        ("reconstruct_node", "mode", "best", "mode: Input should be 'solid' or 'paper', got 'best'"),
        ("reconstruct_node", "rows", 200, None),
        ("registrar_node", "min_range", 10.0, None),
        ("replay_node", "rate", "fast", "expected 'Type.DOUBLE'"),
    ],
)
def test_a_value_that_does_not_do_is_refused_with_the_reason_and_changes_nothing(
    followed, name, parameter, value, told
):
    arguments = {"rows": ("-p", "columns:=100"), "min_range": ("-p", "max_range:=5.0")}.get(parameter, ())
    reasons = {"rows": "rows x columns", "min_range": "min_range must be smaller than max_range"}
    node, taken = followed(name, *arguments)
    before = node.get_parameter(parameter).value
    answer = node.set_parameters([Parameter(parameter, value=value)])[0]
    assert not answer.successful and (told or reasons[parameter]) in answer.reason
    assert (node.get_parameter(parameter).value, taken) == (before, [])


@pytest.mark.parametrize("namespace", ["", "robot1", "site/robot1"])
def test_the_file_for_the_g2_applies_in_every_namespace(declared, namespace):
    values, _ = declared("registrar_node", "--params-file", str(ROOT / "config/g2.yaml"), namespace=namespace)
    assert values == parameters.G2["registrar_node"]


@pytest.mark.parametrize(("file", "robots"), [("g2", ""), ("robots", "robot1 robot2 robot3")])
def test_the_files_are_current(file, robots):
    command = f"python -m g2_recon.nodes.parameters {robots}".strip()
    written = (ROOT / f"config/{file}.yaml").read_text()
    assert written == parameters.dump(parameters.G2, robots.split()), f"run `{command} > config/{file}.yaml`"


def test_the_file_for_several_robots_names_them():
    nodes = yaml.safe_load(parameters.dump(parameters.G2, ["anna", "bert"]))
    assert nodes["/**/map_merger_node"]["ros__parameters"]["robots"] == ["anna", "bert"]


def test_what_is_for_one_robot_counts_before_what_is_for_all(declared, tmp_path):
    farthest = {"/**": 5.0, "/robot1": 7.0}
    given = {f"{space}/registrar_node": {"ros__parameters": {"max_range": far}} for space, far in farthest.items()}
    (tmp_path / "robots.yaml").write_text(yaml.safe_dump(given, sort_keys=False))
    values, _ = declared("registrar_node", "--params-file", str(tmp_path / "robots.yaml"), namespace="robot1")
    assert values.max_range == 7.0


def test_the_file_for_the_g2_holds_every_parameter_of_every_node():
    nodes = yaml.safe_load((ROOT / "config/g2.yaml").read_text())
    for name, model in MODELS.items():
        assert set(nodes[f"/**/{name}"]["ros__parameters"]) == set(model.model_fields)
