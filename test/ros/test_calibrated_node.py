# SPDX-License-Identifier: Apache-2.0
"""The file that `obbhbb calibrate` writes starts the node, whose boxes are those of the study."""

from dataclasses import replace

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from std_msgs.msg import Header

from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.nodes.demo import xyxy_of
from obbhbb_ros.nodes.player_messages import detections_message
from obbhbb_ros.study.harbour import harbour
from obbhbb_ros.study.rule_file import yaml_text

RULE = HullRule('superellipse', 3.5058, 1.0037, 0.995)
OWN = {
    'tug': HullRule('shape_aware', 2.2, 0.9, 1.0),
    'cargo': HullRule('superellipse', np.inf, 1.0, 1.0204),
    'bow_stern 0.60': HullRule('superellipse', 2.0, 0.9, 1.0),
}


@pytest.mark.parametrize('own', [{}, OWN], ids=['one rule', 'rules by class'])
def test_a_calibrated_node_gives_the_boxes_of_the_study(start, own, tmp_path) -> None:
    path = tmp_path / 'params.yaml'
    path.write_text(yaml_text(RULE, own, ['Written by: a test']), encoding='utf-8')
    labels = rectangular(harbour())
    node = start(arguments=['--params-file', str(path)])
    node.connect()
    answer = node.convert(detections_message(labels, Header(frame_id='camera')))
    boxes = xyxy_of(serialize_message(answer))
    rules = [own.get(class_id, RULE) for class_id in labels.class_ids]
    oriented = OrientedBoxes.from_corners(labels.corners)
    expected = [convert_by_rule(oriented, rule)[row] for row, rule in enumerate(rules)]
    np.testing.assert_allclose(boxes, expected, rtol=0, atol=1e-9)


def rectangular(labels):
    """Square the corners, which the file rounds: a message has centre, size and angle only."""
    boxes = OrientedBoxes.from_corners(labels.corners)
    rows = boxes.xywhr
    return replace(labels, corners=OrientedBoxes.from_xywhr(rows).corners)
