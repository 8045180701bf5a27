# SPDX-License-Identifier: Apache-2.0
"""Views of the same ship: whatever is done to a spool, ranks are those of the rule."""

import random
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import settings
from hypothesis import strategies as st
from spooled import FACTS
from spooled import SpoolUsers
from spooled import database

from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.chip_rows import NewChip
from obbhbb_ros.spool.console import ANY_CHIP
from obbhbb_ros.spool.console import ChipFilter
from obbhbb_ros.spool.ranking import MAX_K
from obbhbb_ros.spool.ranking import key_of
from obbhbb_ros.spool.ranking import rank_of

ALL = float('inf')
FIELDS = 'seq, id, state, object, worth, k'


@pytest.fixture
def spool(tmp_path) -> Iterator[SpoolUsers]:
    made = SpoolUsers(tmp_path, print)
    yield made
    made.close()


def store(spool, *views, size=300, max_bytes=0.0, **facts) -> None:
    """Store a frame of chips, given as value and object."""
    chips = [
        NewChip(value, 'ship', (5, 0), FACTS | facts, bytes(size), object_id)
        for value, object_id in views
    ]
    assert spool.writer.store(spool.writer.plan(len(chips)), chips, {}, max_bytes)


def waiting(spool):
    """List value and k of the chips that wait, in the order of their release."""
    return [(chip.value, chip.k) for chip in spool.console.select() if chip.state == 0]


def release(spool, count=1):
    """Release chips; return their descriptions."""
    claim = spool.releaser.claim(count, ALL, ALL, 0)
    spool.releaser.released([chip.id for chip, _ in claim.chips], is_delivered=True)
    return [chip.describe(claim.fade) for chip, _ in claim.chips]


# The rule


def test_the_second_view_of_a_ship_waits_for_the_first_of_others(spool) -> None:
    store(spool, (0.9, 'a-1'), (0.8, 'a-1'), (0.7, 'a-1'), (0.5, 'a-2'), (0.06, ''))
    assert waiting(spool) == [(0.9, 0), (0.5, 0), (0.8, 1), (0.06, 0), (0.7, 2)]
    released = release(spool, 5)
    assert [(each['object'], each['view']) for each in released] == [
        ('a-1', 1),
        ('a-2', 1),
        ('a-1', 2),
        (None, None),
        ('a-1', 3),
    ]
    assert [each['rank'] for each in released] == pytest.approx([0.9, 0.5, 0.08, 0.06, 0.007])
    assert [each['value'] for each in released] == [0.9, 0.5, 0.8, 0.06, 0.7]


def test_a_better_view_takes_the_place_of_the_first(spool) -> None:
    store(spool, (0.5, 'a-1'))
    store(spool, (0.9, 'a-1'))
    store(spool, (0.7, 'a-1'), (0.1, 'a-1'), (0.2, 'a-1'))
    assert waiting(spool) == [(0.9, 0), (0.7, 1), (0.5, 2), (0.2, 3), (0.1, 3)]


def test_released_views_are_remembered_after_delivery_and_over_restarts(spool, tmp_path) -> None:
    store(spool, (0.9, 'a-1'))
    release(spool)
    spool.close()
    again = SpoolUsers(tmp_path, print)
    store(again, (0.8, 'a-1'), (0.1, 'a-2'))
    assert waiting(again) == [(0.1, 0), (0.8, 1)]
    assert release(again, 2)[1]['view'] == 2
    status = again.console.status()
    assert (status.objects_waiting, status.counts['objects_released']) == (0, 2)
    again.close()


@pytest.mark.parametrize('value', [0.0, -0.5])
def test_a_value_that_is_not_positive_does_not_rise_by_repeating(spool, value) -> None:
    store(spool, (value, 'a-1'), (value, 'a-1'), (-0.1, 'a-2'))
    assert [chip.rank(0.1) for chip in spool.console.select()] == sorted(
        (value, value, -0.1), reverse=True
    )


def test_a_chip_that_the_border_cuts_counts_for_what_is_seen(spool) -> None:
    store(spool, (0.9, 'a-1'), obb=[0.0, 40.0, 30.0, 10.0, 0.0])
    store(spool, (0.6, 'a-1'), obb=[30.0, 40.0, 30.0, 10.0, 0.0])
    assert waiting(spool) == [(0.6, 0), (0.9, 1)]
    # Its value is the same, its rank is half of it.
    assert spool.console.revalue(ChipFilter(min_value=0.9), 1.0, 1.1) == 1
    assert waiting(spool) == [(2.0, 0), (0.6, 1)]
    assert spool.console.select(limit=1)[0].rank(0.1) == 1.0


