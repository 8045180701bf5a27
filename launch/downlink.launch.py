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
from obbhbb_ros.launching import parameters_in
from obbhbb_ros.launching import params_file
from obbhbb_ros.launching import state_file
from obbhbb_ros.launching import unread

HOME = os.environ.get('ROS_HOME') or os.path.expanduser('~/.ros')
# In place of a folder: none but that of the parameter files.
NONE = 'none'
# Arguments that set a parameter, by node.
PATHS = {
    'chip_extractor': {'spool': 'spool.path'},
    'downlink': {'spool': 'spool.path', 'outbox': 'outbox.path'},
}
CHAIN = ('obb_to_hbb', 'chip_extractor', 'downlink')
NODES = (*CHAIN, 'overlay')
TOPICS = (
    'detections',
    'polygons',
    'camera_info',
    'image',
    'contact',
    'boxes',
    'crop_regions',
    'crop_sources',
)


def generate_launch_description() -> LaunchDescription:
    """Describe the nodes, each with a parameter file of its own, in one namespace."""
    return LaunchDescription(
        [
            argument(
                'params_file',
                '',
                'YAML file with parameters of any of the nodes; wins over those of one node '
                '(empty: none)',
            ),
            *(params_file(f'{name}_params_file', name) for name in NODES),
            argument('nodes', ' '.join(CHAIN), f'which nodes to start, of {", ".join(NODES)}'),
            argument(
                'spool',
                '',
                'folder in which chips wait for contact; by default that of the parameter files, '
                f'or {HOME}/obbhbb/<namespace>/spool if they name none (none: as they say)',
            ),
            argument(
                'outbox',
                '',
                'folder from which the bus takes chips; by default that of the parameter files, or '
                f'{HOME}/obbhbb/<namespace>/outbox if they name none (none: as they say)',
            ),
            *(argument(topic, topic, f'topic to use for `{topic}`') for topic in TOPICS),
            *common_arguments(),
            nodes(_nodes),
        ]
    )


def _nodes(value: Callable[[str], str]) -> list[Any]:
    """Describe the nodes that were chosen."""
    chosen = value('nodes').replace(',', ' ').split()
    if unknown := sorted({*chosen} - {*NODES}):
        raise ValueError(f'nodes: {", ".join(unknown)} is none of {", ".join(NODES)}')
    files = {name: _files(value, name) for name in chosen}
    return [*unread(value('namespace'), files), *(_node(value, name) for name in chosen)]


def _node(value: Callable[[str], str], name: str) -> Any:
    """Describe a node."""
    parameters = [*_files(value, name), *_paths(value, name), *state_file(value, name)]
    return node(value, name, name, parameters, TOPICS)


def _files(value: Callable[[str], str], name: str) -> list[str]:
    """List the parameter files of a node; a later one wins."""
    return list(filter(None, (value(f'{name}_params_file'), value('params_file'))))


def _paths(value: Callable[[str], str], name: str) -> list[dict[str, str]]:
    """Give the folders of a node; a default gives way to what its parameter files say."""
    said: dict[str, Any] = {}
    for file in _files(value, name):
        said.update(parameters_in(file, value('namespace'), name))
    return [
        {parameter: value(folder) or _default(value('namespace'), folder)}
        for folder, parameter in PATHS.get(name, {}).items()
        if value(folder) != NONE and (value(folder) or not said.get(parameter))
    ]


def _default(namespace: str, folder: str) -> str:
    """Name a folder that no other namespace has."""
    return '/'.join(filter(None, (HOME, 'obbhbb', namespace.strip('/'), folder)))
