# SPDX-License-Identifier: Apache-2.0
"""From the spool to the outbox: in order, within the budget, each chip once."""

import errno
import json
import os
import shutil
import threading
import time
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import settings as profile
from hypothesis import strategies as st
from spooled import RELEASE
from spooled import Clock
from spooled import database
from spooled import feeder
from spooled import in_outbox
from spooled import new_chip
from spooled import store
from spooled import values_in_outbox

from obbhbb_ros.downlink.budget import BudgetSettings
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.console import SpoolConsole
from obbhbb_ros.spool.feeder import FeederThread
from obbhbb_ros.spool.feeder import ReleaseSettings
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.spool.ranking import FADE
from obbhbb_ros.spool.releaser import SpoolReleaser
from obbhbb_ros.spool.writer import SpoolWriter

REMOVAL = ReleaseSettings(removal=True)


class Ground:
    """A writer, a feeder, an operator, and what they report."""

    def __init__(self, folder, settings=RELEASE):
        self.folder, self.troubles, self.clock = folder, [], Clock()
        self.settings, self.is_contact = settings, True
        self.writer = SpoolWriter(folder / 'spool', self.troubles.append)
        self.console = SpoolConsole(folder / 'spool', self.troubles.append)
        self.open()

    def open(self):
        self.feeder = feeder(self.folder, self.troubles.append, self.clock, self.settings)
        self.is_contact = True

    def restart(self):
        """End the feeder at once, and start another."""
        self.feeder.close()
        self.open()

    def set(self, **changes):
        self.settings = replace(self.settings, **changes)
        self.feeder.steer(self.settings, self.is_contact)

    def set_contact(self, is_contact):
        self.is_contact = is_contact
        self.feeder.steer(self.settings, is_contact)

    def claimed(self):
        """List the ids of claimed chips."""
        return [chip.id for chip in self.console.select() if chip.state == ChipState.CLAIMED]

    def steps(self, count=1, seconds=0.0):
        for _ in range(count):
            self.feeder.step()
            self.clock.now += seconds

    def out(self):
        return values_in_outbox(self.folder / 'outbox')

    def remove(self, values):
        """Take chips away, as the bus does."""
        for path in list((self.folder / 'outbox').glob('*/*.json')):
            if in_outbox(self.folder / 'outbox')[path.stem]['value'] in values:
                path.with_suffix('.jpg').unlink()
                path.unlink()

    def status(self):
        status = self.writer.status()
        assert status.balance == 0
        return status

    def close(self):
        self.writer.close()
        self.console.close()
        self.feeder.close()


@pytest.fixture
def ground(tmp_path):
    made = Ground(tmp_path)
    yield made
    made.close()


def test_chips_are_released_with_their_description(ground) -> None:
    ground.writer.store(ground.writer.plan(1), [new_chip(0.9, class_id='Schlepper')], {})
    (chip,) = ground.console.select()
    ground.steps()
    assert in_outbox(ground.folder / 'outbox') == {chip.id: chip.describe(FADE)}
    status = ground.status()
    assert status.counts == {'planned': 1, 'released': 1, 'delivered': 1, 'delivered_bytes': 300}
    assert ground.feeder.stalled_by == ''
    ground.steps()
    assert ground.feeder.stalled_by == 'nothing waits'
    assert ground.troubles == []


def test_nothing_is_released_without_contact(ground) -> None:
    store(ground.writer, [0.5])
    ground.set_contact(False)
    ground.steps(3)
    assert ground.feeder.stalled_by == 'no contact'
    assert ground.out() == []
    ground.set_contact(True)
    ground.steps()
    assert ground.out() == [0.5]


def noted_puts(monkeypatch):
    """List the values of chips in the order of their release."""
    order = []
    real = Outbox.add

    def put(self, chip_id, suffix, data, description, level):
        order.append(json.loads(description)['value'])
        real(self, chip_id, suffix, data, description, level)

    monkeypatch.setattr(Outbox, 'add', put)
    return order


def test_the_order_is_by_value_over_all_frames(ground, monkeypatch) -> None:
    order = noted_puts(monkeypatch)
    values = [(7 * i % 50) / 50 for i in range(50)]
    for i in range(0, 50, 10):
        store(ground.writer, values[i : i + 10])
    ground.steps(1)
    store(ground.writer, [2.0])
    ground.steps(6)
    first = sorted(values, reverse=True)
    assert order == first[:16] + [2.0] + first[16:]


