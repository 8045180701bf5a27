# SPDX-License-Identifier: Apache-2.0
"""Each chip with its own place, id, class, score, camera and source image, on its topics."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from harness import ChipNode
from harness import Converter
from harness import Site
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import RegionOfInterest
from ships import detections
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.nodes.player_messages import image_message

# Long, and about DDS, SQLite and files rather than NumPy and Pillow.
pytestmark = pytest.mark.once

ROOT = Path(__file__).parents[2]
SIDE = 800
WHITE = np.full((SIDE, SIDE), 255, np.uint8)


@pytest.fixture(scope='module')
def shared(site: Site) -> Iterator[ChipNode]:
    with ChipNode(site, {'codec': 'png'}) as node:
        node.identities = node.peer.collect(Detection2DArray, 'chip/detections')
        node.connect()
        node.wait(lambda: node.identities, 'a first identity')
        yield node


@pytest.fixture
def node(shared: ChipNode) -> ChipNode:
    shared.set({'cache.slop': 0.0, 'cache.max_age': 5.0})
    shared.forget()
    shared.identities.clear()
    return shared


def grid(count: int) -> list[tuple[int, int, int, int]]:
    """Give regions of different sizes in different places."""
    return [
        (40 * (i % 20), 40 * (i // 20), 40 * (i % 20) + 8 + i % 7, 40 * (i // 20) + 8 + i % 11)
        for i in range(count)
    ]


def send(node: ChipNode, count: int, header: Header, image_header: Header | None = None) -> None:
    """Send an image and a plan, each region with an id, a class and a score of its own."""
    rows = [((a + c) / 2, (b + d) / 2, c - a, d - b, 0.0) for a, b, c, d in grid(count)]
    plan = detections(rows)
    plan.header = header
    for i, detection in enumerate(plan.detections):
        detection.id = f'id {i}'
        detection.results[0].hypothesis.class_id = f'class {i % 5}'
        detection.results[0].hypothesis.score = 1.0 - i / 1000
        # Detectors leave it empty, or do not.
        detection.header.stamp.sec = i
    node.images.publish(image_message('mono8', WHITE, image_header or header))
    node.plans.publish(plan)


EXAMPLE = re.search(
    r'```python\n(import rclpy.*?)```', (ROOT / 'doc' / 'chip_extractor.md').read_text(), re.S
)[1]


def test_the_example_of_the_page_pairs_a_hundred_chips_per_frame(
    node: ChipNode, tmp_path: Path
) -> None:
    (tmp_path / 'example.py').write_text(EXAMPLE)
    path = os.environ.get('PYTHONPATH', '')
    if importlib.util.find_spec('message_filters') is None:
        path = os.pathsep.join(filter(None, (path, str(ROOT / 'test' / 'stand_ins'))))
    with (
        (tmp_path / 'out').open('w') as out,
        subprocess.Popen(
            [sys.executable, 'example.py', '--ros-args', '-r', f'__ns:={node.namespace}'],
            cwd=tmp_path,
            stdout=out,
            env={**os.environ, 'PYTHONPATH': path},
        ) as example,
    ):
        try:
            count = node.peer.node.count_subscribers
            node.wait(
                lambda: (
                    all(count(f'chip/{name}') == 2 for name in ('compressed', 'camera_info'))
                    and count('chip/detections') == 2
                ),
                'the example',
            )
            # The node's end knows of it a little later.
            node.send_until(
                lambda: send(node, 1, node.stamp()), (tmp_path / 'out').read_text, 'a first line'
            )
            frames = []
            for _ in range(3):
                frames.append(node.stamp())
                frames[-1].stamp.nanosec = 999_999_950
                send(node, 100, frames[-1])
            lines = {
                f'{f.stamp.sec} {f.stamp.nanosec} id {i} class {i % 5} {1.0 - i / 1000} '
                for f in frames
                for i in range(100)
            }
            node.wait(
                lambda: (
                    sum(
                        ' 999999950 ' in line
                        for line in (tmp_path / 'out').read_text().splitlines()
                    )
                    == 300
                ),
                'three hundred chips',
            )
        finally:
            example.kill()
    told = [line for line in (tmp_path / 'out').read_text().splitlines() if ' 999999950 ' in line]
    sizes = {}
    for line in told:
        (start,) = (each for each in lines if line.startswith(each))
        number, x, y, width, height = map(int, line.removeprefix(start).split())
        i = int(start.split()[3])
        a, b, c, d = grid(100)[i]
        assert (x, y, width, height) == (a, b, c - a, d - b)
        # The file of the chip itself, not of another one.
        assert sizes.setdefault((width, height), number) == number
        lines.remove(start)
    assert not lines


def test_no_two_chips_share_a_stamp_though_frames_are_nanoseconds_apart(node: ChipNode) -> None:
    first, second = Header(frame_id='a'), Header(frame_id='b')
    first.stamp.sec = second.stamp.sec = 5000
    second.stamp.nanosec = 3
    for header in (first, second):
        send(node, 10, header)

    def of_both(messages: list[Any]) -> dict[tuple[int, int], Any]:
        return {
            (each.header.stamp.sec, each.header.stamp.nanosec): each
            for each in messages
            if each.header.frame_id in {'a', 'b'}
        }

    node.wait(
        lambda: len(of_both(node.chips)) == len(of_both(node.identities)) == 20,
        'twenty chips with stamps of their own',
    )
    by_stamp = of_both(node.identities)
    for chip in of_both(node.chips).values():
        identity = by_stamp[chip.header.stamp.sec, chip.header.stamp.nanosec]
        source = first if chip.header.frame_id == 'a' else second
        assert identity.header == chip.header
        assert identity.detections[0].header == source


def camera(width: int, height: int) -> CameraInfo:
    return CameraInfo(
        width=width,
        height=height,
        distortion_model='plumb_bob',
        d=[0.1, 0.2, 0.3, 0.4, 0.5],
        k=np.arange(9.0),
        r=np.arange(9.0) + 10,
        p=np.arange(12.0) + 20,
    )


def seen_by(node: ChipNode, info: CameraInfo) -> CameraInfo:
    """Publish a camera info and give that of the chip (20, 30, 60, 50)."""
    node.heard_publisher(CameraInfo, 'camera_info').publish(info)
    # The camera is known when it has come before the image.
    node.counts()
    node.forget()
    node.send(WHITE, 'mono8', [(20, 30, 60, 50)])
    node.wait(lambda: node.infos and node.chips, 'a chip')
    return node.infos[0]


def test_the_camera_of_the_image_is_that_of_the_chip_with_its_place(node: ChipNode) -> None:
    info = camera(SIDE, SIDE)
    found = seen_by(node, info)
    expected = camera(SIDE, SIDE)
    expected.header = node.chips[0].header
    expected.roi = RegionOfInterest(x_offset=20, y_offset=30, width=40, height=20)
    assert found == expected


def test_the_place_is_in_pixels_of_the_camera_if_the_image_is_a_part_of_it_or_binned(
    node: ChipNode,
) -> None:
    info = camera(4000, 3000)
    info.binning_x, info.binning_y = 2, 3
    info.roi = RegionOfInterest(
        x_offset=100, y_offset=200, width=2 * SIDE, height=3 * SIDE, do_rectify=True
    )
    found = seen_by(node, info)
    assert found.roi == RegionOfInterest(
        x_offset=140, y_offset=290, width=80, height=60, do_rectify=True
    )
    assert (found.width, found.height) == (4000, 3000)


def test_a_camera_of_another_size_is_not_that_of_the_image(node: ChipNode) -> None:
    found = seen_by(node, camera(SIDE + 2, SIDE))
    assert (found.width, found.height) == (SIDE, SIDE)
    assert not found.k.any()


def test_a_chip_waits_for_a_camera_that_is_on_its_way(node: ChipNode) -> None:
    cameras = node.heard_publisher(CameraInfo, 'camera_info')
    headers = [node.stamp() for _ in range(3)]
    infos = []
    for i, header in enumerate(headers):
        infos.append(camera(4000, 3000))
        infos[i].header = header
        infos[i].roi = RegionOfInterest(x_offset=1000 * i, width=SIDE, height=SIDE)
    cameras.publish(infos[0])
    node.counts()
    node.forget()
    before = node.counts()
    for header in headers:
        send(node, 1, header)
    node.wait(lambda: node.counts()['chips_waiting'] == 2, 'two chips that wait')
    for info in infos[1:]:
        cameras.publish(info)
    node.wait(lambda: len(node.infos) == 3, 'three chips')
    assert [info.roi.x_offset // 1000 for info in node.infos] == [0, 1, 2]
    assert node.counts().since(before, 'camera_info') == {'camera_info_by_stamp': 3}
    # If it does not come, the latest counts in the end, and the next image does not wait.
    node.set({'cache.max_age': 3.0})
    for _ in range(2):
        send(node, 1, node.stamp())
    node.wait(lambda: len(node.infos) == 5, 'two more')
    assert node.counts().since(before)['camera_info_latest'] == 2


def test_a_camera_of_another_size_is_said_with_both_sizes(node: ChipNode) -> None:
    before = node.counts()
    seen_by(node, camera(640, 480))
    node.wait(lambda: node.warned('800 x 800 pixels, its camera_info says 640 x 480'), 'a warning')
    assert node.counts().since(before)['camera_info_of_another_size'] == 1


def test_frames_that_differ_are_counted_and_said_once(node: ChipNode) -> None:
    info = camera(SIDE, SIDE)
    info.header.frame_id = 'right'
    seen_by(node, info)
    before = node.counts()
    node.forget()
    for _ in range(2):
        header = node.stamp()
        send(node, 1, Header(stamp=header.stamp, frame_id='left'), header)
    node.wait(lambda: len(node.chips) == 2, 'two chips')
    assert node.counts().since(before, 'frame_ids') == {
        'frame_ids_differ.crop_regions': 2,
        'frame_ids_differ.camera_info': 2,
    }
    for what in ("crop_regions of frame 'left'", "camera_info of frame 'right'"):
        assert node.process.log.count(f"image of frame 'bow_camera', but {what}") == 1


def test_a_region_of_interest_that_is_a_pixel_off_keeps_the_camera(node: ChipNode) -> None:
    info = camera(2 * SIDE, 2 * SIDE)
    info.binning_x, info.binning_y = 2, 2
    info.roi = RegionOfInterest(width=2 * SIDE - 1, height=2 * SIDE + 2)
    found = seen_by(node, info)
    assert (found.width, found.height) == (2 * SIDE, 2 * SIDE)
    assert found.k.tolist() == info.k.tolist()
    assert found.roi == RegionOfInterest(x_offset=40, y_offset=60, width=80, height=40)


def test_a_chip_has_the_camera_of_its_image_though_its_plan_comes_late(node: ChipNode) -> None:
    cameras = node.heard_publisher(CameraInfo, 'camera_info')
    before = node.counts()
    headers = [node.stamp() for _ in range(5)]
    for i, header in enumerate(headers):
        info = camera(4000, 3000)
        info.header = header
        info.roi = RegionOfInterest(x_offset=100 * i, y_offset=10 * i, width=SIDE, height=SIDE)
        cameras.publish(info)
    # All cameras are known before the first image is cut.
    node.counts()
    node.forget()
    for header in headers:
        send(node, 1, header)
    node.wait(lambda: len(node.infos) == 5, 'five chips')
    places = {info.header.stamp.sec: (info.roi.x_offset, info.roi.y_offset) for info in node.infos}
    x, y = places[headers[0].stamp.sec]
    assert places == {
        header.stamp.sec: (x + 100 * i, y + 10 * i) for i, header in enumerate(headers)
    }
    assert node.counts().since(before, 'camera_info') == {'camera_info_by_stamp': 5}
    node.set({'cache.max_age': 0.5})
    send(node, 1, node.stamp())
    node.wait(lambda: len(node.infos) == 6, 'a chip of an image without a camera of its stamp')
    assert node.infos[-1].roi.x_offset == x + 400
    assert node.counts().since(before, 'camera_info')['camera_info_latest'] == 1


def test_stamps_that_differ_by_no_more_than_the_slop_are_paired(node: ChipNode) -> None:
    image, plan = node.stamp(), node.stamp()
    plan.stamp.sec = image.stamp.sec
    plan.stamp.nanosec = 40_000_000
    node.set({'cache.max_age': 60.0})
    send(node, 1, plan, image)
    node.send(WHITE, 'mono8', [(0, 0, 4, 4)])
    node.wait(lambda: node.chips and node.identities, 'the chip of another frame')
    assert len(node.chips) == 1
    node.forget()
    node.identities.clear()
    # They still wait.
    node.set({'cache.slop': 0.05})
    node.wait(lambda: node.chips and node.identities, 'a chip')
    assert node.counts()['frames_paired_by_slop'] == 1
    # It is the image's stamp that counts.
    assert node.chips[0].header.stamp == image.stamp
    assert node.identities[0].detections[0].header.stamp == image.stamp


def test_the_source_of_a_region_is_its_most_valuable_detection(site: Site) -> None:
    parameters = {
        'image_width': SIDE,
        'image_height': SIDE,
        'crop.merge_max_size': 400,
        'class_ids': ['tug'],
        'classes.tug.weight': 10.0,
    }
    with Converter(site, parameters=parameters) as converter:
        sources = converter.peer.collect(Detection2DArray, 'crop_sources')
        regions = converter.peer.collect(Detection2DArray, 'crop_regions')
        converter.connect(sources)
        converter.connect(regions)
        message = detections(
            [
                (100, 100, 60, 30, 0.3),
                (105, 100, 14, 30, 0.3),
                (600, 600, 80, 30, -0.5),
            ]
        )
        for detection, (name, score) in zip(
            message.detections, [('ship', 0.9), ('tug', 0.4), ('ship', 0.8)], strict=True
        ):
            detection.id = name
            detection.results[0].hypothesis.class_id = name
            detection.results[0].hypothesis.score = score
        stamp = converter.send(message)
        found = converter.answer_to(stamp, sources)
        plan = converter.answer_to(stamp, regions)
        assert [each.id for each in plan.detections] == ['tug|ship', 'ship']
        first, second = found.detections
        assert first.results[0].hypothesis.class_id == 'tug'
        assert first.results[0].hypothesis.score == pytest.approx(4.0 + 0.9)
        assert second.results[0].hypothesis.score == pytest.approx(0.8)
        # The long side lies along theta.
        box = first.bbox
        assert (box.center.position.x, box.center.position.y) == pytest.approx((105, 100))
        assert (box.size_x, box.size_y) == pytest.approx((30, 14))
        assert box.center.theta == pytest.approx(0.3 + np.pi / 2 - np.pi)
        # The scores of the plan are those of the detector.
        scores = [r.hypothesis.score for each in plan.detections for r in each.results]
        assert scores == [0.4, 0.9, 0.8]


def test_a_camera_with_a_region_that_no_message_can_hold_is_refused(node: ChipNode) -> None:
    info = camera(SIDE, SIDE)
    info.roi = RegionOfInterest(x_offset=2**32 - 1, width=SIDE, height=SIDE)
    publisher = node.peer.publisher(CameraInfo, 'camera_info')
    node.send_until(
        lambda: publisher.publish(info),
        lambda: 'a region of interest up to' in node.next_report().message,
        'the warning',
    )
    assert node.counts()['messages_unreadable']


def test_a_camera_that_cannot_be_read_costs_no_chip(node: ChipNode) -> None:
    publisher = node.peer.publisher(CameraInfo, 'camera_info')
    node.send_until(
        lambda: publisher.publish(b'\0\1\0\0' + bytes(5)),
        lambda: node.counts()['messages_unreadable'],
        'it is counted',
    )
    node.send(WHITE, 'mono8', [(0, 0, 4, 4)])
    node.wait(lambda: node.chips, 'a chip')
