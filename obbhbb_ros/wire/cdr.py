# SPDX-License-Identifier: Apache-2.0
"""
Plain CDR (XCDR1), the form in which ROS 2 messages travel: descriptions, and how to walk them.

A message is described by the kinds below. Positions follow from the description and two rules: a
number of n bytes lies at a multiple of n bytes from the end of the 4-byte encapsulation header,
and a string or a sequence starts with its length in four bytes.

`walk` goes over one struct with plain numbers. `walk_all` goes over many structs of a kind at once
with arrays, if it is known where they start. Both tell where the fields lie, in bytes from the end
of the encapsulation header.
"""

from __future__ import annotations

import struct
import sys
from collections import defaultdict
from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any
from typing import NamedTuple
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.wire.buffer import WireError

IntArray: TypeAlias = NDArray[np.int64]
Words: TypeAlias = NDArray[np.uint32]

ENCAPSULATION = 4
LITTLE_ENDIAN = b'\x00\x01\x00\x00'
_PLAIN = {b'\x00\x00': '>', b'\x00\x01': '<'}
# Serializer and middleware may each pad to a multiple of four bytes.
_MOST_PADDING = 6
_NATIVE = '<' if sys.byteorder == 'little' else '>'
# In a buffer four bytes lie before the encapsulation header, so that its body is aligned.
BODY = 2 * ENCAPSULATION
# What is left of a word whose first 0, 1, 2 or 3 bytes belong to a string; 0: it has no such word.
_KEPT = np.array([0xFFFFFFFF, 0xFF, 0xFFFF, 0xFFFFFF], np.uint32)


class UnevenError(Exception):
    """Structs that cannot be walked all at once."""


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
    """Bytes of a number."""
    length: int
    """Bytes of the numbers, or of an item of an array; fewest bytes of an element."""
    inner: Sequence[Step]
    """Steps over an element of a sequence."""
    alignment: int
    """Multiple of bytes at which the numbers or the length start; 1: they do so by themselves."""


def smallest(steps: Sequence[Step]) -> int:
    """Return the fewest bytes that a struct takes."""
    return sum(step.length if step.kind is Numbers else _LEAST[step.kind] for step in steps)


# A string has at least its closing zero.
_LEAST = {Text: 5, Array: 4, Many: 4}


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
            new = [Step(Many, path, 4, smallest(inner), inner, 4)]
        elif isinstance(kind, Text):
            new = [Step(Text, path, 1, 0, (), 4)]
        else:
            alignment = kind.size if isinstance(kind, Numbers) else 4
            new = [Step(type(kind), path, kind.size, kind.size * kind.count, (), alignment)]
        for step in new:
            last = steps[-1] if steps and steps[-1].kind is Numbers else None
            if last and step.kind is Numbers and step.size == last.size:
                steps[-1] = last._replace(length=last.length + step.length)
            else:
                by_itself = last is not None and last.size >= step.alignment
                steps.append(step._replace(alignment=1) if by_itself else step)
    return steps


Found: TypeAlias = defaultdict[str, list[int]]
"""By path, where the numbers start, or the lengths of strings and sequences."""