def test_objects_of_which_no_view_was_released_for_long_are_forgotten(spool) -> None:
    for number in range(40):
        store(spool, (0.9, f'a-{number}'))
        release(spool)
    # Room for some of them.
    limit = 60_000.0
    store(spool, (0.5, 'a-0'), (0.5, 'a-39'), max_bytes=limit)
    store(spool, (0.1, 'a-1'), max_bytes=limit)
    with database(spool.folder) as rows:
        (count,) = rows.execute('SELECT count(*) FROM objects').fetchone()
    assert 10 <= count < 30
    assert waiting(spool) == [(0.5, 0), (0.1, 0), (0.5, 1)]
    spool.writer.close()


def test_views_in_a_lost_outbox_were_not_released(spool) -> None:
    store(spool, (0.9, 'a-1'), (0.8, 'a-1'), (0.7, 'a-2'))
    chips = spool.releaser.claim(2, ALL, ALL, 0).chips
    spool.releaser.released([chip.id for chip, _ in chips], is_delivered=False)
    assert waiting(spool) == [(0.8, 1)]
    assert spool.console.forget_outbox() == 2
    assert waiting(spool) == [(0.8, 0)]
    status = spool.console.status()
    assert status.counts['objects_released'] == 0
    assert status.balance == 0


def test_two_views_that_are_claimed_at_once_have_different_numbers(spool) -> None:
    store(spool, (0.9, 'a-1'), (0.8, 'a-1'), (0.7, 'a-1'))
    claim = spool.releaser.claim(2, ALL, ALL, 0)
    assert [chip.view for chip, _ in claim.chips] == [1, 2]
    spool.releaser.unclaim([claim.chips[1][0].id])
    spool.releaser.released([claim.chips[0][0].id], is_delivered=True)
    assert [each['view'] for each in release(spool, 2)] == [2, 3]


def test_an_evicted_object_waits_no_more(spool) -> None:
    store(spool, (0.5, 'a-1'), (0.6, 'a-1'), (0.7, 'a-2'), size=20_000)
    assert spool.console.status().objects_waiting == 2
    store(spool, (0.9, 'a-3'), size=20_000, max_bytes=70_000.0)
    status = spool.console.status()
    assert waiting(spool) == [(0.9, 0), (0.7, 0)]
    assert status.objects_waiting == 2


@pytest.mark.parametrize(
    'damage',
    [
        "released = 'text'",
        "released = x'ff'",
        'released = -4',
        'released = 9223372036854775807',
        "turn = 'text'",
    ],
)
def test_damage_to_what_is_remembered_stops_nothing(spool, damage) -> None:
    store(spool, (0.9, 'a-1'))
    release(spool)
    with database(spool.folder) as rows:
        rows.execute(f'UPDATE objects SET {damage}')
    store(spool, (0.8, 'a-1'), (0.7, 'a-1'), max_bytes=1e6)
    assert len(release(spool, 2)) == 2
    assert spool.console.status().balance == 0


@pytest.mark.parametrize('damage', ['k = 7', 'k = -3', "k = 'text'", "worth = 'text'"])
def test_a_chip_with_a_damaged_place_is_not_passed_over(spool, damage) -> None:
    store(spool, (0.9, 'a-1'), (0.8, 'a-1'), (0.7, ''))
    with database(spool.folder) as rows:
        rows.execute(f'UPDATE chips SET {damage} WHERE seq = 1')
    assert len(spool.console.select()) == 3
    store(spool, (0.6, 'a-1'))
    assert len(spool.releaser.claim(9, ALL, ALL, 0).chips) == 4


@pytest.mark.parametrize('damage', ['k = 7', 'k = -3', "k = 'text'", "worth = 'text'"])
def test_a_chip_with_a_damaged_place_can_be_evicted(spool, damage) -> None:
    store(spool, (0.9, 'a-1'))
    with database(spool.folder) as rows:
        rows.execute(f'UPDATE chips SET {damage} WHERE seq = 1')
    store(spool, (0.6, 'a-1'), max_bytes=1.0)
    assert spool.console.status().counts['evicted.max_bytes'] == 2


@given(st.text(), st.integers(0, 10**12), st.integers(0, 10**12))
def test_keys_fit_into_a_column_and_differ_by_the_number(text, first, second) -> None:
    one, other = key_of(f'{text}-{first}'), key_of(f'{text}-{second}')
    assert -(2**63) <= one < 2**63
    assert (one == other) == (first == second)


# Brute force


