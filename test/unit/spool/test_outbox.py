# SPDX-License-Identifier: Apache-2.0
"""The outbox: a chip is there with its JSON, or not at all."""

import errno
import json
import os
import shutil
import stat
from hashlib import sha256
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.spool.outbox import json_bytes
from obbhbb_ros.spool.outbox import level_of
from obbhbb_ros.spool.seals import is_sealed


def put(outbox, name='a', data=b'data', level=0, suffix='jpg'):
    outbox.put(name, suffix, data, {'id': name, 'text': 'größe'}, level)


def names(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob('*') if path.is_file())


@pytest.mark.parametrize('level', [0, 1, 12])
@pytest.mark.parametrize('suffix', ['jpg', 'jp2'])
def test_a_chip_lies_beside_its_json_in_the_folder_of_its_level(tmp_path, level, suffix) -> None:
    put(Outbox(tmp_path), level=level, suffix=suffix)
    assert names(tmp_path) == [f'{level}/a.{suffix}', f'{level}/a.json']
    assert (tmp_path / str(level) / f'a.{suffix}').read_bytes() == b'data'
    content = (tmp_path / str(level) / 'a.json').read_bytes()
    *facts, (last, digest) = json.loads(content).items()
    assert dict(facts) == {'id': 'a', 'text': 'größe'}
    # Of all bytes before it.
    assert (last, digest) == ('digest', sha256(content[:-31]).hexdigest()[:16])


def test_the_json_gets_its_name_last_when_both_are_on_disk(tmp_path, monkeypatch) -> None:
    done = []
    fsync, replace = os.fsync, os.replace

    def noted_fsync(descriptor):
        done.append(('fsync', Path(os.readlink(f'/proc/self/fd/{descriptor}')).suffix))
        fsync(descriptor)

    def noted_replace(source, target):
        done.append(('replace', Path(target).suffix))
        replace(source, target)

    monkeypatch.setattr(os, 'fsync', noted_fsync)
    monkeypatch.setattr(os, 'replace', noted_replace)
    put(Outbox(tmp_path))
    # Of the new folder; of the files, the name of one, of the folder, the name of the other; ''
    # is a folder.
    assert done == [
        ('fsync', ''),
        ('fsync', '.jpg'),
        ('fsync', '.json'),
        ('replace', '.jpg'),
        ('fsync', ''),
        ('replace', '.json'),
        ('fsync', ''),
    ]


