# SPDX-License-Identifier: Apache-2.0
"""
Feed damaged messages to the other inputs of the nodes: polygons, crop plans, images, camera infos,
poses, positions, and the detections of `ship_tracker`.

    python test/fuzz/inputs.py --inputs 200000          # of each kind

Whatever the bytes are, the message is refused in reading, or everything that the node does with it
comes to its end, without a warning. GEOS ends the process where it fails, so this is run as it is,
without a net.
"""

from __future__ import annotations

import argparse
import json
import random
import struct
import warnings
from array import array
from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import Point32
from geometry_msgs.msg import Polygon
from geometry_msgs.msg import PolygonStamped
from geometry_msgs.msg import PoseWithCovarianceStamped
from geometry_msgs.msg import Quaternion
from polygon_msgs.msg import Point2D
from polygon_msgs.msg import Polygon2D
from polygon_msgs.msg import Polygon2DCollection
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import Image
from sensor_msgs.msg import Imu
from sensor_msgs.msg import NavSatFix
from vision_msgs.msg import Detection3D
from vision_msgs.msg import Detection3DArray
from vision_msgs.msg import ObjectHypothesisWithPose
from wire import TEXTS
from wire import run_mutations
from wire import seed_message
from yolo_msgs.msg import Detection
from yolo_msgs.msg import DetectionArray
from yolo_msgs.msg import KeyPoint2D
from yolo_msgs.msg import Point2D as MaskPoint

from obbhbb_ros.downlink.cameras import CameraChoice
from obbhbb_ros.downlink.chips import ENCODINGS
from obbhbb_ros.downlink.chips import PIXEL_FORMATS
from obbhbb_ros.downlink.chips import ChipError
from obbhbb_ros.downlink.chips import cut
from obbhbb_ros.downlink.chips import pixel_format
from obbhbb_ros.downlink.chips import placed
from obbhbb_ros.downlink.chips import view_of
from obbhbb_ros.earth.pinhole import Pinhole
from obbhbb_ros.earth.placement import place
from obbhbb_ros.earth.pose import CameraPose
from obbhbb_ros.earth.pose import PoseError
from obbhbb_ros.earth.pose_source import CameraPoses
from obbhbb_ros.earth.pose_source import PoseAt
from obbhbb_ros.earth.pose_source import VehiclePoses
from obbhbb_ros.earth.reported import ShipPlaces
from obbhbb_ros.earth.reported import reported_covariances
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.pipeline.batch import Batch
from obbhbb_ros.pipeline.identification import ShipIdentifier
from obbhbb_ros.pipeline.identification import TrackerOutputs
from obbhbb_ros.pipeline.outcome import Output
from obbhbb_ros.pipeline.placing import ShipPlacer
from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB
from obbhbb_ros.settings.ship_tracker import SHIP_TRACKER
from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.camera import WireCamera
from obbhbb_ros.wire.camera import read_camera
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.image import read_image
from obbhbb_ros.wire.layouts import INPUT_TYPES
from obbhbb_ros.wire.plans import WirePlan
from obbhbb_ros.wire.plans import read_sources
from obbhbb_ros.wire.poses import WireAttitude
from obbhbb_ros.wire.poses import WireFix
from obbhbb_ros.wire.poses import read_attitude
from obbhbb_ros.wire.poses import read_fix
from obbhbb_ros.wire.poses import read_pose
from obbhbb_ros.wire.positions import read_positions
from obbhbb_ros.wire.stamp import Stamp

EXTREMES = [0.0, -0.0, 5e-324, 1e-308, 1e15, 1e150, 1e154, 1e155, 1.7e308, np.nan, np.inf]


SETTINGS = [
    OBB_TO_HBB.settings(
        {
            'invalid_policy': policy,
            'crop.merge_max_size': merged,
            'clip_boxes': bool(merged),
            'heading': 'theta' if merged else 'none',
            'q_bow': 2.2,
        }
    )
    for policy, merged in (('drop', 0), ('keep', 300))
]


TRACKER_SETTINGS = [
    SHIP_TRACKER.settings(values)
    for values in (
        {'ids': 'assign'},
        {'pose_type': 'PoseStamped', 'heading': 'theta', 'min_length': 10.0, 'max_length': 1e4},
    )
]


def coordinate(source: random.Random) -> float:
    """Make up a coordinate, now and then one that GEOS fails on."""
    if source.random() < 0.1:
        return source.choice([1, -1]) * source.choice(EXTREMES)
    return source.choice([source.uniform(-10, 4000), float(source.randrange(30))])


