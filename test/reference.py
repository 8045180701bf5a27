# SPDX-License-Identifier: Apache-2.0
"""
What `obbhbb_ros.pipeline` does, by way of message objects: slow, plain, and all of it by the book.

It shares the mathematics with the product, and nothing of how bytes are read and written.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from cdr import Detection
from cdr import Hypothesis
from cdr import Message
from cdr import encode
from rclpy.serialization import deserialize_message
from vision_msgs.msg import Detection2D
from vision_msgs.msg import Detection2DArray
from vision_msgs.msg import ObjectHypothesisWithPose

from obbhbb_ros.downlink.crops import plan_crops
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.geometry.converter import centers_and_extents
from obbhbb_ros.geometry.converter import half_extents
from obbhbb_ros.geometry.converter import to_xyxy
from obbhbb_ros.settings.obb_to_hbb import ConversionSettings
from obbhbb_ros.wire.layouts import InputType


class Reference:
    """The detections of one message, like `obbhbb_ros.pipeline.batch.Batch`."""

    def __init__(
        self,
        data: bytes,
        input_type: InputType,
        settings: ConversionSettings,
        image_size: tuple[int, int] | None = None,
    ) -> None:
        kind = getattr(import_module(f'{input_type.package}.msg'), input_type.name)
        message = deserialize_message(data, kind)
        self._settings = settings
        if hasattr(message, 'detections'):
            if not isinstance(message, Detection2DArray):
                message = from_yolo(message)
            self._message = message
            xywhr = np.array([box_of(detection) for detection in message.detections]).reshape(-1, 5)
            xywhr[:, 4] *= settings.input_frame.theta_scale
            self._boxes = OrientedBoxes.from_xywhr(xywhr, bow=settings.bow)
        else:
            polygons = message.polygons if hasattr(message, 'polygons') else [message.polygon]
            self._message = without_boxes(message, len(polygons))
            self._boxes = OrientedBoxes.from_polygons(
                [(point.x, point.y) for point in polygon.points] for polygon in polygons
            )
        best = [best_hypothesis(detection) for detection in self._message.detections]
        self._scores = np.array([np.nan if result is None else result.score for result in best])
        self._rule_of = np.array(
            [
                settings.rule_of_class.get('' if result is None else result.class_id, 0)
                for result in best
            ],
            np.intp,
        )
        self._image_size = image_size
        self._center, self._extents = centers_and_extents(
            self._boxes, settings.rules, self._rule_of, settings.caps
        )

    def boxes_message(self) -> bytes:
        """Write the message with axis-aligned boxes."""
        answer = Detection2DArray(header=self._message.header)
        for detection, center, extents in zip(
            self._message.detections, self._center, self._extents, strict=True
        ):
            if np.isfinite(extents[0]):
                answer.detections.append(with_box(detection, *center, *(2.0 * extents)))
            elif self._settings.keep_invalid:
                answer.detections.append(detection)
        return serialized(answer)

    def crop_regions_message(self) -> bytes:
        """Write the crop regions as a message."""
        settings, xyxy = self._settings, to_xyxy(self._center, self._extents)
        for row, rule in enumerate(self._rule_of):
            hull = settings.crop_rules[rule] if settings.crop_rules else None
            if hull is not None:
                box = self._boxes[row]
                around = to_xyxy(box.center, half_extents(box, [hull], caps=settings.caps))[0]
                xyxy[row, :2] = np.minimum(xyxy[row, :2], around[:2])
                xyxy[row, 2:] = np.maximum(xyxy[row, 2:], around[2:])
        weights, least = settings.weights[self._rule_of], settings.min_scores[self._rule_of]
        plan = plan_crops(xyxy, self._scores, self._image_size, settings.crop, weights, least)
        answer = Detection2DArray(header=self._message.header)
        for (x0, y0, x1, y1), group in zip(plan.regions.tolist(), plan.groups(), strict=True):
            members = [self._message.detections[row] for row in group]
            joined = Detection2D(
                header=members[0].header,
                results=[result for member in members for result in member.results],
                id='|'.join(member.id for member in members),
            )
            box = (x0 + x1) / 2.0, (y0 + y1) / 2.0, x1 - x0, y1 - y0
            answer.detections.append(with_box(joined, *box))
        return serialized(answer)


def box_of(detection: Detection2D) -> tuple[float, ...]:
    """Read the box of a detection as `OrientedBoxes.from_xywhr` takes it."""
    box = detection.bbox
    position = box.center.position
    return position.x, position.y, box.size_x, box.size_y, box.center.theta


def with_box(
    detection: Detection2D, x: float, y: float, width: float, height: float
) -> Detection2D:
    """Copy a detection with an axis-aligned box."""
    copy = Detection2D(header=detection.header, results=detection.results, id=detection.id)
    copy.bbox.center.position.x, copy.bbox.center.position.y = float(x), float(y)
    copy.bbox.size_x, copy.bbox.size_y = float(width), float(height)
    return copy


def without_boxes(message: Any, count: int) -> Detection2DArray:
    """Make detections of polygons: their header is that of the message, they have no id."""
    nan = float('nan')
    detections = [
        with_box(Detection2D(header=message.header), nan, nan, nan, nan) for _ in range(count)
    ]
    return Detection2DArray(header=message.header, detections=detections)


def from_yolo(message: Any) -> Detection2DArray:
    """Make detections of a `yolo_msgs/DetectionArray`; their header is that of the message."""
    answer = Detection2DArray(header=message.header)
    for source in message.detections:
        detection = Detection2D(header=message.header, id=source.id)
        result = ObjectHypothesisWithPose()
        result.hypothesis.class_id, result.hypothesis.score = source.class_name, source.score
        detection.results.append(result)
        box, center = detection.bbox, source.bbox.center
        box.center.position.x, box.center.position.y = center.position.x, center.position.y
        box.center.theta, box.size_x, box.size_y = (
            center.theta,
            source.bbox.size.x,
            source.bbox.size.y,
        )
        answer.detections.append(detection)
    return answer


def best_hypothesis(detection: Detection2D) -> Any:
    """Find the first hypothesis of the highest score, NaN being the lowest; None without any."""
    best = None
    for result in detection.results:
        score = result.hypothesis.score
        if best is None or score > best.score or (np.isnan(best.score) and not np.isnan(score)):
            best = result.hypothesis
    return best


def serialized(message: Detection2DArray) -> bytes:
    """Write a message by the rules of CDR, with zeros between the fields."""

    def stamp_of(header: Any) -> tuple[int, int]:
        return header.stamp.sec, header.stamp.nanosec

    def pose_of(result: Any) -> tuple[float, ...]:
        position, orientation = result.pose.pose.position, result.pose.pose.orientation
        return (
            position.x,
            position.y,
            position.z,
            orientation.x,
            orientation.y,
            orientation.z,
            orientation.w,
            *result.pose.covariance.tolist(),
        )

    detections = []
    for detection in message.detections:
        x, y, width, height, theta = box_of(detection)
        results = tuple(
            Hypothesis(result.hypothesis.class_id, result.hypothesis.score, pose_of(result))
            for result in detection.results
        )
        detections.append(
            Detection(
                stamp_of(detection.header),
                detection.header.frame_id,
                results,
                (x, y, theta, width, height),
                detection.id,
            )
        )
    header = message.header
    return encode(Message(stamp_of(header), header.frame_id, tuple(detections)))
