"""How good a box is: overlap with a reference, and what of a hull it holds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from obbhbb_ros.boxes import FloatArray


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
    low = np.maximum(xyxy[:, :2], reference[:, :2])
    high = np.minimum(xyxy[:, 2:], reference[:, 2:])
    shared = area(np.hstack((low, high)))
    return shared / (area(xyxy) + area(reference) - shared)


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
