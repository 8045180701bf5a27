# SPDX-License-Identifier: Apache-2.0
"""From the coordinates of a network's input to those of the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import replace

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.geometry.boxes import corners_of

__all__ = ['FITS', 'InputFrame']

FITS = ('none', 'stretch', 'letterbox')


@dataclass(frozen=True)
class InputFrame:
    """
    Coordinates of detections: how an image was fitted to a network's input, and unit of angles.

    Attributes
    ----------
    size : tuple of int
        Width and height of the input, pixels.
    fit : str
        One of `FITS`: detections are in image coordinates; the image was stretched to the input;
        or it was scaled as a whole, with equal margins left and right or above and below.
    theta_scale : float
        Factor from the unit of theta to radians.

    Raises
    ------
    ValueError
        If the size is needed and missing.

    Examples
    --------
    >>> frame = InputFrame((640, 640), 'letterbox')
    >>> frame.to_image(np.array([[320.0, 140.0]]), (1280, 720))
    array([[640.,   0.]])
    """

    size: tuple[int, int]
    fit: str = 'none'
    theta_scale: float = 1.0

    def __post_init__(self) -> None:
        """Check that there is a size."""
        if self.fit != 'none' and not all(self.size):
            raise ValueError(f'input_fit {self.fit} needs input_width and input_height')

    @property
    def is_image(self) -> bool:
        """Whether detections are in image coordinates already."""
        return self.fit == 'none'

    def oriented_boxes(
        self,
        xywhr: FloatArray,
        polygons: Sequence[FloatArray] | None = None,
        image_size: tuple[int, int] | None = None,
        *,
        bow: bool = False,
    ) -> OrientedBoxes:
        """
        Make oriented boxes in image coordinates from detections in this frame.

        Parameters
        ----------
        xywhr : ndarray, shape (N, 5)
            Boxes as `OrientedBoxes.from_xywhr` takes them, but with theta in the unit of the frame.
        polygons : sequence of ndarray, each of shape (K, 2), optional
            Vertices of N polygons, pixels, to be used in place of `xywhr`.
        image_size : tuple of int, optional
            Width and height of the image, pixels; without it boxes stay in this frame.
        bow : bool
            Whether theta points to the bow.

        Returns
        -------
        OrientedBoxes
            N boxes.
        """
        target = None if self.is_image else image_size
        if polygons is not None:
            if target:
                polygons = [self.to_image(vertices, target) for vertices in polygons]
            return OrientedBoxes.from_polygons(polygons)
        if self.theta_scale != 1.0:
            # NumPy warns of a signalling NaN.
            with np.errstate(invalid='ignore', over='ignore'):
                theta = xywhr[:, 4:] * self.theta_scale
            xywhr = np.hstack((xywhr[:, :4], theta))
        if target:
            return self.boxes_to_image(xywhr, target, bow)
        return OrientedBoxes.from_xywhr(xywhr, bow=bow)

    def to_image(self, points: FloatArray, image_size: tuple[int, int]) -> FloatArray:
        """
        Map points to the image.

        Parameters
        ----------
        points : ndarray, shape (..., 2)
            x and y in the input, pixels.
        image_size : tuple of int
            Width and height of the image, pixels.

        Returns
        -------
        ndarray, shape (..., 2)
            x and y in the image, pixels.
        """
        image, frame = np.array(image_size, np.float64), np.array(self.size, np.float64)
        scale = frame / image
        if self.fit == 'letterbox':
            scale[:] = scale.min()
        with np.errstate(over='ignore', invalid='ignore'):
            mapped: FloatArray = (points - (frame - image * scale) / 2.0) / scale
        return mapped

    def boxes_to_image(
        self, xywhr: FloatArray, image_size: tuple[int, int], bow: bool = False
    ) -> OrientedBoxes:
        """
        Map boxes to the image.

        Where the image was stretched unequally a box is no longer a rectangle; its corners are
        taken as by `OrientedBoxes.from_corners`.

        Parameters
        ----------
        xywhr : ndarray, shape (N, 5)
            Boxes as `OrientedBoxes.from_xywhr` takes them, with theta in radians.
        image_size : tuple of int
            Width and height of the image, pixels.
        bow : bool
            Whether theta points to the bow.

        Returns
        -------
        OrientedBoxes
            The boxes in the image; defects are kept.
        """
        boxes = OrientedBoxes.from_xywhr(xywhr, bow=bow)
        # Rolled, so that the first two are the bow end.
        corners = np.roll(corners_of(boxes.center, boxes.first, boxes.second), -1, axis=1)
        mapped = OrientedBoxes.from_corners(self.to_image(corners, image_size), bow=boxes.bow)
        return replace(mapped, defects=np.where(boxes.valid, mapped.defects, boxes.defects))
