# SPDX-License-Identifier: Apache-2.0
"""The places of the ships of an image, from `positions` and `image_pose`."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from vision_msgs.msg import Detection3DArray

from obbhbb_ros.downlink.cameras import CameraMemory
from obbhbb_ros.earth.pose import PoseError
from obbhbb_ros.earth.reported import ShipPlaces
from obbhbb_ros.nodes.managed import ManagedNode
from obbhbb_ros.nodes.node_topics import reliable
from obbhbb_ros.nodes.parts import Part
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.poses import read_pose
from obbhbb_ros.wire.positions import read_positions
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.stamp import stamp_at_start

_DEPTH = 100
_MAX_BYTES = 32 * 2**20


class PositionsInput(Part):
    """
    Keeps the places of ships for the images of their stamp.

    Parameters
    ----------
    node : ManagedNode
        The node.
    on_positions : callable
        Called when positions have come.
    """

    def __init__(self, node: ManagedNode[Any], on_positions: Callable[[], object]) -> None:
        self._node, self._on_positions = node, on_positions
        # Unread: most are never needed.
        self._positions = CameraMemory[bytes](_MAX_BYTES, len)
        self._cameras = CameraMemory[tuple[float, ...]]()
        quality = reliable(_DEPTH)
        node.topics.input(PoseWithCovarianceStamped, 'image_pose', self._on_image_pose, qos=quality)
        self._topic = node.topics.input(
            Detection3DArray, 'positions', self._keep_positions, qos=quality
        )
        node.parts.append(self)

    def configure(self) -> None:
        """Forget the positions of earlier runs."""
        self._positions.clear()
        self._cameras.clear()

    def is_coming(self, stamp: Stamp) -> bool:
        """Return whether the places of the ships of an image are likely to be on their way."""
        return self._positions.is_coming(stamp)

    def places(self, stamp: Stamp) -> ShipPlaces | None:
        """
        Return where the ships of an image are; None if no positions have its stamp.

        Positions that are missing or cannot be used are counted.
        """
        found = self._positions.choice(stamp)
        if found is None:
            return None
        if not found.has_stamp:
            self._node.monitor.add('images_without_positions')
            return None
        camera = self._cameras.choice(stamp)
        place = camera.camera if camera is not None and camera.has_stamp else None
        try:
            return ShipPlaces(read_positions(found.camera), place)
        except (PoseError, WireError) as error:
            self._node.monitor.add('images_without_positions')
            self._node.reporter.warn('positions', f'{self._topic.topic_name}: {error}')
            return None

    def _keep_positions(self, data: bytes) -> None:
        """Keep positions for the image of their stamp."""
        self._positions.add(stamp_at_start(data), data, time.monotonic())
        self._on_positions()

    def _on_image_pose(self, data: bytes) -> None:
        """Keep where the camera was for the image of that stamp."""
        pose = read_pose(data, PoseWithCovarianceStamped.__name__)
        self._cameras.add(pose.stamp, pose.position, time.monotonic())
