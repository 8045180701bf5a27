# SPDX-License-Identifier: Apache-2.0
"""
Crop plans: which whole-pixel regions of an image to send, given axis-aligned boxes.

A region is [x0, x1) x [y0, y1) in whole pixels of the image, pixel i covering [i, i + 1).

A plan is made in three steps: each box becomes a region, overlapping regions are merged where that
saves pixels, and the most valuable ones are kept within the limits of the frame. No step depends
on the order of the boxes.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.downlink.merging import MergeRules
from obbhbb_ros.downlink.merging import Pixels
from obbhbb_ros.downlink.merging import merge_regions
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.limits import MAX_INT
from obbhbb_ros.limits import Range
from obbhbb_ros.limits import check_settings
from obbhbb_ros.limits import setting
from obbhbb_ros.wire.image import IMAGE_SIZE_LIMIT

_FARTHEST = 2.0**52
_PIXELS = Range(0, IMAGE_SIZE_LIMIT)


class LeftOut(str, Enum):
    """Why a box has no region in the plan."""

    INVALID = 'invalid'
    OUTSIDE = 'outside_image'
    MIN_SCORE = 'min_score'
    ZERO_WEIGHT = 'zero_weight'
    MAX_COUNT = 'max_count'
    MAX_PIXELS = 'max_pixels'


@dataclass(frozen=True)
class CropSettings:
    """
    How boxes become regions; ValueError if values are out of range or in conflict.

    Regions below `min_size` grow about their centre, at most to the size of the image; regions
    above `max_size` are cut about their centre. Sides are rounded up to `multiple_of`, or down to
    `max_size`; a side that would exceed the image becomes as long as the image. Two regions are
    merged if the region around both has fewer pixels than the two together. A region that exceeds
    the remaining `max_pixels` is left out; less valuable ones that fit are kept.

    Examples
    --------
    >>> CropSettings(padding=-0.1)
    Traceback (most recent call last):
        ...
    ValueError: padding must be 0 to 100, not -0.1
    """

    min_score: float = setting(
        0.0, 'Minimum score of a detection for a crop region. 0: any score.', Range(0.0, 1e6)
    )
    padding: float = setting(
        0.0,
        'Margin on each side of a crop region, as a fraction of the box along that axis.',
        Range(0.0, 100.0),
    )
    padding_px: float = setting(
        0.0,
        'Margin on each side of a crop region, pixels, in addition to padding.',
        Range(0.0, IMAGE_SIZE_LIMIT),
    )
    min_size: int = setting(
        0, 'Minimum side of a crop region, pixels. Smaller regions grow. 0: no minimum.', _PIXELS
    )
    max_size: int = setting(
        0, 'Maximum side of a crop region, pixels. Larger regions are cut. 0: unlimited.', _PIXELS
    )
    multiple_of: int = setting(
        0,
        'Make the sides of crop regions multiples of this, pixels, for example the block size of '
        'the codec. Sides as long as the image are exempt. 0: any size.',
        _PIXELS,
    )
    merge_max_size: int = setting(
        0,
        'Merge crop regions where that saves pixels, up to this side, pixels. 0: never merge.',
        _PIXELS,
    )
    max_count: int = setting(
        0, 'Maximum crop regions per message; the most valuable are kept. 0: unlimited.', _PIXELS
    )
    max_pixels: int = setting(
        0,
        'Maximum total pixels of the crop regions of a message; the most valuable are kept. '
        '0: unlimited.',
        Range(0, MAX_INT),
    )

    def __post_init__(self) -> None:
        """Check every value and their combination."""
        check_settings(self)
        if 0 < self.max_size < self.min_size:
            raise ValueError(
                f'max_size ({self.max_size}) must not be smaller than min_size ({self.min_size})'
            )
        step = max(self.multiple_of, 1)
        if self.max_size and self._largest < max(self.min_size, step):
            raise ValueError(
                f'max_size ({self.max_size}) leaves no multiple_of ({self.multiple_of}) that '
                f'reaches min_size ({self.min_size})'
            )

    @property
    def _largest(self) -> float:
        """The largest side that `max_size` and `multiple_of` allow, pixels."""
        step = max(self.multiple_of, 1)
        return self.max_size // step * step if self.max_size else np.inf


@dataclass(frozen=True, eq=False)
class CropPlan:
    """
    The regions of one frame, most valuable first.

    Attributes
    ----------
    regions : ndarray of int64, shape (M, 4)
        x0, y0, x1, y1 of each region, whole pixels inside the image, upper ends exclusive.
    sources : ndarray of int, shape (K,)
        Rows of the boxes in the regions, region after region, the most valuable of a region
        first. Without merging one per region.
    offsets : ndarray of int, shape (M + 1,)
        Region i contains the boxes `sources[offsets[i]:offsets[i + 1]]`.
    values : ndarray, shape (M,)
        Value of each region, -inf where no box of it has a score.
    left_out : dict of LeftOut to int
        Number of boxes without a region, by reason.
    """

    regions: NDArray[np.int64]
    sources: NDArray[np.intp]
    offsets: NDArray[np.intp]
    values: FloatArray
    left_out: dict[LeftOut, int]

    @property
    def merged(self) -> bool:
        """Whether any region contains several boxes."""
        return len(self.sources) > len(self.regions)

    @property
    def pixels(self) -> int:
        """Pixels of all regions together."""
        return int(_pixels(self.regions.T).sum())

    def groups(self) -> list[list[int]]:
        """List the rows of the boxes in each region."""
        rows, bounds = self.sources.tolist(), self.offsets.tolist()
        return [rows[i:j] for i, j in pairwise(bounds)]


def plan_crops(
    xyxy: FloatArray,
    scores: FloatArray,
    image_size: tuple[int, int],
    settings: CropSettings,
    weights: FloatArray | None = None,
    min_scores: FloatArray | None = None,
) -> CropPlan:
    """
    Plan the regions of one frame.

    The value of a box is its score times its weight, that of a region the sum over its boxes.
    Regions of equal value are sorted by x0, y0, x1, y1, then by the coordinates of their boxes.
    The order of the input matters only for boxes that agree in value and all coordinates.

    Parameters
    ----------
    xyxy : ndarray, shape (N, 4)
        Axis-aligned boxes, pixels; NaN rows are left out.
    scores : ndarray, shape (N,)
        Score of each box; NaN ranks below any number.
    image_size : tuple of int
        Width and height of the image, pixels.
    settings : CropSettings
        Padding, sizes and limits.
    weights : ndarray, shape (N,), optional
        Weight of each box's score, 0 or more; 1 by default. Boxes of weight 0 are left out.
    min_scores : ndarray, shape (N,), optional
        Minimum score for each box, instead of `settings.min_score`.

    Examples
    --------
    >>> xyxy = np.array([[10.2, 20.0, 50.0, 40.0], [200.0, 90.0, 230.0, 99.9], [12, 22, 52, 42]])
    >>> scores = np.array([0.5, 0.6, 0.4])
    >>> plan = plan_crops(xyxy, scores, (640, 480), CropSettings(merge_max_size=128))
    >>> plan.regions.tolist()
    [[10, 20, 52, 42], [200, 90, 230, 100]]
    >>> plan.groups()
    [[0, 2], [1]]
    """
    # One coordinate of all boxes after another, so that everything runs along contiguous memory.
    boxes = np.ascontiguousarray(xyxy.T)
    rows = np.arange(len(xyxy))
    left_out: dict[LeftOut, int] = {}
    # NaN passes through the maximum and compares as false.
    if not np.maximum.reduce(np.abs(boxes), axis=None, initial=0.0) < _FARTHEST:
        rows = np.flatnonzero(np.isfinite(boxes).all(axis=0))
        left_out[LeftOut.INVALID] = len(xyxy) - len(rows)
        # Farther out a double does not resolve a pixel; within, no difference overflows.
        boxes = np.clip(boxes[:, rows], -_FARTHEST, _FARTHEST)
    bounds = np.array((*image_size, *image_size), dtype=np.float64)[:, None]
    # The box itself must be in the image, not only its padding.
    inside = np.concatenate((boxes[2:] > 0.0, boxes[:2] < bounds[:2]))
    if not inside.all():
        meets = np.logical_and.reduce(inside)
        rows, boxes = _filtered(meets, LeftOut.OUTSIDE, rows, boxes, left_out)
    if settings.min_score or min_scores is not None:
        least = settings.min_score if min_scores is None else min_scores[rows]
        # NaN is below any minimum but 0.
        enough = (scores[rows] >= least) | (np.asarray(least) == 0.0)
        rows, boxes = _filtered(enough, LeftOut.MIN_SCORE, rows, boxes, left_out)
    if weights is not None:
        rows, boxes = _filtered(weights[rows] > 0.0, LeftOut.ZERO_WEIGHT, rows, boxes, left_out)
    corners = _regions(boxes, bounds, settings)
    # fmax replaces NaN.
    values = np.fmax(scores[rows] if weights is None else scores[rows] * weights[rows], -np.inf)
    order = _by_value(values, corners, boxes)
    rows, corners, values = rows[order], corners[:, order], values[order]
    offsets = np.arange(len(rows) + 1)
    if settings.merge_max_size and len(rows) > 1:
        corners, rows, offsets, values = _merged(corners, values, rows, image_size, settings)
    too_many = 0 < settings.max_count < corners.shape[1]
    if too_many or 0 < settings.max_pixels < _pixels(corners).sum():
        sizes = np.diff(offsets)
        kept, over = _within_limits(corners, sizes, settings)
        left_out |= over
        rows, corners, values = rows[np.repeat(kept, sizes)], corners[:, kept], values[kept]
        offsets = _offsets(sizes[kept])
    left_out = {reason: count for reason, count in left_out.items() if count}
    return CropPlan(corners.T, rows, offsets, values, left_out)


def _filtered(
    wanted: NDArray[np.bool_],
    reason: LeftOut,
    rows: NDArray[np.intp],
    boxes: FloatArray,
    left_out: dict[LeftOut, int],
) -> tuple[NDArray[np.intp], FloatArray]:
    """Keep the wanted boxes, (4, N), and count the others."""
    left_out[reason] = len(rows) - int(np.count_nonzero(wanted))
    return rows[wanted], boxes[:, wanted]


def _by_value(
    values: FloatArray, corners: NDArray[np.int64], boxes: FloatArray | None = None
) -> NDArray[np.intp]:
    """Sort by descending value, then by corners, then by the boxes before rounding."""
    order = np.argsort(-values, kind='stable')
    ranked = values[order]
    if not (ranked[1:] == ranked[:-1]).any():
        return order
    unrounded = () if boxes is None else tuple(boxes[::-1])
    return np.lexsort((*unrounded, *corners[::-1], -values))


def _merged(
    corners: NDArray[np.int64],
    values: FloatArray,
    rows: NDArray[np.intp],
    image_size: tuple[int, int],
    settings: CropSettings,
) -> tuple[NDArray[np.int64], NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Merge regions in descending value; return corners, sources, offsets, values of the plan."""
    bounds = np.array(image_size, dtype=np.float64)[:, None]

    def fit(low: Pixels, high: Pixels) -> tuple[Pixels, Pixels]:
        fitted = _fit_sizes(low.astype(float), high.astype(float), bounds, settings)
        return fitted[0].astype(low.dtype), fitted[1].astype(low.dtype)

    limit = min(settings.merge_max_size, settings._largest)
    merged, group_of = merge_regions(
        corners, MergeRules(limit, settings.multiple_of, image_size, fit)
    )
    groups = merged.shape[1]
    if groups == len(rows):
        return corners, rows, np.arange(groups + 1), values
    # A box without a score counts only if its whole region has none.
    known = values > -np.inf
    counts = np.bincount(group_of[known], minlength=groups)
    sums = np.bincount(group_of[known], values[known], groups)
    totals: FloatArray = np.where(counts > 0, sums, -np.inf)
    order = _by_value(totals, merged)
    rank = np.argsort(order)[group_of]
    members = np.argsort(rank, kind='stable')
    return merged[:, order], rows[members], _offsets(np.bincount(rank)), totals[order]


