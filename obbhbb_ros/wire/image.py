# SPDX-License-Identifier: Apache-2.0
"""`sensor_msgs/Image` and `sensor_msgs/CameraInfo`, read from their bytes."""

from __future__ import annotations

from dataclasses import dataclass

from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.cdr import Message
from obbhbb_ros.wire.cdr import steps_of
from obbhbb_ros.wire.layouts import CAMERA_INFO
from obbhbb_ros.wire.layouts import IMAGE

IMAGE_SIZE_LIMIT = 1_000_000
"""Maximum width and height of an image that is planned for, pixels."""

_IMAGE = steps_of(IMAGE)
_CAMERA_INFO = steps_of(CAMERA_INFO)


@dataclass(frozen=True)
class WireImage:
    """
    A `sensor_msgs/Image` in its bytes.

    Attributes
    ----------
    stamp : tuple of int
        Seconds and nanoseconds.
    frame_id, encoding : str
        As in the message; bytes that are no UTF-8 are escaped.
    width, height : int
        Pixels.
    step : int
        Bytes from one row to the next.
    is_bigendian : bool
        Order of the bytes in a pixel.
    data : memoryview
        The pixels, a view into the bytes that the message was read from.
    """

    stamp: tuple[int, int]
    frame_id: str
    encoding: str
    width: int
    height: int
    step: int
    is_bigendian: bool
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
    message = Message(data, _IMAGE)
    height, width = message.integers('height', 2)
    return WireImage(
        stamp=message.stamp,
        frame_id=message.text('header.frame_id'),
        encoding=message.text('encoding'),
        width=width,
        height=height,
        step=message.integers('step')[0],
        is_bigendian=message.bytes_at('is_bigendian')[0] != 0,
        data=message.octets('data'),
    )


def read_image_size(data: bytes) -> tuple[int, int]:
    """
    Read the size of the image that a camera info describes.

    Parameters
    ----------
    data : bytes
        A serialized `sensor_msgs/CameraInfo`, as `read_image` takes an image.

    Returns
    -------
    tuple of int
        Width and height after region of interest and binning, pixels.

    Raises
    ------
    WireError
        If the bytes are no such message, or a side is longer than `IMAGE_SIZE_LIMIT`.
    """
    message = Message(data, _CAMERA_INFO)
    height, width = message.integers('height', 2)
    binning_x, binning_y, _, _, roi_height, roi_width = message.integers('binning_x', 6)
    if roi_width and roi_height:
        width, height = roi_width, roi_height
    width, height = width // max(binning_x, 1), height // max(binning_y, 1)
    if max(width, height) > IMAGE_SIZE_LIMIT:
        raise WireError(f'an image of {width} x {height} pixels')
    return width, height
