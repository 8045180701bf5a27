# SPDX-License-Identifier: Apache-2.0
"""The chip node over DDS: exact pixels, every chip accounted for, the budget of the link."""

from __future__ import annotations

import io
import itertools
import os
import time
from collections.abc import Callable
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
from harness import ChipNode
from harness import Converter
from harness import Region
from harness import Site
from lifecycle_msgs.msg import Transition
from numpy.typing import NDArray
from PIL import Image as Picture
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.downlink.chips import PIXEL_FORMATS
from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.chips import encode
from obbhbb_ros.labels import write_labels
from obbhbb_ros.nodes.player_messages import image_message
from obbhbb_ros.study.harbour import harbour

# Long; what depends on the versions of NumPy and Pillow is tested without DDS as well.
pytestmark = pytest.mark.once

REGIONS: list[Region] = [(10, 20, 31, 41), (0, 0, 8, 8), (90, 50, 120, 80)]
WIDTH, HEIGHT = 120, 80

_numbers = itertools.count()


def pixels_of(chip: CompressedImage) -> NDArray[Any]:
    with Picture.open(io.BytesIO(chip.data.tobytes())) as file:
        return np.asarray(file)


def place_of(info: CameraInfo) -> Region:
    roi = info.roi
    return roi.x_offset, roi.y_offset, roi.x_offset + roi.width, roi.y_offset + roi.height


def patient(site: Site, **parameters: Any) -> ChipNode:
    """Start a node that loses no image, however long the machine keeps it from taking them."""
    namespace = f'/patient_{os.getpid()}_{next(_numbers)}'
    depth = {f'qos_overrides.{namespace}/image.subscription.depth': 100}
    return ChipNode(site, depth | parameters, namespace)


@pytest.fixture
def start(site: Site) -> Iterator[Callable[..., ChipNode]]:
    """Starts nodes that end with the test."""
    with ExitStack() as stack:
        yield lambda **parameters: stack.enter_context(patient(site, **parameters))


@pytest.fixture(scope='module')
def shared(site: Site) -> Iterator[ChipNode]:
    with patient(site, codec='png') as node:
        node.connect()
        yield node


@pytest.fixture
def node(shared: ChipNode) -> ChipNode:
    """The module's node, with PNG and without a budget."""
    shared.set({'codec': 'png', 'lossless': False, 'quality': 85, 'cache.max_age': 2.0})
    shared.set({'cache.images': 0, 'cache.max_bytes': 1e8, 'cache.slop': 0.0})
    shared.forget()
    return shared


def picture(encoding: str) -> NDArray[Any]:
    layout = PIXEL_FORMATS[encoding]
    shape = (HEIGHT, WIDTH, len(layout.channels))
    values = np.random.default_rng(1).integers(0, 2**layout.depth, shape)
    return values.astype(f'u{layout.depth // 8}')


def send_image(node: ChipNode, value: int = 0) -> Header:
    """Publish a small image, and return its header."""
    header = node.stamp()
    pixels = np.full((8, 8), value, np.uint8)
    node.images.publish(image_message('mono8', pixels, header))
    node.peer.spin(0.01)
    return header


def warning_of_late_plan(node: ChipNode, header: Header) -> str:
    """Publish a plan whose image is gone, and return the warning."""
    before = node.counts()
    node.send_plan([(0, 0, 4, 4)] * 2, header)
    changed: dict[str, float] = {}

    def is_dropped() -> bool:
        changed.update(node.counts().since(before))
        return 'crop_plans_dropped.partner_gone' in changed

    node.wait(is_dropped, 'the plan to be dropped')
    assert changed['chips_dropped.crop_plan_partner_gone'] == 2
    return node.wait_for_log('after its image').rpartition('dropped: ')[2]


def test_a_detector_may_be_forty_images_late(start: Callable[..., ChipNode]) -> None:
    node = start(**{'codec': 'png', 'cache.max_age': 60.0})
    node.connect()
    before = node.counts()
    first, *_ = [send_image(node) for _ in range(40)]
    node.wait(lambda: node.counts().since(before)['images_received'] == 40, 'all images')
    node.send_plan([(0, 0, 4, 4)], first)
    node.wait(lambda: node.chips, 'the chip of the first image')
    assert node.chips[0].header.stamp.sec == first.stamp.sec


