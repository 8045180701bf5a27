# SPDX-License-Identifier: Apache-2.0
"""
The executables. Signals are handled first; modules that take time to import come after that.

    python -m obbhbb_ros.nodes obb_to_hbb --ros-args -p q:=2.5
    python -m obbhbb_ros.nodes payload --nodes obb_to_hbb chip_extractor downlink
"""

from __future__ import annotations

import os.path
import sys
from importlib import import_module

from obbhbb_ros.nodes.running.executables import NODES
from obbhbb_ros.nodes.running.executables import PAYLOAD
from obbhbb_ros.nodes.running.failure import REASONS
from obbhbb_ros.nodes.running.failure import cannot_start
from obbhbb_ros.nodes.running.stop import Stop


def run_executable(executable: str) -> int:
    """Run the node of an executable, or the nodes of `payload`, and return the exit code."""
    try:
        stop = Stop()
        names, arguments = [executable], not_for_ros(sys.argv[1:])
        if executable == PAYLOAD:
            names = import_module('obbhbb_ros.nodes.running.payload').chosen(arguments)
        elif arguments:
            import_module('obbhbb_ros.nodes.running.usage').answer(executable, arguments)
        process = import_module('obbhbb_ros.nodes.running.process')
        modules = {name: import_module(f'obbhbb_ros.nodes.{name}') for name in names}
    except REASONS as error:
        return cannot_start(error)
    makers = {name: getattr(module, NODES[name]) for name, module in modules.items()}
    return int(process.run(makers, stop))


def not_for_ros(arguments: list[str]) -> list[str]:
    """List the arguments outside of `--ros-args ... --`."""
    outside, is_for_ros = [], False
    for argument in arguments:
        if argument == '--ros-args' or (is_for_ros and argument == '--'):
            is_for_ros = argument == '--ros-args'
        elif not is_for_ros:
            outside.append(argument)
    return outside


def main() -> int:
    """Run the executable that the program is named for, or else the first argument names."""
    executables = (*NODES, PAYLOAD)
    name = os.path.basename(sys.argv[0])
    if name not in executables:
        name = sys.argv.pop(1) if len(sys.argv) > 1 else ''
    if name not in executables:
        sys.exit(f'name an executable: {", ".join(executables)}')
    return run_executable(name)


if __name__ == '__main__':
    sys.exit(main())
