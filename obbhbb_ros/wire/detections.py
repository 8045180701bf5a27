# SPDX-License-Identifier: Apache-2.0
"""
Detections <-> arrays, in the bytes of `vision_msgs/Detection2DArray`.

rclpy spends about 0.1 ms on the objects of each detection. Here a message stays what it was on
the wire: the five numbers of each box are found and changed, and everything else travels
untouched. Messages of other types are first written as a `Detection2DArray`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from collections.abc import Sequence
from functools import cached_property
from math import nan
from typing import Any
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.cdr import ENDS
from obbhbb_ros.wire.cdr import LITTLE_ENDIAN
from obbhbb_ros.wire.cdr import Elements
from obbhbb_ros.wire.cdr import IntArray
from obbhbb_ros.wire.cdr import Words
from obbhbb_ros.wire.cdr import steps_of
from obbhbb_ros.wire.layouts import DETECTION_2D
from obbhbb_ros.wire.layouts import HEADER
from obbhbb_ros.wire.layouts import INPUT_TYPES
from obbhbb_ros.wire.layouts import InputType

FloatArray: TypeAlias = NDArray[np.float64]

ID_SEPARATOR = '|'

_HEADER = steps_of(HEADER)
_DETECTION = steps_of(DETECTION_2D)
_ELEMENTS = {each.name: steps_of(each.element) for each in INPUT_TYPES.values()}
_TAILS = {each.name: steps_of(each.tail) for each in INPUT_TYPES.values()}
_START = 'header.stamp.sec'
_RESULTS = 'results'
_CLASS = 'results.hypothesis.class_id'
_SCORE = 'results.hypothesis.score'
_BOX = 'bbox.center.position.x'
_ID = 'id'
# In the message a box is x, y, theta, size x, size y; `OrientedBoxes` has theta last.
_XYWHR = np.array([[0], [1], [3], [4], [2]])
_BOX_BYTES = 8 * _XYWHR.size
# x, y, theta, size x, size y.
_NO_BOX = np.array([[nan], [nan], [0.0], [nan], [nan]])
# Words of headers for each word of the message: every detection has one of its own.
_MOST_HEADERS = 16
# Score, pose with covariance.
_HYPOTHESIS_WORDS = 88
_ORIENTATION_W = 7
_PADDING = bytes(8)
# Rows of `Detections._spans`.
_RESULTS_AT, _ID_AT = 1, 5


class Detections:
    """
    The detections of one message.

    Parameters
    ----------
    data : bytes
        The serialized message with its encapsulation header, plain CDR of either endianness, with
        up to 6 bytes of padding behind it.
    input_type : InputType
        Type of the message; `vision_msgs/Detection2DArray` by default.

    Attributes
    ----------
    polygons : list of ndarray, each of shape (K, 2), or None
        Vertices of each detection, where the message holds polygons; their boxes are NaN.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """

    def __init__(
        self, data: bytes, input_type: InputType = INPUT_TYPES['Detection2DArray']
    ) -> None:
        name = input_type.name
        message = Elements(data, _HEADER, _ELEMENTS[name], input_type.many, _TAILS[name])
        self.polygons = _polygons(message, input_type) if input_type.points else None
        if input_type.element is not DETECTION_2D:
            message = _as_detections(message, input_type)
        self._message = message
        self._numbers = message.words.view(np.float64)
        self._boxes_at = (message.places(_BOX) >> 3) + _XYWHR

    def __len__(self) -> int:
        """Count the detections."""
        return self._message.count

    @property
    def stamp(self) -> tuple[int, int]:
        """Seconds and nanoseconds of the message's stamp."""
        return self._message.stamp

    def xywhr(self) -> FloatArray:
        """
        Read the oriented boxes.

        Returns
        -------
        ndarray, shape (N, 5)
            Centre x and y, size x and y, theta, as `OrientedBoxes.from_xywhr` takes them.
        """
        return self._numbers[self._boxes_at].T

    def scores(self) -> FloatArray:
        """
        Read the score of each detection's best hypothesis.

        Returns
        -------
        ndarray, shape (N,)
            Scores, NaN where there is no hypothesis.
        """
        return self._best_hypotheses[1]

    def class_ids(self) -> list[str]:
        """
        Read the class of each detection's best hypothesis, the first of equals.

        Returns
        -------
        list of str
            N class ids, empty where there is no hypothesis. Bytes that are no UTF-8 are escaped.
        """
        at, _ = self._best_hypotheses
        return [
            self._message.content(each).decode(errors='backslashreplace') if each else ''
            for each in at.tolist()
        ]

    def ids(self) -> list[str]:
        """Read the id of each detection; bytes that are no UTF-8 are escaped."""
        at = self._message.places(_ID).tolist()
        return [self._message.content(each).decode(errors='backslashreplace') for each in at]

    def rewrite(self, xywh: FloatArray, rows: Any = slice(None)) -> bytes:
        """
        Return the message with axis-aligned boxes; all else is as it was.

        The boxes of this object change as well.

        Parameters
        ----------
        xywh : ndarray, shape (N, 4)
            Centre x and y, size x and y of the axis-aligned boxes, pixels.
        rows : ndarray of bool, shape (N,), optional
            Which detections get them, all by default; the others keep their oriented box.

        Returns
        -------
        bytes
            The serialized message, little-endian.
        """
        self._place(rows, xywh[rows])
        return self._message.message()

    def selected(self, rows: IntArray, xywh: FloatArray) -> bytes:
        """
        Return the message with some of its detections, in another order, with other boxes.

        The boxes of this object change as well.

        Parameters
        ----------
        rows : ndarray of int, shape (M,)
            Which detections, in the order wanted.
        xywh : ndarray, shape (M, 4)
            Centre x and y, size x and y of their axis-aligned boxes, pixels.

        Returns
        -------
        bytes
            The serialized message, little-endian.
        """
        self._place(rows, xywh)
        return _Writer(self._message, len(rows)).copy(self._spans[:, rows]).message()

    def joined(self, groups: Sequence[Sequence[int]], xywh: FloatArray) -> bytes:
        """
        Return the message with one detection for each group of its detections.

        The boxes of this object change as well.

        Parameters
        ----------
        groups : sequence of sequences of int
            M groups of one detection or more, in the order wanted, each with another first one.
        xywh : ndarray, shape (M, 4)
            Centre x and y, size x and y of their axis-aligned boxes, pixels.

        Returns
        -------
        bytes
            The serialized message, little-endian. A detection has the header of the first of its
            group, all hypotheses of the group, and the ids of the group joined by `ID_SEPARATOR`.
        """
        spans = self._spans
        counts = self._message.words[spans[_RESULTS_AT] >> 2].tolist()
        rows = spans.T.tolist()
        self._place(np.array([group[0] for group in groups], np.int64), xywh)
        writer = _Writer(self._message, len(groups))
        for group in groups:
            start, results, _, _, box, *_ = rows[group[0]]
            writer.add(start, results)
            writer.add_bytes(sum(counts[row] for row in group).to_bytes(4, 'little'))
            for row in group:
                if counts[row]:
                    _, results, fields_end, first, first_end, _, _ = rows[row]
                    writer.add(results + 4, fields_end)
                    writer.align()
                    writer.add(first, first_end)
            writer.align()
            writer.add(box, box + _BOX_BYTES)
            ids = [self._message.content(rows[row][_ID_AT]) for row in group]
            writer.add_text(ID_SEPARATOR.encode().join(ids))
        return writer.message()

    def ranked(self, rows: IntArray, boxes: FloatArray, values: FloatArray) -> bytes:
        """
        Return the message with some of its detections, in another order, with values for scores.

        The boxes of this object change as well.

        Parameters
        ----------
        rows : ndarray of int, shape (M,)
            Which detections, in the order wanted, none twice.
        boxes : ndarray, shape (5, M)
            Centre x and y, size along theta and across it, theta.
        values : ndarray, shape (M,)
            Their values: the score of the best hypothesis becomes the value, that of others NaN.

        Returns
        -------
        bytes
            The serialized message, little-endian.
        """
        self._numbers[self._boxes_at[:, rows]] = boxes
        scores_at = self._message.places(_SCORE) >> 3
        scores = self._numbers[scores_at]
        classes_at, _ = self._best_hypotheses
        best = np.searchsorted(self._message.places(_CLASS), classes_at[rows])
        with_class = classes_at[rows] > 0
        self._numbers[scores_at] = nan
        self._numbers[scores_at[best[with_class]]] = values[with_class]
        try:
            return _Writer(self._message, len(rows)).copy(self._spans[:, rows]).message()
        finally:
            self._numbers[scores_at] = scores

    def alone(self, row: int, header: bytes, own_header: bytes) -> bytes:
        """
        Return a message with one of the detections.

        Parameters
        ----------
        row : int
            Which detection.
        header, own_header : bytes
            Headers of the message and of the detection, as `header_bytes` writes them.

        Returns
        -------
        bytes
            The serialized message, little-endian.
        """
        _, results, fields_end, first, box, id_at, _ = self._spans[:, row].tolist()
        writer = _Writer(self._message, 1, header)
        writer.add_bytes(own_header)
        writer.add(results, fields_end)
        writer.align()
        writer.add(first, box + _BOX_BYTES)
        writer.add_text(self._message.content(id_at))
        return writer.message()

    def _place(self, rows: Any, xywh: FloatArray) -> None:
        """Write axis-aligned boxes, (M, 4), over those of some detections."""
        boxes_at = self._boxes_at[:, rows]
        self._numbers[boxes_at[:4]] = xywh.T
        self._numbers[boxes_at[4]] = 0.0

    @cached_property
    def _hypotheses(self) -> tuple[IntArray, IntArray]:
        """How many hypotheses each detection has, and how many lie before its first one; (N,)."""
        counts = self._message.words[self._message.places(_RESULTS) >> 2].astype(np.int64)
        return counts, counts.cumsum() - counts

    @cached_property
    def _best_hypotheses(self) -> tuple[IntArray, FloatArray]:
        """Where the class of each best hypothesis lies, 0 for none, and its score; (N,)."""
        classes_at = self._message.places(_CLASS)
        all_scores = self._numbers[self._message.places(_SCORE) >> 3]
        counts, firsts = self._hypotheses
        if (counts == 1).all():
            return classes_at, all_scores
        at, scores = np.zeros(len(self), np.int64), np.full(len(self), np.nan)
        for number in range(counts.max(initial=0)):
            rows = np.flatnonzero(counts > number)
            each = firsts[rows] + number
            mine, best = all_scores[each], scores[rows]
            # NaN is less than any number.
            better = (mine > best) | (np.isnan(best) & ~np.isnan(mine)) | (number == 0)
            at[rows] = np.where(better, classes_at[each], at[rows])
            scores[rows] = np.where(better, mine, best)
        return at, scores

    @cached_property
    def _spans(self) -> IntArray:
        """
        Find the parts of each detection.

        Returns
        -------
        ndarray of int, shape (7, N)
            Bytes: start, number of results, end of what precedes the first number of eight bytes,
            that number, box, id, and end.
        """
        places = self._message.places
        results, box = places(_RESULTS), places(_BOX)
        fields_end, first = results + 4, box.copy()
        counts, firsts = self._hypotheses
        (rows,) = counts.nonzero()
        classes_at = places(_CLASS)[firsts[rows]]
        fields_end[rows] = classes_at + self._message.words[classes_at >> 2] + 7 & -4
        first[rows] = places(_SCORE)[firsts[rows]]
        return np.stack(
            (places(_START), results, fields_end, first, box, places(_ID), places(ENDS))
        )


