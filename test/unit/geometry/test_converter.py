# SPDX-License-Identifier: Apache-2.0
"""convert(): the rules' invariants, the paper's numbers, real ships, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume
from hypothesis import given
from hypothesis import strategies as st
from strategies import FACTOR
from strategies import SIDE
from strategies import Q
from strategies import sides_differ
from strategies import xywhr

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert
from obbhbb_ros.geometry.boxes import BLOCK
from obbhbb_ros.geometry.converter import Caps
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import centers_and_extents
from obbhbb_ros.geometry.converter import convert_with_diagnostics
from obbhbb_ros.geometry.converter import half_extents
from obbhbb_ros.geometry.methods import METHODS

DATA = Path(__file__).parents[2] / 'data'
TUNABLE = [name for name, method in METHODS.items() if method.tunable]
EVEN = [name for name in METHODS if name != 'shape_aware']


def extents(rows, method='superellipse', **parameters):
    """Half-extents (N, 2) of boxes given as xywhr."""
    boxes = OrientedBoxes.from_xywhr(rows)
    return half_extents(boxes, [HullRule(method, **parameters)])


def table(name):
    return np.genfromtxt(DATA / name, delimiter=',', names=True, dtype=float)


def test_shape_aware_is_the_published_program() -> None:
    vectors = table('published_rule_vectors.csv')
    boxes, expected = [], []
    for v in vectors:
        row = [v[k] for k in ('cx', 'cy', 'length', 'width', 'angle_rad')]
        caps = {k: None if np.isnan(v[k]) else float(v[k]) for k in ('max_length', 'max_width')}
        tuned = {k: float(v[k]) for k in 'qfs'}
        ship = OrientedBoxes.from_xywhr([row])
        boxes.append(convert(ship, method='shape_aware', **tuned, **caps)[0])
        expected.append([v[k] for k in ('x_min', 'y_min', 'x_max', 'y_max')])
    assert len(vectors) == 300
    np.testing.assert_allclose(boxes, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ('method', 'parameters', 'mean_iou'),
    [
        ('superellipse', {}, 0.92001),
        ('shape_aware', {'q': 2.2, 'f': 0.9}, 0.82121),
        ('outer', {}, 0.80998),
        ('midpoint', {}, 0.80704),
        ('gaussian', {}, 0.89033),
        ('gaussian_published', {}, 0.38644),
        ('area_equivalent_published', {}, 0.25658),
    ],
)
def test_mean_iou_on_real_ships(method, parameters, mean_iou) -> None:
    ships = table('real_ships.csv')
    corners = np.stack([[ships[f'x{i}'], ships[f'y{i}']] for i in range(1, 5)]).transpose(2, 0, 1)
    drawn = np.stack([ships[k] for k in ('hx1', 'hy1', 'hx2', 'hy2')], axis=1)
    box = convert(OrientedBoxes.from_corners(corners), method=method, **parameters)
    shared = np.minimum(box[:, 2:], drawn[:, 2:]) - np.maximum(box[:, :2], drawn[:, :2])
    shared = np.clip(shared, 0, None).prod(axis=1)
    areas = [(b[:, 2:] - b[:, :2]).prod(axis=1) for b in (box, drawn)]
    assert np.mean(shared / (sum(areas) - shared)) == pytest.approx(mean_iou, abs=5e-5)


@pytest.mark.parametrize('method', METHODS)
@given(rows=xywhr(), q=Q, f=FACTOR)
def test_extents_have_period_pi_and_are_even_in_the_angle(method, rows, q, f) -> None:
    assume(method not in TUNABLE or sides_differ(rows))
    expected = extents(rows, method, q=q, f=f)
    # An error of 1e-15 in the angle turns into so much of a side.
    tolerance = 1e-11 * rows[:, 2:4].max()
    for sign, turns in ((1, 1), (1, -3), (-1, 0), (-1, 2)):
        other = rows * [1, 1, 1, 1, sign] + [0, 0, 0, 0, turns * np.pi]
        _assert_close(extents(other, method, q=q, f=f), expected, tolerance, method, q)


def _assert_close(actual, expected, tolerance, method, q):
    """Compare; the published rule's root is steep near q = 1, where it is left out."""
    if method == 'shape_aware' and 1.0 < q < 1.01:
        return
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=max(tolerance * 100, 1e-12))


