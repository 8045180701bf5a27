# SPDX-License-Identifier: Apache-2.0
"""The hull of run-length encoded masks."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
import shapely
from hypothesis import given
from hypothesis.extra import numpy as hnp

from obbhbb_ros.labels.masks import coco_mask_ring
from obbhbb_ros.labels.masks import listed_runs
from obbhbb_ros.labels.masks import mask_ring

MASKS = hnp.arrays(np.bool_, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12))


def _runs(mask: npt.NDArray[np.bool_]) -> list[int]:
    """Encode along the rows."""
    changes = np.flatnonzero(np.diff(mask.ravel(), prepend=False))
    return np.diff(changes, prepend=0, append=mask.size).tolist()


def _compressed(runs: list[int]) -> str:
    """Compress as the COCO API does."""
    text = ''
    for index, run in enumerate(runs):
        rest = run - (runs[index - 2] if index > 2 else 0)
        more = True
        while more:
            bits = rest & 31
            rest >>= 5
            more = rest != (-1 if bits & 16 else 0)
            text += chr(48 + bits + 32 * more)
    return text


def _hull(mask: npt.NDArray[np.bool_]) -> shapely.Polygon:
    rows, columns = np.nonzero(mask)
    return shapely.union_all(shapely.box(columns, rows, columns + 1, rows + 1)).convex_hull


@given(MASKS.filter(np.any))
def test_the_ring_is_the_hull_of_the_pixels(mask: npt.NDArray[np.bool_]) -> None:
    height, width = mask.shape
    expected = _hull(mask)
    along_rows = mask_ring(_runs(mask), width, height)[:, ::-1]
    assert shapely.Polygon(along_rows).equals(expected)
    runs = _runs(mask.T)
    for counts in (runs, _compressed(runs)):
        ring = coco_mask_ring({'size': [height, width], 'counts': counts})
        assert shapely.Polygon(ring).equals(expected)


def test_masks_as_datumaro_writes_them() -> None:
    text = 'TUW1d0\\h' + '0' * 78 + 'ljVf0'
    expected = shapely.box(50, 100, 90, 120)
    ring = coco_mask_ring({'size': [800, 1000], 'counts': text})
    assert shapely.Polygon(ring).equals(expected)
    rows = listed_runs('100050, 40, ' + '960, 40, ' * 19 + '680910')
    assert shapely.Polygon(mask_ring(rows, 1000, 800)[:, ::-1]).equals(expected)


def test_a_mask_as_large_as_a_country_is_not_unpacked() -> None:
    side = 1 << 24
    ring = coco_mask_ring({'size': [side, side], 'counts': [0, side * side]})
    assert shapely.Polygon(ring).bounds == (0, 0, side, side)


@pytest.mark.parametrize(
    ('size', 'counts', 'message'),
    [
        ([2, 2], [4], 'the mask is empty'),
        ([2, 2], [], 'do not fill 2 x 2'),
        ([2, 2], [1, 2], 'do not fill 2 x 2'),
        ([2, 2], [-1, 5], 'do not fill 2 x 2'),
        ([2, 2], [1, 2.5], 'not whole numbers'),
        ([2, 2], [True, 3], 'not whole numbers'),
        ([2, 2], None, 'not whole numbers'),
        ([2, 2], {'a': 1}, 'not whole numbers'),
        ([2], [4], 'not height and width'),
        ('22', [4], 'not height and width'),
        ([0, 2], [0], 'cannot have'),
        ([2, 10**30], [4], 'cannot have'),
        ([2, 2.0], [4], 'cannot have'),
        ([2, 2], '0~', "has '~'"),
        ([2, 2], 'ooooooooooooooooooooooo', 'does not belong there'),
        ([2, 2], '1o', 'cut off'),
        ([1 << 20, 1 << 20], [1] * (1 << 20) + [2], 'more than 1048576'),
    ],
)
def test_a_mask_that_cannot_be_read_is_refused(size: object, counts: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        coco_mask_ring({'size': size, 'counts': counts})
