# SPDX-License-Identifier: Apache-2.0
"""Damaged catalogues: what is released is right, the books say what was lost, both nodes go on."""

import fcntl
import json
import sqlite3
from contextlib import closing
from contextlib import suppress
from hashlib import sha256

import pytest
from flips import ChipFlips
from flips import ListFlips
from spooled import SpoolUsers
from spooled import database
from spooled import feeder
from spooled import in_outbox
from spooled import new_chip
from spooled import store

from obbhbb_ros.spool.books import Books
from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.catalogue import catalogue_files
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.chip_rows import describe_intact
from obbhbb_ros.spool.console import ANY_CHIP
from obbhbb_ros.spool.salvage import intact_chips
from obbhbb_ros.spool.schema import SCHEMA
from obbhbb_ros.spool.seals import is_sealed
from obbhbb_ros.spool.seals import sealed
from obbhbb_ros.spool.writer import SpoolWriter

ALL = float('inf')


@pytest.fixture
def troubles():
    return []


@pytest.fixture
def spool(tmp_path, troubles):
    made = SpoolUsers(tmp_path / 'spool', troubles.append)
    yield made
    made.close()


def go_on(spool, folder, troubles):
    """Store a chip and release all; give values in the outbox and the books."""
    assert store(spool.writer, [0.95])
    releasing = feeder(folder, troubles.append)
    spool.releaser.close()
    for _ in range(4):
        releasing.step()
    releasing.close()
    status = spool.console.status()
    assert status.balance == 0
    return sorted(chip['value'] for chip in in_outbox(folder / 'outbox').values()), status


# Bits


@pytest.mark.parametrize('bit', [144, 376, 49304, 65026, 129442, 157528])
def test_bits_that_once_stopped_a_node(tmp_path, bit) -> None:
    """Of the header, of an index, the state of a row, the text of the books, the id of a chip."""
    flips = ChipFlips(tmp_path)
    assert flips.check(bit)


def test_no_flipped_bit_releases_a_wrong_chip_or_stops_a_node(tmp_path) -> None:
    """A sample; `test/fuzz/catalogue.py` takes all."""
    flips = ChipFlips(tmp_path)
    outcomes = {flips.check(bit) for bit in range(0, flips.bits, 2503)}
    assert outcomes >= {'set aside', '1 damaged chips, reported', '0 damaged chips, not a word'}


def test_no_flipped_bit_loses_a_ship_in_silence(tmp_path) -> None:
    """A sample; `test/fuzz/catalogue.py --lists` takes all."""
    flips = ListFlips(tmp_path)
    outcomes = {flips.check(bit) for bit in range(20, flips.bits, 1639)}
    assert outcomes >= {
        '0 ships lost, 0 set aside, not a word',
        '4 ships lost, 0 set aside, reported',
        '8 ships lost, 1 set aside, reported',
    }


@pytest.mark.parametrize('place', [-1, -2, -10, -100])
def test_damage_of_an_index_alone_costs_no_chip(spool, tmp_path, troubles, place) -> None:
    for i in range(10):
        store(spool.writer, [0.5 + i / 1000 + j / 100000 for j in range(100)])
    spool.close()
    (path,) = catalogue_files(tmp_path / 'spool')
    with database(tmp_path / 'spool') as rows:
        (root,) = rows.execute(
            "SELECT rootpage FROM sqlite_master WHERE name = 'chips_in_order'"
        ).fetchone()
    content = bytearray(path.read_bytes())
    # The last page that the first one of the index leads to.
    start = (root - 1) * 2048
    assert content[start] == 2
    page = int.from_bytes(content[start + 8 : start + 12], 'big')
    content[page * 2048 + place] ^= 0xFF
    path.write_bytes(content)
    claimed = []
    for _ in range(3):
        with suppress(SpoolError):
            claimed += spool.releaser.claim(2000, 1e9, 1e9, 0).chips
    status = spool.console.status()
    assert len(claimed) == 1000
    assert (status.set_aside, status.balance, status.counts['restored']) == (0, 0, 1)
    assert spool.console.integrity() == []


