# SPDX-License-Identifier: Apache-2.0
"""A player: publishes label files as detections, to try the nodes without a detector."""

from __future__ import annotations

import operator
from array import array
from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import as_file
from importlib.resources import files
from pathlib import Path
from typing import Any
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import Point32
from geometry_msgs.msg import Polygon
from geometry_msgs.msg import PolygonStamped
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from vision_msgs.msg import Detection2D
from vision_msgs.msg import Detection2DArray
from vision_msgs.msg import ObjectHypothesisWithPose

from obbhbb_ros.data import HARBOUR
from obbhbb_ros.data import HARBOUR_SIZE
from obbhbb_ros.earth.pose import CameraPose
from obbhbb_ros.earth.pose_source import EARTH
from obbhbb_ros.earth.straight_pass import StraightPass
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels.image_files import find_images
from obbhbb_ros.labels.image_files import load_image
from obbhbb_ros.labels.image_files import size_of_file
from obbhbb_ros.labels.image_labels import BowSource
from obbhbb_ros.labels.image_labels import ImageSize
from obbhbb_ros.labels.passes import inside_image
from obbhbb_ros.labels.passes import pass_over
from obbhbb_ros.nodes.given_parameters import report_unknown
from obbhbb_ros.nodes.live_parameters import LiveParameters
from obbhbb_ros.nodes.node_topics import create_output
from obbhbb_ros.nodes.node_topics import message_type
from obbhbb_ros.settings.play_detections import PLAY_DETECTIONS
from obbhbb_ros.settings.play_detections import PlayerSettings
from obbhbb_ros.wire.layouts import INPUT_TYPES

_POLL_PERIOD = 0.1
_QUIET_POLLS = 3
_DEPTH = 100


class _Frame(NamedTuple):
    """
    Labels to play, and the file of their image.

    Of a pass also the row at which the window begins, and the way of the camera if it has a pose.
    """

    labels: ImageLabels
    file: Path | None
    top: int | None = None
    flight: StraightPass | None = None


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
        self._skipped = self._outside = 0
        self._images = list(self._read(settings))
        if not self._images:
            raise ValueError(f'no image to play in {settings.path}')
        self._frames = list(self._framed(settings))
        self._files = [frame.file for frame in self._frames]
        self._picture: tuple[Path, str, NDArray[Any]] | None = None
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
        self._image_publisher = (
            create_output(self, Image, 'image', depth=4) if any(self._files) else None
        )
        if missing := self._files.count(None):
            self.get_logger().info(
                f'{missing} of {len(self._files)} images have no file: only their labels are '
                'published'
            )
        self._timer = self.create_timer(_POLL_PERIOD, self._begin)

    def _read(self, settings: PlayerSettings) -> Iterator[ImageLabels]:
        """Read the labels; malformed records are reported, counted and left out."""
        size = (settings.image_width, settings.image_height)
        if settings.path:
            yield from read_labels(
                Path(settings.path).expanduser(),
                settings.format or None,
                image_size=size if all(size) else None,
                on_error=self._skip,
            )
        else:
            with as_file(files('obbhbb_ros') / 'data' / HARBOUR) as path:
                yield from read_labels(path, image_size=HARBOUR_SIZE)

    def _framed(self, settings: PlayerSettings) -> Iterator[_Frame]:
        """List what is played: whole images, or the windows of a pass over each."""
        for labels, file in zip(self._images, find_images(self._images), strict=True):
            if not settings.pass_height:
                yield _Frame(labels, file)
                continue
            sighted = self._in_sight(labels, file)
            flight = _flight(settings, sighted.size)
            for top, seen in pass_over(sighted, settings.pass_height, settings.pass_step):
                yield _Frame(seen, file, top, flight)

    def _in_sight(self, labels: ImageLabels, file: Path | None) -> ImageLabels:
        """Give labels the size of their image file; leave out, and report, those outside it."""
        size = labels.size
        if file is not None:
            try:
                size = size_of_file(file)
            except ValueError as error:
                self.get_logger().error(f'no image: {error}')
        if labels.size and labels.size != size:
            self.get_logger().warning(
                f'{file} has {_pixels(size)}, its labels say {_pixels(labels.size)}: the pass is '
                'over the file'
            )
        sized = replace(labels, size=size)
        seen = inside_image(sized)
        if left := len(labels.class_ids) - len(seen.class_ids):
            self._outside += left
            self.get_logger().warning(
                f'{labels.source}: image {labels.image!r}: {left} labels are outside it and are '
                'not played'
            )
        return seen

    def _skip(self, error: LabelError) -> None:
        """Log and count a malformed record."""
        self._skipped += 1
        self.get_logger().error(f'skipped: {error}')

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
        image = self._read_image(frame, header) if file and settings.images else None
        size = labels.size or (image and (image.width, image.height))
        # Before the labels, because a node that plans crops needs the size first.
        if size:
            self._publish_camera(frame, size, header)
        if image and self._image_publisher is not None:
            self._image_publisher.publish(image)
        for message in _MESSAGES[self._output_type.name](labels, header, settings.bow):
            if frame.top is not None:
                _forget_ids(message)
            self._publisher.publish(message)

    def _publish_camera(self, frame: _Frame, size: ImageSize, header: Header) -> None:
        """Publish what is known of the camera of an image of a size."""
        flight, top, height = frame.flight, frame.top, size[1]
        k = () if flight is None else flight.k(height)
        self._camera_publisher.publish(camera_info_message(header, size, k))
        if self._pose_publisher is not None and flight is not None and top is not None:
            self._pose_publisher.publish(_pose_message(flight.pose(top, height), header))

    def _read_image(self, frame: _Frame, header: Header) -> Image | None:
        """Read the image of a frame; None if it cannot be read."""
        file = frame.file
        if file is None:
            return None
        try:
            if self._picture is None or self._picture[0] != file:
                self._picture = (file, *load_image(file))
        except (ImportError, OSError, ValueError) as error:
            self.get_logger().error(f'no image: {file}: {error}', throttle_duration_sec=5.0)
            return None
        _, encoding, pixels = self._picture
        if frame.top is not None and frame.labels.size is not None:
            width, height = frame.labels.size
            pixels = pixels[frame.top : frame.top + height]
            # The file may have changed, or its size may be written in another way than it is shown.
            if pixels.shape[:2] != (height, width):
                self.get_logger().error(
                    f'no image: {file}: its size is not the one it had at the start',
                    throttle_duration_sec=5.0,
                )
                return None
        return image_message(encoding, pixels, header)

    def _end(self) -> None:
        """End when everything is delivered."""
        self._publisher.wait_for_all_acked(Duration(seconds=5))
        self.get_logger().info(
            f'played {len(self._frames)} images, skipped {self._skipped} malformed records'
            + (f' and {self._outside} labels outside their image' if self._outside else '')
        )
        self.context.try_shutdown()