def test_a_chip_goes_into_the_folder_of_its_level(ground) -> None:
    ground.set(levels=(0.8, 0.5))
    store(ground.writer, [0.9, 0.8, 0.6, 0.1])
    ground.steps()
    assert {
        path.parent.name: path.read_bytes()[:3]
        for path in sorted((ground.folder / 'outbox').glob('*/*.jpg'))
    } == {'0': b'0.9', '1': b'0.6', '2': b'0.1'} | {'0': b'0.8'}


# Budget


@profile(max_examples=25)
@given(
    st.floats(500.0, 20_000.0),
    st.sampled_from([0.0, 1500.0, 6000.0]),
    st.sampled_from([0, 100]),
    st.lists(st.floats(0.0, 0.6), min_size=10, max_size=40),
    st.data(),
)
def test_the_budget_is_held_in_every_second(
    tmp_path_factory, rate, burst, overhead, pauses, data
) -> None:
    budget = BudgetSettings(bytes_per_second=rate, burst=burst, overhead=overhead)
    ground = Ground(tmp_path_factory.mktemp('g'), ReleaseSettings(budget=budget))
    outbox = ground.folder / 'outbox'
    sizes = data.draw(st.lists(st.integers(10, 3000), min_size=30, max_size=30))
    chips = [new_chip(0.5, size) for size in sizes]
    ground.writer.store(ground.writer.plan(30), chips, {})
    sent = [(ground.clock.now, 0)]
    for pause in pauses:
        ground.clock.now += pause
        ground.steps()
        total = sum(
            path.stat().st_size + (overhead if path.suffix == '.json' else 0)
            for path in outbox.glob('[0-9]/*')
        )
        sent.append((ground.clock.now, total))
    ground.close()
    for i, (start, before) in enumerate(sent):
        for end, after in sent[i:]:
            assert after - before <= (burst or rate) + rate * (end - start) + 1e-6
    assert set(ground.troubles) <= {'all chips that wait are larger than budget.burst'}


def test_a_less_valuable_chip_never_overtakes_one_that_waits_for_the_budget(ground) -> None:
    ground.writer.store(ground.writer.plan(2), [new_chip(0.9, 3000), new_chip(0.8, 10)], {})
    ground.set(budget=BudgetSettings(bytes_per_second=1000.0, burst=5000.0))
    ground.steps(3)
    assert ground.feeder.stalled_by == 'link budget'
    assert ground.out() == []
    ground.clock.now += 4.0
    ground.steps()
    assert 0.9 in ground.out()


def test_a_stalled_step_tells_when_the_next_makes_sense(ground) -> None:
    ground.set(budget=BudgetSettings(bytes_per_second=100_000.0))
    store(ground.writer, [0.5], 1000)
    pause = ground.feeder.step()
    # File, JSON of 300 to 500 bytes, and 128.
    assert 0.013 < pause < 0.017
    ground.clock.now += pause + 1e-6
    ground.steps()
    assert ground.out() == [0.5]


def test_a_chip_beyond_the_burst_stays_and_holds_up_nothing(ground) -> None:
    ground.set(budget=BudgetSettings(bytes_per_second=2000.0))
    ground.writer.store(ground.writer.plan(2), [new_chip(0.9, 5000), new_chip(0.8, 10)], {})
    ground.clock.now += 1.0
    ground.steps(3, 1.0)
    assert ground.out() == [0.8]
    # Said once.
    text = 'all chips that wait are larger than budget.burst'
    assert (ground.feeder.stalled_by, ground.troubles) == (text, [text])
    assert ground.status().waiting == 1


def in_the_middle(monkeypatch, after, change):
    """Do something after some chips of a batch."""
    real, count = Outbox.add, []

    def put(self, *args, **kwargs):
        real(self, *args, **kwargs)
        count.append(1)
        if len(count) == after:
            change()

    monkeypatch.setattr(Outbox, 'add', put)


CHANGES = {
    'contact lost': lambda ground: ground.set_contact(False),
    'budget set': lambda ground: ground.set(budget=BudgetSettings(bytes_per_second=5000.0)),
    'outbox limited': lambda ground: ground.set(max_bytes=1.0),
}


