# SPDX-License-Identifier: Apache-2.0
"""Pairs what belongs to the same stamp, in bounded memory, whichever comes first."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any
from typing import TypeAlias

Stamp: TypeAlias = tuple[int, int]
"""Seconds and nanoseconds."""

_PAIRED_REMEMBERED = 1000


class Unpaired(str, Enum):
    """Why an item was let go without its partner."""

    EXPIRED = 'expired'
    CROWDED_OUT = 'crowded_out'
    DUPLICATE = 'duplicate'
    ZERO_STAMP = 'zero_stamp'
    CLEARED = 'deactivated'


@dataclass(frozen=True)
class PairingLimits:
    """
    How much may wait, and for how long.

    Attributes
    ----------
    capacity : tuple of int
        Items of the one kind and of the other; the oldest goes when there are more.
    max_age : float
        Seconds from the arrival of an item.
    """

    capacity: tuple[int, int]
    max_age: float


class Pairing:
    """
    A cache of two kinds of items, 0 and 1, that belong together by exact stamp.

    Parameters
    ----------
    let_go : callable
        Called with kind, reason and item for every item that finds no partner.
    ran_back : callable
        Called with kind, latest stamp and new stamp where the new one is the earlier: a bag that
        loops, a clock that was set back.
    """

    def __init__(
        self,
        let_go: Callable[[int, Unpaired, Any], None],
        ran_back: Callable[[int, Stamp, Stamp], None],
    ) -> None:
        self._let_go = let_go
        self._ran_back = ran_back
        self._latest: list[Stamp] = [(0, 0), (0, 0)]
        self._waiting: tuple[OrderedDict[Stamp, tuple[float, Any]], ...] = (
            OrderedDict(), OrderedDict()
        )
        self._paired: OrderedDict[Stamp, float] = OrderedDict()

    def waiting(self, kind: int) -> list[Any]:
        """List the items of a kind that wait for a partner, the oldest first."""
        return [item for _, item in self._waiting[kind].values()]

    def add(
        self, kind: int, stamp: Stamp, item: Any, now: float, limits: PairingLimits
    ) -> tuple[Any, Any] | None:
        """
        Take an item in.

        Parameters
        ----------
        kind : int
            0 or 1.
        stamp : tuple of int
            Seconds and nanoseconds. Zero is no stamp and pairs with nothing.
        item : object
            The item.
        now : float
            Seconds, of a clock that never goes back.
        limits : PairingLimits
            How much may wait, and for how long.

        Returns
        -------
        tuple of object, or None
            The items of kind 0 and 1 with this stamp, if this was the second of them.
        """
        self.expire(now, limits)
        if stamp == (0, 0):
            self._let_go(kind, Unpaired.ZERO_STAMP, item)
            return None
        if stamp < self._latest[kind]:
            self._ran_back(kind, self._latest[kind], stamp)
            # What comes now has been there before, and is to be paired again.
            self._paired.clear()
        self._latest[kind] = stamp
        mine, others = self._waiting[kind], self._waiting[1 - kind]
        if stamp in self._paired:
            self._let_go(kind, Unpaired.DUPLICATE, item)
            return None
        if stamp in others:
            _, other = others.pop(stamp)
            self._remember(stamp, now)
            return (item, other) if kind == 0 else (other, item)
        if stamp in mine:
            self._let_go(kind, Unpaired.DUPLICATE, mine.pop(stamp)[1])
        mine[stamp] = now, item
        while len(mine) > limits.capacity[kind]:
            self._let_first_go(kind, Unpaired.CROWDED_OUT)
        return None

    def expire(self, now: float, limits: PairingLimits) -> None:
        """Let go what has waited too long."""
        for kind, waiting in enumerate(self._waiting):
            while waiting and now - next(iter(waiting.values()))[0] > limits.max_age:
                self._let_first_go(kind, Unpaired.EXPIRED)
        while self._paired and now - next(iter(self._paired.values())) > limits.max_age:
            self._paired.popitem(last=False)

    def clear(self) -> None:
        """Let everything go, and take whatever stamps come next for new."""
        self._latest = [(0, 0), (0, 0)]
        for kind, waiting in enumerate(self._waiting):
            while waiting:
                self._let_first_go(kind, Unpaired.CLEARED)

    def _let_first_go(self, kind: int, reason: Unpaired) -> None:
        """Let the oldest of a kind go."""
        _, (_, item) = self._waiting[kind].popitem(last=False)
        self._let_go(kind, reason, item)

    def _remember(self, stamp: Stamp, now: float) -> None:
        """Know a stamp that had its pair, as long as another item of it may be on its way."""
        self._paired[stamp] = now
        if len(self._paired) > _PAIRED_REMEMBERED:
            self._paired.popitem(last=False)
