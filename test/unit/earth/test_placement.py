# SPDX-License-Identifier: Apache-2.0
"""Hulls that PROJ laid on the Earth are found again from their boxes in the image."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros import OrientedBoxes
from obbhbb_ros.earth.ellipsoid import east_north_up
from obbhbb_ros.earth.ellipsoid import first_hits
from obbhbb_ros.earth.pinhole import Pinhole
from obbhbb_ros.earth.placement import Unplaced
from obbhbb_ros.earth.placement import place
from obbhbb_ros.earth.pose import CameraPose
from obbhbb_ros.earth.quaternions import matrices_of_vectors
from obbhbb_ros.earth.quaternions import matrix_of

pytest.importorskip('pyproj')

from geodesy import GEOD
from geodesy import TO_GEODETIC
from geodesy import Scene
from geodesy import quaternion_of
from geodesy import turn

D = (-0.2, 0.06, 0.001, -0.0007, 0.01)
DRONE = Scene(
    height=120.0, focal=3000.0, d=D, offset=(96, 64), binning=(2, 2), center=(2000.5, 1550.5)
)
# Binned, of a long lens, with a window far from the axis.
ORBIT = Scene(d=(-20.0, 300.0, 0.01, -0.02, 0.0), offset=(500, 300), binning=(2, 2))
SCENES = [replace(scene, tilt=tilt) for scene in (DRONE, ORBIT) for tilt in (0.0, 30.0, 45.0)]
SCENES += [replace(DRONE, tilt=75.0), replace(ORBIT, tilt=60.0, height=500e3)]
BOXES = OrientedBoxes.from_xywhr(
    [[700, 600, 120, 30, 0.7], [300, 200, 60, 12, -1.2], [1000, 500, 40, 9, 3.0]], bow=True
)
# Of a pose: east, north, up (m), and turns about them (rad).
DRONE_SIGMAS = (1.5, 1.8, 2.5, *np.radians((0.5, 0.6, 2.0)))
ORBIT_SIGMAS = (5.0, 6.0, 4.0, *np.radians((0.01, 0.012, 0.02)))


def fleet(scene, count=300):
    """Lay hulls where pixels of an image look; latitude, longitude, course, length, width."""
    random = np.random.default_rng(3)
    pixels = random.uniform((100, 80), (1800, 1400), (count, 2))
    rays = scene.camera.rays(pixels) @ scene.matrix.T
    points = first_hits(scene.position, rays)
    # Not those that are low above the horizon, or past it.
    points = points[np.linalg.norm(points - scene.position, axis=1) < 6 * scene.height]
    count = len(points)
    assert count > 100
    longitude, latitude, _ = TO_GEODETIC.transform(*points.T)
    length = random.uniform(10, 300, count) if scene.height > 1e3 else random.uniform(3, 15, count)
    return latitude, longitude, random.uniform(0, 360, count), length, length / 6


@pytest.mark.parametrize('scene', SCENES, ids=lambda s: f'{s.height:.0f} m, {s.tilt:.0f} deg')
def test_hulls_are_found_again(scene) -> None:
    latitude, longitude, course, length, width = fleet(scene)
    boxes = scene.boxes(latitude, longitude, course, length, width)
    ships = place(boxes, scene.camera, scene.pose())
    assert not ships.unplaced.any()
    off = GEOD.inv(longitude, latitude, ships.longitude, ships.latitude)[2]
    # From orbit a ten-millionth of a pixel is 1e-7 m, and the ray is 600 km long.
    assert off.max() < 1e-3
    turned = (ships.course - course + 180) % 360 - 180
    assert np.abs(turned).max() < 1e-3
    np.testing.assert_allclose(ships.length, length, rtol=1e-4)
    # A hull seen at a slant is no rectangle in the image, which a box is.
    np.testing.assert_allclose(np.median(ships.width / width), 1.0, atol=0.3)


@pytest.mark.parametrize('scene', SCENES[:1] + SCENES[3:4], ids=['drone', 'orbit'])
def test_the_width_is_right_where_the_camera_looks_straight_down(scene) -> None:
    hulls = fleet(scene)
    ships = place(scene.boxes(*hulls), scene.camera, scene.pose())
    np.testing.assert_allclose(np.median(ships.width / hulls[4]), 1.0, atol=0.02)


def test_without_a_bow_the_course_is_that_of_one_of_the_ends() -> None:
    ships = place(BOXES, DRONE.camera, DRONE.pose())
    unknown = place(OrientedBoxes.from_xywhr(BOXES.xywhr), DRONE.camera, DRONE.pose())
    np.testing.assert_allclose(unknown.course, ships.course % 180)
    np.testing.assert_allclose(unknown.points, ships.points, atol=1e-9)
    assert (unknown.course < 180).all()
    assert (ships.course >= 180).any()


def test_the_surface_may_be_above_the_ellipsoid() -> None:
    high = replace(DRONE, height=DRONE.height + 40.0)
    low, above = (
        place(BOXES, scene.camera, scene.pose(), height)
        for scene, height in ((DRONE, 0.0), (high, 40.0))
    )
    np.testing.assert_allclose(above.latitude, low.latitude, rtol=0, atol=1e-8)
    np.testing.assert_allclose(above.length, low.length, rtol=1e-4)


def test_the_attitude_of_a_ship_has_x_along_its_course_and_z_up() -> None:
    ships = place(BOXES, DRONE.camera, DRONE.pose())
    for row, attitude in enumerate(ships.attitudes):
        axes = east_north_up(ships.latitude[row], ships.longitude[row])
        ahead, _, up = (axes @ matrix_of(attitude)).T
        course = np.radians(ships.course[row])
        np.testing.assert_allclose(ahead, (np.sin(course), np.cos(course), 0), atol=1e-9)
        np.testing.assert_allclose(up, (0, 0, 1), atol=1e-9)


@pytest.mark.parametrize(
    ('scene', 'sigmas'),
    [(replace(DRONE, tilt=tilt), DRONE_SIGMAS) for tilt in (0.0, 45.0, 75.0)]
    + [(replace(ORBIT, tilt=tilt), ORBIT_SIGMAS) for tilt in (0.0, 30.0, 60.0)],
    ids=lambda value: f'{value.height:.0f} m, {value.tilt:.0f} deg' if hasattr(value, 'd') else '',
)
def test_the_covariance_is_that_of_many_poses(scene, sigmas) -> None:
    pose, boxes = scene.pose(sigmas), BOXES[:1]
    ships = place(boxes, scene.camera, pose)
    random, count = np.random.default_rng(4), 20_000
    errors = random.multivariate_normal(np.zeros(6), pose.covariance, count)
    turns = matrices_of_vectors(errors[:, 3:])
    ends = np.concatenate((boxes.center + boxes.long_axis, boxes.center - boxes.long_axis))
    rays = scene.camera.rays(ends) @ scene.matrix.T
    origins = (pose.position + errors[:, :3])[:, None]
    hits = first_hits(origins, np.einsum('kij,nj->kni', turns, rays))
    axes = east_north_up(ships.latitude[0], ships.longitude[0])
    east, north, _ = axes @ (hits.mean(axis=1) - ships.points[0]).T
    x, y, _ = axes @ (hits[:, 0] - hits[:, 1]).T
    course = np.unwrap(np.arctan2(x, y))
    expected = np.cov((east, north, np.hypot(x, y), course))
    scales = np.sqrt(np.diagonal(expected))
    stated = ships.covariance[0]
    # 20,000 draws tell a standard deviation to half a percent, near the horizon to two.
    np.testing.assert_allclose(np.sqrt(np.diagonal(stated)), scales, rtol=0.05)
    square = np.outer(scales, scales)
    np.testing.assert_allclose(stated / square, expected / square, atol=0.08)


def test_an_ellipse_lies_along_the_larger_uncertainty() -> None:
    # North of a camera that looks north, its pitch is what is known worst.
    scene = replace(DRONE, tilt=70.0, azimuth=0.0)
    ships = place(BOXES[:1], scene.camera, scene.pose((0.1, 0.1, 0.1, 0.02, 1e-4, 1e-4)))
    ((major, minor, azimuth),) = ships.ellipses
    assert major > 10 * minor
    there = GEOD.inv(scene.longitude, scene.latitude, ships.longitude[0], ships.latitude[0])[0]
    assert abs((azimuth - there + 90) % 180 - 90) < 3
    east, north = (ships.covariance[0, i, i] for i in (0, 1))
    assert major**2 + minor**2 == pytest.approx(east + north)


def test_a_pose_without_covariance_gives_none() -> None:
    ships = place(BOXES, DRONE.camera, DRONE.pose())
    assert ships.covariance is None
    assert ships.ellipses is None


def test_a_pose_that_may_miss_the_earth_has_no_covariance() -> None:
    scene = replace(DRONE, tilt=50.0)
    ships = place(BOXES, scene.camera, scene.pose((1, 1, 1, 0.5, 0.5, 0.5)))
    assert not ships.unplaced.any()
    assert np.isnan(ships.covariance).all()


def reasons(boxes=BOXES, scene=DRONE, camera=None, **options):
    """Place boxes; return why they have no place, after a check that all else is NaN there."""
    ships = place(boxes, camera or scene.camera, scene.pose(DRONE_SIGMAS), **options)
    lost = ships.unplaced > 0
    for values in (ships.points, ships.latitude, ships.longitude, ships.length, ships.width):
        assert np.isnan(values[lost]).all()
        assert np.isfinite(values[~lost]).all()
    assert np.isnan(ships.course[lost]).all()
    assert np.isnan(ships.elevation[lost]).all()
    assert np.isnan(ships.covariance[lost]).all()
    return [Unplaced(reason).name for reason in ships.unplaced]


def test_a_ship_without_a_place_has_the_reason() -> None:
    assert reasons() == ['NONE'] * 3
    assert reasons(scene=replace(DRONE, tilt=130.0)) == ['ABOVE_HORIZON'] * 3
    assert reasons(surface_height=200.0) == ['BELOW_SURFACE'] * 3
    assert reasons(scene=replace(DRONE, tilt=50.0), min_elevation=60.0) == ['LOW'] * 3
    folding = Pinhole([900.0, 0, 600, 0, 900.0, 500, 0, 0, 1], [-0.9, 0, 0, 0, 0])
    far = OrientedBoxes.from_xywhr([[600, 500, 60, 9, 0], [1500, 500, 60, 9, 0], [0, 0, 0, 0, 0]])
    assert reasons(far, camera=folding) == ['NONE', 'NO_RAY', 'NO_BOX']


def test_a_ship_that_reaches_past_the_horizon_has_no_place() -> None:
    scene = replace(DRONE, tilt=90.0)
    middle = (scene.center[1] + 0.5 - 64) / 2
    boxes = OrientedBoxes.from_xywhr([[700, middle + 25, 60, 9, np.pi / 2]])
    assert reasons(boxes, scene, min_elevation=0.0) == ['ABOVE_HORIZON']


def test_no_box_is_no_ship() -> None:
    ships = place(OrientedBoxes.from_xywhr([]), DRONE.camera, DRONE.pose(DRONE_SIGMAS))
    assert ships.points.shape == (0, 3)
    assert ships.covariance.shape == (0, 4, 4)
    assert ships.ellipses.shape == (0, 3)
    assert ships.attitudes.shape == (0, 4)


TILTED = replace(DRONE, tilt=40.0)


@given(st.floats(-180, 180))
def test_a_turn_of_the_earth_about_its_axis_changes_the_longitude_alone(angle) -> None:
    ships = place(BOXES, TILTED.camera, TILTED.pose(DRONE_SIGMAS))
    about = turn(2, angle)
    both = np.kron(np.eye(2), about)
    pose = TILTED.pose(DRONE_SIGMAS)
    turned = CameraPose.from_message(
        about @ pose.position,
        quaternion_of(about @ TILTED.matrix),
        both @ pose.covariance @ both.T,
    )
    others = place(BOXES, TILTED.camera, turned)
    apart = (others.longitude - ships.longitude - angle + 180) % 360 - 180
    np.testing.assert_allclose(apart, 0, atol=1e-9)
    for name in ('latitude', 'length', 'width', 'course', 'elevation', 'covariance'):
        expected, found = getattr(ships, name), getattr(others, name)
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7)


def test_a_mirror_of_the_image_mirrors_the_ships() -> None:
    # East of the camera's meridian for west, which turns the courses the other way.
    scene = replace(TILTED, azimuth=0.0, longitude=0.0)
    ships = place(BOXES, scene.camera, scene.pose())
    width = 1920.0
    k = [3000.0, 0, 2 * width + 2 * 96 - 1 - scene.center[0], 0, 3000.0, scene.center[1], 0, 0, 1]
    d = (*D[:3], -D[3], D[4])
    rows = BOXES.xywhr * (-1, 1, 1, 1, -1) + (width, 0, 0, 0, np.pi)
    mirrored = place(
        OrientedBoxes.from_xywhr(rows, bow=True),
        Pinhole(k, d, 'plumb_bob', scene.offset, scene.binning),
        scene.pose(),
    )
    np.testing.assert_allclose(mirrored.latitude, ships.latitude, rtol=0, atol=1e-11)
    np.testing.assert_allclose(mirrored.longitude, -ships.longitude, rtol=0, atol=1e-11)
    np.testing.assert_allclose(mirrored.course, 360 - ships.course, rtol=0, atol=1e-6)
    np.testing.assert_allclose(mirrored.length, ships.length, rtol=1e-9)


@given(st.floats(0.1, 10.0))
def test_a_camera_with_more_pixels_sees_the_same_ships(factor) -> None:
    ships = place(BOXES, TILTED.camera, TILTED.pose(DRONE_SIGMAS))
    half = 0.5 * (factor - 1)
    finer = replace(
        TILTED,
        focal=TILTED.focal * factor,
        center=tuple(factor * c + half for c in TILTED.center),
        offset=tuple(factor * x for x in TILTED.offset),
    )
    boxes = OrientedBoxes.from_xywhr(BOXES.xywhr * (factor, factor, factor, factor, 1), bow=True)
    others = place(boxes, finer.camera, finer.pose(DRONE_SIGMAS))
    for name in ('points', 'length', 'width', 'course', 'elevation', 'covariance'):
        expected, found = getattr(ships, name), getattr(others, name)
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
