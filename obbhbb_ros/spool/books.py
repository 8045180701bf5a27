# SPDX-License-Identifier: Apache-2.0
"""
The books of a spool: the tables of its catalogue, and the rules by which they balance.

Every change is one transaction that is on disk when it ends: a frame is planned, its chips are
stored, a chip is claimed, released, delivered. So at every instant

    planned = delivered + waiting + evicted + refused + in work,

where `in work` are the chips of frames that a running process has not stored yet.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from obbhbb_ros.spool.catalogue import Catalogue
from obbhbb_ros.spool.chip_rows import ChipState

# Chips to evict, and free pages to give back to the disk, in one transaction; a lowered limit is
# reached in several.
_MAX_EVICTED = _MAX_PAGES_GIVEN_BACK = 1000
# The file may be larger than its limit by this factor.
_SLACK = 1.1
_VERSION = 1
# Tables, and triggers that count the chips that move or leave.
_SCHEMA = """
CREATE TABLE chips (
    seq INTEGER PRIMARY KEY AUTOINCREMENT,
    id TEXT NOT NULL UNIQUE,
    state INTEGER NOT NULL,
    value REAL NOT NULL,
    class_id TEXT NOT NULL,
    bytes INTEGER NOT NULL,
    facts TEXT NOT NULL,
    data BLOB
);
CREATE INDEX chips_in_order ON chips (state, value DESC, seq);
CREATE TABLE frames (
    number INTEGER PRIMARY KEY AUTOINCREMENT, writer INTEGER NOT NULL, chips INTEGER NOT NULL
);
CREATE TABLE notes (name TEXT PRIMARY KEY, text TEXT NOT NULL);
CREATE TABLE books (name TEXT PRIMARY KEY, count INTEGER NOT NULL);
CREATE TABLE totals (state INTEGER PRIMARY KEY, chips INTEGER NOT NULL, bytes INTEGER NOT NULL);
INSERT INTO totals VALUES (0, 0, 0), (1, 0, 0), (2, 0, 0);
CREATE TRIGGER chip_moved AFTER UPDATE OF state ON chips BEGIN
    UPDATE totals SET chips = chips - 1, bytes = bytes - OLD.bytes WHERE state = OLD.state;
    UPDATE totals SET chips = chips + 1, bytes = bytes + NEW.bytes WHERE state = NEW.state;
END;
CREATE TRIGGER chip_out AFTER DELETE ON chips BEGIN
    UPDATE totals SET chips = chips - 1, bytes = bytes - OLD.bytes WHERE state = OLD.state;
