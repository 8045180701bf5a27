# SPDX-License-Identifier: Apache-2.0
"""Rows of damaged SQLite files: everything that is not in a damaged place can still be read."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from dataclasses import field
from typing import Any
from typing import NamedTuple

# Behind a damaged place keys are tried one by one, then in steps of this share of the way so far:
# 10,000 tries reach any key.
_STEP = 1 / 256
# In a whole table, besides one for each of its rows.
_MAX_TRIES = 100_000
_MAX_KEY = 2**63 - 1


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
    # Behind a row with a wrong key there may be rows that are reached from the end alone.
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
    tries: int = 0

    def up_from(self, place: int) -> Iterator[tuple[Any, ...]]:
        """Read rows from a key on, past damaged places."""
        row: tuple[Any, ...] | None
        while place <= _MAX_KEY:
            first = place
            try:
                for row in self._rows_from(first, -1):
                    self._check_order(first, row)
                    place = row[0] + 1
                    yield self._new(row)
                return
            except sqlite3.Error as error:
                self.is_damaged, failure = True, error
            # Python reads ahead: the row before the damage was not seen.
            row = self._next_row(place)
            if row is None:
                self.gap = self.gap or (place, failure)
                return
            place = row[0] + 1
            yield self._new(row)

    def start_of_tail(self) -> int | None:
        """Find the first unread key that can be reached from the end of the table."""
        key = self.columns[0]
        tail: int | None = None
        with suppress(sqlite3.Error):
            for (number,) in self.database.execute(
                f'SELECT {key} FROM {self.table} ORDER BY {key} DESC'
            ):
                if number in self.seen or (tail is not None and number >= tail):
                    break
                tail = number
        return tail

    def close_gap(self, last: int | None) -> None:
        """Report the gap that ends with a key, if there is one."""
        if self.gap is not None:
            first, error = self.gap
            self.gap = None
            self.on_gap(Gap(first, last, error))

    def _new(self, row: tuple[Any, ...]) -> tuple[Any, ...]:
        """Write down that a row is read, and return it."""
        self.seen.add(row[0])
        self.close_gap(row[0] - 1)
        return row

    def _rows_from(self, place: int, limit: int) -> sqlite3.Cursor:
        """Ask for the rows from a key on."""
        key = self.columns[0]
        return self.database.execute(
            f'SELECT {", ".join(self.columns)} FROM {self.table} WHERE {key} >= ? '
            f'ORDER BY {key} LIMIT ?',
            (place, limit),
        )

    def _check_order(self, place: int, row: tuple[Any, ...]) -> None:
        """Refuse a row that should not come now: damage can give a row any key."""
        if row[0] < place or row[0] in self.seen:
            raise sqlite3.DatabaseError('its rows are not in order')

    def _next_row(self, place: int) -> tuple[Any, ...] | None:
        """Find the first row that can be read, from a key on; None if there is none."""
        failed, reached, row = place - 1, place, None
        while reached <= _MAX_KEY and self.tries < _MAX_TRIES + len(self.seen):
            try:
                row = self._try(reached)
                break
            except sqlite3.Error as error:
                self.gap = self.gap or (reached, error)
                failed, reached = reached, reached + 1 + int((reached - place) * _STEP)
        while reached - failed > 1 and reached <= _MAX_KEY:
            middle = (failed + reached) // 2
            try:
                row, reached = self._try(middle), middle
            except sqlite3.Error:
                failed = middle
        return row

    def _try(self, place: int) -> tuple[Any, ...] | None:
        """Read the first row from a key on; None if there is none."""
        self.tries += 1
        row: tuple[Any, ...] | None = self._rows_from(place, 1).fetchone()
        if row is not None:
            self._check_order(place, row)
        return row
