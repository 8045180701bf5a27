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
    Items by stamp, in the order of arrival. Times are seconds of a monotonic clock.

    Parameters
    ----------
    on_dropped : callable
        Called with reason and item for each item that is dropped: by `put`, `expire` or `clear`.

    Examples
    --------
    >>> cache = StampCache[str](print)
    >>> cache.put((5, 0), 'first', now=0.0, max_count=2)
    >>> cache.put((6, 0), 'second', now=0.1, max_count=2)
    >>> cache.nearest((5, 9), slop=1e-8)
    (5, 0)
    >>> cache.expire(now=2.05, max_age=2.0)
    Unpaired.EXPIRED first
    >>> list(cache)
    ['second']
    """

    def __init__(self, on_dropped: Callable[[Unpaired, Item], object]) -> None:
        self._on_dropped = on_dropped
        self._entries: OrderedDict[Stamp, tuple[float, Item]] = OrderedDict()

    def __len__(self) -> int:
        """Count the items."""
        return len(self._entries)

    def __contains__(self, stamp: Stamp) -> bool:
        """Return whether there is an item of this stamp."""
        return stamp in self._entries

    def __getitem__(self, stamp: Stamp) -> Item:
        """Return the item of a stamp; KeyError if there is none."""
        return self._entries[stamp][1]

    def __iter__(self) -> Iterator[Item]:
        """Iterate over the items, the oldest first."""
        return (item for _, item in self._entries.values())

    def items(self) -> list[tuple[Stamp, Item]]:
        """List stamps and items, the oldest first."""
        return [(stamp, item) for stamp, (_, item) in self._entries.items()]

    def put(self, stamp: Stamp, item: Item, now: float, max_count: int) -> None:
        """Add an item as the newest; drop one of the same stamp, and the oldest over the count."""
        replaced = self._entries.pop(stamp, None)
        self._entries[stamp] = now, item
        if replaced is not None:
            self._on_dropped(Unpaired.DUPLICATE, replaced[1])
        self._drop_while(Unpaired.CROWDED_OUT, lambda _: len(self._entries) > max_count)

    def renew(self, stamp: Stamp, now: float) -> None:
        """Let the item of a stamp, if there is one, wait from now on."""
        if stamp in self._entries:
            self._entries[stamp] = now, self._entries.pop(stamp)[1]

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

    def expire(self, now: float, max_age: float) -> None:
        """Drop the items that came more than `max_age` seconds ago."""
        self._drop_while(Unpaired.EXPIRED, lambda arrival: now - arrival > max_age)

    def clear(self) -> None:
        """Drop all items."""
        self._drop_while(Unpaired.CLEARED, lambda _: True)

    def _drop_while(self, reason: Unpaired, condition: Callable[[float], bool]) -> None:
        """Drop the oldest items while the arrival of the oldest meets a condition."""
        while self._entries and condition(next(iter(self._entries.values()))[0]):
            # One by one: an error of the callback costs no other item.
            _, (_, item) = self._entries.popitem(last=False)
            self._on_dropped(reason, item)


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
        self.waiting = StampCache[Item](on_dropped)
        # Stamps of items that were paired: a duplicate may still arrive.
        self._joined = StampCache[None](lambda reason, _: None)
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
            self._on_dropped(Unpaired.ZERO_STAMP, item)
            return None
        if stamp < self._latest:
            self._on_jump_back(self._latest, stamp)
            # The same stamps come again and must be paired again.
            self._joined.clear()
            self._other._joined.clear()
        self._latest = stamp
        if stamp in self._joined:
            self._on_dropped(Unpaired.DUPLICATE, item)
            return None
        partner_stamp = self._other.waiting.nearest(stamp, slop)
        if partner_stamp is None:
            self.waiting.put(stamp, item, now, max_count)
            return None
        self._joined.put(stamp, None, now, _MAX_JOINED)
        self._other._joined.put(partner_stamp, None, now, _MAX_JOINED)
        return self._other.waiting.pop(partner_stamp)

    def expire(self, now: float, max_age: float) -> None:
        """Drop the items that came more than `max_age` seconds ago."""
        self.waiting.expire(now, max_age)
        self._joined.expire(now, max_age)

    def clear(self) -> None:
        """Drop all items; the next stamp is not a jump back."""
        self._latest = ZERO_STAMP
        self.waiting.clear()
