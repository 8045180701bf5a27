# SPDX-License-Identifier: Apache-2.0
"""Boxes whose bow is known: where it comes from, and what q_bow and q_stern do with it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import FACTOR
from strategies import Q
from strategies import xywhr

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert
from obbhbb_ros.geometry.boxes import BLOCK
from obbhbb_ros.geometry.converter import Caps
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import centers_and_extents
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.geometry.converter import convert_with_diagnostics
from obbhbb_ros.geometry.converter import to_xyxy
from obbhbb_ros.geometry.methods import METHODS

# Half-length 10, half-width 5, direction (0.6, 0.8): A = (6, 8), B = (4, 3).
SLOPE = [0.0, 0.0, 20.0, 10.0, np.arctan2(0.8, 0.6)]
CORNERS = [[[2, 11], [10, 5], [-2, -11], [-10, -5]]]
ENDS = {'q_bow': 2.0, 'q_stern': np.inf}
EXPECTED = [-10.0, -11.0, 52**0.5, 73**0.5]


@st.composite
def ships(draw):
    """Draw xywhr with the longer side along theta."""
    rows = draw(xywhr())
    rows[:, 2:4] = -np.sort(-rows[:, 2:4], axis=1)
    return rows


def tolerance(rows):
    return 1e-11 * np.abs(rows[:, :4]).max()


def test_each_end_reaches_as_far_as_its_own_superellipse() -> None:
    boxes = OrientedBoxes.from_xywhr([SLOPE], bow=True)
    np.testing.assert_allclose(convert(boxes, **ENDS), [EXPECTED])


def test_the_first_two_corners_are_the_bow_end() -> None:
    boxes = OrientedBoxes.from_corners(CORNERS, bow=True)
    assert boxes.bow.tolist() == [True]
    np.testing.assert_allclose(convert(boxes, **ENDS), [EXPECTED])
    backwards = OrientedBoxes.from_corners(np.roll(CORNERS, 2, axis=1), bow=True)
    np.testing.assert_allclose(convert(backwards, **ENDS)[0], -np.roll(EXPECTED, 2))
    counter_clockwise = np.array(CORNERS)[:, [1, 0, 3, 2]]
    again = OrientedBoxes.from_corners(counter_clockwise, bow=True)
    np.testing.assert_allclose(convert(again, **ENDS), [EXPECTED])


def test_fullness_narrows_the_hull_and_shrinking_keeps_its_middle() -> None:
    boxes = OrientedBoxes.from_xywhr([SLOPE], bow=True)
    expected = [-0.5 * 8.0, -0.5 * 9.5, 0.5 * 40**0.5, 0.5 * 66.25**0.5]
    np.testing.assert_allclose(convert(boxes, f=0.5, s=0.5, **ENDS), [expected])


def test_one_end_alone_takes_q_for_the_other() -> None:
    boxes = OrientedBoxes.from_xywhr([SLOPE], bow=True)
    np.testing.assert_allclose(convert(boxes, q=np.inf, q_bow=2.0), [EXPECTED])
    np.testing.assert_allclose(convert(boxes, q=2.0, q_stern=np.inf), [EXPECTED])


@pytest.mark.parametrize(
    ('row', 'known'),
    [
        (SLOPE, True),
        ([0, 0, 10, 20, 0.3], False),
        ([0, 0, 10, 10, 0.3], True),
        ([0, 0, np.nan, 20, 0], False),
        ([0, 0, -20, 10, 0], False),
        ([0, 0, 20, 0, 0], False),
        ([0, 0, 1e300, 1e290, 0], False),
    ],
)
def test_the_bow_is_known_where_theta_is_along_the_longer_side(row, known) -> None:
    assert OrientedBoxes.from_xywhr([row], bow=True).bow.tolist() == [known]
    assert OrientedBoxes.from_xywhr([row], bow=False).bow.tolist() == [False]


def test_the_bow_may_be_known_for_some() -> None:
    boxes = OrientedBoxes.from_xywhr([SLOPE] * 3, bow=np.array([True, False, True]))
    assert boxes.bow.tolist() == [True, False, True]
    assert boxes[[1, 2]].bow.tolist() == [False, True]
    assert OrientedBoxes.from_xywhr([SLOPE])[0].bow.tolist() == [False]
    with pytest.raises(ValueError, match=r'^bow must'):
        OrientedBoxes.from_xywhr([SLOPE], bow=np.array([True, False]))


@given(rows=ships(), q_bow=Q, q_stern=Q, f=FACTOR, s=FACTOR)
def test_a_bow_at_the_other_end_mirrors_the_box(rows, q_bow, q_stern, f, s) -> None:
    rule = HullRule('superellipse', 3.0, f, s, q_bow, q_stern)
    turned = rows + [0, 0, 0, 0, np.pi]
    one = convert_by_rule(OrientedBoxes.from_xywhr(rows, bow=True), rule)
    other = convert_by_rule(OrientedBoxes.from_xywhr(turned, bow=True), rule)
    mirrored = 2.0 * rows[:, [0, 1, 0, 1]] - other[:, [2, 3, 0, 1]]
    np.testing.assert_allclose(one, mirrored, rtol=0, atol=tolerance(rows))
    exchanged = HullRule('superellipse', 3.0, f, s, q_stern, q_bow)
    third = convert_by_rule(OrientedBoxes.from_xywhr(turned, bow=True), exchanged)
    np.testing.assert_allclose(one, third, rtol=0, atol=tolerance(rows))


@given(rows=xywhr(), q=Q, q_bow=Q, q_stern=Q, f=FACTOR, s=FACTOR)
def test_the_box_lies_between_those_of_the_least_and_the_greatest_q(
    rows, q, q_bow, q_stern, f, s
) -> None:
    boxes = OrientedBoxes.from_xywhr(rows, bow=True)
    box = convert(boxes, q=q, f=f, s=s, q_bow=q_bow, q_stern=q_stern)
    low, high = (convert(boxes, q=choose(q, q_bow, q_stern), f=f, s=s) for choose in (min, max))
    slack = tolerance(rows)
    sign = np.array([-1, -1, 1, 1])
    assert (sign * low <= sign * box + slack).all()
    assert (sign * box <= sign * high + slack).all()


@given(rows=xywhr(), q=Q, f=FACTOR, s=FACTOR)
def test_ends_that_are_alike_give_the_plain_box_to_the_last_bit(rows, q, f, s) -> None:
    plain = convert(OrientedBoxes.from_xywhr(rows), q=q, f=f, s=s)
    boxes = OrientedBoxes.from_xywhr(rows, bow=True)
    for ends in ({}, {'q_bow': q, 'q_stern': q}, {'q_stern': q}):
        np.testing.assert_array_equal(convert(boxes, q=q, f=f, s=s, **ends), plain)


@given(rows=xywhr(), q=Q, q_bow=Q, q_stern=Q, f=FACTOR, s=FACTOR)
def test_an_unknown_bow_gives_the_plain_box_to_the_last_bit(rows, q, q_bow, q_stern, f, s) -> None:
    rules = [HullRule('superellipse', q, f, s, q_bow, q_stern)]
    plain = OrientedBoxes.from_xywhr(rows)
    center, extents = centers_and_extents(plain, [HullRule('superellipse', q, f, s)])
    nowhere = np.zeros(len(rows), bool)
    for boxes in (plain, OrientedBoxes.from_xywhr(rows, bow=nowhere)):
        placed = centers_and_extents(boxes, rules)
        np.testing.assert_array_equal(placed[0], center)
        np.testing.assert_array_equal(placed[1], extents)
    # The first edge of these corners is a long side; that of a square may be either.
    corners = plain.corners[plain.length > 1.01 * plain.width]
    expected = convert_by_rule(OrientedBoxes.from_corners(corners), rules[0])
    for bow in (nowhere[: len(corners)], True):
        boxes = OrientedBoxes.from_corners(corners, bow=bow)
        assert not boxes.bow.any()
        np.testing.assert_array_equal(convert_by_rule(boxes, rules[0]), expected)


@pytest.mark.parametrize('method', [name for name in METHODS if name != 'superellipse'])
def test_the_other_methods_ignore_the_bow(method) -> None:
    boxes = OrientedBoxes.from_xywhr([SLOPE], bow=True)
    plain = convert(OrientedBoxes.from_xywhr([SLOPE]), method=method)
    np.testing.assert_array_equal(convert(boxes, method=method, **ENDS), plain)


def half_hull(a, b, q):
    """Sample the half of a superellipse with x >= 0, (2, K); denser where it bends."""
    part = np.linspace(0.0, 1.0, 20001) ** 2
    other = np.where(part < 1.0, 1.0, 0.0) if np.isinf(q) else (1.0 - part**q) ** (1.0 / q)
    x, y = a * np.concatenate((part, other)), b * np.concatenate((other, part))
    if np.isinf(q):
        x, y = np.append(x, a), np.append(y, b)
    return np.concatenate(([x, y], [x, -y]), axis=1)


@given(
    length=st.floats(1.0, 500.0),
    aspect=st.floats(1.0, 12.0),
    theta=st.floats(-7.0, 7.0),
    q_bow=st.one_of(st.floats(1.0, 20.0), st.just(np.inf)),
    q_stern=st.one_of(st.floats(1.0, 20.0), st.just(np.inf)),
    f=st.floats(0.5, 1.0),
)
def test_the_box_is_that_of_two_half_superellipses(
    length, aspect, theta, q_bow, q_stern, f
) -> None:
    a, b = length / 2, f * length / aspect / 2
    hull = np.hstack((half_hull(a, b, q_bow), [[-1], [1]] * half_hull(a, b, q_stern)))
    turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    points = turn @ hull
    boxes = OrientedBoxes.from_xywhr([[0, 0, length, length / aspect, theta]], bow=True)
    xyxy = convert(boxes, f=f, q_bow=q_bow, q_stern=q_stern)[0]
    sampled = [*points.min(axis=1), *points.max(axis=1)]
    np.testing.assert_allclose(xyxy, sampled, rtol=0, atol=1e-6 * length)


def test_caps_bound_the_whole_box_about_its_own_centre() -> None:
    boxes = OrientedBoxes.from_xywhr([SLOPE], bow=True)
    free = np.array(EXPECTED)
    middle = (free[:2] + free[2:]) / 2
    capped = convert(boxes, max_length=12.0, max_width=6.0, **ENDS)[0]
    # y is the longer side.
    np.testing.assert_allclose(capped, [*(middle - [3, 6]), *(middle + [3, 6])])
    rule = HullRule(**ENDS)
    assert convert_with_diagnostics(boxes, rule, Caps(max_length=12.0)).capped.tolist() == [True]
    assert convert_with_diagnostics(boxes, rule, Caps(max_length=40.0)).capped.tolist() == [False]


def test_the_contact_is_that_of_the_side_of_the_bow() -> None:
    rows = [SLOPE, SLOPE]
    boxes = OrientedBoxes.from_xywhr(rows, bow=np.array([True, False]))
    conversion = convert_with_diagnostics(boxes, HullRule(q=1.0, q_bow=2.0, q_stern=5.0))
    np.testing.assert_allclose(conversion.t_x, [6 / 52**0.5, 1.0])
    np.testing.assert_allclose(conversion.t_y, [8 / 73**0.5, 1.0])


@pytest.mark.filterwarnings('error')
@given(rows=xywhr())
def test_boxes_out_of_the_ordinary_do_not_change_the_others(rows) -> None:
    odd = [
        [np.nan, 0, 4, 2, 0],
        [0, 0, 4, 2, np.inf],
        [0, 0, -4, 2, 0],
        [0, 0, 4, 0, 1],
        [0, 0, 1e300, 1e299, 1],
        [1.7e308, 0, 1.7e308, 1.7e308, 0.7],
    ]
    rule = HullRule(**ENDS)
    beside = OrientedBoxes.from_xywhr([*rows, *odd], bow=True)
    alone = convert_by_rule(OrientedBoxes.from_xywhr(rows, bow=True), rule)
    xyxy = convert_by_rule(beside, rule)
    np.testing.assert_allclose(xyxy[: len(rows)], alone, rtol=1e-13, atol=tolerance(rows))
    assert np.isnan(xyxy[len(rows) :]).all(axis=1).tolist() == [True] * 4 + [False, True]
    _, extents = centers_and_extents(beside, [rule])
    np.testing.assert_array_equal(np.isnan(extents[:, 0]), np.isnan(xyxy[:, 0]))


def test_many_boxes_of_several_classes_come_out_as_each_alone() -> None:
    random = np.random.default_rng(3)
    rows = random.uniform(1, 100, (2 * BLOCK + 7, 5))
    boxes = OrientedBoxes.from_xywhr(rows, bow=random.random(len(rows)) < 0.5)
    rules = [HullRule('outer'), HullRule(f=0.9, **ENDS), HullRule(s=1.1, q_bow=1.5)]
    rule_of = random.integers(0, 3, len(rows))
    mixed = to_xyxy(*centers_and_extents(boxes, rules, rule_of))
    together = to_xyxy(*centers_and_extents(boxes, rules[1:]))
    np.testing.assert_allclose(together, convert_by_rule(boxes, rules[1]), rtol=1e-12, atol=1e-12)
    for index, rule in enumerate(rules):
        rows_of_rule = rule_of == index
        alone = convert_by_rule(boxes[rows_of_rule], rule)
        np.testing.assert_allclose(mixed[rows_of_rule], alone, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(boxes.center, rows[:, :2])


@pytest.mark.parametrize('name', ['q_bow', 'q_stern'])
@pytest.mark.parametrize('value', [0.99, np.nan, 0.0, -np.inf])
def test_an_exponent_of_an_end_out_of_range_is_an_error_that_names_it(name, value) -> None:
    with pytest.raises(ValueError, match=f'^{name} must be 1 to inf'):
        convert(OrientedBoxes.from_xywhr([SLOPE]), **{name: value})


@pytest.mark.parametrize('count', [0, 1])
def test_no_box_or_one(count) -> None:
    for boxes in (
        OrientedBoxes.from_xywhr([SLOPE] * count, bow=True),
        OrientedBoxes.from_corners(CORNERS * count, bow=True),
    ):
        assert boxes.bow.shape == (count,)
        assert convert(boxes, **ENDS).shape == (count, 4)
