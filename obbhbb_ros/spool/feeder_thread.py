# SPDX-License-Identifier: Apache-2.0
"""The thread that releases chips, so that a slow disk delays nothing else."""

from __future__ import annotations

import threading
import time
from collections import deque
from pathlib import Path

from obbhbb_ros.spool.feeder import OutboxFeeder
from obbhbb_ros.spool.feeder import ReleaseSettings
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.spool.releaser import SpoolReleaser

# Seconds that the thread has for its last step; a disk that does not answer keeps it longer.
_LAST_STEP = 2.0


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
