# SPDX-License-Identifier: Apache-2.0
"""`outbox.json: compact`: short JSON, and each camera once, before the first chip that names it."""

import errno
import json
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from spooled import CAMERA
from spooled import Clock
from spooled import cameras_in_outbox
from spooled import feeder
from spooled import in_outbox
from spooled import new_chip

from obbhbb_ros.downlink.budget import LinkSettings
from obbhbb_ros.spool.compact_json import compact_bytes
from obbhbb_ros.spool.compact_json import shortened
from obbhbb_ros.spool.compact_json import with_camera
from obbhbb_ros.spool.compact_json import without_camera
from obbhbb_ros.spool.feeder import ReleaseSettings
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.spool.writer import SpoolWriter

COMPACT = ReleaseSettings(is_compact=True)
REMOVAL = replace(COMPACT, removal=True)


class Ground:
    """A spool and its outbox."""

    def __init__(self, folder) -> None:
        self.folder, self.outbox = folder, folder / 'outbox'
        self.troubles, self.clock = [], Clock()
        self.writer = SpoolWriter(folder / 'spool', self.troubles.append)
        self.feeder = feeder(folder, self.troubles.append, self.clock, COMPACT)

    def restart(self, settings) -> None:
        """Start the releasing process again."""
        self.feeder.close()
        self.feeder = feeder(self.folder, self.troubles.append, self.clock, settings)

    def store(self, *chips) -> None:
        assert self.writer.store(self.writer.plan(len(chips)), chips, {})

    def steps(self, count=3, seconds=100.0) -> None:
        for _ in range(count):
            self.feeder.step()
            self.clock.now += seconds

    def take_all(self) -> list[str]:
        """Remove all files, as the bus does; list the names of the JSON files."""
        records = sorted(self.outbox.glob('*/[!.]*.json'))
        for record in records:
            for path in record.parent.glob(f'{record.stem}.*'):
                path.unlink()
        return [record.stem for record in records]

    def close(self) -> None:
        self.writer.close()
        self.feeder.close()


@pytest.fixture
def ground(tmp_path):
    made = Ground(tmp_path)
    yield made
    made.close()


def test_a_camera_is_released_once_and_named_by_its_chips(ground) -> None:
    moved = CAMERA | {'roi': [8, 8, 640, 480], 'binning': [2, 2]}
    ground.store(new_chip(0.9, camera=CAMERA), new_chip(0.8, camera=moved), new_chip(0.7))
    ground.steps()
    ((camera, record),) = cameras_in_outbox(ground.outbox).items()
    assert record['kind'] == 'camera'
    shared = json.loads((ground.outbox / '0' / f'{camera}.camera').read_bytes())
    whole, window, none = sorted(in_outbox(ground.outbox).values(), key=lambda chip: -chip['value'])
    assert whole['camera'] == {'id': camera, 'roi': CAMERA['roi'], 'binning': [1, 1]}
    assert with_camera(whole['camera'], shared) == CAMERA
    assert with_camera(window['camera'], shared) == moved
    assert none['camera'] is None
    assert ground.feeder.cameras == 1
    assert ground.writer.status().counts['released'] == 3
    assert ground.troubles == []


def test_every_camera_has_its_own_file(ground) -> None:
    ground.store(*(new_chip(camera=CAMERA | {'k': [float(i)] * 9}) for i in range(3)))
    ground.steps()
    assert len(cameras_in_outbox(ground.outbox)) == 3


def test_a_camera_is_complete_before_the_json_of_its_chip(ground, monkeypatch) -> None:
    real, seen = Outbox.add, []

    def add(self, file_id, *arguments) -> None:
        seen.append((file_id, len(cameras_in_outbox(self.folder))))
        real(self, file_id, *arguments)

    monkeypatch.setattr(Outbox, 'add', add)
    other = CAMERA | {'d': None}
    ground.store(*(new_chip(0.9 - 0.1 * i, camera=(CAMERA, other)[i % 2]) for i in range(4)))
    ground.steps()
    assert [count for _, count in seen] == [0, 1, 1, 2, 2, 2]
    assert len(in_outbox(ground.outbox)) == 4


