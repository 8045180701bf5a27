# SPDX-License-Identifier: Apache-2.0
"""
How the image moved since the last frame, and where what it showed is now.

A frame may lie ten ship lengths beside the last one. The motion is guessed, by the pose, the drift
of the camera, or votes of the boxes, until most boxes meet an object; those pairs then measure it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.tracking.assignment import GATE
from obbhbb_ros.tracking.assignment import Pairs
from obbhbb_ros.tracking.assignment import alike
from obbhbb_ros.tracking.assignment import assigned
from obbhbb_ros.tracking.shift import fitted
from obbhbb_ros.tracking.shift import voted_shift
from obbhbb_ros.tracking.shift import voted_turn
from obbhbb_ros.tracking.sightings import MAX_PIXELS
from obbhbb_ros.tracking.sightings import Carry
from obbhbb_ros.tracking.sightings import Motion
from obbhbb_ros.tracking.sightings import Places
from obbhbb_ros.tracking.sightings import Rows
from obbhbb_ros.tracking.sightings import SightedFrame
from obbhbb_ros.tracking.sightings import are_inside
from obbhbb_ros.tracking.sightings import middle_of

# Only the longest boxes vote, which bounds the number of pairs.
_VOTERS = 200
_LIKE_SHARE = 0.1
# The matcher tries other motions until this share of the boxes meets an object.
_EXPLAINED = 0.6
# The camera's motion: how many seconds it is remembered, and how much it changes in a frame.
_DRIFT_MEMORY = 3.0
_DRIFT_ERROR = 0.1
_MIN_COMMON = 3
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


class ImageMotion:
    """Finds how image after image moved, and remembers how the camera drifts."""

    def __init__(self) -> None:
        # Error of the pose from image to image, pixels.
        self._pose_error = _POSE_ERROR
        # Motion of the middle of the image, px/s.
        self._drift: complex | None = None

    def follow(self, objects: Rows, frame: SightedFrame, step: float, carry: Carry | None) -> Rows:
        """
        Move objects to where they must be in the next image.

        Parameters
        ----------
        objects : ndarray
            Rows of objects, where they must be if the image did not move.
        frame : SightedFrame
            The boxes of the next image.
        step : float
            Seconds since the last image.
        carry : callable, optional
            Tells by the pose of the camera how the image moved.

        Returns
        -------
        ndarray
            The rows, in the same order.
        """
        if not len(objects) or abs(step) > _DRIFT_MEMORY:
            self._drift = None
        prior, by_pose = self._prior(step), None
        if carry is not None and (by_pose := motion_of(carry, frame.size / 2)) is not None:
            objects = _carried(objects, carry, by_pose)
            prior = Motion(1.0, 0.0, self._pose_error)
        motion, is_measured = self._motion(objects, frame, prior)
        objects = motion.of(objects)
        if is_measured:
            self._learn(motion, by_pose, step, frame.size / 2)
        return objects

    def _learn(self, motion: Motion, by_pose: Motion | None, step: float, middle: complex) -> None:
        """Remember how fast the image moves, and by how much the pose is off."""
        if by_pose is not None:
            # The largest recent one, so that a lucky image does not narrow the gates.
            self._pose_error = max(abs(motion.shift), 0.9 * self._pose_error)
            motion = motion.after(by_pose)
        if 0.0 < abs(step) < math.inf:
            self._drift = (motion.turn * middle + motion.shift - middle) / step

    def _prior(self, step: float) -> Motion:
        """Guess that the image moves as before."""
        shift = (self._drift or 0.0) * (step if abs(step) < math.inf else 0.0)
        return Motion(1.0, shift, _DRIFT_ERROR * abs(shift))

    def _motion(self, objects: Rows, frame: SightedFrame, prior: Motion) -> tuple[Motion, bool]:
        """Find out how the image moved, and whether that was measured."""
        if not len(objects) or not len(frame.boxes):
            return prior, False
        boxes, noise = frame.boxes, frame.noise
        guess, pairs = self._best_guess(objects, frame, prior)
        # Ships at the border say little about it.
        steady = boxes['whole'][pairs.boxes] & objects['whole'][pairs.objects]
        rows = Pairs(*(column[steady] for column in pairs)) if steady.any() else pairs
        if not len(rows.off):
            return guess.motion, False
        has_turned = guess.by == 'turn'
        tolerance = (GATE + (10.0 if has_turned else 0.0)) * noise
        same = np.abs(rows.off - middle_of(rows.off)) < tolerance
        if same.sum() < max(_MIN_COMMON, 0.5 * len(same)):
            return guess.motion, guess.by != 'prior' or self._drift is None
        turn, shift = fitted(
            objects['place'][rows.objects[same]],
            boxes['place'][rows.boxes[same]],
            guess.motion.turn,
            has_turned,
        )
        return Motion(turn, shift, noise / math.sqrt(same.sum())), True

    def _best_guess(
        self, objects: Rows, frame: SightedFrame, prior: Motion
    ) -> tuple[_Guess, Pairs]:
        """Return the guess by which most boxes meet an object, or the first by which many do."""
        boxes, size = frame.boxes, frame.size
        best, best_pairs, most = _Guess('prior', prior), None, -math.inf
        is_last = _are_last(objects)
        for guess in self._guesses(objects, frame, prior):
            moved = guess.motion.of(objects)
            pairs = assigned(moved, boxes, size)
            inside = are_inside(moved['place'], size)
            # Some meet by chance: wide gates do not make a guess better.
            gates = math.pi * GATE**2 * (moved['place_var'][inside] + frame.noise**2)
            chance = _LIKE_SHARE * len(boxes) / frame.area * gates.sum()
            met = len(pairs.off) - chance
            if met > most + (most > 0):
                best, best_pairs, most = guess, pairs, met
            if most >= _EXPLAINED * min(len(boxes), (inside & is_last).sum()) > 0:
                break
        return best, best_pairs or assigned(prior.of(objects), boxes, size)

    def _guesses(self, objects: Rows, frame: SightedFrame, prior: Motion) -> Iterator[_Guess]:
        """Guess how the image moved: as before, by vote, with a turn, from all objects."""
        boxes, noise, area = frame.boxes, frame.noise, frame.area
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


def _are_last(objects: Rows) -> NDArray[np.bool_]:
    """Tell which objects were in the last frame that had any."""
    last: NDArray[np.bool_] = objects['seen'] == objects['seen'].max()
    return last


def _longest(rows: Rows, count: int) -> Rows:
    """Return the longest rows, the longest first."""
    return rows[np.argsort(-rows['length'], kind='stable')[:count]]
