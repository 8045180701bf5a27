# SPDX-License-Identifier: Apache-2.0
"""The conversion node: oriented detections in, axis-aligned boxes and crop regions out."""

from __future__ import annotations

import time
from typing import Any

from sensor_msgs.msg import CameraInfo
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.downlink.cameras import CameraMemory
from obbhbb_ros.downlink.joiner import CAMERAS_KEPT
from obbhbb_ros.nodes.managed import ManagedNode
from obbhbb_ros.nodes.node_topics import reliable
from obbhbb_ros.pipeline import OTHER_FRAME
from obbhbb_ros.pipeline import Output
from obbhbb_ros.pipeline import Outputs
from obbhbb_ros.pipeline import answer
from obbhbb_ros.pipeline import outside_complaint
from obbhbb_ros.plausibility import OutsideWatch
from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB
from obbhbb_ros.settings.obb_to_hbb import ConversionSettings
from obbhbb_ros.wire.camera import WireCamera
from obbhbb_ros.wire.camera import read_camera
from obbhbb_ros.wire.layouts import INPUT_TYPES
from obbhbb_ros.wire.stamp import stamp_at_start


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
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(
            'obb_to_hbb', OBB_TO_HBB, ('messages_received', 'detections_received'), **kwargs
        )
        self._input_type = INPUT_TYPES[self.get_parameter('input_type').value]
        self._outputs = [
            self.topics.output(Detection2DArray, topic)
            for topic in ('boxes', 'crop_regions', 'crop_sources')
        ]
        # First, so that the node knows an image size that was published before the detections.
        cameras = reliable(CAMERAS_KEPT)
        self.topics.input(CameraInfo, 'camera_info', self._on_camera_info, qos=cameras)
        self._detections = self.topics.input(
            self._input_type, self._input_type.topic, self._on_message, 'messages_received'
        )
        self.reporter.add_facts(self._facts)

    def configure(self) -> None:
        """Forget the cameras."""
        self._cameras = CameraMemory[WireCamera]()
        self._outside = OutsideWatch()
        self._answers = Outputs(*(Output(topic.publish, topic.wanted) for topic in self._outputs))

    def _facts(self) -> dict[str, str]:
        """Report how many pixels the crop plans save compared with those of the outer boxes."""
        outer = self.monitor.counts['crop_pixels.outer_boxes']
        if not outer:
            return {}
        saved = 1.0 - self.monitor.counts['crop_pixels.compared'] / outer
        return {'crop_pixels.saved_percent': f'{100.0 * saved:.1f}'}

    def _on_camera_info(self, data: bytes) -> None:
        """Keep the camera for the detections of its stamp."""
        camera = read_camera(data)
        self._cameras.add(camera.stamp, camera, time.monotonic())

    def _on_message(self, data: bytes) -> None:
        """Convert a message under one snapshot of the parameters; publish what has subscribers."""
        started = time.perf_counter()
        settings = self.parameters.settings
        camera = self._cameras.choice(stamp_at_start(data))
        outcome = answer(data, self._input_type, settings, camera, self._answers)
        self.monitor.counts.update(outcome.counts)
        if 'messages_without_subscriber' in outcome.counts:
            return
        outside = outside_complaint(self._outside, outcome)
        for kind, text in (outcome.complaints | outside).items():
            said = f'{self._detections.topic_name}: {text}'
            if kind == OTHER_FRAME:
                self.reporter.warn_once(said)
            else:
                self.reporter.warn(kind, said)
        self.monitor.took(time.perf_counter() - started)
