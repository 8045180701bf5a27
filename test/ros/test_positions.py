# SPDX-License-Identifier: Apache-2.0
"""The node `ship_tracker` over DDS, with a pose: every ship in its place, or the reason why not."""

from __future__ import annotations

import time
from collections.abc import Callable
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from geometry_msgs.msg import Pose
from geometry_msgs.msg import PoseStamped
from geometry_msgs.msg import PoseWithCovarianceStamped
from geometry_msgs.msg import Quaternion
from harness import Converter
from harness import Site
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import Imu
from sensor_msgs.msg import NavSatFix
from ships import detections
from vision_msgs.msg import Detection3D
from vision_msgs.msg import Detection3DArray

from obbhbb_ros.data import HARBOUR_SIZE
from obbhbb_ros.earth.quaternions import matrices_of_vectors
from obbhbb_ros.earth.straight_pass import StraightPass
from obbhbb_ros.study.harbour import harbour
from obbhbb_ros.wire.poses import WireAttitude
from obbhbb_ros.wire.poses import WireFix
from obbhbb_ros.wire.poses import read_attitude
from obbhbb_ros.wire.poses import read_fix
from obbhbb_ros.wire.poses import read_pose
from obbhbb_ros.wire.positions import WirePositions
from obbhbb_ros.wire.positions import read_positions

pytest.importorskip('pyproj')

from geodesy import GEOD
from geodesy import TO_GEODETIC
from geodesy import Scene
from geodesy import ecef
from geodesy import quaternion_of

# It depends on rclpy alone, which is the same in all environments.
pytestmark = pytest.mark.once

SCENE = Scene(height=150.0, focal=3000.0, tilt=30.0)
# Rows of hulls below the camera: latitude, longitude, course, length, width.
HULLS = np.array(
    [
        (54.2005, 12.1004, 20.0, 12.0, 2.0),
        (54.2007, 12.1008, 140.0, 8.0, 1.5),
        (54.2006, 12.1002, 280.0, 30.0, 5.0),
    ]
).T
BOXES = SCENE.boxes(*HULLS)
Begin = Callable[..., Any]


class Tracker(Converter):
    """A tracker with a pose, and what a peer sends and hears."""

    def __init__(self, site: Site, pose_type: str, **parameters: Any) -> None:
        given = {'pose_type': pose_type, 'heading': 'theta', **parameters}
        super().__init__(
            site, parameters=given, executable='ship_tracker', topic='tracked_detections'
        )
        self.positions: list[Any] = self.peer.collect(Detection3DArray, 'positions')
        self.poses: list[Any] = self.peer.collect(PoseWithCovarianceStamped, 'image_pose')
        self.pose_type = pose_type

    def connect(self, answers: list[Any] | None = None) -> None:
        """Send the camera, a pose and an image until the node hears all of them."""
        camera = self.peer.publisher(CameraInfo, 'camera_info')
        k = [SCENE.focal, 0.0, SCENE.center[0], 0.0, SCENE.focal, SCENE.center[1], 0.0, 0.0, 1.0]
        info = CameraInfo(width=4096, height=3072, k=k, distortion_model='plumb_bob')
        if self.pose_type == 'NavSatFix':
            kinds = (NavSatFix, 'fix', fix), (Imu, 'attitude', attitude)
        else:
            kinds = ((KINDS[self.pose_type][0], 'camera_pose', KINDS[self.pose_type][1]),)
        self.senders = [(self.peer.publisher(kind, topic), make) for kind, topic, make in kinds]
        heard = stamp_at(1.0)

        def send() -> None:
            camera.publish(info)
            self.tell_pose(1.0)
            self.send_hulls(1.0)

        def is_placed() -> bool:
            points = [
                one.bbox.center.position.x
                for message in self.positions
                for one in message.detections
                if message.header.stamp == heard
            ]
            return bool(np.isfinite(points).any()) and bool(self.boxes and self.poses)

        self.send_until(send, is_placed, 'the first places')
        # By the next report, messages on their way are counted.
        self.before = self.counts()

    def count(self, key: str) -> float:
        """Return by how much a counter grew since all was heard."""
        return self.counts().since(self.before).get(key, 0)

    def tell_pose(self, seconds: float, **changes: Any) -> None:
        """Send the pose of the scene with a stamp."""
        for publisher, make in self.senders:
            publisher.publish(make(stamp_at(seconds), **changes))

    def send_hulls(self, seconds: float) -> None:
        """Send the detections of an image with a stamp."""
        message = detections(BOXES.xywhr)
        message.header.stamp = stamp_at(seconds)
        self.publisher.publish(message)

    def answer_at(self, seconds: float) -> tuple[Any, WirePositions]:
        """Wait for the answer to the image with a stamp."""
        stamp = stamp_at(seconds)

        def at(messages: list[Any]) -> list[Any]:
            return [message for message in messages if message.header.stamp == stamp]

        self.wait(lambda: at(self.boxes) and at(self.positions), f'the answer at {seconds}')
        (tracked,), (positions,) = at(self.boxes), at(self.positions)
        return tracked, read_positions(serialize_message(positions))


