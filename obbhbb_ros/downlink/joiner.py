# SPDX-License-Identifier: Apache-2.0
"""
Joining of messages by stamp, in bounded memory and in any order of arrival.

`StampCache` holds the messages of one topic; whatever needs a message of a certain stamp later
looks it up there. `PairJoiner` pairs images with crop plans through two of them.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Generic
from typing import TypeVar

from obbhbb_ros.limits import CheckedSettings
from obbhbb_ros.limits import Range
from obbhbb_ros.limits import setting
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.stamp import nanoseconds_of

Item = TypeVar('Item')
Partner = TypeVar('Partner')
ImageT = TypeVar('ImageT')
PlanT = TypeVar('PlanT')

ZERO_STAMP: Stamp = (0, 0)
"""No stamp at all: a header that nobody filled in."""

# During a stall the middleware keeps this much, 1.6 s of images at 10 Hz, and then delivers it at
# once, images and plans in any order: the caches hold as much.
IMAGES_KEPT = 16
PLANS_KEPT = 100
_MAX_JOINED = 1000


class Unpaired(str, Enum):
    """Why an item was dropped without a partner."""

    EXPIRED = 'expired'
    CROWDED_OUT = 'crowded_out'
    DUPLICATE = 'duplicate'
    ZERO_STAMP = 'zero_stamp'
    CLEARED = 'deactivated'


class StampCache(Generic[Item]):
    """
    Items by stamp, in the order of arrival.

    It drops nothing by itself: `put`, `expire`, `shrink` and `clear` return what they remove, so
    that the caller can account for it. Times are seconds of a monotonic clock.

    Examples
    --------
    >>> cache = StampCache[str]()
    >>> cache.put((5, 0), 'first', now=0.0)
    >>> cache.put((6, 0), 'second', now=0.1)
    >>> cache.nearest((5, 9), slop=1e-8)
    (5, 0)
    >>> cache.shrink(1), list(cache)
    (['first'], ['second'])
    """

    def __init__(self) -> None:
        self._entries: OrderedDict[Stamp, tuple[float, Item]] = OrderedDict()

    def __len__(self) -> int:
        """Count the items."""
        return len(self._entries)

    def __contains__(self, stamp: Stamp) -> bool:
        """Return whether there is an item of this stamp."""
        return stamp in self._entries

    def __iter__(self) -> Iterator[Item]:
        """Iterate over the items, the oldest first."""
        return (item for _, item in self._entries.values())

    def items(self) -> list[tuple[Stamp, Item]]:
        """List stamps and items, the oldest first."""
        return [(stamp, item) for stamp, (_, item) in self._entries.items()]

    def get(self, stamp: Stamp) -> Item | None:
        """Return the item of a stamp."""
        return self._entries.get(stamp, (0.0, None))[1]

    def put(self, stamp: Stamp, item: Item, now: float) -> Item | None:
        """Add an item as the newest; return the item of the same stamp that it replaces."""
        replaced = self.pop(stamp)
        self._entries[stamp] = now, item
        return replaced

    def pop(self, stamp: Stamp) -> Item | None:
        """Remove and return the item of a stamp."""
        return self._entries.pop(stamp, (0.0, None))[1]

    def nearest(self, stamp: Stamp, slop: float) -> Stamp | None:
        """Return the nearest stamp at most `slop` seconds away, the earlier of two."""
        if stamp in self._entries:
            return stamp
        if not slop or not self._entries:
            return None
        target = nanoseconds_of(stamp)
        distance, nearest = min(
            (abs(nanoseconds_of(other) - target), other) for other in self._entries
        )
        return nearest if distance <= round(slop * 1e9) else None

    def expire(self, now: float, max_age: float) -> list[Item]:
        """Remove the items that came more than `max_age` seconds ago."""
        return self._remove_while(lambda arrival: now - arrival > max_age)

    def shrink(self, count: int) -> list[Item]:
        """Remove the oldest items until no more than `count` are left."""
        return self._remove_while(lambda _: len(self._entries) > count)

    def clear(self) -> list[Item]:
        """Remove all items."""
        return self.shrink(0)

    def _remove_while(self, condition: Callable[[float], bool]) -> list[Item]:
        """Remove the oldest items while the arrival of the oldest meets a condition."""
        removed = []
        while self._entries and condition(next(iter(self._entries.values()))[0]):
            removed.append(self._entries.popitem(last=False)[1][1])
        return removed


@dataclass(frozen=True)
class PairLimits(CheckedSettings):
    """How images and crop plans wait for each other; ValueError if a value is out of range."""

    images: int = setting(
        IMAGES_KEPT,
        'Maximum images that wait for their crop plan; the oldest is dropped first.',
        Range(1, 1000),
    )
    regions: int = setting(
        PLANS_KEPT,
        'Maximum crop plans that wait for their image; the oldest is dropped first.',
        Range(1, 100_000),
    )
    max_age: float = setting(
        2.0, 'How long images and crop plans wait for each other, seconds.', Range(0.0, 3600.0)
    )
    slop: float = setting(
        0.0,
        'Maximum difference between the stamps of an image and its crop plan, seconds.',
        Range(0.0, 3600.0),
    )


class JoinerSide(Generic[Item]):
    """
    One side of a `PairJoiner`: the items of one kind.

    Parameters
    ----------
    on_dropped : callable
        Called with reason and item for each item that is dropped without a partner.
    on_jump_back : callable
        Called with the latest and the new stamp if the new one is earlier: a bag that loops, or a
        clock that was set back.

    Attributes
    ----------
    waiting : StampCache
        The items that wait for a partner.
    joined : StampCache
        The stamps whose item has had its partner; a duplicate may still arrive.
    latest : tuple of int
        The stamp that arrived last.
    """

    def __init__(
        self,
        on_dropped: Callable[[Unpaired, Item], None],
        on_jump_back: Callable[[Stamp, Stamp], None],
    ) -> None:
        self.waiting = StampCache[Item]()
        self.joined = StampCache[None]()
        self.latest = ZERO_STAMP
        self._on_dropped, self.on_jump_back = on_dropped, on_jump_back

    def drop(self, reason: Unpaired, *items: Item) -> None:
        """Report items that get no partner."""
        for item in items:
            self._on_dropped(reason, item)

    def note_joined(self, stamp: Stamp, now: float) -> None:
        """Note that the item of a stamp has its partner."""
        self.joined.put(stamp, None, now)
        self.joined.shrink(_MAX_JOINED)

    def expire(self, now: float, max_age: float) -> None:
        """Drop the items that have waited too long."""
        self.drop(Unpaired.EXPIRED, *self.waiting.expire(now, max_age))
        self.joined.expire(now, max_age)

    def clear(self) -> None:
        """Drop all items; the next stamp is not a jump back."""
        self.latest = ZERO_STAMP
        self.drop(Unpaired.CLEARED, *self.waiting.clear())


class PairJoiner(Generic[ImageT, PlanT]):
    """
    Pairs images with crop plans by stamp.

    An item is paired with the waiting one of the same stamp, or else with the one of the nearest
    stamp within the slop, the earlier of two. A zero stamp means no stamp and is never paired.

    Parameters
    ----------
    images, plans : JoinerSide
        The two sides.

    Examples
    --------
    >>> joiner = PairJoiner(JoinerSide(print, print), JoinerSide(print, print))
    >>> limits = PairLimits(images=10, regions=10, max_age=1.0)
    >>> joiner.add_plan((5, 0), 'plan', now=0.0, limits=limits)
    >>> joiner.add_image((5, 0), 'image', now=0.1, limits=limits)
    ('image', 'plan')
    """

    def __init__(self, images: JoinerSide[ImageT], plans: JoinerSide[PlanT]) -> None:
        self._images, self._plans = images, plans

    def add_image(
        self, stamp: Stamp, image: ImageT, now: float, limits: PairLimits
    ) -> tuple[ImageT, PlanT] | None:
        """Add an image at `now`, seconds of a monotonic clock; return it with its plan, if any."""
        self.expire(now, limits)
        plan = self._join(stamp, image, now, self._images, self._plans, limits.slop)
        self._images.drop(Unpaired.CROWDED_OUT, *self._images.waiting.shrink(limits.images))
        return None if plan is None else (image, plan)

    def add_plan(
        self, stamp: Stamp, plan: PlanT, now: float, limits: PairLimits
    ) -> tuple[ImageT, PlanT] | None:
        """Add a plan at `now`, seconds of a monotonic clock; return it with its image, if any."""
        self.expire(now, limits)
        image = self._join(stamp, plan, now, self._plans, self._images, limits.slop)
        self._plans.drop(Unpaired.CROWDED_OUT, *self._plans.waiting.shrink(limits.regions))
        return None if image is None else (image, plan)

    def expire(self, now: float, limits: PairLimits) -> None:
        """Drop what has waited too long."""
        self._images.expire(now, limits.max_age)
        self._plans.expire(now, limits.max_age)

    def clear(self) -> None:
        """Drop all items; the next stamp of either kind is not a jump back."""
        self._images.clear()
        self._plans.clear()

    def _join(
        self,
        stamp: Stamp,
        item: Item,
        now: float,
        side: JoinerSide[Item],
        other_side: JoinerSide[Partner],
        slop: float,
    ) -> Partner | None:
        """Take the partner of an item from the other side, or let the item wait."""
        if stamp == ZERO_STAMP:
            side.drop(Unpaired.ZERO_STAMP, item)
            return None
        if stamp < side.latest:
            side.on_jump_back(side.latest, stamp)
            # The same stamps come again and must be paired again.
            side.joined.clear()
            other_side.joined.clear()
        side.latest = stamp
        if stamp in side.joined:
            side.drop(Unpaired.DUPLICATE, item)
            return None
        partner_stamp = other_side.waiting.nearest(stamp, slop)
        if partner_stamp is not None:
            side.note_joined(stamp, now)
            other_side.note_joined(partner_stamp, now)
            return other_side.waiting.pop(partner_stamp)
        replaced = side.waiting.put(stamp, item, now)
        if replaced is not None:
            side.drop(Unpaired.DUPLICATE, replaced)
        return None
