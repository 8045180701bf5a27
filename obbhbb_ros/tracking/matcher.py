# SPDX-License-Identifier: Apache-2.0
"""
Numbers for ships, from the boxes of a camera that moves.

For each frame, the matcher moves the known ships on by their own speeds, finds how the image moved,
pairs boxes and ships within gates, and corrects the ships. The gates grow while no frame shows a
ship.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.tracking.assignment import LOOSE
from obbhbb_ros.tracking.assignment import assigned
from obbhbb_ros.tracking.image_motion import ImageMotion
from obbhbb_ros.tracking.known_ships import KnownShips
from obbhbb_ros.tracking.sightings import MAX_PIXELS
from obbhbb_ros.tracking.sightings import Carry
from obbhbb_ros.tracking.sightings import Places
from obbhbb_ros.tracking.sightings import SightedFrame
from obbhbb_ros.tracking.sightings import sightings

MAX_BOXES = 5000
"""Maximum number of boxes to follow in a frame, the longest ones."""

_MIN_LENGTH = 1e-2


class ShipMatcher:
    """
    Gives boxes the numbers of ships.

    Parameters
    ----------
    memory : float
        How long to remember a ship that no frame shows, seconds.

    Examples
    --------
    >>> matcher = ShipMatcher()
    >>> size, length, angle = 1000 + 1000j, np.array([50.0, 30.0]), np.array([0.1, 0.9])
    >>> place = np.array([300 + 400j, 700 + 500j])
    >>> matcher.track(0.0, place, length, angle, size).tolist()
    [0, 1]
    >>> matcher.track(0.1, place + 150j, length, angle, size).tolist()
    [0, 1]
    """

    def __init__(self, memory: float = 30.0) -> None:
        self.memory = memory
        self._ships = KnownShips()
        self._motion = ImageMotion()
        self._time = -math.inf

    @property
    def object_count(self) -> int:
        """How many ships are remembered."""
        return len(self._ships.rows)

    def track(
        self,
        time: float,
        place: Places,
        length: FloatArray,
        angle: FloatArray,
        size: complex,
        carry: Carry | None = None,
    ) -> NDArray[np.int64]:
        """
        Return the numbers of the boxes of the next frame.

        Parameters
        ----------
        time : float
            Stamp of the frame, seconds.
        place : ndarray of complex, shape (N,)
            Middles of the boxes, x + iy, pixels.
        length, angle : ndarray, shape (N,)
            Long sides of the boxes, pixels, and their angles, radians.
        size : complex
            Width and height of the image, pixels.
        carry : callable, optional
            Says, from the pose of the camera, how the image moved since the last call.

        Returns
        -------
        ndarray of int, shape (N,)
            Numbers from 0, the same for boxes of one ship. They do not depend on the order of the
            boxes. -1 for boxes that are not followed: they have no size, are not finite, or there
            are too many.
        """
        numbers = np.full(len(place), -1, np.int64)
        followed = _followed(place, length, angle)
        boxes = sightings(
            time, place[followed], length[followed], angle[followed], self._ships.noise, size
        )
        self._identify(time, SightedFrame(boxes, size, self._ships.noise), carry)
        numbers[followed] = boxes['id']
        return numbers

    def _identify(self, time: float, frame: SightedFrame, carry: Carry | None) -> None:
        """Write the numbers of ships into the boxes of a frame."""
        ships, boxes, step = self._ships, frame.boxes, time - self._time
        self._time = time
        ships.move_on(time, step, self.memory)
        ships.rows = self._motion.follow(ships.rows, frame, step, carry)
        pairs = assigned(ships.rows, boxes, frame.size, 2 * LOOSE)
        boxes['id'][pairs.boxes] = ships.rows['id'][pairs.objects]
        ships.correct(pairs, boxes[pairs.boxes])
        ships.add(boxes)


def _followed(place: Places, length: FloatArray, angle: FloatArray) -> NDArray[np.intp]:
    """Return the rows of the boxes to follow, in an order that depends only on the boxes."""
    with np.errstate(invalid='ignore', over='ignore'):
        usable = (np.abs(place) < MAX_PIXELS) & (length > _MIN_LENGTH) & (length < MAX_PIXELS)
    rows = np.flatnonzero(usable & np.isfinite(angle))
    rows = rows[np.lexsort((angle[rows], place[rows].imag, place[rows].real, -length[rows]))]
    return rows[:MAX_BOXES]
