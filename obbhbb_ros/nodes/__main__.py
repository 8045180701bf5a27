# SPDX-License-Identifier: Apache-2.0
"""
The executables. Signals come first, and only then everything that takes time to import.

    python -m obbhbb_ros.nodes obb_to_hbb --ros-args -p q:=2.5
"""

from __future__ import annotations

import sys
from importlib import import_module

from obbhbb_ros.nodes.stop import Stop

_CLASSES = {
    'obb_to_hbb': 'ObbToHbb',
    'chip_extractor': 'ChipExtractor',
    'downlink': 'Downlink',
    'overlay': 'Overlay',
    'play_detections': 'PlayDetections',
}


def obb_to_hbb() -> int:
    """Run the conversion node."""
    return _run('obb_to_hbb')


def chip_extractor() -> int:
    """Run the chip node."""
    return _run('chip_extractor')


def downlink() -> int:
    """Run the downlink node."""
    return _run('downlink')


def overlay() -> int:
    """Run the overlay node."""
    return _run('overlay')


def play_detections() -> int:
    """Run the player."""
    return _run('play_detections')


def _run(name: str) -> int:
    """Run a node by the name of its module."""
    stop = Stop()
    process = import_module('obbhbb_ros.nodes.process')
    module = import_module(f'obbhbb_ros.nodes.{name}')
    code: int = process.run(getattr(module, _CLASSES[name]), stop)
    return code


if __name__ == '__main__':
    chosen = sys.argv.pop(1) if len(sys.argv) > 1 else ''
    if chosen not in _CLASSES:
        sys.exit(f'name an executable: {", ".join(_CLASSES)}')
    sys.exit(_run(chosen))
