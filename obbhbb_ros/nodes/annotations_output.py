# SPDX-License-Identifier: Apache-2.0
"""The output of annotations, which needs a package that may be missing."""

from __future__ import annotations

from obbhbb_ros.nodes.lifecycle.monitor import Monitor
from obbhbb_ros.nodes.lifecycle.node_topics import NodeTopics
from obbhbb_ros.nodes.lifecycle.node_topics import message_class
from obbhbb_ros.overlay.overlay_frame import OverlayFrame
from obbhbb_ros.wire.image_annotations import MESSAGES
from obbhbb_ros.wire.image_annotations import AnnotationWriter


class AnnotationsOutput:
    """
    Publishes frames as `foxglove_msgs/ImageAnnotations` on `overlay/annotations`.

    Parameters
    ----------
    topics : NodeTopics
        The topics of the node.
    monitor : Monitor
        Counts the messages.

    Attributes
    ----------
    output : TopicOutput
        The topic.

    Raises
    ------
    ModuleNotFoundError
        If foxglove_msgs is not installed.
    obbhbb_ros.wire.image_annotations.UnknownFieldsError
        If the installed foxglove_msgs has fields that are not known.
    """

    def __init__(self, topics: NodeTopics, monitor: Monitor) -> None:
        kinds = {name: message_class('foxglove_msgs', name) for name in MESSAGES}
        self._writer = AnnotationWriter(
            {name: kind.get_fields_and_field_types() for name, kind in kinds.items()}
        )
        self.output = topics.output(kinds['ImageAnnotations'], 'overlay/annotations')
        self._monitor = monitor

    def send(self, frame: OverlayFrame) -> None:
        """Publish the annotations of a frame."""
        annotations = frame.annotations()
        self.output.publish(
            self._writer.write(frame.image.stamp, annotations.strokes, annotations.captions)
        )
        self._monitor.add('annotations_sent')
        self._monitor.add('labels_left_out', annotations.labels_left_out)