def test_the_json_is_short_and_says_the_same(ground) -> None:
    box = [25.004, 40.006, 38.1234567, 12.0, 0.123456789]
    chip = new_chip(0.8999999761581421, obb=box, score=0.8999999761581421, camera=CAMERA)
    ground.store(chip)
    ground.steps()
    (name,) = in_outbox(ground.outbox)
    content = (ground.outbox / '0' / f'{name}.json').read_text()
    assert ' ' not in content.partition(', "digest"')[0]
    described = json.loads(content)
    assert (described['score'], described['value']) == (0.9, 0.9)
    assert described['obb'] == [25.0, 40.01, 38.12, 12.0, 0.12346]


def full_and_compact_cost(ground, chip) -> tuple[int, int]:
    """Return the bytes of a chip in the outbox with full and with compact JSON."""
    sizes = []
    for settings in (ReleaseSettings(), COMPACT):
        ground.restart(settings)
        ground.store(chip)
        ground.steps()
        sizes.append(sum(path.stat().st_size for path in ground.outbox.glob('0/[!c]*')))
        ground.take_all()
    return sizes[0], sizes[1]


def test_a_chip_that_fits_only_with_compact_json_is_released(ground) -> None:
    chip = new_chip(size=1000, camera=CAMERA)
    full, compact = full_and_compact_cost(ground, chip)
    assert compact < full - 100
    ground.store(chip)
    for is_compact, released in ((False, 0), (True, 1)):
        # Of rank and number of the view nobody knows how long they get.
        budget = LinkSettings(bytes_per_second=100.0, burst=compact + 20.0)
        ground.restart(ReleaseSettings(budget=budget, is_compact=is_compact))
        ground.steps(5)
        assert len(in_outbox(ground.outbox)) == released
    assert ground.troubles == ['all chips that wait are larger than budget.burst']


def test_a_chip_with_compact_json_waits_for_no_more_room_than_it_takes(ground) -> None:
    chip = new_chip(size=1000, camera=CAMERA)
    full, compact = full_and_compact_cost(ground, chip)
    ground.restart(replace(REMOVAL, max_bytes=2.0 * full))
    ground.store(chip)
    ground.steps()
    camera = sum(path.stat().st_size for path in ground.outbox.glob('0/c*'))
    ground.restart(replace(REMOVAL, max_bytes=camera + 2.0 * compact + 20.0))
    ground.store(chip)
    ground.steps()
    assert len(in_outbox(ground.outbox)) == 2


def test_a_chip_whose_camera_never_fits_is_passed_over(ground) -> None:
    camera = CAMERA | {'model': 'rational_polynomial', 'd': [-0.123456789 - i for i in range(14)]}
    ground.store(new_chip(0.9, size=10, camera=camera), new_chip(0.8, size=10, camera=None))
    # More than the chip with its JSON, less than the camera with its own.
    budget = LinkSettings(bytes_per_second=1000.0, burst=480.0)
    ground.restart(replace(COMPACT, budget=budget))
    ground.steps()
    assert [chip['value'] for chip in in_outbox(ground.outbox).values()] == [0.8]
    assert not cameras_in_outbox(ground.outbox)
    assert ground.feeder.stalled_by == 'all chips that wait are larger than budget.burst'
    ground.restart(replace(COMPACT, budget=replace(budget, burst=700.0)))
    ground.steps()
    assert len(cameras_in_outbox(ground.outbox)) == 1
    assert len(in_outbox(ground.outbox)) == 2


def test_full_json_holds_its_camera(ground) -> None:
    ground.restart(ReleaseSettings())
    ground.store(new_chip(camera=CAMERA))
    ground.steps()
    (chip,) = in_outbox(ground.outbox).values()
    assert chip['camera'] == CAMERA
    assert not cameras_in_outbox(ground.outbox)


def test_without_acknowledgement_a_camera_comes_down_once_in_each_contact(ground) -> None:
    for is_contact in (True, True, False, True):
        ground.feeder.steer(COMPACT, is_contact)
        ground.store(new_chip(camera=CAMERA))
        ground.steps()
        ground.take_all()
    assert ground.feeder.cameras == 2


def test_a_camera_that_the_bus_has_removed_does_not_come_again(ground) -> None:
    ground.restart(REMOVAL)
    for is_contact in (True, False, True):
        ground.feeder.steer(REMOVAL, is_contact)
        ground.store(new_chip(camera=CAMERA))
        ground.steps()
        ground.take_all()
    assert ground.feeder.cameras == 1
    ground.steps()
    assert ground.writer.status().counts['delivered'] == 3


