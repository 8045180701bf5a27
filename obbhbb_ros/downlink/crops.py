# SPDX-License-Identifier: Apache-2.0
"""
Crop plans: which whole-pixel regions of an image to send, given axis-aligned boxes.

A region is [x0, x1) x [y0, y1) in whole pixels of the image, pixel i covering [i, i + 1).

A plan takes four steps: boxes are selected, each of them becomes a region, overlapping regions are
merged where that saves pixels, and the most valuable ones are kept within the limits of the frame.
No step depends on the order of the boxes.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.downlink.merging import MergeRules
from obbhbb_ros.downlink.merging import merge_regions
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.limits import MAX_INT
from obbhbb_ros.limits import CheckedSettings
from obbhbb_ros.limits import Range
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
    MAX_IMAGES = 'max_images'


@dataclass(frozen=True)
class CropSettings(CheckedSettings):
    """
    How boxes become regions; ValueError if values are out of range or in conflict.

    Regions below `min_size` grow about their centre, at most to the size of the image; regions
    above `max_size` are cut about their centre. Sides are rounded up to `multiple_of`, or down to
    `max_size`; a side that would exceed the image becomes as long as the image. Two regions are
    merged if the region around both has fewer pixels than the two together. A region that exceeds
    what is left of `max_pixels` or `max_images` is left out; less valuable ones that fit are kept.

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
    max_images: float = setting(
        8.0,
        'Maximum total pixels of the crop regions of a message, in times the pixels of the image; '
        'the most valuable are kept. 0: unlimited.',
        Range(0.0, 1e6),
    )

    def __post_init__(self) -> None:
        """Check every value and their combination."""
        super().__post_init__()
        if 0 < self.max_size < self.min_size:
            raise ValueError(
                f'max_size ({self.max_size}) must not be smaller than min_size ({self.min_size})'
            )
        if self.max_size and self.max_side < max(self.min_size, self.multiple_of, 1):
            raise ValueError(
                f'max_size ({self.max_size}) leaves no multiple_of ({self.multiple_of}) that '
                f'reaches min_size ({self.min_size})'
            )

    @property
    def max_side(self) -> float:
        """Maximum side of a region, pixels: a multiple of `multiple_of`, infinite if unlimited."""
        step = max(self.multiple_of, 1)
        return self.max_size // step * step if self.max_size else np.inf

    def pixel_limit(self, image_size: tuple[int, int]) -> tuple[float, LeftOut]:
        """Return how many pixels all regions of an image may have, and which limit that is."""
        by_image = self.max_images * image_size[0] * image_size[1] or np.inf
        by_pixels = self.max_pixels or np.inf
        if by_image < by_pixels:
            return by_image, LeftOut.MAX_IMAGES
        return by_pixels, LeftOut.MAX_PIXELS


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
    bounds = np.array((*image_size, *image_size), dtype=np.float64)[:, None]
    selection = _select(xyxy, scores, bounds, settings, weights, min_scores)
    rows, boxes = selection.rows, selection.boxes
    corners = _regions(boxes, bounds, settings)
    # fmax replaces NaN.
    values = np.fmax(scores[rows] if weights is None else scores[rows] * weights[rows], -np.inf)
    order = _by_value(values, corners, boxes)
    rows, corners, values = rows[order], corners[:, order], values[order]
    plan = CropPlan(corners.T, rows, np.arange(len(rows) + 1), values, selection.left_out)
    if settings.merge_max_size and len(rows) > 1:
        plan = _merged(plan, image_size, settings)
    return _limited(plan, settings.max_count, *settings.pixel_limit(image_size))


class _Selection:
    """The boxes that get a region, as rows and corners (4, N), and how many do not, by reason."""

    def __init__(self, xyxy: FloatArray) -> None:
        # Each coordinate contiguous, as everything runs along one coordinate of all boxes.
        self.boxes = np.ascontiguousarray(xyxy.T)
        self.rows = np.arange(len(xyxy))
        self.left_out: dict[LeftOut, int] = {}

    def keep(self, wanted: NDArray[np.bool_], reason: LeftOut) -> None:
        """Keep the wanted boxes, and count the others."""
        left_out = len(self.rows) - int(np.count_nonzero(wanted))
        if left_out:
            self.left_out[reason] = left_out
            self.rows, self.boxes = self.rows[wanted], self.boxes[:, wanted]


def _select(
    xyxy: FloatArray,
    scores: FloatArray,
    bounds: FloatArray,
    settings: CropSettings,
    weights: FloatArray | None,
    min_scores: FloatArray | None,
) -> _Selection:
    """Select the boxes that get a region; `bounds` are width, height twice, (4, 1)."""
    selection = _Selection(xyxy)
    # NaN passes through the maximum and compares as false; NumPy warns of signalling ones.
    with np.errstate(invalid='ignore'):
        farthest = np.maximum.reduce(np.abs(selection.boxes), axis=None, initial=0.0)
    if not farthest < _FARTHEST:
        selection.keep(np.isfinite(selection.boxes).all(axis=0), LeftOut.INVALID)
        # Farther out a double does not resolve a pixel; within, no difference overflows.
        selection.boxes = np.clip(selection.boxes, -_FARTHEST, _FARTHEST)
    # The box itself must be in the image, not only its padding.
    low, high = selection.boxes[:2], selection.boxes[2:]
    inside = np.concatenate((high > 0.0, low < bounds[:2]))
    if not inside.all():
        selection.keep(np.logical_and.reduce(inside), LeftOut.OUTSIDE)
    if settings.min_score or min_scores is not None:
        minimum = settings.min_score if min_scores is None else min_scores[selection.rows]
        # NaN is below any minimum but 0.
        enough = (scores[selection.rows] >= minimum) | (np.asarray(minimum) == 0.0)
        selection.keep(enough, LeftOut.MIN_SCORE)
    if weights is not None:
        selection.keep(weights[selection.rows] > 0.0, LeftOut.ZERO_WEIGHT)
    return selection


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


