# SPDX-License-Identifier: Apache-2.0
"""Rows of damaged SQLite files: each that is not in a damaged place, once, in order."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from obbhbb_ros.damaged_sqlite import Gap
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
    gaps: list[Gap] = []
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


@pytest.mark.parametrize(('groups', 'distance'), [(2, 10**9), (3, 300_000)])
def test_rows_behind_large_gaps_are_read_after_few_tries(
    tmp_path: Path, groups: int, distance: int
) -> None:
    rows = [
        (key + group * distance, b'%d ' % group + data)
        for group in range(groups)
        for key, data in ROWS
    ]
    path = write(tmp_path / 'far.sqlite3', rows)
    content = bytearray(path.read_bytes())
    for group in range(groups - 1):
        start = content.index(b'%d row 002000' % group) // PAGE * PAGE
        content[start : start + PAGE] = b'\xff' * PAGE
    path.write_bytes(content)
    gaps: list[Gap] = []
    queries: list[str] = []
    with closing(sqlite3.connect(path)) as database:
        database.set_trace_callback(queries.append)
        keys = [key for (key,) in rows_around_damage(database, 'rows', ('key',), gaps.append)]
    assert keys == sorted(set(keys))
    assert len(keys) > groups * 2000 - 50
    assert keys[-1] == (groups - 1) * distance + 2000
    assert len(gaps) == groups - 1
    assert len(queries) < 10_000 * groups


def test_the_search_ends_although_a_table_leads_back_to_its_start(path: Path) -> None:
    # The last page of the list of pages becomes a copy of the first, another one is damaged.
    content = bytearray(path.read_bytes())
    starts = [content.index(b'row %06d' % row) // PAGE * PAGE for row in (1, 2000)]
    content[starts[1] : starts[1] + PAGE] = content[starts[0] : starts[0] + PAGE]
    path.write_bytes(content)
    damage(path, 1000)
    rows, gaps = read(path)
    assert rows == [row for row in ROWS if not any(row[0] in gap for gap in gaps)]
    assert len(rows) > 1950


def test_the_greatest_key_is_read(tmp_path: Path) -> None:
    path = write(tmp_path / 'a.sqlite3', [*ROWS, (2**63 - 1, b'last')])
    damage(path, 1000)
    assert read(path)[0][-1] == (2**63 - 1, b'last')


def test_the_search_ends_where_nothing_can_be_read() -> None:
    gaps: list[Gap] = []
    with closing(sqlite3.connect(':memory:')) as database:
        assert list(rows_around_damage(database, 'rows', ('key',), gaps.append)) == []
    ((first, last, error),) = gaps
    assert (first, last, str(error)) == (1, None, 'no such table: rows')
