# SPDX-License-Identifier: Apache-2.0
"""A camera that flies straight over an image: where it is, and where the image is on Earth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from obbhbb_ros.earth.ellipsoid import to_ecef
from obbhbb_ros.earth.ellipsoid import to_geodetic
from obbhbb_ros.earth.pose import CameraPose
from obbhbb_ros.earth.quaternions import enu_quaternion
from obbhbb_ros.earth.quaternions import matrix_of
from obbhbb_ros.earth.quaternions import product
from obbhbb_ros.geometry.boxes import FloatArray

# From the optical frame of a camera that looks down, its image north up, to east-north-up.
_DOWN = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class StraightPass:
    """
    A camera that looks straight down and flies south, over an image that is north up.

    The image touches the ellipsoid in its middle, and is flat. The camera sees a window as wide as
    the image. So a pixel has the same place in each window but for what the roundness of the Earth
    makes: two hundredths of a millimetre for an image of a kilometre from 500 km, a centimetre
    from one.

    Attributes
    ----------
    latitude, longitude : float
        Where the middle of the image is, degrees.
    altitude : float
        Height of the camera above the image, metres.
    ground_sample_distance : float
        Size of a pixel, metres.
    size : tuple of int
        Width and height of the image, pixels.

    Examples
    --------
    >>> over = StraightPass(0.0, 0.0, 500_000.0, 1.0, (1000, 800))
    >>> over.k(200)[:6]
    (500000.0, 0.0, 499.5, 0.0, 500000.0, 99.5)
    >>> over.pose(0, 200).position[[0, 2]].round(3).tolist()
    [6878137.0, 300.0]
    """

    latitude: float
    longitude: float
    altitude: float
    ground_sample_distance: float
    size: tuple[int, int]

    def k(self, height: int) -> tuple[float, ...]:
        """
        Return K of the camera, nine numbers row by row.

        Parameters
        ----------
        height : int
            Height of the window, pixels. The optical axis goes through its middle.
        """
        focal = self.altitude / self.ground_sample_distance
        # The centre of pixel 0 is at 0, not at ½.
        x, y = (self.size[0] - 1) / 2, (height - 1) / 2
        return focal, 0.0, x, 0.0, focal, y, 0.0, 0.0, 1.0

    def pose(self, top: int, height: int) -> CameraPose:
        """
        Return the pose of the camera.

        Parameters
        ----------
        top, height : int
            The row of the image at which the window begins, and its height, pixels.
        """
        above = (self.size[0] / 2, top + height / 2)
        return CameraPose.from_message(self._points(above, self.altitude), self._attitude)

    def places(self, points: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return latitudes and longitudes, degrees, of points of the image, (N, 2), pixels."""
        latitude, longitude, _ = to_geodetic(self._points(points, 0.0))
        return latitude, longitude

    @cached_property
    def _attitude(self) -> FloatArray:
        """The quaternion from the optical frame to ECEF."""
        return product(enu_quaternion(self.latitude, self.longitude), _DOWN)

    def _points(self, points: ArrayLike, height: float) -> FloatArray:
        """Return points of the image, raised by a height, in ECEF; (..., 3)."""
        from_middle = np.asarray(points, np.float64) - np.divide(self.size, 2.0)
        down = np.full(from_middle.shape[:-1], -height)
        offsets = np.stack((*np.moveaxis(from_middle * self.ground_sample_distance, -1, 0), down))
        middle = to_ecef(self.latitude, self.longitude, 0.0)
        return middle + np.moveaxis(offsets, 0, -1) @ matrix_of(self._attitude).T
