# SPDX-License-Identifier: Apache-2.0
"""The spool: whatever is done to it, every chip that is planned is accounted for."""

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections import Counter
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine
from hypothesis.stateful import invariant
from hypothesis.stateful import rule
from spooled import FACTS
from spooled import SpoolUsers
from spooled import database
from spooled import new_chip
from spooled import store

from obbhbb_ros.spool.catalogue import DAMAGED
from obbhbb_ros.spool.catalogue import Catalogue
from obbhbb_ros.spool.catalogue import SpoolDamagedError
from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.catalogue import catalogue_files
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.console import ANY_CHIP
from obbhbb_ros.spool.console import ChipFilter
from obbhbb_ros.spool.console import SpoolConsole
from obbhbb_ros.spool.outbox import json_bytes
from obbhbb_ros.spool.ranking import FADE
from obbhbb_ros.spool.releaser import Claim
from obbhbb_ros.spool.releaser import SpoolReleaser
from obbhbb_ros.spool.releaser import Stall
from obbhbb_ros.spool.salvage import intact_chips
from obbhbb_ros.spool.writer import SpoolWriter

ALL = float('inf')
MB = 1e6


@pytest.fixture
def troubles():
    return []


@pytest.fixture
def spool(tmp_path, troubles):
    made = SpoolUsers(tmp_path, troubles.append)
    yield made
    made.close()


def claim(spool, most=100, room=ALL, largest=ALL, overhead=0):
    """Claim chips; give their values."""
    return [chip.value for chip, _ in spool.releaser.claim(most, room, largest, overhead).chips]


def counts(spool):
    """Give the books, which balance."""
    status = spool.console.status()
    assert status.balance == 0
    return status


# Books


def test_a_frame_is_in_work_until_its_chips_are_stored_or_refused(spool) -> None:
    frame = spool.writer.plan(5)
    assert counts(spool).in_work == 5
    refused = {'encoder_failed': 2, 'outside_image': 1}
    assert spool.writer.store(frame, [new_chip(), new_chip()], refused)
    status = counts(spool)
    assert (status.in_work, status.waiting, status.waiting_bytes) == (0, 2, 600)
    assert status.counts == {'planned': 5, 'refused.encoder_failed': 2, 'refused.outside_image': 1}
    assert status.total('refused') == 3


@pytest.mark.parametrize('delivered', [True, False])
def test_a_chip_goes_from_waiting_to_released_to_delivered(spool, delivered) -> None:
    store(spool.writer, [0.5, 0.6])
    chips = spool.releaser.claim(1, ALL, ALL, 0).chips
    assert [data for _, data in chips] == [new_chip(0.6).data]
    # On its way.
    assert counts(spool).waiting == 2
    ids = [chip.id for chip, _ in chips]
    spool.releaser.released(ids, delivered)
    status = counts(spool)
    assert (status.waiting, status.waiting_bytes) == (1, 300)
    assert status.in_outbox == (not delivered)
    if not delivered:
        assert spool.releaser.ids(ChipState.RELEASED) == set(ids)
        assert list(spool.console.files([chips[0][0]])) == []
        spool.releaser.delivered(ids)
    assert counts(spool).counts == {
        'planned': 2,
        'released': 1,
        'delivered': 1,
        'delivered_bytes': 300,
    }


def test_nothing_is_counted_twice(spool) -> None:
    store(spool.writer, [0.5])
    ids = [chip.id for chip, _ in spool.releaser.claim(1, ALL, ALL, 0).chips]
    for _ in range(2):
        spool.releaser.released(ids, is_delivered=False)
        spool.releaser.unclaim(ids)
        assert (counts(spool).waiting, counts(spool).in_outbox) == (0, 1)
    for _ in range(2):
        spool.releaser.delivered(ids)
    status = counts(spool)
    assert (status.counts['released'], status.counts['delivered'], status.waiting) == (1, 1, 0)


def test_the_books_are_kept_when_it_is_closed(spool, tmp_path) -> None:
    store(spool.writer, [0.5, 0.7])
    before = counts(spool)
    spool.close()
    again = SpoolUsers(tmp_path, print)
    assert counts(again) == before
    assert [chip.value for chip in again.console.select()] == [0.7, 0.5]
    again.close()


# Chips


def test_a_spool_keeps_the_facts_of_a_chip(spool, tmp_path) -> None:
    given = new_chip(0.25, 123, (1764285402, 5), 'Frachter', obb=None, score=None)
    spool.writer.store(spool.writer.plan(1), [given], {})
    (chip,) = spool.console.select()
    described = chip.describe(FADE)
    tag = catalogue_files(tmp_path)[0].stem[-6:]
    assert described.pop('id') == chip.id == f'1764285402_000000005_{tag}_1'
    assert len(described.pop('sha256')) == 64
    assert described == FACTS | {
        'stamp': {'sec': 1764285402, 'nanosec': 5},
        'class_id': 'Frachter',
        'value': 0.25,
        'rank': 0.25,
        'object': None,
        'view': None,
        'obb': None,
        'score': None,
        'bytes': 123,
    }
    assert list(spool.console.files([chip])) == [(chip, given.data)]