@pytest.mark.parametrize('change', CHANGES.values(), ids=CHANGES.keys())
def test_a_change_in_the_middle_of_a_batch_counts_at_once(ground, monkeypatch, change) -> None:
    in_the_middle(monkeypatch, 3, lambda: change(ground))
    store(ground.writer, [0.1 * i for i in range(10)])
    ground.steps()
    assert len(ground.out()) == 3
    # The others are not on their way any more.
    assert ground.claimed() == []
    assert ground.status().waiting == 7


def test_an_overhead_that_grows_in_the_middle_of_a_batch_counts_at_once(ground, monkeypatch):
    budget = BudgetSettings(bytes_per_second=10_000.0)
    ground.set(budget=budget)
    ground.steps()
    ground.clock.now += 1.0
    in_the_middle(monkeypatch, 2, lambda: ground.set(budget=replace(budget, overhead=9_500)))
    store(ground.writer, [0.1 * i for i in range(8)])
    ground.steps()
    assert len(ground.out()) == 2


def test_a_budget_that_is_lifted_counts_at_once(ground) -> None:
    ground.set(budget=BudgetSettings(bytes_per_second=10.0))
    store(ground.writer, [0.5] * 5)
    ground.steps(2)
    assert ground.out() == []
    ground.set(budget=BudgetSettings())
    ground.steps()
    assert len(ground.out()) == 5


# Delivered


def test_a_chip_is_delivered_when_the_bus_has_removed_it(tmp_path) -> None:
    ground = Ground(tmp_path, REMOVAL)
    store(ground.writer, [0.9, 0.8, 0.7])
    ground.steps(3, 2.0)
    status = ground.status()
    assert (status.in_outbox, status.waiting, status.counts['released']) == (3, 0, 3)
    assert 'delivered' not in status.counts
    ground.remove([0.8])
    ground.steps(2, 2.0)
    status = ground.status()
    assert (status.in_outbox, status.counts['delivered']) == (2, 1)
    # Both files.
    for path in (tmp_path / 'outbox').glob('*/*.json'):
        path.unlink()
    ground.steps(2, 100.0)
    assert ground.status().in_outbox == 2
    for path in (tmp_path / 'outbox').glob('*/*.jpg'):
        path.unlink()
    ground.steps(2, 100.0)
    assert ground.status().counts['delivered'] == 3
    assert ground.troubles == []
    ground.close()


def test_removal_is_noticed_after_a_restart(tmp_path) -> None:
    ground = Ground(tmp_path, REMOVAL)
    store(ground.writer, [0.9, 0.8])
    ground.steps()
    ground.remove([0.9])
    ground.restart()
    ground.steps()
    status = ground.status()
    assert (status.in_outbox, status.counts['delivered']) == (1, 1)
    ground.close()


@pytest.mark.parametrize('contact', [True, False])
def test_removal_is_noticed_without_contact_as_well(tmp_path, contact) -> None:
    ground = Ground(tmp_path, REMOVAL)
    store(ground.writer, [0.9])
    ground.steps()
    ground.remove([0.9])
    ground.set_contact(contact)
    ground.clock.now += 100.0
    ground.steps()
    assert ground.status().counts['delivered'] == 1
    ground.close()


def test_chips_that_wait_for_their_removal_still_do_after_a_change_of_settings(tmp_path) -> None:
    ground = Ground(tmp_path, REMOVAL)
    store(ground.writer, [0.9])
    ground.steps()
    ground.set(removal=False)
    store(ground.writer, [0.8])
    ground.steps(2, 100.0)
    status = ground.status()
    assert (status.in_outbox, status.counts['delivered']) == (1, 1)
    ground.remove([0.9])
    ground.steps(2, 100.0)
    status = ground.status()
    assert (status.in_outbox, status.counts['delivered']) == (0, 2)
    ground.close()


# Room in the outbox


