# SPDX-License-Identifier: Apache-2.0
"""obbhbb spool: an operator sees what is in it, and changes what goes first."""

import json
import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from spooled import SpoolUsers
from spooled import database
from spooled import in_outbox
from spooled import new_chip
from spooled import ship_report
from spooled import store
from spooled import values_in_outbox

from obbhbb_ros.cli import main
from obbhbb_ros.reports.ship_list import read_ship_list
from obbhbb_ros.spool.books import Books
from obbhbb_ros.spool.catalogue import DAMAGED
from obbhbb_ros.spool.catalogue import catalogue_files
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.console import SpoolConsole
from obbhbb_ros.spool.list_spool import ListSpool
from obbhbb_ros.spool.writer import SpoolWriter

ALL = float('inf')


@pytest.fixture
def folder(tmp_path):
    """Make a spool: 6 chips waiting, one of them on its way, one in the outbox, one delivered."""
    made = tmp_path / 'spool'
    spool = SpoolUsers(made, print)
    chips = [
        new_chip(value, 1500, class_id=class_id)
        for value, class_id in zip(
            (0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2), ['tug', 'ship'] * 4, strict=True
        )
    ]
    spool.writer.store(spool.writer.plan(10), chips, {'outside_image': 2})
    ids = [chip.id for chip, _ in spool.releaser.claim(3, ALL, ALL, 0).chips]
    spool.releaser.released(ids[:1], is_delivered=True)
    spool.releaser.released(ids[1:2], is_delivered=False)
    spool.close()
    return made


def values(folder, state=ChipState.WAITING):
    """List the values of chips in the order of their release."""
    console = SpoolConsole(folder, print)
    listed = [round(chip.value, 6) for chip in console.select() if chip.state == state]
    assert console.status().balance == 0
    console.close()
    return listed


def run(*arguments):
    return main(['spool', *map(str, arguments)])


def test_the_books_and_the_next_chips_are_shown(folder, capsys) -> None:
    assert run(folder) == 0
    books, table = capsys.readouterr().out.split('\n\n')
    assert books.splitlines() == [
        'planned    10',
        'waiting    6 (0.0 MB)',
        'in outbox  1',
        'delivered  1',
        'evicted    0',
        'refused    2 (outside_image 2)',
    ]
    head, *rows = table.splitlines()
    assert head.split() == ['id', 'class', 'value', 'rank', 'kB', 'state']
    assert [row.split()[1:5] for row in rows] == [
        [class_id, value, value, '1.5']
        for class_id, value in (
            ('ship', '0.6'),
            ('tug', '0.5'),
            ('ship', '0.4'),
            ('tug', '0.3'),
            ('ship', '0.2'),
            ('tug', '0.7'),
            ('ship', '0.8'),
        )
    ]
    assert [row.split(maxsplit=5)[5] for row in rows] == (
        ['waiting'] * 5 + ['being released', 'in outbox']
    )


@pytest.mark.parametrize(
    ('options', 'shown'),
    [
        (['--limit', '2'], [0.6, 0.5]),
        (['--limit', '0'], [0.6, 0.5, 0.4, 0.3, 0.2, 0.7, 0.8]),
        (['--class', 'tug'], [0.5, 0.3, 0.7]),
        (['--class', 'tug', 'ship', '--limit', '1'], [0.6]),
        (['--min-value', '0.5'], [0.6, 0.5, 0.7, 0.8]),
        (['--max-value', '0.3'], [0.3, 0.2]),
        (['--min-value', '0.3', '--max-value', '0.5', '--class', 'ship'], [0.4]),
        (['--class', "x' OR '1'='1"], []),
    ],
)
def test_conditions_select_chips(folder, capsys, options, shown) -> None:
    assert run(folder, '--json', *options) == 0
    found = json.loads(capsys.readouterr().out)
    assert [each['value'] for each in found['chips']] == shown
    assert (found['waiting'], found['in_outbox'], found['in_work']) == (6, 1, 0)
    assert found['counts']['planned'] == 10


def test_one_chip_is_found_by_its_id(folder, capsys) -> None:
    run(folder, '--json')
    chip = json.loads(capsys.readouterr().out)['chips'][1]
    run(folder, '--json', '--id', chip['id'])
    assert json.loads(capsys.readouterr().out)['chips'] == [chip]
    assert chip['state'] == 'waiting'