@pytest.mark.parametrize('method', EVEN)
@given(rows=xywhr(), q=Q, f=FACTOR)
def test_swapping_the_sides_with_a_quarter_turn_changes_nothing(method, rows, q, f) -> None:
    assume(sides_differ(rows))
    turned = rows[:, [0, 1, 3, 2, 4]] + [0, 0, 0, 0, np.pi / 2]
    tolerance = 1e-9 * rows[:, 2:4].max()
    np.testing.assert_allclose(
        extents(turned, method, q=q, f=f),
        extents(rows, method, q=q, f=f),
        rtol=1e-9,
        atol=tolerance,
    )


@pytest.mark.parametrize('method', METHODS)
@given(rows=xywhr(), q=Q, f=FACTOR, shift=st.integers(-1000, 1000))
def test_a_shifted_box_gives_the_shifted_result(method, rows, q, f, shift) -> None:
    moved = rows + [shift, -shift, 0, 0, 0]
    np.testing.assert_array_equal(extents(moved, method, q=q, f=f), extents(rows, method, q=q, f=f))
    boxes, other = OrientedBoxes.from_xywhr(rows), OrientedBoxes.from_xywhr(moved)
    difference = convert(other, method=method, q=q, f=f) - convert(boxes, method=method, q=q, f=f)
    np.testing.assert_allclose(difference, [[shift, -shift] * 2] * len(rows), atol=1e-9)


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('scale', [2.0**-7, 0.5, 2.0**13])
@given(rows=xywhr(), q=Q, f=FACTOR)
def test_a_scaled_box_gives_the_scaled_result(method, scale, rows, q, f) -> None:
    scaled = rows * [scale, scale, scale, scale, 1]
    np.testing.assert_allclose(
        extents(scaled, method, q=q, f=f), scale * extents(rows, method, q=q, f=f), rtol=1e-12
    )


@given(rows=xywhr(), q=Q)
def test_midpoint_lies_in_superellipse_lies_in_outer(rows, q) -> None:
    inner, hull, outer = (
        extents(rows, method, q=q) for method in ('midpoint', 'superellipse', 'outer')
    )
    assert (inner <= hull * (1 + 1e-12)).all()
    assert (hull <= outer * (1 + 1e-12)).all()


@pytest.mark.parametrize('method', TUNABLE)
@given(rows=xywhr(), q=Q, more=Q, f=FACTOR)
def test_a_fuller_hull_never_shrinks_the_box(method, rows, q, more, f) -> None:
    low, high = sorted((q, more))
    assert (
        extents(rows, method, q=low, f=f) <= extents(rows, method, q=high, f=f) * (1 + 1e-9)
    ).all()


@given(rows=xywhr(), q=Q, f=FACTOR)
def test_the_published_curve_lies_inside_the_superellipse_by_at_most_15_percent(rows, q, f) -> None:
    published = extents(rows, 'shape_aware', q=q, f=f)
    hull = extents(rows, 'superellipse', q=q, f=f)
    assert (published <= hull * (1 + 1e-9)).all()
    assert (published >= 0.845 * hull).all()


@pytest.mark.parametrize('method', TUNABLE)
@pytest.mark.parametrize(
    ('near', 'limit'), [(1 + 1e-7, 1.0), (1e9, np.inf), (1e20, np.inf), (1e300, np.inf)]
)
@given(rows=xywhr())
def test_the_limits_of_q_are_reached(method, near, limit, rows) -> None:
    np.testing.assert_allclose(
        extents(rows, method, q=near), extents(rows, method, q=limit), rtol=1e-5
    )


@given(rows=xywhr(), q=st.floats(1.0 + 1e-12, 1.0 + 1e-3))
def test_q_next_to_one_does_not_overflow(rows, q) -> None:
    for method in TUNABLE:
        assert np.isfinite(extents(rows, method, q=q)).all()


@pytest.mark.parametrize(
    ('q', 'same_as'), [(1.0, 'midpoint'), (2.0, 'gaussian'), (np.inf, 'outer')]
)
@given(rows=xywhr())
def test_superellipse_holds_the_simple_rules_as_special_cases(q, same_as, rows) -> None:
    np.testing.assert_allclose(extents(rows, q=q), extents(rows, same_as), rtol=1e-12)


