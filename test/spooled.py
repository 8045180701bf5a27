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
from hashlib import sha256
from pathlib import Path
from typing import Any

from obbhbb_ros.spool.catalogue import files
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.spool.release import Releaser
from obbhbb_ros.spool.release import ReleaseSettings
from obbhbb_ros.spool.spool import NewChip
from obbhbb_ros.spool.spool import Spool

FACTS = {
    'frame_id': 'camera',
    'roi': [10, 20, 30, 40],
    'image_size': [640, 480],
    'score': 0.5,
    'detection_ids': ['7'],
    'obb': [25.0, 40.0, 38.0, 12.0, 0.3],
    'codec': 'jpeg',
    'camera_matrix': None,
}


RELEASE = ReleaseSettings()


def new_chip(
    value: float = 0.5,
    size: int = 300,
    stamp: tuple[int, int] = (5, 0),
    class_id: str = 'ship',
    **facts: Any,
) -> NewChip:
    """Make a chip whose file tells its value."""
    data = f'{value}'.encode().ljust(size, b'.')
    return NewChip(value, class_id, stamp, FACTS | facts, data)


def store(spool: Spool, values: Sequence[float], size: int = 300, max_bytes: float = 0.0) -> bool:
    """Plan and store a frame."""
    chips = [new_chip(value, size) for value in values]
    return spool.store(spool.plan(len(values)), chips, {}, max_bytes)


class Clock:
    """Time that goes on when it is told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def releaser(
    folder: Path,
    on_trouble: Callable[[str], object],
    clock: Clock | None = None,
    settings: ReleaseSettings = RELEASE,
    contact: bool = True,
) -> Releaser:
    """Make a releaser from `spool` to `outbox` in a folder."""
    made = Releaser(
        Spool(folder / 'spool', on_trouble, 'releaser'),
        Outbox(folder / 'outbox'),
        settings,
        on_trouble,
        clock or Clock(),
    )
    made.contact = contact
    return made


def in_outbox(folder: Path) -> dict[str, dict[str, Any]]:
    """Read the JSON files of an outbox, by id; AssertionError if anything is amiss there."""
    visible = {path for path in folder.glob('*/*') if not path.name.startswith('.')}
    found = {}
    for path in sorted(visible):
        if path.suffix == '.json':
            described = json.loads(path.read_text(encoding='utf-8'))
            data = path.with_suffix('.jpg').read_bytes()
            assert path.stem == described['id']
            assert described['id'] not in found, 'it is there twice'
            assert described['bytes'] == len(data)
            assert described['sha256'] == sha256(data).hexdigest()
            found[path.stem] = described
    assert len(visible) == 2 * len(found), 'a chip without JSON'
    return found


def values_in_outbox(folder: Path) -> list[float]:
    """List the values of the chips in an outbox, the greatest first."""
    return sorted((each['value'] for each in in_outbox(folder).values()), reverse=True)


@contextmanager
def database(folder: Path) -> Iterator[sqlite3.Connection]:
    """Open the newest catalogue of a spool."""
    with closing(sqlite3.connect(files(folder)[-1])) as found, found:
        yield found