@pytest.mark.parametrize('text', ['', 'größe', '船', 'a"b\\c', 'a\0b', '\x1b[31m', "'; DROP"])
def test_any_text_is_kept(spool, text) -> None:
    spool.writer.store(spool.writer.plan(1), [new_chip(class_id=text, frame_id=text)], {})
    (chip,) = spool.console.select(ChipFilter(class_ids=[text]))
    assert (chip.class_id, chip.describe(FADE)['frame_id']) == (text, text)


@pytest.mark.parametrize('value', [float('nan'), ALL, -ALL])
def test_a_value_must_be_finite(value) -> None:
    with pytest.raises(ValueError, match='finite'):
        new_chip(value)


def test_numbers_of_numpy_are_numbers(spool) -> None:
    obb = list(np.array([5.0, 5.0, 4.0, 2.0, 0.3]))
    given = new_chip(np.float64(0.7), 123, obb=obb, image_size=[8, 8])
    spool.writer.store(spool.writer.plan(1), [given], {})
    (chip,) = spool.console.select(ANY_CHIP)
    assert chip.is_intact()


def test_no_number_is_used_twice(spool, tmp_path, troubles) -> None:
    seen = []
    for _ in range(3):
        store(spool.writer, [0.5, 0.6])
        seen += [chip.id for chip in spool.console.select()]
        spool.console.delete(ANY_CHIP)
    shutil.rmtree(tmp_path)
    store(spool.writer, [0.5])
    seen += [chip.id for chip in spool.console.select()]
    assert len(set(seen)) == len(seen) == 7


# Order


@given(st.lists(st.sampled_from([-1.0, 0.0, 0.25, 0.5, 1e300]), max_size=30), st.integers(4, 9))
@settings(max_examples=20)
def test_the_most_valuable_goes_first_then_the_oldest(values, most) -> None:
    with tempfile.TemporaryDirectory() as folder:
        spool = SpoolUsers(Path(folder), print)
        # A clock that runs back.
        chips = [new_chip(value, stamp=(1000 - i, 0)) for i, value in enumerate(values)]
        spool.writer.store(spool.writer.plan(len(chips)), chips, {})
        order = []
        while chips := spool.releaser.claim(most, ALL, ALL, 0).chips:
            assert len(chips) <= most
            described = [chip.describe(FADE) for chip, _ in chips]
            order += [(-each['value'], 1000 - each['stamp']['sec']) for each in described]
        spool.close()
    assert order == sorted(order)
    assert sorted(number for _, number in order) == list(range(len(values)))


def cost_of(spool, value):
    """Bytes that a chip costs the link at most: file, facts, and 192 for the rest of its JSON."""
    (chip,) = spool.console.select(ChipFilter(min_value=value, max_value=value))
    return chip.bytes + len(chip.facts.encode()) + 192


def test_a_chip_without_room_ends_the_claim(spool) -> None:
    spool.writer.store(
        spool.writer.plan(3), [new_chip(0.9, 300), new_chip(0.8, 5000), new_chip(0.7, 300)], {}
    )
    first, second = cost_of(spool, 0.9), cost_of(spool, 0.8)
    chips, *why = spool.releaser.claim(9, first + second - 1, ALL, 0)
    assert ([chip.value for chip, _ in chips], why) == ([0.9], [FADE, Stall.NO_ROOM, second])
    assert spool.releaser.claim(9, second - 1, ALL, 0) == Claim([], FADE, Stall.NO_ROOM, second)
    assert claim(spool, room=second) == [0.8]


def test_a_chip_that_can_never_go_is_passed_over(spool) -> None:
    spool.writer.store(spool.writer.plan(2), [new_chip(0.9, 5000), new_chip(0.8, 300)], {})
    large = cost_of(spool, 0.9)
    assert claim(spool, largest=large - 1) == [0.8]
    assert spool.releaser.claim(9, ALL, large - 1, 0) == Claim([], FADE, Stall.ALL_TOO_LARGE)
    assert claim(spool, largest=large) == [0.9]
    assert spool.releaser.claim(9, ALL, large, 0) == Claim([], FADE, Stall.NOTHING_WAITS)


def test_the_overhead_costs_as_well(spool) -> None:
    store(spool.writer, [0.9])
    cost = cost_of(spool, 0.9)
    no_room = Claim([], FADE, Stall.NO_ROOM, cost + 100)
    assert spool.releaser.claim(9, cost + 99, ALL, 100) == no_room
    assert spool.releaser.claim(9, ALL, cost + 99, 100) == Claim([], FADE, Stall.ALL_TOO_LARGE)
    assert claim(spool, room=cost + 100, largest=cost + 100, overhead=100) == [0.9]


CHIPS = st.builds(
    new_chip,
    st.floats(allow_nan=False, allow_infinity=False),
    stamp=st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1)),
    frame_id=st.text(st.characters(exclude_categories=['Cs']), max_size=30),
)