def points_of(source: random.Random) -> list[tuple[float, float]]:
    """Make up a polygon."""
    count = source.choice([0, 1, 2, 3, 4, 4, 5, 17])
    return [(coordinate(source), coordinate(source)) for _ in range(count)]


def polygons_seed(source: random.Random) -> bytes:
    """Write a `Polygon2DCollection`."""
    message = Polygon2DCollection()
    message.header.frame_id = source.choice(TEXTS)
    message.polygons = [
        Polygon2D(points=[Point2D(x=x, y=y) for x, y in points_of(source)])
        for _ in range(source.choice([0, 1, 3, 10]))
    ]
    return serialize_message(message)


def polygon_seed(source: random.Random) -> bytes:
    """Write a `PolygonStamped`."""
    with np.errstate(over='ignore'):
        points = np.float32(points_of(source)).reshape(-1, 2).tolist()
    polygon = Polygon(points=[Point32(x=x, y=y) for x, y in points])
    message = PolygonStamped(polygon=polygon)
    message.header.frame_id = source.choice(TEXTS)
    return serialize_message(message)


def yolo_seed(source: random.Random) -> bytes:
    """Write a `yolo_msgs/DetectionArray`."""
    message = DetectionArray()
    message.header.frame_id = source.choice(TEXTS)
    for _ in range(source.choice([0, 1, 3, 40])):
        detection = Detection(
            class_name=source.choice(TEXTS), id=source.choice(TEXTS), score=source.random()
        )
        center, size = detection.bbox.center, detection.bbox.size
        center.position.x, center.position.y = coordinate(source), coordinate(source)
        center.theta, size.x, size.y = coordinate(source), coordinate(source), coordinate(source)
        detection.mask.data = [MaskPoint()] * source.choice([0, 0, 2, 9])
        detection.keypoints.data = [KeyPoint2D()] * source.choice([0, 0, 1, 4])
        message.detections.append(detection)
    return serialize_message(message)


def image_seed(source: random.Random) -> bytes:
    """Write an `Image`."""
    encoding = source.choice([*ENCODINGS, '32FC1', ''])
    width, height = source.choice([0, 1, 7, 32]), source.choice([0, 1, 5, 16])
    step = width * source.choice([1, 2, 3, 4, 6]) + source.choice([0, 0, 3])
    image = Image(
        width=width,
        height=height,
        step=step,
        encoding=encoding,
        data=array('B', bytes(step * height)),
    )
    return serialize_message(image)


def camera_seed(source: random.Random) -> bytes:
    """Write a `CameraInfo`."""
    info = CameraInfo(width=source.randrange(5000), height=source.randrange(5000))
    info.d = [0.0] * source.choice([0, 5])
    info.binning_x = source.choice([0, 1, 2**32 - 1])
    return serialize_message(info)


def lens_seed(source: random.Random) -> bytes:
    """Write a `CameraInfo` with K and D."""
    info = CameraInfo(width=640, height=480)
    info.distortion_model = source.choice(
        ['plumb_bob', 'rational_polynomial', 'equidistant', *TEXTS]
    )
    info.k = [1e5, 0.0, 320.0, 0.0, 1e5, 240.0, 0.0, 0.0, 1.0]
    info.d = [source.uniform(-1.0, 1.0)] * source.choice([0, 4, 5, 8, 12, 14])
    info.binning_x = source.choice([0, 1, 2, 2**32 - 1])
    return serialize_message(info)


def pose_seed(source: random.Random) -> bytes:
    """Write a `PoseWithCovarianceStamped`, from 500 km straight down."""
    message = PoseWithCovarianceStamped()
    message.header.stamp.sec = source.choice([0, 99, 100, 101, 2**31 - 1])
    message.header.frame_id = source.choice(['earth', 'earth', *TEXTS])
    message.pose.pose.position.x = 6_878_137.0
    x, y, z, w = 0.5, 0.5, -0.5, -0.5
    message.pose.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
    message.pose.covariance = source.choice([1.0, 0.0, 1e-9]) * np.eye(6).ravel()
    return serialize_message(message)


def fix_seed(source: random.Random) -> bytes:
    """Write a `NavSatFix`."""
    message = NavSatFix(latitude=54.0, longitude=source.choice([12.0, 360.0]), altitude=120.0)
    message.header.stamp.sec = source.choice([0, 99, 100, 101])
    message.status.status = source.choice([-2, -1, 0, 2])
    message.position_covariance_type = source.randrange(4)
    return serialize_message(message)


