# SPDX-License-Identifier: Apache-2.0
"""Collects what belongs to one image by exact stamp, in bounded memory and in any order."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from collections.abc import Set
from dataclasses import dataclass
from dataclasses import field
from enum import Enum
from typing import Any

from obbhbb_ros.downlink.stamps import Stamp

IMAGE = 'image'
"""The part without which nothing can be drawn."""

_FRAMES_KEPT = 1000


class NotDrawn(str, Enum):
    """Why a frame was discarded."""

    NO_IMAGE = 'no_image'
    OVERTAKEN = 'overtaken'
    CROWDED_OUT = 'crowded_out'
    CLEARED = 'deactivated'


@dataclass(frozen=True)
class CollectorLimits:
    """
    How long parts wait for each other.

    Attributes
    ----------
    max_wait : float
        How long an image waits for other parts, seconds from its arrival.
    max_age : float
        How long other parts wait for their image, seconds from the arrival of the first.
    images : int
        How many images may wait.
    """

    max_wait: float
    max_age: float
    images: int


@dataclass
class _Frame:
    """The parts of one stamp so far; when the image, or before it the first part, came."""

    since: float
    number: int = 0
    parts: dict[str, Any] = field(default_factory=dict)


class FrameCollector:
    """
    Frames that wait for their parts.

    A frame is ready once all the parts that are awaited are there, or some time after its image
    came with those that are. One that is not complete by then is discarded if a frame whose image
    came later was ready before: pictures do not go back in time. A large image takes a while to
    arrive, so other parts may wait longer for it than it for them.

    Parameters
    ----------
    on_discarded : callable
        Called with the reason for each frame that is discarded.

    Examples
    --------
    >>> frames = FrameCollector(on_discarded=print)
    >>> limits = CollectorLimits(max_wait=0.5, max_age=5.0, images=10)
    >>> frames.add('boxes', (5, 0), 'some boxes', now=0.0)
    True
    >>> frames.add('image', (5, 0), 'pixels', now=0.1)
    True
    >>> frames.ready({'boxes'}, now=0.1, limits=limits)
    [{'boxes': 'some boxes', 'image': 'pixels'}]
    """

    def __init__(self, on_discarded: Callable[[NotDrawn], None]) -> None:
        self._on_discarded = on_discarded
        self._waiting: OrderedDict[Stamp, _Frame] = OrderedDict()
        self._images = 0
        self._latest_ready = 0

    def __len__(self) -> int:
        """Count the frames that wait."""
        return len(self._waiting)

    def add(self, kind: str, stamp: Stamp, item: Any, now: float) -> bool:
        """
        Add a part at `now`, seconds of a monotonic clock.

        Returns false if it takes the place of another of the same kind and stamp.
        """
        frame = self._waiting.get(stamp)
        if frame is None:
            frame = self._waiting[stamp] = _Frame(now)
        is_new = kind not in frame.parts
        if kind == IMAGE and is_new:
            self._images += 1
            frame.since, frame.number = now, self._images
        frame.parts[kind] = item
        return is_new

    def ready(self, awaited: Set[str], now: float, limits: CollectorLimits) -> list[dict[str, Any]]:
        """List the parts of each frame that is ready, besides the image those of `awaited`."""
        found = []
        needed = awaited | {IMAGE}
        for stamp, frame in list(self._waiting.items()):
            complete = needed <= frame.parts.keys()
            patience = limits.max_wait if IMAGE in frame.parts else limits.max_age
            if not complete and now - frame.since < patience:
                continue
            del self._waiting[stamp]
            if IMAGE not in frame.parts:
                self._on_discarded(NotDrawn.NO_IMAGE)
            elif not complete and frame.number < self._latest_ready:
                self._on_discarded(NotDrawn.OVERTAKEN)
            else:
                self._latest_ready = max(self._latest_ready, frame.number)
                found.append(frame.parts)
        self._make_room(limits.images)
        return found

    def clear(self) -> None:
        """Discard everything."""
        while self._waiting:
            self._discard(next(iter(self._waiting)), NotDrawn.CLEARED)

    def _make_room(self, images: int) -> None:
        """Discard the oldest frames, where there are too many."""
        with_image = [stamp for stamp, frame in self._waiting.items() if IMAGE in frame.parts]
        for stamp in with_image[: max(len(with_image) - images, 0)]:
            self._discard(stamp, NotDrawn.CROWDED_OUT)
        while len(self._waiting) > _FRAMES_KEPT:
            self._discard(next(iter(self._waiting)), NotDrawn.CROWDED_OUT)

    def _discard(self, stamp: Stamp, reason: NotDrawn) -> None:
        """Discard a frame."""
        del self._waiting[stamp]
        self._on_discarded(reason)
