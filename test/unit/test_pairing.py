"""Pairs by stamp: each item has one fate, and what waits is bounded."""

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.pairing import Pairing
from obbhbb_ros.pairing import PairingLimits
from obbhbb_ros.pairing import Unpaired

LIMITS = PairingLimits((2, 3), 1.0)


class Log:
    """Keeps what was let go."""

    def __init__(self):
        self.let_go = []
        self.pairing = Pairing(lambda *args: self.let_go.append(args))

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


@pytest.mark.parametrize('paired', [False, True])
def test_what_comes_twice_is_let_go(paired) -> None:
    log = Log()
    log.add(0, 1, 'first')
    if paired:
        log.add(1, 1, 'regions')
    assert log.add(0, 1, 'second') is None
    assert log.let_go == [(0, Unpaired.DUPLICATE, 'second')]
    assert paired or log.add(1, 1, 'regions') == ('first', 'regions')


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
        (0, Unpaired.CLEARED), (1, Unpaired.CLEARED)
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
    stamps = [pair[0][1] for pair in pairs]
    assert len(stamps) == len(set(stamps))


def waiting_items(log):
    return log.pairing.waiting(0) + log.pairing.waiting(1)


def test_pairs_of_long_ago_are_forgotten() -> None:
    log = Log()
    for stamp in [*range(1, 3000), 1]:
        log.add(0, stamp, stamp)
        assert log.add(1, stamp, stamp) == (stamp, stamp)
