# SPDX-License-Identifier: Apache-2.0
"""The simulation of what the spool is worth: its books, and what no strategy may do."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / 'benchmarks'))

from passes import ORDERS
from passes import Day
from passes import Outcome
from passes import simulate
from passes import table

# A frame of it is 37 chips, about 100 kB with their JSON.
DAY = Day(frames=24, contacts=2, contact_frames=3, rate=2e3, spool_bytes=5e5)


@pytest.fixture(scope='module')
def outcome() -> Outcome:
    return simulate(DAY)


@pytest.mark.parametrize('name', ORDERS)
def test_every_chip_is_delivered_waiting_or_evicted(outcome: Outcome, name: str) -> None:
    books = outcome.books[name]
    assert books.balance == books.in_work == books.in_outbox == books.total('refused') == 0
    assert books.counts['planned'] == len(outcome.values) == 24 * 37
    assert books.counts['delivered'] == len(outcome.delivered[name])
    # All of it happens, or there is nothing to compare.
    assert min(books.counts['delivered'], books.waiting, books.counts['evicted.max_bytes']) > 0


@pytest.mark.parametrize('name', [*ORDERS, 'drop at once'])
def test_a_contact_carries_no_more_than_it_can(outcome: Outcome, name: str) -> None:
    for window in DAY.windows:
        start, stop = window.start * DAY.period, window.stop * DAY.period
        carried = sum(each.bytes for each in outcome.delivered[name] if start <= each.at < stop)
        assert 0 < carried <= DAY.capacity / DAY.contacts


@pytest.mark.parametrize('name', [*ORDERS, 'drop at once'])
def test_nothing_is_delivered_without_contact_or_before_it_is_planned(
    outcome: Outcome, name: str
) -> None:
    for each in outcome.delivered[name]:
        assert any(int(each.at // DAY.period) in window for window in DAY.windows)
        assert 0.0 <= each.age <= each.at


@pytest.mark.parametrize('name', ORDERS)
def test_no_spool_delivers_more_value_than_the_contacts_can_carry(
    outcome: Outcome, name: str
) -> None:
    value = sum(each.value for each in outcome.delivered[name])
    assert 0.0 < value <= outcome.best_by_byte()
    assert outcome.best() <= outcome.best_by_byte() <= outcome.values.sum()


def test_what_is_dropped_at_once_is_never_old(outcome: Outcome) -> None:
    sent = outcome.delivered['drop at once']
    assert {each.at for each in sent} == {
        frame * DAY.period for window in DAY.windows for frame in window
    }
    assert {each.age for each in sent} == {0.0}


def test_the_table_has_a_row_for_each_strategy_and_each_bound(outcome: Outcome) -> None:
    rows = table(outcome).splitlines()[2:]
    assert len(rows) == len(ORDERS) + 3


def test_contacts_that_do_not_fit_into_the_day_are_refused() -> None:
    with pytest.raises(ValueError, match='100 frames are too few, at least 128'):
        Day(frames=100)


def test_a_strategy_that_delivers_nothing_is_drawn_all_the_same(tmp_path) -> None:
    delivery = pytest.importorskip('delivery')
    curves = {'all': (np.array([1.0, 2.0]), np.array([3.0, 4.0])), 'none': (np.empty(0),) * 2}
    figure = delivery.delivery_figure(curves, 8.0, [(1.0, 2.5)], 6.0, 'synthetic')
    figure.savefig(tmp_path / 'passes.png')
    lines = figure.axes[0].get_lines()
    assert [line.get_ydata()[-1] for line in lines] == [8.0, 7.0, 0.0]
