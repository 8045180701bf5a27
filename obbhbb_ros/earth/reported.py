# SPDX-License-Identifier: Apache-2.0
"""
Places of ships as `positions` reports them, and what the ground is told of one.

A ship whose bow is not known lies as reported or the other way round. Its rotation about the
vertical then has π²/2 added to its variance, the second moment of an error that is 0 or π.
"""

from __future__ import annotations

import math

import numpy as np

from obbhbb_ros.earth.ellipsoid import east_north_up
from obbhbb_ros.earth.ellipsoid import to_geodetic
from obbhbb_ros.earth.placement import Placement
from obbhbb_ros.earth.placement import ellipses_of
from obbhbb_ros.earth.quaternions import matrix_of
from obbhbb_ros.geometry.boxes import FloatArray

__all__ = ['position_facts', 'reported_covariances']

_EITHER_WAY = math.pi**2 / 2


def reported_covariances(ships: Placement) -> FloatArray:
    """
    Give the covariances of places in ECEF.

    Parameters
    ----------
    ships : Placement
        N ships.

    Returns
    -------
    ndarray, shape (N, 6, 6)
        Of the point (m) and of small rotations about the axes of ECEF (rad). NaN where that of the
        pose is not known; but the rotation of a ship whose bow is not known is always given.
    """
    axes = east_north_up(ships.latitude, ships.longitude)
    up = axes[:, 2]
    matrices = np.full((len(up), 6, 6), np.nan)
    if ships.covariance is not None:
        # A course is clockwise, a rotation about the vertical is not.
        signs = np.array((1.0, 1.0, -1.0))
        spread = ships.covariance[:, [[0], [1], [3]], [0, 1, 3]] * signs * signs[:, None]
        to_earth = np.zeros((len(up), 6, 3))
        to_earth[:, :3, :2], to_earth[:, 3:, 2] = axes[:, :2].transpose(0, 2, 1), up
        matrices = to_earth @ spread @ to_earth.transpose(0, 2, 1)
    unknown = ~ships.has_bow
    vertical = _EITHER_WAY * up[unknown, :, None] * up[unknown, None, :]
    matrices[unknown, 3:, 3:] = np.nan_to_num(matrices[unknown, 3:, 3:]) + vertical
    return matrices


def position_facts(
    point: FloatArray,
    attitude: FloatArray,
    size: FloatArray,
    covariance: FloatArray,
    pose_age: float | None,
    camera_position: FloatArray | None,
) -> dict[str, object] | None:
    """
    List what the ground is told of the place of a ship.

    Parameters
    ----------
    point : ndarray, shape (3,)
        Its middle, ECEF, metres.
    attitude : ndarray, shape (4,)
        Quaternion: x along the hull, z up.
    size : ndarray, shape (2,)
        Length and width, metres.
    covariance : ndarray, shape (6, 6)
        As `reported_covariances` gives it.
    pose_age : float or None
        Seconds between the image and the nearest pose.
    camera_position : ndarray, shape (3,), or None
        Where the camera was, ECEF, metres.

    Returns
    -------
    dict or None
        `lat` and `lon` (degrees), `course` (degrees from north, clockwise), `course_ambiguous`
        (the course may be the opposite one), `length_m`, `width_m`, `sigma_m` (half axes of the
        error ellipse and azimuth of the major one), `look_deg` (between the vertical at the ship
        and the line to the camera), `pose_age` (s). None for a ship without a place.

    Examples
    --------
    >>> facts = position_facts(
    ...     np.array([6378137.0, 0.0, 0.0]), np.array([0.5, 0.5, 0.5, 0.5]),
    ...     np.array([90.0, 15.0]), np.full((6, 6), np.nan), 0.1, np.array([6878137.0, 0.0, 0.0])
    ... )
    >>> facts['lat'], facts['lon'], facts['course'], facts['sigma_m'], facts['look_deg']
    (0.0, 0.0, 90.0, None, 0.0)
    """
    numbers = (*point, *attitude, *size)
    if not all(map(math.isfinite, numbers)) or not point.any() or not attitude.any():
        return None
    latitude, longitude, _ = (float(value) for value in to_geodetic(point))
    axes = east_north_up(latitude, longitude)
    rotation = matrix_of(attitude / math.hypot(*attitude.tolist()))
    east, north, _ = axes @ rotation[:, 0]
    is_ambiguous = bool(axes[2] @ covariance[3:, 3:] @ axes[2] > _EITHER_WAY / 2)
    course = math.degrees(math.atan2(east, north)) % (180.0 if is_ambiguous else 360.0)
    return {
        'lat': round(latitude, 7),
        'lon': round(longitude, 7),
        'course': round(course, 1),
        'course_ambiguous': is_ambiguous,
        'length_m': round(float(size[0]), 1),
        'width_m': round(float(size[1]), 1),
        'sigma_m': _ellipse(axes, covariance),
        'look_deg': _look(axes[2], point, camera_position),
        'pose_age': None if pose_age is None else round(pose_age, 3),
    }


def _ellipse(axes: FloatArray, covariance: FloatArray) -> list[float] | None:
    """Give the error ellipse of a place; None if it is not known."""
    plane = axes[:2] @ covariance[:3, :3] @ axes[:2].T
    if not np.isfinite(plane).all():
        return None
    major, minor, azimuth = ellipses_of(plane[None])[0].tolist()
    return [round(major, 2), round(minor, 2), round(azimuth, 1)]


def _look(up: FloatArray, point: FloatArray, camera: FloatArray | None) -> float | None:
    """Measure the angle between the vertical and the line to the camera, degrees."""
    if camera is None:
        return None
    sight = camera - point
    distance = math.hypot(*sight.tolist())
    if not 0.0 < distance < math.inf:
        return None
    cosine = float(up @ sight) / distance
    return round(math.degrees(math.acos(max(-1.0, min(1.0, cosine)))), 2)
