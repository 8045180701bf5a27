# SPDX-License-Identifier: Apache-2.0
"""The byte-level path and the typed path write the same bytes of every message that both read."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cdr import MESSAGES
from cdr import Detection
from cdr import Hypothesis
from cdr import Message
from cdr import encode
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import serialize_message
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.boxes import FEW
from obbhbb_ros.converter import HullRule
from obbhbb_ros.converter import few_half_extents
from obbhbb_ros.converter import half_extents
from obbhbb_ros.converter import to_xyxy
from obbhbb_ros.downlink.crops import CropSettings
from obbhbb_ros.downlink.crops import plan_crops
from obbhbb_ros.labels import read_labels
from obbhbb_ros.nodes.frames import TypedFrame
from obbhbb_ros.nodes.frames import WireFrame
from obbhbb_ros.nodes.play_detections import detections_message
from obbhbb_ros.wire import Forms
from obbhbb_ros.wire import NotPlainCdrError

DATA = Path(__file__).parents[1] / 'data'
RULES = [HullRule(), HullRule('outer')]
FORMS = Forms()


def outputs(frame, theta_scale, keep_invalid, crop):
    """Do with a frame what the node does."""
    boxes = frame.boxes(theta_scale)
    class_ids, scores = frame.class_ids(), frame.scores()
    rule_of = np.array([class_id == 'tug' for class_id in class_ids], np.intp)
    extents = half_extents(boxes, RULES, rule_of)
    weights = np.where(rule_of == 1, 3.0, 1.0)
    plan = plan_crops(to_xyxy(boxes.center, extents), scores, (1920, 1080), crop, weights)
    written = frame.boxes_message(boxes, extents, keep_invalid)
    crops = frame.crops_message(plan)
    return frame.stamp, class_ids, scores.tolist(), crops, written


def outputs_of_few(frame, theta_scale):
    """Do with a frame what the node does with one of a handful of detections, if it is one."""
    rows = frame.few_boxes(theta_scale)
    extents = None if rows is None else few_half_extents(rows, RULES[0])
    if extents is None:
        return None
    return np.array(rows).tolist(), frame.few_boxes_message(extents)


def outputs_of_any(frame, theta_scale):
    """Do with a frame what the node does with one of any number of detections."""
    boxes = frame.boxes(theta_scale)
    return frame.boxes_message(boxes, half_extents(boxes, RULES[:1]), False)


def assert_same(data, theta_scale=1.0, keep_invalid=False, crop=None):
    """Hold the two paths together."""
    crop = crop or CropSettings()
    fast = outputs(WireFrame(data, FORMS), theta_scale, keep_invalid, crop)
    typed = outputs(TypedFrame(data, Detection2DArray), theta_scale, keep_invalid, crop)
    np.testing.assert_equal(fast, typed)
    few = outputs_of_few(WireFrame(data, FORMS), theta_scale)
    assert few == outputs_of_few(TypedFrame(data, Detection2DArray), theta_scale)
    if few is not None:
        assert few[1] == outputs_of_any(WireFrame(data, FORMS), theta_scale)


CROPS = st.builds(
    CropSettings, padding=st.floats(0, 1), max_count=st.integers(0, 5),
    min_size=st.integers(0, 99), merge_max_size=st.sampled_from([0, 10**6]),
)


@pytest.mark.parametrize('order', '<>')
@given(
    message=MESSAGES, padding=st.sampled_from([0, 0xA5]), trailing=st.integers(0, 3),
    theta_scale=st.sampled_from([1.0, np.pi / 180]), keep_invalid=st.booleans(), crop=CROPS,
)
def test_generated_messages(
    order, message, padding, trailing, theta_scale, keep_invalid, crop
) -> None:
    data = encode(message, order, padding) + bytes(trailing)
    assert_same(data, theta_scale, keep_invalid, crop)


@pytest.mark.parametrize('order', '<>')
@pytest.mark.parametrize('count', [0, 1, 17, 500, 2000])
@pytest.mark.parametrize('hypotheses', [0, 1, 2])
@pytest.mark.parametrize('merge_max_size', [0, 300])
def test_long_messages(order, count, hypotheses, merge_max_size) -> None:
    detection = Detection(results=(Hypothesis(), Hypothesis('tug', 0.9))[:hypotheses])
    detections = tuple(
        replace(detection, bbox=(i % 1900, i % 1000, 0.1 * i, 60.0, i % 40), id=str(i))
        for i in range(count)
    )
    crop = CropSettings(merge_max_size=merge_max_size)
    assert_same(encode(Message(detections=detections), order), crop=crop)


@pytest.mark.parametrize('name', ['real_ships.csv', '../../obbhbb_ros/data/harbour.csv'])
def test_annotations(name) -> None:
    for labels in read_labels(DATA / name):
        data = serialize_message(detections_message(labels, Header(frame_id='camera')))
        assert_same(data)
        assert_same(data, crop=CropSettings(padding=0.5, merge_max_size=500))


@pytest.mark.parametrize('count', [0, 1, FEW - 1, FEW])
def test_a_handful_of_detections_takes_the_shortest_way(count) -> None:
    data = encode(Message(detections=(Detection(),) * count))
    for frame in (WireFrame(data, FORMS), TypedFrame(data, Detection2DArray)):
        few = outputs_of_few(frame, 1.0)
        assert (few is not None) == (count < FEW)


@pytest.mark.parametrize('keep_invalid', [False, True])
@pytest.mark.parametrize(
    'bad', [np.nan, np.inf, -np.inf, -1.0, 0.0, 1e308], ids=str
)
@pytest.mark.parametrize('place', [0, 3, 4])
def test_detections_that_cannot_be_converted(keep_invalid, bad, place) -> None:
    good = (100.0, 200.0, 0.3, 40.0, 8.0)
    spoilt = tuple(bad if i == place else value for i, value in enumerate(good))
    boxes = [good, spoilt, good, spoilt, spoilt, good]
    detections = tuple(Detection(bbox=box, id='x' * i) for i, box in enumerate(boxes))
    assert_same(encode(Message(detections=detections)), keep_invalid=keep_invalid)


@pytest.mark.parametrize(
    'data',
    [
        b'\0\1\0\0' + encode(Message())[4:] + bytes(8),
        encode(Message(frame_id='')).replace(b'\1\0\0\0\0', b'\0\0\0\0'),
    ],
    ids=['more behind the message than padding', 'a string without its closing zero'],
)
def test_what_the_byte_level_path_declines_the_typed_path_reads(data) -> None:
    with pytest.raises(NotPlainCdrError):
        WireFrame(data, FORMS)
    assert len(TypedFrame(data, Detection2DArray).boxes(1.0)) == 0
