"""plan_crops(): regions that lie in the image, hold their boxes, and keep to the limits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.crops import CropSettings
from obbhbb_ros.crops import LeftOut
from obbhbb_ros.crops import plan_crops

IMAGE = (640, 480)
COORDINATE = st.one_of(st.floats(-50.0, 700.0), st.floats(allow_nan=False, allow_infinity=False))


@st.composite
def frames(draw):
    """Draw boxes (some far out, some NaN) with scores."""
    corners = draw(st.lists(st.tuples(COORDINATE, COORDINATE, COORDINATE, COORDINATE), max_size=12))
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
    low, high = sorted((draw(st.integers(0, 200)), draw(st.integers(0, 900))))
    return CropSettings(
        padding=draw(st.floats(0, 3)),
        padding_px=draw(st.floats(0, 300)),
        min_size=low,
        max_size=draw(st.sampled_from([0, high])),
        max_count=draw(st.integers(0, 6)),
    )


NO_LIMITS = CropSettings()


def plan(xyxy, settings=NO_LIMITS, scores=None, image=IMAGE):
    xyxy = np.array(xyxy, dtype=float)
    scores = np.ones(len(xyxy)) if scores is None else np.array(scores, dtype=float)
    return plan_crops(xyxy, scores, image, settings)


@given(frames(), settings())
def test_every_region_lies_in_the_image_and_respects_the_sizes(frame, limits) -> None:
    found = plan_crops(*frame, IMAGE, limits)
    low, high = found.regions[:, :2], found.regions[:, 2:]
    assert (low >= 0).all()
    assert (high <= IMAGE).all()
    sides = high - low
    assert (sides >= np.minimum(np.maximum(limits.min_size, 1), IMAGE)).all()
    if limits.max_size:
        assert (sides <= limits.max_size).all()


@given(frames(), settings())
def test_every_box_is_planned_or_left_out_for_a_reason(frame, limits) -> None:
    found = plan_crops(*frame, IMAGE, limits)
    assert len(found.regions) + sum(found.left_out.values()) == len(frame[0])
    assert len(set(found.sources.tolist())) == len(found.sources)


@given(frames(), settings())
def test_the_most_valuable_come_first_and_stay_under_the_count(frame, limits) -> None:
    xyxy, scores = frame
    found = plan_crops(xyxy, scores, IMAGE, limits)
    value = np.nan_to_num(scores[found.sources], nan=-1.0)
    assert (np.diff(value) <= 0).all()
    if limits.max_count:
        assert len(found.regions) <= limits.max_count


@given(frames(), st.floats(0, 3), st.floats(0, 50))
def test_without_a_size_limit_a_region_holds_all_of_its_box_that_is_in_the_image(
    frame, padding, pixels
) -> None:
    xyxy, scores = frame
    found = plan_crops(xyxy, scores, IMAGE, CropSettings(padding=padding, padding_px=pixels))
    visible = np.clip(xyxy[found.sources], 0, np.tile(IMAGE, 2))
    assert (found.regions[:, :2] <= visible[:, :2]).all()
    assert (found.regions[:, 2:] >= visible[:, 2:]).all()


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
    ],
)
def test_padding_clipping_rounding_and_sizes(limits, region) -> None:
    assert plan([[10.2, 20.0, 30.8, 40.7]], limits).regions.tolist() == [region]


def test_a_region_grown_at_the_edge_is_moved_inside() -> None:
    found = plan([[630.0, 2.0, 639.0, 8.0]], CropSettings(min_size=64))
    assert found.regions.tolist() == [[576, 0, 640, 64]]


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
    found = plan([box, [1, 1, 5, 5]], CropSettings(padding_px=100.0))
    assert found.sources.tolist() == [1]
    assert found.left_out == {reason: 1}


def test_equal_scores_keep_the_order_of_the_boxes_and_nan_is_last() -> None:
    boxes = [[i, 0, i + 5, 5] for i in range(5)]
    found = plan(boxes, CropSettings(max_count=4), scores=[0.5, np.nan, 0.9, 0.5, 0.9])
    assert found.sources.tolist() == [2, 4, 0, 3]
    assert found.left_out == {LeftOut.MAX_COUNT: 1}


def test_no_boxes_give_an_empty_plan() -> None:
    found = plan(np.empty((0, 4)))
    assert found.regions.shape == (0, 4)
    assert found.left_out == {}


@pytest.mark.parametrize(
    ('field', 'value'),
    [('padding', -0.1), ('padding', np.nan), ('padding_px', np.inf), ('min_size', -1),
     ('max_count', -2)],
)
def test_a_setting_out_of_range_is_an_error_that_names_it(field, value) -> None:
    with pytest.raises(ValueError, match=f'^{field} must'):
        CropSettings(**{field: value})


def test_a_largest_size_below_the_smallest_is_an_error_that_tells_both() -> None:
    with pytest.raises(ValueError, match=r'max_size \(10\) .* min_size \(20\)'):
        CropSettings(min_size=20, max_size=10)
