# SPDX-License-Identifier: Apache-2.0
"""Pairs two kinds of items by stamp, in bounded memory and in any order of arrival."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

from obbhbb_ros.downlink.stamps import Stamp

_PAIRED_REMEMBERED = 1000


class Unpaired(str, Enum):
    """Why an item was discarded without a partner."""

    EXPIRED = 'expired'
    CROWDED_OUT = 'crowded_out'
    DUPLICATE = 'duplicate'
    ZERO_STAMP = 'zero_stamp'
    CLEARED = 'deactivated'


@dataclass(frozen=True)
class PairingLimits:
    """
    How many items may wait, and for how long.

    Attributes
    ----------
    capacity : tuple of int
        Maximum number of waiting items of kinds 0 and 1; the oldest is discarded first.
    max_age : float
        Seconds from the arrival of an item.
    slop : float
        Maximum difference between the stamps of a pair, seconds (0: stamps are equal).
    """

    capacity: tuple[int, int]
    max_age: float
    slop: float = 0.0


class Pairing:
    """
    A cache of two kinds of items, 0 and 1, that are paired by stamp.

    Parameters
    ----------
    on_unpaired : callable
        Called with kind, reason and item for each item that is discarded without a partner.
    on_jump_back : callable
        Called with kind, latest stamp and new stamp if the new one is earlier: a bag that loops,
        or a clock that was set back.

    Examples
    --------
    >>> pairing = Pairing(on_unpaired=print, on_jump_back=print)
    >>> limits = PairingLimits(capacity=(10, 10), max_age=1.0)
    >>> pairing.add(0, (5, 0), 'regions', now=0.0, limits=limits)
    >>> pairing.add(1, (5, 0), 'image', now=0.1, limits=limits)
    ('regions', 'image')
    """

    def __init__(
        self,
        on_unpaired: Callable[[int, Unpaired, Any], None],
        on_jump_back: Callable[[int, Stamp, Stamp], None],
    ) -> None:
        self._on_unpaired = on_unpaired
        self._on_jump_back = on_jump_back
        self._latest: list[Stamp] = [(0, 0), (0, 0)]
        self._waiting: tuple[OrderedDict[Stamp, tuple[float, Any]], ...] = (
            OrderedDict(),
            OrderedDict(),
        )
        self._paired: tuple[OrderedDict[Stamp, float], ...] = (OrderedDict(), OrderedDict())

    def waiting(self, kind: int) -> list[Any]:
        """List the items of a kind that wait for a partner, the oldest first."""
        return [item for _, item in self._waiting[kind].values()]

    def add(
        self, kind: int, stamp: Stamp, item: Any, now: float, limits: PairingLimits
    ) -> tuple[Any, Any] | None:
        """
        Add an item of kind 0 or 1 at `now`, seconds of a monotonic clock.

        Returns the items of kinds 0 and 1 if there is a partner: the waiting item of the same
        stamp, or else the one with the nearest stamp within the slop, the earlier of two. A zero
        stamp means no stamp and is never paired.
        """
        self.expire(now, limits)
        if stamp == (0, 0):
            self._on_unpaired(kind, Unpaired.ZERO_STAMP, item)
            return None
        if stamp < self._latest[kind]:
            self._on_jump_back(kind, self._latest[kind], stamp)
            # The same stamps come again and must be paired again.
            for paired in self._paired:
                paired.clear()
        self._latest[kind] = stamp
        mine, others = self._waiting[kind], self._waiting[1 - kind]
        if stamp in self._paired[kind]:
            self._on_unpaired(kind, Unpaired.DUPLICATE, item)
            return None
        partner = _nearest(stamp, others, limits.slop)
        if partner is not None:
            _, other = others.pop(partner)
            self._remember(kind, stamp, now)
            self._remember(1 - kind, partner, now)
            return (item, other) if kind == 0 else (other, item)
        if stamp in mine:
            self._on_unpaired(kind, Unpaired.DUPLICATE, mine.pop(stamp)[1])
        mine[stamp] = now, item
        while len(mine) > limits.capacity[kind]:
            self._discard_oldest(kind, Unpaired.CROWDED_OUT)
        return None

    def expire(self, now: float, limits: PairingLimits) -> None:
        """Discard items that have waited too long."""
        for kind, waiting in enumerate(self._waiting):
            while waiting and now - next(iter(waiting.values()))[0] > limits.max_age:
                self._discard_oldest(kind, Unpaired.EXPIRED)
        for paired in self._paired:
            while paired and now - next(iter(paired.values())) > limits.max_age:
                paired.popitem(last=False)

    def clear(self) -> None:
        """Discard all items; the next stamp of either kind is not a jump back."""
        self._latest = [(0, 0), (0, 0)]
        for kind, waiting in enumerate(self._waiting):
            while waiting:
                self._discard_oldest(kind, Unpaired.CLEARED)

    def _remember(self, kind: int, stamp: Stamp, now: float) -> None:
        """Remember that a stamp was paired: a duplicate of its item may still arrive."""
        paired = self._paired[kind]
        paired[stamp] = now
        if len(paired) > _PAIRED_REMEMBERED:
            paired.popitem(last=False)

    def _discard_oldest(self, kind: int, reason: Unpaired) -> None:
        """Discard the oldest item of a kind."""
        _, (_, item) = self._waiting[kind].popitem(last=False)
        self._on_unpaired(kind, reason, item)


def _nearest(stamp: Stamp, waiting: Mapping[Stamp, Any], slop: float) -> Stamp | None:
    """Find the waiting stamp that is nearest to a stamp, at most `slop` seconds away."""
    if stamp in waiting:
        return stamp
    if not slop or not waiting:
        return None
    distance = {other: abs(_nanoseconds(other) - _nanoseconds(stamp)) for other in waiting}
    nearest = min(waiting, key=lambda other: (distance[other], other))
    return nearest if distance[nearest] <= round(slop * 1e9) else None


def _nanoseconds(stamp: Stamp) -> int:
    """Return a stamp as a number."""
    return stamp[0] * 1_000_000_000 + stamp[1]
