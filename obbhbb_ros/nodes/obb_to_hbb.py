# SPDX-License-Identifier: Apache-2.0
"""The conversion node: oriented detections in, axis-aligned boxes and crop regions out."""

from __future__ import annotations

import time
from typing import Any

from sensor_msgs.msg import CameraInfo
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.nodes.managed import ManagedNode
from obbhbb_ros.nodes.managed import message_type
from obbhbb_ros.pipeline import Batch
from obbhbb_ros.settings import OBB_TO_HBB
from obbhbb_ros.settings import Settings
from obbhbb_ros.wire.cdr import WireError
from obbhbb_ros.wire.image import read_image_size
from obbhbb_ros.wire.layouts import INPUT_TYPES


class ObbToHbb(ManagedNode[Settings]):
    """
    Managed node `obb_to_hbb`.

    Subscribes to oriented detections and to `camera_info`, publishes `boxes`, `crop_regions`,
    `crop_sources` and `/diagnostics`. Topics and parameters: `doc/obb_to_hbb.md`.

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
            'obb_to_hbb', OBB_TO_HBB, ('messages_received', 'detections_received'), **kwargs
        )
        self._camera_size = (0, 0)
        self._autostart()

    def _create_topics(self) -> None:
        """Create publishers and subscriptions."""
        self._input_type = INPUT_TYPES[self.get_parameter('input_type').value]
        self._boxes = self._output(Detection2DArray, 'boxes')
        self._crop_regions = self._output(Detection2DArray, 'crop_regions')
        self._crop_sources = self._output(Detection2DArray, 'crop_sources')
        # First, so that the size that was published before a message is known by then.
        self._camera = self._input(CameraInfo, 'camera_info', self._on_camera_info)
        self._detections = self._input(
            message_type(self._input_type), self._input_type.topic, self._on_message
        )
        self._camera_size = (0, 0)

    def _facts(self) -> dict[str, str]:
        """Report how many pixels the crop plans save against those of the outer boxes."""
        outer = self._monitor.counts['crop_pixels.outer_boxes']
        if not outer:
            return {}
        saved = 1.0 - self._monitor.counts['crop_pixels.compared'] / outer
        return {'crop_pixels.saved_percent': f'{100.0 * saved:.1f}'}

    def _on_camera_info(self, data: bytes) -> None:
        """Learn the size of the image."""
        try:
            self._camera_size = read_image_size(data)
        except WireError as error:
            self._drop_unreadable(data, self._camera, error)

    def _on_message(self, data: bytes) -> None:
        """Convert one message under one snapshot of the parameters, and publish what is wanted."""
        started = time.perf_counter()
        self._monitor.add('messages_received')
        wants_boxes = _wanted(self._boxes)
        if not self._active:
            self._monitor.add('messages_while_inactive')
            return
        if not (wants_boxes or _wanted(self._crop_regions) or _wanted(self._crop_sources)):
            self._monitor.add('messages_without_subscriber')
            return
        settings = self._parameters_in_force.settings
        image_size = self._image_size(settings)
        if image_size is None and not settings.input_frame.is_image:
            self._warn_of_image_size('no boxes')
            return
        try:
            batch = Batch(data, self._input_type, settings, image_size)
        except WireError as error:
            self._drop_unreadable(data, self._detections, error)
            return
        if wants_boxes:
            self._boxes.publish(batch.boxes_message())
        # Subscribers are counted only now: whoever waits for the boxes does not wait for this.
        if image_size is None:
            self._warn_of_missed(wants_boxes and settings.clip_boxes)
        else:
            self._publish_crops(batch)
        self._monitor.counts.update(batch.counts)
        if batch.complaint:
            topic = self._detections.topic_name
            self._warn('invalid detections', f'{topic}: {batch.complaint}')
        self._monitor.took(time.perf_counter() - started)

    def _publish_crops(self, batch: Batch) -> None:
        """Publish what is wanted of the crop plan."""
        # The sources first, so that they are there when the regions are cut.
        if _wanted(self._crop_sources):
            self._crop_sources.publish(batch.crop_sources_message())
        if _wanted(self._crop_regions):
            self._crop_regions.publish(batch.crop_regions_message())

    def _warn_of_missed(self, wants_clipped: bool) -> None:
        """Report what a message without the size of the image does not get."""
        wants_crops = _wanted(self._crop_regions) or _wanted(self._crop_sources)
        missed = {'no crop regions': wants_crops, 'boxes are not clipped': wants_clipped}
        if any(missed.values()):
            self._warn_of_image_size(', '.join(each for each in missed if missed[each]))

    def _image_size(self, settings: Settings) -> tuple[int, int] | None:
        """Return the size of the image, None if it is not known."""
        width, height = (
            given or seen
            for given, seen in zip(settings.image_size, self._camera_size, strict=True)
        )
        return (width, height) if width and height else None

    def _warn_of_image_size(self, consequence: str) -> None:
        """Count and report a message that needs the size of the image."""
        self._monitor.add('messages_without_image_size')
        self._warn(
            'no image size',
            f'{consequence} without the size of the image: set image_width and image_height, or '
            'publish camera_info',
        )


def _wanted(publisher: Any) -> bool:
    """Return whether a topic has a subscriber."""
    return bool(publisher.get_subscription_count())