@given(side=SIDE, q=Q, theta=st.floats(-4, 4))
def test_superellipse_is_continuous_where_length_meets_width(side, q, theta) -> None:
    rows = np.array([[0, 0, side, side * k, theta] for k in (1 - 1e-9, 1, 1 + 1e-9)])
    low, middle, high = extents(rows, q=q)
    np.testing.assert_allclose(low, middle, rtol=1e-7, atol=1e-7 * side)
    np.testing.assert_allclose(high, middle, rtol=1e-7, atol=1e-7 * side)


@given(rows=xywhr(), q=Q, f=FACTOR)
def test_superellipse_touches_a_finely_sampled_hull(rows, q, f) -> None:
    assume(1.05 < q < 20)
    width, height, theta = rows[0, 2:]
    a, b = max(width, height) / 2, min(width, height) / 2 * f
    angle = theta + (np.pi / 2 if height > width else 0)
    t = np.linspace(0, 2 * np.pi, 20001)
    u = a * np.sign(np.cos(t)) * np.abs(np.cos(t)) ** (2 / q)
    v = b * np.sign(np.sin(t)) * np.abs(np.sin(t)) ** (2 / q)
    reach_x = np.max(u * np.cos(angle) - v * np.sin(angle))
    reach_y = np.max(u * np.sin(angle) + v * np.cos(angle))
    expected = extents(rows[:1], q=q, f=f)[0]
    assert (np.array([reach_x, reach_y]) <= expected * (1 + 1e-9)).all()
    np.testing.assert_allclose([reach_x, reach_y], expected, rtol=5e-3)


@given(rows=xywhr(), s=FACTOR)
def test_shrink_scales_the_extents_of_tunable_methods_only(rows, s) -> None:
    for name, method in METHODS.items():
        factor = s if method.tunable else 1.0
        np.testing.assert_allclose(extents(rows, name, s=s), factor * extents(rows, name))


def test_area_equivalent_keeps_the_area_and_the_shape_of_the_outer_box() -> None:
    rows = np.array([[0, 0, 60, 20, 0.7], [0, 0, 9, 9, 0.1]])
    kept, outer = extents(rows, 'area_equivalent'), extents(rows, 'outer')
    np.testing.assert_allclose(4 * kept.prod(axis=1), rows[:, 2] * rows[:, 3])
    np.testing.assert_allclose(kept[:, 0] / kept[:, 1], outer[:, 0] / outer[:, 1])


@pytest.mark.parametrize(
    ('method', 'expected'),
    [('gaussian_published', [10, 30]), ('area_equivalent_published', [30, 10])],
)
@pytest.mark.parametrize('theta', [0.0])
def test_the_published_baselines_have_their_published_faults(method, expected, theta) -> None:
    np.testing.assert_allclose(extents([[0, 0, 60, 20, theta]], method)[0], expected, atol=1e-9)


def test_outer_is_the_minimum_and_maximum_of_corners_rounded_to_pixels() -> None:
    corners = np.array([[[54, 249], [152, 229], [157, 252], [58, 272]]], float)
    expected = np.hstack((corners.min(axis=1), corners.max(axis=1)))
    np.testing.assert_allclose(
        convert(OrientedBoxes.from_corners(corners), method='outer'), expected
    )


@given(rows=xywhr(), length=SIDE, width=SIDE)
def test_caps_bound_the_longer_and_the_shorter_side(rows, length, width) -> None:
    boxes = OrientedBoxes.from_xywhr(rows)
    free = 2.0 * half_extents(boxes, [HullRule()])
    capped = 2.0 * half_extents(boxes, [HullRule()], caps=Caps(length, width))
    limit = np.where(free[:, :1] >= free[:, 1:], [length, width], [width, length])
    np.testing.assert_array_equal(capped, np.minimum(free, limit))
    xyxy = convert(boxes, max_length=length, max_width=width)
    np.testing.assert_allclose(xyxy[:, 2:] - xyxy[:, :2], capped, atol=1e-9)


