# SPDX-License-Identifier: Apache-2.0
"""`obbhbb bag` gives the bytes of the live node, message for message."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from harness import RELIABLE
from harness import Converter
from rclpy.serialization import deserialize_message
from recordings import Recorded
from recordings import build
from recordings import camera_info
from recordings import detections
from recordings import header
from recordings import messages_of
from recordings import on
from recordings import pack
from recordings import real_ships
from recordings import record
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.bags.replay import Options
from obbhbb_ros.bags.replay import add_boxes
from obbhbb_ros.labels import read_labels
from obbhbb_ros.nodes.documentation import yaml_value
from obbhbb_ros.nodes.play_detections import detections_message
from obbhbb_ros.wire.layouts import INPUT_TYPES

pytest.importorskip('mcap')

DATA = Path(__file__).parents[1] / 'data'
SHIPS = [row for image in real_ships() for row in image]
# The last is no ship.
MESSAGES = [*(SHIPS[i : i + 5] for i in range(0, 40, 5)), SHIPS[:1], [*SHIPS[:2], [0.0] * 5]]
PARAMETERS = {'q': 2.5, 'clip_boxes': True, 'crop.padding': 0.1, 'crop.merge_max_size': 900}


def empty(kind: str, stamp: int, little_endian: bool) -> bytes:
    """Write a message without detections."""
    return pack(kind, build(kind, header=header(stamp)), little_endian)


class Conversation:
    """Messages sent to a live node, as they would be recorded, and what it answers."""

    def __init__(self, node: Converter, kind: str) -> None:
        self._node = node
        self._topic = INPUT_TYPES[kind].topic
        self.sent: list[Recorded] = []
        self.boxes = node.peer.collect(Detection2DArray, 'boxes', RELIABLE, raw=True)
        self.regions = node.peer.collect(Detection2DArray, 'crop_regions', RELIABLE, raw=True)
        self._camera = node.peer.publisher(CameraInfo, 'camera_info')
        self._make_heard(kind)

    def _make_heard(self, kind: str) -> None:
        """
        Wait until all four topics are connected and nothing is on its way any more.

        The node is left without an image size.
        """
        first, last = (detections(kind, MESSAGES[0], stamp) for stamp in (1, 2))
        node = self._node
        node.connect()
        node.send_until(
            lambda: self._camera.publish(b'no camera info'),
            lambda: node.reports() and node.counts().get('messages_unreadable'),
            'the camera info',
        )
        node.set({'image_width': 10, 'image_height': 10})
        node.send_until(lambda: node.publisher.publish(first), lambda: self.regions, 'regions')
        node.publisher.publish(last)
        # The stamp is what a message begins with.
        node.wait(
            lambda: {self.boxes[-1][4:8], self.regions[-1][4:8]} == {last[4:8]}, 'the last answer'
        )
        node.set({'image_width': 0, 'image_height': 0})
        self.boxes.clear()
        self.regions.clear()

    def tell_size(self, width: int, height: int) -> None:
        data = camera_info(width, height)
        self._camera.publish(data)
        self.sent.append(Recorded('/here/camera_info', len(self.sent), data))

    def wait_for_regions(self, count: int) -> None:
        self._node.wait(lambda: len(self.regions) == count, 'the last crop regions')

    def ask(self, data: bytes) -> None:
        """Send a message and wait for its boxes."""
        count = len(self.boxes)
        self.sent.append(Recorded(f'/here/{self._topic}', len(self.sent), data))
        self._node.publisher.publish(data)
        self._node.wait(lambda: len(self.boxes) > count, 'boxes')


def filled(messages: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    """Fill messages up to a multiple of four bytes, as Fast DDS does on the way."""
    return [(time, data + bytes(-len(data) % 4)) for time, data in messages]


@pytest.mark.parametrize('kind', INPUT_TYPES)
def test_a_bag_gets_the_bytes_of_the_live_node(
    start: Callable[..., Converter], tmp_path: Path, kind: str
) -> None:
    if kind == 'DetectionArray':
        pytest.importorskip('yolo_msgs')
    talk = Conversation(start(parameters={'input_type': kind, **PARAMETERS}), kind)
    for little_endian in (True, False):
        # Boxes alone, as the size of the image is not known yet.
        talk.ask(detections(kind, MESSAGES[0], 1, little_endian))
    for size in ((1200, 800), (700, 600)):
        talk.tell_size(*size)
        for stamp, rows in enumerate(MESSAGES):
            for little_endian in (True, False):
                talk.ask(detections(kind, rows, stamp, little_endian))
    for little_endian in (True, False):
        talk.ask(empty(kind, 99, little_endian))
    talk.wait_for_regions(len(talk.boxes) - 2)

    topic = f'/here/{INPUT_TYPES[kind].topic}'
    params = tmp_path / 'params.yaml'
    lines = [f'    {name}: {yaml_value(value)}' for name, value in PARAMETERS.items()]
    params.write_text('\n'.join(['/**:', '  ros__parameters:', *lines]))
    for storage in ('mcap', 'sqlite3'):
        source, target = tmp_path / storage, tmp_path / f'{storage}_out'
        record(source, {'/here/camera_info': 'CameraInfo', topic: kind}, talk.sent, storage)
        add_boxes(source, target, Options(params_file=params))
        made = messages_of(target)
        times = [time for time, _ in on(topic, talk.sent)]
        assert filled(on('/here/boxes', made)) == list(zip(times, talk.boxes, strict=True))
        assert filled(on('/here/crop_regions', made)) == list(
            zip(times[2:], talk.regions, strict=True)
        )
    assert len(set(talk.regions)) >= 20


def test_the_bag_that_comes_with_the_tests_is_what_the_player_sends() -> None:
    found = on('/detections', messages_of(DATA / 'real_ships_bag'))
    messages = [detections_message(each, Header()) for each in read_labels(DATA / 'real_ships.csv')]
    for (_, data), message in zip(found, messages, strict=True):
        recorded = deserialize_message(data, Detection2DArray)
        message.header = recorded.header
        for each in message.detections:
            each.header = recorded.header
        assert recorded == message