def test_a_full_outbox_keeps_chips_in_the_spool(ground) -> None:
    ground.set(max_bytes=5000.0)
    store(ground.writer, [0.1 * i for i in range(20)])
    # It is not looked at in this time.
    ground.steps(5, 0.01)
    size = sum(path.stat().st_size for path in (ground.folder / 'outbox').glob('*/*'))
    assert 3000 < size <= 5000
    assert 'outbox is full' in ground.feeder.stalled_by
    # Once, not at every step.
    assert ground.troubles == [ground.feeder.stalled_by]
    # A more valuable one overtakes them.
    store(ground.writer, [9.0])
    ground.remove(ground.out()[:3])
    ground.steps(2, 100.0)
    assert ground.out()[0] == 9.0


def test_the_overhead_of_the_link_takes_no_room_in_the_outbox(ground) -> None:
    ground.set(
        max_bytes=2000.0,
        budget=BudgetSettings(bytes_per_second=1e6, burst=1e6, overhead=100_000),
    )
    ground.steps(1, 1.0)
    store(ground.writer, [0.9, 0.8])
    ground.steps(3, 0.1)
    assert ground.out() == [0.9, 0.8]
    assert ground.troubles == []


def test_chips_in_the_outbox_at_start_take_room(ground) -> None:
    store(ground.writer, [0.5] * 10)
    ground.steps()
    ground.set(max_bytes=5000.0)
    store(ground.writer, [0.5] * 10)
    ground.restart()
    ground.steps(3, 2.0)
    assert len(ground.out()) == 10


# Interrupted releases


class Killed(BaseException):
    """The end of a process."""


