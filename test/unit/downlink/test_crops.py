# SPDX-License-Identifier: Apache-2.0
"""plan_crops(): regions that lie in the image, hold their boxes, and keep to the limits."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.downlink.crops import CropSettings
from obbhbb_ros.downlink.crops import LeftOut
from obbhbb_ros.downlink.crops import plan_crops

IMAGE = (640, 480)
COORDINATE = st.one_of(st.floats(-50.0, 700.0), st.floats(allow_nan=False, allow_infinity=False))
SIDE = st.floats(1.0, 60.0)
SHIP = st.tuples(st.floats(0.0, 150.0), st.floats(0.0, 150.0), SIDE, SIDE).map(
    lambda ship: (ship[0], ship[1], ship[0] + ship[2], ship[1] + ship[3])
)


@st.composite
def frames(draw):
    """Draw boxes (ships, some far out, some NaN) with scores."""
    anything = st.tuples(COORDINATE, COORDINATE, COORDINATE, COORDINATE)
    corners = draw(
        st.one_of(st.lists(SHIP, max_size=12), st.lists(st.one_of(SHIP, anything), max_size=12))
    )
    array = np.array(corners, dtype=float).reshape(-1, 4)
    low, high = np.minimum(array[:, :2], array[:, 2:]), np.maximum(array[:, :2], array[:, 2:])
    xyxy = np.hstack((low, high))
    if len(xyxy) and draw(st.booleans()):
        xyxy[draw(st.integers(0, len(xyxy) - 1))] = np.nan
    score = st.one_of(st.floats(0, 1), st.just(np.nan))
    scores = draw(st.lists(score, min_size=len(xyxy), max_size=len(xyxy)))
    return xyxy, np.array(scores)


@st.composite
def settings(draw):
    """Draw settings that fit together."""
    step = draw(st.sampled_from([0, 1, 2, 7, 8, 16, 100]))
    low, high = sorted((draw(st.integers(0, 200)), draw(st.integers(0, 900))))
    return CropSettings(
        padding=draw(st.floats(0, 3)),
        padding_px=draw(st.floats(0, 300)),
        min_size=low,
        max_size=draw(st.sampled_from([0, high + step])),
        multiple_of=step,
        merge_max_size=draw(st.sampled_from([0, 50, 300, 10**6])),
        max_count=draw(st.integers(0, 6)),
        max_pixels=draw(st.sampled_from([0, 1, 5000, 60_000])),
        max_images=draw(st.sampled_from([0.0, 0.01, 1.0, 8.0])),
    )


NO_LIMITS = CropSettings()


def plan(xyxy, settings=NO_LIMITS, scores=None, image=IMAGE):
    xyxy = np.array(xyxy, dtype=float)
    scores = np.ones(len(xyxy)) if scores is None else np.array(scores, dtype=float)
    return plan_crops(xyxy, scores, image, settings)


@given(frames(), settings())
def test_every_region_lies_in_the_image_and_respects_the_sizes(frame, limits) -> None:
    crop_plan = plan_crops(*frame, IMAGE, limits)
    low, high = crop_plan.regions[:, :2], crop_plan.regions[:, 2:]
    assert (low >= 0).all()
    assert (high <= IMAGE).all()
    sides = high - low
    assert (sides >= np.minimum(np.maximum(limits.min_size, 1), IMAGE)).all()
    if limits.max_size:
        assert (sides <= limits.max_size).all()
    if limits.multiple_of:
        assert ((sides % limits.multiple_of == 0) | (sides == IMAGE)).all()


@given(frames(), settings())
def test_every_box_is_planned_or_left_out_for_a_reason(frame, limits) -> None:
    crop_plan = plan_crops(*frame, IMAGE, limits)
    assert len(crop_plan.sources) + sum(crop_plan.left_out.values()) == len(frame[0])
    assert len(set(crop_plan.sources.tolist())) == len(crop_plan.sources)
    assert [row for group in crop_plan.groups() for row in group] == crop_plan.sources.tolist()
    assert len(crop_plan.groups()) == len(crop_plan.regions)
    assert all(crop_plan.groups())


@given(frames(), settings())
def test_the_most_valuable_come_first_and_stay_under_the_limits(frame, limits) -> None:
    xyxy, scores = frame
    crop_plan = plan_crops(xyxy, scores, IMAGE, limits)
    values = [values_of(scores, group) for group in crop_plan.groups()]
    assert (np.diff([sum(value) for value in values]) <= 1e-9).all()
    assert all((np.diff(value) <= 0).all() for value in values)
    if limits.max_count:
        assert len(crop_plan.regions) <= limits.max_count
    if limits.max_pixels:
        assert crop_plan.pixels <= limits.max_pixels
    if limits.max_images:
        assert crop_plan.pixels <= limits.max_images * IMAGE[0] * IMAGE[1]


def values_of(scores, rows):
    """Give the scores of some boxes; so little for NaN that it only matters alone."""
    return np.nan_to_num(scores[rows], nan=-1e-10)


@given(frames(), settings(), st.randoms(use_true_random=False))
def test_the_plan_does_not_depend_on_the_order_of_the_boxes(frame, limits, random) -> None:
    xyxy, scores = frame
    order = list(range(len(xyxy)))
    random.shuffle(order)
    first = plan_crops(xyxy, scores, IMAGE, limits)
    again = plan_crops(xyxy[order], scores[order], IMAGE, limits)
    np.testing.assert_array_equal(again.regions, first.regions)
    assert again.left_out == first.left_out
    np.testing.assert_array_equal(again.offsets, first.offsets)
    np.testing.assert_array_equal(xyxy[order][again.sources], xyxy[first.sources])
    np.testing.assert_array_equal(scores[order][again.sources], scores[first.sources])


LIMITS = ('max_count', 'max_pixels', 'max_images')


@given(frames(), settings())
def test_merged_regions_cover_their_parts_and_cost_less(frame, limits) -> None:
    limits = replace(limits, **dict.fromkeys(LIMITS, 0))
    merged = plan_crops(*frame, IMAGE, limits)
    parts = plan_crops(*frame, IMAGE, replace(limits, merge_max_size=0))
    part_of = dict(zip(parts.sources.tolist(), parts.regions, strict=True))
    assert set(part_of) == set(merged.sources.tolist())
    for region, group in zip(merged.regions, merged.groups(), strict=True):
        inside = np.array([part_of[row] for row in group])
        assert (region[:2] <= inside[:, :2]).all()
        assert (region[2:] >= inside[:, 2:]).all()
        if len(group) > 1:
            assert pixels(region[None]) < sum(pixels(inside))
        if (region[2:] - region[:2] > limits.merge_max_size).any():
            assert any((part == region).all() for part in inside)


@given(frames(), settings(), st.booleans())
def test_no_two_regions_are_left_that_would_save_pixels_as_one(frame, limits, small) -> None:
    limits = replace(limits, **dict.fromkeys(LIMITS, 0), multiple_of=0, max_size=0)
    if small:
        # So that several are left.
        limits = replace(limits, min_size=0, padding=0.0, padding_px=0.0)
    regions = plan_crops(*frame, IMAGE, limits).regions
    for i, j in combinations(range(len(regions)), 2):
        low = np.minimum(regions[i, :2], regions[j, :2])
        high = np.maximum(regions[i, 2:], regions[j, 2:])
        if (high - low <= limits.merge_max_size).all():
            assert np.prod(high - low) >= sum(pixels(regions[[i, j]]))


@pytest.mark.parametrize('count', [60, 300, 1000])
@pytest.mark.parametrize('side', [300, 1500, 40_000])
@pytest.mark.parametrize('limit', [60, 150, 10**6])
def test_crowds_are_merged_as_far_as_it_pays(count, side, limit) -> None:
    random = np.random.default_rng(count + side)
    center, reach = random.uniform(0, side, (count, 2)), random.uniform(5, 50, (count, 2))
    xyxy = np.clip(np.hstack((center - reach, center + reach)), 0, side)
    crop_plan = plan(xyxy, CropSettings(merge_max_size=limit, max_images=0.0), image=(side, side))
    regions = crop_plan.regions
    low = np.minimum(regions[:, None, :2], regions[:, :2])
    high = np.maximum(regions[:, None, 2:], regions[:, 2:])
    union = np.prod(high - low, axis=2)
    area = pixels(regions)
    saves = (union < area[:, None] + area) & (high - low <= limit).all(axis=2)
    assert np.flatnonzero(saves.sum(axis=1) > 1).size == 0
    assert sorted(crop_plan.sources.tolist()) == list(range(count))


def pixels(regions):
    return np.prod(regions[:, 2:] - regions[:, :2], axis=1)


@given(frames(), st.floats(0, 3), st.floats(0, 50))
def test_without_a_size_limit_a_region_holds_all_of_its_box_that_is_in_the_image(
    frame, padding, pixels
) -> None:
    xyxy, scores = frame
    crop_plan = plan_crops(xyxy, scores, IMAGE, CropSettings(padding=padding, padding_px=pixels))
    visible = np.clip(xyxy[crop_plan.sources], 0, np.tile(IMAGE, 2))
    assert (crop_plan.regions[:, :2] <= visible[:, :2]).all()
    assert (crop_plan.regions[:, 2:] >= visible[:, 2:]).all()


@pytest.mark.parametrize(
    ('limits', 'region'),
    [
        (CropSettings(), [10, 20, 31, 41]),
        (CropSettings(padding=0.5), [0, 9, 42, 52]),
        (CropSettings(padding_px=2.0), [8, 18, 33, 43]),
        (CropSettings(padding=0.1, padding_px=1.0), [7, 16, 34, 44]),
        (CropSettings(min_size=41), [0, 10, 41, 51]),
        (CropSettings(max_size=11), [15, 25, 26, 36]),
        (CropSettings(min_size=500), [0, 0, 500, 480]),
        (CropSettings(multiple_of=16), [4, 14, 36, 46]),
        (CropSettings(multiple_of=16, max_size=31), [12, 22, 28, 38]),
        (CropSettings(multiple_of=16, min_size=33), [0, 6, 48, 54]),
        (CropSettings(multiple_of=450), [0, 0, 450, 450]),
        (CropSettings(multiple_of=500), [0, 0, 500, 480]),
    ],
)
def test_padding_clipping_rounding_and_sizes(limits, region) -> None:
    assert plan([[10.2, 20.0, 30.8, 40.7]], limits).regions.tolist() == [region]


def test_a_region_grown_at_the_edge_is_moved_inside() -> None:
    crop_plan = plan([[630.0, 2.0, 639.0, 8.0]], CropSettings(min_size=64))
    assert crop_plan.regions.tolist() == [[576, 0, 640, 64]]


@pytest.mark.parametrize(
    ('box', 'reason'),
    [
        ([-20, 10, -1, 30], LeftOut.OUTSIDE),
        ([640, 10, 700, 30], LeftOut.OUTSIDE),
        ([10, 481, 30, 490], LeftOut.OUTSIDE),
        ([10, np.nan, 30, 490], LeftOut.INVALID),
        ([np.nan] * 4, LeftOut.INVALID),
    ],
)
def test_what_has_no_pixel_in_the_image_is_left_out_even_if_its_padding_has(box, reason) -> None:
    crop_plan = plan([box, [1, 1, 5, 5]], CropSettings(padding_px=100.0))
    assert crop_plan.sources.tolist() == [1]
    assert crop_plan.left_out == {reason: 1}


def test_equal_scores_go_from_left_to_right_and_nan_is_last() -> None:
    boxes = [[i, 0, i + 5, 5] for i in range(5)]
    crop_plan = plan(boxes, CropSettings(max_count=4), scores=[0.5, np.nan, 0.9, 0.5, 0.9])
    assert crop_plan.sources.tolist() == [2, 4, 0, 3]
    assert crop_plan.left_out == {LeftOut.MAX_COUNT: 1}


def test_the_weight_of_a_box_scales_its_value() -> None:
    boxes = np.array([[i, 0.0, i + 5.0, 5.0] for i in range(3)])
    scores, weights = np.array([0.9, 0.5, np.nan]), np.array([1.0, 2.0, 9.0])
    assert plan_crops(boxes, scores, IMAGE, NO_LIMITS, weights).sources.tolist() == [1, 0, 2]


def test_overlapping_boxes_become_one_region_worth_all_of_them() -> None:
    boxes = [[10, 10, 30, 30], [12, 10, 32, 30], [100, 100, 120, 120], [16, 16, 20, 20]]
    crop_plan = plan(boxes, CropSettings(merge_max_size=1000), scores=[0.4, 0.5, 0.8, 0.3])
    assert crop_plan.regions.tolist() == [[10, 10, 32, 30], [100, 100, 120, 120]]
    assert crop_plan.groups() == [[1, 0, 3], [2]]
    assert crop_plan.merged


@pytest.mark.parametrize(
    ('other', 'limit'),
    [([29, 29, 49, 49], 1000), ([31, 10, 51, 30], 1000), ([12, 10, 32, 30], 21)],
    ids=['the union costs more', 'side by side', 'the union is too large'],
)
def test_regions_stay_apart(other, limit) -> None:
    crop_plan = plan([[10, 10, 30, 30], other], CropSettings(merge_max_size=limit))
    assert crop_plan.groups() == [[0], [1]]
    assert not crop_plan.merged


def test_a_region_within_another_joins_it_whatever_the_limit() -> None:
    crop_plan = plan([[10, 10, 90, 90], [20, 20, 30, 30]], CropSettings(merge_max_size=1))
    assert crop_plan.regions.tolist() == [[10, 10, 90, 90]]
    assert crop_plan.groups() == [[0, 1]]


def test_the_pixels_of_a_frame_are_filled_by_value() -> None:
    boxes = [[0, 0, 10, 10], [20, 0, 50, 30], [60, 0, 65, 5], [80, 0, 85, 5]]
    crop_plan = plan(boxes, CropSettings(max_pixels=130), scores=[0.9, 0.8, 0.7, 0.6])
    assert crop_plan.sources.tolist() == [0, 2]
    assert crop_plan.left_out == {LeftOut.MAX_PIXELS: 2}
    assert crop_plan.pixels == 125


def test_by_default_a_plan_has_the_pixels_of_eight_images_at_most() -> None:
    whole = [[0, 0, *IMAGE]] * 1000
    crop_plan = plan(whole)
    assert crop_plan.pixels == 8 * IMAGE[0] * IMAGE[1]
    assert crop_plan.left_out == {LeftOut.MAX_IMAGES: 992}
    assert len(plan(whole, CropSettings(max_images=0.0)).regions) == 1000


def test_the_smaller_limit_of_pixels_gives_the_reason() -> None:
    boxes = [[0, 0, 10, 10], [20, 0, 30, 10]]
    few = CropSettings(max_pixels=150, max_images=1.0)
    assert plan(boxes, few).left_out == {LeftOut.MAX_PIXELS: 1}
    few = CropSettings(max_pixels=150, max_images=120 / (IMAGE[0] * IMAGE[1]))
    assert plan(boxes, few).left_out == {LeftOut.MAX_IMAGES: 1}


def test_no_boxes_give_an_empty_plan() -> None:
    crop_plan = plan(np.empty((0, 4)))
    assert crop_plan.regions.shape == (0, 4)
    assert crop_plan.left_out == {}


@pytest.mark.parametrize(
    ('field', 'value'),
    [
        ('padding', -0.1),
        ('padding', np.nan),
        ('padding_px', np.inf),
        ('min_size', -1),
        ('max_count', -2),
        ('multiple_of', -8),
        ('merge_max_size', -1),
        ('max_pixels', -1),
        ('max_images', -0.5),
    ],
)
def test_a_setting_out_of_range_is_an_error_that_names_it(field, value) -> None:
    with pytest.raises(ValueError, match=f'^{field} must'):
        CropSettings(**{field: value})


def test_a_largest_size_below_the_smallest_is_an_error_that_tells_both() -> None:
    with pytest.raises(ValueError, match=r'max_size \(10\) .* min_size \(20\)'):
        CropSettings(min_size=20, max_size=10)


@pytest.mark.parametrize(
    'sizes', [{'max_size': 15}, {'max_size': 31, 'min_size': 17}], ids=['none', 'none from 17 on']
)
def test_a_largest_size_below_every_allowed_multiple_is_an_error(sizes) -> None:
    with pytest.raises(ValueError, match=r'leaves no multiple_of \(16\)'):
        CropSettings(multiple_of=16, **sizes)