def test_a_plan_for_an_image_that_was_crowded_out_names_the_bytes_that_are_needed(
    start: Callable[..., ChipNode],
) -> None:
    node = start(**{'codec': 'png', 'cache.max_bytes': 1000.0, 'cache.max_age': 60.0})
    node.connect()
    before = node.counts()
    first, *_ = [send_image(node) for _ in range(25)]
    node.wait(lambda: node.counts().since(before)['images_received'] == 25, 'all images')
    # Of 64 bytes, 15 wait at most.
    assert node.counts()['images_waiting'] == 15
    said = warning_of_late_plan(node, first)
    assert said == 'more than cache.max_bytes waited; 1600 bytes are needed'


def test_a_plan_for_an_image_that_expired_says_how_late_it_is(
    start: Callable[..., ChipNode],
) -> None:
    node = start(**{'codec': 'png', 'cache.max_age': 0.3})
    node.connect()
    first = send_image(node)
    node.wait(lambda: node.counts()['images_dropped.expired'], 'expiry')
    assert warning_of_late_plan(node, first) == 'it waited longer than cache.max_age'


def test_the_image_of_an_equal_stamp_wins_though_it_comes_after_its_plan(node: ChipNode) -> None:
    node.set({'cache.slop': 1.5})
    before = node.counts()
    for i in range(1, 31):
        header = node.stamp()
        if i % 3 == 0:
            node.send_plan([(0, 0, 4, 4)], header)
            node.peer.spin(0.05)
        header_of_image = Header(stamp=header.stamp, frame_id=header.frame_id)
        pixels = np.full((8, 8), i, np.uint8)
        node.images.publish(image_message('mono8', pixels, header_of_image))
    node.wait(lambda: len(node.chips) == 10, 'ten chips')
    assert [pixels_of(chip).max() for chip in node.chips] == list(range(3, 31, 3))
    assert 'frames_paired_by_slop' not in node.counts().since(before)


@pytest.mark.parametrize('encoding', PIXEL_FORMATS)
def test_chips_have_the_pixels_of_the_image_at_their_place(node: ChipNode, encoding: str) -> None:
    layout = PIXEL_FORMATS[encoding]
    seen = picture(encoding)
    stored = np.empty_like(seen)
    stored[..., layout.channels] = seen
    header = node.send(stored, encoding, REGIONS)
    node.wait(lambda: len(node.chips) == len(node.infos) == 3, 'three chips')
    for i, (chip, info, region) in enumerate(zip(node.chips, node.infos, REGIONS, strict=True)):
        header.stamp.nanosec = i
        assert chip.header == info.header == header
        assert chip.format.startswith(f'{encoding}; png compressed ')
        assert (info.width, info.height) == (WIDTH, HEIGHT)
        x0, y0, x1, y1 = place_of(info)
        if layout.bayer:
            assert (x0 % 2, y0 % 2) == (0, 0)
            assert x0 in {region[0], region[0] - 1}
        else:
            assert (x0, y0, x1, y1) == region
        np.testing.assert_array_equal(
            pixels_of(chip).reshape(y1 - y0, x1 - x0, -1), seen[y0:y1, x0:x1]
        )