def test_a_batch_flushes_its_folders_twice(tmp_path, monkeypatch) -> None:
    outbox, folders = Outbox(tmp_path), []
    put(outbox)
    put(outbox, level=1)
    fsync = os.fsync

    def noted_fsync(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            folders.append(Path(os.readlink(f'/proc/self/fd/{descriptor}')).name)
        fsync(descriptor)

    monkeypatch.setattr(os, 'fsync', noted_fsync)
    for i in range(8):
        outbox.add(f'chip{i}', 'jpg', b'data', json_bytes({'id': i}), i % 2)
    assert folders == []
    assert outbox.contents().complete == {'a'}
    outbox.finish()
    assert sorted(folders) == ['0', '0', '1', '1']
    assert len(outbox.contents().complete) == 9


# Entries of others


def test_links_and_folders_in_the_outbox_are_left_alone(tmp_path) -> None:
    outbox = Outbox(tmp_path)
    put(outbox)
    level = tmp_path / '0'
    (level / 'loop').symlink_to('loop')
    (level / 'b.json').symlink_to('missing')
    (level / 'c.json').mkdir()
    os.mkfifo(level / 'd.json')
    (tmp_path / '7').symlink_to('7')
    contents = outbox.contents()
    assert (contents.ids, contents.complete) == ({'a'}, {'a'})
    outbox.remove_unfinished(['b', 'c'])
    assert {path.name for path in level.iterdir()} == {
        'a.jpg',
        'a.json',
        'c.json',
        'd.json',
        'loop',
    }


@pytest.mark.parametrize('name', ['a.jpg', 'a.json'])
@pytest.mark.parametrize('kind', ['folder', 'link', 'pipe'])
def test_what_has_the_name_of_a_chip_does_not_keep_it_out(tmp_path, name, kind) -> None:
    level = tmp_path / '0'
    level.mkdir()
    if kind == 'folder':
        (level / name).mkdir()
        (level / name / 'kept').touch()
    elif kind == 'link':
        (level / name).symlink_to(tmp_path / 'elsewhere')
    else:
        os.mkfifo(level / name)
    put(Outbox(tmp_path))
    assert (level / 'a.jpg').read_bytes() == b'data'
    assert is_sealed((level / 'a.json').read_bytes())
    assert not (tmp_path / 'elsewhere').exists()
    assert len(list(level.glob('.*/kept'))) == (kind == 'folder')


@pytest.mark.parametrize('kind', ['link', 'zeros', 'pipe', 'folder'])
def test_a_token_that_is_no_file_is_an_error_at_once(tmp_path, kind) -> None:
    path = tmp_path / '.outbox'
    if kind in ('link', 'zeros'):
        path.symlink_to('/dev/zero' if kind == 'zeros' else '.outbox')
    elif kind == 'pipe':
        os.mkfifo(path)
    else:
        path.mkdir()
    with pytest.raises(OSError, match=r'\.outbox'):
        Outbox(tmp_path).token()


def test_a_token_is_read_with_a_limit(tmp_path) -> None:
    path = tmp_path / '.outbox'
    path.touch()
    os.truncate(path, 2**40)
    assert len(Outbox(tmp_path).token()) == 64


def test_an_outbox_has_one_releaser_at_a_time(tmp_path) -> None:
    first, second = Outbox(tmp_path), Outbox(tmp_path)
    first.token()
    first.lock()
    first.lock()
    with pytest.raises(OSError, match='another process releases into this outbox'):
        second.lock()
    first.close()
    second.lock()
    # Another folder in its place is another outbox.
    tmp_path.rename(tmp_path.with_name('aside'))
    tmp_path.mkdir()
    first.token()
    first.lock()
    first.close()
    second.close()


def test_a_chip_in_the_outbox_is_replaced(tmp_path) -> None:
    outbox = Outbox(tmp_path)
    put(outbox, data=b'old')
    put(outbox, data=b'new')
    assert (tmp_path / '0' / 'a.jpg').read_bytes() == b'new'
    assert len(names(tmp_path)) == 2


@pytest.mark.parametrize('failing', range(5))
def test_a_chip_that_fails_leaves_no_half(tmp_path, monkeypatch, failing) -> None:
    outbox, calls = Outbox(tmp_path), []
    real = os.fsync

    def fail(descriptor):
        calls.append(descriptor)
        if len(calls) == failing + 1:
            raise OSError(errno.ENOSPC, 'No space left on device')
        real(descriptor)

    monkeypatch.setattr(os, 'fsync', fail)
    with pytest.raises(OSError, match='No space left'):
        put(outbox)
    # Before the last, the JSON has no name; the first is for the new folder.
    assert names(tmp_path) == ([] if failing < 4 else ['0/a.jpg', '0/a.json'])


def test_the_contents_of_an_outbox_are_listed(tmp_path) -> None:
    outbox = Outbox(tmp_path)
    outbox.token()
    put(outbox, 'a', b'12345')
    put(outbox, 'b', b'123', level=1)
    put(outbox, 'c')
    put(outbox, 'd')
    (tmp_path / '0' / 'c.jpg').unlink()
    (tmp_path / '0' / 'd.json').unlink()
    (tmp_path / '0' / '.0123abcd.jpg').write_bytes(b'unfinished')
    (tmp_path / 'log.txt').write_text('of the bus')
    (tmp_path / 'other').mkdir()
    (tmp_path / 'other' / 'e.json').write_text('{}')
    contents = outbox.contents()
    # 'c' was complete before the bus began to remove it.
    assert contents.complete == {'a', 'b', 'c'}
    assert contents.ids == {'a', 'b', 'c', 'd'}
    sizes = [
        (tmp_path / each).stat().st_size
        for each in names(tmp_path)
        if each[0] in '01' and not each[2:].startswith('.')
    ]
    assert contents.bytes == sum(sizes)


def test_a_chip_that_is_taken_while_it_is_looked_at_is_not_there(tmp_path, monkeypatch) -> None:
    outbox = Outbox(tmp_path)
    put(outbox)
    put(outbox, 'b')
    real = os.scandir

    def scandir(folder):
        entries = list(real(folder))
        for entry in entries:
            if entry.name.startswith('a.'):
                os.unlink(entry.path)
        return iter(entries)

    monkeypatch.setattr(os, 'scandir', scandir)
    contents = outbox.contents()
    assert (contents.complete, contents.ids) == ({'b'}, {'b'})


def test_a_missing_outbox_is_an_error_rather_than_empty(tmp_path) -> None:
    with pytest.raises(FileNotFoundError):
        Outbox(tmp_path / 'missing').contents()


def test_unfinished_files_are_removed_and_nothing_else(tmp_path) -> None:
    outbox = Outbox(tmp_path)
    token = outbox.token()
    for name in 'abc':
        put(outbox, name)
    (tmp_path / '0' / 'b.json').unlink()
    (tmp_path / '0' / 'c.json').unlink()
    (tmp_path / '0' / '.0123abcd.jpg').write_bytes(b'')
    outbox.remove_unfinished(['b'])
    assert names(tmp_path) == ['.outbox', '0/a.jpg', '0/a.json', '0/c.jpg']
    assert outbox.token() == token


def test_every_outbox_has_a_token_of_its_own(tmp_path) -> None:
    first, second = Outbox(tmp_path / 'a'), Outbox(tmp_path / 'b')
    assert first.token() == Outbox(tmp_path / 'a').token() != second.token()
    shutil.rmtree(tmp_path / 'a')
    assert first.token() not in ('', second.token())


@given(st.floats(-2.0, 2.0), st.lists(st.floats(-1.0, 1.0), max_size=5))
def test_a_level_counts_the_thresholds_above(value, thresholds) -> None:
    level = level_of(value, thresholds)
    assert level == len([each for each in thresholds if value < each])
    assert level_of(value + 0.5, thresholds) <= level


@pytest.mark.parametrize('text', ['größe', '船', '\ud800', 'a"b'])
def test_json_is_utf8(text) -> None:
    assert json.loads(json_bytes({'text': text}))['text'] == text.replace('\ud800', '?')


def test_files_of_others_are_left_alone(tmp_path) -> None:
    outbox = Outbox(tmp_path)
    put(outbox)
    (tmp_path / '0' / '.sync').mkdir()
    (tmp_path / '0' / '.a.jpg.Xy12').write_bytes(b'of rsync')
    outbox.remove_unfinished([])
    assert sorted(path.name for path in (tmp_path / '0').iterdir()) == [
        '.a.jpg.Xy12',
        '.sync',
        'a.jpg',
        'a.json',
    ]
