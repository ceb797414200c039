# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The nodes of one robot, on the topics of its namespace."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription, Substitution
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue

PACKAGE = "g2_recon"


def generate_launch_description() -> LaunchDescription:
    share = Path(get_package_share_directory(PACKAGE))
    arguments = [
        DeclareLaunchArgument(
            "namespace", default_value="", description="namespace of all nodes and topics, such as the robot's name"
        ),
        DeclareLaunchArgument(
            "config",
            default_value=str(share / "config" / "g2.yaml"),
            description="parameter file of all nodes; its laser poses must be those of the robot",
        ),
        DeclareLaunchArgument(
            "lasers",
            default_value="vertical",
            choices=["vertical", "sweeps"],
            description="vertical: a horizontal and a vertical laser; sweeps: one that tilts while the robot stands",
        ),
        DeclareLaunchArgument(
            "frame_prefix",
            default_value="",
            description="goes before the names of all frames, as robot1/ where several robots share one tree of TF",
        ),
        DeclareLaunchArgument(
            "mesh",
            default_value="true",
            description="false: without reconstruct_node, where another one makes the mesh of all robots",
        ),
        DeclareLaunchArgument(
            "use_sim_time", default_value="false", description="true: the time is that of `/clock`, as of a simulation"
        ),
    ]
    config = ParameterFile(LaunchConfiguration("config"))
    given = {
        "use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool),
        "frame_prefix": ParameterValue(LaunchConfiguration("frame_prefix"), value_type=str),
    }

    def stage(executable: str, lasers: str = "", *, wanted: Substitution | None = None) -> Node:
        """A node that every robot has, or only one with such lasers, or one for which something is wanted."""
        if lasers:
            wanted = EqualsSubstitution(LaunchConfiguration("lasers"), lasers)
        return Node(
            package=PACKAGE,
            executable=executable,
            namespace=LaunchConfiguration("namespace"),
            parameters=[config, given],
            condition=None if wanted is None else IfCondition(wanted),
            output="screen",
        )

    return LaunchDescription(
        [
            *arguments,
            stage("localizer_node", "vertical"),
            stage("registrar_node", "vertical"),
            stage("sweep_node", "sweeps"),
            stage("reconstruct_node", wanted=LaunchConfiguration("mesh")),
        ]
    )
