# SPDX-License-Identifier: Apache-2.0
"""
From the spool to the outbox: what is released, when, and when it counts as delivered.

A chip is claimed in the catalogue, written to the outbox, and written down as released, each on
disk before the next begins. A release that was interrupted is looked up in the outbox.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from dataclasses import field
from math import inf

from obbhbb_ros.downlink.budget import LinkSettings
from obbhbb_ros.downlink.budget import TokenBucket
from obbhbb_ros.downlink.chips import CODECS
from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.outbox import Contents
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.spool.outbox import json_bytes
from obbhbb_ros.spool.outbox import level_of
from obbhbb_ros.spool.spool import CLAIMED
from obbhbb_ros.spool.spool import RELEASED
from obbhbb_ros.spool.spool import Spool
from obbhbb_ros.spool.spool import StoredChip
from obbhbb_ros.spool.spool import describe_intact

# Chips that are claimed at once.
_BATCH = 16
# Seconds: pause when there is nothing to do, after a failure, and between looks at the outbox.
IDLE, _RETRY, _LOOK = 0.1, 1.0, 1.0
# A look at the outbox may take this share of the time.
_LOOK_SHARE = 0.05


@dataclass(frozen=True)
class ReleaseSettings:
    """
    How chips are released.

    Attributes
    ----------
    budget : LinkSettings
        Rate, burst and overhead of the link.
    levels : tuple of float
        Value thresholds of the priority folders.
    removal : bool
        Whether a chip is delivered when the bus has removed it, or when it is in the outbox.
    max_bytes : float
        Maximum bytes in the outbox (0: unlimited).
    """

    budget: LinkSettings = field(default_factory=LinkSettings)
    levels: tuple[float, ...] = ()
    removal: bool = False
    max_bytes: float = 0.0


class Releaser:
    """
    Releases chips; whoever has it calls `step` again and again, always in the same thread.

    Parameters
    ----------
    spool : Spool
        Where chips wait, opened as `releaser`.
    outbox : Outbox
        Where they go.
    settings : ReleaseSettings
        How.
    on_trouble : callable
        Called with a text about everything that an operator should know.
    clock : callable
        Returns the time in seconds.

    Attributes
    ----------
    settings : ReleaseSettings
        May be replaced at any time, by another thread too; counts from the next chip on.
    contact : bool
        Whether chips may be released; likewise.
    stalled_by : str
        Why nothing was released in the last step; empty if something was.
    available : float
        Bytes that the link could carry at the last step.
    """

    def __init__(
        self,
        spool: Spool,
        outbox: Outbox,
        settings: ReleaseSettings,
        on_trouble: Callable[[str], object],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.settings = settings
        self.contact = False
        self.stalled_by = ''
        self.available = 0.0
        self._spool, self._outbox = spool, outbox
        self._on_trouble, self._clock = on_trouble, clock
        self._budget = settings.budget
        self._bucket = TokenBucket(settings.budget, clock())
        self._is_resumed = False
        # Ids of claimed chips: in the outbox, and not to be released now.
        self._put_out: list[str] = []
        self._put_back: list[str] = []
        self._contents = Contents()
        self._look_at = 0.0

    def step(self) -> float:
        """
        Release some chips, if there is contact.

        Returns
        -------
        float
            Seconds until the next step makes sense.
        """
        try:
            if not self._is_resumed:
                self._resume()
            self._record()
            self._look()
            return self._release()
        except OSError as error:
            self.stalled_by = str(error)
            self._on_trouble(self.stalled_by)
            return _RETRY

    def _resume(self) -> None:
        """Find out what became of the chips whose release was interrupted."""
        self._own_outbox()
        contents = self._outbox.contents()
        claimed = set(self._spool.ids(CLAIMED))
        # The bus may have taken some of those that were put out before the interruption.
        out = claimed & contents.complete.union(self._put_out)
        self._put_out, self._put_back = list(out), list(claimed - out)
        self._outbox.remove_unfinished(self._put_back)
        self._is_resumed = True

    def _own_outbox(self) -> None:
        """Refuse an outbox that is not the one into which chips have gone, as if unmounted."""
        known, folder = self._spool.outbox(), self._outbox.folder
        if known and not folder.exists():
            raise SpoolError(f'{folder} is missing; is it mounted? Make it if it is to be new')
        token = self._outbox.token()
        if known == token:
            return
        if known and (waiting := len(self._spool.ids(RELEASED))):
            raise SpoolError(
                f'{folder} is not the outbox into which {waiting} chips were released that have '
                'not been removed yet; is it mounted? If that one is lost: obbhbb spool PATH '
                'forget-outbox'
            )
        if known:
            self._on_trouble(f'{folder} is another outbox than before; is it mounted?')
        self._spool.set_outbox(token)

    def _record(self) -> None:
        """Write down what became of claimed chips."""
        if self._put_out and self.settings.removal:
            known, folder = self._spool.outbox(), self._outbox.folder
            if known and not (folder.exists() and known == self._outbox.token()):
                # Into whatever has taken its place; they are looked up when it is back.
                self._put_out, self._is_resumed = [], False
                raise SpoolError(f'{self._outbox.folder} was replaced; is it mounted?')
        self._spool.released(self._put_out, delivered=not self.settings.removal)
        self._put_out = []
        self._spool.unclaim(self._put_back)
        self._put_back = []

    def _look(self) -> None:
        """Look into the outbox now and then: for chips that the bus has removed, and for room."""
        settings, now = self.settings, self._clock()
        if now < self._look_at:
            return
        # Those whose removal is waited for, and go on being so when that is changed.
        released = self._spool.ids(RELEASED)
        if not (settings.removal or settings.max_bytes or released):
            return
        self._own_outbox()
        self._contents = self._outbox.contents()
        # It may have been unmounted while it was read.
        self._own_outbox()
        self._spool.delivered([each for each in released if each not in self._contents])
        done = self._clock()
        self._look_at = done + max(_LOOK, (done - now) / _LOOK_SHARE)

    def _release(self) -> float:
        """Claim chips and put them into the outbox as long as that is allowed."""
        budget = self._room_for_link()
        if not self.contact:
            self.stalled_by = 'no contact'
            return IDLE
        # The overhead is the link's: it takes no room in the outbox.
        room = self._room_in_outbox() + budget.overhead
        most = (self.settings.max_bytes or inf) + budget.overhead
        # Whatever interrupts this, the next step looks into the outbox.
        self._is_resumed = False
        claimed, missing = self._spool.claim(
            _BATCH, min(self.available, room), min(self._bucket.burst, most), budget.overhead
        )
        self._put_back = [chip.id for chip, _ in claimed]
        for chip, data in claimed:
            if not self._put(chip, data):
                break
        self._is_resumed = True
        if not claimed:
            return self._stall(missing, room, most)
        self.stalled_by = ''
        self._record()
        return 0.0

    def _put(self, chip: StoredChip, data: bytes) -> bool:
        """Put a claimed chip into the outbox; False if that is not allowed any more."""
        budget = self._room_for_link()
        description = describe_intact(chip, data)
        if description is None:
            self._spool.set_aside(chip.id)
            self._put_back.remove(chip.id)
            self._on_trouble(f'{chip.id} is damaged in the spool and was set aside')
            return True
        size = len(data) + len(json_bytes(description))
        cost = size + budget.overhead
        if not self.contact or cost > self.available or size > self._room_in_outbox():
            return False
        suffix = CODECS[description['codec']].suffix
        level = level_of(chip.value, self.settings.levels)
        self._bucket.spend(cost, self._clock())
        try:
            self._outbox.put(chip.id, suffix, data, description, level)
        except OSError:
            # What failed late may be in the outbox all the same.
            if not self._outbox.holds(chip.id, level):
                self._bucket.give_back(cost)
            raise
        self._contents.bytes += size
        self._put_back.remove(chip.id)
        self._put_out.append(chip.id)
        return True

    def _stall(self, missing: float, room: float, most: float) -> float:
        """Say why nothing is released; return how long to wait."""
        if not missing:
            self.stalled_by = 'nothing waits'
            return IDLE
        if missing == inf:
            limits = {'budget.burst': self._bucket.burst, 'outbox.max_bytes': most}
            least = min(limits, key=lambda name: limits[name])
            self._report_stall(f'all chips that wait are larger than {least}')
            # To find that out, all of them have to be looked at.
            return _RETRY
        if missing > room:
            self._report_stall(f'outbox is full, outbox.max_bytes is {self.settings.max_bytes:.0f}')
            return IDLE
        self.stalled_by = 'link budget'
        # Not longer: the budget may change.
        return min(IDLE, (missing - self.available) / self._budget.bytes_per_second)

    def _report_stall(self, text: str) -> None:
        """Say, once, what an operator has to change before anything is released."""
        if self.stalled_by != text:
            self._on_trouble(text)
        self.stalled_by = text

    def _room_for_link(self) -> LinkSettings:
        """Bring budget and available bytes up to date."""
        budget, now = self.settings.budget, self._clock()
        if budget != self._budget:
            self._bucket.change(budget, now)
            self._budget = budget
        self.available = self._bucket.available(now)
        return budget

    def _room_in_outbox(self) -> float:
        """Return how many bytes the outbox takes."""
        most = self.settings.max_bytes
        return most - self._contents.bytes if most else float('inf')
