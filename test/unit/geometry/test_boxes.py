# SPDX-License-Identifier: Apache-2.0
"""OrientedBoxes: what it takes, what it keeps, what it refuses."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from strategies import xywhr

from obbhbb_ros import OrientedBoxes
from obbhbb_ros.geometry.boxes import FARTHEST
from obbhbb_ros.geometry.boxes import Defect

# The largest double but for its digits: its square overflows, and GEOS follows.
_B = 1e308
CRASHES_GEOS = [
    (0, 0),
    (_B, 1),
    (_B, _B),
    (_B, 6),
    (1, 7),
    (0, 8),
    (1, _B),
    (0, 10),
    (1, 0),
    (0, 16),
    (0, 17),
    (_B, 21),
    (0, _B),
    (1, 24),
    (1, 25),
    (0, 26),
    (1, 28),
]
SQUARE_ON_ITS_TIP = [[2.0, 0.0], [4.0, 2.0], [2.0, 4.0], [0.0, 2.0]]


def test_corners_of_an_upright_box_give_centre_length_width_and_angle() -> None:
    boxes = OrientedBoxes.from_corners([[[0, 0], [10, 0], [10, 4], [0, 4]]])
    np.testing.assert_allclose(boxes.center[0], [5, 2])
    assert (boxes.length[0], boxes.width[0], boxes.theta[0]) == (10, 4, 0)


@given(xywhr(), st.integers(0, 3), st.booleans())
def test_any_start_and_either_sense_of_the_corners_give_the_same_box(rows, start, turned) -> None:
    boxes = OrientedBoxes.from_xywhr(rows)
    corners = np.roll(boxes.corners, start, axis=1)
    again = OrientedBoxes.from_corners(corners[:, ::-1] if turned else corners)
    np.testing.assert_allclose(again.length, boxes.length, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(again.width, boxes.width, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(again.center, boxes.center, atol=1e-9 * 1e5)


@given(xywhr())
def test_swapping_the_sides_with_a_quarter_turn_changes_nothing(rows) -> None:
    turned = rows[:, [0, 1, 3, 2, 4]] + [0, 0, 0, 0, np.pi / 2]
    one, other = OrientedBoxes.from_xywhr(rows), OrientedBoxes.from_xywhr(turned)
    np.testing.assert_allclose(other.length, one.length)
    np.testing.assert_allclose(other.width, one.width)


@given(xywhr())
def test_the_angle_lies_in_a_half_turn(rows) -> None:
    theta = OrientedBoxes.from_xywhr(rows).theta
    assert ((theta >= -np.pi / 2) & (theta < np.pi / 2)).all()


# Four corners, closed or not, are a box and not a polygon.
@given(
    st.lists(st.tuples(st.integers(0, 300), st.integers(0, 300)), min_size=3, max_size=12).filter(
        lambda points: len(points) not in (4, 5)
    )
)
def test_the_rectangle_of_a_polygon_covers_it_and_touches_it(points) -> None:
    boxes = OrientedBoxes.from_polygons([points])
    hull = shapely.convex_hull(shapely.multipoints(points))
    if hull.area == 0:
        assert not boxes.valid[0]
        return
    rectangle = shapely.polygons(boxes.corners[0])
    assert shapely.covers(shapely.buffer(rectangle, 1e-6), hull)
    assert shapely.area(rectangle) <= shapely.area(shapely.box(*shapely.bounds(hull))) + 1e-6


@pytest.mark.parametrize('order', [[0, 1, 2, 3], [0, 2, 1, 3], [3, 1, 0, 2]])
def test_the_vertices_of_a_polygon_may_come_in_any_order(order) -> None:
    boxes = OrientedBoxes.from_polygons([np.array(SQUARE_ON_ITS_TIP)[order]])
    np.testing.assert_allclose([boxes.length[0], boxes.width[0]], 8**0.5)


def test_a_closed_ring_counts_its_first_vertex_once() -> None:
    boxes = OrientedBoxes.from_polygons([[*SQUARE_ON_ITS_TIP, SQUARE_ON_ITS_TIP[0]]])
    np.testing.assert_allclose(boxes.width, 8**0.5)


@pytest.mark.parametrize(
    ('row', 'defect'),
    [
        ([np.nan, 0, 4, 2, 0], Defect.NOT_FINITE),
        ([0, np.inf, 4, 2, 0], Defect.NOT_FINITE),
        ([0, 0, -np.inf, 2, 0], Defect.NOT_FINITE),
        ([0, 0, 4, 2, np.nan], Defect.NOT_FINITE),
        ([0, 0, -4, 2, 0], Defect.NEGATIVE_SIZE),
        ([0, 0, 4, -2, 0], Defect.NEGATIVE_SIZE),
        ([0, 0, 4, 0, 0], Defect.EMPTY),
        ([0, 0, 0, 2, 0], Defect.EMPTY),
        ([0, 0, 0, 0, 0], Defect.EMPTY),
    ],
)
def test_a_box_that_is_none_is_marked_and_its_neighbours_are_not(row, defect) -> None:
    good = [5, 5, 4, 2, 0.3]
    boxes = OrientedBoxes.from_xywhr([good, row, good])
    assert boxes.defects.tolist() == [Defect.NONE, defect, Defect.NONE]
    assert np.isnan(boxes.center[1]).all()
    assert np.isfinite(boxes.center[[0, 2]]).all()


def signalling_nan(*shape: int) -> np.ndarray:
    """Make an array of a NaN that every operation reports, as only the bytes of a message have."""
    return np.full(shape, 0x7FF0000000000001, np.uint64).view(np.float64)


@pytest.mark.parametrize(
    'build',
    [
        lambda: OrientedBoxes.from_corners(signalling_nan(1, 4, 2)),
        lambda: OrientedBoxes.from_corners(signalling_nan(1, 4, 2), bow=True),
        lambda: OrientedBoxes.from_polygons([signalling_nan(5, 2)]),
        lambda: OrientedBoxes.from_xywhr(signalling_nan(1, 5)),
        lambda: OrientedBoxes.from_xywhr(signalling_nan(1, 5), degrees=True, bow=True),
    ],
    ids=['corners', 'corners with bow', 'polygon', 'xywhr', 'xywhr in degrees'],
)
def test_a_signalling_nan_is_not_finite_and_no_warning(build) -> None:
    assert build().defects.tolist() == [Defect.NOT_FINITE]


def test_boxes_with_different_defects_are_told_apart_in_one_batch() -> None:
    good = [5, 5, 4, 2, 0.3]
    rows = [
        good,
        [5, 5, -4, 2, 0.3],
        [np.nan, 5, 4, 2, 0.3],
        [5, 5, 4, 0, 0.3],
        good,
        [5, np.inf, 4, -2, 0.3],
    ]
    assert OrientedBoxes.from_xywhr(rows).defects.tolist() == [
        Defect.NONE,
        Defect.NEGATIVE_SIZE,
        Defect.NOT_FINITE,
        Defect.EMPTY,
        Defect.NONE,
        Defect.NOT_FINITE,
    ]


@pytest.mark.parametrize(
    ('polygon', 'defect'),
    [
        ([[0, 0], [1, 1]], Defect.TOO_FEW_POINTS),
        ([[0, 0], [1, 1], [0, 0], [1, 1]], Defect.TOO_FEW_POINTS),
        (np.empty((0, 2)), Defect.TOO_FEW_POINTS),
        ([[0, 0], [1, 1], [2, 2]], Defect.EMPTY),
        ([[0, 0], [1, np.nan], [2, 0]], Defect.NOT_FINITE),
        ([[0, 0], [1, 0], [0, 1.1 * FARTHEST]], Defect.NO_RECTANGLE),
        (CRASHES_GEOS, Defect.NO_RECTANGLE),
        ([(1e160, 1e154), (1e155, 1e160), (1, 0), (1e154, 1), (1e155, 100)], Defect.NO_RECTANGLE),
    ],
)
def test_a_polygon_without_a_rectangle_is_marked(polygon, defect) -> None:
    boxes = OrientedBoxes.from_polygons([SQUARE_ON_ITS_TIP, polygon, SQUARE_ON_ITS_TIP])
    assert boxes.defects.tolist() == [Defect.NONE, defect, Defect.NONE]
    assert np.isnan(boxes.center[1]).all()
    np.testing.assert_allclose(boxes.length[[0, 2]], 8**0.5)


@pytest.mark.parametrize(
    'thin',
    [
        [
            (6.8500510593043965e-301, -477738976.99282265),
            (3.3333333333333334e-301, 1),
            (0, -5.336e-321),
            (-3.3e-322, -796928573.3537534),
        ],
        # An edge whose squared length underflows.
        [(0.0, 0.0), (0.0, 0.0), (0.0, 1.0), (1.1113793747425424e-162, 0.0)],
    ],
)
def test_a_polygon_that_shapely_raises_on_costs_its_neighbours_nothing(thin) -> None:
    boxes = OrientedBoxes.from_polygons([SQUARE_ON_ITS_TIP, thin, SQUARE_ON_ITS_TIP])
    # Not every release does raise.
    assert boxes.valid[[0, 2]].all()
    assert boxes.valid[1] == np.isfinite(boxes.corners[1]).all()


ANYWHERE = st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 2)


@given(st.lists(st.lists(ANYWHERE, min_size=3, max_size=12), max_size=5))
def test_whatever_its_coordinates_a_polygon_is_converted_or_marked(polygons) -> None:
    boxes = OrientedBoxes.from_polygons(polygons)
    np.testing.assert_array_equal(np.isfinite(boxes.corners).all(axis=(1, 2)), boxes.valid)


@pytest.mark.parametrize(
    ('build', 'argument', 'name'),
    [
        (OrientedBoxes.from_corners, np.zeros((2, 3, 2)), 'corners'),
        (OrientedBoxes.from_corners, np.zeros((4, 2)), 'corners'),
        (OrientedBoxes.from_xywhr, np.zeros((2, 4)), 'xywhr'),
        (OrientedBoxes.from_xywhr, np.zeros(5), 'xywhr'),
        (OrientedBoxes.from_xywhr, [['a'] * 5], 'xywhr'),
        (OrientedBoxes.from_polygons, [SQUARE_ON_ITS_TIP, [[1, 2, 3]]], r'polygons\[1\]'),
    ],
)
def test_a_wrong_shape_is_an_error_that_names_the_argument(build, argument, name) -> None:
    with pytest.raises(ValueError, match=f'^{name} must'):
        build(argument)


@pytest.mark.parametrize(
    'boxes',
    [
        OrientedBoxes.from_corners(np.empty((0, 4, 2))),
        OrientedBoxes.from_xywhr([]),
        OrientedBoxes.from_polygons([]),
    ],
)
def test_no_boxes_are_boxes_too(boxes) -> None:
    assert len(boxes) == 0
    assert boxes.corners.shape == (0, 4, 2)


def test_a_box_about_the_origin_is_as_good_as_any() -> None:
    assert OrientedBoxes.from_xywhr([[0, 0, 4, 2, 0]]).valid.all()


def test_the_input_arrays_are_never_changed() -> None:
    rows = np.array([[1.0, 2, -3, 4, 0.5], [1, 2, 3, 4, 0.5]])
    before = rows.copy()
    OrientedBoxes.from_xywhr(rows)
    np.testing.assert_array_equal(rows, before)
    corners = np.full((1, 4, 2), np.nan)
    OrientedBoxes.from_corners(corners)
    assert np.isnan(corners).all()


@given(rows=xywhr(4), rounded=st.booleans())
def test_a_few_corners_give_the_boxes_that_they_give_among_many(rows, rounded) -> None:
    corners = OrientedBoxes.from_xywhr(rows).corners
    if rounded:
        corners = np.round(corners)
    alone = OrientedBoxes.from_corners(corners)
    among = OrientedBoxes.from_corners(np.tile(corners, (5, 1, 1)))
    assert alone.regular == among.regular
    for name in ('center', 'first', 'second', 'defects'):
        few, many = getattr(alone, name), getattr(among, name)
        np.testing.assert_array_equal(many, np.concatenate([few] * 5))


# A sequence of boxes ---------------------------------------------------------------------------

ROWS = np.array(
    [[50.0, 40, 60, 20, 0.3], [9, 9, 4, 2, 1], [5, 5, 0, 2, 0], [8, 7, 6, 5, -1.2], [1, 2, 9, 3, 0]]
)
NAMES = ['center', 'first', 'second', 'defects', 'bow', 'long_axis', 'short_axis']


@pytest.mark.parametrize('name', NAMES)
def test_boxes_cannot_be_changed(name) -> None:
    boxes = OrientedBoxes.from_xywhr(ROWS, bow=True)
    with pytest.raises(ValueError, match='read-only'):
        getattr(boxes, name)[:] = 0
    with pytest.raises(AttributeError):
        setattr(boxes, name, getattr(boxes, name))


@pytest.mark.parametrize('count', [0, 1, 20_000])
@pytest.mark.parametrize('name', ['center', 'first', 'second', 'long_axis', 'short_axis'])
def test_points_and_vectors_have_a_row_for_each_box(name, count) -> None:
    assert getattr(OrientedBoxes.from_xywhr(np.ones((count, 5))), name).shape == (count, 2)


@pytest.mark.parametrize(
    'rows',
    [slice(1, 4), slice(None, None, -1), [3, 0, 0], np.array([True, False, True, True, False]), []],
    ids=str,
)
def test_any_index_of_numpy_selects_boxes(rows) -> None:
    boxes, indices = OrientedBoxes.from_xywhr(ROWS, bow=True), np.arange(len(ROWS))[rows]
    assert boxes[rows] == OrientedBoxes.from_xywhr(ROWS[indices.astype(int)], bow=True)


@pytest.mark.parametrize('row', [0, 4, -1, np.int64(2)])
def test_an_integer_selects_one_box(row) -> None:
    boxes = OrientedBoxes.from_xywhr(ROWS)
    assert boxes[row] == OrientedBoxes.from_xywhr(ROWS[[row]])


@pytest.mark.parametrize('row', [5, -6])
def test_an_integer_out_of_range_is_an_error(row) -> None:
    with pytest.raises(IndexError):
        OrientedBoxes.from_xywhr(ROWS)[row]


def test_iteration_gives_one_box_at_a_time() -> None:
    boxes = OrientedBoxes.from_xywhr(ROWS, bow=True)
    parts = list(boxes)
    assert [len(part) for part in parts] == [1] * 5
    assert OrientedBoxes.concatenate(parts) == boxes


def test_boxes_are_joined_in_order() -> None:
    boxes = OrientedBoxes.from_xywhr(ROWS, bow=True)
    assert OrientedBoxes.concatenate([boxes[2:], boxes[:2]]) == boxes[[2, 3, 4, 0, 1]]
    assert OrientedBoxes.concatenate([]) == OrientedBoxes.from_xywhr([])
    assert OrientedBoxes.concatenate([boxes[:2], boxes[3:]]).valid.all()


def test_boxes_are_equal_to_the_last_bit_or_not() -> None:
    boxes = OrientedBoxes.from_xywhr(ROWS)
    assert boxes == OrientedBoxes.from_xywhr(ROWS)
    assert boxes != OrientedBoxes.from_xywhr(ROWS + [0, 0, 0, 0, 1e-9])
    assert boxes != OrientedBoxes.from_xywhr(ROWS, bow=True)
    assert boxes != boxes[:4]
    assert boxes != ROWS.tolist()
    # Of another defect.
    assert boxes[2] != OrientedBoxes.from_xywhr([[5, 5, -1, 2, 0]])


def test_the_text_of_boxes_shows_how_many_and_the_first() -> None:
    boxes = OrientedBoxes.from_xywhr(ROWS)
    lines = repr(boxes).splitlines()
    assert lines[0] == '<OrientedBoxes: 5 boxes, 1 invalid, xywhr:'
    assert len(lines) == 4
    assert lines[-1].endswith(' ...>')
    assert repr(boxes[0]) == '<OrientedBoxes: 1 box, xywhr:\n[[50.  40.  60.  20.   0.3]]>'
    assert repr(boxes[:0]) == '<OrientedBoxes: 0 boxes, xywhr:\n[]>'


def test_boxes_are_no_array_and_the_error_says_what_is() -> None:
    with pytest.raises(TypeError, match=r'take \.xywhr'):
        np.asarray(OrientedBoxes.from_xywhr(ROWS))


# Other forms -----------------------------------------------------------------------------------


@given(xywhr(), st.booleans())
def test_xywhr_gives_the_same_boxes_and_bows(rows, bow) -> None:
    boxes = OrientedBoxes.from_xywhr(rows, bow=bow)
    again = OrientedBoxes.from_xywhr(boxes.xywhr, bow=boxes.bow)
    slack = 1e-11 * np.abs(rows[:, :4]).max()
    # The corners may start with another one, and run the other way round.
    orders = [np.roll(again.corners[:, ::way], i, axis=1) for i in range(4) for way in (1, -1)]
    assert (np.abs(orders - boxes.corners).max(axis=(2, 3)).min(axis=0) <= slack).all()
    heading = boxes.bow & again.bow
    np.testing.assert_allclose(again.first[heading], boxes.first[heading], atol=slack)
    # A square may lose its bow to rounding; nothing else does.
    assert (boxes.bow == again.bow)[boxes.length > 1.001 * boxes.width].all()


def test_flat_corners_are_corners() -> None:
    corners = OrientedBoxes.from_xywhr(ROWS).corners
    assert OrientedBoxes.from_corners(corners.reshape(-1, 8)) == OrientedBoxes.from_corners(corners)
    flat = corners[0].ravel().tolist()
    assert OrientedBoxes.from_corners([flat]) == OrientedBoxes.from_corners(corners[:1])


def test_angles_may_be_in_degrees() -> None:
    degrees = OrientedBoxes.from_xywhr([[5, 5, 4, 2, 30], [5, 5, 4, 2, -90]], degrees=True)
    np.testing.assert_allclose(degrees.theta, np.radians([30, -90]))


def test_polygons_may_be_those_of_shapely() -> None:
    ring = [(0, 0), (9, 0), (9, 4), (0, 4)]
    hole = [[(1, 1), (2, 1), (2, 2)]]
    geometries = [shapely.Polygon(ring, hole), shapely.MultiPoint(ring), shapely.Polygon()]
    boxes = OrientedBoxes.from_polygons([*geometries, ring])
    assert boxes.defects.tolist() == [0, 0, Defect.TOO_FEW_POINTS, 0]
    np.testing.assert_allclose(boxes.length[[0, 1, 3]], 9)


def test_boxes_become_polygons_of_shapely_and_the_invalid_none() -> None:
    boxes = OrientedBoxes.from_xywhr(ROWS)
    polygons = boxes.to_polygons()
    assert [polygon is None for polygon in polygons] == (~boxes.valid).tolist()
    np.testing.assert_allclose(shapely.area(polygons[boxes.valid]), [1200, 8, 30, 27])
    assert OrientedBoxes.from_polygons(polygons[boxes.valid]).valid.all()
