# SPDX-License-Identifier: Apache-2.0
"""Pieces of little-endian plain CDR, each filled up with zeros to whole words."""

from __future__ import annotations

import struct

from obbhbb_ros.wire.stamp import Stamp

_ZEROS = bytes(8)


def text_bytes(content: bytes) -> bytes:
    """Write a string: its length, its content and a closing zero."""
    size = len(content) + 1
    return size.to_bytes(4, 'little') + content + _ZEROS[: 1 + (-size & 3)]


def header_bytes(stamp: Stamp, frame_id: str) -> bytes:
    """Write a `std_msgs/Header`."""
    return struct.pack('<iI', *stamp) + text_bytes(frame_id.encode(errors='replace'))


def padding(end: int) -> bytes:
    """Return the zeros that lead from a place, the end of a field, to a multiple of eight bytes."""
    return _ZEROS[: -end & 7]