def walk(
    words: memoryview, at: int, steps: Sequence[Step], found: Found, gaps: list[tuple[int, int]]
) -> int:
    """
    Go over one struct.

    Parameters
    ----------
    words : memoryview of uint32
        The message after its encapsulation header.
    at : int
        Byte at which what lies before the struct ends.
    steps : sequence of Step
        The steps over the struct.
    found : Found
        Where the fields lie, to be added to.
    gaps : list of tuple of int
        First byte of padding and the one behind it, to be added to.

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
        for kind, path, size, length, inner, alignment in steps:
            start = at + alignment - 1 & -alignment
            if start > at:
                gaps.append((at, start))
                at = start
            found[path].append(at)
            if kind is Numbers:
                at += length
                continue
            count = words[at >> 2]
            at += 4
            if kind is Text:
                if not count:
                    raise WireError(f'{path} at byte {at} has no closing zero')
                at += count
            elif kind is Array:
                if count:
                    at = (at + size - 1 & -size) + count * length
            else:
                _check_count(path, count, length, 4 * len(words) - at)
                for _ in range(count):
                    at = walk(words, at, inner, found, gaps)
    except IndexError:
        raise WireError(
            f'{path} at byte {at} lies behind the end of the message, byte {4 * len(words)}'
        ) from None
    return at


def walk_all(
    words: Words,
    at: IntArray,
    steps: Sequence[Step],
    found: dict[str, IntArray],
    gaps: list[tuple[IntArray, IntArray]],
) -> IntArray:
    """
    Go over many structs of a kind, like `walk`, with arrays of shape (N,) in place of numbers.

    Raises
    ------
    UnevenError
        If they cannot be walked together: a string has no closing zero, or sequences of structs
        differ in length, or the message cannot hold them all.
    IndexError
        If a length would lie behind the end.
    """
    for step in steps:
        if step.alignment > 1:
            before, at = at, at + (step.alignment - 1) & -step.alignment
            gaps.append((before, at))
        found[step.path] = at
        if step.kind is Numbers:
            at = at + step.length
            continue
        count = words[at >> 2].astype(np.int64)
        at = at + 4
        if step.kind is Text:
            if not count.all():
                raise UnevenError
            at = at + count
        elif step.kind is Array:
            items = (at + step.size - 1 & -step.size) + count * step.length
            at = np.where(count > 0, items, at)
        else:
            at = _walk_elements(words, at, step, count, found, gaps)
    return at


def _walk_elements(
    words: Words,
    at: IntArray,
    step: Step,
    count: IntArray,
    found: dict[str, IntArray],
    gaps: list[tuple[IntArray, IntArray]],
) -> IntArray:
    """Go over sequences of structs, the first elements of all, then the second ones, and so on."""
    # The starts may be wrong, and overlap.
    too_many = int(count.sum()) * step.length > 4 * len(words)
    if too_many or (count != count[0]).any():
        raise UnevenError
    walks: list[dict[str, IntArray]] = []
    for _ in range(int(count[0])):
        walks.append({})
        at = walk_all(words, at, step.inner, walks[-1], gaps)
    for path in walks[0] if walks else ():
        # Those of one struct after another, as `walk` finds them.
        found[path] = np.stack([each[path] for each in walks], axis=1).ravel()
    return at


def _check_count(path: str, count: int, least: int, left: int) -> None:
    """Refuse a number of structs that the bytes left cannot hold."""
    if count * least > left:
        raise WireError(f'{path}: {left} bytes cannot hold {count} elements')


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
        self._found: Found = defaultdict(list)
        _check_end(walk(memoryview(words.data), 0, steps, self._found, []), len(self._body))

    @property
    def stamp(self) -> tuple[int, int]:
        """Seconds and nanoseconds."""
        at = self._found['header.stamp.sec'][0]
        seconds, nanoseconds = struct.unpack_from(self._order + 'iI', self._body, at)
        return seconds, nanoseconds

    def integers(self, path: str, count: int = 1) -> tuple[int, ...]:
        """Read 32-bit unsigned integers."""
        at = self._found[path][0]
        return struct.unpack_from(f'{self._order}{count}I', self._body, at)

    def bytes_at(self, path: str, size: int = 1) -> memoryview:
        """Look at the bytes of a number."""
        at = self._found[path][0]
        return self._body[at : at + size]

    def octets(self, path: str) -> memoryview:
        """Look at the content of a string, with its closing zero, or of a sequence of bytes."""
        (size,) = self.integers(path)
        at = self._found[path][0] + 4
        return self._body[at : at + size]

    def text(self, path: str) -> str:
        """Read a string; bytes that are no UTF-8 are escaped."""
        return bytes(self.octets(path)[:-1]).decode(errors='backslashreplace')


# From this many elements on it is faster to find the fields of all together.
_MANY = 32
# Words of a string that are compared when looking for it.
_MOST_WORDS = 4
# Path of the byte behind each element, for `Elements.places`.
ENDS = ''
_Tree: TypeAlias = dict[int, Any]
"""By the length at `_OFFSET` bytes from the start of an element, another tree, or its size."""
_OFFSET = -1


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
        size = len(data) - ENCAPSULATION
        order = _byte_order(data)
        filling = bytes((-size & 7) + 8)
        self._buffer = bytearray().join((bytes(ENCAPSULATION), data, filling))
        self._buffer[ENCAPSULATION:BODY] = LITTLE_ENDIAN
        self.words = np.frombuffer(self._buffer, '<u4', offset=BODY)
        # No length is read from behind the end.
        self._lengths = self.words[: size // 4]
        if order == '>':
            self._byteswap(header, element, many, tail)
        # A memoryview gives single numbers in a third of the time that an array takes.
        self._scalars = memoryview(self._lengths.data)
        found: Found = defaultdict(list)
        gaps: list[tuple[int, int]] = []
        at = walk(self._scalars, 0, header, found, gaps)
        self.header_words = at + 3 >> 2
        gaps.append((at, 4 * self.header_words))
        self.count, at = _count(self._scalars, at, element) if many else (1, at)
        self._element = element
        self._at_once: dict[str, IntArray] = {}
        self._one_by_one: Found = defaultdict(list)
        end = self._walk_at_once(at) if self.count >= _MANY else None
        if end is None:
            end = self._walk_one_by_one(at, gaps)
        self.end = end
        _check_end(walk(self._scalars, end, tail, defaultdict(list), []), size)
        # Between fields and behind the last one, writers leave whatever was in memory.
        gaps.append((end, len(self._buffer) - BODY))
        for start, stop in gaps:
            self._buffer[BODY + start : BODY + stop] = bytes(stop - start)

    @classmethod
    def blank(cls, header: Words, count: int, words: int) -> Elements:
        """Make a message with a header and room for elements; `found` tells where they are."""
        new = cls.__new__(cls)
        new.count, new.header_words = count, len(header)
        size = ENCAPSULATION + 4 * (len(header) + 1 + words)
        new._buffer = bytearray(size + (-size & 7) + 2 * BODY)
        new._buffer[ENCAPSULATION:BODY] = LITTLE_ENDIAN
        new.words = np.frombuffer(new._buffer, '<u4', offset=BODY)
        new.words[: len(header)] = header
        new.words[len(header)] = count
        new.end = 4 * (len(header) + 1)
        return new

    def found(self, places: dict[str, IntArray]) -> None:
        """Take in where the fields of the elements are."""
        self._at_once = places
        if self.count:
            self.end = int(places[ENDS][-1])

    def places(self, path: str) -> IntArray:
        """Return the byte at which a field of each element starts; see `Found`."""
        if path in self._at_once:
            return self._at_once[path]
        return np.array(self._one_by_one[path], np.int64)

    def message(self) -> bytes:
        """Return the message with what was written to `words`."""
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

    def _walk_one_by_one(self, at: int, gaps: list[tuple[int, int]]) -> int:
        """Find the fields of the elements; tell where the last one ends."""
        for number in range(self.count):
            at = self._walk_element(number, at, self._one_by_one, gaps)
            self._one_by_one[ENDS].append(at)
        return at

    def _walk_at_once(self, start: int) -> int | None:
        """Find the fields of all elements together; None if sequences in them differ in length."""
        gaps: list[tuple[IntArray, IntArray]] = []
        # Each way takes longer than the one before, and finds more.
        for find in (self._likely_starts, partial(self._starts, depth=2), self._starts):
            found: dict[str, IntArray] = {}
            gaps.clear()
            starts = find(start)
            if len(starts) != self.count or starts[0] != start + 3 & -4:
                continue
            try:
                ends = walk_all(self._lengths, starts, self._element, found, gaps)
            except (IndexError, UnevenError):
                continue
            # Elements start there for certain if each ends where the next one starts.
            if (ends[:-1] + 3 & -4 == starts[1:]).all():
                break
        else:
            return None
        found[ENDS] = ends
        self._at_once = found
        before, after = (np.concatenate(each) for each in zip(*gaps, strict=True))
        before, after = np.append(before, ends[:-1]), np.append(after, starts[1:])
        self.words[before >> 2] &= _KEPT[before & 3]
        # Alignment to eight bytes may leave a word free besides.
        self.words[(after[after - before >= 4] >> 2) - 1] = 0
        return int(ends[-1])

    def _likely_starts(self, start: int) -> IntArray:
        """List where the first string of the first element is again, and the length behind it."""
        if [step.kind for step in self._element[:2]] != [Numbers, Text]:
            return np.array([], np.int64)
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

    def _starts(self, at: int, depth: int | None = None) -> IntArray:
        """
        Find where elements start; one with the lengths of an earlier one is not walked over.

        With a `depth`, only its first lengths are compared.
        """
        words, starts = self._scalars, []
        # For starts at an even and at an odd word: a tree that leads by lengths to the size.
        trees: tuple[_Tree, _Tree] = ({}, {})
        for number in range(self.count):
            at = at + 3 & -4
            starts.append(at)
            node: Any = trees[at >> 2 & 1]
            try:
                while type(node) is dict:
                    node = node[words[at + node[_OFFSET] >> 2]]
                at += node
            except (IndexError, KeyError):
                found: Found = defaultdict(list)
                try:
                    end = self._walk_element(number, at, found, [])
                except WireError:
                    if depth is None:
                        raise
                    # An element before this one was another than it seemed.
                    return np.array([], np.int64)
                _learn(trees[at >> 2 & 1], words, self._element, at, end, found, depth)
                at = end
        return np.array(starts, np.int64)

    def _walk_element(self, number: int, at: int, found: Found, gaps: list[tuple[int, int]]) -> int:
        """Go over one element; an error names it."""
        try:
            return walk(self._scalars, at, self._element, found, gaps)
        except WireError as error:
            raise WireError(f'element {number}: {error}') from None

    def _byteswap(
        self, header: Sequence[Step], element: Sequence[Step], many: bool, tail: Sequence[Step]
    ) -> None:
        """Turn the numbers of the message from big-endian to little-endian."""
        words = memoryview(self._lengths.byteswap().data)
        found: Found = defaultdict(list)
        at = walk(words, 0, header, found, [])
        counts_at = [at + 3 & -4] if many else []
        count, at = _count(words, at, element) if many else (1, at)
        for _ in range(count):
            at = walk(words, at, element, found, [])
        at = walk(words, at, tail, found, [])
        if at > 4 * len(self.words) - 8:
            raise WireError(f'the content ends at byte {at}, behind the end of the message')
        body = self.words.view(np.uint8)
        _swap(body, 4, np.array(counts_at, np.int64))
        for step in _flat([*header, *element, *tail]):
            starts, length = np.array(found[step.path], np.int64), step.length
            if step.kind is Array and step.size > 1:
                for start in starts.tolist():
                    first = start + 4 + step.size - 1 & -step.size
                    end = first + words[start >> 2] * length
                    _swap(body, step.size, np.arange(first, end, step.size))
            if step.kind is Numbers:
                starts = (starts[:, None] + np.arange(0, length, step.size)).ravel()
            _swap(body, step.size if step.kind is Numbers else 4, starts)


def _learn(
    tree: _Tree,
    words: memoryview,
    steps: Sequence[Step],
    start: int,
    end: int,
    found: Found,
    depth: int | None,
) -> None:
    """Make a tree lead to the size of an element by its first lengths."""
    places = sorted(
        at for step in _flat(steps) if step.kind is not Numbers for at in found[step.path]
    )[:depth]
    for at in places[:-1]:
        tree[_OFFSET] = at - start
        tree = tree.setdefault(words[at >> 2], {})
    tree[_OFFSET] = places[-1] - start
    tree[words[places[-1] >> 2]] = end - start


def _flat(steps: Sequence[Step]) -> Iterator[Step]:
    """List steps and those inside them."""
    for step in steps:
        yield step
        yield from _flat(step.inner)


def _count(words: memoryview, at: int, element: Sequence[Step]) -> tuple[int, int]:
    """Read how many elements a message has, and where they start."""
    at = at + 3 & -4
    if at >> 2 >= len(words):
        raise WireError(f'the message ends before the number of its elements, at byte {at}')
    _check_count('message', words[at >> 2], smallest(element), 4 * len(words) - at - 4)
    return words[at >> 2], at + 4