def _pixels(size: ImageSize | None) -> str:
    """Write a size."""
    return '{} x {} pixels'.format(*size) if size else 'an unknown size'


def _flight(settings: PlayerSettings, size: ImageSize | None) -> StraightPass | None:
    """Return how the camera flies over an image, if it has a pose."""
    if not settings.pass_altitude or size is None:
        return None
    return StraightPass(
        settings.pass_latitude,
        settings.pass_longitude,
        settings.pass_altitude,
        settings.pass_ground_sample_distance,
        size,
    )


def _pose_message(pose: CameraPose, header: Header) -> PoseStamped:
    """Write a pose of the camera, in frame `earth`, with the stamp of its image."""
    message = PoseStamped(header=Header(stamp=header.stamp, frame_id=EARTH))
    place, attitude = message.pose.position, message.pose.orientation
    place.x, place.y, place.z = pose.position.tolist()
    attitude.x, attitude.y, attitude.z, attitude.w = pose.attitude.tolist()
    return message


def camera_info_message(header: Header, size: ImageSize, k: Sequence[float] = ()) -> CameraInfo:
    """Describe a camera without distortion by width, height and K, nine numbers; none: unknown."""
    width, height = size
    if not k:
        return CameraInfo(header=header, width=width, height=height)
    return CameraInfo(
        header=header,
        width=width,
        height=height,
        distortion_model='plumb_bob',
        d=[0.0] * 5,
        k=k,
        r=np.eye(3).ravel(),
        p=np.column_stack((np.reshape(k, (3, 3)), np.zeros(3))).ravel(),
    )


def _forget_ids(message: Any) -> None:
    """Clear the ids of a message: a detector does not recognise a ship that it sees again."""
    for detection in getattr(message, 'detections', ()):
        detection.id = ''


