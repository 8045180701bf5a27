# SPDX-License-Identifier: Apache-2.0
"""The stamp of a message: seconds and nanoseconds."""

Stamp = tuple[int, int]
"""Seconds and nanoseconds, as `builtin_interfaces/Time` has them."""


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
