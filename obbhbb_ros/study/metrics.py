# SPDX-License-Identifier: Apache-2.0
"""
Box quality: overlap with a reference, and the part of a hull inside the box.

The paper scores boxes in two ways that answer different questions; here each has a name.
Protocol `obb` compares an axis-aligned box with the *oriented* box it was made from (its
ShipRSImageNet table; the IoU of `outer` is then 1 minus its overshoot, and the tightest box wins
even if it cuts the ship). Protocol `hbb` compares it with a separately drawn axis-aligned box (its
Sentinel-2 table): the box that a user wants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes

PROTOCOLS = {'obb': 'against the oriented box itself', 'hbb': 'against a separate axis-aligned box'}


@dataclass(frozen=True, eq=False)
class Overlap:
    """
    The three areas, of N boxes and their references, that every figure follows from.

    Build one with `overlap_with_hbb` or `overlap_with_obb`.

    Attributes
    ----------
    shared, predicted, reference : ndarray, shape (N,)
        Area of the intersection, of the box and of its reference, square pixels.
    """

    shared: FloatArray
    predicted: FloatArray
    reference: FloatArray

    @property
    def iou(self) -> FloatArray:
        """Intersection over union, in [0, 1], shape (N,)."""
        return self.shared / (self.predicted + self.reference - self.shared)

    @property
    def overshoot(self) -> FloatArray:
        """Share of the box that lies outside its reference (the paper's Note), shape (N,)."""
        return 1.0 - self.shared / self.predicted

    @property
    def undershoot(self) -> FloatArray:
        """Share of the reference that the box misses (the paper's Note), shape (N,)."""
        return 1.0 - self.coverage

    @property
    def average_error(self) -> FloatArray:
        """Mean of overshoot and undershoot (Table "ShipRSImageNet", Avg. Error), shape (N,)."""
        return (self.overshoot + self.undershoot) / 2.0

    @property
    def relative_error(self) -> FloatArray:
        """Area difference over the reference's area (Eq. relerr), shape (N,)."""
        return np.abs(self.predicted - self.reference) / self.reference

    @property
    def coverage(self) -> FloatArray:
        """Share of the reference that the box keeps, in [0, 1], shape (N,)."""
        return self.shared / self.reference

    def match(self, threshold: float = 0.5) -> NDArray[np.bool_]:
        """Find the boxes with an IoU of at least `threshold` (Match50 at 0.5), shape (N,)."""
        return self.iou >= threshold


def overlap_with_hbb(xyxy: FloatArray, reference: FloatArray) -> Overlap:
    """Compare N boxes with axis-aligned references, each (N, 4), pixels; NaN where either is."""
    low = np.maximum(xyxy[:, :2], reference[:, :2])
    high = np.minimum(xyxy[:, 2:], reference[:, 2:])
    return Overlap(area(np.hstack((low, high))), area(xyxy), area(reference))


def overlap_with_obb(xyxy: FloatArray, boxes: OrientedBoxes) -> Overlap:
    """Compare N boxes, (N, 4), pixels, with N oriented references; NaN where either is."""
    # Coordinates relative to the centre keep their digits.
    center = boxes.center
    corners, local = boxes.corners - center[:, None], xyxy - np.tile(center, 2)
    finite = np.isfinite(local).all(axis=1) & np.isfinite(corners).all(axis=(1, 2))
    shared = np.full(len(xyxy), np.nan)
    shared[finite] = _shared_area(shapely.polygons(corners[finite]), local[finite])
    return Overlap(shared, area(xyxy), boxes.length * boxes.width)


def _shared_area(polygons: Any, xyxy: FloatArray) -> FloatArray:
    """Compute the area that polygons and boxes share in pairs, (N,)."""
    # Older releases of shapely warn where nothing is shared.
    with np.errstate(invalid='ignore'):
        return np.asarray(shapely.area(shapely.intersection(polygons, shapely.box(*xyxy.T))))


def area(xyxy: FloatArray) -> FloatArray:
    """Compute the areas of boxes, (N, 4), in square pixels; 0 where a box is inside out."""
    sides = np.maximum(xyxy[:, 2:] - xyxy[:, :2], 0.0)
    return sides[:, 0] * sides[:, 1]


def bounds(points: FloatArray) -> FloatArray:
    """Find the axis-aligned bounds of corners or vertices, (..., K, 2), as xyxy, (..., 4)."""
    return np.concatenate((points.min(axis=-2), points.max(axis=-2)), axis=-1)


def iou(xyxy: FloatArray, reference: FloatArray) -> FloatArray:
    """
    Compute the intersection over union, (N,), of boxes in pairs, each (N, 4); NaN where either is.

    Examples
    --------
    >>> iou(np.array([[0.0, 0.0, 4.0, 4.0]]), np.array([[0.0, 2.0, 4.0, 10.0]]))
    array([0.2])
    """
    return overlap_with_hbb(xyxy, reference).iou


def hull_inside(xyxy: FloatArray, hulls: Sequence[FloatArray]) -> FloatArray:
    """Compute the area of each hull, (K, 2), inside its box, (4,), in square pixels, (N,)."""
    return _shared_area(np.array([shapely.polygons(hull) for hull in hulls], object), xyxy)


def outlines(hulls: Sequence[FloatArray | None]) -> NDArray[np.object_]:
    """Make geometries of hull polygons, (K, 2) each; None where there is none, or no area."""
    polygons = np.full(len(hulls), None, object)
    for row, hull in enumerate(hulls):
        if hull is not None and len(hull) >= 3:
            polygons[row] = shapely.polygons(hull)
    # Masks touch and cross themselves.
    polygons = np.asarray(shapely.make_valid(polygons), object)
    polygons[~(shapely.area(polygons) > 0.0)] = None
    return polygons


def hull_share(xyxy: FloatArray, polygons: NDArray[np.object_]) -> FloatArray:
    """
    Compute the share of each hull's area inside its box, (N,).

    `xyxy` are N boxes, (N, 4), pixels, and `polygons` the N `outlines`; NaN where either is
    unknown.

    Examples
    --------
    >>> hull = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 2.0], [0.0, 2.0]])
    >>> hull_share(np.array([[1.0, 0.0, 9.0, 9.0]]), outlines([hull]))
    array([0.75])
    """
    share = np.full(len(xyxy), np.nan)
    rows = np.isfinite(xyxy).all(axis=1) & ~shapely.is_missing(polygons)
    if rows.any():
        share[rows] = _shared_area(polygons[rows], xyxy[rows]) / shapely.area(polygons[rows])
    return share