END;
"""


@dataclass(frozen=True)
class Status:
    """
    The books of a spool at one instant.

    Attributes
    ----------
    waiting, waiting_bytes : int
        Chips in the spool, those on their way to the outbox included, and bytes of their files.
    in_outbox : int
        Chips in the outbox that the bus has not removed yet.
    in_work : int
        Chips of frames that are being cut.
    file_bytes : int
        Size of the catalogue in use.
    set_aside : int
        Damaged catalogues beside it.
    least_value : float or None
        Least value of the chips that wait, None if there are none; a full spool evicts these first.
    counts : mapping of str to int
        `planned`, `released`, `delivered`, `delivered_bytes`, and `evicted.<reason>`,
        `refused.<reason>`.
    """

    waiting: int
    waiting_bytes: int
    in_outbox: int
    in_work: int
    file_bytes: int
    set_aside: int
    least_value: float | None
    counts: Mapping[str, int]

    def total(self, kind: str) -> int:
        """Sum up `evicted` or `refused` over all reasons."""
        return sum(n for name, n in self.counts.items() if name.startswith(f'{kind}.'))

    @property
    def balance(self) -> int:
        """Number of chips planned that are unaccounted for; 0 if the books balance."""
        planned, delivered = (self.counts.get(name, 0) for name in ('planned', 'delivered'))
        gone = delivered + self.total('evicted') + self.total('refused')
        return planned - gone - self.waiting - self.in_outbox - self.in_work


class SpoolAccess:
    """
    What every user of a spool can do; the base of writer, releaser and console.

    The spool is opened by the first call that needs it. Only one thread at a time may use it.
    Methods raise `SpoolError` if the spool cannot be used now, because the disk is full for
    example; the next call tries again.

    Parameters
    ----------
    folder : Path
        Folder of the spool; created if it is missing.
    on_trouble : callable
        Called with a text about anything that an operator should know and that raises no error.
    """

    # Seconds to wait for another process.
    _patience = 5.0

    def __init__(self, folder: Path, on_trouble: Callable[[str], object]) -> None:
        self._folder, self._on_trouble = Path(folder), on_trouble
        self._catalogue = Catalogue(
            self._folder, _SCHEMA, _VERSION, on_trouble, self._on_open, self._patience
        )

    def status(self) -> Status:
        """Read the books."""
        with self._catalogue.transaction() as rows:
            totals = 'FROM totals WHERE state'
            return Status(
                waiting=number(rows, f'SELECT sum(chips) {totals} != ?', ChipState.RELEASED),
                waiting_bytes=number(rows, f'SELECT sum(bytes) {totals} != ?', ChipState.RELEASED),
                in_outbox=number(rows, f'SELECT chips {totals} = ?', ChipState.RELEASED),
                in_work=number(rows, 'SELECT ifnull(sum(chips), 0) FROM frames'),
                file_bytes=number(rows, 'PRAGMA page_count') * number(rows, 'PRAGMA page_size'),
                set_aside=self._catalogue.set_aside,
                least_value=rows.execute(
                    'SELECT min(value) FROM chips WHERE state = ?', (ChipState.WAITING,)
                ).fetchone()[0],
                counts=dict(rows.execute('SELECT name, count FROM books').fetchall()),
            )

    def close(self) -> None:
        """Close the catalogue and release the locks; the next call opens it again."""
        self._catalogue.close()

    def _on_open(self, rows: sqlite3.Cursor) -> None:
        """Prepare a catalogue that has just been opened."""


def number(rows: sqlite3.Cursor, query: str, *values: object) -> int:
    """Read one number."""
    return int(rows.execute(query, values).fetchone()[0])


def book(rows: sqlite3.Cursor, name: str, count: int) -> None:
    """Add to a count."""
    if count:
        rows.execute(
            'INSERT INTO books VALUES (?, ?) ON CONFLICT (name) DO UPDATE SET count = count + ?',
            (name, count, count),
        )


def deliver(rows: sqlite3.Cursor, ids: Iterable[str]) -> None:
    """Count chips as delivered and delete them."""
    delivered = 0
    for chip_id in ids:
        rows.execute('DELETE FROM chips WHERE id = ? RETURNING bytes', (chip_id,))
        for (size,) in rows.fetchall():
            delivered += 1
            book(rows, 'delivered_bytes', size)
    book(rows, 'delivered', delivered)


def evict(rows: sqlite3.Cursor, max_bytes: float) -> bool:
    """
    Delete the least valuable chips, the oldest of equals first, to make room for the rest.

    Returns False if there is still no room when all waiting chips are gone.
    """
    evicted, max_pages, is_left = 0, max_bytes / number(rows, 'PRAGMA page_size'), True
    while is_left and evicted < _MAX_EVICTED and _used_pages(rows) > max_pages:
        # Two queries, both answered by the one index.
        rows.execute(
            'DELETE FROM chips WHERE seq = (SELECT seq FROM chips WHERE state = ?1 AND value = '
            '(SELECT min(value) FROM chips WHERE state = ?1) ORDER BY seq LIMIT 1)',
            (ChipState.WAITING,),
        )
        is_left = bool(rows.rowcount)
        evicted += rows.rowcount
    book(rows, 'evicted.max_bytes', evicted)
    # Free pages are used again; only those far beyond a lowered limit go back to the disk.
    excess = number(rows, 'PRAGMA page_count') - int(_SLACK * max_pages)
    for _ in range(min(excess, number(rows, 'PRAGMA freelist_count'), _MAX_PAGES_GIVEN_BACK)):
        # One by one: Python takes one step of a statement that returns no rows.
        rows.execute('PRAGMA incremental_vacuum(1)')
    return is_left


def _used_pages(rows: sqlite3.Cursor) -> int:
    """Count the pages of a catalogue that are not free."""
    return number(rows, 'PRAGMA page_count') - number(rows, 'PRAGMA freelist_count')