@given(st.lists(CHIPS, min_size=1, max_size=30))
@settings(max_examples=10)
def test_a_chip_costs_no_more_than_its_estimate(chips) -> None:
    with tempfile.TemporaryDirectory() as folder:
        spool = SpoolUsers(Path(folder), print)
        spool.writer.store(spool.writer.plan(len(chips)), chips, {})
        for stored in spool.console.select():
            real = stored.bytes + len(json_bytes(stored.describe(FADE)))
            thought = stored.bytes + len(stored.facts.encode()) + 192
            assert real <= thought <= real + 128
        spool.close()


def test_what_is_put_back_goes_again_in_its_place(spool) -> None:
    store(spool.writer, [0.9, 0.8, 0.7])
    ids = [chip.id for chip, _ in spool.releaser.claim(2, ALL, ALL, 0).chips]
    assert len(spool.releaser.ids(ChipState.CLAIMED)) == 2
    spool.releaser.unclaim(ids)
    assert spool.releaser.ids(ChipState.CLAIMED) == set()
    assert claim(spool) == [0.9, 0.8, 0.7]


def test_revalued_chips_have_another_place(spool) -> None:
    store(spool.writer, [0.9, 0.8, 0.7])
    assert spool.console.revalue(ChipFilter(max_value=0.85), 2.0, 0.0) == 2
    assert spool.console.revalue(ChipFilter(min_value=0.9, max_value=0.9), 0.0, 0.1) == 1
    assert claim(spool) == [1.6, 1.4, 0.1]


def test_a_chip_on_its_way_is_neither_revalued_nor_deleted_nor_evicted(spool) -> None:
    store(spool.writer, [0.1, 0.2], size=3000)
    ids = [chip.id for chip, _ in spool.releaser.claim(9, ALL, ALL, 0).chips]
    spool.releaser.released(ids[:1], is_delivered=False)
    assert spool.console.revalue(ANY_CHIP, 0.0, 5.0) == spool.console.delete(ANY_CHIP) == 0
    store(spool.writer, [0.9], max_bytes=1.0)
    status = counts(spool)
    assert (status.waiting, status.in_outbox, status.counts['evicted.max_bytes']) == (1, 1, 1)


@pytest.mark.parametrize('factor', [1e308, -1e308])
def test_a_revalued_chip_has_a_finite_value(spool, factor) -> None:
    store(spool.writer, [100.0])
    spool.console.revalue(ANY_CHIP, factor, 0.0)
    (chip,) = spool.console.select()
    assert abs(chip.value) == sys.float_info.max


def test_deleted_chips_are_counted_as_evicted(spool) -> None:
    store(spool.writer, [0.9, 0.8, 0.7])
    assert spool.console.delete(ChipFilter(max_value=0.85)) == 2
    assert counts(spool).counts == {'planned': 3, 'evicted.deleted': 2}


# Size


def test_many_are_deleted_and_revalued_in_pieces_so_that_writers_get_their_turn(
    spool, monkeypatch
) -> None:
    store(spool.writer, [0.1] * 2500 + [0.9] * 5, 10)
    pieces = []
    real = Catalogue.transaction

    def transaction(self, write=False):
        pieces.append(write)
        return real(self, write)

    monkeypatch.setattr(Catalogue, 'transaction', transaction)
    few = ChipFilter(max_value=0.5)
    assert spool.console.revalue(few, 2.0, 0.0) == 2500
    # Three pieces, and the one that finds no more.
    assert pieces == [True] * 4
    pieces.clear()
    values = [chip.value for chip in spool.console.select()]
    assert values == [0.9] * 5 + [0.2] * 2500
    pieces.clear()
    assert spool.console.delete(few) == 2500
    assert pieces == [True] * 4
    assert counts(spool).counts['evicted.deleted'] == 2500


def test_the_least_valuable_are_evicted_the_oldest_of_equals_first(spool) -> None:
    limit = 0.5 * MB
    for number in range(9):
        chips = [new_chip(value, 20_000, (number, 0)) for value in (0.1, 0.5, 0.5, 0.9)]
        spool.writer.store(spool.writer.plan(4), chips, {}, limit)
        status = counts(spool)
        assert status.file_bytes <= 1.1 * limit
    described = [chip.describe(FADE) for chip in spool.console.select()]
    kept = Counter((each['value'], each['stamp']['sec']) for each in described)
    assert status.counts['evicted.max_bytes'] == 36 - kept.total() > 9
    assert all(kept[0.9, number] == 1 for number in range(9))
    assert not any(kept[0.1, number] for number in range(9))
    halves = [kept[0.5, number] for number in range(9)]
    assert halves == sorted(halves)


def test_a_chip_that_is_not_worth_its_place_is_evicted_at_once(spool) -> None:
    store(spool.writer, [0.5] * 10, 20_000, 0.2 * MB)
    store(spool.writer, [0.1], 20_000, 0.2 * MB)
    assert min(chip.value for chip in spool.console.select()) == 0.5


