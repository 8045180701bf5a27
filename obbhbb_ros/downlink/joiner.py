# SPDX-License-Identifier: Apache-2.0
"""
Joining of messages by stamp, in bounded memory and in any order of arrival.

`StampCache` holds messages until they are looked up by their stamp. A `JoinerSide` pairs those of
one topic with those of another.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from typing import Generic
from typing import NamedTuple
from typing import TypeVar

from obbhbb_ros.limits import MAX_BYTES
from obbhbb_ros.limits import CheckedSettings
from obbhbb_ros.limits import Range
from obbhbb_ros.limits import setting
from obbhbb_ros.wire.stamp import ZERO_STAMP
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.stamp import nanoseconds_of

Item = TypeVar('Item')
Partner = TypeVar('Partner')

# During a stall the middleware keeps this much, 1.6 s of images at 10 Hz, and then delivers it at
# once, images and plans in any order.
IMAGES_KEPT = 16
PLANS_KEPT = 100
CAMERAS_KEPT = 100
_MAX_JOINED = 1000
_MAX_GONE = 1000


class Unpaired(str, Enum):
    """Why an item was dropped without a partner."""

    EXPIRED = 'expired'
    CROWDED_OUT = 'crowded_out'
    PARTNER_GONE = 'partner_gone'
    DUPLICATE = 'duplicate'
    ZERO_STAMP = 'zero_stamp'
    CLEARED = 'deactivated'
    OVERLOADED = 'overloaded'


class Mark(NamedTuple):
    """When an item came, seconds, and how many items, and bytes of items, had come before it."""

    arrival: float
    items: int
    bytes: int


class WaitingItem(NamedTuple, Generic[Item]):
    """
    An item of a `StampCache`.

    Attributes
    ----------
    arrival : float
        When it came, seconds.
    item : Item
        The item.
    mark : Mark
        When it came first, and what had come before it.
    """

    arrival: float
    item: Item
    mark: Mark


class Lateness(NamedTuple):
    """
    What a cache would have needed to keep an item that it has dropped.

    Attributes
    ----------
    age : float
        Time since the item came, seconds.
    items, bytes : int
        Number and bytes of the items that have come since, itself included.
    """

    age: float
    items: int
    bytes: int


class DropMemory:
    """Remembers the last 1000 items that were dropped, by stamp, and what would have kept them."""

    def __init__(self) -> None:
        self._items = self._bytes = 0
        self._dropped: OrderedDict[Stamp, Mark] = OrderedDict()

    def arrived(self, stamp: Stamp, size: int, now: float) -> Mark:
        """Note an item of some bytes; it may come again after it was dropped."""
        self._dropped.pop(stamp, None)
        mark = Mark(now, self._items, self._bytes)
        self._items += 1
        self._bytes += size
        return mark

    def dropped(self, stamp: Stamp, mark: Mark) -> None:
        """Note that an item was dropped."""
        self._dropped[stamp] = mark
        if len(self._dropped) > _MAX_GONE:
            self._dropped.popitem(last=False)

    def lateness(self, stamp: Stamp, now: float) -> Lateness | None:
        """Tell what would have kept the item of a stamp; None if none was dropped."""
        if (mark := self._dropped.get(stamp)) is None:
            return None
        return Lateness(now - mark.arrival, self._items - mark.items, self._bytes - mark.bytes)

    def clear(self) -> None:
        """Forget what was dropped."""
        self._dropped.clear()


class StampCache(Generic[Item]):
    """
    Items by stamp, in the order of arrival. Times are seconds of a monotonic clock.

    Parameters
    ----------
    on_dropped : callable
        Called with reason and item for each item that is dropped: by `put`, `expire` or `clear`.
    size_of : callable, optional
        Returns the bytes of an item, for a cache that is bounded by bytes.

    Examples
    --------
    >>> cache = StampCache[str](print, size_of=len)
    >>> cache.put((5, 0), 'first', now=0.0, max_count=2)
    >>> cache.put((6, 0), 'second', now=0.1, max_count=2)
    >>> cache.expire(now=2.05, max_age=2.0)
    Unpaired.EXPIRED first
    >>> list(cache)
    ['second']
    >>> cache.lateness((5, 0), now=3.5)
    Lateness(age=3.5, items=2, bytes=11)
    """

    def __init__(
        self,
        on_dropped: Callable[[Unpaired, Item], object],
        size_of: Callable[[Item], int] = lambda _: 0,
    ) -> None:
        self._on_dropped, self._size_of = on_dropped, size_of
        self._entries: OrderedDict[Stamp, WaitingItem[Item]] = OrderedDict()
        self._bytes = 0
        # What expired or was crowded out.
        self._memory = DropMemory()

    def __len__(self) -> int:
        """Count the items."""
        return len(self._entries)

    def __contains__(self, stamp: Stamp) -> bool:
        """Return whether there is an item of this stamp."""
        return stamp in self._entries

    def __getitem__(self, stamp: Stamp) -> Item:
        """Return the item of a stamp; KeyError if there is none."""
        return self._entries[stamp].item

    def __iter__(self) -> Iterator[Item]:
        """Iterate over the items, the oldest first."""
        return (entry.item for entry in self._entries.values())

    def items(self) -> list[tuple[Stamp, Item]]:
        """List stamps and items, the oldest first."""
        return [(stamp, entry.item) for stamp, entry in self._entries.items()]

    def stamps(self) -> Iterable[Stamp]:
        """Iterate over the stamps, the oldest item first."""
        return self._entries.keys()

    def put(
        self,
        stamp: Stamp,
        item: Item,
        now: float,
        max_count: int = 0,
        max_bytes: float = math.inf,
    ) -> None:
        """
        Add an item as the newest; drop one of the same stamp, and the oldest beyond the bounds.

        A `max_count` of 0 is no bound. The newest item stays, whatever its size.
        """
        replaced = self._remove(stamp)
        size = self._size_of(item)
        self._entries[stamp] = WaitingItem(now, item, self._memory.arrived(stamp, size, now))
        self._bytes += size
        if replaced is not None:
            self._on_dropped(Unpaired.DUPLICATE, replaced.item)

        def is_full(_: float) -> bool:
            too_many = 0 < max_count < len(self._entries)
            return too_many or (self._bytes > max_bytes and len(self._entries) > 1)

        self._drop_while(Unpaired.CROWDED_OUT, is_full)

    def renew(self, stamp: Stamp, now: float) -> None:
        """Let the item of a stamp, if there is one, wait from now on."""
        if stamp in self._entries:
            self._entries[stamp] = self._entries.pop(stamp)._replace(arrival=now)

    def pop(self, stamp: Stamp) -> Item | None:
        """Remove and return the item of a stamp."""
        entry = self._remove(stamp)
        return None if entry is None else entry.item

    def arrival(self, stamp: Stamp) -> float:
        """Return when the item of a stamp came, or was renewed."""
        return self._entries[stamp].arrival

    def lateness(self, stamp: Stamp, now: float) -> Lateness | None:
        """Tell what would have kept an item that expired or was crowded out; None if none did."""
        return self._memory.lateness(stamp, now)

    def forget_dropped(self) -> None:
        """Forget what was dropped: the same stamps come again."""
        self._memory.clear()

    def expire(self, now: float, max_age: float) -> None:
        """Drop the items that came more than `max_age` seconds ago."""
        self._drop_while(Unpaired.EXPIRED, lambda arrival: now - arrival > max_age)

    def clear(self) -> None:
        """Drop all items."""
        self._drop_while(Unpaired.CLEARED, lambda _: True)

    def _remove(self, stamp: Stamp) -> WaitingItem[Item] | None:
        """Remove and return an item with what is known of it."""
        entry = self._entries.pop(stamp, None)
        if entry is not None:
            self._bytes -= self._size_of(entry.item)
        return entry

    def _drop_while(self, reason: Unpaired, condition: Callable[[float], bool]) -> None:
        """Drop the oldest items while the arrival of the oldest meets a condition."""
        while self._entries:
            stamp, entry = next(iter(self._entries.items()))
            if not condition(entry.arrival):
                return
            # One by one: an error of the callback costs no other item.
            self._remove(stamp)
            if reason is not Unpaired.CLEARED:
                self._memory.dropped(stamp, entry.mark)
            self._on_dropped(reason, entry.item)


@dataclass(frozen=True)
class PairLimits(CheckedSettings):
    """How images and crop plans wait for each other; ValueError if a value is out of range."""

    max_bytes: float = setting(
        128.0 * 2**20,
        'Maximum bytes of the images that wait for their crop plan; the oldest is dropped first.',
        Range(1.0, MAX_BYTES),
    )
    images: int = setting(
        0, 'Maximum number of these images. 0: no limit but cache.max_bytes.', Range(0, 1000)
    )
    regions: int = setting(
        PLANS_KEPT,
        'Maximum crop plans that wait for their image; the oldest is dropped first.',
        Range(1, 100_000),
    )
    max_age: float = setting(
        5.0, 'How long images and crop plans wait for each other, seconds.', Range(0.0, 3600.0)
    )
    slop: float = setting(
        0.0,
        'Maximum difference between the stamps of an image and its crop plan, seconds.',
        Range(0.0, 3600.0),
    )

    def shortage(self, lateness: Lateness) -> str:
        """
        Say why an image had been dropped when its plan came, and which limits would have kept it.

        Examples
        --------
        >>> PairLimits(max_bytes=1e6).shortage(Lateness(age=3.5, items=105, bytes=32_256_000))
        'more than cache.max_bytes waited; 32256000 bytes are needed'
        """
        return shortage(
            lateness,
            ('cache.max_bytes', self.max_bytes),
            ('cache.images', self.images),
            ('cache.max_age', self.max_age),
        )


def shortage(
    lateness: Lateness,
    max_bytes: tuple[str, float],
    max_items: tuple[str, int],
    max_age: tuple[str, float],
) -> str:
    """
    Say which limits were too small to keep an image, and what they would have to be.

    Parameters
    ----------
    lateness : Lateness
        What would have kept it.
    max_bytes, max_items, max_age : tuple of str and number
        Name and value of the parameters; 0 items are no limit.
    """
    reasons = []
    if lateness.bytes > max_bytes[1]:
        reasons.append(f'more than {max_bytes[0]} waited; {lateness.bytes} bytes are needed')
    if 0 < max_items[1] < lateness.items:
        reasons.append(f'more than {max_items[0]} waited; {lateness.items} images are needed')
    if lateness.age > max_age[1] or not reasons:
        reasons.append(f'it waited longer than {max_age[0]}')
    return ', and '.join(reasons)


class JoinerSide(Generic[Item, Partner]):
    """
    One side of a joiner: items that are paired by stamp with those of another side.

    `add` pairs an item with the waiting one of the same stamp; `near_pairs` pairs what is left with
    the one of the nearest stamp. A zero stamp means no stamp and is never paired.

    Parameters
    ----------
    on_dropped : callable
        Called with reason and item for each item that is dropped without a partner.
    on_jump_back : callable
        Called with the latest and the new stamp if the new one is earlier: a bag that loops, or a
        clock that was set back.
    on_late : callable, optional
        Called with each item whose partner has expired or was crowded out, before it is dropped.
    size_of : callable, optional
        As in `StampCache`.

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
        on_late: Callable[[Item, Lateness], None] = lambda item, lateness: None,
        size_of: Callable[[Item], int] = lambda _: 0,
    ) -> None:
        self.waiting = StampCache[Item](on_dropped, size_of)
        # Stamps of items that were paired: a duplicate may still arrive.
        self._joined = StampCache[None](lambda reason, _: None)
        self._latest = ZERO_STAMP
        self._on_dropped, self._on_jump_back, self._on_late = on_dropped, on_jump_back, on_late
        self._other: JoinerSide[Partner, Item]

    def pair_with(self, other: JoinerSide[Partner, Item]) -> None:
        """Make this side and another one the two sides of a joiner."""
        self._other, other._other = other, self

    def add(
        self,
        stamp: Stamp,
        item: Item,
        now: float,
        max_count: int = 0,
        max_bytes: float = math.inf,
    ) -> Partner | None:
        """
        Add an item, and return its partner of the same stamp; without one the item waits.

        An item whose partner has expired or was crowded out is dropped.

        Parameters
        ----------
        stamp : tuple of int
            Seconds and nanoseconds.
        item : Item
            The item.
        now : float
            Seconds of a monotonic clock.
        max_count, max_bytes : int, float
            As in `StampCache.put`, for the items that wait on this side.
        """
        if stamp == ZERO_STAMP:
            self._on_dropped(Unpaired.ZERO_STAMP, item)
            return None
        if stamp < self._latest:
            self._on_jump_back(self._latest, stamp)
            # The same stamps come again and must be paired again.
            for side in (self, self._other):
                side._joined.clear()
                side.waiting.forget_dropped()
        self._latest = stamp
        if stamp in self._joined:
            self._on_dropped(Unpaired.DUPLICATE, item)
        elif stamp in self._other.waiting:
            self._remember(stamp, stamp, now)
            return self._other.waiting.pop(stamp)
        elif lateness := self._other.waiting.lateness(stamp, now):
            self._on_late(item, lateness)
            self._on_dropped(Unpaired.PARTNER_GONE, item)
        else:
            self.waiting.put(stamp, item, now, max_count, max_bytes)
        return None

    def near_pairs(self, now: float, slop: float, max_age: float) -> Iterator[tuple[Item, Partner]]:
        """
        Remove and yield pairs of this side and the other whose stamps differ by the slop or less.

        The nearest stamps go first, the earlier of two. A pair waits until neither item can have a
        partner of its own stamp any more: a later stamp of the other kind has come for both, or the
        later of the two has waited for `slop` seconds, or for `max_age`.

        Parameters
        ----------
        now : float
            Seconds of a monotonic clock.
        slop, max_age : float
            Seconds.
        """
        patience = min(slop, max_age)
        is_done = not slop
        while not is_done:
            is_done = True
            taken: set[tuple[bool, Stamp]] = set()
            for ours, theirs in self._near_stamps(slop):
                ends = {(False, ours), (True, theirs)}
                if taken.isdisjoint(ends) and self._is_settled(ours, theirs, now - patience):
                    yield self._take(ours, theirs, now)
                    is_done = False
                # A nearer pair that still waits keeps both.
                taken |= ends

    def _near_stamps(self, slop: float) -> list[tuple[Stamp, Stamp]]:
        """List neighbouring stamps of both sides within the slop, the nearest first."""
        if not self.waiting or not self._other.waiting:
            return []
        ours = [(nanoseconds_of(stamp), False, stamp) for stamp in self.waiting.stamps()]
        theirs = [(nanoseconds_of(stamp), True, stamp) for stamp in self._other.waiting.stamps()]
        near = [
            (second[0] - first[0], first, second)
            for first, second in pairwise(sorted(ours + theirs))
            if first[1] != second[1] and second[0] - first[0] <= round(slop * 1e9)
        ]
        return [
            (second[2], first[2]) if first[1] else (first[2], second[2])
            for _, first, second in sorted(near)
        ]

    def _is_settled(self, ours: Stamp, theirs: Stamp, patient_since: float) -> bool:
        """Return whether the pair need not wait any longer for items of equal stamps."""
        if self._latest > theirs and self._other._latest > ours:
            return True
        arrivals = self.waiting.arrival(ours), self._other.waiting.arrival(theirs)
        return max(arrivals) <= patient_since

    def _take(self, ours: Stamp, theirs: Stamp, now: float) -> tuple[Item, Partner]:
        """Remove and return a pair, and remember its stamps."""
        pair = self.waiting[ours], self._other.waiting[theirs]
        self.waiting.pop(ours)
        self._other.waiting.pop(theirs)
        self._remember(ours, theirs, now)
        return pair

    def _remember(self, ours: Stamp, theirs: Stamp, now: float) -> None:
        """Remember the stamps of a pair."""
        self._joined.put(ours, None, now, _MAX_JOINED)
        self._other._joined.put(theirs, None, now, _MAX_JOINED)

    def expire(self, now: float, max_age: float) -> None:
        """Drop the items that came more than `max_age` seconds ago."""
        self.waiting.expire(now, max_age)
        self._joined.expire(now, max_age)

    def clear(self) -> None:
        """Drop all items; the next stamp is not a jump back."""
        self._latest = ZERO_STAMP
        self.waiting.clear()
