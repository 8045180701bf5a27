"""
CDR bytes <-> arrays, without ROS: `vision_msgs/Detection2DArray` and `sensor_msgs/Image`.

rclpy spends about 0.1 ms on the objects of each detection. Here a message stays what it was on
the wire: the five numbers of each box are found, changed in a copy, and everything else travels
untouched.

A message is described once, as the tables below have it; positions follow from the description
and the rules of CDR (XCDR1): a number of n bytes lies at a multiple of n from the end of the
4-byte encapsulation header, a string or a sequence starts with its length in four bytes.

Detections whose strings and sequences have the same lengths have their fields at the same
places. Each such form is walked once and remembered as a `_Template`; the next detection of the
same form costs a few look-ups, and a run of them is verified at once with NumPy.
"""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field
from typing import Any
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]

ENCAPSULATION = 4
_PLAIN_CDR = {b'\x00\x00\x00\x00': '>', b'\x00\x01\x00\x00': '<'}
_LITTLE_ENDIAN = np.array([0, 1, 0, 0], np.uint8)
_PADDING = bytes(8)


class WireError(ValueError):
    """Bytes that are no such message; the text says what is wrong and at which byte."""


class NotPlainCdrError(WireError):
    """Bytes that may be such a message, but not in a form that is read here."""


@dataclass(frozen=True)
class Numbers:
    """`count` numbers of `size` bytes each, one behind the other."""

    size: int
    count: int = 1


@dataclass(frozen=True)
class Text:
    """A string: its length with the closing zero byte, then its bytes."""


@dataclass(frozen=True)
class Octets:
    """A sequence of bytes: their number, then the bytes."""


@dataclass(frozen=True)
class Many:
    """A sequence: its length, then the elements."""

    element: Struct


Struct: TypeAlias = dict[str, Any]
"""Fields in order, by name; a value is one of the kinds above or another struct."""

_UINT8 = Numbers(1)
_INT32 = _UINT32 = Numbers(4)
_FLOAT64 = Numbers(8)

HEADER: Struct = {'stamp': {'sec': _INT32, 'nanosec': _UINT32}, 'frame_id': Text()}
HYPOTHESIS: Struct = {'class_id': Text(), 'score': _FLOAT64}
POSE: Struct = {'position': Numbers(8, 3), 'orientation': Numbers(8, 4)}
DETECTION_2D: Struct = {
    'header': HEADER,
    'results': Many({
        'hypothesis': HYPOTHESIS, 'pose': {'pose': POSE, 'covariance': Numbers(8, 36)},
    }),
    'bbox': {
        'center': {'position': {'x': _FLOAT64, 'y': _FLOAT64}, 'theta': _FLOAT64},
        'size_x': _FLOAT64,
        'size_y': _FLOAT64,
    },
    'id': Text(),
}
DETECTION_2D_ARRAY: Struct = {'header': HEADER, 'detections': Many(DETECTION_2D)}
IMAGE: Struct = {
    'header': HEADER,
    'height': _UINT32,
    'width': _UINT32,
    'encoding': Text(),
    'is_bigendian': _UINT8,
    'step': _UINT32,
    'data': Octets(),
}

_BOX = 'detections.bbox.center.position.x'
_CLASS = 'detections.results.hypothesis.class_id'
_SCORE = 'detections.results.hypothesis.score'
# The numbers of a box in the order that `OrientedBoxes.from_xywhr` takes them.
_XYWHR = np.array([0, 1, 3, 4, 2])
_XYWH = _XYWHR[:4]
_HYPOTHESIS_NUMBERS = 44
# Of the lengths in a detection, that of its hypotheses comes behind that of its frame_id.
_RESULTS = 1
ID_SEPARATOR = '|'


@dataclass
class _Step:
    """One field, flattened: where it goes in the walk and what its parts need at least."""

    path: str
    kind: Numbers | Text | Octets | Many
    inner: list[_Step] = field(default_factory=list)

    @property
    def min_size(self) -> int:
        """Fewest bytes that this field can take."""
        return self.kind.size * self.kind.count if isinstance(self.kind, Numbers) else 4