def killed_after(ground, monkeypatch, puts):
    """End the releaser after it has put out some chips."""
    real, count = Outbox.add, []

    def put(self, *args):
        if len(count) == puts:
            raise Killed
        count.append(1)
        real(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(Outbox, 'add', put)
        with pytest.raises(Killed):
            ground.feeder.step()
    ground.restart()


@pytest.mark.parametrize('settings', [ReleaseSettings(), REMOVAL], ids=['release', 'removal'])
@pytest.mark.parametrize('taken', [False, True])
def test_a_release_that_was_not_recorded_is_found_in_the_outbox(
    tmp_path, monkeypatch, settings, taken
) -> None:
    ground = Ground(tmp_path, settings)
    ground.steps()
    store(ground.writer, [0.9, 0.8, 0.7])
    killed_after(ground, monkeypatch, 2)
    assert len(ground.claimed()) == 3
    assert ground.out() == [0.9, 0.8]
    if taken:
        ground.remove([0.9])
    order = noted_puts(monkeypatch)
    ground.steps(2)
    # A chip that the bus has taken is released again.
    assert order == ([0.9, 0.7] if taken else [0.7])
    assert ground.out() == [0.9, 0.8, 0.7]
    assert ground.status().counts['released'] == 3
    assert ground.claimed() == []
    ground.close()


@pytest.mark.parametrize('settings', [RELEASE, REMOVAL], ids=['release', 'removal'])
@pytest.mark.parametrize('is_contact', [False, True])
def test_a_chip_that_the_bus_may_have_taken_is_delivered_rather_than_evicted(
    tmp_path, monkeypatch, settings, is_contact
) -> None:
    ground = Ground(tmp_path, settings)
    ground.steps()
    store(ground.writer, [0.2, 0.1])
    killed_after(ground, monkeypatch, 1)
    ground.remove([0.2])
    # More valuable ones come before the next start and after it, and there is no room for all.
    store(ground.writer, [1.0] * 20)
    ground.set_contact(is_contact)
    ground.steps()
    store(ground.writer, [1.0] * 40, 9000, 200_000.0)
    assert ground.status().counts['evicted.max_bytes'] > 0
    ground.set_contact(True)
    ground.steps(8)
    assert ground.out()[-2:] == [0.2, 0.1]
    assert ground.claimed() == []
    ground.close()


def test_a_chip_that_the_bus_is_removing_at_the_start_is_not_released_again(
    tmp_path, monkeypatch
) -> None:
    ground = Ground(tmp_path, REMOVAL)
    ground.steps()
    store(ground.writer, [0.9, 0.8])
    killed_after(ground, monkeypatch, 1)
    # The bus removes the JSON last.
    (chip,) = (tmp_path / 'outbox').glob('*/*.jpg')
    chip.unlink()
    order = noted_puts(monkeypatch)
    ground.steps(2, 100.0)
    assert order == [0.8]
    assert ground.status().in_outbox == 2
    (tmp_path / 'outbox' / '0' / f'{chip.stem}.json').unlink()
    ground.steps(1, 100.0)
    assert ground.status().counts['delivered'] == 1
    ground.close()


def test_a_chip_of_an_interrupted_release_that_is_too_large_now_holds_up_nothing(
    ground, monkeypatch
) -> None:
    ground.steps()
    ground.writer.store(ground.writer.plan(2), [new_chip(0.9, 5000), new_chip(0.8, 5000)], {})
    killed_after(ground, monkeypatch, 0)
    ground.set(max_bytes=2000.0)
    ground.steps(2)
    assert ground.feeder.stalled_by == 'all chips that wait are larger than outbox.max_bytes'
    store(ground.writer, [0.1])
    ground.steps(2)
    assert ground.out() == [0.1]
    ground.set(max_bytes=0.0)
    ground.steps(2)
    assert ground.out() == [0.9, 0.8, 0.1]
    assert ground.status().counts['delivered'] == 3


def test_a_failed_write_that_got_to_the_bus_is_delivered_rather_than_evicted(
    ground, monkeypatch
) -> None:
    store(ground.writer, [0.2, 0.1])
    real_add, real_finish = Outbox.add, Outbox.finish

    def add(self, chip_id, *args):
        if chip_id.endswith('_2'):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        real_add(self, chip_id, *args)

    def finish(self):
        real_finish(self)
        ground.remove([0.2])
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with monkeypatch.context() as patch:
        patch.setattr(Outbox, 'add', add)
        patch.setattr(Outbox, 'finish', finish)
        ground.steps()
    ground.set_contact(False)
    ground.steps()
    assert len(ground.claimed()) == 1
    store(ground.writer, [1.0] * 40, 9000, 200_000.0)
    ground.set_contact(True)
    ground.steps(4)
    assert ground.out()[-1] == 0.2
    # The other was never tried, and had its turn.
    assert 0.1 not in ground.out()


def test_unfinished_files_of_an_interrupted_release_are_removed(ground, monkeypatch) -> None:
    store(ground.writer, [0.9, 0.8])
    ground.steps(0)
    killed_after(ground, monkeypatch, 1)
    (kept,) = in_outbox(ground.folder / 'outbox')
    lost = next(chip_id for chip_id in ground.claimed() if chip_id != kept)
    level = ground.folder / 'outbox' / '0'
    (level / f'{lost}.jpg').write_bytes(b'half')
    (level / '.0123abcd.json').write_bytes(b'half')
    ground.set_contact(False)
    ground.steps()
    assert {path.stem for path in level.iterdir()} == {kept}
    assert ground.status().waiting == 1


# Trouble


def test_a_damaged_chip_is_evicted_and_holds_up_nothing(ground) -> None:
    damages = [
        "data = x'00'",
        "facts = '{'",
        "facts = x'ff'",
        "facts = '[]'",
        "data = 'a'",
        "facts = replace(facts, 'jpeg', 'bmp0')",
        'facts = \'{"sha256": 1}\'',
    ]
    store(ground.writer, [0.1 * i for i in range(len(damages) + 2)])
    with database(ground.folder / 'spool') as rows:
        for i, damage in enumerate(damages):
            rows.execute(f'UPDATE chips SET {damage} WHERE seq = ?', [i + 2])
    ground.steps(3)
    assert ground.out() == [0.1 * (len(damages) + 1), 0.0]
    assert ground.status().counts['evicted.damaged'] == len(damages)
    assert len(ground.troubles) == len(damages)
    assert all('damaged' in text for text in ground.troubles)


def test_a_chip_that_is_damaged_after_its_release_is_reported(tmp_path) -> None:
    ground = Ground(tmp_path, REMOVAL)
    store(ground.writer, [0.5])
    ground.steps(2, 2.0)
    with database(tmp_path / 'spool') as rows:
        rows.execute("UPDATE chips SET facts = '{'")
    ground.remove([0.5])
    ground.steps(2, 2.0)
    counts = ground.status().counts
    ground.close()
    assert (counts['evicted.damaged'], counts.get('delivered', 0)) == (1, 0)
    assert len(ground.troubles) == 1
    assert 'does not count as delivered' in ground.troubles[0]


def test_an_outbox_that_cannot_be_written_is_tried_again(ground, monkeypatch) -> None:
    store(ground.writer, [0.9, 0.8, 0.7])
    real = Outbox.add
    failing = [True]

    def put(self, chip_id, *args):
        if failing and chip_id.endswith('_2'):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.folder))
        real(self, chip_id, *args)

    monkeypatch.setattr(Outbox, 'add', put)
    # What the bus takes at once is not released again, though it was not written down.
    for left in ([0.9], []):
        assert ground.feeder.step() == 1.0
        assert 'No space left' in ground.feeder.stalled_by
        assert ground.out() == left
        ground.remove([0.9])
    assert ground.troubles == [ground.feeder.stalled_by] * 2
    failing.clear()
    ground.steps()
    assert ground.out() == [0.8, 0.7]
    assert ground.claimed() == []
    assert ground.status().counts['released'] == 3


