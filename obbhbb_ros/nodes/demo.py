# SPDX-License-Identifier: Apache-2.0
"""What the demonstration asks of the node."""

from __future__ import annotations

import numpy as np
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.methods import ONBOARD_METHODS
from obbhbb_ros.nodes.play_detections import detections_message
from obbhbb_ros.nodes.remote import RemoteConverter


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
    """
    message = detections_message(labels, Header(frame_id='camera'))
    boxes = {}
    with RemoteConverter() as node:
        for method in ONBOARD_METHODS:
            node.set_parameters({'method': method})
            boxes[method] = xyxy_of(node.convert(message))
    return boxes


def xyxy_of(message: Detection2DArray) -> FloatArray:
    """Read axis-aligned boxes from a message, (N, 4), pixels."""
    rows = np.array([
        (d.bbox.center.position.x, d.bbox.center.position.y, d.bbox.size_x, d.bbox.size_y)
        for d in message.detections
    ]).reshape(-1, 4)
    return np.hstack((rows[:, :2] - rows[:, 2:] / 2.0, rows[:, :2] + rows[:, 2:] / 2.0))
