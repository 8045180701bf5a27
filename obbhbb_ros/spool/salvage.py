# SPDX-License-Identifier: Apache-2.0
"""Chips and ship lists of a damaged catalogue: all but those in damaged places."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from collections.abc import Sequence
from contextlib import closing
from contextlib import suppress
from pathlib import Path

from obbhbb_ros.damaged_sqlite import Gap
from obbhbb_ros.damaged_sqlite import lossy_text
from obbhbb_ros.damaged_sqlite import rows_around_damage
from obbhbb_ros.reports.ship_list import LIST_KIND
from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.chip_rows import COLUMNS_1
from obbhbb_ros.spool.chip_rows import StoredChip
from obbhbb_ros.spool.chip_rows import describe_intact
from obbhbb_ros.spool.list_rows import ShipListFile
from obbhbb_ros.spool.list_rows import StoredList

_COLUMNS = (*StoredChip._fields, 'data')
# Catalogues of version 1 have no digests.
_COLUMNS_1 = (*COLUMNS_1, 'data')


def intact_chips(path: Path) -> Iterator[tuple[StoredChip, bytes]]:
    """
    Read the intact chips of a catalogue, damaged or not.

    Parameters
    ----------
    path : Path
        The SQLite file.

    Yields
    ------
    (StoredChip, bytes)
        Chips whose file is the one that was stored.

    Raises
    ------
    SpoolError
        If it cannot be opened, is not a catalogue, or no chip of it can be read.
    """
    gaps: list[Gap] = []
    is_empty = True
    with closing(_open(path)) as database:
        columns = _columns_of(path, database, 'chips', (_COLUMNS, _COLUMNS_1))
        for *fields, data in rows_around_damage(database, 'chips', columns, gaps.append):
            is_empty = False
            chip = StoredChip(*fields)
            if columns is _COLUMNS_1:
                with suppress(TypeError):
                    chip = StoredChip.of_version_1(*fields)
            if describe_intact(chip, data, fade=None):
                yield chip, data
    if gaps and is_empty:
        raise SpoolError(f'{path}: no chip can be read: {gaps[0].error}')


def holds_lists(path: Path) -> bool:
    """Tell by its name whether a catalogue holds ship lists."""
    return path.name.startswith(f'{LIST_KIND}_')


def intact_lists(path: Path) -> Iterator[ShipListFile]:
    """
    Read the intact ship lists of a catalogue of lists, damaged or not.

    Parameters
    ----------
    path : Path
        The SQLite file.

    Yields
    ------
    ShipListFile
        Lists that were not in the outbox, each as it was stored.

    Raises
    ------
    SpoolError
        If it cannot be opened, is not such a catalogue, or no list of it can be read.
    """
    gaps: list[Gap] = []
    is_empty, tag = True, path.stem.rpartition('_')[2]
    with closing(_open(path)) as database:
        columns = _columns_of(path, database, 'lists', (StoredList._fields,))
        for fields in rows_around_damage(database, 'lists', columns, gaps.append):
            is_empty, row = False, StoredList(*fields)
            if row.read() is not None and row.data is not None:
                yield ShipListFile(f'{LIST_KIND}_{tag}_{row.seq}', row.ships, row.data)
    if gaps and is_empty:
        raise SpoolError(f'{path}: no ship list can be read: {gaps[0].error}')


def _open(path: Path) -> sqlite3.Connection:
    """Open a file, damaged or not, for reading; SpoolError if it is not a catalogue."""
    try:
        database = sqlite3.connect(f'{path.resolve().as_uri()}?mode=ro', uri=True)
        database.text_factory = lossy_text
        # With it, SQLite reads a file that has lost its end.
        database.execute('PRAGMA writable_schema = ON')
        database.execute('PRAGMA schema_version')
    except sqlite3.OperationalError as error:
        raise SpoolError(
            f'{path}: {error}; it must be readable, and if its disk is read-only, copy all files '
            'of the same name to another'
        ) from error
    except (sqlite3.DatabaseError, UnicodeDecodeError):
        # Damage is found below, and row by row.
        pass
    return database


def _columns_of(
    path: Path, database: sqlite3.Connection, table: str, versions: Sequence[tuple[str, ...]]
) -> tuple[str, ...]:
    """Return the columns of its table, the first ones it has; SpoolError if it is no catalogue."""
    for columns in versions:
        try:
            database.execute(f'SELECT {", ".join(columns)} FROM {table} LIMIT 0')
            return columns
        except (sqlite3.DatabaseError, UnicodeDecodeError) as failure:
            # A message of SQLite with damaged names in it may be no text.
            error = failure
    raise SpoolError(
        f'{path} is no catalogue of a spool, or its start is damaged: {error}'
    ) from error
