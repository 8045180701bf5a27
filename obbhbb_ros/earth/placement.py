# SPDX-License-Identifier: Apache-2.0
"""Oriented boxes of an image to ships on Earth: place, length, width and course."""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.earth.ellipsoid import east_north_up
from obbhbb_ros.earth.ellipsoid import first_hits
from obbhbb_ros.earth.ellipsoid import is_above
from obbhbb_ros.earth.ellipsoid import to_geodetic
from obbhbb_ros.earth.pinhole import Pinhole
from obbhbb_ros.earth.pose import CameraPose
from obbhbb_ros.earth.pose_sweep import PoseSweep
from obbhbb_ros.earth.quaternions import enu_quaternion
from obbhbb_ros.earth.quaternions import product
from obbhbb_ros.earth.quaternions import turn_about_up
from obbhbb_ros.earth.uncertainty import covariances
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes

__all__ = ['Placement', 'Unplaced', 'ellipses_of', 'place']


class Unplaced(IntEnum):
    """
    Why a ship has no place.

    Attributes
    ----------
    NONE
        It has one.
    NO_BOX
        The box has a defect.
    NO_RAY
        The distortion of the lens has no inverse at one of its sides.
    BELOW_SURFACE
        The camera lies below the surface.
    ABOVE_HORIZON
        A part of the ship is past the horizon, or the camera looks up.
    LOW
        The camera stands lower above the ship's horizon than `min_elevation`.
    NO_POSE
        The camera or its pose is not known.
    """

    NONE = 0
    NO_BOX = 1
    NO_RAY = 2
    BELOW_SURFACE = 3
    ABOVE_HORIZON = 4
    LOW = 5
    NO_POSE = 6


@dataclass(frozen=True, eq=False)
class Placement:
    """
    Where N ships are, NaN where one cannot be placed.

    Attributes
    ----------
    points : ndarray, shape (N, 3)
        Their middles, ECEF, metres.
    latitude, longitude : ndarray, shape (N,)
        Degrees.
    length, width : ndarray, shape (N,)
        Metres; the width is measured square to the length.
    course : ndarray, shape (N,)
        Degrees from north, clockwise: of the bow, in [0, 360); where the bow is not known, of one
        of the two ends, in [0, 180).
    elevation : ndarray, shape (N,)
        How high the camera stands above the ship's horizon, degrees.
    has_bow : ndarray of bool, shape (N,)
        Whether it is known which end is the bow.
    covariance : ndarray, shape (N, 4, 4), or None
        Of east (m), north (m), length (m) and course (rad); None where the pose has none, NaN where
        it is so large that a part of it misses the Earth.
    unplaced : ndarray of uint8, shape (N,)
        An `Unplaced` for each ship.
    """

    points: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    length: FloatArray
    width: FloatArray
    course: FloatArray
    elevation: FloatArray
    has_bow: NDArray[np.bool_]
    covariance: FloatArray | None
    unplaced: NDArray[np.uint8]

    def __getitem__(self, rows: NDArray[np.intp]) -> Placement:
        """Select ships by their rows."""
        arrays = {name: array for name, array in vars(self).items() if array is not None}
        return replace(self, **{name: array[rows] for name, array in arrays.items()})

    @property
    def attitudes(self) -> FloatArray:
        """Quaternions, (N, 4), to ECEF from ships: x along the course, z up."""
        yaw = np.radians(90.0 - self.course)
        return product(enu_quaternion(self.latitude, self.longitude), turn_about_up(yaw))

    @property
    def ellipses(self) -> FloatArray | None:
        """
        Ellipses of one standard deviation, shape (N, 3); None without a covariance.

        Half the major and half the minor axis in metres, and the azimuth of the major one in
        degrees from north, clockwise, in [0, 180).
        """
        return None if self.covariance is None else ellipses_of(self.covariance[:, :2, :2])

    @classmethod
    def nowhere(cls, count: int) -> Placement:
        """Make ships that have no place, because their camera or its pose is not known."""
        unknown = np.full(count, np.nan)
        return cls(
            np.full((count, 3), np.nan),
            *6 * (unknown,),
            np.zeros(count, np.bool_),
            None,
            np.full(count, np.uint8(Unplaced.NO_POSE)),
        )


