# SPDX-License-Identifier: Apache-2.0
"""
What a run of a node leaves to the next one: a small file, and the stacks of a crash beside it.

The file is written once a second and at the end, always as a whole. It is not flushed to disk but
at the end: the time that takes would be the node's. A power cut may cost its last seconds, and on
some file systems leaves it damaged.
"""

from __future__ import annotations

import faulthandler
import fcntl
import json
import os
import signal
import threading
from collections.abc import Callable
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from dataclasses import dataclass
from dataclasses import field
from datetime import datetime
from datetime import timezone
from pathlib import Path
from typing import BinaryIO

_BOOT_ID = Path('/proc/sys/kernel/random/boot_id')
# Far more than a state file has.
_MOST_BYTES = 1_000_000
# More than is worth logging.
_MOST_STACKS = 20_000
_CRASH, _TIMEOUT = 'Fatal Python error: ', 'Timeout ('
_SIGNAL_NAMES = {
    signal.strsignal(each): each.name
    for each in (signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGILL, signal.SIGFPE)
}


@dataclass(frozen=True)
class Run:
    """
    A run of a node, as a state file has it.

    Attributes
    ----------
    node : str
        Full name of the node.
    pid : int
        Its process.
    boot : str
        The kernel's id of the time since the machine was started.
    started, written : str
        When the run began, and the last moment that is known of it.
    restarts : int
        How many runs in a row before it ended without being asked to.
    state : str
        Lifecycle state.
    ended : str
        Why it ended, empty before.
    asked : bool
        Whether it was asked to end.
    counters : mapping of str to int
        Counters of the diagnostics.
    """

    node: str = ''
    pid: int = 0
    boot: str = ''
    started: str = ''
    written: str = ''
    restarts: int = 0
    state: str = ''
    ended: str = ''
    asked: bool = False
    counters: Mapping[str, int] = field(default_factory=dict)


def read_run(data: bytes) -> Run:
    """
    Read the content of a state file.

    Raises
    ------
    ValueError
        If it is none.
    """
    try:
        document = json.loads(data)
        # Half a character cannot be published.
        json.dumps(document, ensure_ascii=False).encode()
    except (ValueError, RecursionError):
        raise ValueError('not the state of a run: it is damaged') from None
    if not isinstance(document, dict):
        raise ValueError('not the state of a run')
    blank = asdict(Run())
    for name, value in blank.items():
        if type(document.get(name)) is not type(value):
            raise ValueError(f'not the state of a run: {name} is missing or wrong')
    if not all(type(count) is int for count in document['counters'].values()):
        raise ValueError('not the state of a run: counters are wrong')
    return Run(**{name: document[name] for name in blank})


def end_of(run: Run, stacks: str, boot: str) -> tuple[str, bool]:
    """
    Find out why a run ended.

    Parameters
    ----------
    run : Run
        The run, as it is known from its state file.
    stacks : str
        What faulthandler has written, if it had reason to.
    boot : str
        Id of the machine's start, of today.

    Returns
    -------
    why : str
        The reason.
    asked : bool
        Whether it was asked to end.
    """
    head = stacks.partition('\n')[0]
    # These may be of an attempt to start since.
    if head.startswith(_CRASH):
        what = head.removeprefix(_CRASH)
        return f'crashed: {what} ({_SIGNAL_NAMES.get(what, "see its log")})', False
    if head.startswith(_TIMEOUT):
        return 'watchdog: stuck outside Python', False
    if run.ended:
        return run.ended, run.asked
    if boot != run.boot:
        return 'the machine was restarted: a power cut or a reset', False
    return 'killed: SIGKILL, or out of memory', False


