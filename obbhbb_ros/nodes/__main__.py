# SPDX-License-Identifier: Apache-2.0
"""
The executables. Signals are handled first; modules that take time to import come after that.

    python -m obbhbb_ros.nodes obb_to_hbb --ros-args -p q:=2.5
"""

from __future__ import annotations

import os.path
import sys
from importlib import import_module

from obbhbb_ros.nodes.failure import REASONS
from obbhbb_ros.nodes.failure import cannot_start
from obbhbb_ros.nodes.stop import Stop

NODES = {
    'obb_to_hbb': 'ObbToHbb',
    'chip_extractor': 'ChipExtractor',
    'downlink': 'Downlink',
    'overlay': 'Overlay',
    'play_detections': 'PlayDetections',
    'ship_tracker': 'ShipTracker',
}
"""The class of each executable; its module has the name of the executable."""


def run_node(name: str) -> int:
    """Run the node of an executable, and return the exit code."""
    try:
        stop = Stop()
        if arguments := not_for_ros(sys.argv[1:]):
            import_module('obbhbb_ros.nodes.usage').answer(name, arguments)
        process = import_module('obbhbb_ros.nodes.process')
        module = import_module(f'obbhbb_ros.nodes.{name}')
    except REASONS as error:
        return cannot_start(error)
    return int(process.run(getattr(module, NODES[name]), stop))


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
    """Run the node that the executable is named for, or else the first argument names."""
    name = os.path.basename(sys.argv[0])
    if name not in NODES:
        name = sys.argv.pop(1) if len(sys.argv) > 1 else ''
    if name not in NODES:
        sys.exit(f'name an executable: {", ".join(NODES)}')
    return run_node(name)


if __name__ == '__main__':
    sys.exit(main())
