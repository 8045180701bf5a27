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
from spooled import lists_in_outbox
from spooled import new_chip
from spooled import ship_report

from obbhbb_ros.reports.ship_list import read_ship_list
from obbhbb_ros.reports.ship_report import ShipReport
from obbhbb_ros.spool.books import Status
from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.catalogue import catalogue_files
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.feeder import ReleaseSettings
from obbhbb_ros.spool.list_spool import ListSpool
from obbhbb_ros.spool.writer import SpoolWriter

PLANNED = 8
_SUFFIXES = {'camera': '.camera', 'ships': '.geojson.gz', None: '.jpg'}


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
        self.lists = ListSpool(self.on_board / 'spool', self.troubles.append)
        self._unlisted: list[ShipReport] = []
        self._may_come_twice: set[str] = set()
        self._settings = ReleaseSettings(removal=removal, is_compact=True)
        self.feeder = feeder(self.on_board, self.troubles.append, self.clock, self._settings)

    def play(self) -> None:
        """
        Plan, store, release, take: frames of 5 and 3 chips, one of which is refused.

        And lists of 2 and 1 ships that wait together, and one of 2 ships.
        """
        self.list_ships(1, 2)
        self.list_ships(2)
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
        self.list_ships(3, 4)
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

    def list_ships(self, *numbers: int) -> None:
        """List ships, and those that could not be listed before, as the node does."""
        self._unlisted += map(ship_report, numbers)
        if not self._unlisted:
            return
        try:
            self.lists.add(self._unlisted)
            self._unlisted = []
        except SpoolError as error:
            self.troubles.append(str(error))

    def steps(self, number: int) -> None:
        """Release, and let time go by in which the bus is looked after."""
        for _ in range(number):
            self.feeder.step()
            self.clock.now += 100.0

    def bus(self) -> None:
        """Take what is complete, also what is not recorded as released, which may come again."""
        complete = sorted((self.on_board / 'outbox').glob('*/[!.]*.json'))
        if complete:
            self._may_come_twice |= self.claimed() & {path.stem for path in complete}
        for path in complete:
            described = json.loads(path.read_text(encoding='utf-8'))
            chip = path.with_suffix(_SUFFIXES[described.get('kind')])
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
        self.list_ships()
        status = self.writer.status()
        assert status.balance == 0, status
        assert status.in_work == 0, status
        in_outbox(self.on_board / 'outbox')
        cameras_in_outbox(self.on_board / 'outbox')
        lists_in_outbox(self.on_board / 'outbox')
        self.feeder.steer(self._settings, is_contact=True)
        self.steps(3)
        self.bus()
        self.steps(1)
        self._check_lists()
        status = self.writer.status()
        assert status.balance == 0, status
        assert status.waiting == status.in_outbox == status.objects_waiting == 0, status
        assert status.counts.get('objects_released', 0) == self._objects_down(), status
        down = self._down()
        twice = {Path(name).stem for name, number in down.items() if number > 1}
        assert twice <= may_come_twice | self._may_come_twice, down
        assert len(down) == status.counts.get('delivered', 0), status
        assert len(down) == status.counts.get('released', 0), status
        assert status.set_aside == 0
        return status

    def _check_lists(self) -> None:
        """Hold the books of the lists against the ground."""
        if not self.lists.exists:
            return
        status = self.lists.status()
        assert status.balance == 0, status
        assert status.ships_waiting == status.ships_claimed == status.in_outbox == 0, status
        counts = status.counts
        down: dict[str, int] = {}
        for path in self.ground.glob('*.geojson.gz'):
            name = path.name.partition('_')[2]
            down[name] = sum(ship.views for ship in read_ship_list(path.read_bytes()))
        assert len(down) == counts.get('released', 0) == counts.get('delivered', 0), status
        # Each ship is listed with one view.
        assert sum(down.values()) == counts.get('ships_added', 0), status

    def _down(self) -> Counter[str]:
        """Count how often each chip came down; AssertionError if one came without its camera."""
        down: Counter[str] = Counter()
        named, cameras = set(), set()
        for path in self.ground.glob('*.json'):
            described = json.loads(path.read_text(encoding='utf-8'))
            if described.get('kind') == 'camera':
                cameras.add(described['id'])
            elif 'kind' not in described:
                down[path.name.partition('_')[2]] += 1
                named.add((described['camera'] or {}).get('id'))
        assert named - {None} <= cameras, named - cameras
        return down

    def _objects_down(self) -> int:
        """Count the ships on the ground."""
        described = (json.loads(path.read_text()) for path in self.ground.glob('*.json'))
        return len({each['object'] for each in described if 'object' in each})

    def close(self) -> None:
        """Close all of them."""
        self.writer.close()
        self.lists.close()
        self.feeder.close()
