# SPDX-License-Identifier: Apache-2.0
"""Bags for tests: messages of every input type, written by rosbags and read back."""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Mapping
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any
from typing import NamedTuple

import numpy as np
import pytest

pytest.importorskip('rosbags')

from rosbags.interfaces import Qos
from rosbags.interfaces import QosDurability
from rosbags.interfaces import QosHistory
from rosbags.interfaces import QosLiveliness
from rosbags.interfaces import QosReliability
from rosbags.interfaces import QosTime
from rosbags.rosbag2 import CompressionFormat
from rosbags.rosbag2 import CompressionMode
from rosbags.rosbag2 import Reader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores
from rosbags.typesys import get_types_from_msg
from rosbags.typesys import get_typestore

from obbhbb_ros import OrientedBoxes
from obbhbb_ros.labels import read_labels

INTERFACES = Path(__file__).parent / 'interfaces'
SHIPS = Path(__file__).parent / 'data' / 'real_ships.csv'
TYPES = {
    'Detection2DArray': 'vision_msgs/msg/Detection2DArray',
    'DetectionArray': 'yolo_msgs/msg/DetectionArray',
    'Polygon2DCollection': 'polygon_msgs/msg/Polygon2DCollection',
    'PolygonStamped': 'geometry_msgs/msg/PolygonStamped',
    'CameraInfo': 'sensor_msgs/msg/CameraInfo',
    'String': 'std_msgs/msg/String',
}
STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}

_NEVER = QosTime(9223372036, 854775807)
LATCHED = Qos(
    QosHistory.KEEP_LAST,
    3,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _NEVER,
    _NEVER,
    QosLiveliness.AUTOMATIC,
    _NEVER,
    False,
)


@cache
def real_ships() -> list[Any]:
    """Give the ships of each image as rows of centre, size and angle."""
    found = [each.boxes() for each in read_labels(SHIPS)]
    return [each.xywhr.tolist() for each in found]


class Recorded(NamedTuple):
    """A message of a bag."""

    topic: str
    time: int
    data: bytes


@cache
def typestore() -> Any:
    """Know the messages of Jazzy and those of test/interfaces."""
    store = get_typestore(Stores.ROS2_JAZZY)
    found = {}
    for path in INTERFACES.glob('*/msg/*.msg'):
        name = f'{path.parent.parent.name}/msg/{path.stem}'
        found |= get_types_from_msg(path.read_text(encoding='utf-8'), name)
    store.register(found)
    return store


def build(kind: str, **fields: Any) -> Any:
    """Make a message; what is not given is zero, empty or made likewise."""
    store = typestore()
    msgtype = TYPES.get(kind, kind)
    made = {}
    for name, (shape, detail) in store.fielddefs[msgtype][1]:
        if name in fields:
            made[name] = fields[name]
        elif shape == 1:
            made[name] = '' if detail[0] == 'string' else 0
        elif shape == 2:
            made[name] = build(detail)
        else:
            (inner, what), count = detail
            made[name] = [] if inner == 2 else np.zeros(count, what[0])
    return store.types[msgtype](**made)


def pack(kind: str, message: Any, little_endian: bool = True) -> bytes:
    """Serialize a message."""
    return bytes(typestore().serialize_cdr(message, TYPES[kind], little_endian=little_endian))


def header(stamp: int) -> Any:
    time = build('builtin_interfaces/msg/Time', sec=stamp, nanosec=7)
    return build('std_msgs/msg/Header', stamp=time, frame_id='camera')


def camera_info(width: int, height: int, stamp: int = 1) -> bytes:
    made = build('CameraInfo', header=header(stamp), width=width, height=height)
    return pack('CameraInfo', made)


def detections(kind: str, rows: Any, stamp: int = 1, little_endian: bool = True) -> bytes:
    """Write rows of centre, size, angle as a message; one of a single polygon has the first."""
    corners = OrientedBoxes.from_xywhr(rows).corners.tolist()
    if kind == 'Detection2DArray':
        made = build(
            kind,
            header=header(stamp),
            detections=[_detection(row, str(i), stamp) for i, row in enumerate(rows)],
        )
    elif kind == 'DetectionArray':
        made = build(
            kind,
            header=header(stamp),
            detections=[_yolo_detection(row, str(i), stamp) for i, row in enumerate(rows)],
        )
    elif kind == 'Polygon2DCollection':
        made = build(
            kind,
            header=header(stamp),
            polygons=[
                build(
                    'polygon_msgs/msg/Polygon2D',
                    points=[build('polygon_msgs/msg/Point2D', x=x, y=y) for x, y in each],
                )
                for each in corners
            ],
        )
    else:
        points = [build('geometry_msgs/msg/Point32', x=x, y=y) for x, y in corners[0]]
        polygon = build('geometry_msgs/msg/Polygon', points=points)
        made = build(kind, header=header(stamp), polygon=polygon)
    return pack(kind, made, little_endian)


def _detection(row: Sequence[float], name: str, stamp: int) -> Any:
    x, y, width, height, theta = row
    center = build(
        'vision_msgs/msg/Pose2D', position=build('vision_msgs/msg/Point2D', x=x, y=y), theta=theta
    )
    hypothesis = build('vision_msgs/msg/ObjectHypothesis', class_id='ship', score=0.5)
    return build(
        'vision_msgs/msg/Detection2D',
        header=header(stamp),
        id=name,
        results=[build('vision_msgs/msg/ObjectHypothesisWithPose', hypothesis=hypothesis)],
        bbox=build('vision_msgs/msg/BoundingBox2D', center=center, size_x=width, size_y=height),
    )


def _yolo_detection(row: Sequence[float], name: str, stamp: int) -> Any:
    x, y, width, height, theta = row
    center = build(
        'yolo_msgs/msg/Pose2D', position=build('yolo_msgs/msg/Point2D', x=x, y=y), theta=theta
    )
    size = build('yolo_msgs/msg/Vector2', x=width, y=height)
    return build(
        'yolo_msgs/msg/Detection',
        class_name='ship',
        score=0.5,
        id=name,
        bbox=build('yolo_msgs/msg/BoundingBox2D', center=center, size=size),
    )


def record(
    path: Path,
    topics: Mapping[str, str],
    messages: Iterable[Recorded],
    storage: str = 'mcap',
    compression: str = 'none',
    custom: Mapping[str, str] | None = None,
) -> Path:
    """Write a bag with topics of kinds."""
    writer = Writer(path, version=9, storage_plugin=STORAGES[storage])
    writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    for key, value in (custom or {}).items():
        writer.set_custom_data(key, value)
    with writer:
        connections = {
            topic: writer.add_connection(
                topic, TYPES[kind], typestore=typestore(), offered_qos_profiles=[LATCHED]
            )
            for topic, kind in topics.items()
        }
        for message in messages:
            writer.write(connections[message.topic], message.time, message.data)
    return path


def messages_of(path: Path) -> list[Recorded]:
    """Read a bag."""
    with Reader(path) as reader:
        return [Recorded(each.topic, time, bytes(data)) for each, time, data in reader.messages()]


def on(topic: str, messages: Iterable[Recorded]) -> list[tuple[int, bytes]]:
    """Give times and bytes of the messages of a topic."""
    return [(each.time, each.data) for each in messages if each.topic == topic]
