# SPDX-License-Identifier: Apache-2.0
"""The file that `obbhbb calibrate` writes starts the node, whose boxes are those of the study."""

import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.boxes import OrientedBoxes
from obbhbb_ros.converter import HullRule
from obbhbb_ros.nodes.demo import xyxy_of
from obbhbb_ros.nodes.play_detections import detections_message
from obbhbb_ros.study.harbour import harbour
from obbhbb_ros.study.parameter_file import yaml_text
from obbhbb_ros.study.rules import convert_by_class
from obbhbb_ros.study.ships import Ships

PATIENCE = 30.0
RULE = HullRule('superellipse', 3.5058, 1.0037, 0.995)
OWN = {
    'tug': HullRule('shape_aware', 2.2, 0.9, 1.0),
    'cargo': HullRule('superellipse', np.inf, 1.0, 1.0204),
    'bow_stern 0.60': HullRule('superellipse', 2.0, 0.9, 1.0),
}


@pytest.mark.parametrize('own', [{}, OWN], ids=['one rule', 'rules by class'])
def test_a_calibrated_node_gives_the_boxes_of_the_study(own, tmp_path) -> None:
    path = tmp_path / 'params.yaml'
    path.write_text(yaml_text(RULE, own, ['Written by: a test']), encoding='utf-8')
    labels = rectangular(harbour())
    boxes = xyxy_of(converted(detections_message(labels, Header(frame_id='camera')), path))
    expected = convert_by_class(Ships.from_labels([labels]), RULE, own)
    np.testing.assert_allclose(boxes, expected, rtol=0, atol=1e-9)


def rectangular(labels):
    """Square the corners, which the file rounds: a message has centre, size and angle only."""
    boxes = OrientedBoxes.from_corners(labels.corners)
    rows = np.column_stack((*boxes.center, boxes.length, boxes.width, boxes.theta))
    return replace(labels, corners=OrientedBoxes.from_xywhr(rows).corners)


def converted(message, path):
    """Send a message to a node that was started with a parameter file."""
    namespace = '/test_calibrated_node'
    process = subprocess.Popen([
        sys.executable, '-m', 'obbhbb_ros.nodes', 'obb_to_hbb', '--ros-args',
        '--params-file', str(path), '-r', f'__ns:={namespace}',
    ])
    context, answers = Context(), []
    rclpy.init(context=context)
    node = rclpy.create_node('client', namespace=namespace, context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        node.create_subscription(Detection2DArray, 'boxes', answers.append, QoSProfile(depth=10))
        publisher = node.create_publisher(Detection2DArray, 'detections', QoSProfile(depth=10))
        deadline = time.monotonic() + PATIENCE
        while not answers and process.poll() is None and time.monotonic() < deadline:
            # Again and again: who has found whom yet is not known.
            publisher.publish(message)
            executor.spin_once(timeout_sec=0.2)
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(PATIENCE)
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)
    assert answers, 'the node gave no boxes'
    return answers[0]
