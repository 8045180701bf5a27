# SPDX-License-Identifier: Apache-2.0
"""The conversion node: oriented detections in, axis-aligned boxes and crop regions out."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.boxes import Defect
from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.boxes import OrientedBoxes
from obbhbb_ros.converter import HullRule
from obbhbb_ros.converter import few_half_extents
from obbhbb_ros.converter import half_extents
from obbhbb_ros.converter import to_xyxy
from obbhbb_ros.downlink.crops import CropPlan
from obbhbb_ros.downlink.crops import plan_crops
from obbhbb_ros.nodes import messages
from obbhbb_ros.nodes.frames import Frame
from obbhbb_ros.nodes.frames import TypedFrame
from obbhbb_ros.nodes.frames import WireFrame
from obbhbb_ros.nodes.managed import ManagedNode
from obbhbb_ros.nodes.settings import CLASS_TABLE
from obbhbb_ros.nodes.settings import DETECTIONS
from obbhbb_ros.nodes.settings import TABLE
from obbhbb_ros.nodes.settings import Settings
from obbhbb_ros.nodes.settings import build_settings
from obbhbb_ros.wire import Forms
from obbhbb_ros.wire import NotPlainCdrError

OUTER = (HullRule('outer'),)


class ObbToHbb(ManagedNode[Settings]):
    """
    Managed node `obb_to_hbb`.

    Subscribes to `detections` or `polygons` and to `camera_info`, publishes `boxes`,
    `crop_regions` and `/diagnostics`. The README documents topics and parameters.

    Parameters
    ----------
    **kwargs
        Passed to `rclpy.lifecycle.LifecycleNode`.

    Raises
    ------
    ValueError, rclpy.exceptions.ParameterException
        If the parameters given at start cannot be used.
    StartError
        If `autostart` is set and the node cannot be configured or activated.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(
            'obb_to_hbb', TABLE, build_settings, ('messages_received', 'detections_received'),
            CLASS_TABLE, **kwargs,
        )
        self._forms = Forms()
        self._camera_size = (0, 0)
        self._autostart()

    def _create_topics(self) -> None:
        """Create publishers and subscriptions."""
        self._input_type = self.get_parameter('input_type').value
        self._message_type = messages.message_type(self._input_type)
        self._boxes_publisher = self._output(Detection2DArray, 'boxes')
        self._crops_publisher = self._output(Detection2DArray, 'crop_regions')
        topic = 'detections' if self._input_type == DETECTIONS else 'polygons'
        # First, so that the size that was published before a message is known by then.
        self._camera_subscription = self._input(
            CameraInfo, 'camera_info', self._on_camera_info, raw=True
        )
        self._subscription = self._input(self._message_type, topic, self._on_message, raw=True)
        self._camera_size = (0, 0)

    def _facts(self) -> dict[str, str]:
        """Tell by how much the crop plans beat those of the outer boxes."""
        outer = self._monitor.counts['crop_pixels.outer_boxes']
        if not outer:
            return {}
        saved = 1.0 - self._monitor.counts['crop_pixels.compared'] / outer
        return {'crop_pixels.saved_percent': f'{100.0 * saved:.1f}'}

    def _on_camera_info(self, data: bytes) -> None:
        """Learn the size of the image."""
        try:
            self._camera_size = messages.image_size(deserialize_message(data, CameraInfo))
        except Exception as error:
            topic = self._camera_subscription.topic_name
            self._drop_unreadable(data, topic, 'CameraInfo', error)

    def _on_message(self, data: bytes) -> None:
        """Convert one message under one snapshot of the parameters."""
        started = time.perf_counter()
        self._monitor.add('messages_received')
        wants_boxes = _wanted(self._boxes_publisher)
        if not self._active:
            self._monitor.add('messages_while_inactive')
        elif not (wants_boxes or _wanted(self._crops_publisher)):
            self._monitor.add('messages_without_subscriber')
        else:
            frame = self._read(data)
            if frame is not None:
                self._convert(frame, self._parameters_in_force.settings, wants_boxes)
            self._monitor.took(time.perf_counter() - started)

    def _read(self, data: bytes) -> Frame | None:
        """Read a message the fast way, or else by message objects; None if it is none."""
        try:
            if self._input_type != DETECTIONS:
                self._monitor.add('typed_path.input_type')
            else:
                try:
                    frame = WireFrame(data, self._forms)
                    self._monitor.add('fast_path')
                    return frame
                except NotPlainCdrError:
                    self._monitor.add('typed_path.not_plain_cdr')
            return TypedFrame(data, self._message_type)
        except Exception as error:
            topic = self._subscription.topic_name
            self._drop_unreadable(data, topic, self._input_type, error)
            return None

    def _convert(self, frame: Frame, settings: Settings, wants_boxes: bool) -> None:
        """Convert one message and publish what is wanted of it."""
        uniform = not (settings.rule_of_class or settings.caps.given)
        rows = frame.few_boxes(settings.theta_scale) if uniform else None
        few = None if rows is None else few_half_extents(rows, settings.rules[0])
        if few is None:
            self._convert_many(frame, settings, wants_boxes)
            return
        if wants_boxes:
            self._boxes_publisher.publish(frame.few_boxes_message(few))
        # Asked only now: whoever waits for the boxes does not wait for this.
        if _wanted(self._crops_publisher):
            boxes = OrientedBoxes.from_xywhr(rows)
            extents = np.array(few, np.float64).reshape(-1, 2).T
            self._publish_crops(frame, boxes, extents, None, settings)
        self._count(len(few))

    def _convert_many(self, frame: Frame, settings: Settings, wants_boxes: bool) -> None:
        """Convert one message of any kind and publish what is wanted of it."""
        boxes = frame.boxes(settings.theta_scale)
        rule_of = None
        if settings.rule_of_class:
            rule_of = messages.rules_of(frame.class_ids(), settings.rule_of_class)
        extents = half_extents(boxes, settings.rules, rule_of, settings.caps)
        if wants_boxes:
            message = frame.boxes_message(boxes, extents, settings.keep_invalid)
            self._boxes_publisher.publish(message)
        if _wanted(self._crops_publisher):
            weights = None if rule_of is None else settings.weights[rule_of]
            self._publish_crops(frame, boxes, extents, weights, settings)
        self._count(len(boxes))
        if not boxes.tame:
            self._look_for_invalid(frame, boxes, extents, settings)

    def _publish_crops(
        self,
        frame: Frame,
        boxes: OrientedBoxes,
        extents: FloatArray,
        weights: FloatArray | None,
        settings: Settings,
    ) -> None:
        """Plan and publish the crop regions of one message."""
        image_size = self._image_size(settings)
        if image_size is None:
            return
        scores = frame.scores()

        def plan_of(extents: FloatArray) -> CropPlan:
            xyxy = to_xyxy(boxes.center, extents)
            return plan_crops(xyxy, scores, image_size, settings.crop, weights)

        plan = plan_of(extents)
        self._crops_publisher.publish(frame.crops_message(plan))
        self._count_crops(plan)
        if settings.compare_outer:
            of_outer = plan_of(half_extents(boxes, OUTER))
            self._monitor.add('crop_pixels.compared', plan.pixels)
            self._monitor.add('crop_pixels.outer_boxes', of_outer.pixels)

    def _image_size(self, settings: Settings) -> tuple[int, int] | None:
        """Tell the size of the image; warn and give None if it is not known."""
        width, height = (
            given or seen
            for given, seen in zip(settings.image_size, self._camera_size, strict=True)
        )
        if width and height:
            return width, height
        self._monitor.add('messages_without_image_size')
        self._warn(
            'no image size',
            'no crop regions without the size of the image: set image_width and '
            'image_height, or publish camera_info'
        )
        return None

    def _count_crops(self, plan: CropPlan) -> None:
        """Count the regions of a plan, and the boxes that have none."""
        self._monitor.add('crops_planned', len(plan.regions))
        self._monitor.add('crop_pixels.planned', plan.pixels)
        if plan.merged:
            self._monitor.add('crops_merged_away', len(plan.sources) - len(plan.regions))
        for reason, count in plan.left_out.items():
            self._monitor.add(f'crops_left_out.{reason.value}', count)

    def _count(self, detections: int) -> None:
        """Count a message that was converted."""
        self._monitor.add('messages_converted')
        self._monitor.add('detections_received', detections)

    def _look_for_invalid(
        self,
        frame: Frame,
        boxes: OrientedBoxes,
        extents: FloatArray,
        settings: Settings,
    ) -> None:
        """Tell of the detections that cannot be converted."""
        invalid = np.flatnonzero(np.isnan(extents[0]))
        if not invalid.size:
            return
        # A box without a defect that has no extents overflowed.
        defects = np.maximum(boxes.defects[invalid], np.uint8(Defect.NOT_FINITE))
        self._report_invalid(frame, len(boxes), invalid, defects, settings)

    def _report_invalid(
        self,
        frame: Frame,
        total: int,
        rows: NDArray[np.intp],
        defects: NDArray[np.uint8],
        settings: Settings,
    ) -> None:
        """Count invalid detections by reason and warn of the first."""
        action = 'kept' if settings.keep_invalid else 'dropped'
        for defect, count in zip(*np.unique(defects, return_counts=True), strict=True):
            self._monitor.add(f'detections_{action}.{Defect(defect).name.lower()}', int(count))
        seconds, nanoseconds = frame.stamp
        self._warn(
            'invalid detections',
            f'{action} {len(rows)} of {total} detections on '
            f'{self._subscription.topic_name} at stamp {seconds}.{nanoseconds:09d}: '
            f'index {rows[0]} is {Defect(defects[0]).name.lower()}'
        )


def _wanted(publisher: Any) -> bool:
    """Tell whether a topic has a subscriber."""
    return bool(publisher.get_subscription_count())
