# SPDX-License-Identifier: Apache-2.0
"""
Ship lists from their catalogue to the outbox, before any chip.

A list is claimed, put into the outbox, and recorded as released, as chips are. One that an
interruption left claimed goes again under the same name, unless it is in the outbox: the bus may
have taken it, and takes the same twice then.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from math import inf
from typing import NamedTuple
from typing import TypeVar

from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.list_rows import ShipListFile
from obbhbb_ros.spool.list_rows import names_list
from obbhbb_ros.spool.list_spool import ListSpool
from obbhbb_ros.spool.outbox import Contents

_Answer = TypeVar('_Answer')

# Seconds to wait after a failure.
_RETRY = 1.0


class ListFeeder:
    """
    Releases ship lists; trouble with them is reported and does not keep the chips waiting.

    Parameters
    ----------
    lists : ListSpool
        Where lists wait.
    on_trouble : callable
        Called with a text about everything that an operator should know.
    clock : callable
        Returns the time in seconds.

    Attributes
    ----------
    released : int
        How many lists were put into the outbox. Read only.
    """

    def __init__(
        self,
        lists: ListSpool,
        on_trouble: Callable[[str], object],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.released = 0
        self._lists, self._on_trouble, self._clock = lists, on_trouble, clock
        self._retry_at = -inf
        self._unrecorded: _Release | None = None

    def recover(self, contents: Contents, outbox: str, is_delivered: bool) -> set[str]:
        """
        Find out after an interruption whether the claimed list is in the outbox.

        Parameters
        ----------
        contents : Contents
            What is in the outbox.
        outbox : str
            Its token.
        is_delivered : bool
            Whether being there delivers a list.

        Returns
        -------
        set of str
            Lists of which only a part is there.
        """
        claimed = self._guarded(self._lists.claimed_id)
        if claimed and claimed in contents.complete:
            self.record(claimed, outbox, is_delivered)
        return set(filter(names_list, contents.ids - contents.complete))

    def record(self, list_id: str, outbox: str, is_delivered: bool) -> None:
        """Write down that the claimed list is in an outbox, now or as soon as that is possible."""
        self._unrecorded = _Release(list_id, outbox, is_delivered)
        self._settle()

    def has_released(self) -> bool:
        """Return whether lists are in an outbox."""
        return bool(self._guarded(self._lists.in_outbox))

    def look(self, contents: Contents, outbox: str) -> None:
        """Count lists that the bus has taken as delivered, those in another outbox as lost."""
        released = self._guarded(self._lists.in_outbox) or {}
        here = {list_id for list_id, token in released.items() if token == outbox}
        taken, lost = here - contents.ids, released.keys() - here
        self._guarded(lambda: self._lists.gone(taken, is_delivered=True))
        self._guarded(lambda: self._lists.gone(lost, is_delivered=False))

    def needed(self, max_size: float) -> int:
        """Return what the next list costs at most, file and JSON, bytes; 0 if none waits."""
        self._settle()
        if self._unrecorded is not None:
            # It would be claimed again.
            return 0
        return self._guarded(lambda: self._lists.needed(max_size)) or 0

    def claim(self, max_size: float) -> ShipListFile | None:
        """Claim the next list; None if it cannot be had now, or is larger than `max_size` bytes."""
        claimed = self._guarded(lambda: self._lists.claim(max_size))
        if claimed is not None and claimed.size <= max_size:
            return claimed
        if self._clock() >= self._retry_at:
            self._retry_at = self._clock() + _RETRY
            self._on_trouble(
                f'a ship list waits, but not one of its ships fits into {max_size:.0f} bytes: see '
                'budget.burst and outbox.max_bytes'
            )
        return None

    def close(self) -> None:
        """Close the catalogue."""
        self._lists.close()

    def _settle(self) -> None:
        """Write down what could not be written down before."""
        if (release := self._unrecorded) is None:
            return

        def write() -> bool:
            self._lists.released(*release)
            return True

        if self._guarded(write):
            self._unrecorded = None
            self.released += 1

    def _guarded(self, call: Callable[[], _Answer]) -> _Answer | None:
        """Call something; None after a failure, or while there are no lists."""
        if self._clock() < self._retry_at or not self._lists.exists:
            return None
        try:
            return call()
        except SpoolError as error:
            self._on_trouble(str(error))
            self._retry_at = self._clock() + _RETRY
            return None


class _Release(NamedTuple):
    """A list that was put into an outbox."""

    list_id: str
    outbox: str
    is_delivered: bool
