# SPDX-License-Identifier: Apache-2.0
"""What `obbhbb demo` leaves: a bag of the whole chain that viewers open, an overlay, images."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from harness import Site
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import CompressedImage

from obbhbb_ros.cli import main
from obbhbb_ros.colors import LAYER_COLORS
from obbhbb_ros.geometry.methods import ONBOARD_METHODS
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels.image_files import find_images

# What it tests depends on rclpy, which is the same in all environments.
pytestmark = pytest.mark.once

pytest.importorskip('matplotlib')
pytest.importorskip('PIL')
rosbag2 = pytest.importorskip('rosbags.rosbag2')
typesys = pytest.importorskip('rosbags.typesys')
mcap = pytest.importorskip('mcap.reader')

Recording = list[tuple[Any, Any, Any]]


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp('demo') / 'new'


@pytest.fixture(scope='module')
def printed(site: Site, folder: Path) -> str:
    """What the command prints, all of it on its standard output."""
    command = [sys.executable, '-m', 'obbhbb_ros.cli', 'demo', '--picture', folder / 'harbour.png']
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600)
    assert done.stderr == ''
    return done.stdout


def test_the_command_prints_a_table_and_draws_a_picture(printed: str, folder: Path) -> None:
    assert all(f'\n{method} ' in printed for method in ONBOARD_METHODS)
    assert (folder / 'harbour.png').read_bytes().startswith(b'\x89PNG')


@pytest.fixture
def recorded(printed: str, folder: Path) -> Recording:
    """Schema, channel and message of everything in the bag, in the order of the file."""
    with (folder / 'harbour_bag' / 'harbour_bag.mcap').open('rb') as stream:
        return list(mcap.make_reader(stream).iter_messages(log_time_order=False))


def by_topic(recorded: Recording) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    for _, channel, message in recorded:
        found.setdefault(channel.topic, []).append(message.data)
    return found


def test_the_bag_holds_the_whole_chain(recorded: Recording) -> None:
    found = {topic: len(messages) for topic, messages in by_topic(recorded).items()}
    images = found['/image']
    chips = found.pop('/chip/compressed')
    assert found.pop('/diagnostics') > 1
    assert images > 1
    assert chips > images
    assert found == {
        **dict.fromkeys(
            (
                '/image',
                '/camera_info',
                '/detections',
                '/boxes',
                '/crop_regions',
                '/overlay/compressed',
            ),
            images,
        ),
        **{f'/overlay/markers/{layer}': images for layer in LAYER_COLORS},
        '/overlay/markers': len(LAYER_COLORS) * images,
        '/chip/camera_info': chips,
        '/chip/detections': chips,
    }


def test_all_of_a_frame_has_its_stamp(recorded: Recording) -> None:
    stamps = {
        topic: {data[4:12] for data in messages}
        for topic, messages in by_topic(recorded).items()
        if not topic.startswith(('/chip/', '/diagnostics'))
    }
    assert len(stamps['/image']) > 1
    assert all(each == stamps['/image'] for each in stamps.values())


def test_the_bag_can_be_read_with_its_own_definitions_alone(recorded: Recording) -> None:
    stores = {}
    for schema, _, _ in recorded:
        if schema.id not in stores:
            stores[schema.id] = store = typesys.get_typestore(typesys.Stores.EMPTY)
            store.register(typesys.get_types_from_msg(schema.data.decode(), schema.name))
    for schema, channel, message in recorded:
        assert (channel.message_encoding, schema.encoding) == ('cdr', 'ros2msg')
        read = stores[schema.id].deserialize_cdr(message.data, schema.name)
        assert channel.topic == '/diagnostics' or read.header.frame_id == 'camera'


def test_the_times_in_the_bag_do_not_go_back(recorded: Recording) -> None:
    times = [message.log_time for _, _, message in recorded]
    assert times == sorted(times)
    assert (times[-1] - times[0]) / 1e9 > 18.0


def test_the_bag_holds_the_diagnostics_of_its_nodes_alone(recorded: Recording) -> None:
    reports = [
        deserialize_message(data, DiagnosticArray) for data in by_topic(recorded)['/diagnostics']
    ]
    names = Counter(status.name.partition('/')[2] for each in reports for status in each.status)
    assert set(names) == {'obb_to_hbb', 'chip_extractor', 'overlay'}
    assert min(names.values()) > 10


def test_the_scores_of_the_ships_differ(folder: Path, printed: str) -> None:
    frames = list(read_labels(folder / 'frames' / 'labels.csv'))
    for frame in frames:
        assert 0.4 < frame.scores.min() < 0.7
        assert 0.9 < frame.scores.max() <= 1.0
        assert np.ptp(np.quantile(frame.scores, (0.25, 0.75))) > 0.05
        assert (frame.scores == frames[0].scores).all()


def test_the_type_hashes_in_the_bag_are_those_of_ros(
    site: Site, printed: str, folder: Path
) -> None:
    with rosbag2.Reader(folder / 'harbour_bag') as reader:
        hashes = {each.msgtype: each.digest for each in reader.connections}
    node = rclpy.create_node('hashes', namespace='/hashes', context=site.context)
    for msgtype, digest in hashes.items():
        package, _, name = msgtype.split('/')
        kind = getattr(importlib.import_module(f'{package}.msg'), name)
        node.create_publisher(kind, name, 1)
        (info,) = node.get_publishers_info_by_topic(f'/hashes/{name}')
        assert str(info.topic_type_hash) == digest, msgtype
    node.destroy_node()


def test_pictures_in_the_bag_are_jpeg_files_and_say_so(recorded: Recording, folder: Path) -> None:
    found = by_topic(recorded)
    for topic in ('/overlay/compressed', '/chip/compressed'):
        for data in found[topic]:
            message = deserialize_message(data, CompressedImage)
            assert 'jpeg' in message.format
            assert bytes(message.data).startswith(b'\xff\xd8\xff')
    last = deserialize_message(found['/overlay/compressed'][-1], CompressedImage)
    assert (folder / 'overlay.jpg').read_bytes() == bytes(last.data)


def test_cameras_in_the_bag_have_a_focal_length(recorded: Recording) -> None:
    for topic in ('/camera_info', '/chip/camera_info'):
        for data in by_topic(recorded)[topic]:
            info = deserialize_message(data, CameraInfo)
            assert info.k[0] == info.k[4] == info.p[0] == info.p[5] > 0.0


def test_obbhbb_bag_makes_the_boxes_of_the_bag_again(
    recorded: Recording, folder: Path, tmp_path: Path
) -> None:
    command = ['bag', str(folder / 'harbour_bag'), str(tmp_path / 'again'), '--replace']
    assert main(command) == 0
    with rosbag2.Reader(tmp_path / 'again') as reader:
        again: dict[str, list[bytes]] = {}
        for connection, _, data in reader.messages():
            again.setdefault(connection.topic, []).append(bytes(data))
    for topic in ('/boxes', '/crop_regions'):
        # Fast DDS fills up to a multiple of four bytes.
        filled = [data + bytes(-len(data) % 4) for data in again[topic]]
        assert filled == by_topic(recorded)[topic]


def test_the_frames_can_be_played(printed: str, folder: Path) -> None:
    frames = list(read_labels(folder / 'frames' / 'labels.csv'))
    files = find_images(frames)
    assert len(frames) > 1
    assert all(files)
    assert len({len(each.class_ids) for each in frames}) == 1
