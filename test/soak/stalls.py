# SPDX-License-Identifier: Apache-2.0
"""
Runs a command, such as pytest, on a machine that stalls.

Every few seconds all of its processes, or one of them, are stopped for up to 1.2 s, as on a host
that has something else to do. A test that fails in it counts on time where it should wait.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path


def family(root: int) -> list[int]:
    """List a process and all that came from it."""
    children: dict[int, list[int]] = {}
    for stat in Path('/proc').glob('[0-9]*/stat'):
        with suppress(OSError):
            parent = int(stat.read_text().rpartition(')')[2].split()[1])
            children.setdefault(parent, []).append(int(stat.parent.name))
    tree = [root]
    for process in tree:
        tree += children.get(process, [])
    return tree


def send(number: int, pids: Iterable[int]) -> None:
    """Send a signal to those processes that are still there."""
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, number)


def main() -> int:
    """Stall a command until it ends, and end with its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('command', nargs=argparse.REMAINDER)
    options = parser.parse_args()
    if not options.command:
        parser.error('which command?')
    chance, stalls = random.Random(options.seed), 0
    with subprocess.Popen(options.command) as process:
        while process.poll() is None:
            time.sleep(chance.uniform(0.5, 4.0))
            pids = family(process.pid)
            chosen = pids if chance.random() < 0.5 else [chance.choice(pids)]
            try:
                send(signal.SIGSTOP, chosen)
                time.sleep(chance.uniform(0.2, 1.2))
            finally:
                send(signal.SIGCONT, chosen)
            stalls += 1
    print(f'{stalls} stalls, exit code {process.returncode}')
    return process.returncode


if __name__ == '__main__':
    raise SystemExit(main())
