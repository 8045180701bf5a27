# SPDX-License-Identifier: Apache-2.0
"""From image to outbox over DDS: every chip stored, released in contact, accounted for."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from faults.library import build
from harness import ChipNode
from harness import Converter
from harness import Counts
from harness import Node
from harness import NodeProcess
from harness import Peer
from harness import Site
from harness import stamp_of
from harness import unexplained
from harness import values_of
from lifecycle_msgs.msg import Transition
from PIL import Image as Picture
from rclpy.qos import DurabilityPolicy
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image
from ships import detections
from std_msgs.msg import Bool
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.nodes.player_messages import image_message

# Long, and about DDS, SQLite and files rather than NumPy and Pillow.
pytestmark = pytest.mark.once

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Files that are not complete have a hidden name.
COMPLETE = '*/[!.]*.json'
NOISE = np.random.default_rng(5).integers(0, 256, (256, 256)).astype(np.uint8)


class Chain(ExitStack):
    """`chip_extractor` with a spool, `downlink`, and a peer that sends images and plans."""

    def __init__(self, site: Site, folder: Path) -> None:
        super().__init__()
        self.site, self.spool, self.outbox = site, folder / 'spool', folder / 'outbox'
        self.chips = self.enter_context(
            ChipNode(site, {'codec': 'png', 'spool.path': self.spool, 'cache.max_age': 30.0})
        )
        self.chips.images = self.chips.peer.publisher(Image, 'image')
        self.chips.plans = self.chips.peer.publisher(Detection2DArray, 'crop_regions')
        # Once: nothing that is reliable gets lost, and tests count on a single chip.
        self.store([0.01])
        self.chips.wait(lambda: self.books()['spool.waiting'], 'a first chip')

    def downlink(self, **parameters: Any) -> Node:
        """Start the node; close it to start another."""
        node = Node(self.site, 'downlink', self.chips.namespace)
        self.enter_context(node)
        node.start(
            parameters={
                'spool.path': self.spool,
                'outbox.path': self.outbox,
                **{name.replace('__', '.'): value for name, value in parameters.items()},
            }
        )
        return node

    def store(self, scores: list[float], id_of_all: str = '') -> None:
        """Send a frame with a chip for each score, with ids of their own, or one for all."""
        header = self.chips.stamp()
        rows = [(8 + i % 240, 8 + i // 240 * 20, 16, 16, 0) for i in range(len(scores))]
        plan = detections(rows)
        plan.header = header
        for i, (detection, score) in enumerate(zip(plan.detections, scores, strict=True)):
            detection.id = id_of_all or f'{header.stamp.sec}.{i}'
            detection.results[0].hypothesis.score = score
        self.chips.images.publish(image_message('mono8', NOISE, header))
        self.chips.plans.publish(plan)

    def books(self) -> Counts:
        """Give the books of the spool, and check that they balance."""
        books = self.chips.counts()
        balance = books['spool.planned'] - sum(
            n
            for name, n in books.items()
            if name in ('spool.delivered', 'spool.waiting', 'spool.in_outbox', 'spool.in_work')
            or name.startswith(('spool.evicted.', 'spool.refused.'))
        )
        assert balance == 0, books
        return books

    def released(self) -> list[dict[str, Any]]:
        """Read the JSON files of the outbox, in the order of their release."""
        found = []
        for path in self.outbox.glob(COMPLETE):
            each = json.loads(path.read_text())
            data = path.with_suffix('.png').read_bytes()
            assert hashlib.sha256(data).hexdigest() == each['sha256']
            assert len(data) == each['bytes']
            found.append((path.stat().st_mtime_ns, each))
        return [each for _, each in sorted(found, key=lambda pair: pair[0])]


@pytest.fixture
def chain(site: Site, tmp_path: Path) -> Iterator[Chain]:
    with Chain(site, tmp_path) as chain:
        yield chain


def test_what_is_stored_is_released_with_everything_that_is_known_of_it(
    site: Site, tmp_path: Path
) -> None:
    size = {'image_width': 256, 'image_height': 256}
    spool, outbox = tmp_path / 'spool', tmp_path / 'outbox'
    with (
        ChipNode(site, {'codec': 'png', 'spool.path': spool}) as chips,
        Converter(site, parameters=size, namespace=chips.namespace) as converter,
        Node(site, 'downlink', chips.namespace) as downlink,
    ):
        images = chips.heard_publisher(Image, 'image')
        cameras = chips.heard_publisher(CameraInfo, 'camera_info')
        regions = chips.peer.collect(Detection2DArray, 'crop_regions')
        converter.connect()

        def send(message: Detection2DArray) -> int:
            number = converter.send(message)
            images.publish(image_message('mono8', NOISE, message.header))
            return number

        def is_connected() -> bool:
            counts = chips.counts()
            return counts['chips_stored'] > counts['plans_without_sources']

        chips.send_until(
            lambda: send(detections([(100, 100, 8, 8, 0)])),
            is_connected,
            'a chip that was planned by the other node',
        )
        ships = [(60, 50, 50, 16, 0.4), (150, 160, 70, 20, -1.2), (200, 40, 20, 60, 0.1)]
        message = detections(ships)
        for i, detection in enumerate(message.detections):
            detection.id = f'track {i}'
            detection.results[0].hypothesis.class_id = ('tug', 'ferry', 'barge')[i]
            detection.results[0].hypothesis.score = (0.7, 0.9, 0.6)[i]
        camera = CameraInfo(
            width=1000,
            height=800,
            distortion_model='plumb_bob',
            d=[0.1, -0.2, 0.0, 0.0, 0.5],
            k=np.arange(1.0, 10.0),
            binning_x=2,
            binning_y=3,
        )
        camera.roi.x_offset, camera.roi.y_offset = 70, 20
        camera.roi.width, camera.roi.height = 512, 768
        cameras.publish(camera)
        before = chips.counts()
        number = send(message)
        chips.wait(
            # A frame from before may be among them.
            lambda: chips.counts().since(before).get('chips_stored', 0) >= 3,
            'three chips stored',
        )
        downlink.start(parameters={'spool.path': spool, 'outbox.path': outbox})
        found = []

        def have_come() -> bool:
            files = [json.loads(path.read_text()) for path in outbox.glob(COMPLETE)]
            found[:] = [facts for facts in files if facts['stamp']['sec'] == number]
            return len(found) == 3

        downlink.wait(have_come, 'three files')
        # It is the other node's peer that listens.
        plan = chips.wait_for(
            lambda: (each for each in regions if stamp_of(each) == number), 'its plan'
        )
    found.sort(key=lambda facts: -facts['value'])
    for facts, detection in zip(found, plan.detections, strict=True):
        i = int(detection.id.split()[1])
        box = detection.bbox
        roi = [
            round(box.center.position.x - box.size_x / 2),
            round(box.center.position.y - box.size_y / 2),
            round(box.size_x),
            round(box.size_y),
        ]
        x, y, along, across, theta = ships[i]
        length, width = max(along, across), min(along, across)
        turned = theta + (np.pi / 2 if across > along else 0.0)
        # A session of this run comes before the ids of others.
        assert re.fullmatch(
            f'[0-9a-f]{{16}} [0-9a-f]{{8}}-track {i}',
            f'{facts.pop("digest")} {facts.pop("object")}',
        )
        facts_of_obb = facts.pop('obb')
        assert facts_of_obb[:4] == pytest.approx([x, y, length, width])
        assert np.cos(2 * (facts_of_obb[4] - turned)) == pytest.approx(1.0)
        (chip,) = outbox.glob(f'*/{facts["id"]}.png')
        with Picture.open(io.BytesIO(chip.read_bytes())) as picture:
            a, b, w, h = roi
            np.testing.assert_array_equal(np.asarray(picture), NOISE[b : b + h, a : a + w])
        stamp = {'sec': message.header.stamp.sec, 'nanosec': message.header.stamp.nanosec}
        score = (0.7, 0.9, 0.6)[i]
        assert facts == {
            'id': chip.stem,
            'stamp': stamp,
            'frame_id': 'camera',
            'roi': roi,
            'image_size': [256, 256],
            'class_id': ('tug', 'ferry', 'barge')[i],
            'score': score,
            'value': score,
            'rank': score,
            'view': 1,
            'detection_ids': [f'track {i}'],
            'codec': 'png',
            'camera': {
                'size': [1000, 800],
                'k': list(range(1, 10)),
                'model': 'plumb_bob',
                'd': [0.1, -0.2, 0.0, 0.0, 0.5],
                'roi': [70, 20, 512, 768],
                'binning': [2, 3],
            },
            'bytes': chip.stat().st_size,
            'sha256': hashlib.sha256(chip.read_bytes()).hexdigest(),
        }


def test_compact_json_names_a_camera_that_comes_down_once(chain: Chain) -> None:
    cameras = chain.chips.heard_publisher(CameraInfo, 'camera_info')
    cameras.publish(CameraInfo(width=256, height=256, k=np.arange(1.0, 10.0)))

    def images_with_camera() -> float:
        chain.store([0.5])
        return chain.chips.counts()['camera_info_latest']

    chain.chips.wait(lambda: images_with_camera() >= 2, 'chips with a camera')
    node = chain.downlink(outbox__json='compact')
    node.wait(lambda: chain.books()['spool.delivered'] == chain.books()['spool.planned'], 'all')
    records = [json.loads(path.read_text()) for path in chain.outbox.glob(COMPLETE)]
    ((camera,), chips) = (
        [each for each in records if ('kind' in each) == is_camera] for is_camera in (True, False)
    )
    assert {each['camera']['id'] for each in chips if each['camera']} == {camera['id']}
    content = json.loads((chain.outbox / '0' / f'{camera["id"]}.camera').read_bytes())
    assert content['k'] == list(range(1, 10))
    node.wait(lambda: node.counts()['cameras_released'] == 1, 'the count of cameras')
    # By parameter, while it runs.
    node.set({'outbox.json': 'full'})
    chain.store([0.7])
    node.wait(lambda: chain.books()['spool.delivered'] > len(chips), 'one more')
    full = [json.loads(path.read_text()) for path in chain.outbox.glob(COMPLETE)]
    assert [each['camera']['k'] for each in full if each.get('value') == 0.7] == [content['k']]


def test_release_waits_for_contact_and_goes_by_value_then_age(chain: Chain) -> None:
    for scores in ([0.2, 0.9], [0.5, 0.9]):
        chain.store(scores)
    chain.chips.wait(lambda: chain.books()['spool.waiting'] >= 5, 'chips in the spool')
    # A chip costs 0.7 kB. Released with pauses, as the clock of files ticks every few milliseconds.
    node = chain.downlink(
        contact='topic',
        outbox__levels=[0.8, 0.4],
        budget__bytes_per_second=4000.0,
        budget__burst=1200.0,
    )
    node.wait(
        lambda: values_of(node.next_report())['stalled_by'] == 'no contact', 'that it is stalled'
    )
    assert values_of(node.next_report())['contact'] == 'false'
    assert not chain.outbox.exists() or not chain.released()
    with Peer(chain.site.context, chain.chips.namespace) as ground:
        contact = ground.publisher(Bool, 'contact', LATCHED)
        contact.publish(Bool(data=True))
        node.wait(lambda: chain.books()['spool.delivered'] == chain.books()['spool.planned'], 'all')
        contact.publish(Bool(data=False))
        node.wait(lambda: values_of(node.next_report())['contact'] == 'false', 'the end of contact')
        chain.store([0.99])
        chain.chips.wait(lambda: chain.books()['spool.waiting'] == 1, 'one more')
    times = [path.stat().st_mtime_ns for path in chain.outbox.glob(COMPLETE)]
    assert len(set(times)) == len(times)
    released = [(each['value'], each['stamp']['sec']) for each in chain.released()]
    wanted = [r for r in released if r[0] > 0.1]
    assert [value for value, _ in wanted] == [0.9, 0.9, 0.5, 0.2]
    assert wanted[0][1] < wanted[1][1]
    assert released == sorted(released, key=lambda r: (-r[0], r[1]))
    folders = {path.parent.name for path in chain.outbox.glob(COMPLETE)}
    assert folders == {'0', '1', '2'}


def test_a_node_that_starts_late_learns_of_the_contact(chain: Chain) -> None:
    with Peer(chain.site.context, chain.chips.namespace) as ground:
        publisher = ground.node.create_publisher(Bool, 'contact', LATCHED)
        publisher.publish(Bool(data=True))
        node = chain.downlink(contact='topic')
        node.wait(lambda: node.counts()['spool.delivered'] == 1, 'a release')


def test_what_the_topics_cannot_take_is_stored_all_the_same(chain: Chain) -> None:
    chain.chips.set({'budget.max_chips': 1})
    chain.chips.forget()
    before = chain.books()
    chain.store([0.5] * 10)
    chain.chips.wait(
        lambda: chain.books()['spool.waiting'] == before['spool.waiting'] + 10, 'ten chips'
    )
    changed = chain.chips.counts().since(before)
    assert changed['chips_sent'] == 1
    assert changed['chips_dropped.frame_max_chips'] == 9


def test_the_budget_holds_in_every_second_and_a_change_counts_at_once(chain: Chain) -> None:
    for _ in range(8):
        chain.store([0.5] * 20)
    chain.chips.wait(lambda: chain.books()['spool.waiting'] >= 160, 'chips in the spool')
    rate = 10_000.0
    node = chain.downlink(budget__bytes_per_second=rate, budget__overhead=50)
    node.wait(lambda: any(chain.outbox.glob(COMPLETE)), 'a first release')
    node.peer.spin_to(time.monotonic() + 3.0)
    moments = sorted(
        (path.stat().st_mtime, path.stat().st_size + path.with_suffix('.png').stat().st_size + 50)
        for path in chain.outbox.glob(COMPLETE)
    )
    for i, (first, _) in enumerate(moments):
        in_window = [cost for moment, cost in moments[i:] if moment < first + 1.0]
        # Written a little later than taken from the budget.
        assert sum(in_window) <= rate + rate + 0.2 * rate
    assert sum(cost for _, cost in moments) > rate
    node.wait(
        lambda: values_of(node.next_report())['stalled_by'] == 'link budget', 'that it is stalled'
    )
    node.set({'budget.bytes_per_second': 0.0})
    node.wait(lambda: node.counts()['spool.waiting'] == 0, 'the rest at once')


def test_removal_acknowledges_and_a_full_outbox_keeps_chips_in_the_spool(chain: Chain) -> None:
    chain.store([0.1 * i for i in range(1, 10)])
    chain.chips.wait(lambda: chain.books()['spool.waiting'] == 10, 'chips in the spool')
    node = chain.downlink(acknowledge='removal', outbox__max_bytes=3000.0)
    node.wait(
        lambda: values_of(node.next_report())['stalled_by'].startswith('outbox is full'), 'full'
    )
    counts = node.counts()
    assert 0 < counts['spool.in_outbox'] < 10
    assert counts['spool.delivered'] == 0
    taken = []

    def take_and_look() -> bool:
        for path in chain.outbox.glob(COMPLETE):
            taken.append(json.loads(path.read_text())['id'])
            path.with_suffix('.png').unlink()
            path.unlink()
        return node.counts()['spool.delivered'] == 10

    node.wait(take_and_look, 'all delivered')
    assert len(set(taken)) == len(taken) == 10
    chain.chips.wait(lambda: chain.books()['spool.delivered'] == 10, 'the same books')


def test_an_outbox_that_was_replaced_delivers_nothing(chain: Chain) -> None:
    node = chain.downlink(acknowledge='removal')
    node.wait(lambda: node.counts()['spool.in_outbox'] == 1, 'one chip')
    aside = chain.outbox.with_name('unmounted')
    chain.outbox.rename(aside)
    chain.outbox.mkdir()
    node.wait_for_log('is not the outbox that has 1 released chips')
    chain.store([0.5])
    counts = node.counts()
    assert (counts['spool.in_outbox'], counts['spool.delivered']) == (1, 0)
    assert not chain.released()
    # With what the node may put into it at any moment.
    chain.outbox.rename(chain.outbox.with_name('other'))
    aside.rename(chain.outbox)
    node.wait(lambda: node.counts()['spool.in_outbox'] == 2, 'it goes on')


def test_ids_that_name_no_ship_are_counted_and_reported(chain: Chain) -> None:
    chain.store([0.5, 0.6, 0.7], id_of_all='ship')
    chain.chips.wait(lambda: chain.chips.warned('ids: assign'), 'the warning')
    counts = chain.chips.counts()
    assert counts['ids_doubtful.repeated'] == 3
    assert counts['spool.objects_waiting'] == 1
    assert not unexplained(counts, 'chip_extractor.md')


def test_sources_wait_as_long_as_their_plan_and_are_counted_if_no_plan_uses_them(
    chain: Chain,
) -> None:
    chips = chain.chips
    publisher = chips.peer.publisher(Detection2DArray, 'crop_sources')

    def message() -> Detection2DArray:
        message = detections([(16, 16, 16, 16, 0)])
        message.header = chips.stamp()
        message.detections[0].id = 'ship'
        return message

    chips.set({'cache.max_age': 0.1})
    chips.send_until(
        lambda: publisher.publish(message()),
        lambda: chips.counts()['crop_sources_dropped.expired'],
        'sources without plan',
    )
    chips.set({'cache.max_age': 4.0})
    plan = message()
    stored = chips.counts()['chips_stored']
    publisher.publish(plan)
    time.sleep(2.5)
    chips.plans.publish(plan)
    time.sleep(2.5)
    chips.images.publish(image_message('mono8', NOISE, plan.header))
    chips.wait(lambda: chips.counts()['chips_stored'] > stored, 'the chip')
    # Only the first frame of the chain had no sources.
    assert chips.counts()['plans_without_sources'] == 1
    for _ in range(2):
        publisher.publish(plan)
    chips.wait(lambda: chips.counts()['crop_sources_dropped.duplicate'], 'the same sources again')
    assert chips.change_state(Transition.TRANSITION_DEACTIVATE)
    chips.wait(lambda: chips.counts()['crop_sources_dropped.deactivated'], 'the deactivation')
    assert not unexplained(chips.counts(), 'chip_extractor.md')


def test_an_inactive_node_releases_nothing(chain: Chain) -> None:
    node = chain.downlink(autostart=False)
    assert node.change_state(Transition.TRANSITION_CONFIGURE)
    assert node.counts()['spool.waiting'] == 1
    assert not list(chain.outbox.glob('*/*'))
    assert node.change_state(Transition.TRANSITION_ACTIVATE)
    node.wait(lambda: node.counts()['spool.waiting'] == 0, 'a release')
    assert node.change_state(Transition.TRANSITION_DEACTIVATE)
    chain.store([0.5])
    chain.chips.wait(lambda: chain.books()['spool.waiting'] == 1, 'one more')
    assert node.counts()['spool.waiting'] == 1
    assert node.change_state(Transition.TRANSITION_CLEANUP)
    assert node.change_state(Transition.TRANSITION_CONFIGURE)
    assert node.change_state(Transition.TRANSITION_ACTIVATE)
    node.wait(lambda: node.counts()['spool.waiting'] == 0, 'a release again')


def test_a_spool_has_one_downlink(chain: Chain) -> None:
    node = chain.downlink()
    node.wait(lambda: node.counts()['spool.waiting'] == 0, 'a release')
    second = Node(chain.site, 'downlink')
    with second:
        second.start(parameters={'spool.path': chain.spool, 'outbox.path': chain.outbox / 'second'})
        second.wait_for_log('another process releases this spool')


@pytest.mark.parametrize('missing', ['spool.path', 'outbox.path'])
def test_without_a_folder_it_does_not_start(site: Site, tmp_path: Path, missing: str) -> None:
    given = {'spool.path': tmp_path / 'spool', 'outbox.path': tmp_path / 'outbox'}
    del given[missing]
    with site.start('downlink', parameters=given) as process:
        assert process.wait() == 1
        assert f'cannot start: {missing} is missing' in process.log


@pytest.mark.parametrize(
    ('folders', 'reason'),
    [
        ({'spool.path': 'spool'}, 'spool.path must be an absolute path, not spool'),
        ({'outbox.path': '/a/outbox', 'spool.path': '/a/outbox/'}, 'must be separate folders'),
        ({'outbox.path': '/a', 'spool.path': '/a/0'}, 'must be separate folders'),
    ],
)
def test_folders_that_cannot_be_meant_are_refused(
    site: Site, folders: dict[str, str], reason: str
) -> None:
    given = {'spool.path': '/a/spool', 'outbox.path': '/a/outbox'} | folders
    with site.start('downlink', parameters=given) as process:
        assert process.wait() == 1
        assert reason in process.log


BROKEN = """
import sys
from obbhbb_ros.nodes import __main__ as nodes
from obbhbb_ros.nodes.chip_topics import FrameTopics
real, count = FrameTopics.publish, []
def publish(self, chip, data):
    count.append(1)
    if len(count) == 3:
        raise RuntimeError('the middleware is full')
    real(self, chip, data)
