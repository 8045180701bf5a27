# SPDX-License-Identifier: Apache-2.0
"""
What a spool of many chips costs: storing, starting, releasing, looking at it, memory.

`python test/benchmarks/spool.py` prints figures, and fails if the order is not right.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from spooled import FACTS

from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.chips import encode
from obbhbb_ros.spool.chip_rows import NewChip
from obbhbb_ros.spool.feeder import OutboxFeeder
from obbhbb_ros.spool.feeder import ReleaseSettings
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.spool.releaser import SpoolReleaser
from obbhbb_ros.spool.writer import SpoolWriter
from obbhbb_ros.text_tables import text_table

FRAME = 100
SIZE = 2000


def seconds(work: Callable[[], Any]) -> float:
    """Give how much processor time something takes."""
    started = time.process_time()
    work()
    return time.process_time() - started


def memory() -> float:
    """Give the memory that this process uses now, MB."""
    pages = int(Path('/proc/self/statm').read_text(encoding='ascii').split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 1e6


def encoding() -> list[float]:
    """Measure the encoding of a frame's chips, 90 x 80 pixels of colour as JPEG."""
    noise = np.random.default_rng(0).integers(100, 140, (FRAME, 80, 90, 3), np.uint8)
    codec = CodecSettings()
    return [seconds(lambda: [encode(chip, codec) for chip in noise]) for _ in range(10)]


def object_id(which: str, number: int, place: int) -> str:
    """Give the id of the ship of a chip: of each ship in ten frames, or of all of one."""
    return {'none': '', 'ships': f'3fa9c2d1-{10 * number + place}', 'one': '3fa9c2d1-1'}[which]


def storing(writer: SpoolWriter, chips: int, which: str, max_bytes: float = 0.0) -> list[float]:
    """Measure planning and storing, frame by frame."""
    data = os.urandom(SIZE)
    times = []
    for number in range(chips // FRAME):
        made = [
            NewChip(
                random.random(), 'ship', (number, 0), FACTS, data, object_id(which, number, place)
            )
            for place in range(FRAME)
        ]
        times.append(seconds(lambda: writer.store(writer.plan(FRAME), made, {}, max_bytes)))  # noqa: B023
    return times


class Noted(Outbox):
    """An outbox that notes in which order chips come."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.order: list[tuple[float, int]] = []

    def add(self, chip_id: str, suffix: str, data: bytes, description: bytes, level: int) -> None:
        self.order.append((-json.loads(description)['rank'], int(chip_id.rpartition('_')[2])))
        super().add(chip_id, suffix, data, description, level)


def command(folder: Path) -> list[str]:
    """Give the command that an operator types."""
    return [sys.executable, '-m', 'obbhbb_ros.cli', 'spool', str(folder), '--json']


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--chips', type=int, default=100_000)
    parser.add_argument('--objects', choices=('none', 'ships', 'one'), default='ships')
    parser.add_argument('--seconds', type=float, default=10.0, help='of releasing')
    options = parser.parse_args()
    random.seed(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / 'spool'
        writer = SpoolWriter(folder, print)
        before = memory()
        times = 1e3 * np.array(storing(writer, options.chips, options.objects))
        grown = memory() - before
        encoded = 1e3 * np.array(encoding())
        size = writer.status().file_bytes
        full = 1e3 * np.array(storing(writer, 20 * FRAME, options.objects, size))
        status = seconds(writer.status)
        shown: list[Any] = []
        looked = -time.perf_counter()
        shown.append(json.loads(subprocess.check_output(command(folder))))
        looked += time.perf_counter()
        outbox = Noted(Path(name) / 'outbox')
        release = ReleaseSettings()
        feeder = OutboxFeeder(SpoolReleaser(folder, print), outbox, release, print)
        started = seconds(feeder.step)
        feeder.steer(release, is_contact=True)
        first = seconds(feeder.step)
        before = memory()
        until = time.perf_counter() + options.seconds
        released = len(outbox.order)
        while time.perf_counter() < until:
            feeder.step()
        rate = (len(outbox.order) - released) / options.seconds
        releasing = memory() - before
        assert outbox.order == sorted(outbox.order), 'not in order'
        assert writer.status().balance == 0
        writer.close()
        feeder.close()
    print(
        text_table(
            (f'{shown[0]["waiting"]} chips of {SIZE} bytes', 'median', 'greatest'),
            [
                (f'store a frame of {FRAME} [ms]', f'{np.median(times):.1f}', f'{times.max():.1f}'),
                ('the same, evicting [ms]', f'{np.median(full):.1f}', f'{full.max():.1f}'),
                (
                    f'encode {FRAME} chips of 90 x 80 [ms]',
                    f'{np.median(encoded):.1f}',
                    f'{encoded.max():.1f}',
                ),
                ('start of the releaser [ms]', f'{1e3 * started:.1f}', ''),
                ('first batch [ms]', f'{1e3 * first:.1f}', ''),
                ('status [ms]', f'{1e3 * status:.1f}', ''),
                ('obbhbb spool [ms]', f'{1e3 * looked:.0f}', ''),
                ('released per second', f'{rate:.0f}', ''),
                ('size of the catalogue [MB]', f'{size / 1e6:.0f}', ''),
                ('memory grown by storing [MB]', f'{grown:.1f}', ''),
                ('memory grown by releasing [MB]', f'{releasing:.1f}', ''),
            ],
        )
    )


if __name__ == '__main__':
    main()
