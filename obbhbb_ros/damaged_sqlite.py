# SPDX-License-Identifier: Apache-2.0
"""Rows of damaged SQLite files: everything that is not in a damaged place can still be read."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field
from typing import Any
from typing import NamedTuple

# Keys to try, one by one, behind a damaged place. One damaged page hides fewer rows than this.
_MAX_SKIPPED = 100_000


class Gap(NamedTuple):
    """Keys of rows that cannot be read, both included (`last` is None: to the end), and why."""

    first: int
    last: int | None
    error: sqlite3.Error


def lossy_text(content: bytes) -> str:
    """Decode text, even if it is damaged; a `text_factory` of SQLite connections."""
    return content.decode(errors='replace')


def rows_around_damage(
    database: sqlite3.Connection,
    table: str,
    columns: Sequence[str],
    on_gap: Callable[[Gap], object],
) -> Iterator[tuple[Any, ...]]:
    """
    Read a table in the order of its key, and continue behind each damaged place.

    Parameters
    ----------
    database : sqlite3.Connection
        The file, with `PRAGMA writable_schema = ON` if its end may be missing.
    table : str
        Name of the table.
    columns : sequence of str
        Columns to read; the first one is the integer primary key, 1 or more.
    on_gap : callable
        Called with each `Gap` as soon as its last key is known.

    Yields
    ------
    tuple
        The columns of one row, each row once.
    """
    walk = _Walk(database, table, columns, on_gap)
    yield from walk.up_from(1)
    if walk.is_damaged and (tail := walk.start_of_tail()):
        yield from walk.up_from(tail)
    walk.close_gap(None)


@dataclass
class _Walk:
    """A walk through a damaged table: what was read, and the gap that it is in."""

    database: sqlite3.Connection
    table: str
    columns: Sequence[str]
    on_gap: Callable[[Gap], object]
    seen: set[int] = field(default_factory=set)
    gap: tuple[int, sqlite3.Error] | None = None
    is_damaged: bool = False

    def up_from(self, place: int) -> Iterator[tuple[Any, ...]]:
        """Read rows from a key on, past damaged places; stop where too many keys fail in a row."""
        key, skipped, limit = self.columns[0], 0, -1
        query = (
            f'SELECT {", ".join(self.columns)} FROM {self.table} WHERE {key} >= ? '
            f'ORDER BY {key} LIMIT ?'
        )
        while skipped < _MAX_SKIPPED:
            start, is_end = place, True
            try:
                for row in self.database.execute(query, (start, limit)):
                    # Never go backwards: damage can give a row any key.
                    place, skipped, is_end = max(place, start + 1, row[0] + 1), 0, False
                    if row[0] >= start and row[0] not in self.seen:
                        self.seen.add(row[0])
                        self.close_gap(row[0] - 1)
                        yield row
                if is_end or limit < 0:
                    return
                limit = -1
            except sqlite3.Error as error:
                self.is_damaged = True
                if limit > 0:
                    self.gap = self.gap or (place, error)
                    place, skipped = place + 1, skipped + 1
                # One by one now: Python reads ahead, and the row before the damage was not seen.
                limit = 1

    def start_of_tail(self) -> int | None:
        """Find the first unread key that can be reached from the end of the table."""
        key, place, tail, skipped = self.columns[0], 2**63 - 1, None, 0
        query = f'SELECT {key} FROM {self.table} WHERE {key} <= ? ORDER BY {key} DESC'
        while skipped < _MAX_SKIPPED:
            try:
                for (number,) in self.database.execute(query, (place,)):
                    if number in self.seen:
                        return tail
                    tail, place, skipped = number, min(place, number - 1), 0
                return tail
            except sqlite3.Error:
                if tail is None:
                    return None
                place, skipped = place - 1, skipped + 1
        return tail

    def close_gap(self, last: int | None) -> None:
        """Report the gap that ends with a key, if there is one."""
        if self.gap is not None:
            first, error = self.gap
            self.gap = None
            self.on_gap(Gap(first, last, error))
