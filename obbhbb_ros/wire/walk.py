# SPDX-License-Identifier: Apache-2.0
"""
Descriptions of messages, and how to find the fields of a message by its description.

A description is a dict of fields, in order; `steps_of` turns it into a list of steps. `walk` takes
these steps over one struct, with plain integers. `walk_all` takes them over many structs of a kind
at once, with arrays, if the start of each is known. Both collect the places of the fields.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from typing import NamedTuple
from typing import TypeAlias

import numpy as np

from obbhbb_ros.wire.buffer import Buffer
from obbhbb_ros.wire.buffer import IntArray
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.buffer import Words


class UnevenError(Exception):
    """These structs cannot be walked all at once."""


@dataclass(frozen=True)
class Numbers:
    """`count` numbers of `size` bytes each, one after the other."""

    size: int
    count: int = 1


@dataclass(frozen=True)
class Text:
    """A string: its length, which counts the closing zero byte, then its bytes."""


@dataclass(frozen=True)
class Array:
    """A sequence of items that are `count` numbers of `size` bytes each, such as points."""

    size: int
    count: int = 1


@dataclass(frozen=True)
class Many:
    """A sequence of structs."""

    element: Struct


Struct: TypeAlias = dict[str, Any]
"""Fields in order, by name; a value is one of the kinds above or another struct."""

# The fewest bytes that a field takes; a string has at least its closing zero.
_MIN_BYTES = {Text: 5, Array: 4, Many: 4}


class Step(NamedTuple):
    """
    What `walk` has to know about a field, or about adjacent numbers of one size.

    Attributes
    ----------
    kind : type
        `Numbers`, `Text`, `Array` or `Many`.
    path : str
        Names of the field and of the structs around it, joined by dots.
    size : int
        Bytes of a number.
    length : int
        Bytes of `Numbers` together; of an item of an `Array`; the fewest bytes of an element of
        `Many`.
    inner : sequence of Step
        The steps over an element of `Many`.
    alignment : int
        The field starts at a multiple of this many bytes; 1 where the field before it ends at one.
    """

    kind: type
    path: str
    size: int
    length: int
    inner: Sequence[Step]
    alignment: int


Places: TypeAlias = defaultdict[str, list[int]]
"""By path, the place of each field: where numbers, or the length of a string or sequence, start."""
Gaps: TypeAlias = list[tuple[int, int]]
"""Start and end of padding between fields."""
ArrayPlaces: TypeAlias = dict[str, IntArray]
ArrayGaps: TypeAlias = list[tuple[IntArray, IntArray]]
AnyPlaces: TypeAlias = Mapping[str, Sequence[int] | IntArray]


def steps_of(struct: Struct, prefix: str = '') -> list[Step]:
    """
    List the steps over a struct and over the structs in it.

    Parameters
    ----------
    struct : Struct
        The description.
    prefix : str
        Put before the name of each field, with a dot at its end.

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
            new = [Step(Many, path, 4, min_bytes(inner), inner, 4)]
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
                is_aligned = last is not None and last.size >= step.alignment
                steps.append(step._replace(alignment=1) if is_aligned else step)
    return steps


def min_bytes(steps: Sequence[Step]) -> int:
    """Return the fewest bytes that a struct takes."""
    return sum(step.length if step.kind is Numbers else _MIN_BYTES[step.kind] for step in steps)


def _check_count(path: str, count: int, min_size: int, bytes_left: int) -> None:
    """Refuse a number of structs that the bytes left in the message cannot hold."""
    if count * min_size > bytes_left:
        raise WireError(f'{path}: {bytes_left} bytes cannot hold {count} elements')


