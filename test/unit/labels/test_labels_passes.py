# SPDX-License-Identifier: Apache-2.0
"""A window that moves over an image: what it sees, and where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from obbhbb_ros.labels.passes import inside_image
from obbhbb_ros.labels.passes import pass_over
from obbhbb_ros.study.harbour import harbour


def test_every_ship_is_seen_as_often_as_the_windows_overlap_and_where_it_is() -> None:
    labels = harbour()
    assert labels.size is not None
    seen = list(pass_over(labels, 300, 100))
    assert [top for top, _ in seen] == [0, 100, 200, 300, 400, 468]
    middles = labels.boxes().center
    for top, part in seen:
        assert part.size == (labels.size[0], 300)
        rows = np.flatnonzero((middles[:, 1] >= top) & (middles[:, 1] < top + 300))
        assert part.class_ids == tuple(labels.class_ids[row] for row in rows)
        np.testing.assert_allclose(part.boxes().center, middles[rows] - (0, top))
        assert not any(part.ids)


def test_a_window_larger_than_the_image_sees_all_of_it() -> None:
    labels = harbour()
    ((top, part),) = pass_over(labels, 100_000, 10)
    assert (top, part.size, part.class_ids) == (0, labels.size, labels.class_ids)


def test_without_the_size_of_the_image_there_is_no_pass() -> None:
    with pytest.raises(ValueError, match='no pass without its size'):
        list(pass_over(replace(harbour(), size=None), 10, 10))


@pytest.mark.parametrize(('height', 'step'), [(300, 90), (300, 299), (300, 300), (299, 7), (1, 1)])
def test_every_row_of_the_image_is_flown_over(height: int, step: int) -> None:
    labels = harbour()
    assert labels.size is not None
    tops = [top for top, _ in pass_over(labels, height, step)]
    assert tops[0] == 0
    assert tops[-1] + height == labels.size[1]
    assert tops == sorted({*tops})
    assert max(np.diff(tops)) <= step


def test_a_step_that_skips_rows_is_refused() -> None:
    with pytest.raises(ValueError, match='a step of 41 skips rows'):
        list(pass_over(harbour(), 40, 41))


def test_labels_outside_the_image_are_not_seen() -> None:
    labels = replace(harbour(), size=(400, 350))
    inside = (labels.boxes().center < (400, 350)).all(axis=1)
    assert 0 < inside.sum() < inside.size
    seen = inside_image(labels)
    np.testing.assert_array_equal(seen.corners, labels.corners[inside])
    assert len(inside_image(replace(labels, corners=labels.corners - 1e6)).class_ids) == 0
