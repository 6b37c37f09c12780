"""Start navigation_node: `ros2 launch attitude_alignment navigation.launch.py params_file:=my.yaml`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    package = FindPackageShare("attitude_alignment")
    default_params = PathJoinSubstitution([package, "config", "navigation.yaml"])
    node = PythonLaunchDescriptionSource([PathJoinSubstitution([package, "launch", "node.launch.py"])])
    return LaunchDescription([
        DeclareLaunchArgument("params_file", default_value=default_params, description="parameter file"),
        IncludeLaunchDescription(node, launch_arguments={"node": "navigation_node"}.items()),
    ])
