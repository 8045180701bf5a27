# SPDX-License-Identifier: Apache-2.0
"""Where the camera is and where it looks: from the fields of messages, and between two of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from obbhbb_ros.earth.ellipsoid import east_north_up
from obbhbb_ros.earth.ellipsoid import to_ecef
from obbhbb_ros.earth.ellipsoid import to_geodetic
from obbhbb_ros.earth.quaternions import enu_quaternion
from obbhbb_ros.earth.quaternions import matrix_of
from obbhbb_ros.earth.quaternions import product
from obbhbb_ros.earth.quaternions import slerp
from obbhbb_ros.earth.quaternions import unit_quaternion
from obbhbb_ros.errors import ObbhbbError
from obbhbb_ros.geometry.boxes import FloatArray

__all__ = ['Attitude', 'CameraPose', 'Fix', 'PoseError']

# Ten times the distance of the Moon: a larger number is not a position in metres.
_MAX_DISTANCE = 4e9
_NO_FIX = -1
_UNKNOWN = 0


class PoseError(ObbhbbError, ValueError):
    """A pose that cannot be used; the text says why."""


@dataclass(frozen=True, eq=False)
class CameraPose:
    """
    The camera's optical frame in frame `earth`.

    Make it with `from_message` or `from_parts`.

    Attributes
    ----------
    position : ndarray, shape (3,)
        ECEF, metres.
    attitude : ndarray, shape (4,)
        Unit quaternion x, y, z, w: from vectors of the optical frame to ECEF.
    covariance : ndarray, shape (6, 6), or None
        Of the position (m) and of small rotations about the axes of ECEF (rad), in that order;
        None if it is not known.

    Examples
    --------
    A camera 500 km above the equator, image up to the north:

    >>> pose = CameraPose.from_message([6878137, 0, 0], [0.5, 0.5, -0.5, -0.5])
    >>> (pose.matrix @ [1, 2, 3]).tolist()
    [-3.0, 1.0, -2.0]
    """

    position: FloatArray
    attitude: FloatArray
    covariance: FloatArray | None = None

    @cached_property
    def matrix(self) -> FloatArray:
        """The attitude as a rotation matrix, (3, 3)."""
        return matrix_of(self.attitude)

    def origins(self, lines: FloatArray) -> FloatArray:
        """Tell where the camera is, (3,), ECEF: the same for all lines of the image."""
        return self.position

    def turned(self, rays: FloatArray, lines: FloatArray) -> FloatArray:
        """Turn rays, (M, 3), of the optical frame into ECEF, by the same pose for all lines."""
        return rays @ self.matrix.T

    @classmethod
    def from_message(
        cls, position: ArrayLike, attitude: ArrayLike, covariance: ArrayLike | None = None
    ) -> CameraPose:
        """
        Take the pose of a `PoseStamped`, `PoseWithCovarianceStamped` or `Odometry`.

        Parameters
        ----------
        position : array_like, shape (3,)
            x, y, z in frame `earth`, metres.
        attitude : array_like, shape (4,)
            x, y, z, w: the orientation of the optical frame in `earth`.
        covariance : array_like, shape (36,) or (6, 6), optional
            As in the message: x, y, z, and rotations about the fixed axes X, Y and Z. All zeros,
            and what is no covariance, are not known.

        Raises
        ------
        PoseError
            If a number is not finite or beyond 4 million km, or the attitude is no rotation.
        """
        return cls(_position(position), _attitude(attitude), _covariance(covariance, 6))

    @classmethod
    def from_parts(cls, fix: Fix, attitude: Attitude, mount: FloatArray) -> CameraPose:
        """
        Join where a vehicle is, how its body lies, and how the camera is mounted.

        The distance between camera and antenna is taken as 0.

        Parameters
        ----------
        fix : Fix
            Where it is.
        attitude : Attitude
            How its body lies.
        mount : ndarray, shape (4,)
            Unit quaternion: from the optical frame to the body.
        """
        axes = east_north_up(fix.latitude, fix.longitude)
        body = product(enu_quaternion(fix.latitude, fix.longitude), attitude.quaternion)
        if fix.covariance is None or attitude.covariance is None:
            return cls(fix.position, product(body, mount))
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = fix.covariance
        covariance[3:, 3:] = axes.T @ attitude.covariance @ axes
        return cls(fix.position, product(body, mount), covariance)

    def toward(self, later: CameraPose, fraction: float) -> CameraPose:
        """
        Interpolate: the position along a line, the attitude by slerp.

        In orbit the line is below the path by up to 1.2 m after a second between the poses, and by
        four times as much after two. Covariances are weighted means, as errors of poses that follow
        each other are alike.

        Parameters
        ----------
        later : CameraPose
            The other pose.
        fraction : float
            0 for this one, 1 for the other.
        """
        return CameraPose(
            _mixed(self.position, later.position, fraction),
            slerp(self.attitude, later.attitude, fraction),
            _mixed_covariance(self.covariance, later.covariance, fraction),
        )


@dataclass(frozen=True, eq=False)
class Fix:
    """
    A place as `sensor_msgs/NavSatFix` has it. Make it with `from_message`.

    Attributes
    ----------
    latitude, longitude : float
        Degrees.
    position : ndarray, shape (3,)
        ECEF, metres.
    covariance : ndarray, shape (3, 3), or None
        In ECEF, m²; None if it is not known.
    """

    latitude: float
    longitude: float
    position: FloatArray
    covariance: FloatArray | None = None

    @classmethod
    def from_message(
        cls,
        latitude: float,
        longitude: float,
        altitude: float,
        *,
        status: int = 0,
        covariance: ArrayLike | None = None,
        covariance_type: int = _UNKNOWN,
    ) -> Fix:
        """
        Take a `sensor_msgs/NavSatFix`.

        Parameters
        ----------
        latitude, longitude : float
            Degrees.
        altitude : float
            Metres above the ellipsoid.
        status : int
            `status.status`.
        covariance : array_like, shape (9,) or (3, 3), optional
            Of east, north and up, m².
        covariance_type : int
            `position_covariance_type`.

        Raises
        ------
        PoseError
            If there is no fix, or the numbers are no place.

        Examples
        --------
        >>> Fix.from_message(0.0, 90.0, 120.0).position.round(3).tolist()
        [0.0, 6378257.0, 0.0]
        """
        if status <= _NO_FIX:
            raise PoseError(f'no fix (status {status})')
        if not abs(latitude) <= 90.0 or not abs(longitude) <= 360.0:
            raise PoseError(f'latitude {latitude}, longitude {longitude} are not degrees')
        known = None if covariance_type == _UNKNOWN else _covariance(covariance, 3)
        if known is not None:
            axes = east_north_up(latitude, longitude)
            known = axes.T @ known @ axes
        position = _position(to_ecef(latitude, longitude, altitude))
        return cls(latitude, longitude, position, known)

    def toward(self, later: Fix, fraction: float) -> Fix:
        """Interpolate along a line; 0 is this place, 1 the other."""
        position = _mixed(self.position, later.position, fraction)
        latitude, longitude, _ = to_geodetic(position)
        covariance = _mixed_covariance(self.covariance, later.covariance, fraction)
        return Fix(float(latitude), float(longitude), position, covariance)


@dataclass(frozen=True, eq=False)
class Attitude:
    """
    How a body lies in east-north-up, as `sensor_msgs/Imu` has it. Make it with `from_message`.

    Attributes
    ----------
    quaternion : ndarray, shape (4,)
        Unit quaternion: from the body (x forward, y left, z up) to east-north-up.
    covariance : ndarray, shape (3, 3), or None
        Of small rotations about east, north and up, rad²; None if it is not known.
    """

    quaternion: FloatArray
    covariance: FloatArray | None = None

    @classmethod
    def from_message(
        cls, orientation: ArrayLike, covariance: Sequence[float] | None = None
    ) -> Attitude:
        """
        Take a `sensor_msgs/Imu`.

        Parameters
        ----------
        orientation : array_like, shape (4,)
            x, y, z, w.
        covariance : sequence of float, shape (9,), optional
            `orientation_covariance`, rad².

        Raises
        ------
        PoseError
            If the message says that it has no orientation (the covariance begins with -1), or it is
            no rotation.

        Examples
        --------
        >>> Attitude.from_message([0, 0, 0, 1], [-1.0] + 8 * [0.0])
        Traceback (most recent call last):
        obbhbb_ros.earth.pose.PoseError: the Imu has no orientation
        """
        if covariance is not None and len(covariance) and covariance[0] == -1.0:
            raise PoseError('the Imu has no orientation')
        return cls(_attitude(orientation), _covariance(covariance, 3))

    def toward(self, later: Attitude, fraction: float) -> Attitude:
        """Interpolate by slerp; 0 is this attitude, 1 the other."""
        return Attitude(
            slerp(self.quaternion, later.quaternion, fraction),
            _mixed_covariance(self.covariance, later.covariance, fraction),
        )


def _position(numbers: ArrayLike) -> FloatArray:
    """Check a position, (3,), ECEF."""
    position = np.array(numbers, np.float64)
    if position.shape != (3,) or not (np.abs(position) <= _MAX_DISTANCE).all():
        raise PoseError(f'position {position.tolist()} is not three numbers in metres')
    return position


def _attitude(numbers: ArrayLike) -> FloatArray:
    """Check a quaternion, (4,)."""
    try:
        return unit_quaternion(numbers)
    except ValueError as error:
        raise PoseError(str(error)) from None


def _covariance(numbers: ArrayLike | None, size: int) -> FloatArray | None:
    """Return a covariance, (size, size), or None if it is not known."""
    if numbers is None:
        return None
    matrix = np.array(numbers, np.float64)
    if matrix.size != size * size or not (np.abs(matrix) < 1e100).all():
        return None
    matrix = matrix.reshape(size, size)
    variances = np.diagonal(matrix)
    if not (variances >= 0.0).all() or not variances.any():
        return None
    symmetric: FloatArray = 0.5 * (matrix + matrix.T)
    return symmetric


def _mixed(before: FloatArray, after: FloatArray, fraction: float) -> FloatArray:
    """Interpolate along a line."""
    return before + fraction * (after - before)


def _mixed_covariance(
    before: FloatArray | None, after: FloatArray | None, fraction: float
) -> FloatArray | None:
    """Interpolate covariances, None if one is not known."""
    if before is None or after is None:
        return None
    return _mixed(before, after, fraction)
