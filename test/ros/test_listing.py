# SPDX-License-Identifier: Apache-2.0
"""Ship lists of `ship_tracker` over DDS: every ship of a pass comes down, before any chip."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from harness import Converter
from harness import Node
from harness import Site
from harness import unexplained
from harness import values_of
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo
from ships import detections
from vision_msgs.msg import Detection3DArray

from obbhbb_ros.reports.ship_list import read_ship_list
from obbhbb_ros.reports.ship_report import ShipReport
from obbhbb_ros.wire.positions import read_positions

pytest.importorskip('pyproj')

from geodesy import GEOD
from geodesy import Scene
from geodesy import quaternion_of

# It depends on rclpy alone, which is the same in all environments.
pytestmark = pytest.mark.once

SCENE = Scene(height=150.0, focal=3000.0, tilt=30.0)
# Latitude, longitude, course, length, width.
HULLS = np.array(
    [
        (54.2005, 12.1004, 20.0, 12.0, 2.0),
        (54.2007, 12.1008, 140.0, 8.0, 1.5),
        (54.2006, 12.1002, 280.0, 30.0, 5.0),
    ]
).T
BOXES = SCENE.boxes(*HULLS)


class ListingTracker(Converter):
    """A tracker that lists ships, and what a peer sends it."""

    def __init__(self, site: Site, spool: Path, **parameters: Any) -> None:
        given = {
            'pose_type': 'PoseStamped',
            'heading': 'theta',
            'report_period': 0.5,
            'spool.path': spool,
            **parameters,
        }
        super().__init__(
            site, parameters=given, executable='ship_tracker', topic='tracked_detections'
        )
        self.cameras = self.peer.publisher(CameraInfo, 'camera_info')
        self.poses = self.peer.publisher(PoseStamped, 'camera_pose')
        self.positions: list[Any] = self.peer.collect(Detection3DArray, 'positions')
        self._second = 0

    def look(self) -> None:
        """Send the next image of the scene, a second after the last, with its camera and pose."""
        self._second += 1
        k = [SCENE.focal, 0.0, SCENE.center[0], 0.0, SCENE.focal, SCENE.center[1], 0.0, 0.0, 1.0]
        self.cameras.publish(CameraInfo(width=4096, height=3072, k=k, distortion_model='plumb_bob'))
        pose = PoseStamped()
        pose.header.frame_id, pose.header.stamp.sec = 'earth', self._second
        at, turn = pose.pose.position, pose.pose.orientation
        at.x, at.y, at.z = SCENE.position.tolist()
        turn.x, turn.y, turn.z, turn.w = quaternion_of(SCENE.matrix)
        self.poses.publish(pose)
        message = detections(BOXES.xywhr)
        message.header.stamp.sec = self._second
        self.publisher.publish(message)

    def seen(self) -> set[str]:
        """Return the ids of the ships that had a place so far."""
        messages = [read_positions(serialize_message(message)) for message in self.positions]
        return {
            ship_id
            for message in messages
            for ship_id, point in zip(message.ids, message.points, strict=True)
            if np.isfinite(point).all()
        }


def releasing(site: Site, spool: Path) -> Node:
    """Start `downlink` for a spool and the outbox beside it."""
    node = Node(site, 'downlink')
    node.start(parameters={'spool.path': spool, 'outbox.path': spool.with_name('outbox')})
    return node


def listed(outbox: Path) -> list[ShipReport]:
    """Read all lists in an outbox."""
    ships: list[ShipReport] = []
    for path in outbox.glob('0/ships_*.json'):
        described = json.loads(path.read_bytes())
        suffix = 'geojson.gz' if described['format'] == 'geojson' else 'ships'
        ships += read_ship_list(path.with_suffix(f'.{suffix}').read_bytes())
    return ships


@pytest.mark.parametrize('max_bytes', [0, 340])
def test_every_ship_comes_down_in_a_list(site: Site, tmp_path: Path, max_bytes: int) -> None:
    spool, outbox = tmp_path / 'spool', tmp_path / 'outbox'
    with ListingTracker(site, spool, report_max_bytes=max_bytes) as tracker, releasing(site, spool):
        tracker.send_until(tracker.look, lambda: len(tracker.seen()) >= 3, 'places')
        seen = tracker.seen()
        tracker.wait(lambda: {ship.id for ship in listed(outbox)} >= seen, 'the lists')
        tracker.wait(lambda: tracker.counts()['lists.delivered'] >= 1, 'the books')
        keys = values_of(tracker.next_report())
        lists = {key: value for key, value in keys.items() if 'list' in key}
        assert {'lists.ships_added', 'ships_to_list'} <= lists.keys()
        assert not unexplained(lists, 'ship_tracker.md')
    best = {ship.id: ship for ship in listed(outbox)}
    for latitude, longitude, course, length, _ in HULLS.T:
        (ship,) = (one for one in best.values() if abs(one.length_m / length - 1.0) < 0.02)
        assert GEOD.inv(ship.longitude, ship.latitude, longitude, latitude)[2] < 1.5
        assert abs((ship.course - course + 180.0) % 360.0 - 180.0) < 2.0


def test_a_shutdown_lists_the_ships_of_the_last_period(site: Site, tmp_path: Path) -> None:
    spool, outbox = tmp_path / 'spool', tmp_path / 'outbox'
    with ListingTracker(site, spool, report_period=3600.0) as tracker:
        tracker.send_until(tracker.look, lambda: len(tracker.seen()) >= 3, 'places')
        seen = tracker.seen()
    with releasing(site, spool) as node:
        node.wait(lambda: {ship.id for ship in listed(outbox)} >= seen, 'the list')


@pytest.mark.parametrize(
    ('parameters', 'reason'),
    [
        ({'report_period': 60.0, 'spool.path': 'spool'}, 'report_period needs a pose'),
        ({'report_period': 60.0, 'pose_type': 'Odometry'}, 'report_period needs spool.path'),
        ({'report_max_bytes': 50}, 'report_max_bytes must be 0 or at least'),
    ],
)
def test_lists_that_cannot_be_made_keep_the_node_from_starting(
    site: Site, parameters: dict[str, Any], reason: str
) -> None:
    with site.start('ship_tracker', parameters=parameters) as process:
        assert process.wait() == 1
        assert f'cannot start: {reason}' in process.log