@pytest.mark.parametrize('state', [ChipState.WAITING, ChipState.CLAIMED, ChipState.RELEASED])
def test_chips_that_an_index_does_not_list_are_delivered(spool, tmp_path, troubles, state) -> None:
    store(spool.writer, [0.5])
    if state:
        (chip,) = [chip.id for chip, _ in spool.releaser.claim(1, 1e9, 1e9, 0).chips]
        if state == ChipState.RELEASED:
            spool.releaser.released([chip], is_delivered=False)
    spool.close()
    with database(tmp_path / 'spool') as rows:
        rows.execute('PRAGMA writable_schema = ON')
        where = "FROM sqlite_master WHERE name = 'chips_in_order'"
        ((sql,),) = rows.execute(f'SELECT sql {where}')
        # An index of no chip takes its place, under its description.
        rows.execute('DROP INDEX chips_in_order')
        rows.execute(f'{sql} WHERE seq < 0')
        rows.execute("UPDATE sqlite_master SET sql = ? WHERE name = 'chips_in_order'", (sql,))
    with suppress(SpoolError):
        spool.releaser.ids(state)
        spool.releaser.claim(1, 1e9, 1e9, 0)
    assert len(spool.releaser.ids(state)) == 1
    assert spool.console.status().counts['restored'] == 1


