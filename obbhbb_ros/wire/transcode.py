# SPDX-License-Identifier: Apache-2.0
"""Messages of other types, written as `vision_msgs/Detection2DArray`; and polygons as arrays."""

from __future__ import annotations

from math import nan
from typing import TYPE_CHECKING
from typing import NamedTuple

import numpy as np

from obbhbb_ros.wire.buffer import LITTLE_ENDIAN
from obbhbb_ros.wire.buffer import EditableBuffer
from obbhbb_ros.wire.buffer import IntArray
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.buffer import Words
from obbhbb_ros.wire.elements import ElementIndex
from obbhbb_ros.wire.layouts import InputType
from obbhbb_ros.wire.walk import ranges
from obbhbb_ros.wire.writing import text_bytes

if TYPE_CHECKING:
    from obbhbb_ros.geometry.boxes import FloatArray

# Each detection has a copy of the message's header. Their words together may be this many times
# the words of the message.
_MAX_HEADERS = 16
# Doubles of a box: x, y, theta, size x, size y; and those of a detection without one.
_BOX = np.arange(5)
_NO_BOX = np.array([nan, nan, 0.0, nan, nan])
# Doubles of a hypothesis: score, position, orientation, covariance. In a new message, w of the
# orientation is 1.
_HYPOTHESIS_DOUBLES = 1 + 3 + 4 + 36
_ORIENTATION_W = 7