def test_a_chip_that_cannot_be_written_costs_no_budget(ground) -> None:
    ground.set(budget=BudgetSettings(bytes_per_second=100.0, burst=1000.0))
    ground.steps(1, 100.0)
    store(ground.writer, [0.9, 0.8])
    (ground.folder / 'outbox' / '0').write_text('in the way')
    for _ in range(3):
        assert ground.feeder.step() == 1.0
        assert 'Not a directory' in ground.feeder.stalled_by
    (ground.folder / 'outbox' / '0').unlink()
    ground.steps()
    assert ground.out() == [0.9]


def test_a_release_that_cannot_be_recorded_is_recorded_later(ground, monkeypatch) -> None:
    store(ground.writer, [0.9, 0.8])
    with monkeypatch.context() as patch:

        def fail(self, ids, is_delivered):
            if ids:
                raise OSError(errno.EIO, 'Input/output error')

        patch.setattr(SpoolReleaser, 'released', fail)
        ground.steps(3)
    assert len(ground.troubles) == 3
    order = noted_puts(monkeypatch)
    ground.steps(2)
    assert order == []
    assert ground.status().counts['delivered'] == 2


def test_a_second_releaser_releases_nothing(ground) -> None:
    store(ground.writer, [0.9])
    ground.steps()
    store(ground.writer, [0.8])
    second = feeder(ground.folder, ground.troubles.append)
    assert second.step() == 1.0
    assert 'another process releases' in second.stalled_by
    assert ground.out() == [0.9]


def test_a_feeder_survives_a_deleted_spool(ground) -> None:
    store(ground.writer, [0.9, 0.8])
    ground.set(budget=BudgetSettings(bytes_per_second=1.0))
    ground.steps()
    shutil.rmtree(ground.folder / 'spool')
    ground.set(budget=BudgetSettings())
    store(ground.writer, [0.7])
    ground.steps(2)
    assert ground.out() == [0.7]
    assert ground.status().counts['delivered'] == 1
    assert any('deleted' in text for text in ground.troubles)


def swap(outbox, other):
    """Put another folder in place of the outbox, as mounting or unmounting does."""
    aside = outbox.with_name('aside')
    outbox.rename(aside)
    if other.exists():
        other.rename(outbox)
    else:
        outbox.mkdir()
    aside.rename(other)


def test_an_unmounted_outbox_delivers_nothing(tmp_path) -> None:
    ground = Ground(tmp_path, REMOVAL)
    outbox, other = tmp_path / 'outbox', tmp_path / 'other'
    store(ground.writer, [0.9, 0.8])
    ground.steps(2, 2.0)
    swap(outbox, other)
    for _ in range(2):
        ground.clock.now += 100.0
        store(ground.writer, [0.7])
        ground.steps(2, 1.0)
        assert 'is it mounted?' in ground.feeder.stalled_by
        ground.restart()
    assert ground.status().in_outbox == 2
    assert in_outbox(outbox) == {}
    swap(outbox, other)
    ground.clock.now += 100.0
    ground.steps(2, 1.0)
    assert ground.out() == [0.9, 0.8, 0.7, 0.7]
    assert 'delivered' not in ground.status().counts
    ground.remove([0.9])
    ground.steps(2, 100.0)
    assert ground.status().counts['delivered'] == 1
    ground.close()


