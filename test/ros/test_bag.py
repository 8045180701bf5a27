# SPDX-License-Identifier: Apache-2.0
"""`obbhbb bag` gives the bytes of the live node, message for message."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from harness import RELIABLE
from harness import Converter
from harness import Site
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

from obbhbb_ros.bags.replay import ReplayOptions
from obbhbb_ros.bags.replay import add_boxes
from obbhbb_ros.labels import read_labels
from obbhbb_ros.nodes.lifecycle.node_topics import message_type
from obbhbb_ros.nodes.player_messages import detections_message
from obbhbb_ros.settings.parameter_file import yaml_value
from obbhbb_ros.wire.layouts import INPUT_TYPES

# Long; what depends on the versions of NumPy and Pillow is tested without DDS as well.
pytestmark = pytest.mark.once

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
        self.node, self.kind = node, kind
        self.topic = INPUT_TYPES[kind].topic
        self.sent: list[Recorded] = []
        self.boxes = node.peer.collect(Detection2DArray, 'boxes', RELIABLE, raw=True)
        self.regions = node.peer.collect(Detection2DArray, 'crop_regions', RELIABLE, raw=True)

    def connect(self) -> None:
        """Wait until all four topics are connected and nothing is on its way any more."""
        first, last = (detections(self.kind, MESSAGES[0], stamp) for stamp in (1, 2))
        node = self.node
        node.connect()
        self._camera = node.heard_publisher(CameraInfo, 'camera_info')
        node.set({'image_width': 10, 'image_height': 10})
        node.send_until(lambda: node.publisher.publish(first), lambda: self.regions, 'regions')
        node.publisher.publish(last)
        # The stamp is what a message begins with.
        node.wait(
            lambda: {self.boxes[-1][4:8], self.regions[-1][4:8]} == {last[4:8]}, 'the last answer'
        )
        node.set({'image_width': 0, 'image_height': 0})

    def begin(self) -> None:
        for messages in (self.sent, self.boxes, self.regions):
            messages.clear()

    def tell_size(self, width: int, height: int) -> None:
        self._send(self._camera, 'camera_info', camera_info(width, height))

    def ask(self, data: bytes) -> None:
        """Send a message and wait for its boxes."""
        count = len(self.boxes)
        self._send(self.node.publisher, self.topic, data)
        self.node.wait(lambda: len(self.boxes) > count, 'boxes')

    def _send(self, publisher: Any, name: str, data: bytes) -> None:
        publisher.publish(data)
        self.sent.append(Recorded(f'/here/{name}', len(self.sent), data))

    def wait_for_regions(self, count: int) -> None:
        self.node.wait(lambda: len(self.regions) == count, 'the last crop regions')

    def check(self, folder: Path) -> None:
        """Compare what the node has answered with what becomes of a bag of what it was sent."""
        topic = f'/here/{self.topic}'
        topics = {'/here/camera_info': 'CameraInfo', topic: self.kind}
        times = [time for time, _ in on(topic, self.sent)]
        params = folder / 'params.yaml'
        lines = [f'    {name}: {yaml_value(value)}' for name, value in PARAMETERS.items()]
        params.write_text('\n'.join(['/**:', '  ros__parameters:', *lines]))
        for storage in ('mcap', 'sqlite3'):
            source = record(folder / f'{storage}_in', topics, self.sent, storage)
            add_boxes(source, folder / storage, ReplayOptions(params_file=params))
            made = messages_of(folder / storage)
            # Those without regions came first.
            for name, answers in (('boxes', self.boxes), ('crop_regions', self.regions)):
                expected = zip(times[-len(answers) :], answers, strict=True)
                assert filled(on(f'/here/{name}', made)) == list(expected)


def filled(messages: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    """Fill messages up to a multiple of four bytes, as Fast DDS does on the way."""
    return [(time, data + bytes(-len(data) % 4)) for time, data in messages]


@pytest.fixture(scope='module', params=INPUT_TYPES)
def talk(site: Site, request: pytest.FixtureRequest) -> Iterator[Conversation]:
    """A node of each input type, which loses nothing however busy the machine is."""
    kind = request.param
    if kind == 'DetectionArray':
        pytest.importorskip('yolo_msgs')
    namespace = f'/bag_{os.getpid()}_{kind.lower()}'
    arguments = []
    for topic in (INPUT_TYPES[kind].topic, 'camera_info'):
        for name, value in (('reliability', 'reliable'), ('depth', '100')):
            override = f'qos_overrides.{namespace}/{topic}.subscription.{name}:={value}'
            arguments += ['-p', override]
    parameters = {'input_type': kind, **PARAMETERS}
    with Converter(site, arguments, parameters, namespace) as node:
        conversation = Conversation(node, kind)
        conversation.connect()
        yield conversation


def test_a_bag_gets_the_bytes_of_the_live_node(talk: Conversation, tmp_path: Path) -> None:
    talk.begin()
    # No size: boxes alone.
    for size in ((0, 0), (1200, 800), (700, 600)):
        talk.tell_size(*size)
        for stamp, rows in enumerate(MESSAGES):
            for little_endian in (True, False):
                talk.ask(detections(talk.kind, rows, stamp, little_endian))
    for little_endian in (True, False):
        talk.ask(empty(talk.kind, 99, little_endian))
    talk.wait_for_regions(len(talk.boxes) - 2 * len(MESSAGES))
    talk.check(tmp_path)
    assert len(set(talk.regions)) >= 20


def test_a_bag_recorded_from_the_player_gets_the_bytes_of_the_live_node(
    site: Site, talk: Conversation, tmp_path: Path
) -> None:
    node = talk.node
    talk.begin()
    infos = node.peer.collect(CameraInfo, 'camera_info', RELIABLE, raw=True)
    inputs = node.peer.collect(message_type(INPUT_TYPES[talk.kind]), talk.topic, raw=True)
    parameters = {
        'path': DATA / 'real_ships.csv',
        'output_type': talk.kind,
        'rate': 50.0,
        'image_width': 1200,
        'image_height': 800,
        'wait_for_subscribers': 2,
    }
    player = site.start('play_detections', parameters=parameters, namespace=node.namespace)
    try:
        talk.wait_for_regions(len(SHIPS))
        node.wait(lambda: len(infos) == len(inputs) == len(SHIPS), 'the input')
    finally:
        player.close()
    for i, messages in enumerate(zip(infos, inputs, strict=True)):
        for name, data in zip(('camera_info', talk.topic), messages, strict=True):
            talk.sent.append(Recorded(f'/here/{name}', i, data))
    talk.check(tmp_path)


def test_the_bag_that_comes_with_the_tests_is_what_the_player_sends() -> None:
    found = on('/detections', messages_of(DATA / 'real_ships_bag'))
    messages = [detections_message(each, Header()) for each in read_labels(DATA / 'real_ships.csv')]
    for (_, data), message in zip(found, messages, strict=True):
        recorded = deserialize_message(data, Detection2DArray)
        assert len(recorded.detections) == len(message.detections)
        for ours, theirs in zip(message.detections, recorded.detections, strict=True):
            assert (ours.id, ours.results) == (theirs.id, theirs.results)
            # The last bit of an angle depends on the version of NumPy.
            assert box_of(ours) == pytest.approx(box_of(theirs), rel=1e-12)


def box_of(detection: Any) -> tuple[float, ...]:
    box = detection.bbox
    center = box.center
    return center.position.x, center.position.y, center.theta, box.size_x, box.size_y
