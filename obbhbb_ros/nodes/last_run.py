# SPDX-License-Identifier: Apache-2.0
"""What the next run learns from the state file and the crash stacks of a run."""

from __future__ import annotations

import json
import signal
from collections.abc import Mapping
from dataclasses import asdict
from dataclasses import dataclass
from dataclasses import field

# How the first line of what faulthandler writes begins.
_CRASH, _STUCK = 'Fatal Python error: ', ('Thread 0x', 'Current thread 0x')
_SIGNAL_NAMES = {
    signal.strsignal(number): number.name
    for number in (signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGILL, signal.SIGFPE)
}


@dataclass(frozen=True)
class Run:
    """
    A run of a node, as its state file has it.

    Attributes
    ----------
    node : str
        Full name of the node.
    pid : int
        Process id.
    boot : str
        Boot id of the kernel.
    started, written : str
        When the run began, and when the file was written, UTC.
    restarts : int
        Number of runs in a row before this one that ended without being asked to.
    state : str
        Lifecycle state.
    ended : str
        Why the run ended; empty while it goes on.
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
        If it is not one, or damaged.
    """
    try:
        document = json.loads(data)
        # Diagnostics cannot hold a lone surrogate.
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


@dataclass(frozen=True)
class LastRun:
    """
    How the run before this one ended.

    Attributes
    ----------
    ended : str
        Why it ended; empty if nothing is known of it.
    restarts : int
        Number of runs in a row, up to that one, that ended without being asked to.
    stacks : str
        Its stacks, if it crashed.
    run : Run or None
        What its state file says, if that can be read.
    """

    ended: str = ''
    restarts: int = 0
    stacks: str = ''
    run: Run | None = None

    @property
    def warning(self) -> str:
        """What to warn the operator of; empty if the run was asked to end."""
        if not self.restarts:
            return ''
        return f'restart {self.restarts} in a row; end of the last run: {self.ended}'

    def facts(self) -> dict[str, str]:
        """Return what the diagnostics report, by key."""
        facts = {'restarts': str(self.restarts)}
        if self.run is not None:
            for name, count in self.run.counters.items():
                facts[f'last_run.{name}'] = str(count)
            for name in ('pid', 'started', 'written', 'state'):
                facts[f'last_run.{name}'] = str(getattr(self.run, name))
        if self.ended:
            facts['last_run.ended'] = self.ended
        return facts


def last_run(run: Run, stacks: str, boot: str) -> LastRun:
    """
    Find out how a run ended.

    Parameters
    ----------
    run : Run
        What its state file says.
    stacks : str
        What faulthandler wrote; empty if it had no reason to.
    boot : str
        The present boot id of the kernel.
    """
    ended, asked = _end_of(run, stacks.partition('\n')[0], boot)
    if asked:
        return LastRun(ended, run=run)
    return LastRun(ended, run.restarts + 1, stacks, run)


def _end_of(run: Run, stacks_head: str, boot: str) -> tuple[str, bool]:
    """Return why a run ended, and whether it was asked to."""
    # Stacks come first: they may be those of an attempt to start after the run.
    if stacks_head.startswith(_CRASH):
        crash = stacks_head.removeprefix(_CRASH)
        return f'crashed: {crash} ({_SIGNAL_NAMES.get(crash, "see its log")})', False
    if stacks_head.startswith(_STUCK):
        return 'watchdog: stuck outside Python', False
    if run.ended:
        return run.ended, run.asked
    if boot != run.boot:
        return 'the machine was restarted: a power cut or a reset', False
    return 'killed: SIGKILL, or out of memory', False
