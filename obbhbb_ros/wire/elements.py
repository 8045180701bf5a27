# SPDX-License-Identifier: Apache-2.0
"""
Messages that are a header and a sequence of structs, its elements: where the fields of each lie.

`read_elements` copies a message into a buffer and returns it with an `ElementIndex`. A few
elements are walked over one by one. That takes 3 µs an element or more, so many are walked over all
at once, with arrays. For this, it must be known where each starts, which two functions can tell.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any
from typing import TypeAlias

import numpy as np

from obbhbb_ros.wire.buffer import EditableBuffer
from obbhbb_ros.wire.buffer import IntArray
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.walk import Numbers
from obbhbb_ros.wire.walk import Places
from obbhbb_ros.wire.walk import Step
from obbhbb_ros.wire.walk import Text
from obbhbb_ros.wire.walk import UnevenError
from obbhbb_ros.wire.walk import all_steps
from obbhbb_ros.wire.walk import check_count
from obbhbb_ros.wire.walk import min_bytes
from obbhbb_ros.wire.walk import number_places
from obbhbb_ros.wire.walk import walk
from obbhbb_ros.wire.walk import walk_all

# From this many elements on it is faster to walk over all at once.
_MIN_AT_ONCE = 32
# How many words of a string are compared when other elements with the same string are looked for.
_MAX_WORDS = 4
_SizeTree: TypeAlias = dict[int, Any]
"""By the length that lies `_OFFSET` bytes behind the start of an element: a tree, or its size."""
_OFFSET = -1


@dataclass(slots=True)
class ElementIndex:
    """
    Where the fields of the elements of a message lie.

    Attributes
    ----------
    header_words : int
        Words of the message's header.
    count : int
        Number of elements.
    fields : mapping of str to sequence of int
        By path, the place of the field in each element; see `Places`.
    end : int
        Place at which the last element ends.
    ends : sequence of int
        Place at which each element ends.
    """

    header_words: int
    count: int
    fields: Mapping[str, Sequence[int] | IntArray]
    end: int
    ends: Sequence[int] | IntArray

    def places(self, path: str) -> IntArray:
        """Return the place of a field in each element; empty if no element has it."""
        return np.asarray(self.fields.get(path, ()), np.int64)


def read_elements(
    data: bytes,
    header: Sequence[Step],
    element: Sequence[Step],
    is_sequence: bool = True,
    tail: Sequence[Step] = (),
) -> tuple[EditableBuffer, ElementIndex]:
    """
    Copy a message, and find the fields of its elements.

    Parameters
    ----------
    data : bytes
        The serialized message.
    header : sequence of Step
        The steps over the header.
    element : sequence of Step
        The steps over an element, which begins with a number of four bytes.
    is_sequence : bool
        Whether the message has a sequence of elements, or just one.
    tail : sequence of Step
        The steps over whatever follows the elements, which is not copied.

    Returns
    -------
    buffer : EditableBuffer
        The message, little-endian, with zeros between its fields and behind its elements.
    index : ElementIndex
        Where the fields of the elements lie.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """
    buffer = EditableBuffer(data)
    lengths = buffer.lengths
    header_fields: Places = defaultdict(list)
    gaps: list[tuple[int, int]] = []
    header_end = walk(lengths, 0, header, header_fields, gaps)
    at = header_end + 3 & -4
    gaps.append((header_end, at))
    header_words, count = at >> 2, 1
    if is_sequence:
        count = _element_count(lengths, at, element)
        at += 4
    fields, ends = _locate(buffer, at, element, count, gaps)
    end = int(ends[-1]) if count else at
    buffer.check_end(walk(lengths, end, tail, defaultdict(list), []))
    # Between fields and behind the last one, writers leave whatever was in memory.
    gaps.append((end, 4 * len(buffer.words)))
    buffer.clear(gaps)

    def numbers() -> Iterator[tuple[int, IntArray]]:
        yield from number_places(lengths, header, header_fields)
        if is_sequence:
            yield 4, np.array([4 * header_words])
        yield from number_places(lengths, element, fields)

    buffer.make_little_endian(numbers())
    return buffer, ElementIndex(header_words, count, fields, end, ends)


def _element_count(lengths: memoryview, place: int, element: Sequence[Step]) -> int:
    """Read how many elements a message has."""
    if place >> 2 >= len(lengths):
        raise WireError(f'the message ends before the number of its elements, at byte {place}')
    count: int = lengths[place >> 2]
    check_count('message', count, min_bytes(element), 4 * len(lengths) - place - 4)
    return count


def _locate(
    buffer: EditableBuffer,
    start: int,
    element: Sequence[Step],
    count: int,
    gaps: list[tuple[int, int]],
) -> tuple[Mapping[str, Sequence[int] | IntArray], Sequence[int] | IntArray]:
    """Find the fields of elements, and where each ends; gaps between them are added or cleared."""
    if count >= _MIN_AT_ONCE:
        located = _locate_all_at_once(buffer, start, element, count)
        if located is not None:
            return located
    return _locate_one_by_one(buffer.lengths, start, element, count, gaps)


def _locate_one_by_one(
    lengths: memoryview,
    start: int,
    element: Sequence[Step],
    count: int,
    gaps: list[tuple[int, int]],
) -> tuple[Places, list[int]]:
    """Walk over one element after another."""
    fields: Places = defaultdict(list)
    ends = []
    at = start
    for number in range(count):
        at = _walk_element(lengths, at, element, number, fields, gaps)
        ends.append(at)
    return fields, ends


def _locate_all_at_once(
    buffer: EditableBuffer, start: int, element: Sequence[Step], count: int
) -> tuple[dict[str, IntArray], IntArray] | None:
    """Walk over all elements together; None if that fails, as where sequences differ in length."""
    lengths = np.asarray(buffer.lengths)
    # Each of these takes longer than the one before, and fails less often.
    for find_starts in (_likely_starts, partial(_learned_starts, max_lengths=2), _learned_starts):
        fields: dict[str, IntArray] = {}
        gaps: list[tuple[IntArray, IntArray]] = []
        try:
            starts = find_starts(buffer.lengths, start, element, count)
            if len(starts) != count or starts[0] != start:
                continue
            ends = walk_all(lengths, starts, element, fields, gaps)
        except (IndexError, UnevenError, WireError):
            continue
        # The elements start there for certain if each ends where the next one starts.
        if (ends[:-1] + 3 & -4 == starts[1:]).all():
            buffer.check_content(int(ends[-1]))
            gaps.append((ends[:-1], starts[1:]))
            buffer.clear_all(*(np.concatenate(edges) for edges in zip(*gaps, strict=True)))
            return fields, ends
    return None


def _likely_starts(
    lengths: memoryview, start: int, element: Sequence[Step], count: int
) -> IntArray:
    """
    Find where the first string of the first element, and the length behind it, occur again.

    In most messages it is the frame_id, and all elements have the same.
    """
    if [step.kind for step in element[:2]] != [Numbers, Text]:
        return np.array([], np.int64)
    before, _, behind = element[:3]
    words = np.asarray(lengths)
    first = start + before.length >> 2
    # There is such a word: the message has bytes enough for the smallest elements.
    length = int(words[first])
    marks = [*range(min(1 + length // 4, _MAX_WORDS))]
    if behind.kind is not Numbers:
        marks.append(1 + (length + 3) // 4)
    if first + marks[-1] >= len(words):
        return np.array([], np.int64)
    (places,) = (words[first : len(words) - marks[-1]] == words[first]).nonzero()
    places += first
    for mark in marks[1:]:
        places = places[words[places + mark] == words[first + mark]]
    return 4 * places - before.length


def _learned_starts(
    lengths: memoryview,
    start: int,
    element: Sequence[Step],
    count: int,
    max_lengths: int | None = None,
) -> IntArray:
    """
    Go from element to element, and walk only over those unlike any before.

    An element whose strings and sequences are as long as those of an earlier one has its size. With
    `max_lengths`, only this many of them are compared.
    """
    starts = []
    # Elements that start at an even and at an odd word have other padding.
    trees: tuple[_SizeTree, _SizeTree] = ({}, {})
    at = start
    for number in range(count):
        at = at + 3 & -4
        starts.append(at)
        node: Any = trees[at >> 2 & 1]
        try:
            while type(node) is dict:
                node = node[lengths[at + node[_OFFSET] >> 2]]
            at += node
        except (IndexError, KeyError):
            fields: Places = defaultdict(list)
            end = _walk_element(lengths, at, element, number, fields, [])
            places = _length_places(element, fields)[:max_lengths]
            _learn(trees[at >> 2 & 1], lengths, at, end, places)
            at = end
    return np.array(starts, np.int64)


def _length_places(element: Sequence[Step], fields: Places) -> list[int]:
    """List the places of all lengths in an element, in order."""
    steps = (step for step in all_steps(element) if step.kind is not Numbers)
    return sorted(place for step in steps for place in fields[step.path])


def _learn(
    tree: _SizeTree, lengths: memoryview, start: int, end: int, places: Sequence[int]
) -> None:
    """Make the lengths of an element lead to its size in a tree."""
    for place in places[:-1]:
        tree[_OFFSET] = place - start
        tree = tree.setdefault(lengths[place >> 2], {})
    tree[_OFFSET] = places[-1] - start
    tree[lengths[places[-1] >> 2]] = end - start


def _walk_element(
    lengths: memoryview,
    at: int,
    element: Sequence[Step],
    number: int,
    fields: Places,
    gaps: list[tuple[int, int]],
) -> int:
    """Walk over one element; an error names it."""
    try:
        return walk(lengths, at, element, fields, gaps)
    except WireError as error:
        raise WireError(f'element {number}: {error}') from None
