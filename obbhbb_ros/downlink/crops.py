# SPDX-License-Identifier: Apache-2.0
"""
Axis-aligned boxes in, crop plan out: which whole-pixel regions of the image are worth sending.

A region is [x0, x1) x [y0, y1) in whole pixels of the image, pixel i covering [i, i + 1).

A plan is made in three steps: each box becomes a region, regions that overlap become one where
that takes fewer pixels, and the limits of the frame are filled by falling value. No step depends
on the order in which the boxes come.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.downlink.merging import MergeRules
from obbhbb_ros.downlink.merging import Pixels
from obbhbb_ros.downlink.merging import merge_regions

_FARTHEST = 2.0**52


class LeftOut(str, Enum):
    """Why a box has no region in the plan."""

    INVALID = 'invalid'
    OUTSIDE = 'outside_image'
    MAX_COUNT = 'max_count'
    MAX_PIXELS = 'max_pixels'


@dataclass(frozen=True)
class CropSettings:
    """
    How boxes become regions.

    Attributes
    ----------
    padding : float
        Added on each side, as a fraction of the box's extent along that axis; 0 or more.
    padding_px : float
        Added on each side after that, pixels; 0 or more.
    min_size : int
        Regions are grown about their centre to at least so many pixels a side; 0 for no bound.
        An image that is smaller bounds them first.
    max_size : int
        Regions are cut about their centre to at most so many pixels a side; 0 for no bound.
    multiple_of : int
        Both sides of a region are multiples of so many pixels, the block of a codec; 0 or 1 for
        any size. Sides are rounded up, or down where `max_size` bounds them. A region that would
        then no longer fit takes the whole side of the image, the only case in which a side is
        no multiple.
    merge_max_size : int
        Regions become one where the region around both has fewer pixels than the two have
        together, and at most so many pixels a side (nor more than `max_size`); 0 for no merging.
    max_count : int
        At most so many regions a frame; 0 for no bound.
    max_pixels : int
        At most so many pixels in the regions of a frame together; 0 for no bound. A region that
        does not fit into what is left is left out, a less valuable one that fits is taken.

    Raises
    ------
    ValueError
        If a value is negative, or no side fits `min_size`, `max_size` and `multiple_of`; the
        message names it.
    """

    padding: float = 0.0
    padding_px: float = 0.0
    min_size: int = 0
    max_size: int = 0
    multiple_of: int = 0
    merge_max_size: int = 0
    max_count: int = 0
    max_pixels: int = 0

    def __post_init__(self) -> None:
        """Check every value and how they fit together."""
        for name, value in vars(self).items():
            if not 0 <= value < np.inf:
                raise ValueError(f'{name} must be finite and not negative, not {value}')
        if 0 < self.max_size < self.min_size:
            raise ValueError(
                f'max_size ({self.max_size}) must not be smaller than min_size ({self.min_size})'
            )
        if 0 < self.max_size < max(self._smallest, self.multiple_of):
            raise ValueError(
                f'max_size ({self.max_size}) leaves no multiple_of ({self.multiple_of}) that '
                f'reaches min_size ({self.min_size})'
            )

    @property
    def _smallest(self) -> int:
        """The smallest side that `multiple_of` allows, pixels."""
        step = max(self.multiple_of, 1)
        return -(-self.min_size // step) * step

    @property
    def _largest(self) -> float:
        """The largest side that `multiple_of` allows, pixels; infinity for any."""
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
        Rows of the boxes that the regions were made from, region after region, the most valuable
        of a region first. Without merging one for each region.
    offsets : ndarray of int, shape (M + 1,)
        Region i was made from `sources[offsets[i]:offsets[i + 1]]`.
    left_out : dict of LeftOut to int
        How many boxes have no region, by reason.
    """

    regions: NDArray[np.int64]
    sources: NDArray[np.intp]
    offsets: NDArray[np.intp]
    left_out: dict[LeftOut, int]

    @property
    def merged(self) -> bool:
        """Whether any region was made from several boxes."""
        return len(self.sources) > len(self.regions)

    @property
    def pixels(self) -> int:
        """Pixels of all regions together."""
        return int(_pixels(self.regions.T).sum())

    def groups(self) -> list[list[int]]:
        """List for each region the rows of the boxes that it was made from."""
        rows, bounds = self.sources.tolist(), self.offsets.tolist()
        return [rows[i:j] for i, j in pairwise(bounds)]


