# SPDX-License-Identifier: Apache-2.0
"""Rows of damaged SQLite files: each that is not in a damaged place, once, in order."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from obbhbb_ros.damaged_sqlite import lossy_text
from obbhbb_ros.damaged_sqlite import rows_around_damage

PAGE = 4096
ROWS = [(key, f'row {key:06}'.encode() + bytes(300)) for key in range(1, 2001)]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write(tmp_path / 'a.sqlite3', ROWS)


def write(path: Path, rows: list[tuple[int, bytes]]) -> Path:
    """Make a file with some rows."""
    with closing(sqlite3.connect(path)) as database, database:
        database.execute('CREATE TABLE rows (key INTEGER PRIMARY KEY, data BLOB)')
        database.executemany('INSERT INTO rows VALUES (?, ?)', rows)
    return path


def damage(path: Path, row: int) -> None:
    """Overwrite the page with a row."""
    content = bytearray(path.read_bytes())
    start = content.index(f'row {row:06}'.encode()) // PAGE * PAGE
    content[start : start + PAGE] = b'\xff' * PAGE
    path.write_bytes(content)


def read(path: Path) -> tuple[list[tuple[int, bytes]], list[range]]:
    """Read the rows, and the keys that are lost."""
    gaps = []
    with closing(sqlite3.connect(path)) as database:
        database.text_factory = lossy_text
        database.execute('PRAGMA writable_schema = ON')
        rows = list(rows_around_damage(database, 'rows', ('key', 'data'), gaps.append))
    assert all(isinstance(gap.error, sqlite3.DatabaseError) for gap in gaps)
    end = max(key for key, _ in ROWS)
    return rows, [range(gap.first, (gap.last or end) + 1) for gap in gaps]


def test_all_rows_of_an_intact_file_are_read(path: Path) -> None:
    assert read(path) == (ROWS, [])


@pytest.mark.parametrize('damaged', [(1000,), (500, 1500), (1, 1000, 2000), (1, 2000)], ids=str)
def test_only_rows_on_damaged_pages_are_lost(path: Path, damaged: tuple[int, ...]) -> None:
    for row in damaged:
        damage(path, row)
    rows, gaps = read(path)
    assert len(gaps) == len(damaged)
    assert all(row in gap and len(gap) < 20 for row, gap in zip(damaged, gaps, strict=True))
    assert rows == [row for row in ROWS if not any(row[0] in gap for gap in gaps)]


def test_a_row_with_damage_beyond_its_first_page_is_lost_alone(tmp_path: Path) -> None:
    long = [
        (key, f'row {key:06}'.encode() + b'.' * 9000 + b'end%06d' % key) for key in range(1, 51)
    ]
    path = write(tmp_path / 'long.sqlite3', long)
    content = bytearray(path.read_bytes())
    # The number of the next page, at the start of a page that continues a row.
    start = (content.index(b'end000030') // PAGE - 1) * PAGE
    content[start : start + 4] = b'\xff' * 4
    path.write_bytes(content)
    rows, gaps = read(path)
    assert gaps == [range(30, 31)]
    assert rows == [row for row in long if row[0] != 30]


def test_a_file_without_its_end_is_read_up_to_there(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2 // PAGE * PAGE])
    rows, gaps = read(path)
    assert rows == ROWS[: len(rows)]
    assert 800 < len(rows) < 1100
    assert gaps == [range(len(rows) + 1, 2001)]


def test_rows_behind_a_large_gap_are_read_from_the_end(tmp_path: Path) -> None:
    far = [(key + 10**9, data) for key, data in ROWS]
    path = write(tmp_path / 'far.sqlite3', ROWS + far)
    damage(path, 2000)
    with closing(sqlite3.connect(path)) as database:
        gaps = []
        keys = [key for (key,) in rows_around_damage(database, 'rows', ('key',), gaps.append)]
    assert keys == sorted(set(keys))
    assert len(keys) > 3950
    assert keys[-1] == 10**9 + 2000


def test_the_search_ends_where_nothing_can_be_read() -> None:
    gaps = []
    with closing(sqlite3.connect(':memory:')) as database:
        assert list(rows_around_damage(database, 'rows', ('key',), gaps.append)) == []
    ((first, last, error),) = gaps
    assert (first, last, str(error)) == (1, None, 'no such table: rows')
