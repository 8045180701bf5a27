# SPDX-License-Identifier: Apache-2.0
"""Ends a process whose executor is stuck in a callback, so that it is started again."""

from __future__ import annotations

import faulthandler
import os
import sys
import threading
from collections.abc import Callable
from typing import Any

from obbhbb_ros.nodes.last_run import RunRecord
from obbhbb_ros.nodes.stop import leave

# Exit code.
STUCK = 70
# An idle executor makes a turn every second.
_SHORTEST = 2.0
# Looks per timeout. They are counted instead of the time, which goes on while a process is stopped
# from outside.
_LOOKS = 8
# Times the timeout, before one that needs nothing of Python takes over.
_LAST_RESORT = 2.0


class Watchdog:
    """
    Ends the process when the executor makes no turn for some time.

    It looks from a thread of its own. While something holds Python's lock that thread cannot run;
    then faulthandler ends the process, with exit code 1, after twice the time.

    Parameters
    ----------
    timeout : float
        Seconds; 0 for no watchdog.
    record : RunRecord, optional
        Where the reason is left for the next run.
    log : callable, optional
        Told the reason.

    Attributes
    ----------
    turns : int
        To be counted up at each turn of the executor. Before the first one the node is made.

    Raises
    ------
    ValueError
        If the timeout is so short that an idle executor would be taken for a stuck one.
    """

    def __init__(
        self,
        timeout: float = 0.0,
        record: RunRecord | None = None,
        log: Callable[[str], object] = lambda reason: None,
    ) -> None:
        if 0.0 < timeout < _SHORTEST:
            raise ValueError(f'watchdog_timeout must be 0, or {_SHORTEST:g} or more, not {timeout}')
        self.turns = 0
        self._timeout = timeout
        self._record, self._log = record or RunRecord(), log
        self._stopping = threading.Event()
        self._file: Any = self._record.stacks_file or sys.stderr
        if timeout:
            threading.Thread(target=self._watch, name='watchdog', daemon=True).start()

    def stop(self) -> None:
        """Look no more."""
        self._stopping.set()

    def _watch(self) -> None:
        """Look for turns until told to stop."""
        turns, unchanged = self.turns, 0
        if self._file is None:
            self._file = os.open(os.devnull, os.O_WRONLY)
        self._arm_last_resort()
        while not self._stopping.wait(self._timeout / _LOOKS):
            self._arm_last_resort()
            unchanged = unchanged + 1 if turns == self.turns else 0
            turns = self.turns
            if unchanged == _LOOKS:
                self._leave()
        faulthandler.cancel_dump_traceback_later()

    def _arm_last_resort(self) -> None:
        """Have faulthandler end the process, unless this is called again in time."""
        faulthandler.dump_traceback_later(_LAST_RESORT * self._timeout, exit=True, file=self._file)

    def _leave(self) -> None:
        """End the process, and say why."""
        reason = f'watchdog: no turn of the executor for {self._timeout:g} s, {_place()}'

        def say() -> None:
            self._record.end(reason)
            self._log(f'{reason}, leaving with exit code {STUCK}')

        leave(STUCK, reason, say)


def _place() -> str:
    """Tell where the main thread is."""
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    if frame is None:
        return 'not in Python'
    code = frame.f_code
    return f'in {code.co_name}, {code.co_filename}:{frame.f_lineno}'
