# SPDX-License-Identifier: Apache-2.0
"""A window that moves over an image: what it sees, and where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from obbhbb_ros.labels.passes import pass_over
from obbhbb_ros.study.harbour import harbour


def test_every_ship_is_seen_as_often_as_the_windows_overlap_and_where_it_is() -> None:
    labels = harbour()
    assert labels.size is not None
    seen = list(pass_over(labels, 300, 100))
    assert [top for top, _ in seen] == [0, 100, 200, 300, 400]
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
