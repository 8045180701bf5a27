# SPDX-License-Identifier: Apache-2.0
"""The stamp of a message: seconds and nanoseconds."""

import struct

Stamp = tuple[int, int]
"""Seconds and nanoseconds, as `builtin_interfaces/Time` has them."""
ZERO_STAMP: Stamp = (0, 0)
"""No stamp at all: a header that nobody filled in."""
# Seconds are an int32.
_LATEST = (1 << 31) * 1_000_000_000 - 1
# Behind an encapsulation header of four bytes.
_STAMP_ENDS = 12


def stamp_text(stamp: Stamp) -> str:
    """
    Write a stamp as a number of seconds.

    Examples
    --------
    >>> stamp_text((5, 20))
    '5.000000020'
    """
    seconds, nanoseconds = stamp
    return f'{seconds}.{nanoseconds:09d}'


def nanoseconds_of(stamp: Stamp) -> int:
    """
    Return a stamp as a number of nanoseconds.

    Examples
    --------
    >>> nanoseconds_of((5, 20))
    5000000020
    """
    return stamp[0] * 1_000_000_000 + stamp[1]


def stamp_at_start(data: bytes) -> Stamp:
    """
    Read the stamp of a serialized message that starts with a header; zero if there is none.

    Examples
    --------
    >>> stamp_at_start(bytes([0, 1, 0, 0, 5, 0, 0, 0, 20, 0, 0, 0]))
    (5, 20)
    """
    if len(data) < _STAMP_ENDS:
        return 0, 0
    order = '<' if data[1] else '>'
    seconds, nanoseconds = struct.unpack_from(f'{order}iI', data, 4)
    return seconds, nanoseconds


def later(stamp: Stamp, seconds: float) -> Stamp:
    """
    Return the stamp some seconds later, which may be negative.

    None is before zero, or beyond the last one that a message can hold.

    Examples
    --------
    >>> later((5, 900_000_000), 0.25)
    (6, 150000000)
    """
    nanoseconds = nanoseconds_of(stamp) + round(seconds * 1e9)
    return divmod(min(max(nanoseconds, 0), _LATEST), 1_000_000_000)
