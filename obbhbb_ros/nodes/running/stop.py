# SPDX-License-Identifier: Apache-2.0
"""Handles SIGINT and SIGTERM from the first line of a node's process to its last."""

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

STARTING = 1.0
"""Patience while the node starts, seconds: reading a long label file is not worth waiting for."""

RUNNING = 4.0
"""Patience after that, seconds; `ros2 launch` kills after ten."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_LAST_CALL = 1.0


class Stop:
    """
    Handles both signals until the process ends: the first asks it to end, the rest do nothing.

    The signals are blocked in all threads, and a thread of this class waits for them. So they
    interrupt nothing, although Ctrl-C in a terminal reaches a launched node twice within 50 ms.
    This module imports nothing else of the package, so that it can be the first to run.

    Attributes
    ----------
    patience : float
        How long the process may take to end after the first signal, seconds. At first it ends at
        once.
    name : str
        Name of the first signal; empty before it comes.
    on_leaving : callable
        Called with the reason if the process does not end by itself.
    """

    def __init__(self) -> None:
        self.patience = 0.0
        self.name = ''
        self.on_leaving: Callable[[str], object] = lambda reason: None
        self._wake: Callable[[], object] = lambda: None
        self._lock = threading.Lock()
        signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
        threading.Thread(target=self._listen, name='signals', daemon=True).start()

    @property
    def requested(self) -> bool:
        """Whether the process was asked to end."""
        return bool(self.name)

    def wake_by(self, wake: Callable[[], object]) -> None:
        """Set the function that the signal thread calls when a signal comes."""
        with self._lock:
            self._wake = wake

    def _listen(self) -> None:
        """Wait for the first signal, ask the process to end, and make sure that it does."""
        self.name = signal.Signals(signal.sigwait(_SIGNALS)).name
        asked = time.monotonic()
        with self._lock:
            self._wake()
        # The node may finish starting in the meantime, which raises the patience.
        while (left := asked + self.patience - time.monotonic()) > 0.0:
            signal.sigtimedwait(_SIGNALS, left)
        if self.patience <= STARTING:
            os._exit(0)
        reason = f'not ended {self.patience:g} s after a signal'
        leave(1, reason, lambda: self.on_leaving(reason))


def leave(code: int, reason: str, last: Callable[[], object]) -> NoReturn:
    """
    End the process at once, from any thread, whatever the other threads do.

    Parameters
    ----------
    code : int
        Exit code.
    reason : str
        Written to standard error, with the stacks of all threads.
    last : callable
        Called before the end, for one second at most: a disk may not answer.
    """
    # If standard error is closed, its number belongs to another file.
    if sys.stderr is not None:
        with suppress(OSError, ValueError, RuntimeError):
            os.write(2, f'{reason}, leaving from:\n'.encode())
            faulthandler.dump_traceback(2, all_threads=True)
    # Starting a thread fails when memory or a limit is used up.
    with suppress(RuntimeError):
        thread = threading.Thread(target=last, daemon=True)
        thread.start()
        thread.join(_LAST_CALL)
    os._exit(code)
