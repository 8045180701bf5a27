# SPDX-License-Identifier: Apache-2.0
"""A small catalogue with one bit flipped, and what must be true of everything that follows."""

from __future__ import annotations

import json
import shutil
from abc import ABC
from abc import abstractmethod
from hashlib import sha256
from pathlib import Path
from typing import Any

from spooled import Clock
from spooled import feeder
from spooled import new_chip
from spooled import ship_report
from spooled import store

from obbhbb_ros.reports.ship_geojson import ship_geojson
from obbhbb_ros.reports.ship_list import read_ship_list
from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.catalogue import catalogue_files
from obbhbb_ros.spool.feeder import ReleaseSettings
from obbhbb_ros.spool.list_spool import ListSpool
from obbhbb_ros.spool.releaser import SpoolReleaser
from obbhbb_ros.spool.seals import is_sealed
from obbhbb_ros.spool.writer import SpoolWriter

SETTINGS = ReleaseSettings(removal=True)
NEW = (0.95, 0.05)


class Flips(ABC):
    """
    A spool, and its copies with a bit of a catalogue flipped.

    Parameters
    ----------
    folder : Path
        Where all of it is made.

    Attributes
    ----------
    bits : int
        Number of bits of the catalogue.
    """

    def __init__(self, folder: Path) -> None:
        self._whole, self._copy = folder / 'whole', folder / 'copy'
        troubles: list[str] = []
        self._make(troubles)
        assert troubles == []
        self.bits = 8 * self._catalogue(self._whole).stat().st_size

    def check(self, bit: int) -> str:
        """Flip a bit, let the nodes go on, and tell the outcome."""
        shutil.rmtree(self._copy, ignore_errors=True)
        shutil.copytree(self._whole, self._copy)
        with self._catalogue(self._copy).open('r+b') as stream:
            stream.seek(bit // 8)
            (byte,) = stream.read(1)
            stream.seek(bit // 8)
            stream.write(bytes([byte ^ 1 << bit % 8]))
        return self._outcome()

    @abstractmethod
    def _make(self, troubles: list[str]) -> None:
        """Make the spool."""

    @abstractmethod
    def _catalogue(self, folder: Path) -> Path:
        """Return the catalogue of the spool in a folder."""

    @abstractmethod
    def _outcome(self) -> str:
        """Go on with the damaged catalogue; AssertionError if anything is wrong."""


class ChipFlips(Flips):
    """Chips in all states."""

    def _make(self, troubles: list[str]) -> None:
        writer = SpoolWriter(self._whole / 'spool', troubles.append)
        releasing = feeder(self._whole, troubles.append, settings=SETTINGS)
        store(writer, [0.9, 0.8])
        releasing.step()
        releasing.step()
        releasing.close()
        chips = [new_chip(0.1 * i, 700 if i % 2 else 100) for i in range(1, 7)]
        writer.store(writer.plan(7), chips, {'encoder_failed': 1})
        claimer = SpoolReleaser(self._whole / 'spool', troubles.append)
        claimer.claim(2, 1e9, 1e9, 0)
        claimer.close()
        writer.close()
        self._known = {new_chip(0.1 * i, 700 if i % 2 else 100).data for i in range(1, 7)}
        self._known |= {new_chip(value).data for value in (0.9, 0.8, *NEW)}

    def _catalogue(self, folder: Path) -> Path:
        (path,) = catalogue_files(folder / 'spool')
        return path

    def _outcome(self) -> str:
        troubles: list[str] = []
        clock = Clock()
        writer = SpoolWriter(self._copy / 'spool', troubles.append)
        releasing = feeder(self._copy, troubles.append, clock, SETTINGS)
        try:
            stored = [store(writer, NEW[:1]), store(writer, NEW[1:])]
            for _ in range(6):
                releasing.step()
                clock.now += 100.0
            assert store(writer, NEW[1:]), troubles
            released = self._released()
            # Both nodes go on; what was in a catalogue that was set aside then is lost.
            is_lost = not stored[0] or any('set aside' in text for text in troubles)
            assert new_chip(NEW[0]).data in released or is_lost, troubles
            releasing.step()
            assert new_chip(NEW[1]).data in self._released(), troubles
            status = writer.status()
            assert status.balance == 0, (status, troubles)
            assert status.waiting == status.in_work == 0 or troubles, status
            assert min(status.counts.values(), default=0) >= 0, status
        finally:
            writer.close()
            releasing.close()
        if status.set_aside:
            return 'set aside'
        if status.counts.get('restored'):
            return 'books restored'
        damaged = status.counts.get('evicted.damaged', 0)
        assert troubles or not damaged, 'not a word of a damaged chip'
        return f'{damaged} damaged chips, {"reported" if troubles else "not a word"}'

    def _released(self) -> list[bytes]:
        """Read the outbox; AssertionError if a chip is not what was stored."""
        released = []
        for path in sorted((self._copy / 'outbox').glob('*/[!.]*.json')):
            content = path.read_bytes()
            assert is_sealed(content), path
            data = path.with_suffix('.jpg').read_bytes()
            described: dict[str, Any] = json.loads(content)
            assert data in self._known, path
            chip = new_chip(described['value'], len(data))
            assert chip.data == data, path
            assert described.items() >= dict(chip.facts).items(), path
            assert (described['id'], described['class_id']) == (path.stem, 'ship'), path
            released.append(data)
        return released


class ListFlips(Flips):
    """Ship lists in all states: four ships each in the outbox, on their way, and waiting."""

    _OLD, _NEW, _LAST = range(12), (20, 21), 22

    def _make(self, troubles: list[str]) -> None:
        lists = ListSpool(self._whole / 'spool', troubles.append)
        lists.add([*map(ship_report, self._OLD[:4])])
        releasing = feeder(self._whole, troubles.append, settings=SETTINGS)
        releasing.step()
        releasing.close()
        lists.add([*map(ship_report, self._OLD[4:8])])
        lists.claim(1e9)
        lists.add([*map(ship_report, self._OLD[8:])])
        lists.close()

    def _catalogue(self, folder: Path) -> Path:
        (path,) = (folder / 'spool' / 'lists').glob('*.sqlite3')
        return path

    def _outcome(self) -> str:
        troubles: list[str] = []
        clock = Clock()
        lists = ListSpool(self._copy / 'spool', troubles.append)
        releasing = feeder(self._copy, troubles.append, clock, SETTINGS)
        kept: list[int] = []
        try:
            for number in (*self._NEW, self._LAST):
                kept.append(number)
                # As `ship_tracker` does: report what cannot be stored, and keep it.
                try:
                    lists.add([*map(ship_report, kept)])
                    kept.clear()
                except SpoolError as error:
                    troubles.append(str(error))
                for _ in range(3):
                    releasing.step()
                    clock.now += 100.0
            released = self._released()
            assert kept == [], (kept, troubles)
            assert self._LAST in released, (released, troubles)
            missing = {*self._OLD, *self._NEW} - {*released}
            assert not missing or troubles, f'not a word of ships {missing}'
            status = lists.status()
            assert status.balance == 0, (status, troubles)
            assert status.ships_waiting == status.ships_claimed == 0, status
            assert min(status.counts.values(), default=0) >= 0, status
        finally:
            lists.close()
            releasing.close()
        said = 'reported' if troubles else 'not a word'
        return f'{len(missing)} ships lost, {status.set_aside} set aside, {said}'

    def _released(self) -> list[int]:
        """Read the lists of the outbox; AssertionError if a ship is not what was stored."""
        numbers = []
        for path in sorted((self._copy / 'outbox').glob('0/[!.]*.json')):
            content = path.read_bytes()
            assert is_sealed(content), path
            data = path.with_suffix('.geojson.gz').read_bytes()
            assert json.loads(content)['sha256'] == sha256(data).hexdigest(), path
            for ship in read_ship_list(data):
                numbers.append(int(ship.id.partition('-')[2]))
                (stored,) = read_ship_list(ship_geojson([ship_report(numbers[-1])]))
                assert ship == stored, (ship, stored)
        return numbers
