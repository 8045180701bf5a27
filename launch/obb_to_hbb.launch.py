# SPDX-License-Identifier: Apache-2.0
"""Launch the conversion node: `ros2 launch obbhbb_ros obb_to_hbb.launch.py --show-args`."""

from launch import LaunchDescription
from obbhbb_ros.launching import NodeStart
from obbhbb_ros.launching import argument
from obbhbb_ros.launching import common_arguments
from obbhbb_ros.launching import node
from obbhbb_ros.launching import nodes
from obbhbb_ros.launching import params_file
from obbhbb_ros.launching import state_file
from obbhbb_ros.launching import topics_of

TOPICS = ('detections', 'polygons', 'camera_info', 'boxes', 'crop_regions', 'crop_sources')


def generate_launch_description() -> LaunchDescription:
    """Describe the node, with its parameter file and topics as arguments."""
    return LaunchDescription(
        [
            params_file('params_file', 'obb_to_hbb'),
            argument('name', 'obb_to_hbb', 'name of the node'),
            *common_arguments(TOPICS),
            nodes(
                lambda value: [
                    node(
                        value,
                        NodeStart(
                            'obb_to_hbb',
                            value('name'),
                            [value('params_file'), *state_file(value, value('name'))],
                            topics_of(value, TOPICS),
                        ),
                    ),
                ]
            ),
        ]
    )
