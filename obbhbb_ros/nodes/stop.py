# SPDX-License-Identifier: Apache-2.0
"""SIGINT and SIGTERM, from the first line of a node's process to its last."""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """
    Takes both signals for the rest of the process: the first asks it to end, the others do nothing.

    They are blocked in every thread and waited for in one of ours, so that none interrupts
    anything, wherever it is: a terminal's Ctrl-C reaches a launched node twice within 50 ms.
    Nothing else of the package is imported here, so that this can be the first thing to happen.

    Attributes
    ----------
    patience : float
        How long the process may take to end after the first signal, seconds. As long as nothing
        has begun it leaves at once.
    """

    def __init__(self) -> None:
        self.patience = 0.0
        self._wake: Callable[[], None] | None = None
        self._requested = threading.Event()
        self._lock = threading.Lock()
        signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        threading.Thread(target=self._listen, name='signals', daemon=True).start()

    @property
    def requested(self) -> bool:
        """Whether the process was asked to end."""
        return self._requested.is_set()

    def wake_by(self, wake: Callable[[], None] | None) -> None:
        """Call `wake`, from another thread, when a signal comes; nothing from now on for None."""
        with self._lock:
            self._wake = wake

    def _listen(self) -> None:
        """Wait for the first signal, ask the process to end, and make sure that it does."""
        signal.sigwait(SIGNALS)
        asked = time.monotonic()
        self._requested.set()
        with self._lock:
            if self._wake is not None:
                self._wake()
        # It may have begun meanwhile, and get more time.
        while (left := asked + self.patience - time.monotonic()) > 0.0:
            signal.sigtimedwait(SIGNALS, left)
        self._leave()

    def _leave(self) -> None:
        """End the process at once; write its stacks if it should have ended by itself."""
        if self.patience <= STARTING:
            os._exit(0)
        # Without standard error its number is that of another file.
        if sys.stderr is not None:
            with suppress(OSError, ValueError, RuntimeError):
                text = f'not ended {self.patience:g} s after a signal, leaving from:\n'
                os.write(2, text.encode())
                faulthandler.dump_traceback(2, all_threads=True)
        os._exit(1)


# Patience while a node is being made: a long label file is not read to its end.
STARTING = 1.0
# Patience after that; `ros2 launch` kills after ten seconds.
RUNNING = 4.0
