# SPDX-License-Identifier: Apache-2.0
"""Ships as messages, and what has to become of them."""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import Point32
from geometry_msgs.msg import Polygon
from geometry_msgs.msg import PolygonStamped
from numpy.typing import ArrayLike
from numpy.typing import NDArray
from polygon_msgs.msg import Point2D
from polygon_msgs.msg import Polygon2D
from polygon_msgs.msg import Polygon2DCollection
from rclpy.serialization import serialize_message
from std_msgs.msg import Header
from vision_msgs.msg import Detection2D
from vision_msgs.msg import Detection2DArray
from vision_msgs.msg import ObjectHypothesisWithPose

from obbhbb_ros import OrientedBoxes
from obbhbb_ros.geometry.converter import NO_CAPS
from obbhbb_ros.geometry.converter import Caps
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import half_extents

FloatArray = NDArray[np.float64]


def fleet(count: int, seed: int = 1) -> FloatArray:
    """Make up ships as rows of centre, size and angle."""
    random = np.random.default_rng(seed)
    return np.column_stack(
        (
            random.uniform(0.0, 1000.0, (count, 2)),
            random.uniform(20.0, 200.0, count),
            random.uniform(5.0, 60.0, count),
            random.uniform(-6.2, 6.2, count),
        )
    )


def detection(
    row: Iterable[float], class_id: str | None = 'ship', score: float = 0.5, name: str = ''
) -> Detection2D:
    """Write a row of centre, size and angle as a detection, without hypothesis for no class."""
    message = Detection2D(id=name)
    box = message.bbox
    box.center.position.x, box.center.position.y, box.size_x, box.size_y, box.center.theta = row
    if class_id is not None:
        result = ObjectHypothesisWithPose()
        result.hypothesis.class_id = class_id
        result.hypothesis.score = score
        message.results.append(result)
    return message


def detections(rows: Any, **kwargs: Any) -> Detection2DArray:
    """Write rows of centre, size and angle as a message."""
    rows = np.asarray(rows, np.float64).reshape(-1, 5).tolist()
    header = Header(frame_id='camera')
    return Detection2DArray(header=header, detections=[detection(r, **kwargs) for r in rows])


def detector_message(count: int, side: int = 4096) -> bytes:
    """Write `count` detections of an image as a detector would: classes and ids differ."""
    random = np.random.default_rng(count)
    array = Detection2DArray(header=Header(frame_id='camera'))
    for i in range(count):
        row = (
            *random.uniform(100, side - 96, 2),
            random.uniform(20, 200),
            random.uniform(5, 50),
            random.uniform(-3, 3),
        )
        class_id = ('ship', 'tug', 'tanker')[random.integers(3)]
        ship = detection(row, class_id, random.uniform(), str(i))
        ship.header = array.header
        array.detections.append(ship)
    return serialize_message(array)


def collection(polygons: Iterable[Sequence[Sequence[float]]]) -> Polygon2DCollection:
    shapes = [Polygon2D(points=[Point2D(x=x, y=y) for x, y in points]) for points in polygons]
    return Polygon2DCollection(header=Header(frame_id='camera'), polygons=shapes)


def polygon(points: Sequence[Sequence[float]]) -> PolygonStamped:
    shape = Polygon(points=[Point32(x=x, y=y) for x, y in points])
    return PolygonStamped(header=Header(frame_id='camera'), polygon=shape)


def rows_of(message: Detection2DArray) -> FloatArray:
    """Read a message back as rows of centre, size and angle."""
    boxes = [detection.bbox for detection in message.detections]
    rows = [
        (b.center.position.x, b.center.position.y, b.size_x, b.size_y, b.center.theta)
        for b in boxes
    ]
    return np.array(rows, np.float64).reshape(-1, 5)


def axis_aligned(
    boxes: ArrayLike | OrientedBoxes, rule: HullRule | None = None, caps: Caps = NO_CAPS
) -> FloatArray:
    """Give the rows that the node has to make of boxes, or of rows of them, to the last bit."""
    if not isinstance(boxes, OrientedBoxes):
        boxes = OrientedBoxes.from_xywhr(boxes)
    size = 2.0 * half_extents(boxes, [rule or HullRule()], caps=caps)
    return np.column_stack((boxes.center, size, np.zeros(len(boxes))))
