# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Several robots, each in its namespace, and one map and one mesh of all; on one computer or on several.

One parameter file tells all: the robots are those that `robots` of map_merger_node names.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription, OpaqueFunction
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node, SetRemap
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue

PACKAGE = "g2_recon"


def generate_launch_description() -> LaunchDescription:
    share = Path(get_package_share_directory(PACKAGE))
    arguments = [
        DeclareLaunchArgument(
            "config",
            default_value=str(share / "config" / "robots.yaml"),
            description="parameter file of all nodes of all robots; `robots` of map_merger_node names the robots",
        ),
        DeclareLaunchArgument(
            "here",
            default_value="all",
            description="robots whose nodes run on this computer, as in robot1,robot2; all; or none",
        ),
        DeclareLaunchArgument(
            "merger",
            default_value="true",
            description="true: map_merger_node and the reconstruct_node of all robots run on this computer",
        ),
        DeclareLaunchArgument(
            "world",
            default_value="",
            description="frame of the map of all robots; empty: `world_frame` of map_merger_node in the parameter file",
        ),
        DeclareLaunchArgument(
            "tf",
            default_value="shared",
            choices=["shared", "own"],
            description="shared: one tree of TF, names of frames begin with that of the robot; own: a /tf a robot, "
            "<robot>/tf, with the same names in each",
        ),
        DeclareLaunchArgument(
            "lasers",
            default_value="vertical",
            choices=["vertical", "sweeps"],
            description="vertical: a horizontal and a vertical laser; sweeps: one that tilts while the robot stands",
        ),
        DeclareLaunchArgument(
            "use_sim_time", default_value="false", description="true: the time is that of `/clock`, as of a simulation"
        ),
    ]
    config = ParameterFile(LaunchConfiguration("config"))
    on_time = {"use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)}

    def of_all(executable: str, **parameters: Any) -> Node:
        """A node that there is once for all robots."""
        return Node(
            package=PACKAGE,
            executable=executable,
            parameters=[config, on_time | parameters],
            condition=IfCondition(LaunchConfiguration("merger")),
            output="screen",
        )

    def merger_and_mesh(context: LaunchContext) -> list[Node]:
        named = LaunchConfiguration("world").perform(context)
        world = named or merger_parameters(Path(LaunchConfiguration("config").perform(context))).get("world_frame")
        frame = ParameterValue(world or "world", value_type=str)
        return [of_all("map_merger_node", world_frame=frame), of_all("reconstruct_node", map_frame=frame)]

    def robots_here(context: LaunchContext) -> list[GroupAction]:
        named = robots_of(Path(LaunchConfiguration("config").perform(context)))
        here = LaunchConfiguration("here").perform(context)
        wanted = {"all": named, "none": []}.get(here, here.split(","))
        if unknown := [robot for robot in wanted if robot not in named]:
            raise RuntimeError(f"here: {', '.join(unknown)}: the robots of the parameter file are {', '.join(named)}")
        shared = LaunchConfiguration("tf").perform(context) == "shared"
        return [robot(name, shared=shared) for name in wanted]

    def robot(name: str, *, shared: bool) -> GroupAction:
        nodes = IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(share / "launch" / "robot.launch.py")),
            launch_arguments={
                "namespace": name,
                "config": LaunchConfiguration("config"),
                "lasers": LaunchConfiguration("lasers"),
                "frame_prefix": f"{name}/" if shared else "",
                "mesh": "false",
                "use_sim_time": LaunchConfiguration("use_sim_time"),
            }.items(),
        )
        own = [] if shared else [SetRemap(f"/{topic}", topic) for topic in ("tf", "tf_static")]
        return GroupAction([*own, nodes])

    return LaunchDescription(
        [*arguments, OpaqueFunction(function=robots_here), OpaqueFunction(function=merger_and_mesh)]
    )


def robots_of(file: Path) -> list[str]:
    """The robots that a parameter file names. Raises RuntimeError where it names none."""
    robots = [name for name in merger_parameters(file).get("robots", []) if name]
    if not robots:
        raise RuntimeError(f"{file}: `robots` of map_merger_node names no robot")
    return robots


def merger_parameters(file: Path) -> dict[str, Any]:
    """The parameters of map_merger_node in a parameter file; what comes later in it counts."""
    found: dict[str, Any] = {}
    for node, content in (yaml.safe_load(file.read_text()) or {}).items():
        if node.endswith("map_merger_node"):
            found |= content["ros__parameters"]
    return found
