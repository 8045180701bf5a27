# SPDX-License-Identifier: Apache-2.0
"""Where the ships of an image are on Earth, as `vision_msgs/Detection3DArray`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from obbhbb_ros.wire.buffer import LITTLE_ENDIAN
from obbhbb_ros.wire.elements import read_elements
from obbhbb_ros.wire.layouts import POSITIONS
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.writing import header_bytes
from obbhbb_ros.wire.writing import padding
from obbhbb_ros.wire.writing import text_bytes

if TYPE_CHECKING:
    from obbhbb_ros.geometry.boxes import FloatArray

_COVARIANCE = 36
_CENTER = 'bbox.center.position'
_SCORE = 'results.hypothesis.score'


@dataclass(frozen=True, eq=False)
class WirePositions:
    """
    A message on `positions`: one element for each detection of an image.

    Attributes
    ----------
    stamp : Stamp
        Stamp of the image.
    frame_id : str
        Frame of the positions.
    ids, class_ids : list of str
        N ids, and the class of each.
    scores : ndarray, shape (N,)
        Their scores.
    points : ndarray, shape (N, 3)
        Middles of the ships, metres; NaN where one has no place.
    attitudes : ndarray, shape (N, 4)
        Quaternions: x along the hull, z up.
    sizes : ndarray, shape (N, 2)
        Length and width, metres.
    covariances : ndarray, shape (N, 6, 6)
        Of the point (m) and of rotations about the axes of the frame (rad); NaN where it is not
        known.
    own_stamps : list of Stamp
        Stamp of each element: that of the image, less the age of the pose.
    """

    stamp: Stamp
    frame_id: str
    ids: Sequence[str]
    class_ids: Sequence[str]
    scores: FloatArray
    points: FloatArray
    attitudes: FloatArray
    sizes: FloatArray
    covariances: FloatArray
    own_stamps: Sequence[Stamp]

    def __len__(self) -> int:
        """Count the elements."""
        return len(self.ids)

    def to_bytes(self) -> bytes:
        """Write the message, little-endian, with its encapsulation header."""
        poses = np.hstack((self.points, self.attitudes))
        matrices = self.covariances.reshape(-1, _COVARIANCE)
        sizes = np.pad(self.sizes, ((0, 0), (0, 1)))
        numbers = np.hstack((self.scores[:, None], poses, matrices, poses, sizes)).astype('<f8')
        body = header_bytes(self.stamp, self.frame_id) + len(self).to_bytes(4, 'little')
        one = (1).to_bytes(4, 'little')
        heads = {own: header_bytes(own, self.frame_id) + one for own in set(self.own_stamps)}
        classes = {name: _text(name) for name in set(self.class_ids)}
        chunks, end, text = [body], len(body), b''
        for own, name, content, ship in zip(
            self.own_stamps, self.class_ids, numbers, self.ids, strict=True
        ):
            fields, text = heads[own] + classes[name], _text(ship)
            chunks += (fields, padding(end + len(fields)), content.tobytes(), text)
            end += len(fields)
            end += (-end & 7) + content.nbytes + len(text)
        if text:
            # Bytes that fill up the last word are not sent.
            chunks[-1] = text[: 4 + int.from_bytes(text[:4], 'little')]
        return LITTLE_ENDIAN + b''.join(chunks)


def read_positions(data: bytes) -> WirePositions:
    """
    Read a message on `positions`.

    Parameters
    ----------
    data : bytes
        A serialized `vision_msgs/Detection3DArray`. Of several hypotheses the first one counts.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """
    buffer, index = read_elements(data, POSITIONS)
    numbers, count = buffer.words.view(np.float64), index.count
    boxes = numbers[(index.places(_CENTER)[:, None] >> 3) + np.arange(10)].reshape(-1, 10)
    hypotheses = buffer.words[index.places('results') >> 2].astype(np.int64)
    firsts = hypotheses.cumsum() - hypotheses
    (with_one,) = hypotheses.nonzero()
    scores, covariances = np.full(count, np.nan), np.full((count, _COVARIANCE), np.nan)
    class_ids = [''] * count
    if len(with_one):
        # The score, the pose, and the covariance follow each other.
        places = index.places(_SCORE)[firsts[with_one]] >> 3
        scores[with_one] = numbers[places]
        covariances[with_one] = numbers[places[:, None] + 8 + np.arange(_COVARIANCE)]
        class_places = index.places(POSITIONS.class_id)[firsts[with_one]].tolist()
        for row, place in zip(with_one.tolist(), class_places, strict=True):
            class_ids[row] = buffer.text(place)
    starts = index.places('header.stamp.sec').tolist()
    return WirePositions(
        stamp=buffer.stamp,
        frame_id=buffer.frame_id,
        ids=[buffer.text(place) for place in index.places(POSITIONS.id).tolist()],
        class_ids=class_ids,
        scores=scores,
        points=boxes[:, :3],
        attitudes=boxes[:, 3:7],
        sizes=boxes[:, 7:9],
        covariances=covariances.reshape(-1, 6, 6),
        own_stamps=[_stamp(buffer.numbers(start, 'iI')) for start in starts],
    )


def _text(text: str) -> bytes:
    """Write a string."""
    return text_bytes(text.encode(errors='replace'))


def _stamp(numbers: Sequence[int]) -> Stamp:
    """Return seconds and nanoseconds as a stamp."""
    seconds, nanoseconds = numbers
    return seconds, nanoseconds
