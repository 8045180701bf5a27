# SPDX-License-Identifier: Apache-2.0
"""Launch the conversion node: `ros2 launch obbhbb_ros obb_to_hbb.launch.py --show-args`."""

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.actions import SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

TOPICS = ('detections', 'polygons', 'camera_info', 'boxes', 'crop_regions')


def generate_launch_description() -> LaunchDescription:
    """Describe the node, with its parameter file, namespace, remaps and log level as arguments."""
    share = get_package_share_directory('obbhbb_ros')
    arguments = [
        DeclareLaunchArgument(
            'params_file', default_value=f'{share}/config/obb_to_hbb.yaml',
            description='YAML file with parameters of the node',
        ),
        DeclareLaunchArgument(
            'name', default_value='obb_to_hbb', description='name of the node',
        ),
        DeclareLaunchArgument(
            'namespace', default_value='', description='namespace of the node and its topics',
        ),
        DeclareLaunchArgument('log_level', default_value='info', description='log level'),
    ]
    arguments += [
        DeclareLaunchArgument(
            topic, default_value=topic, description=f'topic to use for `{topic}`',
        )
        for topic in TOPICS
    ]
    arguments.append(
        DeclareLaunchArgument(
            'large_messages', default_value='false',
            description='use the DDS profile for messages over 0.5 MB',
        )
    )
    profile = SetEnvironmentVariable(
        'FASTRTPS_DEFAULT_PROFILES_FILE', f'{share}/config/fastdds_large.xml',
        condition=IfCondition(LaunchConfiguration('large_messages')),
    )
    node = Node(
        package='obbhbb_ros',
        executable='obb_to_hbb',
        name=LaunchConfiguration('name'),
        namespace=LaunchConfiguration('namespace'),
        parameters=[LaunchConfiguration('params_file')],
        remappings=[(topic, LaunchConfiguration(topic)) for topic in TOPICS],
        ros_arguments=['--log-level', LaunchConfiguration('log_level')],
        output='screen',
    )
    return LaunchDescription([*arguments, profile, node])
