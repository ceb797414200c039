# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A recording, the nodes that work on it, and RViz where it is wanted."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue

PACKAGE = "g2_recon"


def generate_launch_description() -> LaunchDescription:
    share = Path(get_package_share_directory(PACKAGE))
    arguments = [
        DeclareLaunchArgument(
            "bag",
            default_value=str(share / "bags" / "first_floor"),
            description="recording to replay: the folder of a rosbag2 or a bag file",
        ),
        DeclareLaunchArgument(
            "rate", default_value="1.0", description="speed of the replay, 0.01 to 100; 1: as it was recorded"
        ),
        DeclareLaunchArgument("rviz", default_value="false", description="true: show all in RViz"),
        DeclareLaunchArgument(
            "namespace", default_value="", description="namespace of all nodes and topics, such as the robot's name"
        ),
        DeclareLaunchArgument(
            "config",
            default_value=str(share / "config" / "g2.yaml"),
            description="parameter file of all nodes; its laser poses must be those of the recording",
        ),
        DeclareLaunchArgument(
            "lasers",
            default_value="vertical",
            choices=["vertical", "sweeps"],
            description="vertical: a horizontal and a vertical laser; sweeps: one that tilts while the robot stands",
        ),
    ]
    namespace = LaunchConfiguration("namespace")
    robot = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(share / "launch" / "robot.launch.py")),
        launch_arguments={
            "namespace": namespace,
            "config": LaunchConfiguration("config"),
            "lasers": LaunchConfiguration("lasers"),
            "frame_prefix": "",
            "mesh": "true",
            "use_sim_time": "true",
        }.items(),
    )
    replay = Node(
        package=PACKAGE,
        executable="replay_node",
        namespace=namespace,
        parameters=[
            ParameterFile(LaunchConfiguration("config")),
            {
                "bag": ParameterValue(LaunchConfiguration("bag"), value_type=str),
                "rate": ParameterValue(LaunchConfiguration("rate"), value_type=float),
            },
        ],
        output="screen",
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        namespace=namespace,
        arguments=["-d", str(share / "rviz" / "g2_recon.rviz")],
        parameters=[{"use_sim_time": True}],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription([*arguments, robot, replay, rviz])
