"""Start navigation_node: `ros2 launch attitude_alignment navigation.launch.py params_file:=my.yaml`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    package = FindPackageShare("attitude_alignment")
    default_params = PathJoinSubstitution([package, "config", "navigation.yaml"])
    return LaunchDescription([
        DeclareLaunchArgument("params_file", default_value=default_params, description="parameter file"),
        DeclareLaunchArgument("namespace", default_value="", description="put before every topic"),
        DeclareLaunchArgument("use_sim_time", default_value="false", description="take the time from /clock"),
        Node(
            package="attitude_alignment",
            executable="navigation_node",
            namespace=LaunchConfiguration("namespace"),
            parameters=[
                LaunchConfiguration("params_file"),
                {"use_sim_time": LaunchConfiguration("use_sim_time")},
            ],
            output="screen",
        ),
    ])
