# SPDX-License-Identifier: Apache-2.0
"""Oriented boxes and the reference boxes of another source."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fleets import labels
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.study.matching import match_boxes
from obbhbb_ros.study.matching import match_references


def make(image: str, *xyxy: tuple[float, ...]) -> ImageLabels:
    """Label an image with upright boxes whose reference is the box itself."""
    return labels(image, xyxy, np.array(xyxy, float))


def unmatched(images: tuple[ImageLabels, ...]) -> list[tuple[str, int]]:
    """List the boxes without a reference, by image and row."""
    return [
        (image.image, row)
        for image in images
        for row, reference in enumerate(image.reference)
        if np.isnan(reference).any()
    ]


def test_boxes_take_the_reference_of_the_same_image() -> None:
    boxes = [make('b', (0, 0, 10, 4)), make('a', (0, 0, 10, 4), (20, 0, 30, 4))]
    references = [
        make('train/a.png', (20, 0, 30, 5), (1, 0, 10, 4)),
        make('b.JPG', (0, 0, 9, 4)),
    ]
    matched = match_references(boxes, references)
    assert [each.image for each in matched] == ['b', 'a']
    assert matched[0].reference.tolist() == [[0, 0, 9, 4]]
    assert matched[1].reference.tolist() == [[1, 0, 10, 4], [20, 0, 30, 5]]
    assert unmatched(matched) == []


def test_boxes_and_references_without_a_partner_stay_alone() -> None:
    boxes = [make('a', (0, 0, 10, 4), (50, 50, 60, 60)), make('lone', (0, 0, 1, 1))]
    references = [make('a', (0, 0, 10, 4), (90, 90, 99, 99)), make('c', (1, 1, 2, 2))]
    matched = match_references(boxes, references)
    assert matched[0].reference[0].tolist() == [0, 0, 10, 4]
    assert np.isnan(matched[0].reference).tolist() == [[False] * 4, [True] * 4]
    assert unmatched(matched) == [('a', 1), ('lone', 0)]


def test_the_best_pair_is_matched_first() -> None:
    boxes = [make('a', (0, 0, 10, 10), (2, 0, 12, 10))]
    matched = match_references(boxes, [make('a', (2, 0, 12, 10))])
    assert np.isnan(matched[0].reference[:, 0]).tolist() == [True, False]


def test_at_equal_overlap_the_earlier_goes_first() -> None:
    boxes = [make('a', (0, 0, 10, 10), (0, 0, 10, 10))]
    references = [make('a', (0, 0, 10, 9), (0, 1, 10, 10))]
    matched = match_references(boxes, references)
    assert matched[0].reference.tolist() == [[0, 0, 10, 9], [0, 1, 10, 10]]


@pytest.mark.parametrize(('min_iou', 'left'), [(0.5, []), (0.51, [('a', 0)])])
def test_pairs_below_the_minimum_iou_do_not_match(
    min_iou: float, left: list[tuple[str, int]]
) -> None:
    boxes, references = [make('a', (0, 0, 10, 4))], [make('a', (0, 0, 5, 4))]
    assert unmatched(match_references(boxes, references, min_iou)) == left


def test_a_tilted_box_is_compared_by_its_bounds() -> None:
    tilted = np.array([[[0.0, 5.0], [5.0, 0.0], [10.0, 5.0], [5.0, 10.0]]])
    boxes = [replace(make('a', (0, 0, 10, 10)), corners=tilted)]
    matched = match_references(boxes, [make('a', (0, 0, 10, 10))], 1.0)
    assert unmatched(matched) == []


def test_a_source_may_name_an_image_more_than_once() -> None:
    boxes = [make('a', (0, 0, 10, 4)), make('a', (0, 0, 10, 4))]
    matched = match_references(boxes, [make('a', (0, 0, 10, 4))])
    assert matched[0].reference.tolist() == [[0, 0, 10, 4]]
    assert unmatched(matched) == [('a', 0)]


def test_references_that_are_not_there_match_nothing() -> None:
    bare = labels('a', (0, 0, 10, 4))
    matched = match_references([make('a', (0, 0, 10, 4))], [bare])
    assert unmatched(matched) == [('a', 0)]
    broken = labels('a', (np.nan,) * 4)
    assert unmatched(match_references([broken], [make('a', (0, 0, 1, 1))])) == [('a', 0)]
    assert match_references([], []) == ()


def test_images_of_one_bare_name_are_refused() -> None:
    with pytest.raises(ValueError, match=r"'train/a\.png' and 'val/a\.png' have the same name"):
        match_references([], [make(name, (0, 0, 9, 4)) for name in ('train/a.png', 'val/a.png')])


@pytest.mark.parametrize('min_iou', [0.0, -1.0, 1.5, float('nan')])
def test_the_least_iou_is_above_0_and_at_most_1(min_iou: float) -> None:
    with pytest.raises(ValueError, match='min_iou'):
        match_references([], [], min_iou)


POSITION = st.integers(0, 40)
SIDE = st.integers(1, 20)


@st.composite
def _boxes(draw: st.DrawFn, distinct: bool = False) -> np.ndarray:
    rows = draw(st.lists(st.tuples(POSITION, POSITION, SIDE, SIDE), max_size=12, unique=distinct))
    array = np.array(rows, dtype=np.float64).reshape(-1, 4)
    array[:, 2:] += array[:, :2]
    return array


@given(_boxes(), _boxes(), st.floats(0.05, 1.0))
def test_every_box_and_reference_is_used_once(
    boxes: np.ndarray, references: np.ndarray, min_iou: float
) -> None:
    own, other = match_boxes(boxes, references, min_iou)
    assert len(set(own.tolist())) == len(own) == len(other) == len(set(other.tolist()))


@given(_boxes(distinct=True), st.randoms())
def test_identical_boxes_find_each_other_in_any_order(boxes: np.ndarray, random: object) -> None:
    order = list(range(len(boxes)))
    random.shuffle(order)
    own, other = match_boxes(boxes, boxes[order], 1.0)
    assert len(own) == len(boxes)
    np.testing.assert_array_equal(boxes[own], boxes[order][other])


@given(_boxes(), _boxes())
def test_no_pair_that_is_left_overlaps_enough(boxes: np.ndarray, references: np.ndarray) -> None:
    own, other = match_boxes(boxes, references, 0.3)
    left = np.delete(boxes, own, axis=0), np.delete(references, other, axis=0)
    assert len(match_boxes(*left, 0.3)[0]) == 0
