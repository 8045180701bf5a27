# SPDX-License-Identifier: Apache-2.0
"""The whole chain under a camera that flies over ships: each comes down with its place on Earth."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from geometry_msgs.msg import Pose
from geometry_msgs.msg import PoseWithCovarianceStamped
from geometry_msgs.msg import Quaternion
from harness import Node
from harness import Site
from harness import payload_process
from sensor_msgs.msg import CameraInfo
from sensor_msgs.msg import Image
from ships import detections
from vision_msgs.msg import Detection2DArray

pytest.importorskip('pyproj')

from geodesy import GEOD
from geodesy import Scene
from geodesy import quaternion_of

# It depends on rclpy alone, which is the same in all environments.
pytestmark = pytest.mark.once

WIDTH, HEIGHT = 640, 480
FOCAL = 600.0
# Of the pose: east, north, up (m), and turns about them (rad).
SIGMAS = (0.5, 0.5, 0.5, 1e-3, 1e-3, 1e-3)
# latitude, longitude, course, length, width of ships under the path.
SHIPS = np.array(
    [
        (54.2003, 12.1000, 30.0, 40.0, 7.0),
        (54.2010, 12.1010, 120.0, 60.0, 9.0),
        (54.2017, 12.0993, 250.0, 50.0, 8.0),
        (54.2028, 12.1004, 310.0, 30.0, 6.0),
    ]
)


def scene_at(number: int) -> Scene:
    """Return the camera of an image: 300 m high, on its way to the north."""
    return Scene(
        latitude=54.2 + 0.0004 * number,
        longitude=12.1,
        height=300.0,
        tilt=10.0,
        azimuth=0.0,
        focal=FOCAL,
        center=((WIDTH - 1) / 2, (HEIGHT - 1) / 2),
    )


def seen(scene: Scene) -> Any:
    """Return the boxes of the ships that lie wholly in an image."""
    boxes = scene.boxes(*SHIPS.T)
    corners = boxes.corners.reshape(-1, 8)
    inside = (corners > 0).all(axis=1)
    inside &= (corners[:, ::2] < WIDTH).all(axis=1) & (corners[:, 1::2] < HEIGHT).all(axis=1)
    return boxes[inside]


class Flight:
    """What camera, detector and navigator send of each image."""

    def __init__(self, node: Node) -> None:
        publisher = node.peer.publisher
        self.camera = publisher(CameraInfo, 'camera_info')
        self.image = publisher(Image, 'image')
        self.pose = publisher(PoseWithCovarianceStamped, 'camera_pose')
        self.detections = publisher(Detection2DArray, 'detections')

    def send(self, number: int) -> None:
        """Send everything of an image."""
        scene, stamp = scene_at(number), Time(sec=100 + number)
        boxes = seen(scene)
        info = CameraInfo(width=WIDTH, height=HEIGHT, distortion_model='plumb_bob')
        info.k = [FOCAL, 0.0, scene.center[0], 0.0, FOCAL, scene.center[1], 0.0, 0.0, 1.0]
        image = Image(width=WIDTH, height=HEIGHT, encoding='mono8', step=WIDTH)
        image.data = bytes(WIDTH * HEIGHT)
        found = detections(boxes.xywhr)
        pose = PoseWithCovarianceStamped()
        x, y, z, w = quaternion_of(scene.matrix)
        position = dict(zip('xyz', scene.position.tolist(), strict=True))
        pose.pose.pose = Pose(
            position=Point(**position), orientation=Quaternion(x=x, y=y, z=z, w=w)
        )
        pose.pose.covariance = scene.pose(SIGMAS).covariance.ravel()
        for message in (info, image, found, pose):
            message.header.stamp = stamp
        pose.header.frame_id = 'earth'
        # The pose last: what is asked for has to wait for it.
        self.camera.publish(info)
        self.detections.publish(found)
        self.image.publish(image)
        self.pose.publish(pose)


def positions_in(outbox: Path) -> Sequence[dict[str, Any]]:
    """Read the positions of the chips in an outbox."""
    chips = [json.loads(path.read_bytes()) for path in outbox.glob('*/*.json')]
    return [chip['position'] for chip in chips if chip.get('position')]


def test_every_ship_comes_down_with_its_place_length_and_course(site: Site, tmp_path: Path) -> None:
    spool, outbox = {'spool.path': tmp_path / 'spool'}, tmp_path / 'outbox'
    node = Node(site, 'downlink')
    parameters = {
        'ship_tracker': {'pose_type': 'PoseWithCovarianceStamped', 'heading': 'theta'},
        'obb_to_hbb': {'heading': 'theta'},
        'chip_extractor': spool,
        'downlink': spool | {'outbox.path': outbox},
    }
    behind = ['-r', 'obb_to_hbb:detections:=tracked_detections']
    node.process = payload_process(tmp_path, node.namespace, parameters, arguments=behind)
    with node:
        flight = Flight(node)
        # Until all of them hear.
        node.send_until(lambda: flight.send(0), lambda: positions_in(outbox), 'the first place')
        for number in range(1, 9):
            flight.send(number)
            node.peer.spin(0.2)
        last = len(seen(scene_at(8)))
        assert last
        node.wait(lambda: len(seen_ships(outbox)) == len(SHIPS), 'every ship')
    for place in positions_in(outbox):
        off = GEOD.inv(
            *np.full((2, len(SHIPS)), [[place['lon']], [place['lat']]]), SHIPS[:, 1], SHIPS[:, 0]
        )[2]
        ship = SHIPS[off.argmin()]
        assert off.min() < 1.0
        assert place['length_m'] == pytest.approx(ship[3], rel=0.01)
        assert abs((place['course'] - ship[2] + 180) % 360 - 180) < 0.2
        assert place['course_ambiguous'] is False
        major, minor, _ = place['sigma_m']
        assert 0.5 < minor <= major < 2.0
        assert 0.0 < place['look_deg'] < 45.0
        assert place['pose_age'] == 0.0


def seen_ships(outbox: Path) -> set[int]:
    """Tell which ships came down, by their lengths."""
    lengths = [place['length_m'] for place in positions_in(outbox)]
    return {int(np.abs(SHIPS[:, 3] - length).argmin()) for length in lengths}
