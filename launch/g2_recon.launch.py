# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Localizer, registrar and reconstruction of one robot; with a bag, its replay on simulated time."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, NotEqualsSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue

PACKAGE = "g2_recon"


def generate_launch_description() -> LaunchDescription:
    share = Path(get_package_share_directory(PACKAGE))
    arguments = [
        DeclareLaunchArgument(
            "bag", default_value="", description="recording to replay; empty: work on the topics of a running robot"
        ),
        DeclareLaunchArgument(
            "rate", default_value="1.0", description="speed of the replay, 0.01 to 100; 1: as it was recorded"
        ),
        DeclareLaunchArgument(
            "config",
            default_value=str(share / "config" / "g2.yaml"),
            description="parameter file of all nodes; its laser poses must be those of the robot",
        ),
        DeclareLaunchArgument(
            "namespace", default_value="", description="namespace of all nodes and topics, such as the robot's name"
        ),
        DeclareLaunchArgument("rviz", default_value="false", description="true: show all in RViz"),
    ]
    bag, namespace = LaunchConfiguration("bag"), LaunchConfiguration("namespace")
    replays = NotEqualsSubstitution(bag, "")
    config = ParameterFile(LaunchConfiguration("config"))
    on_time_of_bag = {"use_sim_time": ParameterValue(replays, value_type=bool)}
    stages = [
        Node(
            package=PACKAGE,
            executable=executable,
            namespace=namespace,
            parameters=[config, on_time_of_bag],
            output="screen",
        )
        for executable in ("localizer_node", "registrar_node", "reconstruct_node")
    ]
    replay = Node(
        package=PACKAGE,
        executable="replay_node",
        namespace=namespace,
        parameters=[
            config,
            {
                "bag": ParameterValue(bag, value_type=str),
                "rate": ParameterValue(LaunchConfiguration("rate"), value_type=float),
            },
        ],
        condition=IfCondition(replays),
        output="screen",
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        namespace=namespace,
        arguments=["-d", str(share / "rviz" / "g2_recon.rviz")],
        parameters=[on_time_of_bag],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription([*arguments, *stages, replay, rviz])
