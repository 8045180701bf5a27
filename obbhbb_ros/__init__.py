# SPDX-License-Identifier: Apache-2.0
"""Axis-aligned boxes and crop regions from oriented detections."""

from importlib import import_module
from typing import TYPE_CHECKING
from typing import Any

if TYPE_CHECKING:
    from obbhbb_ros.geometry.boxes import OrientedBoxes
    from obbhbb_ros.geometry.converter import convert

__all__ = ['OrientedBoxes', 'convert']


def __getattr__(name: str) -> Any:
    """
    Import the exported names on first use.

    NumPy and shapely take 0.15 s to import, and a node must handle signals before that.
    """
    if name == '__version__':
        return import_module('importlib.metadata').version('obbhbb_ros')
    if name in __all__:
        module = {'OrientedBoxes': 'geometry.boxes', 'convert': 'geometry.converter'}[name]
        return getattr(import_module(f'obbhbb_ros.{module}'), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
