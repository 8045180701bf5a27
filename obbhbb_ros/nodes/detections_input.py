# SPDX-License-Identifier: Apache-2.0
"""The input of the nodes that read oriented detections, and the camera of each message."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any
from typing import NamedTuple
from typing import TypeAlias

from sensor_msgs.msg import CameraInfo

from obbhbb_ros.downlink.cameras import CameraChoice
from obbhbb_ros.downlink.cameras import CameraMemory
from obbhbb_ros.downlink.frame_queue import FrameQueue
from obbhbb_ros.downlink.joiner import CAMERAS_KEPT
from obbhbb_ros.nodes.lifecycle.managed import ManagedNode
from obbhbb_ros.nodes.lifecycle.node_topics import reliable
from obbhbb_ros.nodes.lifecycle.parts import Part
from obbhbb_ros.pipeline.outcome import SAID_ONCE
from obbhbb_ros.pipeline.outcome import Outcome
from obbhbb_ros.wire.camera import WireCamera
from obbhbb_ros.wire.camera import read_camera
from obbhbb_ros.wire.layouts import INPUT_TYPES
from obbhbb_ros.wire.layouts import InputType
from obbhbb_ros.wire.stamp import Stamp
from obbhbb_ros.wire.stamp import stamp_at_start

Answer: TypeAlias = Callable[[bytes, InputType, CameraChoice[WireCamera] | None], Outcome]
# What waits is bounded by bytes as well.
_MAX_WAITING = 32 * 2**20


class Waits(NamedTuple):
    """
    What messages wait for.

    Attributes
    ----------
    is_coming : callable
        Returns whether what belongs to a stamp is on its way.
    max_age : callable
        Returns for how long they wait at most, seconds.
    """

    is_coming: Callable[[Stamp], bool]
    max_age: Callable[[], float]


class DetectionsInput(Part):
    """
    Reads `detections` or `polygons`, and `camera_info`.

    It is the last part of its node, and counts and reports what becomes of a message.

    Parameters
    ----------
    node : ManagedNode
        The node, with the parameter `input_type`.
    answer : callable
        Takes a message, its type and the camera of its image; publishes what comes of it.
    waits : Waits, optional
        What a message waits for; nothing by default.
    needs_camera : bool
        Whether the node can do nothing without `camera_info`, so that its absence is reported.
    """

    def __init__(
        self,
        node: ManagedNode[Any],
        answer: Answer,
        waits: Waits | None = None,
        needs_camera: bool = False,
    ) -> None:
        self._node, self._answer, self._waits = node, answer, waits
        self._waiting = FrameQueue[bytes](waits.is_coming) if waits else None
        self._input_type = INPUT_TYPES[node.get_parameter('input_type').value]
        # First, so that the node knows an image size that was published before the detections.
        cameras = reliable(CAMERAS_KEPT)
        node.topics.input(
            CameraInfo, 'camera_info', self._on_camera_info, qos=cameras, optional=not needs_camera
        )
        self._detections = node.topics.input(
            self._input_type, self._input_type.topic, self._on_message, 'messages_received'
        )
        node.parts.append(self)

    def configure(self) -> None:
        """Forget the cameras."""
        self._cameras = CameraMemory[WireCamera]()

    def deactivate(self) -> None:
        """Drop the messages that wait."""
        while self._waiting:
            self._waiting.pop()
            self._node.monitor.add('messages_dropped.deactivated')

    def catch_up(self) -> None:
        """Answer the messages that wait for nothing any more, or have waited long enough."""
        if self._waiting and self._waits:
            now, max_age = time.monotonic(), self._waits.max_age()
            for data in self._waiting.ready(now, max_age, _MAX_WAITING):
                self._serve(data)

    def _on_camera_info(self, data: bytes) -> None:
        """Keep the camera for the detections of its stamp."""
        camera = read_camera(data)
        self._cameras.add(camera.stamp, camera, time.monotonic())

    def _on_message(self, data: bytes) -> None:
        """Answer a message, or let it wait."""
        if self._waiting is None:
            self._serve(data)
            return
        self._waiting.add(stamp_at_start(data), data, len(data), time.monotonic())
        self.catch_up()

    def _serve(self, data: bytes) -> None:
        """Answer a message; count and report what became of it."""
        started = time.perf_counter()
        camera = self._cameras.choice(stamp_at_start(data))
        outcome = self._answer(data, self._input_type, camera)
        monitor, reporter = self._node.monitor, self._node.reporter
        monitor.counts.update(outcome.counts)
        if 'messages_without_subscriber' in outcome.counts:
            return
        for kind, text in outcome.complaints.items():
            said = f'{self._detections.topic_name}: {text}'
            if kind in SAID_ONCE:
                reporter.warn_once(said)
            else:
                reporter.warn(kind, said)
        monitor.took(time.perf_counter() - started)
