# SPDX-License-Identifier: Apache-2.0
"""Runs the nodes in separate processes and talks to them over DDS, for `obbhbb demo`."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter
from typing import Any
from typing import NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray
from visualization_msgs.msg import ImageMarker

from obbhbb_ros.colors import LAYER_COLORS
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.methods import ONBOARD_METHODS
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.nodes.demo_chain import DemoChain
from obbhbb_ros.nodes.play_detections import camera_info_message
from obbhbb_ros.nodes.play_detections import detections_message
from obbhbb_ros.nodes.play_detections import image_message
from obbhbb_ros.wire.buffer import Buffer
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.stamp import nanoseconds_of

OVERLAY_TOPIC = '/overlay/compressed'
DIAGNOSTICS_TOPIC = '/diagnostics'

_AGAIN = 0.5
# A busy machine may lose a message, and the frame of it is never complete.
_SECONDS_TO_COMPLETE = 5.0
_PERIOD = 1.25
# Pixels. Viewers refuse a camera info without a focal length.
_FOCAL_LENGTH = 2000.0

_SENT = {'/camera_info': CameraInfo, '/image': Image, '/detections': Detection2DArray}
_PER_FRAME = {
    # First, because viewers show the first image topic by default.
    OVERLAY_TOPIC: CompressedImage,
    **_SENT,
    '/boxes': Detection2DArray,
    '/crop_regions': Detection2DArray,
    **{f'/overlay/markers/{layer}': ImageMarker for layer in LAYER_COLORS},
}
_PER_LAYER = {'/overlay/markers': ImageMarker}
_PER_CHIP = {
    '/chip/compressed': CompressedImage,
    '/chip/camera_info': CameraInfo,
    '/chip/detections': Detection2DArray,
}
_TYPES = {**_PER_FRAME, **_PER_LAYER, **_PER_CHIP}
RECORDED_TOPICS = {
    topic: f'{kind.__module__.partition(".")[0]}/msg/{kind.__name__}'
    for topic, kind in {**_TYPES, DIAGNOSTICS_TOPIC: DiagnosticArray}.items()
}
"""Message type by topic of what `record_chain` records."""


class Recorded(NamedTuple):
    """
    A message as it arrived over DDS.

    Attributes
    ----------
    topic : str
        Its topic, without the namespace of the nodes.
    time : int
        When it arrived, nanoseconds since 1970.
    data : bytes
        The serialized message with its encapsulation header.
    """

    topic: str
    time: int
    data: bytes


def boxes_by_method(labels: ImageLabels) -> dict[str, FloatArray]:
    """
    Convert an image's labels with the real node, by every method that it offers.

    Parameters
    ----------
    labels : ImageLabels
        N ships.

    Returns
    -------
    dict of str to ndarray of shape (N, 4)
        x_min, y_min, x_max, y_max by method, pixels.

    Raises
    ------
    TimeoutError
        If the node does not answer in time.
    """
    # One class per method, so that a single message asks for all methods.
    message = Detection2DArray(header=Header(frame_id='camera'))
    arguments = ['-p', f'class_ids:=[{",".join(ONBOARD_METHODS)}]']
    for method in ONBOARD_METHODS:
        arguments += ['-p', f'classes.{method}.method:={method}']
        ships = replace(labels, class_ids=(method,) * len(labels.class_ids))
        message.detections += detections_message(ships, message.header).detections
    answers: list[bytes] = []
    with DemoChain({'obb_to_hbb': arguments}) as chain:
        chain.node.create_subscription(Detection2DArray, 'boxes', answers.append, 10, raw=True)
        publisher = chain.node.create_publisher(Detection2DArray, 'detections', 10)
        # Repeat it, because client and node discover each other's topics one by one.
        chain.spin_until(lambda: bool(answers), 'boxes', partial(publisher.publish, message))
    boxes = np.split(xyxy_of(answers[0]), len(ONBOARD_METHODS))
    return dict(zip(ONBOARD_METHODS, boxes, strict=True))


def xyxy_of(data: bytes) -> FloatArray:
    """Read axis-aligned boxes from a serialized message, (N, 4), pixels."""
    rows = Detections(data).xywhr()
    centers, sizes = rows[:, :2], rows[:, 2:4]
    return np.hstack((centers - sizes / 2.0, centers + sizes / 2.0))


def record_chain(frames: Sequence[tuple[ImageLabels, NDArray[np.uint8]]]) -> list[Recorded]:
    """
    Send images and their detections through the nodes.

    Parameters
    ----------
    frames : sequence of (ImageLabels, ndarray of uint8 of shape (H, W, 3))
        Labels and pixels of each image.

    Returns
    -------
    list of Recorded
        The messages sent, those from `obb_to_hbb`, `chip_extractor` and `overlay`, and the
        diagnostics of these nodes, in the order of arrival. Every frame is complete.

    Raises
    ------
    TimeoutError
        If the nodes do not answer in time.
    """
    # On a busy machine, a picture with a shorter wait would miss layers.
    nodes = {'obb_to_hbb': [], 'chip_extractor': [], 'overlay': ['-p', 'max_wait:=60.0']}
    with DemoChain(nodes) as chain:
        camera = _Camera(chain.node)
        # Discovery takes a different time for every topic.
        _send_until_complete(chain, camera, frames[0], _AGAIN)
        camera.frames.clear()
        camera.reports.clear()
        for image in frames:
            due = time.monotonic() + _PERIOD
            _send_until_complete(chain, camera, image, _SECONDS_TO_COMPLETE)
            chain.spin_for(due - time.monotonic())
    messages = itertools.chain(camera.reports, *filter(_is_complete, camera.frames.values()))
    return sorted(messages, key=attrgetter('time'))


def _send_until_complete(
    chain: DemoChain, camera: _Camera, image: tuple[ImageLabels, NDArray[np.uint8]], again: float
) -> None:
    """Send an image, and again after some seconds, until everything about one has arrived."""
    attempts: list[list[Recorded]] = []
    chain.spin_until(
        lambda: any(map(_is_complete, attempts)),
        'complete frame',
        lambda: attempts.append(camera.send(*image)),
        again,
    )


def last_overlay(messages: Sequence[Recorded]) -> bytes:
    """Return the last picture with boxes, a JPEG file."""
    *_, last = (message for message in messages if message.topic == OVERLAY_TOPIC)
    return bytes(deserialize_message(last.data, CompressedImage).data)


def _is_complete(frame: Sequence[Recorded]) -> bool:
    """Return whether every message about an image has arrived exactly once."""
    plans = (message.data for message in frame if message.topic == '/crop_regions')
    chips = sum(len(Detections(data)) for data in plans)
    expected = {
        **dict.fromkeys(_PER_FRAME, 1),
        **dict.fromkeys(_PER_LAYER, len(LAYER_COLORS)),
        **dict.fromkeys(_PER_CHIP, chips),
    }
    return Counter(message.topic for message in frame) == Counter(expected)


class _Camera:
    """
    A camera with a detector, which records all messages about its images.

    Attributes
    ----------
    frames : dict of int to list of Recorded
        The messages about each image by its stamp, in the order of the stamps.
    reports : list of Recorded
        The diagnostics of the nodes in the camera's namespace.
    """

    def __init__(self, node: Any) -> None:
        self.frames: dict[int, list[Recorded]] = {}
        self.reports: list[Recorded] = []
        self._node = node
        self._publishers = {
            topic: node.create_publisher(kind, topic.strip('/'), 100)
            for topic, kind in _SENT.items()
        }
        for topic, kind in _TYPES.items():
            receive = partial(self._receive, topic)
            node.create_subscription(kind, topic.strip('/'), receive, 1000, raw=True)
        node.create_subscription(
            DiagnosticArray, DIAGNOSTICS_TOPIC, self._receive_report, 100, raw=True
        )

    def send(self, labels: ImageLabels, pixels: NDArray[np.uint8]) -> list[Recorded]:
        """Publish an image with the present time as its stamp; return the list of its messages."""
        moment = self._node.get_clock().now()
        header = Header(stamp=moment.to_msg(), frame_id='camera')
        height, width = pixels.shape[:2]
        frame = self.frames[moment.nanoseconds] = list[Recorded]()
        k = (_FOCAL_LENGTH, 0.0, width / 2, 0.0, _FOCAL_LENGTH, height / 2, 0.0, 0.0, 1.0)
        self._publishers['/camera_info'].publish(camera_info_message(header, (width, height), k))
        self._publishers['/image'].publish(image_message('rgb8', pixels, header))
        self._publishers['/detections'].publish(detections_message(labels, header))
        return frame

    def _receive(self, topic: str, data: bytes) -> None:
        """Add a message to its frame."""
        message = Recorded(topic, time.time_ns(), bytes(data))
        stamp = nanoseconds_of(Buffer(data).stamp)
        # The stamp of a chip is that of its image plus some nanoseconds.
        image_stamp = max((taken for taken in self.frames if taken <= stamp), default=None)
        if image_stamp is not None:
            self.frames[image_stamp].append(message)

    def _receive_report(self, data: bytes) -> None:
        """Keep the diagnostics of the nodes in this namespace; the topic is that of all nodes."""
        namespace = self._node.get_namespace().lstrip('/')
        statuses = deserialize_message(data, DiagnosticArray).status
        if all(status.name.startswith(f'{namespace}/') for status in statuses):
            self.reports.append(Recorded(DIAGNOSTICS_TOPIC, time.time_ns(), bytes(data)))
