# SPDX-License-Identifier: Apache-2.0
"""The player: label files in, messages out, and through the node with all input types."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from harness import Converter
from harness import Node
from harness import NodeProcess
from harness import Site
from PIL import Image as Picture
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import Image
from ships import FloatArray
from ships import axis_aligned
from ships import rows_of
from vision_msgs.msg import Detection2DArray

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import read_labels
from obbhbb_ros.nodes.node_topics import message_type
from obbhbb_ros.nodes.play_detections import HARBOUR_SIZE
from obbhbb_ros.wire.layouts import INPUT_TYPES

# Long; what depends on the versions of NumPy and Pillow is tested without DDS as well.
pytestmark = pytest.mark.once

REAL_SHIPS = Path(__file__).parents[1] / 'data' / 'real_ships.csv'

DOTA = """imagesource:GoogleEarth
gsd:0.15
10 20 50 20 50 30 10 30 ship 0
100.5 200 100.5 260 90.5 260 90.5 200 tug 1
"""
# The same in an image of 400 x 500.
YOLO = """0 0.025 0.04 0.125 0.04 0.125 0.06 0.025 0.06 1.0
1 0.25125 0.4 0.25125 0.52 0.22625 0.52 0.22625 0.4 0.75
"""
CSV = """image,instance,class,x1,y1,x2,y2,x3,y3,x4,y4,score
P1,a,ship,10,20,50,20,50,30,10,30,
P2,c,ferry,0,0,8,0,8,4,0,4,0.25
P1,b,tug,100.5,200,100.5,260,90.5,260,90.5,200,0.75
"""
ROWS = [(30.0, 25.0, 40.0, 10.0, 0.0), (95.5, 230.0, 60.0, 10.0, np.pi / 2)]

Play = Callable[..., 'Player']
Put = Callable[[str, str], Path]


class Player(Node):
    """The node `play_detections` and a peer that listens to it."""

    def __init__(self, site: Site, **parameters: Any) -> None:
        super().__init__(site, 'play_detections')
        output_type = INPUT_TYPES[parameters.get('output_type', 'Detection2DArray')]
        # All is listened to before the player may count its subscribers.
        self.infos = self.peer.collect(CameraInfo, 'camera_info')
        self.images = self.peer.collect(Image, 'image')
        self.messages = self.peer.collect(message_type(output_type), output_type.topic)
        self.start(parameters={'rate': 50.0, **parameters})

    @property
    def log(self) -> str:
        return self.process.log

    def finish(self) -> int:
        """Listen until the player ends by itself, and give the exit code."""
        self.peer.spin_until(lambda: not self.process.running, 'the end of the player')
        for _ in range(20):
            self.peer.spin()
        return self.process.wait()


@pytest.fixture(scope='module')
def play(site: Site) -> Iterator[Play]:
    """
    Starts players that end with the module, all at once.

    A player that has played waits about three seconds to be told that all has arrived.
    """
    players: list[Player] = []

    def _play(**parameters: Any) -> Player:
        players.append(Player(site, **parameters))
        return players[-1]

    yield _play
    for player in players:
        player.process.send_signal(signal.SIGINT)
    for player in players:
        player.close()


@pytest.fixture(scope='module')
def put(tmp_path_factory: pytest.TempPathFactory) -> Put:
    """Writes a file below a folder of its own."""

    def _put(name: str, text: str) -> Path:
        path = tmp_path_factory.mktemp('labels') / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding='utf-8')
        return path

    return _put


def folder_of_labels(put: Put) -> Path:
    folder = put('labelTxt/d.txt', '').parent
    for name in ('b', 'c', 'a'):
        (folder / f'{name}.txt').write_text(DOTA)
    return folder


def yolo_labels(put: Put) -> Path:
    path = put('labels/P1.txt', YOLO)
    path.with_name('classes.txt').write_text('ship\ntug\n')
    return path


MALFORMED = DOTA + '10 20 50 20 50 thirty 10 30 ship 0\n1 2 3\n' + DOTA
# A category that is a number.
AMBIGUOUS = '10 20 50 20 50 30 10 30 7\n'


@pytest.fixture(scope='module')
def played(play: Play, put: Put) -> dict[str, Player]:
    """All that is played once and then ends, at the same time."""
    size = {'image_width': 400, 'image_height': 500}
    players = {
        'dota': play(path=put('P1.txt', DOTA)),
        'yolo': play(path=yolo_labels(put), frame_id='nadir', **size),
        'csv': play(path=put('ships.csv', CSV)),
        'named format': play(path=put('P1.txt', AMBIGUOUS), format='dota'),
        'folder': play(path=folder_of_labels(put)),
        'malformed': play(path=put('P1.txt', MALFORMED)),
        'harbour': play(),
        'typo': play(frame='left'),
    }
    for player in players.values():
        assert player.finish() == 0
        assert 'Traceback' not in player.log
    return players


def hypotheses(message: Detection2DArray) -> list[tuple[str, str, float]]:
    """Read id, class and score of each detection."""
    pairs = [(each.id, each.results) for each in message.detections]
    return [(name, r.hypothesis.class_id, r.hypothesis.score) for name, (r,) in pairs]


# What is played -------------------------------------------------------------------------------


def test_dota_labels_are_played(played: dict[str, Player]) -> None:
    (message,) = played['dota'].messages
    np.testing.assert_allclose(rows_of(message)[:, :4], np.array(ROWS)[:, :4], rtol=1e-12)
    assert hypotheses(message) == [('P1/0', 'ship', 1.0), ('P1/1', 'tug', 1.0)]
    assert message.header.frame_id == 'camera'
    assert {each.header.frame_id for each in message.detections} == {'camera'}
    assert played['dota'].infos == []


def test_yolo_labels_are_played_with_the_size_of_the_image(played: dict[str, Player]) -> None:
    (message,) = played['yolo'].messages
    np.testing.assert_allclose(rows_of(message)[:, :4], np.array(ROWS)[:, :4], rtol=1e-12)
    assert hypotheses(message) == [('P1/0', 'ship', 1.0), ('P1/1', 'tug', 0.75)]
    (info,) = played['yolo'].infos
    assert (info.width, info.height) == (400, 500)
    assert info.header == message.header
    assert info.header.frame_id == 'nadir'


def test_a_table_is_played_as_one_message_per_image(played: dict[str, Player]) -> None:
    one, other = played['csv'].messages
    np.testing.assert_allclose(rows_of(one)[:, :4], np.array(ROWS)[:, :4], rtol=1e-12)
    assert hypotheses(one) == [('P1/a', 'ship', 1.0), ('P1/b', 'tug', 0.75)]
    assert hypotheses(other) == [('P2/c', 'ferry', 0.25)]
    stamps = [(each.header.stamp.sec, each.header.stamp.nanosec) for each in (one, other)]
    assert stamps[0] < stamps[1]


def test_a_format_can_be_named(played: dict[str, Player]) -> None:
    assert hypotheses(played['named format'].messages[0]) == [('P1/0', '7', 1.0)]


def test_a_folder_is_played_in_the_order_of_its_names(played: dict[str, Player]) -> None:
    messages = played['folder'].messages
    names = [[each.id[0] for each in message.detections] for message in messages]
    assert names == [['a', 'a'], ['b', 'b'], ['c', 'c'], []]
    assert 'played 4 images, skipped 0' in played['folder'].log


def test_without_a_path_the_harbour_is_played(played: dict[str, Player]) -> None:
    (message,) = played['harbour'].messages
    assert len(message.detections) > 10
    (info,) = played['harbour'].infos
    assert (info.width, info.height) == HARBOUR_SIZE
    assert '1 of 1 images have no file' in played['harbour'].log


def test_without_image_files_nobody_publishes_on_image(play: Play, put: Put) -> None:
    player = play(path=put('ships.csv', CSV), loop=True)
    player.peer.spin_until(lambda: len(player.messages) > 1, 'the labels')
    assert player.peer.node.count_publishers('camera_info') == 1
    assert player.peer.node.count_publishers('image') == 0
    player.process.send_signal(signal.SIGINT)


def test_a_parameter_that_does_not_exist_is_reported(played: dict[str, Player]) -> None:
    assert 'unknown parameters, ignored: frame' in played['typo'].log


def test_a_malformed_line_is_reported_by_file_and_line_and_the_rest_is_played(
    played: dict[str, Player],
) -> None:
    (message,) = played['malformed'].messages
    assert len(message.detections) == 4
    log = played['malformed'].log
    assert "P1.txt:5: 'thirty' is not a number" in log
    assert 'P1.txt:6: 3 fields' in log
    assert 'skipped 2 malformed records' in log


def test_a_loop_goes_on_until_a_signal(play: Play, put: Put) -> None:
    player = play(path=put('ships.csv', CSV), loop=True, rate=200.0)
    player.peer.spin_until(lambda: len(player.messages) >= 12, 'six rounds')
    counts = [len(message.detections) for message in player.messages[:12]]
    assert counts == [2, 1] * 6
    player.process.send_signal(signal.SIGINT)
    assert player.process.wait(10.0) == 0
    assert 'Traceback' not in player.log


def test_it_waits_for_a_subscriber(play: Play, put: Put) -> None:
    player = play(path=put('ships.csv', CSV), wait_for_subscribers=2)
    player.peer.spin_until(lambda: 'waiting for 2' in player.log, 'the player to wait')
    late = player.peer.collect(Detection2DArray, 'detections')
    player.peer.spin_until(lambda: len(late) == len(player.messages) == 2, 'both images, twice')


@pytest.mark.parametrize('images', [True, False])
def test_images_beside_the_labels_are_published_with_their_stamp(
    play: Play, put: Put, images: bool
) -> None:
    labels = put('labels.csv', CSV)
    pixels = np.random.default_rng(5).integers(0, 256, (30, 40, 3)).astype(np.uint8)
    Picture.fromarray(pixels).save(labels.parent / 'P2.png')
    player = play(path=labels, images=images)
    assert player.finish() == 0
    assert len(player.messages) == 2
    assert len(player.images) == len(player.infos) == int(images)
    assert '1 of 2 images have no file' in player.log
    for image in player.images:
        assert image.header == player.messages[1].header == player.infos[0].header
        assert (image.encoding, image.width, image.height) == ('rgb8', 40, 30)
        assert image.data.tobytes() == pixels.tobytes()


# A pass over images ---------------------------------------------------------------------------


def test_a_pass_is_over_the_image_file_whatever_size_is_claimed(play: Play, put: Put) -> None:
    labels = put('P1.txt', DOTA)
    pixels = np.random.default_rng(6).integers(0, 256, (100, 40)).astype(np.uint8)
    Picture.fromarray(pixels).save(labels.parent / 'P1.png')
    claimed = {'image_width': 40, 'image_height': 500}
    player = play(path=labels, pass_height=30, pass_step=20, **claimed)
    assert player.finish() == 0
    assert 'P1.png has 40 x 100 pixels, its labels say 40 x 500 pixels' in player.log
    assert "image 'P1': 1 labels are outside it" in player.log
    assert 'played 5 images, skipped 0 malformed records and 1 labels outside' in player.log
    assert [(each.width, each.height) for each in player.infos] == [(40, 30)] * 5
    for top, image in zip((0, 20, 40, 60, 70), player.images, strict=True):
        assert image.data.tobytes() == pixels[top : top + 30].tobytes()
    # The ship is at row 25.
    assert [len(message.detections) for message in player.messages] == [1, 1, 0, 0, 0]
    assert 'Traceback' not in player.log


def test_an_image_that_shrinks_during_a_pass_is_reported(play: Play, put: Put) -> None:
    labels = put('P1.txt', DOTA)
    file = labels.parent / 'P1.png'
    Picture.new('L', (40, 100)).save(file)
    player = play(path=labels, pass_height=30, pass_step=30, wait_for_subscribers=2)
    player.peer.spin_until(lambda: 'waiting for 2' in player.log, 'the player to wait')
    Picture.new('L', (40, 50)).save(file)
    player.peer.collect(Detection2DArray, 'detections')
    assert player.finish() == 0
    assert f'no image: {file}: its size is not the one' in player.log
    assert len(player.infos) == len(player.images) + 3 == 4
    assert {image.height for image in player.images} == {30}


# What cannot be played ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('parameters', 'texts'),
    [
        ({'path': '/nowhere/ships.csv'}, ('/nowhere/ships.csv', 'no such')),
        ({'path': str(REAL_SHIPS), 'format': 'runes'}, ('format', 'runes', 'dota')),
        ({'path': str(REAL_SHIPS), 'rate': 0.0}, ('rate', '0.0')),
        ({'path': str(REAL_SHIPS), 'output_type': 'Image'}, ('output_type', 'Image')),
        ({'path': str(REAL_SHIPS), 'image_width': 5}, ('image_width', 'image_height')),
        ({'pass_height': 300, 'pass_step': 301}, ('pass_step', 'pass_height')),
        ({'path': str(REAL_SHIPS), 'pass_height': 300}, ('real_ships.csv', 'size')),
        ({'path': str(REAL_SHIPS.parent / 'README.md')}, ('README.md', 'format')),
    ],
)
def test_unplayable_labels_end_the_start_with_one_line(
    site: Site, parameters: dict[str, Any], texts: tuple[str, ...]
) -> None:
    with site.start('play_detections', parameters=parameters) as process:
        assert process.wait() == 1
    line = process.log.splitlines()[-1]
    assert line.startswith('cannot start: ')
    assert all(text in line for text in texts)
    assert 'Traceback' not in process.log


def test_an_empty_folder_ends_the_start(site: Site, tmp_path: Path) -> None:
    folder = tmp_path / 'labels'
    folder.mkdir()
    with site.start('play_detections', parameters={'path': folder}) as process:
        assert process.wait() == 1
    assert f'cannot start: {folder}: no label file' in process.log


# Through the node -----------------------------------------------------------------------------


def real_ships() -> list[ImageLabels]:
    return list(read_labels(REAL_SHIPS))


def boxes_sent(labels: ImageLabels, output_type: str) -> list[OrientedBoxes]:
    """Give what the node has to find in each message made of an image's labels."""
    if output_type in ('Detection2DArray', 'DetectionArray'):
        boxes = OrientedBoxes.from_corners(labels.corners)
        rows = boxes.xywhr
        return [OrientedBoxes.from_xywhr(rows)]
    if output_type == 'Polygon2DCollection':
        return [OrientedBoxes.from_polygons(labels.corners)]
    single = labels.corners.astype(np.float32).astype(np.float64)
    return [OrientedBoxes.from_polygons([corners]) for corners in single]


