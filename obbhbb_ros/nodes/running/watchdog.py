# SPDX-License-Identifier: Apache-2.0
"""Ends a process if an executor or a thread of a node is stuck, so that it is started again."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field
from functools import partial
from typing import IO
from typing import Any

from obbhbb_ros.nodes.running.last_resort import LastResort
from obbhbb_ros.nodes.running.stop import leave

STUCK = 70
"""Exit code of a process that the watchdog ends."""

# An idle executor returns once a second.
_MIN_TIMEOUT = 2.0
# The watchdog counts its own looks instead of reading a clock: a clock goes on while the process is
# stopped from outside.
_LOOKS_PER_TIMEOUT = 8
# Seconds more that a thread has: it may wait for another process, and for slow disks.
_WORKER_PATIENCE = 10.0
# Number of timeouts after which the last resort ends the process.
_LAST_RESORT = 2.0


@dataclass
class Turns:
    """
    How often the executor of a node has returned.

    Attributes
    ----------
    node : str
        Name of the node.
    count : int
        To be increased whenever the executor returns. Until the first time, the node is starting.
    thread : int or None
        Identifier of the thread that runs the executor.
    """

    node: str
    count: int = 0
    thread: int | None = field(default_factory=lambda: threading.main_thread().ident)


class Watchdog:
    """
    Ends the process when an executor, or a thread of a node, is blocked for some time.

    It looks from a thread of its own. While a library holds Python's lock, that thread cannot run;
    then the last resort ends the process, by SIGALRM, after twice the time.

    Parameters
    ----------
    timeout : float
        Seconds; 0 for no watchdog.
    turns : sequence of Turns
        Those of the executors.
    stacks_file : file or None
        Where the stacks are written in that case; standard error by default.
    on_stuck : callable
        Called with the reason before the process ends.
    worker_signs : sequence of callable
        Each returns a number that grows as long as a thread of a node goes on; None without one.

    Raises
    ------
    ValueError
        If the timeout is so short that an idle executor would seem to be blocked.
    """

    def __init__(
        self,
        timeout: float,
        turns: Sequence[Turns],
        stacks_file: IO[bytes] | None,
        on_stuck: Callable[[str], object],
        worker_signs: Sequence[Callable[[], int | None]] = (),
    ) -> None:
        if 0.0 < timeout < _MIN_TIMEOUT:
            raise ValueError(
                f'watchdog_timeout must be 0, or {_MIN_TIMEOUT:g} or more, not {timeout}'
            )
        self._turns = turns
        self._timeout, self._stacks_file, self._on_stuck = timeout, stacks_file, on_stuck
        self._worker_signs = worker_signs
        self._stopping = threading.Event()
        if timeout:
            threading.Thread(target=self._watch, name='watchdog', daemon=True).start()

    def stop(self) -> None:
        """Stop watching."""
        self._stopping.set()

    def _watch(self) -> None:
        """Watch the number of turns, and the signs of threads, until told to stop."""
        stacks_file: Any = self._stacks_file or sys.stderr or os.open(os.devnull, os.O_WRONLY)
        grace = int(self._timeout / 2)
        last_resort = LastResort(_LAST_RESORT * self._timeout - grace, grace, stacks_file)
        worker_timeout = self._timeout + _WORKER_PATIENCE
        max_worker_looks = _LOOKS_PER_TIMEOUT * worker_timeout / self._timeout
        unchanged, silent = [0] * len(self._turns), [0] * len(self._worker_signs)
        while max(unchanged) < _LOOKS_PER_TIMEOUT and max(silent, default=0) < max_worker_looks:
            # It ends the process, unless this line is reached again in time.
            last_resort.put_off()
            counts = [turns.count for turns in self._turns]
            signs = [sign() for sign in self._worker_signs]
            if self._stopping.wait(self._timeout / _LOOKS_PER_TIMEOUT):
                last_resort.cancel()
                return
            unchanged = [
                looks + 1 if before == turns.count else 0
                for looks, before, turns in zip(unchanged, counts, self._turns, strict=True)
            ]
            silent = [
                looks + 1 if before is not None and before == sign() else 0
                for looks, before, sign in zip(silent, signs, self._worker_signs, strict=True)
            ]
        if max(unchanged) >= _LOOKS_PER_TIMEOUT:
            stuck = self._turns[unchanged.index(max(unchanged))]
            whose = f' of {stuck.node}' if len(self._turns) > 1 else ''
            reason = (
                f'watchdog: no turn of the executor{whose} for {self._timeout:g} s, '
                f'{_place(stuck.thread)}'
            )
        else:
            reason = f'watchdog: no sign of a thread of the node for {worker_timeout:g} s'
        leave(STUCK, reason, partial(self._on_stuck, reason))


def _place(thread: int | None) -> str:
    """Say where a thread is."""
    frame = sys._current_frames().get(thread or 0)
    if frame is None:
        return 'not in Python'
    code = frame.f_code
    return f'in {code.co_name}, {code.co_filename}:{frame.f_lineno}'
