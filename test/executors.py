# SPDX-License-Identifier: Apache-2.0
"""
Executors by name, and the nodes run by any of them.

    python test/executors.py rclpy.experimental:EventsExecutor overlay --ros-args -r __ns:=/test
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

OURS = 'obbhbb_ros.nodes.running.executor:ExpressExecutor'


def executor_class(name: str) -> Callable[..., Any]:
    """Return the executor class of a name such as `rclpy.executors:SingleThreadedExecutor`."""
    module, _, attribute = name.partition(':')
    return getattr(import_module(module), attribute)


def main() -> int:
    """Run a node as its executable does, but by the executor of the first argument."""
    from obbhbb_ros.nodes.running.executables import NODES
    from obbhbb_ros.nodes.running.stop import Stop

    # Before libraries start threads, as the executables do.
    stop = Stop()
    executor_name, node_name = sys.argv.pop(1), sys.argv.pop(1)
    process = import_module('obbhbb_ros.nodes.running.process')

    def make_executor(node: Any) -> Any:
        executor = executor_class(executor_name)(context=node.context)
        executor.add_node(node)
        return executor

    node_class = getattr(import_module(f'obbhbb_ros.nodes.{node_name}'), NODES[node_name])
    return process.run({node_name: node_class}, stop, make_executor=make_executor)


if __name__ == '__main__':
    sys.exit(main())