def stamp_at(seconds: float) -> Time:
    """Make a stamp."""
    return Time(sec=int(seconds), nanosec=round(seconds % 1.0 * 1e9))


def pose(attitude: Any = None) -> Pose:
    """Make the pose of the scene."""
    x, y, z, w = quaternion_of(SCENE.matrix) if attitude is None else attitude
    point = dict(zip('xyz', SCENE.position.tolist(), strict=True))
    return Pose(position=Point(**point), orientation=Quaternion(x=x, y=y, z=z, w=w))


def stamped(stamp: Time, frame: str = 'earth', attitude: Any = None) -> PoseStamped:
    """Make a pose message."""
    message = PoseStamped(pose=pose(attitude))
    message.header.stamp, message.header.frame_id = stamp, frame
    return message


def with_covariance(
    stamp: Time, error: Any = None, covariance: Any = None
) -> PoseWithCovarianceStamped:
    """Make a pose message, by default right, with a covariance of 1 m and 1 mrad."""
    message = PoseWithCovarianceStamped()
    message.header.stamp, message.header.frame_id = stamp, 'earth'
    message.pose.pose = pose()
    if error is not None:
        (turn,) = matrices_of_vectors(error[None, 3:])
        message.pose.pose = pose(quaternion_of(turn @ SCENE.matrix))
        x, y, z = (SCENE.position + error[:3]).tolist()
        message.pose.pose.position = Point(x=x, y=y, z=z)
    known = np.diag([1.0] * 3 + [1e-6] * 3) if covariance is None else covariance
    message.pose.covariance = known.ravel()
    return message


def odometry(stamp: Time) -> Odometry:
    """Make an odometry message."""
    message = Odometry(child_frame_id='camera_optical')
    message.header.stamp, message.header.frame_id = stamp, 'earth'
    message.pose.pose = pose()
    return message


def fix(stamp: Time) -> NavSatFix:
    """Make a fix of the scene."""
    message = NavSatFix(latitude=SCENE.latitude, longitude=SCENE.longitude, altitude=SCENE.height)
    message.header.stamp, message.status.status = stamp, 0
    return message


def attitude(stamp: Time) -> Imu:
    """Make the attitude of a body that lies level, its front to the east."""
    message = Imu()
    message.header.stamp, message.orientation.w = stamp, 1.0
    return message


MOUNT = quaternion_of(SCENE.to_enu @ SCENE.matrix).tolist()
KINDS = {
    'PoseStamped': (PoseStamped, stamped),
    'PoseWithCovarianceStamped': (PoseWithCovarianceStamped, with_covariance),
    'Odometry': (Odometry, odometry),
}


@pytest.fixture
def begin(site: Site) -> Iterator[Begin]:
    """Start trackers."""
    with ExitStack() as stack:

        def begun(pose_type: str, **parameters: Any) -> Tracker:
            node = Tracker(site, pose_type, **parameters)
            stack.enter_context(node)
            node.connect()
            return node

        yield begun


def assert_right(positions: WirePositions) -> None:
    """Hold positions against the hulls: within 1 m and 1 %."""
    latitude, longitude, _, length, _ = HULLS
    east, north, _ = TO_GEODETIC.transform(*positions.points.T)
    assert GEOD.inv(longitude, latitude, east, north)[2].max() < 1.0
    np.testing.assert_allclose(positions.sizes[:, 0], length, rtol=0.01)


@pytest.mark.parametrize('pose_type', [*KINDS, 'NavSatFix'])
def test_every_ship_is_in_its_place_with_any_message_that_tells_the_pose(
    begin: Begin, pose_type: str
) -> None:
    mount = {'camera_mount': MOUNT} if pose_type == 'NavSatFix' else {}
    node = begin(pose_type, **mount)
    node.tell_pose(10.0)
    # The image comes before the later pose: it waits.
    node.send_hulls(10.2)
    node.tell_pose(10.4)
    tracked, positions = node.answer_at(10.2)
    assert_right(positions)
    assert [one.id for one in tracked.detections] == list(positions.ids)
    assert all(positions.ids)
    assert positions.frame_id == 'earth'
    node.wait(
        lambda: any(one.header.stamp == stamp_at(10.2) for one in node.poses),
        'the pose of the image',
    )
    known = np.isfinite(positions.covariances[:, :3, :3]).all()
    assert known == (pose_type == 'PoseWithCovarianceStamped')