class _Writer:
    """
    Writes a `Detection2DArray`, mostly from pieces of another message.

    Parameters
    ----------
    source : Elements
        The other message.
    count : int
        How many detections the new one has.
    header : bytes, optional
        Header of the new one, whole words; by default that of the other.
    """

    def __init__(self, source: Elements, count: int, header: bytes = b'') -> None:
        self._raw = memoryview(source.words.data).cast('B')
        self._chunks: list[Any] = [LITTLE_ENDIAN]
        self._end = 0
        # Bytes that fill up the last word: not sent with the last string of the message.
        self._filling = 0
        self.add_bytes(header or self._raw[: 4 * source.header_words])
        self.add_bytes(count.to_bytes(4, 'little'))

    def copy(self, spans: IntArray) -> _Writer:
        """Add detections of the other message, (7, M) as `Detections._spans` gives them."""
        if not spans.size:
            return self
        start, _, fields_end, first, _, _, unfilled = spans
        end = unfilled + 3 & -4
        # From its first number of eight bytes on, a detection is the same at every position. The
        # fields before may start at the other half of eight bytes, with other padding behind them.
        before, behind = fields_end - start, end - first
        padding = (np.concatenate(([self._end], behind[:-1])) + before) & 4
        self._end += int((before + padding + behind).sum())
        self._filling = int(end[-1] - unfilled[-1])
        moved = padding != first - fields_end
        zeros = np.full_like(start, len(self._raw) - 8)
        starts = np.array((start, zeros, first)).T
        stops = np.array(
            (np.where(moved, fields_end, end), zeros + padding * moved, np.where(moved, end, first))
        ).T
        pieces = stops > starts
        self._chunks += [
            self._raw[i:j]
            for i, j in zip(starts[pieces].tolist(), stops[pieces].tolist(), strict=True)
        ]
        return self

    def add(self, start: int, end: int) -> None:
        """Add bytes of the other message, whole words."""
        self.add_bytes(self._raw[start:end])

    def add_bytes(self, content: bytes | memoryview) -> None:
        """Add whole words."""
        self._chunks.append(content)
        self._end += len(content)

    def align(self) -> None:
        """Go on at a multiple of eight bytes."""
        self.add_bytes(_PADDING[: -self._end & 7])

    def add_text(self, content: bytes) -> None:
        """Add a string, and what fills up its last word."""
        size = len(content) + 1
        self._filling = -size & 3
        self.add_bytes(size.to_bytes(4, 'little') + content + _PADDING[: 1 + self._filling])

    def message(self) -> bytes:
        """Return the message."""
        if self._filling:
            self._chunks[-1] = self._chunks[-1][: -self._filling]
        return b''.join(self._chunks)


