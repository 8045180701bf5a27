# SPDX-License-Identifier: Apache-2.0
"""
`visualization_msgs/ImageMarker`, written to bytes.

rclpy spends several microseconds on the object of each point, and a box has eight points.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import numpy as np

from obbhbb_ros.wire.buffer import LITTLE_ENDIAN
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.writing import header_bytes
from obbhbb_ros.wire.writing import padding
from obbhbb_ros.wire.writing import text_bytes

if TYPE_CHECKING:
    from obbhbb_ros.geometry.boxes import FloatArray

_LINE_LIST = 2
_ADD = 0


def line_list(
    stamp: Stamp,
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
    stamp : Stamp
        Stamp of the image.
    frame_id : str
        Frame id of the image.
    layer : tuple of str and int
        Namespace and id of the marker.
    segments : ndarray, shape (M, 2, 2)
        x and y of the ends of each line, pixels of the image.
    color : str
        '#rrggbb'.
    width : float
        Width of the lines, pixels.

    Returns
    -------
    bytes
        The serialized message, little-endian, with its encapsulation header.
    """
    namespace, number = layer
    rgba = *(int(color[i : i + 2], 16) / 255.0 for i in (1, 3, 5)), 1.0
    points = np.pad(segments.reshape(-1, 2).astype('<f8'), ((0, 0), (0, 1)))
    body = header_bytes(stamp, frame_id) + text_bytes(namespace.encode())
    body += struct.pack('<3i', number, _LINE_LIST, _ADD)
    # Position, scale, outline colour, filled, fill colour. A lifetime of 0 lasts until the next
    # marker of the layer.
    body += padding(len(body)) + struct.pack('<3d', 0.0, 0.0, 0.0)
    body += struct.pack('<f4fB3x4f', width, *rgba, 0, *rgba) + struct.pack('<iI', 0, 0)
    body += struct.pack('<I', len(points))
    if len(points):
        body += padding(len(body)) + points.tobytes()
    # No outline colours of single lines.
    return LITTLE_ENDIAN + body + struct.pack('<I', 0)
