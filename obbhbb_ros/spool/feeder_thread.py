# SPDX-License-Identifier: Apache-2.0
"""A thread that feeds the outbox, so that a slow disk stalls nothing else."""

from __future__ import annotations

import threading
from collections import deque
from pathlib import Path

from obbhbb_ros.spool.feeder import OutboxFeeder
from obbhbb_ros.spool.feeder import ReleaseSettings
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.spool.releaser import SpoolReleaser

# Seconds to wait for the last step; a disk that does not answer keeps it longer.
_LAST_STEP = 2.0
# Texts to keep between two reports.
_MAX_TROUBLES = 100


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
        self._troubles: deque[str] = deque(maxlen=_MAX_TROUBLES)
        self._settings = settings
        self.feeder = OutboxFeeder(
            SpoolReleaser(spool, self._troubles.append),
            Outbox(outbox),
            settings,
            self._troubles.append,
        )
        self._wake, self._is_stopping = threading.Event(), False
        # The process does not wait for it to end: every step may be interrupted.
        self._thread = threading.Thread(target=self._work, name='release', daemon=True)
        self._thread.start()

    def steer(self, settings: ReleaseSettings, is_contact: bool) -> None:
        """Set how chips are released, and whether they may be; takes effect at once."""
        self._settings = settings
        self.feeder.steer(settings, is_contact)
        self._wake.set()

    def take_troubles(self) -> list[str]:
        """Return what an operator should know since the last call."""
        troubles = []
        while self._troubles:
            troubles.append(self._troubles.popleft())
        return troubles

    def stop(self) -> None:
        """End the thread after its step, without waiting for a disk that does not answer."""
        self._is_stopping = True
        self.steer(self._settings, is_contact=False)
        self._thread.join(_LAST_STEP)

    def _work(self) -> None:
        """Release chips until told to stop."""
        while not self._is_stopping:
            self._wake.wait(self.feeder.step())
            self._wake.clear()
        self.feeder.close()
