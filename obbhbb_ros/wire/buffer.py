# SPDX-License-Identifier: Apache-2.0
"""
The bytes of a serialized message.

A ROS 2 message travels as plain CDR (XCDR1): an encapsulation header of four bytes, which tells the
byte order, and a body. In the body, a number of n bytes lies at a multiple of n bytes, and a string
or a sequence starts with its length in four bytes. Everywhere in `obbhbb_ros.wire`, a place is a
number of bytes from the start of the body.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.errors import ObbhbbError
from obbhbb_ros.wire.stamp import Stamp

IntArray: TypeAlias = NDArray[np.int64]
Words: TypeAlias = NDArray[np.uint32]

LITTLE_ENDIAN = b'\x00\x01\x00\x00'
"""Encapsulation header of a little-endian message."""

_ENCAPSULATION = len(LITTLE_ENDIAN)
# Behind the stamp of a header.
_FRAME_ID = 8
_BYTE_ORDERS = {b'\x00\x00': '>', b'\x00\x01': '<'}
_WORD = {order: np.dtype(f'{order}u4') for order in '<>'}
# Serializer and middleware may each pad to a multiple of four bytes.
_MAX_PADDING = 6
# By how many bytes of a word precede a gap: the mask that keeps these bytes and clears the others.
# With 0 the gap starts at a word of its own.
_KEPT = np.array([0xFFFFFFFF, 0xFF, 0xFFFF, 0xFFFFFF], np.uint32)
# How `backslashreplace` begins a byte that `surrogateescape` has read.
_ESCAPED = b'\\udc'


class WireError(ObbhbbError, ValueError):
    """The bytes are not a message of the expected type; the text says what is wrong and where."""


class Buffer:
    """
    A message to be read, in the byte order that it has.

    Parameters
    ----------
    data : bytes
        The serialized message.

    Attributes
    ----------
    order : str
        Byte order, '<' or '>', as `struct` writes it.
    body : memoryview of bytes
        The message without its encapsulation header.
    size : int
        Bytes of the body.
    lengths : memoryview of uint32
        The body as unsigned integers, from which lengths of strings and sequences are read.

    Raises
    ------
    WireError
        If the bytes do not start with the encapsulation header of plain CDR.
    """

    def __init__(self, data: bytes) -> None:
        header = bytes(data[:_ENCAPSULATION])
        order = _BYTE_ORDERS.get(header[:2])
        if order is None or len(header) < _ENCAPSULATION:
            raise WireError(f'encapsulation {header.hex()} is not plain CDR')
        self.order = order
        self.body, self.size = self._hold(memoryview(data)[_ENCAPSULATION:])
        words = np.frombuffer(self.body, _WORD[order], self.size // 4)
        # A memoryview gives single numbers in a third of the time that an array takes.
        self.lengths: memoryview = words.astype(_WORD['<'], copy=False).data

    def _hold(self, body: memoryview) -> tuple[memoryview, int]:
        """Return the body to work on, here without a copy, and its size."""
        return body, len(body)

    @property
    def stamp(self) -> Stamp:
        """The stamp of the header that the message starts with."""
        seconds, nanoseconds = self.numbers(0, 'iI')
        return seconds, nanoseconds

    @property
    def frame_id(self) -> str:
        """The frame of that header; bytes that are not UTF-8 are escaped."""
        return self.text(_FRAME_ID)

    def numbers(self, place: int, codes: str) -> tuple[Any, ...]:
        """Read numbers, whose types are given as `struct` does."""
        return struct.unpack_from(self.order + codes, self.body, place)

    def content(self, place: int) -> memoryview:
        """Return the bytes that follow a length: a string with its closing zero, or a uint8[]."""
        start = place + 4
        return self.body[start : start + self.lengths[place >> 2]]

    def text(self, place: int) -> str:
        """Read a string; bytes that are not UTF-8 are escaped."""
        return _decoded(bytes(self.content(place)[:-1]))

    def repeated_texts(self, places: Iterable[int]) -> list[str]:
        """Read strings of which many are equal, empty for a place of 0."""
        contents = [bytes(self.content(place)[:-1]) if place else b'' for place in places]
        texts = {content: _decoded(content) for content in set(contents)}
        return [texts[content] for content in contents]

    def check_content(self, end: int) -> None:
        """Refuse a message that ends before its content does."""
        if end > self.size:
            raise WireError(f'the content ends at byte {end}, the message at byte {self.size}')

    def check_end(self, end: int) -> None:
        """Refuse a message that is shorter than its content, or longer by more than padding."""
        self.check_content(end)
        if self.size - end > _MAX_PADDING:
            raise WireError(f'{self.size - end} bytes behind the content')


class EditableBuffer(Buffer):
    """
    A copy of a message, to be changed in place and written again.

    Parameters
    ----------
    data : bytes
        The serialized message.
    room : int
        Zeros to add to the body, bytes.

    Attributes
    ----------
    words : ndarray of uint32
        The body, and at least two words of zeros.

    Raises
    ------
    WireError
        If the bytes do not start with the encapsulation header of plain CDR.
    """

    def __init__(self, data: bytes, room: int = 0) -> None:
        self._room = room
        super().__init__(data)

    def _hold(self, body: memoryview) -> tuple[memoryview, int]:
        """Copy the body, so that it starts at a multiple of eight bytes, and ends at one."""
        size = len(body) + self._room
        copy = bytearray().join((body, bytes(self._room + (-size & 7) + 8)))
        self.words: Words = np.frombuffer(copy, _WORD['<'])
        return memoryview(copy), size

    def make_little_endian(self, numbers: Iterable[tuple[int, IntArray]]) -> None:
        """Reverse the bytes of all numbers, given as sizes in bytes and places."""
        for size, places in numbers:
            values = self.words.view(f'u{size}')
            values[places // size] = values[places // size].byteswap()
        self.order = '<'

    def clear(self, gaps: Iterable[tuple[int, int]]) -> None:
        """Write zeros over gaps within the buffer, given as pairs of start and end."""
        for start, end in gaps:
            self.body[start:end] = bytes(end - start)

    def clear_all(self, starts: IntArray, ends: IntArray) -> None:
        """Write zeros over gaps of up to seven bytes, which end at multiples of four."""
        self.words[starts >> 2] &= _KEPT[starts & 3]
        self.words[(ends[ends - starts >= 4] >> 2) - 1] = 0

    def message(self, end: int) -> bytes:
        """Return the serialized message, little-endian, whose content ends at a place."""
        return b''.join((LITTLE_ENDIAN, self.body[:end]))


def _decoded(content: bytes) -> str:
    r"""Decode UTF-8; write other bytes as `\xff`, five times as fast as `backslashreplace`."""
    if content.isascii():
        return content.decode()
    if _ESCAPED in content:
        return content.decode(errors='backslashreplace')
    escaped = content.decode(errors='surrogateescape').encode(errors='backslashreplace')
    return escaped.replace(_ESCAPED, b'\\x').decode()