def _polygons(message: Elements, input_type: InputType) -> list[FloatArray]:
    """Read the vertices of each polygon, (K, 2)."""
    (step,) = _ELEMENTS[input_type.name]
    numbers = message.words.view(f'<f{step.size}')
    at = message.places(input_type.points)
    counts = message.words[at >> 2].tolist()
    firsts = ((at + 4 + step.size - 1 & -step.size) // step.size).tolist()
    width = step.length // step.size
    # NumPy warns when it converts a signalling NaN.
    with np.errstate(invalid='ignore'):
        return [
            numbers[first : first + count * width].reshape(-1, width)[:, :2].astype(np.float64)
            for first, count in zip(firsts, counts, strict=True)
        ]


def _as_detections(message: Elements, input_type: InputType) -> Elements:
    """Write a message's elements as detections; those without a class have no hypothesis."""
    count, head, source = message.count, message.header_words, message.words
    if count * head > _MOST_HEADERS * len(source):
        raise WireError(f'{count} elements with a header of {4 * head} bytes each')
    if input_type.id:
        id_source, ids = source, message.places(input_type.id) >> 2
    else:
        id_source, ids = _texts(map(str, range(count)))
    id_words = _words_of(id_source, ids)
    has_class = bool(input_type.class_id)
    classes = message.places(input_type.class_id) >> 2 if has_class else ids[:0]
    class_words = _words_of(source, classes) if has_class else np.zeros_like(ids)
    # In words: header, number of hypotheses and class; padding; numbers, that start at even words,
    # as those of a hypothesis and a box are; id.
    before = head + 1 + class_words
    odd = np.concatenate(([head + 1], id_words[:-1])) + before & 1 if count else before
    numbers_words = _HYPOTHESIS_WORDS * has_class + _BOX_BYTES // 4
    size = before + odd + numbers_words + id_words
    starts = head + 1 + size.cumsum() - size
    numbers = starts + before + odd
    boxes = numbers + _HYPOTHESIS_WORDS * has_class
    written = Elements.blank(source[:head], count, int(size.sum()))
    words, doubles = written.words, written.words.view(np.float64)
    words[starts[:, None] + np.arange(head)] = source[:head]
    words[starts + head] = has_class
    _copy(words, starts + head + 1, source, classes, class_words)
    _copy(words, boxes + _BOX_BYTES // 4, id_source, ids, id_words)
    given = source.view(np.float64)
    if has_class:
        doubles[numbers >> 1] = given[message.places(input_type.score) >> 3]
        # The orientation that a new message has: w is 1.
        doubles[(numbers >> 1) + _ORIENTATION_W] = 1.0
    box_numbers = (boxes >> 1) + np.arange(_XYWHR.size)[:, None]
    if input_type.box:
        doubles[box_numbers] = given[
            (message.places(input_type.box) >> 3) + np.arange(_XYWHR.size)[:, None]
        ]
    else:
        doubles[box_numbers] = _NO_BOX
    id_at = 4 * boxes + _BOX_BYTES
    written.found(
        {
            _START: 4 * starts,
            _RESULTS: 4 * (starts + head),
            _CLASS: 4 * (starts + head + 1),
            _SCORE: 4 * numbers,
            _BOX: 4 * boxes,
            _ID: id_at,
            ENDS: id_at + 4 + words[id_at >> 2],
        }
    )
    return written


def _texts(texts: Iterable[str]) -> tuple[Words, IntArray]:
    """Write strings; give the words, and at which word each starts."""
    contents = [text.encode() + b'\0' for text in texts]
    padded = [
        len(each).to_bytes(4, 'little') + each + _PADDING[: -len(each) & 3] for each in contents
    ]
    sizes = np.array([len(each) // 4 for each in padded], np.int64)
    return np.frombuffer(b''.join(padded), '<u4'), sizes.cumsum() - sizes


def _words_of(source: Words, at: IntArray) -> IntArray:
    """Count the words of strings that start at a word."""
    return (source[at].astype(np.int64) + 7) >> 2


def _copy(target: Words, to: IntArray, source: Words, at: IntArray, counts: IntArray) -> None:
    """Copy pieces of words."""
    if at.size:
        step = np.arange(counts.sum()) - np.repeat(counts.cumsum() - counts, counts)
        target[np.repeat(to, counts) + step] = source[np.repeat(at, counts) + step]


def canonical(data: bytes) -> bytes:
    """
    Return a message as the node writes it.

    Parameters
    ----------
    data : bytes
        A serialized `vision_msgs/Detection2DArray`.

    Returns
    -------
    bytes
        The same message, little-endian, with zeros between its fields and nothing behind it.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """
    return Elements(data, _HEADER, _DETECTION).message()


def header_bytes(stamp: tuple[int, int], frame_id: str) -> bytes:
    """Write a `std_msgs/Header`, little-endian, filled up to whole words."""
    content = frame_id.encode(errors='replace') + b'\0'
    seconds, nanoseconds = stamp
    return (
        struct.pack('<iII', seconds, nanoseconds, len(content))
        + content
        + _PADDING[: -len(content) & 3]
    )
