# SPDX-License-Identifier: Apache-2.0
"""Ship lists on their way to the outbox: every ship once, before any chip, whatever happens."""

import json
import shutil
import sqlite3
from contextlib import closing
from hashlib import sha256

import pytest
from hypothesis import given
from hypothesis import settings as profile
from hypothesis import strategies as st
from spooled import Clock
from spooled import feeder
from spooled import in_outbox
from spooled import ship_report
from spooled import store

from obbhbb_ros.downlink.budget import BudgetSettings
from obbhbb_ros.reports import seen_ships
from obbhbb_ros.reports.ship_list import read_ship_list
from obbhbb_ros.spool import list_spool
from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.catalogue import catalogue_files
from obbhbb_ros.spool.feeder import ReleaseSettings
from obbhbb_ros.spool.list_spool import FOLDER
from obbhbb_ros.spool.list_spool import ListSpool
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.spool.seals import is_sealed
from obbhbb_ros.spool.writer import SpoolWriter

FREE = ReleaseSettings()
REMOVAL = ReleaseSettings(removal=True)


def numbers(ships):
    """Return the numbers of ships."""
    return [int(each.id.partition('-')[2]) for each in ships]


class Chain:
    """A tracker's lists, a writer of chips, a feeder, a bus, and what they report."""

    def __init__(self, folder, settings=FREE):
        self.folder, self.settings = folder, settings
        self.troubles, self.clock, self.down = [], Clock(), {}
        self.lists = ListSpool(folder / 'spool', self.troubles.append)
        self.writer = SpoolWriter(folder / 'spool', self.troubles.append)
        self.feeder = feeder(folder, self.troubles.append, self.clock, settings)

    def steps(self, count=3, seconds=2.0):
        """Release, and let time go by."""
        for _ in range(count):
            self.feeder.step()
            self.clock.now += seconds

    def restart(self):
        """End feeder and tracker at once, and start others."""
        self.feeder.close()
        self.lists.close()
        self.lists = ListSpool(self.folder / 'spool', self.troubles.append)
        self.feeder = feeder(self.folder, self.troubles.append, self.clock, self.settings)

    def bus(self):
        """Take the lists that are complete in the outbox; return the numbers of their ships."""
        taken = []
        for path in sorted((self.folder / 'outbox').glob('0/[!.]*.json')):
            described = json.loads(path.read_text(encoding='utf-8'))
            if described.get('kind') != 'ships':
                continue
            assert is_sealed(path.read_bytes())
            (file,) = (other for other in path.parent.glob(f'{path.stem}.*') if other != path)
            content = file.read_bytes()
            suffix = {'geojson': '.geojson.gz', 'message': '.ships'}[described['format']]
            assert file.name == described['id'] + suffix
            assert described['bytes'] == len(content)
            assert described['sha256'] == sha256(content).hexdigest()
            ships = read_ship_list(content)
            assert described['ships'] == len(ships)
            self.down[path.stem] = ships
            taken += numbers(ships)
            file.unlink()
            path.unlink()
        return taken

    def status(self):
        """Read the books, which balance."""
        status = self.lists.status()
        assert status.balance == 0, status
        return status

    def close(self):
        self.feeder.close()
        self.lists.close()
        self.writer.close()


@pytest.fixture
def chain(tmp_path):
    made = Chain(tmp_path)
    yield made
    made.close()


def test_a_list_goes_before_any_chip(chain):
    store(chain.writer, [0.9] * 20)
    chain.lists.add([ship_report(1), ship_report(2)])
    chain.feeder.step()
    assert in_outbox(chain.folder / 'outbox') == {}
    assert chain.bus() == [1, 2]
    chain.steps()
    assert len(in_outbox(chain.folder / 'outbox')) == 20
    assert chain.troubles == []


def test_at_most_one_list_waits_and_the_next_takes_its_ships_over(chain):
    chain.lists.add([ship_report(1), ship_report(2)])
    chain.lists.add([ship_report(2, first=5, last=10**10, views=3), ship_report(3)])
    assert chain.status().ships_waiting == 3
    chain.steps()
    assert chain.bus() == [1, 2, 3]
    (ships,) = chain.down.values()
    assert [each.views for each in ships] == [1, 4, 1]
    assert ships[1].last == 10**10
    counts = chain.status().counts
    assert (counts['ships_added'], counts['ships_merged'], counts['ships_released']) == (4, 1, 3)
    assert (counts['released'], counts['delivered']) == (1, 1)