class RunRecord:
    """
    Keeps the state file of a run, and knows what the run before left in it.

    Trouble with files is told once and stops nothing. Safe to use from several threads.

    Parameters
    ----------
    path : str
        The state file; without one nothing is kept.
    node : str
        Full name of the node.
    counters : mapping of str to int
        Its counters, which go on counting.
    complain : callable
        Told what is wrong with the file.

    Attributes
    ----------
    restart : str
        That this run is a restart after an end that nobody had asked for, and why it ended; empty
        if it is not.
    restarts : int
        How many such ends in a row there have been.
    last : dict of str to str
        What is known of the run before.
    stacks : str
        Its stacks, if it crashed.
    stacks_file : binary file or None
        Where faulthandler writes.
    """

    def __init__(
        self,
        path: str = '',
        node: str = '',
        counters: Mapping[str, int] | None = None,
        complain: Callable[[str], object] = lambda text: None,
    ) -> None:
        self.restart, self.restarts = '', 0
        self.last: dict[str, str] = {}
        self.stacks = ''
        self.stacks_file: BinaryIO | None = None
        # `Path.expanduser` raises where there is no such user.
        self._path = Path(os.path.expanduser(path))
        self._complain = complain
        self._has_complained = False
        self._counters = {} if counters is None else counters
        self._lock = threading.Lock()
        self._has_ended = False
        self._state = ''
        self._run = Run(node=node, pid=os.getpid(), boot=_boot_id(), started=_now())
        if path:
            self._open()

    @property
    def is_kept(self) -> bool:
        """Whether there is a state file."""
        return self.stacks_file is not None

    def note(self, state: str) -> None:
        """Write that the node runs, in this lifecycle state."""
        if self.stacks_file is not None and not self._state:
            # Now the run counts: what the run before left is not needed any more.
            with suppress(OSError):
                self.stacks_file.truncate(0)
        self._state = state
        self._write()

    def end(self, why: str, asked: bool = False) -> None:
        """Write why the run ends; what comes after the first reason is ignored."""
        self._write(why, asked)

    def _open(self) -> None:
        """Make sure that no other process uses the files, and read them."""
        try:
            if not self._path.is_absolute():
                raise ValueError('not an absolute path')
            # What a link points at is replaced, not the link.
            self._path = Path(os.path.realpath(self._path))
            self._path.parent.mkdir(parents=True, exist_ok=True)
            if self._path.exists() and not self._path.is_file():
                raise ValueError('not a file')
            if _is_foreign(self._path):
                raise ValueError('it holds something else')
            stacks_file = self._path.with_name(f'{self._path.name}.stacks').open('a+b')
            # Held until the process is gone, however it ends.
            fcntl.flock(stacks_file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._fail('in use by another node, nothing is kept of this run')
            return
        except (OSError, ValueError) as error:
            self._fail(f'{error}; nothing is kept of this run')
            return
        self.stacks_file = stacks_file
        self._read(stacks_file)
        faulthandler.enable(stacks_file)

    def _read(self, stacks_file: BinaryIO) -> None:
        """Learn of the run before."""
        try:
            stacks_file.seek(0)
            stacks = stacks_file.read(_MOST_STACKS).decode(errors='replace')
            with self._path.open('rb') as file:
                run = read_run(file.read(_MOST_BYTES))
        except FileNotFoundError:
            return
        except (OSError, ValueError) as error:
            self._fail(str(error))
            self._be_a_restart(f'not known, {self._path} cannot be read', 1)
            return
        if run.node != self._run.node:
            self._fail(f'of another node before, {run.node}')
            return
        why, asked = end_of(run, stacks, self._run.boot)
        self.last = {
            **{name: str(count) for name, count in run.counters.items()},
            'pid': str(run.pid),
            'started': run.started,
            'written': run.written,
            'state': run.state,
            'ended': why,
        }
        if not asked:
            self.stacks = stacks
            self._be_a_restart(why, run.restarts + 1)

    def _be_a_restart(self, why: str, restarts: int) -> None:
        """Remember that the run before ended without being asked to."""
        self.last['ended'] = why
        self.restarts = restarts
        self.restart = f'restart {restarts} in a row; end of the last run: {why}'

    def _write(self, ended: str = '', asked: bool = False) -> None:
        """Replace the state file."""
        if not self.is_kept:
            return
        with self._lock:
            if self._has_ended:
                return
            self._has_ended = bool(ended)
            run = asdict(self._run) | {
                'written': _now(),
                'restarts': self.restarts,
                'state': self._state,
                'ended': ended,
                'asked': asked,
                'counters': dict(self._counters),
            }
            # The same name each time, so that kills leave no more than one.
            partial = self._path.with_name(f'.{self._path.name}')
            try:
                with partial.open('w', encoding='utf-8') as file:
                    # Counters may be integers of NumPy.
                    file.write(f'{json.dumps(run, indent=1, default=int)}\n')
                    if ended:
                        file.flush()
                        os.fsync(file.fileno())
                partial.replace(self._path)
            except OSError as error:
                self._fail(str(error))
                with suppress(OSError):
                    partial.unlink()
            else:
                self._has_complained = False

    def _fail(self, text: str) -> None:
        """Tell once what is wrong."""
        if not self._has_complained:
            self._has_complained = True
            self._complain(f'state.path: {self._path}: {text}')


def _is_foreign(path: Path) -> bool:
    """
    Return whether a file is none of ours, and must not be replaced.

    Ours is a JSON object, or what a power cut leaves of it: nothing, or zeros.
    """
    if not path.exists():
        return False
    with path.open('rb') as file:
        return file.read(1) not in (b'', b'\0', b'{')


def _now() -> str:
    """Write the time of now."""
    return datetime.now(timezone.utc).isoformat(timespec='milliseconds')


def _boot_id() -> str:
    """Return the id of the machine's start, where there is one."""
    try:
        return _BOOT_ID.read_text(encoding='ascii').strip()
    except OSError:
        return ''
