"""Start one node of this package with a parameter file; attitude, navigation and alignment.launch.py include it."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    return LaunchDescription([
        DeclareLaunchArgument("node", description="executable, for example attitude_node"),
        DeclareLaunchArgument("params_file", description="parameter file"),
        DeclareLaunchArgument("namespace", default_value="", description="put before every topic"),
        DeclareLaunchArgument("use_sim_time", default_value="false", description="take the time from /clock"),
        Node(
            package="attitude_alignment",
            executable=LaunchConfiguration("node"),
            namespace=LaunchConfiguration("namespace"),
            parameters=[
                LaunchConfiguration("params_file"),
                {"use_sim_time": LaunchConfiguration("use_sim_time")},
            ],
            output="screen",
        ),
    ])
