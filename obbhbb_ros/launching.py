# SPDX-License-Identifier: Apache-2.0
"""What the launch files share: arguments, and nodes that are started again when they end."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.actions import LogInfo
from launch.actions import OpaqueFunction
from launch.actions import SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from obbhbb_ros.settings.parameter_file import read_values

PACKAGE = 'obbhbb_ros'


def argument(name: str, default: str, meaning: str) -> Any:
    """Declare an argument."""
    return DeclareLaunchArgument(name, default_value=default, description=meaning)


def params_file(name: str, node: str) -> Any:
    """Declare the argument for the parameter file of a node."""
    share = get_package_share_directory(PACKAGE)
    return argument(name, f'{share}/config/{node}.yaml', f'YAML file with parameters of {node}')


def parameters_in(file: str, namespace: str, node: str) -> Mapping[str, Any]:
    """Read the parameters of a node; none if that is not possible, as the node will say itself."""
    try:
        return read_values(Path(file), f'{namespace.strip("/")}/{node}')
    except (OSError, ValueError):
        return {}


def unread(namespace: str, files: Mapping[str, Sequence[str]]) -> list[Any]:
    """Say which of the parameter files of each node have no parameters for any of them."""
    full = {node: f'/{namespace.strip("/")}/{node}'.replace('//', '/') for node in files}
    readers: dict[str, list[str]] = {}
    for node, each in files.items():
        for file in each:
            readers.setdefault(file, []).append(node)
    return [
        LogInfo(msg=f'{file}: no parameters for {", ".join(full[node] for node in nodes)}')
        for file, nodes in readers.items()
        if not any(parameters_in(file, namespace, node) for node in nodes)
    ]


def common_arguments() -> list[Any]:
    """Declare the arguments of every launch file, and use the DDS profile if one asks for it."""
    share = get_package_share_directory(PACKAGE)
    return [
        argument('namespace', '', 'namespace of nodes and topics'),
        argument('log_level', 'info', 'log level'),
        argument('respawn', 'true', 'start a node again when it ends by itself'),
        argument('respawn_delay', '1.0', 'seconds before that'),
        argument(
            'state',
            '',
            'folder in which each run of a node tells the next one how it ended; by default as the '
            'parameter files say',
        ),
        argument('large_messages', 'false', 'use the DDS profile for messages over 0.5 MB'),
        SetEnvironmentVariable(
            'FASTRTPS_DEFAULT_PROFILES_FILE',
            f'{share}/config/fastdds_large.xml',
            condition=IfCondition(LaunchConfiguration('large_messages')),
        ),
    ]


def state_file(value: Any, name: str) -> list[dict[str, str]]:
    """Give the parameter for the state file of a node, if there is a folder for it."""
    folder = '/'.join(filter(None, (value('state'), value('namespace').strip('/'))))
    return [{'state.path': f'{folder}/{name}.json'}] if value('state') else []


def nodes(make: Any) -> Any:
    """
    Start nodes when the arguments are known.

    Parameters
    ----------
    make : callable
        Called with a function from the name of an argument to its value; lists the nodes.
    """

    def at_launch(context: Any) -> list[Any]:
        return list(make(lambda name: LaunchConfiguration(name).perform(context)))

    return OpaqueFunction(function=at_launch)


def node(
    value: Any, executable: str, name: str, parameters: Sequence[Any], topics: Sequence[str]
) -> Any:
    """
    Describe a node under the common arguments.

    Parameters
    ----------
    value : callable
        Function from the name of an argument to its value.
    executable, name : str
        Executable and name of the node.
    parameters : sequence of str or dict
        Parameter files and parameters; a later one wins.
    topics : sequence of str
        Topics with an argument of the same name.

    Raises
    ------
    FileNotFoundError
        If there is no such parameter file; the node would start with its defaults.
    """
    for file in parameters:
        if isinstance(file, str) and not Path(file).is_file():
            raise FileNotFoundError(f'{file}: no such parameter file')
    return Node(
        package=PACKAGE,
        executable=executable,
        name=name,
        namespace=value('namespace'),
        parameters=list(parameters),
        remappings=[(topic, value(topic)) for topic in topics],
        ros_arguments=['--log-level', value('log_level')],
        respawn=value('respawn').lower() in ('true', '1', 'yes', 'on'),
        respawn_delay=float(value('respawn_delay')),
        output='screen',
    )