def test_a_list_larger_than_the_link_carries_at_once_goes_in_parts(tmp_path):
    budget = BudgetSettings(bytes_per_second=1000.0, burst=1500.0, overhead=50)
    chain = Chain(tmp_path, ReleaseSettings(budget=budget))
    store(chain.writer, [0.9])
    chain.lists.add([ship_report(number) for number in range(100)])
    chain.steps(1)
    first = chain.bus()
    assert 0 < len(first) < 60
    assert set(first) == set(range(100 - len(first), 100)), 'the most valuable go first'
    assert in_outbox(chain.folder / 'outbox') == {}
    chain.steps(20)
    rest = chain.bus()
    assert sorted(first + rest) == list(range(100))
    assert len(in_outbox(chain.folder / 'outbox')) == 1
    assert chain.status().counts['ships_released'] == 100
    assert chain.troubles == []
    chain.close()


def test_messages_hold_what_fits_and_the_rest_goes_in_the_next(chain):
    chain.lists.add([ship_report(number) for number in range(50)], max_bytes=340)
    chain.steps(5)
    assert sorted(chain.bus()) == list(range(50))
    assert [len(ships) for ships in chain.down.values()] == [19, 19, 12]


def test_lists_wait_for_budget_and_contact(tmp_path):
    budget = BudgetSettings(bytes_per_second=100.0, burst=2000.0)
    chain = Chain(tmp_path, ReleaseSettings(budget=budget))
    store(chain.writer, [0.9])
    chain.feeder.steer(chain.settings, is_contact=False)
    chain.lists.add([ship_report(1)])
    chain.steps()
    assert chain.bus() == []
    chain.feeder.steer(chain.settings, is_contact=True)
    chain.steps(1, seconds=0.0)
    assert chain.bus() == [1]
    chain.lists.add([ship_report(number) for number in range(2, 40)])
    chain.steps(1, seconds=0.0)
    chain.lists.add([ship_report(40)])
    chain.steps(1, seconds=20.0)
    assert chain.feeder.stalled_by == 'link budget'
    assert in_outbox(chain.folder / 'outbox') == {}
    chain.steps(1)
    assert sorted(chain.bus()) == list(range(2, 41))
    chain.close()


def test_a_ship_that_the_link_cannot_carry_is_reported_and_chips_go_on(tmp_path):
    chain = Chain(tmp_path, ReleaseSettings(budget=BudgetSettings(1000.0, burst=700.0)))
    store(chain.writer, [0.9], size=100)
    chain.lists.add([ship_report(1, class_id=str(list(range(700))))])
    chain.steps(4)
    assert len(in_outbox(chain.folder / 'outbox')) == 1
    assert any('budget.burst' in text for text in chain.troubles)
    assert chain.status().ships_waiting == 1
    chain.close()


def test_lists_are_delivered_when_the_bus_has_taken_them(tmp_path):
    chain = Chain(tmp_path, REMOVAL)
    chain.lists.add([ship_report(1)])
    chain.steps()
    status = chain.status()
    assert status.in_outbox == 1
    assert 'delivered' not in status.counts
    assert chain.bus() == [1]
    chain.steps()
    status = chain.status()
    assert (status.in_outbox, status.counts['delivered']) == (0, 1)
    chain.close()


def test_lists_in_a_lost_outbox_are_counted(tmp_path):
    chain = Chain(tmp_path, REMOVAL)
    chain.lists.add([ship_report(1)])
    chain.steps()
    shutil.rmtree(tmp_path / 'outbox')
    (tmp_path / 'outbox').mkdir()
    chain.steps(4)
    status = chain.status()
    assert (status.in_outbox, status.counts['outbox_lost']) == (0, 1)
    chain.close()


def test_too_many_ships_are_dropped_the_least_valuable_first(chain, monkeypatch):
    monkeypatch.setattr(list_spool, 'MAX_SHIPS', 10)
    chain.lists.add([ship_report(number) for number in range(8)])
    chain.lists.add([ship_report(number) for number in range(8, 16)])
    chain.steps()
    assert chain.bus() == list(range(6, 16))
    assert chain.status().counts['ships_dropped'] == 6
    assert seen_ships.MAX_SHIPS == 20_000


def test_texts_that_no_list_can_hold_cost_their_ships_alone(chain):
    long = 'x' * 9_000_000
    chain.lists.add([ship_report(1, class_id=long), ship_report(2, class_id=long), ship_report(3)])
    chain.steps()
    down = chain.bus()
    assert 3 in down
    assert chain.status().counts['ships_dropped'] == 3 - len(down) > 0
    assert chain.troubles == []


def change_rows(folder, statement):
    """Change the newest catalogue of lists."""
    path = catalogue_files(folder / 'spool' / FOLDER)[-1]
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(statement)


@pytest.mark.parametrize(
    'statement',
    [
        "UPDATE lists SET data = x'00'",
        'UPDATE lists SET data = NULL',
        "UPDATE lists SET ships = 'many'",
        "UPDATE lists SET digest = x'ff'",
        'UPDATE lists SET max_bytes = 7',
        'UPDATE lists SET state = 64',
        'UPDATE lists SET state = 1',
        'UPDATE lists SET state = 2',
        'DELETE FROM lists',
    ],
)
def test_a_damaged_list_is_counted_and_said(chain, statement):
    chain.lists.add([ship_report(1), ship_report(2)])
    change_rows(chain.folder, statement)
    chain.steps()
    chain.lists.add([ship_report(3)])
    chain.steps()
    status = chain.status()
    damaged = status.counts.get('ships_damaged', 0)
    assert sorted(chain.bus()) == ([3] if damaged else [1, 2, 3])
    assert damaged in (0, 2)
    assert bool(chain.troubles) == bool(damaged)


