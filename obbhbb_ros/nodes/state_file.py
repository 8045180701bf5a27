# SPDX-License-Identifier: Apache-2.0
"""
The state file of a node: a small file that each run leaves for the next one.

It is written as a whole once a second and at the end. Only the last write is flushed to disk,
because a flush would hold up the node; a power cut may cost the last seconds, and on some file
systems damages the file. Beside it lies a file for the stacks of a crash.
"""

from __future__ import annotations

import faulthandler
import fcntl
import json
import os
import threading
from collections.abc import Callable
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from dataclasses import replace
from datetime import datetime
from datetime import timezone
from pathlib import Path
from typing import BinaryIO

from obbhbb_ros.nodes.last_run import LastRun
from obbhbb_ros.nodes.last_run import Run
from obbhbb_ros.nodes.last_run import last_run
from obbhbb_ros.nodes.last_run import read_run

_BOOT_ID = Path('/proc/sys/kernel/random/boot_id')
# A state file has about 2 kB.
_MAX_BYTES = 1_000_000
# More of the stacks is not worth logging.
_MAX_STACKS = 20_000


def open_state_file(
    path: str, node: str, counters: Mapping[str, int], warn: Callable[[str], object]
) -> StateFile | None:
    """
    Open the state file of a node, and read what the last run left in it.

    Parameters
    ----------
    path : str
        Absolute path; may be empty.
    node : str
        Full name of the node.
    counters : mapping of str to int
        Its counters, written as they are at the time.
    warn : callable
        Receives the text of a problem. Problems stop nothing.

    Returns
    -------
    StateFile or None
        None if there is no path, or no state file can be kept there.
    """

    def warn_of_file(text: str) -> None:
        warn(f'state.path: {path}: {text}')

    if not path:
        return None
    # `Path.expanduser` raises if there is no such user.
    path = os.path.expanduser(path)
    try:
        return StateFile(Path(path), node, counters, warn_of_file)
    except (OSError, ValueError) as error:
        warn_of_file(f'{error}; this run keeps no state file')
        return None


class StateFile:
    """
    The state file of the present run, from `open_state_file`. Several threads may use it.

    Attributes
    ----------
    last_stacks : dict of int to str
        What faulthandler left, if anything, by the process id of the last run.
    stacks_file : binary file
        Where faulthandler writes.

    Raises
    ------
    OSError, ValueError
        If the path cannot be that of a state file, or another process uses it.
    """

    def __init__(
        self, path: Path, node: str, counters: Mapping[str, int], warn: Callable[[str], object]
    ) -> None:
        self._path, self.stacks_file = _locked(path)
        self._counters, self._warn, self._is_writable = counters, warn, True
        self._lock = threading.Lock()
        self._run = Run(node=node, pid=os.getpid(), boot=_boot_id(), started=_now())
        self._last = self._read_last()
        self.last_stacks = self._read_stacks()
        faulthandler.enable(self.stacks_file)

    def explain(self, stacks: Mapping[int, str]) -> LastRun:
        """
        Find out how the last run ended, before this one begins.

        Parameters
        ----------
        stacks : mapping of int to str
            What faulthandler left, by process id: of the nodes of a process, one has the stacks.
        """
        if isinstance(self._last, Run):
            last = last_run(self._last, stacks.get(self._last.pid, ''), self._run.boot)
        else:
            last = self._last
        self._run = replace(self._run, restarts=last.restarts)
        return last

    def begin(self, state: str) -> None:
        """Write that the run has begun; what the last run left is not needed any more."""
        with suppress(OSError):
            self.stacks_file.truncate(0)
        self.note(state)

    def note(self, state: str) -> None:
        """Write that the node runs, and its lifecycle state."""
        self._write(replace(self._run, state=state))

    def end(self, reason: str, asked: bool = False) -> None:
        """Write why the run ends; only the first reason counts."""
        self._write(replace(self._run, ended=reason, asked=asked))

    def _read_last(self) -> Run | LastRun:
        """Read the last run; warn if the file does not say, and return what is known then."""
        try:
            with self._path.open('rb') as file:
                run = read_run(file.read(_MAX_BYTES))
        except FileNotFoundError:
            return LastRun()
        except (OSError, ValueError) as error:
            self._warn(str(error))
            return LastRun(f'not known, {self._path} cannot be read', 1)
        if run.node != self._run.node:
            self._warn(f'it was the state file of another node, {run.node}')
            return LastRun()
        return run

    def _read_stacks(self) -> dict[int, str]:
        """Read what faulthandler wrote in the last run."""
        self.stacks_file.seek(0)
        stacks = self.stacks_file.read(_MAX_STACKS).decode(errors='replace')
        return {self._last.pid: stacks} if isinstance(self._last, Run) and stacks else {}

    def _write(self, run: Run) -> None:
        """Replace the file, unless the run has ended; warn once if that becomes impossible."""
        with self._lock:
            if self._run.ended:
                return
            self._run = replace(run, written=_now(), counters=dict(self._counters))
            # The same name each time, so that kills leave no more than one.
            partial = self._path.with_name(f'.{self._path.name}')
            try:
                with partial.open('w', encoding='utf-8') as file:
                    # Counters may be integers of NumPy.
                    file.write(f'{json.dumps(asdict(self._run), indent=1, default=int)}\n')
                    if self._run.ended:
                        file.flush()
                        os.fsync(file.fileno())
                partial.replace(self._path)
                self._is_writable = True
            except OSError as error:
                if self._is_writable:
                    self._warn(str(error))
                self._is_writable = False
                with suppress(OSError):
                    partial.unlink()


def _locked(path: Path) -> tuple[Path, BinaryIO]:
    """
    Lock a state file; return its path behind links, and the open file of its stacks.

    Raises
    ------
    OSError, ValueError
        If it cannot be a state file, or another process has locked it.
    """
    if not path.is_absolute():
        raise ValueError('not an absolute path')
    # Writing replaces what a link points to, not the link.
    path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():
        if not path.is_file():
            raise ValueError('not a file')
        with path.open('rb') as file:
            # A state file is a JSON object, or what a power cut leaves of it: nothing, or zeros.
            if file.read(1) not in (b'', b'\0', b'{'):
                raise ValueError('not a state file')
    stacks_file = path.with_name(f'{path.name}.stacks').open('a+b')
    try:
        # The lock lasts until the process is gone, however it ends.
        fcntl.flock(stacks_file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise ValueError('in use by another node') from None
    return path, stacks_file


def _now() -> str:
    """Write the present time."""
    return datetime.now(timezone.utc).isoformat(timespec='milliseconds')


def _boot_id() -> str:
    """Return the boot id of the kernel, if it has one."""
    try:
        return _BOOT_ID.read_text(encoding='ascii').strip()
    except OSError:
        return ''