def test_a_yuv_image_is_cut_in_colour_where_the_plan_says(node: ChipNode) -> None:
    red = np.array([[81, 90], [81, 240]], np.uint8)
    stored = np.tile(red, (HEIGHT, WIDTH // 2, 1))
    stored[21:40, 12:30] = [41, 240]
    stored[21:40, 13:30:2] = [41, 110]
    node.send(stored, 'yuyv', [(11, 20, 31, 41)])
    node.wait(lambda: node.chips and node.infos, 'a chip')
    assert node.chips[0].format == 'yuyv; png compressed bgr8'
    assert place_of(node.infos[0]) == (11, 20, 31, 41)
    expected = np.full((21, 20, 3), (255, 0, 0))
    expected[1:20, 1:19] = (0, 0, 255)
    assert np.abs(pixels_of(node.chips[0]).astype(int) - expected).max() <= 1


def test_a_mosaic_is_developed_if_asked_for(node: ChipNode) -> None:
    node.set({'develop': True})
    mosaic = np.tile(np.array([[200, 100], [100, 50]], np.uint8), (HEIGHT // 2, WIDTH // 2))
    node.send(mosaic, 'bayer_rggb8', [(11, 21, 31, 41)])
    node.wait(lambda: node.chips and node.infos, 'a chip')
    node.set({'develop': False})
    assert place_of(node.infos[0]) == (11, 21, 31, 41)
    np.testing.assert_array_equal(pixels_of(node.chips[0]), np.full((20, 20, 3), (200, 100, 50)))


def test_images_may_travel_as_files(site: Site) -> None:
    arguments = {'codec': 'png', 'image_transport': 'compressed', 'input_timeout': 60.0}
    with ChipNode(site, arguments) as node:
        images = node.peer.publisher(CompressedImage, 'image/compressed')
        node.plans = node.peer.publisher(Detection2DArray, 'crop_regions')
        seen = picture('rgb8')
        good, damaged = (encode(seen, CodecSettings('png')), b'no picture')

        def send(data: bytes) -> None:
            header = node.stamp()
            images.publish(CompressedImage(header=header, format='rgb8; png', data=data))
            node.send_plan([(11, 20, 31, 41)], header)

        node.send_until(lambda: send(good), lambda: node.chips, 'a chip')
        np.testing.assert_array_equal(pixels_of(node.chips[0]), seen[20:41, 11:31])
        node.send_until(
            lambda: send(damaged), lambda: node.warned('no image in the file'), 'the warning'
        )
        counts = node.counts()
        assert counts['messages_unreadable'] == counts['chips_dropped.image_refused'] > 0
        node.forget()
        node.send_until(lambda: send(good), lambda: node.chips, 'a chip')


def test_rows_may_be_padded_and_bytes_in_either_order(node: ChipNode) -> None:
    seen = picture('mono16')[..., 0]
    header = node.stamp()
    rows = np.zeros((HEIGHT, 2 * WIDTH + 5), np.uint8)
    rows[:, : 2 * WIDTH] = seen.astype('>u2').view(np.uint8)
    image = image_message('mono16', rows, header)
    image.width, image.step, image.is_bigendian = WIDTH, 2 * WIDTH + 5, 1
    node.images.publish(image)
    node.send_plan([(10, 20, 31, 41)], header)
    node.wait(lambda: node.chips, 'a chip')
    np.testing.assert_array_equal(pixels_of(node.chips[0]), seen[20:41, 10:31])


@pytest.mark.parametrize('image_first', [True, False])
def test_image_and_plan_may_come_in_either_order(node: ChipNode, image_first: bool) -> None:
    headers = [node.stamp(), node.stamp()]
    image = [image_message('mono8', np.zeros((8, 8), np.uint8), header) for header in headers]
    # The second frame's parts overtake those of the first.
    steps = [lambda i=i: node.images.publish(image[i]) for i in (0, 1)]
    plans = [lambda i=i: node.send_plan([(0, 0, 4, 4)], headers[i]) for i in (1, 0)]
    for step in steps + plans if image_first else plans + steps:
        step()
    node.wait(lambda: len(node.chips) == 2, 'two chips')
    assert {chip.header.stamp.sec for chip in node.chips} == {h.stamp.sec for h in headers}


def test_what_never_meets_comes_twice_or_has_no_stamp_is_counted_and_nothing_stalls(
    node: ChipNode,
) -> None:
    node.set({'cache.images': 4})
    node.wait(lambda: not node.counts()['images_waiting'], 'that no image waits')
    before = node.counts()
    image = image_message('mono8', np.zeros((8, 8), np.uint8), Header())
    region: list[Region] = [(0, 0, 4, 4)]
    # No stamp.
    node.images.publish(image)
    node.send_plan(region, Header())
    # Never meet.
    for _ in range(20):
        image.header = node.stamp()
        node.images.publish(image)
        node.peer.spin(0.01)
    for _ in range(5):
        node.send_plan(region * 3, node.stamp())
    # Twice, before and after it was paired.
    image.header = node.stamp()
    node.send_plan(region, image.header)
    node.send_plan(region, image.header)
    node.images.publish(image)
    node.images.publish(image)
    node.wait(lambda: node.chips, 'a chip')
    changed: dict[str, float] = {}

    def all_told() -> bool:
        changed.clear()
        changed.update(node.counts().since(before))
        return changed.get('crop_plans_dropped.expired') == 5

    node.wait(all_told, 'expiry')
    assert changed['images_dropped.zero_stamp'] == changed['crop_plans_dropped.zero_stamp'] == 1
    # Four wait at most; on a slow machine more than the last of them may expire.
    assert changed['images_dropped.crowded_out'] + changed['images_dropped.expired'] == 20
    assert changed['images_dropped.crowded_out'] > 0
    assert changed['images_dropped.duplicate'] == changed['crop_plans_dropped.duplicate'] == 1
    assert changed['chips_planned'] == 18
    assert changed['chips_sent'] == 1
    dropped = {name: n for name, n in changed.items() if name.startswith('chips_dropped.')}
    assert dropped == {
        'chips_dropped.crop_plan_expired': 15,
        'chips_dropped.crop_plan_zero_stamp': 1,
        'chips_dropped.crop_plan_duplicate': 1,
    }
    assert 'chips_waiting' not in changed
    # Late: its partner has gone.
    late = node.stamp()
    node.send_plan(region, late)
    node.send(np.zeros((8, 8), np.uint8), 'mono8', region)
    node.wait(lambda: len(node.chips) == 2, 'the chip of a later frame')


def test_an_image_that_cannot_be_cut_is_refused_with_a_reason_and_the_node_lives(
    node: ChipNode,
) -> None:
    before = node.counts()
    node.send(np.zeros((8, 8, 4), np.uint8), '32FC1', [(0, 0, 4, 4)])
    node.wait(lambda: "encoding '32FC1' cannot be cut" in node.process.log, 'a warning')
    node.set({'codec': 'jpeg'})
    node.send(np.zeros((8, 8), np.uint16), 'mono16', [(0, 0, 4, 4)])
    node.send(np.zeros((8, 8), np.uint8), 'mono8', [(0, 0, 4, 4)])
    node.wait(lambda: node.chips, 'a chip')
    assert node.chips[0].format == 'mono8; jpeg compressed '
    assert node.counts().since(before)['chips_dropped.image_refused'] == 2


@pytest.mark.parametrize(('codec', 'side'), [('webp', 16_384), ('jpeg', 65_501)])
def test_a_chip_that_its_format_cannot_hold_is_counted_and_said(
    start: Callable[..., ChipNode], codec: str, side: int
) -> None:
    node = start(codec=codec)
    node.connect()
    node.send(np.zeros((1, side), np.uint8), 'mono8', [(0, 0, side, 1), (0, 0, 8, 1)])
    node.wait(lambda: node.chips, 'the other chip')
    text = f'{codec} cannot hold the chip of {side} x 1 pixels at (0, 0)'
    node.wait(lambda: text in node.process.log, 'the warning')
    node.wait(lambda: node.warned(text), 'the level')
    # Last, as it forgets the diagnostics before.
    assert node.counts()['chips_dropped.encoder_failed'] == 1


def test_a_plan_for_another_image_is_said(start: Callable[..., ChipNode]) -> None:
    node = start(codec='png')
    node.connect()
    node.send(np.zeros((8, 8), np.uint8), 'mono8', [(100, 100, 108, 108), (0, 0, 4, 4)])
    node.wait(lambda: 'dropped 1 of 2 chips' in node.process.log, 'the warning')
    node.wait(lambda: node.warned('outside the image'), 'the level')


def test_what_is_no_message_is_counted(node: ChipNode) -> None:
    before = node.counts()
    node.images.publish(b'\0\1\0\0' + bytes(5))
    node.plans.publish(b'\0\1\0\0' + bytes(5))
    node.wait(
        lambda: node.counts().since(before).get('messages_unreadable') == 2, 'both are counted'
    )
    node.send(np.zeros((8, 8), np.uint8), 'mono8', [(0, 0, 4, 4)])
    node.wait(lambda: node.chips, 'a chip')


def test_settings_that_do_not_fit_are_refused_and_change_nothing(node: ChipNode) -> None:
    result = node.set_atomically({'codec': 'jpeg', 'lossless': True})
    assert not result.successful
    assert 'lossless: jpeg cannot be' in result.reason
    node.send(np.zeros((8, 8), np.uint8), 'mono8', [(0, 0, 4, 4)])
    node.wait(lambda: node.chips, 'a chip')
    assert node.chips[0].format == 'mono8; png compressed '


def test_the_budget_of_the_link_holds_and_every_chip_is_accounted_for(
    start: Callable[..., ChipNode],
) -> None:
    rate, burst = 20_000.0, 10_000.0
    node = start(codec='png')
    node.connect()
    node.set({'budget.bytes_per_second': rate, 'budget.burst': burst})
    before = node.counts()
    noise = np.random.default_rng(2).integers(0, 256, (480, 640)).astype(np.uint8)
    places = np.random.default_rng(3).integers(0, (600, 440), (200, 2)).tolist()
    regions = [(x, y, x + 20 + i % 20, y + 30) for i, (x, y) in enumerate(places)]
    order = {region: i for i, region in enumerate(regions)}
    node.forget()
    began = time.monotonic()
    for frame in range(25):
        node.send(noise, 'mono8', regions)
        node.peer.spin_to(began + 0.1 * frame)
    changed: dict[str, float] = {}

    def all_told() -> bool:
        changed.update(node.counts().since(before))
        return changed.get('frames_paired') == 25

    node.wait(all_told, 'all frames')
    node.wait(lambda: len(node.chips) == changed['chips_sent'], 'all chips')
    assert changed['chips_planned'] == 25 * 200
    dropped = sum(n for name, n in changed.items() if name.startswith('chips_dropped.'))
    assert changed['chips_sent'] + dropped == 25 * 200
    sizes = [len(chip.data) for chip in node.chips]
    assert sum(sizes) == changed['bytes_sent']
    # A chip is published a little after it was taken from the budget.
    slack = 0.2 * rate
    for i, j in itertools.combinations_with_replacement(range(len(sizes)), 2):
        window = node.sent[j] - node.sent[i]
        assert sum(sizes[i : j + 1]) <= rate * window + burst + slack
    # The link was used, and by the most valuable of each frame.
    assert sum(sizes) > 0.5 * rate * (node.sent[-1] - node.sent[0])
    by_frame: dict[int, list[int]] = {}
    for info in node.infos:
        by_frame.setdefault(info.header.stamp.sec, []).append(order[place_of(info)])
    assert all(indices == list(range(len(indices))) for indices in by_frame.values())


def test_an_inactive_node_sends_nothing_and_what_waited_is_counted(
    start: Callable[..., ChipNode],
) -> None:
    # The plan waits as long as it takes to be deactivated.
    node = start(**{'codec': 'png', 'cache.max_age': 60.0})
    node.connect()
    before = node.counts()
    node.send_plan(REGIONS, node.stamp())
    node.wait(lambda: node.counts()['chips_waiting'] == 3, 'a waiting plan')
    assert node.change_state(Transition.TRANSITION_DEACTIVATE)
    node.send(np.zeros((8, 8), np.uint8), 'mono8', [(0, 0, 4, 4)])
    node.wait(
        lambda: node.counts().since(before).get('messages_while_inactive') == 2, 'both are counted'
    )
    changed = node.counts().since(before)
    assert changed['chips_dropped.crop_plan_deactivated'] == 3
    assert node.chips == []
    assert node.change_state(Transition.TRANSITION_ACTIVATE)
    node.send(np.zeros((8, 8), np.uint8), 'mono8', [(0, 0, 4, 4)])
    node.wait(lambda: node.chips, 'a chip')


def test_a_frame_that_takes_long_is_cut_in_slices_between_which_the_node_answers(
    start: Callable[..., ChipNode], tmp_path: Any
) -> None:
    node = start(**{'codec': 'jpeg2000', 'lossless': True, 'spool.path': str(tmp_path)})
    node.connect()
    # Cut in one go, it would take about two minutes.
    pixels = np.random.default_rng(1).integers(0, 256, (512, 512, 3)).astype(np.uint8)
    before = node.counts()
    node.send(pixels, 'rgb8', [(0, 0, 512, 512)] * 1000)
    node.wait(lambda: node.counts()['spool.waiting'] > 3, 'a part of the frame')
    assert node.counts()['chips_waiting'] == 1000
    assert node.change_state(Transition.TRANSITION_DEACTIVATE)
    changed = node.counts().since(before)
    cut_off = changed['chips_dropped.deactivated']
    assert changed['chips_sent'] + cut_off == 1000
    assert changed['chips_stored'] + changed['spool.refused.deactivated'] == 1000
    assert node.counts()['spool.in_work'] == 0


def test_what_each_chip_repeats_is_short(node: ChipNode) -> None:
    before = node.counts()
    header = node.stamp()
    header.frame_id = 'c' * 200_000
    node.images.publish(image_message('mono8', np.zeros((8, 8), np.uint8), header))
    node.send_plan([(0, 0, 4, 4)] * 2, header)
    node.wait(
        lambda: node.counts().since(before).get('chips_dropped.image_refused') == 2, 'refused chips'
    )
    assert node.chips == []


def side_that_takes(seconds: float) -> int:
    """Find the side of a noisy image that takes some time to encode."""
    noise = np.random.default_rng(1).integers(0, 256, (500, 500, 3)).astype(np.uint8)
    taken = []
    for _ in range(3):
        started = time.perf_counter()
        encode(noise, CodecSettings('jpeg2000', lossless=True))
        taken.append(time.perf_counter() - started)
    return int(500 * (seconds / min(taken)) ** 0.5)


@pytest.mark.parametrize('stall', [0.6, 0.9])
def test_no_frame_is_lost_to_a_stall(site: Site, stall: float) -> None:
    with ChipNode(site, {'codec': 'jpeg2000', 'lossless': True}) as node:
        node.connect()
        send_through_a_stall(node, stall)


def send_through_a_stall(node: ChipNode, stall: float) -> None:
    """Send frames, one of which takes as long to encode as others take to come."""
    # A chip that takes as long to encode, amid frames that take none.
    side = side_that_takes(stall)
    large = np.random.default_rng(1).integers(0, 256, (side, side, 3)).astype(np.uint8)
    small = np.zeros((512, 512, 3), np.uint8)
    sent: set[int] = set()

    def on_the_way() -> int:
        return len(sent - {chip.header.stamp.sec for chip in node.chips})

    for i in range(50):
        node.peer.spin_to(time.monotonic() + 0.1)
        # A busy machine makes the stall longer, but no more frames come in it.
        node.wait(lambda: on_the_way() <= 10.0 * stall, 'a chip')
        pixels, size = (large, side) if i == 20 else (small, 8)
        sent.add(node.send(pixels, 'rgb8', [(0, 0, size, size)]).stamp.sec)
    node.wait(lambda: not on_the_way(), 'fifty chips')
    # It was one: longer than the time between frames.
    assert node.counts()['latency_max_ms'] > 100.0


def test_a_bag_that_loops_gives_its_chips_each_time_and_says_so(
    start: Callable[..., ChipNode],
) -> None:
    node = start(codec='png')
    node.connect()
    headers = [node.stamp() for _ in range(30)]
    pixels = np.zeros((8, 8), np.uint8)
    for _ in range(3):
        node.forget()
        for i, header in enumerate(headers):
            node.images.publish(image_message('mono8', pixels, header))
            node.send_plan([(0, 0, 4, 4)], header)
            node.wait(lambda i=i: len(node.chips) > i, 'its chip')
        assert len(node.chips) == 30
    assert node.counts()['stamps_ran_back'] == 4
    assert 'went backwards from ' in node.process.log


def test_the_whole_chain_runs_from_a_folder(site: Site, tmp_path: Any) -> None:
    labels = harbour()
    write_labels(tmp_path / 'harbour.csv', [labels])
    random = np.random.default_rng(4)
    seen = random.integers(0, 256, (labels.size[1], labels.size[0], 3)).astype(np.uint8)
    Picture.fromarray(seen).save(tmp_path / 'harbour.png')
    with ChipNode(site, {'codec': 'png'}) as node:
        node.connect()
        # What the test itself sent to get connected would be a second camera.
        for publisher in (node.images, node.plans):
            node.peer.node.destroy_publisher(publisher)
        with Converter(site, namespace=node.namespace) as converter:
            plans = node.peer.collect(Detection2DArray, 'crop_regions')
            converter.connect()
            parameters = {'path': tmp_path, 'rate': 2.0, 'loop': True}
            player = {'namespace': node.namespace, 'parameters': parameters}
            with site.start('play_detections', **player):
                node.wait(lambda: min(len(node.chips), len(node.infos)) >= 30, 'chips')
            assert plans
        for chip, info in zip(node.chips, node.infos, strict=False):
            x0, y0, x1, y1 = place_of(info)
            assert chip.header == info.header
            np.testing.assert_array_equal(pixels_of(chip), seen[y0:y1, x0:x1])
