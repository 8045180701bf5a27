# SPDX-License-Identifier: Apache-2.0
"""`sensor_msgs/CameraInfo`, read from its bytes."""

from __future__ import annotations

from dataclasses import dataclass

from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.image import IMAGE_SIZE_LIMIT
from obbhbb_ros.wire.layouts import CAMERA_INFO
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.walk import read_struct


@dataclass(frozen=True)
class WireCamera:
    """
    A `sensor_msgs/CameraInfo`.

    Attributes
    ----------
    stamp : Stamp
        The header's stamp.
    frame_id, model : str
        Frame and distortion model as in the message; bytes that are not UTF-8 are escaped.
    size : tuple of int
        Width and height at full resolution, pixels.
    d, k : tuple of float
        Distortion, and K in nine numbers row by row, all 0 if it is not known.
    roi : tuple of int
        The part that the image shows: x, y, width and height at full resolution.
    binning : tuple of int
        Pixels at full resolution for one of the image, across and down.
    """

    stamp: Stamp
    frame_id: str
    size: tuple[int, int]
    model: str
    d: tuple[float, ...]
    k: tuple[float, ...]
    roi: tuple[int, int, int, int]
    binning: tuple[int, int]

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the image, after region of interest and binning, pixels."""
        (_, _, width, height), (across, down) = self.roi, self.binning
        return width // across, height // down

    def fits(self, size: tuple[int, int]) -> bool:
        """
        Return whether an image of some width and height is of this camera.

        A pixel more or less on a side does no harm: some drivers give the valid part as the region
        of interest, and they round differently when they bin.
        """
        return all(abs(a - b) <= 1 for a, b in zip(self.image_size, size, strict=True))


def read_camera(data: bytes) -> WireCamera:
    """
    Read a camera info.

    Parameters
    ----------
    data : bytes
        A serialized `sensor_msgs/CameraInfo`, as `read_image` takes an image.

    Returns
    -------
    WireCamera
        The camera. A message without region of interest or binning has those of the whole image.

    Raises
    ------
    WireError
        If the bytes are no such message, or a side of the image is longer than `IMAGE_SIZE_LIMIT`.
    """
    buffer, places = read_struct(data, CAMERA_INFO)
    height, width = buffer.numbers(places['height'], '2I')
    across, down, x, y, roi_height, roi_width = buffer.numbers(places['binning_x'], '6I')
    if not roi_width or not roi_height:
        roi_width, roi_height = width, height
    at = places['d']
    count = buffer.lengths[at >> 2]
    camera = WireCamera(
        stamp=buffer.stamp,
        frame_id=buffer.text(places['header.frame_id']),
        size=(width, height),
        model=buffer.text(places['distortion_model']),
        d=buffer.numbers(at + 4 + 7 & -8, f'{count}d'),
        k=buffer.numbers(places['k'], '9d'),
        roi=(x, y, roi_width, roi_height),
        binning=(max(across, 1), max(down, 1)),
    )
    width, height = camera.image_size
    if max(width, height) > IMAGE_SIZE_LIMIT:
        raise WireError(f'an image of {width} x {height} pixels')
    return camera