def test_a_limit_that_is_lowered_is_reached_on_the_disk(spool) -> None:
    for _ in range(5):
        store(spool.writer, [0.5] * 10, 20_000)
    assert counts(spool).file_bytes > MB
    for _ in range(3):
        store(spool.writer, [0.5], 20_000, 0.3 * MB)
    assert counts(spool).file_bytes <= 1.1 * 0.3 * MB


def test_a_raised_limit_keeps_more(spool) -> None:
    store(spool.writer, [0.5] * 10, 20_000, 0.1 * MB)
    few = counts(spool).waiting
    store(spool.writer, [0.5] * 10, 20_000, 10 * MB)
    assert counts(spool).waiting == few + 10


def test_nothing_is_evicted_without_a_limit(spool) -> None:
    store(spool.writer, [0.5] * 30, 50_000)
    assert counts(spool).waiting == 30


def test_a_limit_without_room_for_any_chip_is_reported(spool, troubles) -> None:
    store(spool.writer, [0.5] * 10, 20_000, 0.1 * MB)
    assert troubles == []
    store(spool.writer, [0.5], 20_000, 10_000)
    assert counts(spool).waiting == 0
    assert 'spool.max_bytes, 10000, and no chip is left to evict' in troubles[0]


# Several processes


def test_two_writers_and_a_releaser_share_one(tmp_path, spool, troubles) -> None:
    second = SpoolWriter(tmp_path, troubles.append)
    tickets = spool.writer.plan(1), second.plan(1)
    spool.writer.store(tickets[0], [new_chip(0.1)], {})
    second.store(tickets[1], [new_chip(0.2)], {})
    assert claim(spool) == [0.2, 0.1]
    assert counts(spool).counts == {'planned': 2}
    second.close()
    assert troubles == []


def test_a_second_releaser_is_refused_until_the_first_is_gone(tmp_path, spool, troubles) -> None:
    store(spool.writer, [0.5])
    assert spool.releaser.ids(ChipState.CLAIMED) == set()
    second = SpoolReleaser(tmp_path, troubles.append)
    with pytest.raises(SpoolError, match='another process releases'):
        second.claim(1, ALL, ALL, 0)
    spool.releaser.close()
    assert [chip.value for chip, _ in second.claim(1, ALL, ALL, 0).chips] == [0.5]
    second.close()


def test_frames_of_a_writer_that_was_closed_were_interrupted(tmp_path, spool, troubles) -> None:
    second, third = (SpoolWriter(tmp_path, troubles.append) for _ in range(2))
    spool.writer.plan(3)
    second.plan(5)
    spool.writer.close()
    third.plan(7)
    status = counts(spool)
    assert (status.in_work, status.counts['refused.interrupted']) == (12, 3)
    second.close()
    third.close()


WRITER = """
import sys
from pathlib import Path
from obbhbb_ros.spool.writer import SpoolWriter
SpoolWriter(Path(sys.argv[1]), print).plan(int(sys.argv[2]))
print('planned', flush=True)
sys.stdin.read()
"""