def test_a_damaged_catalogue_is_set_aside_and_chips_go_on(chain):
    chain.lists.add([ship_report(1)])
    store(chain.writer, [0.9])
    chain.lists.close()
    (path,) = catalogue_files(chain.folder / 'spool' / FOLDER)
    path.write_bytes(b'\xff' * path.stat().st_size)
    chain.steps(5)
    assert len(in_outbox(chain.folder / 'outbox')) == 1
    chain.lists.add([ship_report(2)])
    chain.steps(5)
    assert chain.bus() == [2]
    assert chain.status().set_aside == 1
    assert any('set aside' in text for text in chain.troubles)


def test_a_deleted_folder_of_lists_is_replaced(chain):
    chain.lists.add([ship_report(1)])
    shutil.rmtree(chain.folder / 'spool' / FOLDER)
    chain.lists.add([ship_report(2)])
    chain.steps(5)
    assert chain.bus() == [2]
    assert any('deleted' in text for text in chain.troubles)


def test_lists_that_cannot_be_stored_raise_an_error_and_chips_go_on(chain):
    (chain.folder / 'spool').mkdir()
    (chain.folder / 'spool' / FOLDER).write_text('in the way', encoding='utf-8')
    with pytest.raises(SpoolError):
        chain.lists.add([ship_report(1)])
    store(chain.writer, [0.9])
    chain.steps()
    assert len(in_outbox(chain.folder / 'outbox')) == 1


class InterruptionError(Exception):
    """An interruption between two steps."""


@pytest.mark.parametrize('settings', [FREE, REMOVAL])
@pytest.mark.parametrize('step', ['claim', 'add', 'finish', 'released'])
@pytest.mark.parametrize('is_before', [True, False])
def test_an_interruption_between_list_and_release_loses_nothing(
    tmp_path, monkeypatch, settings, step, is_before
):
    chain = Chain(tmp_path, settings)
    chain.lists.add([ship_report(1), ship_report(2)])
    owner = list_spool.ListSpool if step in ('claim', 'released') else Outbox
    original = getattr(owner, step)

    def interrupted(*args, **kwargs):
        if not is_before:
            original(*args, **kwargs)
        raise InterruptionError

    with monkeypatch.context() as patch:
        patch.setattr(owner, step, interrupted)
        chain.steps(1)
    chain.restart()
    chain.lists.add([ship_report(3)])
    chain.steps(4)
    assert sorted(chain.bus()) == [1, 2, 3]
    chain.steps(2)
    status = chain.status()
    assert status.counts['ships_released'] == 3
    assert status.counts['released'] == status.counts['delivered'] == len(chain.down)
    assert status.in_outbox == status.ships_claimed == status.ships_waiting == 0
    chain.close()


ACTIONS = st.lists(
    st.one_of(
        st.tuples(st.just('add'), st.lists(st.integers(0, 30), max_size=8, unique=True)),
        st.tuples(st.just('step'), st.integers(1, 3)),
        st.tuples(st.sampled_from(['bus', 'restart', 'contact', 'no contact']), st.just(0)),
    ),
    max_size=12,
)


@profile(max_examples=15)
@given(actions=ACTIONS, removal=st.booleans(), burst=st.sampled_from([0.0, 1200.0]))
def test_every_ship_comes_down_whatever_the_order(tmp_path_factory, actions, removal, burst):
    budget = BudgetSettings(bytes_per_second=burst, burst=burst)
    chain = Chain(tmp_path_factory.mktemp('chain'), ReleaseSettings(budget=budget, removal=removal))
    views = 0
    for name, value in actions:
        if name == 'add':
            chain.lists.add([ship_report(number) for number in value])
            views += len(value)
        elif name == 'step':
            chain.steps(value)
        elif name == 'bus':
            chain.bus()
        elif name == 'restart':
            chain.restart()
        else:
            chain.feeder.steer(chain.settings, is_contact=name == 'contact')
        if chain.lists.exists:
            chain.status()
    chain.feeder.steer(chain.settings, is_contact=True)
    chain.steps(15)
    chain.bus()
    chain.steps(2)
    assert sum(each.views for ships in chain.down.values() for each in ships) == views
    if chain.lists.exists:
        status = chain.status()
        assert status.ships_waiting == status.ships_claimed == status.in_outbox == 0
        assert status.counts.get('delivered', 0) == len(chain.down)
    assert chain.troubles == []
    chain.close()