def test_the_stated_uncertainty_covers_the_errors_of_noisy_poses(begin: Begin) -> None:
    node = begin('PoseWithCovarianceStamped')
    random, images = np.random.default_rng(4), 150
    spread = SCENE.pose((1.5, 1.5, 2.0, *np.radians((0.3, 0.3, 1.0)))).covariance
    errors = random.multivariate_normal(np.zeros(6), spread, images)
    distances = []
    plane = SCENE.to_enu[:2]
    for number, error in enumerate(errors):
        node.tell_pose(100.0 + number, error=error, covariance=spread)
        node.send_hulls(100.0 + number)
        _, positions = node.answer_at(100.0 + number)
        off = plane @ (positions.points[0] - ecef(HULLS[0, 0], HULLS[1, 0], 0.0))
        stated = plane @ positions.covariances[0, :3, :3] @ plane.T
        distances.append(off @ np.linalg.solve(stated, off))
    # Of a normal distribution in the plane: 39 % within one standard deviation, 86 % within two.
    assert np.mean(np.array(distances) < 1.0) == pytest.approx(0.39, abs=0.1)
    assert np.mean(np.array(distances) < 4.0) == pytest.approx(0.86, abs=0.07)


def test_an_image_without_a_pose_goes_on_after_a_time_and_the_reason_is_said(
    begin: Begin,
) -> None:
    node = begin('PoseStamped', pose_max_age=0.2)
    node.tell_pose(10.0)
    node.send_hulls(12.0)
    tracked, positions = node.answer_at(12.0)
    assert np.isnan(positions.points).all()
    assert all(one.id for one in tracked.detections)
    node.wait(lambda: node.count('ships_unplaced.no_pose') == 3, 'the reason')
    node.wait_for_log('the nearest pose is 2 s earlier')


def test_without_any_poses_no_image_waits(begin: Begin) -> None:
    node = begin('PoseStamped')
    # The last pose is longer ago than any frame waits.
    time.sleep(4.2)
    started = time.monotonic()
    for number in range(5):
        node.send_hulls(20.0 + number)
        node.answer_at(20.0 + number)
    # Waiting would take 20 s.
    assert time.monotonic() - started < 15.0
    assert node.count('ships_unplaced.no_pose') == 15


def test_poses_that_are_none_are_refused_and_said(begin: Begin) -> None:
    node = begin('PoseStamped')
    node.tell_pose(10.0, frame='map')
    node.tell_pose(10.0, attitude=(np.nan, 0.0, 0.0, 1.0))
    node.tell_pose(10.0, attitude=(0.0, 0.0, 0.0, 0.0))
    node.wait(lambda: node.counts()['poses_refused.camera_pose'] == 3, 'the refusals')
    node.wait_for_log("frame 'map', not 'earth'")
    node.tell_pose(11.0)
    node.send_hulls(11.0)
    assert_right(node.answer_at(11.0)[1])


def test_ships_of_another_length_are_left_out_while_the_node_runs(begin: Begin) -> None:
    node = begin('PoseStamped')
    node.tell_pose(10.0)
    node.send_hulls(10.0)
    assert len(node.answer_at(10.0)[1]) == 3
    node.set({'min_length': 10.0, 'max_length': 20.0})
    node.tell_pose(11.0)
    node.send_hulls(11.0)
    tracked, positions = node.answer_at(11.0)
    assert len(tracked.detections) == len(positions) == 1
    assert positions.sizes[0, 0] == pytest.approx(12.0, rel=0.01)
    node.wait(lambda: node.count('detections_left_out.length') == 2, 'the count')


def test_a_node_with_a_pose_that_cannot_be_does_not_start(site: Site) -> None:
    with site.start('ship_tracker', parameters={'pose_type': 'NavSatFix'}) as process:
        assert process.wait() == 1
        assert 'cannot start: camera_mount is missing' in process.log


