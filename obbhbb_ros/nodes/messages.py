# SPDX-License-Identifier: Apache-2.0
"""Typed messages <-> arrays: the path that takes whatever the byte-level one declines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import PolygonStamped
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo
from vision_msgs.msg import BoundingBox2D
from vision_msgs.msg import Detection2D
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.boxes import OrientedBoxes
from obbhbb_ros.downlink.chips import Region
from obbhbb_ros.downlink.crops import CropPlan
from obbhbb_ros.nodes.settings import DETECTIONS
from obbhbb_ros.nodes.settings import POLYGON
from obbhbb_ros.nodes.settings import POLYGONS
from obbhbb_ros.wire import ID_SEPARATOR
from obbhbb_ros.wire import Detections
from obbhbb_ros.wire import Forms
from obbhbb_ros.wire import NotPlainCdrError

# Beyond any image, and exact as a number of pixels.
_FARTHEST = 2.0**52


def message_type(input_type: str) -> Any:
    """
    Give the message class of an input type.

    Raises
    ------
    ModuleNotFoundError
        If the package that defines it is not installed.
    """
    if input_type == POLYGONS:
        # Only here: whoever feeds detections needs no polygon_msgs.
        from polygon_msgs.msg import Polygon2DCollection

        return Polygon2DCollection
    return {DETECTIONS: Detection2DArray, POLYGON: PolygonStamped}[input_type]


def detections_from(message: Any) -> Detection2DArray:
    """
    Wrap a polygon message's polygons as detections that still want their boxes.

    Each takes the header of the message, and its place in the message as id.
    """
    count = len(message.polygons) if hasattr(message, 'polygons') else 1
    detections = [Detection2D(header=message.header, id=str(i)) for i in range(count)]
    for detection in detections:
        _place(detection.bbox, np.nan, np.nan, np.nan, np.nan)
    return Detection2DArray(header=message.header, detections=detections)


def boxes_of_detections(message: Detection2DArray, theta_scale: float) -> OrientedBoxes:
    """
    Read the oriented boxes of a message.

    Parameters
    ----------
    message : Detection2DArray
        N detections.
    theta_scale : float
        Factor from the message's angle unit to radians.

    Returns
    -------
    OrientedBoxes
        N boxes.
    """
    xywhr = xywhr_of(message)
    xywhr[:, 4] *= theta_scale
    return OrientedBoxes.from_xywhr(xywhr)


def xywhr_of(message: Detection2DArray) -> FloatArray:
    """Read centre x and y, size x and y, theta of each detection, (N, 5)."""
    xywhr = np.empty((len(message.detections), 5))
    for row, detection in zip(xywhr, message.detections, strict=True):
        box = detection.bbox
        position = box.center.position
        row[:] = position.x, position.y, box.size_x, box.size_y, box.center.theta
    return xywhr


def boxes_of_polygons(message: Any) -> OrientedBoxes:
    """Read the minimum rotated rectangles of a message's polygons."""
    polygons = message.polygons if hasattr(message, 'polygons') else [message.polygon]
    return OrientedBoxes.from_polygons(
        [(point.x, point.y) for point in polygon.points] for polygon in polygons
    )


def best_hypotheses(message: Detection2DArray) -> tuple[list[str], FloatArray]:
    """
    Give class id and score of each detection's best hypothesis.

    Returns
    -------
    class_ids : list of str
        N class ids, empty where there is no hypothesis.
    scores : ndarray, shape (N,)
        Their scores, NaN where there is none. The first of equals is taken.
    """
    class_ids = []
    scores = np.full(len(message.detections), np.nan)
    for i, detection in enumerate(message.detections):
        best = _best([result.hypothesis.score for result in detection.results])
        class_ids.append('' if best is None else detection.results[best].hypothesis.class_id)
        if best is not None:
            scores[i] = detection.results[best].hypothesis.score
    return class_ids, scores


def rules_of(class_ids: Sequence[str], rule_of_class: Any) -> NDArray[np.intp]:
    """Look up the rule of each class, 0 for those that have none of their own."""
    return np.array([rule_of_class.get(class_id, 0) for class_id in class_ids], np.intp)