@pytest.mark.parametrize('count', [0, 1, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK + 7])
def test_the_size_of_the_batch_does_not_change_a_box(count) -> None:
    rows = np.random.default_rng(7).uniform(1, 100, (count, 5))
    whole = convert(OrientedBoxes.from_xywhr(rows), q=2.7, f=0.9)
    assert whole.shape == (count, 4)
    for i in {0, count // 2, count - 1} & set(range(count)):
        alone = convert(OrientedBoxes.from_xywhr(rows[i : i + 1]), q=2.7, f=0.9)
        np.testing.assert_allclose(whole[i], alone[0], rtol=1e-14)


@pytest.mark.parametrize('method', METHODS)
@given(rows=xywhr(15), q=Q, f=FACTOR, s=FACTOR)
def test_a_few_boxes_come_out_as_among_many(method, rows, q, f, s) -> None:
    rule = HullRule(method, q, f, s)
    alone = half_extents(OrientedBoxes.from_xywhr(rows), [rule])
    among = half_extents(OrientedBoxes.from_xywhr(np.tile(rows, (16, 1))), [rule])
    np.testing.assert_allclose(among, np.tile(alone, (16, 1)), rtol=1e-13, atol=1e-12)


@given(rows=xywhr(), q=Q)
def test_each_class_has_its_own_rule(rows, q) -> None:
    rules = [HullRule('outer'), HullRule('superellipse', q, 0.8), HullRule('midpoint')]
    rule_of = np.arange(len(rows)) % 3
    boxes = OrientedBoxes.from_xywhr(rows)
    mixed = half_extents(boxes, rules, rule_of)
    for i in range(len(rows)):
        alone = half_extents(boxes[i], [rules[rule_of[i]]])
        np.testing.assert_allclose(mixed[i], alone[0], rtol=1e-14)


def test_invalid_rows_come_back_as_nan_and_the_others_as_boxes() -> None:
    boxes = OrientedBoxes.from_xywhr(
        [[0, 0, 4, 2, 0], [0, 0, np.nan, 2, 0], [0, 0, -4, 2, 0], [0, 0, 0, 2, 0]]
    )
    xyxy = convert(boxes)
    np.testing.assert_array_equal(np.isnan(xyxy).all(axis=1), ~boxes.valid)
    np.testing.assert_allclose(xyxy[0], [-2, -1, 2, 1])


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize(
    'row',
    [
        [np.nan, 0, 4, 2, 0],
        [0, 0, 4, 2, np.inf],
        [0, 0, -4, 2, 0],
        [0, 0, 1e300, 1e300, 1],
        [0, 0, 1e-200, 1e-200, 1],
    ],
)
@given(rows=xywhr(), q=st.one_of(Q, st.floats(1.0, 1e308)))
def test_a_box_out_of_the_ordinary_does_not_change_the_others(method, row, rows, q) -> None:
    alone, beside = OrientedBoxes.from_xywhr(rows), OrientedBoxes.from_xywhr([*rows, row])
    assert alone.regular
    assert not beside.regular
    expected = convert(alone, method=method, q=q)
    np.testing.assert_allclose(
        convert(beside, method=method, q=q)[:-1], expected, rtol=1e-13, atol=1e-9
    )
    rules = [HullRule(method, q)]
    among = half_extents(beside, rules)[:-1]
    np.testing.assert_allclose(among, half_extents(alone, rules), rtol=1e-13)
    # And so for corners.
    alone = OrientedBoxes.from_corners(alone.corners)
    beside = OrientedBoxes.from_corners(beside.corners)
    assert not beside.regular
    expected = convert(alone, method=method, q=q)
    np.testing.assert_allclose(
        convert(beside, method=method, q=q)[:-1], expected, rtol=1e-13, atol=1e-9
    )


@pytest.mark.parametrize('method', METHODS)
def test_a_result_that_overflows_is_nan_not_infinite(method) -> None:
    boxes = OrientedBoxes.from_xywhr([[1.7e308, 0, 1.7e308, 1.7e308, 0.7], [0, 0, 4, 2, 0]])
    xyxy = convert(boxes, method=method)
    assert np.isnan(xyxy[0]).all()
    assert np.isfinite(xyxy[1]).all()
    assert np.isnan(half_extents(boxes, [HullRule(method)])[0]).all()


@pytest.mark.parametrize(
    ('argument', 'value'),
    [
        ('method', 'magic'),
        ('q', 0.99),
        ('q', np.nan),
        ('q', -np.inf),
        ('f', 0.0),
        ('f', 2.01),
        ('s', -1.0),
        ('s', np.nan),
        ('max_length', 0.0),
        ('max_width', -3.0),
        ('max_length', np.nan),
    ],
)
def test_a_parameter_out_of_range_is_an_error_that_names_it(argument, value) -> None:
    with pytest.raises(ValueError, match=f'^{argument} must'):
        convert(OrientedBoxes.from_xywhr([[0, 0, 4, 2, 0]]), **{argument: value})


@pytest.mark.parametrize('argument', ['q', 'f', 's', 'q_bow', 'max_length'])
def test_a_parameter_that_is_no_number_is_an_error_that_names_it(argument) -> None:
    with pytest.raises(TypeError, match=f"^{argument} must be a number, not '3'"):
        convert(OrientedBoxes.from_xywhr([[0, 0, 4, 2, 0]]), **{argument: '3'})


@pytest.mark.parametrize('boxes', [np.zeros((3, 5)), [[0, 0, 4, 2, 0]], None], ids=type)
@pytest.mark.parametrize(
    'function', [convert, lambda boxes: centers_and_extents(boxes, [HullRule()])]
)
def test_anything_but_oriented_boxes_is_an_error_that_says_what_to_pass(function, boxes) -> None:
    with pytest.raises(TypeError, match=r'OrientedBoxes, not .*OrientedBoxes\.from_xywhr'):
        function(boxes)


def test_the_options_of_convert_are_named() -> None:
    with pytest.raises(TypeError, match='positional'):
        convert(OrientedBoxes.from_xywhr([[0, 0, 4, 2, 0]]), 'outer')


def test_diagnostics_are_those_of_algorithm_1() -> None:
    length, width, theta, q, f = 60.0, 20.0, 1.2, 2.2, 0.9
    boxes = OrientedBoxes.from_xywhr([[0, 0, length, width, theta], [0, 0, 4, np.nan, 0]])
    conversion = convert_with_diagnostics(
        boxes, HullRule('shape_aware', q, f), Caps(max_length=40.0)
    )
    k = q * f * width / length
    t_x = min(1.0, (np.cos(theta) / np.sin(theta) / k) ** (1 / (q - 1)))
    assert (conversion.length[0], conversion.width[0], conversion.theta[0]) == pytest.approx(
        (60, 20, 1.2)
    )
    assert (conversion.t_x[0], conversion.t_y[0]) == pytest.approx((t_x, 1.0))
    assert conversion.capped.tolist() == [True, False]
    assert conversion.valid.tolist() == [True, False]
    assert np.isnan([conversion.t_x[1], conversion.t_y[1], conversion.length[1]]).all()


@pytest.mark.parametrize('method', ['superellipse', 'shape_aware', 'outer', 'midpoint', 'gaussian'])
@given(
    length=st.floats(10.0, 500.0),
    aspect=st.floats(1.1, 12.0),
    theta=st.floats(0.01, 1.56),
    q=st.floats(1.2, 20.0),
)
def test_the_contact_is_how_fast_the_extent_grows_with_the_length(
    method, length, aspect, theta, q
) -> None:
    direction = np.array([np.cos(theta), np.sin(theta)])
    row = np.array([[0.0, 0.0, length, length / aspect, theta]])
    step = 1e-6 * length
    longer, shorter = row + [0, 0, step, 0, 0], row - [0, 0, step, 0, 0]
    slope = (extents(longer, method, q=q) - extents(shorter, method, q=q))[0] / (step * direction)
    # The rule may turn a corner just here; there is no slope to compare with then.
    corner = np.abs(np.tan(theta) - [aspect, 1 / aspect, aspect / q, q / aspect])
    assume(corner.min() > 1e-4)
    conversion = convert_with_diagnostics(OrientedBoxes.from_xywhr(row), HullRule(method, q))
    np.testing.assert_allclose([conversion.t_x[0], conversion.t_y[0]], slope, atol=1e-4)