class BruteForce:
    """Random work on a spool, and after each step what the rule says of every chip."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.random = random.Random(seed)
        self.spool = SpoolUsers(folder, print)
        self.fade = self.random.choice((0.0, 0.1, 0.5))
        self.spool.writer.set_fade(self.fade)
        self.objects = self.random.choice((1, 3, 30))
        self.claimed: list[str] = []
        self.released: Counter[int] = Counter()
        self.in_outbox: list[tuple[str, int | None]] = []
        self.last = 0
        store(self.spool)

    def rows(self):
        """List the chips, past the code that is tested."""
        with database(self.spool.folder) as rows:
            return rows.execute(f'SELECT {FIELDS} FROM chips').fetchall()

    def step(self) -> None:
        """Do something."""
        work = (self.store, self.claim, self.release, self.put_back, self.delete, self.revalue)
        self.random.choices((*work, self.take_damaged, self.forget), (8, 3, 4, 1, 1, 1, 1, 1))[0]()
        self.check()

    def store(self) -> None:
        choose = self.random
        views = [
            (
                choose.choice((choose.random(), 0.5, 0.7, 0.0, -choose.random())),
                choose.choice(('', f'a-{choose.randrange(self.objects)}')),
            )
            for _ in range(choose.randrange(9))
        ]
        chips = {row[0]: row[2:5] for row in self.rows()}
        for value, object_id in views:
            self.last += 1
            chips[self.last] = (0, key_of(object_id) if object_id else None, value)
        store(self.spool, *views, size=1500, max_bytes=choose.choice((0, 60e3)))
        while len(chips) > len(self.rows()):
            due = self.due(chips)
            del chips[
                min(
                    (rank_of(worth, due[seq], self.fade), worth, seq)
                    for seq, (state, _, worth) in chips.items()
                    if state == ChipState.WAITING
                )[2]
            ]
        assert chips.keys() == {row[0] for row in self.rows()}

    def due(self, chips):
        """Return k of chips by the rule, given state, object and worth of all of them."""
        views: dict[int, list[tuple[float, int]]] = {}
        for seq, (state, key, worth) in chips.items():
            if key is not None and state != ChipState.RELEASED:
                views.setdefault(key, []).append((-worth, seq))
        return dict.fromkeys(chips, 0) | {
            seq: min(MAX_K, place + self.released[key])
            for key, places in views.items()
            for place, (_, seq) in enumerate(sorted(places))
        }

    def claim(self) -> None:
        order = sorted(
            (row for row in self.rows() if row[2] == ChipState.WAITING),
            key=lambda row: (-rank_of(row[4], row[5], self.fade), -row[4], row[0]),
        )
        count = self.random.randint(1, 6)
        claim = self.spool.releaser.claim(count, ALL, ALL, 0)
        assert [chip.id for chip, _ in claim.chips] == [row[1] for row in order[:count]]
        self.claimed += [chip.id for chip, _ in claim.chips]

    def release(self) -> None:
        self.random.shuffle(self.claimed)
        now, self.claimed = self.claimed[:3], self.claimed[3:]
        keys = {row[1]: row[3] for row in self.rows()}
        is_delivered = self.random.random() < 0.5
        self.released.update(keys[chip_id] for chip_id in now if keys[chip_id] is not None)
        self.in_outbox += [] if is_delivered else [(chip_id, keys[chip_id]) for chip_id in now]
        self.spool.releaser.released(now, is_delivered)

    def put_back(self) -> None:
        self.spool.releaser.unclaim(self.claimed)
        self.claimed = []

    def take_damaged(self) -> None:
        for chip in self.spool.console.select():
            if chip.id in self.claimed[:1]:
                self.spool.releaser.evict_damaged(chip)
                self.claimed.pop(0)

    def delete(self) -> None:
        self.spool.console.delete(
            ChipFilter(objects=[f'a-{self.random.randrange(self.objects)}'], min_value=0.4)
        )

    def revalue(self) -> None:
        low = self.random.random()
        chips = ChipFilter(min_value=low, max_value=low + 0.3)
        self.spool.console.revalue(chips, self.random.choice((0.5, 2.0)), -0.1)

    def forget(self) -> None:
        self.spool.console.forget_outbox()
        self.released.subtract(key for _, key in self.in_outbox if key is not None)
        self.in_outbox = []

    def check(self) -> None:
        """Compare every k with the rule."""
        chips = [row for row in self.rows() if row[2] != ChipState.RELEASED]
        due = self.due({row[0]: row[2:5] for row in chips})
        assert {row[0]: row[5] for row in chips} == due
        status = self.spool.console.status()
        assert status.balance == 0
        assert status.objects_waiting == len({row[3] for row in chips} - {None})
        assert status.counts.get('objects_released', 0) >= len(+self.released)
        assert all(chip.is_intact() for chip in self.spool.console.select(ANY_CHIP))


@given(st.integers(0, 2**32))
@settings(max_examples=20, deadline=None)
def test_ranks_are_those_of_the_rule_whatever_is_done(seed) -> None:
    # In memory, where there is one: the disk is not what is tested.
    memory = Path('/dev/shm')
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        work = BruteForce(Path(folder), seed)
        for _ in range(60):
            work.step()
        assert work.spool.console.integrity() == []
        work.spool.close()
