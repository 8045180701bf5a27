# SPDX-License-Identifier: Apache-2.0
"""Launch conversion and chips: `ros2 launch obbhbb_ros downlink.launch.py --show-args`."""

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.actions import SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

NODES = ('obb_to_hbb', 'chip_extractor')


def generate_launch_description() -> LaunchDescription:
    """Describe the two nodes, each with a parameter file of its own, in one namespace."""
    share = get_package_share_directory('obbhbb_ros')
    arguments = [
        DeclareLaunchArgument(
            f'{name}_params_file', default_value=f'{share}/config/{name}.yaml',
            description=f'YAML file with parameters of {name}',
        )
        for name in NODES
    ]
    arguments += [
        DeclareLaunchArgument(
            'namespace', default_value='', description='namespace of the nodes and their topics',
        ),
        DeclareLaunchArgument('image', default_value='image', description='topic of the images'),
        DeclareLaunchArgument(
            'large_messages', default_value='false',
            description='use the DDS profile for messages over 0.5 MB',
        ),
    ]
    profile = SetEnvironmentVariable(
        'FASTRTPS_DEFAULT_PROFILES_FILE', f'{share}/config/fastdds_large.xml',
        condition=IfCondition(LaunchConfiguration('large_messages')),
    )
    nodes = [
        Node(
            package='obbhbb_ros',
            executable=name,
            name=name,
            namespace=LaunchConfiguration('namespace'),
            parameters=[LaunchConfiguration(f'{name}_params_file')],
            remappings=[('image', LaunchConfiguration('image'))],
            output='screen',
        )
        for name in NODES
    ]
    return LaunchDescription([*arguments, profile, *nodes])
