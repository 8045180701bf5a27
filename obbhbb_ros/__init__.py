# SPDX-License-Identifier: Apache-2.0
"""
Axis-aligned boxes and crop regions from oriented detections.

Examples
--------
>>> from obbhbb_ros import OrientedBoxes, convert
>>> convert(OrientedBoxes.from_xywhr([[50, 40, 60, 20, 0]]))
array([[20., 30., 80., 50.]])
"""

from importlib import import_module
from typing import TYPE_CHECKING
from typing import Any

if TYPE_CHECKING:
    from obbhbb_ros.errors import ObbhbbError
    from obbhbb_ros.geometry.boxes import Defect
    from obbhbb_ros.geometry.boxes import OrientedBoxes
    from obbhbb_ros.geometry.converter import HullRule
    from obbhbb_ros.geometry.converter import convert
    from obbhbb_ros.geometry.methods import METHODS

__all__ = ['METHODS', 'Defect', 'HullRule', 'ObbhbbError', 'OrientedBoxes', 'convert']

_MODULES = {
    'METHODS': 'geometry.methods',
    'Defect': 'geometry.boxes',
    'HullRule': 'geometry.converter',
    'ObbhbbError': 'errors',
    'OrientedBoxes': 'geometry.boxes',
    'convert': 'geometry.converter',
}


def __getattr__(name: str) -> Any:
    """
    Import the exported names on first use.

    NumPy and shapely take 0.15 s to import, and a node must handle signals before that.
    """
    if name == '__version__':
        return import_module('importlib.metadata').version('obbhbb_ros')
    if name in _MODULES:
        return getattr(import_module(f'obbhbb_ros.{_MODULES[name]}'), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


def __dir__() -> list[str]:
    """List the exported names, which completion offers."""
    return [*__all__, '__version__']
