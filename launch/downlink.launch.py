# SPDX-License-Identifier: Apache-2.0
"""Launch the nodes, all or some: `ros2 launch obbhbb_ros downlink.launch.py --show-args`."""

import os
from typing import Any

from launch import LaunchDescription
from obbhbb_ros.launching import ArgumentValue
from obbhbb_ros.launching import NodeStart
from obbhbb_ros.launching import argument
from obbhbb_ros.launching import common_arguments
from obbhbb_ros.launching import is_true
from obbhbb_ros.launching import node
from obbhbb_ros.launching import nodes
from obbhbb_ros.launching import parameters_in
from obbhbb_ros.launching import params_file
from obbhbb_ros.launching import payload
from obbhbb_ros.launching import state_file
from obbhbb_ros.launching import topics_of

HOME = os.environ.get('ROS_HOME') or os.path.expanduser('~/.ros')
# Instead of a folder: use the one in the parameter files.
NONE = 'none'
FOLDERS = {
    'spool': 'in which chips wait for contact',
    'outbox': 'from which the bus takes chips',
}
# The arguments that set a parameter of a node.
PATHS = {
    'ship_tracker': {'spool': 'spool.path'},
    'chip_extractor': {'spool': 'spool.path'},
    'downlink': {'spool': 'spool.path', 'outbox': 'outbox.path'},
}
# What `ship_tracker` publishes, whatever it reads.
TRACKED = {'input_type': 'Detection2DArray'}
CHAIN = ('obb_to_hbb', 'chip_extractor', 'downlink')
NODES = (*CHAIN, 'overlay', 'ship_tracker')
TOPICS = (
    'detections',
    'polygons',
    'camera_info',
    'image',
    'contact',
    'boxes',
    'crop_regions',
    'crop_sources',
    'tracked_detections',
    'camera_pose',
    'fix',
    'attitude',
    'positions',
    'image_pose',
)


def generate_launch_description() -> LaunchDescription:
    """Describe the nodes, all in one namespace, with a parameter file for each of them."""
    return LaunchDescription(
        [
            argument(
                'params_file',
                '',
                'YAML file with parameters of any nodes; wins over the file of a single node '
                '(empty: none)',
            ),
            *(params_file(f'{name}_params_file', name) for name in NODES),
            argument('nodes', ' '.join(CHAIN), f'which nodes to start, of {", ".join(NODES)}'),
            argument('one_process', 'false', 'run all of them in one process'),
            *(
                argument(
                    folder,
                    '',
                    f'folder {purpose}; by default the one in the parameter files, or '
                    f'{HOME}/obbhbb/<namespace>/{folder} if they name none (none: as in the files)',
                )
                for folder, purpose in FOLDERS.items()
            ),
            *common_arguments(TOPICS),
            nodes(_nodes),
        ]
    )


def _nodes(value: ArgumentValue) -> list[Any]:
    """Describe the chosen nodes."""
    chosen = _chosen(value)
    if unknown := sorted({*chosen} - {*NODES}):
        raise ValueError(f'nodes: {", ".join(unknown)} is none of {", ".join(NODES)}')
    starts = [_start(value, name) for name in chosen]
    if is_true(value('one_process')):
        return [payload(value, starts)]
    return [node(value, start) for start in starts]


def _chosen(value: ArgumentValue) -> list[str]:
    """List the chosen nodes."""
    return value('nodes').replace(',', ' ').split()


def _start(value: ArgumentValue, name: str) -> NodeStart:
    """Describe how a node is started."""
    parameters = [*_files(value, name), *_paths(value, name), *state_file(value, name)]
    topics = topics_of(value, TOPICS)
    if name == 'obb_to_hbb' and 'ship_tracker' in _chosen(value):
        topics['detections'] = topics['tracked_detections']
        parameters.append(TRACKED)
    return NodeStart(name, name, parameters, topics)


def _files(value: ArgumentValue, name: str) -> list[str]:
    """List the parameter files of a node; a later one wins."""
    shared = value('params_file') if name in _readers(value) else ''
    return list(filter(None, (value(f'{name}_params_file'), shared)))


def _readers(value: ArgumentValue) -> list[str]:
    """List the nodes for which the common file is: all if it suits none, so that they say so."""
    file, namespace, chosen = value('params_file'), value('namespace'), _chosen(value)
    return [name for name in chosen if parameters_in(file, namespace, name)] or chosen


def _paths(value: ArgumentValue, name: str) -> list[dict[str, str]]:
    """Return the folders of a node; a folder in its parameter files wins over the default."""
    in_files: dict[str, Any] = {}
    for file in _files(value, name):
        in_files.update(parameters_in(file, value('namespace'), name))
    return [
        {parameter: value(folder) or _default(value('namespace'), folder)}
        for folder, parameter in PATHS.get(name, {}).items()
        if value(folder) != NONE and (value(folder) or not in_files.get(parameter))
    ]


def _default(namespace: str, folder: str) -> str:
    """Return the default folder, a different one in each namespace."""
    return '/'.join(filter(None, (HOME, 'obbhbb', namespace.strip('/'), folder)))
