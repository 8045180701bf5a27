# SPDX-License-Identifier: Apache-2.0
"""A small catalogue with one bit flipped, and what must be true of everything that follows."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from spooled import Clock
from spooled import feeder
from spooled import new_chip
from spooled import store

from obbhbb_ros.spool.catalogue import catalogue_files
from obbhbb_ros.spool.feeder import ReleaseSettings
from obbhbb_ros.spool.releaser import SpoolReleaser
from obbhbb_ros.spool.seals import is_sealed
from obbhbb_ros.spool.writer import SpoolWriter

SETTINGS = ReleaseSettings(removal=True)
NEW = (0.95, 0.05)


class Flips:
    """
    A spool with chips in all states, and its copies with a bit flipped.

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
        assert troubles == []
        self._known = {new_chip(0.1 * i, 700 if i % 2 else 100).data for i in range(1, 7)}
        self._known |= {new_chip(value).data for value in (0.9, 0.8, *NEW)}
        (path,) = catalogue_files(self._whole / 'spool')
        self.bits = 8 * path.stat().st_size

    def check(self, bit: int) -> str:
        """Flip a bit, let writer and releaser go on, and tell the outcome."""
        shutil.rmtree(self._copy, ignore_errors=True)
        shutil.copytree(self._whole, self._copy)
        (path,) = catalogue_files(self._copy / 'spool')
        with path.open('r+b') as stream:
            stream.seek(bit // 8)
            (byte,) = stream.read(1)
            stream.seek(bit // 8)
            stream.write(bytes([byte ^ 1 << bit % 8]))
        return self._outcome()

    def _outcome(self) -> str:
        """Go on with the damaged catalogue; AssertionError if anything is wrong."""
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
