# SPDX-License-Identifier: Apache-2.0
"""The camera info of an image, and the region of interest of a chip in it."""

from __future__ import annotations

from typing import Any
from typing import NamedTuple

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import RegionOfInterest

from obbhbb_ros.downlink.chips import Region
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.camera import WireCamera
from obbhbb_ros.wire.camera import read_camera
from obbhbb_ros.wire.image import WireImage

# Maximum of the numbers in a region of interest.
_MAX_UINT32 = 2**32 - 1


class Camera(NamedTuple):
    """
    A message on `camera_info`.

    Attributes
    ----------
    facts : WireCamera
        The camera.
    message : sensor_msgs.msg.CameraInfo
        The message.
    """

    facts: WireCamera
    message: Any


def camera_of(data: bytes) -> Camera:
    """Read a serialized camera info; WireError if it cannot be read, or no chip has a place."""
    facts = read_camera(data)
    try:
        message = deserialize_message(data, CameraInfo)
    except Exception as error:
        # For example, a string that is not UTF-8.
        raise WireError(str(error)) from None
    # The image may be a pixel larger.
    ends = [
        start + (length + 1) * binning
        for start, length, binning in zip(
            facts.roi[:2], facts.image_size, facts.binning, strict=True
        )
    ]
    if max(ends) > _MAX_UINT32:
        raise WireError(f'a region of interest up to {ends[0]}, {ends[1]}')
    return Camera(facts, message)


def sized(image: WireImage) -> Any:
    """Return a camera info that knows no more than the size of an image."""
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
