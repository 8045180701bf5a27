# SPDX-License-Identifier: Apache-2.0
"""Messages of a detector over the Earth: places, lengths, courses, and why a ship has none."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from cdr import Detection
from cdr import Message
from cdr import encode
from hypothesis import given
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from obbhbb_ros import OrientedBoxes
from obbhbb_ros.downlink.cameras import CameraChoice
from obbhbb_ros.earth.ellipsoid import first_hits
from obbhbb_ros.earth.placement import place
from obbhbb_ros.earth.pose import PoseError
from obbhbb_ros.earth.pose_source import CameraPoses
from obbhbb_ros.earth.pose_source import VehiclePoses
from obbhbb_ros.earth.pose_sweep import swept_pose
from obbhbb_ros.earth.quaternions import matrices_of_vectors
from obbhbb_ros.earth.quaternions import unit_quaternion
from obbhbb_ros.earth.reported import ShipPlaces
from obbhbb_ros.earth.reprojection import Viewpoint
from obbhbb_ros.identification import ShipIdentifier
from obbhbb_ros.identification import TrackerOutputs
from obbhbb_ros.pipeline import Output
from obbhbb_ros.reports.seen_ships import ShipCollector
from obbhbb_ros.settings.ship_tracker import SHIP_TRACKER
from obbhbb_ros.wire.camera import WireCamera
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.layouts import INPUT_TYPES
from obbhbb_ros.wire.poses import WireAttitude
from obbhbb_ros.wire.poses import WireFix
from obbhbb_ros.wire.poses import WirePose
from obbhbb_ros.wire.poses import read_pose
from obbhbb_ros.wire.positions import WirePositions
from obbhbb_ros.wire.positions import read_positions

pytest.importorskip('pyproj')

from geodesy import GEOD
from geodesy import TO_GEODETIC
from geodesy import Scene
from geodesy import ecef
from geodesy import quaternion_of

TYPE = INPUT_TYPES['Detection2DArray']
ORBIT = Scene(tilt=20.0)
DRONE = Scene(height=120.0, focal=3000.0, tilt=35.0)
STAMP, MIDDLE = (100, 0), (100, 500_000_000)
LEVEL = (0.0, 0.0, 0.0, 1.0)
HOSTILE = st.one_of(
    st.floats(-1e7, 1e7), st.sampled_from([0.0, math.nan, math.inf, -math.inf, 1e308, 5e-324])
)
COURSES = np.array([10.0, 100.0, 190.0, 280.0, 55.0])
LENGTHS = np.array([20.0, 60.0, 120.0, 250.0, 9.0])


def camera_of(scene, **changes):
    """Describe the camera of a scene as its message does."""
    k = (scene.focal, 0.0, scene.center[0], 0.0, scene.focal, scene.center[1], 0.0, 0.0, 1.0)
    camera = WireCamera(
        MIDDLE, 'camera', (4096, 3072), scene.model, scene.d, k, (0, 0, 4096, 3072), (1, 1)
    )
    return replace(camera, **changes)


def pose_of(scene, stamp=MIDDLE, frame='earth', covariance=()):
    """Write the pose of a scene as its message does."""
    position, attitude = scene.position, quaternion_of(scene.matrix)
    return WirePose(stamp, frame, tuple(position), tuple(attitude), covariance)


def hulls(scene, lengths=LENGTHS, courses=COURSES):
    """Lay hulls side by side below the camera; latitude, longitude, course, length, width."""
    pixels = np.stack((np.linspace(600, 3400, len(lengths)), np.full(len(lengths), 1500.0)), 1)
    rays = scene.camera.rays(pixels) @ scene.matrix.T
    longitude, latitude, _ = TO_GEODETIC.transform(*first_hits(scene.position, rays).T)
    return latitude, longitude, courses, lengths, lengths / 6


def message_of(boxes, stamp=MIDDLE):
    """Write the boxes as a detector does."""
    rows = boxes.xywhr[:, [0, 1, 4, 2, 3]]
    return encode(
        Message(stamp=stamp, detections=tuple(Detection(bbox=tuple(row), id='') for row in rows))
    )


class Tracker:
    """A tracker without its node, and what it publishes."""

    def __init__(self, poses, **values) -> None:
        given = {'pose_type': 'PoseStamped', 'heading': 'theta', **values}
        self.settings = SHIP_TRACKER.settings(given)
        self.identifier = ShipIdentifier(poses)

    def answer(self, data, camera):
        """Answer a message; return outcome, tracked detections, positions and poses."""
        tracked, positions, poses = [], [], []
        outputs = TrackerOutputs(*(Output(sent.append) for sent in (tracked, positions, poses)))
        choice = None if camera is None else CameraChoice(camera, has_stamp=True)
        outcome = self.identifier.answer(data, TYPE, self.settings, choice, outputs)
        return outcome, Detections(tracked[0]), read_positions(positions[0]), poses


def placed(scene, poses, boxes, camera=None, **values):
    """Place boxes of a scene; return what a tracker answers."""
    return Tracker(poses, **values).answer(message_of(boxes), camera or camera_of(scene))


def known(*poses):
    """Return a source that has these poses."""
    source = CameraPoses()
    for pose in poses:
        source.add(pose)
    return source


def facts_of(positions, row=0, camera_position=None):
    """Tell what the ground is told of a ship."""
    return ShipPlaces(positions, camera_position).facts(positions.ids[row])


def assert_right(positions, truth):
    """Hold positions against hulls: within 1 m and 1 %."""
    latitude, longitude, course, length, _ = truth
    seen_longitude, seen_latitude, height = TO_GEODETIC.transform(*positions.points.T)
    assert GEOD.inv(longitude, latitude, seen_longitude, seen_latitude)[2].max() < 1.0
    assert np.abs(height).max() < 0.01
    np.testing.assert_allclose(positions.sizes[:, 0], length, rtol=0.01)
    seen = [facts_of(positions, row)['course'] for row in range(len(course))]
    assert np.abs((np.array(seen) - course + 180) % 360 - 180).max() < 0.1


@pytest.mark.parametrize('scene', [ORBIT, DRONE], ids=['orbit', 'drone'])
def test_ships_are_where_they_are_and_in_the_order_of_the_detections(scene) -> None:
    truth = hulls(scene)
    outcome, tracked, positions, poses = placed(scene, known(pose_of(scene)), scene.boxes(*truth))
    assert_right(positions, truth)
    assert positions.ids == tracked.ids()
    assert all(positions.ids)
    assert (positions.frame_id, positions.stamp) == ('earth', MIDDLE)
    assert positions.class_ids == tracked.class_ids()
    np.testing.assert_array_equal(positions.scores, tracked.scores())
    assert not any(key.startswith('ships_unplaced') for key in outcome.counts)
    (pose,) = (read_pose(data, 'PoseWithCovarianceStamped') for data in poses)
    assert pose.position == tuple(scene.position)


def test_a_pose_is_interpolated_and_never_extrapolated() -> None:
    ahead, behind = (replace(ORBIT, latitude=54.2 + off) for off in (0.03, -0.03))
    truth = hulls(ORBIT)
    boxes = ORBIT.boxes(*truth)
    around = [pose_of(behind, (100, 0)), pose_of(ahead, (101, 0))]
    outcome, _, positions, _ = placed(ORBIT, known(*around), boxes)
    # Half a second from both: the path is above the line by 1 m.
    seen_longitude, seen_latitude, _ = TO_GEODETIC.transform(*positions.points.T)
    assert GEOD.inv(truth[1], truth[0], seen_longitude, seen_latitude)[2].max() < 2.0
    assert [own[1] for own in positions.own_stamps] == [0] * 5
    for source in (known(around[0]), known(around[1]), CameraPoses()):
        outcome, tracked, positions, poses = placed(ORBIT, source, boxes)
        assert outcome.counts['ships_unplaced.no_pose'] == 5
        assert np.isnan(positions.points).all()
        assert positions.ids == tracked.ids()
        assert poses == []
    assert 'no pose has come' in outcome.complaints['no_pose']
    assert 'before and after it' in outcome.complaints['no_pose']
    outcome, *_ = placed(ORBIT, known(*around), boxes, pose_max_age=0.4)
    assert 'the nearest pose is 0.5 s' in outcome.complaints['no_pose']


def test_a_vehicle_with_place_attitude_and_mount_is_as_good_as_a_pose() -> None:
    truth = hulls(DRONE)
    # The body level, front to the north; the camera turned to the scene's azimuth and tilt.
    mount = quaternion_of(DRONE.to_enu @ DRONE.matrix)
    vehicle = VehiclePoses()
    place = (DRONE.latitude, DRONE.longitude, DRONE.height)
    for stamp in ((100, 0), (101, 0)):
        vehicle.add_fix(WireFix(stamp, 0, place, (1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0), 2))
        spread = (1e-6, 0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 0.0, 1e-6)
        vehicle.add_attitude(WireAttitude(stamp, LEVEL, spread))
    values = {'pose_type': 'NavSatFix', 'camera_mount': mount.tolist()}
    _, _, positions, _ = placed(DRONE, vehicle, DRONE.boxes(*truth), **values)
    assert_right(positions, truth)
    major, minor, _ = facts_of(positions)['sigma_m']
    assert 1.0 <= minor < major < 1.5


def test_a_line_of_a_pushbroom_camera_has_its_own_pose() -> None:
    speed, readout = 7000.0, 0.6
    scenes = [replace(ORBIT, tilt=0.0, latitude=54.2 + speed * t / 111_200) for t in (0, 1)]
    source = known(*(pose_of(scene, (100 + t, 500_000_000)) for t, scene in enumerate(scenes)))
    first, last = (source.at((100 + t, 500_000_000), 1.0).pose for t in (0, 1))
    lines = np.array([100.0, 1500.0, 2900.0])
    camera = ORBIT.camera
    for line in lines:
        pose = first.toward(last, readout * line / 3072)
        ray = (camera.rays([[2000.0, line]]) @ pose.matrix.T)[0]
        expected = first_hits(pose.position, ray)
        boxes = OrientedBoxes.from_xywhr([[2000.0, line, 40.0, 8.0, 0.0]])
        _, _, positions, _ = placed(ORBIT, source, boxes, readout=readout)
        np.testing.assert_allclose(positions.points[0], expected, atol=0.02)
        _, _, still, _ = placed(ORBIT, source, boxes)
        moved = np.linalg.norm(still.points[0] - positions.points[0])
        assert moved == pytest.approx(speed * readout * line / 3072, rel=0.1)
    # The last line comes after the last pose.
    outcome, *_ = placed(ORBIT, source, boxes, readout=1.5)
    assert outcome.counts['ships_unplaced.no_pose'] == 1


def test_a_sweep_without_motion_is_a_pose() -> None:
    pose = ORBIT.pose()
    sweep = swept_pose(lambda seconds: pose, 3.0, 3072)
    lines, rays = np.array([0.0, 3072.0, 5000.0, np.nan]), np.random.default_rng(1).random((4, 3))
    np.testing.assert_allclose(sweep.turned(rays, lines), pose.turned(rays, lines))
    np.testing.assert_allclose(sweep.origins(lines), np.tile(pose.position, (4, 1)))
    assert swept_pose(lambda seconds: pose if seconds < 2 else None, 3.0, 3072) is None


@pytest.mark.parametrize(
    ('reason', 'scene', 'camera', 'words'),
    [
        ('no_camera', ORBIT, {'k': 9 * (0.0,)}, 'not calibrated'),
        ('no_camera', ORBIT, {'model': 'unheard', 'd': (0.1,)}, 'unheard'),
        ('above_horizon', replace(ORBIT, tilt=120.0), {}, 'above the horizon'),
        ('above_horizon', replace(ORBIT, tilt=68.5), {}, 'above the horizon'),
        ('low', replace(ORBIT, tilt=67.65), {}, 'min_elevation'),
        ('below_surface', replace(DRONE, height=-20.0), {}, 'surface_height'),
        ('lens', replace(ORBIT, focal=1000.0), {'d': (-30.0, 0.0, 0.0, 0.0)}, 'no inverse'),
    ],
)
def test_a_ship_without_a_place_is_counted_with_its_reason(reason, scene, camera, words) -> None:
    # Away from the axis of the lens.
    boxes = ORBIT.boxes(*hulls(ORBIT))[[0, 1, 3, 4]]
    outcome, tracked, positions, _ = placed(
        scene, known(pose_of(scene)), boxes, camera_of(scene, **camera)
    )
    assert outcome.counts[f'ships_unplaced.{reason}'] == 4
    assert words in outcome.complaints[reason]
    assert np.isnan(positions.points).all()
    assert np.isnan(positions.sizes).all()
    assert facts_of(positions) is None
    assert len(tracked) == len(positions) == 4


def test_without_a_camera_there_is_no_place() -> None:
    tracker = Tracker(known(pose_of(ORBIT)), image_width=4096, image_height=3072)
    boxes = ORBIT.boxes(*hulls(ORBIT))
    outcome, tracked, *_ = tracker.answer(message_of(boxes), None)
    assert outcome.counts['ships_unplaced.no_camera'] == 5
    assert all(tracked.ids())


def test_ships_of_another_length_are_not_passed_on_and_those_without_a_place_are() -> None:
    truth = hulls(ORBIT)
    boxes = ORBIT.boxes(*truth)
    limits = {'min_length': 15.0, 'max_length': 130.0}
    outcome, tracked, positions, _ = placed(ORBIT, known(pose_of(ORBIT)), boxes, **limits)
    assert outcome.counts['detections_left_out.length'] == 2
    assert outcome.counts['detections_received'] == 5
    assert_right(positions, [part[:3] for part in truth])
    assert positions.ids == tracked.ids()
    np.testing.assert_allclose(tracked.xywhr(), boxes.xywhr[:3])
    outcome, tracked, positions, _ = placed(ORBIT, CameraPoses(), boxes, **limits)
    assert len(tracked) == 5
    assert 'detections_left_out.length' not in outcome.counts


def test_without_a_heading_the_course_is_ambiguous() -> None:
    truth = hulls(ORBIT)
    boxes, source = ORBIT.boxes(*truth), known(pose_of(ORBIT))
    _, _, sure, _ = placed(ORBIT, source, boxes)
    _, _, unsure, _ = placed(ORBIT, source, boxes, heading='none')
    for row, course in enumerate(truth[2]):
        assert facts_of(sure, row)['course_ambiguous'] is False
        facts = facts_of(unsure, row)
        assert facts['course_ambiguous'] is True
        assert abs((facts['course'] - course + 90) % 180 - 90) < 0.1


def test_the_ground_is_told_where_a_ship_is_and_how_well_that_is_known() -> None:
    sigmas = np.array((5.0, 6.0, 4.0, *np.radians((0.01, 0.012, 0.02))))
    truth = hulls(ORBIT)
    pose = ORBIT.pose(sigmas)
    spread = tuple(pose.covariance.ravel())
    boxes = ORBIT.boxes(*truth)
    _, _, positions, _ = placed(ORBIT, known(pose_of(ORBIT, covariance=spread)), boxes)
    facts = facts_of(positions, 2, ORBIT.position)
    expected = place(boxes, ORBIT.camera, pose)
    assert facts['sigma_m'] == pytest.approx(expected.ellipses[2], abs=0.06)
    assert facts['look_deg'] == pytest.approx(90 - expected.elevation[2], abs=0.01)
    assert facts['lat'] == pytest.approx(truth[0][2], abs=2e-7)
    assert facts['lon'] == pytest.approx(truth[1][2], abs=2e-7)
    assert facts['length_m'] == pytest.approx(120.0, abs=0.2)
    assert facts['pose_age'] == 0.0


@pytest.mark.parametrize(('course', 'heading'), [(359.98, 'theta'), (179.98, 'none')])
def test_no_course_is_told_as_a_full_circle(course, heading) -> None:
    truth = hulls(ORBIT, courses=np.full(len(LENGTHS), course))
    _, _, positions, _ = placed(ORBIT, known(pose_of(ORBIT)), ORBIT.boxes(*truth), heading=heading)
    assert min(facts_of(positions, row)['course'] for row in range(len(LENGTHS))) == 0.0


def test_the_stated_sigma_covers_what_noisy_poses_give() -> None:
    scene, sigmas = DRONE, np.array((1.5, 1.5, 2.0, *np.radians((0.3, 0.3, 1.0))))
    latitude, longitude, course, length, width = (part[2:3] for part in hulls(scene))
    boxes = scene.boxes(latitude, longitude, course, length, width)
    spread = scene.pose(sigmas).covariance
    random, draws = np.random.default_rng(7), 400
    inside = []
    for moved in random.multivariate_normal(np.zeros(6), spread, draws):
        (turn,) = matrices_of_vectors(moved[None, 3:])
        noisy = WirePose(
            MIDDLE,
            'earth',
            tuple(scene.position + moved[:3]),
            tuple(unit_quaternion(quaternion_of(turn @ scene.matrix))),
            tuple(spread.ravel()),
        )
        _, _, positions, _ = placed(scene, known(noisy), boxes)
        off = positions.points[0] - ecef(latitude, longitude, 0.0)[0]
        plane = scene.to_enu[:2]
        inside.append(
            plane
            @ off
            @ np.linalg.solve(plane @ positions.covariances[0, :3, :3] @ plane.T, plane @ off)
        )
    # Of a normal distribution in the plane: 39 % within one standard deviation, 86 % within two.
    assert np.mean(np.array(inside) < 1.0) == pytest.approx(0.39, abs=0.06)
    assert np.mean(np.array(inside) < 4.0) == pytest.approx(0.86, abs=0.05)


@pytest.mark.parametrize('stamp', [(2**31 - 1, 2**32 - 1), (-(2**31), 0), (100, 2**32 - 1)])
@pytest.mark.parametrize('is_known', [False, True])
def test_any_stamp_that_a_message_can_hold_is_answered(stamp, is_known) -> None:
    poses = known(pose_of(ORBIT, stamp)) if is_known else known()
    tracker = Tracker(poses, readout=0.01)
    data = message_of(ORBIT.boxes(*hulls(ORBIT)), stamp)
    _, tracked, positions, _ = tracker.answer(data, camera_of(ORBIT))
    assert tracked.stamp == positions.stamp == stamp


def test_poses_in_another_frame_are_refused() -> None:
    with pytest.raises(PoseError, match="frame 'map', not 'earth'"):
        CameraPoses().add(pose_of(ORBIT, frame='map'))


@pytest.mark.parametrize(
    ('values', 'words'),
    [
        ({'pose_type': 'NavSatFix'}, 'camera_mount is missing: NavSatFix needs'),
        ({'pose_type': 'NavSatFix', 'camera_mount': [1.0, 2.0]}, 'camera_mount must be'),
        ({'min_length': 5.0}, 'min_length needs a pose'),
        ({'pose_type': 'Odometry', 'min_length': 5.0, 'max_length': 4.0}, 'at most max_length'),
    ],
)
def test_settings_that_cannot_work_are_refused(values, words) -> None:
    with pytest.raises(ValueError, match=words):
        SHIP_TRACKER.settings(values)


def test_positions_in_another_frame_or_of_ids_that_name_no_ship_are_not_believed() -> None:
    _, _, positions, _ = placed(ORBIT, known(pose_of(ORBIT)), ORBIT.boxes(*hulls(ORBIT)))
    ids = ['twice', '', 'twice', *positions.ids[3:]]
    places = ShipPlaces(replace(positions, ids=ids))
    assert [places.facts(ship) is not None for ship in ids] == [False, False, False, True, True]
    assert places.facts('nobody') is None
    with pytest.raises(PoseError, match="frame 'map', not 'earth'"):
        ShipPlaces(replace(positions, frame_id='map'))


@given(
    hnp.arrays(np.float64, (1, 7), elements=HOSTILE),
    hnp.arrays(np.float64, (1, 2), elements=HOSTILE),
    hnp.arrays(np.float64, (1, 6, 6), elements=HOSTILE),
    hnp.arrays(np.float64, (3,), elements=HOSTILE),
)
@settings(deadline=None)
def test_hostile_positions_give_facts_that_json_can_express(pose, size, spread, camera) -> None:
    positions = WirePositions(
        STAMP, 'earth', ['x'], [''], np.ones(1), pose[:, :3], pose[:, 3:], size, spread, [STAMP]
    )
    facts = ShipPlaces(positions, camera).facts('x')
    json.dumps(facts, allow_nan=False)


def test_ships_keep_their_ids_however_the_camera_turns_if_its_pose_is_known() -> None:
    scenes = [
        replace(DRONE, tilt=tilt, azimuth=azimuth, latitude=54.2 + move, height=height)
        for tilt, azimuth, move, height in (
            (10.0, 0.0, 0.0, 120.0),
            (25.0, 200.0, 3e-4, 150.0),
            (15.0, 95.0, 1e-4, 100.0),
        )
    ]
    ships = np.array([(54.2001, 12.1, 20.0, 8.0, 2.0), (54.20005, 12.10008, 120.0, 12.0, 3.0)])
    source, tracker = CameraPoses(), None
    seen = []
    for number, scene in enumerate(scenes):
        stamp = (100 + number, 0)
        source.add(pose_of(scene, stamp))
        tracker = tracker or Tracker(source)
        boxes = scene.boxes(*ships.T)[[number % 2, 1 - number % 2]]
        _, tracked, _, _ = tracker.answer(message_of(boxes, stamp), camera_of(scene))
        seen.append(tracked.ids()[:: 1 - 2 * (number % 2)])
    assert seen[0] == seen[1] == seen[2]
    assert len({*seen[0]}) == 2


@given(st.floats(0, 80), st.floats(0, 360), st.floats(0, 80), st.floats(0, 360), st.integers(0, 99))
def test_what_an_image_shows_is_found_in_another_and_back(
    tilt, azimuth, other, toward, seed
) -> None:
    scenes = replace(DRONE, tilt=tilt, azimuth=azimuth), replace(DRONE, tilt=other, azimuth=toward)
    first, second = (Viewpoint(scene.camera, scene.pose(), 0.0) for scene in scenes)
    pixels = np.random.default_rng(seed).uniform((0, 0), (4096, 3072), (50, 2))
    there = first.pixels_in(second, pixels)
    back = second.pixels_in(first, there)
    known = np.isfinite(back).all(axis=1)
    np.testing.assert_allclose(back[known], pixels[known], atol=1e-3)


def test_ships_with_a_place_are_noted_for_the_next_list() -> None:
    truth, collector = hulls(ORBIT), ShipCollector()
    tracker = Tracker(known(pose_of(ORBIT)), min_length=10.0)
    tracker.identifier = ShipIdentifier(known(pose_of(ORBIT)), collector)
    boxes = ORBIT.boxes(*truth)
    _, tracked, _, _ = tracker.answer(message_of(boxes), camera_of(ORBIT))
    ships = collector.take()
    assert [ship.id for ship in ships] == tracked.ids()
    assert [ship.length_m for ship in ships] == pytest.approx(truth[3][:4], rel=0.01)
    assert [ship.course for ship in ships] == pytest.approx(truth[2][:4], abs=0.1)
    assert all(ship.first == 100_500_000_000 for ship in ships)


def test_an_image_without_ships_adds_none_to_the_next_list() -> None:
    collector = ShipCollector()
    tracker = Tracker(known(pose_of(ORBIT)))
    tracker.identifier = ShipIdentifier(known(pose_of(ORBIT)), collector)
    none = OrientedBoxes.from_xywhr(np.empty((0, 5)))
    _, tracked, positions, _ = tracker.answer(message_of(none), camera_of(ORBIT))
    assert not tracked.ids()
    assert not positions.ids
    assert not collector.take()