def attitude_seed(source: random.Random) -> bytes:
    """Write an `Imu`."""
    message = Imu()
    message.header.stamp.sec = source.choice([0, 99, 100, 101])
    message.orientation.w = 1.0
    message.orientation_covariance[0] = source.choice([-1.0, 0.0, 1e-6])
    return serialize_message(message)


def positions_seed(source: random.Random) -> bytes:
    """Write a `Detection3DArray`."""
    message = Detection3DArray()
    message.header.frame_id = source.choice(['earth', *TEXTS])
    for _ in range(source.choice([0, 1, 3, 40])):
        one = Detection3D(id=source.choice(TEXTS))
        one.bbox.center.position.x = 6_378_137.0
        one.bbox.center.orientation.w = 1.0
        one.bbox.size.x, one.bbox.size.y = coordinate(source), coordinate(source)
        one.results = [ObjectHypothesisWithPose() for _ in range(source.choice([0, 1, 1, 2]))]
        message.detections.append(one)
    return serialize_message(message)


def batch_check(name: str) -> Callable[[bytes], str]:
    """Do with a message what the conversion node does."""

    def check(data: bytes) -> str:
        for settings in SETTINGS:
            try:
                batch = Batch(data, INPUT_TYPES[name], settings, (640, 480))
            except WireError:
                return 'refused'
            batch.boxes_message()
            batch.crop_regions_message(batch.plan_crops())
        return 'read'

    return check


def image_check(data: bytes) -> str:
    """Do with an image what the chip node does."""
    try:
        image = read_image(data)
    except WireError:
        return 'refused'
    try:
        develop = image.encoding.endswith('8')
        layout = pixel_format(image.encoding, 'png', develop)
        view = view_of(image, develop)
    except ChipError:
        return 'not to be cut'
    for wanted in ((0, 0, 4, 4), (-9, 3, 10**9, 10**9)):
        region = placed(wanted, (view.shape[1], view.shape[0]), layout)
        if region is not None:
            cut(view, region, layout)
    return 'cut'


def regions_check(data: bytes) -> str:
    """Do with a crop plan what the chip node does."""
    try:
        plan = WirePlan(data)
        read_sources(data)
    except WireError:
        return 'refused'
    layout = PIXEL_FORMATS['rgb8']
    plan.detection_ids()
    for row, region in enumerate(plan.regions):
        placed(region, (640, 480), layout)
        Detections(plan.alone(row, (1, 2), plan.stamp, 'camera'))
    return 'read'


def poses_check(kind: str) -> Callable[[bytes], str]:
    """Do with a message about the pose what `ship_tracker` does, and place a ship by it."""
    camera, vehicle = CameraPoses(), VehiclePoses()
    add: Callable[[bytes], None] = {
        'pose': lambda data: camera.add(read_pose(data, 'PoseWithCovarianceStamped')),
        'fix': lambda data: vehicle.add_fix(read_fix(data)),
        'attitude': lambda data: vehicle.add_attitude(read_attitude(data)),
    }[kind]
    vehicle.add_fix(WireFix((100, 0), 0, (54.0, 12.0, 120.0), 9 * (1.0,), 2))
    vehicle.add_attitude(WireAttitude((100, 0), (0.0, 0.0, 0.0, 1.0), 9 * (1e-6,)))
    mount = np.array([0.5**0.5, -(0.5**0.5), 0.0, 0.0])
    boxes = OrientedBoxes.from_xywhr([[320.0, 240.0, 60.0, 10.0, 0.5]])
    lens = Pinhole([1e5, 0, 320, 0, 1e5, 240, 0, 0, 1])

    def check(data: bytes) -> str:
        try:
            add(data)
        except (WireError, PoseError):
            return 'refused'
        found = camera.at((100, 0), 1.0) if kind == 'pose' else vehicle.at((100, 0), 1.0, mount)
        if found is None:
            return 'at another time'
        ships = place(boxes, lens, found.pose)
        reported_covariances(ships)
        return 'placed' if not ships.unplaced.any() else 'not placed'

    return check


def positions_check(data: bytes) -> str:
    """Do with positions what the chip node does."""
    try:
        positions = read_positions(data)
        places = ShipPlaces(positions, (6_878_137.0, 0.0, 0.0))
    except (WireError, PoseError):
        return 'refused'
    known = [places.facts(ship) for ship in positions.ids]
    json.dumps(known, allow_nan=False)
    return 'read'