FrameTopics.publish = publish
sys.exit(nodes.run_executable('chip_extractor'))
"""


def test_an_error_on_the_topics_costs_the_spool_nothing(site: Site, tmp_path: Path) -> None:
    node = ChipNode.__new__(ChipNode)
    Node.__init__(node, site, 'chip_extractor')
    node.chips = node.peer.collect(CompressedImage, 'chip/compressed')
    with node:
        node.process = NodeProcess(
            [sys.executable, '-c', BROKEN],
            tmp_path / 'log',
            namespace=node.namespace,
            parameters={'codec': 'png', 'spool.path': tmp_path / 'spool'},
        )
        node.images = node.peer.publisher(Image, 'image')
        node.plans = node.peer.publisher(Detection2DArray, 'crop_regions')
        node.send_until(
            lambda: node.send(NOISE, 'mono8', [(0, 0, 8, 8), (8, 8, 16, 16)]),
            lambda: 'the middleware is full' in node.process.log,
            'the error',
        )
        counts = node.counts()
        assert counts['spool.planned'] == counts['spool.waiting'] > 2
        dropped = sum(n for name, n in counts.items() if name.startswith('chips_dropped.'))
        assert counts['chips_planned'] == counts['chips_sent'] + dropped
        assert counts['chips_dropped.failed'] > 0
        assert counts['spool.in_work'] == 0


def test_a_deleted_spool_is_reported_and_replaced(chain: Chain) -> None:
    node = chain.downlink()
    node.wait(lambda: node.counts()['spool.waiting'] == 0, 'a release')
    # All of it at once: the nodes make its files anew as soon as they miss them.
    gone = chain.spool.with_name('gone')
    chain.spool.rename(gone)
    shutil.rmtree(gone)
    chain.store([0.5, 0.6])
    chain.chips.wait_for_log('was deleted or replaced; a new catalogue begins')
    node.wait(lambda: node.counts()['spool.delivered'] == 2, 'both are released')
    assert chain.books()['spool.planned'] == 2


@pytest.mark.parametrize('error', [errno.ENOSPC, errno.EROFS], ids=errno.errorcode.get)
def test_a_disk_that_fails_is_said_and_survived_and_chips_go_on_by_topic(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: int
) -> None:
    flag = tmp_path / 'failing'
    monkeypatch.setenv('LD_PRELOAD', str(build(tmp_path)))
    monkeypatch.setenv('FAULT_FOLDER', str(tmp_path / 'spool'))
    monkeypatch.setenv('FAULT_FLAG', str(flag))
    with Chain(site, tmp_path) as chain:
        flag.write_text(str(error))
        chain.chips.forget()
        chain.store([0.5] * 5)
        chain.chips.wait(lambda: len(chain.chips.chips) == 5, 'the chips on their topic')
        chain.chips.wait_for_log('spool: ')
        chain.chips.wait(lambda: chain.chips.warned('spool: '), 'the level')
        flag.unlink()
        chain.store([0.6] * 3)
        chain.chips.wait(lambda: chain.books()['spool.waiting'] == 4, 'chips in the spool again')
        assert chain.books()['spool.refused.spool_failed'] == 5
        node = chain.downlink()
        node.wait(lambda: node.counts()['spool.delivered'] == 4, 'a release')


def test_a_damaged_catalogue_is_set_aside_and_chips_go_on(chain: Chain) -> None:
    (catalogue,) = chain.spool.glob('chips_*.sqlite3')
    # Overwritten in place, as a failing disk does.
    for path in (catalogue, catalogue.with_name(f'{catalogue.name}-wal')):
        with path.open('r+b') as stream:
            stream.write(b'\xa5' * path.stat().st_size)
    # Whoever reads it from the disk notices, and the others follow.
    node = chain.downlink()
    node.wait_for_log(f'{catalogue.name} is damaged and set aside')
    chain.chips.forget()
    chain.store([0.5, 0.6])
    chain.chips.wait(lambda: len(chain.chips.chips) == 2, 'the chips on their topic')
    node.wait(lambda: node.counts()['spool.delivered'] == 2, 'both are released')
    chain.chips.wait(lambda: chain.books()['spool.delivered'] == 2, 'one catalogue for all')
    assert chain.books()['spool.set_aside'] == 1
    assert catalogue.exists()


def test_a_smaller_quota_counts_from_the_next_frame_on(chain: Chain) -> None:
    for _ in range(10):
        chain.store([0.1, 0.9] * 30)
    chain.chips.wait(lambda: chain.books()['spool.waiting'] == 601, 'chips in the spool')
    size = chain.books()['spool.file_bytes']
    chain.chips.set({'spool.max_bytes': 0.7 * size})
    chain.store([0.95])
    chain.chips.wait(lambda: chain.books()['spool.evicted.max_bytes'], 'eviction')
    (path,) = chain.spool.glob('chips_*.sqlite3')
    with sqlite3.connect(path) as database:
        left = [value for (value,) in database.execute('SELECT value FROM chips')]
    database.close()
    assert 0.95 in left
    assert left.count(0.9) == 300 or 0.1 not in left


def test_a_full_spool_that_evicts_is_a_warning_while_it_lasts(chain: Chain) -> None:
    node = chain.downlink(contact='topic')
    chain.store([0.3] * 60)
    chain.chips.wait(lambda: chain.books()['spool.waiting'] == 61, 'chips in the spool')
    assert chain.books()['spool.least_rank'] == 0.01
    node.wait(lambda: node.counts()['spool.waiting'] == 61, 'the books of the other node')
    chain.chips.set({'spool.max_bytes': 0.9 * chain.books()['spool.file_bytes']})
    chain.store([0.9] * 20)
    chain.chips.wait(lambda: chain.books()['spool.evicted.max_bytes'], 'eviction')
    evicted = chain.books()['spool.evicted.max_bytes']
    text = (
        f'the spool is full: evicted {evicted:.0f} chips since the last report, {evicted:.0f} in '
        'all; the lowest rank that waits is 0.3; see spool.max_bytes of chip_extractor'
    )
    for witness in (chain.chips, node):
        witness.wait_for_log('WARN', text)
        witness.send_until(
            lambda: chain.store([0.9] * 5),
            lambda witness=witness: witness.warned('the spool is full: evicted '),
            'the level',
        )
        witness.wait(
            lambda witness=witness: witness.next_report().level == DiagnosticStatus.OK, 'the end'
        )


def test_contact_that_is_not_renewed_is_lost_and_comes_back(chain: Chain) -> None:
    node = chain.downlink(contact='topic', contact_timeout=2.0)
    with Peer(chain.site.context, chain.chips.namespace) as ground:
        contact = ground.publisher(Bool, 'contact', LATCHED)
        contact.publish(Bool(data=True))
        node.wait(lambda: node.counts()['spool.delivered'] == 1, 'a release')
        node.wait(lambda: node.counts()['contacts_lost'] == 1, 'the loss')
        chain.store([0.5])
        chain.chips.wait(lambda: chain.books()['spool.waiting'] == 1, 'a chip that waits')
        report = node.next_report()
        assert (report.level, values_of(report)['contact']) == (DiagnosticStatus.WARN, 'false')
        assert 'contact lost: no message on ' in report.message
        assert values_of(report)['stalled_by'] == 'no contact'
        assert node.process.log.count('contact lost') == 1
        contact.publish(Bool(data=True))
        node.wait(lambda: node.counts()['spool.delivered'] == 2, 'the other release')
        contact.publish(Bool(data=False))
        node.wait(lambda: node.next_report().level == DiagnosticStatus.OK, 'the end')
        node.wait_for_log('/contact is back')


def test_a_message_on_contact_that_has_no_effect_is_reported(chain: Chain) -> None:
    node = chain.downlink()
    with Peer(chain.site.context, chain.chips.namespace) as ground:
        contact = ground.publisher(Bool, 'contact', LATCHED)
        contact.publish(Bool(data=False))
        node.wait_for_log('/contact has no effect while the parameter contact is always')
        assert values_of(node.next_report())['contact'] == 'true'
        node.set({'contact': 'topic'})
        node.wait(lambda: values_of(node.next_report())['contact'] == 'false', 'the end of contact')


def test_after_a_kill_contact_is_heard_again(chain: Chain) -> None:
    with Peer(chain.site.context, chain.chips.namespace) as ground:
        contact = ground.node.create_publisher(Bool, 'contact', LATCHED)
        contact.publish(Bool(data=True))
        node = chain.downlink(contact='topic')
        node.wait(lambda: node.counts()['spool.delivered'] == 1, 'a release')
        node.process.send_signal(signal.SIGKILL)
        assert node.process.wait() == -signal.SIGKILL
        chain.store([0.5])
        chain.chips.wait(lambda: chain.books()['spool.waiting'] == 1, 'a chip that waits')
        node = chain.downlink(contact='topic')
        node.wait(lambda: node.counts()['spool.delivered'] == 2, 'the release of the next run')


def test_a_node_that_is_killed_in_the_middle_loses_nothing(chain: Chain) -> None:
    for _ in range(5):
        chain.store([0.5] * 40)
    chain.chips.wait(lambda: chain.books()['spool.waiting'] == 201, 'chips in the spool')

    def out() -> int:
        return len(list(chain.outbox.glob(COMPLETE)))

    for _ in range(3):
        # All of them may be out, if we stood still meanwhile.
        enough = min(out() + 20, 201)
        node = chain.downlink()
        node.wait(lambda enough=enough: out() >= enough, 'some releases')
        node.process.send_signal(signal.SIGKILL)
        assert node.process.wait() == -signal.SIGKILL
        chain.books()
    node = chain.downlink()
    node.wait(lambda: node.counts()['spool.waiting'] == 0, 'the rest')
    released = chain.released()
    assert len({each['id'] for each in released}) == len(released) == 201
    assert node.counts()['spool.delivered'] == 201


def test_every_key_of_the_downlink_node_is_explained(chain: Chain) -> None:
    node = chain.downlink(contact='topic', contact_timeout=0.1)
    with Peer(chain.site.context, chain.chips.namespace) as ground:
        contact = ground.publisher(Bool, 'contact', LATCHED)
        contact.publish(Bool(data=True))
        node.wait(lambda: node.counts()['spool.delivered'], 'a delivery')
        node.wait(lambda: node.counts()['contacts_lost'], 'lost contact')
        contact.publish(b'\0\1\0\0')
        node.wait(lambda: node.counts()['messages_unreadable'], 'an unreadable message')
    assert not unexplained(values_of(node.next_report()), 'downlink.md')
    assert not unexplained(chain.books(), 'chip_extractor.md')


@pytest.mark.parametrize(
    ('options', 'count'), [(['--count', '30'], '3[01]'), (['--count', '5', '--lists'], '[56]')]
)
def test_the_books_balance_after_every_kill_and_the_bus_has_what_they_say(
    site: Site, options: list[str], count: str
) -> None:
    command = Path(__file__).parents[1] / 'soak' / 'kills.py'
    done = subprocess.run(
        [sys.executable, command, '--seed', '1', *options],
        check=False,
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(rf'{count} kills, .*none wrong', done.stdout)
