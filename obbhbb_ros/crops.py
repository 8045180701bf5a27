"""
Axis-aligned boxes in, crop plan out: which whole-pixel regions of the image are worth sending.

A region is [x0, x1) x [y0, y1) in whole pixels of the image, pixel i covering [i, i + 1).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.boxes import FloatArray

_FARTHEST = 2.0**52


class LeftOut(str, Enum):
    """Why a box has no region in the plan."""

    INVALID = 'invalid'
    OUTSIDE = 'outside_image'
    MAX_COUNT = 'max_count'


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
    max_count : int
        At most so many regions a frame; 0 for no bound.

    Raises
    ------
    ValueError
        If a value is negative, or `max_size` lies below `min_size`; the message names it.
    """

    padding: float = 0.0
    padding_px: float = 0.0
    min_size: int = 0
    max_size: int = 0
    max_count: int = 0

    def __post_init__(self) -> None:
        """Check every value and how they fit together."""
        for name, value in vars(self).items():
            if not 0 <= value < np.inf:
                raise ValueError(f'{name} must be finite and not negative, not {value}')
        if 0 < self.max_size < self.min_size:
            raise ValueError(
                f'max_size ({self.max_size}) must not be smaller than min_size ({self.min_size})'
            )


@dataclass(frozen=True, eq=False)
class CropPlan:
    """
    The regions of one frame, most valuable first.

    Attributes
    ----------
    regions : ndarray of int64, shape (M, 4)
        x0, y0, x1, y1 of each region, whole pixels inside the image, upper ends exclusive.
    sources : ndarray of int, shape (M,)
        For each region, the row of the box that it was made from.
    left_out : dict of LeftOut to int
        How many boxes have no region, by reason.
    """

    regions: NDArray[np.int64]
    sources: NDArray[np.intp]
    left_out: dict[LeftOut, int]


def plan_crops(
    xyxy: FloatArray,
    scores: FloatArray,
    image_size: tuple[int, int],
    settings: CropSettings,
) -> CropPlan:
    """
    Plan the regions of one frame.

    Parameters
    ----------
    xyxy : ndarray, shape (N, 4)
        Axis-aligned boxes, pixels; NaN rows are left out.
    scores : ndarray, shape (N,)
        Value of each box; NaN counts as less than any number.
    image_size : tuple of int
        Width and height of the image, pixels.
    settings : CropSettings
        Padding, sizes and limits.

    Returns
    -------
    CropPlan
        The regions by falling score; equal scores keep the order of the boxes.
    """
    usable = np.isfinite(xyxy).all(axis=1)
    rows = np.flatnonzero(usable)
    regions, inside = _regions(xyxy[rows], image_size, settings)
    rows, regions = rows[inside], regions[inside]
    order = np.argsort(-np.nan_to_num(scores[rows], nan=-np.inf), kind='stable')
    kept = order[: settings.max_count] if settings.max_count else order
    left_out = {
        LeftOut.INVALID: int((~usable).sum()),
        LeftOut.OUTSIDE: int((~inside).sum()),
        LeftOut.MAX_COUNT: len(order) - len(kept),
    }
    return CropPlan(
        regions=regions[kept],
        sources=rows[kept],
        left_out={reason: count for reason, count in left_out.items() if count},
    )


def _regions(
    xyxy: FloatArray, image_size: tuple[int, int], settings: CropSettings
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Pad, clip, round outwards and fit to size; also tell which boxes meet the image at all."""
    bounds = np.array(image_size, dtype=np.float64)
    # So far out no pixel is left to tell apart, and no difference below overflows.
    xyxy = np.clip(xyxy, -_FARTHEST, _FARTHEST)
    margin = settings.padding * (xyxy[:, 2:] - xyxy[:, :2]) + settings.padding_px
    # A box is worth a region for its own pixels, not for its padding.
    inside: NDArray[np.bool_] = np.all((xyxy[:, 2:] > 0.0) & (xyxy[:, :2] < bounds), axis=1)
    low = np.floor(np.clip(xyxy[:, :2] - margin, 0.0, bounds))
    high = np.ceil(np.clip(xyxy[:, 2:] + margin, 0.0, bounds))
    low, high = _fit_sizes(low, high, bounds, settings)
    return np.hstack((low, high)).astype(np.int64), inside


def _fit_sizes(
    low: FloatArray, high: FloatArray, bounds: FloatArray, settings: CropSettings
) -> tuple[FloatArray, FloatArray]:
    """Grow or cut each side about its centre into [min_size, max_size], inside the image."""
    size = np.maximum(high - low, settings.min_size)
    if settings.max_size:
        size = np.minimum(size, settings.max_size)
    size = np.minimum(size, bounds)
    fitted = np.where(size == high - low, low, np.floor((low + high - size) / 2.0))
    fitted = np.clip(fitted, 0.0, bounds - size)
    return fitted, fitted + size
