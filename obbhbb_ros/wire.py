# SPDX-License-Identifier: Apache-2.0
"""
CDR bytes <-> arrays, without ROS: `vision_msgs/Detection2DArray` and `sensor_msgs/Image`.

rclpy spends about 0.1 ms on the objects of each detection. Here a message stays what it was on
the wire: the five numbers of each box are found, changed in a copy, and everything else travels
untouched.

A message is described once, as the tables below have it; positions follow from the description
and the rules of CDR (XCDR1): a number of n bytes lies at a multiple of n from the end of the
4-byte encapsulation header, a string or a sequence starts with its length in four bytes.

Detections whose strings and sequences have the same lengths have their fields at the same
places. Each such form is walked once and remembered as a `_Form`; the next detection of the
same form costs a few look-ups. Many detections are looked up all at once with NumPy, which is
sure of where they start as each has to end where the next one starts.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field
from operator import itemgetter
from typing import Any
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.boxes import FEW

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]

ENCAPSULATION = 4
_PLAIN_CDR = {b'\x00\x00\x00\x00': '>', b'\x00\x01\x00\x00': '<'}
_LITTLE_ENDIAN = b'\x00\x01\x00\x00'
_PADDING = bytes(8)
_FLOAT = np.dtype('<f8')
# In a buffer four bytes lie before the encapsulation header, so that its body is aligned.
_BODY = 2 * ENCAPSULATION


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
# The numbers of a box in the order that `OrientedBoxes.from_xywhr` takes them, (5, 1).
_XYWHR = np.array([[0], [1], [3], [4], [2]])
_STAMP = struct.Struct('<iI')
_BOX_NUMBERS = struct.Struct('<5d')
_THETA_AND_SIZES = struct.Struct('<3d')
_in_order = itemgetter(*_XYWHR.ravel().tolist())
_HYPOTHESIS_NUMBERS = 44
# Of the lengths in a detection, that of its hypotheses comes behind that of its frame_id.
_RESULTS = 1
# The length of its frame_id lies behind its stamp.
_FRAME_ID = 8
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


class _Form:
    """One form of detection: where its fields lie, in bytes from its start, and how big it is."""

    def __init__(self, trace: _Trace, start: int) -> None:
        self.lengths = [(at - start, length) for at, length in trace.lengths]
        self.size = trace.end - start
        self.stride = _aligned(self.size, 4)
        self.phase = start % 8
        self.box = trace.found[_BOX][0] - start
        self.classes = np.array(trace.found.get(_CLASS, []), np.int64) - start
        self.scores = np.array(trace.found.get(_SCORE, []), np.int64) - start
        self.swaps = _numbers_by_size(trace, start)
        padding = [at - start for at in trace.padding]
        self.padding = np.array([*padding, *range(self.size, self.stride)], np.int64)
        self.gaps = _runs(self.padding)
        self.moved = _moved(trace, start)


def _runs(places: IntArray) -> list[tuple[int, int, bytes]]:
    """Write rising places as runs, from the first to behind the last, with as many zeros."""
    runs = np.split(places, np.flatnonzero(np.diff(places) > 1) + 1) if places.size else []
    return [(int(run[0]), int(run[-1]) + 1, bytes(len(run))) for run in runs]


@dataclass(frozen=True)
class _Moved:
    """A detection laid out four bytes off: what to copy with what padding, where the box is."""

    pieces: list[tuple[bytes, int, int]]
    stride: int
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
    # Only before numbers of eight bytes does the padding differ: up to the next start it does not.
    behind = _aligned(trace.end, 4)
    pieces.append((padding, copied - start, behind - start))
    return _Moved(pieces, size + len(padding) + behind - copied, box)


class _HeaderForm:
    """One form of message header: where the number of detections lies, what is padding."""

    def __init__(self, trace: _Trace) -> None:
        self.end = trace.end
        self.count_at = _aligned(trace.end, 4)
        self.padding = [*trace.padding, *range(trace.end, self.count_at)]
        self.swaps = _numbers_by_size(trace, 0)
        self.swaps[4] = np.append(self.swaps[4], self.count_at)


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
_LEAST_DETECTION = sum(step.min_size for step in _ELEMENT.inner)
# From so many detections on it pays to look for all at once.
_MANY = 64
# What is longer, or has more results, is not kept in tables.
_LONG = 128
_MOST_RESULTS = 5
_UNKNOWN = np.iinfo(np.int32).min
# So many words of a frame_id are compared.
_MOST_WORDS = 4
_MOST_PADDING = 64
_BYTE_ORDER = '<' if sys.byteorder == 'little' else '>'


_Node: TypeAlias = list[Any]
"""Where the next length lies, in words from the start; a node or a form by its value; which."""


def _node() -> _Node:
    """Make a node that leads nowhere yet."""
    return [0, {}, False]


def _plant(node: _Node, lengths: Sequence[tuple[int, int]], form: Any) -> None:
    """Make a tree lead to a form by its lengths."""
    *before, (last, value) = lengths
    for at, length in before:
        node[0], node[2] = at // 4, True
        node = node[1].setdefault(length, _node())
    node[0] = last // 4
    node[1][value] = form


class Forms:
    """
    Memory of the forms of detection and header seen so far; share one among a topic's messages.

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
        self.headers: _Node = _node()
        # Behind another multiple of eight the same lengths make another form: two trees.
        self.known: tuple[_Node, _Node] = (_node(), _node())
        self.all: list[_Form] = []
        self.strides: list[int] = []
        self._places = _Places(self.all)
        self._tables: _Tables | None = None

    def make_room(self) -> None:
        """Forget everything if that has become too much."""
        if len(self.all) + len(self.headers[1]) > self._capacity:
            self._forget()

    def learn_header(self, trace: _Trace) -> _HeaderForm:
        """Remember the form of a header."""
        form = _HeaderForm(trace)
        _plant(self.headers, trace.lengths, form)
        return form

    def learn(self, trace: _Trace, start: int) -> int:
        """Remember the form of a detection found at `start`; give its number."""
        form = _Form(trace, start)
        _plant(self.known[start // 4 % 2], form.lengths, len(self.all))
        self.all.append(form)
        self.strides.append(form.stride // 4)
        return len(self.all) - 1

    def places(self) -> _Places:
        """Give by form where most detections have what is needed most."""
        if len(self._places) != len(self.all):
            self._places = _Places(self.all)
            self._tables = None
        return self._places

    def tables(self) -> _Tables | None:
        """Give the trees as tables; None while every message brings new forms."""
        if len(self._places) != len(self.all):
            return None
        if self._tables is None:
            self._tables = _Tables(self.known)
        return self._tables


class _Places:
    """
    Tables by form of where detections have what is needed most.

    Numbers of eight bytes are counted from the last multiple of eight bytes at or before the start
    of the detection, by eights.

    Attributes
    ----------
    stride : ndarray of int, shape (F,)
        How far it is to the next detection, in words.
    box : ndarray of int, shape (5, F)
        Where x, y, size x, size y and theta lie.
    score : ndarray of int, shape (F,)
        Where the score lies, for forms with just one hypothesis.
    class_id : ndarray of int, shape (F,)
        Where their class id lies, in bytes from the start.
    all_single : bool
        Whether all forms have just one.
    padding : ndarray of int, shape (F, P), or None
        The bytes between fields, in bytes from the start of the detection. Some repeated, to
        fill the rows, and -1 for a form without any; None where a form has so many that a table
        of them would take more memory than the message justifies.
    some_unpadded : bool
        Whether there is a form without any.
    """

    def __init__(self, forms: Sequence[_Form]) -> None:
        self._count = len(forms)
        self.stride = np.array([form.stride // 4 for form in forms], np.int64)
        phase = np.array([form.phase for form in forms], np.int64)
        self.all_single = all(form.scores.size == 1 for form in forms)
        self.box = (np.array([form.box for form in forms], np.int64) + phase) // 8 + _XYWHR
        if self.all_single:
            self.score = (np.array([form.scores[0] for form in forms], np.int64) + phase) // 8
            self.class_id = np.array([form.classes[0] for form in forms], np.int64)
        self.padding = _padding_table(forms)
        self.some_unpadded = not all(form.padding.size for form in forms)

    def __len__(self) -> int:
        """Count the forms."""
        return self._count


class _Tables:
    """
    The trees of `Forms`, for looking up the forms of many detections at once.

    Attributes
    ----------
    roots : dict of (int, int) to ndarray of int, shape (2,)
        By the first two lengths of a detection, those of its frame_id and of its results, the node
        that comes next, for starts at an even and an odd word; `_UNKNOWN` where there is none.
    """

    def __init__(self, trees: tuple[_Node, _Node]) -> None:
        self.roots: dict[tuple[int, int], IntArray] = {}
        self._place: list[int] = []
        self._next: list[NDArray[np.int32]] = []
        for odd, tree in enumerate(trees):
            for frame_id, below in tree[1].items():
                for results, node in below[1].items():
                    if results > _MOST_RESULTS:
                        continue
                    root = self.roots.setdefault((frame_id, results), np.full(2, _UNKNOWN))
                    root[odd] = self._enter(node)
        self._places, self._nexts = np.array(self._place), np.array(self._next)

    def _enter(self, node: _Node) -> int:
        """Write a node and those below it into the tables; give its number."""
        place, below, more = node
        number = len(self._place)
        self._place.append(place)
        following = np.full(_LONG, _UNKNOWN, np.int32)
        self._next.append(following)
        for length, each in below.items():
            if length < _LONG:
                # A form is told from a node by its sign.
                following[length] = self._enter(each) if more else ~each
        return number

    def forms(
        self, words: NDArray[np.uint32], starts: IntArray, lengths: tuple[int, int]
    ) -> IntArray | None:
        """
        Look up forms.

        Parameters
        ----------
        words : ndarray of uint32
            The message.
        starts : ndarray of int, shape (N,)
            Where its detections start, in words.
        lengths : tuple of int
            The first two lengths of all.

        Returns
        -------
        ndarray of int, shape (N,), or None
            The forms; None if one is not known.

        Raises
        ------
        IndexError
            If there are not so many words.
        """
        if lengths not in self.roots:
            return None
        nodes = self.roots[lengths].take(starts & 1)
        while True:
            lowest = nodes.min()
            if lowest == _UNKNOWN:
                return None
            if lowest < 0:
                # The results of all are equal in number, and so are the lengths that lie ahead.
                return ~nodes
            found = words[starts + self._places.take(nodes)]
            if found.max() >= _LONG:
                return None
            nodes = self._nexts[nodes, found]


def _padding_table(forms: Sequence[_Form]) -> IntArray | None:
    """Write the bytes between fields by form, see `_Places`."""
    most = max([1, *(form.padding.size for form in forms)])
    if most > _MOST_PADDING:
        return None
    return np.array([
        np.resize(form.padding, most) if form.padding.size else np.full(most, -1)
        for form in forms
    ], np.int64).reshape(-1, most)


class _Finder:
    """
    Finds the detections of a message: where each starts and which form it has.

    Parameters
    ----------
    words : memoryview of uint32
        The message behind its encapsulation header.
    limit : int
        How many bytes that are.
    forms : Forms
        The forms known so far.

    Attributes
    ----------
    header : _HeaderForm
        Form of the message's header.
    count : int
        Number of detections.
    starts : ndarray of int, shape (N,)
        Where each detection starts, in words.
    forms : ndarray of int, shape (N,)
        Number of its form.
    pairs : list of tuple of int, or None
        Both, where the detections were found one by one.
    end : int
        Where the last one ends, in bytes.

    Raises
    ------
    WireError
        If they are no such message.
    """

    def __init__(self, words: memoryview, limit: int, forms: Forms) -> None:
        # Reading an element of a memoryview takes a third of the time of a NumPy scalar.
        self._words = words
        self._limit = limit
        self._memory = forms
        self.header = self._find_header()
        first = self.header.count_at + 4
        self.count = self._count()
        self.pairs: list[tuple[int, int]] | None = None
        self._arrays: tuple[IntArray, IntArray] | None = None
        if self.count < _MANY or not self._find_at_once(first // 4):
            self._find_one_by_one(first // 4)
        self.end = self._end(first)

    @property
    def starts(self) -> IntArray:
        """Where each detection starts, in words, (N,)."""
        return self._as_arrays()[0]

    @property
    def forms(self) -> IntArray:
        """Number of the form of each, (N,)."""
        return self._as_arrays()[1]

    def _as_arrays(self) -> tuple[IntArray, IntArray]:
        """Give starts and forms, once they are asked for."""
        if self._arrays is None:
            starts, forms = np.array(self.pairs, np.int64).reshape(-1, 2).T
            self._arrays = starts, forms
        return self._arrays

    def _end(self, end: int) -> int:
        """Tell where the last detection ends, `end` if there is none."""
        if self.count:
            start, form = self.pairs[-1] if self.pairs else (self.starts[-1], self.forms[-1])
            end = 4 * int(start) + self._memory.all[form].size
            if end > self._limit:
                raise WireError(f'{_ELEMENT.path} ends at byte {end} of {self._limit}')
        return end

    @property
    def _walk(self) -> _Walk:
        """Go through what is not known yet, field by field."""
        return _Walk(self._words, self._limit)

    def _find_header(self) -> _HeaderForm:
        """Find the form of the message's header."""
        place, known, _ = self._memory.headers
        try:
            form: _HeaderForm = known[self._words[place]]
        except (IndexError, KeyError):
            form = self._memory.learn_header(self._walk.over(_HEADER_STEPS, 0))
        return form

    def _count(self) -> int:
        """Read how many detections there are, and that they can be there."""
        at = self.header.count_at
        if at + 4 <= self._limit:
            count = self._words[at // 4]
            if count * _LEAST_DETECTION <= self._limit - at - 4:
                return count
        # This says what is wrong.
        return self._walk.count(_ELEMENT, self.header.end).lengths[0][1]

    def _find_one_by_one(self, word: int) -> None:
        """Go from detection to detection."""
        words, known, strides = self._words, self._memory.known, self._memory.strides
        self.pairs = pairs = []
        for _ in range(self.count):
            place, values, more = known[word & 1]
            try:
                while more:
                    place, values, more = values[words[word + place]]
                form = values[words[word + place]]
            except (IndexError, KeyError):
                form = self._memory.learn(self._walk.over(_ELEMENT.inner, 4 * word), 4 * word)
            pairs.append((word, form))
            word += strides[form]

    def _find_at_once(self, first: int) -> bool:
        """
        Find detections that all have the frame_id of the first and as many results; or give up.

        Wherever these two are, a detection may start. That they do start there is certain if each
        ends where the next one starts.
        """
        tables = self._memory.tables()
        if tables is None:
            return False
        words = np.frombuffer(self._words, np.uint32)
        try:
            starts, lengths = self._likely_starts(words, first)
            known = len(starts) == self.count
            forms = tables.forms(words, starts, lengths) if known else None
        except IndexError:
            return False
        if forms is None:
            return False
        ends = starts + self._memory.places().stride.take(forms)
        if starts[0] != first or np.not_equal(ends[:-1], starts[1:]).any():
            return False
        self._arrays = starts, forms
        return True

    def _likely_starts(
        self, words: NDArray[np.uint32], first: int
    ) -> tuple[IntArray, tuple[int, int]]:
        """Find where the frame_id and the number of results of the first detection are again."""
        frame_at = _FRAME_ID // 4
        frame_id = self._words[first + frame_at]
        results_at = frame_at + 1 + _aligned(frame_id, 4) // 4
        results = self._words[first + results_at]
        reach = len(words) - first - results_at
        alike = words[first + results_at :] == results
        # What is left of the last word is padding.
        for at in range(frame_at, frame_at + 1 + min(frame_id // 4, _MOST_WORDS)):
            word = self._words[first + at]
            alike &= words[first + at : first + at + reach] == word
        (starts,) = alike.nonzero()
        starts += first
        return starts, (frame_id, results)


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
        order = _PLAIN_CDR.get(data[:ENCAPSULATION])
        if order is None:
            raise NotPlainCdrError(f'encapsulation {data[:ENCAPSULATION].hex()}')
        limit = len(data) - ENCAPSULATION
        # Copied to where numbers are aligned, the encapsulation header before a multiple of
        # eight, and rounded up so that it can be seen as numbers.
        filling = _PADDING[: -len(data) - ENCAPSULATION & 7]
        self._buffer = bytearray().join((_PADDING[:ENCAPSULATION], data, filling))
        words = memoryview(self._buffer)[_BODY : _BODY + limit // 4 * 4].cast('I')
        if order != _BYTE_ORDER:
            words = memoryview(np.array(words).byteswap())
        forms = Forms() if forms is None else forms
        forms.make_room()
        self._found = found = _Finder(words, limit, forms)
        if limit - found.end > 3:
            raise NotPlainCdrError(f'{limit - found.end} bytes behind the message')
        # The memory may be emptied for a later message; what this one needs stays.
        self._forms, self._places = forms.all, forms.places()
        if order == '>':
            self._turn_around()
        self._buffer[ENCAPSULATION:_BODY] = _LITTLE_ENDIAN
        self._numbers = np.frombuffer(self._buffer, _FLOAT, offset=_BODY)
        self._places_of_boxes: IntArray | None = None
        # Few detections are seen to one by one, by where their boxes lie in the buffer.
        self._few: list[int] | None = None
        if found.pairs is not None and found.count < FEW:
            self._few = [_BODY + 4 * start + self._forms[form].box for start, form in found.pairs]
        self._blank_padding()

    def __len__(self) -> int:
        """Count the detections."""
        return self._found.count

    @property
    def _boxes_at(self) -> IntArray:
        """Tell which numbers are x, y, size x, size y and theta of each detection, (5, N)."""
        if self._places_of_boxes is None:
            starts, forms = self._found.starts, self._found.forms
            self._places_of_boxes = self._places.box.take(forms, axis=1) + (starts >> 1)
        return self._places_of_boxes

    @property
    def stamp(self) -> tuple[int, int]:
        """Seconds and nanoseconds of the message's stamp."""
        seconds, nanoseconds = _STAMP.unpack_from(self._buffer, _BODY)
        return seconds, nanoseconds

    def xywhr(self) -> FloatArray:
        """
        Read the oriented boxes.

        Returns
        -------
        ndarray, shape (N, 5)
            Centre x and y, size x and y, theta, as `OrientedBoxes.from_xywhr` takes them.
        """
        return self._numbers[self._boxes_at].T

    def few_boxes(self) -> list[Sequence[float]] | None:
        """
        Read the oriented boxes of a message that has so few that NumPy would take longer.

        Returns
        -------
        list of N tuples of five float, or None
            Rows as `xywhr` gives them; None if there are more.
        """
        if self._few is None:
            return None
        return [_in_order(_BOX_NUMBERS.unpack_from(self._buffer, at)) for at in self._few]

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
        places = self._places
        if places.all_single:
            starts, forms = self._found.starts, self._found.forms
            scores = self._numbers[(starts >> 1) + places.score[forms]]
            return 4 * starts + places.class_id[forms], scores
        scores = np.full(len(self), np.nan)
        classes_at = np.zeros(len(self), np.int64)
        for form, rows in self._rows_by_form():
            if not form.scores.size:
                continue
            starts = 4 * self._found.starts[rows]
            values = self._numbers[(starts[:, None] + form.scores) // 8]
            best = np.nan_to_num(values, nan=-np.inf).argmax(axis=1)
            scores[rows] = values[np.arange(len(rows)), best]
            classes_at[rows] = starts + form.classes[best]
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
        raw = memoryview(self._buffer)[_BODY:]
        lengths = np.frombuffer(raw, '<u4')[classes_at // 4 - 1] - 1
        return [
            bytes(raw[at : at + length]).decode(errors='backslashreplace') if at else ''
            for at, length in zip(classes_at.tolist(), lengths.tolist(), strict=True)
        ]

    def rewrite(self, extents: FloatArray, rows: NDArray[np.bool_] | None = None) -> bytes:
        """
        Give the message with axis-aligned boxes about the same centres; all else is as it was.

        The boxes of this object change as well.

        Parameters
        ----------
        extents : ndarray, shape (2, N)
            Half-extents of the axis-aligned boxes along x and y, pixels.
        rows : ndarray of bool, shape (N,), optional
            Which detections get them; the others keep their oriented box.

        Returns
        -------
        bytes
            The serialized message, little-endian.
        """
        # Behind the sizes comes theta.
        written, boxes_at = np.zeros((3, len(self))), self._boxes_at[2:]
        np.multiply(extents, 2.0, out=written[:2])
        if rows is not None:
            written, boxes_at = written[:, rows], boxes_at[:, rows]
        self._numbers[boxes_at] = written
        return _message(self._buffer, self._found.end)

    def rewrite_few(self, extents: Sequence[tuple[float, float]]) -> bytes:
        """
        Do what `rewrite` does to a message for which `few_boxes` gives boxes.

        Parameters
        ----------
        extents : sequence of N tuples of two float
            Half-extents of each axis-aligned box along x and y, pixels.

        Returns
        -------
        bytes
            The serialized message, little-endian.
        """
        for at, (half_x, half_y) in zip(self._few or (), extents, strict=True):
            sizes = 2.0 * half_x, 2.0 * half_y
            _THETA_AND_SIZES.pack_into(self._buffer, at + 16, 0.0, *sizes)
        return _message(self._buffer, self._found.end)

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
        raw = memoryview(self._buffer)[_BODY:]
        found, all_forms = self._found, self._forms
        chunks, end = self._beginning(raw, len(rows))
        boxes_at, unpadded = [], end
        starts, forms = (4 * found.starts[rows]).tolist(), found.forms[rows].tolist()
        for start, number in zip(starts, forms, strict=True):
            form = all_forms[number]
            if (end - start) % 8 == 0:
                chunks.append(raw[start : start + form.stride])
                boxes_at.append(end + form.box)
                end += form.stride
            else:
                moved = form.moved
                for padding, begin, stop in moved.pieces:
                    chunks += (padding, raw[start + begin : start + stop])
                boxes_at.append(end + moved.box)
                end += moved.stride
            unpadded = end - form.stride + form.size
        return _ending(chunks, unpadded, boxes_at, xywh)

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
        raw = bytes(memoryview(self._buffer)[_BODY:])
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

    def _beginning(self, raw: bytes | memoryview, count: int) -> tuple[list[Any], int]:
        """Begin a message of `count` detections; also tell how long that is."""
        at = self._found.header.count_at
        chunks = [_PADDING[:ENCAPSULATION], _LITTLE_ENDIAN, raw[:at]]
        return [*chunks, count.to_bytes(4, 'little')], at + 4

    def _parts(self, raw: bytes, row: int) -> tuple[bytes, list[tuple[bytes, bytes]], bytes]:
        """Take a detection apart: header, class id and numbers of each hypothesis, id."""
        start = 4 * int(self._found.starts[row])
        form = self._forms[self._found.forms[row]]
        # Up to the last byte that is no padding.
        frame_at, frame_size = form.lengths[0]
        header = raw[start : start + frame_at + 4 + frame_size]
        hypotheses = []
        class_lengths = form.lengths[_RESULTS + 1 : -1]
        for (at, length), numbers in zip(class_lengths, form.scores.tolist(), strict=True):
            behind = start + numbers + 8 * _HYPOTHESIS_NUMBERS
            class_id = raw[start + at : start + at + 4 + length]
            hypotheses.append((class_id, raw[start + numbers : behind]))
        at, length = form.lengths[-1]
        return header, hypotheses, raw[start + at + 4 : start + at + 4 + length - 1]

    def _rows_by_form(self) -> Iterator[tuple[_Form, IntArray]]:
        """Group the detections by their form."""
        forms = self._found.forms
        order = np.argsort(forms, kind='stable')
        bounds = np.flatnonzero(np.diff(forms[order])) + 1
        for rows in np.split(order, bounds) if len(order) else ():
            yield self._forms[forms[rows[0]]], rows

    def _body(self) -> NDArray[np.uint8]:
        """View the message behind its encapsulation header."""
        return np.frombuffer(self._buffer, np.uint8, offset=_BODY)

    def _blank_padding(self) -> None:
        """Zero the bytes between fields: what writers leave there is whatever their memory held."""
        for at in self._found.header.padding:
            self._buffer[_BODY + at] = 0
        if self._few is not None:
            for start, number in self._found.pairs or ():
                at = _BODY + 4 * start
                for begin, behind, zeros in self._forms[number].gaps:
                    self._buffer[at + begin : at + behind] = zeros
            return
        starts, forms, table = self._found.starts, self._found.forms, self._places.padding
        body = self._body()
        if table is None:
            for form, rows in self._rows_by_form():
                body[4 * starts[rows, None] + form.padding] = 0
        else:
            padding = table.take(forms, axis=0)
            at = padding + 4 * starts[:, None]
            if self._places.some_unpadded:
                at = at[padding[:, 0] >= 0]
            body[at] = 0

    def _turn_around(self) -> None:
        """Turn the bytes of every number around, from big-endian to little-endian."""
        places = {size: [at] for size, at in self._found.header.swaps.items()}
        for form, rows in self._rows_by_form():
            starts = 4 * self._found.starts[rows, None]
            for size, relative in form.swaps.items():
                places[size].append((starts + relative).ravel())
        body = self._body()
        for size, parts in places.items():
            numbers = body.view(f'u{size}')
            at = np.concatenate(parts) // size
            numbers[at] = numbers[at].byteswap()


def _text(content: bytes) -> bytes:
    """Write a string."""
    return (len(content) + 1).to_bytes(4, 'little') + content + b'\0'


def _ending(chunks: list[Any], end: int, boxes_at: list[int], xywh: FloatArray) -> bytes:
    """Make a message of chunks that hold `end` bytes, with boxes at the bytes given."""
    chunks.append(_PADDING)
    buffer = bytearray().join(chunks)
    numbers = np.frombuffer(buffer, _FLOAT, _aligned(end, 8) // 8, _BODY)
    _write_boxes(numbers, np.array(boxes_at, np.int64) // 8 + _XYWHR, xywh)
    return _message(buffer, end)


def _write_boxes(numbers: FloatArray, boxes_at: IntArray, xywh: FloatArray) -> None:
    """Write axis-aligned boxes, (N, 4), at the places of x, y, size x, size y, theta, (5, N)."""
    numbers[boxes_at[:4]] = xywh.T
    numbers[boxes_at[4]] = 0.0


def _message(buffer: bytearray, end: int) -> bytes:
    """Take the message whose body has `end` bytes out of its buffer."""
    return bytes(memoryview(buffer)[ENCAPSULATION : _BODY + end])


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
    return detections.rewrite(np.zeros((2, len(detections))), nothing)
