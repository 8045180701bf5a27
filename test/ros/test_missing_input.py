# SPDX-License-Identifier: Apache-2.0
"""A node without input says why, if that can be known."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from harness import ChipNode
from harness import Converter
from harness import Site
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import CompressedImage
from ships import detections
from ships import fleet
from vision_msgs.msg import Detection2DArray
from yolo_msgs.msg import DetectionArray

# These tests depend on rclpy alone, which is the same in all environments.
pytestmark = pytest.mark.once


def test_a_detector_with_another_message_type_is_reported(
    start: Callable[..., Converter],
) -> None:
    arguments = ['-r', 'detections:=/drone/yolo/detections']
    node = start(arguments=arguments)
    node.peer.node.create_publisher(DetectionArray, '/drone/yolo/detections', 10)
    text = (
        '/drone/yolo/detections carries yolo_msgs/DetectionArray, this node reads '
        'Detection2DArray: set input_type to DetectionArray'
    )
    assert 'WARN' in node.wait_for_log(text)
    node.wait(lambda: node.warned(text), 'the level')


def test_compressed_images_on_the_topic_of_plain_ones_are_reported(site: Site) -> None:
    with ChipNode(site) as node:
        node.peer.node.create_publisher(CompressedImage, 'image', 10)
        node.wait_for_log(
            'carries sensor_msgs/CompressedImage', 'set image_transport to compressed'
        )


def test_a_topic_without_a_publisher_is_reported_once_and_in_the_diagnostics(
    start: Callable[..., Converter],
) -> None:
    node = start()
    line = node.wait_for_log(f'nobody publishes on {node.namespace}/detections')
    assert 'Detection2DArray' in line
    message = f'active, nobody publishes on {node.namespace}/detections'
    for _ in range(3):
        status = node.next_report()
        assert (status.level, status.message) == (DiagnosticStatus.OK, message)
    assert node.process.log.count('nobody publishes') == 1
    node.connect()
    node.wait(lambda: node.next_report().message == 'active', 'the end of it')
    node.convert(detections(fleet(2)))


def test_without_input_in_time_the_reason_is_in_the_diagnostics(
    start: Callable[..., Converter],
) -> None:
    node = start(parameters={'input_timeout': 1.0})
    reason = f'nobody publishes on {node.namespace}/detections'

    def is_explained() -> bool:
        status = node.next_report()
        return status.level >= DiagnosticStatus.ERROR and reason in status.message

    node.wait(is_explained, 'the reason')
    node.peer.node.create_publisher(DetectionArray, 'detections', 10)
    reason = 'carries yolo_msgs/DetectionArray'
    node.wait(is_explained, 'the other reason')


def test_outputs_of_the_package_are_not_proposed_as_input(start: Callable[..., Converter]) -> None:
    node = start()
    for topic in ('chip/detections', 'left/crop_regions', 'yolo'):
        node.peer.node.create_publisher(Detection2DArray, topic, 10)
    line = node.wait_for_log(f'nobody publishes on {node.namespace}/detections')
    assert line.endswith(f'; remap it to {node.namespace}/yolo?')


def test_the_compressed_topic_is_named_if_nobody_publishes_on_the_plain_one(site: Site) -> None:
    with ChipNode(site) as node:
        node.peer.node.create_publisher(CompressedImage, 'image/compressed', 10)
        node.wait_for_log(f'nobody publishes on {node.namespace}/image', 'set image_transport')


def test_a_tracker_that_places_ships_says_which_camera_info_it_may_read(
    start: Callable[..., Converter],
) -> None:
    node = start(
        parameters={'pose_type': 'PoseStamped'},
        executable='ship_tracker',
        topic='tracked_detections',
    )
    node.peer.node.create_publisher(CameraInfo, 'camera/camera_info', 10)
    line = node.wait_for_log(f'nobody publishes on {node.namespace}/camera_info')
    assert line.endswith(f'; remap it to {node.namespace}/camera/camera_info?')
