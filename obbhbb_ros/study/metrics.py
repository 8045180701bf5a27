# SPDX-License-Identifier: Apache-2.0
"""
How good a box is: overlap with a reference, and what of a hull it holds.

The paper scores boxes in two ways that answer different questions, and here they are kept apart
by name. Protocol `obb` compares an axis-aligned box with the *oriented* box it was made from (its
ShipRSImageNet table; then `outer` is 1 minus its overshoot, and the tightest box wins even if it
cuts the ship). Protocol `hbb` compares it with a separately drawn axis-aligned box (its Sentinel-2
table): the box that a user wants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.boxes import OrientedBoxes

PROTOCOLS = {
    'obb': 'against the oriented box itself',
    'hbb': 'against a separate axis-aligned box',
}


@dataclass(frozen=True, eq=False)
class Overlap:
    """
    N boxes beside their references: the three areas that every figure follows from.

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
        """Tell which boxes reach an IoU of at least `threshold` (Match50 at 0.5), shape (N,)."""
        return self.iou >= threshold


def overlap_with_hbb(xyxy: FloatArray, reference: FloatArray) -> Overlap:
    """
    Lay boxes beside axis-aligned references.

    Parameters
    ----------
    xyxy, reference : ndarray, shape (N, 4)
        Boxes, pixels.

    Returns
    -------
    Overlap
        NaN where either row is.
    """
    return Overlap(_shared(xyxy, reference), area(xyxy), area(reference))


def overlap_with_obb(xyxy: FloatArray, boxes: OrientedBoxes) -> Overlap:
    """
    Lay axis-aligned boxes beside oriented ones.

    Parameters
    ----------
    xyxy : ndarray, shape (N, 4)
        Boxes, pixels.
    boxes : OrientedBoxes
        N references.

    Returns
    -------
    Overlap
        NaN where either row is.
    """
    return Overlap(shared_with_obb(xyxy, boxes), area(xyxy), boxes.length * boxes.width)


def shared_with_obb(xyxy: FloatArray, boxes: OrientedBoxes) -> FloatArray:
    """
    Compute the area that each axis-aligned box shares with its oriented box.

    Parameters
    ----------
    xyxy : ndarray, shape (N, 4)
        Boxes, pixels.
    boxes : OrientedBoxes
        N oriented boxes.

    Returns
    -------
    ndarray, shape (N,)
        Square pixels; NaN where either row is.
    """
    center = boxes.center.T
    # Coordinates relative to the centre keep their digits.
    corners, local = boxes.corners - center[:, None], xyxy - np.tile(center, 2)
    shared = np.full(len(xyxy), np.nan)
    known = np.isfinite(local).all(axis=1) & np.isfinite(corners).all(axis=(1, 2))
    # Older releases of shapely warn where nothing is shared.
    with np.errstate(invalid='ignore'):
        shared[known] = shapely.area(
            shapely.intersection(
                shapely.polygons(corners[known]), shapely.box(*local[known].T)
            )
        )
    return shared


def _shared(xyxy: FloatArray, reference: FloatArray) -> FloatArray:
    """Compute the area that axis-aligned boxes share in pairs, (N,)."""
    low = np.maximum(xyxy[:, :2], reference[:, :2])
    high = np.minimum(xyxy[:, 2:], reference[:, 2:])
    return area(np.hstack((low, high)))


def area(xyxy: FloatArray) -> FloatArray:
    """
    Compute areas.

    Parameters
    ----------
    xyxy : ndarray, shape (N, 4)
        Boxes, pixels.

    Returns
    -------
    ndarray, shape (N,)
        Square pixels; 0 for a box turned inside out, NaN for a NaN row.
    """
    sides = np.maximum(xyxy[:, 2:] - xyxy[:, :2], 0.0)
    return sides[:, 0] * sides[:, 1]


def bounds(points: FloatArray) -> FloatArray:
    """
    Find the axis-aligned bounds of points.

    Parameters
    ----------
    points : ndarray, shape (..., K, 2)
        Corners or vertices, pixels.

    Returns
    -------
    ndarray, shape (..., 4)
        x_min, y_min, x_max, y_max, pixels.
    """
    return np.concatenate((points.min(axis=-2), points.max(axis=-2)), axis=-1)


def iou(xyxy: FloatArray, reference: FloatArray) -> FloatArray:
    """
    Compute the intersection over union of boxes in pairs.

    Parameters
    ----------
    xyxy, reference : ndarray, shape (N, 4)
        Boxes, pixels.

    Returns
    -------
    ndarray, shape (N,)
        In [0, 1]; NaN where either row is.
    """
    return overlap_with_hbb(xyxy, reference).iou


def hull_inside(xyxy: FloatArray, hulls: Sequence[FloatArray]) -> FloatArray:
    """
    Measure what of each hull lies in its box.

    Parameters
    ----------
    xyxy : ndarray, shape (N, 4)
        Boxes, pixels.
    hulls : sequence of ndarray, each of shape (K, 2)
        N hull polygons, pixels.

    Returns
    -------
    ndarray, shape (N,)
        Square pixels.
    """
    polygons = np.array([shapely.polygons(hull) for hull in hulls], dtype=object)
    return np.asarray(shapely.area(shapely.intersection(polygons, shapely.box(*xyxy.T))))


def background_removed(xyxy: FloatArray, outer: FloatArray, hulls: Sequence[FloatArray]) -> float:
    """
    Compare the background in boxes with that in outer boxes.

    Parameters
    ----------
    xyxy, outer : ndarray, shape (N, 4)
        Boxes and outer boxes of the same ships, pixels.
    hulls : sequence of ndarray, each of shape (K, 2)
        Their hull polygons, pixels.

    Returns
    -------
    float
        Share of the outer boxes' background, summed over the ships, that is gone.
    """
    left = np.sum(area(xyxy) - hull_inside(xyxy, hulls))
    before = np.sum(area(outer) - hull_inside(outer, hulls))
    return float(1.0 - left / before)
