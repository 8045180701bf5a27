# SPDX-License-Identifier: Apache-2.0
"""Cameras over the Earth, and hulls on it as they see them, by formulas of their own."""

from dataclasses import dataclass

import numpy as np
import pyproj

from obbhbb_ros import OrientedBoxes
from obbhbb_ros.earth.pinhole import Pinhole
from obbhbb_ros.earth.pose import CameraPose

GEOD = pyproj.Geod(ellps='WGS84')
TO_ECEF = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
TO_GEODETIC = pyproj.Transformer.from_crs(4978, 4979, always_xy=True)


def ecef(latitude, longitude, height):
    """Turn geodetic coordinates, (N,), into ECEF, (N, 3), by PROJ."""
    latitude, longitude, height = np.broadcast_arrays(latitude, longitude, height)
    return np.stack(TO_ECEF.transform(longitude, latitude, height), axis=-1)


def turn(axis, degrees):
    """Give the matrix that turns vectors about an axis, 0 to 2."""
    angle, (i, j) = np.radians(degrees), ((1, 2), (2, 0), (0, 1))[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
    return matrix


def quaternion_of(matrix):
    """Turn a rotation matrix into x, y, z, w: the eigenvector of Bar-Itzhack's matrix."""
    r = matrix
    rows = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
            [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
        ]
    )
    return np.linalg.eigh(rows)[1][:, -1]


@dataclass
class Scene:
    """A camera tilted from the vertical toward an azimuth, its image up that way; degrees, m."""

    latitude: float = 54.2
    longitude: float = 12.1
    height: float = 500e3
    tilt: float = 0.0
    azimuth: float = 33.0
    focal: float = 333_333.0
    center: tuple = (2047.5, 1535.5)
    d: tuple = ()
    model: str = 'plumb_bob'
    offset: tuple = (0, 0)
    binning: tuple = (1, 1)

    @property
    def position(self):
        """Where it is, ECEF."""
        return ecef(self.latitude, self.longitude, self.height)

    @property
    def to_enu(self):
        """From ECEF to east-north-up below the camera."""
        return turn(0, self.latitude - 90) @ turn(2, -self.longitude - 90)

    @property
    def matrix(self):
        """From the optical frame to ECEF."""
        down = np.diag((1.0, -1.0, -1.0))
        return self.to_enu.T @ turn(2, -self.azimuth) @ turn(0, self.tilt) @ down

    @property
    def camera(self):
        """The camera as the product has it."""
        k = [self.focal, 0, self.center[0], 0, self.focal, self.center[1], 0, 0, 1]
        return Pinhole(k, self.d, self.model, self.offset, self.binning)

    def pose(self, covariance=None):
        """Its pose as the product has it; the covariance as standard deviations east-north-up."""
        if covariance is not None:
            to_enu = np.kron(np.eye(2), self.to_enu)
            covariance = to_enu.T @ np.diag(covariance) ** 2 @ to_enu
        return CameraPose.from_message(self.position, quaternion_of(self.matrix), covariance)

    def pixels(self, points):
        """Project points, (N, 3), ECEF, to the image; with the centre of pixel 0 at 1/2."""
        x, y, z = ((points - self.position) @ self.matrix).T
        x, y = distorted(x / z, y / z, self.d)
        # OpenCV's pixels of the full sensor, then ours of the window.
        full = np.stack((x, y), axis=1) * self.focal + self.center
        return (full + 0.5 - self.offset) / self.binning

    def boxes(self, latitude, longitude, course, length, width):
        """Draw the boxes of hulls on the ellipsoid: axis from stern to bow, width across it."""
        ends = [
            self.pixels(ecef(*GEOD.fwd(longitude, latitude, course + angle, size / 2)[1::-1], 0.0))
            for angle, size in ((0, length), (180, length), (90, width), (-90, width))
        ]
        along, across = ends[0] - ends[1], ends[2] - ends[3]
        size = np.hypot(*along.T)
        square = np.abs(along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]) / size
        theta = np.arctan2(along[:, 1], along[:, 0])
        rows = np.column_stack(((ends[0] + ends[1]) / 2, size, square, theta))
        return OrientedBoxes.from_xywhr(rows, bow=True)


def distorted(x, y, d):
    """Bend points of the plane z = 1 as OpenCV's page on calibration has it."""
    k1, k2, p1, p2, k3, k4, k5, k6 = [*d, *[0.0] * (8 - len(d))]
    r2 = x**2 + y**2
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
        y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
    )