@pytest.mark.parametrize('restarted', [False, True])
def test_chips_that_went_into_an_unmounted_outbox_are_released_again(tmp_path, restarted) -> None:
    """Between two looks at the outbox the feeder cannot see that another folder is in its place."""
    ground = Ground(tmp_path, REMOVAL)
    outbox, other = tmp_path / 'outbox', tmp_path / 'other'
    store(ground.writer, [0.9])
    ground.steps(2, 0.01)
    swap(outbox, other)
    store(ground.writer, [0.8])
    ground.steps()
    assert len(in_outbox(outbox)) == 1
    assert 'is it mounted?' in ground.feeder.stalled_by
    if restarted:
        ground.restart()
    ground.steps(2, 1.0)
    swap(outbox, other)
    ground.steps(3, 100.0)
    assert ground.out() == [0.9, 0.8]
    status = ground.status()
    assert (status.in_outbox, status.counts['released']) == (2, 2)
    ground.close()


def test_an_outbox_unmounted_while_it_is_looked_at_delivers_nothing(tmp_path, monkeypatch) -> None:
    ground = Ground(tmp_path, REMOVAL)
    store(ground.writer, [0.9])
    ground.steps(2, 100.0)
    real = Outbox.contents

    def contents(self):
        swap(tmp_path / 'outbox', tmp_path / 'other')
        return real(self)

    monkeypatch.setattr(Outbox, 'contents', contents)
    ground.steps()
    assert ground.status().in_outbox == 1
    ground.close()


def test_an_outbox_without_chips_may_be_replaced(tmp_path) -> None:
    ground = Ground(tmp_path, REMOVAL)
    ground.steps(2, 2.0)
    shutil.rmtree(tmp_path / 'outbox')
    ground.clock.now += 100.0
    store(ground.writer, [0.9])
    ground.steps(2, 2.0)
    assert (
        'outbox is missing; is it mounted? For a new outbox, create this folder'
        in ground.troubles[-1]
    )
    assert not (tmp_path / 'outbox').exists()
    (tmp_path / 'outbox').mkdir()
    ground.steps(2, 2.0)
    assert ground.out() == [0.9]
    ground.close()


def test_an_outbox_that_disappears_between_two_looks_is_not_created_again(ground) -> None:
    store(ground.writer, [0.9])
    ground.steps(2, 0.01)
    shutil.rmtree(ground.folder / 'outbox')
    store(ground.writer, [0.8])
    ground.steps(3, 0.01)
    assert 'outbox is missing; is it mounted?' in ground.feeder.stalled_by
    assert not (ground.folder / 'outbox').exists()
    assert ground.status().counts['delivered'] == 1


# Anything, in any order


@profile(max_examples=25)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(['store', 'step', 'take', 'restart', 'contact', 'evict', 'removal']),
            st.integers(0, 5),
        ),
        max_size=25,
    )
)
def test_every_chip_comes_down_once(tmp_path_factory, actions) -> None:
    folder = tmp_path_factory.mktemp('g')
    ground, down = Ground(folder), []

    def take(most):
        for chip_id in list(in_outbox(folder / 'outbox'))[:most]:
            down.append(chip_id)
            for path in (folder / 'outbox').glob(f'*/{chip_id}.*'):
                path.unlink()

    does = {
        'store': lambda number: store(ground.writer, [0.1 * i for i in range(number)], 3000),
        'step': lambda number: ground.steps(number, 1.0),
        'take': take,
        'restart': lambda number: ground.restart(),
        'contact': lambda number: ground.set_contact(bool(number % 2)),
        'evict': lambda number: store(ground.writer, [1.0], 9000, 150_000.0),
        'removal': lambda number: ground.set(removal=bool(number % 2)),
    }
    for action, number in actions:
        does[action](number)
        ground.status()
    ground.set_contact(True)
    ground.steps(8, 100.0)
    take(1000)
    ground.steps(2, 100.0)
    status = ground.status()
    ground.close()
    assert len(set(down)) == len(down) == status.counts.get('delivered', 0)
    assert status.waiting == status.in_outbox == 0
    assert len(down) + status.total('evicted') == status.counts.get('planned', 0)
    assert ground.troubles == []


