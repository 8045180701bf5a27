# SPDX-License-Identifier: Apache-2.0
"""A player: publishes label files as detections, to try the nodes without a detector."""

from __future__ import annotations

import operator
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from obbhbb_ros.labels.image_labels import ImageSize
from obbhbb_ros.nodes.lifecycle.given_parameters import report_unknown
from obbhbb_ros.nodes.lifecycle.live_parameters import LiveParameters
from obbhbb_ros.nodes.lifecycle.node_topics import create_output
from obbhbb_ros.nodes.lifecycle.node_topics import message_type
from obbhbb_ros.nodes.played_frames import PlayedFrame
from obbhbb_ros.nodes.played_frames import PlayedFrames
from obbhbb_ros.nodes.player_messages import MESSAGES
from obbhbb_ros.nodes.player_messages import camera_info_message
from obbhbb_ros.nodes.player_messages import forget_ids
from obbhbb_ros.nodes.player_messages import image_message
from obbhbb_ros.nodes.player_messages import pose_message
from obbhbb_ros.settings.play_detections import PLAY_DETECTIONS
from obbhbb_ros.settings.play_detections import PlayerSettings
from obbhbb_ros.wire.layouts import INPUT_TYPES

_POLL_PERIOD = 0.1
_QUIET_POLLS = 3
_DEPTH = 100


class PlayDetections(Node):
    """
    Node `play_detections`: one message per image, at a rate, once or looped.

    Publishes `detections` or `polygons`, `camera_info` where the image's size is known, `image`
    where there are image files, and `camera_pose` in a pass at an altitude.

    Parameters
    ----------
    **kwargs
        Passed to `rclpy.node.Node`.

    Raises
    ------
    ValueError, OSError, rclpy.exceptions.ParameterException
        If the parameters or the label files cannot be used.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('play_detections', **kwargs)
        self._live_parameters = LiveParameters[PlayerSettings](self, PLAY_DETECTIONS)
        report_unknown(self, self._live_parameters.unknown)
        settings = self._live_parameters.settings
        self._output_type = INPUT_TYPES[settings.output_type]
        self._frames = PlayedFrames(settings, self.get_logger())
        self._position = 0
        self._subscribers: list[int] = []
        self._quiet_polls = 0
        self._publisher = create_output(
            self, message_type(self._output_type), self._output_type.topic, _DEPTH
        )
        self._camera_publisher = create_output(self, CameraInfo, 'camera_info', _DEPTH)
        self._pose_publisher = (
            create_output(self, PoseStamped, 'camera_pose', _DEPTH)
            if settings.pass_altitude
            else None
        )
        # Without image files the topic has no publisher, so that its subscribers can say so.
        missing = self._frames.without_file
        self._image_publisher = (
            create_output(self, Image, 'image', depth=4) if missing < len(self._frames) else None
        )
        if missing:
            self.get_logger().info(
                f'{missing} of {len(self._frames)} images have no file: only their labels are '
                'published'
            )
        self._timer = self.create_timer(_POLL_PERIOD, self._begin)

    def _begin(self) -> None:
        """Wait for the subscribers, then play."""
        settings = self._live_parameters.settings
        wanted = settings.wait_for_subscribers
        if self._publisher.get_subscription_count() < wanted:
            self.get_logger().info(
                f'waiting for {wanted} subscriber(s) of {self._publisher.topic_name}',
                throttle_duration_sec=5.0,
            )
            return
        if not self._subscribers_are_connected():
            return
        self.destroy_timer(self._timer)
        self._timer = self.create_timer(1.0 / settings.rate, self._play_next)
        self._play_next()

    def _subscribers_are_connected(self) -> bool:
        """Return whether all subscribers are connected, and none has come for a while."""
        outputs = (
            self._publisher,
            self._camera_publisher,
            self._pose_publisher,
            self._image_publisher,
        )
        publishers = [publisher for publisher in outputs if publisher is not None]
        counts = [publisher.get_subscription_count() for publisher in publishers]
        subscribers = [self.count_subscribers(publisher.topic_name) for publisher in publishers]
        complete = subscribers == self._subscribers and all(map(operator.ge, counts, subscribers))
        self._quiet_polls = self._quiet_polls + 1 if complete else 0
        self._subscribers = subscribers
        return self._quiet_polls >= _QUIET_POLLS

    def _play_next(self) -> None:
        """Publish the next image's labels, or end."""
        settings = self._live_parameters.settings
        if self._position == len(self._frames):
            if not settings.loop:
                self._end()
                return
            self._position = 0
        frame = self._frames[self._position]
        labels, file = frame.labels, frame.file
        self._position += 1
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=settings.frame_id)
        picture = self._frames.picture(frame) if file and settings.images else None
        image = image_message(*picture, header) if picture else None
        size = labels.size or (image and (image.width, image.height))
        # Before the labels, because a node that plans crops needs the size first.
        if size:
            self._publish_camera(frame, size, header)
        if image and self._image_publisher is not None:
            self._image_publisher.publish(image)
        for message in MESSAGES[self._output_type.name](labels, header, settings.bow):
            if frame.top is not None:
                forget_ids(message)
            self._publisher.publish(message)

    def _publish_camera(self, frame: PlayedFrame, size: ImageSize, header: Header) -> None:
        """Publish what is known of the camera of an image of a size."""
        flight, top, height = frame.flight, frame.top, size[1]
        k = () if flight is None else flight.k(height)
        self._camera_publisher.publish(camera_info_message(header, size, k))
        if self._pose_publisher is not None and flight is not None and top is not None:
            self._pose_publisher.publish(pose_message(flight.pose(top, height), header))

    def _end(self) -> None:
        """End when everything is delivered."""
        self._publisher.wait_for_all_acked(Duration(seconds=5))
        skipped, outside = self._frames.skipped, self._frames.outside
        self.get_logger().info(
            f'played {len(self._frames)} images, skipped {skipped} malformed records'
            + (f' and {outside} labels outside their image' if outside else '')
        )
        self.context.try_shutdown()