def boxes_message(
    message: Detection2DArray, center: FloatArray, extents: FloatArray, keep_invalid: bool
) -> Detection2DArray:
    """
    Write axis-aligned boxes as a message.

    Parameters
    ----------
    message : Detection2DArray
        N detections, whose own boxes are changed.
    center, extents : ndarray, shape (2, N)
        Centres and half-extents, pixels; NaN columns for what could not be converted.
    keep_invalid : bool
        Whether those detections stay as they are, or are left out.

    Returns
    -------
    Detection2DArray
        The detections with their new boxes.
    """
    valid = np.isfinite(extents[0]).tolist()
    rows = np.concatenate((center, 2.0 * extents)).T.tolist()
    for detection, row, ok in zip(message.detections, rows, valid, strict=True):
        if ok:
            _place(detection.bbox, *row)
    if keep_invalid or all(valid):
        return message
    kept = [each for each, ok in zip(message.detections, valid, strict=True) if ok]
    return Detection2DArray(header=message.header, detections=kept)


def crop_message(message: Detection2DArray, plan: CropPlan) -> Detection2DArray:
    """
    Write a crop plan as a message.

    Parameters
    ----------
    message : Detection2DArray
        What the plan was made from; header, ids and hypotheses are taken from it.
    plan : CropPlan
        The plan.

    Returns
    -------
    Detection2DArray
        A detection a region, its box from the region's first pixel to behind its last. A merged
        region has the header of its most valuable detection, the hypotheses of all, and their ids
        joined by `ID_SEPARATOR`, most valuable first.
    """
    regions = []
    for group, row in zip(plan.groups(), region_boxes(plan).tolist(), strict=True):
        members = [message.detections[source] for source in group]
        box = BoundingBox2D()
        _place(box, *row)
        regions.append(
            Detection2D(
                header=members[0].header,
                results=[result for member in members for result in member.results],
                bbox=box,
                id=ID_SEPARATOR.join(member.id for member in members),
            )
        )
    return Detection2DArray(header=message.header, detections=regions)


def region_boxes(plan: CropPlan) -> FloatArray:
    """Give centre x and y, size x and y of the regions of a plan, (M, 4), pixels."""
    low, high = plan.regions.T[:2], plan.regions.T[2:]
    return np.concatenate(((low + high) / 2.0, high - low)).T


def read_regions(data: bytes, forms: Forms) -> tuple[tuple[int, int], list[Region]]:
    """
    Read the regions of a serialized crop plan.

    Parameters
    ----------
    data : bytes
        A serialized `Detection2DArray`.
    forms : Forms
        Memory of the forms of detection in earlier messages.

    Returns
    -------
    stamp : tuple of int
        Seconds and nanoseconds.
    regions : list of tuple of int
        x0, y0, x1, y1 in whole pixels, a region's parts of pixels taken in as wholes; empty ones
        for boxes that are not finite.

    Raises
    ------
    Exception
        Whatever the middleware raises on bytes that are no such message.
    """
    try:
        detections = Detections(data, forms)
        stamp, xywhr = detections.stamp, detections.xywhr()
    except NotPlainCdrError:
        message = deserialize_message(data, Detection2DArray)
        stamp = message.header.stamp.sec, message.header.stamp.nanosec
        xywhr = xywhr_of(message)
    center, half = xywhr[:, :2], xywhr[:, 2:4] / 2.0
    corners = np.hstack((np.floor(center - half), np.ceil(center + half)))
    corners[~np.isfinite(corners).all(axis=1)] = 0.0
    rows = np.clip(corners, -_FARTHEST, _FARTHEST).astype(np.int64).tolist()
    return stamp, [(x0, y0, x1, y1) for x0, y0, x1, y1 in rows]


def image_size(info: CameraInfo) -> tuple[int, int]:
    """Give width and height of the image that a camera info describes, pixels."""
    roi = info.roi
    width, height = (roi.width, roi.height) if roi.width and roi.height else (
        info.width, info.height
    )
    return width // max(info.binning_x, 1), height // max(info.binning_y, 1)


def _place(box: BoundingBox2D, x: float, y: float, width: float, height: float) -> None:
    """Write an axis-aligned box."""
    box.center.position.x = x
    box.center.position.y = y
    box.center.theta = 0.0
    box.size_x = width
    box.size_y = height


def _best(scores: Sequence[float]) -> int | None:
    """Find the first of the highest scores; NaN is lower than any number."""
    if not scores:
        return None
    return int(np.argmax(np.nan_to_num(scores, nan=-np.inf)))
