# SPDX-License-Identifier: Apache-2.0
"""Polygon input, both types, as the node's users send it."""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence

import numpy as np
import pytest
from harness import Converter
from harness import Site
from ships import axis_aligned
from ships import collection
from ships import fleet
from ships import polygon
from ships import rows_of

from obbhbb_ros import OrientedBoxes
from obbhbb_ros.converter import HullRule

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


def single(points: Points) -> list[list[float]]:
    """Round to what a `PolygonStamped` can hold."""
    return np.asarray(points, np.float32).astype(np.float64).tolist()


def test_a_collection_becomes_the_boxes_of_its_minimum_rectangles(
    polygons_node: Converter
) -> None:
    answer = rows_of(polygons_node.convert(collection(SHAPES)))
    np.testing.assert_array_equal(answer, axis_aligned(OrientedBoxes.from_polygons(SHAPES)))


def test_polygons_are_known_by_their_place(polygons_node: Converter) -> None:
    message = collection(SHAPES)
    answer = polygons_node.convert(message)
    assert answer.header == message.header
    assert [each.id for each in answer.detections] == [str(i) for i in range(len(SHAPES))]
    assert all(each.header == message.header for each in answer.detections)
    assert not any(each.results for each in answer.detections)


def test_quads_give_what_detections_give(polygons_node: Converter) -> None:
    answer = rows_of(polygons_node.convert(collection(QUADS)))
    np.testing.assert_allclose(answer, axis_aligned(fleet(6)), rtol=1e-9)


def test_an_empty_collection_is_answered_with_an_empty_message(
    polygons_node: Converter
) -> None:
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
    assert [(each.id, each.header) for each in answer.detections] == [('0', message.header)]


@pytest.mark.parametrize('points', SHAPES)
def test_a_stamped_polygon_gives_the_box_of_its_minimum_rectangle(
    polygon_node: Converter, points: Points
) -> None:
    answer = rows_of(polygon_node.convert(polygon(points)))
    boxes = OrientedBoxes.from_polygons([single(points)])
    np.testing.assert_array_equal(answer, axis_aligned(boxes))
