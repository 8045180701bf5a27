# SPDX-License-Identifier: Apache-2.0
"""The message packages in use, released or from test/interfaces, are the interfaces we mean."""

import ctypes
import struct
from typing import Any

import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from geometry_msgs.msg import Pose
from geometry_msgs.msg import PoseWithCovariance
from geometry_msgs.msg import Quaternion
from harness import Peer
from harness import Site
from polygon_msgs.msg import Point2D as PolygonPoint
from polygon_msgs.msg import Polygon2D
from polygon_msgs.msg import Polygon2DCollection
from rclpy.qos import DurabilityPolicy
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.serialization import serialize_message
from std_msgs.msg import ColorRGBA
from std_msgs.msg import Header
from vision_msgs.msg import BoundingBox2D
from vision_msgs.msg import Detection2D
from vision_msgs.msg import Detection2DArray
from vision_msgs.msg import ObjectHypothesis
from vision_msgs.msg import ObjectHypothesisWithPose
from vision_msgs.msg import Point2D
from vision_msgs.msg import Pose2D

# Of the packages released for Jazzy. Another hash means other fields, types or order.
RELEASED = {
    (
        'vision_msgs',
        'Detection2DArray',
    ): 'RIHS01_214274120007f4a683866481336b70310268cfa107aebe9d594a6acf75bda968',
    (
        'vision_msgs',
        'Detection3DArray',
    ): 'RIHS01_793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018',
    (
        'polygon_msgs',
        'Polygon2DCollection',
    ): 'RIHS01_52f380704d680f7b0b1b1d7f6776178477212a5be9e54781569dc7aeec144d50',
}

CDR_LITTLE_ENDIAN = bytes((0, 1, 0, 0))

# Offsets in the layouts below count from the end of the four bytes above, as the alignment of
# numbers does; '<' adds no padding of its own. A byte of padding may have any value, and with
# Fast DDS it does: what stood in that memory before.
ANY = None

# A late subscriber gets the message too, so that one is enough.
KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

DETECTIONS = Detection2DArray(
    header=Header(stamp=Time(sec=1700000000, nanosec=123456789), frame_id='camera'),
    detections=[
        Detection2D(
            header=Header(stamp=Time(sec=-5, nanosec=6), frame_id='bow'),
            results=[
                ObjectHypothesisWithPose(
                    hypothesis=ObjectHypothesis(class_id='helicopter', score=0.875),
                    pose=PoseWithCovariance(
                        pose=Pose(
                            position=Point(x=1.5, y=-2.5, z=3.5),
                            orientation=Quaternion(x=0.1, y=0.2, z=0.3, w=0.4),
                        ),
                        covariance=[k / 7 for k in range(36)],
                    ),
                )
            ],
            bbox=BoundingBox2D(
                center=Pose2D(position=Point2D(x=320.25, y=240.5), theta=-0.7),
                size_x=81.0,
                size_y=12.125,
            ),
            id='hull-7',
        )
    ],
)
DETECTIONS_CDR = [
    *CDR_LITTLE_ENDIAN,
    *struct.pack('<iI', 1700000000, 123456789),  # 0: header.stamp
    *struct.pack('<I7s', 7, b'camera\0'),  # 8: header.frame_id
    *[ANY] * 1,
    *struct.pack('<I', 1),  # 20: how many detections
    *struct.pack('<iI', -5, 6),  # 24: detections[0].header.stamp
    *struct.pack('<I4s', 4, b'bow\0'),  # 32: .header.frame_id
    *struct.pack('<I', 1),  # 40: how many .results
    *struct.pack('<I11s', 11, b'helicopter\0'),  # 44: .results[0].hypothesis.class_id
    *[ANY] * 5,
    *struct.pack('<d', 0.875),  # 64: .hypothesis.score
    *struct.pack('<3d', 1.5, -2.5, 3.5),  # 72: .pose.pose.position
    *struct.pack('<4d', 0.1, 0.2, 0.3, 0.4),  # 96: .pose.pose.orientation
    *struct.pack('<36d', *(k / 7 for k in range(36))),  # 128: .pose.covariance
    *struct.pack('<3d', 320.25, 240.5, -0.7),  # 416: detections[0].bbox.center
    *struct.pack('<2d', 81.0, 12.125),  # 440: .bbox.size_x, .bbox.size_y
    *struct.pack('<I7s', 7, b'hull-7\0'),  # 456: .id
]

