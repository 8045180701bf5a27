# SPDX-License-Identifier: Apache-2.0
"""
Has the disk fail at each call that changes a file, for one call or until the end of the scene.

`python test/faults/disk_errors.py --all` takes every call, else every twenty-fifth.
"""

from __future__ import annotations

import argparse
import errno
import tempfile
from collections import Counter
from contextlib import suppress
from itertools import count
from itertools import product
from pathlib import Path

from library import loaded
from scene import PLANNED
from scene import Scene

ERRORS = (errno.ENOSPC, errno.EROFS, errno.EIO)
# Of the spool, of the outbox, of both.
DISKS = ('on_board/spool', 'on_board/outbox', 'on_board')
_NEVER = 10**9


def main() -> None:
    """Fail at each point, and check what is left once the disk is well again."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--all', action='store_true')
    options = parser.parse_args()
    library = loaded()
    outcomes: Counter[str] = Counter()
    points = 0
    kinds = list(product(DISKS, ERRORS, (1, _NEVER), (False, True)))
    for number, (disk, error, calls, removal) in enumerate(kinds):
        # Not the same points for all.
        start = 0 if options.all else number % 25
        for point in count(start, 1 if options.all else 25):
            with tempfile.TemporaryDirectory() as folder:
                scene = Scene(Path(folder), removal)
                library.faults_fail(str(Path(folder) / disk).encode(), point, calls, error)
                scene.play()
                met = library.faults_calls() > point
                library.faults_arm(b'', -1)
                name = f'{errno.errorcode[error]} from call {point} on {disk}, {calls=}, {removal=}'
                try:
                    # One failing call may be made up for without a word.
                    assert scene.troubles or not met or calls == 1, 'not a word'
                    assert met or not scene.troubles, scene.troubles
                    status = scene.recover(may_come_twice=scene.claimed())
                    assert status.counts['planned'] == PLANNED, status
                except AssertionError as failed:
                    raise AssertionError(name) from failed
                finally:
                    with suppress(OSError):
                        scene.close()
                if not met:
                    break
                points += 1
                lost = status.counts.get('refused.spool_failed', 0)
                outcomes[f'refused as spool_failed {lost}, troubles {bool(scene.troubles)}'] += 1
    print(f'{points} points')
    for outcome, number in sorted(outcomes.items()):
        print(f'{number:5} times {outcome}')


if __name__ == '__main__':
    main()
