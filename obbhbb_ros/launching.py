# SPDX-License-Identifier: Apache-2.0
"""The common part of the launch files: arguments, and nodes that are restarted when they exit."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Mapping
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from typing import NamedTuple
from typing import TypeAlias

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.actions import OpaqueFunction
from launch.actions import SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from obbhbb_ros.settings.parameter_file import read_values
from obbhbb_ros.settings.parameter_file import yaml_value

PACKAGE = 'obbhbb_ros'

_PROFILE = 'FASTRTPS_DEFAULT_PROFILES_FILE'

ArgumentValue: TypeAlias = Callable[[str], str]
"""Returns the value of a launch argument by its name."""


def argument(name: str, default: str, meaning: str) -> Any:
    """Declare an argument."""
    return DeclareLaunchArgument(name, default_value=default, description=meaning)


def params_file(name: str, node: str) -> Any:
    """Declare the argument for the parameter file of a node."""
    share = get_package_share_directory(PACKAGE)
    return argument(name, f'{share}/config/{node}.yaml', f'YAML file with parameters of {node}')


def common_arguments(topics: Sequence[str]) -> list[Any]:
    """Declare the arguments of every launch file; choose the DDS profile, unless one is set."""
    share = get_package_share_directory(PACKAGE)
    return [
        *(argument(topic, topic, f'topic to use for `{topic}`') for topic in topics),
        argument('namespace', '', 'namespace of nodes and topics'),
        argument('log_level', 'info', 'log level'),
        argument('respawn', 'true', 'restart a node whenever it exits'),
        argument('respawn_delay', '1.0', 'seconds to wait before a restart'),
        argument(
            'state',
            '',
            'folder for the state files of the nodes, see the parameter state.path; by default as '
            'in the parameter files',
        ),
        argument('large_messages', 'false', 'use the DDS profile for sending messages over 0.5 MB'),
        SetEnvironmentVariable(_PROFILE, os.environ.get(_PROFILE, f'{share}/config/fastdds.xml')),
        SetEnvironmentVariable(
            _PROFILE,
            f'{share}/config/fastdds_nodes.xml',
            condition=IfCondition(LaunchConfiguration('large_messages')),
        ),
    ]


def parameters_in(file: str, namespace: str, node: str) -> Mapping[str, Any]:
    """Read the parameters of a node; none if the file is unusable, which the node will report."""
    try:
        return read_values(Path(file), f'{namespace.strip("/")}/{node}')
    except (OSError, ValueError):
        return {}


def state_file(value: ArgumentValue, name: str) -> list[dict[str, str]]:
    """Return the parameter for the state file of a node, if the argument names a folder."""
    folder = '/'.join(filter(None, (value('state'), value('namespace').strip('/'))))
    return [{'state.path': f'{folder}/{name}.json'}] if value('state') else []


def nodes(describe: Callable[[ArgumentValue], Iterable[Any]]) -> Any:
    """
    Start nodes when the arguments have their values.

    Parameters
    ----------
    describe : callable
        Lists the nodes, with a function that returns the value of an argument by its name.
    """

    def at_launch(context: Any) -> list[Any]:
        return list(describe(lambda name: LaunchConfiguration(name).perform(context)))

    return OpaqueFunction(function=at_launch)


class NodeStart(NamedTuple):
    """
    How a node is started.

    Attributes
    ----------
    executable, name : str
        Executable and name of the node.
    parameters : sequence of str or dict
        Parameter files and parameters; a later one wins.
    topics : mapping of str to str
        The topic to use instead of each.
    """

    executable: str
    name: str
    parameters: Sequence[str | Mapping[str, str]]
    topics: Mapping[str, str]


def topics_of(value: ArgumentValue, topics: Sequence[str]) -> dict[str, str]:
    """Return the topics that arguments of their names give."""
    return {topic: value(topic) for topic in topics}


def node(value: ArgumentValue, start: NodeStart) -> Any:
    """
    Describe a node that follows the common arguments.

    Parameters
    ----------
    value : callable
        Returns the value of an argument by its name.
    start : NodeStart
        The node.

    Raises
    ------
    FileNotFoundError
        If a parameter file does not exist; the node would start with its defaults.
    """
    _require_files(start)
    return Node(
        executable=start.executable,
        name=start.name,
        parameters=list(start.parameters),
        remappings=list(start.topics.items()),
        **_common(value),
    )


def payload(value: ArgumentValue, starts: Sequence[NodeStart]) -> Any:
    """
    Describe one process of several nodes that follows the common arguments.

    The parameter files are for single nodes, with sections for any name. So what they say is
    written to one file with a section for each node.

    Raises
    ------
    OSError, ValueError
        If a parameter file does not exist, or cannot be read.
    """
    descriptor, path = tempfile.mkstemp('.yaml', 'payload_')
    with os.fdopen(descriptor, 'w', encoding='utf-8') as file:
        for start in starts:
            _require_files(start)
            file.write(_section(f'/{value("namespace").strip("/")}/{start.name}', start))
    return Node(
        executable='payload',
        arguments=['--nodes', *(start.executable for start in starts)],
        parameters=[path],
        remappings=[
            (f'{start.name}:{topic}', other)
            for start in starts
            for topic, other in start.topics.items()
        ],
        **_common(value),
    )


def _common(value: ArgumentValue) -> dict[str, Any]:
    """Return what the common arguments say of a process."""
    return {
        'package': PACKAGE,
        'namespace': value('namespace'),
        'ros_arguments': ['--log-level', value('log_level')],
        'respawn': is_true(value('respawn')),
        'respawn_delay': float(value('respawn_delay')),
        'output': 'screen',
    }


def is_true(text: str) -> bool:
    """Read the value of an argument that is true or false."""
    return text.lower() in ('true', '1', 'yes', 'on')


def _require_files(start: NodeStart) -> None:
    """Raise FileNotFoundError if a parameter file does not exist."""
    for file in start.parameters:
        if isinstance(file, str) and not Path(file).is_file():
            raise FileNotFoundError(f'{file}: no such parameter file')


def _section(full_name: str, start: NodeStart) -> str:
    """Write the parameters of a node, if any, as a section of a parameter file."""
    values: dict[str, Any] = {}
    for item in start.parameters:
        values.update(read_values(Path(item), full_name) if isinstance(item, str) else item)
    if not values:
        # ROS refuses an empty section.
        return ''
    lines = (f'    {yaml_value(name)}: {yaml_value(item)}' for name, item in values.items())
    return '\n'.join((f'{re.sub("/+", "/", full_name)}:', '  ros__parameters:', *lines, ''))
