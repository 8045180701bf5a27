# SPDX-License-Identifier: Apache-2.0
"""The conversion node: oriented detections in, axis-aligned boxes and crop regions out."""

from __future__ import annotations

import time
from typing import Any

from sensor_msgs.msg import CameraInfo
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.nodes.managed import ManagedNode
from obbhbb_ros.nodes.managed import message_type
from obbhbb_ros.pipeline import Output
from obbhbb_ros.pipeline import Outputs
from obbhbb_ros.pipeline import answer
from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB
from obbhbb_ros.settings.obb_to_hbb import ConversionSettings
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.image import read_image_size
from obbhbb_ros.wire.layouts import INPUT_TYPES


class ObbToHbb(ManagedNode[ConversionSettings]):
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
        self._answers = Outputs(
            *(
                Output(publisher.publish, publisher.get_subscription_count)
                for publisher in (
                    self._output(Detection2DArray, 'boxes'),
                    self._output(Detection2DArray, 'crop_regions'),
                    self._output(Detection2DArray, 'crop_sources'),
                )
            )
        )
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
        if not self._active:
            self._monitor.add('messages_while_inactive')
            return
        settings = self._parameters_in_force.settings
        try:
            outcome = answer(data, self._input_type, settings, self._camera_size, self._answers)
        except WireError as error:
            self._drop_unreadable(data, self._detections, error)
            return
        self._monitor.counts.update(outcome.counts)
        if outcome.counts['messages_without_subscriber']:
            return
        for kind, text in outcome.complaints.items():
            self._warn(kind, f'{self._detections.topic_name}: {text}')
        self._monitor.took(time.perf_counter() - started)
