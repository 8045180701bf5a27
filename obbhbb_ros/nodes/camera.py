# SPDX-License-Identifier: Apache-2.0
"""The camera of an image, and what it is for a chip of the image."""

from __future__ import annotations

from typing import Any

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import RegionOfInterest

from obbhbb_ros.downlink.chips import Region
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.image import WireImage
from obbhbb_ros.wire.image import read_image_size

# What a region of interest can hold.
_FARTHEST = 2**32 - 1


class Camera:
    """
    The latest camera info.

    Attributes
    ----------
    image_size : tuple of int
        Width and height of the images that it is for, pixels; 0 before the first one.
    """

    def __init__(self) -> None:
        self.image_size = (0, 0)
        self._info = CameraInfo()

    def see(self, data: bytes) -> None:
        """Take in a serialized camera info; WireError if the bytes are no such message."""
        size = read_image_size(data)
        try:
            info = deserialize_message(data, CameraInfo)
        except Exception as error:
            # A text that is no UTF-8, for example.
            raise WireError(str(error)) from None
        ends = [
            start + length * max(binning, 1)
            for start, length, binning in zip(
                (info.roi.x_offset, info.roi.y_offset),
                size,
                (info.binning_x, info.binning_y),
                strict=True,
            )
        ]
        if max(ends) > _FARTHEST:
            raise WireError(f'a region of interest up to {ends[0]}, {ends[1]}')
        self._info, self.image_size = info, size

    def info_for(self, image: WireImage) -> Any:
        """Return the camera info of an image; with its size alone if none is known for that."""
        if self.image_size == (image.width, image.height):
            return self._info
        return CameraInfo(width=image.width, height=image.height)


def region_of_interest(info: Any, region: Region) -> Any:
    """
    Write the place of a chip as that of an image of the camera.

    Parameters
    ----------
    info : sensor_msgs.msg.CameraInfo
        The camera of the image, which may show a part of what the camera sees, or be binned.
    region : tuple of int
        x0, y0, x1, y1 in pixels of the image.

    Returns
    -------
    sensor_msgs.msg.RegionOfInterest
        In pixels of the camera at full resolution.
    """
    x0, y0, x1, y1 = region
    across, down = max(info.binning_x, 1), max(info.binning_y, 1)
    return RegionOfInterest(
        x_offset=info.roi.x_offset + x0 * across,
        y_offset=info.roi.y_offset + y0 * down,
        width=(x1 - x0) * across,
        height=(y1 - y0) * down,
        do_rectify=info.roi.do_rectify,
    )
