# SPDX-License-Identifier: Apache-2.0
"""
Numbers for ships, from the boxes of a camera that moves.

The image may move by ten ship lengths from one frame to the next. So the matcher first guesses how
it moved, until most boxes meet an object. Then it pairs boxes and objects within gates, which grow
while no frame shows the object.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.tracking.assignment import GATE
from obbhbb_ros.tracking.assignment import LOOSE
from obbhbb_ros.tracking.assignment import Pairs
from obbhbb_ros.tracking.assignment import alike
from obbhbb_ros.tracking.assignment import anchored_variance
from obbhbb_ros.tracking.assignment import anchors
from obbhbb_ros.tracking.assignment import assigned
from obbhbb_ros.tracking.shift import fitted
from obbhbb_ros.tracking.shift import voted_shift
from obbhbb_ros.tracking.shift import voted_turn
from obbhbb_ros.tracking.sightings import FIELDS
from obbhbb_ros.tracking.sightings import Carry
from obbhbb_ros.tracking.sightings import Motion
from obbhbb_ros.tracking.sightings import Places
from obbhbb_ros.tracking.sightings import Rows
from obbhbb_ros.tracking.sightings import are_inside
from obbhbb_ros.tracking.sightings import axis_turn
from obbhbb_ros.tracking.sightings import middle_of
from obbhbb_ros.tracking.sightings import sightings

MAX_OBJECTS = 20_000
"""Maximum number of objects to remember; the ones seen last stay."""
MAX_BOXES = 5000
"""Maximum number of boxes to follow in a frame, the longest ones."""
MAX_PIXELS = 1e7
"""The matcher does not follow boxes further out, or longer, than this."""

_MIN_LENGTH = 1e-2
# Change of the speed of a ship within a second, ship lengths per second.
_UNREST = 0.05
# Standard deviation of a place, pixels: before it is measured, and its limits.
_NOISE = 2.0
_NOISES = (1.0, 8.0)
# The median of the modulus of a complex normal number, in standard deviations.
_MEDIAN = 1.18
# Only the longest boxes vote, which bounds the number of pairs.
_VOTERS = 200
_LIKE_SHARE = 0.1
# The matcher tries other motions until this share of the boxes meets an object.
_EXPLAINED = 0.6
# The camera's motion: how many seconds it is remembered, and how much it changes in a frame.
_DRIFT_MEMORY = 3.0
_DRIFT_ERROR = 0.1
_MIN_COMMON = 3
# A steady ship was seen whole this often; it takes this many steady ships to measure the noise.
_MIN_HITS = 3
_MIN_STEADY = 5
# Weight of a new length or angle.
_BLEND = 0.3
# Error of the pose from image to image before it is measured, pixels.
_POSE_ERROR = 20.0
# The scale of the next image does not change by more than this factor.
_MAX_ZOOM = 1e3
# Distance over which turn and scale of the image are measured, pixels.
_ARM = 100.0


class _Guess(NamedTuple):
    """A guess how the image moved; `by` names the method."""

    by: str
    motion: Motion


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
        self._objects: Rows = np.zeros(0, FIELDS)
        self._next, self._time, self._noise = 0, -math.inf, _NOISE
        # Error of the pose from image to image, pixels.
        self._pose_error = _POSE_ERROR
        # Motion of the middle of the image, px/s.
        self._drift: complex | None = None

    @property
    def object_count(self) -> int:
        """How many ships are remembered."""
        return len(self._objects)

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
        numbers[followed] = self._track(
            time, place[followed], length[followed], angle[followed], size, carry
        )
        return numbers

    def _track(
        self,
        time: float,
        place: Places,
        length: FloatArray,
        angle: FloatArray,
        size: complex,
        carry: Carry | None,
    ) -> NDArray[np.int64]:
        """Return the numbers of boxes that are followed."""
        step = time - self._time
        boxes = sightings(time, place, length, angle, self._noise, size)
        objects = self._predicted(time)
        prior, carried = self._prior(step), None
        if carry is not None and (carried := motion_of(carry, size / 2)) is not None:
            objects = _carried(objects, carry, carried)
            prior = Motion(1.0, 0.0, self._pose_error)
        motion, is_measured = self._motion(objects, boxes, prior, size)
        objects = motion.of(objects)
        if carried is not None:
            if is_measured:
                # The largest recent one, so that a lucky image does not narrow the gates.
                self._pose_error = max(abs(motion.shift), 0.9 * self._pose_error)
            motion = motion.after(carried)
        if is_measured and 0.0 < abs(step) < math.inf:
            middle = size / 2
            self._drift = (motion.turn * middle + motion.shift - middle) / step
        pairs = assigned(objects, boxes, size, 2 * LOOSE)
        boxes['id'][pairs.boxes] = objects['id'][pairs.objects]
        self._update(objects, pairs, boxes[pairs.boxes])
        new = boxes['id'] < 0
        boxes['id'][new] = self._next + np.arange(new.sum())
        self._next += int(new.sum())
        self._objects, self._time = np.concatenate((objects, boxes[new])), time
        numbers: NDArray[np.int64] = boxes['id']
        return numbers

    def _predicted(self, time: float) -> Rows:
        """Move the objects on by their own speeds, and forget old ones."""
        objects = self._objects[np.abs(time - self._objects['seen']) <= self.memory]
        if len(objects) > MAX_OBJECTS:
            objects = objects[np.argsort(objects['seen'], kind='stable')[-MAX_OBJECTS:]]
        if not len(objects):
            self._drift = None
            return objects
        step = time - self._time
        if abs(step) > _DRIFT_MEMORY:
            self._drift = None
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
        return objects

    def _prior(self, step: float) -> Motion:
        """Guess that the image moves as before."""
        shift = (self._drift or 0.0) * (step if abs(step) < math.inf else 0.0)
        return Motion(1.0, shift, _DRIFT_ERROR * abs(shift))

    def _motion(
        self, objects: Rows, boxes: Rows, prior: Motion, size: complex
    ) -> tuple[Motion, bool]:
        """Find out how the image moved, and whether that was measured."""
        if not len(objects) or not len(boxes):
            return prior, False
        guess, pairs = self._best_guess(objects, boxes, prior, size)
        # Ships at the border say little about it.
        steady = boxes['whole'][pairs.boxes] & objects['whole'][pairs.objects]
        rows = Pairs(*(column[steady] for column in pairs)) if steady.any() else pairs
        if not len(rows.off):
            return guess.motion, False
        has_turned = guess.by == 'turn'
        tolerance = (GATE + (10.0 if has_turned else 0.0)) * self._noise
        same = np.abs(rows.off - middle_of(rows.off)) < tolerance
        if same.sum() < max(_MIN_COMMON, 0.5 * len(same)):
            return guess.motion, guess.by != 'prior' or self._drift is None
        turn, shift = fitted(
            objects['place'][rows.objects[same]],
            boxes['place'][rows.boxes[same]],
            guess.motion.turn,
            has_turned,
        )
        return Motion(turn, shift, self._noise / math.sqrt(same.sum())), True

    def _best_guess(
        self, objects: Rows, boxes: Rows, prior: Motion, size: complex
    ) -> tuple[_Guess, Pairs]:
        """Return the guess by which most boxes meet an object, or the first by which many do."""
        best, best_pairs, most = _Guess('prior', prior), None, -math.inf
        is_last = _are_last(objects)
        for guess in self._guesses(objects, boxes, prior, size):
            moved = guess.motion.of(objects)
            pairs = assigned(moved, boxes, size)
            inside = are_inside(moved['place'], size)
            # Some meet by chance: wide gates do not make a guess better.
            gates = math.pi * GATE**2 * (moved['place_var'][inside] + self._noise**2)
            chance = _LIKE_SHARE * len(boxes) / (size.real * size.imag) * gates.sum()
            met = len(pairs.off) - chance
            if met > most + (most > 0):
                best, best_pairs, most = guess, pairs, met
            if most >= _EXPLAINED * min(len(boxes), (inside & is_last).sum()) > 0:
                break
        return best, best_pairs or assigned(prior.of(objects), boxes, size)

    def _guesses(
        self, objects: Rows, boxes: Rows, prior: Motion, size: complex
    ) -> Iterator[_Guess]:
        """Guess how the image moved: as before, by vote, with a turn, from all objects."""
        area, noise = size.real * size.imag, self._noise
        is_steady = prior.error <= 3 * noise
        if is_steady:
            yield _Guess('prior', prior)
        calm = prior._replace(error=0.0)
        new = _longest(boxes, _VOTERS)
        old = calm.of(_longest(objects[_are_last(objects)], _VOTERS))
        if not is_steady and (shift := voted_shift(old, new, noise, area, prior.error)) is not None:
            yield _Guess('near', prior.shifted(shift, noise))
        i, j = alike(old, new)
        if len(i) == 1:
            shift = new['place'][j[0]] - old['place'][i[0]]
            if self._drift is None or abs(shift) < GATE * prior.error:
                yield _Guess('lone', prior.shifted(shift, noise))
        if (shift := voted_shift(old, new, noise, area)) is not None:
            yield _Guess('shift', prior.shifted(shift, noise))
        if (turn := voted_turn(old, new, noise)) is not None:
            shift = voted_shift(Motion(turn, 0.0, 0.0).of(old), new, noise, area)
            if shift is not None:
                motion = Motion(turn * prior.turn, turn * prior.shift + shift, 2 * noise)
                yield _Guess('turn', motion)
        few = new[: _VOTERS**2 // len(objects) + 3]
        if (shift := voted_shift(calm.of(objects), few, noise, area)) is not None:
            yield _Guess('memory', prior.shifted(shift, 2 * noise))
        if not is_steady:
            yield _Guess('prior', prior)

    def _update(self, objects: Rows, pairs: Pairs, boxes: Rows) -> None:
        """Correct objects by their boxes: a Kalman filter for each, the same in x and y."""
        known, off = objects[pairs.objects], pairs.off
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
        objects[pairs.objects] = known

    def _measure_noise(self, known: Rows, boxes: Rows, deviations: FloatArray) -> None:
        """Measure the error of places with steady ships."""
        steady = (known['hits'] >= _MIN_HITS) & boxes['whole']
        if steady.sum() >= _MIN_STEADY:
            measured = self._noise * float(np.median(deviations[steady])) / _MEDIAN
            low, high = _NOISES
            self._noise = min(max(0.9 * self._noise + 0.1 * measured, low), high)


def motion_of(carry: Carry, middle: complex) -> Motion | None:
    """Return how the image moves about its middle; None if that is not known."""
    start, end = carry(np.array([middle, middle + _ARM], np.complex128)).tolist()
    turn = (end - start) / _ARM
    # NaN compares as false.
    if not abs(start) < MAX_PIXELS or not 1.0 / _MAX_ZOOM < abs(turn) < _MAX_ZOOM:
        return None
    return Motion(turn, start - turn * middle, 0.0)


def _carried(objects: Rows, carry: Carry, about_middle: Motion) -> Rows:
    """Move objects as the pose says; where that is unknown, like the middle of the image."""
    moved = about_middle.of(objects)
    middles: Places = objects['place']
    half = np.asarray(objects['length'] / 2 * np.exp(1j * objects['angle']), np.complex128)
    place = carry(middles)
    turn = (carry(middles + half) - place) / half
    with np.errstate(invalid='ignore', over='ignore'):
        zoom = np.abs(turn)
        known = (np.abs(place) < MAX_PIXELS) & (zoom > 1.0 / _MAX_ZOOM) & (zoom < _MAX_ZOOM)
    ships, turn = objects[known], turn[known]
    for name in ('speed', 'inner'):
        ships[name] *= turn
    ships['inner'] /= np.abs(turn)
    ships['place'] = place[known]
    ships['length'] *= np.abs(turn)
    ships['angle'] += np.angle(turn)
    moved[known] = ships
    return moved


def _followed(place: Places, length: FloatArray, angle: FloatArray) -> NDArray[np.intp]:
    """Return the rows of the boxes to follow, in an order that depends only on the boxes."""
    with np.errstate(invalid='ignore', over='ignore'):
        usable = (np.abs(place) < MAX_PIXELS) & (length > _MIN_LENGTH) & (length < MAX_PIXELS)
    rows = np.flatnonzero(usable & np.isfinite(angle))
    rows = rows[np.lexsort((angle[rows], place[rows].imag, place[rows].real, -length[rows]))]
    return rows[:MAX_BOXES]


def _are_last(objects: Rows) -> NDArray[np.bool_]:
    """Tell which objects were in the last frame that had any."""
    last: NDArray[np.bool_] = objects['seen'] == objects['seen'].max()
    return last


def _longest(rows: Rows, count: int) -> Rows:
    """Return the longest rows, the longest first."""
    return rows[np.argsort(-rows['length'], kind='stable')[:count]]


def _new_lengths(known: Rows, boxes: Rows) -> FloatArray:
    """Return the lengths of objects, corrected by boxes that show the whole ship."""
    of_part = np.where(
        known['whole'], known['length'], np.maximum(known['length'], boxes['length'])
    )
    blend = np.where(known['whole'], _BLEND, 1.0)
    of_whole = known['length'] * (boxes['length'] / known['length']) ** blend
    lengths: FloatArray = np.where(boxes['whole'], of_whole, of_part)
    return lengths
