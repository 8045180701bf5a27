# SPDX-License-Identifier: Apache-2.0
"""
Messages that are a header and a sequence of structs, its elements: where the fields of each lie.

`read_elements` copies a message into a buffer and returns it with an `ElementIndex`. A few
elements are walked over one by one. That takes 3 µs an element or more, so many are walked over all
at once, with arrays. For this, it must be known where each starts, which two functions can tell.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any
from typing import NamedTuple
from typing import TypeAlias

import numpy as np

from obbhbb_ros.wire.buffer import EditableBuffer
from obbhbb_ros.wire.buffer import IntArray
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.layouts import HEADER
from obbhbb_ros.wire.layouts import InputType
from obbhbb_ros.wire.walk import AnyPlaces
from obbhbb_ros.wire.walk import ArrayGaps
from obbhbb_ros.wire.walk import ArrayPlaces
from obbhbb_ros.wire.walk import Gaps
from obbhbb_ros.wire.walk import Many
from obbhbb_ros.wire.walk import Numbers
from obbhbb_ros.wire.walk import Places
from obbhbb_ros.wire.walk import Step
from obbhbb_ros.wire.walk import Text
from obbhbb_ros.wire.walk import UnevenError
from obbhbb_ros.wire.walk import all_steps
from obbhbb_ros.wire.walk import element_count
from obbhbb_ros.wire.walk import number_places
from obbhbb_ros.wire.walk import walk
from obbhbb_ros.wire.walk import walk_all

# From this many elements on it is faster to walk over all at once.
_MIN_AT_ONCE = 32
# How many words of a string are compared when other elements with the same string are looked for.
_MAX_WORDS = 4
# How many elements are walked over to learn which lengths differ; how many lengths are compared at
# least.
_SAMPLE = 8
_MIN_COMPARED = 2
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
        By path, the place of the field in each element.
    ends : sequence of int
        Place at which each element ends.
    end : int
        Place at which the last element ends.
    """

    header_words: int
    count: int
    fields: AnyPlaces
    ends: Sequence[int] | IntArray
    end: int

    def places(self, path: str) -> IntArray:
        """Return the place of a field in each element; empty if no element has it."""
        return np.asarray(self.fields.get(path, ()), np.int64)


class _Span(NamedTuple):
    """Elements to be located: place of the first one, steps over each, and how many there are."""

    lengths: memoryview
    start: int
    steps: Sequence[Step]
    elements: int

    def walk(self, number: int, at: int, fields: Places, gaps: Gaps) -> int:
        """Walk over one element; an error names it."""
        try:
            return walk(self.lengths, at, self.steps, fields, gaps)
        except WireError as error:
            raise WireError(f'element {number}: {error}') from None


def read_elements(data: bytes, input_type: InputType) -> tuple[EditableBuffer, ElementIndex]:
    """
    Copy a message, and find the fields of its elements.

    Parameters
    ----------
    data : bytes
        The serialized message.
    input_type : InputType
        Its type.

    Returns
    -------
    buffer : EditableBuffer
        The message, little-endian, without the tail, and with zeros between its fields.
    index : ElementIndex
        Where the fields of the elements lie.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """
    buffer = EditableBuffer(data)
    lengths = buffer.lengths
    gaps: Gaps = []
    header_fields: Places = defaultdict(list)
    header_end = walk(lengths, 0, HEADER, header_fields, gaps)
    start = header_end + 3 & -4
    gaps.append((header_end, start))
    header_words, count = start >> 2, 1
    if input_type.is_sequence:
        count = element_count(lengths, start, input_type.min_bytes)
        start += 4
    span = _Span(lengths, start, input_type.element, count)
    located = _locate_all_at_once(span, buffer) if count >= _MIN_AT_ONCE else None
    fields, ends = located or _locate_one_by_one(span, gaps)
    end = int(ends[-1]) if count else start
    buffer.check_end(walk(lengths, end, input_type.tail, defaultdict(list), []))
    # Between fields and behind the last one, writers leave whatever was in memory.
    gaps.append((end, 4 * len(buffer.words)))
    buffer.clear(gaps)
    if buffer.order == '>':
        buffer.make_little_endian(
            chain(
                number_places(lengths, HEADER, header_fields),
                [(4, np.arange(4 * header_words, start, 4))],
                number_places(lengths, input_type.element, fields),
            )
        )
    return buffer, ElementIndex(header_words, count, fields, ends, end)


