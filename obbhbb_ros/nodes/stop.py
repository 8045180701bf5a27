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
from typing import NoReturn

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
    name : str
        Name of the first signal, empty before.
    on_leaving : callable
        Called with the reason if the process does not end by itself.
    """

    def __init__(self) -> None:
        self.patience = 0.0
        self.name = ''
        self.on_leaving: Callable[[str], object] = lambda reason: None
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
        self.name = signal.Signals(signal.sigwait(SIGNALS)).name
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
        reason = f'not ended {self.patience:g} s after a signal'
        leave(1, reason, lambda: self.on_leaving(reason))


def leave(code: int, reason: str, last: Callable[[], object]) -> NoReturn:
    """
    End the process at once, from any thread, whatever the others are stuck in.

    Parameters
    ----------
    code : int
        Exit code.
    reason : str
        Written to standard error, with the stacks of all threads.
    last : callable
        Done before the end, unless it takes too long: a disk may not answer.
    """
    # Without standard error its number is that of another file.
    if sys.stderr is not None:
        with suppress(OSError, ValueError, RuntimeError):
            os.write(2, f'{reason}, leaving from:\n'.encode())
            faulthandler.dump_traceback(2, all_threads=True)
    # No thread can be started where memory or a limit is used up.
    with suppress(RuntimeError):
        thread = threading.Thread(target=last, daemon=True)
        thread.start()
        thread.join(_LAST_WORDS)
    os._exit(code)


# Patience while a node is being made: a long label file is not read to its end.
STARTING = 1.0
# Patience after that; `ros2 launch` kills after ten seconds.
RUNNING = 4.0
_LAST_WORDS = 1.0