def lens_check(data: bytes) -> str:
    """Place a ship by a camera info, as `ship_tracker` does."""
    settings = TRACKER_SETTINGS[1].place
    try:
        camera = read_camera(data)
    except WireError:
        return 'refused'
    assert settings is not None
    boxes = OrientedBoxes.from_xywhr([[320.0, 240.0, 60.0, 10.0, 0.5]])
    placed_ships = ShipPlacer(Above()).place(boxes, (100, 0), camera, None, settings)
    return next(iter(placed_ships.finding.counts), 'placed')


class Above:
    """A camera that looks straight down from 500 km, at any time."""

    frame_id = ''

    _pose = CameraPose.from_message((6_878_137.0, 0.0, 0.0), (0.5, 0.5, -0.5, -0.5))

    def has_reached(self, stamp: Stamp) -> bool:
        """Tell that all has come."""
        return True

    def at(self, stamp: Stamp, max_age: float, mount: FloatArray) -> PoseAt:
        """Return the pose."""
        return PoseAt(self._pose, 0.1)

    def why_not(self, stamp: Stamp) -> str:
        """There always is a pose."""
        return ''

    def clear(self) -> None:
        """Keep it."""


def tracker_check(name: str) -> Callable[[bytes], str]:
    """Do with a message what `ship_tracker` does, after all those before it."""
    camera = WireCamera(
        (0, 0),
        'camera',
        (640, 480),
        'plumb_bob',
        (-0.1, 0.01, 0.0, 0.0, 0.0),
        (1e5, 0.0, 320.0, 0.0, 1e5, 240.0, 0.0, 0.0, 1.0),
        (0, 0, 640, 480),
        (1, 1),
    )
    choice = CameraChoice(camera, has_stamp=True)
    answers: list[bytes] = []
    outputs = TrackerOutputs(Output(answers.append), Output(answers.append))
    trackers = [ShipIdentifier(Above()) for _ in TRACKER_SETTINGS]

    def check(data: bytes) -> str:
        for tracker, settings in zip(trackers, TRACKER_SETTINGS, strict=True):
            answers.clear()
            try:
                tracker.answer(data, INPUT_TYPES[name], settings, choice, outputs)
            except WireError:
                return 'refused'
            *positions, tracked = answers
            count = len(Detections(tracked, INPUT_TYPES['Detection2DArray']))
            assert all(len(read_positions(each).ids) == count for each in positions)
        return 'read'

    return check


def camera_check(data: bytes) -> str:
    """Do with a camera info what the conversion node does."""
    try:
        width, height = read_camera(data).image_size
    except WireError:
        return 'refused'
    assert width >= 0 <= height
    return 'read'


KINDS = {
    'detections': (seed_message, batch_check('Detection2DArray')),
    'yolo': (yolo_seed, batch_check('DetectionArray')),
    'polygons': (polygons_seed, batch_check('Polygon2DCollection')),
    'polygon': (polygon_seed, batch_check('PolygonStamped')),
    'tracked detections': (seed_message, tracker_check('Detection2DArray')),
    'tracked yolo': (yolo_seed, tracker_check('DetectionArray')),
    'tracked polygons': (polygons_seed, tracker_check('Polygon2DCollection')),
    'regions': (seed_message, regions_check),
    'image': (image_seed, image_check),
    'camera_info': (camera_seed, camera_check),
    'camera_info of places': (lens_seed, lens_check),
    'camera_pose': (pose_seed, poses_check('pose')),
    'fix': (fix_seed, poses_check('fix')),
    'attitude': (attitude_seed, poses_check('attitude')),
    'positions': (positions_seed, positions_check),
}


def with_extremes(seed: Callable[[random.Random], bytes]) -> Callable[[random.Random], bytes]:
    """Write numbers that no detector sends over the doubles of a message."""

    def seeded(source: random.Random) -> bytes:
        data = bytearray(seed(source))
        for _ in range(source.choice([0, 0, 1, 3])):
            at = 4 + 8 * source.randrange(max(len(data) // 8 - 1, 1))
            data[at : at + 8] = struct.pack('<d', source.choice(EXTREMES))
        return bytes(data)

    return seeded


def main() -> None:
    """Fuzz."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--inputs', type=int, default=200_000, help='of each kind')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--kinds', nargs='+', choices=KINDS, default=list(KINDS))
    options = parser.parse_args()
    # NumPy's, of numbers that nobody has checked.
    warnings.simplefilter('error', RuntimeWarning)
    for kind in options.kinds:
        seed, check = KINDS[kind]
        print(f'{kind}: ', end='', flush=True)
        run_mutations(options.inputs, options.seed, with_extremes(seed), check)


if __name__ == '__main__':
    main()
