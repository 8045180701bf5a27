# SPDX-License-Identifier: Apache-2.0
"""Four corners in any order are the same box, whether they come as corners or as polygon."""

from itertools import permutations

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from strategies import xywhr

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert
from obbhbb_ros.geometry.boxes import FARTHEST
from obbhbb_ros.geometry.boxes import Defect
from obbhbb_ros.geometry.boxes import crossed

ORDERS = list(permutations(range(4)))
CYCLIC = [order for order in ORDERS if abs(order[0] - order[2]) == 2]
POINT = st.tuples(st.integers(0, 300), st.integers(0, 300))
FOUR_POINTS = st.lists(POINT, min_size=4, max_size=4)
BOX = np.array([[10.0, 10], [90, 40], [82, 61], [2, 31]])
# Bow, port, stern and starboard of a hull.
RHOMBUS = np.array([[100.0, 0], [0, 20], [-100, 0], [0, -20]])
# Less than a sixth of it is missing at one corner.
SNUBBED = np.array([[0.0, 0], [100, 0], [100, 20], [0, 14]])


def outer(boxes):
    """Convert to the boxes around all four corners."""
    return convert(boxes, method='outer')


@pytest.mark.parametrize('decimals', [12, 6, 2, 0])
def test_corners_of_a_box_in_any_order_are_that_box(decimals) -> None:
    rows = np.random.default_rng(2).uniform([0, 0, 30, 12, -4], [4096, 4096, 300, 90, 4], (300, 5))
    corners = OrientedBoxes.from_xywhr(rows).corners.round(decimals)
    boxes = OrientedBoxes.from_corners(corners)
    for order in ORDERS:
        shuffled = OrientedBoxes.from_corners(corners[:, order])
        np.testing.assert_allclose(convert(shuffled), convert(boxes), rtol=0, atol=1e-9)
        np.testing.assert_allclose(shuffled.length, boxes.length)
        assert crossed(corners[:, order]).tolist() == [order not in CYCLIC] * len(rows)


@given(FOUR_POINTS)
def test_any_four_points_in_any_order_are_the_same_box_or_none(points) -> None:
    boxes = OrientedBoxes.from_corners(np.array(points, float)[ORDERS])
    assert len(set(boxes.defects.tolist())) == 1
    np.testing.assert_allclose(boxes.center, boxes.center[[0] * 24], atol=1e-9)
    np.testing.assert_allclose(outer(boxes), outer(boxes)[[0] * 24], atol=1e-9)
    np.testing.assert_allclose(boxes.length, boxes.length[[0] * 24])


@given(FOUR_POINTS)
def test_four_points_have_their_mean_edges_or_their_minimum_rectangle(points) -> None:
    (box,) = OrientedBoxes.from_corners([points])
    hull = shapely.convex_hull(shapely.multipoints(points))
    if hull.area == 0:
        assert box.defects[0] == Defect.EMPTY
        return
    rectangle = shapely.oriented_envelope(hull).area
    is_box = hull.area >= 0.85 * rectangle
    area = shapely.area(shapely.polygons(box.corners[0]))
    np.testing.assert_allclose(area, hull.area if is_box else rectangle)


@given(FOUR_POINTS)
def test_a_polygon_of_four_corners_closed_or_not_is_the_box_of_these_corners(points) -> None:
    rings = np.array(points, float)[ORDERS]
    boxes = OrientedBoxes.from_corners(rings)
    for polygons in (rings, np.concatenate((rings, rings[:, :1]), axis=1)):
        around = OrientedBoxes.from_polygons(polygons)
        np.testing.assert_array_equal(around.corners, boxes.corners)


def test_corners_that_outline_a_hull_give_its_minimum_rectangle() -> None:
    (box,) = OrientedBoxes.from_corners([RHOMBUS])
    (rectangle,) = box.to_polygons()
    expected = shapely.oriented_envelope(shapely.polygons(RHOMBUS))
    np.testing.assert_allclose(rectangle.area, expected.area)
    assert rectangle.buffer(1e-9).covers(shapely.polygons(RHOMBUS))


def test_corners_that_almost_fill_a_rectangle_give_their_mean_edges() -> None:
    (box,) = OrientedBoxes.from_corners([SNUBBED])
    np.testing.assert_allclose(box.width, 17.0)
    np.testing.assert_allclose(box.center, [[50.0, 10.0]])