def flipped(content):
    """Flip every bit of a text, one at a time, as SQLite would give it back."""
    for i in range(8 * len(content)):
        damaged = bytearray(content)
        damaged[i // 8] ^= 1 << i % 8
        yield bytes(damaged)


def test_every_flipped_bit_of_a_description_is_noticed(spool) -> None:
    store(spool.writer, [0.5])
    (chip,) = spool.console.select()
    data = new_chip(0.5).data
    assert describe_intact(chip, data, None)
    for name in ('id', 'class_id', 'facts', 'digest'):
        for content in flipped(getattr(chip, name).encode()):
            damaged = chip._replace(**{name: content.decode(errors='replace')})
            assert describe_intact(damaged, data, None) is None
    for change in ({'value': 0.25}, {'value': 'text'}, {'bytes': 301}, {'facts': None}):
        assert describe_intact(chip._replace(**change), data, None) is None


def test_every_flipped_bit_of_a_sealed_json_is_noticed() -> None:
    content = sealed(json.dumps({'id': 'größe', 'roi': [1, 2, 3, 4]}).encode())
    assert is_sealed(content)
    assert not any(map(is_sealed, flipped(content)))
    assert not any(is_sealed(content[:i]) for i in range(len(content)))


@pytest.mark.parametrize('value', [0.0, -0.0, 1, -1e308, 5e-324, 0.1])
def test_a_digest_survives_what_sqlite_does_to_a_number(spool, value) -> None:
    store(spool.writer, [value])
    spool.console.revalue(ANY_CHIP, 1.0, -0.0)
    (chip,) = spool.console.select()
    assert chip.is_intact()
    assert chip.value == value


def test_a_chip_with_another_place_is_not_released(spool, tmp_path, troubles) -> None:
    store(spool.writer, [0.5, 0.6])
    with database(tmp_path / 'spool') as rows:
        rows.execute("""UPDATE chips SET facts = replace(facts, '"roi": [1', '"roi": [9')""")
    values, status = go_on(spool, tmp_path, troubles)
    assert (values, status.counts['evicted.damaged']) == ([0.95], 2)


HOSTILE = [
    "value = 'text'",
    "facts = '" + '[' * 100_000 + "'",
    'bytes = 1 << 62',
    "bytes = 'text'",
    "id = 'another'",
    "id = x'00'",
]


@pytest.mark.parametrize('change', HOSTILE, ids=range(len(HOSTILE)))
def test_a_chip_of_which_nothing_is_right_holds_up_no_other(
    spool, tmp_path, troubles, change
) -> None:
    store(spool.writer, [0.5, 0.6])
    with database(tmp_path / 'spool') as rows:
        rows.execute(f'UPDATE chips SET {change} WHERE seq = 2')
    values, status = go_on(spool, tmp_path, troubles)
    assert values == [0.5, 0.95]
    assert (status.counts['evicted.damaged'], status.waiting) == (1, 0)


def test_a_released_chip_with_another_id_is_not_counted_as_delivered(spool) -> None:
    store(spool.writer, [0.5])
    ((chip, _),) = spool.releaser.claim(1, ALL, ALL, 0).chips
    spool.releaser.released([chip.id], is_delivered=False)
    with database(spool.folder) as rows:
        rows.execute("UPDATE chips SET id = '6' || substr(id, 2)")
    spool.releaser.delivered(spool.releaser.ids(2))
    status = spool.console.status()
    assert (status.balance, status.counts['evicted.damaged'], status.in_outbox) == (0, 1, 0)
    assert 'delivered' not in status.counts


# Books


def spoil(folder, *tables, text='{}'):
    with database(folder) as rows:
        for table in tables:
            rows.execute(f'UPDATE {table} SET text = ?', (text,))


@pytest.mark.parametrize('table', ['books', 'books_copy'])
def test_damaged_books_are_restored_from_their_copy(spool, tmp_path, troubles, table) -> None:
    store(spool.writer, [0.5, 0.6])
    before = spool.console.status()
    spoil(tmp_path / 'spool', table)
    status = spool.console.status()
    assert (status.waiting, status.balance) == (2, 0)
    values, status = go_on(spool, tmp_path, troubles)
    assert values == [0.5, 0.6, 0.95]
    assert status.counts['planned'] == before.counts['planned'] + 1
    restored = status.counts.get('restored', 0)
    assert restored == len(troubles) == (table == 'books')
    assert all('damaged books were restored' in text for text in troubles)


WRONG_BOOKS = ['', '{}', '[]', sealed(b'{"a": 1}').decode(), sealed(b'{"counts": 1}').decode()]


@pytest.mark.parametrize('text', WRONG_BOOKS, ids=range(len(WRONG_BOOKS)))
def test_a_catalogue_without_books_is_set_aside(spool, tmp_path, troubles, text) -> None:
    store(spool.writer, [0.5])
    (path,) = catalogue_files(tmp_path / 'spool')
    spoil(tmp_path / 'spool', 'books', 'books_copy', text=text)
    values, status = go_on(spool, tmp_path, troubles)
    assert (values, status.set_aside) == ([0.95], 1)
    assert troubles == [f'{path} is damaged and set aside: its books and their copy are damaged']
    assert len(list(intact_chips(path))) == 1


@pytest.mark.parametrize(
    'damage', ['DELETE FROM books', 'UPDATE books SET number = -5', 'UPDATE books SET number = 9']
)
def test_damage_to_number_and_key_of_the_rows_leaves_no_old_books(
    spool, tmp_path, troubles, damage
) -> None:
    store(spool.writer, [0.5])
    with database(tmp_path / 'spool') as rows:
        rows.execute(damage)
    store(spool.writer, [0.6])
    with database(tmp_path / 'spool') as rows:
        assert [
            rows.execute(f'SELECT count(*), max(number) FROM {table}').fetchone()
            for table in ('books', 'books_copy')
        ] == [(1, 1), (1, 1)]
    assert spool.console.status().waiting == 2


# Tables


def test_the_tables_fit_into_the_first_page(tmp_path, spool) -> None:
    """Else a chip could not be read if the second page were damaged."""
    spool.console.status()
    with database(tmp_path / 'spool') as rows:
        (size,) = rows.execute('SELECT sum(length(sql)) FROM sqlite_master').fetchone()
    # Of 2048, with names and numbers.
    assert size < 1600


@pytest.mark.parametrize(
    'damage',
    [
        'DROP TABLE books',
        'DROP TABLE chips',
        'DROP INDEX chips_in_order',
        'CREATE TABLE another (a)',
        'ALTER TABLE chips RENAME COLUMN k TO j',
        'PRAGMA user_version = 0',
        'PRAGMA user_version = 3',
    ],
)
@pytest.mark.parametrize('is_open', [False, True])
def test_other_tables_are_damage(spool, tmp_path, troubles, damage, is_open) -> None:
    store(spool.writer, [0.5])
    if not is_open:
        spool.close()
    with database(tmp_path / 'spool') as rows:
        rows.execute(damage)
    if is_open and 'another' not in damage:
        # What the program needs is noticed while it runs.
        store(spool.writer, [0.5])
    spool.close()
    values, status = go_on(spool, tmp_path, troubles)
    assert 0.95 in values
    assert status.set_aside == len(troubles) == 1


@pytest.mark.parametrize('old', [b'books_copy', b'CREATE TABLE chips', b'value REAL'])
def test_tables_whose_names_are_no_text_any_more_are_damage(spool, tmp_path, troubles, old) -> None:
    store(spool.writer, [0.5])
    spool.close()
    (path,) = catalogue_files(tmp_path / 'spool')
    content = path.read_bytes()
    path.write_bytes(content.replace(old, bytes([old[0] ^ 0x80]) + old[1:], 1))
    values, status = go_on(spool, tmp_path, troubles)
    assert (values, status.set_aside, len(troubles)) == ([0.95], 1, 1)
    with suppress(SpoolError):
        list(intact_chips(path))


# Version 1

VERSION_1 = """
CREATE TABLE chips (
    seq INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT NOT NULL UNIQUE, state INTEGER NOT NULL,
    value REAL NOT NULL, class_id TEXT NOT NULL, bytes INTEGER NOT NULL, facts TEXT NOT NULL,
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
INSERT INTO books VALUES ('planned', 2016), ('released', 5), ('delivered', 4),
    ('delivered_bytes', 1200);
INSERT INTO frames (writer, chips) VALUES (0, 7);
INSERT INTO notes VALUES ('outbox', '0123456789abcdef');
PRAGMA user_version = 1;
"""


def version_1(folder, damage=''):
    """Make a catalogue as earlier releases did: 2000 chips wait, 4 are claimed, 1 is released."""
    folder.mkdir()
    path = folder / 'chips_0003_abc123.sqlite3'
    with closing(sqlite3.connect(path)) as rows, rows:
        rows.executescript('PRAGMA page_size = 2048; PRAGMA auto_vacuum = INCREMENTAL;')
        rows.executescript('PRAGMA journal_mode = WAL;' + VERSION_1)
        for seq in range(1, 2010):
            state = 0 if seq <= 2000 else 1 if seq <= 2004 else 2
            chip = new_chip(seq / 3000)
            old = chip.stored(seq, 'abc123')[:7]
            if seq <= 2005:
                rows.execute(
                    'INSERT INTO chips VALUES (?, ?, ?, ?, ?, ?, ?, ?)',
                    (*old[:2], state, *old[3:], None if state == 2 else chip.data),
                )
        rows.execute("UPDATE sqlite_sequence SET seq = 2009 WHERE name = 'chips'")
        rows.executescript(damage)
    return path


def test_a_catalogue_of_version_1_is_taken_over_with_all_that_waits(
    spool, tmp_path, troubles
) -> None:
    path = version_1(tmp_path / 'spool')
    status = spool.console.status()
    assert (status.waiting, status.in_outbox, status.in_work) == (2004, 1, 0)
    assert (status.waiting_bytes, status.balance, status.set_aside) == (2004 * 300, 0, 0)
    assert status.counts == {
        'planned': 2016,
        'released': 5,
        'delivered': 4,
        'delivered_bytes': 1200,
        'refused.interrupted': 7,
    }
    assert spool.releaser.outbox() == '0123456789abcdef'
    assert len(spool.releaser.ids(1)) == 4
    chips = spool.console.select()
    assert len(chips) == 2005
    assert all(chip.is_intact() for chip in chips)
    whole = list(spool.console.files(chips))
    assert len(whole) == 2004
    assert all(describe_intact(chip, data, None) for chip, data in whole)
    # A number that was used is not used again.
    store(spool.writer, [0.99])
    best = spool.console.select()[0]
    assert (best.id, best.value) == ('5_000000000_abc123_2010', 0.99)
    assert catalogue_files(tmp_path / 'spool') == [path]
    assert spool.console.integrity() == troubles == []
    spool.close()
    assert len(list(intact_chips(path))) == 2005


DAMAGES_1 = [
    "UPDATE sqlite_sequence SET seq = 'text'",
    'UPDATE sqlite_sequence SET seq = 9223372036854775807',
    'UPDATE sqlite_sequence SET seq = 4',
    'UPDATE totals SET state = 64 WHERE state = 0',
    'UPDATE totals SET chips = 3',
    "INSERT INTO books VALUES (x'ff', 'text')",
    "UPDATE frames SET chips = 'text'",
    "UPDATE chips SET value = 'text' WHERE seq = 7",
    'UPDATE chips SET state = 64 WHERE seq = 7',
]


@pytest.mark.parametrize('damage', DAMAGES_1)
def test_damage_to_small_tables_of_version_1_is_made_good(
    spool, tmp_path, troubles, damage
) -> None:
    version_1(tmp_path / 'spool', damage)
    assert store(spool.writer, [0.99])
    status = spool.console.status()
    damaged = status.counts.get('evicted.damaged', 0)
    assert (damaged, status.waiting) == ((1, 2004) if 'value' in damage else (0, 2005))
    assert (status.set_aside, troubles) == (0, [])
    assert spool.console.integrity() == []
    # Frames of which nobody knows how many chips they had.
    assert status.balance == (7 if 'frames' in damage else 0)


@pytest.mark.parametrize('name', ['releaser', 'writer_0', 'writer_3'])
def test_a_catalogue_that_an_earlier_version_uses_is_left_alone(
    spool, tmp_path, troubles, name
) -> None:
    path = version_1(tmp_path / 'spool')
    with closing(sqlite3.connect(path)) as rows:
        before = sha256(''.join(rows.iterdump()).encode()).hexdigest()
    with (tmp_path / 'spool' / f'{name}.lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(SpoolError, match='a process of an earlier version uses it'):
            spool.console.status()
        assert not store(spool.writer, [0.5])
    with closing(sqlite3.connect(path)) as rows:
        assert sha256(''.join(rows.iterdump()).encode()).hexdigest() == before
    assert spool.console.status().waiting == 2004
    # Both that were refused meanwhile are counted now.
    assert store(spool.writer, [0.5])
    assert spool.console.status().counts['refused.spool_failed'] == 1


def test_a_migration_that_fails_changes_nothing(tmp_path, monkeypatch, troubles) -> None:
    path = version_1(tmp_path / 'spool')

    def fail(rows):
        SCHEMA.migrate(rows)
        raise sqlite3.OperationalError('database or disk is full')

    with monkeypatch.context() as patch:
        patch.setattr('obbhbb_ros.spool.access.SCHEMA', SCHEMA._replace(migrate=fail))
        writer = SpoolWriter(tmp_path / 'spool', troubles.append)
        assert not store(writer, [0.5])
        writer.close()
    assert all('disk is full' in text for text in troubles)
    with closing(sqlite3.connect(path)) as rows:
        assert rows.execute('PRAGMA user_version').fetchone() == (1,)
        assert rows.execute('SELECT sum(chips) FROM totals WHERE state < 2').fetchone() is not None
    spool = SpoolUsers(tmp_path / 'spool', print)
    assert spool.console.status().waiting == 2004
    spool.close()


def test_the_intact_chips_of_a_damaged_catalogue_of_version_1_can_be_read(tmp_path) -> None:
    path = version_1(tmp_path / 'spool', "UPDATE chips SET data = x'00' WHERE seq = 5")
    assert len(list(intact_chips(path))) == 2003


def test_books_are_those_that_were_written(tmp_path, spool) -> None:
    store(spool.writer, [0.5])
    with database(tmp_path / 'spool') as rows:
        books = Books.read(rows.cursor())
    assert (books.last_seq, books.held, books.frames) == (1, [[1, 300], [0, 0], [0, 0]], {})
