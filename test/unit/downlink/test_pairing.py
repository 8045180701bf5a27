# SPDX-License-Identifier: Apache-2.0
"""Pairs by stamp: each item has one fate, and what waits is bounded."""

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.downlink.pairing import Pairing
from obbhbb_ros.downlink.pairing import PairingLimits
from obbhbb_ros.downlink.pairing import Unpaired

LIMITS = PairingLimits((2, 3), 1.0)


class Log:
    """Keeps what was let go."""

    def __init__(self):
        self.let_go = []
        self.ran_back = []
        self.pairing = Pairing(
            lambda *args: self.let_go.append(args), lambda *args: self.ran_back.append(args)
        )

    def add(self, kind, stamp, item, now=0.0):
        return self.pairing.add(kind, (stamp, 0), item, now, LIMITS)


@pytest.mark.parametrize('kinds', [(0, 1), (1, 0)])
def test_either_may_come_first(kinds) -> None:
    log = Log()
    first, second = kinds
    assert log.add(first, 5, f'item {first}') is None
    assert log.add(second, 5, f'item {second}') == ('item 0', 'item 1')
    assert log.let_go == []


def test_stamps_may_come_out_of_order() -> None:
    log = Log()
    for stamp in (1, 2):
        log.add(0, stamp, stamp)
    assert log.add(1, 2, 'b') == (2, 'b')
    assert log.add(1, 1, 'a') == (1, 'a')


def test_a_stamp_that_differs_by_a_nanosecond_is_another() -> None:
    log = Log()
    log.pairing.add(0, (1, 1), 'image', 0.0, LIMITS)
    assert log.pairing.add(1, (1, 2), 'regions', 0.0, LIMITS) is None


def test_what_waits_too_long_expires() -> None:
    log = Log()
    log.add(0, 1, 'early', now=0.0)
    log.add(0, 2, 'later', now=0.5)
    assert log.add(1, 1, 'late', now=1.1) is None
    assert log.let_go == [(0, Unpaired.EXPIRED, 'early')]
    assert log.add(1, 2, 'in time', now=1.2) == ('later', 'in time')


def test_the_oldest_goes_when_there_are_too_many() -> None:
    log = Log()
    for stamp in (1, 2, 3):
        log.add(0, stamp, stamp)
    assert log.let_go == [(0, Unpaired.CROWDED_OUT, 1)]


def test_what_comes_again_while_it_waits_takes_its_own_place() -> None:
    log = Log()
    log.add(0, 1, 'first', now=0.0)
    assert log.add(0, 1, 'second', now=0.9) is None
    assert log.let_go == [(0, Unpaired.DUPLICATE, 'first')]
    assert log.add(1, 1, 'regions', now=1.5) == ('second', 'regions')


def test_what_comes_again_after_its_pair_is_let_go() -> None:
    log = Log()
    log.add(0, 1, 'first')
    log.add(1, 1, 'regions')
    assert log.add(0, 1, 'second') is None
    assert log.let_go == [(0, Unpaired.DUPLICATE, 'second')]


def test_a_pair_is_forgotten_by_age() -> None:
    log = Log()
    for now in (0.0, 1.1):
        assert log.add(0, 1, 'image', now) is None
        assert log.add(1, 1, 'regions', now) == ('image', 'regions')
    assert log.let_go == log.ran_back == []


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
    assert log.let_go == []
    back = ((frames, 0), (1, 0))
    assert Counter(log.ran_back) == {(0, *back): 2, (1, *back): 2}


def test_a_stamp_of_zero_pairs_with_nothing() -> None:
    log = Log()
    log.add(0, 0, 'image')
    assert log.add(1, 0, 'regions') is None
    assert [reason for _, reason, _ in log.let_go] == [Unpaired.ZERO_STAMP] * 2


def test_clearing_lets_everything_go() -> None:
    log = Log()
    log.add(0, 1, 'image')
    log.add(1, 2, 'regions')
    log.pairing.clear()
    assert [(kind, reason) for kind, reason, _ in log.let_go] == [
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
        waiting = log.pairing.waiting(0), log.pairing.waiting(1)
        assert len(waiting[0]) <= LIMITS.capacity[0]
        assert len(waiting[1]) <= LIMITS.capacity[1]
    fates = [item for pair in pairs for item in pair]
    fates += [item for _, _, item in log.let_go] + waiting_items(log)
    assert Counter(number for number, _ in fates) == Counter(range(len(events)))
    passes = 1 + len(log.ran_back)
    assert max(Counter(pair[0][1] for pair in pairs).values(), default=0) <= passes


def waiting_items(log):
    return log.pairing.waiting(0) + log.pairing.waiting(1)


def test_pairs_of_long_ago_are_forgotten() -> None:
    log = Log()
    for stamp in [*range(1, 3000), 1]:
        log.add(0, stamp, stamp)
        assert log.add(1, stamp, stamp) == (stamp, stamp)


# Stamps that differ


def slop_of(seconds):
    return PairingLimits((5, 5), 10.0, seconds)


@pytest.mark.parametrize('second', [(5, 10_000_000), (4, 990_000_000)])
@pytest.mark.parametrize('kinds', [(0, 1), (1, 0)])
@pytest.mark.parametrize('slop', [0.0, 0.009, 0.01, 0.02])
def test_stamps_that_differ_by_no_more_than_the_slop_pair(second, kinds, slop) -> None:
    log = Log()
    log.pairing.add(kinds[0], (5, 0), kinds[0], 0.0, slop_of(slop))
    pair = log.pairing.add(kinds[1], second, kinds[1], 0.0, slop_of(slop))
    assert pair == ((0, 1) if slop >= 0.01 else None)
    assert log.let_go == []


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
    log, limits = Log(), slop_of(10e-9)
    for each in (100, 110, 120):
        log.pairing.add(0, (5, each), each, 0.0, limits)
    pair = log.pairing.add(1, (5, stamp), 'plan', 0.0, limits)
    assert pair == (None if partner is None else (partner, 'plan'))


def test_an_item_is_paired_once_whatever_is_near() -> None:
    log, limits = Log(), slop_of(10e-9)
    log.pairing.add(0, (5, 100), 'image', 0.0, limits)
    assert log.pairing.add(1, (5, 101), 'first', 0.0, limits) == ('image', 'first')
    # The same plan again, and the same image: both have had their partner.
    assert log.pairing.add(1, (5, 101), 'first', 0.0, limits) is None
    assert log.pairing.add(1, (5, 102), 'second', 0.0, limits) is None
    assert log.pairing.add(0, (5, 100), 'image', 0.0, limits) is None
    assert log.let_go == [(1, Unpaired.DUPLICATE, 'first'), (0, Unpaired.DUPLICATE, 'image')]


NANOSECONDS = st.lists(st.tuples(st.integers(0, 1), st.integers(1, 200)), max_size=50, unique=True)


@given(NANOSECONDS, st.integers(0, 30))
def test_no_pair_is_farther_apart_than_the_slop(events, slop) -> None:
    log, limits = Log(), PairingLimits((100, 100), 10.0, slop * 1e-9)
    paired = 0
    for kind, stamp in sorted(events, key=lambda event: event[1]):
        waiting = [each for each in log.pairing.waiting(1 - kind) if abs(each - stamp) <= slop]
        pair = log.pairing.add(kind, (0, stamp), stamp, 0.0, limits)
        assert (pair is not None) == bool(waiting)
        if pair:
            paired += 2
            assert pair[kind] == stamp
            assert abs(pair[0] - pair[1]) == min(abs(each - stamp) for each in waiting)
    assert paired + len(waiting_items(log)) == len(events)
    assert log.let_go == []
