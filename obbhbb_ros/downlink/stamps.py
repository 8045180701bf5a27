# SPDX-License-Identifier: Apache-2.0
"""Stamps by which chips are told apart: each chip of an image has one of its own."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import TypeAlias

Stamp: TypeAlias = tuple[int, int]
"""Seconds and nanoseconds."""

_REMEMBERED = 10_000
_SECOND = 1_000_000_000
_LAST = 2**31 - 1


class ChipStamps:
    """
    Gives out stamps, none of them twice among the last 10,000.

    Examples
    --------
    >>> stamps = ChipStamps()
    >>> first, second = stamps.of_image((7, 999_999_999)), stamps.of_image((8, 0))
    >>> next(first), next(first), next(second)
    ((7, 999999999), (8, 0), (8, 1))
    """

    def __init__(self) -> None:
        self._given: set[Stamp] = set()
        self._order: deque[Stamp] = deque()

    def of_image(self, stamp: Stamp) -> Iterator[Stamp]:
        """Give stamps for the chips of an image: its own and those 1, 2, ... ns after it."""
        seconds, nanoseconds = stamp
        while True:
            stamp = seconds, nanoseconds
            if stamp not in self._given:
                self._remember(stamp)
                yield stamp
            nanoseconds += 1
            if nanoseconds >= _SECOND:
                # After the last second that a message can hold comes the first.
                seconds, nanoseconds = (0 if seconds == _LAST else seconds + 1), 0

    def _remember(self, stamp: Stamp) -> None:
        """Remember a stamp instead of the oldest."""
        self._given.add(stamp)
        self._order.append(stamp)
        if len(self._order) > _REMEMBERED:
            self._given.discard(self._order.popleft())