def _flatten(struct: Struct, prefix: str = '') -> list[_Step]:
    """List the fields of a struct and of the structs in it."""
    steps = []
    for name, kind in struct.items():
        path = prefix + name
        if isinstance(kind, dict):
            steps += _flatten(kind, path + '.')
        elif isinstance(kind, Many):
            steps.append(_Step(path, kind, _flatten(kind.element, path + '.')))
        else:
            steps.append(_Step(path, kind))
    return steps


@dataclass
class _Trace:
    """Where a walk found things, in bytes behind the encapsulation header."""

    lengths: list[tuple[int, int]] = field(default_factory=list)
    numbers: list[tuple[int, int, int]] = field(default_factory=list)
    joints: list[tuple[int, int]] = field(default_factory=list)
    padding: list[int] = field(default_factory=list)
    found: dict[str, list[int]] = field(default_factory=dict)
    end: int = 0
    aligned: bool = False


class _Walk:
    """Goes through fields one by one, and never leaves the bytes that are there."""

    def __init__(self, words: Sequence[int], limit: int) -> None:
        self._words = words
        self._limit = limit

    def over(self, steps: Sequence[_Step], start: int) -> _Trace:
        """Walk over the fields of a struct that begins at `start`."""
        trace = _Trace(end=start)
        self._fields(steps, trace)
        return trace

    def _fields(self, steps: Sequence[_Step], trace: _Trace) -> None:
        """Walk over some fields."""
        for step in steps:
            kind = step.kind
            if isinstance(kind, Numbers):
                self._numbers(step.path, kind, trace)
            elif isinstance(kind, Text):
                self._text(step.path, trace)
            elif isinstance(kind, Octets):
                self._octets(step.path, trace)
            else:
                self._many(step, trace)

    def count(self, step: _Step, start: int) -> _Trace:
        """Read how many elements a sequence has, and that they can be there."""
        trace = _Trace(end=start)
        self._count(step, trace)
        return trace

    def _numbers(self, path: str, kind: Numbers, trace: _Trace) -> None:
        """Walk over numbers."""
        at = self._align(trace, kind.size)
        # Only behind something else can the padding before an 8-byte number depend on the place.
        if kind.size == 8 and not trace.aligned:
            trace.joints.append((trace.end, at))
        trace.aligned = kind.size == 8
        trace.numbers.append((kind.size, at, kind.count))
        trace.found.setdefault(path, []).append(at)
        trace.end = self._inside(at + kind.size * kind.count, path)

    def _text(self, path: str, trace: _Trace) -> None:
        """Walk over a string."""
        length = self._length(path, trace)
        if length == 0:
            raise NotPlainCdrError(f'{path} at byte {trace.end} has no closing zero')
        trace.found.setdefault(path, []).append(trace.end)
        trace.end = self._inside(trace.end + length, path)

    def _octets(self, path: str, trace: _Trace) -> None:
        """Walk over a sequence of bytes."""
        length = self._length(path, trace)
        trace.found.setdefault(path, []).append(trace.end)
        trace.end = self._inside(trace.end + length, path)

    def _many(self, step: _Step, trace: _Trace) -> None:
        """Walk over a sequence."""
        for _ in range(self._count(step, trace)):
            self._fields(step.inner, trace)

    def _count(self, step: _Step, trace: _Trace) -> int:
        """Read the length of a sequence; refuse one that the bytes left cannot hold."""
        count = self._length(step.path, trace)
        if count * sum(inner.min_size for inner in step.inner) > self._limit - trace.end:
            raise WireError(f'{step.path} at byte {trace.end} cannot hold {count} elements')
        return count

    def _length(self, path: str, trace: _Trace) -> int:
        """Read a length and step behind it."""
        at = self._align(trace, 4)
        trace.end = self._inside(at + 4, path)
        length = int(self._words[at // 4])
        trace.lengths.append((at, length))
        trace.aligned = False
        return length

    def _align(self, trace: _Trace, size: int) -> int:
        """Tell where the next number of `size` bytes lies; its place may be padded."""
        at = _aligned(trace.end, size)
        trace.padding += range(trace.end, at)
        return at

    def _inside(self, end: int, path: str) -> int:
        """Refuse to go behind the last byte."""
        if end > self._limit:
            raise WireError(f'{path} ends at byte {end}, the message has {self._limit}')
        return end


class _Template:
    """One form of detection: where its fields lie, in bytes from its start."""

    def __init__(self, trace: _Trace, start: int) -> None:
        self.lengths = [(at - start, length) for at, length in trace.lengths]
        self.size = trace.end - start
        self.stride = _aligned(self.size, 4)
        self.box = trace.found[_BOX][0] - start
        self.classes = np.array(trace.found.get(_CLASS, []), np.int64) - start
        self.scores = np.array(trace.found.get(_SCORE, []), np.int64) - start
        self.swaps = _numbers_by_size(trace, start)
        padding = [at - start for at in trace.padding]
        self.padding = np.array([*padding, *range(self.size, self.stride)], np.int64)
        self.moved = _moved(trace, start)


@dataclass(frozen=True)
class _Moved:
    """A detection laid out four bytes off: what to copy with what padding, where the box is."""

    pieces: list[tuple[bytes, int, int]]
    size: int
    box: int


def _moved(trace: _Trace, start: int) -> _Moved:
    """Lay a walked detection out for a start that differs by four from a multiple of eight."""
    pieces = []
    padding, copied, size, box = b'', start, 0, 0
    phase = (start + 4) % 8
    for end, at in trace.joints:
        pieces.append((padding, copied - start, end - start))
        size += len(padding) + end - copied
        padding, copied = bytes(-(phase + size) % 8), at
        if at <= trace.found[_BOX][0]:
            box = size + len(padding) + trace.found[_BOX][0] - at
    pieces.append((padding, copied - start, trace.end - start))
    return _Moved(pieces, size + len(padding) + trace.end - copied, box)


def _numbers_by_size(trace: _Trace, start: int) -> dict[int, IntArray]:
    """List the numbers of a walk by their size, for turning their bytes around."""
    places: dict[int, list[int]] = {4: [at for at, _ in trace.lengths], 8: []}
    for size, at, count in trace.numbers:
        places[size] += range(at, at + size * count, size)
    return {size: np.array(found, np.int64) - start for size, found in places.items()}


def _aligned(position: int, size: int) -> int:
    """Go on to the next multiple of `size`."""
    return -(-position // size) * size


_HEADER_STEPS = _flatten(HEADER)
_ELEMENT = next(step for step in _flatten(DETECTION_2D_ARRAY) if isinstance(step.kind, Many))
_MIN_RUN = 16
_MOST_PADDING = 64


_Node: TypeAlias = list[Any]
"""Where the next length lies, in words from the start; a node or a form by its value."""


def _node() -> _Node:
    """Make a node that leads nowhere yet."""
    return [0, {}]


class Forms:
    """
    Memory of the forms of detection seen so far; share one among the messages of a topic.

    It holds at most `capacity` forms from one message to the next.

    Parameters
    ----------
    capacity : int
        With more than so many forms it starts afresh.
    """

    def __init__(self, capacity: int = 512) -> None:
        self._capacity = capacity
        self._forget()

    def _forget(self) -> None:
        """Know no form."""
        self.templates: list[_Template] = []
        # Behind another multiple of eight the same lengths make another form: two trees.
        self.known: tuple[_Node, _Node] = (_node(), _node())
        self._tables: tuple[IntArray, ...] = ()
        self._padding = np.empty((0, 0), np.int64)

    def make_room(self) -> None:
        """Forget everything if that has become too much."""
        if len(self.templates) > self._capacity:
            self._forget()

    def learn(self, template: _Template, start: int) -> int:
        """Remember a form, found at `start`; give its number."""
        form = len(self.templates)
        self.templates.append(template)
        node = self.known[start // 4 % 2]
        *before, (last, value) = template.lengths
        for at, length in before:
            node[0] = at // 4
            node = node[1].setdefault(length, _node())
        node[0] = last // 4
        node[1][value] = form
        return form

    def tables(self) -> tuple[IntArray, ...]:
        """
        Give by form what most detections need.

        Returns
        -------
        boxes, scores, classes : ndarray of int, shape (F,)
            Where box, score and class id lie, in bytes from the start of the detection; the last
            two are 0 for forms that do not have just one hypothesis.
        """
        if not self._tables or len(self._tables[0]) != len(self.templates):
            rows = [
                (t.box, t.scores[0], t.classes[0]) if t.scores.size == 1 else (t.box, 0, 0)
                for t in self.templates
            ]
            self._tables = tuple(np.array(rows, np.int64).reshape(-1, 3).T)
        return self._tables

    def padding(self) -> IntArray | None:
        """
        Give the bytes between fields by form, in bytes from the start of the detection.

        Returns
        -------
        ndarray of int, shape (F, P), or None
            Some repeated, to fill the rows, and -1 for a form without any; None where a form has
            so many that a table of them would take more memory than the message justifies.
        """
        if len(self._padding) != len(self.templates):
            most = max(1, *(t.padding.size for t in self.templates))
            if most > _MOST_PADDING:
                return None
            self._padding = np.array([
                np.resize(t.padding, most) if t.padding.size else np.full(most, -1)
                for t in self.templates
            ]).reshape(-1, most)
        return self._padding


class _Finder:
    """
    Finds the detections of a message: where each starts and which form it has.

    Parameters
    ----------
    words : ndarray of uint32
        The message behind its encapsulation header.
    limit : int
        How many bytes that are.
    forms : Forms
        The forms known so far.

    Raises
    ------
    WireError
        If they are no such message.
    """

    def __init__(self, words: NDArray[np.uint32], limit: int, forms: Forms) -> None:
        self._words = words
        # Reading an element of a memoryview takes a third of the time of a NumPy scalar.
        self._view = memoryview(words.data)
        self._limit = limit
        self._walk = _Walk(self._view, limit)
        self._memory = forms
        self.header = self._walk.over(_HEADER_STEPS, 0)
        counted = self._walk.count(_ELEMENT, self.header.end)
        self.count_at, count = counted.lengths[0]
        self.starts = np.empty(count, np.int64)
        self.forms = np.empty(count, np.int64)
        self.end = counted.end
        self._find_all(count)

    def _find_all(self, count: int) -> None:
        """Go from detection to detection, in leaps where many in a row have one form."""
        view, known, templates = self._view, self._memory.known, self._memory.templates
        starts: list[int] = []
        forms: list[int] = []
        done, alike, wanted, last = 0, 0, 3, -1
        while done + len(starts) < count:
            start = (self.end + 3) // 4
            node: Any = known[start % 2]
            try:
                while node.__class__ is list:
                    node = node[1][view[start + node[0]]]
            except (IndexError, KeyError):
                node = self._learn(4 * start)
            starts.append(4 * start)
            forms.append(node)
            self.end = 4 * start + templates[node].size
            alike, last = alike + 1 if node == last else 1, node
            if alike >= wanted and count - done - len(starts) >= _MIN_RUN:
                done = self._note(done, starts, forms)
                leap = self._leap(done, count - done)
                done += leap
                # Where runs are short, looking for them is dearer than what they save.
                wanted, alike = (1, 0) if leap >= _MIN_RUN else (3 * wanted, 0)
        self._note(done, starts, forms)
        if self.end > self._limit:
            raise WireError(f'{_ELEMENT.path} ends at byte {self.end} of {self._limit}')

    def _learn(self, start: int) -> int:
        """Walk over a detection of a form not seen before."""
        template = _Template(self._walk.over(_ELEMENT.inner, start), start)
        return self._memory.learn(template, start)

    def _note(self, done: int, starts: list[int], forms: list[int]) -> int:
        """Write down what was found one by one; tell how many detections that makes."""
        behind = done + len(starts)
        self.starts[done:behind] = starts
        self.forms[done:behind] = forms
        starts.clear()
        forms.clear()
        return behind

    def _leap(self, index: int, most: int) -> int:
        """Take in all detections from `index` on that have the form of the one before."""
        form = int(self.forms[index - 1])
        template = self._memory.templates[form]
        start = int(self.starts[index - 1]) + template.stride
        most = min(most, (self._limit - start - template.size) // template.stride + 1)
        # Four bytes on, another form holds for the same lengths.
        if template.stride % 8 or most < _MIN_RUN:
            return 0
        step = template.stride // 4
        alike = np.ones(most, np.bool_)
        for at, length in template.lengths:
            first = (start + at) // 4
            alike &= self._words[first : first + step * (most - 1) + 1 : step] == length
        count = most if alike.all() else int(alike.argmin())
        self.starts[index : index + count] = start + template.stride * np.arange(count)
        self.forms[index : index + count] = form
        self.end = start + template.stride * (count - 1) + template.size if count else self.end
        return count


class Detections:
    """
    The detections of one message, in its bytes.

    Parameters
    ----------
    data : bytes
        A serialized `vision_msgs/Detection2DArray` with its encapsulation header, of either
        endianness, with up to 3 bytes of padding behind it.
    forms : Forms, optional
        Memory of forms seen in earlier messages, to be added to.

    Raises
    ------
    NotPlainCdrError
        If the bytes may be read in another way, but not here.
    WireError
        If they are no such message.
    """

    def __init__(self, data: bytes, forms: Forms | None = None) -> None:
        order = _PLAIN_CDR.get(bytes(data[:ENCAPSULATION]))
        if order is None:
            raise NotPlainCdrError(f'encapsulation {bytes(data[:ENCAPSULATION]).hex()}')
        limit = len(data) - ENCAPSULATION
        # Copied to where numbers are aligned, the encapsulation header before a multiple of
        # eight, and rounded up so that it can be seen as numbers.
        self._buffer = np.empty(2 * ENCAPSULATION + _aligned(limit, 8), np.uint8)
        self._buffer[:ENCAPSULATION] = 0
        self._buffer[ENCAPSULATION : 2 * ENCAPSULATION + limit] = np.frombuffer(data, np.uint8)
        self._buffer[ENCAPSULATION : 2 * ENCAPSULATION] = _LITTLE_ENDIAN
        self._body = self._buffer[2 * ENCAPSULATION :]
        self._body[limit:] = 0
        words = self._body.view(order + 'u4')[: limit // 4]
        forms = Forms() if forms is None else forms
        forms.make_room()
        found = _Finder(np.ascontiguousarray(words, np.uint32), limit, forms)
        if limit - found.end > 3:
            raise NotPlainCdrError(f'{limit - found.end} bytes behind the message')
        self._found = found
        # The memory may be emptied for a later message; what this one needs stays.
        self._templates, self._tables = forms.templates, forms.tables()
        if order == '>':
            self._turn_around()
        self._blank_padding(forms.padding() if len(found.starts) else None)
        self._numbers = self._body.view('<f8')
        self._boxes_at = self._at(0) // 8

    def __len__(self) -> int:
        """Count the detections."""
        return len(self._found.starts)

    def _at(self, table: int) -> IntArray:
        """Tell where a field of each detection lies, by one of the forms' tables."""
        return self._found.starts + self._tables[table][self._found.forms]

    @property
    def stamp(self) -> tuple[int, int]:
        """Seconds and nanoseconds of the message's stamp."""
        seconds, nanoseconds = self._body[:8].view('<u4').tolist()
        return seconds - (seconds >> 31 << 32), nanoseconds

    def xywhr(self) -> FloatArray:
        """
        Read the oriented boxes.

        Returns
        -------
        ndarray, shape (N, 5)
            Centre x and y, size x and y, theta, as `OrientedBoxes.from_xywhr` takes them.
        """
        return self._numbers[self._boxes_at[:, None] + _XYWHR]

    def best_hypotheses(self) -> tuple[IntArray, FloatArray]:
        """
        Find each detection's best hypothesis.

        Returns
        -------
        classes_at : ndarray of int, shape (N,)
            Where its class id lies, for `class_ids`; 0 where there is no hypothesis.
        scores : ndarray, shape (N,)
            Its score, NaN where there is none. The first of equals is taken.
        """
        if self._tables[1][self._found.forms].all():
            return self._at(2), self._numbers[self._at(1) // 8]
        scores = np.full(len(self), np.nan)
        classes_at = np.zeros(len(self), np.int64)
        for form, rows in self._rows_by_form():
            template = self._templates[form]
            if not template.scores.size:
                continue
            starts = self._found.starts[rows]
            values = self._numbers[(starts[:, None] + template.scores) // 8]
            best = np.nan_to_num(values, nan=-np.inf).argmax(axis=1)
            scores[rows] = values[np.arange(len(rows)), best]
            classes_at[rows] = starts + template.classes[best]
        return classes_at, scores

    def class_ids(self, classes_at: IntArray) -> list[str]:
        """
        Read class ids.

        Parameters
        ----------
        classes_at : ndarray of int, shape (N,)
            Where `best_hypotheses` found them.

        Returns
        -------
        list of str
            N class ids, empty where there is no hypothesis. Bytes that are no UTF-8 are escaped.
        """
        lengths = self._body.view('<u4')[classes_at // 4 - 1] - 1
        raw = self._body.data
        return [
            bytes(raw[at : at + length]).decode(errors='backslashreplace') if at else ''
            for at, length in zip(classes_at.tolist(), lengths.tolist(), strict=True)
        ]

    def rewrite(self, xywh: FloatArray, rows: NDArray[np.bool_] | None = None) -> bytes:
        """
        Give the message with other boxes; all else is as it was.

        The boxes of this object change as well.

        Parameters
        ----------
        xywh : ndarray, shape (N, 4)
            Centre x and y, size x and y of the axis-aligned boxes, pixels.
        rows : ndarray of bool, shape (N,), optional
            Which detections get them; the others keep their oriented box.

        Returns
        -------
        bytes
            The serialized message, little-endian.
        """
        if rows is None:
            _write_boxes(self._body, self._boxes_at, xywh)
        else:
            _write_boxes(self._body, self._boxes_at[rows], xywh[rows])
        return self._buffer[ENCAPSULATION : 2 * ENCAPSULATION + self._found.end].tobytes()

    def selected(self, rows: IntArray, xywh: FloatArray) -> bytes:
        """
        Give the message with some of its detections, in another order, with other boxes.

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
        raw = self._body.tobytes()
        found, templates = self._found, self._templates
        chunks, end = self._beginning(raw, len(rows))
        boxes_at = []
        starts, forms = found.starts[rows].tolist(), found.forms[rows].tolist()
        for start, form in zip(starts, forms, strict=True):
            template = templates[form]
            at = _aligned(end, 4)
            if at != end:
                chunks.append(_PADDING[: at - end])
            if (at - start) % 8 == 0:
                chunks.append(raw[start : start + template.size])
                boxes_at.append(at + template.box)
                end = at + template.size
            else:
                for padding, begin, stop in template.moved.pieces:
                    chunks += (padding, raw[start + begin : start + stop])
                boxes_at.append(at + template.moved.box)
                end = at + template.moved.size
        return _ending(chunks, end, boxes_at, xywh)

    def joined(self, groups: Sequence[Sequence[int]], xywh: FloatArray) -> bytes:
        """
        Give the message with one detection for each group of its detections.

        Parameters
        ----------
        groups : sequence of sequences of int
            M groups of one detection or more, in the order wanted.
        xywh : ndarray, shape (M, 4)
            Centre x and y, size x and y of their axis-aligned boxes, pixels.

        Returns
        -------
        bytes
            The serialized message, little-endian. A detection has the header of the first of its
            group, all hypotheses of the group, and the ids of the group joined by `ID_SEPARATOR`.
        """
        raw = self._body.tobytes()
        chunks, end = self._beginning(raw, len(groups))
        boxes_at = []
        for group in groups:
            parts = [self._parts(raw, row) for row in group]
            count = sum(len(hypotheses) for _, hypotheses, _ in parts)
            pieces = [(4, parts[0][0]), (4, count.to_bytes(4, 'little'))]
            for _, hypotheses, _ in parts:
                for class_id, numbers in hypotheses:
                    pieces += ((4, class_id), (8, numbers))
            pieces.append((8, bytes(8 * _XYWHR.size)))
            pieces.append((4, _text(ID_SEPARATOR.encode().join(each for *_, each in parts))))
            for size, piece in pieces:
                at = _aligned(end, size)
                chunks += (_PADDING[: at - end], piece)
                end = at + len(piece)
            # The last piece follows the box without padding.
            boxes_at.append(at - 8 * _XYWHR.size)
        return _ending(chunks, end, boxes_at, xywh)

    def _beginning(self, raw: bytes, count: int) -> tuple[list[bytes], int]:
        """Begin a message of `count` detections; also tell how long that is."""
        at = self._found.count_at
        chunks = [bytes(ENCAPSULATION), _LITTLE_ENDIAN.tobytes(), raw[:at]]
        return [*chunks, count.to_bytes(4, 'little')], at + 4

    def _parts(self, raw: bytes, row: int) -> tuple[bytes, list[tuple[bytes, bytes]], bytes]:
        """Take a detection apart: header, class id and numbers of each hypothesis, id."""
        start = int(self._found.starts[row])
        template = self._templates[self._found.forms[row]]
        # Up to the last byte that is no padding.
        frame_at, frame_size = template.lengths[0]
        header = raw[start : start + frame_at + 4 + frame_size]
        hypotheses = []
        class_lengths = template.lengths[_RESULTS + 1 : -1]
        for (at, length), numbers in zip(class_lengths, template.scores.tolist(), strict=True):
            behind = start + numbers + 8 * _HYPOTHESIS_NUMBERS
            class_id = raw[start + at : start + at + 4 + length]
            hypotheses.append((class_id, raw[start + numbers : behind]))
        at, length = template.lengths[-1]
        return header, hypotheses, raw[start + at + 4 : start + at + 4 + length - 1]

    def _rows_by_form(self) -> Iterator[tuple[int, IntArray]]:
        """Group the detections by their form."""
        forms = self._found.forms
        order = np.argsort(forms, kind='stable')
        bounds = np.flatnonzero(np.diff(forms[order])) + 1
        for rows in np.split(order, bounds) if len(order) else ():
            yield int(forms[rows[0]]), rows

    def _blank_padding(self, padding: IntArray | None) -> None:
        """Zero the bytes between fields: what writers leave there is whatever their memory held."""
        found = self._found
        self._body[[*found.header.padding, *range(found.header.end, found.count_at)]] = 0
        if padding is not None:
            at = padding[found.forms]
            at += found.starts[:, None]
            if padding.size and padding.min() < 0:
                at = at[padding[found.forms, 0] >= 0]
            self._body[at] = 0
            return
        for form, rows in self._rows_by_form():
            self._body[found.starts[rows][:, None] + self._templates[form].padding] = 0

    def _turn_around(self) -> None:
        """Turn the bytes of every number around, from big-endian to little-endian."""
        found = self._found
        places = {size: [at] for size, at in _numbers_by_size(found.header, 0).items()}
        places[4].append(np.array([found.count_at], np.int64))
        for form, rows in self._rows_by_form():
            for size, relative in self._templates[form].swaps.items():
                places[size].append((found.starts[rows][:, None] + relative).ravel())
        for size, parts in places.items():
            numbers = self._body.view(f'u{size}')
            at = np.concatenate(parts) // size
            numbers[at] = numbers[at].byteswap()


def _text(content: bytes) -> bytes:
    """Write a string."""
    return (len(content) + 1).to_bytes(4, 'little') + content + b'\0'


def _ending(chunks: list[bytes], end: int, boxes_at: list[int], xywh: FloatArray) -> bytes:
    """Make a message of chunks that hold `end` bytes, with boxes at the places given."""
    chunks.append(_PADDING[: _aligned(end, 8) - end])
    buffer = np.frombuffer(bytearray().join(chunks), np.uint8)
    at_numbers = np.array(boxes_at, np.int64) // 8
    _write_boxes(buffer[2 * ENCAPSULATION :], at_numbers, xywh)
    return buffer[ENCAPSULATION : 2 * ENCAPSULATION + end].tobytes()


def _write_boxes(body: NDArray[np.uint8], boxes_at: IntArray, xywh: FloatArray) -> None:
    """Write axis-aligned boxes at the numbers of `body` that `boxes_at` counts to."""
    numbers = body.view('<f8')
    numbers[boxes_at[:, None] + _XYWH] = xywh
    numbers[boxes_at + 2] = 0.0


@dataclass(frozen=True)
class WireImage:
    """
    A `sensor_msgs/Image` in its bytes.

    Attributes
    ----------
    stamp : tuple of int
        Seconds and nanoseconds.
    frame_id, encoding : str
        As in the message; bytes that are no UTF-8 are escaped.
    width, height : int
        Pixels.
    step : int
        Bytes from one row to the next.
    is_bigendian : bool
        Order of the bytes in a pixel.
    data : memoryview
        The pixels, a view into the bytes that the message was read from.
    """

    stamp: tuple[int, int]
    frame_id: str
    encoding: str
    width: int
    height: int
    step: int
    is_bigendian: bool
    data: memoryview


_IMAGE_STEPS = _flatten(IMAGE)


def read_image(data: bytes) -> WireImage:
    """
    Read an image without copying its pixels.

    Parameters
    ----------
    data : bytes
        A serialized `sensor_msgs/Image` with its encapsulation header, of either endianness, with
        up to 3 bytes of padding behind it.

    Returns
    -------
    WireImage
        The image, which keeps `data` alive.

    Raises
    ------
    WireError
        If the bytes are no such message.
    """
    order = _PLAIN_CDR.get(bytes(data[:ENCAPSULATION]))
    if order is None:
        raise NotPlainCdrError(f'encapsulation {bytes(data[:ENCAPSULATION]).hex()}')
    body = memoryview(data)[ENCAPSULATION:]
    words: Any = np.frombuffer(body, order + 'u4', len(body) // 4)
    trace = _Walk(words, len(body)).over(_IMAGE_STEPS, 0)
    if len(body) - trace.end > 3:
        raise WireError(f'{len(body) - trace.end} bytes behind the image')
    lengths = {at + 4: length for at, length in trace.lengths}

    def number(path: str) -> int:
        return int(words[trace.found[path][0] // 4])

    def content(path: str, closing: int = 0) -> memoryview:
        at = trace.found[path][0]
        return body[at : at + lengths[at] - closing]

    def text(path: str) -> str:
        return bytes(content(path, 1)).decode(errors='backslashreplace')

    seconds = number('header.stamp.sec')
    return WireImage(
        stamp=(seconds - (seconds >> 31 << 32), number('header.stamp.nanosec')),
        frame_id=text('header.frame_id'),
        encoding=text('encoding'),
        width=number('width'),
        height=number('height'),
        step=number('step'),
        is_bigendian=bool(body[trace.found['is_bigendian'][0]]),
        data=content('data'),
    )


def canonical(data: bytes) -> bytes:
    """
    Give the one form of a message that both paths of the node publish.

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
    WireError
        If the bytes are no such message.
    """
    detections = Detections(data)
    nothing = np.zeros(len(detections), np.bool_)
    return detections.rewrite(np.empty((len(detections), 4)), nothing)