def walk(lengths: memoryview, at: int, steps: Sequence[Step], places: Places, gaps: Gaps) -> int:
    """
    Find the fields of one struct.

    Parameters
    ----------
    lengths : memoryview of uint32
        The body of the message.
    at : int
        Place at which whatever precedes the struct ends.
    steps : sequence of Step
        The steps over the struct.
    places : Places
        The places of the fields are added to it.
    gaps : Gaps
        The gaps between fields are added to it.

    Returns
    -------
    int
        Place at which the struct ends; it may lie behind the end of the message.

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
            places[path].append(at)
            if kind is Numbers:
                at += length
                continue
            count = lengths[at >> 2]
            at += 4
            if kind is Text:
                if not count:
                    raise WireError(f'{path} at byte {at} has no closing zero')
                at += count
            elif kind is Array:
                if count:
                    at = (at + size - 1 & -size) + count * length
            else:
                _check_count(path, count, length, 4 * len(lengths) - at)
                for _ in range(count):
                    at = walk(lengths, at, inner, places, gaps)
    except IndexError:
        raise WireError(
            f'{path} at byte {at} lies behind the end of the message, byte {4 * len(lengths)}'
        ) from None
    return at


def element_count(lengths: memoryview, place: int, min_size: int) -> int:
    """Read how many elements, of some bytes or more, a message has."""
    if place >> 2 >= len(lengths):
        raise WireError(f'the message ends before the number of its elements, at byte {place}')
    count: int = lengths[place >> 2]
    _check_count('message', count, min_size, 4 * len(lengths) - place - 4)
    return count


def read_struct(data: bytes, steps: Sequence[Step]) -> tuple[Buffer, dict[str, int]]:
    """
    Read a message that is one struct, without copying it.

    Parameters
    ----------
    data : bytes
        The serialized message.
    steps : sequence of Step
        The steps over it.

    Returns
    -------
    buffer : Buffer
        The message.
    places : dict of int
        Place of each field, by its path.

    Raises
    ------
    obbhbb_ros.wire.buffer.WireError
        If the bytes are no such message.
    """
    buffer = Buffer(data)
    places: Places = defaultdict(list)
    buffer.check_end(walk(buffer.lengths, 0, steps, places, []))
    return buffer, {path: place for path, (place, *_) in places.items()}


def walk_all(
    lengths: Words, at: IntArray, steps: Sequence[Step], places: ArrayPlaces, gaps: ArrayGaps
) -> IntArray:
    """
    Find the fields of many structs, as `walk` does, with arrays of shape (N,) for integers.

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
        places[step.path] = at
        if step.kind is Numbers:
            at = at + step.length
            continue
        count = lengths[at >> 2].astype(np.int64)
        at = at + 4
        if step.kind is Text:
            if not count.all():
                raise UnevenError
            at = at + count
        elif step.kind is Array:
            items = (at + step.size - 1 & -step.size) + count * step.length
            at = np.where(count > 0, items, at)
        else:
            at = _walk_elements(lengths, at, step, count, places, gaps)
    return at


def _walk_elements(
    lengths: Words, at: IntArray, step: Step, count: IntArray, places: ArrayPlaces, gaps: ArrayGaps
) -> IntArray:
    """Walk over sequences of structs: first the first elements of all, then the second ones."""
    number = int(count[0])
    # Structs that start at wrong places may overlap, so that together they claim too much.
    too_many = number * len(count) * step.length > 4 * len(lengths)
    if too_many or (count != number).any():
        raise UnevenError
    walks: list[ArrayPlaces] = []
    for _ in range(number):
        walks.append({})
        at = walk_all(lengths, at, step.inner, walks[-1], gaps)
    for path in walks[0] if walks else ():
        # In the order of `walk`: all elements of the first struct, then those of the second.
        places[path] = np.array([elements[path] for elements in walks]).T.ravel()
    return at


def all_steps(steps: Sequence[Step]) -> Iterator[Step]:
    """List steps and those inside them."""
    for step in steps:
        yield step
        yield from all_steps(step.inner)


def ranges(starts: IntArray, counts: IntArray) -> IntArray:
    """
    Concatenate ranges of integers.

    Examples
    --------
    >>> ranges(np.array([10, 20]), np.array([3, 2]))
    array([10, 11, 12, 20, 21])
    """
    return np.repeat(starts - counts.cumsum() + counts, counts) + np.arange(counts.sum())


def number_places(
    lengths: memoryview, steps: Sequence[Step], places: AnyPlaces
) -> Iterator[tuple[int, IntArray]]:
    """
    List all numbers of structs, lengths of strings and sequences included.

    Yields
    ------
    size : int
        Bytes of a number.
    places : ndarray of int
        Where numbers of this size are.
    """
    for step in all_steps(steps):
        starts = np.array(places.get(step.path, ()), np.int64)
        if step.kind is Numbers:
            yield step.size, (starts[:, None] + np.arange(0, step.length, step.size)).ravel()
            continue
        yield 4, starts
        if step.kind is Array and step.size > 1:
            items = np.asarray(lengths)[starts >> 2].astype(np.int64)
            firsts = (starts + 4 + step.size - 1) // step.size
            yield step.size, step.size * ranges(firsts, items * (step.length // step.size))
