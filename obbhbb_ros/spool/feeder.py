# SPDX-License-Identifier: Apache-2.0
"""
From the spool to the outbox: what is released, when, and when it counts as delivered.

A chip is claimed in the catalogue, written to the outbox, and recorded as released, each on disk
before the next begins. After any interruption the outbox tells which claimed chips got there. The
bus may have taken the others, so they stay claimed, which saves them from eviction, and go first.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from dataclasses import field
from enum import Enum
from math import inf
from pathlib import Path
from typing import Any
from typing import NamedTuple

from obbhbb_ros.downlink.budget import LinkSettings
from obbhbb_ros.downlink.budget import TokenBucket
from obbhbb_ros.downlink.chips import CODECS
from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.chip_rows import StoredChip
from obbhbb_ros.spool.chip_rows import describe_intact
from obbhbb_ros.spool.compact_json import CAMERA_KIND
from obbhbb_ros.spool.compact_json import CameraFile
from obbhbb_ros.spool.compact_json import compact_bytes
from obbhbb_ros.spool.compact_json import names_camera
from obbhbb_ros.spool.compact_json import shortened
from obbhbb_ros.spool.compact_json import without_camera
from obbhbb_ros.spool.list_feeder import ListFeeder
from obbhbb_ros.spool.list_spool import ListSpool
from obbhbb_ros.spool.outbox import Contents
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.spool.outbox import json_bytes
from obbhbb_ros.spool.outbox import level_of
from obbhbb_ros.spool.releaser import Claim
from obbhbb_ros.spool.releaser import SpoolReleaser
from obbhbb_ros.spool.releaser import Stall

# Chips to claim at once.
_BATCH = 16
# Seconds to wait: with nothing to do, after a failure, and between two looks into the outbox.
_IDLE, _RETRY, _LOOK = 0.1, 1.0, 1.0
# Looking into the outbox may take this share of the time.
_LOOK_SHARE = 0.05
# Cameras to remember: one that zooms is a different camera in every image.
_MAX_CAMERAS = 1000
# Seconds that a thread has for its last step; a disk that does not answer keeps it longer.
_LAST_STEP = 2.0


@dataclass(frozen=True)
class ReleaseSettings:
    """
    How chips are released.

    Attributes
    ----------
    budget : LinkSettings
        Rate, burst and overhead of the link.
    levels : tuple of float
        Thresholds of rank of the priority folders.
    removal : bool
        Whether a chip counts as delivered when the bus has removed it from the outbox; if not,
        when it is in the outbox.
    max_bytes : float
        Maximum bytes in the outbox (0: unlimited).
    is_compact : bool
        Whether the JSON of chips is short, and their cameras have files of their own.
    """

    budget: LinkSettings = field(default_factory=LinkSettings)
    levels: tuple[float, ...] = ()
    removal: bool = False
    max_bytes: float = 0.0
    is_compact: bool = False


class Phase(Enum):
    """What a feeder does next: find out what an interruption left behind, or release chips."""

    RECOVER = 'recover'
    RUN = 'run'


class ReleaseBatch(NamedTuple):
    """Ids of claimed chips: those put into the outbox, and those that never were."""

    put: set[str]
    left: set[str]


class OutboxFeeder:
    """
    Moves chips from a spool to an outbox, by their rank, within the budget.

    One thread calls `step` again and again; any other may call `steer`.

    Parameters
    ----------
    spool : SpoolReleaser
        Where chips wait.
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
    stalled_by : str
        Why nothing was released in the last step; empty if something was. Read only.
    available : float
        Bytes that the link could carry at the last step. Read only.
    signs : int
        Grows with each step and each chip: no disk keeps it waiting. Read only.
    cameras : int
        How many files of cameras were put into the outbox. Read only.
    """

    def __init__(
        self,
        spool: SpoolReleaser,
        outbox: Outbox,
        settings: ReleaseSettings,
        on_trouble: Callable[[str], object],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.stalled_by, self.available, self.signs, self.cameras = '', 0.0, 0, 0
        self._spool, self._outbox = spool, outbox
        self._lists = ListFeeder(ListSpool(spool.folder, on_trouble), on_trouble, clock)
        self._on_trouble, self._clock = on_trouble, clock
        # One attribute, so that another thread sets both at once.
        self._orders = (settings, False)
        self._bucket = TokenBucket(settings.budget, clock())
        self._phase = Phase.RECOVER
        self._batch = ReleaseBatch(set(), set())
        # Claimed chips that may have been in the outbox: the bus may have taken them.
        self._unsure: set[str] = set()
        # Cameras that are in the outbox, or were.
        self._known_cameras: set[str] = set()
        # Level and cost of the chips that are not complete in the outbox yet.
        self._added: dict[str, tuple[int, int]] = {}
        self._contents = Contents()
        self._look_at = 0.0

    @property
    def settings(self) -> ReleaseSettings:
        """How chips are released."""
        return self._orders[0]

    @property
    def is_contact(self) -> bool:
        """Whether chips may be released."""
        return self._orders[1]

    def steer(self, settings: ReleaseSettings, is_contact: bool) -> None:
        """
        Set how chips are released, and whether they may be; takes effect with the next chip.

        Any thread may call it at any time.
        """
        self._orders = (settings, is_contact)

    def step(self) -> float:
        """
        Release some chips, if there is contact.

        Returns
        -------
        float
            Seconds until the next step makes sense.
        """
        # Unless this step ends well, the next one recovers.
        phase, self._phase = self._phase, Phase.RECOVER
        self.signs += 1
        try:
            if phase is Phase.RECOVER:
                self._recover()
            self._record()
            self._look()
            pause = self._release()
        # An error must not end the thread: nothing would start it again.
        except Exception as error:
            name = '' if isinstance(error, OSError) else f'{type(error).__name__}: '
            self.stalled_by = f'{name}{error}'
            self._on_trouble(self.stalled_by)
            return _RETRY
        self._phase = Phase.RUN
        return pause

    def close(self) -> None:
        """Close spool and outbox."""
        self._spool.close()
        self._lists.close()
        self._outbox.close()

    def _recover(self) -> None:
        """Find out which claimed chips have reached the outbox."""
        self._check_outbox()
        contents = self._outbox.contents()
        claimed = self._spool.ids(ChipState.CLAIMED)
        # The bus may have taken some that were put there before the interruption.
        put = claimed & contents.complete.union(self._batch.put)
        missing = claimed - put
        self._batch = ReleaseBatch(put, missing & self._batch.left)
        self._unsure = missing - self._batch.left
        # A camera is put there again with the next chip that names it.
        self._known_cameras.clear()
        cameras = set(filter(names_camera, contents.ids - contents.complete))
        is_delivered = not self.settings.removal
        lists = self._lists.recover(contents, self._spool.outbox(), is_delivered)
        self._outbox.remove_unfinished(missing | cameras | lists)

    def _check_outbox(self) -> None:
        """Refuse an outbox that is not the one that chips have gone into; it may be unmounted."""
        expected, folder = self._spool.outbox(), self._outbox.folder
        if expected and not folder.exists():
            raise SpoolError(
                f'{folder} is missing; is it mounted? For a new outbox, create this folder'
            )
        token = self._outbox.token()
        self._outbox.lock()
        if token == expected:
            return
        if expected and (waiting := len(self._spool.ids(ChipState.RELEASED))):
            raise SpoolError(
                f'{folder} is not the outbox that has {waiting} released chips which the bus has '
                'not removed; is it mounted? If that outbox is lost for good: obbhbb spool PATH '
                'forget-outbox'
            )
        if expected:
            self._on_trouble(f'{folder} is not the same outbox as before; is it mounted?')
        self._spool.set_outbox(token)

    def _record(self) -> None:
        """Write down what became of the chips of a batch."""
        (put, left), removal = self._batch, self.settings.removal
        if put and removal and self._is_replaced():
            # They are in another folder; the next step reads the outbox when it is back.
            put.clear()
            raise SpoolError(f'{self._outbox.folder} was replaced; is it mounted?')
        self._spool.released(put, is_delivered=not removal)
        put.clear()
        self._spool.unclaim(left)
        left.clear()

    def _is_replaced(self) -> bool:
        """Return whether another folder, or none, is in the place of the outbox."""
        token = self._spool.outbox()
        return bool(token) and not (self._outbox.folder.exists() and token == self._outbox.token())

    def _look(self) -> None:
        """Look into the outbox now and then: for chips that are gone, and for room."""
        settings, now = self.settings, self._clock()
        if now < self._look_at:
            return
        # Chips that wait for their removal still do after a change of settings.
        released = self._spool.ids(ChipState.RELEASED)
        if not (settings.removal or settings.max_bytes or released or self._lists.has_released()):
            return
        self._check_outbox()
        self._contents = self._outbox.contents()
        # It may have been unmounted while it was read.
        self._check_outbox()
        self._spool.delivered(released - self._contents.ids)
        self._lists.look(self._contents, self._spool.outbox())
        done = self._clock()
        self._look_at = done + max(_LOOK, (done - now) / _LOOK_SHARE)

    def _release(self) -> float:
        """Claim chips and put them into the outbox as long as that is allowed."""
        settings = self._refresh()
        if not self.is_contact:
            self.stalled_by = 'no contact'
            if not settings.removal:
                # Nothing says whether the ground has them: they come down once in each contact.
                self._known_cameras.clear()
            return _IDLE
        overhead = settings.budget.overhead
        # The overhead is the link's: it takes no room in the outbox.
        room = self._room_in_outbox(settings) + overhead
        max_cost = min(self._bucket.burst, (settings.max_bytes or inf) + overhead)
        pause = self._release_list(settings, room, max_cost)
        if pause is not None:
            return pause
        claim = self._spool.claim(
            _BATCH,
            min(self.available, room),
            max_cost,
            overhead,
            is_resumed=bool(self._unsure),
            is_compact=settings.is_compact,
        )
        if not claim.chips:
            return self._stall(claim, settings, room)
        self._batch = ReleaseBatch(set(), {chip.id for chip, _ in claim.chips} - self._unsure)
        try:
            for chip, data in claim.chips:
                if not self._put(chip, data, claim.fade):
                    break
        finally:
            self._finish()
        self.stalled_by = ''
        self._record()
        return 0.0

    def _release_list(
        self, settings: ReleaseSettings, room: float, max_cost: float
    ) -> float | None:
        """Put the next ship list into the outbox; None if none waits, else seconds to wait."""
        overhead, removal = settings.budget.overhead, settings.removal
        needed = self._lists.needed(max_cost - overhead)
        if not needed:
            return None
        if needed + overhead > min(self.available, room):
            return self._stall(Claim([], 0.0, Stall.NO_ROOM, needed + overhead), settings, room)
        file = self._lists.claim(max_cost - overhead)
        if file is None:
            return None
        self.signs += 1
        if self._add(file.id, file.suffix, file.content, file.json_bytes(), 0, settings):
            self._finish()
            self._batch.put.discard(file.id)
            if removal and self._is_replaced():
                raise SpoolError(f'{self._outbox.folder} was replaced; is it mounted?')
            self._lists.record(file.id, self._spool.outbox(), is_delivered=not removal)
            self.stalled_by = ''
        return 0.0

    def _put(self, chip: StoredChip, data: bytes, fade: float) -> bool:
        """Add a claimed chip to the outbox; False if that is not allowed any more."""
        self.signs += 1
        settings = self._refresh()
        description = describe_intact(chip, data, fade)
        if description is None:
            self._spool.evict_damaged(chip)
            self._batch.left.discard(chip.id)
            self._unsure.discard(chip.id)
            self._on_trouble(f'{chip.id} is damaged in the spool and was evicted')
            return True
        described, camera = _written(description, settings.is_compact)
        if camera is not None and not self._put_camera(camera, settings):
            return False
        suffix = CODECS[description['codec']].suffix
        level = level_of(chip.rank(fade), settings.levels)
        if not self._add(chip.id, suffix, data, described, level, settings):
            return False
        self._batch.left.discard(chip.id)
        return True

    def _put_camera(self, camera: CameraFile, settings: ReleaseSettings) -> bool:
        """
        Complete the file of a camera in the outbox, if need be; False if that is not allowed.

        No camera costs more than what its chip was claimed for, so that it has room.
        """
        if camera.id in self._known_cameras:
            return True
        if not self._outbox.holds(camera.id, 0):
            described = camera.json_bytes()
            if not self._add(camera.id, CAMERA_KIND, camera.content, described, 0, settings):
                return False
            # On disk before any JSON that names it.
            self._finish()
            self._batch.put.discard(camera.id)
            self.cameras += 1
        if len(self._known_cameras) >= _MAX_CAMERAS:
            self._known_cameras.clear()
        self._known_cameras.add(camera.id)
        return True

    def _add(
        self,
        file_id: str,
        suffix: str,
        data: bytes,
        described: bytes,
        level: int,
        settings: ReleaseSettings,
    ) -> bool:
        """Add a pair of files to the outbox; False if that is not allowed any more."""
        size = len(data) + len(described)
        cost = size + settings.budget.overhead
        available = self._bucket.available(self._clock())
        if not self.is_contact or cost > available or size > self._room_in_outbox(settings):
            return False
        self._bucket.spend(cost, self._clock())
        try:
            self._outbox.add(file_id, suffix, data, described, level)
        except OSError:
            # The bus has it if it was put there before.
            if not self._outbox.holds(file_id, level):
                self._bucket.give_back(cost)
            raise
        self._contents.bytes += size
        self._added[file_id] = level, cost
        return True

    def _finish(self) -> None:
        """Complete the chips that were added to the outbox."""
        added, self._added = self._added, {}
        try:
            self._outbox.finish()
        except OSError:
            # A late failure may leave a chip in the outbox all the same.
            for chip_id, (level, cost) in added.items():
                if not self._outbox.holds(chip_id, level):
                    self._bucket.give_back(cost)
            raise
        self._unsure.difference_update(added)
        self._batch.put.update(added)

    def _stall(self, claim: Claim, settings: ReleaseSettings, room: float) -> float:
        """Say why nothing is released; return how long to wait."""
        if claim.stall is Stall.NOTHING_WAITS:
            self.stalled_by = Stall.NOTHING_WAITS.value
            return _IDLE
        if claim.stall is Stall.ALL_TOO_LARGE:
            max_size = self._bucket.burst - settings.budget.overhead
            limit = (
                'budget.burst' if max_size <= (settings.max_bytes or inf) else 'outbox.max_bytes'
            )
            self._report_stall(f'all chips that wait are larger than {limit}')
            # To find that out, all of them have to be read.
            return _RETRY
        if claim.missing > room:
            self._report_stall(f'outbox is full, outbox.max_bytes is {settings.max_bytes:.0f}')
            return _IDLE
        self.stalled_by = 'link budget'
        # Not longer: the budget may change.
        return min(_IDLE, (claim.missing - self.available) / settings.budget.bytes_per_second)

    def _report_stall(self, text: str) -> None:
        """Report, once, what an operator has to change before anything is released."""
        if self.stalled_by != text:
            self._on_trouble(text)
        self.stalled_by = text

    def _refresh(self) -> ReleaseSettings:
        """Bring budget and available bytes up to date; return the settings in force."""
        settings, now = self.settings, self._clock()
        self._bucket.change(settings.budget, now)
        self.available = self._bucket.available(now)
        return settings

    def _room_in_outbox(self, settings: ReleaseSettings) -> float:
        """Return how many more bytes the outbox takes."""
        return settings.max_bytes - self._contents.bytes if settings.max_bytes else inf


def _written(description: dict[str, Any], is_compact: bool) -> tuple[bytes, CameraFile | None]:
    """Write the JSON of a chip; also return the camera that it names instead of holding it."""
    if not is_compact:
        return json_bytes(description), None
    short, camera = without_camera(shortened(description))
    return compact_bytes(short), camera


class FeederThread:
    """
    Releases chips in a thread of its own, which starts at once and without contact.

    Parameters
    ----------
    spool : Path
        Folder of the spool.
    outbox : Path
        Folder of the outbox.
    settings : ReleaseSettings
        How chips are released.

    Attributes
    ----------
    feeder : OutboxFeeder
        What it does, to be read only.
    """

    def __init__(self, spool: Path, outbox: Path, settings: ReleaseSettings) -> None:
        # The last ones, if they are not taken.
        self._troubles: deque[str] = deque(maxlen=100)
        self.feeder = OutboxFeeder(
            SpoolReleaser(spool, self._troubles.append),
            Outbox(outbox),
            settings,
            self._troubles.append,
        )
        self._seen = 0, time.monotonic()
        self._wake, self._is_stopping = threading.Event(), False
        # The process does not wait for it to end: every step may be interrupted.
        self._thread = threading.Thread(target=self._work, name='release', daemon=True)
        self._thread.start()

    def steer(self, settings: ReleaseSettings, is_contact: bool) -> None:
        """Set how chips are released, and whether they may be; takes effect at once."""
        self.feeder.steer(settings, is_contact)
        self._wake.set()

    def silence(self) -> float:
        """Return for how many seconds no call of this method has met a new sign of the thread."""
        signs, now = self.feeder.signs, time.monotonic()
        if signs != self._seen[0]:
            self._seen = signs, now
        return now - self._seen[1]

    def take_troubles(self) -> list[str]:
        """Return what an operator should know since the last call."""
        return [self._troubles.popleft() for _ in range(len(self._troubles))]

    def stop(self) -> None:
        """End the thread after its step, without waiting for a disk that does not answer."""
        self._is_stopping = True
        self.steer(self.feeder.settings, is_contact=False)
        self._thread.join(_LAST_STEP)

    def _work(self) -> None:
        """Release chips until told to stop."""
        while not self._is_stopping:
            self._wake.wait(self.feeder.step())
            self._wake.clear()
        self.feeder.close()
