# SPDX-License-Identifier: Apache-2.0
"""Pixels of an image to rays of its camera and back: K, distortion, window and binning."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from obbhbb_ros.earth.lenses import lens_of
from obbhbb_ros.geometry.boxes import FloatArray

__all__ = ['Pinhole']

# The centre of the first pixel is at 1/2 here, but at 0 in the convention of K.
_HALF = 0.5


class Pinhole:
    """
    A camera as its `sensor_msgs/CameraInfo` states it.

    Pixel i of an image covers [i, i + 1), so its centre is at i + 1/2. K is in the pixels of the
    full sensor, whose centres are at whole numbers, as OpenCV calibrates and image_geometry takes
    it.

    Parameters
    ----------
    k : sequence of float
        The nine numbers of K, row by row, pixels.
    d : sequence of float
        Coefficients of the distortion, as `lenses.lens_of` takes them.
    model : str
        Its model.
    offset : tuple of float
        x and y of the window of the sensor that the image shows, pixels.
    binning : tuple of float
        Pixels of the sensor for one of the image, across and down; 0 is 1.

    Raises
    ------
    ValueError
        If the camera is not calibrated (K is 0), no camera has K, or the distortion is not known.

    Examples
    --------
    >>> k = [1000, 0, 319.5, 0, 1000, 239.5, 0, 0, 1]
    >>> camera = Pinhole(k, offset=(120, 40), binning=(2, 2))
    >>> camera.rays([[100.0, 100.0], [600.0, 100.0]])
    array([[0., 0., 1.],
           [1., 0., 1.]])
    >>> camera.pixels([[2.0, 0.0, 2.0], [0.0, 0.0, -1.0]])
    array([[600., 100.],
           [ nan,  nan]])
    """

    def __init__(
        self,
        k: Sequence[float],
        d: Sequence[float] = (),
        model: str = 'plumb_bob',
        offset: tuple[float, float] = (0, 0),
        binning: tuple[float, float] = (1, 1),
    ) -> None:
        numbers = [float(value) for value in k]
        if len(numbers) != 9 or not all(map(math.isfinite, numbers)):
            raise ValueError('K must be nine finite numbers')
        if not any(numbers):
            raise ValueError('K is 0: the camera is not calibrated')
        fx, skew, cx, _, fy, cy, *_ = numbers
        if numbers[3:4] + numbers[6:] != [0.0, 0.0, 0.0, 1.0] or fx <= 0.0 or fy <= 0.0:
            raise ValueError(f'no camera has this K: {numbers}')
        if not all(0 <= value < math.inf for value in (*offset, *binning)):
            raise ValueError(f'a window at {offset}, binned by {binning}')
        self.focal_lengths = (fx, fy)
        self._skew = skew
        self._lens = lens_of(model, d)
        self._binning = np.array([[max(value, 1)] for value in binning], np.float64)
        # The optical axis, from the corner of the window.
        self._center = np.array([[cx + _HALF - offset[0]], [cy + _HALF - offset[1]]])

    def rays(self, pixels: ArrayLike) -> FloatArray:
        """
        Find the rays of pixels.

        Parameters
        ----------
        pixels : array_like, shape (N, 2)
            x and y in the image.

        Returns
        -------
        ndarray, shape (N, 3)
            Directions in the optical frame, of any length. NaN where the lens shows nothing.
        """
        with np.errstate(all='ignore'):
            u, v = np.asarray(pixels, np.float64).T * self._binning - self._center
            fx, fy = self.focal_lengths
            y = v / fy
            return self._lens.rays(np.array(((u - self._skew * y) / fx, y))).T

    def pixels(self, rays: ArrayLike) -> FloatArray:
        """
        Compute where rays meet the image, also beyond its border.

        Parameters
        ----------
        rays : array_like, shape (N, 3)
            Directions in the optical frame, of any length.

        Returns
        -------
        ndarray, shape (N, 2)
            x and y in the image. NaN where the lens shows nothing, as behind the camera.
        """
        x, y = self._lens.points(np.asarray(rays, np.float64).T)
        fx, fy = self.focal_lengths
        with np.errstate(all='ignore'):
            points = np.array((fx * x + self._skew * y, fy * y))
            return ((points + self._center) / self._binning).T
