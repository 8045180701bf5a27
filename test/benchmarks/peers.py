# SPDX-License-Identifier: Apache-2.0
"""Nodes to measure against: a wire, and what a user would write."""

import math
import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos import ReliabilityPolicy
from vision_msgs.msg import Detection2D
from vision_msgs.msg import Detection2DArray

BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


class RawEcho(Node):
    """Publishes the bytes that it gets: the floor."""

    def __init__(self) -> None:
        super().__init__('echo')
        publisher = self.create_publisher(Detection2DArray, 'boxes', 10)
        self.create_subscription(
            Detection2DArray, 'detections', publisher.publish, BEST_EFFORT, raw=True
        )


class TypedMinMax(Node):
    """Encloses the corners of each detection, one message object after another."""

    def __init__(self) -> None:
        super().__init__('typed')
        self._publisher = self.create_publisher(Detection2DArray, 'boxes', 10)
        self.create_subscription(Detection2DArray, 'detections', self._convert, BEST_EFFORT)

    def _convert(self, message: Detection2DArray) -> None:
        answer = Detection2DArray(header=message.header)
        for detection in message.detections:
            box = detection.bbox
            cos, sin = math.cos(box.center.theta), math.sin(box.center.theta)
            half_x, half_y = box.size_x / 2, box.size_y / 2
            x, y = zip(
                *(
                    (u * half_x * cos - v * half_y * sin, u * half_x * sin + v * half_y * cos)
                    for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1))
                ),
                strict=True,
            )
            converted = Detection2D(header=detection.header, id=detection.id)
            converted.results = detection.results
            converted.bbox.center.position.x = box.center.position.x
            converted.bbox.center.position.y = box.center.position.y
            converted.bbox.size_x = max(x) - min(x)
            converted.bbox.size_y = max(y) - min(y)
            answer.detections.append(converted)
        self._publisher.publish(answer)


def main() -> None:
    """Run the peer that the first argument names."""
    rclpy.init()
    node = {'echo': RawEcho, 'typed': TypedMinMax}[sys.argv[1]]()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        executor.shutdown()


if __name__ == '__main__':
    main()
