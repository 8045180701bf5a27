# SPDX-License-Identifier: Apache-2.0
"""
The state file of a node: a small file that each run leaves to the next one.

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
# No more of the stacks is worth logging.
_MAX_STACKS = 20_000


class StateFile:
    """
    The state file of the present run, and what the last run left in it.

    Problems with the file are reported once and stop nothing. Several threads may use it.

    Parameters
    ----------
    path : str
        Absolute path; without one, nothing is kept.
    node : str
        Full name of the node.
    counters : mapping of str to int
        Its counters, written as they are at the time.
    warn : callable
        Receives the text of a problem.

    Attributes
    ----------
    last_run : LastRun
        How the last run ended.
    stacks_file : binary file or None
        Where faulthandler writes; None if nothing is kept.
    """

    def __init__(
        self,
        path: str,
        node: str,
        counters: Mapping[str, int],
        warn: Callable[[str], object],
    ) -> None:
        self.last_run = LastRun()
        self.stacks_file: BinaryIO | None = None
        # `Path.expanduser` raises if there is no such user.
        self._path = Path(os.path.expanduser(path))
        self._counters, self._warn, self._has_warned = counters, warn, False
        self._lock = threading.Lock()
        self._run = Run(node=node, pid=os.getpid(), boot=_boot_id(), started=_now())
        if path:
            self._open()

    @property
    def is_kept(self) -> bool:
        """Whether there is a state file."""
        return self.stacks_file is not None

    def begin(self, state: str) -> None:
        """Write that the run has begun; what the last run left is not needed any more."""
        if self.stacks_file is not None:
            with suppress(OSError):
                self.stacks_file.truncate(0)
        self.note(state)

    def note(self, state: str) -> None:
        """Write that the node runs, and its lifecycle state."""
        self._write(replace(self._run, state=state))

    def end(self, reason: str, asked: bool = False) -> None:
        """Write why the run ends; only the first reason counts."""
        self._write(replace(self._run, ended=reason, asked=asked))

    def _open(self) -> None:
        """Lock the files against other processes, and read them."""
        try:
            self._path, stacks_file = _locked(self._path)
        except BlockingIOError:
            self._fail('in use by another node; this run keeps no state file')
            return
        except (OSError, ValueError) as error:
            self._fail(f'{error}; this run keeps no state file')
            return
        self.stacks_file = stacks_file
        try:
            self.last_run = self._read(stacks_file)
        except FileNotFoundError:
            pass
        except (OSError, ValueError) as error:
            self._fail(str(error))
            self.last_run = LastRun(f'not known, {self._path} cannot be read', 1)
        self._run = replace(self._run, restarts=self.last_run.restarts)
        faulthandler.enable(stacks_file)

    def _read(self, stacks_file: BinaryIO) -> LastRun:
        """Read how the last run ended."""
        stacks_file.seek(0)
        stacks = stacks_file.read(_MAX_STACKS).decode(errors='replace')
        with self._path.open('rb') as file:
            run = read_run(file.read(_MAX_BYTES))
        if run.node != self._run.node:
            self._fail(f'it was the state file of another node, {run.node}')
            return LastRun()
        return last_run(run, stacks, self._run.boot)

    def _write(self, run: Run) -> None:
        """Replace the file, unless the run has ended."""
        if not self.is_kept:
            return
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
            except OSError as error:
                self._fail(str(error))
                with suppress(OSError):
                    partial.unlink()
            else:
                self._has_warned = False

    def _fail(self, text: str) -> None:
        """Warn of a problem once, until the file can be written again."""
        if not self._has_warned:
            self._has_warned = True
            self._warn(f'state.path: {self._path}: {text}')


def _locked(path: Path) -> tuple[Path, BinaryIO]:
    """
    Lock a state file; return its path behind links, and the open file of its stacks.

    Raises
    ------
    BlockingIOError
        If another process has locked it.
    OSError, ValueError
        If it cannot be a state file.
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
    # The lock lasts until the process is gone, however it ends.
    fcntl.flock(stacks_file, fcntl.LOCK_EX | fcntl.LOCK_NB)
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
