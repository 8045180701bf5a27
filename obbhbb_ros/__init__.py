# SPDX-License-Identifier: Apache-2.0
"""Axis-aligned boxes and crop regions from oriented detections."""

from typing import TYPE_CHECKING
from typing import Any

if TYPE_CHECKING:
    from obbhbb_ros.boxes import OrientedBoxes
    from obbhbb_ros.converter import convert

__all__ = ['OrientedBoxes', 'convert']

_HOMES = {'OrientedBoxes': 'obbhbb_ros.boxes', 'convert': 'obbhbb_ros.converter'}


def __getattr__(name: str) -> Any:
    """
    Import what the package exports when somebody asks for it.

    NumPy and shapely take 0.15 s to import: a node has its signals in hand before that.
    """
    if name == '__version__':
        from importlib.metadata import version

        return version('obbhbb_ros')
    if name in _HOMES:
        from importlib import import_module

        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
