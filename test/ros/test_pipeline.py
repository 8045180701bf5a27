# SPDX-License-Identifier: Apache-2.0
"""The pipeline writes the bytes that the reference by message objects writes."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cdr import DETECTIONS as DETECTIONS_2D
from cdr import MESSAGES
from cdr import Detection
from cdr import Hypothesis
from cdr import Message
from cdr import Writer
from cdr import encode
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import serialize_message
from reference import Reference
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import RegionOfInterest
from std_msgs.msg import Header

from obbhbb_ros.labels import read_labels
from obbhbb_ros.nodes.player_messages import detections_message
from obbhbb_ros.nodes.player_messages import polygon_message
from obbhbb_ros.nodes.player_messages import polygons_message
from obbhbb_ros.nodes.player_messages import yolo_message
from obbhbb_ros.pipeline.batch import Batch
from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.camera import read_camera
from obbhbb_ros.wire.layouts import INPUT_TYPES

DATA = Path(__file__).parents[1] / 'data'
IMAGE_SIZE = 1920, 1080
TUG = {
    'class_ids': ['tug', 'ship'],
    'classes.tug.method': 'outer',
    'classes.tug.weight': 3.0,
    'classes.tug.crop_q': 7.0,
    'classes.ship.q_bow': 1.8,
    'classes.ship.min_score': 0.4,
}
DETECTIONS = INPUT_TYPES['Detection2DArray']
ORDERS = pytest.mark.parametrize('order', '<>')


def regions_of(batch):
    """Write the crop regions of a batch."""
    return batch.crop_regions_message(batch.plan_crops())


def assert_same(data, values=None, input_type=DETECTIONS):
    """Hold pipeline and reference together; crops alone, and after the boxes."""
    settings = OBB_TO_HBB.settings(values or {})
    reference = Reference(data, input_type, settings, IMAGE_SIZE)
    regions = reference.crop_regions_message()
    assert regions_of(Batch(data, input_type, settings, IMAGE_SIZE)) == regions
    batch = Batch(data, input_type, settings, IMAGE_SIZE)
    assert batch.boxes_message() == reference.boxes_message()
    assert regions_of(batch) == regions


VALUES = st.fixed_dictionaries(
    {},
    optional={
        'q': st.floats(1, 10),
        'f': st.floats(0.1, 2.0),
        'angle_unit': st.just('deg'),
        'invalid_policy': st.just('keep'),
        'max_length': st.floats(1, 50),
        'crop.padding': st.floats(0, 1),
        'crop.q': st.sampled_from([0.0, 1.0, 4.0]),
        'crop.min_score': st.floats(0, 1),
        'heading': st.just('theta'),
        'q_bow': st.sampled_from([1.0, 2.2]),
        'q_stern': st.just(4.2),
        'crop.max_count': st.integers(0, 5),
        'crop.min_size': st.integers(0, 99),
        'crop.merge_max_size': st.just(10**6),
    },
)


@ORDERS
@given(
    message=MESSAGES,
    padding=st.sampled_from([0, 0xA5]),
    trailing=st.integers(0, 6),
    values=VALUES,
    tug=st.booleans(),
)
def test_generated_messages(order, message, padding, trailing, values, tug) -> None:
    data = encode(message, order, padding) + bytes(trailing)
    assert_same(data, values | TUG if tug else values)


@ORDERS
@pytest.mark.parametrize('count', [0, 1, 17, 500, 2000])
@pytest.mark.parametrize('hypotheses', [0, 1, 2])
@pytest.mark.parametrize('merge_max_size', [0, 300])
def test_long_messages(order, count, hypotheses, merge_max_size) -> None:
    detection = Detection(results=(Hypothesis(), Hypothesis('tug', 0.9))[:hypotheses])
    detections = tuple(
        replace(detection, bbox=(i % 1900, i % 1000, 0.1 * i, 60.0, i % 40), id=str(i))
        for i in range(count)
    )
    data = encode(Message(detections=detections), order)
    assert_same(data, TUG | {'crop.merge_max_size': merge_max_size})


@pytest.mark.parametrize('name', ['real_ships.csv', '../../obbhbb_ros/data/harbour.csv'])
@pytest.mark.parametrize('values', [{}, {'crop.padding': 0.5, 'crop.merge_max_size': 500}])
def test_annotations_as_any_input_type(name, values) -> None:
    header = Header(frame_id='camera')
    for labels in read_labels(DATA / name):
        for input_type, messages in (
            ('Detection2DArray', [detections_message(labels, header)]),
            ('DetectionArray', [yolo_message(labels, header)]),
            ('Polygon2DCollection', [polygons_message(labels, header)]),
            ('PolygonStamped', [polygon_message(c, header) for c in labels.corners[:3].tolist()]),
        ):
            for message in messages:
                assert_same(serialize_message(message), values, INPUT_TYPES[input_type])


POINTS = st.lists(
    st.tuples(*[st.one_of(st.floats(-100, 2000, width=32), st.just(float('nan')))] * 2),
    max_size=9,
)


@ORDERS
@given(
    polygons=st.lists(POINTS, max_size=6),
    frame_id=st.sampled_from(['', 'camera', 'größe']),
    colors=st.integers(0, 3),
)
def test_generated_polygons(order, polygons, frame_id, colors) -> None:
    writer = Writer(order, 0xA5)
    writer.header((3, 4), frame_id)
    writer.number('I', len(polygons))
    for points in polygons:
        writer.number('I', len(points))
        for x, y in points:
            writer.number('d', x)
            writer.number('d', y)
    writer.number('I', colors)
    for _ in range(4 * colors):
        writer.number('f', 0.5)
    data = bytes([0, order == '<', 0, 0]) + bytes(writer.data)
    for policy in ('drop', 'keep'):
        assert_same(data, {'invalid_policy': policy}, INPUT_TYPES['Polygon2DCollection'])


KEYPOINTS = st.integers(0, 5)
YOLO = st.lists(
    st.tuples(
        DETECTIONS_2D,
        st.integers(-(2**31), 2**31 - 1),
        st.integers(0, 7),
        KEYPOINTS,
        KEYPOINTS,
        st.sampled_from(['', 'map']),
    ),
    max_size=6,
)


@ORDERS
@given(
    rows=YOLO,
    repeat=st.sampled_from([1, 1, 20]),
    padding=st.sampled_from([0, 0xA5]),
    frame_id=st.sampled_from(['', 'camera', 'größe']),
    values=VALUES,
    tug=st.booleans(),
)
def test_generated_yolo_detections(order, rows, repeat, padding, frame_id, values, tug) -> None:
    writer = Writer(order, padding)
    writer.header((3, 4), frame_id)
    writer.number('I', len(rows) * repeat)
    for row in rows * repeat:
        write_yolo(writer, *row)
    data = bytes([0, order == '<', 0, 0]) + bytes(writer.data)
    assert_same(data, values | TUG if tug else values, INPUT_TYPES['DetectionArray'])


def write_yolo(writer, detection, class_id, mask, keypoints, keypoints3d, frame_id) -> None:
    """Write a `yolo_msgs/Detection` field by field."""
    (hypothesis,) = detection.results[:1] or (Hypothesis(),)
    writer.number('i', class_id)
    writer.text(hypothesis.class_id)
    writer.number('d', hypothesis.score)
    writer.text(detection.id)
    for value in (*detection.bbox, *range(10)):
        writer.number('d', value)
    writer.text(frame_id)
    for value in (480, 640, mask):
        writer.number('I', value)
    for value in range(2 * mask):
        writer.number('d', value)
    for count, size in ((keypoints, 2), (keypoints3d, 3)):
        writer.number('I', count)
        for number in range(count):
            writer.number('i', number)
            for value in range(size + 1):
                writer.number('d', value)
    writer.text(frame_id)


@ORDERS
@given(points=POINTS, frame_id=st.sampled_from(['', 'camera', 'größe']))
def test_generated_single_polygons(order, points, frame_id) -> None:
    writer = Writer(order, 0xA5)
    writer.header((3, 4), frame_id)
    writer.number('I', len(points))
    for x, y in points:
        for value in (x, y, 0.0):
            writer.number('f', value)
    data = bytes([0, order == '<', 0, 0]) + bytes(writer.data)
    assert_same(data, input_type=INPUT_TYPES['PolygonStamped'])


@pytest.mark.parametrize('policy', ['keep', 'drop'])
@pytest.mark.parametrize('bad', [np.nan, np.inf, -np.inf, -1.0, 0.0, 1e308], ids=str)
@pytest.mark.parametrize('place', [0, 3, 4])
def test_detections_that_cannot_be_converted(policy, bad, place) -> None:
    good = (100.0, 200.0, 0.3, 40.0, 8.0)
    spoilt = tuple(bad if i == place else value for i, value in enumerate(good))
    boxes = [good, spoilt, good, spoilt, spoilt, good]
    detections = tuple(Detection(bbox=box, id='x' * i) for i, box in enumerate(boxes))
    assert_same(encode(Message(detections=detections)), {'invalid_policy': policy})


@pytest.mark.parametrize('name', INPUT_TYPES)
@pytest.mark.parametrize(
    ('data', 'reason'),
    [
        (b'\0\3\0\0' + bytes(40), 'encapsulation 00030000 is not plain CDR'),
        (b'\0\1\0\0' + struct.pack('<iII', 1, 2, 0) + bytes(40), 'frame_id at byte 12 has no'),
        (encode(Message()) + bytes(12), r'\d+ bytes behind'),
        (encode(Message())[:-5], 'behind the end|before the number'),
    ],
)
def test_what_is_not_plain_cdr_is_refused_with_the_reason(name, data, reason) -> None:
    with pytest.raises(WireError, match=reason):
        Batch(data, INPUT_TYPES[name], OBB_TO_HBB.settings({}))


@given(
    size=st.tuples(*[st.integers(0, 9000)] * 2),
    roi=st.tuples(*[st.integers(0, 900)] * 2),
    binning=st.tuples(*[st.integers(0, 4)] * 2),
    model=st.sampled_from(['', 'plumb_bob']),
    d=st.lists(st.just(0.5), max_size=8),
)
def test_the_size_of_an_image_is_that_after_region_of_interest_and_binning(
    size, roi, binning, model, d
) -> None:
    info = CameraInfo(
        width=size[0],
        height=size[1],
        binning_x=binning[0],
        binning_y=binning[1],
        distortion_model=model,
        d=d,
        roi=RegionOfInterest(width=roi[0], height=roi[1]),
    )
    wanted = roi if all(roi) else size
    expected = tuple(side // max(by, 1) for side, by in zip(wanted, binning, strict=True))
    camera = read_camera(serialize_message(info))
    assert camera.image_size == expected
    assert (camera.size, camera.model, camera.d, camera.k) == (size, model, tuple(d), (0.0,) * 9)
    assert camera.binning == tuple(max(by, 1) for by in binning)
