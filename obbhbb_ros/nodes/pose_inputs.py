# SPDX-License-Identifier: Apache-2.0
"""The inputs that say where the camera is."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any
from typing import TypeAlias

from geometry_msgs.msg import PoseStamped
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Imu
from sensor_msgs.msg import NavSatFix

from obbhbb_ros.earth.pose import PoseError
from obbhbb_ros.earth.pose_source import CameraPoses
from obbhbb_ros.earth.pose_source import VehiclePoses
from obbhbb_ros.nodes.managed import ManagedNode
from obbhbb_ros.nodes.node_topics import reliable
from obbhbb_ros.nodes.parts import Part
from obbhbb_ros.settings.ship_tracker import VEHICLE
from obbhbb_ros.wire.poses import read_attitude
from obbhbb_ros.wire.poses import read_fix
from obbhbb_ros.wire.poses import read_pose

_KINDS = {kind.__name__: kind for kind in (PoseStamped, PoseWithCovarianceStamped, Odometry)}
# Depth for an IMU at 1 kHz and a stall of a fifth of a second.
_DEPTH = 200

AnyPoses: TypeAlias = CameraPoses | VehiclePoses


class PoseInputs(Part):
    """
    Reads `camera_pose`, or `fix` and `attitude`.

    Parameters
    ----------
    node : ManagedNode
        The node.
    pose_type : str
        The message type on `camera_pose`, or `NavSatFix`.
    on_pose : callable
        Called when a message has come.

    Attributes
    ----------
    poses : CameraPoses or VehiclePoses
        What has come.
    """

    def __init__(
        self, node: ManagedNode[Any], pose_type: str, on_pose: Callable[[], object]
    ) -> None:
        self._node, self._on_pose = node, on_pose
        self.poses: AnyPoses
        if pose_type == VEHICLE:
            self.poses = vehicle = VehiclePoses()
            self._input(NavSatFix, 'fix', lambda data: vehicle.add_fix(read_fix(data)))
            self._input(Imu, 'attitude', lambda data: vehicle.add_attitude(read_attitude(data)))
        else:
            self.poses = camera = CameraPoses()
            self._input(
                _KINDS[pose_type],
                'camera_pose',
                lambda data: camera.add(read_pose(data, pose_type)),
            )
        node.parts.append(self)

    def configure(self) -> None:
        """Forget the poses of earlier runs."""
        self.poses.clear()
        self._last = -math.inf

    def age(self) -> float:
        """Return the seconds since the last pose came."""
        return time.monotonic() - self._last

    def _input(self, kind: Any, topic: str, add: Callable[[bytes], object]) -> None:
        """Subscribe to a topic of poses."""
        quality: QoSProfile = reliable(_DEPTH)
        self._node.topics.input(kind, topic, partial(self._take, topic, add), qos=quality)

    def _take(self, topic: str, add: Callable[[bytes], object], data: bytes) -> None:
        """Keep a pose; count and report one that cannot be used."""
        try:
            add(data)
        except PoseError as error:
            self._node.monitor.add(f'poses_refused.{topic}')
            name = self._node.resolve_topic_name(topic)
            self._node.reporter.warn(f'refused {topic}', f'{name}: a pose was refused: {error}')
        else:
            self._last = time.monotonic()
            self._node.monitor.add(f'poses_received.{topic}')
        self._on_pose()
