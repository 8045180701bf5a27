# SPDX-License-Identifier: Apache-2.0
"""What detectors and cameras hardly mean: it is used as it is, and reported."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.geometry.input_frame import InputFrame
from obbhbb_ros.pipeline.outcome import Finding
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.stamp import stamp_text

MAX_ANGLE = 6.3
"""A full turn, rounded up: angles beyond it are hardly radians."""

# Scores are often of single precision, and sums of such.
_MAX_SCORE = 1.0 + 1e-6
_MIN_SCORE = -1e-6
_OUTSIDE_WINDOW = 20


class Doubt(NamedTuple):
    """
    Something that a detector hardly means.

    Attributes
    ----------
    key : str
        Its counter in the diagnostics.
    rows : ndarray of int, shape (K,)
        Which detections.
    what : str
        What they have.
    cause : str
        The likely cause, and what to do.
    """

    key: str
    rows: NDArray[np.intp]
    what: str
    cause: str


def doubtful_angles(theta: NDArray[np.float64]) -> Iterator[Doubt]:
    """
    Find angles beyond a full turn.

    Parameters
    ----------
    theta : ndarray, shape (N,)
        Angles that are meant to be radians. Infinite ones, as NaN, are other trouble.
    """
    size = np.abs(theta)
    if np.count_nonzero(size > MAX_ANGLE):
        (rows,) = np.nonzero((size > MAX_ANGLE) & np.isfinite(size))
        if rows.size:
            yield Doubt(
                'angles_doubtful.beyond_turn',
                rows,
                f'an angle beyond {MAX_ANGLE} rad',
                'degrees? Then set angle_unit: deg',
            )


def doubtful_scores(scores: NDArray[np.float64]) -> Iterator[Doubt]:
    """
    Find scores that are not from 0 to 1.

    Parameters
    ----------
    scores : ndarray, shape (N,)
        Scores; NaN where there is none, which is no doubt.
    """
    above, below = scores > _MAX_SCORE, scores < _MIN_SCORE
    if not np.count_nonzero(above) and not np.count_nonzero(below):
        return
    infinite = np.isinf(scores)
    for key, mask, what, cause in (
        (
            'above_one',
            above & ~infinite,
            'a score above 1',
            'percent? crop.min_score and outbox.levels are compared with scores as they are',
        ),
        (
            'negative',
            below & ~infinite,
            'a negative score',
            'logits? outbox.levels are compared with scores as they are',
        ),
        ('infinite', infinite, 'an infinite score', 'in the spool its value is 0'),
    ):
        (rows,) = np.nonzero(mask)
        if rows.size:
            yield Doubt(f'scores_doubtful.{key}', rows, what, cause)


def finding_of(doubt: Doubt, values: NDArray[np.float64], stamp: Stamp) -> Finding:
    """
    Count the detections that are doubtful, and say which and why.

    Parameters
    ----------
    doubt : Doubt
        The doubt.
    values : ndarray, shape (N,)
        The values of all detections that it is about.
    stamp : Stamp
        Stamp of their message.
    """
    first, count = doubt.rows[0], len(doubt.rows)
    text = (
        f'{count} of {len(values)} detections at stamp {stamp_text(stamp)} have {doubt.what}; '
        f'index {first} has {values[first]:.4g}: {doubt.cause}'
    )
    return Finding({doubt.key: count}, {doubt.key: text})


def angle_findings(
    theta: NDArray[np.float64], frame: InputFrame, stamp: Stamp
) -> Iterator[Finding]:
    """
    Count and report angles that are hardly radians.

    Parameters
    ----------
    theta : ndarray, shape (N,)
        Angles as in the message.
    frame : InputFrame
        Tells their unit.
    stamp : Stamp
        Stamp of the message.
    """
    if frame.theta_scale == 1.0:
        for doubt in doubtful_angles(theta):
            yield finding_of(doubt, theta, stamp)


def frames_text(
    one: tuple[str, str], other: tuple[str, str], advice: str = 'two cameras on one topic?'
) -> str:
    """
    Say that two messages are of different frames; empty if one of them names none.

    Parameters
    ----------
    one, other : tuple of str
        What a message is, and its frame id.
    advice : str
        What may be wrong.

    Examples
    --------
    >>> frames_text(('detections', 'left'), ('camera_info', 'right'))
    "detections of frame 'left', but camera_info of frame 'right': two cameras on one topic?"
    """
    (what, frame_id), (other_what, other_frame_id) = one, other
    if frame_id == other_frame_id or not frame_id or not other_frame_id:
        return ''
    return f'{what} of frame {frame_id!r}, but {other_what} of frame {other_frame_id!r}: {advice}'


class OutsideWatch:
    """
    Notices that most detections lie outside the image.

    Examples
    --------
    >>> watch = OutsideWatch()
    >>> [watch.note(outside=4, total=7, size=(640, 480)) for _ in range(3)][2]
    '12 of the last 21 detections lie outside the image of 640 x 480 pixels'
    """

    def __init__(self) -> None:
        self._outside = self._total = 0

    def note(self, outside: int, total: int, size: tuple[int, int]) -> str:
        """Count detections; say after every 20 or more if more than half of them lie outside."""
        self._outside += outside
        self._total += total
        if self._total < _OUTSIDE_WINDOW:
            return ''
        outside, total = self._outside, self._total
        self._outside = self._total = 0
        if 2 * outside <= total:
            return ''
        width, height = size
        return (
            f'{outside} of the last {total} detections lie outside the image of '
            f'{width} x {height} pixels'
        )

    def complaint(self, outside: int, total: int, size: tuple[int, int]) -> dict[str, str]:
        """Count detections; complain, by kind, if most of the latest ones lie outside."""
        text = self.note(outside, total, size)
        if not text:
            return {}
        return {
            'outside': f'{text}: is camera_info, or image_width and image_height, that of the '
            'image that the detector saw?'
        }
