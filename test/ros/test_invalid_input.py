# SPDX-License-Identifier: Apache-2.0
"""Boxes that are none, polygons that enclose nothing, and bytes that are no message."""

from __future__ import annotations

import random
import struct
import time
from collections.abc import Callable
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from harness import ROSOUT
from harness import Converter
from harness import Counts
from harness import Site
from rcl_interfaces.msg import Log
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo
from ships import axis_aligned
from ships import collection
from ships import detections
from ships import fleet
from ships import polygon
from ships import rows_of
from vision_msgs.msg import Detection2DArray

from obbhbb_ros import OrientedBoxes
from obbhbb_ros.geometry.converter import HullRule

NAN, INF = float('nan'), float('inf')
GOOD = (100.0, 80.0, 60.0, 20.0, 0.5)
DEFECTS = [
    ((NAN, 80.0, 60.0, 20.0, 0.5), 'not_finite'),
    ((100.0, NAN, 60.0, 20.0, 0.5), 'not_finite'),
    ((100.0, 80.0, NAN, 20.0, 0.5), 'not_finite'),
    ((100.0, 80.0, 60.0, NAN, 0.5), 'not_finite'),
    ((100.0, 80.0, 60.0, 20.0, NAN), 'not_finite'),
    ((INF, 80.0, 60.0, 20.0, 0.5), 'not_finite'),
    ((100.0, 80.0, INF, 20.0, 0.5), 'not_finite'),
    ((100.0, 80.0, 60.0, 20.0, -INF), 'not_finite'),
    ((100.0, 80.0, -60.0, 20.0, 0.5), 'negative_size'),
    ((100.0, 80.0, 60.0, -20.0, 0.5), 'negative_size'),
    ((100.0, 80.0, 0.0, 20.0, 0.5), 'empty'),
    ((100.0, 80.0, 60.0, 0.0, 0.5), 'empty'),
    ((100.0, 80.0, 0.0, -0.0, 0.5), 'empty'),
]
REASONS = [reason for _, reason in DEFECTS]
# Good ones between the bad ones.
MIXED = [row for bad, _ in DEFECTS for row in (bad, GOOD)]
COUNTED = {reason: REASONS.count(reason) for reason in set(REASONS)}


def test_dropped_detections_leave_the_others_in_order(node: Converter) -> None:
    message = detections(MIXED)
    for i, detection in enumerate(message.detections):
        detection.id = str(i)
    answer = node.convert(message)
    assert [detection.id for detection in answer.detections] == [str(i) for i in range(1, 26, 2)]
    # Converted among the bad ones, as the node does: NumPy 1.26 rounds the cosine of a few angles
    # in another way than that of many.
    np.testing.assert_array_equal(rows_of(answer), axis_aligned(MIXED)[1::2])


def test_kept_detections_are_passed_on_unchanged(node: Converter) -> None:
    node.set({'invalid_policy': 'keep'})
    answer = node.convert(detections(MIXED))
    expected = np.array(MIXED)
    expected[1::2] = axis_aligned(MIXED)[1::2]
    np.testing.assert_array_equal(rows_of(answer), expected)
    assert len(answer.detections[0].results) == 1


@pytest.mark.parametrize(('policy', 'action'), [('drop', 'dropped'), ('keep', 'kept')])
def test_invalid_detections_are_counted_by_reason(
    node: Converter, policy: str, action: str
) -> None:
    node.set({'invalid_policy': policy})
    before = node.counts()
    node.convert(detections(MIXED))
    counts = node.counts().since(before, 'detections_')
    counts.pop('detections_received_per_second', None)
    expected = {f'detections_{action}.{reason}': count for reason, count in COUNTED.items()}
    assert counts == {'detections_received': len(MIXED), **expected}


def test_a_message_of_invalid_detections_alone_is_answered(node: Converter) -> None:
    answer = node.convert(detections([bad for bad, _ in DEFECTS]))
    assert answer.detections == []


