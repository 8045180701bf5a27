# SPDX-License-Identifier: Apache-2.0
"""
Memory over a million ships: tracked, stored in a spool, released and delivered, a frame at a time.

    python test/soak/objects.py --ships 1000000

Each ship is seen in two frames. The memory of the process and the size of the catalogue are printed
ten times; they have to come to rest. What is remembered of the ships is bounded.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from contextlib import closing
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from spooled import SpoolUsers
from spooled import new_chip

from obbhbb_ros.text_tables import text_table
from obbhbb_ros.tracking.matcher import ShipMatcher
from obbhbb_ros.tracking.object_ids import ObjectIds

# Ships that enter with a frame; the same number is seen again.
ENTERING = 50
SIZE = 6000 + 4000j
# Of the spool, bytes: what is remembered of objects may take a fiftieth.
MAX_BYTES = 20e6
ALL = 1e12
# A disk in memory: this is not about speed.
SHARED_MEMORY = Path('/dev/shm')


def memory() -> int:
    """Return the resident memory of this process, bytes."""
    pages = Path('/proc/self/statm').read_text(encoding='ascii').split()[1]
    return int(pages) * os.sysconf('SC_PAGE_SIZE')


def main() -> None:
    """Fly over ships, and print what they take."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--ships', type=int, default=1_000_000)
    options = parser.parse_args()
    frames = options.ships // ENTERING
    rows = []
    with (
        tempfile.TemporaryDirectory(
            dir=SHARED_MEMORY if SHARED_MEMORY.is_dir() else None
        ) as folder,
        closing(SpoolUsers(Path(folder) / 'spool', print)) as spool,
    ):
        matcher, objects = ShipMatcher(), ObjectIds()
        random = np.random.default_rng(1)
        last = np.empty((0, 4))
        for frame in range(1, frames + 1):
            entering = random.uniform((0, 0, 20, -3), (6000, 2000, 200, 3), (ENTERING, 4))
            last = np.vstack((last[-ENTERING:] + [0, 2000, 0, 0], entering))
            x, y, length, angle = last.T
            numbers = matcher.track(frame / 2, x + 1j * y, length, angle, SIZE)
            ids = objects.name([f'c0ffee00-{number}' for number in numbers], frame / 2)
            chips = [new_chip(object_id=name, size=200) for name in ids]
            assert spool.writer.store(spool.writer.plan(len(chips)), chips, {}, MAX_BYTES)
            claimed = [chip.id for chip, _ in spool.releaser.claim(len(chips), ALL, ALL, 0).chips]
            spool.releaser.released(claimed, is_delivered=True)
            if frame % max(frames // 10, 1) == 0:
                counts = spool.writer.status().counts
                rows.append(
                    (
                        f'{frame * ENTERING}',
                        f'{numbers.max()}',
                        f'{counts["delivered"]}',
                        f'{counts["objects_released"]}',
                        f'{matcher.object_count}',
                        f'{memory() / 1e6:.1f}',
                        f'{spool.writer.status().file_bytes / 1e6:.1f}',
                    )
                )
                print(rows[-1], flush=True)
    head = ('ships', 'ids', 'delivered', 'released', 'remembered', 'memory, MB', 'catalogue, MB')
    print(text_table(head, rows))


if __name__ == '__main__':
    main()
