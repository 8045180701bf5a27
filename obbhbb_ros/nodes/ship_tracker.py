# SPDX-License-Identifier: Apache-2.0
"""The tracking node: oriented detections in, the same with the ids of ships out."""

from __future__ import annotations

from typing import Any

from vision_msgs.msg import Detection2DArray

from obbhbb_ros.downlink.cameras import CameraChoice
from obbhbb_ros.identification import ShipIdentifier
from obbhbb_ros.nodes.detections_input import DetectionsInput
from obbhbb_ros.nodes.managed import ManagedNode
from obbhbb_ros.pipeline import ConversionOutcome
from obbhbb_ros.pipeline import Output
from obbhbb_ros.settings.ship_tracker import SHIP_TRACKER
from obbhbb_ros.settings.ship_tracker import TrackerSettings
from obbhbb_ros.wire.camera import WireCamera
from obbhbb_ros.wire.layouts import InputType


class ShipTracker(ManagedNode[TrackerSettings]):
    """
    Managed node `ship_tracker`.

    Subscribes to oriented detections and to `camera_info`, publishes `tracked_detections` and
    `/diagnostics`. Topics and parameters: `doc/ship_tracker.md`.

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
            'ship_tracker', SHIP_TRACKER, ('messages_received', 'detections_received'), **kwargs
        )
        self._tracked = self.topics.output(Detection2DArray, 'tracked_detections')
        DetectionsInput(self, self._answer)
        self.reporter.add_facts(self._facts)
        self._identifier = ShipIdentifier()

    def configure(self) -> None:
        """Forget all ships, and begin a new session of ids."""
        self._identifier = ShipIdentifier()
        self._output = Output(self._tracked.publish, self._tracked.wanted)

    def _facts(self) -> dict[str, str]:
        """Report the session of the ids, and how many ships are remembered."""
        return {
            'session': self._identifier.session,
            'ships_remembered': str(self._identifier.ships_remembered),
        }

    def _answer(
        self, data: bytes, input_type: InputType, camera: CameraChoice[WireCamera] | None
    ) -> ConversionOutcome:
        """Give ids under one snapshot of the parameters."""
        settings = self.parameters.settings
        return self._identifier.answer(data, input_type, settings, camera, self._output)
