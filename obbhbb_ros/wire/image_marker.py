# SPDX-License-Identifier: Apache-2.0
"""
`visualization_msgs/ImageMarker`, written to bytes.

rclpy spends several microseconds on the object of each point, and a box has eight of them.
"""

from __future__ import annotations

import struct
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.wire.cdr import LITTLE_ENDIAN

FloatArray: TypeAlias = NDArray[np.float64]

_LINE_LIST = 2
_ADD = 0


def line_list(
    stamp: tuple[int, int],
    frame_id: str,
    layer: tuple[str, int],
    segments: FloatArray,
    color: str,
    width: float,
) -> bytes:
    """
    Write a marker of type LINE_LIST.

    Parameters
    ----------
    stamp : tuple of int
        Seconds and nanoseconds.
    frame_id : str
        As in the image.
    layer : tuple of str and int
        Namespace and id of the marker.
    segments : ndarray, shape (M, 2, 2)
        x and y of the ends of each line, pixels of the image.
    color : str
        '#rrggbb'.
    width : float
        Of the lines, pixels.

    Returns
    -------
    bytes
        The serialized message, little-endian, with its encapsulation header.
    """
    namespace, number = layer
    rgba = *(int(color[i : i + 2], 16) / 255.0 for i in (1, 3, 5)), 1.0
    body = bytearray(struct.pack('<iI', *stamp))
    _add_text(body, frame_id)
    _add_text(body, namespace)
    _align(body, 4)
    body += struct.pack('<3i', number, _LINE_LIST, _ADD)
    _align(body, 8)
    body += struct.pack('<3d', 0.0, 0.0, 0.0)
    body += struct.pack('<f4fB3x4f', width, *rgba, 0, *rgba)
    # For ever, that is until the next marker of the layer.
    body += struct.pack('<iI', 0, 0)
    points = segments.reshape(-1, 2)
    body += struct.pack('<I', len(points))
    if len(points):
        _align(body, 8)
        body += np.hstack((points, np.zeros((len(points), 1)))).astype('<f8').tobytes()
    # No colours of single lines.
    body += struct.pack('<I', 0)
    return LITTLE_ENDIAN + bytes(body)


def _add_text(body: bytearray, text: str) -> None:
    """Add a string."""
    content = text.encode() + b'\0'
    _align(body, 4)
    body += struct.pack('<I', len(content)) + content


def _align(body: bytearray, size: int) -> None:
    """Fill up to a multiple of some bytes."""
    body += bytes(-len(body) % size)
