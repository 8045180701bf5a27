# SPDX-License-Identifier: Apache-2.0
"""
Places of ships as `positions` reports them, and what the ground learns about them.

A ship whose bow is not known lies as reported, or the opposite way round. Its rotation about the
vertical then has π²/2 added to its variance, the second moment of an error that is 0 or π.
"""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from numpy.typing import ArrayLike

from obbhbb_ros.earth.ellipsoid import east_north_up
from obbhbb_ros.earth.ellipsoid import to_geodetic
from obbhbb_ros.earth.placement import Placement
from obbhbb_ros.earth.placement import ellipses_of
from obbhbb_ros.earth.pose import PoseError
from obbhbb_ros.earth.pose_source import EARTH
from obbhbb_ros.earth.quaternions import matrix_of
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.wire.positions import WirePositions
from obbhbb_ros.wire.stamp import nanoseconds_of

__all__ = ['ShipPlaces', 'reported_covariances']

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


class ShipPlaces:
    """
    What the ground learns about the places of the ships in an image.

    Parameters
    ----------
    positions : WirePositions
        Where they are, in frame `earth`.
    camera : array_like, shape (3,), optional
        Where the camera was, ECEF, metres.

    Raises
    ------
    PoseError
        If the positions are in another frame.
    """

    def __init__(self, positions: WirePositions, camera: ArrayLike | None = None) -> None:
        if positions.frame_id.lstrip('/') != EARTH:
            raise PoseError(f"positions are in frame '{positions.frame_id}', not '{EARTH}'")
        self._positions = positions
        self._camera = None if camera is None else np.asarray(camera, np.float64)
        counts = Counter(positions.ids)
        # An id that several ships share names none of them.
        self._rows = {
            text: row for row, text in enumerate(positions.ids) if text and counts[text] == 1
        }

    def facts(self, ship: str) -> dict[str, object] | None:
        """
        List what the ground learns about the place of a ship.

        Parameters
        ----------
        ship : str
            Its id.

        Returns
        -------
        dict or None
            `lat` and `lon` (degrees), `course` (degrees from north, clockwise),
            `course_ambiguous` (the course may be the opposite one), `length_m`, `width_m`,
            `sigma_m` (half axes of the error ellipse and azimuth of the major one), `look_deg`
            (between the vertical at the ship and the line to the camera), `pose_age` (s); null
            what is not known. None for a ship without a place.
        """
        row = self._rows.get(ship)
        if row is None:
            return None
        all_positions = self._positions
        point, attitude = all_positions.points[row], all_positions.attitudes[row]
        covariance = all_positions.covariances[row]
        length, width = all_positions.sizes[row].tolist()
        with np.errstate(all='ignore'):
            latitude, longitude, _ = (float(value) for value in to_geodetic(point))
            axes = east_north_up(latitude, longitude)
            course, is_ambiguous = _course(axes, attitude, covariance)
            ellipse, look = _ellipse(axes, covariance), _look(axes[2], point, self._camera)
        if not all(map(math.isfinite, (latitude, longitude, course, length, width))):
            return None
        age = nanoseconds_of(all_positions.stamp) - nanoseconds_of(all_positions.own_stamps[row])
        return {
            'lat': round(latitude, 7),
            'lon': round(longitude, 7),
            'course': round(course, 1) % (180.0 if is_ambiguous else 360.0),
            'course_ambiguous': is_ambiguous,
            'length_m': round(length, 1),
            'width_m': round(width, 1),
            'sigma_m': ellipse,
            'look_deg': look,
            'pose_age': round(abs(age) * 1e-9, 3),
        }


def _course(axes: FloatArray, attitude: FloatArray, covariance: FloatArray) -> tuple[float, bool]:
    """Give the course of a ship, degrees, NaN if it has none; and whether it may be opposite."""
    norm = math.hypot(*attitude.tolist())
    east, north, _ = axes @ matrix_of(attitude / norm)[:, 0]
    variance = axes[2] @ covariance[3:, 3:] @ axes[2]
    is_ambiguous = bool(variance > _EITHER_WAY / 2)
    return math.degrees(math.atan2(east, north)) % (180.0 if is_ambiguous else 360.0), is_ambiguous


def _ellipse(axes: FloatArray, covariance: FloatArray) -> list[float] | None:
    """Give the error ellipse of a place; None if it is not known."""
    plane = axes[:2] @ covariance[:3, :3] @ axes[:2].T
    major, minor, azimuth = ellipses_of(plane[None])[0].tolist()
    if not math.isfinite(major + minor + azimuth) or not major:
        return None
    return [round(major, 2), round(minor, 2), round(azimuth, 1)]


def _look(up: FloatArray, point: FloatArray, camera: FloatArray | None) -> float | None:
    """Measure the angle between the vertical and the line to the camera, degrees."""
    if camera is None:
        return None
    sight = camera - point
    angle = math.degrees(np.arccos(np.clip(up @ sight / math.hypot(*sight.tolist()), -1.0, 1.0)))
    return round(angle, 2) if math.isfinite(angle) else None
