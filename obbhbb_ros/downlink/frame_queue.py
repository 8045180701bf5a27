# SPDX-License-Identifier: Apache-2.0
"""Frames that wait for what belongs to them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from collections.abc import Iterator
from typing import Generic
from typing import TypeVar

from obbhbb_ros.wire.stamp import Stamp

Frame = TypeVar('Frame')


class FrameQueue(Generic[Frame]):
    """
    Frames that wait, in order, for something of their stamp that is on its way.

    A small message that is lost beside large ones is sent again, seconds later.

    Parameters
    ----------
    is_coming : callable
        Returns whether what belongs to a stamp is on its way.

    Examples
    --------
    >>> queue = FrameQueue[str](lambda stamp: stamp > (5, 0))
    >>> for number in range(4, 8):
    ...     queue.add((number, 0), f'frame {number}', size=100, now=0.0)
    >>> list(queue.ready(now=0.1, max_age=1.0, max_bytes=1e6)), len(queue)
    (['frame 4', 'frame 5'], 2)
    >>> list(queue.ready(now=1.1, max_age=1.0, max_bytes=1e6))
    ['frame 6', 'frame 7']
    """

    def __init__(self, is_coming: Callable[[Stamp], bool]) -> None:
        self._is_coming = is_coming
        self._waiting: deque[tuple[Stamp, Frame, int, float]] = deque()
        self._bytes = 0

    def __len__(self) -> int:
        """Count the frames that wait."""
        return len(self._waiting)

    def __iter__(self) -> Iterator[Frame]:
        """Iterate over the frames that wait, the first one first."""
        return (frame for _, frame, _, _ in self._waiting)

    def add(self, stamp: Stamp, frame: Frame, size: int, now: float) -> None:
        """Add a frame of some bytes, at `now`, seconds of a monotonic clock."""
        self._waiting.append((stamp, frame, size, now))
        self._bytes += size

    def ready(self, now: float, max_age: float, max_bytes: float) -> Iterator[Frame]:
        """Remove and yield the frames that need not, or can no longer, wait."""
        while self._waiting:
            stamp, _, _, since = self._waiting[0]
            may_wait = now - since <= max_age and self._bytes <= max_bytes
            if may_wait and self._is_coming(stamp):
                return
            yield self.pop()

    def is_over(self, max_bytes: float) -> bool:
        """Return whether more bytes wait than that, in more than one frame."""
        return self._bytes > max_bytes and len(self._waiting) > 1

    def pop(self) -> Frame:
        """Remove and return the first frame."""
        _, frame, size, _ = self._waiting.popleft()
        self._bytes -= size
        return frame