@pytest.mark.parametrize(
    ('options', 'message', 'waiting'),
    [
        (['--class', 'tug', '--to', '5'], '2 chips revalued', [5.0, 5.0, 0.6, 0.4, 0.2]),
        (['--class', 'ship', '--by', '0.1'], '3 chips revalued', [0.5, 0.3, 0.06, 0.04, 0.02]),
        (['--all', '--by', '2'], '5 chips revalued', [1.2, 1.0, 0.8, 0.6, 0.4]),
        (['--min-value', '9', '--to', '1'], '0 chips revalued', [0.6, 0.5, 0.4, 0.3, 0.2]),
    ],
)
def test_revalued_chips_have_another_place(folder, capsys, options, message, waiting) -> None:
    assert run(folder, 'revalue', *options) == 0
    assert capsys.readouterr().out == message + '\n'
    assert values(folder) == waiting
    assert values(folder, ChipState.CLAIMED) == [0.7]


@pytest.mark.parametrize(
    ('options', 'waiting'),
    [(['--class', 'tug'], [0.6, 0.4, 0.2]), (['--max-value', '0.4'], [0.6, 0.5]), (['--all'], [])],
)
def test_deleted_chips_are_counted(folder, capsys, options, waiting) -> None:
    assert run(folder, 'delete', *options) == 0
    assert capsys.readouterr().out == f'{5 - len(waiting)} chips deleted\n'
    assert values(folder) == waiting
    run(folder)
    assert f'evicted    {5 - len(waiting)} (deleted {5 - len(waiting)})' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('options', 'words'),
    [
        (['delete'], 'which chips'),
        (['revalue', '--to', '1'], 'which chips'),
        (['revalue', '--all'], 'either --to or --by'),
        (['revalue', '--all', '--to', '1', '--by', '2'], 'either --to or --by'),
        (['revalue', '--all', '--to', 'nan'], 'finite'),
        (['revalue', '--all', '--by', 'inf'], 'finite'),
        (['check', '--class', 'tug'], 'check: takes no condition'),
        (['forget-outbox', '--min-value', '0.5'], 'forget-outbox: takes no condition'),
    ],
)
def test_what_is_unclear_changes_nothing(folder, capsys, options, words) -> None:
    assert run(folder, *options) == 1
    error = capsys.readouterr().err
    assert error.startswith('obbhbb: ')
    assert words in error
    assert values(folder) == [0.6, 0.5, 0.4, 0.3, 0.2]


@pytest.mark.parametrize('action', ['list', 'check', 'delete', 'export'])
def test_a_folder_without_spool_is_left_alone(tmp_path, capsys, action) -> None:
    assert run(tmp_path, action, '--all') == 1
    assert f'{tmp_path} is no spool' in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_listed_is_not_said_to_be_without_spool(folder) -> None:
    folder.chmod(0o300)
    # Root reads any folder, but for these capabilities.
    held = '-dac_override,-dac_read_search'
    limited = ['setpriv', '--bounding-set', held, '--inh-caps', held] if os.getuid() == 0 else []
    done = subprocess.run(
        [*limited, sys.executable, '-m', 'obbhbb_ros.cli', 'spool', folder],
        capture_output=True,
        text=True,
        check=False,
    )
    folder.chmod(0o700)
    assert done.returncode == 1
    assert 'Permission denied' in done.stderr
    assert 'Traceback' not in done.stderr


def test_a_sound_spool_is_in_order(folder, capsys) -> None:
    assert run(folder, 'check') == 0
    assert capsys.readouterr().out == f'{folder} is in order\n'


@pytest.mark.parametrize(
    ('damage', 'words'),
    [
        ("UPDATE chips SET data = x'00' WHERE seq = 5", '_5: its file or description is damaged'),
        ("UPDATE chips SET facts = '{' WHERE seq = 5", '_5: its file or description is damaged'),
    ],
)
def test_check_reports_what_is_wrong(folder, capsys, damage, words) -> None:
    with database(folder) as rows:
        rows.execute(damage)
    assert run(folder, 'check') == 1
    (line,) = capsys.readouterr().out.splitlines()
    assert words in line


def test_check_reports_books_that_do_not_balance(folder, capsys) -> None:
    with database(folder) as rows:
        books = Books.read(rows.cursor())
        books.count('planned', 1)
        books.write(rows.cursor())
    assert run(folder, 'check') == 1
    assert '1 chips are unaccounted for' in capsys.readouterr().out


