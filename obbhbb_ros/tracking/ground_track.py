# SPDX-License-Identifier: Apache-2.0
"""Speed and course over ground of a ship, from its places in several images."""

from __future__ import annotations

import math
from typing import NamedTuple

__all__ = ['GroundTrack', 'Velocity']

# A speed is significant from this many standard deviations on.
_SIGNIFICANT = 3.0
# No ship is faster than this, m/s: two ships must share an id.
_MAX_SPEED = 50.0
_MIN_VIEWS = 3
# No place is known better than this, metres.
_MIN_SIGMA = 0.1


class Velocity(NamedTuple):
    """
    A speed over ground, and its course.

    Attributes
    ----------
    speed, speed_sigma : float
        m/s.
    course, course_sigma : float
        Degrees from north, clockwise, in [0, 360).
    """

    speed: float
    speed_sigma: float
    course: float
    course_sigma: float


class GroundTrack:
    """
    A straight line through the places of a ship, by weighted least squares.

    It takes the same memory for any number of places.

    Examples
    --------
    >>> track = GroundTrack()
    >>> for second in range(10):
    ...     track.add(second, 6.0 * second, 8.0 * second, variance=1.0)
    >>> velocity = track.velocity()
    >>> round(velocity.speed, 3), round(velocity.speed_sigma, 3), round(velocity.course, 3)
    (10.0, 0.11, 36.87)
    """

    __slots__ = ('_e', '_ee', '_n', '_nn', '_te', '_tn', '_tt', '_w', '_wt', 'is_weighted', 'views')

    def __init__(self) -> None:
        self.views, self.is_weighted = 0, True
        self._w = self._wt = self._tt = 0.0
        self._e = self._n = self._te = self._tn = self._ee = self._nn = 0.0

    def add(self, time: float, east: float, north: float, variance: float | None) -> None:
        """
        Add a place.

        Parameters
        ----------
        time : float
            Seconds since any moment close to it.
        east, north : float
            Metres from any place close to it.
        variance : float or None
            Of the place in each direction, m²; None if it is not known.
        """
        is_known = variance is not None and variance > 0.0
        self.views += 1
        self.is_weighted &= is_known
        weight = 1.0 / variance if variance is not None and is_known else 1.0
        self._w += weight
        self._wt += weight * time
        self._tt += weight * time * time
        self._e += weight * east
        self._n += weight * north
        self._te += weight * time * east
        self._tn += weight * time * north
        self._ee += weight * east * east
        self._nn += weight * north * north

    def velocity(self) -> Velocity | None:
        """
        Fit speed and course.

        The uncertainty comes from that of the places, or from their distances to the line,
        whichever is larger.

        Returns
        -------
        Velocity or None
            None if there are fewer than three places, if the ship may lie still, or if it would be
            faster than any ship. 1 % of the ships that lie still get a speed: those beyond three
            standard deviations, or more if few places of unknown uncertainty give the deviation.
        """
        if self.views < _MIN_VIEWS:
            return None
        spread = self._w * self._tt - self._wt**2
        if not spread > 1e-9 * self._w * self._tt:
            return None
        east = (self._w * self._te - self._wt * self._e) / spread
        north = (self._w * self._tn - self._wt * self._n) / spread
        variance = max(self._residual(east, north), 1.0 if self.is_weighted else _MIN_SIGMA**2)
        sigma = math.sqrt(variance * self._w / spread)
        speed = math.hypot(east, north)
        limit = _SIGNIFICANT if self.is_weighted else self._limit()
        if not limit * sigma < speed < _MAX_SPEED:
            return None
        course = math.degrees(math.atan2(east, north)) % 360.0
        return Velocity(speed, sigma, course, math.degrees(sigma / speed))

    def _limit(self) -> float:
        """
        Return how many standard deviations are significant if they come from the residuals.

        If the ship lies still, half the square of this number has the F distribution with 2 and n
        degrees of freedom, where n are those of the residuals. It exceeds x with a probability of
        (1 + 2 x / n)^(-n/2). This is set to that of three known standard deviations, exp(-9/2).
        """
        freedom = 2 * self.views - 4
        return math.sqrt(freedom * math.expm1(_SIGNIFICANT**2 / freedom))

    def _residual(self, east: float, north: float) -> float:
        """Return the weighted variance of the places about the line, in one direction."""
        total = 0.0
        for squares, placed, timed, speed in (
            (self._ee, self._e, self._te, east),
            (self._nn, self._n, self._tn, north),
        ):
            start = (placed - speed * self._wt) / self._w
            total += max(squares - start * placed - speed * timed, 0.0)
        # Two directions, two numbers each.
        return total / (2 * self.views - 4)
