# SPDX-License-Identifier: Apache-2.0
"""The input of images, which may travel as files."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.qos import QoSProfile
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image

from obbhbb_ros.downlink.decoding import AnyImage
from obbhbb_ros.nodes.lifecycle.node_topics import NodeTopics
from obbhbb_ros.nodes.lifecycle.node_topics import TopicInput
from obbhbb_ros.settings.common import IMAGE_TRANSPORT
from obbhbb_ros.wire.image import read_compressed_image
from obbhbb_ros.wire.image import read_image


def image_input(
    topics: NodeTopics,
    callback: Callable[[AnyImage], object],
    qos: QoSProfile,
    on_demand: bool = False,
) -> TopicInput:
    """
    Add the input of images to a node that has the parameter `image_transport`.

    Parameters
    ----------
    topics : NodeTopics
        The topics of the node.
    callback : callable
        Handles an image; it is not decoded yet.
    qos : QoSProfile
        Quality of service.
    on_demand : bool
        As in `NodeTopics.input`.
    """
    kind: Any = Image
    topic = 'image'
    read: Callable[[bytes], AnyImage] = read_image
    if topics.node.get_parameter(IMAGE_TRANSPORT.name).value == 'compressed':
        # As `image_transport` does: behind the name of the image after namespace and remaps.
        topic = f'{topics.node.resolve_topic_name(topic)}/compressed'
        kind, read = CompressedImage, read_compressed_image

    def receive(data: bytes) -> None:
        callback(read(data))

    return topics.input(kind, topic, receive, 'images_received', qos, on_demand)
