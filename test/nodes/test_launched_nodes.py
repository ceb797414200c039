# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What the launch files start, told by running them with stand-ins for `launch`, which the package index does not hold.

The stand-ins know as much of it as the launch files use; `test_launching.py` starts the nodes where it is installed.
"""

from __future__ import annotations

import functools
import runpy
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

import ament_index_python.packages as ament_index
import setuptools

from g2_recon import config
from g2_recon.nodes.localizer_node import LocalizerNode
from g2_recon.nodes.map_merger_node import MapMergerNode
from g2_recon.nodes.parameters import G2
from g2_recon.nodes.reconstruct_node import ReconstructNode
from g2_recon.nodes.registrar_node import RegistrarNode
from g2_recon.nodes.sweep_node import SweepNode

ROOT = Path(__file__).parents[2]
NODES = (LocalizerNode, RegistrarNode, SweepNode, ReconstructNode, MapMergerNode)
# Names of launch and launch_ros, by module.
OFFERED = {
    "launch": "LaunchContext LaunchDescription Substitution",
    "launch.actions": "DeclareLaunchArgument GroupAction IncludeLaunchDescription OpaqueFunction",
    "launch.conditions": "IfCondition",
    "launch.launch_description_sources": "PythonLaunchDescriptionSource",
    "launch.substitutions": "EqualsSubstitution LaunchConfiguration",
    "launch_ros": "",
    "launch_ros.actions": "Node SetRemap",
    "launch_ros.parameter_descriptions": "ParameterFile ParameterValue",
}
# What every node of ROS has.
OF_ROS = {"use_sim_time"}
EVERY_WAY = [
    ("robot", {}),
    ("robot", {"lasers": "sweeps", "namespace": "robot1", "frame_prefix": "robot1/", "mesh": "false"}),
    ("replay", {"namespace": "robot1", "rate": "2.0"}),
    ("replay", {"lasers": "sweeps", "rviz": "true"}),
    ("robots", {}),
    ("robots", {"tf": "own", "lasers": "sweeps", "here": "robot2", "world": "site"}),
    ("robots", {"here": "none"}),
]


# Reading a parameter file takes a while, and its text says all.
load = functools.cache(yaml.safe_load)


class StandIn:
    """Whatever a launch file makes: what it was made of."""

    def __init__(self, *given, **named):
        self.given, self.named = given, named

    def perform(self, values):
        """The value of a LaunchConfiguration."""
        return values[self.given[0]]


@dataclass(frozen=True)
class Started:
    """A node that is started: its parameter files, its parameters by name, and what is remapped for it."""

    package: str
    executable: str
    namespace: str
    files: tuple[str, ...]
    parameters: dict[str, object]
    remapped: tuple[tuple[str, str], ...]


def value_of(thing, values):
    """What a substitution or a parameter stands for."""
    if not isinstance(thing, StandIn):
        return thing
    kind = type(thing).__name__
    if kind == "LaunchConfiguration":
        return thing.perform(values)
    if kind == "EqualsSubstitution":
        one, other = (value_of(part, values) for part in thing.given)
        return str(one == other).lower()
    assert kind in ("ParameterValue", "IfCondition", "PythonLaunchDescriptionSource"), kind
    value = value_of(thing.given[0], values)
    wanted = thing.named.get("value_type", str)
    return {"true": True, "false": False}[value] if wanted is bool else wanted(value)


def run_file(file, given):
    """The nodes that a launch file starts with arguments; those that it does not declare are an error."""
    description = runpy.run_path(str(file))["generate_launch_description"]()
    declared = {a.given[0] for a in description.given[0] if type(a).__name__ == "DeclareLaunchArgument"}
    assert set(given) <= declared
    return list(nodes_of(description.given[0], dict(given), ()))


def nodes_of(actions, values, remapped):
    for action in actions:
        kind = type(action).__name__
        if kind == "DeclareLaunchArgument":
            value = values.setdefault(action.given[0], action.named["default_value"])
            assert value in action.named.get("choices", [value])
        elif kind == "OpaqueFunction":
            yield from nodes_of(action.named["function"](values), values, remapped)
        elif kind == "GroupAction":
            yield from nodes_of(action.given[0], dict(values), remapped)
        elif kind == "SetRemap":
            remapped = (*remapped, action.given)
        elif kind == "IncludeLaunchDescription":
            given = {name: value_of(value, values) for name, value in action.named["launch_arguments"]}
            for node in run_file(value_of(action.given[0], values), given):
                yield Started(**{**vars(node), "remapped": remapped})
        else:
            assert kind == "Node"
            condition = action.named.get("condition")
            if condition is None or value_of(condition, values) == "true":
                yield node_of(action.named, values, remapped)


def node_of(named, values, remapped):
    assert set(named) <= {"package", "executable", "namespace", "parameters", "arguments", "condition", "output"}
    files = [value_of(p.given[0], values) for p in named["parameters"] if isinstance(p, StandIn)]
    parameters = {}
    for given in named["parameters"]:
        if isinstance(given, dict):
            parameters |= {name: value_of(value, values) for name, value in given.items()}
    namespace = value_of(named.get("namespace", ""), values)
    return Started(named["package"], named["executable"], namespace, tuple(files), parameters, remapped)


@pytest.fixture
def launched(monkeypatch):
    """`launched(name, arguments)`: the nodes that a launch file starts."""
    for module, names in OFFERED.items():
        made = ModuleType(module)
        for name in names.split():
            setattr(made, name, type(name, (StandIn,), {}))
        monkeypatch.setitem(sys.modules, module, made)
    monkeypatch.setattr(yaml, "safe_load", load)
    monkeypatch.setattr(ament_index, "get_package_share_directory", {"g2_recon": str(ROOT)}.__getitem__)
    return lambda name, arguments: run_file(ROOT / f"launch/{name}.launch.py", arguments)


@pytest.fixture(scope="module")
def package():
    """What setup.py tells setuptools."""
    told = SimpleNamespace()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(setuptools, "setup", lambda **given: vars(told).update(given))
        patch.chdir(ROOT)
        runpy.run_path(str(ROOT / "setup.py"))
    return told


@pytest.fixture(scope="module")
def checked():
    """`checked(file)`: the sections of a parameter file, whose parameters the nodes have and take."""

    @functools.cache
    def sections_of(file):
        sections = load(file.read_text())
        for section, content in sections.items():
            config.make(type(G2[section.removeprefix("/**/")]), content["ros__parameters"])
        return sections

    return sections_of


@pytest.fixture(scope="module")
def topics(module_ros):
    """The topics that nodes have, by executable."""
    found = {}
    for kind in NODES:
        node = module_ros.add(kind)
        ends = [*node.publishers, *node.subscriptions]
        found[node.get_name()] = {end.topic_name.lstrip("/") for end in ends}
    return found


def test_entry_points_of_the_package_are_functions(package):
    scripts = dict(text.split(" = ") for text in package.entry_points["console_scripts"])
    for target in scripts.values():
        module, function = target.split(":")
        assert callable(getattr(import_module(module), function))


@pytest.mark.parametrize(("name", "arguments"), EVERY_WAY)
def test_what_is_started_is_an_entry_point(launched, package, name, arguments):
    scripts = {text.split(" = ")[0] for text in package.entry_points["console_scripts"]}
    started = launched(name, arguments)
    assert {node.executable for node in started if node.package == "g2_recon"} <= scripts
    assert {(node.package, node.executable) for node in started if node.package != "g2_recon"} <= {("rviz2", "rviz2")}


@pytest.mark.parametrize(("name", "arguments"), EVERY_WAY)
def test_what_is_given_are_parameters_with_values_that_the_node_takes(launched, name, arguments):
    for node in launched(name, arguments):
        given = {key: value for key, value in node.parameters.items() if key not in OF_ROS}
        if node.package == "g2_recon":
            config.make(type(G2[node.executable]), given)
        else:
            assert not given
        assert isinstance(node.parameters.get("use_sim_time", False), bool)


@pytest.mark.parametrize(("name", "arguments"), EVERY_WAY)
def test_parameter_files_are_there_and_have_what_nodes_have(launched, package, checked, name, arguments):
    installed = {file for _, files in package.data_files for file in files}
    for node in launched(name, arguments):
        if node.package != "g2_recon":
            continue
        (file,) = map(Path, node.files)
        assert file.relative_to(ROOT).as_posix() in installed
        assert f"/**/{node.executable}" in checked(file)


def test_launch_files_and_all_that_they_name_are_installed(package):
    installed = {(place, file) for place, files in package.data_files for file in files}
    for file in [*ROOT.glob("launch/*.launch.py"), *ROOT.glob("config/*"), *ROOT.glob("rviz/*")]:
        name = file.relative_to(ROOT)
        assert (f"share/g2_recon/{name.parent}", str(name)) in installed


def test_one_robot_alone(launched):
    names = [(node.executable, node.namespace) for node in launched("robot", {})]
    assert names == [("localizer_node", ""), ("registrar_node", ""), ("reconstruct_node", "")]


def test_robots_are_in_their_namespaces_and_share_a_merger_and_a_mesh(launched):
    nodes = launched("robots", {"lasers": "sweeps", "world": "site"})
    places = [(node.executable, node.namespace, node.parameters.get("frame_prefix")) for node in nodes]
    each = [("sweep_node", name, f"{name}/") for name in ("robot1", "robot2", "robot3")]
    assert places == [*each, ("map_merger_node", "", None), ("reconstruct_node", "", None)]
    assert nodes[-2].parameters["world_frame"] == nodes[-1].parameters["map_frame"] == "site"


def test_with_trees_of_their_own_all_nodes_of_robots_have_tf_in_their_namespace(launched):
    nodes = launched("robots", {"tf": "own", "here": "robot2"})
    remapped = {(node.executable, node.namespace): dict(node.remapped) for node in nodes}
    own = {"/tf": "tf", "/tf_static": "tf_static"}
    assert remapped == {
        ("localizer_node", "robot2"): own,
        ("registrar_node", "robot2"): own,
        ("map_merger_node", ""): {},
        ("reconstruct_node", ""): {},
    }


def test_what_nodes_of_a_robot_tell_each_other_has_the_same_name_at_both_ends(topics):
    for topic, sender, receivers in [
        ("pose", "localizer_node", ["registrar_node"]),
        ("trajectory", "localizer_node", ["registrar_node"]),
        ("cloud", "registrar_node", ["reconstruct_node"]),
        ("cloud", "sweep_node", ["reconstruct_node"]),
        ("cloud", "map_merger_node", ["reconstruct_node"]),
    ]:
        assert all(topic in topics[node] for node in (sender, *receivers))


def test_a_robot_that_the_file_does_not_name_is_refused(launched):
    with pytest.raises(RuntimeError, match="robot9: the robots of the parameter file are robot1, robot2, robot3"):
        launched("robots", {"here": "robot1,robot9"})
