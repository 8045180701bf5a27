# SPDX-License-Identifier: Apache-2.0
"""Input other than `Detection2DArray`, as the node's users send it."""

from __future__ import annotations

import os
from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from harness import Converter
from harness import Site
from ships import axis_aligned
from ships import collection
from ships import fleet
from ships import polygon
from ships import rows_of
from std_msgs.msg import Header

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.nodes.player_messages import detections_message
from obbhbb_ros.nodes.player_messages import yolo_message

DATA = Path(__file__).parents[1] / 'data'
Points = Sequence[Sequence[float]]

TRIANGLE = [(10.0, 10.0), (60.0, 10.0), (10.0, 40.0)]
CIRCLE = [
    (200.0 + 90.0 * np.cos(t), 150.0 + 30.0 * np.sin(t))
    for t in np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
]
CLOSED_SQUARE = [(0.0, 0.0), (8.0, 0.0), (8.0, 8.0), (0.0, 8.0), (0.0, 0.0)]
CROSSED = [(0.0, 0.0), (40.0, 10.0), (40.0, 0.0), (0.0, 10.0)]
QUADS = OrientedBoxes.from_xywhr(fleet(6)).corners.tolist()
SHAPES = [TRIANGLE, CIRCLE, CLOSED_SQUARE, CROSSED, *QUADS]


@pytest.fixture(scope='module')
def polygons_node(site: Site) -> Iterator[Converter]:
    with Converter(site, parameters={'input_type': 'Polygon2DCollection'}) as node:
        node.connect()
        yield node


@pytest.fixture(scope='module')
def polygon_node(site: Site) -> Iterator[Converter]:
    with Converter(site, parameters={'input_type': 'PolygonStamped'}) as node:
        node.connect()
        yield node


@pytest.fixture(scope='module')
def yolo_node(site: Site) -> Iterator[Converter]:
    pytest.importorskip('yolo_msgs')
    with Converter(site, parameters={'input_type': 'DetectionArray'}) as node:
        node.connect()
        yield node


def test_real_ships_as_yolo_detections_become_their_boxes(yolo_node: Converter) -> None:
    for labels in read_labels(DATA / 'real_ships.csv'):
        message = yolo_message(labels, Header(frame_id='camera'))
        answer = yolo_node.convert(message)
        sent = message.detections
        assert [detection.id for detection in answer.detections] == [
            detection.id for detection in sent
        ]
        assert [detection.results[0].hypothesis.class_id for detection in answer.detections] == [
            detection.class_name for detection in sent
        ]
        assert [detection.results[0].hypothesis.score for detection in answer.detections] == [
            detection.score for detection in sent
        ]
        assert all(detection.header == message.header for detection in answer.detections)
        rows = [
            (box.center.position.x, box.center.position.y, box.size.x, box.size.y, box.center.theta)
            for box in (detection.bbox for detection in sent)
        ]
        np.testing.assert_array_equal(rows_of(answer), axis_aligned(rows))


@pytest.mark.parametrize('input_type', ['Detection2DArray', 'DetectionArray'])
def test_the_player_tells_the_node_where_the_bow_is(
    start: Callable[..., Converter], input_type: str
) -> None:
    if input_type == 'DetectionArray':
        pytest.importorskip('yolo_msgs')
    ends = {'q_bow': 2.2, 'q_stern': 4.2}
    node = start(parameters={'input_type': input_type, 'heading': 'theta', **ends})
    node.connect()
    write = {'Detection2DArray': detections_message, 'DetectionArray': yolo_message}[input_type]
    for labels in read_labels(DATA / 'real_ships.csv'):
        answer = rows_of(node.convert(write(labels, Header(), 'first-edge')))
        xyxy = convert(labels.boxes('first-edge'), **ends)
        expected = np.hstack(((xyxy[:, :2] + xyxy[:, 2:]) / 2.0, xyxy[:, 2:] - xyxy[:, :2]))
        # Corners were rounded: not all are rectangles to the last bit.
        np.testing.assert_allclose(answer[:, :4], expected, atol=0.01)


