# SPDX-License-Identifier: Apache-2.0
"""Pairs by stamp: each item has one fate, and what waits is bounded."""

from collections import Counter
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.downlink.joiner import JoinerSide
from obbhbb_ros.downlink.joiner import Lateness
from obbhbb_ros.downlink.joiner import PairLimits
from obbhbb_ros.downlink.joiner import StampCache
from obbhbb_ros.downlink.joiner import Unpaired

CAPACITY = 2, 3
MAX_AGE = 1.0


class Log:
    """Joins items of kind 0, images, and 1, plans, and keeps what was dropped."""

    def __init__(self, capacity=CAPACITY):
        self.capacity = capacity
        self.dropped = []
        self.jumps_back = []
        self.sides = [
            JoinerSide(partial(self._on_dropped, kind), partial(self._on_jump_back, kind))
            for kind in (0, 1)
        ]
        self.sides[0].pair_with(self.sides[1])

    def _on_dropped(self, kind, reason, item):
        self.dropped.append((kind, reason, item))

    def _on_jump_back(self, kind, latest, stamp):
        self.jumps_back.append((kind, latest, stamp))

    def add(self, kind, stamp, item, now=0.0, slop=0.0):
        """Add an item as the node does, and return it with its partner."""
        if isinstance(stamp, int):
            stamp = stamp, 0
        for side in self.sides:
            side.expire(now, MAX_AGE)
        partner = self.sides[kind].add(stamp, item, now, self.capacity[kind])
        if partner is not None:
            return (partner, item) if kind else (item, partner)
        return next(self.near(now, slop), None)

    def near(self, now, slop):
        """Take the pairs whose stamps differ."""
        return self.sides[0].near_pairs(now, slop, MAX_AGE)

    def waiting(self, kind):
        return list(self.sides[kind].waiting)


@pytest.mark.parametrize('kinds', [(0, 1), (1, 0)])
def test_either_may_come_first(kinds) -> None:
    log = Log()
    first, second = kinds
    assert log.add(first, 5, f'item {first}') is None
    assert log.add(second, 5, f'item {second}') == ('item 0', 'item 1')
    assert log.dropped == []


def test_stamps_may_come_out_of_order() -> None:
    log = Log()
    for stamp in (1, 2):
        log.add(0, stamp, stamp)
    assert log.add(1, 2, 'b') == (2, 'b')
    assert log.add(1, 1, 'a') == (1, 'a')


def test_a_stamp_that_differs_by_a_nanosecond_is_another() -> None:
    log = Log()
    log.add(0, (1, 1), 'image')
    assert log.add(1, (1, 2), 'regions') is None


def test_what_waits_too_long_expires() -> None:
    log = Log()
    log.add(0, 1, 'early', now=0.0)
    log.add(0, 2, 'later', now=0.5)
    assert log.add(1, 1, 'late', now=1.1) is None
    assert log.dropped == [(0, Unpaired.EXPIRED, 'early'), (1, Unpaired.PARTNER_GONE, 'late')]
    assert log.add(1, 2, 'in time', now=1.2) == ('later', 'in time')


def test_the_oldest_goes_when_there_are_too_many() -> None:
    log = Log()
    for stamp in (1, 2, 3):
        log.add(0, stamp, stamp)
    assert log.dropped == [(0, Unpaired.CROWDED_OUT, 1)]


def test_what_comes_again_while_it_waits_takes_its_own_place() -> None:
    log = Log()
    log.add(0, 1, 'first', now=0.0)
    assert log.add(0, 1, 'second', now=0.9) is None
    assert log.dropped == [(0, Unpaired.DUPLICATE, 'first')]
    assert log.add(1, 1, 'regions', now=1.5) == ('second', 'regions')


def test_what_comes_again_after_its_pair_is_dropped() -> None:
    log = Log()
    log.add(0, 1, 'first')
    log.add(1, 1, 'regions')
    assert log.add(0, 1, 'second') is None
    assert log.dropped == [(0, Unpaired.DUPLICATE, 'second')]


def test_a_pair_is_forgotten_by_age() -> None:
    log = Log()
    for now in (0.0, 1.1):
        assert log.add(0, 1, 'image', now) is None
        assert log.add(1, 1, 'regions', now) == ('image', 'regions')
    assert log.dropped == log.jumps_back == []