def test_after_a_restart_a_camera_comes_down_again_if_it_is_not_there(ground) -> None:
    ground.store(new_chip(camera=CAMERA))
    ground.steps()
    ground.restart(COMPACT)
    ground.store(new_chip(camera=CAMERA))
    ground.steps()
    assert ground.feeder.cameras == 0
    ground.take_all()
    ground.restart(COMPACT)
    ground.store(new_chip(camera=CAMERA))
    ground.steps()
    assert ground.feeder.cameras == 1
    assert len(ground.take_all()) == 2


def test_a_camera_costs_the_link_what_it_weighs(ground) -> None:
    link = LinkSettings(bytes_per_second=100.0, burst=1500.0, overhead=50)
    ground.restart(replace(COMPACT, budget=link))
    ground.store(new_chip(0.9, camera=CAMERA), new_chip(0.8, camera=CAMERA))
    spent = 0
    for _ in range(40):
        ground.feeder.step()
        files = [path for path in ground.outbox.glob('*/[!.]*') if path.is_file()]
        spent = sum(path.stat().st_size for path in files) + 25 * len(files)
        assert spent <= 1500.0 + 100.0 * (ground.clock.now - 100.0) + 1.0
        ground.clock.now += 1.0
    assert len(in_outbox(ground.outbox)) == 2
    assert len(cameras_in_outbox(ground.outbox)) == 1


@pytest.mark.parametrize('failing', ['add', 'finish'])
def test_a_camera_that_cannot_be_written_holds_its_chips_back(ground, monkeypatch, failing) -> None:
    real, left = getattr(Outbox, failing), [1]

    def fail_once(self, *arguments) -> None:
        if left:
            left.pop()
            self.finish() if failing == 'add' else None
            raise OSError(errno.ENOSPC, 'No space left on device')
        real(self, *arguments)

    monkeypatch.setattr(Outbox, failing, fail_once)
    ground.store(new_chip(camera=CAMERA))
    ground.steps(1)
    assert not in_outbox(ground.outbox)
    assert len(ground.troubles) == 1
    ground.steps()
    assert len(in_outbox(ground.outbox)) == 1
    assert len(cameras_in_outbox(ground.outbox)) == 1


def test_files_of_others_beside_the_cameras_are_left_alone(ground) -> None:
    notes = ground.outbox / '0' / 'camera_notes.txt'
    notes.parent.mkdir(parents=True)
    notes.touch()
    half = notes.with_name('camera_0123456789abcdef.camera')
    half.touch()
    ground.store(new_chip(camera=CAMERA))
    ground.steps()
    assert notes.exists()
    # Without a JSON it is not complete, and nobody would finish it.
    assert not half.exists()


numbers = st.floats(allow_nan=False, allow_infinity=False, width=32)
cameras = st.fixed_dictionaries(
    {
        'size': st.lists(st.integers(0, 2**32 - 1), min_size=2, max_size=2),
        'k': st.none() | st.lists(numbers, min_size=9, max_size=9),
        'model': st.text(),
        'd': st.none() | st.lists(numbers),
        'roi': st.lists(st.integers(0, 2**32 - 1), min_size=4, max_size=4),
        'binning': st.lists(st.integers(1, 8), min_size=2, max_size=2),
    }
)


@given(cameras)
def test_a_camera_comes_back_as_it_was(camera) -> None:
    described, file = without_camera({'camera': camera})
    received = json.loads(compact_bytes(described))
    camera['model'] = camera['model'].encode(errors='replace').decode()
    assert with_camera(received['camera'], json.loads(file.content)) == camera


@given(st.floats(-1e300, 1e300), st.lists(st.floats(-1e5, 1e5), min_size=5, max_size=5))
def test_rounding_changes_next_to_nothing(value, box) -> None:
    short = shortened({'value': value, 'score': None, 'obb': box, 'id': 'a'})
    assert short['value'] == pytest.approx(value, rel=1e-5)
    assert short['obb'][:4] == pytest.approx(box[:4], abs=0.0051, rel=0)
    assert short['obb'][4] == pytest.approx(box[4], abs=5.1e-6, rel=0)
    assert (short['score'], short['id']) == (None, 'a')
