# SPDX-License-Identifier: Apache-2.0
"""
Descriptions of the messages that this package reads, and what their fields mean.

To read one more type of detections, describe it here, and add an `InputType` that names the fields
with class, score, id and box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from obbhbb_ros.wire.walk import Array
from obbhbb_ros.wire.walk import Many
from obbhbb_ros.wire.walk import Numbers
from obbhbb_ros.wire.walk import Step
from obbhbb_ros.wire.walk import Struct
from obbhbb_ros.wire.walk import Text
from obbhbb_ros.wire.walk import min_bytes
from obbhbb_ros.wire.walk import steps_of

_UINT8 = Numbers(1)
_INT32 = _UINT32 = Numbers(4)
_FLOAT64 = Numbers(8)

_HEADER: Struct = {'stamp': {'sec': _INT32, 'nanosec': _UINT32}, 'frame_id': Text()}

_POSE: Struct = {'position': Numbers(8, 3), 'orientation': Numbers(8, 4)}
_POSE_2D: Struct = {'position': {'x': _FLOAT64, 'y': _FLOAT64}, 'theta': _FLOAT64}
_POSE_COVARIANCE: Struct = {'pose': _POSE, 'covariance': Numbers(8, 36)}
_HYPOTHESIS: Struct = {
    'hypothesis': {'class_id': Text(), 'score': _FLOAT64},
    'pose': _POSE_COVARIANCE,
}
_DETECTION_2D: Struct = {
    'header': _HEADER,
    'results': Many(_HYPOTHESIS),
    'bbox': {'center': _POSE_2D, 'size_x': _FLOAT64, 'size_y': _FLOAT64},
    'id': Text(),
}
_DETECTION_3D: Struct = {
    'header': _HEADER,
    'results': Many(_HYPOTHESIS),
    'bbox': {'center': _POSE, 'size': Numbers(8, 3)},
    'id': Text(),
}
_YOLO_DETECTION: Struct = {
    'class_id': _INT32,
    'class_name': Text(),
    'score': _FLOAT64,
    'id': Text(),
    'bbox': {'center': _POSE_2D, 'size': {'x': _FLOAT64, 'y': _FLOAT64}},
    'bbox3d': {'center': _POSE, 'size': Numbers(8, 3), 'frame_id': Text()},
    'mask': {'height': _INT32, 'width': _INT32, 'data': Array(8, 2)},
    'keypoints': {'data': Many({'id': _INT32, 'point': Numbers(8, 2), 'score': _FLOAT64})},
    'keypoints3d': {
        'data': Many({'id': _INT32, 'point': Numbers(8, 3), 'score': _FLOAT64}),
        'frame_id': Text(),
    },
}

_IMAGE: Struct = {
    'header': _HEADER,
    'height': _UINT32,
    'width': _UINT32,
    'encoding': Text(),
    'is_bigendian': _UINT8,
    'step': _UINT32,
    'data': Array(1),
}
_CAMERA_INFO: Struct = {
    'header': _HEADER,
    'height': _UINT32,
    'width': _UINT32,
    'distortion_model': Text(),
    'd': Array(8),
    'k': Numbers(8, 9),
    'r': Numbers(8, 9),
    'p': Numbers(8, 12),
    'binning_x': _UINT32,
    'binning_y': _UINT32,
    'roi': {
        'x_offset': _UINT32,
        'y_offset': _UINT32,
        'height': _UINT32,
        'width': _UINT32,
        'do_rectify': _UINT8,
    },
}

_IMU: Struct = {
    'header': _HEADER,
    'orientation': Numbers(8, 4),
    'orientation_covariance': Numbers(8, 9),
    'angular_velocity': Numbers(8, 3),
    'angular_velocity_covariance': Numbers(8, 9),
    'linear_acceleration': Numbers(8, 3),
    'linear_acceleration_covariance': Numbers(8, 9),
}
_NAV_SAT_FIX: Struct = {
    'header': _HEADER,
    'status': {'status': Numbers(1), 'service': Numbers(2)},
    'latitude': _FLOAT64,
    'longitude': _FLOAT64,
    'altitude': _FLOAT64,
    'position_covariance': Numbers(8, 9),
    'position_covariance_type': _UINT8,
}

HEADER = steps_of(_HEADER)
DETECTION_2D = steps_of(_DETECTION_2D)
BOOL = steps_of({'data': _UINT8})
IMAGE = steps_of(_IMAGE)
COMPRESSED_IMAGE = steps_of({'header': _HEADER, 'format': Text(), 'data': Array(1)})
CAMERA_INFO = steps_of(_CAMERA_INFO)
POSE_STAMPED = steps_of({'header': _HEADER, 'pose': _POSE})
POSE_WITH_COVARIANCE_STAMPED = steps_of({'header': _HEADER, 'pose': _POSE_COVARIANCE})
ODOMETRY = steps_of(
    {
        'header': _HEADER,
        'child_frame_id': Text(),
        'pose': _POSE_COVARIANCE,
        'twist': {'twist': Numbers(8, 6), 'covariance': Numbers(8, 36)},
    }
)
IMU = steps_of(_IMU)
NAV_SAT_FIX = steps_of(_NAV_SAT_FIX)


class Field:
    """Paths of the fields of a `vision_msgs/Detection2D`."""

    START = 'header.stamp.sec'
    RESULTS = 'results'
    CLASS = 'results.hypothesis.class_id'
    SCORE = 'results.hypothesis.score'
    BOX = 'bbox.center.position.x'
    ID = 'id'


@dataclass(frozen=True)
class InputType:
    """
    A type of message that holds oriented detections after a header.

    Attributes
    ----------
    package, name : str
        Where ROS finds the message type.
    topic : str
        Default name of the topic.
    element : sequence of Step
        The steps over a detection, which begins with a number of four bytes.
    is_sequence : bool
        Whether a message holds a sequence of detections, or just one.
    tail : sequence of Step
        The steps over whatever follows the detections.
    points : str
        Path of the vertices, where a detection is a polygon.
    class_id, score : str
        Paths of these fields; without them, detections have no hypothesis.
    id : str
        Path of the id; without one, detections have an empty id: an index would name no ship.
    box : str
        Path of the first number of the box: x, y, theta, size along theta, size across it.
        Without one, the box is that around the vertices.
    """

    package: str
    name: str
    topic: str
    element: Sequence[Step]
    is_sequence: bool = True
    tail: Sequence[Step] = ()
    points: str = ''
    class_id: str = ''
    score: str = ''
    id: str = ''
    box: str = ''

    @cached_property
    def min_bytes(self) -> int:
        """The fewest bytes that a detection takes."""
        return min_bytes(self.element)


_INPUT_TYPES = (
    InputType(
        'vision_msgs',
        'Detection2DArray',
        'detections',
        DETECTION_2D,
        class_id=Field.CLASS,
        score=Field.SCORE,
        id=Field.ID,
        box=Field.BOX,
    ),
    InputType(
        'yolo_msgs',
        'DetectionArray',
        'detections',
        steps_of(_YOLO_DETECTION),
        class_id='class_name',
        score='score',
        id='id',
        box='bbox.center.position.x',
    ),
    InputType(
        'polygon_msgs',
        'Polygon2DCollection',
        'polygons',
        steps_of({'points': Array(8, 2)}),
        tail=steps_of({'colors': Array(4, 4)}),
        points='points',
    ),
    InputType(
        'geometry_msgs',
        'PolygonStamped',
        'polygons',
        steps_of({'polygon': {'points': Array(4, 3)}}),
        is_sequence=False,
        points='polygon.points',
    ),
)
POSITIONS = InputType(
    'vision_msgs',
    'Detection3DArray',
    'positions',
    steps_of(_DETECTION_3D),
    class_id='results.hypothesis.class_id',
    score='results.hypothesis.score',
    id='id',
)
"""Where ships are on Earth, as `ship_tracker` publishes it."""

INPUT_TYPES = {input_type.name: input_type for input_type in _INPUT_TYPES}
"""What `obb_to_hbb` can subscribe to, by name of the message type; the first is the default."""