@pytest.mark.parametrize('lag', [0, 1])
@pytest.mark.parametrize('frames', [3, 7, 30])
def test_stamps_that_begin_again_pair_again(frames, lag) -> None:
    log = Log()
    stamps = list(range(1, frames + 1)) * 3
    pairs = []
    for i in range(len(stamps) + lag):
        if i < len(stamps):
            pairs.append(log.add(0, stamps[i], stamps[i], 0.01 * i))
        if i >= lag:
            pairs.append(log.add(1, stamps[i - lag], stamps[i - lag], 0.01 * i))
    assert [pair for pair in pairs if pair] == [(stamp, stamp) for stamp in stamps]
    assert log.dropped == []
    back = ((frames, 0), (1, 0))
    assert Counter(log.jumps_back) == {(0, *back): 2, (1, *back): 2}


def test_a_stamp_of_zero_pairs_with_nothing() -> None:
    log = Log()
    log.add(0, 0, 'image')
    assert log.add(1, 0, 'regions') is None
    assert [reason for _, reason, _ in log.dropped] == [Unpaired.ZERO_STAMP] * 2


def test_clearing_drops_everything() -> None:
    log = Log()
    log.add(0, 1, 'image')
    log.add(1, 2, 'regions')
    for side in log.sides:
        side.clear()
    assert [(kind, reason) for kind, reason, _ in log.dropped] == [
        (0, Unpaired.CLEARED),
        (1, Unpaired.CLEARED),
    ]


EVENT = st.tuples(st.integers(0, 1), st.integers(-3, 6), st.floats(0.0, 0.7))


@given(st.lists(EVENT, max_size=60))
def test_every_item_has_one_fate_and_what_waits_is_bounded(events) -> None:
    log = Log()
    now, pairs = 0.0, []
    for number, (kind, stamp, pause) in enumerate(events):
        now += pause
        pair = log.add(kind, stamp, (number, stamp), now)
        if pair:
            pairs.append(pair)
            assert pair[0][1] == pair[1][1] != 0
        waiting = log.waiting(0), log.waiting(1)
        assert len(waiting[0]) <= CAPACITY[0]
        assert len(waiting[1]) <= CAPACITY[1]
    fates = [item for pair in pairs for item in pair]
    fates += [item for _, _, item in log.dropped] + waiting_items(log)
    assert Counter(number for number, _ in fates) == Counter(range(len(events)))
    passes = 1 + len(log.jumps_back)
    assert max(Counter(pair[0][1] for pair in pairs).values(), default=0) <= passes


def waiting_items(log):
    return log.waiting(0) + log.waiting(1)


def test_pairs_of_long_ago_are_forgotten() -> None:
    log = Log()
    for stamp in [*range(1, 3000), 1]:
        log.add(0, stamp, stamp)
        assert log.add(1, stamp, stamp) == (stamp, stamp)


# Stamps that differ


@pytest.mark.parametrize('second', [(5, 10_000_000), (4, 990_000_000)])
@pytest.mark.parametrize('kinds', [(0, 1), (1, 0)])
@pytest.mark.parametrize('slop', [0.0, 0.009, 0.01, 0.02])
def test_stamps_that_differ_by_no_more_than_the_slop_pair_in_the_end(second, kinds, slop) -> None:
    log = Log()
    assert log.add(kinds[0], (5, 0), kinds[0], slop=slop) is None
    assert log.add(kinds[1], second, kinds[1], slop=slop) is None
    assert list(log.near(0.9 * slop, slop)) == []
    assert list(log.near(slop, slop)) == ([(0, 1)] if slop >= 0.01 else [])
    assert log.dropped == []


def test_an_equal_stamp_on_its_way_wins() -> None:
    log, slop = Log(capacity=(9, 9)), 1.5
    # The plans come before their images, and only every third image has one.
    pairs = []
    for stamp in range(1, 31):
        now = 0.01 * stamp
        if stamp % 3 == 0:
            pairs.append(log.add(1, stamp, stamp, now, slop))
        pairs.append(log.add(0, stamp, stamp, now, slop))
    assert [pair for pair in pairs if pair] == [(stamp, stamp) for stamp in range(3, 31, 3)]