def test_a_chip_larger_than_the_outbox_holds_up_nothing(ground) -> None:
    ground.set(max_bytes=2000.0)
    ground.writer.store(ground.writer.plan(2), [new_chip(0.9, 5000), new_chip(0.8, 10)], {})
    ground.steps(3, 2.0)
    assert ground.out() == [0.8]
    assert ground.troubles == ['all chips that wait are larger than outbox.max_bytes']


def test_a_lost_outbox_can_be_forgotten(ground) -> None:
    ground.set(removal=True)
    store(ground.writer, [0.9, 0.8])
    ground.steps(2, 2.0)
    shutil.rmtree(ground.folder / 'outbox')
    ground.steps(2, 2.0)
    assert 'outbox is missing; is it mounted?' in ground.troubles[-1]
    (ground.folder / 'outbox').mkdir()
    ground.steps(2, 2.0)
    assert 'obbhbb spool PATH forget-outbox' in ground.troubles[-1]
    assert ground.status().in_outbox == 2
    assert ground.console.forget_outbox() == 2
    store(ground.writer, [0.7])
    ground.steps(2, 2.0)
    assert ground.out() == [0.7]
    assert ground.status().counts['evicted.outbox_lost'] == 2


def test_another_outbox_is_reported_though_the_first_was_empty(ground) -> None:
    store(ground.writer, [0.9])
    ground.steps()
    (ground.folder / 'outbox').rename(ground.folder / 'aside')
    (ground.folder / 'outbox').mkdir()
    ground.restart()
    ground.steps()
    assert ground.troubles == [
        f'{ground.folder}/outbox is not the same outbox as before; is it mounted?'
    ]


def test_the_available_budget_is_up_to_date_without_contact(ground) -> None:
    ground.set_contact(False)
    ground.set(budget=BudgetSettings(bytes_per_second=100.0))
    ground.clock.now += 0.5
    ground.steps()
    ground.clock.now += 0.5
    ground.steps()
    assert ground.feeder.available == pytest.approx(50.0)


# In a thread


def wait_for(condition):
    """Wait until something holds."""
    deadline = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_thread_releases_from_contact_until_it_is_stopped(ground) -> None:
    ground.feeder.close()
    store(ground.writer, [0.9])
    thread = FeederThread(ground.folder / 'spool', ground.folder / 'outbox', RELEASE)
    wait_for(lambda: thread.feeder.stalled_by == 'no contact')
    assert ground.status().counts == {'planned': 1}
    thread.steer(RELEASE, is_contact=True)
    wait_for(lambda: ground.status().counts.get('delivered') == 1)
    thread.stop()
    assert thread.take_troubles() == []
    # Another one may release the spool now.
    store(ground.writer, [0.8])
    ground.open()
    ground.steps()
    assert ground.out() == [0.9, 0.8]


def test_a_thread_that_hangs_is_silent(ground, monkeypatch) -> None:
    ground.feeder.close()
    store(ground.writer, [0.9])
    is_well = threading.Event()
    with monkeypatch.context() as patch:
        patch.setattr(Outbox, 'add', lambda *_: is_well.wait(60.0))
        thread = FeederThread(ground.folder / 'spool', ground.folder / 'outbox', RELEASE)
        wait_for(lambda: thread.feeder.stalled_by == 'no contact')
        assert thread.silence() < 1.0
        thread.steer(RELEASE, is_contact=True)
        wait_for(lambda: thread.silence() > 1.5)
        is_well.set()
        wait_for(lambda: thread.silence() < 0.5)
        thread.stop()


def test_an_unexpected_error_does_not_end_the_thread(ground, monkeypatch) -> None:
    ground.feeder.close()
    store(ground.writer, [0.9])
    with monkeypatch.context() as patch:
        patch.setattr(Outbox, 'add', lambda *_: 1 / 0)
        thread = FeederThread(ground.folder / 'spool', ground.folder / 'outbox', RELEASE)
        thread.steer(RELEASE, is_contact=True)
        wait_for(lambda: thread.feeder.stalled_by == 'ZeroDivisionError: division by zero')
    wait_for(lambda: ground.status().counts.get('delivered') == 1)
    thread.stop()
    assert set(thread.take_troubles()) == {'ZeroDivisionError: division by zero'}
    assert thread.take_troubles() == []