def test_a_chip_whose_description_is_damaged_is_shown_as_such(folder, capsys) -> None:
    with database(folder) as rows:
        rows.execute("UPDATE chips SET class_id = 'tuh', value = 'text' WHERE seq = 5")
    assert run(folder) == 0
    assert '_5  damaged  ' in capsys.readouterr().out
    assert run(folder, '--json') == 0
    chips = json.loads(capsys.readouterr().out)['chips']
    assert [chip['id'][-2:] for chip in chips if chip.get('damaged')] == ['_5']
    # It keeps its damage: a new digest would hide it.
    assert run(folder, 'revalue', '--all', '--by', '2') == 0
    assert capsys.readouterr().out == '4 chips revalued\n'


def test_letters_that_the_terminal_lacks_are_written_as_numbers(tmp_path) -> None:
    writer = SpoolWriter(tmp_path, print)
    writer.store(writer.plan(1), [new_chip(class_id='b\xe5t')], {})
    writer.close()
    done = subprocess.run(
        [sys.executable, '-m', 'obbhbb_ros.cli', 'spool', tmp_path],
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
        env=os.environ | {'PYTHONIOENCODING': 'ascii'},
    )
    assert (done.returncode, done.stderr) == (0, '')
    assert 'b\\xe5t' in done.stdout


@pytest.mark.parametrize(
    ('action', 'option'),
    [
        ('delete', ['--limit', '2']),
        ('export', ['--limit', '0']),
        ('revalue', ['--limit', '2']),
        ('check', ['--json']),
        ('export', ['--json']),
        ('list', ['--to', '4']),
        ('delete', ['--by', '2']),
        ('list', ['-o', 'out']),
    ],
)
def test_an_option_of_another_action_is_refused(folder, capsys, action, option) -> None:
    before = values(folder)
    assert run(folder, action, '--class', 'tug', *option) == 1
    assert f'{action}: takes no --' in capsys.readouterr().err
    assert values(folder) == before


def test_a_factor_that_would_turn_the_order_round_is_refused(folder, capsys) -> None:
    before = values(folder)
    assert run(folder, 'revalue', '--all', '--by', '-1') == 1
    assert '--by must be 0 or more' in capsys.readouterr().err
    assert values(folder) == before


def test_exported_chips_stay_in_the_spool(folder, tmp_path, capsys) -> None:
    out = tmp_path / 'out'
    assert run(folder, 'export', '--class', 'tug', '-o', out) == 0
    assert capsys.readouterr().out == '3 chips exported\n'
    assert values_in_outbox(out) == [0.7, 0.5, 0.3]
    assert len(values(folder)) == 5


