# SPDX-License-Identifier: Apache-2.0
"""Detections in the coordinates of a network come back on the ships of the image."""

import numpy as np
import pytest
from cdr import Detection
from cdr import Message
from cdr import Writer
from cdr import encode
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert
from obbhbb_ros.geometry.converter import half_extents
from obbhbb_ros.geometry.input_frame import InputFrame
from obbhbb_ros.pipeline.batch import Batch
from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.layouts import INPUT_TYPES

SIZE = st.integers(32, 4096)
SHIPS = np.array(
    [
        [300.0, 200.0, 120.0, 30.0, 0.7],
        [40.0, 500.0, 60.0, 12.0, -1.2],
        [9.0, 9.0, 8.0, 3.0, 3.0],
    ]
)


def to_network(points, image, network, fit):
    """Fit points of an image to the input of a network."""
    image, network = np.array(image, float), np.array(network, float)
    if fit == 'stretch':
        return points * network / image
    scale = min(network / image)
    return points * scale + (network - image * scale) / 2.0


@pytest.mark.parametrize('fit', ['stretch', 'letterbox'])
@given(image=st.tuples(SIZE, SIZE), network=st.tuples(SIZE, SIZE))
def test_points_come_back(fit, image, network) -> None:
    points = np.random.default_rng(1).uniform(0, 4096, (5, 4, 2))
    there = to_network(points, image, network, fit)
    back = InputFrame(network, fit).to_image(there, image)
    np.testing.assert_allclose(back, points, atol=1e-6)


@pytest.mark.parametrize('fit', ['stretch', 'letterbox'])
@pytest.mark.parametrize('image', [(1280, 720), (640, 640), (512, 2048)])
def test_boxes_of_a_network_are_those_of_the_image(fit, image) -> None:
    # Only boxes along the axes are boxes still when the image is stretched unequally.
    turned = SHIPS if fit == 'letterbox' else SHIPS * (1, 1, 1, 1, 0) + (0, 0, 0, 0, np.pi / 2)
    ships = OrientedBoxes.from_xywhr(turned)
    detected = OrientedBoxes.from_corners(to_network(ships.corners, image, (640, 640), fit))
    rows = detected.xywhr
    detections = tuple(
        Detection(bbox=(x, y, theta, length, width), id=str(i))
        for i, (x, y, length, width, theta) in enumerate(rows)
    )
    values = {'input_width': 640, 'input_height': 640, 'input_fit': fit}
    data = encode(Message(detections=detections))
    settings = OBB_TO_HBB.settings(values)
    batch = Batch(data, INPUT_TYPES['Detection2DArray'], settings, image)
    received = Detections(batch.boxes_message()).xywhr()
    expected = np.hstack((ships.center, 2.0 * half_extents(ships, settings.rules)))
    np.testing.assert_allclose(received[:, :4], expected, atol=1e-6)


@pytest.mark.parametrize('fit', ['stretch', 'letterbox'])
@pytest.mark.parametrize('order', [[0, 1, 2, 3], [0, 1, 3, 2]], ids=['in order', 'crossed'])
def test_polygons_of_a_network_are_those_of_the_image(fit, order) -> None:
    ships = OrientedBoxes.from_xywhr(SHIPS)
    image, network = (512, 2048), (640, 640)
    writer = Writer('<', 0)
    writer.header((1, 2), 'camera')
    writer.number('I', len(SHIPS))
    for corners in to_network(ships.corners, image, network, fit):
        writer.number('I', 4)
        for value in corners[order].ravel():
            writer.number('d', value)
    writer.number('I', 0)
    values = {'input_width': 640, 'input_height': 640, 'input_fit': fit}
    settings = OBB_TO_HBB.settings(values)
    data = bytes([0, 1, 0, 0]) + bytes(writer.data)
    batch = Batch(data, INPUT_TYPES['Polygon2DCollection'], settings, image)
    reordered = {'polygons_reordered': 3} if order[2] == 3 else {}
    received = {'messages_converted': 1, 'detections_received': 3}
    assert batch.counts == received | reordered
    received = Detections(batch.boxes_message()).xywhr()
    expected = np.hstack((ships.center, 2.0 * half_extents(ships, settings.rules)))
    np.testing.assert_allclose(received[:, :4], expected, atol=1e-6)


@pytest.mark.parametrize('values', [{}, {'input_width': 640}, {'input_height': 640}])
def test_a_fit_without_a_size_is_refused(values) -> None:
    with pytest.raises(ValueError, match='input_fit letterbox needs input_width and input_height'):
        OBB_TO_HBB.settings({'input_fit': 'letterbox', **values})


@pytest.mark.parametrize('fit', ['stretch', 'letterbox'])
def test_the_bow_stays_where_it_is(fit) -> None:
    ships = SHIPS * (1, 1, 1, 1, 0) + (0, 0, 0, 0, np.pi)
    there = to_network(ships[:, :2], (1280, 720), (640, 640), fit)
    scale = (0.5, 640 / 720) if fit == 'stretch' else (0.5, 0.5)
    rows = np.hstack((there, ships[:, 2:4] * scale, ships[:, 4:]))
    boxes = InputFrame((640, 640), fit).boxes_to_image(rows, (1280, 720), bow=True)
    expected = convert(OrientedBoxes.from_xywhr(ships, bow=True), q_bow=1.5, q_stern=4.0)
    np.testing.assert_allclose(convert(boxes, q_bow=1.5, q_stern=4.0), expected, atol=1e-6)
    assert boxes.bow.all()


def test_defects_keep_their_reason() -> None:
    boxes = InputFrame((64, 64), 'stretch').boxes_to_image(
        np.array([[1.0, 2, 3, -4, 0], [1, 2, 0, 4, 0], [1, np.nan, 3, 4, 0], [9, 9, 4, 2, 0]]),
        (128, 128),
    )
    assert boxes.defects.tolist() == [2, 3, 1, 0]


@given(x=st.floats(-50, 690), y=st.floats(-50, 530), theta=st.floats(-4, 4))
def test_clipped_boxes_end_at_the_border(x, y, theta) -> None:
    detection = Detection(bbox=(x, y, theta, 60.0, 20.0))
    data = encode(Message(detections=(detection,)))
    kind, size = INPUT_TYPES['Detection2DArray'], (640, 480)
    plain = Batch(data, kind, OBB_TO_HBB.settings({}), size)
    clipped = Batch(data, kind, OBB_TO_HBB.settings({'clip_boxes': True}), size)
    (before,) = Detections(plain.boxes_message()).xywhr()
    low = np.maximum(before[:2] - before[2:4] / 2, 0)
    high = np.minimum(before[:2] + before[2:4] / 2, size)
    received = Detections(clipped.boxes_message()).xywhr()
    if (low < high).all():
        np.testing.assert_allclose(received[0, :4], [*(low + high) / 2, *(high - low)], atol=1e-9)
    else:
        assert len(received) == 0
        assert clipped.counts['detections_dropped.outside_image'] == 1
        assert 'outside_image' in clipped.complaint
