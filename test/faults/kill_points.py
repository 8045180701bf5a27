# SPDX-License-Identifier: Apache-2.0
"""
Kills writer and releaser before each call that changes a file; what is left must be in order.

`python test/faults/kill_points.py --all` takes every call, else every fifth.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import shutil
import tempfile
import traceback
from collections import Counter
from itertools import count
from pathlib import Path

from library import loaded
from scene import PLANNED
from scene import Scene


def is_killed(library: ctypes.CDLL, folder: Path, removal: bool, point: int) -> bool:
    """Play in a process of its own; return whether it was killed at the point, or played it all."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            library.faults_arm(str(folder / 'on_board').encode(), point)
            scene = Scene(folder, removal)
            scene.play()
            code = 1 if scene.troubles else 0
        except BaseException:
            traceback.print_exc()
        os._exit(code)
    status = os.waitpid(child, 0)[1]
    if not os.WIFSIGNALED(status) and status:
        raise AssertionError(f'point {point}: there was trouble without a fault')
    return os.WIFSIGNALED(status)


def check(folder: Path, removal: bool, bus_is_first: bool) -> str:
    """Start again where the process was killed; tell the books."""
    scene = Scene(folder, removal)
    claimed = scene.claimed()
    if bus_is_first:
        scene.bus()
    status = scene.recover(may_come_twice=claimed if bus_is_first else set())
    assert scene.troubles == [], scene.troubles
    scene.close()
    planned, delivered = (status.counts.get(name, 0) for name in ('planned', 'delivered'))
    return (
        f'planned {planned}, delivered {delivered}, refused {status.total("refused")}, '
        f'evicted {status.total("evicted")}'
    )


def main() -> None:
    """Kill at each point, with the bus before the next start and after it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--all', action='store_true')
    options = parser.parse_args()
    library = loaded()
    for removal in (False, True):
        outcomes: Counter[str] = Counter()
        points = 0
        for points in count(step=1 if options.all else 5):
            with tempfile.TemporaryDirectory() as folder:
                played = Path(folder) / 'played'
                played.mkdir()
                if not is_killed(library, played, removal, points):
                    break
                copy = shutil.copytree(played, Path(folder) / 'copy') if options.all else played
                try:
                    outcomes[check(played, removal, bus_is_first=points % 2 == 0)] += 1
                    if options.all:
                        check(copy, removal, bus_is_first=points % 2 == 1)
                except AssertionError as error:
                    raise AssertionError(f'killed before call {points}, {removal=}') from error
        assert max(outcomes) <= f'planned {PLANNED}, z'
        print(f'{"removal" if removal else "release"}: killed before {points} calls')
        for outcome, number in sorted(outcomes.items()):
            print(f'{number:5} times {outcome}')


if __name__ == '__main__':
    main()