def _within_limits(
    corners: NDArray[np.int64], sizes: NDArray[np.intp], settings: CropSettings
) -> tuple[NDArray[np.bool_], dict[LeftOut, int]]:
    """Select regions in order up to the limits of a frame, and count the boxes of the others."""
    kept = np.zeros(len(sizes), np.bool_)
    count, left = settings.max_count or len(sizes), settings.max_pixels or np.inf
    pixels = _pixels(corners).tolist()
    index = 0
    while index < len(sizes) and count:
        if pixels[index] <= left:
            kept[index] = True
            count -= 1
            left -= pixels[index]
        index += 1
    return kept, {
        LeftOut.MAX_PIXELS: int(sizes[:index][~kept[:index]].sum()),
        LeftOut.MAX_COUNT: int(sizes[index:].sum()),
    }


def _offsets(sizes: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return where groups of these sizes start and end."""
    return np.concatenate(([0], np.cumsum(sizes)))


def _pixels(corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count the pixels of each region, (4, N) to (N,)."""
    width, height = corners[2:] - corners[:2]
    return width * height


def _regions(boxes: FloatArray, bounds: FloatArray, settings: CropSettings) -> NDArray[np.int64]:
    """Pad, clip to the image, round outwards and fit to size; all (4, N), `bounds` (4, 1)."""
    if settings.padding or settings.padding_px:
        margin = settings.padding * (boxes[2:] - boxes[:2]) + settings.padding_px
        boxes = np.concatenate((boxes[:2] - margin, boxes[2:] + margin))
    corners = np.minimum(np.maximum(boxes, 0.0), bounds)
    low, high = corners[:2], corners[2:]
    np.floor(low, out=low)
    np.ceil(high, out=high)
    fitted = _fit_sizes(low, high, bounds[:2], settings)
    if fitted[0] is not low:
        corners = np.concatenate(fitted)
    return corners.astype(np.int64)


def _fit_sizes(
    low: FloatArray, high: FloatArray, bounds: FloatArray, settings: CropSettings
) -> tuple[FloatArray, FloatArray]:
    """
    Change sides about their centre to a size that the settings allow, inside the image.

    All are (2, N), whole numbers from 0 to `bounds`.
    """
    given = high - low
    size = np.maximum(given, max(settings.min_size, 1))
    if settings.multiple_of > 1:
        size = np.ceil(size / settings.multiple_of) * settings.multiple_of
    if settings.max_size:
        size = np.minimum(size, settings._largest)
    size = np.minimum(size, bounds)
    unchanged = size == given
    if unchanged.all():
        return low, high
    fitted = np.where(unchanged, low, np.floor((low + high - size) / 2.0))
    fitted = np.minimum(np.maximum(fitted, 0.0), bounds - size)
    return fitted, fitted + size
