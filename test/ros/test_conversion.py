# SPDX-License-Identifier: Apache-2.0
"""Detections in, axis-aligned detections out, over DDS."""

from __future__ import annotations

import copy
import struct
from collections.abc import Callable
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from harness import Converter
from rclpy.serialization import serialize_message
from ships import axis_aligned
from ships import detection
from ships import detections
from ships import fleet
from ships import rows_of
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray
from vision_msgs.msg import ObjectHypothesisWithPose

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert
from obbhbb_ros.geometry.converter import Caps
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.methods import ONBOARD_METHODS


def hypothesis(class_id: str, score: float) -> ObjectHypothesisWithPose:
    result = ObjectHypothesisWithPose()
    result.hypothesis.class_id, result.hypothesis.score = class_id, score
    result.pose.pose.position.x, result.pose.pose.orientation.w = -1.5, 0.25
    result.pose.covariance = [score * k / 7.0 for k in range(36)]
    return result


def rich_message() -> Detection2DArray:
    """Detections with everything that a detector may put into them."""
    message = detections(fleet(5), class_id=None)
    for i, item in enumerate(message.detections):
        item.id = f'schiff-{i}-ß'
        item.header = Header(frame_id=f'tile_{i}')
        item.header.stamp.sec, item.header.stamp.nanosec = -i, 999_999_999 - i
        item.results = [hypothesis(f'class{k}', 0.1 * k) for k in range(i)]
    return message


def test_everything_but_the_boxes_comes_back_as_it_was(node: Converter) -> None:
    message = rich_message()
    answer = node.convert(message)
    for sent, got in zip(message.detections, answer.detections, strict=True):
        got.bbox = copy.deepcopy(sent.bbox)
    assert answer == message


@pytest.mark.parametrize('count', [1, 2, 50])
def test_boxes_are_those_of_convert_to_the_last_bit(node: Converter, count: int) -> None:
    rows = fleet(count)
    answer = rows_of(node.convert(detections(rows)))
    np.testing.assert_array_equal(answer, axis_aligned(rows))
    xyxy = convert(OrientedBoxes.from_xywhr(rows))
    np.testing.assert_array_equal(answer[:, :2] - answer[:, 2:4] / 2, xyxy[:, :2])
    np.testing.assert_array_equal(answer[:, :2] + answer[:, 2:4] / 2, xyxy[:, 2:])


def test_centres_are_passed_on_and_theta_is_zero(node: Converter) -> None:
    rows = fleet(20)
    answer = rows_of(node.convert(detections(rows)))
    assert answer[:, :2].tobytes() == rows[:, :2].tobytes()
    assert answer[:, 4].tobytes() == np.zeros(20).tobytes()


def test_a_ship_along_x_keeps_its_size_and_one_across_swaps_it(node: Converter) -> None:
    rows = [(50.0, 40.0, 60.0, 20.0, 0.0), (50.0, 40.0, 60.0, 20.0, np.pi / 2)]
    along, across = rows_of(node.convert(detections(rows)))
    np.testing.assert_array_equal(along, [50.0, 40.0, 60.0, 20.0, 0.0])
    np.testing.assert_allclose(across, [50.0, 40.0, 20.0, 60.0, 0.0], atol=1e-12)


def test_an_empty_message_is_answered_with_an_empty_one(node: Converter) -> None:
    message = Detection2DArray(header=Header(frame_id='camera'))
    assert node.convert(message) == message


@pytest.mark.parametrize('method', ONBOARD_METHODS)
def test_every_method_is_at_hand_while_the_node_runs(node: Converter, method: str) -> None:
    node.set({'method': method, 'q': 2.2, 'f': 0.9, 's': 1.1})
    answer = rows_of(node.convert(detections(fleet(20))))
    rule = HullRule(method, q=2.2, f=0.9, s=1.1)
    np.testing.assert_array_equal(answer, axis_aligned(fleet(20), rule))


def test_angles_may_be_degrees(node: Converter) -> None:
    node.set({'angle_unit': 'deg'})
    rows = fleet(20)
    degrees = rows * [1, 1, 1, 1, 180 / np.pi]
    answer = rows_of(node.convert(detections(degrees)))
    np.testing.assert_allclose(answer, axis_aligned(rows), rtol=1e-12)


@pytest.mark.parametrize(
    ('parameters', 'caps'),
    [
        ({'max_length': 60.0}, Caps(60.0, None)),
        ({'max_width': 25.0}, Caps(None, 25.0)),
        ({'max_length': 60.0, 'max_width': 25.0}, Caps(60.0, 25.0)),
        (
            {'max_length': 60.0, 'max_width': 25.0, 'ground_sample_distance': 0.5},
            Caps(120.0, 50.0),
        ),
    ],
    ids=['length', 'width', 'both', 'metres'],
)
def test_caps_bound_the_boxes(node: Converter, parameters: dict[str, float], caps: Caps) -> None:
    node.set(parameters)
    answer = rows_of(node.convert(detections(fleet(20))))
    np.testing.assert_array_equal(answer, axis_aligned(fleet(20), caps=caps))
    assert (answer != axis_aligned(fleet(20))).any()


