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
from obbhbb_ros.wire.layouts import Field
from obbhbb_ros.wire.layouts import InputType
from obbhbb_ros.wire.walk import ranges
from obbhbb_ros.wire.writing import text_bytes

if TYPE_CHECKING:
    from obbhbb_ros.geometry.boxes import FloatArray

# Each detection has a copy of the message's header. Their words together may be this many times
# the words of the message.
_MAX_HEADERS = 16
# An empty polygon has four bytes, and takes 700 in memory; from so many on, half may be empty.
_MANY_POLYGONS = 1000
# Doubles of a box: x, y, theta, size x, size y.
_BOX_DOUBLES = np.arange(5)
_NO_BOX = np.array([nan, nan, 0.0, nan, nan])
# Score, position, orientation, covariance. In a new message, w of the orientation is 1.
_HYPOTHESIS_WORDS = 2 * (1 + 3 + 4 + 36)
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

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If most of many polygons are empty.
    """
    (step,) = input_type.element
    numbers = buffer.words.view(f'<f{step.size}')
    places = index.places(input_type.points)
    counts = buffer.words[places >> 2].tolist()
    if len(counts) > _MANY_POLYGONS and 2 * counts.count(0) > len(counts):
        raise WireError(f'{counts.count(0)} of {len(counts)} polygons are empty')
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
    ids = _strings(buffer.words, index.places(input_type.id)) if input_type.id else _empty(count)
    classes = None
    if input_type.class_id:
        classes = _strings(buffer.words, index.places(input_type.class_id))
    new = _layout(len(header), ids, classes)
    written = EditableBuffer(LITTLE_ENDIAN + header.tobytes(), new.end - 4 * len(header))
    words, doubles = written.words, written.words.view(np.float64)
    words[len(header)] = count
    words[(new.places(Field.START) >> 2)[:, None] + np.arange(len(header))] = header
    words[new.places(Field.RESULTS) >> 2] = classes is not None
    _copy(ids, words, new.places(Field.ID))
    numbers = buffer.words.view(np.float64)
    if classes is not None:
        _copy(classes, words, new.places(Field.CLASS))
        hypotheses = new.places(Field.SCORE) >> 3
        doubles[hypotheses] = numbers[index.places(input_type.score) >> 3]
        doubles[hypotheses + _ORIENTATION_W] = 1.0
    boxes = _NO_BOX
    if input_type.box:
        boxes = numbers[(index.places(input_type.box) >> 3)[:, None] + _BOX_DOUBLES]
    doubles[(new.places(Field.BOX) >> 3)[:, None] + _BOX_DOUBLES] = boxes
    return written, new


class _Strings(NamedTuple):
    """N strings in a message: the place of each, and how many words it takes with its length."""

    source: Words
    places: IntArray
    sizes: IntArray


def _strings(source: Words, places: IntArray) -> _Strings:
    """Measure strings."""
    return _Strings(source, places, source[places >> 2].astype(np.int64) + 7 >> 2)


def _empty(count: int) -> _Strings:
    """Write an empty string for each element."""
    return _strings(np.frombuffer(text_bytes(b''), '<u4'), np.zeros(count, np.int64))


def _copy(strings: _Strings, target: Words, places: IntArray) -> None:
    """Copy strings to their places in another message."""
    sources = ranges(strings.places >> 2, strings.sizes)
    targets = sources + np.repeat((places - strings.places) >> 2, strings.sizes)
    target[targets] = strings.source[sources]


def _layout(header_words: int, ids: _Strings, classes: _Strings | None) -> ElementIndex:
    """Lay out detections of header, hypothesis, box and id; numbers start at even words."""
    hypothesis_words = 0
    numbers = np.full_like(ids.sizes, header_words + 1)
    if classes is not None:
        hypothesis_words = _HYPOTHESIS_WORDS
        numbers += classes.sizes
    # The first detection follows header and count, the others follow an id.
    preceding = np.concatenate(([header_words + 1], ids.sizes[:-1]))[: len(numbers)]
    numbers += preceding + numbers & 1
    boxes = numbers + hypothesis_words
    id_starts = boxes + 2 * len(_BOX_DOUBLES)
    sizes = id_starts + ids.sizes
    starts = header_words + 1 + sizes.cumsum() - sizes
    fields = {
        Field.START: 4 * starts,
        Field.RESULTS: 4 * (starts + header_words),
        Field.CLASS: 4 * (starts + header_words + 1),
        Field.SCORE: 4 * (starts + numbers),
        Field.BOX: 4 * (starts + boxes),
        Field.ID: 4 * (starts + id_starts),
    }
    ends = fields[Field.ID] + 4 + ids.source[ids.places >> 2]
    end = int(ends[-1]) if len(ends) else 4 * (header_words + 1)
    return ElementIndex(header_words, len(ends), fields, ends, end)
