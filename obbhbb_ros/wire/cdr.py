# SPDX-License-Identifier: Apache-2.0
"""
Plain CDR (XCDR1), the form in which ROS 2 messages travel: descriptions, and how to walk them.

A message is described by the kinds below. Positions follow from the description and two rules: a
number of n bytes lies at a multiple of n bytes from the end of the 4-byte encapsulation header,
and a string or a sequence starts with its length in four bytes.

There are two ways to walk a description. `skip` goes over one struct with plain numbers and tells
where it ends. `Walk` goes over many structs of a kind at once with arrays, and tells where their
fields lie.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from typing import NamedTuple
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

IntArray: TypeAlias = NDArray[np.int64]
Words: TypeAlias = NDArray[np.uint32]

ENCAPSULATION = 4
LITTLE_ENDIAN = b'\x00\x01\x00\x00'
_PLAIN = {b'\x00\x00': '>', b'\x00\x01': '<'}
# A serializer pads to a multiple of four bytes, and the middleware what it is given.
_MOST_PADDING = 6
_NATIVE = '<' if sys.byteorder == 'little' else '>'
# In a buffer four bytes lie before the encapsulation header, so that its body is aligned.
BODY = 2 * ENCAPSULATION
# What is left of a word whose first 0, 1, 2 or 3 bytes belong to a string; 0: it has no such word.
_KEPT = np.array([0xFFFFFFFF, 0xFF, 0xFFFF, 0xFFFFFF], np.uint32)


class WireError(ValueError):
    """Bytes that cannot be read as the message; the text says what is wrong and where."""


@dataclass(frozen=True)
class Numbers:
    """`count` numbers of `size` bytes each, one after the other."""

    size: int
    count: int = 1


@dataclass(frozen=True)
class Text:
    """A string: its length with the closing zero byte, then its bytes."""


@dataclass(frozen=True)
class Array:
    """A sequence of items that are `count` numbers of `size` bytes each; bytes, points, numbers."""

    size: int
    count: int = 1


@dataclass(frozen=True)
class Many:
    """A sequence of structs."""

    element: Struct


Struct: TypeAlias = dict[str, Any]
"""Fields in order, by name; a value is one of the kinds above or another struct."""


class Step(NamedTuple):
    """A field, or adjacent numbers of one size, ready to be walked over."""

    kind: type
    path: str
    size: int
    """Bytes of a number; its alignment."""
    length: int
    """Bytes of the numbers, or of an item of an array."""
    inner: Sequence[Step]
    """Steps of an element of a sequence."""
    fixed: bool
    """Whether all elements from the second on have the same size."""
    aligned: bool = False
    """Whether what lies before ends where this may start, wherever the struct starts."""


def steps_of(struct: Struct, prefix: str = '') -> list[Step]:
    """
    List the steps over a struct, those of the structs in it included.

    Parameters
    ----------
    struct : Struct
        The description.
    prefix : str
        What stands before the name of each field, with a dot at its end.

    Returns
    -------
    list of Step
        In order. Adjacent numbers of one size are one step, named after the first.
    """
    steps: list[Step] = []
    for name, kind in struct.items():
        path = prefix + name
        if isinstance(kind, dict):
            new = steps_of(kind, f'{path}.')
        elif isinstance(kind, Many):
            inner = steps_of(kind.element, f'{path}.')
            fixed = all(step.kind is Numbers for step in inner)
            new = [Step(Many, path, 4, 0, inner, fixed)]
        elif isinstance(kind, Text):
            new = [Step(Text, path, 4, 0, (), False)]
        else:
            new = [Step(type(kind), path, kind.size, kind.size * kind.count, (), False)]
        for step in new:
            last = steps[-1] if steps else None
            if last and step.kind is last.kind is Numbers and step.size == last.size:
                steps[-1] = last._replace(length=last.length + step.length)
            else:
                needed = step.size if step.kind is Numbers else 4
                aligned = last is not None and last.kind is Numbers and last.size >= needed
                steps.append(step._replace(aligned=aligned))
    return steps


def skip(words: memoryview, at: int, steps: Sequence[Step]) -> int:
    """
    Go over one struct.

    Parameters
    ----------
    words : memoryview of uint32
        The message after its encapsulation header.
    at : int
        Byte at which the struct starts, or at which what lies before it ends.
    steps : sequence of Step
        The steps over the struct.

    Returns
    -------
    int
        Byte behind the struct, which may lie behind the end of the message.

    Raises
    ------
    WireError
        If the message ends before the struct does, or a string has no closing zero.
    """
    path = ''
    try:
        for kind, path, size, length, inner, fixed, _ in steps:
            if kind is Numbers:
                at = (at + size - 1 & -size) + length
                continue
            at = at + 3 & -4
            count = words[at >> 2]
            at += 4
            if kind is Text:
                if not count:
                    raise WireError(f'{path} at byte {at} has no closing zero')
                at += count
            elif kind is Array:
                if count:
                    at = (at + size - 1 & -size) + count * length
            elif count > len(words):
                raise WireError(f'{path} at byte {at} cannot hold {count} elements')
            else:
                at = _skip_elements(words, at, inner, count, fixed)
    except IndexError:
        raise WireError(
            f'{path} at byte {at} lies behind the end of the message, byte {4 * len(words)}'
        ) from None
    return at


def _skip_elements(
    words: memoryview, at: int, element: Sequence[Step], count: int, fixed: bool
) -> int:
    """Go over the elements of a sequence, or, if they are of fixed size, over the first ones."""
    for number in range(count):
        before, at = at, skip(words, at, element)
        if fixed and number == 1:
            return at + (count - 2) * (at - before)
    return at


class Walk:
    """
    The fields of many structs of a kind.

    Parameters
    ----------
    words : ndarray of uint32
        The message after its encapsulation header.
    starts : ndarray of int, shape (N,)
        Byte at which each struct starts, or at which what lies before it ends.
    steps : sequence of Step
        The steps over the struct.

    Attributes
    ----------
    found : dict of str to ndarray of int, shape (N,)
        For each step, byte at which its numbers start, or the length of its string or sequence.
    ends : dict of str to ndarray of int, shape (N,)
        For each step that may have to be aligned, byte at which what lies before it ends.
    elements : dict of str to list of (rows, Walk)
        For each sequence of structs, the first elements of all structs, then the second ones, and
        so on; `rows` is an index of the structs that have one.
    end : ndarray of int, shape (N,)
        Byte behind each struct.

    Raises
    ------
    IndexError
        If a length would lie behind the end.
    """

    def __init__(self, words: Words, starts: IntArray, steps: Sequence[Step]) -> None:
        self._words = words
        self._steps = steps
        self.found: dict[str, IntArray] = {}
        self.ends: dict[str, IntArray] = {}
        self.elements: dict[str, list[tuple[Any, Walk]]] = {}
        at = starts
        for step in steps:
            if not step.aligned:
                self.ends[step.path] = at
                size = step.size if step.kind is Numbers else 4
                at = at + (size - 1) & -size
            self.found[step.path] = at
            at = at + step.length if step.kind is Numbers else self._behind(step, at)
        self.end = at

    def _behind(self, step: Step, at: IntArray) -> IntArray:
        """Find the byte behind strings or sequences whose lengths lie at a byte."""
        count = self._words[at >> 2]
        at = at + 4
        if step.kind is Text:
            return at + count
        if step.kind is Many:
            return self._walk_elements(step, at, count)
        items = (at + step.size - 1 & -step.size) + count.astype(np.int64) * step.length
        return np.where(count > 0, items, at)

    def _walk_elements(self, step: Step, at: IntArray, count: Words) -> IntArray:
        """Walk over the elements of sequences of structs."""
        elements = self.elements[step.path] = []
        lowest = count.min(initial=0xFFFFFFFF)
        for number in range(count.max(initial=0)):
            rows: Any = slice(None) if number < lowest else count > number
            walk = Walk(self._words, at[rows], step.inner)
            elements.append((rows, walk))
            at[rows] = walk.end
        return at

    @property
    def has_empty_string(self) -> bool:
        """Whether a string has not even its closing zero."""
        texts = [self.found[step.path] for step in self._steps if step.kind is Text]
        return any((self._words[at >> 2] == 0).any() for at in texts) or any(
            walk.has_empty_string for elements in self.elements.values() for _, walk in elements
        )

    def blank(self, words: Words) -> None:
        """Zero the bytes between fields: what writers leave there is whatever memory held."""
        gaps = self._gaps()
        ends = np.concatenate([end for end, _ in gaps])
        words[ends >> 2] &= _KEPT[ends & 3]
        # Alignment to eight bytes may leave a word free besides.
        starts = np.concatenate([at for _, at in gaps])
        words[(starts[starts - ends >= 4] >> 2) - 1] = 0

    def _gaps(self) -> list[tuple[IntArray, IntArray]]:
        """List the ends of fields and the starts of those behind them."""
        gaps = [(end, self.found[path]) for path, end in self.ends.items()]
        for elements in self.elements.values():
            for _, walk in elements:
                gaps += walk._gaps()
        return [*gaps, (self.end, self.end)]

    def byteswap(self, body: NDArray[np.uint8]) -> None:
        """Turn every number and length from big-endian to little-endian."""
        for step in self._steps:
            at = self.found[step.path]
            if step.kind is Numbers:
                _swap(body, step.size, (at[:, None] + np.arange(0, step.length, step.size)).ravel())
                continue
            _swap(body, 4, at)
            if step.kind is Array and step.size > 1:
                first = at + 4 + step.size - 1 & -step.size
                counts = self._words[at >> 2].tolist()
                for start, count in zip(first.tolist(), counts, strict=True):
                    end = start + count * step.length
                    _swap(body, step.size, np.arange(start, end, step.size))
        for elements in self.elements.values():
            for _, walk in elements:
                walk.byteswap(body)


def _swap(body: NDArray[np.uint8], size: int, at: IntArray) -> None:
    """Turn the bytes of numbers around."""
    numbers = body.view(f'u{size}')
    numbers[at // size] = numbers[at // size].byteswap()


def _byte_order(data: bytes) -> str:
    """Read the byte order from the encapsulation header, '<' or '>'; its options are ignored."""
    header = bytes(data[:ENCAPSULATION])
    order = _PLAIN.get(header[:2])
    if order is None or len(header) < ENCAPSULATION:
        raise WireError(f'encapsulation {header.hex()} is not plain CDR')
    return order


def _check_end(end: int, size: int) -> None:
    """Refuse a message that is shorter than its content, or longer by more than padding."""
    if end > size:
        raise WireError(f'the content ends at byte {end}, the message at byte {size}')
    if size - end > _MOST_PADDING:
        raise WireError(f'{size - end} bytes behind the content')


class Message:
    """
    A message that is one struct, and is only read.

    Parameters
    ----------
    data : bytes
        The serialized message.
    steps : sequence of Step
        The steps over it.

    Raises
    ------
    WireError
        If the bytes are no such message.
    """

    def __init__(self, data: bytes, steps: Sequence[Step]) -> None:
        self._order = _byte_order(data)
        self._body = memoryview(data)[ENCAPSULATION:]
        given = np.frombuffer(self._body, self._order + 'u4', len(self._body) // 4)
        words: Words = given.astype('=u4', copy=False)
        _check_end(skip(memoryview(words.data), 0, steps), len(self._body))
        self._at = Walk(words, np.zeros(1, np.int64), steps).found

    @property
    def stamp(self) -> tuple[int, int]:
        """Seconds and nanoseconds."""
        at = int(self._at['header.stamp.sec'][0])
        seconds, nanoseconds = struct.unpack_from(self._order + 'iI', self._body, at)
        return seconds, nanoseconds

    def integers(self, path: str, count: int = 1) -> tuple[int, ...]:
        """Read 32-bit unsigned integers."""
        at = int(self._at[path][0])
        return struct.unpack_from(f'{self._order}{count}I', self._body, at)

    def bytes_at(self, path: str, size: int = 1) -> memoryview:
        """Look at the bytes of a number."""
        at = int(self._at[path][0])
        return self._body[at : at + size]

    def octets(self, path: str) -> memoryview:
        """Look at the content of a string, with its closing zero, or of a sequence of bytes."""
        (size,) = self.integers(path)
        at = int(self._at[path][0]) + 4
        return self._body[at : at + size]

    def text(self, path: str) -> str:
        """Read a string; bytes that are no UTF-8 are escaped."""
        return bytes(self.octets(path)[:-1]).decode(errors='backslashreplace')


# From this many elements on it is faster to look for all of them at once.
_MANY = 32
# Words of a string that are compared when looking for it.
_MOST_WORDS = 4


class Elements:
    """
    A message that is a header and a sequence of structs, in a copy that may be written to.

    The copy is little-endian and has zeros between its fields.

    Parameters
    ----------
    data : bytes
        The serialized message.
    header : sequence of Step
        The steps over the header.
    element : sequence of Step
        The steps over an element, which begins with a number of four bytes.
    many : bool
        Whether there is a sequence of elements, or just one.
    tail : sequence of Step
        The steps over what lies behind the elements.

    Attributes
    ----------
    words : ndarray of uint32
        The message after its encapsulation header, and at least two words of zeros.
    count : int
        Number of elements.
    header_words : int
        Words of the header.
    walk : Walk
        The fields of the elements.
    end : int
        Byte behind the last element.

    Raises
    ------
    WireError
        If the bytes are no such message.
    """

    def __init__(
        self,
        data: bytes,
        header: Sequence[Step],
        element: Sequence[Step],
        many: bool = True,
        tail: Sequence[Step] = (),
    ) -> None:
        order = _byte_order(data)
        size = len(data) - ENCAPSULATION
        filling = bytes((-size & 7) + 8)
        self._buffer = bytearray().join((bytes(ENCAPSULATION), data, filling))
        self.words = np.frombuffer(self._buffer, '<u4', offset=BODY)
        # Lengths are read from here, and no farther than the message goes.
        self._lengths = self.words[: size // 4].astype('=u4', copy=False)
        if order == '>':
            self._lengths = self._lengths.byteswap()
        # A memoryview gives single numbers in a third of the time that an array takes.
        self._scalars = memoryview(self._lengths.data)
        self._element = element
        header_end = skip(self._scalars, 0, header)
        self.count, start = self._count(header_end) if many else (1, header_end)
        self.header_words = header_end + 3 >> 2
        self.walk = self._find(start)
        self.end = int(self.walk.end[-1]) if self.count else start
        _check_end(skip(self._scalars, self.end, tail), size)
        self._tidy(order, header, header_end, many)

    def message(self) -> bytes:
        """Give the message with what was written to `words`."""
        return bytes(memoryview(self._buffer)[ENCAPSULATION : BODY + self.end])

    def content(self, at: int) -> bytes:
        """Read the string whose length lies at a byte, without its closing zero."""
        start = BODY + at + 4
        return bytes(self._buffer[start : start + int(self.words[at >> 2]) - 1])

    @property
    def stamp(self) -> tuple[int, int]:
        """Seconds and nanoseconds of the header's stamp."""
        seconds, nanoseconds = struct.unpack_from('<iI', self._buffer, BODY)
        return seconds, nanoseconds

    def _count(self, at: int) -> tuple[int, int]:
        """Read how many elements there are, and where the first starts."""
        at = at + 3 & -4
        words = len(self._scalars)
        if at >> 2 >= words:
            raise WireError(f'the message ends before the number of its elements, at byte {at}')
        count = self._scalars[at >> 2]
        if count > words:
            raise WireError(f'the message cannot hold {count} elements')
        return count, at + 4

    def _find(self, start: int) -> Walk:
        """Find the elements and their fields."""
        begins_with_text = [step.kind for step in self._element[:2]] == [Numbers, Text]
        if self.count >= _MANY and begins_with_text:
            walk = self._find_at_once(start)
            if walk is not None:
                return walk
        starts, at = [], start
        for number in range(self.count):
            starts.append(at)
            try:
                at = skip(self._scalars, at, self._element)
            except WireError as error:
                raise WireError(f'element {number}: {error}') from None
        return Walk(self._lengths, np.array(starts, np.int64), self._element)

    def _find_at_once(self, start: int) -> Walk | None:
        """
        Find elements of which each has the same first string as the first one; or give up.

        Wherever that string is, an element may start. That they do start there is certain if each
        ends where the next one starts.
        """
        starts = self._likely_starts(start)
        if len(starts) != self.count:
            return None
        try:
            walk = Walk(self._lengths, starts, self._element)
        except IndexError:
            return None
        chained = (walk.end[:-1] + 3 & -4 == starts[1:]).all() and starts[0] == start + 3 & -4
        return walk if chained and not walk.has_empty_string else None

    def _likely_starts(self, start: int) -> IntArray:
        """List where the first string of the first element is again, and the length behind it."""
        before, _, behind = self._element[:3]
        first = (start + 3 >> 2) + before.length // 4
        words = self._lengths
        length = int(words[first]) if first < len(words) else len(words)
        marks = [*range(min(1 + length // 4, _MOST_WORDS))]
        if behind.kind is not Numbers:
            marks.append(1 + (length + 3) // 4)
        if first + marks[-1] >= len(words):
            return np.array([], np.int64)
        (places,) = (words[first : len(words) - marks[-1]] == words[first]).nonzero()
        places += first
        for mark in marks[1:]:
            places = places[words[places + mark] == words[first + mark]]
        return 4 * places - before.length

    def _tidy(self, order: str, header: Sequence[Step], header_end: int, many: bool) -> None:
        """Make the copy little-endian, with zeros between its fields and behind its end."""
        if order == '>':
            body = self.words.view(np.uint8)
            Walk(self._lengths, np.zeros(1, np.int64), header).byteswap(body)
            self.walk.byteswap(body)
            if many:
                _swap(body, 4, np.array([4 * self.header_words]))
        self._buffer[ENCAPSULATION:BODY] = LITTLE_ENDIAN
        self.words[header_end >> 2] &= _KEPT[header_end & 3]
        self.walk.blank(self.words)
        self.words[self.end + 3 >> 2 :] = 0
