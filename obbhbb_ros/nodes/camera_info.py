# SPDX-License-Identifier: Apache-2.0
"""The camera info of an image, and the region of interest of a chip in it."""

from __future__ import annotations

from typing import Any

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import RegionOfInterest

from obbhbb_ros.downlink.chips import Region
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.image import WireImage
from obbhbb_ros.wire.image import read_image_size

# Maximum of the numbers in a region of interest.
_MAX_UINT32 = 2**32 - 1


class LatestCameraInfo:
    """
    The latest message on `camera_info`.

    Attributes
    ----------
    image_size : tuple of int
        Width and height of the images that it describes, pixels; 0 before the first message.
    """

    def __init__(self) -> None:
        self.image_size = (0, 0)
        self._info = CameraInfo()

    def update(self, data: bytes) -> None:
        """Take a serialized camera info; WireError if it cannot be read."""
        size = read_image_size(data)
        try:
            info = deserialize_message(data, CameraInfo)
        except Exception as error:
            # For example, a string that is not UTF-8.
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
        if max(ends) > _MAX_UINT32:
            raise WireError(f'a region of interest up to {ends[0]}, {ends[1]}')
        self._info, self.image_size = info, size

    def info_for(self, image: WireImage) -> Any:
        """Return the latest camera info if it fits the image, else one with the size alone."""
        if self.image_size == (image.width, image.height):
            return self._info
        return CameraInfo(width=image.width, height=image.height)


def region_of_interest(info: Any, region: Region) -> Any:
    """
    Return the region of interest of a chip.

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