def ellipses_of(covariance: FloatArray) -> FloatArray:
    """
    Give the ellipses of one standard deviation of covariances of east and north.

    Parameters
    ----------
    covariance : ndarray, shape (N, 2, 2)
        m².

    Returns
    -------
    ndarray, shape (N, 3)
        Half the major and half the minor axis in metres, and the azimuth of the major one in
        degrees from north, clockwise, in [0, 180).

    Examples
    --------
    >>> ellipses_of(np.array([[[4.0, 0.0], [0.0, 1.0]]])).tolist()
    [[2.0, 1.0, 90.0]]
    """
    east, both, north = (covariance[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    with np.errstate(invalid='ignore'):
        mean, half = 0.5 * (east + north), 0.5 * (east - north)
        apart = np.hypot(half, both)
        axes = np.sqrt(np.maximum([mean + apart, mean - apart], 0.0))
        # Twice the angle from north of the direction with the largest variance.
        azimuth = np.degrees(0.5 * np.arctan2(both, -half)) % 180.0
    return np.stack((*axes, azimuth), axis=-1)


def place(
    boxes: OrientedBoxes,
    camera: Pinhole,
    pose: CameraPose | PoseSweep,
    surface_height: float = 0.0,
    min_elevation: float = 5.0,
) -> Placement:
    """
    Place ships on Earth.

    The ends of a box's long axis are taken as bow and stern, and the middles of its long sides as
    the sides of the ship: all four are traced to the surface. The place is the middle between bow
    and stern on Earth, which in perspective is not that of the box.

    Parameters
    ----------
    boxes : OrientedBoxes
        N boxes, pixels.
    camera : Pinhole
        The camera of the image.
    pose : CameraPose or PoseSweep
        Its pose at the time of the image, or its poses at the times of the lines.
    surface_height : float
        Height of the water above the ellipsoid, metres.
    min_elevation : float
        How high the camera must stand above the horizon of a ship, degrees.

    Examples
    --------
    A camera 500 km above the equator, image up to the north, and a ship of 60 pixels of 1.5 m:

    >>> pose = CameraPose.from_message([6878137, 0, 0], [0.5, 0.5, -0.5, -0.5])
    >>> camera = Pinhole([1e6 / 3, 0, 511.5, 0, 1e6 / 3, 511.5, 0, 0, 1])
    >>> boxes = OrientedBoxes.from_xywhr([[512, 512, 60, 10, -0.5]], bow=True)
    >>> ships = place(boxes, camera, pose)
    >>> float(ships.length[0].round(3)), float(ships.course[0].round(3))
    (90.0, 61.352)
    """
    count = len(boxes)
    long, short = boxes.long_axis.T, boxes.short_axis.T
    # Bow, stern and the two sides.
    offsets = np.stack((long, -long, short, -short), axis=1)
    with np.errstate(all='ignore'):
        pixels = (boxes.center.T[:, None] + offsets).reshape(2, -1)
        rays = pose.turned(camera.rays(pixels.T), pixels[1])
        origins = pose.origins(pixels[1])
        hits = first_hits(origins, rays, surface_height).T.reshape(3, 4, count)
        # Of bow, stern and the two sides, if they differ.
        origins = origins.T.reshape(3, -1, 1 if origins.ndim == 1 else count)
        middle = 0.5 * (hits[:, 0] + hits[:, 1])
        latitude, longitude, _ = to_geodetic(middle.T)
        axes = east_north_up(latitude, longitude).transpose(1, 2, 0)
        ahead, aside = (_on_axes(axes, hits[:, i] - hits[:, i + 1]) for i in (0, 2))
        sight = origins.mean(axis=1) - middle
        up = (axes[2] * sight).sum(axis=0) / np.sqrt((sight * sight).sum(axis=0))
        elevation = np.degrees(np.arcsin(np.clip(up, -1.0, 1.0)))
        unplaced = _reasons(boxes, rays, is_above(pose.position, surface_height))
        unplaced[(unplaced == 0) & ~np.isfinite(hits[0]).all(axis=0)] = Unplaced.ABOVE_HORIZON
        unplaced[(unplaced == 0) & ~(elevation >= min_elevation)] = Unplaced.LOW
        length = np.hypot(*ahead)
        width = np.abs(ahead[0] * aside[1] - ahead[1] * aside[0]) / length
        course = np.degrees(np.arctan2(*ahead)) % np.where(boxes.bow, 360.0, 180.0)
        numbers = np.array((*middle, latitude, longitude, length, width, course, elevation))
        numbers[:, unplaced > 0] = np.nan
        spread = covariances(pose, origins[:, :2], hits[:, :2], axes[:2], surface_height)
        if spread is not None:
            spread[unplaced > 0] = np.nan
    latitude, longitude, length, width, course, elevation = numbers[3:]
    return Placement(
        points=numbers[:3].T,
        latitude=latitude,
        longitude=longitude,
        length=length,
        width=width,
        course=course,
        elevation=elevation,
        has_bow=boxes.bow,
        covariance=spread,
        unplaced=unplaced,
    )


def _on_axes(axes: FloatArray, vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Give the components east and north, (N,) each, of vectors, (3, N), by axes, (3, 3, N)."""
    east, north = (axes[:2] * vectors).sum(axis=1)
    return east, north


def _reasons(boxes: OrientedBoxes, rays: FloatArray, above: bool) -> NDArray[np.uint8]:
    """Give the reasons, (N,), that are known before rays, (4 N, 3), meet the Earth."""
    unplaced = np.zeros(len(boxes), np.uint8)
    if not above:
        unplaced[:] = Unplaced.BELOW_SURFACE
    # Either all components of a ray are finite, or none is.
    unplaced[~np.isfinite(rays[:, 2]).reshape(4, -1).all(axis=0)] = Unplaced.NO_RAY
    unplaced[~boxes.valid] = Unplaced.NO_BOX
    return unplaced
