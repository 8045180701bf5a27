"""Axis-aligned boxes and crop regions from oriented detections."""

from obbhbb_ros.boxes import OrientedBoxes
from obbhbb_ros.converter import convert

__all__ = ['OrientedBoxes', 'convert']


def __getattr__(name: str) -> str:
    """Look the version up where the installer put it, when somebody asks."""
    if name == '__version__':
        from importlib.metadata import version

        return version('obbhbb_ros')
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
