# SPDX-License-Identifier: Apache-2.0
"""
The tables of a catalogue, and how those of version 1 become those of version 2.

The script must fit into the first page of the file, 2 kB: if a second one of it were damaged, no
chip could be read any more.
"""

from __future__ import annotations

import sqlite3

from obbhbb_ros.spool.books import Books
from obbhbb_ros.spool.books import number
from obbhbb_ros.spool.catalogue import CatalogueSchema
from obbhbb_ros.spool.chip_rows import COLUMNS_1
from obbhbb_ros.spool.chip_rows import INSERT
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.chip_rows import StoredChip

BOOKS_SCRIPT = f"""\
CREATE TABLE books (number INTEGER PRIMARY KEY, text TEXT NOT NULL);
CREATE TABLE books_copy (number INTEGER PRIMARY KEY, text TEXT NOT NULL);
INSERT INTO books VALUES (1, '{Books().text()}');
INSERT INTO books_copy VALUES (1, '{Books().text()}');"""
"""SQL script that creates the tables of empty books."""
# `data` comes last, so that SQLite reads the rest without it. `objects` remembers of which ships
# views were released, and in which turn.
_SCRIPT = f"""
CREATE TABLE chips (
    seq INTEGER PRIMARY KEY,
    id TEXT NOT NULL,
    state INTEGER NOT NULL,
    value REAL NOT NULL,
    class_id TEXT NOT NULL,
    bytes INTEGER NOT NULL,
    facts TEXT NOT NULL,
    digest TEXT NOT NULL,
    object INTEGER,
    worth REAL NOT NULL,
    k INTEGER NOT NULL,
    view INTEGER,
    data BLOB
);
CREATE INDEX chips_in_order ON chips (state, k, worth DESC, seq);
CREATE INDEX chips_by_object ON chips (object, worth DESC, seq)
    WHERE object IS NOT NULL AND state < 2;
CREATE TABLE objects (
    object INTEGER PRIMARY KEY, released INTEGER NOT NULL, turn INTEGER NOT NULL
);
CREATE INDEX objects_in_turn ON objects (turn);
{BOOKS_SCRIPT}
"""
# Chips to move at once: their space in the old table is used again for the new one.
_PIECE = 1000


def _from_version_1(rows: sqlite3.Cursor) -> None:
    """Bring a catalogue of version 1, which no process uses, to version 2."""
    books = _books_of_version_1(rows)
    for statement in (
        'DROP TRIGGER chip_moved',
        'DROP TRIGGER chip_out',
        'DROP INDEX chips_in_order',
        'DROP TABLE frames',
        'DROP TABLE notes',
        'DROP TABLE books',
        'DROP TABLE totals',
        'ALTER TABLE chips RENAME TO old_chips',
        *_SCRIPT.split(';')[:-1],
    ):
        rows.execute(statement)
    while _move_chips(rows, books):
        pass
    rows.execute('DROP TABLE old_chips')
    books.write(rows)


def _books_of_version_1(rows: sqlite3.Cursor) -> Books:
    """Collect the books from their tables; what the chips tell is counted again."""
    outbox = rows.execute("SELECT text FROM notes WHERE name = 'outbox'").fetchone()
    whole = "typeof({0}) = 'integer' AND {0} BETWEEN 0 AND 1 << 60"
    books = Books(last_seq=_greatest(rows, 'seq', 'sqlite_sequence', whole.format('seq')))
    books.last_seq = max(books.last_seq, _greatest(rows, 'seq', 'chips'))
    books.outbox = str(outbox[0]) if outbox else ''
    for name, count in rows.execute('SELECT name, count FROM books WHERE ' + whole.format('count')):
        books.count(str(name), count)
    # No writer is left that could store them.
    interrupted = 'SELECT ifnull(sum(chips), 0) FROM frames WHERE ' + whole.format('chips')
    books.count('refused.interrupted', number(rows, interrupted))
    return books


def _greatest(rows: sqlite3.Cursor, column: str, table: str, condition: str = 'TRUE') -> int:
    """Read the greatest number in a column, 0 if it has none."""
    return number(rows, f'SELECT ifnull(max({column}), 0) FROM {table} WHERE {condition}')


def _move_chips(rows: sqlite3.Cursor, books: Books) -> int:
    """Move some chips from the old table to the new one; return how many there were."""
    columns = ', '.join(COLUMNS_1)
    rows.execute(f'SELECT {columns}, data FROM old_chips ORDER BY seq LIMIT ?', (_PIECE,))
    old = rows.fetchall()
    moved = []
    for *fields, data in old:
        try:
            chip = StoredChip.of_version_1(*fields)
        except TypeError:
            # Damage has turned a text into something else.
            books.count('evicted.damaged', 1)
            continue
        chip = chip._replace(state=chip.state if chip.state in range(3) else ChipState.WAITING)
        books.put(chip.state, [chip.bytes])
        moved.append((*chip, data))
    rows.executemany(INSERT, moved)
    rows.executemany('DELETE FROM old_chips WHERE seq = ?', [(seq,) for seq, *_ in old])
    return len(old)


def count_rebuilt(rows: sqlite3.Cursor) -> None:
    """Count in the books that damage was made good."""
    books = Books.read(rows)
    books.count('restored', 1)
    books.write(rows)


SCHEMA = CatalogueSchema(2, _SCRIPT, _from_version_1, count_rebuilt)