def _merged(plan: CropPlan, image_size: tuple[int, int], settings: CropSettings) -> CropPlan:
    """Merge the regions of a plan in which each has one box."""
    bounds = np.array(image_size, dtype=np.float64)[:, None]
    fit = partial(_fit_sizes, bounds=bounds, settings=settings)
    max_side = min(settings.merge_max_size, settings.max_side)
    rules = MergeRules(max_side, settings.multiple_of, image_size, fit)
    merged, group_of = merge_regions(plan.regions.T, rules)
    groups = merged.shape[1]
    if groups == len(plan.regions):
        return plan
    # A box without a score counts only if its whole region has none.
    has_score = plan.values > -np.inf
    scored = group_of[has_score]
    sums = np.bincount(scored, plan.values[has_score], groups)
    values: FloatArray = np.where(np.bincount(scored, minlength=groups) > 0, sums, -np.inf)
    order = _by_value(values, merged)
    rank = np.argsort(order)[group_of]
    sources = plan.sources[np.argsort(rank, kind='stable')]
    offsets = _offsets(np.bincount(rank))
    return CropPlan(merged[:, order].T, sources, offsets, values[order], plan.left_out)


def _limited(plan: CropPlan, max_count: int, max_pixels: float, reason: LeftOut) -> CropPlan:
    """Keep the regions, in order of value, that are within the limits of a frame."""
    is_too_many = 0 < max_count < len(plan.regions)
    if not is_too_many and plan.pixels <= max_pixels:
        return plan
    kept, end = _within_limits(_pixels(plan.regions.T).tolist(), max_count, max_pixels)
    sizes = np.diff(plan.offsets)
    over_pixels, over_count = sizes[:end][~kept[:end]].sum(), sizes[end:].sum()
    over = {reason: int(over_pixels), LeftOut.MAX_COUNT: int(over_count)}
    left_out = plan.left_out | {why: count for why, count in over.items() if count}
    regions, sources = plan.regions.T[:, kept].T, plan.sources[np.repeat(kept, sizes)]
    return CropPlan(regions, sources, _offsets(sizes[kept]), plan.values[kept], left_out)


def _within_limits(
    pixels: list[int], max_count: int, pixels_left: float
) -> tuple[NDArray[np.bool_], int]:
    """Select regions up to the limits; also return the index at which the count is reached."""
    kept = np.zeros(len(pixels), np.bool_)
    count_left = max_count or len(pixels)
    for index, size in enumerate(pixels):
        if not count_left:
            return kept, index
        if size <= pixels_left:
            kept[index] = True
            count_left -= 1
            pixels_left -= size
    return kept, len(pixels)


def _offsets(sizes: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the starts of groups of these sizes, and the end of the last, (M + 1,)."""
    return np.concatenate(([0], np.cumsum(sizes)))


def _pixels(corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count the pixels of each region, (4, N) to (N,)."""
    width, height = corners[2:] - corners[:2]
    return width * height


def _regions(boxes: FloatArray, bounds: FloatArray, settings: CropSettings) -> NDArray[np.int64]:
    """Pad boxes, clip them to the image, round them outwards and fit their size; all (4, N)."""
    if settings.padding or settings.padding_px:
        margin = settings.padding * (boxes[2:] - boxes[:2]) + settings.padding_px
        boxes = np.concatenate((boxes[:2] - margin, boxes[2:] + margin))
    corners = np.minimum(np.maximum(boxes, 0.0), bounds)
    np.floor(corners[:2], out=corners[:2])
    np.ceil(corners[2:], out=corners[2:])
    return _fit_sizes(corners, bounds[:2], settings).astype(np.int64)


def _fit_sizes(corners: NDArray[Any], bounds: FloatArray, settings: CropSettings) -> NDArray[Any]:
    """
    Change the sides of regions about their centres to what the settings allow.

    `corners` are x0, y0, x1, y1, (4, N), whole numbers from 0 to `bounds`, (2, 1), and so is the
    result.
    """
    low, high = corners[:2], corners[2:]
    sides = high - low
    size = np.maximum(sides, max(settings.min_size, 1))
    if settings.multiple_of > 1:
        size = np.ceil(size / settings.multiple_of) * settings.multiple_of
    if settings.max_size:
        size = np.minimum(size, settings.max_side)
    size = np.minimum(size, bounds)
    unchanged = size == sides
    if unchanged.all():
        return corners
    fitted = np.where(unchanged, low, np.floor((low + high - size) / 2.0))
    fitted = np.minimum(np.maximum(fitted, 0.0), bounds - size)
    return np.concatenate((fitted, fitted + size))
