"""Nodes to measure against: a wire, and what a user would write."""

import sys

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos import ReliabilityPolicy
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
        for detection in message.detections:
            box = detection.bbox
            cos, sin = abs(np.cos(box.center.theta)), abs(np.sin(box.center.theta))
            width = box.size_x * cos + box.size_y * sin
            height = box.size_x * sin + box.size_y * cos
            box.size_x, box.size_y, box.center.theta = float(width), float(height), 0.0
        self._publisher.publish(message)


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
