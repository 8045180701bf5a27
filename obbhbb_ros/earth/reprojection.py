# SPDX-License-Identifier: Apache-2.0
"""What one image shows of the water, found in another image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obbhbb_ros.earth.ellipsoid import first_hits
from obbhbb_ros.earth.pinhole import Pinhole
from obbhbb_ros.earth.pose import CameraPose
from obbhbb_ros.geometry.boxes import FloatArray

__all__ = ['Viewpoint']


class Viewpoint(NamedTuple):
    """
    A camera and its pose at the time of an image.

    Attributes
    ----------
    camera : Pinhole
        The camera.
    pose : CameraPose
        Its pose.
    surface_height : float
        Height of the water above the ellipsoid, metres.
    """

    camera: Pinhole
    pose: CameraPose
    surface_height: float

    def pixels_in(self, other: Viewpoint, pixels: FloatArray) -> FloatArray:
        """
        Find what pixels show in another image.

        Parameters
        ----------
        other : Viewpoint
            The other image.
        pixels : ndarray, shape (N, 2)
            x and y in this image.

        Returns
        -------
        ndarray, shape (N, 2)
            x and y in the other image, also beyond its border; NaN for sky, what is past the
            horizon, and what a lens does not show.

        Examples
        --------
        >>> camera = Pinhole([1e6 / 3, 0, 511.5, 0, 1e6 / 3, 511.5, 0, 0, 1])
        >>> down = [0.5, 0.5, -0.5, -0.5]
        >>> before = Viewpoint(camera, CameraPose.from_message([6878137, 0, 0], down), 0.0)
        >>> after = Viewpoint(camera, CameraPose.from_message([6878137, 150, 0], down), 0.0)
        >>> before.pixels_in(after, np.array([[512.0, 512.0]])).round(3).tolist()
        [[412.0, 512.0]]
        """
        rays = self.camera.rays(pixels) @ self.pose.matrix.T
        with np.errstate(all='ignore'):
            points = first_hits(self.pose.position, rays, self.surface_height)
            return other.camera.pixels((points - other.pose.position) @ other.pose.matrix)