def read_polygons(
    buffer: EditableBuffer, index: ElementIndex, input_type: InputType
) -> list[FloatArray]:
    """
    Read the vertices of each polygon of a message.

    Parameters
    ----------
    buffer : EditableBuffer
        The message.
    index : ElementIndex
        Where the fields of its polygons lie.
    input_type : InputType
        Its type, whose elements are polygons.

    Returns
    -------
    list of ndarray, each of shape (K, 2)
        x and y of the vertices, pixels.
    """
    (step,) = input_type.element_steps
    numbers = buffer.words.view(f'<f{step.size}')
    places = index.places(input_type.points)
    counts = buffer.words[places >> 2].tolist()
    firsts = ((places + 4 + step.size - 1) // step.size).tolist()
    width = step.length // step.size
    # NumPy warns when it converts a signalling NaN.
    with np.errstate(invalid='ignore'):
        return [
            numbers[first : first + count * width].reshape(-1, width)[:, :2].astype(np.float64)
            for first, count in zip(firsts, counts, strict=True)
        ]


def as_detections(
    buffer: EditableBuffer, index: ElementIndex, input_type: InputType
) -> tuple[EditableBuffer, ElementIndex]:
    """
    Write a message as a `vision_msgs/Detection2DArray`.

    Parameters
    ----------
    buffer : EditableBuffer
        The message.
    index : ElementIndex
        Where the fields of its elements lie.
    input_type : InputType
        Its type.

    Returns
    -------
    buffer : EditableBuffer
        The new message. Each detection has the header of the message; without a class it has no
        hypothesis.
    index : ElementIndex
        Where the fields of the detections lie.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the copies of the header would take far more room than the message.
    """
    header, count = buffer.words[: index.header_words], index.count
    if count * len(header) > _MAX_HEADERS * len(buffer.words):
        raise WireError(f'{count} elements with a header of {4 * len(header)} bytes each')
    ids = _strings_at(buffer, index, input_type.id) if input_type.id else _numbered(count)
    classes = _strings_at(buffer, index, input_type.class_id) if input_type.class_id else None
    layout = _layout(len(header), ids, classes)
    written = EditableBuffer(LITTLE_ENDIAN + bytes(4 * layout.end))
    words, doubles = written.words, written.words.view(np.float64)
    words[: len(header)] = header
    words[len(header)] = count
    words[layout.starts[:, None] + np.arange(len(header))] = header
    words[layout.results] = classes is not None
    _copy(ids, words, layout.ids)
    numbers = buffer.words.view(np.float64)
    if classes is not None:
        _copy(classes, words, layout.results + 1)
        doubles[layout.hypotheses] = numbers[index.places(input_type.score) >> 3]
        doubles[layout.hypotheses + _ORIENTATION_W] = 1.0
    doubles[layout.boxes[:, None] + _BOX] = (
        numbers[(index.places(input_type.box) >> 3)[:, None] + _BOX] if input_type.box else _NO_BOX
    )
    return written, _index(layout, len(header), words)


class _Strings(NamedTuple):
    """N strings in an array: the word at which each starts, and its words, the length included."""

    source: Words
    starts: IntArray
    words: IntArray


def _strings(source: Words, starts: IntArray) -> _Strings:
    """Measure strings that start at some words."""
    return _Strings(source, starts, source[starts].astype(np.int64) + 7 >> 2)


def _strings_at(buffer: EditableBuffer, index: ElementIndex, path: str) -> _Strings:
    """Return a string of each element."""
    return _strings(buffer.words, index.places(path) >> 2)


def _numbered(count: int) -> _Strings:
    """Write the index of each element as a string."""
    texts = [text_bytes(str(number).encode()) for number in range(count)]
    sizes = np.array([len(text) // 4 for text in texts], np.int64)
    return _strings(np.frombuffer(b''.join(texts), '<u4'), sizes.cumsum() - sizes)


def _copy(strings: _Strings, target: Words, starts: IntArray) -> None:
    """Copy strings to where they start in a message, in words."""
    source = strings.source[ranges(strings.starts, strings.words)]
    target[ranges(starts, strings.words)] = source


class _Layout(NamedTuple):
    """
    Where the parts of N detections lie in the new message.

    Attributes
    ----------
    starts, results, ids : ndarray of int, shape (N,)
        Words at which the detection, the number of its hypotheses and its id start. A class
        follows the number of hypotheses.
    hypotheses, boxes : ndarray of int, shape (N,)
        Doubles at which the numbers of the hypothesis, if there is one, and of the box start.
    end : int
        Word at which the last id ends.
    """

    starts: IntArray
    results: IntArray
    hypotheses: IntArray
    boxes: IntArray
    ids: IntArray
    end: int


def _layout(header_words: int, ids: _Strings, classes: _Strings | None) -> _Layout:
    """Lay out detections of header, hypothesis, box and id; numbers start at even words."""
    before = np.full_like(ids.words, header_words + 1)
    hypothesis_doubles = 0
    if classes is not None:
        before += classes.words
        hypothesis_doubles = _HYPOTHESIS_DOUBLES
    # The first detection follows header and count, the others an id.
    preceding = np.concatenate(([header_words + 1], ids.words[:-1]))[: len(before)]
    numbers_at = before + (preceding + before & 1)
    ids_at = numbers_at + 2 * (hypothesis_doubles + len(_BOX))
    ends = header_words + 1 + (ids_at + ids.words).cumsum()
    starts = ends - ids_at - ids.words
    hypotheses = starts + numbers_at >> 1
    return _Layout(
        starts,
        starts + header_words,
        hypotheses,
        hypotheses + hypothesis_doubles,
        starts + ids_at,
        int(ends[-1]) if len(ends) else header_words + 1,
    )


def _index(layout: _Layout, header_words: int, words: Words) -> ElementIndex:
    """Describe the new message as `read_elements` does."""
    ends = 4 * (layout.ids + 1) + words[layout.ids]
    fields = {
        'header.stamp.sec': 4 * layout.starts,
        'results': 4 * layout.results,
        'results.hypothesis.class_id': 4 * (layout.results + 1),
        'results.hypothesis.score': 8 * layout.hypotheses,
        'bbox.center.position.x': 8 * layout.boxes,
        'id': 4 * layout.ids,
    }
    end = int(ends[-1]) if len(ends) else 4 * layout.end
    return ElementIndex(header_words, len(ends), fields, end, ends)