@pytest.mark.parametrize(
    'row',
    [(0.0, 0.0, 1.7e308, 1.7e308, 0.7), (1.7e308, 0.0, 1e308, 1.0, 0.0)],
    ids=['size', 'edge'],
)
def test_a_box_that_overflows_counts_as_not_finite(node: Converter, row: Any) -> None:
    node.set({'method': 'outer'})
    before = node.counts()
    answer = node.convert(detections([row, GOOD]))
    np.testing.assert_array_equal(rows_of(answer), axis_aligned([GOOD], HullRule('outer')))
    counts = node.counts().since(before, 'detections_dropped')
    assert counts == {'detections_dropped.not_finite': 1}


def test_numbers_that_are_only_just_valid_are_converted(node: Converter) -> None:
    rows = [(-1e150, 1e150, 1e100, 1e-100, 1e9), (0.0, -0.0, 1e-150, 1e-150, -1e-300)]
    answer = rows_of(node.convert(detections(rows)))
    np.testing.assert_array_equal(answer, axis_aligned(rows))


def test_the_warning_names_topic_stamp_and_index(start: Callable[..., Converter]) -> None:
    node = start()
    log = node.peer.collect(Log, '/rosout', ROSOUT)
    node.connect()
    bad = (100.0, 80.0, -60.0, 20.0, 0.5)
    stamp = node.send(detections([GOOD, GOOD, bad, GOOD, bad]))
    texts = (
        f'{node.namespace}/detections',
        f'stamp {stamp}.{7 * stamp:09d}',
        'index 2',
        'dropped 2 of 5',
        'negative_size',
    )
    line = node.wait_for_log(*texts)
    assert '[WARN]' in line
    node.wait_for(
        lambda: (line for line in log if all(text in line.msg for text in texts)),
        'the warning on /rosout',
    )


def test_warnings_come_at_a_rate_that_can_be_read(start: Callable[..., Converter]) -> None:
    node = start()
    node.connect()
    bad = detections([(100.0, 80.0, -60.0, 20.0, 0.5)])
    started = time.monotonic()
    for _ in range(100):
        node.convert(bad)
    # It need not be the next one that tells.
    node.wait(
        lambda: any('negative_size' in report.status[0].message for report in node.reports()),
        'the warning',
    )
    # One in five seconds.
    assert 1 <= node.process.log.count('negative_size') <= 2 + (time.monotonic() - started) / 5.0


def test_one_kind_of_warning_does_not_silence_another(start: Callable[..., Converter]) -> None:
    node = start()
    node.connect()
    node.publisher.publish(b'\x00\x01\x00\x00 no message at all')
    node.wait_for_log('cannot be read')
    node.convert(detections([(100.0, 80.0, -60.0, 20.0, 0.5)]))
    node.convert(detections([GOOD]))
    assert 'negative_size' in node.process.log


# Polygons -------------------------------------------------------------------------------------

SQUARE = [(0.0, 0.0), (8.0, 0.0), (8.0, 8.0), (0.0, 8.0)]
B = 1e308
CRASHES_GEOS = [
    (0.0, 0.0),
    (B, 1.0),
    (B, B),
    (B, 6.0),
    (1.0, 7.0),
    (0.0, 8.0),
    (1.0, B),
    (0.0, 10.0),
    (1.0, 0.0),
    (0.0, 16.0),
    (0.0, 17.0),
    (B, 21.0),
    (0.0, B),
    (1.0, 24.0),
    (1.0, 25.0),
    (0.0, 26.0),
    (1.0, 28.0),
]
POINTLESS = [
    ([], 'too_few_points'),
    ([(1.0, 2.0)], 'too_few_points'),
    ([(1.0, 2.0), (3.0, 4.0)], 'too_few_points'),
    ([(1.0, 2.0), (3.0, 4.0), (1.0, 2.0), (3.0, 4.0)], 'too_few_points'),
    ([(1.0, 1.0), (2.0, 2.0), (3.0, 3.0)], 'empty'),
    ([(1.0, 1.0), (NAN, 2.0), (3.0, 1.0)], 'not_finite'),
    ([(1.0, 1.0), (2.0, INF), (3.0, 1.0)], 'not_finite'),
    # GEOS crashes on the first and raises on the second.
    (CRASHES_GEOS, 'no_rectangle'),
    ([(1e160, 1e154), (1e155, 1e160), (1.0, 0.0), (1e154, 1.0), (1e155, 100.0)], 'no_rectangle'),
]