def plan_crops(
    xyxy: FloatArray,
    scores: FloatArray,
    image_size: tuple[int, int],
    settings: CropSettings,
    weights: FloatArray | None = None,
) -> CropPlan:
    """
    Plan the regions of one frame.

    The value of a box is its score times its weight, that of a region the sum over its boxes. Of
    equal values the one further left comes first, then the one further up, then the one whose
    right and lower end come first. Only where boxes agree in value and in all coordinates does
    their order in the input decide, as nothing else tells them apart.

    Parameters
    ----------
    xyxy : ndarray, shape (N, 4)
        Axis-aligned boxes, pixels; NaN rows are left out.
    scores : ndarray, shape (N,)
        Score of each box; NaN counts as less than any number.
    image_size : tuple of int
        Width and height of the image, pixels.
    settings : CropSettings
        Padding, sizes and limits.
    weights : ndarray, shape (N,), optional
        What the score of each box counts, 0 or more; 1 by default.

    Returns
    -------
    CropPlan
        The regions by falling value.
    """
    # All that follows runs along contiguous memory: one coordinate of all boxes after another.
    boxes = np.ascontiguousarray(xyxy.T)
    rows = np.arange(len(xyxy))
    # NaN passes through the maximum, and compares as false.
    if not np.maximum.reduce(np.abs(boxes), axis=None, initial=0.0) < _FARTHEST:
        rows = np.flatnonzero(np.isfinite(boxes).all(axis=0))
        # So far out no pixel is left to tell apart, and no difference below overflows.
        boxes = np.clip(boxes[:, rows], -_FARTHEST, _FARTHEST)
    left_out = {LeftOut.INVALID: len(xyxy) - len(rows)}
    bounds = np.array((*image_size, *image_size), dtype=np.float64)[:, None]
    # A box is worth a region for its own pixels, not for its padding.
    inside = np.concatenate((boxes[2:] > 0.0, boxes[:2] < bounds[:2]))
    if not inside.all():
        meets = np.logical_and.reduce(inside)
        left_out[LeftOut.OUTSIDE] = len(rows) - int(np.count_nonzero(meets))
        rows, boxes = rows[meets], boxes[:, meets]
    corners = _regions(boxes, bounds, settings)
    # NaN is less than any number.
    values = np.fmax(scores[rows] if weights is None else scores[rows] * weights[rows], -np.inf)
    order = _by_value(values, corners, boxes)
    rows, corners = rows[order], corners[:, order]
    offsets = np.arange(len(rows) + 1)
    if settings.merge_max_size and len(rows) > 1:
        corners, rows, offsets = _merged(corners, values[order], rows, image_size, settings)
    if _over_limits(corners, settings):
        kept, over = _within_limits(corners, settings)
        sizes = np.diff(offsets)
        left_out |= {reason: int(sizes[indices].sum()) for reason, indices in over.items()}
        rows = rows[np.repeat(np.isin(np.arange(corners.shape[1]), kept), sizes)]
        corners, offsets = corners[:, kept], np.concatenate(([0], np.cumsum(sizes[kept])))
    left_out = {reason: count for reason, count in left_out.items() if count}
    return CropPlan(corners.T, rows, offsets, left_out)


def _by_value(
    values: FloatArray, corners: NDArray[np.int64], boxes: FloatArray | None = None
) -> NDArray[np.intp]:
    """Sort by falling value, then by place; `boxes` tell apart what rounding made equal."""
    order = np.argsort(-values, kind='stable')
    ranked = values[order]
    if not (ranked[1:] == ranked[:-1]).any():
        return order
    finer = () if boxes is None else tuple(boxes[::-1])
    return np.lexsort((*finer, *corners[::-1], -values))