def test_an_unequal_stamp_is_taken_when_later_ones_of_both_kinds_have_come() -> None:
    log, slop = Log(capacity=(9, 9)), 4e-9
    assert log.add(0, (5, 10), 'image', slop=slop) is None
    # A plan of the stamp 10 is not to come any more, but an image of the stamp 12 is.
    assert log.add(1, (5, 12), 'plan', slop=slop) is None
    assert log.add(0, (5, 20), 'next', slop=slop) == ('image', 'plan')
    assert log.waiting(0) == ['next']


@pytest.mark.parametrize(
    ('stamp', 'partner'),
    [
        (100, 100),
        (104, 100),
        (105, 100),
        (106, 110),
        (95, 100),
        (120, 120),
        (125, 120),
        (131, None),
        (90, 100),
        (89, None),
    ],
)
def test_the_nearest_waiting_stamp_is_the_partner_the_earlier_of_two(stamp, partner) -> None:
    log = Log(capacity=(5, 5))
    for nanoseconds in (100, 110, 120):
        log.add(0, (5, nanoseconds), nanoseconds)
    pair = log.add(1, (5, stamp), 'plan') or next(log.near(0.5, slop=10e-9), None)
    assert pair == (None if partner is None else (partner, 'plan'))


def test_a_pair_that_still_waits_keeps_both_for_itself() -> None:
    log, slop = Log(capacity=(5, 5)), 0.1
    log.add(0, (5, 0), 'image', now=0.0)
    log.add(1, (4, 950_000_000), 'far', now=0.0)
    log.add(1, (5, 10_000_000), 'near', now=0.09)
    assert list(log.near(0.15, slop)) == []
    assert list(log.near(0.2, slop)) == [('image', 'near')]


def test_near_stamps_pair_before_they_are_too_old() -> None:
    log = Log()
    log.add(0, (5, 0), 'image', now=0.0)
    log.add(1, (8, 0), 'plan', now=0.0)
    assert list(log.near(MAX_AGE, slop=60.0)) == [('image', 'plan')]


def test_an_item_is_paired_once_whatever_is_near() -> None:
    log, slop = Log(), 10e-9
    log.add(0, (5, 100), 'image', slop=slop)
    log.add(1, (5, 101), 'first', slop=slop)
    assert list(log.near(0.1, slop)) == [('image', 'first')]
    # The same plan again, and the same image: both have had their partner.
    assert log.add(1, (5, 101), 'first', slop=slop) is None
    assert log.add(1, (5, 102), 'second', slop=slop) is None
    assert log.add(0, (5, 100), 'image', slop=slop) is None
    assert log.dropped == [(1, Unpaired.DUPLICATE, 'first'), (0, Unpaired.DUPLICATE, 'image')]


NANOSECONDS = st.lists(st.tuples(st.integers(0, 1), st.integers(1, 200)), max_size=50, unique=True)


@given(NANOSECONDS, st.integers(0, 30))
def test_no_pair_is_farther_apart_than_the_slop_and_none_is_left_that_is_not(events, slop) -> None:
    log = Log(capacity=(100, 100))
    pairs = []
    for kind, stamp in events:
        if pair := log.add(kind, (0, stamp), stamp):
            assert pair[0] == pair[1]
            pairs.append(pair)
    pairs += log.near(0.5, slop * 1e-9)
    assert all(abs(image - plan) <= slop for image, plan in pairs)
    images, plans = log.waiting(0), log.waiting(1)
    if slop:
        assert not any(abs(image - plan) <= slop for image in images for plan in plans)
    fates = [*images, *plans, *(stamp for pair in pairs for stamp in pair)]
    assert sorted(fates) == sorted(stamp for _, stamp in events)
    assert log.dropped == []


# What came too late


@pytest.mark.parametrize('images', [0, 3])
def test_a_plan_whose_image_is_gone_is_dropped_with_what_would_have_kept_it(images) -> None:
    late, dropped = [], []
    sides = [
        JoinerSide(lambda *fate: dropped.append(fate), print, size_of=len),
        JoinerSide(
            lambda *fate: dropped.append(fate), print, lambda item, note: late.append((item, note))
        ),
    ]
    sides[0].pair_with(sides[1])
    for second in range(1, 7):
        sides[0].add((second, 0), b'.' * 100, 0.1 * second, images, max_bytes=350)
    assert dropped == [(Unpaired.CROWDED_OUT, b'.' * 100)] * 3
    assert sides[1].add((3, 0), 'plan', 1.3) is None
    ((item, lateness),) = late
    assert (item, lateness.items, lateness.bytes) == ('plan', 4, 400)
    assert lateness.age == pytest.approx(1.0)
    assert dropped[3:] == [(Unpaired.PARTNER_GONE, 'plan')]
    assert sides[1].add((4, 0), 'in time', 1.3) == b'.' * 100
    # From the start: the image may come again.
    sides[1].add((2, 0), 'again', 1.4)
    assert list(sides[1].waiting) == ['again']


