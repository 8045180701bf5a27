# SPDX-License-Identifier: Apache-2.0
"""What a node says about the parameters given at start that it does not use."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from collections.abc import Sequence
from pathlib import Path

from rclpy.node import Node

from obbhbb_ros.nodes.node_topics import OVERRIDE_PREFIX
from obbhbb_ros.settings.parameter_file import parameter_files
from obbhbb_ros.settings.parameter_file import read_values
from obbhbb_ros.settings.parameter_file import shared_names


def warn_of_unused_files(nodes: Sequence[Node]) -> None:
    """Warn of the parameter files on the command line that have nothing for any of the nodes."""
    names = [node.get_fully_qualified_name() for node in nodes]
    for file in parameter_files(sys.argv):
        if not any(_has_parameters(file, name) for name in names):
            nodes[0].get_logger().warning(f'{file}: no parameters for {", ".join(names)}')


def _has_parameters(file: Path, name: str) -> bool:
    """Return whether a file has parameters for a node."""
    try:
        return bool(read_values(file, name))
    except (OSError, ValueError):
        return False


def report_unknown(node: Node, unknown: Iterable[str]) -> None:
    """
    Report the names given at start that are no parameters of a node.

    In a section for several nodes, those of another node of the package are no mistake.
    """
    names = [name for name in unknown if not name.startswith(OVERRIDE_PREFIX)]
    of_others = _of_other_nodes(node) if names else set()
    mistakes = [name for name in names if name not in of_others]
    if mistakes:
        node.get_logger().warning(f'unknown parameters, ignored: {", ".join(mistakes)}')
    if len(mistakes) < len(names):
        others = ', '.join(name for name in names if name in of_others)
        node.get_logger().info(f'parameters of other nodes, ignored: {others}')


def _shared(file: Path, name: str) -> set[str]:
    """Collect the names in sections for several nodes; none of a pipe, which ROS has emptied."""
    try:
        return shared_names(file, name)
    except (OSError, ValueError):
        return set()


def _of_other_nodes(node: Node) -> set[str]:
    """Collect the names in sections for several nodes that some node of the package has."""
    # It takes time to import, and few nodes need it.
    from obbhbb_ros.settings.all_nodes import NODE_TABLES

    name = node.get_fully_qualified_name()
    shared = set[str]().union(*(_shared(file, name) for file in parameter_files(sys.argv)))
    return {
        known
        for table in NODE_TABLES.values()
        for known in shared & table.parameters(table.mentioned_classes(shared)).keys()
    }
