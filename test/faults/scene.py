# SPDX-License-Identifier: Apache-2.0
"""A writer, a releaser and a bus at work, and what must be true of what they leave behind."""

from __future__ import annotations

import json
import sqlite3
import sys
from collections import Counter
from contextlib import suppress
from hashlib import sha256
from itertools import count
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from spooled import CAMERA
from spooled import Clock
from spooled import cameras_in_outbox
from spooled import database
from spooled import feeder
from spooled import in_outbox
from spooled import new_chip

from obbhbb_ros.spool.books import Status
from obbhbb_ros.spool.catalogue import catalogue_files
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.feeder import ReleaseSettings
from obbhbb_ros.spool.writer import SpoolWriter

PLANNED = 8


class Scene:
    """
    What happens below a folder.

    `on_board` has spool and outbox; the bus moves chips to `ground`.
    """

    def __init__(self, folder: Path, removal: bool) -> None:
        self.on_board, self.ground = folder / 'on_board', folder / 'ground'
        self.on_board.mkdir(parents=True, exist_ok=True)
        self.ground.mkdir(exist_ok=True)
        self.troubles: list[str] = []
        self.clock = Clock()
        self.writer = SpoolWriter(self.on_board / 'spool', self.troubles.append)
        self._settings = ReleaseSettings(removal=removal, is_compact=True)
        self.feeder = feeder(self.on_board, self.troubles.append, self.clock, self._settings)

    def play(self) -> None:
        """Plan, store, release, take: frames of 5 and 3 chips, one of which is refused."""
        frame = self.writer.plan(5)
        self.writer.store(
            frame,
            [
                new_chip(0.1 * i, 3000, (5, i), object_id=f'a-{i // 2}', camera=CAMERA)
                for i in range(4)
            ],
            {'encoder_failed': 1},
        )
        self.steps(2)
        frame = self.writer.plan(3)
        self.bus()
        # A full one: the least valuable goes.
        self.writer.store(
            frame,
            [
                new_chip(0.9, 3000, object_id='a-1', camera=CAMERA),
                new_chip(0.8, 3000, object_id='a-1', camera=CAMERA | {'model': 'equidistant'}),
                new_chip(0.0, 40_000, object_id='a-0'),
            ],
            {},
            100_000.0,
        )
        self.steps(2)

    def steps(self, number: int) -> None:
        """Release, and let time go by in which the bus is looked after."""
        for _ in range(number):
            self.feeder.step()
            self.clock.now += 100.0

    def bus(self) -> None:
        """Take what is complete."""
        for path in sorted((self.on_board / 'outbox').glob('*/[!.]*.json')):
            described = json.loads(path.read_text(encoding='utf-8'))
            chip = path.with_suffix('.camera' if 'kind' in described else '.jpg')
            assert described['sha256'] == sha256(chip.read_bytes()).hexdigest(), path
            for each in (chip, path):
                number = next(i for i in count() if not (self.ground / f'{i}_{each.name}').exists())
                each.rename(self.ground / f'{number}_{each.name}')

    def claimed(self) -> set[str]:
        """List the chips whose release is not recorded, past the code that is tested."""
        with suppress(sqlite3.OperationalError):
            if catalogue_files(self.on_board / 'spool'):
                with database(self.on_board / 'spool') as rows:
                    return {
                        chip_id
                        for (chip_id,) in rows.execute(
                            'SELECT id FROM chips WHERE state = ?', [ChipState.CLAIMED]
                        )
                    }
        return set()

    def recover(self, may_come_twice: set[str]) -> Status:
        """Go on after whatever has happened, to the end; AssertionError if anything is amiss."""
        self.feeder.steer(self._settings, is_contact=False)
        self.steps(1)
        self.writer.plan(0)
        status = self.writer.status()
        assert status.balance == 0, status
        assert status.in_work == 0, status
        in_outbox(self.on_board / 'outbox')
        cameras_in_outbox(self.on_board / 'outbox')
        self.feeder.steer(self._settings, is_contact=True)
        self.steps(2)
        self.bus()
        self.steps(1)
        status = self.writer.status()
        assert status.balance == 0, status
        assert status.waiting == status.in_outbox == status.objects_waiting == 0, status
        assert status.counts.get('objects_released', 0) == self._objects_down(), status
        down = self._down()
        assert {Path(each).stem for each, n in down.items() if n > 1} <= may_come_twice, down
        assert len(down) == status.counts.get('delivered', 0), status
        assert len(down) == status.counts.get('released', 0), status
        assert status.set_aside == 0
        return status

    def _down(self) -> Counter[str]:
        """Count how often each chip came down; AssertionError if one came without its camera."""
        down: Counter[str] = Counter()
        named, cameras = set(), set()
        for path in self.ground.glob('*.json'):
            described = json.loads(path.read_text(encoding='utf-8'))
            if 'kind' in described:
                cameras.add(described['id'])
            else:
                down[path.name.partition('_')[2]] += 1
                named.add((described['camera'] or {}).get('id'))
        assert named - {None} <= cameras, named - cameras
        return down

    def _objects_down(self) -> int:
        """Count the ships on the ground."""
        described = (json.loads(path.read_text()) for path in self.ground.glob('*.json'))
        return len({each['object'] for each in described if 'object' in each})

    def close(self) -> None:
        """Close both."""
        self.writer.close()
        self.feeder.close()