def _locate_one_by_one(span: _Span, gaps: Gaps) -> tuple[Places, list[int]]:
    """Walk over one element after another."""
    fields: Places = defaultdict(list)
    ends = []
    at = span.start
    for number in range(span.elements):
        at = span.walk(number, at, fields, gaps)
        ends.append(at)
    return fields, ends


def _locate_all_at_once(span: _Span, buffer: EditableBuffer) -> tuple[ArrayPlaces, IntArray] | None:
    """Walk over all elements together; None if that fails, as where sequences differ in length."""
    # The second one takes longer, and fails less often.
    for find_starts in (_likely_starts, _learned_starts):
        fields: ArrayPlaces = {}
        gaps: ArrayGaps = []
        try:
            starts = find_starts(span)
            if len(starts) != span.elements or starts[0] != span.start:
                continue
            ends = walk_all(np.asarray(span.lengths), starts, span.steps, fields, gaps)
        except (IndexError, UnevenError, WireError):
            continue
        # The elements start there for certain if each ends where the next one starts.
        if (ends[:-1] + 3 & -4 == starts[1:]).all():
            buffer.check_content(int(ends[-1]))
            gaps.append((ends[:-1], starts[1:]))
            buffer.clear_all(*(np.concatenate(edges) for edges in zip(*gaps, strict=True)))
            return fields, ends
    return None


def _likely_starts(span: _Span) -> IntArray:
    """
    Find where the first string of the first element, and the length behind it, occur again.

    In most messages it is the frame_id, and all elements have the same.
    """
    if [step.kind for step in span.steps[:2]] != [Numbers, Text]:
        return np.array([], np.int64)
    before, _, behind = span.steps[:3]
    words = np.asarray(span.lengths)
    first = span.start + before.length >> 2
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


def _learned_starts(span: _Span) -> IntArray:
    """
    Go from element to element, and walk only over those unlike any before.

    An element whose strings and sequences are as long as those of an earlier one has its size.
    """
    lengths, starts = span.lengths, []
    compared = _compared_steps(span)
    # Elements that start at an even and at an odd word have other padding.
    trees: tuple[_SizeTree, _SizeTree] = ({}, {})
    at = span.start
    for number in range(span.elements):
        at = at + 3 & -4
        starts.append(at)
        node: Any = trees[at >> 2 & 1]
        try:
            while type(node) is dict:
                node = node[lengths[at + node[_OFFSET] >> 2]]
            at += node
        except (IndexError, KeyError):
            fields: Places = defaultdict(list)
            end = span.walk(number, at, fields, [])
            places = sorted(place for step in compared for place in fields[step.path])
            _learn(trees[at >> 2 & 1], lengths, at, end, places)
            at = end
    return np.array(starts, np.int64)


def _compared_steps(span: _Span) -> list[Step]:
    """
    List strings and sequences up to the last one whose length differs among the first elements.

    To compare the lengths of all would take twice as long.
    """
    fields: Places = defaultdict(list)
    at = span.start
    for number in range(min(_SAMPLE, span.elements)):
        at = span.walk(number, at, fields, [])
    steps = [step for step in all_steps(span.steps) if step.kind is not Numbers]
    differing = [
        index
        for index, step in enumerate(steps)
        if len({span.lengths[place >> 2] for place in fields[step.path]}) > 1
    ]
    if any(steps[index].kind is Many for index in differing):
        raise UnevenError
    return steps[: max(_MIN_COMPARED, 1 + max(differing, default=0))]


def _learn(
    tree: _SizeTree, lengths: memoryview, start: int, end: int, places: Sequence[int]
) -> None:
    """Make the lengths of an element lead to its size in a tree."""
    for place in places[:-1]:
        tree[_OFFSET] = place - start
        tree = tree.setdefault(lengths[place >> 2], {})
    tree[_OFFSET] = places[-1] - start
    tree[lengths[places[-1] >> 2]] = end - start