def _merged(
    corners: NDArray[np.int64],
    values: FloatArray,
    rows: NDArray[np.intp],
    image_size: tuple[int, int],
    settings: CropSettings,
) -> tuple[NDArray[np.int64], NDArray[np.intp], NDArray[np.intp]]:
    """Merge regions given by falling value; give regions, sources and offsets of a plan."""
    bounds = np.array(image_size, dtype=np.float64)[:, None]

    def fit(low: Pixels, high: Pixels) -> tuple[Pixels, Pixels]:
        fitted = _fit_sizes(low.astype(float), high.astype(float), bounds, settings)
        return fitted[0].astype(low.dtype), fitted[1].astype(low.dtype)

    limit = min(settings.merge_max_size, settings._largest)
    rules = MergeRules(limit, settings.multiple_of, image_size, fit)
    united, group_of = merge_regions(corners, rules)
    if united.shape == corners.shape:
        return corners, rows, np.arange(len(rows) + 1)
    order = _by_value(_sums(values, group_of, united.shape[1]), united)
    rank = np.argsort(order)[group_of]
    members = np.argsort(rank, kind='stable')
    offsets = np.concatenate(([0], np.cumsum(np.bincount(rank))))
    return united[:, order], rows[members], offsets


def _sums(values: FloatArray, group_of: NDArray[np.intp], groups: int) -> FloatArray:
    """Add up the values of each group; what has none counts only where no other has one."""
    known = values > -np.inf
    sums = np.bincount(group_of[known], values[known], groups)
    counts = np.bincount(group_of[known], minlength=groups)
    return np.where(counts > 0, sums, -np.inf)


def _over_limits(corners: NDArray[np.int64], settings: CropSettings) -> bool:
    """Tell whether the regions together are more than a frame may have."""
    if 0 < settings.max_count < corners.shape[1]:
        return True
    return bool(settings.max_pixels and _pixels(corners).sum() > settings.max_pixels)


def _within_limits(
    corners: NDArray[np.int64], settings: CropSettings
) -> tuple[NDArray[np.intp], dict[LeftOut, list[int]]]:
    """Fill the limits of a frame in the order given; also tell what is over which limit."""
    kept: list[int] = []
    over: dict[LeftOut, list[int]] = {LeftOut.MAX_COUNT: [], LeftOut.MAX_PIXELS: []}
    count, left = settings.max_count or np.inf, settings.max_pixels or np.inf
    for index, size in enumerate(_pixels(corners).tolist()):
        if len(kept) == count:
            over[LeftOut.MAX_COUNT].append(index)
        elif size > left:
            over[LeftOut.MAX_PIXELS].append(index)
        else:
            kept.append(index)
            left -= size
    return np.array(kept, np.intp), over


def _pixels(corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count the pixels of each region, (4, N) to (N,)."""
    width, height = corners[2:] - corners[:2]
    return width * height


def _regions(
    boxes: FloatArray, bounds: FloatArray, settings: CropSettings
) -> NDArray[np.int64]:
    """Pad, clip to 0 and `bounds`, (4, 1), round outwards and fit to size; all (4, N)."""
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
    Bring each side about its centre to a size that the settings allow, inside the image.

    All are (2, N), and whole numbers within 0 and `bounds`.
    """
    given = high - low
    size = np.maximum(given, max(settings.min_size, 1))
    if settings.multiple_of > 1:
        size = np.ceil(size / settings.multiple_of) * settings.multiple_of
    if settings.max_size:
        size = np.minimum(size, settings._largest)
    size = np.minimum(size, bounds)
    as_given = size == given
    if as_given.all():
        return low, high
    fitted = np.where(as_given, low, np.floor((low + high - size) / 2.0))
    fitted = np.minimum(np.maximum(fitted, 0.0), bounds - size)
    return fitted, fitted + size