def test_three_corners_and_a_point_between_them_give_the_rectangle_of_the_three() -> None:
    triangle = [[0, 0], [30, 0], [0, 12]]
    boxes = OrientedBoxes.from_corners([[*triangle, [8, 3]], [*triangle, [0, 0]]])
    around = OrientedBoxes.from_polygons([triangle])
    np.testing.assert_allclose(outer(boxes), outer(around)[[0, 0]])


@pytest.mark.parametrize('scale', [1e-160, 1e-80, 1.0, 1e80, 1e160, 1e300])
def test_the_size_of_the_numbers_makes_no_difference(scale) -> None:
    boxes = OrientedBoxes.from_corners(BOX[ORDERS] * scale)
    assert boxes.valid.all()
    edges = 2.0 * np.hypot(*np.stack((boxes.first, boxes.second)).transpose(2, 1, 0) / scale)
    np.testing.assert_allclose(np.sort(edges, axis=1), [[22.47, 85.44]] * 24, rtol=1e-3)


@pytest.mark.parametrize('points', [[[1, 2], [4, 8], [2, 4], [10, 20]], [[7, 7]] * 4], ids=str)
def test_corners_on_one_line_have_no_area_in_any_order(points) -> None:
    boxes = OrientedBoxes.from_corners(np.array(points, float)[ORDERS])
    assert boxes.defects.tolist() == [Defect.EMPTY] * 24


@pytest.mark.parametrize('order', ORDERS)
def test_the_first_edge_is_the_bow_only_if_the_corners_are_in_order(order) -> None:
    bow_first = np.roll(BOX, -1, axis=0)
    (box,) = OrientedBoxes.from_corners([bow_first[list(order)]], bow=True)
    in_order_from_the_bow = order in CYCLIC and set(order[:2]) in ({0, 1}, {2, 3})
    assert box.bow.tolist() == [in_order_from_the_bow]
    if in_order_from_the_bow:
        middle = bow_first[list(order)][:2].mean(axis=0)
        np.testing.assert_allclose(box.center[0] + box.first[0], middle, atol=1.0)


def test_the_bow_of_a_hull_drawn_from_its_bow_is_at_that_end() -> None:
    pointed = [[100, -4], [100, 4], [-100, 20], [-100, -20]]
    (box,) = OrientedBoxes.from_corners([pointed], bow=True)
    assert box.bow.tolist() == [True]
    assert box.first[0, 0] > 90


@given(rows=xywhr(), number=st.integers(0, 7), order=st.sampled_from(ORDERS))
def test_one_box_in_another_order_changes_no_other(rows, number, order) -> None:
    corners = OrientedBoxes.from_xywhr(rows).corners
    row = number % len(rows)
    shuffled = corners.copy()
    shuffled[row] = corners[row, list(order)]
    one, other = (OrientedBoxes.from_corners(each) for each in (corners, shuffled))
    others = np.arange(len(rows)) != row
    assert one[others] == other[others]


@pytest.mark.parametrize('offset', [0.0, 6.65e6, 1.2e7, 1e8])
def test_a_polygon_keeps_its_digits_at_map_coordinates(offset) -> None:
    hull = np.array([[0, 0], [55, 0], [60, 10], [55, 20], [0, 20]]) * 1.25
    turned = hull @ [[0.8, 0.6], [-0.6, 0.8]]
    here, there = OrientedBoxes.from_polygons([turned, turned + offset])
    np.testing.assert_allclose(there.center - offset, here.center, atol=1e-7)
    np.testing.assert_allclose(there.length, here.length, atol=1e-7)
    np.testing.assert_allclose(there.width, here.width, atol=1e-7)


def test_polygons_of_any_number_of_corners_keep_their_order() -> None:
    polygons = [RHOMBUS[:3], BOX, [[0, 0], [1, 1]], [*BOX, BOX[0]], [*RHOMBUS, [3, 2]], RHOMBUS]
    boxes = OrientedBoxes.from_polygons(polygons)
    alone = [OrientedBoxes.from_polygons([polygon]) for polygon in polygons]
    assert boxes == OrientedBoxes.concatenate(alone)


def test_four_corners_beyond_reach_are_no_polygon() -> None:
    boxes = OrientedBoxes.from_polygons([BOX, BOX + 2 * FARTHEST, BOX * np.nan])
    expected = [Defect.NONE, Defect.NO_RECTANGLE, Defect.NOT_FINITE]
    assert boxes.defects.tolist() == expected
    assert np.isnan(boxes.center[1:]).all()