def message_without_gaps() -> Detection2DArray:
    """
    Detections whose strings leave no gap before the next number in CDR.

    The standard does not say what is in a gap, and the middleware leaves what its memory held.
    """
    message = detections(fleet(4), class_id='tug', name='hull-07')
    for headed in (message, *message.detections):
        headed.header.frame_id = 'cam'
    return message


def test_the_same_bytes_give_the_same_bytes(node: Converter) -> None:
    answers = node.peer.collect(Detection2DArray, 'boxes', raw=True)
    node.connect()
    # The node may know of the second subscriber a little later.
    node.send_until(lambda: node.send(detections([])), lambda: answers, 'bytes')
    recording = []
    for _ in range(5):
        message = message_without_gaps()
        node.stamped(message)
        recording.append(serialize_message(message))
    replays = []
    for _ in range(3):
        replays.append([answer_to_bytes(node, data, answers) for data in recording])
        node.convert(detections(fleet(30, seed=2), class_id='something else'))
    assert replays[0] == replays[1] == replays[2]
    assert [len(answer) for answer in replays[0]] == [len(data) for data in recording]


def answer_to_bytes(node: Converter, data: bytes, answers: list[bytes]) -> bytes:
    """Send serialized detections and give the bytes that come back."""
    # The stamp tells which answer it is.
    stamp = slice(4, 12)
    answers.clear()
    node.publisher.publish(data)
    return node.wait_for(
        lambda: (answer for answer in answers if answer[stamp] == data[stamp]), 'its bytes'
    )


@pytest.mark.parametrize('count', [1, 2, 3])
def test_bytes_of_padding_behind_a_message_do_no_harm(node: Converter, count: int) -> None:
    message = message_without_gaps()
    stamp = node.stamped(message)
    node.publisher.publish(serialize_message(message) + bytes(count))
    answer = node.answer_to(stamp)
    np.testing.assert_array_equal(rows_of(answer), axis_aligned(fleet(4)))


def test_a_message_of_another_byte_order_is_converted_all_the_same(node: Converter) -> None:
    message = rich_message()
    stamp = node.stamped(message)
    node.publisher.publish(big_endian(message))
    answer = node.answer_to(stamp)
    np.testing.assert_array_equal(rows_of(answer), axis_aligned(fleet(5)))
    for sent, got in zip(message.detections, answer.detections, strict=True):
        got.bbox = copy.deepcopy(sent.bbox)
    assert answer == message


def big_endian(message: Detection2DArray) -> bytes:
    """Serialize a message as a machine with the other byte order does."""
    data = bytearray()
    for kind, value in parts(message):
        data += bytes(-len(data) % struct.calcsize(kind[-1]))
        data += struct.pack('>' + kind, value)
    return bytes(4) + bytes(data)


def parts(value: Any) -> Iterator[tuple[str, Any]]:
    """Take a message apart into what CDR is made of."""
    if isinstance(value, str):
        text = value.encode() + bytes(1)
        yield 'I', len(text)
        yield f'{len(text)}s', text
    elif isinstance(value, (list, np.ndarray)):
        if isinstance(value, list):
            yield 'I', len(value)
        for item in value:
            yield from parts(item)
    elif isinstance(value, (int, float)):
        yield 'd' if isinstance(value, float) else 'i', value
    else:
        for name in value.get_fields_and_field_types():
            yield from parts(getattr(value, name))


def test_a_late_subscriber_gets_the_messages_from_then_on(start: Callable[..., Converter]) -> None:
    node = start(listen=False)
    before = node.send(detections(fleet(1)))
    node.boxes = node.peer.collect(Detection2DArray, 'boxes')
    node.connect()
    node.send(detections(fleet(1)))
    answer = node.convert(detections(fleet(2)))
    np.testing.assert_array_equal(rows_of(answer), axis_aligned(fleet(2)))
    assert before not in [message.header.stamp.sec for message in node.boxes]


def test_nothing_is_converted_that_nobody_listens_to(start: Callable[..., Converter]) -> None:
    node = start(listen=False)
    counts = node.counts()
    while counts['messages_without_subscriber'] < 3:
        # The first ones may be lost: the node may not know of the peer yet.
        for _ in range(3):
            node.send(detections(fleet(1)))
        counts = node.counts()
    assert counts['messages_received'] == counts['messages_without_subscriber']
    assert counts['messages_converted'] == 0
    assert counts['detections_received'] == 0


def test_a_detection_without_hypothesis_is_converted(node: Converter) -> None:
    message = Detection2DArray(detections=[detection(fleet(1)[0], class_id=None)])
    answer = node.convert(message)
    np.testing.assert_array_equal(rows_of(answer), axis_aligned(fleet(1)))
    assert answer.detections[0].results == []
