# SPDX-License-Identifier: Apache-2.0
"""Geodetic coordinates and rays to the ellipsoid, against PROJ and pymap3d."""

import numpy as np
import pytest
from hypothesis import assume
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.earth.ellipsoid import EQUATOR
from obbhbb_ros.earth.ellipsoid import POLE
from obbhbb_ros.earth.ellipsoid import east_north_up
from obbhbb_ros.earth.ellipsoid import first_hits
from obbhbb_ros.earth.ellipsoid import is_above
from obbhbb_ros.earth.ellipsoid import normals
from obbhbb_ros.earth.ellipsoid import to_ecef
from obbhbb_ros.earth.ellipsoid import to_geodetic

pyproj = pytest.importorskip('pyproj')

LATITUDE = st.floats(-90.0, 90.0)
LONGITUDE = st.floats(-180.0, 180.0)
# What a degree is on the ground, metres.
DEGREE = 111e3
HEIGHTS = (100.0, 10e3, 500e3, 36e6)


def anywhere(random, count):
    """Make up latitudes and longitudes, evenly over the Earth, with the poles and the edges."""
    latitude = np.degrees(np.arcsin(random.uniform(-1, 1, count)))
    longitude = random.uniform(-180, 180, count)
    latitude[:4], longitude[2:6] = (90, -90, 0, 0), (180, -180, 0, 90)
    return latitude, longitude


def test_the_axis_is_that_of_wgs84() -> None:
    assert pytest.approx(6356752.314245, abs=1e-6) == POLE


@pytest.mark.parametrize('height', [-5e6, -1e4, 0.0, 30.0, *HEIGHTS])
def test_geodetic_coordinates_are_those_of_proj(height) -> None:
    latitude, longitude = anywhere(np.random.default_rng(1), 2000)
    transformer = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    expected = np.stack(transformer.transform(longitude, latitude, np.full(2000, height)), axis=1)
    points = to_ecef(latitude, longitude, height)
    np.testing.assert_allclose(points, expected, rtol=0, atol=1e-7)
    back = to_geodetic(points)
    np.testing.assert_allclose(back[0], latitude, rtol=0, atol=1e-8 / DEGREE)
    off = (back[1] - longitude + 180) % 360 - 180
    assert np.abs(off[2:]).max() < 1e-8 / DEGREE
    np.testing.assert_allclose(back[2], height, rtol=0, atol=1e-7)


@pytest.mark.parametrize('point', [(0, 0, 0), (1e5, 1e5, 1e5), (np.nan, 0, 7e6), (np.inf, 0, 0)])
def test_what_is_no_place_has_no_coordinates(point) -> None:
    assert np.isnan(to_geodetic(point)).all()


@pytest.mark.parametrize('place', [(90.1, 0, 0), (np.nan, 0, 0), (0, np.inf, 0)])
def test_what_are_no_degrees_is_no_place(place) -> None:
    assert np.isnan(to_ecef(*place)).any()


@given(LATITUDE, LONGITUDE)
def test_up_is_square_to_the_ellipsoid(latitude, longitude) -> None:
    axes = east_north_up(latitude, longitude)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(np.cross(axes[0], axes[1]), axes[2], atol=1e-15)
    np.testing.assert_allclose(normals(to_ecef(latitude, longitude, 0.0)), axes[2], atol=1e-14)


@pytest.mark.parametrize('height', HEIGHTS)
def test_rays_meet_the_ellipsoid_where_pymap3d_says(height) -> None:
    los = pytest.importorskip('pymap3d.los')
    random, count = np.random.default_rng(2), 10_000
    latitude, longitude = anywhere(random, count)
    azimuth = random.uniform(0, 360, count)
    # To the horizon and a little beyond; up to the antipode of what is below.
    horizon = np.degrees(np.arcsin(POLE / (POLE + height)))
    tilt = random.uniform(0, min(1.02 * horizon, 89.9), count)
    tilt[: count // 4] = horizon - random.uniform(0, 1e-3, count // 4)
    ahead, side = np.sin(np.radians(tilt)), np.radians(azimuth)
    enu = np.stack((ahead * np.sin(side), ahead * np.cos(side), -np.cos(np.radians(tilt))), axis=1)
    axes = east_north_up(latitude, longitude)
    origins = to_ecef(latitude, longitude, height)
    rays = np.einsum('nij,ni->nj', axes, enu)
    points = first_hits(origins, rays)
    with np.errstate(invalid='ignore'):
        expected = los.lookAtSpheroid(latitude, longitude, height, azimuth, tilt)
    expected = to_ecef(np.asarray(expected[0]), np.asarray(expected[1]), 0.0)
    # Within a thousandth of a degree of the horizon rounding decides where a ray touches.
    high = -(rays * normals(points)).sum(axis=1) > 1e-3
    assert high.sum() > count // 2
    assert np.linalg.norm(points - expected, axis=1)[high].max() < 1e-5
    apart = np.isnan(points[:, 0]) != np.isnan(expected[:, 0])
    assert np.count_nonzero(apart) <= 3


@given(LATITUDE, LONGITUDE, st.floats(10.0, 4e7), LATITUDE, LONGITUDE, st.floats(-100.0, 3000.0))
def test_a_hit_lies_on_the_surface_and_no_other_before_it(a, b, above, c, d, height) -> None:
    origin = to_ecef(a, b, height + above)
    assume(is_above(origin, height))
    target = to_ecef(c, d, height)
    ray = target - origin
    hit = first_hits(origin, ray, height)
    facing = -ray @ normals(target, height) / np.linalg.norm(ray)
    if facing > 1e-3:
        np.testing.assert_allclose(hit, target, rtol=0, atol=1e-5 + 0.005 / facing)
    elif facing < -1e-3:
        # The other side of the Earth is hidden.
        assert np.linalg.norm(hit - origin) < np.linalg.norm(ray)
    if np.isfinite(hit).all():
        assert abs(to_geodetic(hit)[2] - height) < 0.01
        assert np.linalg.norm(np.cross(hit - origin, ray)) <= 1e-6 * np.linalg.norm(ray)


def test_a_camera_below_the_surface_or_looking_away_sees_nothing() -> None:
    above, below = (EQUATOR + 10, 0, 0), (EQUATOR - 10, 0, 0)
    assert np.isnan(first_hits(below, [[-1, 0, 0], [1, 0, 0]])).all()
    assert np.isnan(first_hits(above, [[1, 0, 0], [0, 1, 0], [0, 0, 0]])).all()
    np.testing.assert_allclose(first_hits(below, [-1, 0, 0], -20.0), (EQUATOR - 20, 0, 0))
    assert is_above(above)
    assert not is_above(below)
    assert not is_above((np.nan, 0, 0))
