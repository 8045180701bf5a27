# SPDX-License-Identifier: Apache-2.0
"""Launch the nodes, all or some: `ros2 launch obbhbb_ros downlink.launch.py --show-args`."""

import os
from collections.abc import Callable
from typing import Any

from launch import LaunchDescription
from obbhbb_ros.launching import argument
from obbhbb_ros.launching import common_arguments
from obbhbb_ros.launching import node
from obbhbb_ros.launching import nodes
from obbhbb_ros.launching import params_file
from obbhbb_ros.launching import state_file

HOME = os.environ.get('ROS_HOME') or os.path.expanduser('~/.ros')
CHAIN = ('obb_to_hbb', 'chip_extractor', 'downlink')
NODES = (*CHAIN, 'overlay')
TOPICS = (
    'detections', 'polygons', 'camera_info', 'image', 'contact',
    'boxes', 'crop_regions', 'crop_sources',
)


def generate_launch_description() -> LaunchDescription:
    """Describe the nodes, each with a parameter file of its own, in one namespace."""
    return LaunchDescription([
        *(params_file(f'{name}_params_file', name) for name in NODES),
        argument('nodes', ' '.join(CHAIN), f'which nodes to start, of {", ".join(NODES)}'),
        argument(
            'spool', f'{HOME}/obbhbb/spool',
            'folder in which chips wait for contact (empty: as the parameter files say)',
        ),
        argument(
            'outbox', f'{HOME}/obbhbb/outbox',
            'folder from which the bus takes chips (empty: as the parameter file says)',
        ),
        *(argument(topic, topic, f'topic to use for `{topic}`') for topic in TOPICS),
        *common_arguments(),
        nodes(_nodes),
    ])


def _nodes(value: Callable[[str], str]) -> list[Any]:
    """Describe the nodes that were chosen."""
    chosen = value('nodes').replace(',', ' ').split()
    if unknown := sorted({*chosen} - {*NODES}):
        raise ValueError(f'nodes: {", ".join(unknown)} is none of {", ".join(NODES)}')
    folders = {
        'chip_extractor': {'spool.path': value('spool')},
        'downlink': {'spool.path': value('spool'), 'outbox.path': value('outbox')},
    }
    return [
        node(
            value, name, name,
            [
                value(f'{name}_params_file'),
                *({key: folder} for key, folder in folders.get(name, {}).items() if folder),
                *state_file(value, name),
            ],
            TOPICS,
        )
        for name in chosen
    ]
