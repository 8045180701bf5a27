# SPDX-License-Identifier: Apache-2.0
"""The node in a process of its own, asked over DDS, for `obbhbb demo`."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.methods import ONBOARD_METHODS
from obbhbb_ros.nodes.play_detections import detections_message

_TIMEOUT = 20.0


def boxes_by_method(labels: ImageLabels) -> dict[str, FloatArray]:
    """
    Convert an image's labels with the real node, once with each method it offers.

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
    # One class per method, so that one message asks for all.
    message = Detection2DArray(header=Header(frame_id='camera'))
    arguments = ['-p', f'class_ids:=[{",".join(ONBOARD_METHODS)}]']
    for method in ONBOARD_METHODS:
        arguments += ['-p', f'classes.{method}.method:={method}']
        ships = replace(labels, class_ids=(method,) * len(labels.class_ids))
        message.detections += detections_message(ships, message.header).detections
    boxes = xyxy_of(_converted(message, arguments))
    return dict(zip(ONBOARD_METHODS, np.split(boxes, len(ONBOARD_METHODS)), strict=True))


def xyxy_of(message: Detection2DArray) -> FloatArray:
    """Read axis-aligned boxes from a message, (N, 4), pixels."""
    rows = np.array([
        (d.bbox.center.position.x, d.bbox.center.position.y, d.bbox.size_x, d.bbox.size_y)
        for d in message.detections
    ]).reshape(-1, 4)
    return np.hstack((rows[:, :2] - rows[:, 2:] / 2.0, rows[:, :2] + rows[:, 2:] / 2.0))


def _converted(message: Detection2DArray, arguments: list[str]) -> Detection2DArray:
    """Start `obb_to_hbb` with parameters, send it a message and wait for the boxes."""
    namespace = f'/obbhbb_{os.getpid()}'
    process = subprocess.Popen([
        sys.executable, '-m', 'obbhbb_ros.nodes', 'obb_to_hbb',
        '--ros-args', '-r', f'__ns:={namespace}', *arguments,
    ])
    answers: list[Detection2DArray] = []
    context = Context()
    try:
        rclpy.init(context=context)
        client = rclpy.create_node('client', namespace=namespace, context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(client)
        client.create_subscription(Detection2DArray, 'boxes', answers.append, 10)
        publisher = client.create_publisher(Detection2DArray, 'detections', 10)
        deadline = time.monotonic() + _TIMEOUT
        while not answers:
            if process.poll() is not None or time.monotonic() > deadline:
                raise TimeoutError('the node sends no boxes')
            # Again and again: client and node find each other's topics one after the other.
            publisher.publish(message)
            executor.spin_once(timeout_sec=0.2)
        executor.shutdown()
        client.destroy_node()
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(_TIMEOUT)
        rclpy.try_shutdown(context=context)
    return answers[0]