def test_no_box_of_unknown_bow_gets_one_on_the_way_not_even_a_square() -> None:
    sent = [[50, 50, 10, 10, 0.3], [50, 50, 40, 10, 0.3], [50, 50, 40, 10, 2.0], [9, 9, 5, 5, 1.0]]
    # From a short side on, which may be the bow end.
    corners = np.roll(OrientedBoxes.from_xywhr(sent).corners, -1, axis=1)
    bow_known = [False, False, True, True]
    ships = [
        Box(tuple(row), 'ship', bow=bow)
        for row, bow in zip(corners.reshape(-1, 8).tolist(), bow_known, strict=True)
    ]
    labels = LabelFile(Path('harbour.txt')).image('harbour', ships)
    boxes = labels.boxes('labels')
    message = detections_message(labels, Header(), 'labels')
    received = OrientedBoxes.from_xywhr(rows_of(message), bow=True)
    np.testing.assert_array_equal(received.bow, bow_known)
    np.testing.assert_array_equal(boxes.bow, bow_known)
    np.testing.assert_allclose(convert(received), convert(boxes), rtol=1e-8)


def test_an_input_type_that_is_not_installed_is_an_error_that_names_it(
    start: Callable[..., Converter], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / 'yolo_msgs.py').write_text('raise ModuleNotFoundError("no yolo_msgs")')
    paths = [str(tmp_path), *filter(None, [os.environ.get('PYTHONPATH')])]
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(paths))
    node = start(parameters={'input_type': 'DetectionArray'})
    assert node.process.wait() == 1
    assert 'DetectionArray needs the ROS package yolo_msgs' in node.process.log


def single(points: Points) -> list[list[float]]:
    """Round to what a `PolygonStamped` can hold."""
    return np.asarray(points, np.float32).astype(np.float64).tolist()


def test_a_collection_becomes_the_boxes_of_its_minimum_rectangles(polygons_node: Converter) -> None:
    answer = rows_of(polygons_node.convert(collection(SHAPES)))
    np.testing.assert_array_equal(answer, axis_aligned(OrientedBoxes.from_polygons(SHAPES)))


def test_boxes_of_polygons_have_no_id_as_their_row_names_no_ship(polygons_node: Converter) -> None:
    message = collection(SHAPES)
    answer = polygons_node.convert(message)
    assert answer.header == message.header
    assert [detection.id for detection in answer.detections] == [''] * len(SHAPES)
    assert all(detection.header == message.header for detection in answer.detections)
    assert not any(detection.results for detection in answer.detections)


def test_quads_give_what_detections_give(polygons_node: Converter) -> None:
    answer = rows_of(polygons_node.convert(collection(QUADS)))
    np.testing.assert_allclose(answer, axis_aligned(fleet(6)), rtol=1e-9)


def test_an_empty_collection_is_answered_with_an_empty_message(polygons_node: Converter) -> None:
    message = collection([])
    answer = polygons_node.convert(message)
    assert answer.header == message.header
    assert answer.detections == []


def test_parameters_hold_for_polygons(polygons_node: Converter) -> None:
    polygons_node.set({'method': 'shape_aware', 'q': 2.2, 'f': 0.9, 'angle_unit': 'deg'})
    answer = rows_of(polygons_node.convert(collection(SHAPES)))
    polygons_node.reset()
    rule = HullRule('shape_aware', q=2.2, f=0.9)
    expected = axis_aligned(OrientedBoxes.from_polygons(SHAPES), rule)
    np.testing.assert_array_equal(answer, expected)


def test_a_stamped_polygon_becomes_one_box(polygon_node: Converter) -> None:
    message = polygon(TRIANGLE)
    answer = polygon_node.convert(message)
    assert answer.header == message.header
    assert [(detection.id, detection.header) for detection in answer.detections] == [
        ('', message.header)
    ]


@pytest.mark.parametrize('points', SHAPES)
def test_a_stamped_polygon_gives_the_box_of_its_minimum_rectangle(
    polygon_node: Converter, points: Points
) -> None:
    answer = rows_of(polygon_node.convert(polygon(points)))
    boxes = OrientedBoxes.from_polygons([single(points)])
    np.testing.assert_array_equal(answer, axis_aligned(boxes))
