# SPDX-License-Identifier: Apache-2.0
"""How the image moved between two frames, by a vote of boxes that are alike in both."""

from __future__ import annotations

import math

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.tracking.assignment import GATE
from obbhbb_ros.tracking.assignment import Indices
from obbhbb_ros.tracking.assignment import alike
from obbhbb_ros.tracking.assignment import one_to_one
from obbhbb_ros.tracking.sightings import Places
from obbhbb_ros.tracking.sightings import Rows
from obbhbb_ros.tracking.sightings import axis_turn
from obbhbb_ros.tracking.sightings import middle_of

# Side of the cells that count votes for a shift, standard deviations of a place.
_CELL = 6.0
_STAGGERED = (0.0, 0.5 + 0.5j, 0.5, 0.5j)
# With more votes than this, one grid of cells is enough.
_MANY = 3000
# A vote is believed if the probability that chance alone gives as many votes is below this.
_CHANCE = 1e-3
# Pairs of the longest boxes vote for turn and scale; this many votes are believed.
_PAIRED = 16
_MIN_VOTES = 4
_MAX_TURN = 0.35
_MAX_SCALE = 0.2
# Side of the cells that count those votes; radians, and logarithm of the scale.
_TURN_CELL = 0.015
# Two boxes this close, in standard deviations of a place, say nothing about the turn.
_NEAR = 20.0
_LENGTH_OF_PAIR = 0.4
_ANGLE_OF_PAIR = 0.21
# This many boxes measure a turn, and it must fit better than no turn by this factor.
_MIN_TURN = 6
_BETTER = 0.7


def voted_shift(
    old: Rows, new: Rows, noise: float, area: float, reach: float = math.inf
) -> complex | None:
    """
    Return the shift on which most pairs of like boxes agree; None if chance may give as many.

    Parameters
    ----------
    old, new : ndarray
        Rows of objects and boxes.
    noise : float
        Standard deviation of a place, pixels.
    area : float
        Pixels of the image.
    reach : float
        Standard deviation of the shift as far as it is known, pixels.
    """
    i, j = alike(old, new)
    close = np.abs(new['place'][j] - old['place'][i]) < GATE * reach
    i, j = i[close], j[close]
    if len(i) < 2:
        return None
    shift, cell = new['place'][j] - old['place'][i], _CELL * noise
    near = np.flatnonzero(np.abs(shift - middle_of(_fullest(shift, cell))) < cell)
    middle = middle_of(shift[near])
    votes = len(one_to_one(i[near], j[near], np.abs(shift[near] - middle)))
    # The number of other pairs that are near a pair by chance. Any of the pairs may have the votes.
    rate = len(shift) * cell**2 / min(4 * area / math.pi, (GATE * reach) ** 2)
    chance = math.log(len(shift)) + (votes - 1) * math.log(rate) - math.lgamma(votes)
    return middle if votes > 1 and chance < math.log(_CHANCE) else None


def _fullest(shift: Places, cell: float) -> Places:
    """Return the votes in the fullest cell of all grids."""
    best = shift[:0]
    for offset in _STAGGERED[: 4 if len(shift) < _MANY else 1]:
        corner = shift / cell + offset
        votes = shift[_in_fullest(np.floor(corner.real) * 2.0**20 + np.floor(corner.imag))]
        best = votes if len(votes) > len(best) else best
    return best


def _in_fullest(keys: FloatArray) -> Indices:
    """Return where the commonest key stands."""
    _, group, count = np.unique(keys, return_inverse=True, return_counts=True)
    return np.flatnonzero(group == count.argmax())


def voted_turn(old: Rows, new: Rows, noise: float) -> complex | None:
    """
    Return turn and scale on which most pairs of boxes agree; None if too few do.

    The two boxes of a pair are far apart. Their lengths, and their angles to the line between them,
    are the same in both frames.

    Parameters
    ----------
    old, new : ndarray
        Rows of objects and boxes, the longest first.
    noise : float
        Standard deviation of a place, pixels.
    """
    old, new = old[:_PAIRED], new[:_PAIRED]
    a, b = np.nonzero(~np.eye(len(old), dtype=bool))
    c, d = np.nonzero(~np.eye(len(new), dtype=bool))
    before, after = old['place'][b] - old['place'][a], new['place'][d] - new['place'][c]
    far = np.abs(before) > _NEAR * noise
    a, b, before = a[far], b[far], before[far]
    ratio = after[None] / before[:, None]
    turn, scale = np.angle(ratio), np.log(np.abs(ratio) + 1e-9)
    good = (np.abs(scale) < _MAX_SCALE) & (np.abs(turn) < _MAX_TURN)
    for x, y in ((a, c), (b, d)):
        longer = np.log(new['length'][y][None] / old['length'][x][:, None])
        turned = axis_turn(new['angle'][y][None] - old['angle'][x][:, None] - turn)
        good &= (np.abs(longer) < _LENGTH_OF_PAIR) & (np.abs(turned) < _ANGLE_OF_PAIR)
    votes = ratio[good]
    if len(votes) < _MIN_VOTES:
        return None
    cells = np.round(scale[good] / _TURN_CELL) * 2.0**20 + np.round(turn[good] / _TURN_CELL)
    near = votes[np.abs(votes - middle_of(votes[_in_fullest(cells)])) < 4 / 3 * _TURN_CELL]
    return middle_of(near) if len(near) >= _MIN_VOTES else None


def fitted(
    start: Places, place: Places, turn: complex, has_turned: bool
) -> tuple[complex, complex]:
    """
    Fit a motion to places before and after it by least squares.

    Parameters
    ----------
    start, place : ndarray of complex, shape (N,)
        Places of the same ships, pixels.
    turn : complex
        Turn and scale as far as they are known.
    has_turned : bool
        Whether to fit them; if not, they are fitted only where that is clearly better.

    Returns
    -------
    turn, shift : complex
        The motion.
    """
    origin, target = complex(start.mean()), complex(place.mean())
    before, after = start - origin, place - target
    length = np.vdot(before, before).real
    if len(start) >= (3 if has_turned else _MIN_TURN) and length > 0.0:
        other = complex(np.vdot(before, after) / length)
        scale = abs(other / turn)
        if not math.exp(-_MAX_SCALE) < scale < math.exp(_MAX_SCALE):
            # Boxes on one spot, for example.
            return turn, target - turn * origin
        if has_turned or np.std(after - other * before) < _BETTER * np.std(after - turn * before):
            turn = other
    return turn, target - turn * origin
