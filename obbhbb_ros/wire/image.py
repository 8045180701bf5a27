# SPDX-License-Identifier: Apache-2.0
"""`sensor_msgs/Image` and `sensor_msgs/CompressedImage`, read from their bytes."""

from __future__ import annotations

from dataclasses import dataclass

from obbhbb_ros.wire.layouts import COMPRESSED_IMAGE
from obbhbb_ros.wire.layouts import IMAGE
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.walk import read_struct

IMAGE_SIZE_LIMIT = 1_000_000
"""Maximum width and height of an image for which crop regions are planned, pixels."""


@dataclass(frozen=True)
class WireImage:
    """
    A `sensor_msgs/Image` in its bytes.

    Attributes
    ----------
    stamp : Stamp
        The header's stamp.
    frame_id, encoding : str
        As in the message; bytes that are not UTF-8 are escaped.
    width, height : int
        Pixels.
    step : int
        Bytes from one row to the next.
    is_bigendian : bool
        Whether the bytes of a pixel's number are in big-endian order.
    data : memoryview
        The pixels, a view into the bytes that the message was read from.
    """

    stamp: Stamp
    frame_id: str
    encoding: str
    width: int
    height: int
    step: int
    is_bigendian: bool
    data: memoryview


@dataclass(frozen=True)
class CompressedWireImage:
    """
    A `sensor_msgs/CompressedImage` in its bytes.

    Attributes
    ----------
    stamp : Stamp
        The header's stamp.
    frame_id, format : str
        As in the message; bytes that are not UTF-8 are escaped.
    data : memoryview
        The file, a view into the bytes that the message was read from.
    """

    stamp: Stamp
    frame_id: str
    format: str
    data: memoryview


def read_image(data: bytes) -> WireImage:
    """
    Read an image without copying its pixels.

    Parameters
    ----------
    data : bytes
        A serialized `sensor_msgs/Image` with its encapsulation header, of either endianness, with
        up to 6 bytes of padding behind it.

    Returns
    -------
    WireImage
        The image, which keeps `data` alive.

    Raises
    ------
    WireError
        If the bytes are no such message.
    """
    buffer, places = read_struct(data, IMAGE)
    height, width = buffer.numbers(places['height'], '2I')
    (step,) = buffer.numbers(places['step'], 'I')
    (is_bigendian,) = buffer.numbers(places['is_bigendian'], '?')
    frame_id, encoding = (buffer.text(places[path]) for path in ('header.frame_id', 'encoding'))
    pixels = buffer.content(places['data'])
    return WireImage(buffer.stamp, frame_id, encoding, width, height, step, is_bigendian, pixels)


def read_compressed_image(data: bytes) -> CompressedWireImage:
    """Read a `sensor_msgs/CompressedImage` without decoding its file, as `read_image` does."""
    buffer, places = read_struct(data, COMPRESSED_IMAGE)
    return CompressedWireImage(
        stamp=buffer.stamp,
        frame_id=buffer.text(places['header.frame_id']),
        format=buffer.text(places['format']),
        data=buffer.content(places['data']),
    )