POLYGONS = Polygon2DCollection(
    header=Header(stamp=Time(sec=12, nanosec=34), frame_id='image'),
    polygons=[
        Polygon2D(
            points=[
                PolygonPoint(x=0.5, y=0.25),
                PolygonPoint(x=100.1, y=-7.75),
                PolygonPoint(x=60.0, y=33.3),
            ]
        )
    ],
    colors=[ColorRGBA(r=1.0, g=0.5, b=0.25, a=0.75)],
)
POLYGONS_CDR = [
    *CDR_LITTLE_ENDIAN,
    *struct.pack('<iI', 12, 34),  # 0: header.stamp
    *struct.pack('<I6s', 6, b'image\0'),  # 8: header.frame_id
    *[ANY] * 2,
    *struct.pack('<I', 1),  # 20: how many polygons
    *struct.pack('<I', 3),  # 24: how many polygons[0].points
    *[ANY] * 4,
    *struct.pack('<6d', 0.5, 0.25, 100.1, -7.75, 60.0, 33.3),  # 32: their x and y
    *struct.pack('<I', 1),  # 80: how many colors
    *struct.pack('<4f', 1.0, 0.5, 0.25, 0.75),  # 84: colors[0]
]

EXAMPLES = pytest.mark.parametrize(
    ('message', 'cdr'),
    [
        pytest.param(DETECTIONS, DETECTIONS_CDR, id='Detection2DArray'),
        pytest.param(POLYGONS, POLYGONS_CDR, id='Polygon2DCollection'),
    ],
)


def type_hash(package: str, name: str) -> str:
    """Ask the compiled type support, whose answer is what DDS discovery sends around."""
    library = ctypes.CDLL(f'lib{package}__rosidl_generator_c.so')
    get_type_hash = library[f'{package}__msg__{name}__get_type_hash']
    get_type_hash.argtypes = [ctypes.c_void_p]
    get_type_hash.restype = ctypes.POINTER(ctypes.c_uint8 * 33)
    version, *value = get_type_hash(None).contents
    return f'RIHS{version:02}_{bytes(value).hex()}'


@pytest.mark.parametrize(('package', 'name'), RELEASED)
def test_type_hash_is_that_of_the_released_package(package: str, name: str) -> None:
    assert type_hash(package, name) == RELEASED[package, name]


@EXAMPLES
def test_serialized_message_is_the_cdr_laid_out_by_hand(
    message: Any, cdr: list[int | None]
) -> None:
    data = serialize_message(message)
    expected = [got if byte is ANY else byte for got, byte in zip(data, cdr, strict=False)]
    assert data[: len(cdr)] == bytes(expected)
    # A middleware may fill the end up to the next multiple of four; Fast DDS does not.
    assert len(cdr) <= len(data) <= -(-len(cdr) // 4) * 4


@EXAMPLES
@pytest.mark.parametrize('padding', [0, 0xA5])
def test_cdr_laid_out_by_hand_is_read_as_the_message(
    message: Any, cdr: list[int | None], padding: int
) -> None:
    data = bytes(padding if byte is ANY else byte for byte in cdr)
    assert deserialize_message(data, type(message)) == message


# More than serialization: the middleware also registers the type, by other type supports.
@pytest.mark.parametrize(
    'message', [DETECTIONS, POLYGONS], ids=lambda message: type(message).__name__
)
def test_message_and_type_hash_travel(site: Site, message: Any) -> None:
    with Peer(site.context, '/test_interfaces') as peer:
        received = peer.collect(type(message), 'example', KEPT)
        peer.node.create_publisher(type(message), 'example', KEPT).publish(message)
        peer.spin_until(lambda: received, 'the message')
        publishers = peer.node.get_publishers_info_by_topic('/test_interfaces/example')
    assert received[:1] == [message]
    package = type(message).__module__.split('.', maxsplit=1)[0]
    expected = RELEASED[package, type(message).__name__]
    assert {str(endpoint.topic_type_hash) for endpoint in publishers} == {expected}
