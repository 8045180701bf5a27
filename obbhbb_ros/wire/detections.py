# SPDX-License-Identifier: Apache-2.0
"""
Detections <-> arrays, in the bytes of `vision_msgs/Detection2DArray`.

rclpy spends about 0.1 ms on the objects of each detection. Here a message remains bytes: the five
numbers of each box are located and changed, and everything else passes through untouched. Messages
of other types are first written as a `Detection2DArray`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from math import nan
from typing import TYPE_CHECKING
from typing import Any

import numpy as np

from obbhbb_ros.wire.buffer import LITTLE_ENDIAN
from obbhbb_ros.wire.buffer import IntArray
from obbhbb_ros.wire.elements import read_elements
from obbhbb_ros.wire.layouts import DETECTION_2D
from obbhbb_ros.wire.layouts import INPUT_TYPES
from obbhbb_ros.wire.layouts import Field
from obbhbb_ros.wire.layouts import InputType
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.transcode import as_detections
from obbhbb_ros.wire.transcode import read_polygons
from obbhbb_ros.wire.writing import padding
from obbhbb_ros.wire.writing import text_bytes

if TYPE_CHECKING:
    from obbhbb_ros.geometry.boxes import FloatArray

ID_SEPARATOR = '|'

# The message has x, y, theta, size x, size y; `OrientedBoxes` has theta last.
_XYWHR = np.array([[0], [1], [3], [4], [2]])
_BOX_BYTES = 8 * _XYWHR.size


class Detections:
    """
    The detections of one message.

    Methods that return a message write its boxes over those of this object first, so read the
    oriented boxes before.

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
        Vertices of each detection if the message holds polygons; the boxes are then NaN.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.

    Examples
    --------
    >>> header = bytes([0, 1, 0, 0]) + bytes(8) + bytes([4, 0, 0, 0]) + b'cam' + bytes(1)
    >>> detections = Detections(header + bytes(4))
    >>> len(detections), detections.xywhr().shape
    (0, (0, 5))
    """

    def __init__(
        self, data: bytes, input_type: InputType = INPUT_TYPES['Detection2DArray']
    ) -> None:
        buffer, index = read_elements(data, input_type)
        self.polygons = read_polygons(buffer, index, input_type) if input_type.points else None
        if input_type.element is not DETECTION_2D:
            buffer, index = as_detections(buffer, index, input_type)
        self._buffer, self._index = buffer, index
        self._numbers = buffer.words.view(np.float64)
        self._boxes_at = (index.places(Field.BOX) >> 3) + _XYWHR

    def __len__(self) -> int:
        """Count the detections."""
        return self._index.count

    @property
    def stamp(self) -> Stamp:
        """The stamp of the message's header."""
        return self._buffer.stamp

    @property
    def frame_id(self) -> str:
        """The frame of the message's header; bytes that are not UTF-8 are escaped."""
        return self._buffer.frame_id

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
            N class ids, empty where there is no hypothesis. Bytes that are not UTF-8 are escaped.
        """
        places, _ = self._best_hypotheses
        return self._buffer.repeated_texts(places.tolist())

    def ids(self) -> list[str]:
        """Read the id of each detection; bytes that are not UTF-8 are escaped."""
        return [self._buffer.text(place) for place in self._index.places(Field.ID).tolist()]

    def rewrite(self, xywh: FloatArray, rows: Any = slice(None)) -> bytes:
        """
        Return the message with axis-aligned boxes; everything else is as it was.

        Parameters
        ----------
        xywh : ndarray, shape (N, 4)
            Centre x and y, size x and y of the axis-aligned boxes, pixels.
        rows : ndarray of bool, shape (N,), optional
            Which detections get them, by default all; the others keep their oriented box.

        Returns
        -------
        bytes
            The serialized message, little-endian.
        """
        self._write_boxes(rows, xywh[rows])
        return self._buffer.message(self._index.end)

    def selected(self, rows: IntArray, xywh: FloatArray) -> bytes:
        """
        Return the message with some of its detections, in another order, with other boxes.

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
        self._write_boxes(rows, xywh)
        return self._copied(rows)

    def joined(self, groups: Sequence[Sequence[int]], xywh: FloatArray) -> bytes:
        """
        Return the message with one detection in place of each group of detections.

        Parameters
        ----------
        groups : sequence of sequences of int
            M groups of one or more rows, in the order wanted; no two have the same first row.
        xywh : ndarray, shape (M, 4)
            Centre x and y, size x and y of their axis-aligned boxes, pixels.

        Returns
        -------
        bytes
            The serialized message, little-endian. A detection has the header of the first one of
            its group, all hypotheses of the group, and its ids joined by `ID_SEPARATOR`.
        """
        self._write_boxes(np.array([group[0] for group in groups], np.int64), xywh)
        counts = self._hypotheses[0].tolist()
        spans = self._spans.T.tolist()
        writer = self._writer(len(groups))
        for group in groups:
            start, results, _, _, box, *_ = spans[group[0]]
            writer.add(start, results)
            writer.add_bytes(sum(counts[row] for row in group).to_bytes(4, 'little'))
            for row in group:
                if counts[row]:
                    _, results, fields_end, first, first_end, _, _ = spans[row]
                    writer.add(results + 4, fields_end)
                    writer.align()
                    writer.add(first, first_end)
            writer.align()
            writer.add(box, box + _BOX_BYTES)
            ids = [self._id(spans[row][_ID_AT]) for row in group]
            writer.add_text(ID_SEPARATOR.encode().join(ids))
        return writer.message()

    def ranked(self, rows: IntArray, boxes: FloatArray, values: FloatArray) -> bytes:
        """
        Return the message with some of its detections, in another order, scored by value.

        Parameters
        ----------
        rows : ndarray of int, shape (M,)
            Which detections, in the order wanted, without repetition.
        boxes : ndarray, shape (5, M)
            Centre x and y, size along theta and across it, theta.
        values : ndarray, shape (M,)
            Their values, which become the score of the best hypothesis; other scores become NaN.

        Returns
        -------
        bytes
            The serialized message, little-endian.
        """
        self._numbers[self._boxes_at[:, rows]] = boxes
        scores_at = self._index.places(Field.SCORE) >> 3
        scores = self._numbers[scores_at]
        classes_at, _ = self._best_hypotheses
        best = np.searchsorted(self._index.places(Field.CLASS), classes_at[rows])
        with_class = classes_at[rows] > 0
        self._numbers[scores_at] = nan
        self._numbers[scores_at[best[with_class]]] = values[with_class]
        try:
            return self._copied(rows)
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
            Headers of the message and of the detection, written by `header_bytes`.

        Returns
        -------
        bytes
            The serialized message, little-endian.
        """
        _, results, fields_end, first, box, id_at, _ = self._spans[:, row].tolist()
        writer = self._writer(1, header)
        writer.add_bytes(own_header)
        writer.add(results, fields_end)
        writer.align()
        writer.add(first, box + _BOX_BYTES)
        writer.add_text(self._id(id_at))
        return writer.message()

    def with_ids(
        self,
        ids: Sequence[str],
        xywhr: FloatArray | None = None,
        rows: IntArray | None = None,
    ) -> bytes:
        """
        Return the message with other ids; everything else is as it was.

        Parameters
        ----------
        ids : sequence of str
            M ids, by default for all detections.
        xywhr : ndarray, shape (N, 5), optional
            Oriented boxes to be written as well, as `xywhr` reads them.
        rows : ndarray of int, shape (M,), optional
            Which detections the message keeps, by default all.

        Returns
        -------
        bytes
            The serialized message, little-endian.
        """
        if xywhr is not None:
            self._numbers[self._boxes_at] = xywhr.T
        writer = self._writer(len(ids))
        spans = self._spans if rows is None else self._spans[:, rows]
        writer.copy_with_ids(spans, [text.encode(errors='replace') for text in ids])
        return writer.message()

    def _write_boxes(self, rows: Any, xywh: FloatArray) -> None:
        """Write axis-aligned boxes, (M, 4), over those of some detections."""
        boxes_at = self._boxes_at[:, rows]
        self._numbers[boxes_at[:4]] = xywh.T
        self._numbers[boxes_at[4]] = 0.0

    def _writer(self, count: int, header: bytes = b'') -> _DetectionWriter:
        """Start a message of some detections, by default with the header of this one."""
        body = self._buffer.body
        return _DetectionWriter(body, header or body[: 4 * self._index.header_words], count)

    def _copied(self, rows: IntArray) -> bytes:
        """Return the message with some of its detections, as they are now."""
        writer = self._writer(len(rows))
        writer.copy(self._spans[:, rows])
        return writer.message()

    def _id(self, place: int) -> bytes:
        """Return an id without its closing zero."""
        return bytes(self._buffer.content(place)[:-1])

    @cached_property
    def _hypotheses(self) -> tuple[IntArray, IntArray]:
        """How many hypotheses each detection has, and how many precede its first one; (N,)."""
        counts = self._buffer.words[self._index.places(Field.RESULTS) >> 2].astype(np.int64)
        return counts, counts.cumsum() - counts

    @cached_property
    def _best_hypotheses(self) -> tuple[IntArray, FloatArray]:
        """Place of the class of each best hypothesis, 0 for none, and its score; (N,)."""
        classes_at = self._index.places(Field.CLASS)
        all_scores = self._numbers[self._index.places(Field.SCORE) >> 3]
        counts, firsts = self._hypotheses
        if (counts == 1).all():
            return classes_at, all_scores
        best_at, best = np.zeros(len(self), np.int64), np.full(len(self), nan)
        (rows,) = counts.nonzero()
        if len(rows):
            # NaN is less than any number. NumPy warns of signalling ones.
            with np.errstate(invalid='ignore'):
                highest = np.fmax.reduceat(all_scores, firsts[rows])
            numbers = np.arange(len(all_scores))
            is_highest = all_scores == np.repeat(highest, counts[rows])
            chosen = np.minimum.reduceat(np.where(is_highest, numbers, len(numbers)), firsts[rows])
            chosen = np.where(chosen < len(numbers), chosen, firsts[rows])
            best_at[rows], best[rows] = classes_at[chosen], all_scores[chosen]
        return best_at, best

    @cached_property
    def _spans(self) -> IntArray:
        """
        Locate the parts of each detection.

        Returns
        -------
        ndarray of int, shape (7, N)
            Places: start, number of results, end of the fields before the first number of eight
            bytes, that number, box, id, and end.
        """
        places = self._index.places
        results, box = places(Field.RESULTS), places(Field.BOX)
        fields_end, first = results + 4, box.copy()
        counts, firsts = self._hypotheses
        (rows,) = counts.nonzero()
        classes_at = places(Field.CLASS)[firsts[rows]]
        fields_end[rows] = classes_at + self._buffer.words[classes_at >> 2] + 7 & -4
        first[rows] = places(Field.SCORE)[firsts[rows]]
        ends = np.asarray(self._index.ends, np.int64)
        return np.array(
            (places(Field.START), results, fields_end, first, box, places(Field.ID), ends)
        )


# Row of `Detections._spans`.
_ID_AT = 5


class _DetectionWriter:
    """
    Writes a `Detection2DArray`, mostly from pieces of another message.

    Parameters
    ----------
    source : memoryview of bytes
        Body of the other message, with eight zeros at its end.
    header : bytes
        Header of the new message, in whole words.
    count : int
        How many detections the new message has.
    """

    def __init__(self, source: memoryview, header: bytes | memoryview, count: int) -> None:
        self._source = source
        self._chunks: list[bytes | memoryview] = [LITTLE_ENDIAN]
        self._end = 0
        # Bytes that fill up the last word: not sent with the last string of the message.
        self._filling = 0
        self.add_bytes(header)
        self.add_bytes(count.to_bytes(4, 'little'))

    def copy(self, spans: IntArray) -> None:
        """Add detections of the other message, (7, M) as `Detections._spans` locates them."""
        if not spans.size:
            return
        start, _, fields_end, first, _, _, unfilled = spans
        end = unfilled + 3 & -4
        # From its first number of eight bytes on, a detection is the same at every position. The
        # fields before may start at the other half of eight bytes, with other padding behind them.
        before, behind = fields_end - start, end - first
        gaps = (np.concatenate(([self._end], behind[:-1])) + before) & 4
        self._end += int((before + gaps + behind).sum())
        self._filling = int(end[-1] - unfilled[-1])
        moved = gaps != first - fields_end
        zeros = np.full(len(start), len(self._source) - 8)
        starts = np.array((start, zeros, first)).T
        stops = np.array(
            (np.where(moved, fields_end, end), zeros + gaps * moved, np.where(moved, end, first))
        ).T
        pieces = stops > starts
        self._chunks += [
            self._source[i:j]
            for i, j in zip(starts[pieces].tolist(), stops[pieces].tolist(), strict=True)
        ]

    def copy_with_ids(self, spans: IntArray, ids: Sequence[bytes]) -> None:
        """Add detections of the other message as `copy` does, with other ids."""
        if not ids:
            return
        start, _, fields_end, first, box, _, _ = spans
        texts = [text_bytes(text) for text in ids]
        sizes = np.array([len(text) for text in texts], np.int64)
        # As in `copy`; what precedes a detection is the id of the one before.
        gaps = (np.concatenate(([self._end], sizes[:-1])) + fields_end - start) & 4
        source, zeros = self._source, padding(4)
        for i, middle, gap, j, end, text in zip(
            start.tolist(),
            fields_end.tolist(),
            gaps.tolist(),
            first.tolist(),
            (box + _BOX_BYTES).tolist(),
            texts,
            strict=True,
        ):
            self._chunks += (source[i:middle], zeros[:gap], source[j:end], text)
        self._end += int((fields_end - start + gaps + box + _BOX_BYTES - first + sizes).sum())
        self._filling = -(len(ids[-1]) + 1) & 3

    def add(self, start: int, end: int) -> None:
        """Add whole words of the other message."""
        self.add_bytes(self._source[start:end])

    def add_bytes(self, content: bytes | memoryview) -> None:
        """Add whole words."""
        self._chunks.append(content)
        self._end += len(content)

    def align(self) -> None:
        """Continue at a multiple of eight bytes."""
        self.add_bytes(padding(self._end))

    def add_text(self, content: bytes) -> None:
        """Add a string, filled up to whole words."""
        self.add_bytes(text_bytes(content))
        self._filling = -(len(content) + 1) & 3

    def message(self) -> bytes:
        """Return the message."""
        if self._filling:
            self._chunks[-1] = self._chunks[-1][: -self._filling]
        return b''.join(self._chunks)