@pytest.fixture(scope='module')
def polygons_node(site: Site) -> Iterator[Converter]:
    with Converter(site, parameters={'input_type': 'Polygon2DCollection'}) as node:
        node.connect()
        yield node


@pytest.fixture
def polygons(polygons_node: Converter) -> Converter:
    polygons_node.reset()
    return polygons_node


def test_polygons_without_area_are_dropped_and_counted(polygons: Converter) -> None:
    before = polygons.counts()
    answer = polygons.convert(collection([SQUARE, *(bad for bad, _ in POINTLESS), SQUARE]))
    expected = axis_aligned(OrientedBoxes.from_polygons([SQUARE, SQUARE]))
    np.testing.assert_array_equal(rows_of(answer), expected)
    counts = polygons.counts().since(before, 'detections_dropped.')
    reasons = [reason for _, reason in POINTLESS]
    assert counts == {
        f'detections_dropped.{reason}': reasons.count(reason) for reason in set(reasons)
    }


def test_polygons_without_area_are_kept_as_no_numbers(polygons: Converter) -> None:
    polygons.set({'invalid_policy': 'keep'})
    answer = polygons.convert(collection([SQUARE, *(bad for bad, _ in POINTLESS)]))
    rows = rows_of(answer)
    np.testing.assert_array_equal(rows[:1], axis_aligned(OrientedBoxes.from_polygons([SQUARE])))
    assert np.isnan(rows[1:, :4]).all()
    assert len(rows) == 1 + len(POINTLESS)


def test_a_stamped_polygon_that_has_no_rectangle_is_answered(site: Site) -> None:
    with Converter(site, parameters={'input_type': 'PolygonStamped'}) as node:
        node.connect()
        answer = node.convert(polygon([(0.0, 0.0), (3e38, 1.0), (1.0, 3e38), (3e38, 3e38)]))
        assert answer.detections == []
        assert node.counts()['detections_dropped.no_rectangle'] == 1


# Bytes that are no message --------------------------------------------------------------------


def sample() -> bytes:
    """Give a valid message in its bytes."""
    message = detections(fleet(3), class_id='tug', name='hull-07')
    for headed in (message, *message.detections):
        headed.header.frame_id = 'cam'
    message.header.stamp.sec = 1_000_000
    return serialize_message(message)


def with_count(data: bytes, count: int) -> bytes:
    """Let a message claim to have so many detections."""
    place = slice(20, 24)
    assert struct.unpack('<I', data[place]) == (3,)
    return data[:20] + struct.pack('<I', count) + data[24:]


