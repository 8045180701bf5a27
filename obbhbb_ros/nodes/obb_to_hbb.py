# SPDX-License-Identifier: Apache-2.0
"""The conversion node: oriented detections in, axis-aligned boxes and crop regions out."""

from __future__ import annotations

from typing import Any

from vision_msgs.msg import Detection2DArray

from obbhbb_ros.downlink.cameras import CameraChoice
from obbhbb_ros.nodes.detections_input import DetectionsInput
from obbhbb_ros.nodes.lifecycle.managed import ManagedNode
from obbhbb_ros.pipeline.conversion import Outputs
from obbhbb_ros.pipeline.conversion import answer
from obbhbb_ros.pipeline.conversion import outside_complaint
from obbhbb_ros.pipeline.outcome import Outcome
from obbhbb_ros.pipeline.outcome import Output
from obbhbb_ros.pipeline.plausibility import OutsideWatch
from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB
from obbhbb_ros.settings.obb_to_hbb import ConversionSettings
from obbhbb_ros.wire.camera import WireCamera
from obbhbb_ros.wire.layouts import InputType


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
        self._outputs = [
            self.topics.output(Detection2DArray, topic)
            for topic in ('boxes', 'crop_regions', 'crop_sources')
        ]
        DetectionsInput(self, self._answer)
        self.reporter.add_facts(self._facts)

    def configure(self) -> None:
        """Forget what lay outside the image."""
        self._outside = OutsideWatch()
        self._answers = Outputs(*(Output(topic.publish, topic.wanted) for topic in self._outputs))

    def _facts(self) -> dict[str, str]:
        """Report how many pixels the crop plans save compared with those of the outer boxes."""
        outer = self.monitor.counts['crop_pixels.outer_boxes']
        if not outer:
            return {}
        saved = 1.0 - self.monitor.counts['crop_pixels.compared'] / outer
        return {'crop_pixels.saved_percent': f'{100.0 * saved:.1f}'}

    def _answer(
        self, data: bytes, input_type: InputType, camera: CameraChoice[WireCamera] | None
    ) -> Outcome:
        """Convert a message under one snapshot of the parameters; publish what has subscribers."""
        outcome = answer(data, input_type, self.parameters.settings, camera, self._answers)
        outside = outside_complaint(self._outside, outcome)
        return outcome._replace(complaints=outcome.complaints | outside)