@pytest.mark.parametrize('frame', ['', 'earth', 'a_longer_frame'])
def test_poses_are_read_as_rclpy_writes_them(frame: str) -> None:
    for name, (_, make) in KINDS.items():
        message = make(stamp_at(5.25))
        message.header.frame_id = frame
        read = read_pose(serialize_message(message), name)
        inner = message.pose if name == 'PoseStamped' else message.pose.pose
        assert read.position == (inner.position.x, inner.position.y, inner.position.z)
        assert read.orientation[3] == inner.orientation.w
        assert (read.stamp, read.frame_id) == ((5, 250_000_000), frame)
        if name != 'PoseStamped':
            assert read.covariance == tuple(message.pose.covariance)
    place = fix(stamp_at(5.25))
    place.header.frame_id = frame
    place.status.status, place.position_covariance_type = -1, 2
    place.position_covariance = np.arange(9.0)
    assert read_fix(serialize_message(place)) == WireFix(
        (5, 250_000_000), -1, (54.2, 12.1, 150.0), tuple(np.arange(9.0)), 2
    )
    lying = attitude(stamp_at(5.25))
    lying.header.frame_id, lying.orientation_covariance = frame, np.arange(9.0)
    assert read_attitude(serialize_message(lying)) == WireAttitude(
        (5, 250_000_000), (0.0, 0.0, 0.0, 1.0), tuple(np.arange(9.0))
    )


@pytest.mark.parametrize('count', [0, 1, 3, 50])
def test_positions_are_written_as_rclpy_reads_them(count: int) -> None:
    random = np.random.default_rng(count)
    written = WirePositions(
        (5, 6),
        'earth',
        [f'{"session" * (row % 3)}-{row}' for row in range(count)],
        ['ship' * (row % 3) for row in range(count)],
        random.random(count),
        random.random((count, 3)),
        random.random((count, 4)),
        random.random((count, 2)),
        random.random((count, 6, 6)),
        [(4, row) for row in range(count)],
    )
    data = written.to_bytes()
    message = deserialize_message(data, Detection3DArray)
    assert message.header.frame_id == 'earth'
    for row, one in enumerate(message.detections):
        assert (one.id, one.header.stamp.nanosec) == (written.ids[row], row)
        assert one.results[0].hypothesis.class_id == written.class_ids[row]
        assert one.results[0].hypothesis.score == written.scores[row]
        assert tuple(one.results[0].pose.covariance) == tuple(written.covariances[row].ravel())
        assert one.bbox.center == one.results[0].pose.pose
        assert one.bbox.center.position.z == written.points[row, 2]
        assert one.bbox.center.orientation.x == written.attitudes[row, 0]
        assert (one.bbox.size.x, one.bbox.size.y, one.bbox.size.z) == (*written.sizes[row], 0.0)
    for encoded in (data, serialize_message(message)):
        read = read_positions(encoded)
        for name, value in vars(written).items():
            np.testing.assert_array_equal(getattr(read, name), value)


def test_positions_of_others_may_have_no_hypothesis() -> None:
    message = Detection3DArray()
    for number in range(3):
        message.detections.append(Detection3D(id=str(number)))
    read = read_positions(serialize_message(message))
    assert list(read.ids) == ['0', '1', '2']
    assert np.isnan(read.covariances).all()


def test_the_ships_of_a_played_pass_are_where_the_image_says(site: Site) -> None:
    over = StraightPass(54.2, 12.1, 500e3, 1.0, HARBOUR_SIZE)
    true = harbour().boxes()
    latitudes, longitudes = over.places(true.center)
    with Tracker(site, 'PoseStamped', ids='assign') as node:
        played = {'pass_height': 300, 'pass_step': 100, 'pass_altitude': 500e3, 'rate': 10.0}
        played |= {'pass_latitude': 54.2, 'pass_longitude': 12.1}
        with site.start('play_detections', namespace=node.namespace, parameters=played) as player:
            node.wait(lambda: not player.running, 'the end of the pass')
            assert player.wait() == 0
        node.wait(lambda: len(node.positions) == 6, 'all positions')
        ships: dict[str, list[Detection3D]] = {}
        for message in node.positions:
            for ship in message.detections:
                ships.setdefault(ship.id, []).append(ship)
    assert len(ships) == pytest.approx(len(true), abs=1)
    for views in ships.values():
        points = [view.bbox.center.position for view in views]
        found = np.array([(point.x, point.y, point.z) for point in points])
        longitude, latitude, _ = TO_GEODETIC.transform(*found.T)
        _, _, away = GEOD.inv(
            *np.broadcast_arrays(longitudes, latitudes, longitude[0], latitude[0])
        )
        (row,) = np.flatnonzero(away < 0.01)
        # Of all its views.
        assert np.ptp(found, axis=0).max() < 0.001
        lengths = [view.bbox.size.x for view in views]
        np.testing.assert_allclose(lengths, true.length[row], rtol=1e-4)
