# SPDX-License-Identifier: Apache-2.0
"""
Boxes of a frame and remembered objects, as rows of one structured array.

Places are complex numbers, x + iy in pixels, and stand for the middle of a ship. A motion of the
image turns and scales by a complex factor, then shifts. If the border cuts a ship, its middle and
its length are not visible: the end that is in the image identifies it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any
from typing import NamedTuple
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.geometry.boxes import FloatArray

Rows = NDArray[np.void]
"""Boxes or objects, one per row, with the fields of `FIELDS`."""
Places = NDArray[np.complex128]
Carry: TypeAlias = Callable[[Places], Places]
"""Takes places in the last image, returns them in this one; NaN where that is not known."""

FIELDS = np.dtype(
    [
        ('id', np.int64),
        ('place', np.complex128),
        ('speed', np.complex128),
        # Variances of place and speed in each direction, and their covariance.
        ('place_var', np.float64),
        ('shared_var', np.float64),
        ('speed_var', np.float64),
        ('length', np.float64),
        ('angle', np.float64),
        ('seen', np.float64),
        ('hits', np.int64),
        ('whole', np.bool_),
        # Unit vector from the middle to the end that is in the image; 0 if both are, or none.
        ('inner', np.complex128),
    ]
)
"""Number, px, px/s, px², px²/s, px²/s², px, rad, s, number, whether, unit vector."""

# Standard deviation of a ship's speed before it is measured, ship lengths per second: for a boat of
# 12 m, 15 m/s is four of them. For a part of a ship it is larger by the second number.
_SPEED = 0.3
_SPEED_OF_PART = 3.0
# An end this close to the border, in ship lengths, may be where the border cuts the ship.
_EDGE = 0.15
# Error of the middle of a ship with neither end in the image, ship lengths.
_NO_END = 0.25


class Motion(NamedTuple):
    """
    How the image moved: places become turn × place + shift.

    Attributes
    ----------
    turn : complex
        Turn and scale.
    shift : complex
        Shift, pixels.
    error : float
        Standard deviation of the resulting places, pixels.
    """

    turn: complex
    shift: complex
    error: float

    def of(self, rows: Rows) -> Rows:
        """Move objects with the image."""
        moved = rows.copy()
        moved['place'] = self.turn * rows['place'] + self.shift
        moved['speed'] *= self.turn
        moved['length'] *= abs(self.turn)
        moved['inner'] *= self.turn / abs(self.turn)
        moved['angle'] += np.angle(self.turn)
        moved['place_var'] += self.error**2
        return moved

    def after(self, first: Motion) -> Motion:
        """Return the motion that does another one first, then this one."""
        return Motion(
            self.turn * first.turn,
            self.turn * first.shift + self.shift,
            math.hypot(self.error, first.error),
        )

    def shifted(self, shift: complex, error: float) -> Motion:
        """Return the motion with a further shift, and its error."""
        return Motion(self.turn, self.shift + shift, error)


def sightings(
    time: float, place: Places, length: FloatArray, angle: FloatArray, noise: float, size: complex
) -> Rows:
    """
    Make rows of the boxes of a frame.

    Parameters
    ----------
    time : float
        Stamp of the frame, seconds.
    place : ndarray of complex, shape (N,)
        Middles, pixels.
    length, angle : ndarray, shape (N,)
        Long sides, pixels, and their angles, radians; which end is the bow does not matter.
    noise : float
        Standard deviation of the places, pixels.
    size : complex
        Width and height of the image, pixels.

    Returns
    -------
    ndarray, shape (N,)
        The rows, with -1 as id.
    """
    rows = np.zeros(len(place), FIELDS)
    rows['id'], rows['hits'], rows['seen'] = -1, 1, time
    rows['place'], rows['length'], rows['angle'] = place, length, angle
    axis = np.exp(1j * angle)
    depths = [depth(place + side * length / 2 * axis, size) for side in (1, -1)]
    cut = [end < _EDGE * length + 2 * noise for end in depths]
    both, any_cut = cut[0] & cut[1], cut[0] | cut[1]
    rows['whole'] = ~any_cut
    rows['inner'] = np.where(any_cut & ~both, np.where(depths[0] > depths[1], 1, -1) * axis, 0)
    rows['place_var'] = noise**2 + np.where(both, _NO_END * length, 0.0) ** 2
    rows['speed_var'] = (_SPEED * length * np.where(any_cut, _SPEED_OF_PART, 1.0)) ** 2
    return rows


def depth(place: Places, size: complex) -> FloatArray:
    """Return the depth of places inside the image; negative outside it."""
    x, y = place.real, place.imag
    deep: FloatArray = np.minimum(np.minimum(x, size.real - x), np.minimum(y, size.imag - y))
    return deep


def are_inside(place: Places, size: complex, margin: float = 0.0) -> NDArray[np.bool_]:
    """Tell which places are in the image, with a margin as a fraction of its sides."""
    x, y = place.real / size.real, place.imag / size.imag
    inside: NDArray[np.bool_] = (x > -margin) & (x < 1 + margin) & (y > -margin) & (y < 1 + margin)
    return inside


def axis_turn(angle: Any) -> Any:
    """
    Return the angle between two axes, -π/2 to π/2, from the difference of their angles.

    Examples
    --------
    >>> round(axis_turn(3.0), 3)
    -0.142
    """
    return (angle + math.pi / 2) % math.pi - math.pi / 2


def middle_of(values: Places) -> complex:
    """Return the median of places, separately for x and y."""
    return complex(np.median(values.real), np.median(values.imag))
