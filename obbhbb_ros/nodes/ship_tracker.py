# SPDX-License-Identifier: Apache-2.0
"""The tracking node: oriented detections in, the same detections with ids of ships out."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from vision_msgs.msg import Detection2DArray
from vision_msgs.msg import Detection3DArray

from obbhbb_ros.downlink.cameras import CameraChoice
from obbhbb_ros.nodes.detections_input import DetectionsInput
from obbhbb_ros.nodes.detections_input import Waits
from obbhbb_ros.nodes.lifecycle.managed import ManagedNode
from obbhbb_ros.nodes.lifecycle.node_topics import TopicOutput
from obbhbb_ros.nodes.lifecycle.parts import steady_timer
from obbhbb_ros.nodes.pose_inputs import PoseInputs
from obbhbb_ros.nodes.ship_lists import ShipLists
from obbhbb_ros.pipeline.identification import ShipIdentifier
from obbhbb_ros.pipeline.identification import TrackerOutputs
from obbhbb_ros.pipeline.outcome import Outcome
from obbhbb_ros.pipeline.outcome import Output
from obbhbb_ros.settings.ship_tracker import NO_POSE
from obbhbb_ros.settings.ship_tracker import SHIP_TRACKER
from obbhbb_ros.settings.ship_tracker import TrackerSettings
from obbhbb_ros.wire.camera import WireCamera
from obbhbb_ros.wire.layouts import InputType
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.stamp import later

TRACKED = 'tracked_detections'
"""The topic of detections with ids."""

# A pose may come this much later than an image of the same time, seconds.
_TRANSPORT = 0.5
# DDS sends a message that was lost beside large images again after this time, seconds. Later
# messages wait for it.
_RESENT = 4.0
# Seconds between two looks at the frames that wait for their pose.
_PERIOD = 0.1


class ShipTracker(ManagedNode[TrackerSettings]):
    """
    Managed node `ship_tracker`.

    Subscribes to oriented detections, to `camera_info` and to the pose of the camera, publishes
    `tracked_detections`, `positions`, `image_pose` and `/diagnostics`, and lists the ships in the
    spool. Topics and parameters: `doc/ship_tracker.md`.

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
        self._outputs = TrackerOutputs(_output(self.topics.output(Detection2DArray, TRACKED)))
        self._poses: PoseInputs | None = None
        waits = None
        pose_type = self.get_parameter('pose_type').value
        if pose_type != NO_POSE:
            # Before the detections, so that the poses are there when a frame is placed.
            self._poses = PoseInputs(self, pose_type, self._on_pose)
            waits = Waits(self._is_pose_coming, self._pose_patience)
            self._outputs = self._outputs._replace(
                positions=_output(self.topics.output(Detection3DArray, 'positions')),
                image_pose=_output(self.topics.output(PoseWithCovarianceStamped, 'image_pose')),
            )
        self._detections = DetectionsInput(
            self, self._answer, waits, needs_camera=pose_type != NO_POSE
        )
        # After the detections, so that the last list has all of them.
        listing = self.parameters.settings.reports.period > 0.0
        self._lists = ShipLists(self) if listing else None
        self.reporter.add_facts(self._facts)
        self._timer: Any = None

    def configure(self) -> None:
        """Forget all ships, and begin a new session of ids."""
        self._identifier = ShipIdentifier(
            None if self._poses is None else self._poses.poses,
            None if self._lists is None else self._lists.collector,
        )
        if self._poses is not None:
            self._timer = steady_timer(self, _PERIOD, self._detections.catch_up)

    def cleanup(self) -> None:
        """Stop looking at what waits."""
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None

    def destroy_node(self) -> None:
        """List the ships of the last period."""
        if self._lists is not None:
            self._lists.deactivate()
            self._lists.cleanup()
        super().destroy_node()

    def _on_pose(self) -> None:
        """Answer the frames that waited for this pose."""
        self._detections.catch_up()

    def _is_pose_coming(self, stamp: Stamp) -> bool:
        """Return whether the pose of an image is not complete yet, and poses are coming."""
        place = self.parameters.settings.place
        if self._poses is None or place is None or self._poses.age() > self._pose_patience():
            return False
        return not self._poses.poses.has_reached(later(stamp, place.readout))

    def _pose_patience(self) -> float:
        """Return for how long a frame waits for its pose, seconds."""
        place = self.parameters.settings.place
        return 0.0 if place is None else max(_RESENT, place.pose_max_age + _TRANSPORT)

    def _facts(self) -> dict[str, str]:
        """Report the session of the ids, and how many ships are remembered."""
        return {
            'session': self._identifier.session,
            'ships_remembered': str(self._identifier.ships_remembered),
        }

    def _answer(
        self, data: bytes, input_type: InputType, camera: CameraChoice[WireCamera] | None
    ) -> Outcome:
        """Give ids under one snapshot of the parameters."""
        settings = self.parameters.settings
        return self._identifier.answer(data, input_type, settings, camera, self._outputs)


def _output(topic: TopicOutput) -> Output:
    """Make the output for a topic."""
    return Output(topic.publish, topic.wanted)