@pytest.mark.parametrize('state', ['whole', 'damaged', 'truncated'])
def test_the_intact_chips_of_a_damaged_catalogue_are_exported(tmp_path, capsys, state) -> None:
    writer = SpoolWriter(tmp_path / 'spool', print)
    store(writer, [0.01 * i for i in range(60)], 3000)
    writer.close()
    (path,) = catalogue_files(tmp_path / 'spool')
    path.with_name(path.name + DAMAGED).touch()
    size = path.stat().st_size
    if state == 'damaged':
        with path.open('r+b') as stream:
            stream.seek(size // 2)
            stream.write(b'\xa5' * 8192)
    elif state == 'truncated':
        os.truncate(path, size * 3 // 4)
    assert run(path, 'export', '-o', tmp_path / 'out') == 0
    found = len(in_outbox(tmp_path / 'out'))
    assert capsys.readouterr().out == f'{found} chips exported\n'
    low, high = {'whole': (60, 60), 'damaged': (40, 59), 'truncated': (20, 59)}[state]
    assert low <= found <= high
    assert [Path(each) for each in catalogue_files(tmp_path / 'spool')] == [path]


@pytest.mark.parametrize(
    ('options', 'exported'),
    [
        ([], [0.7, 0.6, 0.5, 0.4, 0.3, 0.2]),
        (['--class', 'tug'], [0.7, 0.5, 0.3]),
        (['--class', 'tug', '--max-value', '0.5'], [0.5, 0.3]),
        (['--min-value', '0.5'], [0.7, 0.6, 0.5]),
        (['--id', '5_000000000_{tag}_4', '5_000000000_{tag}_7'], [0.6, 0.3]),
        (['--class', 'x'], []),
    ],
    ids=str,
)
def test_conditions_select_chips_of_a_catalogue(folder, tmp_path, options, exported) -> None:
    (path,) = catalogue_files(folder)
    tag = path.stem.rpartition('_')[2]
    out = tmp_path / 'out'
    assert run(path, 'export', '-o', out, *(each.format(tag=tag) for each in options)) == 0
    assert values_in_outbox(out) == exported


@pytest.mark.parametrize('content', [b'', b'\xa5' * 9999], ids=len)
def test_chips_cannot_be_exported_from_what_is_no_catalogue(tmp_path, capsys, content) -> None:
    path = tmp_path / 'chips_0001_3fa9c2.sqlite3'
    path.write_bytes(content)
    assert run(path, 'export', '-o', tmp_path / 'out') == 1
    output = capsys.readouterr()
    assert f'obbhbb: {path} is no catalogue of a spool, or its start is damaged: ' in output.err
    assert output.out == ''


def test_a_damaged_catalogue_is_reported(folder, capsys) -> None:
    (path,) = catalogue_files(folder)
    path.write_bytes(b'garbage' * 9999)
    assert run(folder) == 0
    output = capsys.readouterr()
    assert '1 damaged catalogues set aside' in output.out
    assert f'{path} is damaged and set aside' in output.err


@pytest.mark.parametrize(
    'action', [['delete', '--all'], ['revalue', '--all', '--by', '2'], ['export']], ids=str
)
def test_damage_that_an_action_meets_is_an_error(tmp_path, capsys, monkeypatch, action) -> None:
    monkeypatch.chdir(tmp_path)
    writer = SpoolWriter(tmp_path / 'spool', print)
    store(writer, [0.01 * i for i in range(80)], 3000)
    writer.close()
    (path,) = catalogue_files(tmp_path / 'spool')
    with path.open('r+b') as stream:
        stream.seek(path.stat().st_size // 2)
        stream.write(b'\xa5' * 8192)
    assert run(tmp_path / 'spool', *action) == 1
    assert capsys.readouterr().err.startswith(f'obbhbb: {path} is damaged and set aside: ')
    # Once more, with the new catalogue.
    assert run(tmp_path / 'spool') == 0
    assert '1 damaged catalogues set aside' in capsys.readouterr().out


def test_a_spool_with_a_damaged_catalogue_is_not_in_order(folder, capsys) -> None:
    (path,) = catalogue_files(folder)
    path.write_bytes(b'garbage' * 9999)
    for _ in range(2):
        assert run(folder, 'check') == 1
        (line,) = capsys.readouterr().out.splitlines()
        assert line.startswith('1 damaged catalogues are set aside')
        assert "'obbhbb spool FILE export'" in line
    path.unlink()
    path.with_name(path.name + DAMAGED).unlink()
    assert run(folder, 'check') == 0


def test_a_catalogue_that_cannot_be_opened_is_an_error(tmp_path, capsys) -> None:
    writer = SpoolWriter(tmp_path / 'spool', print)
    store(writer, [0.5])
    writer.close()
    (path,) = catalogue_files(tmp_path / 'spool')
    # SQLite cannot make this file, as on a disk that is mounted read-only.
    path.with_name(f'{path.name}-wal').mkdir()
    assert run(path, 'export', '-o', tmp_path / 'out') == 1
    error = capsys.readouterr().err
    assert f'{path}: unable to open' in error
    assert 'copy all files' in error


def test_any_limit_from_0_is_one(folder, capsys) -> None:
    assert run(folder, 'list', '--limit', 10**20) == 0
    assert capsys.readouterr().out
    for words in (['--limit', '-1'], ['--min-value', 'nan'], ['--max-value', 'nan']):
        assert run(folder, 'list', *words) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith('obbhbb: --')


@pytest.fixture
def ships(tmp_path):
    """Make a spool: two chips of one ship, one of another, one of none; one was released."""
    made = tmp_path / 'ships'
    spool = SpoolUsers(made, print)
    objects = ('a-1', 'a-1', 'a-1', 'a-2', '')
    chips = [
        new_chip(value, object_id=object_id)
        for value, object_id in zip((0.9, 0.8, 0.7, 0.5, 0.4), objects, strict=True)
    ]
    spool.writer.store(spool.writer.plan(5), chips, {})
    ((chip, _),) = spool.releaser.claim(1, ALL, ALL, 0).chips
    spool.releaser.released([chip.id], is_delivered=True)
    spool.close()
    return made


def test_ships_are_listed_by_their_best_chips(ships, capsys) -> None:
    assert run(ships, 'list', '--objects') == 0
    books, table = capsys.readouterr().out.split('\n\n')
    assert 'waiting    4 (0.0 MB), of 2 known ships' in books.splitlines()
    assert [row.split() for row in table.splitlines()[1:]] == [
        ['a-2', 'ship', '1', '0', '0.5', '0.5'],
        ['a-1', 'ship', '2', '1', '0.8', '0.08'],
    ]
    assert run(ships, 'list', '--objects', '--json', '--limit', '1') == 0
    shown = json.loads(capsys.readouterr().out)
    assert [(each['object'], each['views']) for each in shown['objects']] == [('a-2', 1)]
    assert (shown['objects_waiting'], shown['counts']['objects_released']) == (2, 1)


def test_chips_of_a_ship_are_revalued_and_deleted(ships, capsys) -> None:
    assert run(ships, 'revalue', '--object', 'a-1', '--by', '10') == 0
    assert values(ships) == [8.0, 0.5, 0.4, 7.0]
    assert run(ships, 'delete', '--object', 'a-1') == 0
    assert capsys.readouterr().out == '2 chips revalued\n2 chips deleted\n'
    assert values(ships) == [0.5, 0.4]


@pytest.fixture
def lists(folder):
    """Add ship lists to the spool: of 40 ships, 10 are in the outbox, 30 wait."""
    spool = ListSpool(folder, print)
    spool.add([ship_report(number) for number in range(10)])
    listed = spool.claim(ALL)
    spool.released(listed.id, 'outbox', is_delivered=False)
    spool.add([ship_report(number) for number in range(10, 40)])
    spool.close()
    return folder / 'lists'


def exported_ships(folder):
    """Read the ids of the ships of all lists in a folder."""
    return {
        ship.id
        for path in folder.glob('0/*.geojson.gz')
        for ship in read_ship_list(path.read_bytes())
    }


WAITING = {ship_report(number).id for number in range(10, 40)}


def test_ship_lists_are_in_the_books(folder, lists, capsys) -> None:
    assert run(folder) == 0
    text = capsys.readouterr().out
    assert 'ships      40 listed (waiting 30, released 10, merged 0, dropped 0, damaged 0)' in text
    assert 'lists      1 released (in outbox 1, delivered 0, lost with an outbox 0)' in text
    for arguments in ((), ('--objects',)):
        assert run(folder, 'list', '--json', *arguments) == 0
        books = json.loads(capsys.readouterr().out)['lists']
        assert (books['ships_added'], books['ships_waiting'], books['in_outbox']) == (40, 30, 1)


def test_a_spool_without_lists_does_not_speak_of_them(folder, capsys) -> None:
    assert run(folder) == 0
    assert 'listed' not in capsys.readouterr().out
    assert run(folder, 'list', '--json') == 0
    assert 'lists' not in json.loads(capsys.readouterr().out)


def test_a_spool_of_ship_lists_alone_is_one(tmp_path, capsys) -> None:
    spool = ListSpool(tmp_path, print)
    spool.add([ship_report(1)])
    spool.close()
    assert run(tmp_path) == 0
    assert '1 listed (waiting 1,' in capsys.readouterr().out


def test_export_writes_the_ships_that_wait(folder, lists, tmp_path, capsys) -> None:
    assert run(folder, 'export', '-o', tmp_path / 'out') == 0
    assert '1 ship lists exported' in capsys.readouterr().out
    assert exported_ships(tmp_path / 'out') == WAITING
    assert run(folder, 'export', '--class', 'tug', '-o', tmp_path / 'tugs') == 0
    assert exported_ships(tmp_path / 'tugs') == set()


@pytest.mark.parametrize(
    ('column', 'value', 'problem'),
    [
        ('data', b'no list', 'the list is damaged'),
        ('ships', 7, 'the list is damaged'),
        ('digest', 'x', 'the list is damaged'),
    ],
)
def test_check_finds_damaged_ship_lists(folder, lists, column, value, problem, capsys) -> None:
    assert run(folder, 'check') == 0
    (file,) = lists.glob('*.sqlite3')
    with closing(sqlite3.connect(file)) as rows, rows:
        rows.execute(f'UPDATE lists SET {column} = ? WHERE state = 0', (value,))
    assert run(folder, 'check') == 1
    assert problem in capsys.readouterr().out


def test_the_intact_lists_of_a_damaged_catalogue_can_be_exported(
    folder, lists, tmp_path, capsys
) -> None:
    (file,) = lists.glob('*.sqlite3')
    # Without its books it is none that the nodes would use.
    with closing(sqlite3.connect(file)) as rows, rows:
        rows.executescript('DROP TABLE books; DROP TABLE books_copy')
    assert run(file, 'export', '-o', tmp_path / 'saved') == 0
    assert exported_ships(tmp_path / 'saved') == WAITING
    assert run(file, 'export', '--class', 'tug') == 1
    assert 'takes no condition' in capsys.readouterr().err
