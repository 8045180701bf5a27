# SPDX-License-Identifier: Apache-2.0
"""Chips for a spool, and a look into its catalogue past the code that is tested."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Sequence
from contextlib import closing
from contextlib import contextmanager
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from obbhbb_ros.reports.ship_report import ShipReport
from obbhbb_ros.spool.catalogue import catalogue_files
from obbhbb_ros.spool.chip_rows import NewChip
from obbhbb_ros.spool.console import SpoolConsole
from obbhbb_ros.spool.feeder import OutboxFeeder
from obbhbb_ros.spool.feeder import ReleaseSettings
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.spool.releaser import SpoolReleaser
from obbhbb_ros.spool.seals import is_sealed
from obbhbb_ros.spool.writer import SpoolWriter

FACTS = {
    'frame_id': 'camera',
    'roi': [10, 20, 30, 40],
    'image_size': [640, 480],
    'score': 0.5,
    'detection_ids': ['7'],
    'obb': [25.0, 40.0, 38.0, 12.0, 0.3],
    'codec': 'jpeg',
    'camera': None,
}

CAMERA = {
    'size': [4096, 3072],
    'k': [4000.123456789, 0.0, 2048.0, 0.0, 4000.0, 1536.0, 0.0, 0.0, 1.0],
    'model': 'plumb_bob',
    'd': [-0.1, 0.01, 0.001, -0.001, 0.0],
    'roi': [0, 0, 4096, 3072],
    'binning': [1, 1],
}
RELEASE = ReleaseSettings()


def new_chip(
    value: float = 0.5,
    size: int = 300,
    stamp: tuple[int, int] = (5, 0),
    class_id: str = 'ship',
    object_id: str = '',
    **facts: Any,
) -> NewChip:
    """Make a chip whose file tells its value."""
    data = f'{value}'.encode().ljust(size, b'.')
    return NewChip(value, class_id, stamp, FACTS | facts, data, object_id)


def store(
    writer: SpoolWriter, values: Sequence[float], size: int = 300, max_bytes: float = 0.0
) -> bool:
    """Plan and store a frame."""
    chips = [new_chip(value, size) for value in values]
    return writer.store(writer.plan(len(values)), chips, {}, max_bytes)


class SpoolUsers:
    """A writer, a releaser and a console of one spool."""

    def __init__(self, folder: Path, on_trouble: Callable[[str], object]) -> None:
        self.folder = folder
        self.writer = SpoolWriter(folder, on_trouble)
        self.releaser = SpoolReleaser(folder, on_trouble)
        self.console = SpoolConsole(folder, on_trouble)

    def close(self) -> None:
        """Close all of them."""
        for user in (self.writer, self.releaser, self.console):
            user.close()


class Clock:
    """Time that goes on when it is told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def feeder(
    folder: Path,
    on_trouble: Callable[[str], object],
    clock: Clock | None = None,
    settings: ReleaseSettings = RELEASE,
    is_contact: bool = True,
) -> OutboxFeeder:
    """Make a feeder from `spool` to `outbox` in a folder."""
    made = OutboxFeeder(
        SpoolReleaser(folder / 'spool', on_trouble),
        Outbox(folder / 'outbox'),
        settings,
        on_trouble,
        clock or Clock(),
    )
    made.steer(settings, is_contact)
    return made


def in_outbox(folder: Path) -> dict[str, dict[str, Any]]:
    """Read the JSON files of chips in an outbox, by id; AssertionError if anything is amiss."""
    return _pairs_in_outbox(folder, None, '.jpg')


def cameras_in_outbox(folder: Path) -> dict[str, dict[str, Any]]:
    """Read the JSON files of cameras in an outbox, likewise."""
    return _pairs_in_outbox(folder, 'camera', '.camera')


def lists_in_outbox(folder: Path) -> dict[str, dict[str, Any]]:
    """Read the JSON files of ship lists in an outbox, likewise."""
    return _pairs_in_outbox(folder, 'ships', '.geojson.gz')


def ship_report(number: int, **changes: Any) -> ShipReport:
    """Make up a ship of a list."""
    made = ShipReport(
        id=f'09af31bc-{number}',
        latitude=36.0 + 0.001 * number,
        longitude=-5.4,
        course=number % 180,
        course_ambiguous=True,
        length_m=30.0 + number,
        width_m=9.0,
        class_id='ship',
        score=0.01 * (number % 100),
        first=number * 10**9,
        last=number * 10**9,
    )
    return replace(made, **changes)


def _pairs_in_outbox(folder: Path, kind: str | None, suffix: str) -> dict[str, dict[str, Any]]:
    """Read the JSON files of a kind, by id."""
    visible = {path for path in folder.glob('*/*') if not path.name.startswith('.')}
    descriptions = {}
    for path in sorted(visible):
        if path.suffix == '.json':
            assert is_sealed(path.read_bytes())
            described = json.loads(path.read_text(encoding='utf-8'))
            del described['digest']
            if described.get('kind') != kind:
                continue
            data = path.with_suffix(suffix).read_bytes()
            assert path.stem == described['id']
            assert described['id'] not in descriptions, 'it is there twice'
            assert described['bytes'] == len(data)
            assert described['sha256'] == sha256(data).hexdigest()
            descriptions[path.stem] = described
    names = {path.name.partition('.')[0] for path in visible if path.name.endswith(suffix)}
    assert names == set(descriptions), 'a file without JSON'
    return descriptions


def values_in_outbox(folder: Path) -> list[float]:
    """List the values of the chips in an outbox, the greatest first."""
    return sorted((chip['value'] for chip in in_outbox(folder).values()), reverse=True)


@contextmanager
def database(folder: Path) -> Iterator[sqlite3.Connection]:
    """Open the newest catalogue of a spool."""
    with closing(sqlite3.connect(catalogue_files(folder)[-1])) as catalogue, catalogue:
        yield catalogue
