# SPDX-License-Identifier: Apache-2.0
"""Stamps for chips: no two chips share one."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator

from obbhbb_ros.wire.stamp import Stamp

_MAX_TAKEN = 10_000
_SECOND = 1_000_000_000
_MAX_SECONDS = 2**31 - 1


class ChipStamps:
    """
    Hands out stamps, none of them twice among the last 10,000.

    Examples
    --------
    >>> stamps = ChipStamps()
    >>> first, second = stamps.of_image((7, 999_999_999)), stamps.of_image((8, 0))
    >>> next(first), next(first), next(second)
    ((7, 999999999), (8, 0), (8, 1))
    """

    def __init__(self) -> None:
        # In the order in which they were taken.
        self._taken: OrderedDict[Stamp, None] = OrderedDict()

    def of_image(self, stamp: Stamp) -> Iterator[Stamp]:
        """Yield stamps for the chips of an image: that of the image, then 1, 2, ... ns after it."""
        seconds, nanoseconds = stamp
        while True:
            stamp = seconds, nanoseconds
            if stamp not in self._taken:
                self._taken[stamp] = None
                if len(self._taken) > _MAX_TAKEN:
                    self._taken.popitem(last=False)
                yield stamp
            nanoseconds += 1
            if nanoseconds >= _SECOND:
                # After the last second that a message can hold, start again from 0.
                seconds, nanoseconds = (0 if seconds == _MAX_SECONDS else seconds + 1), 0
