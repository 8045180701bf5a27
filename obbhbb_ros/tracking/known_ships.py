# SPDX-License-Identifier: Apache-2.0
"""The ships that are remembered: a Kalman filter for each, the same in x and y."""

from __future__ import annotations

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.tracking.assignment import Pairs
from obbhbb_ros.tracking.assignment import anchored_variance
from obbhbb_ros.tracking.assignment import anchors
from obbhbb_ros.tracking.sightings import FIELDS
from obbhbb_ros.tracking.sightings import Rows
from obbhbb_ros.tracking.sightings import axis_turn

MAX_OBJECTS = 20_000
"""Maximum number of objects to remember; the ones seen last stay."""

# Change of the speed of a ship within a second, ship lengths per second.
_UNREST = 0.05
# Standard deviation of a place, pixels: before it is measured, and its limits.
_NOISE = 2.0
_NOISES = (1.0, 8.0)
# The median of the modulus of a complex normal number, in standard deviations.
_MEDIAN = 1.18
# A steady ship was seen whole this often; it takes this many steady ships to measure the noise.
_MIN_HITS = 3
_MIN_STEADY = 5
# Weight of a new length or angle.
_BLEND = 0.3


class KnownShips:
    """
    The ships that are remembered.

    Attributes
    ----------
    rows : ndarray
        Their rows.
    noise : float
        Standard deviation of the places of boxes, pixels, as far as it is measured.
    """

    def __init__(self) -> None:
        self.rows: Rows = np.zeros(0, FIELDS)
        self.noise = _NOISE
        self._next = 0

    def add(self, boxes: Rows) -> None:
        """Give the boxes that are no known ship the next numbers, and remember them."""
        new = boxes['id'] < 0
        boxes['id'][new] = self._next + np.arange(new.sum())
        self._next += int(new.sum())
        self.rows = np.concatenate((self.rows, boxes[new]))

    def move_on(self, time: float, step: float, memory: float) -> None:
        """
        Move ships on by their own speeds, and forget those not seen for long.

        Parameters
        ----------
        time : float
            Stamp of the next image, seconds.
        step : float
            Seconds since the last one.
        memory : float
            For how long a ship that is not seen is remembered, seconds.
        """
        objects = self.rows[np.abs(time - self.rows['seen']) <= memory]
        if len(objects) > MAX_OBJECTS:
            objects = objects[np.argsort(objects['seen'], kind='stable')[-MAX_OBJECTS:]]
        self.rows = objects
        if not len(objects):
            return
        # A speed that is not significant counts as 0: it would lead far away in time.
        is_under_way = np.abs(objects['speed']) ** 2 > 9 * objects['speed_var']
        objects['place'] += np.where(is_under_way, objects['speed'] * step, 0.0)
        unrest = (_UNREST * objects['length']) ** 2 * abs(step)
        objects['place_var'] += 2 * step * objects['shared_var'] + step**2 * objects['speed_var']
        objects['place_var'] += unrest * step**2 / 3
        objects['shared_var'] += step * objects['speed_var'] + unrest * step / 2
        objects['speed_var'] += unrest
        # No ship is expected to be off by more than its length.
        spread = np.sqrt(np.maximum(objects['place_var'], 0.0))
        cut = objects['length'] / np.maximum(objects['length'], spread)
        objects['place_var'] *= cut**2
        objects['shared_var'] *= cut

    def correct(self, pairs: Pairs, boxes: Rows) -> None:
        """Correct ships by the boxes that they are paired with."""
        known, off = self.rows[pairs.objects], pairs.off
        inner = anchors(known, boxes)
        total = anchored_variance(known, boxes, inner)
        self._measure_noise(known, boxes, np.abs(off) / np.sqrt(total))
        gain = known['place_var'] / total
        known['place'] += gain * off
        known['speed'] += known['shared_var'] / total * off
        known['speed_var'] -= known['shared_var'] ** 2 / total
        known['shared_var'] *= 1 - gain
        known['place_var'] *= 1 - gain
        length = _new_lengths(known, boxes)
        # The visible end stays where it is.
        known['place'] -= inner * (length - known['length']) / 2
        known['length'] = length
        known['whole'] |= boxes['whole']
        known['inner'] = np.where(known['whole'], 0, boxes['inner'])
        known['angle'] += _BLEND * axis_turn(boxes['angle'] - known['angle'])
        known['hits'] += 1
        known['seen'] = boxes['seen']
        self.rows[pairs.objects] = known

    def _measure_noise(self, known: Rows, boxes: Rows, deviations: FloatArray) -> None:
        """Measure the error of places with steady ships."""
        steady = (known['hits'] >= _MIN_HITS) & boxes['whole']
        if steady.sum() >= _MIN_STEADY:
            measured = self.noise * float(np.median(deviations[steady])) / _MEDIAN
            low, high = _NOISES
            self.noise = min(max(0.9 * self.noise + 0.1 * measured, low), high)


def _new_lengths(known: Rows, boxes: Rows) -> FloatArray:
    """Return the lengths of objects, corrected by boxes that show the whole ship."""
    of_part = np.where(
        known['whole'], known['length'], np.maximum(known['length'], boxes['length'])
    )
    blend = np.where(known['whole'], _BLEND, 1.0)
    of_whole = known['length'] * (boxes['length'] / known['length']) ** blend
    lengths: FloatArray = np.where(boxes['whole'], of_whole, of_part)
    return lengths