def test_frames_of_a_writer_that_was_killed_were_interrupted(tmp_path, troubles) -> None:
    writers = [
        subprocess.Popen(
            [sys.executable, '-c', WRITER, str(tmp_path), count],
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        for count in '34'
    ]
    killed, alive = writers
    with killed, alive:
        assert [each.stdout.readline() for each in writers] == ['planned\n'] * 2
        os.kill(killed.pid, signal.SIGKILL)
        killed.wait()
        spool = SpoolUsers(tmp_path, troubles.append)
        assert counts(spool).in_work == 7
        spool.writer.plan(1)
        status = counts(spool)
        assert (status.in_work, status.counts['refused.interrupted']) == (5, 3)
        # Its frame is still in work.
        alive.stdin.close()
    fourth = SpoolWriter(tmp_path, troubles.append)
    fourth.plan(1)
    assert counts(spool).counts['refused.interrupted'] == 7
    fourth.close()
    spool.close()


def test_a_frame_that_outlives_the_connection_is_counted_once(spool) -> None:
    frame = spool.writer.plan(2)
    spool.writer.close()
    spool.writer.plan(0)
    assert counts(spool).counts['refused.interrupted'] == 2
    assert spool.writer.store(frame, [new_chip(0.5)], {'encoder_failed': 1})
    status = counts(spool)
    assert (status.counts['planned'], status.counts['refused.interrupted']) == (2, 0)


@pytest.mark.parametrize('is_interrupted', [True, False])
def test_a_frame_can_be_stored_in_parts(spool, is_interrupted) -> None:
    frame = spool.writer.plan(5)
    assert spool.writer.store(frame.part(2), [new_chip(0.5)], {'encoder_failed': 1})
    status = counts(spool)
    assert (status.in_work, status.waiting) == (3, 1)
    if is_interrupted:
        spool.writer.close()
        spool.writer.plan(0)
        assert counts(spool).counts['refused.interrupted'] == 3
    # A part that was taken for interrupted counts as what became of it.
    assert spool.writer.store(frame.part(2), [new_chip(0.5)] * 2, {})
    assert spool.writer.store(frame.part(1), [new_chip(0.5)], {})
    status = counts(spool)
    assert (status.in_work, status.waiting, status.counts['planned']) == (0, 4, 5)
    assert not status.counts.get('refused.interrupted')


# What cannot be written down


class Blocked:
    """A folder in which no spool can be, until it is unblocked."""

    def __init__(self, path):
        self.path = path
        path.write_text('')

    def unblock(self):
        self.path.unlink()


def test_what_cannot_be_written_down_is_counted_later(tmp_path, troubles) -> None:
    blocked = Blocked(tmp_path / 'spool')
    spool = SpoolUsers(tmp_path / 'spool', troubles.append)
    for _ in range(3):
        assert not store(spool.writer, [0.5, 0.6])
    frame = spool.writer.plan(4)
    assert not spool.writer.store(frame, [new_chip()], {'encoder_failed': 3})
    with pytest.raises(SpoolError):
        spool.console.status()
    assert len(troubles) == 8
    assert all(str(tmp_path / 'spool') in text for text in troubles)
    blocked.unblock()
    store(spool.writer, [0.7])
    assert counts(spool).counts == {
        'planned': 11,
        'refused.spool_failed': 7,
        'refused.encoder_failed': 3,
    }
    assert claim(spool) == [0.7]
    spool.close()


@pytest.mark.parametrize('close', [False, True])
def test_it_is_counted_without_another_chip(tmp_path, troubles, close) -> None:
    blocked = Blocked(tmp_path / 'spool')
    spool = SpoolUsers(tmp_path / 'spool', troubles.append)
    store(spool.writer, [0.5, 0.6])
    blocked.unblock()
    if close:
        spool.writer.close()
    else:
        spool.writer.catch_up()
    assert counts(spool).counts == {'planned': 2, 'refused.spool_failed': 2}
    spool.close()


def test_a_failure_that_lasts_takes_no_memory(tmp_path) -> None:
    Blocked(tmp_path / 'spool')
    writer = SpoolWriter(tmp_path / 'spool', lambda text: None)
    store(writer, [0.5])
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    for _ in range(500):
        store(writer, [0.5])
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    # One entry for each frame would take 500 bytes or more.
    assert grown < 50_000


# Damage


def chips_of(folder):
    """Make a spool with 40 chips, 30 of them waiting, 5 claimed, 5 in the outbox."""
    spool = SpoolUsers(folder, print)
    for number in range(4):
        store(spool.writer, [number + 0.1 * i for i in range(10)], 3000)
    ids = [chip.id for chip, _ in spool.releaser.claim(10, ALL, ALL, 0).chips]
    spool.releaser.released(ids[5:], is_delivered=False)
    spool.close()
    (path,) = catalogue_files(folder)
    return path


def overwrite(start, count, content=b'\xa5'):
    def damage(path):
        size = path.stat().st_size
        at = int(start * size)
        with path.open('r+b') as stream:
            stream.seek(at)
            stream.write(content * (count or size - at))

    return damage


def another_version(path):
    with sqlite3.connect(path) as database:
        database.execute('PRAGMA user_version = 99')
    database.close()


DAMAGES = {
    'garbage': overwrite(0.0, 0),
    'header zeroed': overwrite(0.0, 100, b'\0'),
    'first page zeroed': overwrite(0.0, 8192, b'\0'),
    'truncated': lambda path: os.truncate(path, path.stat().st_size // 2),
    'all but the first page': overwrite(8192 / 172032, 0),
    'another version': another_version,
}


@pytest.mark.parametrize('damage', DAMAGES.values(), ids=DAMAGES.keys())
@pytest.mark.parametrize('is_open', [False, True], ids=['closed', 'open'])
def test_a_damaged_catalogue_is_set_aside(tmp_path, troubles, damage, is_open) -> None:
    path = chips_of(tmp_path)
    spool = SpoolUsers(tmp_path, troubles.append)
    frame = spool.writer.plan(1) if is_open else None
    damage(path)
    for _ in range(20):
        assert store(spool.writer, [0.5, 0.6], 3000)
        try:
            spool.console.select()
        except SpoolDamagedError as error:
            troubles.append(str(error))
    if frame is not None:
        spool.close()
        spool.writer.plan(1)
        assert spool.writer.store(frame, [new_chip()], {})
    status = counts(spool)
    # An open one writes its first page again, from memory.
    assert is_open or status.set_aside == 1
    assert len(catalogue_files(tmp_path)) == 1 + status.set_aside
    assert path.with_name(path.name + DAMAGED).exists() == status.set_aside
    assert (
        sum(f'{path} is damaged and set aside' in text for text in troubles)
        == len(troubles)
        == status.set_aside
    )
    stored = spool.console.select(ChipFilter(min_value=0.5, max_value=0.6))
    assert min(chip.value for chip in stored) == 0.5
    spool.close()


def test_an_empty_catalogue_is_a_new_one(tmp_path, troubles) -> None:
    path = chips_of(tmp_path)
    os.truncate(path, 0)
    spool = SpoolUsers(tmp_path, troubles.append)
    assert store(spool.writer, [0.5])
    assert counts(spool).counts == {'planned': 1}
    spool.close()


def test_a_folder_in_place_of_the_catalogue_is_passed_over(tmp_path, troubles) -> None:
    path = chips_of(tmp_path)
    path.unlink()
    path.mkdir()
    spool = SpoolUsers(tmp_path, troubles.append)
    assert store(spool.writer, [0.5])
    assert counts(spool).waiting == 1
    assert path.is_dir()
    spool.close()


@pytest.mark.parametrize('name', ['chips_old.sqlite3', 'chips_0009_a1b2c3.sqlite3.bak', 'chips_9'])
def test_a_file_of_another_name_is_no_catalogue(tmp_path, troubles, name) -> None:
    shutil.copy(chips_of(tmp_path), tmp_path / name)
    spool = SpoolUsers(tmp_path, troubles.append)
    assert store(spool.writer, [0.5])
    assert (counts(spool).waiting, len(catalogue_files(tmp_path))) == (36, 1)
    spool.close()


def test_the_newest_catalogue_is_used_however_many_there_were(tmp_path, troubles) -> None:
    path = chips_of(tmp_path)
    for number in (9_999, 10_000):
        shutil.copy(path, tmp_path / f'chips_{number}_a1b2c3.sqlite3')
    spool = SpoolUsers(tmp_path, troubles.append)
    store(spool.writer, [0.75])
    (chip,) = spool.console.select(ChipFilter(min_value=0.75, max_value=0.75))
    assert chip.id.split('_')[2] == 'a1b2c3'
    assert catalogue_files(tmp_path)[-1].name == 'chips_10000_a1b2c3.sqlite3'
    spool.close()


@pytest.mark.parametrize('suffix', ['-wal', '-shm'])
def test_what_was_lost_with_a_log_is_lost_as_a_whole(tmp_path, troubles, suffix) -> None:
    """A log that is deleted while no process has it open takes its transactions with it."""
    killed = subprocess.run(
        [sys.executable, '-c', WRITER + 'import os; os.kill(os.getpid(), 9)', str(tmp_path), '3'],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        check=False,
    )
    assert killed.returncode == -signal.SIGKILL
    (path,) = catalogue_files(tmp_path)
    Path(f'{path}{suffix}').unlink()
    spool = SpoolUsers(tmp_path, troubles.append)
    assert store(spool.writer, [0.5])
    assert counts(spool).waiting == 1
    spool.close()


@pytest.mark.parametrize(
    'what', ['folder', 'catalogue', 'log', 'index of the log', 'all files', 'replaced']
)
def test_a_new_catalogue_replaces_one_that_was_deleted_while_open(tmp_path, troubles, what) -> None:
    folder = tmp_path / 'spool'
    spool = SpoolUsers(folder, troubles.append)
    store(spool.writer, [0.5, 0.6])
    claim(spool, most=1)
    frame = spool.writer.plan(2)
    (path,) = catalogue_files(folder)
    if what == 'folder':
        shutil.rmtree(folder)
    if what == 'replaced':
        with closing(sqlite3.connect(tmp_path / 'other')) as other:
            other.execute('CREATE TABLE other (a)')
        (tmp_path / 'other').replace(path)
    names = {'all files': '*', 'log': '*-wal', 'index of the log': '*-shm', 'replaced': 'none'}
    for deleted in folder.glob(names.get(what, path.name)):
        deleted.unlink()
    assert spool.writer.store(frame, [new_chip(0.7), new_chip(0.8)], {})
    assert spool.writer.status().counts['planned'] >= 2
    assert claim(spool)[:2] == [0.8, 0.7]
    gone = [text for text in troubles if str(path) in text and 'deleted' in text]
    assert len(gone) == 2
    spool.close()
    again = SpoolUsers(folder, troubles.append)
    assert counts(again).waiting == 2
    assert counts(again).set_aside == (what in ('log', 'index of the log', 'replaced'))
    again.close()


class DeletingLog(dict):
    """Counts of refused chips that delete the log when they are read, in the transaction."""

    def __init__(self, folder):
        super().__init__()
        self._folder = folder

    def items(self):
        for path in self._folder.glob('chips_0001*-wal'):
            path.unlink()
        return super().items()


def test_what_was_stored_into_a_deleted_log_is_stored_again(tmp_path, spool, troubles) -> None:
    frame = spool.writer.plan(2)
    chips = [new_chip(0.7), new_chip(0.8)]
    assert spool.writer.store(frame, chips, DeletingLog(tmp_path))
    assert len(troubles) == 1
    assert 'deleted or replaced' in troubles[0]
    spool.close()
    assert counts(spool).waiting == 2
    assert len(catalogue_files(tmp_path)) == 2


def test_chips_of_a_lost_catalogue_are_none_of_the_new_one(tmp_path, troubles) -> None:
    """Both have a chip number 1."""
    spool = SpoolUsers(tmp_path / 'spool', troubles.append)
    store(spool.writer, [0.5])
    ((lost, _),) = spool.releaser.claim(1, ALL, ALL, 0).chips
    ids = [lost.id]
    shutil.rmtree(tmp_path / 'spool')
    store(spool.writer, [0.7])
    claimed = [chip.id for chip, _ in spool.releaser.claim(1, ALL, ALL, 0).chips]
    spool.releaser.released(ids, is_delivered=True)
    spool.releaser.unclaim(ids)
    spool.releaser.evict_damaged(lost)
    assert spool.releaser.ids(ChipState.CLAIMED) == set(claimed)
    assert counts(spool).counts == {'planned': 1}
    spool.close()


def test_the_intact_chips_of_a_damaged_catalogue_can_be_read(tmp_path) -> None:
    path = chips_of(tmp_path)
    whole = {chip.id: data for chip, data in intact_chips(path)}
    assert len(whole) == 35
    # A few pages in the middle.
    overwrite(0.5, 3 * 8192)(path)
    found = {chip.id: data for chip, data in intact_chips(path)}
    assert 20 <= len(found) < 35
    assert found.items() <= whole.items()
    ends = sorted(int(chip_id.rpartition('_')[2]) for chip_id in found)
    assert ends[0] < 5
    assert ends[-1] > 25


@pytest.mark.parametrize(
    'name',
    ['../../etc/5_000000000_abcdef_1', '/5_000000000_abcdef_1', '', '5_000000000_abcdef_1\n'],
)
def test_a_chip_whose_id_can_be_no_file_name_of_ours_is_damaged(spool, tmp_path, name) -> None:
    store(spool.writer, [0.5, 0.6])
    with database(tmp_path) as rows:
        rows.execute('UPDATE chips SET id = ? WHERE seq = 1', (name,))
    spool.close()
    (path,) = catalogue_files(tmp_path)
    assert [chip.seq for chip, _ in intact_chips(path)] == [2]


@pytest.mark.parametrize('stamp', [(-(2**31), 0), (2**31 - 1, 2**32 - 1)])
def test_a_chip_of_any_stamp_is_intact(spool, tmp_path, stamp) -> None:
    spool.writer.store(spool.writer.plan(1), [new_chip(stamp=stamp)], {})
    spool.close()
    (path,) = catalogue_files(tmp_path)
    assert len(list(intact_chips(path))) == 1


def test_the_intact_chips_between_damaged_places_can_be_read(spool, tmp_path) -> None:
    store(spool.writer, [i / 500 for i in range(500)])
    spool.close()
    (path,) = catalogue_files(tmp_path)
    for share in (0.2, 0.5, 0.8):
        overwrite(share, 2048)(path)
    # A page holds a few chips.
    assert 470 <= len(list(intact_chips(path))) < 500


def test_the_end_of_a_catalogue_can_be_gone(spool, tmp_path) -> None:
    store(spool.writer, [i / 500 for i in range(500)])
    spool.close()
    (path,) = catalogue_files(tmp_path)
    os.truncate(path, path.stat().st_size * 3 // 4)
    assert 300 <= len(list(intact_chips(path))) < 400


def test_a_catalogue_of_which_nothing_can_be_read_is_an_error(spool, tmp_path) -> None:
    store(spool.writer, [0.5] * 50)
    spool.close()
    (path,) = catalogue_files(tmp_path)
    with path.open('r+b') as stream:
        stream.seek(2048)
        stream.write(bytes(path.stat().st_size - 2048))
    with pytest.raises(SpoolError, match='no chip can be read: database disk image is malformed'):
        list(intact_chips(path))


def test_a_catalogue_without_chips_has_no_intact_ones(spool, tmp_path) -> None:
    spool.console.status()
    spool.close()
    assert list(intact_chips(catalogue_files(tmp_path)[0])) == []


@pytest.mark.parametrize('schema', ['', 'CREATE TABLE t (a)', 'CREATE TABLE chips (seq)'])
def test_another_database_is_no_catalogue(tmp_path, schema) -> None:
    path = tmp_path / 'other.sqlite3'
    with closing(sqlite3.connect(path)) as rows:
        rows.executescript(schema or 'VACUUM')
    with pytest.raises(SpoolError, match=r'other\.sqlite3 is no catalogue of a spool'):
        list(intact_chips(path))


def test_a_file_that_is_not_there_cannot_be_opened(tmp_path) -> None:
    with pytest.raises(SpoolError, match=r'none\.sqlite3: unable to open .* must be readable'):
        list(intact_chips(tmp_path / 'none.sqlite3'))


@pytest.mark.parametrize(
    'damage',
    [
        "data = x'00'",
        "facts = '{'",
        "facts = x'ff'",
        "facts = '[]'",
        "data = 'text'",
        "value = 'text'",
        "facts = replace(facts, 'jpeg', 'bmp0')",
    ],
)
def test_a_damaged_chip_is_left_out_of_the_intact_ones(tmp_path, damage) -> None:
    path = chips_of(tmp_path)
    with database(tmp_path) as rows:
        rows.execute(f'UPDATE chips SET {damage} WHERE seq = 3')
    found = [chip.seq for chip, _ in intact_chips(path)]
    assert len(found) == len(set(found)) == 34
    assert 3 not in found


def test_a_process_that_keeps_the_catalogue_locked_does_not_hold_up_a_writer(tmp_path) -> None:
    spool = SpoolUsers(tmp_path, print)
    store(spool.writer, [0.5])
    with database(tmp_path) as other:
        other.execute('BEGIN IMMEDIATE')
        started = time.monotonic()
        assert not any(store(spool.writer, [0.5]) for _ in range(10))
        # The first call waits .8 s. It took 5 s for each once.
        assert time.monotonic() - started < 20.0
        other.execute('ROLLBACK')
    assert store(spool.writer, [0.7])
    spool.writer.catch_up()
    found = counts(spool).counts
    assert (found['planned'], found['refused.spool_failed']) == (12, 10)
    spool.close()


# Anything, in any order


class AnyOrder(RuleBasedStateMachine):
    """Two writers, a releaser, an operator."""

    def __init__(self):
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix='spool'))
        self.troubles = []
        self.writers = [self.open(SpoolWriter), self.open(SpoolWriter)]
        self.releaser = self.open(SpoolReleaser)
        self.operator = self.open(SpoolConsole)
        self.frames = [[], []]
        self.planned = self.stored = 0
        self.claimed, self.released = [], []
        self.out = Counter()

    def open(self, user):
        return user(self.folder, self.troubles.append)

    def chips(self, *states):
        return [chip for chip in self.operator.select() if chip.state in states]

    @rule(which=st.integers(0, 1), count=st.integers(0, 4))
    def plan(self, which, count):
        self.frames[which].append(self.writers[which].plan(count))
        self.planned += count

    @rule(
        which=st.integers(0, 1),
        values=st.lists(st.floats(-2.0, 2.0), min_size=4, max_size=4),
        refused=st.integers(0, 4),
        limit=st.sampled_from([0.0, 150_000.0, 250_000.0]),
    )
    def store(self, which, values, refused, limit):
        if self.frames[which]:
            frame = self.frames[which].pop()
            refused = min(refused, frame.chips)
            chips = [new_chip(value, 9000) for value in values[: frame.chips - refused]]
            assert self.writers[which].store(frame, chips, {'encoder_failed': refused}, limit)

    @rule(most=st.integers(1, 5), room=st.sampled_from([ALL, 25_000.0]))
    def claim(self, most, room):
        chips = self.releaser.claim(most, room, ALL, 0).chips
        keys = [(-chip.value, chip.seq) for chip, _ in chips]
        assert keys == sorted(keys)
        waiting = self.chips(ChipState.WAITING)
        if chips and waiting:
            assert keys[-1] < (-waiting[0].value, waiting[0].seq)
        assert not any(chip.id in self.out for chip, _ in chips)
        self.claimed += [chip.id for chip, _ in chips]

    @rule(count=st.integers(0, 3), delivered=st.booleans())
    def release(self, count, delivered):
        ids, self.claimed = self.claimed[:count], self.claimed[count:]
        self.releaser.released(ids, delivered)
        self.out.update(ids)
        self.released += [] if delivered else ids

    @rule()
    def put_back(self):
        self.releaser.unclaim(self.claimed)
        self.claimed = []

    @rule()
    def deliver(self):
        self.releaser.delivered(self.released)
        self.released = []

    @rule(value=st.floats(-2.0, 2.0), factor=st.floats(-2.0, 2.0))
    def revalue(self, value, factor):
        self.operator.revalue(ChipFilter(max_value=value), factor, 0.0)

    @rule(value=st.floats(-2.0, 2.0))
    def delete(self, value):
        self.operator.delete(ChipFilter(max_value=value))

    @rule(which=st.integers(0, 1))
    def restart(self, which):
        self.writers[which].close()
        self.writers[which] = self.open(SpoolWriter)
        self.frames[which] = []
        # Now it takes its number, and the frames that go with it.
        self.writers[which].plan(0)

    @invariant()
    def books_balance(self):
        status = self.operator.status()
        assert status.balance == 0
        assert status.counts.get('planned', 0) == self.planned
        assert status.in_outbox == len(self.released)
        assert status.counts.get('delivered', 0) == len(self.out) - len(self.released)
        assert status.counts.get('released', 0) == len(self.out)
        assert sorted(chip.id for chip in self.chips(ChipState.CLAIMED)) == sorted(self.claimed)
        assert status.waiting == len(self.chips(ChipState.WAITING, ChipState.CLAIMED))
        assert status.in_work == sum(ticket.chips for frames in self.frames for ticket in frames)
        assert max(self.out.values(), default=0) <= 1

    def teardown(self):
        for user in (*self.writers, self.releaser, self.operator):
            user.close()
        shutil.rmtree(self.folder)
        assert self.troubles == []


TestAnyOrder = AnyOrder.TestCase
TestAnyOrder.settings = settings(max_examples=25, stateful_step_count=30, deadline=None)