def test_the_newest_item_stays_whatever_its_size() -> None:
    dropped = []
    cache = StampCache(lambda *fate: dropped.append(fate), size_of=len)
    for item in ('small', 'large' * 10, 'tiny'):
        cache.put((len(item), 0), item, 0.0, max_bytes=8)
        assert list(cache) == [item]
    assert dropped == [(Unpaired.CROWDED_OUT, 'small'), (Unpaired.CROWDED_OUT, 'large' * 10)]


@pytest.mark.parametrize(
    ('lateness', 'text'),
    [
        (Lateness(1.0, 3, 3100), 'more than cache.max_bytes waited; 3100 bytes are needed'),
        (Lateness(1.0, 31, 310), 'more than cache.images waited; 31 images are needed'),
        (Lateness(3.5, 3, 310), 'it waited longer than cache.max_age'),
        (
            Lateness(3.5, 3, 3100),
            'more than cache.max_bytes waited; 3100 bytes are needed, '
            'and it waited longer than cache.max_age',
        ),
    ],
)
def test_the_shortage_names_limit_and_need(lateness, text) -> None:
    assert PairLimits(max_bytes=1000.0, images=10, max_age=2.0).shortage(lateness) == text


def test_an_error_of_the_callback_costs_no_other_item() -> None:
    fates = []

    def on_dropped(_, item):
        fates.append(item)
        if len(fates) == 1:
            raise RuntimeError('the log is full')

    plans = JoinerSide(on_dropped, print)
    plans.pair_with(JoinerSide(print, print))
    for second in (1, 2, 3):
        plans.add((second, 0), second, 0.0, 3)
    with pytest.raises(RuntimeError, match='the log is full'):
        plans.expire(2.0, MAX_AGE)
    plans.expire(2.0, MAX_AGE)
    assert fates == [1, 2, 3]


# The cache that both sides are made of


def test_a_cache_reports_what_it_drops_the_oldest_first() -> None:
    dropped = []
    cache = StampCache(lambda *fate: dropped.append(fate))
    for second in range(7):
        cache.put((second, 0), second, 0.1 * second, max_count=6)
    assert dropped == [(Unpaired.CROWDED_OUT, 0)]
    assert cache.pop((6, 0)) == 6
    assert cache.pop((6, 0)) is None
    cache.expire(1.25, 1.0)
    cache.put((9, 0), 9, 1.3, max_count=3)
    assert dropped[1:] == [
        (Unpaired.EXPIRED, 1),
        (Unpaired.EXPIRED, 2),
        (Unpaired.CROWDED_OUT, 3),
    ]
    assert (len(cache), (4, 0) in cache, (2, 0) in cache) == (3, True, False)
    cache.clear()
    assert dropped[4:] == [(Unpaired.CLEARED, item) for item in (4, 5, 9)]
    assert list(cache) == []


def test_an_item_that_takes_the_place_of_another_is_the_newest() -> None:
    dropped = []
    cache = StampCache(lambda *fate: dropped.append(fate))
    for item in ('a', 'b'):
        cache.put((ord(item), 0), item, 0.0, max_count=2)
    cache.put((ord('a'), 0), 'c', 1.0, max_count=2)
    assert list(cache) == ['b', 'c']
    cache.expire(1.5, 1.0)
    assert dropped == [(Unpaired.DUPLICATE, 'a'), (Unpaired.EXPIRED, 'b')]


def test_an_item_that_is_renewed_waits_from_then_on() -> None:
    dropped = []
    cache = StampCache(lambda *fate: dropped.append(fate))
    for second in (1, 2, 3):
        cache.put((second, 0), second, 0.0, max_count=3)
    cache.renew((1, 0), 0.5)
    cache.renew((4, 0), 0.5)
    cache.expire(1.2, 1.0)
    assert (list(cache), dropped) == ([1], [(Unpaired.EXPIRED, 2), (Unpaired.EXPIRED, 3)])
