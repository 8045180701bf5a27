# SPDX-License-Identifier: Apache-2.0
"""The messages of the player: labels, camera, pose and pixels of an image."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from collections.abc import Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import Point32
from geometry_msgs.msg import Polygon
from geometry_msgs.msg import PolygonStamped
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from vision_msgs.msg import Detection2D
from vision_msgs.msg import Detection2DArray
from vision_msgs.msg import ObjectHypothesisWithPose

from obbhbb_ros.earth.pose import CameraPose
from obbhbb_ros.earth.pose_source import EARTH
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels.image_labels import BowSource
from obbhbb_ros.labels.image_labels import ImageSize


def pose_message(pose: CameraPose, header: Header) -> PoseStamped:
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


def forget_ids(message: Any) -> None:
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


MESSAGES: dict[str, Callable[[ImageLabels, Header, BowSource], list[Any]]] = {
    'Detection2DArray': lambda labels, header, bow: [detections_message(labels, header, bow)],
    'DetectionArray': lambda labels, header, bow: [yolo_message(labels, header, bow)],
    'Polygon2DCollection': lambda labels, header, _: [polygons_message(labels, header)],
    'PolygonStamped': lambda labels, header, _: [
        polygon_message(corners, header) for corners in labels.corners.tolist()
    ],
}
"""The messages of the labels of an image, by the type of the output."""
