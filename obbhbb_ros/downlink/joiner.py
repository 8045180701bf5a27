# SPDX-License-Identifier: Apache-2.0
"""
Joining of messages by stamp, in bounded memory and in any order of arrival.

`StampCache` holds messages until they are looked up by their stamp. A `JoinerSide` pairs those of
one topic with those of another.
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


class JoinerSide(Generic[Item, Partner]):
    """
    One side of a joiner: items that are paired by stamp with those of another side.

    An item is paired with the waiting one of the same stamp, or else with the one of the nearest
    stamp within the slop, the earlier of two. A zero stamp means no stamp and is never paired.

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

    Examples
    --------
    >>> images, plans = JoinerSide(print, print), JoinerSide(print, print)
    >>> images.pair_with(plans)
    >>> plans.add((5, 0), 'plan', now=0.0, max_count=10)
    >>> images.add((5, 0), 'image', now=0.1, max_count=10)
    'plan'
    """

    def __init__(
        self,
        on_dropped: Callable[[Unpaired, Item], None],
        on_jump_back: Callable[[Stamp, Stamp], None],
    ) -> None:
        self.waiting = StampCache[Item]()
        # Stamps whose item has had its partner: a duplicate may still arrive.
        self._joined = StampCache[None]()
        self._latest = ZERO_STAMP
        self._on_dropped, self._on_jump_back = on_dropped, on_jump_back
        self._other: JoinerSide[Partner, Item]

    def pair_with(self, other: JoinerSide[Partner, Item]) -> None:
        """Make this side and another one the two sides of a joiner."""
        self._other, other._other = other, self

    def add(
        self, stamp: Stamp, item: Item, now: float, max_count: int, slop: float = 0.0
    ) -> Partner | None:
        """
        Add an item, and return its partner; without one the item waits.

        Parameters
        ----------
        stamp : tuple of int
            Seconds and nanoseconds.
        item : Item
            The item.
        now : float
            Seconds of a monotonic clock.
        max_count : int
            Maximum number of items that wait on this side; the oldest is dropped first.
        slop : float
            Maximum difference between the stamps of a pair, seconds (0: stamps are equal).
        """
        if stamp == ZERO_STAMP:
            self._drop(Unpaired.ZERO_STAMP, [item])
            return None
        if stamp < self._latest:
            self._on_jump_back(self._latest, stamp)
            # The same stamps come again and must be paired again.
            self._joined.clear()
            self._other._joined.clear()
        self._latest = stamp
        if stamp in self._joined:
            self._drop(Unpaired.DUPLICATE, [item])
            return None
        partner_stamp = self._other.waiting.nearest(stamp, slop)
        if partner_stamp is not None:
            self._note_joined(stamp, now)
            self._other._note_joined(partner_stamp, now)
            return self._other.waiting.pop(partner_stamp)
        replaced = self.waiting.put(stamp, item, now)
        self._drop(Unpaired.DUPLICATE, [] if replaced is None else [replaced])
        self._drop(Unpaired.CROWDED_OUT, self.waiting.shrink(max_count))
        return None

    def expire(self, now: float, max_age: float) -> None:
        """Drop the items that came more than `max_age` seconds ago."""
        self._drop(Unpaired.EXPIRED, self.waiting.expire(now, max_age))
        self._joined.expire(now, max_age)

    def clear(self) -> None:
        """Drop all items; the next stamp is not a jump back."""
        self._latest = ZERO_STAMP
        self._drop(Unpaired.CLEARED, self.waiting.clear())

    def _note_joined(self, stamp: Stamp, now: float) -> None:
        """Note that the item of a stamp has its partner."""
        self._joined.put(stamp, None, now)
        self._joined.shrink(_MAX_JOINED)

    def _drop(self, reason: Unpaired, items: list[Item]) -> None:
        """Report items that get no partner."""
        for item in items:
            self._on_dropped(reason, item)