UNREADABLE = {
    'half a message': sample()[: len(sample()) // 8 * 4],
    'no detection at all where three are': sample()[:24],
    'header cut off': sample()[:12],
    'more detections than there are': with_count(sample(), 4),
    'more detections than fit into memory': with_count(sample(), 2**32 - 1),
    'a string longer than the message': sample()[:12] + struct.pack('<I', 5000) + sample()[16:],
    'ones': b'\x00\x01\x00\x00' + b'\xff' * 400,
    'text': b'\x00\x01\x00\x00' + b'this is no detection but a sentence ' * 10,
    'unknown encapsulation': b'\x7f\x7f\x00\x00' + sample()[4:],
}


@pytest.mark.parametrize('data', UNREADABLE.values(), ids=UNREADABLE)
def test_bytes_that_are_no_message_are_dropped(node: Converter, data: bytes) -> None:
    node.publisher.publish(data)
    answer = node.convert(detections([GOOD]))
    np.testing.assert_array_equal(rows_of(answer), axis_aligned([GOOD]))
    assert len(node.boxes) == 1


def test_bytes_that_are_no_message_are_counted_and_reported(node: Converter) -> None:
    before = node.counts()
    for data in UNREADABLE.values():
        node.publisher.publish(data)
    node.convert(detections([GOOD]))
    # The first report of all of them also tells of the last one.
    all_of_them = {'messages_unreadable': len(UNREADABLE)}
    report = node.wait_for(
        lambda: (
            report.status[0]
            for report in node.reports()
            if Counts(report.status[0]).since(before, 'messages_unreadable') == all_of_them
        ),
        'a report of all of them',
    )
    assert 'cannot be read as Detection2DArray' in report.message
    assert f'{node.namespace}/detections' in report.message


def test_text_that_is_not_utf8_costs_no_box(node: Converter) -> None:
    data = sample().replace(b'tug', b'\xff\xfeg').replace(b'hull', b'h\xc3ll')
    node.publisher.publish(data)
    answer = node.answer_to(1_000_000)
    np.testing.assert_array_equal(rows_of(answer), axis_aligned(fleet(3)))


def test_the_node_outlives_whatever_bytes_arrive(node: Converter) -> None:
    node.set({'image_width': 640, 'image_height': 480, 'class_ids': ['tug']})
    crops = node.peer.collect(Detection2DArray, 'crop_regions')
    chance = random.Random(7)
    for number in range(300):
        data = damaged(sample(), chance)
        node.publisher.publish(data)
        if number % 5 == 0:
            node.convert(detections([GOOD]))
            node.boxes.clear()
    answer = node.convert(detections([GOOD]))
    np.testing.assert_array_equal(rows_of(answer), axis_aligned([GOOD]))
    node.wait(lambda: crops, 'a crop region')


def damaged(data: bytes, chance: random.Random) -> bytes:
    """Change a few bytes, and cut some off."""
    damaged = bytearray(data)
    for _ in range(chance.randrange(1, 8)):
        damaged[chance.randrange(len(damaged))] = chance.choice((0, 1, 127, 128, 255))
    length = chance.choice((len(damaged), chance.randrange(4, len(damaged), 4)))
    return bytes(damaged[:length])


def test_garbage_on_camera_info_does_no_harm(node: Converter) -> None:
    publisher = node.heard_publisher(CameraInfo, 'camera_info')
    before = node.counts()
    for data in UNREADABLE.values():
        publisher.publish(data)
    # Some can be read as another message's beginning.
    node.wait(lambda: node.counts().since(before).get('messages_unreadable', 0) > 1, 'the garbage')
    answer = node.convert(detections([GOOD]))
    np.testing.assert_array_equal(rows_of(answer), axis_aligned([GOOD]))


def test_degrees_sent_as_radians_are_converted_and_reported(
    start: Callable[..., Converter],
) -> None:
    # Of its own: the log says the same again only after five seconds.
    node = start()
    node.connect()
    before = node.counts()
    rows = [GOOD, (*GOOD[:4], 87.3), (*GOOD[:4], -90.0), (*GOOD[:4], INF)]
    assert len(node.convert(detections(rows)).detections) == 3
    line = node.wait_for_log('WARN', 'beyond 6.3 rad')
    assert '2 of 4 detections at stamp' in line
    assert 'index 1 has 87.3: degrees? Then set angle_unit: deg' in line
    changed = node.counts().since(before)
    assert changed['angles_doubtful.beyond_turn'] == 2
    node.set({'angle_unit': 'deg'})
    before = node.counts()
    node.convert(detections(rows))
    assert not node.counts().since(before, 'angles_doubtful')


def test_scores_that_are_no_fractions_are_reported_where_they_rank(
    start: Callable[..., Converter],
) -> None:
    node = start(parameters={'image_width': 1000, 'image_height': 1000})
    node.connect()
    regions: list[Any] = node.peer.collect(Detection2DArray, 'crop_regions')
    node.connect(regions)
    before = node.counts()
    scores = [0.0, 1.0, NAN, 87.0, -2.5, INF, -INF, 1.0 + 1e-7]
    message = detections([GOOD] * len(scores))
    for detection, score in zip(message.detections, scores, strict=True):
        detection.results[0].hypothesis.score = score
    node.convert(message, regions)
    node.wait_for_log('WARN', 'a score above 1; index 3 has 87: percent?')
    node.wait_for_log('WARN', 'a negative score; index 4 has -2.5: logits?')
    assert node.counts().since(before, 'scores_doubtful') == {
        'scores_doubtful.above_one': 1,
        'scores_doubtful.negative': 1,
        'scores_doubtful.infinite': 2,
    }