@pytest.fixture(scope='module')
def play_to(site: Site) -> Iterator[Callable[..., None]]:
    """Plays to a node; players end with the module, all at once."""
    with ExitStack() as stack:
        players: list[NodeProcess] = []

        def _play_to(node: Converter, **parameters: Any) -> None:
            given = {'rate': 50.0, **parameters}
            player = site.start('play_detections', namespace=node.namespace, parameters=given)
            players.append(stack.enter_context(player))

        yield _play_to
        for player in players:
            assert player.wait() == 0


@pytest.mark.parametrize('output_type', INPUT_TYPES)
def test_real_ships_come_back_as_the_boxes_of_convert(
    start: Callable[..., Converter], play_to: Callable[..., None], output_type: str
) -> None:
    # One that loses nothing however busy the machine is.
    namespace = f'/player_{os.getpid()}_{output_type.lower()}'
    qos = f'qos_overrides.{namespace}/{INPUT_TYPES[output_type].topic}.subscription'
    reliable = {f'{qos}.reliability': 'reliable', f'{qos}.depth': 100}
    node = start(parameters={'input_type': output_type, **reliable}, namespace=namespace)
    node.connect()
    play_to(node, path=REAL_SHIPS, output_type=output_type)
    images = real_ships()
    expected = [boxes for labels in images for boxes in boxes_sent(labels, output_type)]
    node.wait(lambda: len(node.boxes) == len(expected), 'all boxes')
    for boxes, answer in zip(expected, node.boxes, strict=True):
        np.testing.assert_array_equal(rows_of(answer), axis_aligned(boxes))
    xyxy = np.vstack([convert(OrientedBoxes.from_corners(each.corners)) for each in images])
    # Corners were rounded, and one type rounds again: not all are rectangles to the last bit.
    np.testing.assert_allclose(xyxy_of(node.boxes), xyxy, atol=0.5)


def xyxy_of(messages: list[Detection2DArray]) -> FloatArray:
    rows = np.vstack([rows_of(message) for message in messages])
    return np.hstack((rows[:, :2] - rows[:, 2:4] / 2.0, rows[:, :2] + rows[:, 2:4] / 2.0))


def test_the_first_image_already_has_crop_regions(
    start: Callable[..., Converter], play_to: Callable[..., None]
) -> None:
    node = start()
    crops = node.peer.collect(Detection2DArray, 'crop_regions')
    node.set({'image_width': 10, 'image_height': 10})
    node.connect(crops)
    node.set({'image_width': 0, 'image_height': 0})
    play_to(node)
    node.wait(lambda: crops, 'the crop regions')
    assert len(crops[0].detections) > 10
