# SPDX-License-Identifier: Apache-2.0
"""Ends a process whose Python threads cannot run, unless it only was stopped from outside."""

from __future__ import annotations

import ctypes
import faulthandler
import os
import signal
import time
from typing import IO

_SIGEV_THREAD = 2


class _SignalEvent(ctypes.Structure):
    """The C library's ``struct sigevent``."""

    _fields_ = (
        ('value', ctypes.c_size_t),
        ('signal', ctypes.c_int),
        ('kind', ctypes.c_int),
        ('function', ctypes.c_void_p),
        ('attributes', ctypes.c_void_p),
        ('unused', ctypes.c_byte * 32),
    )


class _TimerTimes(ctypes.Structure):
    """The C library's ``struct itimerspec``: then every, and first after, seconds and more."""

    _fields_ = tuple((name, ctypes.c_long) for name in ('every', 'every_ns', 'after', 'after_ns'))


class LastResort:
    """
    Ends the process by SIGALRM if it is not put off in time; faulthandler writes the stacks first.

    It needs no Python thread: a library may hold Python's lock. After `timeout` seconds a timer
    of the C library calls `alarm`, which sends the signal `grace` seconds later. A clock goes on
    while the process is stopped from outside, so the timer may be late when the process continues;
    but then `grace` begins only there, and `put_off` has the time to call the alarm off. Nor does
    faulthandler walk through the stacks of threads that run again, which crashes.

    Parameters
    ----------
    timeout : float
        Seconds.
    grace : int
        Seconds; `put_off` must be called more often than this.
    stacks_file : file or int
        Where the stacks are written.

    Raises
    ------
    OSError
        If the system gives no timer.
    """

    def __init__(self, timeout: float, grace: int, stacks_file: IO[str] | IO[bytes] | int) -> None:
        faulthandler.register(signal.SIGALRM, stacks_file, all_threads=True, chain=True)
        self._libc = ctypes.CDLL(None, use_errno=True)
        alarm = ctypes.cast(self._libc.alarm, ctypes.c_void_p)
        event = _SignalEvent(value=grace, kind=_SIGEV_THREAD, function=alarm)
        self._timer = ctypes.c_void_p()
        new = ctypes.byref(self._timer)
        self._call('timer_create', time.CLOCK_MONOTONIC, ctypes.byref(event), new)
        self._timeout = timeout

    def put_off(self) -> None:
        """Begin to wait from now on."""
        self._set(self._timeout)

    def cancel(self) -> None:
        """Wait no longer."""
        self._set(0.0)

    def _set(self, seconds: float) -> None:
        after, rest = divmod(seconds, 1.0)
        times = _TimerTimes(after=int(after), after_ns=int(rest * 1e9))
        self._call('timer_settime', self._timer, 0, ctypes.byref(times), None)
        signal.alarm(0)

    def _call(self, name: str, *arguments: object) -> None:
        if getattr(self._libc, name)(*arguments) != 0:
            number = ctypes.get_errno()
            raise OSError(number, f'{name}: {os.strerror(number)}')