def detections_message(
    labels: ImageLabels, header: Header, bow: BowSource = 'none'
) -> Detection2DArray:
    """
    Write an image's labels as oriented detections, in the same order.

    The id is `image/instance`; the instance is an index if the labels have no name for it. With
    `bow`, theta points to the bow; if the bow is unknown, the size along theta is the width.
    """
    message = Detection2DArray(header=header)
    for i, (x, y, length, width, theta) in enumerate(_xywhr(labels, bow).tolist()):
        detection = Detection2D(header=header, id=f'{labels.image}/{labels.ids[i] or i}')
        center, box = detection.bbox.center, detection.bbox
        center.position.x, center.position.y, center.theta = x, y, theta
        box.size_x, box.size_y = length, width
        result = ObjectHypothesisWithPose()
        result.hypothesis.class_id = labels.class_ids[i]
        result.hypothesis.score = float(labels.scores[i])
        detection.results.append(result)
        message.detections.append(detection)
    return message


def _xywhr(labels: ImageLabels, bow: BowSource) -> FloatArray:
    """Write boxes as `OrientedBoxes.from_xywhr` reads them, (N, 5)."""
    boxes = labels.boxes(bow)
    rows = boxes.xywhr
    if bow == 'first-edge' or (bow == 'labels' and labels.bow is not None):
        # If the size along theta is the shorter one, the node takes the bow as unknown.
        unknown = ~boxes.bow
        rows[unknown] = rows[unknown][:, [0, 1, 3, 2, 4]] + (0.0, 0.0, 0.0, 0.0, np.pi / 2.0)
        # A square needs a shorter side as well.
        rows[unknown, 3] = np.maximum(rows[unknown, 3], rows[unknown, 2] * (1.0 + 1e-9))
    return rows


def yolo_message(labels: ImageLabels, header: Header, bow: BowSource = 'none') -> Any:
    """Write an image's labels as a `yolo_msgs/DetectionArray`; ids as in `detections_message`."""
    from yolo_msgs.msg import Detection
    from yolo_msgs.msg import DetectionArray

    class_ids = sorted(set(labels.class_ids))
    message = DetectionArray(header=header)
    for source in detections_message(labels, header, bow).detections:
        hypothesis = source.results[0].hypothesis
        detection = Detection(
            class_id=class_ids.index(hypothesis.class_id),
            class_name=hypothesis.class_id,
            score=hypothesis.score,
            id=source.id,
        )
        center, box = source.bbox.center, detection.bbox
        box.center.position.x, box.center.position.y = center.position.x, center.position.y
        box.center.theta = center.theta
        box.size.x, box.size.y = source.bbox.size_x, source.bbox.size_y
        message.detections.append(detection)
    return message


def image_message(encoding: str, pixels: NDArray[Any], header: Header) -> Image:
    """Write an image of uint8 or uint16 pixels, (H, W) or (H, W, C), little-endian."""
    height, width = pixels.shape[:2]
    # rclpy takes an array of bytes as it is, and checks anything else byte by byte.
    data = array('B', pixels.astype(pixels.dtype.newbyteorder('<'), order='C').tobytes())
    step = len(data) // height
    return Image(header=header, height=height, width=width, encoding=encoding, step=step, data=data)


def polygons_message(labels: ImageLabels, header: Header) -> Any:
    """Write an image's labels as a `Polygon2DCollection`, four corners per label."""
    from polygon_msgs.msg import Point2D
    from polygon_msgs.msg import Polygon2D
    from polygon_msgs.msg import Polygon2DCollection

    return Polygon2DCollection(
        header=header,
        polygons=[
            Polygon2D(points=[Point2D(x=x, y=y) for x, y in corners])
            for corners in labels.corners.tolist()
        ],
    )


def polygon_message(corners: Sequence[Sequence[float]], header: Header) -> PolygonStamped:
    """Write one label as a `PolygonStamped`; its coordinates are single precision."""
    points = [Point32(x=x, y=y) for x, y in corners]
    return PolygonStamped(header=header, polygon=Polygon(points=points))


_MESSAGES: dict[str, Callable[[ImageLabels, Header, BowSource], list[Any]]] = {
    'Detection2DArray': lambda labels, header, bow: [detections_message(labels, header, bow)],
    'DetectionArray': lambda labels, header, bow: [yolo_message(labels, header, bow)],
    'Polygon2DCollection': lambda labels, header, _: [polygons_message(labels, header)],
    'PolygonStamped': lambda labels, header, _: [
        polygon_message(corners, header) for corners in labels.corners.tolist()
    ],
}
